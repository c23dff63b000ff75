"""The tangential force of soft spheres: see `jaxgran.Frictional`.

Units here: the diameter and the mass are 1. Spins are (sigma/2) w.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.particles.soft.candidates import Encounters
from jaxgran.particles.soft.scene import SoftSurface
from jaxgran.particles.soft.steps import PairKick
from jaxgran.particles.soft.walls import SoftWalls, WallKick
from jaxgran.particles.spins import torque, twisted


class Rubbed(NamedTuple):
    """Velocities and spins after the tangential kick of a time step, and the energy lost in it, of
    each contact or member."""

    v: Float[Array, "members d"]
    spin: Float[Array, "members spins"]
    dissipated: Float[Array, "..."]


def tangential_kick(
    slip: Float[Array, "contacts d"],
    viscous: Float[Array, "contacts"],
    limit: Float[Array, "contacts"],
    response: Float[Array, "contacts"],
    dt: ArrayLike,
) -> tuple[Float[Array, "contacts d"], Float[Array, "contacts"]]:
    """The kick ``-dt min(viscous |u|, limit) u/|u|`` at the mean slip u, and the energy lost.

    The mean is that of the slips before and after a viscous kick, as in `midpoint_rate`; the energy
    lost is exactly the change of the kinetic energy.

    Args:
        slip: before.
        viscous: force per slip.
        limit: the largest force.
        response: change of the slip over the kick.
        dt: time step.
    """
    dt = jnp.asarray(dt)
    mean = slip / (1 + 0.5 * dt * viscous * response)[:, None]
    square = jnp.sum(mean * mean, -1)
    slips = square > 0
    size = jnp.sqrt(jnp.where(slips, square, 1.0))
    force = jnp.where(slips, jnp.minimum(viscous * size, limit) / size, 0.0)
    kick = -(dt * force)[:, None] * mean
    return kick, -jnp.sum(kick * (slip + 0.5 * response[:, None] * kick), -1)


def kicked(
    surface: SoftSurface,
    spin: Float[Array, "members spins"],
    normal: PairKick,
    chosen: Encounters,
    dt: ArrayLike,
) -> Rubbed:
    """The tangential kick of a time step, which follows the normal one.

    The two commute for one contact: neither changes the velocity that the other depends on.

    Args:
        surface: of the spheres.
        spin: of the members.
        normal: the normal kick.
        chosen: the pairs.
        dt: time step.
    """
    a, b, v, towards = chosen.a, chosen.b, normal.v, -normal.normal
    lever = 1 - normal.xi  # distance of the centres
    relative = v[a] - v[b]
    sideways = relative - jnp.sum(relative * towards, -1, keepdims=True) * towards
    slip = sideways + lever[:, None] * twisted(spin[a] + spin[b], towards)
    kick, lost = tangential_kick(
        slip,
        surface.damping * normal.viscous,
        surface.friction * normal.force,
        2 * (1 + lever**2 / surface.inertia),
        dt,
    )
    twist = (lever / surface.inertia)[:, None] * torque(towards, kick)
    return Rubbed(
        v=v.at[a].add(kick).at[b].add(-kick),
        spin=spin.at[a].add(twist).at[b].add(twist),
        dissipated=lost,
    )


def kicked_by_walls(
    walls: SoftWalls,
    surface: SoftSurface,
    spin: Float[Array, "members spins"],
    normal: WallKick,
    dt: ArrayLike,
) -> Rubbed:
    """The tangential kicks of a time step by walls, one axis after the other.

    Args:
        walls: which rub.
        surface: of the spheres.
        spin: of the members.
        normal: the normal kicks.
        dt: time step.
    """
    assert walls.damping is not None and walls.friction is not None
    v, lost = normal.v, jnp.zeros(len(spin), spin.dtype)
    for axis, along in enumerate(jnp.eye(v.shape[1], dtype=v.dtype)):
        towards = normal.overlaps.outwards[:, axis, None] * along[None]
        lever = 1 - 2 * normal.overlaps.xi[:, axis]  # distance from the wall
        sideways = v * (1 - along)[None]
        kick, taken = tangential_kick(
            sideways + lever[:, None] * twisted(spin, towards),
            walls.damping * normal.viscous[:, axis],
            walls.friction * normal.force[:, axis],
            1 + lever**2 / surface.inertia,
            dt,
        )
        v, lost = v + kick, lost + taken
        spin = spin + (lever / surface.inertia)[:, None] * torque(towards, kick)
    return Rubbed(v, spin, lost)
