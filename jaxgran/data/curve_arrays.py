"""Arrays of a cooling curve by name, as npz files, sweeps and xarray hold them.

A quantity has the name of its field; its values by replica have the suffix _of_replicas. The final
particles have the names of their fields. A saved array is named by its place in the tree:
``saved.S.0`` the mean, ``saved_error.S.0`` its standard error, ``saved_of_replicas.S.0`` the values
of each replica.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax

from jaxgran.data.particles import Particles
from jaxgran.data.quantities import QUANTITIES

TIME = "time"
REPLICA = "replica"
"""Names of dimensions."""

STATUS = "status"
SAVED = "saved"
"""Names of arrays."""

OF_REPLICAS = "_of_replicas"
"""Ending of the names of arrays that have an axis of replicas."""


class Label(NamedTuple):
    """How an array is described in an `xarray.Dataset`.

    Attributes:
        dims: names of its dimensions.
        attributes: long_name and, where it is known, units.
    """

    dims: tuple[str, ...]
    attributes: dict[str, str]


_OF_PARTICLES = (REPLICA, "particle", "axis")

_PARTICLES = {
    "position": Label(_OF_PARTICLES, {"units": "m", "long_name": "position"}),
    "velocity": Label(_OF_PARTICLES, {"units": "m/s", "long_name": "velocity"}),
    "box_side": Label(("axis",), {"units": "m", "long_name": "box side"}),
    "angular_velocity": Label(
        (REPLICA, "particle", "rotation_axis"), {"units": "1/s", "long_name": "angular velocity"}
    ),
}
"""Labels of the arrays of `Particles` at one time."""


def to_arrays(curve: eqx.Module) -> dict[str, Any]:
    """Return the arrays of a cooling curve by name: `curve.from_arrays` is the inverse.

    Raises:
        ValueError: for a key of a saved dictionary that would make a name ambiguous.
    """
    arrays = dict(zip(names_of_leaves(curve), jax.tree.leaves(curve), strict=True))
    arrays.pop(f"times{OF_REPLICAS}", None)
    return arrays


def names_of_leaves(curve: eqx.Module) -> list[str]:
    """Return the name of each leaf of a curve, after a check that it is unique."""
    names = []
    for path, _ in jax.tree.flatten_with_path(curve)[0]:
        keys = [jax.tree_util.keystr((key,), simple=True) for key in path]
        for entry, key in zip(path, keys, strict=True):
            is_index = isinstance(entry, jax.tree_util.SequenceKey)
            if "." in key or "/" in key or (key.isdigit() and not is_index):
                raise ValueError(
                    f"save returns a dictionary with the key {key!r}: keys name arrays of a file "
                    'or of an xarray.Dataset. Use words without "." and "/"'
                )
        if keys[0] == "replicas":
            keys = [f"{keys[1]}{OF_REPLICAS}", *keys[2:]]
        names.append(".".join(keys[1:] if keys[0] == "particles" else keys))
    return names


def nested_fields(arrays: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a curve by name, among them "replicas", the fields of its replicas.

    Args:
        arrays: named as by `to_arrays`.
    """
    places = {}
    for name, array in arrays.items():
        group, _, place = name.partition(".")
        if group in _PARTICLES:
            name = f"particles.{name}"
        elif group.endswith(OF_REPLICAS):
            name = f"replicas.{group.removesuffix(OF_REPLICAS)}.{place}".rstrip(".")
        places[name] = array
    return _nest(places)


def _nest(arrays: dict[str, Any]) -> Any:
    """Return an array, or a dictionary, a tuple or `Particles` of them, by their places."""
    if "" in arrays:
        return arrays[""]
    children: dict[str, dict[str, Any]] = {}
    for name, array in arrays.items():
        first, _, rest = name.partition(".")
        children.setdefault(first, {})[rest] = array
    nested = {name: _nest(inner) for name, inner in children.items()}
    if all(name.isdigit() for name in nested):
        return tuple(nested[str(k)] for k in range(len(nested)))
    is_particles = {*nested, "angular_velocity"} == {*Particles._fields}
    return Particles(**nested) if is_particles else nested


def label_of(name: str, ndim: int, are_particles: bool = False) -> Label:
    """Return the dimensions and the attributes of an array of a curve.

    Args:
        name: from `to_arrays`.
        ndim: number of its axes.
        are_particles: whether `Particles` are saved.
    """
    group, _, place = name.partition(".")
    first = (REPLICA, TIME) if group.endswith(OF_REPLICAS) else (TIME,)
    if group in _PARTICLES or (group == SAVED and are_particles):
        label = _PARTICLES[place or group]
        dims = (*first, *label.dims) if place else label.dims
        return label._replace(dims=dims[:ndim])
    if group.startswith(SAVED):  # of a function of the user, who knows its unit
        base = f"{SAVED}.{place}" if place else SAVED
        axes = (f"{base}.axis{k}" for k in range(ndim - len(first)))
        return Label((*first, *axes), {"long_name": name.replace("_", " ")})
    quantity = QUANTITIES[group.removesuffix(OF_REPLICAS)]
    return Label(first, {"units": quantity.unit, "long_name": quantity.label})
