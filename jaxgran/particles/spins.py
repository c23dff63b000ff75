"""Spins of rough spheres, ``s = (sigma/2) w``, which are velocities of their surfaces."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def at_start(
    key: PRNGKeyArray, shape: tuple[int, int, int], mean_square: Float[Array, ""]
) -> Float[Array, "replicas N spins"]:
    """Maxwellian spins of a given mean square of each component in each replica."""
    spins = jax.random.normal(key, shape, mean_square.dtype)
    size = jnp.sqrt(mean_square / jnp.mean(spins**2, axis=(1, 2), keepdims=True))
    return size * spins


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
