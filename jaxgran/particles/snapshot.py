"""Particles in SI for the user, and records of the user's function of them."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxgran.data.curve import CoolingCurve, Particles
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.gas import Gas

PREFIX = "saved:"
"""Prefix of the names of saved records, before the number of the leaf."""


def box_side(gas: Gas, num_particles: int) -> Float[Array, "..."]:
    """Return the side of the periodic box of a gas, or the sides of its container, m."""
    return gas.box_side(num_particles) if gas.container is None else gas.container.side


class Units(NamedTuple):
    """Units of a run in SI, which are treated as constants in derivatives.

    Attributes:
        length: unit of length, m.
        velocity: unit of velocity, m/s.
        spin: angular velocity of a sphere whose stored spin is 1, 1/s.
        box_side: side of the box, or sides of the container, m.
        mass: mass of a sphere, kg.
    """

    length: Float[Array, ""]
    velocity: Float[Array, ""]
    spin: Float[Array, ""]
    box_side: Float[Array, "..."]
    mass: Float[Array, ""]

    @classmethod
    def of(cls, gas: Gas, num_particles: int, length: Array, velocity: Array) -> "Units":
        """Return the units of N particles of a gas, with units of length and velocity."""
        side = box_side(gas, num_particles)
        return cls(length, velocity, 2 * velocity / gas.diameter, side, gas.mass)


def particles(
    units: Units, replicas: int, position: Array, velocity: Array, spin: Array | None
) -> Particles:
    """Return the particles of all replicas from arrays in units of the run."""

    def to_si(x: Array, unit: Array) -> Array:
        return x.reshape(replicas, -1, x.shape[-1]) * unit

    return Particles(
        position=to_si(position, units.length),
        velocity=to_si(velocity, units.velocity),
        box_side=units.box_side,
        angular_velocity=None if spin is None else to_si(spin, units.spin),
    )


def particle_shapes(
    units: Units, size: tuple[int, int], dimension: int, dtype: Any, rough: bool
) -> Particles:
    """Return the shapes of the particles, for `size` = (replicas, N), and their box."""
    vectors = jax.ShapeDtypeStruct((*size, dimension), dtype)
    spins = jax.ShapeDtypeStruct((*size, NUM_SPIN_COMPONENTS[dimension]), dtype) if rough else None
    return Particles(vectors, vectors, units.box_side, spins)  # type: ignore[arg-type]


def save_function(
    save: Callable[[Particles], Any] | str | None,
) -> Callable[[Particles], Any] | None:
    """Return the function of the particles of one replica for the option `save` of a run."""
    return _without_box if save == "particles" else save  # type: ignore[return-value]


def _without_box(particles: Particles) -> Particles:
    return particles._replace(box_side=None)  # type: ignore[arg-type]


@partial(jax.jit, static_argnames="save")
def saved_records(save: Callable[[Particles], Any], particles: Particles) -> dict[str, Array]:
    """Return one record for each leaf of a user's function of the particles of each replica.

    The particles of one replica have arrays of shape (N, d).
    """
    leaves = jax.tree.leaves(_map_replicas(save, particles))
    return {f"{PREFIX}{k}": jnp.asarray(leaf) for k, leaf in enumerate(leaves)}


def _map_replicas(save: Callable[[Particles], Any], particles: Particles) -> Any:
    def saved(replica: Particles) -> Any:
        tree = save(replica)
        if not jax.tree.leaves(tree):
            raise ValueError(f"save must return arrays, in any tree, got {tree!r:.60} from it")
        return jax.tree.map(_as_array, tree)

    spins = None if particles.angular_velocity is None else 0
    axes: Any = Particles(0, 0, None, spins)  # type: ignore[arg-type]
    return jax.vmap(saved, (axes,))(particles)


def _as_array(leaf: Any) -> Array:
    try:
        array = jnp.asarray(leaf)
    except TypeError:
        raise ValueError(f"save must return numbers, got {leaf!r:.60} from it") from None
    if jnp.issubdtype(array.dtype, jax.dtypes.extended):
        raise ValueError(f"save must return numbers, got an array of {array.dtype} from it")
    return array


def attach_saved(
    curve: CoolingCurve,
    save: Callable[[Particles], Any] | str | None,
    records: dict[str, Array],
    particles: Particles,
    invalid: Bool[Array, "replicas_or_1 times"],
) -> CoolingCurve:
    """Add the saved records to a curve.

    Args:
        curve: curve of the run.
        save: option of the run.
        records: records of shape (times, replicas, ...).
        particles: particles, or their shapes, with the box.
        invalid: mask of the replicas and times at which records are replaced by nan.
    """
    function = save_function(save)
    if function is None:
        return curve

    def leaf(k: int) -> Array:
        x = jnp.swapaxes(records[f"{PREFIX}{k}"], 0, 1)
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return jnp.where(invalid.reshape(*invalid.shape, *[1] * (x.ndim - 2)), jnp.nan, x)

    tree = jax.tree.structure(jax.eval_shape(partial(_map_replicas, function), particles))
    by_replica = jax.tree.unflatten(tree, [leaf(k) for k in range(tree.num_leaves)])
    if save != "particles":
        return curve.with_saved(by_replica)
    side = jnp.broadcast_to(particles.box_side, (invalid.shape[1], *particles.box_side.shape))
    by_time = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), by_replica)
    return dataclasses.replace(curve, saved=by_time._replace(box_side=side))
