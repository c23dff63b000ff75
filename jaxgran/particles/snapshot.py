"""Particles as a user sees them, in SI, and what a user's function makes of them."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxgran.data.curve import CoolingCurve, Particles
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS

PREFIX = "saved:"
"""Before the number of a leaf of what was saved, in the names of records."""


class Units(NamedTuple):
    """Units of a run, SI; nothing is differentiated in them.

    Attributes:
        length: m.
        velocity: m/s.
        spin: of angular velocities, 1/s.
        box_side: side of the box, or sides of the container, m.
        mass: kg.
    """

    length: Float[Array, ""]
    velocity: Float[Array, ""]
    spin: Float[Array, ""]
    box_side: Float[Array, "..."]
    mass: Float[Array, ""]


def particles(
    units: Units, replicas: int, position: Array, velocity: Array, spin: Array | None
) -> Particles:
    """Particles of all replicas from arrays in units of the run, replica after replica."""

    def each(x: Array, unit: Array) -> Array:
        return x.reshape(replicas, -1, x.shape[-1]) * unit

    return Particles(
        position=each(position, units.length),
        velocity=each(velocity, units.velocity),
        box_side=units.box_side,
        angular_velocity=None if spin is None else each(spin, units.spin),
    )


def shapes(
    units: Units, size: tuple[int, int], dimension: int, dtype: Any, rough: bool
) -> Particles:
    """Shapes of the particles of some replicas of N, and their box."""
    each = jax.ShapeDtypeStruct((*size, dimension), dtype)
    spins = jax.ShapeDtypeStruct((*size, NUM_SPIN_COMPONENTS[dimension]), dtype) if rough else None
    return Particles(each, each, units.box_side, spins)  # type: ignore[arg-type]


def function(save: Callable[[Particles], Any] | str | None) -> Callable[[Particles], Any] | None:
    """The function of the particles of a replica that a run's option asks for."""
    return _whole if save == "particles" else save  # type: ignore[return-value]


def _whole(of_one: Particles) -> Particles:
    """All but the box, which is always the same."""
    return of_one._replace(box_side=None)  # type: ignore[arg-type]


@partial(jax.jit, static_argnames="save")
def saved(save: Callable[[Particles], Any], found: Particles) -> dict[str, Array]:
    """Records of a user's function of the particles of each replica, one for each leaf.

    The particles of one replica have arrays of shape (N, d).
    """
    leaves = jax.tree.leaves(_of_each(save, found))
    return {f"{PREFIX}{k}": jnp.asarray(leaf) for k, leaf in enumerate(leaves)}


def _of_each(save: Callable[[Particles], Any], found: Particles) -> Any:
    spins = None if found.angular_velocity is None else 0
    axes: Any = Particles(0, 0, None, spins)  # type: ignore[arg-type]
    return jax.vmap(lambda of_one: _numbers(save(of_one)), (axes,))(found)


def _numbers(tree: Any) -> Any:
    """What a user's function returns, as arrays.

    Raises:
        ValueError: for nothing, and for something else than numbers.
    """
    if not jax.tree.leaves(tree):
        raise ValueError(f"save must return arrays, in any tree, got {tree!r:.60} from it")
    return jax.tree.map(_number, tree)


def _number(leaf: Any) -> Array:
    try:
        array = jnp.asarray(leaf)
    except TypeError:
        raise ValueError(f"save must return numbers, got {leaf!r:.60} from it") from None
    if jnp.issubdtype(array.dtype, jax.dtypes.extended):
        raise ValueError(f"save must return numbers, got an array of {array.dtype} from it")
    return array


def with_saved(
    curve: CoolingCurve,
    save: Callable[[Particles], Any] | str | None,
    records: dict[str, Array],
    particles: Particles,
    wrong: Bool[Array, "replicas_or_1 times"],
) -> CoolingCurve:
    """A curve with what was saved.

    Args:
        curve: of the run.
        save: the option of the run.
        records: of shape (times, replicas, ...).
        particles: of the shapes of those of which it is a function, and with their box.
        wrong: where nothing is known.
    """
    of_one = function(save)
    if of_one is None:
        return curve

    def leaf(k: int) -> Array:
        x = jnp.swapaxes(records[f"{PREFIX}{k}"], 0, 1)
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return jnp.where(wrong.reshape(*wrong.shape, *[1] * (x.ndim - 2)), jnp.nan, x)

    tree = jax.tree.structure(jax.eval_shape(partial(_of_each, of_one), particles))
    each = jax.tree.unflatten(tree, [leaf(k) for k in range(tree.num_leaves)])
    if save != "particles":
        return curve.with_saved(each)
    side = jnp.broadcast_to(particles.box_side, (wrong.shape[1], *particles.box_side.shape))
    at_times = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), each)
    return dataclasses.replace(curve, saved=at_times._replace(box_side=side))
