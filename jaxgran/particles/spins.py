"""Spins of rough spheres, ``s = (sigma/2) w``, which are velocities of their surfaces."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from jaxgran.scene.elements import SPINS


def at_start(
    key: PRNGKeyArray, shape: tuple[int, int, int], mean_square: Float[Array, ""]
) -> Float[Array, "replicas N spins"]:
    """Maxwellian spins of a given mean square of each component in each replica."""
    spins = jax.random.normal(key, shape, mean_square.dtype)
    size = jnp.sqrt(mean_square / jnp.mean(spins**2, axis=(1, 2), keepdims=True))
    return size * spins


def maxwellian(
    key: PRNGKeyArray, velocity: Float[Array, "n d"], replicas: int, mean_square: Float[Array, ""]
) -> Float[Array, "n spins"]:
    """Spins at t = 0 of all spheres of a run with this key, see `at_start`."""
    n, d = velocity.shape
    key = jax.random.fold_in(key, 2)  # 0 and 1 are of positions and velocities
    shape = replicas, n // replicas, SPINS[d]
    return at_start(key, shape, mean_square.astype(velocity.dtype)).reshape(n, SPINS[d])


def twisted(
    spin: Float[Array, "pairs spins"], normal: Float[Array, "pairs d"]
) -> Float[Array, "pairs d"]:
    """``s x n``, the velocity of a surface in the direction of n."""
    if normal.shape[-1] == 2:
        return spin * jnp.stack([-normal[:, 1], normal[:, 0]], axis=-1)
    return jnp.cross(spin, normal)


def torque(
    normal: Float[Array, "pairs d"], force: Float[Array, "pairs d"]
) -> Float[Array, "pairs spins"]:
    """``n x f``; the one component of two vectors in a plane."""
    if normal.shape[-1] == 2:
        return (normal[:, 0] * force[:, 1] - normal[:, 1] * force[:, 0])[:, None]
    return jnp.cross(normal, force)


class Rub(NamedTuple):
    """The tangential part of impacts.

    Attributes:
        sideways: tangential part of the relative velocity of the centres.
        slip: that of the surfaces at contact; 0 where there is no friction.
        kick: change of velocity of the first partner.
        twist: change of spin, of both partners alike.
    """

    sideways: Float[Array, "pairs d"]
    slip: Float[Array, "pairs d"]
    kick: Float[Array, "pairs d"]
    twist: Float[Array, "pairs spins"]


def rub(
    relative: Float[Array, "pairs d"],
    spin: Float[Array, "pairs spins"],
    normal: Float[Array, "pairs d"],
    where: Bool[Array, "pairs"],
    eta: Float[Array, ""],
    inertia: Float[Array, ""],
) -> Rub:
    """The tangential part of impacts, ``-eta`` times the slip: see `jaxgran.Rough`.

    Args:
        relative: velocity of the first partner less that of the second.
        spin: sum of their spins; a wall has none.
        normal: from the first to the second.
        where: there is friction.
        eta: share of the slip that becomes the kick.
        inertia: q.
    """
    sideways = relative - jnp.sum(relative * normal, axis=-1, keepdims=True) * normal
    slip = jnp.where(where[:, None], sideways + twisted(spin, normal), 0.0)
    kick = -eta * slip
    return Rub(sideways, slip, kick, torque(normal, kick) / inertia)
