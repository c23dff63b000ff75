"""Moments of velocities and displacements."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def temperature(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Temperature ``T = <v^2>/d`` for mass 1, of velocities relative to their mean."""
    return jnp.mean(velocity**2, axis=(-2, -1))


def sonine(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Sonine coefficient ``a_2 = d <v^4> / ((d + 2) <v^2>^2) - 1``, of velocities relative to their
    mean; 0 for a Maxwellian gas. Its standard error is ``sqrt(8 / (d (d + 2) N))``."""
    d = velocity.shape[-1]
    square = jnp.sum(velocity**2, axis=-1)
    return d / (d + 2) * jnp.mean(square**2, axis=-1) / jnp.mean(square, axis=-1) ** 2 - 1


def third_sonine(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Sonine coefficient ``a_3 = 1 + 3 a_2 - d^2 <v^6> / ((d + 2)(d + 4) <v^2>^3)``, of velocities
    relative to their mean; 0 for a Maxwellian gas."""
    d = velocity.shape[-1]
    square = jnp.sum(velocity**2, axis=-1)
    sixth = jnp.mean(square**3, axis=-1) / jnp.mean(square, axis=-1) ** 3
    return 1 + 3 * sonine(velocity) - d**2 / ((d + 2) * (d + 4)) * sixth


def mean_square_displacement(
    displacement: Float[Array, "... particles d"],
) -> Float[Array, "..."]:
    """``<dr^2>`` of displacements since t = 0, followed across the faces of the box."""
    return jnp.mean(jnp.sum(displacement**2, axis=-1), axis=-1)


def velocity_correlation(
    first: Float[Array, "... particles d"], velocity: Float[Array, "... particles d"]
) -> Float[Array, "..."]:
    """Velocity autocorrelation ``<v(0) . v(t)> / d``, which is T at t = 0."""
    return jnp.mean(first * velocity, axis=(-2, -1))


def centred(velocity: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Velocities relative to their mean."""
    return velocity - jnp.mean(velocity, axis=0, keepdims=True)
