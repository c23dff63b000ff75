"""The units of a run, particles in SI, and what a user saves of them."""

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
    if gas.container is None:
        return gas.box_side(num_particles)
    return gas.container.side


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
        """Return the units of N particles of a gas, with units of length and velocity.

        The stored spin of a sphere is the velocity of its surface, sigma w/2.
        """
        return cls(
            length=length,
            velocity=velocity,
            spin=2 * velocity / gas.diameter,
            box_side=box_side(gas, num_particles),
            mass=gas.mass,
        )

    def to_particles(
        self, replicas: int, position: Array, velocity: Array, spin: Array | None
    ) -> Particles:
        """Return the particles of all replicas in SI from arrays in units of the run."""

        def to_si(x: Array, unit: Array) -> Array:
            return x.reshape(replicas, -1, x.shape[-1]) * unit

        return Particles(
            position=to_si(position, self.length),
            velocity=to_si(velocity, self.velocity),
            box_side=self.box_side,
            angular_velocity=None if spin is None else to_si(spin, self.spin),
        )


def resolve_save(
    save: Callable[[Particles], Any] | str | None,
) -> Callable[[Particles], Any] | None:
    """Return the function of the particles of one replica for the option `save` of a run.

    For "particles", the only string that `AbstractModel.check_save` allows, it returns the
    particles without their box, which is the same at all times.
    """
    return _without_box if isinstance(save, str) else save


def _without_box(particles: Any) -> Any:
    return particles._replace(box_side=None)


@eqx.filter_jit
def apply_save(save: Callable[[Particles], Any], particles: Particles) -> Any:
    """Return what a user's function returns for the particles of each replica, as arrays.

    Args:
        save: a function of the particles of one replica, arrays of shape (N, d).
        particles: of all replicas.

    Returns:
        A tree of arrays with a first axis of replicas.

    Raises:
        ValueError: if the function returns no arrays, or leaves that are not numbers.
    """

    def saved_of(replica: Particles) -> Any:
        tree = save(replica)
        if not jax.tree.leaves(tree):
            raise ValueError(f"save must return a pytree of arrays, got {tree!r:.60}")
        return jax.tree.map(_as_array, tree)

    axes: Any = jax.tree.map(lambda _: 0, particles)._replace(box_side=None)
    return jax.vmap(saved_of, (axes,))(particles)


def _as_array(leaf: Any) -> Array:
    try:
        array = jnp.asarray(leaf)
    except TypeError:
        raise ValueError(f"save must return numbers, got {leaf!r:.60} from it") from None
    if jnp.issubdtype(array.dtype, jax.dtypes.extended):
        raise ValueError(f"save must return numbers, got an array of {array.dtype} from it")
    return array
