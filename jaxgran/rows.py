"""Indices of what is marked, in arrays of fixed length: where a mask holds, where bits are set."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, UInt32


def rows_where(mask: Bool[Array, "all"], size: int) -> tuple[Array, Array]:
    """Indices where a mask holds, filled up with its length, and how many there are.

    What holds is counted by words of 32 bits, and each index is found by halving its word: two to
    six times as fast, on a CPU, as a running count over the mask.
    """
    num_words = -(-mask.size // 32)
    bits = jnp.pad(mask, (0, 32 * num_words - mask.size)).reshape(num_words, 32)
    words = jnp.sum(bits << jnp.arange(32, dtype=jnp.uint32)[None], axis=1, dtype=jnp.uint32)
    word, bit, count = bits_where(words, size)
    return jnp.where(jnp.arange(size) < count, 32 * word + bit, mask.size), count


def bits_where(
    words: UInt32[Array, "words"], size: int
) -> tuple[Int[Array, "size"], Int[Array, "size"], Int[Array, ""]]:
    """The word and the place in it of each bit that is set, and how many there are.

    Rows past that hold nothing of use.
    """
    counts = jax.lax.population_count(words).astype(jnp.int32)
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    starts, row = ends - counts, jnp.arange(size, dtype=jnp.int32)
    begun = jnp.zeros(size, jnp.int32).at[starts].add(1, mode="drop")
    word = jnp.cumsum(begun, dtype=jnp.int32) - 1  # the last that begins at a row or before
    rest, rank, bit = words[word], row - starts[word], jnp.zeros(size, jnp.int32)
    for half in (16, 8, 4, 2, 1):
        low = jax.lax.population_count(rest & jnp.uint32(2**half - 1)).astype(jnp.int32)
        upper = rank >= low
        rest = jnp.where(upper, rest >> half, rest)
        rank = jnp.where(upper, rank - low, rank)
        bit = jnp.where(upper, bit + half, bit)
    return word, bit, ends[-1]
