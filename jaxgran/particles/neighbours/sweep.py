"""Neighbour lists by sweep and prune, for boxes of up to some thousands of particles."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, UInt32

from jaxgran.particles.bit_masks import WORD, bits_where
from jaxgran.particles.neighbours.comparisons import (
    STEPS,
    num_words_ahead,
    reach_in_steps,
    squared_reach,
)
from jaxgran.particles.neighbours.pairs import ListedPairs

X_STEPS = 2.0**30
"""Number of steps of x per side of a box: the box and its next image have different numbers."""


def unsorted_share(num_particles: int) -> float:
    """Return the share of the box side within which a sweep does not sort particles."""
    return 2.0 ** (_index_bits(num_particles) - 31)


def _index_bits(num_particles: int) -> int:
    return max((num_particles - 1).bit_length(), 1)


@partial(jax.jit, static_argnames=("replicas", "capacity", "ahead"))
def pairs_by_sweep(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int,
    capacity: int,
    ahead: int,
) -> ListedPairs:
    """Find all pairs closer than a cutoff, in each of several equal periodic boxes.

    The method is sweep and prune: the particles of each box are sorted by x, and every particle is
    compared with the following ones, up to the cutoff along x: ``N cutoff / side`` particles in a
    homogeneous gas. Coordinates are rounded to a grid of whole numbers, whose differences are
    periodic by integer overflow (along x by a second copy of the box). The work grows as
    ``N^(2 - 1/d)``. For boxes of up to some ten thousand particles this is faster than a cell list,
    and it needs no call to the host.

    Args:
        position: positions of all particles, replica after replica, in [0, side).
        side: side of the boxes.
        cutoff: distance in the same unit, > 0 and less than half a side by at least a part in 10^6.
        replicas: number of boxes.
        capacity: largest number of pairs that can be returned.
        ahead: largest number of following particles with which a particle can be compared.

    Returns:
        i and j with i < j; the number of pairs, of which the first `capacity` are returned; and the
        look-ahead that was needed. If that exceeds `ahead`, pairs beyond `ahead` are missing. Pairs
        slightly beyond the cutoff may be included, by at most a part in 10^6 of the cutoff and
        10^-8 of the side (in float32: 10^-6).

    Raises:
        ValueError: if the number of particles times the look-ahead is too large for 32-bit indices.
    """
    n = len(position) // replicas
    num_words = num_words_ahead("sweep", min(ahead, n), replicas * n, 1)
    unit = position.reshape(replicas, n, position.shape[-1]) / side
    unit = jnp.where(unit >= 1, 0.0, unit)  # by rounding
    order = _order_along_x(unit)
    here = _in_steps(jnp.take_along_axis(unit, order[..., None], axis=1))
    there = _continued(here)

    reach = reach_in_steps(cutoff, side, position.dtype)
    square = jnp.minimum(squared_reach(reach), (STEPS / 2) ** 2)  # beyond, pairs would occur twice
    along_x = (reach * (X_STEPS / STEPS)).astype(jnp.int32) + _unsorted_steps(n)
    finite = jnp.all(jnp.isfinite(position))

    def following(axis: int, block: Int[Array, ""], count: int) -> Int[Array, "replicas {count}"]:
        """Return coordinates of the particle after each one, from a block of comparisons on."""
        return jax.lax.dynamic_slice_in_dim(there[axis], WORD * block + 1, count, axis=1)

    def compare_block(carry: tuple) -> tuple:
        block, words = carry
        window = [following(axis, block, n + WORD - 1) for axis in range(len(here))]
        return block + 1, words.at[block].set(_near_in_window(here, window, square), mode="drop")

    def unfinished(carry: tuple) -> Array:
        block, _ = carry
        nearest = jnp.min(following(0, block, n) - here[0])
        return finite & (WORD * block + 1 < n) & (nearest <= along_x)

    words = jnp.zeros((num_words, replicas, n), jnp.uint32)
    num_blocks, words = jax.lax.while_loop(unfinished, compare_block, (jnp.int32(0), words))
    i, j, count = _pairs_of_bits(words, order, capacity)
    return ListedPairs(i, j, count, lookahead=jnp.minimum(WORD * num_blocks, n - 1))


def _order_along_x(unit: Float[Array, "replicas n d"]) -> Int[Array, "replicas n"]:
    """Return the particles of each box in the order of coarse steps of x."""
    # Sorting one integer of the coarse coordinate and the index takes a tenth of the time of
    # sorting two arrays.
    n = unit.shape[1]
    bits = _index_bits(n)
    coarse = (unit[..., 0] * 2.0 ** (31 - bits)).astype(jnp.int32) << bits
    return jax.lax.sort(coarse | jnp.arange(n, dtype=jnp.int32)[None]) & (2**bits - 1)


def _unsorted_steps(num_particles: int) -> int:
    """Return the length of a coarse step of x, within which particles are not sorted."""
    return 2 ** max(_index_bits(num_particles) - 1, 1)


def _in_steps(unit: Float[Array, "replicas n d"]) -> list[Int[Array, "replicas n"]]:
    """Return coordinates over the side along each axis as whole numbers of steps."""
    x = (unit[..., 0] * X_STEPS).astype(jnp.int32)
    others = [((unit[..., k] - 0.5) * STEPS).astype(jnp.int32) for k in range(1, unit.shape[-1])]
    return [x, *others]


def _continued(here: list[Int[Array, "replicas n"]]) -> list[Int[Array, "replicas more"]]:
    """Return coordinates, then the same in the next image of the box, and far ones as padding."""
    image = [here[0] + int(X_STEPS), *here[1:]]
    end = jnp.full((len(here[0]), 2 * WORD), jnp.iinfo(jnp.int32).max)
    return [jnp.concatenate([x, y, end], axis=1) for x, y in zip(here, image, strict=True)]


def _near_in_window(
    here: list[Int[Array, "replicas n"]],
    window: list[Int[Array, "replicas more"]],
    square: Float[Array, ""],
) -> UInt32[Array, "replicas n"]:
    """Return which of 32 particles in a window behind each particle are within the cutoff."""
    n = here[0].shape[1]
    word = jnp.zeros(here[0].shape, jnp.uint32)
    for bit in range(WORD):
        apart = [
            (there[:, bit : bit + n] - x).astype(jnp.float32)
            for there, x in zip(window, here, strict=True)
        ]
        apart[0] *= STEPS / X_STEPS
        near = sum(a * a for a in apart) < square
        word |= near.astype(jnp.uint32) << bit
    return word


def _pairs_of_bits(
    words: UInt32[Array, "words replicas n"], order: Int[Array, "replicas n"], capacity: int
) -> tuple[Int[Array, "{capacity}"], Int[Array, "{capacity}"], Int[Array, ""]]:
    """Return i < j of the pair of each set bit, and the number of pairs."""
    replicas, n = order.shape
    word, bit, count = bits_where(words.ravel(), capacity)
    index = word % (replicas * n)
    first = n * (index // n)
    there = index - first + WORD * (word // (replicas * n)) + bit + 1
    there = first + jnp.where(there >= n, there - n, there)
    particle = (order + n * jnp.arange(replicas, dtype=jnp.int32)[:, None]).ravel()
    in_use = jnp.arange(capacity, dtype=jnp.int32) < count
    i, j = (jnp.where(in_use, particle.at[k].get(mode="clip"), 0) for k in (index, there))
    return jnp.minimum(i, j), jnp.maximum(i, j), count
