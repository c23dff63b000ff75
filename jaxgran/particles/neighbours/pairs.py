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
        i, j, count, lookahead: see `ListedPairs`, all of whose fields come first here.
        offset: multiple of the box side in each direction, such that ``x_i - x_j - offset`` is the
            shortest displacement of the pair. It remains valid while particles move without being
            wrapped.
    """

    i: Int[Array, "pairs"]
    j: Int[Array, "pairs"]
    count: Int[Array, ""]
    lookahead: Int[Array, ""]
    offset: Float[Array, "pairs d"]

    @property
    def in_use(self) -> Bool[Array, "pairs"]:
        """Whether each row holds a pair."""
        return jnp.arange(len(self.i), dtype=jnp.int32) < self.count


@jax.jit
def with_offsets(
    position: Float[Array, "particles d"], side: ArrayLike, listed: ListedPairs
) -> Pairs:
    """Add the offsets, which have no derivatives, to the pairs found for these positions."""
    position, side = jax.lax.stop_gradient((position, jnp.asarray(side)))
    offset = side * jnp.round((position[listed.i] - position[listed.j]) / side)
    return Pairs(*listed, offset)
