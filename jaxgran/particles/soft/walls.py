"""Contacts of soft spheres with the flat walls of a container.

Units here: the diameter and the mass are 1. Positions are coordinates from a corner of the
container; centres of spheres that touch no wall are between 1/2 and its side less 1/2. The
periodic box is a cube longer than the container by a diameter: no sphere meets another one through
its boundary.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxgran.scene.contact import contact_force, midpoint_rate

MARGIN = 1.0
"""Diameters by which the periodic box is longer than the container."""


class SoftWalls(eqx.Module):
    """The walls of a container.

    Attributes:
        sides: of the container.
        alpha: elastic constant over effective mass, which is that of the sphere.
        dissipative_constant: A of contacts with walls.
        clipped: as for spheres.
        damping, friction: x_t and mu; None where the walls are smooth.
    """

    sides: Float[Array, "d"]
    alpha: Float[Array, ""]
    dissipative_constant: Float[Array, ""]
    clipped: bool = eqx.field(static=True, default=True)
    damping: Float[Array, ""] | None = None
    friction: Float[Array, ""] | None = None


class Overlaps(NamedTuple):
    """Overlaps with the nearer wall across each axis.

    Attributes:
        xi: the overlap; negative without contact.
        outwards: 1 or -1, the direction to the wall.
    """

    xi: Float[Array, "n d"]
    outwards: Float[Array, "n d"]


def overlaps(walls: SoftWalls, x: Float[Array, "n d"]) -> Overlaps:
    """The overlaps of spheres with the nearer wall across each axis."""
    below, above = 0.5 - x, x - (walls.sides - 0.5)[None]
    return Overlaps(jnp.maximum(below, above), jnp.where(above > below, 1.0, -1.0).astype(x.dtype))


def stored(walls: SoftWalls, x: Float[Array, "n d"]) -> Float[Array, "n"]:
    """Elastic energy of each sphere in contacts with walls, ``(2/5) rho xi^(5/2)``, rho = alpha."""
    xi = overlaps(walls, x).xi
    touching = xi > 0
    energy = 0.4 * walls.alpha * jnp.where(touching, xi, 1.0) ** 2.5
    return jnp.sum(jnp.where(touching, energy, 0.0), axis=-1)


def near(
    walls: SoftWalls | None, x: Float[Array, "n d"], v: Float[Array, "n d"], duration: ArrayLike
) -> Bool[Array, "n"] | None:
    """Which spheres touch a wall now or would in free flight of this duration; None without."""
    if walls is None:
        return None
    farthest = jnp.maximum(overlaps(walls, x).xi, overlaps(walls, x + v * duration).xi)
    return jnp.any(farthest > 0, axis=-1)


class WallKick(NamedTuple):
    """What walls do to spheres in a time step.

    Attributes:
        v: velocities after it.
        overlaps: before it.
        force, viscous: normal force across each axis, and the change of it by a unit of speed.
        dissipated, exchanged: as in `steps.ContactWork`, of each sphere.
        touching: whether a sphere touches a wall.
    """

    v: Float[Array, "n d"]
    overlaps: Overlaps
    force: Float[Array, "n d"]
    viscous: Float[Array, "n d"]
    dissipated: Float[Array, "n"]
    exchanged: Float[Array, "n"]
    touching: Bool[Array, "n"]


def kicked(
    walls: SoftWalls,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    dt: ArrayLike,
) -> WallKick:
    """Velocities after the kick of a time step by the implicit midpoint rule of `midpoint_rate`.

    Args:
        walls: for their sides.
        x, v: of the spheres.
        alpha, dissipative_constant: of the walls, one number or one for each sphere, (n, 1).
        dt: time step.
    """
    dt = jnp.asarray(dt)
    xi, outwards = overlaps(walls, x)
    xi_dot, A = outwards * v, dissipative_constant
    rate = midpoint_rate(xi, xi_dot, alpha, A, dt)
    force = contact_force(xi, rate, alpha, A, clipped=walls.clipped)
    elastic = contact_force(xi, 0.0, alpha, 0.0)
    mean, half = xi_dot - 0.5 * dt * force, 0.5 * dt * force
    viscous = contact_force(xi, 1.0, alpha, A) - elastic
    # As for pairs, the mean of the midpoint and the trapezoidal sum.
    lost = (force - elastic) * mean + 0.5 * viscous * half**2
    return WallKick(
        v=v - dt * force * outwards,
        overlaps=Overlaps(xi, outwards),
        force=force,
        viscous=viscous,
        dissipated=dt * jnp.sum(lost, axis=-1),
        exchanged=dt * jnp.sum(elastic * jnp.abs(mean), axis=-1),
        touching=jnp.any(xi > 0, axis=-1),
    )
