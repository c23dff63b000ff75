"""Objects of this package as JSON and back: modules, named tuples, arrays, numbers, texts."""

import dataclasses
from importlib import import_module
from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

PACKAGE = "jaxgran"


class NotStorable(ValueError):
    """An object, such as a law of a user, that a file cannot hold."""


def to_json(value: Any) -> Any:
    """Return a tree of objects as JSON takes it, of which `from_json` makes equal objects.

    Single numbers and booleans of NumPy come back as numbers and booleans of Python.

    Raises:
        NotStorable: for an object that is not of this package, an array, a number or a text, and
            for complex numbers.

    >>> from jaxgran._utils.json_tree import from_json, to_json
    >>> from_json(to_json((1.5, float("inf"), {"a": np.arange(2)})))
    (1.5, inf, {'a': array([0, 1])})
    """
    # NumPy's numbers come before Python's, since np.float64 is a float, and named tuples
    # before tuples.
    if isinstance(value, np.generic):
        return to_json(value.item())
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else {"float": repr(value)}
    if isinstance(value, np.ndarray | jax.Array):
        if getattr(value.dtype, "kind", None) not in {*"biuf"}:  # keys of JAX have none
            raise NotStorable(f"an array of {value.dtype} cannot be stored as JSON")
        array = np.asarray(value)
        kind = "jax" if isinstance(value, jax.Array) else "numpy"
        numbers = [to_json(x) for x in array.ravel().tolist()]
        return {kind: numbers, "shape": list(array.shape), "dtype": array.dtype.name}
    if isinstance(value, dict):
        return {"dict": [[to_json(key), to_json(part)] for key, part in value.items()]}
    if isinstance(value, list):
        return [to_json(part) for part in value]
    names = _field_names(type(value))
    if names is not None:
        module = type(value).__module__
        if not module.startswith(f"{PACKAGE}."):
            raise NotStorable(f"{type(value).__name__} is not a class of {PACKAGE}")
        place = f"{module}:{type(value).__qualname__}"
        return {"class": place, "fields": {n: to_json(getattr(value, n)) for n in names}}
    if isinstance(value, tuple):
        return {"tuple": [to_json(part) for part in value]}
    raise NotStorable(f"a {type(value).__name__} cannot be stored as JSON")


def from_json(value: Any) -> Any:
    """Return the tree of objects that `to_json` stored.

    Raises:
        ValueError: for a class that is not of this package, or whose fields are not those stored.
    """
    if isinstance(value, list):
        return [from_json(part) for part in value]
    if not isinstance(value, dict):
        return value
    if "float" in value:
        return float(value["float"])
    if "tuple" in value:
        return tuple(from_json(part) for part in value["tuple"])
    if "dict" in value:
        return {from_json(key): from_json(part) for key, part in value["dict"]}
    for kind, make in (("numpy", np.asarray), ("jax", jnp.asarray)):
        if kind in value:
            numbers = [from_json(x) for x in value[kind]]
            return make(np.array(numbers, value["dtype"]).reshape(value["shape"]))
    return _made(value["class"], {name: from_json(x) for name, x in value["fields"].items()})


def _field_names(cls: type) -> list[str] | None:
    """Return the names of the fields of a named tuple or a dataclass; None for other classes."""
    if issubclass(cls, tuple) and (names := getattr(cls, "_fields", None)) is not None:
        return list(names)
    if dataclasses.is_dataclass(cls):
        return [f.name for f in dataclasses.fields(cls)]
    return None


def _made(place: str, fields: dict[str, Any]) -> Any:
    """Return an instance of a class of this package with these fields, without its checks."""
    module, _, name = place.partition(":")
    if not module.startswith(f"{PACKAGE}."):
        raise ValueError(f"{place} is not a class of {PACKAGE}")
    try:
        cls: Any = attrgetter(name)(import_module(module))
    except (ImportError, AttributeError) as e:
        raise ValueError(f"another version of {PACKAGE} stored this: {place} is unknown") from e
    names = _field_names(cls) or []
    if fields.keys() != {*names}:
        raise ValueError(
            f"another version of {PACKAGE} stored this {name}: it has the fields "
            f"{', '.join(fields)}, and now {', '.join(names)}"
        )
    if issubclass(cls, tuple):
        return cls(**fields)
    made = object.__new__(cls)
    for field, value in fields.items():
        object.__setattr__(made, field, value)
    return made
