"""The periodic box and the neighbour list; the only file that imports jax_md.

Importing jax_md takes seconds. It is imported when a box is first used, so that a user of kinetic
theory alone does not wait for it.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran.particles.sweep_and_prune import sweep

ENGINES = ("auto", "sweep", "scipy", "jax-md")
"""Builders of neighbour lists: `sweep` in compiled code, SciPy's k-d tree on the host, jax-md on
the device; "auto" for the fastest of them."""

MOST_AHEAD = 1500
"""Largest look-ahead of a sweep, in particles; beyond it a tree is faster."""


class Pairs(NamedTuple):
    """Pairs of particles closer than a cutoff, each once.

    Attributes:
        i, j: indices into the particles of all replicas; rows beyond `count` are (0, 0).
        offset: a multiple of the box side in each direction, such that ``x_i - x_j - offset`` is
            the shortest displacement of the pair. It remains valid while particles move without
            being wrapped.
        count: number of pairs found. If it exceeds the capacity of the list, pairs are missing.
        lookahead: look-ahead, in particles, that a sweep needed. If it exceeds the capacity of the
            sweep, pairs are missing. 0 for the other builders.
    """

    i: Int[Array, "pairs"]
    j: Int[Array, "pairs"]
    offset: Float[Array, "pairs d"]
    count: Int[Array, ""]
    lookahead: Int[Array, ""]


def displacement(
    side: ArrayLike, a: Float[Array, "... d"], b: Float[Array, "... d"]
) -> Float[Array, "... d"]:
    """Shortest displacement ``a - b`` in a periodic cube (square) of the given side, by jax-md."""
    from jax_md import space

    shortest, _ = space.periodic(jnp.asarray(side, jnp.result_type(float)))
    return jnp.vectorize(shortest, signature="(d),(d)->(d)")(a, b)


def wrap(side: ArrayLike, position: Float[Array, "... d"]) -> Float[Array, "... d"]:
    """Positions moved by multiples of the side into [0, side), by jax-md."""
    from jax_md import space

    _, shift = space.periodic(jnp.asarray(side))
    inside = shift(position, jnp.zeros_like(position))
    return jnp.where(inside >= side, 0.0, inside)  # rounding may give exactly `side`


def engine(name: str, ahead: int = 0, traced: bool = False) -> str:
    """The builder of neighbour lists to use: `name`, or for "auto" the fastest, as measured.

    The fastest is jax-md on a GPU, outside of compiled code. On a CPU it is a sweep up to a
    look-ahead of `MOST_AHEAD`, and a tree beyond. In compiled code it is a sweep, which calls
    nothing on the host.

    Args:
        name: one of `ENGINES`.
        ahead: capacity of a sweep's look-ahead, in particles.
        traced: whether the list is built in code that is being compiled or differentiated.

    Raises:
        ValueError: for any other name.
    """
    if name not in ENGINES:
        raise ValueError(
            f"neighbours must be one of {', '.join(ENGINES)}, got {name!r}; leave it out for the "
            "fastest"
        )
    if name != "auto":
        return name
    if jax.default_backend() != "cpu" and not traced:
        return "jax-md"
    return "sweep" if traced or ahead <= MOST_AHEAD else "scipy"


def find_pairs(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int = 1,
    capacity: int,
    by: str = "scipy",
) -> Pairs:
    """All pairs closer than a cutoff, in each of several equal periodic boxes.

    The result carries no derivatives. A sweep is compiled. A tree works under `jax.jit` and
    `jax.vmap` too, by a callback to the host. jax-md chooses the number of its cells from the
    values, so that with it `position`, `side` and `cutoff` must not be traced.

    Args:
        position: of all particles, replica after replica, in [0, side).
        side: of the boxes.
        cutoff: in the same unit, > 0 and at most half a side; for a sweep less than that by at
            least a part in 10^6.
        replicas: number of boxes; particles of different boxes form no pairs.
        capacity: of the list, in pairs.
        by: "scipy", "sweep" or "jax-md"; all return the same pairs, except that pairs within
            rounding error of the cutoff may or may not be included.

    Raises:
        ValueError: for another `by`.
    """
    n = len(position) // replicas
    return with_offsets(position, side, search(position, side, cutoff, replicas, (capacity, n), by))


Found = tuple[Int[Any, "pairs"], Int[Any, "pairs"], Int[Any, ""], Int[Any, ""]]
"""i, j, count and lookahead of `Pairs`; NumPy arrays if they come from the host."""


def search(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    replicas: int,
    capacity: tuple[int, int],
    by: str,
) -> Found:
    """`find_pairs` without the offsets, which `with_offsets` adds in compiled code.

    The capacities are that of the list, in pairs, and that of a sweep's look-ahead, in particles.
    """
    position, side, cutoff = jax.lax.stop_gradient((position, side, cutoff))
    if by not in ENGINES[1:]:
        raise ValueError(f"by must be one of {', '.join(ENGINES[1:])}, got {by!r}; take 'sweep'")
    most, ahead = capacity
    if by == "sweep":
        return sweep(position, side, cutoff, replicas=replicas, capacity=most, ahead=ahead)
    build = {"scipy": _tree_pairs, "jax-md": _jax_md_pairs}[by]
    i, j, count = build(position, side, cutoff, replicas, most)
    return i, j, count, np.int32(0)


@jax.jit
def with_offsets(position: Float[Array, "particles d"], side: ArrayLike, found: Found) -> Pairs:
    """The pairs found for these positions, with their offsets."""
    position, side = jax.lax.stop_gradient((position, jnp.asarray(side)))
    i, j, count, lookahead = found
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


def tree_search(
    position: Float[np.ndarray, "particles d"],
    side: float,
    cutoff: float,
    replicas: int,
    capacity: int,
) -> tuple[
    Int[np.ndarray, "{capacity}"], Int[np.ndarray, "{capacity}"], Int[np.ndarray | np.int32, ""]
]:
    """`find_pairs` on the host, without offsets: i, j and count of `Pairs` as NumPy arrays.

    Positions that are not finite form no pairs.
    """
    from scipy.spatial import KDTree  # takes a tenth of a second: for a user of particles alone

    pairs, count = np.zeros((2, capacity), np.int32), 0
    if np.all(np.isfinite(position)):
        boxes = position.reshape(replicas, -1, position.shape[-1]).astype(np.float64)
        boxes = np.where(boxes >= side, 0.0, boxes)  # by rounding
        for first, points in zip(range(0, len(position), boxes.shape[1]), boxes, strict=True):
            # Trees that are not balanced find as much and are made in half of the time.
            tree = KDTree(points, boxsize=side, balanced_tree=False, compact_nodes=False)
            found = tree.query_pairs(cutoff, output_type="ndarray")
            end = min(count + len(found), capacity)
            pairs[:, count:end] = found[: end - count].T + first
            count += len(found)
            if count > capacity:
                break
    return pairs[0], pairs[1], np.int32(count)


def _jax_md_pairs(position, side, cutoff, replicas: int, capacity: int):
    boxes = position.reshape(replicas, -1, position.shape[-1])
    multiplier, most = 1.5, 100.0
    with jax.numpy_rank_promotion("allow"):  # jax-md needs it
        while True:
            allocated, update = _jax_md_list(boxes.shape, float(side), float(cutoff), multiplier)
            lists = update(boxes, allocated(boxes[0]))
            if not bool(jnp.any(lists.did_buffer_overflow)):
                break
            if multiplier > most:
                raise RuntimeError(
                    f"jax-md's neighbour list overflows even at {multiplier:.3g} times the "
                    f"capacity of a homogeneous gas (at most {most:g} are tried); use "
                    "neighbours='scipy'"
                )
            multiplier *= 1.5
    return _flatten(lists.idx, boxes.shape[1], capacity)


@lru_cache(maxsize=8)
def _jax_md_list(shape: tuple[int, ...], side: float, cutoff: float, multiplier: float):
    # jax-md's functions are closures, which would be compiled again at every call if not cached.
    from jax_md import partition, space

    shortest, _ = space.periodic(jnp.asarray(side))
    functions = partition.neighbor_list(
        shortest,
        jnp.asarray(side),
        cutoff,
        capacity_multiplier=multiplier,
        format=partition.NeighborListFormat.OrderedSparse,
    )
    allocated = _once(functions.allocate)
    return allocated, jax.jit(jax.vmap(functions.update, in_axes=(0, None)))


def _once(allocate):
    """`allocate`, called at the first positions only; later ones update that list."""
    kept = []

    def allocated(position):
        if not kept:
            kept.append(allocate(position, extra_capacity=1))  # the first list may be empty
        return kept[0]

    return allocated


@partial(jax.jit, static_argnums=(1, 2))
def _flatten(index: Int[Array, "replicas 2 most"], num_particles: int, capacity: int):
    """i, j and count of `Pairs` from one of jax-md's lists per replica."""
    first = num_particles * jnp.arange(len(index), dtype=jnp.int32)[:, None]
    there = jnp.ravel(index[:, 0] < num_particles)
    (rows,) = jnp.nonzero(there, size=capacity, fill_value=0)
    count = jnp.sum(there, dtype=jnp.int32)
    real = jnp.arange(capacity) < count
    i, j = (jnp.where(real, jnp.ravel(index[:, k] + first)[rows], 0) for k in (0, 1))
    return i.astype(jnp.int32), j.astype(jnp.int32), count
