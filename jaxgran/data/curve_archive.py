"""Whole curves in a file: every quantity, each replica, the final particles and the header."""

import json
import zipfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxgran.data.curve import CoolingCurve, Particles
from jaxgran.data.files import write_whole

SUFFIX = ".npz"
HEADER = "header"
"""The entry that holds the header, as JSON; all others are arrays."""


def write_archive(path: Path, curve: CoolingCurve, header: dict[str, str]) -> None:
    """Write all arrays of a curve, without loss, to an npz file.

    Names of entries are those of the fields, as ``replicas.temperature``, ``particles.position``.
    """
    arrays: dict[str, Any] = {HEADER: np.array(json.dumps(header)), **_arrays(curve)}
    write_whole(path, lambda file: np.savez_compressed(file, **arrays))


def read_archive(path: Path) -> tuple[CoolingCurve, dict[str, str]]:
    """Read what `write_archive` wrote.

    Raises:
        ValueError: if the file is none of these.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop(HEADER)))
        return _curve(arrays), header
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path}: not a file that jaxgran.write_curve wrote ({error}); give one, or a CSV file"
        ) from None


def _arrays(part: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Arrays of a curve or of its particles by name; those that are None are left out."""
    found = {}
    for name, value in _fields(part).items():
        if isinstance(value, CoolingCurve | Particles):
            found |= _arrays(value, f"{prefix}{name}.")
        elif value is not None:
            found[prefix + name] = np.asarray(value)
    return found


def _fields(part: CoolingCurve | Particles) -> dict[str, Any]:
    return part._asdict() if isinstance(part, Particles) else dict(vars(part))


def _curve(arrays: dict[str, np.ndarray]) -> CoolingCurve:
    own: dict[str, Any] = {k: jnp.asarray(x) for k, x in arrays.items() if "." not in k}
    for name, build in (("replicas", _curve), ("particles", _particles)):
        prefix = f"{name}."
        inner = {k.removeprefix(prefix): x for k, x in arrays.items() if k.startswith(prefix)}
        if inner:
            own[name] = build(inner)
    return CoolingCurve(**own)


def _particles(arrays: dict[str, np.ndarray]) -> Particles:
    return Particles(**{name: jnp.asarray(x) for name, x in arrays.items()})
