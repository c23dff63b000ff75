"""Random kicks by which white noise drives spheres."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

LARGEST = 0.05
"""Largest growth of T by the kicks of one step, over T."""


def wrapped(words: Array) -> PRNGKeyArray:
    """Two 32-bit words as a key of threefry, whose numbers do not change under `jax.vmap`."""
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def kicks(
    key: PRNGKeyArray,
    velocity: Float[Array, "N d"],
    at_rest: bool,
    counted: Bool[Array, "N"] | None = None,
) -> Float[Array, "N d"]:
    """Random kicks of variance 1 for each component, of the shape of velocities.

    Each is the number of ones in 16 random bits, whose fourth moment is 4 % below that of a
    Gaussian number. Sums over the many small kicks of a mean free time are Gaussian.

    Args:
        key: of the random numbers.
        velocity: of the particles of one replica.
        at_rest: whether the kicks together leave the momentum as it is; they are then enlarged by
            ``sqrt(N/(N - 1))``, so that their mean square is 1 again.
        counted: which particles are kicked; all by default. Those that are not have any value.
    """
    bits = jax.random.bits(key, velocity.shape, jnp.uint16)
    found = 0.5 * (jax.lax.population_count(bits).astype(velocity.dtype) - 8)
    if not at_rest:
        return found
    if counted is None:
        n = len(velocity)
        return (n / (n - 1)) ** 0.5 * (found - jnp.mean(found, axis=0, keepdims=True))
    n = jnp.maximum(jnp.sum(counted), 2).astype(velocity.dtype)
    mean = jnp.sum(jnp.where(counted[:, None], found, 0.0), axis=0, keepdims=True) / n
    return jnp.sqrt(n / (n - 1)) * (found - mean)
