"""Pairs that are near, found by sorting along x and looking ahead: all of it compiled."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran.rows import bits_where

_WORD = 32
_X, _YZ = 2.0**30, 2.0**32  # steps of a box side


def unsorted(num_particles: int) -> float:
    """The share of a box side within which particles are left in any order."""
    return 2.0 ** (_index_bits(num_particles) - 31)


def _index_bits(num_particles: int) -> int:
    return max((num_particles - 1).bit_length(), 1)


@partial(jax.jit, static_argnames=("replicas", "room", "ahead"))
def sweep(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int,
    room: int,
    ahead: int,
) -> tuple[Int[Array, "room"], Int[Array, "room"], Int[Array, ""], Int[Array, ""]]:
    """All pairs closer than a cutoff, in each of several equal periodic boxes.

    Sweep and prune: with the particles of a box in order of x, the partners of each are among those
    that follow it, so many as there are within the cutoff along x: ``N cutoff / side`` in an even
    gas. Coordinates are whole numbers of small steps, whose differences are periodic by themselves
    (along x by a second copy), and one bit tells whether a pair is near. The work grows as
    ``N^(2 - 1/d)``: for boxes of up to some ten thousand particles this is faster than cells, and
    there is no call to the host.

    Args:
        position: of all particles, replica after replica, in [0, side).
        side: of the boxes.
        cutoff: in the same unit, > 0 and, by a part in 10^6, less than half a side.
        replicas: number of boxes.
        room: how many pairs can be returned.
        ahead: how many that follow each particle can be looked at.

    Returns:
        i < j; how many pairs there are, of which those that there was room for come first; and how
        far ahead had to be looked: beyond `ahead` nothing was found. Pairs farther apart than the
        cutoff may be among them, by at most a part in 10^6 and 10^-8 of a side (float32: 10^-6).

    Raises:
        ValueError: if there are too many particles, looking so far ahead, for 32-bit indices.
    """
    n, d = len(position) // replicas, position.shape[-1]
    num_words = max(-(-min(ahead, n) // _WORD), 1)
    if num_words * replicas * n >= 2**31:
        raise ValueError(
            f"a sweep over {replicas * n} particles cannot look {ahead} ahead, as its indices have "
            "32 bits: use neighbours='vesin' or 'jax-md'"
        )
    unit = position.reshape(replicas, n, d) / side
    unit = jnp.where(unit >= 1, 0.0, unit)  # by rounding
    finite = jnp.all(jnp.isfinite(position))

    # One number holds the place, coarsely, and the index: such are sorted ten times as fast as two.
    index_bits = _index_bits(n)
    coarse = (unit[..., 0] * 2.0 ** (31 - index_bits)).astype(jnp.int32) << index_bits
    order = jax.lax.sort(coarse | jnp.arange(n, dtype=jnp.int32)[None]) & (2**index_bits - 1)
    unit = jnp.take_along_axis(unit, order[..., None], axis=1)
    x = (unit[..., 0] * _X).astype(jnp.int32)
    others = [((unit[..., k] - 0.5) * _YZ).astype(jnp.int32) for k in range(1, d)]

    # Who follows the last are the first of the next box side, and then nobody.
    end = jnp.full((replicas, 2 * _WORD), jnp.iinfo(jnp.int32).max)
    x_ahead = jnp.concatenate([x, x + int(_X), end], axis=1)
    others_ahead = [jnp.concatenate([y, y, end], axis=1) for y in others]

    reach = cutoff / side * _YZ + 8 + 4 * _YZ * jnp.finfo(position.dtype).eps  # for rounding
    square = jnp.minimum(reach * reach * (1 + 1e-6), (_YZ / 2) ** 2).astype(jnp.float32)
    farthest = (reach * (_X / _YZ)).astype(jnp.int32) + 2 ** max(index_bits - 1, 1)

    def followers(array, first, count):
        return jax.lax.dynamic_slice_in_dim(array, first, count, axis=1)

    def look(carry):
        block, words = carry
        window = [followers(a, _WORD * block + 1, n + _WORD - 1) for a in (x_ahead, *others_ahead)]
        word = jnp.zeros((replicas, n), jnp.uint32)
        for bit in range(_WORD):
            apart = [
                (there[:, bit : bit + n] - here).astype(jnp.float32)
                for there, here in zip(window, (x, *others), strict=True)
            ]
            apart[0] *= _YZ / _X
            near = sum(a * a for a in apart) < square
            word |= near.astype(jnp.uint32) << bit
        return block + 1, words.at[block].set(word, mode="drop")

    def unfinished(carry):
        block, _ = carry
        nearest = jnp.min(followers(x_ahead, _WORD * block + 1, n) - x)
        return finite & (_WORD * block + 1 < n) & (nearest <= farthest)

    words = jnp.zeros((num_words, replicas, n), jnp.uint32)
    blocks, words = jax.lax.while_loop(unfinished, look, (jnp.int32(0), words))

    word, bit, count = bits_where(words.ravel(), room)
    here = word % (replicas * n)
    first = n * (here // n)
    there = here - first + _WORD * (word // (replicas * n)) + bit + 1
    there = first + jnp.where(there >= n, there - n, there)
    particle = (order + n * jnp.arange(replicas, dtype=jnp.int32)[:, None]).ravel()
    real = jnp.arange(room) < count
    i, j = (jnp.where(real, particle.at[k].get(mode="clip"), 0) for k in (here, there))
    return jnp.minimum(i, j), jnp.maximum(i, j), count, jnp.minimum(_WORD * blocks, n - 1)
