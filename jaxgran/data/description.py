"""What determines a run, in words that are the same in every process."""

import dataclasses
import functools
import hashlib
import inspect
import re
import types
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

SHORT = 4
"""Arrays of at most so many numbers are described by their values, longer ones by a digest."""

_OWN = ("jaxgran.", "equinox.", "builtins", "typing", "abc", "collections.abc")


def described(**parts: Any) -> dict[str, str]:
    """A description of each number and each choice of some objects, by name.

    Two runs whose descriptions agree return the same numbers. Arrays are described by type, shape
    and values, classes and functions from outside of jaxgran by name and source code, functions
    also by their defaults and the variables of a surrounding function that they use. What they take
    from their module is not seen.

    Args:
        parts: modules, named tuples, containers, arrays and plain values, by name.

    Returns:
        Such as ``{"scene.clipped": "True", "times": "float64 [1.0, 3.0]"}``.
    """
    return {name: words for part in parts.items() for name, words in _entries(*part)}


def differences(old: dict[str, str], new: dict[str, str]) -> list[str]:
    """Clauses that say what differs between two descriptions, in the order of the new one."""
    names = [*new, *(name for name in old if name not in new)]
    return [
        f"{name} was {old.get(name, 'absent')} and is {new.get(name, 'absent')}"
        for name in names
        if old.get(name) != new.get(name)
    ]


def _entries(name: str, value: Any, above: tuple[Any, ...] = ()) -> Iterator[tuple[str, str]]:
    """Descriptions of a value and its parts; `above` are the functions that it is a part of."""
    value = inspect.unwrap(value) if callable(value) else value  # what jax.jit has wrapped
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        yield name, _array(value)
    elif isinstance(value, types.FunctionType | types.MethodType):
        yield name, f"{value.__module__}.{value.__qualname__} {_digest(_code(value))}"
        if value not in above:
            for child, part in _kept(value):
                yield from _entries(f"{name}.{child}", part, (*above, value))
    else:
        children = _children(value)
        if children is None:
            yield name, re.sub(r" at 0x[0-9a-f]+", "", repr(value))
            return
        yield name, _class(type(value))
        for child, part in children:
            yield from _entries(f"{name}.{child}", part, above)


def _children(value: Any) -> list[tuple[str, Any]] | None:
    """The parts of a container by name; None for a plain value."""
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


def _kept(function: Any) -> list[tuple[str, Any]]:
    """What a function keeps from where it was made, by name: defaults and its closure."""
    plain = getattr(function, "__func__", function)
    kept = [(f"default {k}", part) for k, part in enumerate(plain.__defaults__ or ())]
    kept += [(f"default {name}", part) for name, part in (plain.__kwdefaults__ or {}).items()]
    if plain is not function:
        kept.append(("self", function.__self__))
    cells = zip(plain.__code__.co_freevars, plain.__closure__ or (), strict=True)
    return kept + [(name, cell.cell_contents) for name, cell in cells]


def _array(value: Any) -> str:
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return f"{value.dtype} {_array(jax.random.key_data(value))}"
    array = np.asarray(value)
    kind = f"{array.dtype}{list(array.shape) if array.ndim else ''}"
    if array.size <= SHORT:
        return f"{kind} {array.tolist()}"
    return f"{kind} {_digest(array.tobytes())}"


def _class(kind: type) -> str:
    """The name of a class, with a digest of the code of those of its bases that users define."""
    name = f"{kind.__module__}.{kind.__qualname__}"
    users = [base for base in kind.__mro__ if not f"{base.__module__}.".startswith(_OWN)]
    if not users:
        return kind.__qualname__
    return f"{name} {_digest(b''.join(_code(base) for base in users))}"


def _code(thing: Any) -> bytes:
    """The source code of a class or function, or its compiled code if there is no source."""
    try:
        return inspect.getsource(thing).encode()
    except (OSError, TypeError):
        pass
    functions = [thing, *vars(thing).values()]
    codes = [part.__code__ for part in functions if hasattr(part, "__code__")]
    return b"".join(code.co_code + repr(code.co_names).encode() for code in codes)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]
