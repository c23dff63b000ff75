"""Rates of a gas, as averages over its last mean free times."""

from typing import Any, NamedTuple

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


class Line(NamedTuple):
    """A ratio that depends linearly on another number x, both of which drift.

    The past fades exponentially, as in `Rates`. Where x stands still the ratio is its mean.

    Attributes:
        below, below_x, below_square: sums of the denominator, times 1, x and its square.
        above, above_x: the same of the numerator.
    """

    below: Float[Array, "replicas"]
    below_x: Float[Array, "replicas"]
    below_square: Float[Array, "replicas"]
    above: Float[Array, "replicas"]
    above_x: Float[Array, "replicas"]

    def after(self, passed: Array, above: Array, below: Array, x: Array) -> "Line":
        """With what came in a further time, in mean free times."""
        more = Line(below, x * below, x**2 * below, above, x * above)
        left = weight_after(passed)
        return Line(*(left * old + new for old, new in zip(self, more, strict=True)))

    def at(self, x: Float[Array, "replicas"]) -> Float[Array, "replicas"]:
        """The ratio at x; 0 where nothing is known."""
        mean, centre = ratio(self.above, self.below), ratio(self.below_x, self.below)
        square = self.below_square - centre * self.below_x
        known = square > 1e-12 * self.below_square
        slope = ratio(self.above_x - centre * self.above, jnp.where(known, square, 0.0))
        return mean + slope * (x - centre)


def weight_after(passed: Any) -> Array:
    """What sums of the past are left by a further time, in mean free times."""
    return jnp.exp(-passed / MEMORY)


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
    old = weight_after(passed * collision_frequency)
    return Rates(
        lost=old * rates.lost + lost,
        could_lose=old * rates.could_lose + energy * trend * duration,
        met=old * rates.met + met,
        could_meet=old * rates.could_meet + passed,
    )


def ratio(above: Array, below: Array) -> Array:
    """The ratio, 0 where the denominator is 0."""
    return jnp.where(below != 0, above / jnp.where(below != 0, below, 1.0), 0.0)
