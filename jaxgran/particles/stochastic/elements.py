"""Walls, a drive and drag in a step of DSMC.

Spins are ``s = (sigma/2) w``, a velocity. Where there is drag, velocities, spins and time are
transformed: see `jaxgran.particles.drag`.
"""

from math import pi, sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxgran.particles import kicks
from jaxgran.particles.drag import Decay, decay, lasting
from jaxgran.particles.spins import rub
from jaxgran.scene.reduced_scene import ReducedDrag, ReducedDrive, ReducedScene
from jaxgran.scene.wall_layer import share_of_impacts
from jaxgran.theory.averages import collision_rate

REACH = 3.5
"""Speed along an axis, in sqrt(2 T), up to which impacts on walls are as frequent as they should
be; one of 1e6 particles is faster."""


class Walled(NamedTuple):
    """Some particles after impacts on walls.

    Attributes:
        velocity, spin: of each.
        lost: decrease of sum v^2.
        turned: increase of q sum s^2.
    """

    velocity: Float[Array, "N d"]
    spin: Float[Array, "N spins"]
    lost: Float[Array, ""]
    turned: Float[Array, ""]


def hit_walls(
    scene: ReducedScene,
    chance: Float[Array, "N"],
    axis: Int[Array, ""],
    velocity: Float[Array, "N d"],
    spin: Float[Array, "N spins"],
    ds: Float[Array, ""],
    slowed: Float[Array, ""] | float,
) -> Walled:
    """Particles after a step in which they meet walls, everywhere alike.

    A sphere between two walls meets one of them ``|v| ds/(L - sigma)`` times in a step, times the
    share that tells how dense the gas is before them (`share_of_impacts`). The steps take the axes
    in turns, and each does d times as much.

    Args:
        scene: in reduced units.
        chance: a random number for each; it meets a wall if this is less than that many times.
        axis: across which the walls are.
        velocity, spin: before.
        ds: length of the step.
        slowed: physical velocities over these.
    """
    walls, surface = scene.walls, scene.surface
    assert walls is not None
    n, d = velocity.shape
    frequency = walls.frequency[axis]
    each = frequency * (d * sqrt(pi)) * ds  # over the speed
    across = (jnp.arange(d) == axis).astype(velocity.dtype)[None]
    normal = jnp.sum(velocity * across, axis=1)
    speed, outwards = jnp.abs(normal), jnp.sign(normal)[:, None] * across
    eps = walls.law.restitution(jnp.where(speed > 0, speed * slowed, 1.0))
    often = share_of_impacts(eps, frequency / collision_rate(0.0, d), d)
    hit = (chance < often * each * speed) & (speed > 0)
    kick = -jnp.where(hit, (1 + eps) * speed, 0.0)[:, None] * outwards
    twist = jnp.zeros_like(spin)
    if surface is not None and walls.beta is not None:
        eta = surface.eta_on_wall(walls.beta)
        found = rub(velocity, spin, outwards, hit, eta, surface.inertia)
        kick, twist = kick + found.kick, found.twist
    # The number of impacts is not differentiable: they count for more where there are more.
    share = frequency * often
    share = share / jax.lax.stop_gradient(share)
    inertia = 0.0 if surface is None else surface.inertia
    lost = -jnp.sum(share[:, None] * kick * (2 * velocity + kick))
    turned = inertia * jnp.sum(share[:, None] * twist * (2 * spin + twist))
    return Walled(velocity + kick, spin + twist, lost, turned)


def fastest_share(
    scene: ReducedScene,
    temperature: Float[Array, "*replicas"],
    slowed: Float[Array, "*replicas"] | float,
    ds: Float[Array, "*replicas"],
    d: int,
) -> Float[Array, "*replicas"]:
    """The probability that a sphere of the speed `REACH` meets a wall in a step, that has its turn
    in each."""
    walls = scene.walls
    assert walls is not None
    speed = REACH * jnp.sqrt(temperature)
    eps = walls.law.restitution(speed * slowed)[..., None]
    frequency = jnp.broadcast_to(walls.frequency, (*eps.shape[:-1], d))
    often = share_of_impacts(eps, frequency / collision_rate(0.0, d), d)
    return jnp.max(often * frequency, axis=-1) * (d * sqrt(pi)) * speed * ds


def left_by(drag: ReducedDrag | None, time: Float[Array, "..."]) -> Decay:
    """What drag has left; all where there is none."""
    if drag is None:
        return Decay(*[jnp.ones_like(time)] * 3)
    return decay(drag, time)


def heating(
    drive: ReducedDrive,
    drag: ReducedDrag | None,
    began: Float[Array, "*replicas"],
    ds: Float[Array, "*replicas"],
    place: float,
) -> Float[Array, "*replicas"]:
    """Growth of T/T_0 by half of the kicks of a step, made at its begin (place 0) or end (1)."""
    if drag is None:
        return drive.strength * jnp.maximum(ds, 0.0) / 2
    return (
        drive.strength
        * lasting(drag, began, ds)
        / 2
        / decay(drag, began + place * ds).velocity ** 2
    )


def shortened(
    scene: ReducedScene,
    temperature: Float[Array, "*replicas"],
    clock: Float[Array, "*replicas"],
    ds: Float[Array, "*replicas"],
    d: int,
) -> Float[Array, "*replicas"]:
    """The length of a step, so short that a sphere meets one wall at most, and that the kicks of a
    drive are small beside the velocities."""
    if scene.walls is not None:
        slowed = left_by(scene.drag, clock).velocity
        ds = ds / jnp.maximum(fastest_share(scene, temperature, slowed, ds, d), 1.0)
    if scene.drive is None:
        return ds
    growth = scene.drive.strength / left_by(scene.drag, clock).velocity ** 3
    safe = jnp.where(growth > 0, growth, 1.0)
    return jnp.where(growth > 0, jnp.minimum(ds, kicks.LARGEST * temperature / safe), ds)


def kicked(
    particles: Float[Array, "N components"],
    key: PRNGKeyArray,
    growth: Float[Array, ""],
    time: Float[Array, ""],
    d: int,
    at_rest: bool,
) -> Float[Array, "N components"]:
    """Particles after random kicks at a time, by which T/T_0 grows.

    Args:
        particles: v, x - v t and spins.
        key: of the random numbers.
        growth: of T/T_0.
        time: t, as in x - v t.
        d: dimension.
        at_rest: whether the kicks leave the momentum as it is.
    """
    change = jnp.sqrt(growth / 2) * kicks.kicks(key, particles[:, :d], at_rest)
    moved = [particles[:, :d] + change, particles[:, d : 2 * d] - time * change]
    return jnp.concatenate([*moved, particles[:, 2 * d :]], axis=1)
