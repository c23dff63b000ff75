"""Save a run to a file and resume it: whole or not at all, and only for the same scene."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

FORMAT = 1


def fingerprint(*trees: Any) -> str:
    """A digest of every number and every static choice of some pytrees."""
    digest = hashlib.sha256()
    for tree in trees:
        leaves, structure = jax.tree.flatten(tree)
        digest.update(str(structure).encode())
        for leaf in leaves:
            if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
                leaf = jax.random.key_data(leaf)
            array = np.asarray(leaf)
            digest.update(f"{array.dtype}{array.shape}".encode())
            digest.update(array.tobytes())
    return digest.hexdigest()


def refuse(path: str | Path | None, model: str) -> None:
    """Raises ValueError if there is a path: compiled code, whose run this is, keeps no file."""
    if path is not None:
        raise ValueError(
            f"inside jax.jit, jax.vmap and derivatives {model} keeps no checkpoint: leave "
            f"checkpoint out, got {str(path)!r}"
        )


def write_whole(path: str | Path, write: Callable[[Any], None]) -> None:
    """Call `write` on a new binary file that replaces `path` only once it is complete.

    Raises:
        OSError: naming the path, if it cannot be written; what was there before is then kept.
    """
    path = Path(path)
    name = None
    try:
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=f".{path.name}.", delete=False
        ) as f:
            name = f.name
            write(f)
            f.flush()
            os.fsync(f.fileno())
        os.replace(name, path)
    except BaseException as error:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise OSError(
            error.errno, f"cannot write ({error.strerror}); any earlier file is unharmed", str(path)
        ) from error


def save(path: str | Path, scene: str, tree: Any) -> None:
    """Write the arrays of a pytree, with the fingerprint of the scene they belong to."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    arrays = {f"leaf_{i}": leaf for i, leaf in enumerate(leaves)}
    head = {"format": str(FORMAT), "version": version("jaxgran"), "scene": scene}
    arrays |= {name: np.asarray(text) for name, text in head.items()}
    write_whole(path, lambda f: np.savez(f, allow_pickle=False, **arrays))


def load(path: str | Path, scene: str, like: Any) -> Any:
    """Read what `save` wrote into the structure of `like`.

    Raises:
        ValueError: if the file is no checkpoint, or one of another version, format or scene.
    """
    try:
        with open(path, "rb") as opened, np.load(opened, allow_pickle=False) as file:
            saved = dict(file)
        head = {name: str(saved.pop(name)) for name in ("format", "version", "scene")}
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise ValueError(
            f"{path} is no checkpoint of jaxgran ({error}); name another file, or remove it"
        ) from None
    except Exception as error:  # zipfile raises errors of its own for damaged files
        raise ValueError(f"{path} is damaged ({error}); name another file, or remove it") from None
    if head["format"] != str(FORMAT):
        raise ValueError(
            f"{path} was written by jaxgran {head['version']} in checkpoint format "
            f"{head['format']}, this is format {FORMAT}; finish the run with that version"
        )
    if head["version"] != version("jaxgran"):
        raise ValueError(
            f"{path} was written by jaxgran {head['version']}, this is {version('jaxgran')}, which "
            "may step otherwise; finish the run with that version, or remove the file"
        )
    leaves, structure = jax.tree.flatten(like)
    if head["scene"] != scene or len(saved) != len(leaves):
        raise ValueError(
            f"{path} belongs to another scene: gas, times, model, precision or start differ; name "
            "another file, or remove it to begin anew"
        )
    return jax.tree.unflatten(structure, [saved[f"leaf_{i}"] for i in range(len(leaves))])
