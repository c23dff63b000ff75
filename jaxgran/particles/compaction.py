"""Fixed-size compaction: indices of the True entries of a mask, or of the set bits of words.

Compiled code cannot make an array of as many rows as there happen to be True entries. It makes one
of a fixed size instead, and counts the entries, so that the caller can tell whether all fitted.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32


def rows_where(mask: Bool[Array, "all"], size: int) -> tuple[Int[Array, "{size}"], Int[Array, ""]]:
    """Indices of the True entries of a mask, in increasing order, and their number.

    The True entries are counted in words of 32 bits, and each is found in its word by bisection: on
    a CPU this is two to six times as fast as a cumulative sum over the mask.

    Args:
        mask: the entries.
        size: length of the array of indices.

    Returns:
        The indices, with ``mask.size`` in the rows that are left over, and the number of True
        entries. If that exceeds `size`, only the first `size` of them are returned.
    """
    num_words = -(-mask.size // 32)
    bits = jnp.pad(mask, (0, 32 * num_words - mask.size)).reshape(num_words, 32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32)[None], axis=1, dtype=jnp.uint32)
    word, bit, count = bits_where(words, size)
    return jnp.where(jnp.arange(size) < count, 32 * word + bit, mask.size), count


def bits_where(
    words: UInt32[Array, "words"], size: int
) -> tuple[Int[Array, "{size}"], Int[Array, "{size}"], Int[Array, ""]]:
    """Positions of the set bits of an array of words, in increasing order, and their number.

    Args:
        words: the bits; bit 0 is the lowest of a word.
        size: length of the arrays of positions.

    Returns:
        For each set bit the index of its word and its place in that word, 0 to 31, and the number
        of set bits. Rows beyond that number hold arbitrary values.
    """
    counts = jax.lax.population_count(words).astype(jnp.int32)
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    starts, row = ends - counts, jnp.arange(size, dtype=jnp.int32)
    begun = jnp.zeros(size, jnp.int32).at[starts].add(1, mode="drop")
    word = jnp.cumsum(begun, dtype=jnp.int32) - 1  # the last word that begins at or before a row
    rest, rank, bit = words[word], row - starts[word], jnp.zeros(size, jnp.int32)
    for half in (16, 8, 4, 2, 1):
        low = jax.lax.population_count(rest & jnp.uint32(2**half - 1)).astype(jnp.int32)
        upper = rank >= low
        rest = jnp.where(upper, rest >> half, rest)
        rank = jnp.where(upper, rank - low, rank)
        bit = jnp.where(upper, bit + half, bit)
    return word, bit, ends[-1]
