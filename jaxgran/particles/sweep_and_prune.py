"""Neighbour search by sweep and prune along x, compiled with the rest of a run."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, DTypeLike, Float, Int, UInt32

from jaxgran.particles.compaction import bits_where

_WORD = 32
_X, _YZ = 2.0**30, 2.0**32  # grid steps per box side, along x and along the other axes


def unsorted(num_particles: int) -> float:
    """Share of the box side within which a sweep leaves particles in arbitrary order."""
    return 2.0 ** (_index_bits(num_particles) - 31)


def _index_bits(num_particles: int) -> int:
    return max((num_particles - 1).bit_length(), 1)


@partial(jax.jit, static_argnames=("replicas", "capacity", "ahead"))
def sweep(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int,
    capacity: int,
    ahead: int,
) -> tuple[Int[Array, "{capacity}"], Int[Array, "{capacity}"], Int[Array, ""], Int[Array, ""]]:
    """All pairs closer than a cutoff, in each of several equal periodic boxes.

    Sweep and prune: the particles of each box are sorted by x, and every particle is compared with
    those that follow it, up to the cutoff along x: ``N cutoff / side`` particles in a homogeneous
    gas. Coordinates are rounded to a grid of whole numbers, whose differences are periodic by
    integer overflow (along x by a second copy of the box). One bit per comparison tells whether the
    pair is within the cutoff. The work grows as ``N^(2 - 1/d)``. For boxes of up to some ten
    thousand particles this is faster than a cell list, and it needs no call to the host.

    Args:
        position: of all particles, replica after replica, in [0, side).
        side: of the boxes.
        cutoff: in the same unit, > 0 and less than half a side by at least a part in 10^6.
        replicas: number of boxes.
        capacity: largest number of pairs that can be returned.
        ahead: how many of the following particles each particle can be compared with.

    Returns:
        i and j with i < j; the number of pairs found, of which the first `capacity` are returned;
        and the look-ahead that was needed. If that exceeds `ahead`, pairs beyond `ahead` are
        missing. Pairs slightly beyond the cutoff may be included, by at most a part in 10^6 of the
        cutoff and 10^-8 of the side (in float32: 10^-6).

    Raises:
        ValueError: if the number of particles times the look-ahead is too large for 32-bit indices.
    """
    n = len(position) // replicas
    num_words = max(-(-min(ahead, n) // _WORD), 1)
    if num_words * replicas * n >= 2**31:
        raise ValueError(
            f"a sweep over {replicas * n} particles cannot look {ahead} particles ahead: its "
            f"indices have 32 bits, which allow {(2**31 - 1) // (replicas * n) * _WORD} ahead; use "
            "neighbours='scipy' or 'jax-md'"
        )
    unit = position.reshape(replicas, n, position.shape[-1]) / side
    unit = jnp.where(unit >= 1, 0.0, unit)  # by rounding
    finite = jnp.all(jnp.isfinite(position))
    order, unit = _sorted_along_x(unit)
    grid = _Grid.of(unit)
    words, num_looked = _near_bits(grid, _reach(side, cutoff, n, position.dtype), finite, num_words)
    word, bit, count = bits_where(words.ravel(), capacity)
    i, j = _decoded(word, bit, order)
    real = jnp.arange(capacity) < count
    i, j = (jnp.where(real, k, 0) for k in (i, j))
    return jnp.minimum(i, j), jnp.maximum(i, j), count, jnp.minimum(num_looked, n - 1)


def _sorted_along_x(
    unit: Float[Array, "replicas n d"],
) -> tuple[Int[Array, "replicas n"], Float[Array, "replicas n d"]]:
    """The order of the particles of each box along x, and their positions in that order."""
    n = unit.shape[1]
    # One integer holds the coarse coordinate and the index: sorting it takes a tenth of the time of
    # sorting two arrays.
    index_bits = _index_bits(n)
    coarse = (unit[..., 0] * 2.0 ** (31 - index_bits)).astype(jnp.int32) << index_bits
    order = jax.lax.sort(coarse | jnp.arange(n, dtype=jnp.int32)[None]) & (2**index_bits - 1)
    return order, jnp.take_along_axis(unit, order[..., None], axis=1)


class _Grid(NamedTuple):
    """Coordinates as whole numbers of grid steps, of particles sorted along x."""

    here: tuple[Int[Array, "replicas n"], ...]  # one array per axis
    ahead: tuple[Int[Array, "replicas more"], ...]  # and the particles that follow, periodically

    @classmethod
    def of(cls, unit: Float[Array, "replicas n d"]) -> "_Grid":
        x = (unit[..., 0] * _X).astype(jnp.int32)
        others = [((unit[..., k] - 0.5) * _YZ).astype(jnp.int32) for k in range(1, unit.shape[-1])]
        # The last particle is followed by the first of the next image of the box, then by nobody.
        end = jnp.full((len(unit), 2 * _WORD), jnp.iinfo(jnp.int32).max)
        x_ahead = jnp.concatenate([x, x + int(_X), end], axis=1)
        others_ahead = [jnp.concatenate([y, y, end], axis=1) for y in others]
        return cls((x, *others), (x_ahead, *others_ahead))

    def following(self, axis: int, first: ArrayLike, count: int) -> Int[Array, "replicas {count}"]:
        """Coordinates of `count` sorted particles, from index `first` on."""
        return jax.lax.dynamic_slice_in_dim(self.ahead[axis], first, count, axis=1)


class _Reach(NamedTuple):
    """The cutoff in grid steps, enlarged by the rounding errors."""

    square: Float[Array, ""]  # of the distance, in steps of y and z
    farthest: Int[Array, ""]  # along x, in steps of x


def _reach(side: ArrayLike, cutoff: ArrayLike, n: int, dtype: DTypeLike) -> _Reach:
    reach = cutoff / side * _YZ + 8 + 4 * _YZ * jnp.finfo(dtype).eps  # for rounding
    square = jnp.minimum(reach * reach * (1 + 1e-6), (_YZ / 2) ** 2).astype(jnp.float32)
    return _Reach(square, (reach * (_X / _YZ)).astype(jnp.int32) + 2 ** max(_index_bits(n) - 1, 1))


def _near_bits(
    grid: _Grid, reach: _Reach, finite: Bool[Array, ""], num_words: int
) -> tuple[UInt32[Array, "{num_words} replicas n"], Int[Array, ""]]:
    """For each particle one bit per following particle: whether it is within the cutoff.

    Returns:
        The words of 32 bits, and how many following particles had to be compared.
    """
    replicas, n = grid.here[0].shape

    def look(carry):
        block, words = carry
        window = [
            grid.following(axis, _WORD * block + 1, n + _WORD - 1) for axis in range(len(grid.here))
        ]
        word = jnp.zeros((replicas, n), jnp.uint32)
        for bit in range(_WORD):
            apart = [
                (there[:, bit : bit + n] - here).astype(jnp.float32)
                for there, here in zip(window, grid.here, strict=True)
            ]
            apart[0] *= _YZ / _X
            near = sum(a * a for a in apart) < reach.square
            word |= near.astype(jnp.uint32) << bit
        return block + 1, words.at[block].set(word, mode="drop")

    def unfinished(carry):
        block, _ = carry
        nearest = jnp.min(grid.following(0, _WORD * block + 1, n) - grid.here[0])
        return finite & (_WORD * block + 1 < n) & (nearest <= reach.farthest)

    words = jnp.zeros((num_words, replicas, n), jnp.uint32)
    blocks, words = jax.lax.while_loop(unfinished, look, (jnp.int32(0), words))
    return words, _WORD * blocks


def _decoded(
    word: Int[Array, "pairs"], bit: Int[Array, "pairs"], order: Int[Array, "replicas n"]
) -> tuple[Int[Array, "pairs"], Int[Array, "pairs"]]:
    """The two particles of the pairs that set bits stand for."""
    replicas, n = order.shape
    here = word % (replicas * n)
    first = n * (here // n)
    there = here - first + _WORD * (word // (replicas * n)) + bit + 1
    there = first + jnp.where(there >= n, there - n, there)
    particle = (order + n * jnp.arange(replicas, dtype=jnp.int32)[:, None]).ravel()
    return particle.at[here].get(mode="clip"), particle.at[there].get(mode="clip")
