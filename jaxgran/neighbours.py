"""Periodic box and lists of pairs that may meet; the only file that imports jax_md.

jax_md is imported when a box is first made, since that takes seconds that a user of kinetic theory
alone need not wait.
"""

from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int
from vesin import NeighborList

from jaxgran.sweep_and_prune import sweep

VESIN_CELLS = 1e5
"""The most cells of vesin's search."""

ENGINES = ("auto", "sweep", "vesin", "jax-md")
"""Who finds the pairs: our sweep in compiled code, vesin on the host, jax-md on the device."""

MOST_AHEAD = 1500
"""Particles that there is room for a sweep to look ahead, beyond which vesin's cells are faster."""


class Pairs(NamedTuple):
    """Pairs of particles closer than a cutoff, each once.

    Attributes:
        i, j: indices into the particles of all replicas; rows past `count` are (0, 0).
        offset: whole box sides that the pair is apart: ``x_i - x_j - offset`` is its shortest
            displacement, and stays so while particles move on without being wrapped.
        count: how many pairs there are; more than there is room for means that some are missing.
        ahead: how far a sweep had to look; if that is farther than it could, some are missing.
    """

    i: Int[Array, "pairs"]
    j: Int[Array, "pairs"]
    offset: Float[Array, "pairs d"]
    count: Int[Array, ""]
    ahead: Int[Array, ""]


def displacement(side: ArrayLike, a: Float[Array, "... d"], b: Float[Array, "... d"]):
    """Shortest ``a - b`` in a periodic cube (square) of the given side, through jax-md."""
    from jax_md import space

    shortest, _ = space.periodic(jnp.asarray(side, jnp.result_type(float)))
    return jnp.vectorize(shortest, signature="(d),(d)->(d)")(a, b)


def wrap(side: ArrayLike, position: Float[Array, "... d"]) -> Float[Array, "... d"]:
    """Positions moved by whole sides into [0, side), through jax-md."""
    from jax_md import space

    _, shift = space.periodic(jnp.asarray(side))
    inside = shift(position, jnp.zeros_like(position))
    return jnp.where(inside >= side, 0.0, inside)  # rounding may land on the far edge


def engine(name: str, ahead: int = 0, traced: bool = False) -> str:
    """The list builder to use: `name`, or for "auto" the one that is fastest as measured.

    That is jax-md on a GPU, where it can be, and on a CPU a sweep if it looks ahead a short way.
    """
    if name not in ENGINES:
        raise ValueError(f"neighbours must be one of {', '.join(ENGINES)}, got {name!r}")
    if name != "auto":
        return name
    if jax.default_backend() != "cpu" and not traced:
        return "jax-md"
    most = 2 * MOST_AHEAD if traced else MOST_AHEAD  # there, room is for twice the need
    return "sweep" if ahead <= most else "vesin"


def find_pairs(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int = 1,
    room: int,
    by: str = "vesin",
) -> Pairs:
    """All pairs closer than a cutoff, in each of several equal periodic boxes.

    Carries no derivatives. A sweep is compiled; vesin works under `jax.jit` and `jax.vmap` too, by
    a call to the host; jax-md sizes its cells from the numbers, so that `position`, `side` and
    `cutoff` must be known.

    Args:
        position: of all particles, replica after replica, in [0, side).
        side: of the boxes.
        cutoff: in the same unit, > 0 and at most half a side; by a part in 10^6 less for a sweep.
        replicas: number of boxes; their particles do not see each other.
        room: how many pairs can be returned.
        by: "vesin", "sweep" or "jax-md"; all return the same pairs but for those within round-off
            of the cutoff.
    """
    n = len(position) // replicas
    return with_offsets(position, side, search(position, side, cutoff, replicas, (room, n), by))


Found = tuple[Int[Any, "pairs"], Int[Any, "pairs"], Int[Any, ""], Int[Any, ""]]
"""i, j, count and ahead of `Pairs`, as NumPy arrays where they come from the host."""


def search(position, side, cutoff, replicas: int, room: tuple[int, int], by: str) -> Found:
    """`find_pairs` without offsets, for compiled code to add by `with_offsets`.

    The room is that of the pairs, and how far a sweep may look ahead.
    """
    position, side, cutoff = jax.lax.stop_gradient((position, side, cutoff))
    if by not in ENGINES[1:]:
        raise ValueError(f"by must be one of {', '.join(ENGINES[1:])}, got {by!r}")
    if by == "sweep":
        return sweep(position, side, cutoff, replicas=replicas, room=room[0], ahead=room[1])
    engine = {"vesin": _vesin_pairs, "jax-md": _jax_md_pairs}[by]
    i, j, count = engine(position, side, cutoff, replicas, room[0])
    return i, j, count, np.int32(0)


@jax.jit
def with_offsets(position: Float[Array, "particles d"], side: ArrayLike, found: Found) -> Pairs:
    """The pairs found for such positions."""
    position, side = jax.lax.stop_gradient((position, jnp.asarray(side)))
    i, j, count, ahead = found
    offset = side * jnp.round((position[i] - position[j]) / side)
    return Pairs(i, j, offset, count, ahead)


def _vesin_pairs(position, side, cutoff, replicas, room):
    def host(position, side, cutoff):
        return vesin_search(np.asarray(position), float(side), float(cutoff), replicas, room)

    if not any(isinstance(x, Tracer) for x in (position, side, cutoff)):
        return host(position, side, cutoff)
    index = jax.ShapeDtypeStruct((room,), jnp.int32)
    shapes = index, index, jax.ShapeDtypeStruct((), jnp.int32)
    return jax.pure_callback(host, shapes, position, side, cutoff, vmap_method="sequential")


def vesin_search(position: np.ndarray, side: float, cutoff: float, replicas: int, room: int):
    """`find_pairs` on the host, without offsets: i, j, count as NumPy arrays."""
    pairs, count = np.zeros((2, room), np.int32), 0
    if np.all(np.isfinite(position)):
        boxes = position.reshape(replicas, -1, position.shape[-1]).astype(np.float64)
        planar = boxes.shape[-1] == 2
        if planar:
            boxes = np.concatenate([boxes, np.zeros_like(boxes[..., :1])], axis=-1)
        # vesin has 1e5 cells at most: where there would be more it makes all three numbers of them
        # smaller alike, and a plane's one layer would become none, which ends the process. So a
        # plane has empty layers above it, so many that its own images are not near.
        layers = 2.1 + 2 * side / cutoff / VESIN_CELLS**0.5
        cell = np.diag([side, side, layers * cutoff if planar else side])
        search = NeighborList(cutoff=cutoff, full_list=False)
        for first, points in zip(range(0, len(position), boxes.shape[1]), boxes, strict=True):
            found = search.compute(points, cell, (True, True, True), "ij", copy=False)
            end = min(count + len(found[0]), room)
            for row, indices in zip(pairs, found, strict=True):
                row[count:end] = indices[: end - count]
            pairs[:, count:end] += first
            count += len(found[0])
            if count > room:
                break
    return pairs[0], pairs[1], np.int32(count)


def _jax_md_pairs(position, side, cutoff, replicas, room):
    boxes = position.reshape(replicas, -1, position.shape[-1])
    multiplier, most = 1.5, 100.0
    with jax.numpy_rank_promotion("allow"):  # jax-md relies on it
        while True:
            allocated, update = _jax_md_list(boxes.shape, float(side), float(cutoff), multiplier)
            lists = update(boxes, allocated(boxes[0]))
            if not bool(jnp.any(lists.did_buffer_overflow)):
                break
            if multiplier > most:
                raise RuntimeError(
                    "jax-md's neighbour list keeps overflowing; use neighbours='vesin'"
                )
            multiplier *= 1.5
    return _flatten(lists.idx, boxes.shape[1], room)


@lru_cache(maxsize=8)
def _jax_md_list(shape: tuple[int, ...], side: float, cutoff: float, multiplier: float):
    # jax-md's functions are closures: kept, or they would be compiled anew at every call.
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
    kept = []

    def allocated(position):
        if not kept:
            kept.append(allocate(position, extra_capacity=1))  # a first list may be empty
        return kept[0]

    return allocated


@partial(jax.jit, static_argnums=(1, 2))
def _flatten(index, num_particles, room):
    first = num_particles * jnp.arange(len(index), dtype=jnp.int32)[:, None]
    there = jnp.ravel(index[:, 0] < num_particles)
    (rows,) = jnp.nonzero(there, size=room, fill_value=0)
    count = jnp.sum(there, dtype=jnp.int32)
    real = jnp.arange(room) < count
    i, j = (jnp.where(real, jnp.ravel(index[:, k] + first)[rows], 0) for k in (0, 1))
    return i.astype(jnp.int32), j.astype(jnp.int32), count
