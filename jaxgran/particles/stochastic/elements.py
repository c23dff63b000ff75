"""Walls in DSMC.

Spins are ``s = (sigma/2) w``, a velocity. Where there is drag, velocities, spins and time are
transformed: see `jaxgran.particles.drag`.
"""

from math import pi, sqrt

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran.particles.spins import rub
from jaxgran.scene.reduced_scene import ReducedRough, ReducedWalls


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
