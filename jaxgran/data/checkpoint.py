"""Checkpoints: the state of a run in a file, from which only the same run can be resumed.

The first line of a file is a JSON object: format, version of jaxgran, a description of everything
that determines the run (see `describe_run`, whose words are equal in every process), type and shape
of every array, and the SHA-256 digest of the remaining bytes. These are what
`equinox.tree_serialise_leaves` writes.
"""

import dataclasses
import functools
import hashlib
import inspect
import io
import json
import re
import types
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.data.files import write_atomically

FORMAT = 3

MAX_NAMED = 4
"""Largest number of differences between two runs that an error message names."""


def save(path: str | Path, scene: dict[str, str], tree: Any) -> None:
    """Write the arrays of a pytree to a checkpoint, atomically.

    Args:
        path: the file; an existing one is replaced.
        scene: description of everything that determines the run, from `describe_run`.
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

    write_atomically(path, write)


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
        f"{path} is damaged: its arrays do not match its header. Name another file, or remove it"
    )
    if hashlib.sha256(body).hexdigest() != header["digest"]:
        raise ValueError(damaged)
    _check_run(path, header, scene, _types_and_shapes(like))
    try:
        return eqx.tree_deserialise_leaves(io.BytesIO(body), like)
    except RuntimeError:  # a file made by hand
        raise ValueError(damaged) from None


def _types_and_shapes(tree: Any) -> list[str]:
    """Return type and shape of every leaf, such as "float64(3, 2)"."""
    leaves = jax.tree.leaves(tree)
    return [f"{getattr(leaf, 'dtype', type(leaf).__name__)}{np.shape(leaf)}" for leaf in leaves]


def _read(path: str | Path) -> tuple[dict[str, Any], bytes]:
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
            f"{path} is no checkpoint of jaxgran ({error}). Name another file, or remove it"
        ) from None
    return header, body


def _check_run(
    path: str | Path, header: dict[str, Any], scene: dict[str, str], arrays: list[str]
) -> None:
    differ = differences(header["scene"], scene)
    if not differ and header["arrays"] != arrays:
        differ = ["types or shapes of its arrays differ"]
    if differ:
        more = f" and {len(differ) - MAX_NAMED} more" if len(differ) > MAX_NAMED else ""
        raise ValueError(
            f"{path} belongs to another run: {'; '.join(differ[:MAX_NAMED])}{more}. Name another "
            "file, or remove this one to start a new run"
        )


def _check_version(path: str | Path, header: dict[str, Any]) -> None:
    if header["format"] != FORMAT:
        raise ValueError(
            f"{path} was written by jaxgran {header['version']} in checkpoint format "
            f"{header['format']}, this is format {FORMAT}. Finish the run with that version"
        )
    if header["version"] != version("jaxgran"):
        raise ValueError(
            f"{path} was written by jaxgran {header['version']}, this is {version('jaxgran')}, "
            "which may compute different steps. Finish the run with that version, or remove the "
            "file"
        )


MAX_LISTED_VALUES = 4
"""Largest number of values that describe an array; a digest describes a longer one."""

_LIBRARIES = ("jaxgran.", "equinox.", "builtins", "typing", "abc", "collections.abc")


def describe_run(**parts: Any) -> dict[str, str]:
    """Return a description of each number and each choice of some objects, by name.

    Two runs with equal descriptions return the same numbers. Arrays are described by type, shape
    and values, classes and functions from outside of jaxgran by name and source code, functions
    also by their defaults and the variables of a surrounding function that they use. The variables
    of their module that they use are not part of the description.

    Args:
        parts: modules, named tuples, containers, arrays and plain values, by name.

    Returns:
        Such as ``{"scene.clipped": "True", "times": "float64 [1.0, 3.0]"}``.
    """
    return {name: words for part in parts.items() for name, words in _entries(*part)}


def differences(old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return a clause on each difference of two descriptions, in the order of the new one."""
    names = [*new, *(name for name in old if name not in new)]
    return [
        f"{name} was {old.get(name, 'absent')} and is {new.get(name, 'absent')}"
        for name in names
        if old.get(name) != new.get(name)
    ]


def _entries(name: str, value: Any, enclosing: tuple[Any, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield descriptions of a value and its parts; `enclosing` are functions that contain it."""
    value = inspect.unwrap(value) if callable(value) else value  # remove the wrapper of jax.jit
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        yield name, _array(value)
    elif isinstance(value, types.FunctionType | types.MethodType):
        yield name, f"{value.__module__}.{value.__qualname__} {_digest(_code(value))}"
        if value not in enclosing:
            for child, part in _captured(value):
                yield from _entries(f"{name}.{child}", part, (*enclosing, value))
    else:
        children = _children(value)
        if children is None:
            yield name, re.sub(r" at 0x[0-9a-f]+", "", repr(value))
            return
        yield name, _class(type(value))
        for child, part in children:
            yield from _entries(f"{name}.{child}", part, enclosing)


def _children(value: Any) -> list[tuple[str, Any]] | None:
    """Return the parts of a container by name, or None for a plain value."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [(field.name, getattr(value, field.name)) for field in dataclasses.fields(value)]
    names = getattr(value, "_fields", None)
    if names is not None:
        return [(name, getattr(value, name)) for name in names]
    if isinstance(value, dict):
        return [(str(key), part) for key, part in value.items()]
    if isinstance(value, list | tuple):
        return [(str(i), part) for i, part in enumerate(value)]
    if isinstance(value, functools.partial):
        return [("function", value.func), ("args", value.args), ("keywords", value.keywords)]
    return None


def _captured(function: Any) -> list[tuple[str, Any]]:
    """Return the defaults, the object of a method and the closure of a function, by name."""
    plain = getattr(function, "__func__", function)
    parts = [(f"default {k}", part) for k, part in enumerate(plain.__defaults__ or ())]
    parts += [(f"default {name}", part) for name, part in (plain.__kwdefaults__ or {}).items()]
    if plain is not function:
        parts.append(("self", function.__self__))
    cells = zip(plain.__code__.co_freevars, plain.__closure__ or (), strict=True)
    return parts + [(name, cell.cell_contents) for name, cell in cells]


def _array(value: Any) -> str:
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return f"{value.dtype} {_array(jax.random.key_data(value))}"
    array = np.asarray(value)
    kind = f"{array.dtype}{list(array.shape) if array.ndim else ''}"
    if array.size <= MAX_LISTED_VALUES:
        return f"{kind} {array.tolist()}"
    return f"{kind} {_digest(array.tobytes())}"


def _class(kind: type) -> str:
    """Return the name of a class, with a digest of the code of all bases that users define."""
    name = f"{kind.__module__}.{kind.__qualname__}"
    users = [base for base in kind.__mro__ if not f"{base.__module__}.".startswith(_LIBRARIES)]
    if not users:
        return kind.__qualname__
    return f"{name} {_digest(b''.join(_code(base) for base in users))}"


def _code(thing: Any) -> bytes:
    """Return the source code of a class or function, or its compiled code without source."""
    try:
        return inspect.getsource(thing).encode()
    except (OSError, TypeError):
        pass
    functions = [thing, *vars(thing).values()]
    codes = [part.__code__ for part in functions if hasattr(part, "__code__")]
    return b"".join(code.co_code + repr(code.co_names).encode() for code in codes)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
