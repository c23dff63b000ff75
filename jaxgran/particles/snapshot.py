"""Particles in SI for the user, and records of the user's function of them."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.data.particles import Particles
from jaxgran.scene.gas import Gas


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
    def from_gas(cls, gas: Gas, num_particles: int, length: Array, velocity: Array) -> "Units":
        """Return the units of N particles of a gas, with units of length and velocity."""
        side = box_side(gas, num_particles)
        return cls(length, velocity, 2 * velocity / gas.diameter, side, gas.mass)


def to_particles(
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


def resolve_save(
    save: Callable[[Particles], Any] | str | None,
) -> Callable[[Particles], Any] | None:
    """Return the function of the particles of one replica for the option `save` of a run."""
    if isinstance(save, str):  # "particles", as checked before
        return _without_box
    return save


def _without_box(particles: Any) -> Any:
    return particles._replace(box_side=None)


@eqx.filter_jit
def apply_save(save: Callable[[Particles], Any], particles: Particles) -> Any:
    """Return what a user's function of the particles of each replica returns, as arrays.

    The particles of one replica have arrays of shape (N, d).
    """

    def of_replica(replica: Particles) -> Any:
        tree = save(replica)
        if not jax.tree.leaves(tree):
            raise ValueError(f"save must return a pytree of arrays, got {tree!r:.60}")
        return jax.tree.map(_as_array, tree)

    axes: Any = jax.tree.map(lambda _: 0, particles)._replace(box_side=None)
    return jax.vmap(of_replica, (axes,))(particles)


def _as_array(leaf: Any) -> Array:
    try:
        array = jnp.asarray(leaf)
    except TypeError:
        raise ValueError(f"save must return numbers, got {leaf!r:.60} from it") from None
    if jnp.issubdtype(array.dtype, jax.dtypes.extended):
        raise ValueError(f"save must return numbers, got an array of {array.dtype} from it")
    return array
