"""Pairs of particles in periodic boxes: as a search finds them, and with their offsets."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int


class ListedPairs(NamedTuple):
    """Pairs of particles closer than a cutoff, each once, as a search finds them.

    Attributes:
        i, j: indices into the particles of all replicas; rows beyond `count` are (0, 0).
        count: number of pairs. If it exceeds the capacity of the list, pairs are missing.
        lookahead: look-ahead, in particles, that a sweep or cells needed. If it exceeds their
            capacity, pairs are missing. 0 for jax-md.
    """

    i: Int[Array, "pairs"]
    j: Int[Array, "pairs"]
    count: Int[Array, ""]
    lookahead: Int[Array, ""]


class Pairs(NamedTuple):
    """Pairs of particles closer than a cutoff, each once, with the images that are close.

    Attributes:
        i, j, count, lookahead: see `ListedPairs`.
        offset: multiple of the box side in each direction, such that ``x_i - x_j - offset`` is the
            shortest displacement of the pair. It remains valid while particles move without being
            wrapped.
    """

    i: Int[Array, "pairs"]
    j: Int[Array, "pairs"]
    offset: Float[Array, "pairs d"]
    count: Int[Array, ""]
    lookahead: Int[Array, ""]

    @property
    def in_use(self) -> Bool[Array, "pairs"]:
        """Whether each row holds a pair."""
        return jnp.arange(len(self.i), dtype=jnp.int32) < self.count


@jax.jit
def with_offsets(
    position: Float[Array, "particles d"], side: ArrayLike, listed: ListedPairs
) -> Pairs:
    """Add the offsets to the pairs that were found for these positions."""
    position, side = jax.lax.stop_gradient((position, jnp.asarray(side)))
    i, j, count, lookahead = listed
    offset = side * jnp.round((position[i] - position[j]) / side)
    return Pairs(i, j, offset, count, lookahead)


def wrap(side: ArrayLike, position: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Move positions by multiples of the side into [0, side)."""
    inside = jnp.mod(position, side)
    return jnp.where(inside >= side, 0.0, inside)  # rounding may give exactly `side`
