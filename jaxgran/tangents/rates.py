"""Rates of a gas, as averages over its last mean free times."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, DTypeLike, Float

MEMORY = 5.0
"""Mean free times over which the rates of cooling and of collision are averaged."""


class Rates(NamedTuple):
    """Exponentially weighted sums, by replica, from which rates are estimated.

    Attributes:
        lost: energy lost.
        could_lose: energy that would have been lost, had the cooling rate been the trend itself.
        met: collisions per particle.
        could_meet: collisions per particle, had their rate been ``T^(1/2)``.
    """

    lost: Float[Array, "replicas"]
    could_lose: Float[Array, "replicas"]
    met: Float[Array, "replicas"]
    could_meet: Float[Array, "replicas"]

    @classmethod
    def none(cls, replicas: int, dtype: DTypeLike) -> "Rates":
        """The sums before the first collision."""
        return cls(*[jnp.zeros(replicas, dtype)] * 4)

    def cooling(self, trend: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """``-d ln T/dt``, given its trend, which is its dependence on T in an arbitrary unit."""
        return ratio(self.lost, self.could_lose) * trend

    def collision(self, temperature: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """Collisions per particle and time, proportional to ``T^(1/2)``."""
        return ratio(self.met, self.could_meet) * temperature**0.5


class Drift(NamedTuple):
    """A ratio that drifts, as the value now of a straight line through its past.

    The past fades exponentially, as in `Rates`. T_rot/T may change by a large part of
    itself in that time, and its mean would lag behind.

    Attributes:
        below, below_age, below_square: sums of the denominator, times 1, the age and its square.
        above, above_age: the same of the numerator.
    """

    below: Float[Array, "replicas"]
    below_age: Float[Array, "replicas"]
    below_square: Float[Array, "replicas"]
    above: Float[Array, "replicas"]
    above_age: Float[Array, "replicas"]

    def after(self, passed: Array, kept: Array, above: Array, below: Array) -> "Drift":
        """With a further time, in which older sums age by it and lose weight by a factor."""
        b, b1, b2, a, a1 = self
        aged = b, b1 + passed * b, b2 + 2 * passed * b1 + passed**2 * b, a, a1 + passed * a
        b, b1, b2, a, a1 = (kept * x for x in aged)
        return Drift(b + below, b1, b2, a + above, a1)

    @property
    def now(self) -> Float[Array, "replicas"]:
        """The ratio; 0 where nothing is known."""
        determinant = self.below * self.below_square - self.below_age**2
        line = determinant > 1e-6 * self.below * self.below_square
        at_zero = self.below_square * self.above - self.below_age * self.above_age
        known = self.below > 0
        mean = jnp.where(known, self.above / jnp.where(known, self.below, 1.0), 0.0)
        return jnp.where(line, at_zero / jnp.where(line, determinant, 1.0), mean)


def remembered(
    rates: Rates,
    lost: Float[Array, "replicas"],
    met: Float[Array, "replicas"],
    energy: Float[Array, "replicas"],
    temperature: Float[Array, "replicas"],
    trend: Float[Array, "replicas"],
    duration: ArrayLike,
    collision_frequency: ArrayLike,
) -> Rates:
    """The exponentially weighted sums after a further time.

    Args:
        rates: the sums before.
        lost: energy lost in this time.
        met: collisions per particle that began in it.
        energy: of the gas.
        temperature: of the gas.
        trend: the dependence of the cooling rate on T, at this temperature.
        duration: of this time.
        collision_frequency: at T = 1.
    """
    passed = duration * jnp.sqrt(temperature)
    old = jnp.exp(-passed * collision_frequency / MEMORY)
    return Rates(
        lost=old * rates.lost + lost,
        could_lose=old * rates.could_lose + energy * trend * duration,
        met=old * rates.met + met,
        could_meet=old * rates.could_meet + passed,
    )


def ratio(above: Array, below: Array) -> Array:
    """The ratio, 0 where the denominator is 0."""
    return jnp.where(below != 0, above / jnp.where(below != 0, below, 1.0), 0.0)
