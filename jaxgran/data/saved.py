"""What `save` makes of the particles: arrays by name, and their dimensions."""

import dataclasses
from typing import Any

import jax

from jaxgran.data.curve import CoolingCurve

TIME, REPLICA = "time", "replica"
SAVED = "saved"
OF_REPLICAS = "_of_replicas"
"""The ending of the names of records that have an axis of replicas."""

_MEAN, _ERROR, _EACH = SAVED, f"{SAVED}_error", f"{SAVED}{OF_REPLICAS}"

_PARTICLES = {
    "position": (REPLICA, "particle", "axis"),
    "velocity": (REPLICA, "particle", "axis"),
    "angular_velocity": (REPLICA, "particle", "rotation_axis"),
    "box_side": ("axis",),
}
"""Dimensions after the time, where the particles themselves are saved."""

_UNITS = {"position": "m", "velocity": "m/s", "angular_velocity": "1/s", "box_side": "m"}

Leaves = dict[str, Any]
"""Arrays by name."""


def is_saved(name: str) -> bool:
    """Whether a record is one of these."""
    return name.partition(".")[0] in (_MEAN, _ERROR, _EACH)


def leaves(curve: CoolingCurve) -> Leaves:
    """The arrays that a curve has saved, named by their places: ``saved.S.0``.

    The standard error is ``saved_error.S.0``, and that of each replica
    ``saved_of_replicas.S.0``.
    """
    return {
        _name(part, path): leaf
        for part, tree in _parts(curve).items()
        for path, leaf in jax.tree.flatten_with_path(tree)[0]
    }


def with_leaves(curve: CoolingCurve, like: CoolingCurve, found: Leaves) -> CoolingCurve:
    """A curve with these arrays in the trees in which another one has them."""
    trees = {}
    for part, tree in _parts(like).items():
        paths, structure = jax.tree.flatten_with_path(tree)
        trees[part] = jax.tree.unflatten(structure, [found[_name(part, path)] for path, _ in paths])
    if _EACH in trees:
        assert curve.replicas is not None
        replicas = dataclasses.replace(curve.replicas, saved=trees.pop(_EACH))
        curve = dataclasses.replace(curve, replicas=replicas)
    return dataclasses.replace(curve, **trees)


def dimensions(name: str, ndim: int, whole: bool) -> tuple[str, ...]:
    """Labels of the axes of one member's array.

    Args:
        name: of `leaves`.
        ndim: number of its axes.
        whole: whether the particles themselves are saved.
    """
    part, _, place = name.partition(".")
    if whole:
        return (TIME, *_PARTICLES[place][: ndim - 1])
    first = (REPLICA, TIME) if part == _EACH else (TIME,)
    own = f"{SAVED}.{place}" if place else SAVED
    return *first, *(f"{own}.axis{k}" for k in range(ndim - len(first)))


def unit(name: str, whole: bool) -> str | None:
    """The unit of an array; None where a user's function determines it."""
    return _UNITS[name.partition(".")[2]] if whole else None


def _parts(curve: CoolingCurve) -> dict[str, Any]:
    """The trees of a curve that hold what was saved, by the beginnings of their names."""
    each = None if curve.replicas is None else curve.replicas.saved
    trees = {_MEAN: curve.saved, _ERROR: curve.saved_error, _EACH: each}
    return {part: tree for part, tree in trees.items() if tree is not None}


def _name(part: str, path: tuple[Any, ...]) -> str:
    """The name of an array at a place in a tree.

    Raises:
        ValueError: for a key of a dictionary that would make it ambiguous.
    """
    keys = [jax.tree_util.keystr((key,), simple=True) for key in path]
    for key in keys:
        if "." in key or "/" in key:
            raise ValueError(
                f"save returns a dictionary with the key {key!r}: keys name arrays of a store "
                'or of an xarray.Dataset, leave "." and "/" out'
            )
    return ".".join([part, *keys])
