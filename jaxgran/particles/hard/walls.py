"""Impacts of hard spheres on the flat walls of a box.

Units here: the diameter, the mass and the first temperature are 1. Positions are coordinates from a
corner of the container, so that centres are between 1/2 and each side less 1/2. The periodic box,
a cube, is longer than the longest side by a diameter: no sphere meets another one through its
boundary.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran.scene.restitution import ReducedLaw

MARGIN = 1.0
"""Diameters by which the periodic box is longer than the container."""


class HardWalls(NamedTuple):
    """The walls of a container.

    Attributes:
        sides: of the container.
        law: of restitution on them, for speeds in units of sqrt(2).
        beta: beta_t of impacts on them; None if they are smooth.
        frequency: impacts on the two walls across each axis of a mixed gas, over the collision
            frequency; for derivatives in the sides.
    """

    sides: Float[Array, "d"]
    law: ReducedLaw
    beta: Float[Array, ""] | None
    frequency: Float[Array, "d"]


class Bounces(NamedTuple):
    """The next impacts of particles on walls: their times, inf if there is none, and axes."""

    times: Float[Array, "slots"]
    axis: Int[Array, "slots"]


def next_bounces(
    walls: HardWalls,
    x: Float[Array, "slots d"],
    v: Float[Array, "slots d"],
    last: Float[Array, "slots"],
    end: ArrayLike,
) -> Bounces:
    """The next impacts on walls of particles on paths x + v s since their last impacts."""
    to = jnp.where(v > 0, walls.sides[None] - 0.5, 0.5)
    moving = v != 0
    each = jnp.where(moving, (to - x) / jnp.where(moving, v, 1.0), jnp.inf)
    axis = jnp.argmin(each, axis=1)
    # Rounding may have left a sphere beyond a wall: it bounces at once.
    times = jnp.maximum(jnp.min(each, axis=1), jnp.maximum(last, 0.0))
    return Bounces(jnp.where(times < end, times, jnp.inf), axis)
