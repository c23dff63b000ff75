"""Checkpoints: the state of a run in a file, from which only the same run can be resumed.

The first line is a JSON object: format, version of jaxgran, a description of all that determines
the run, the type and shape of every array, and the SHA-256 digest of the rest. The rest is what
`equinox.tree_serialise_leaves` writes.
"""

import hashlib
import io
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxgran.data.description import differences
from jaxgran.data.files import write_whole

FORMAT = 3

MOST_NAMED = 4
"""Differences between two runs that an error message names."""


def save(path: str | Path, scene: dict[str, str], tree: Any) -> None:
    """Write the arrays of a pytree to a checkpoint, atomically.

    Args:
        path: the file; an existing one is replaced.
        scene: description of everything that determines the run.
        tree: JAX and NumPy arrays and Python numbers.

    Raises:
        OSError: naming the path, if it cannot be written; an existing file is then unchanged.
    """
    body = io.BytesIO()
    eqx.tree_serialise_leaves(body, tree)
    header = {
        "format": FORMAT,
        "version": version("jaxgran"),
        "scene": scene,
        "arrays": _types_and_shapes(tree),
        "digest": hashlib.sha256(body.getbuffer()).hexdigest(),
    }

    def write(file):
        file.write(json.dumps(header).encode() + b"\n")
        file.write(body.getbuffer())

    write_whole(path, write)


def load(path: str | Path, scene: dict[str, str], like: Any) -> Any:
    """Read a checkpoint.

    Args:
        path: the file that `save` wrote.
        scene: description of everything that determines the run.
        like: a pytree with the structure, types and shapes of the saved one.

    Returns:
        A pytree like `like` with the saved values.

    Raises:
        ValueError: if the file cannot be read, is no checkpoint, is damaged, or belongs to another
            version, format or run, naming what differs.
    """
    header, body = _read(path)
    _check_version(path, header)
    damaged = (
        f"{path} is damaged: its arrays do not match its header; name another file, or remove it"
    )
    if hashlib.sha256(body).hexdigest() != header["digest"]:
        raise ValueError(damaged)
    _check_run(path, header, scene, _types_and_shapes(like))
    try:
        return eqx.tree_deserialise_leaves(io.BytesIO(body), like)
    except RuntimeError:  # a file made by hand
        raise ValueError(damaged) from None


def _types_and_shapes(tree: Any) -> list[str]:
    """Type and shape of every leaf, such as "float64(3, 2)"."""
    leaves = jax.tree.leaves(tree)
    return [f"{getattr(leaf, 'dtype', type(leaf).__name__)}{np.shape(leaf)}" for leaf in leaves]


def _read(path: str | Path) -> tuple[dict[str, Any], bytes]:
    """The header and the body of a checkpoint."""
    try:
        with open(path, "rb") as file:
            line = file.readline()
            body = file.read()
        header = json.loads(line)
        missing = {"format", "version", "scene", "arrays", "digest"} - set(header)
        if missing:
            raise ValueError(f"its first line lacks {', '.join(sorted(missing))}")
        if header["format"] == FORMAT and not isinstance(header["scene"], dict):
            raise ValueError("its first line does not describe a run")
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(
            f"{path} is no checkpoint of jaxgran ({error}); name another file, or remove it"
        ) from None
    return header, body


def _check_run(
    path: str | Path, header: dict[str, Any], scene: dict[str, str], arrays: list[str]
) -> None:
    """Refuse a checkpoint of another run."""
    differ = differences(header["scene"], scene)
    if not differ and header["arrays"] != arrays:
        differ = ["the types or shapes of its arrays are others"]
    if differ:
        more = f" and {len(differ) - MOST_NAMED} more" if len(differ) > MOST_NAMED else ""
        raise ValueError(
            f"{path} belongs to another run: {'; '.join(differ[:MOST_NAMED])}{more}. Name another "
            "file, or remove it to begin anew"
        )


def _check_version(path: str | Path, header: dict[str, Any]) -> None:
    """Refuse a checkpoint of another format or another version of jaxgran."""
    if header["format"] != FORMAT:
        raise ValueError(
            f"{path} was written by jaxgran {header['version']} in checkpoint format "
            f"{header['format']}, this is format {FORMAT}; finish the run with that version"
        )
    if header["version"] != version("jaxgran"):
        raise ValueError(
            f"{path} was written by jaxgran {header['version']}, this is {version('jaxgran')}, "
            "which may compute different steps; finish the run with that version, or remove the "
            "file"
        )
