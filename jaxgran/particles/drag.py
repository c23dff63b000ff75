"""Drag on spheres, exactly: collisions in transformed time.

Between collisions ``dv/dt = -gamma v``, and so ``v = u exp(-gamma t)`` with a velocity u that only
collisions change. In the time ``s = (1 - exp(-gamma t))/gamma`` positions obey ``dx = u ds``: the
sequence of collisions is that of a gas without drag. Its laws see the true velocities,
``v = u (1 - gamma s)``, and spins that have decayed at a rate of their own.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.reduced_scene import ReducedDrag


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
    kept = jnp.exp(-drag.rotational_rate * passed(drag, time))
    return Decay(velocity, kept / velocity, kept)


def passed(drag: ReducedDrag, time: Float[Array, "..."]) -> Float[Array, "..."]:
    """The time at a transformed time."""
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    return jnp.where(drag.rate > 0, -jnp.log1p(-drag.rate * time) / safe, time)


def lasting(
    drag: ReducedDrag, began: Float[Array, "..."], duration: Float[Array, "..."]
) -> Float[Array, "..."]:
    """The time that a transformed duration lasts, >= 0."""
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    share = drag.rate * duration / (1 - drag.rate * began)
    return jnp.maximum(jnp.where(drag.rate > 0, -jnp.log1p(-share) / safe, duration), 0.0)


def transformed(drag: ReducedDrag, times: Float[Array, "times"]) -> Float[Array, "times"]:
    """The transformed times of times."""
    safe = jnp.where(drag.rate > 0, drag.rate, 1.0)
    return jnp.where(drag.rate > 0, -jnp.expm1(-drag.rate * times) / safe, times)
