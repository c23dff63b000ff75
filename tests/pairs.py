"""Pairs of particles, as the tests need them."""

import jax
from jax.typing import ArrayLike

from jaxgran.particles.neighbours import Pairs, search_pairs, with_offsets


def find_pairs(
    position: jax.Array,
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int = 1,
    capacity: int,
    by: str = "scipy",
) -> Pairs:
    """All pairs with their offsets; a sweep may look ahead over all particles of a replica."""
    capacities = capacity, len(position) // replicas
    found = search_pairs(position, side, cutoff, replicas, capacities, by)
    return with_offsets(position, side, found)
