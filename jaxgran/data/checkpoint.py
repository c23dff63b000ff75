"""Checkpoints: the state of a run in a file, from which only the same run can be resumed.

The first line of a file is a JSON object: a description of everything that determines the run (see
`describe_run`, whose words are equal in every process), with the format and the version of jaxgran,
and the SHA-256 digest of the remaining bytes, which `equinox.tree_serialise_leaves` writes.
"""

import dataclasses
import functools
import hashlib
import inspect
import io
import json
import re
import signal
import threading
import types
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.data.files import write_atomically

FORMAT = "5"

MAX_NAMED = 4
"""Largest number of differences between two runs that an error message names."""

MAX_LISTED_VALUES = 4
"""Largest number of values that describe an array; a digest describes a longer one."""

LIBRARIES = ("jaxgran.", "equinox.", "builtins.", "typing.", "abc.", "collections.")
"""Beginnings of names of classes and functions that the versions of packages describe."""

_TERMINATED = threading.Event()
"""Set by SIGTERM during a run that writes checkpoints."""


class Termination(KeyboardInterrupt):
    """SIGTERM during a run that writes checkpoints."""


def stop_if_terminated() -> None:
    """Raise `Termination` after SIGTERM: Python drops errors of signals within callbacks."""
    if _TERMINATED.is_set():
        raise Termination


@contextmanager
def saved_at_termination(path: str | Path | None) -> Iterator[None]:
    """Let SIGTERM end a run as Ctrl-C does, with a checkpoint: batch systems send it.

    The process then ends by that signal. A handler of the user stays, and nothing changes in other
    threads than the main one.

    Args:
        path: of the checkpoint; None without one.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if path is None or not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def interrupt(*_: Any) -> None:
        if not _TERMINATED.is_set():  # a second one must not interrupt the writing
            _TERMINATED.set()
            raise Termination

    signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if _TERMINATED.is_set():
            _TERMINATED.clear()
            signal.raise_signal(signal.SIGTERM)


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
    digest = hashlib.sha256(body.getbuffer()).hexdigest()
    header = json.dumps({"scene": _described(scene, tree), "digest": digest}).encode()
    write_atomically(path, lambda file: file.write(header + b"\n" + body.getbuffer()))


def load(path: str | Path, scene: dict[str, str], like: Any) -> Any:
    """Read a checkpoint.

    Args:
        path: the file that `save` wrote.
        scene: description of everything that determines the run.
        like: a pytree with the structure, types and shapes of the saved one.

    Returns:
        A pytree like `like` with the saved values.

    Raises:
        ValueError: if the file cannot be read, is not a checkpoint, is damaged, or belongs to
            another version, format or run, naming what differs.
    """
    try:
        line, _, body = Path(path).read_bytes().partition(b"\n")
        header = json.loads(line)
        old = dict(header["scene"])
        digest = header["digest"]
    except (OSError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise ValueError(
            f"{path} is not a jaxgran checkpoint ({error}). Name another file, or remove it"
        ) from None
    damaged = (
        f"{path} is damaged: its arrays do not match its header. Name another file, or remove it"
    )
    if differ := differences(old, _described(scene, like)):
        more = f" and {len(differ) - MAX_NAMED} more" if len(differ) > MAX_NAMED else ""
        raise ValueError(
            f"{path} belongs to another run: {'; '.join(differ[:MAX_NAMED])}{more}. Name another "
            "file, or remove this one to start a new run"
        )
    if hashlib.sha256(body).hexdigest() != digest:
        raise ValueError(damaged)
    try:
        return eqx.tree_deserialise_leaves(io.BytesIO(body), like)
    except (RuntimeError, ValueError):  # a file made by hand
        raise ValueError(damaged) from None


def _described(scene: dict[str, str], tree: Any) -> dict[str, str]:
    """Return a description of a run and of its state, such as "float64(3, 2)"."""
    words = [f"{getattr(x, 'dtype', type(x).__name__)}{np.shape(x)}" for x in jax.tree.leaves(tree)]
    made_by = {"format": FORMAT, "version of jaxgran": version("jaxgran")}
    return made_by | scene | {"types and shapes of the state": ", ".join(words)}


def differences(old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Return a clause on each difference of two descriptions, in the order of the new one."""
    return [
        f"{name} was {old.get(name, 'absent')} and is {new.get(name, 'absent')}"
        for name in [*new, *(name for name in old if name not in new)]
        if old.get(name) != new.get(name)
    ]


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


def _entries(name: str, value: Any, enclosing: tuple[Any, ...] = ()) -> Iterator[tuple[str, str]]:
    """Yield descriptions of a value and its parts; `enclosing` are functions that contain it."""
    value = inspect.unwrap(value) if callable(value) else value  # remove the wrapper of jax.jit
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        yield name, _array(value)
        return
    parts = _parts(value)
    if parts is None:
        yield name, re.sub(r" at 0x[0-9a-f]+", "", repr(value))
        return
    is_function = isinstance(value, types.FunctionType | types.MethodType)
    yield name, _source(value) if is_function else _sources(type(value))
    if not any(value is function for function in enclosing):
        enclosing = (*enclosing, value) if is_function else enclosing
        for child, part in parts.items():
            yield from _entries(f"{name}.{child}", part, enclosing)


def _parts(value: Any) -> dict[Any, Any] | None:
    """Return the parts of a container or function by name, or None for a plain value."""
    if isinstance(value, types.MethodType):
        return {"self": value.__self__} | (_parts(value.__func__) or {})
    if isinstance(value, types.FunctionType):
        defaults = dict(enumerate(value.__defaults__ or ())) | (value.__kwdefaults__ or {})
        parts = {f"default {name}": part for name, part in defaults.items()}
        return parts | dict(inspect.getclosurevars(value).nonlocals)
    if isinstance(value, functools.partial):
        return {"function": value.func, "args": value.args, "keywords": value.keywords}
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return value
    if isinstance(value, list | tuple):
        return dict(zip(getattr(value, "_fields", range(len(value))), value, strict=True))
    return None


def _array(value: Any) -> str:
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return f"{value.dtype} {_array(jax.random.key_data(value))}"
    array = np.asarray(value)
    kind = f"{array.dtype}{list(array.shape) if array.ndim else ''}"
    few = array.size <= MAX_LISTED_VALUES
    return f"{kind} {array.tolist() if few else _digest(array.tobytes())}"


def _sources(kind: type) -> str:
    """Return the name of a class, and the sources of the class and all bases that users define."""
    names = [_source(base) for base in kind.__mro__]
    return " ".join([names[0], *(name for name in names[1:] if " " in name)])


def _source(thing: Any) -> str:
    """Return the name of a class or function, with a digest of its code if a user defines it."""
    name = f"{thing.__module__}.{thing.__qualname__}"
    if name.startswith(LIBRARIES):
        return thing.__qualname__
    try:
        code = inspect.getsource(thing)
    except (OSError, TypeError):  # without a file: compiled code
        functions = [getattr(part, "__code__", None) for part in (thing, *vars(thing).values())]
        code = repr([(code.co_code, code.co_names) for code in functions if code])
    return f"{name} {_digest(code.encode())}"


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
