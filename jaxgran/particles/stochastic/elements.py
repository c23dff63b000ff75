"""Drag, rough spheres and walls in DSMC.

Spins are ``s = (sigma/2) w``, a velocity. Where there is drag, velocities u are those over their
decay: they change in collisions only, and so do the spins that are kept. Time is then the length
``ds`` of ``dx = u ds``.
"""

from math import pi, sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran.particles.spins import rub
from jaxgran.scene.reduced_scene import ReducedDrag, ReducedRough, ReducedWalls


class Decay(NamedTuple):
    """What drag has left at a time.

    Attributes:
        velocity: v over u, ``exp(-gamma t)``.
        spin: spins in the units of u over those that are kept.
        kept: spins over those that are kept.
    """

    velocity: Float[Array, "..."]
    spin: Float[Array, "..."]
    kept: Float[Array, "..."]


def decay(drag: ReducedDrag, time: Float[Array, "..."]) -> Decay:
    """What drag has left at a transformed time, ``s = (1 - exp(-gamma t))/gamma``."""
    velocity = 1 - drag.rate * time
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    passed = jnp.where(drag.rate > 0, -jnp.log1p(-drag.rate * time) / safe, time)
    kept = jnp.exp(-drag.rotational_rate * passed)
    return Decay(velocity, kept / velocity, kept)


def transformed(drag: ReducedDrag, times: Float[Array, "times"]) -> Float[Array, "times"]:
    """The transformed times of times."""
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    return jnp.where(drag.rate > 0, -jnp.expm1(-drag.rate * times) / safe, times)


def hit_walls(
    walls: ReducedWalls,
    surface: ReducedRough | None,
    key: PRNGKeyArray,
    velocity: Float[Array, "N d"],
    spin: Float[Array, "N spins"],
    ds: Float[Array, ""],
    slowed: Float[Array, ""] | float,
) -> tuple[Float[Array, "N d"], Float[Array, "N spins"]]:
    """Velocities and spins after a step in which particles meet walls, everywhere alike.

    A sphere between two walls meets one of them ``|v| ds/(L - sigma)`` times in a step.

    Args:
        walls, surface: in reduced units.
        key: of random numbers.
        velocity, spin: before.
        ds: length of the step.
        slowed: physical velocities over these.
    """
    n, d = velocity.shape
    each = walls.frequency * sqrt(pi)  # over the speed
    chance = jax.random.uniform(key, (n, d), velocity.dtype)
    for k in range(d):
        speed = jnp.abs(velocity[:, k])
        hit = (chance[:, k] < each[k] * speed * ds) & (speed > 0)
        eps = walls.law.restitution(jnp.where(hit, speed * slowed, 1.0))
        axis = jnp.zeros((n, d), velocity.dtype).at[:, k].set(jnp.sign(velocity[:, k]))
        push = jnp.where(hit, (1 + eps) * speed, 0.0)[:, None] * axis
        if surface is not None and walls.beta is not None:
            eta = surface.eta_on_wall(walls.beta)
            found = rub(velocity, spin, axis, hit, eta, surface.inertia)
            velocity, spin = velocity + found.kick, spin + found.twist
        velocity = velocity - push
    return velocity, spin
