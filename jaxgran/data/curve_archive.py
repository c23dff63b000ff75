"""Whole curves in a file: every quantity, each replica, the final particles and the header."""

import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.data.curve import CoolingCurve, Particles
from jaxgran.data.files import write_whole

SUFFIX = ".npz"
KEY = "key:"
"""Before a key of a dictionary in the name of an entry."""

HEADER = "header"
"""The entry that holds the header, as JSON; all others are arrays."""


def write_archive(path: Path, curve: CoolingCurve, header: dict[str, str]) -> None:
    """Write all arrays of a curve, without loss, to an npz file.

    Names of entries are those of the fields, as ``replicas.temperature``, ``particles.position``,
    and, of what was saved, of the places in its tree: ``saved.key:g.0``. Lists come back as tuples.
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
    """Arrays of a curve, its particles and what it saved, by name; None is left out.

    Raises:
        ValueError: for something saved that is no array, dictionary, tuple, list or `Particles`.
    """
    if part is None:
        return {}
    children = _children(part)
    if children is not None:
        nested = (_arrays(value, f"{prefix}.{name}") for name, value in children.items())
        return {name: array for found in nested for name, array in found.items()}
    if not isinstance(part, jax.Array | np.ndarray | np.generic | float | int):
        raise ValueError(
            f"{prefix[1:]} is of type {type(part).__name__}: let `save` return arrays in "
            "dictionaries, tuples or lists"
        )
    return {prefix[1:]: np.asarray(part)}


def _children(part: Any) -> dict[str, Any] | None:
    """What a container holds, by names that tell its type; None if it is none."""
    if isinstance(part, CoolingCurve):
        return dict(vars(part))
    if isinstance(part, Particles):
        return part._asdict()
    if isinstance(part, dict):
        return {f"{KEY}{name}": value for name, value in part.items()}
    if isinstance(part, list) or (isinstance(part, tuple) and not hasattr(part, "_fields")):
        return {str(k): value for k, value in enumerate(part)}
    return None


def _curve(arrays: dict[str, np.ndarray]) -> CoolingCurve:
    builders = {"replicas": _curve, "particles": _tree, "saved": _tree, "saved_error": _tree}
    return CoolingCurve(
        **{name: builders.get(name, _tree)(inner) for name, inner in _grouped(arrays).items()}
    )


def _tree(arrays: dict[str, np.ndarray]) -> Any:
    """An array, or a dictionary, a tuple or `Particles` of arrays."""
    if "" in arrays:
        return jnp.asarray(arrays[""])
    children = {name: _tree(inner) for name, inner in _grouped(arrays).items()}
    if all(name.startswith(KEY) for name in children):
        return {name.removeprefix(KEY): child for name, child in children.items()}
    if all(name.isdigit() for name in children):
        return tuple(children[str(k)] for k in range(len(children)))
    return Particles(**children)


def _grouped(arrays: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Arrays by the first part of their names, and then by the rest."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, array in arrays.items():
        first, _, rest = name.partition(".")
        groups.setdefault(first, {})[rest] = array
    return groups
