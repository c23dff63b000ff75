"""Tangents of spins whose contacts rub, beside those of `jaxgran.tangents.thermal`.

A gas of spheres with friction remembers T and T_rot. A change of clock by c makes velocities and
spins faster alike, and leaves the coefficients of friction as they are. What a spin has besides
``(c/2) s`` is followed exactly, and replaced by its part along s at each projection, which is the
change of ``T_rot/T``.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxgran.tangents import rates
from jaxgran.tangents.rates import Line


class RubbingMaterial(NamedTuple):
    """The numbers of friction, or their tangents; None is what a scene does not have.

    Attributes:
        damping, friction, inertia, ratio: of the spheres, as in `soft.scene.SoftSurface`.
        wall_damping, wall_friction: of walls.
    """

    damping: Any
    friction: Any
    inertia: Any
    ratio: Any
    wall_damping: Any = None
    wall_friction: Any = None


class RotationTangents(NamedTuple):
    """Tangents of the spins along p directions.

    Attributes:
        directions: in the numbers of friction.
        spin: tangents of the spins, without the part (c/2) s.
        turned: energy that rotation gained in contacts in a mean free time, over that of
            translation, which depends on the ratio of both.
    """

    directions: RubbingMaterial
    spin: Float[Array, "p n spins"]
    turned: Line

    @classmethod
    def at_start(
        cls,
        directions: RubbingMaterial,
        inertia: Float[Array, ""],
        ratio: Float[Array, ""],
        spin: Float[Array, "n spins"],
        replicas: int,
    ) -> "RotationTangents":
        """The tangents of spins of ``q s^2 = ratio``; nan along a ratio that is 0, of which the
        spins are a square root."""
        along = directions.ratio
        faster = jnp.where(along == 0, 0.0, along / ratio) - directions.inertia / inertia
        zeros = jnp.zeros(replicas, spin.dtype)
        return cls(directions, 0.5 * faster[:, None, None] * spin[None], Line(*[zeros] * 5))

    def projected(
        self,
        spin: Float[Array, "n spins"],
        gain: Float[Array, "p replicas"],
        free: Bool[Array, "n"],
        due: ArrayLike,
    ) -> "RotationTangents":
        """The tangents after a projection that adds a gain to c, or unchanged unless it is due.

        Args:
            spin: of the spheres.
            gain: of c.
            free: spheres without contact, which are projected.
            due: whether it is time to.
        """
        replicas = gain.shape[1]
        size = len(spin) // replicas
        rest = self.spin - 0.5 * jnp.repeat(gain, size, axis=1)[:, :, None] * spin[None]
        share = along_spin(rest, jnp.where(free[:, None], spin, 0.0), replicas)
        kept = jnp.repeat(share, size, axis=1)[:, :, None] * spin[None]
        new = jnp.where(free[None, :, None], kept, rest)
        return self._replace(spin=jnp.where(due, new, self.spin))

    def log_temperature(
        self, spin: Float[Array, "n spins"], inertia: Array, c: Float[Array, "p replicas"]
    ) -> Float[Array, "p replicas"]:
        """Tangents of ln T_rot: those of q, of the clock, and of the spins besides."""
        share = along_spin(self.spin, spin, c.shape[1])
        return (self.directions.inertia / inertia)[:, None] + c + 2 * share


def along_spin(
    rest: Float[Array, "p n spins"], spin: Float[Array, "n spins"], replicas: int
) -> Float[Array, "p replicas"]:
    """The part of each replica's rest along its spins, over them; 0 where none rotates."""
    each = spin.reshape(replicas, -1)
    found = jnp.sum(rest.reshape(len(rest), *each.shape) * each[None], -1)
    return rates.ratio(found, jnp.sum(each * each, -1)[None])
