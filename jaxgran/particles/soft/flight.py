"""Flight between contacts, with the drag of a gas around the spheres.

``dv/dt = -gamma v`` has ``v(t) = v exp(-gamma t)`` and ``x(t) = x + v (1 - exp(-gamma t))/gamma``:
the path is that of free flight, and only the time along it differs.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

SMALL = 0.01
"""gamma t below which its share of time is computed by a series, for the sake of derivatives."""


def shortened(rate: ArrayLike, duration: ArrayLike) -> Array:
    """``(1 - exp(-gamma t))/gamma``, the duration of the free flight that goes as far."""
    z = jnp.asarray(rate * duration)
    small = jnp.abs(z) < SMALL
    large = jnp.where(small, 1.0, z)
    series = jnp.ones_like(z)
    for k in (6, 5, 4, 3, 2):  # to z^5: the next term is 1e-15
        series = 1 - z / k * series
    return jnp.asarray(duration) * jnp.where(small, series, -jnp.expm1(-large) / large)


def slower(rate: ArrayLike, duration: ArrayLike) -> Array:
    """``exp(-gamma t)``, the velocity after a duration over that before."""
    return jnp.exp(-jnp.asarray(rate * duration))


def lost_to_drag(
    square: Float[Array, "n"], rate: ArrayLike, duration: ArrayLike
) -> Float[Array, "n"]:
    """Energy lost in a duration, ``(1 - exp(-2 gamma t))/2`` of the square of the velocities."""
    return -0.5 * jnp.expm1(-2 * jnp.asarray(rate * duration)) * square
