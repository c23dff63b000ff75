"""Comparisons of coordinates as whole numbers, which a sweep and cells share.

Differences of whole numbers are periodic by integer overflow. One bit per comparison says whether a
pair is within the cutoff.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, DTypeLike, Float

from jaxgran.particles.bit_masks import WORD

STEPS = 2.0**32
"""Number of steps of a coordinate per side of a box."""

ALTERNATIVES = {"sweep": "'cells' or 'jax-md'", "cells": "'jax-md'"}
"""Methods that remain where one cannot be used, for messages."""


def reach_in_steps(cutoff: ArrayLike, side: ArrayLike, dtype: DTypeLike) -> Float[Array, ""]:
    """Return the cutoff in `STEPS`, enlarged by the rounding errors of positions of a dtype."""
    reach = jnp.asarray(cutoff / side) * STEPS
    return reach + 8 + 4 * STEPS * jnp.finfo(dtype).eps


def squared_reach(reach: Float[Array, ""]) -> Float[Array, ""]:
    """Return the square of a reach in float32, enlarged by its rounding error."""
    return (reach * reach * (1 + 1e-6)).astype(jnp.float32)


def num_words_ahead(engine: str, ahead: int, num_particles: int, num_runs: int) -> int:
    """Return the number of words that hold the comparisons of a run.

    Args:
        engine: name of the method, for the message.
        ahead: number of particles with which a particle is compared in a run.
        num_particles: number of particles of all replicas.
        num_runs: number of runs of each particle.

    Raises:
        ValueError: if the words of all particles are too many for 32-bit indices.
    """
    num_words = max(-(-ahead // WORD), 1)
    total_runs = num_runs * num_particles
    if num_words * total_runs >= 2**31:
        raise ValueError(
            f"neighbours={engine!r} over {num_particles} particles cannot look {ahead} particles "
            f"ahead: its indices have 32 bits, which allow {(2**31 - 1) // total_runs * WORD} "
            f"ahead. Use neighbours={ALTERNATIVES[engine]}"
        )
    return num_words
