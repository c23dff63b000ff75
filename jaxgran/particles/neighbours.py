"""Periodic boxes and neighbour lists, built by sweep and prune, by SciPy's k-d tree or by jax-md.

Compiled code cannot make an array whose length depends on the number of pairs. Arrays have a fixed
capacity instead, and the number of pairs is counted, so that the caller notices an overflow.

Only this module imports jax_md, and only for a list that jax-md builds: the import takes seconds,
and compiles some hundred programs.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int, UInt32


def rows_where(mask: Bool[Array, "all"], size: int) -> tuple[Int[Array, "{size}"], Int[Array, ""]]:
    """Return the indices of the True entries of a mask, in increasing order, and their number.

    The True entries are counted in words of 32 bits, and each is found in its word by bisection: on
    a CPU this is two to six times as fast as a cumulative sum over the mask.

    Args:
        mask: the entries.
        size: length of the array of indices.

    Returns:
        The indices, with ``mask.size`` in unused rows, and the number of True entries. If that
        exceeds `size`, only the first `size` of them are returned.
    """
    num_words = -(-mask.size // 32)
    bits = jnp.pad(mask, (0, 32 * num_words - mask.size)).reshape(num_words, 32)
    places = jnp.arange(32, dtype=jnp.uint32)[None]
    words = jnp.sum(bits.astype(jnp.uint32) << places, axis=1, dtype=jnp.uint32)
    word, bit, count = bits_where(words, size)
    return jnp.where(jnp.arange(size, dtype=jnp.int32) < count, 32 * word + bit, mask.size), count


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
    is_member = others.at[jnp.where(real[None], ends, n)].set(True, mode="drop")
    members, num_members = rows_where(is_member, capacity[1])
    slots = jnp.arange(capacity[1], dtype=jnp.int32)
    slot = jnp.zeros(n, jnp.int32).at[members].set(slots, mode="drop")
    slots = jnp.where(real[None], slot[ends], 0)
    return rows, real, members, slots, [num_rows, num_members]


def bits_where(
    words: UInt32[Array, "words"], size: int
) -> tuple[Int[Array, "{size}"], Int[Array, "{size}"], Int[Array, ""]]:
    """Return the positions of the set bits of an array of words, in increasing order.

    Args:
        words: the bits; bit 0 is the lowest of a word.
        size: length of the arrays of positions.

    Returns:
        For each set bit the index of its word and its place in that word, 0 to 31, and the number
        of set bits. Rows beyond that number hold arbitrary values.
    """
    counts = jax.lax.population_count(words).astype(jnp.int32)
    ends = jnp.cumsum(counts, dtype=jnp.int32)
    starts = ends - counts
    row = jnp.arange(size, dtype=jnp.int32)
    num_starts = jnp.zeros(size, jnp.int32).at[starts].add(1, mode="drop")
    word = jnp.cumsum(num_starts, dtype=jnp.int32) - 1  # the last one that starts up to this row
    rest = words[word]
    rank = row - starts[word]
    bit = jnp.zeros(size, jnp.int32)
    for half in (16, 8, 4, 2, 1):
        low = jax.lax.population_count(rest & jnp.uint32(2**half - 1)).astype(jnp.int32)
        upper = rank >= low
        rest = jnp.where(upper, rest >> half, rest)
        rank = jnp.where(upper, rank - low, rank)
        bit = jnp.where(upper, bit + half, bit)
    return word, bit, ends[-1]


_WORD = 32
_X_STEPS = 2.0**30
_YZ_STEPS = 2.0**32  # grid steps per box side, along x and the other axes


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
    num_words = max(-(-min(ahead, n) // _WORD), 1)
    if num_words * replicas * n >= 2**31:
        raise ValueError(
            f"a sweep over {replicas * n} particles cannot look {ahead} particles ahead: its "
            f"indices have 32 bits, which allow {(2**31 - 1) // (replicas * n) * _WORD} ahead. Use "
            "neighbours='scipy' or 'jax-md'"
        )
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
    here += [((unit[..., k] - 0.5) * _YZ_STEPS).astype(jnp.int32) for k in range(1, unit.shape[-1])]
    images = [here[0] + int(_X_STEPS), *here[1:]]
    end = jnp.full((replicas, 2 * _WORD), jnp.iinfo(jnp.int32).max)
    ahead_of = [jnp.concatenate([x, y, end], axis=1) for x, y in zip(here, images, strict=True)]

    def following(axis: int, block: Array, count: int) -> Int[Array, "replicas {count}"]:
        first = _WORD * block + 1
        return jax.lax.dynamic_slice_in_dim(ahead_of[axis], first, count, axis=1)

    # The cutoff in steps of y and z, and along x in steps of x, enlarged by the rounding errors.
    reach = cutoff / side * _YZ_STEPS + 8 + 4 * _YZ_STEPS * jnp.finfo(position.dtype).eps
    square = jnp.minimum(reach * reach * (1 + 1e-6), (_YZ_STEPS / 2) ** 2).astype(jnp.float32)
    along_x = (reach * (_X_STEPS / _YZ_STEPS)).astype(jnp.int32) + 2 ** max(bits - 1, 1)
    finite = jnp.all(jnp.isfinite(position))

    def compare_block(carry):
        block, words = carry
        window = [following(axis, block, n + _WORD - 1) for axis in range(len(here))]
        word = jnp.zeros((replicas, n), jnp.uint32)
        for bit in range(_WORD):
            apart = [
                (there[:, bit : bit + n] - x).astype(jnp.float32)
                for there, x in zip(window, here, strict=True)
            ]
            apart[0] *= _YZ_STEPS / _X_STEPS
            near = sum(a * a for a in apart) < square
            word |= near.astype(jnp.uint32) << bit
        return block + 1, words.at[block].set(word, mode="drop")

    def unfinished(carry):
        block, _ = carry
        nearest = jnp.min(following(0, block, n) - here[0])
        return finite & (_WORD * block + 1 < n) & (nearest <= along_x)

    words = jnp.zeros((num_words, replicas, n), jnp.uint32)
    blocks, words = jax.lax.while_loop(unfinished, compare_block, (jnp.int32(0), words))

    # The two particles of the pair of each set bit.
    word, bit, count = bits_where(words.ravel(), capacity)
    index = word % (replicas * n)
    first = n * (index // n)
    there = index - first + _WORD * (word // (replicas * n)) + bit + 1
    there = first + jnp.where(there >= n, there - n, there)
    particle = (order + n * jnp.arange(replicas, dtype=jnp.int32)[:, None]).ravel()
    in_use = jnp.arange(capacity, dtype=jnp.int32) < count
    i, j = (jnp.where(in_use, particle.at[k].get(mode="clip"), 0) for k in (index, there))
    return jnp.minimum(i, j), jnp.maximum(i, j), count, jnp.minimum(_WORD * blocks, n - 1)


ENGINES = ("auto", "sweep", "scipy", "jax-md")
"""Methods of building neighbour lists: `sweep` in compiled code, SciPy's k-d tree on the host, or
jax-md on the device; "auto" is the fastest of them."""

MAX_LOOKAHEAD = 1500
"""Largest look-ahead, in particles, up to which a sweep is faster than a tree."""


class Pairs(NamedTuple):
    """Pairs of particles closer than a cutoff, each once.

    Attributes:
        i, j: indices into the particles of all replicas; rows beyond `count` are (0, 0).
        offset: multiple of the box side in each direction, such that ``x_i - x_j - offset`` is the
            shortest displacement of the pair. It remains valid while particles move without being
            wrapped.
        count: number of pairs. If it exceeds the capacity of the list, pairs are missing.
        lookahead: look-ahead, in particles, that a sweep needed. If it exceeds the capacity of the
            sweep, pairs are missing. 0 for the other engines.
    """

    i: Int[Array, "pairs"]
    j: Int[Array, "pairs"]
    offset: Float[Array, "pairs d"]
    count: Int[Array, ""]
    lookahead: Int[Array, ""]


def wrap(side: ArrayLike, position: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Move positions by multiples of the side into [0, side)."""
    inside = jnp.mod(position, side)
    return jnp.where(inside >= side, 0.0, inside)  # rounding may give exactly `side`


def choose_engine(name: str, ahead: int = 0, traced: bool = False) -> str:
    """Return the engine that builds neighbour lists: `name`, or for "auto" the fastest one.

    As measured, the fastest engine is jax-md on a GPU, outside of compiled code. On a CPU it is a
    sweep up to a look-ahead of `MAX_LOOKAHEAD`, and a tree beyond. In compiled code it is a sweep,
    which does not call the host.

    Args:
        name: one of `ENGINES`.
        ahead: capacity of a sweep's look-ahead, in particles.
        traced: whether the list is built in code that is being compiled or differentiated.

    Raises:
        ValueError: for any other name.
    """
    if name not in ENGINES:
        raise ValueError(
            f'neighbours must be one of {", ".join(ENGINES)}, got {name!r}. The default is "auto"'
        )
    if name != "auto":
        return name
    if jax.default_backend() != "cpu" and not traced:
        return "jax-md"
    return "sweep" if traced or ahead <= MAX_LOOKAHEAD else "scipy"


ListedPairs = tuple[Int[Any, "pairs"], Int[Any, "pairs"], Int[Any, ""], Int[Any, ""]]
"""Fields i, j, count and lookahead of `Pairs`: NumPy arrays if a tree on the host found them."""


def search_pairs(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    replicas: int,
    capacity: tuple[int, int],
    engine: str,
) -> ListedPairs:
    """Find all pairs closer than a cutoff in each of several equal periodic boxes.

    The result has no derivatives. `with_offsets` adds the offsets in compiled code. A sweep is
    compiled. A tree works under `jax.jit` and `jax.vmap` too, by a callback to the host. jax-md
    chooses the number of its cells from the values: `position`, `side` and `cutoff` must not be
    traced.

    Args:
        position: positions of all particles, replica after replica, in [0, side).
        side: side of the boxes.
        cutoff: distance in the same unit, > 0 and at most half a side; for a sweep less than that
            by at least a part in 10^6.
        replicas: number of boxes; particles of different boxes form no pairs.
        capacity: capacity of the list, in pairs, and of a sweep's look-ahead, in particles.
        engine: "scipy", "sweep" or "jax-md". All return the same pairs, but may differ in pairs
            within rounding error of the cutoff.
    """
    position, side, cutoff = jax.lax.stop_gradient((position, side, cutoff))
    max_pairs, ahead = capacity
    if engine == "sweep":
        return sweep(position, side, cutoff, replicas=replicas, capacity=max_pairs, ahead=ahead)
    build = {"scipy": _tree_pairs, "jax-md": _jax_md_pairs}[engine]
    i, j, count = build(position, side, cutoff, replicas, max_pairs)
    return i, j, count, np.int32(0)


@jax.jit
def with_offsets(
    position: Float[Array, "particles d"], side: ArrayLike, listed: ListedPairs
) -> Pairs:
    """Add the offsets to the pairs that were found for these positions."""
    position, side = jax.lax.stop_gradient((position, jnp.asarray(side)))
    i, j, count, lookahead = listed
    offset = side * jnp.round((position[i] - position[j]) / side)
    return Pairs(i, j, offset, count, lookahead)


def _tree_pairs(position, side, cutoff, replicas: int, capacity: int):
    def host(position, side, cutoff):
        return tree_search(np.asarray(position), float(side), float(cutoff), replicas, capacity)

    if not any(isinstance(x, Tracer) for x in (position, side, cutoff)):
        return host(position, side, cutoff)
    index = jax.ShapeDtypeStruct((capacity,), jnp.int32)
    shapes = index, index, jax.ShapeDtypeStruct((), jnp.int32)
    return jax.pure_callback(host, shapes, position, side, cutoff, vmap_method="sequential")


def close_pairs(points: Float[np.ndarray, "n d"], side: float, cutoff: float) -> np.ndarray:
    """Return the indices of all pairs of points closer than a cutoff in a periodic box."""
    from scipy.spatial import KDTree  # the import takes a tenth of a second

    # Unbalanced trees give the same pairs and are built in half of the time.
    tree = KDTree(points, boxsize=side, balanced_tree=False, compact_nodes=False)
    return tree.query_pairs(cutoff, output_type="ndarray")


def least_distance(points: Float[np.ndarray, "n d"], side: float) -> float:
    """Return the least distance between two points in a periodic box, and 1 if none is less."""
    i, j = close_pairs(np.mod(points, side) % side, side, 1.0).T
    separation = points[i] - points[j]
    separation = separation - side * np.round(separation / side)
    return float(np.sqrt(np.min(np.sum(separation**2, axis=1), initial=1.0)))


def tree_search(
    position: Float[np.ndarray, "particles d"],
    side: float,
    cutoff: float,
    replicas: int,
    capacity: int,
) -> tuple[
    Int[np.ndarray, "{capacity}"], Int[np.ndarray, "{capacity}"], Int[np.ndarray | np.int32, ""]
]:
    """Find pairs on the host; return i, j and count of `Pairs` as NumPy arrays.

    If any position is not finite, no pairs are returned.
    """
    pairs = np.zeros((2, capacity), np.int32)
    count = 0
    if np.all(np.isfinite(position)):
        boxes = position.reshape(replicas, -1, position.shape[-1]).astype(np.float64)
        boxes = np.where(boxes >= side, 0.0, boxes)  # by rounding
        for first, points in zip(range(0, len(position), boxes.shape[1]), boxes, strict=True):
            in_box = close_pairs(points, side, cutoff)
            end = min(count + len(in_box), capacity)
            pairs[:, count:end] = in_box[: end - count].T + first
            count += len(in_box)
            if count > capacity:
                break
    return pairs[0], pairs[1], np.int32(count)


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
                    "neighbours='scipy'"
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
