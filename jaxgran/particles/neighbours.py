"""Periodic boxes and neighbour lists, built by sweep and prune, by cells or by jax-md.

Compiled code cannot make an array whose length depends on the number of pairs. Arrays have a fixed
capacity instead, and the number of pairs is counted, so that the caller notices an overflow.

Only this module imports jax_md, and only for a list that jax-md builds: the import takes seconds,
and compiles some hundred programs.
"""

from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.particles.bit_masks import WORD, bits_where, rows_where
from jaxgran.particles.cell_list import STEPS, cells, num_words_ahead, reach_in_steps


def marked(
    mask: Bool[Array, "n"], rows: Int[Array, "..."], where: Bool[Array, "..."]
) -> Bool[Array, "n"]:
    """Return a mask that is also True in some rows, where a condition holds for them."""
    return mask.at[jnp.where(where, rows, len(mask))].set(True, mode="drop")


def select_members(
    selected: Bool[Array, "all"],
    i: Int[Array, "all"],
    j: Int[Array, "all"],
    others: Bool[Array, "n"],
    capacity: tuple[int, int],
) -> tuple[Int[Array, "rows"], Bool[Array, "rows"], Int[Array, "members"], Array, list[Array]]:
    """Return the selected pairs, the particles that belong to them or to `others`, its members.

    Args:
        selected: mask of the pairs.
        i, j: indices of both particles of each pair.
        others: mask of further members.
        capacity: largest numbers of pairs and of members.

    Returns:
        The rows of the pairs, and which of them are real; the members in increasing order, n in
        empty slots; the slots of both particles of each pair; the numbers of pairs and of members.
    """
    n = len(others)
    rows, num_rows = rows_where(selected, capacity[0])
    real = jnp.arange(capacity[0], dtype=jnp.int32) < num_rows
    rows = jnp.where(real, rows, 0)
    ends = jnp.stack([i[rows], j[rows]])
    is_member = marked(others, ends, real[None])
    members, num_members = rows_where(is_member, capacity[1])
    slots = jnp.arange(capacity[1], dtype=jnp.int32)
    slot = jnp.zeros(n, jnp.int32).at[members].set(slots, mode="drop")
    slots = jnp.where(real[None], slot[ends], 0)
    return rows, real, members, slots, [num_rows, num_members]


_X_STEPS = 2.0**30  # grid steps per box side along x, in a sweep


def unsorted_share(num_particles: int) -> float:
    """Return the share of the box side within which a sweep does not sort particles."""
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
    """Find all pairs closer than a cutoff, in each of several equal periodic boxes.

    The method is sweep and prune: the particles of each box are sorted by x, and every particle is
    compared with the following ones, up to the cutoff along x: ``N cutoff / side`` particles in a
    homogeneous gas. Coordinates are rounded to a grid of whole numbers, whose differences are
    periodic by integer overflow (along x by a second copy of the box). One bit per comparison says
    whether the pair is within the cutoff. The work grows as ``N^(2 - 1/d)``. For boxes of up to
    some ten thousand particles this is faster than a cell list, and it needs no call to the host.

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

    # Sorting one integer of the coarse coordinate x and the index takes a tenth of the time of
    # sorting two arrays.
    bits = _index_bits(n)
    coarse = (unit[..., 0] * 2.0 ** (31 - bits)).astype(jnp.int32) << bits
    order = jax.lax.sort(coarse | jnp.arange(n, dtype=jnp.int32)[None]) & (2**bits - 1)
    unit = jnp.take_along_axis(unit, order[..., None], axis=1)

    # Coordinates as whole numbers of steps, continued periodically: the next image of the box
    # follows the last particle, and then padding at a large distance.
    here = [(unit[..., 0] * _X_STEPS).astype(jnp.int32)]
    here += [((unit[..., k] - 0.5) * STEPS).astype(jnp.int32) for k in range(1, unit.shape[-1])]
    images = [here[0] + int(_X_STEPS), *here[1:]]
    end = jnp.full((replicas, 2 * WORD), jnp.iinfo(jnp.int32).max)
    ahead_of = [jnp.concatenate([x, y, end], axis=1) for x, y in zip(here, images, strict=True)]

    def following(axis: int, block: Array, count: int) -> Int[Array, "replicas {count}"]:
        first = WORD * block + 1
        return jax.lax.dynamic_slice_in_dim(ahead_of[axis], first, count, axis=1)

    # The cutoff in steps of y and z, and along x in steps of x, enlarged by the rounding errors.
    reach_steps, square = reach_in_steps(cutoff, side, position)
    square = jnp.minimum(square, (STEPS / 2) ** 2)  # beyond, pairs would occur twice
    along_x = (reach_steps * (_X_STEPS / STEPS)).astype(jnp.int32) + 2 ** max(bits - 1, 1)
    finite = jnp.all(jnp.isfinite(position))

    def compare_block(carry):
        block, words = carry
        window = [following(axis, block, n + WORD - 1) for axis in range(len(here))]
        word = jnp.zeros((replicas, n), jnp.uint32)
        for bit in range(WORD):
            apart = [
                (there[:, bit : bit + n] - x).astype(jnp.float32)
                for there, x in zip(window, here, strict=True)
            ]
            apart[0] *= STEPS / _X_STEPS
            near = sum(a * a for a in apart) < square
            word |= near.astype(jnp.uint32) << bit
        return block + 1, words.at[block].set(word, mode="drop")

    def unfinished(carry):
        block, _ = carry
        nearest = jnp.min(following(0, block, n) - here[0])
        return finite & (WORD * block + 1 < n) & (nearest <= along_x)

    words = jnp.zeros((num_words, replicas, n), jnp.uint32)
    blocks, words = jax.lax.while_loop(unfinished, compare_block, (jnp.int32(0), words))

    # The two particles of the pair of each set bit.
    word, bit, count = bits_where(words.ravel(), capacity)
    index = word % (replicas * n)
    first = n * (index // n)
    there = index - first + WORD * (word // (replicas * n)) + bit + 1
    there = first + jnp.where(there >= n, there - n, there)
    particle = (order + n * jnp.arange(replicas, dtype=jnp.int32)[:, None]).ravel()
    in_use = jnp.arange(capacity, dtype=jnp.int32) < count
    i, j = (jnp.where(in_use, particle.at[k].get(mode="clip"), 0) for k in (index, there))
    return jnp.minimum(i, j), jnp.maximum(i, j), count, jnp.minimum(WORD * blocks, n - 1)


ENGINES = ("auto", "sweep", "cells", "jax-md")
"""Methods of building neighbour lists: `sweep` and `cells` in compiled code, or jax-md on the
device; "auto" is the fastest of them."""

MAX_LOOKAHEAD = 450
"""Expected look-ahead, in particles, up to which a sweep is as fast as cells: some
5000 spheres have it."""


class Pairs(NamedTuple):
    """Pairs of particles closer than a cutoff, each once.

    Attributes:
        i, j: indices into the particles of all replicas; rows beyond `count` are (0, 0).
        offset: multiple of the box side in each direction, such that ``x_i - x_j - offset`` is the
            shortest displacement of the pair. It remains valid while particles move without being
            wrapped.
        count: number of pairs. If it exceeds the capacity of the list, pairs are missing.
        lookahead: look-ahead, in particles, that a sweep or cells needed. If it exceeds their
            capacity, pairs are missing. 0 for jax-md.
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


def wrap(side: ArrayLike, position: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Move positions by multiples of the side into [0, side)."""
    inside = jnp.mod(position, side)
    return jnp.where(inside >= side, 0.0, inside)  # rounding may give exactly `side`


def check_engine(name: str) -> None:
    """Raise ValueError for a name that is not one of `ENGINES`."""
    if name not in ENGINES:
        raise ValueError(
            f'neighbours must be one of {", ".join(ENGINES)}, got {name!r}. The default is "auto"'
        )


def compiled_engine(name: str, ahead: float) -> str:
    """Return the engine that builds neighbour lists in compiled code, "sweep" or "cells".

    It is `name`, or for "auto" and "jax-md" the fastest one, as measured on a CPU: a sweep up to a
    look-ahead of `MAX_LOOKAHEAD`, and cells beyond.

    Args:
        name: one of `ENGINES`.
        ahead: expected look-ahead of a sweep, in particles.
    """
    if name in ("sweep", "cells"):
        return name
    return "sweep" if ahead <= MAX_LOOKAHEAD else "cells"


def choose_engine(name: str, compiled: str, traced: bool) -> str:
    """Return the engine that builds neighbour lists in a run, one of `ENGINES` but not "auto".

    "auto" is jax-md on an accelerator, outside of compiled code.

    Args:
        name: one of `ENGINES`.
        compiled: the engine in compiled code.
        traced: whether the list is built in code that is being compiled or differentiated.
    """
    on_accelerator = jax.default_backend() != "cpu"
    if name == "jax-md" or (name == "auto" and on_accelerator and not traced):
        return "jax-md"
    return compiled


ListedPairs = tuple[Int[Array, "pairs"], Int[Array, "pairs"], Int[Array, ""], Int[Array, ""]]
"""Fields i, j, count and lookahead of `Pairs`."""


def search_pairs(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    replicas: int,
    capacity: tuple[int, int],
    engine: str,
) -> ListedPairs:
    """Find all pairs closer than a cutoff in each of several equal periodic boxes.

    The result has no derivatives. `with_offsets` adds the offsets in compiled code. A sweep and
    cells are compiled, also under `jax.jit` and `jax.vmap`. jax-md chooses the number of its cells
    from the values: `position`, `side` and `cutoff` must not be traced.

    Args:
        position: positions of all particles, replica after replica, in [0, side).
        side: side of the boxes.
        cutoff: distance in the same unit, > 0 and at most half a side; for a sweep less than that
            by at least a part in 10^6.
        replicas: number of boxes; particles of different boxes form no pairs.
        capacity: capacity of the list, in pairs, and of the look-ahead, in particles.
        engine: "sweep", "cells" or "jax-md". All return the same pairs, but may differ in pairs
            within rounding error of the cutoff.
    """
    position, side, cutoff = jax.lax.stop_gradient((position, side, cutoff))
    max_pairs, ahead = capacity
    if engine == "jax-md":
        i, j, count = _jax_md_pairs(position, side, cutoff, replicas, max_pairs)
        return i, j, count, jnp.zeros((), jnp.int32)
    search = {"sweep": sweep, "cells": cells}[engine]
    return search(position, side, cutoff, replicas=replicas, capacity=max_pairs, ahead=ahead)


@jax.jit
def with_offsets(
    position: Float[Array, "particles d"], side: ArrayLike, listed: ListedPairs
) -> Pairs:
    """Add the offsets to the pairs that were found for these positions."""
    position, side = jax.lax.stop_gradient((position, jnp.asarray(side)))
    i, j, count, lookahead = listed
    offset = side * jnp.round((position[i] - position[j]) / side)
    return Pairs(i, j, offset, count, lookahead)


def _jax_md_pairs(position, side, cutoff, replicas: int, capacity: int):
    boxes = position.reshape(replicas, -1, position.shape[-1])
    multiplier = 1.5
    max_multiplier = 100.0
    # jax-md needs both.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        while True:
            allocated, update = _jax_md_list(boxes.shape, float(side), float(cutoff), multiplier)
            lists = update(boxes, allocated(boxes[0]))
            if not bool(jnp.any(lists.did_buffer_overflow)):
                break
            if multiplier > max_multiplier:
                raise RuntimeError(
                    f"jax-md's neighbour list overflows even at {multiplier:.3g} times the "
                    f"capacity of a homogeneous gas, and the limit is {max_multiplier:g}. Use "
                    "neighbours='cells'"
                )
            multiplier *= 1.5
    return _flatten(lists.idx, boxes.shape[1], capacity)


@lru_cache(maxsize=8)
def _jax_md_list(shape: tuple[int, ...], side: float, cutoff: float, multiplier: float):
    # jax-md returns closures, which would be compiled again at every call without this cache.
    from jax_md import partition, space

    shortest, _ = space.periodic(jnp.asarray(side))
    functions = partition.neighbor_list(
        shortest,
        jnp.asarray(side),
        cutoff,
        capacity_multiplier=multiplier,
        format=partition.NeighborListFormat.OrderedSparse,
    )
    lists = []

    def allocated(position):
        """Allocate a list at the first call; later positions update it."""
        if not lists:
            lists.append(functions.allocate(position, extra_capacity=1))  # it may be empty
        return lists[0]

    return allocated, jax.jit(jax.vmap(functions.update, in_axes=(0, None)))


@partial(jax.jit, static_argnums=(1, 2))
def _flatten(index: Int[Array, "replicas 2 most"], num_particles: int, capacity: int):
    """Return i, j and count of `Pairs` from jax-md's lists, one for each replica."""
    first = num_particles * jnp.arange(len(index), dtype=jnp.int32)[:, None]
    is_pair = jnp.ravel(index[:, 0] < num_particles)
    (rows,) = jnp.nonzero(is_pair, size=capacity, fill_value=0)
    count = jnp.sum(is_pair, dtype=jnp.int32)
    in_use = jnp.arange(capacity, dtype=jnp.int32) < count
    i, j = (jnp.where(in_use, jnp.ravel(index[:, k] + first)[rows], 0) for k in (0, 1))
    return i.astype(jnp.int32), j.astype(jnp.int32), count
