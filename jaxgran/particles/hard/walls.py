"""Impacts of hard spheres on the flat walls of a cube (square).

Units here: the diameter, the mass and the first temperature are 1. Positions are coordinates from a
corner of the container, so that centres are between 1/2 and its side less 1/2. The periodic box is
longer than the container by a diameter: no sphere meets another one through its boundary.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran.particles.spins import rub
from jaxgran.scene.reduced_scene import ReducedRough
from jaxgran.scene.restitution import ReducedLaw

MARGIN = 1.0
"""Diameters by which the periodic box is longer than the container."""


class HardWalls(NamedTuple):
    """The walls of a container.

    Attributes:
        side: of the container.
        law: of restitution on them, for speeds in units of sqrt(2).
        beta: beta_t of impacts on them; None if they are smooth.
    """

    side: Float[Array, ""]
    law: ReducedLaw
    beta: Float[Array, ""] | None


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
    to = jnp.where(v > 0, walls.side - 0.5, 0.5)
    moving = v != 0
    each = jnp.where(moving, (to - x) / jnp.where(moving, v, 1.0), jnp.inf)
    axis = jnp.argmin(each, axis=1)
    # Rounding may have left a sphere beyond a wall: it bounces at once.
    times = jnp.maximum(jnp.min(each, axis=1), jnp.maximum(last, 0.0))
    return Bounces(jnp.where(times < end, times, jnp.inf), axis)


class Bounced(NamedTuple):
    """What an impact on a wall does to a particle."""

    v: Float[Array, "slots d"]
    spin: Float[Array, "slots spins"] | None
    lost: Float[Array, "slots"]


def bounced(
    walls: HardWalls,
    surface: ReducedRough | None,
    v: Float[Array, "slots d"],
    spin: Float[Array, "slots spins"] | None,
    axis: Int[Array, "slots"],
    elastic: ArrayLike,
) -> Bounced:
    """Velocities and spins after an impact on the wall across an axis, and the energy lost.

    Args:
        walls, surface: of the scene.
        v, spin: before.
        axis: across which the wall is.
        elastic: where the impact is elastic and smooth.
    """
    d = v.shape[1]
    across = axis[:, None] == jnp.arange(d)[None]
    normal_speed = jnp.abs(jnp.sum(jnp.where(across, v, 0.0), axis=1))
    eps = walls.law.restitution(jnp.where(normal_speed > 0, normal_speed, 1.0) * 0.5**0.5)
    eps = jnp.where(elastic, 1.0, eps)
    outwards = jnp.where(across, jnp.sign(v), 0.0)
    kick = -((1 + eps) * normal_speed)[:, None] * outwards
    lost = 0.5 * (1 - eps**2) * normal_speed**2
    if surface is None or spin is None or walls.beta is None:
        return Bounced(v + kick, spin, lost)
    where = ~jnp.broadcast_to(elastic, normal_speed.shape)
    found = rub(v, spin, outwards, where, surface.eta_on_wall(walls.beta), surface.inertia)
    lost = lost + 0.5 * surface.lost_share(walls.beta) * jnp.sum(found.slip**2, axis=1)
    return Bounced(v + kick + found.kick, spin + found.twist, lost)
