"""Neighbour lists by jax-md.

Only this module imports jax_md, and only for a list that jax-md builds: the import takes seconds,
and compiles some hundred programs.
"""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgran.particles.neighbours.pairs import ListedPairs

MULTIPLIER_GROWTH = 1.5
"""Ratio of successive capacities that are tried, over the capacity for a homogeneous gas."""

MAX_MULTIPLIER = 100.0
"""Multiple of the capacity for a homogeneous gas beyond which no larger one is tried."""


def pairs_by_jax_md(
    position: Float[Array, "particles d"],
    side: Any,
    cutoff: Any,
    replicas: int,
    capacity: int,
) -> ListedPairs:
    """Find all pairs closer than a cutoff, as `jaxgran.particles.neighbours.lists.search_pairs`.

    The values must be known: jax-md chooses the number of its cells from them.

    Raises:
        RuntimeError: if the list of jax-md overflows at the largest capacity that is tried.
    """
    boxes = position.reshape(replicas, -1, position.shape[-1])
    multiplier = MULTIPLIER_GROWTH
    # jax-md needs both.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        while True:
            lists_of = _jax_md_lists(boxes.shape, float(side), float(cutoff), multiplier)
            lists = lists_of(boxes)
            if not bool(jnp.any(lists.did_buffer_overflow)):
                break
            if multiplier > MAX_MULTIPLIER:
                raise RuntimeError(
                    f"jax-md's neighbour list overflows even at {multiplier:.3g} times the "
                    f"capacity of a homogeneous gas, and the limit is {MAX_MULTIPLIER:g}. Use "
                    "neighbours='cells'"
                )
            multiplier *= MULTIPLIER_GROWTH
    i, j, count = _flattened(lists.idx, boxes.shape[1], capacity)
    return ListedPairs(i, j, count, lookahead=jnp.zeros((), jnp.int32))


@lru_cache(maxsize=8)
def _jax_md_lists(
    shape: tuple[int, ...], side: float, cutoff: float, multiplier: float
) -> Callable[[Float[Array, "replicas N d"]], Any]:
    """Return a function that builds jax-md's list of each box.

    jax-md returns closures, which would be compiled again at every call without the cache.
    """
    from jax_md import partition, space

    shortest, _ = space.periodic(jnp.asarray(side))
    functions = partition.neighbor_list(
        shortest,
        jnp.asarray(side),
        cutoff,
        capacity_multiplier=multiplier,
        format=partition.NeighborListFormat.OrderedSparse,
    )
    update = jax.jit(jax.vmap(functions.update, in_axes=(0, None)))
    allocated = []

    def lists_of(boxes: Float[Array, "replicas N d"]) -> Any:
        if not allocated:  # the first positions decide the capacity, later ones update the list
            allocated.append(functions.allocate(boxes[0], extra_capacity=1))  # it may be empty
        return update(boxes, allocated[0])

    return lists_of


@partial(jax.jit, static_argnums=(1, 2))
def _flattened(
    index: Int[Array, "replicas 2 most"], num_particles: int, capacity: int
) -> tuple[Int[Array, "{capacity}"], Int[Array, "{capacity}"], Int[Array, ""]]:
    """Return i, j and count of `ListedPairs` from jax-md's lists, one for each replica."""
    first = num_particles * jnp.arange(len(index), dtype=jnp.int32)[:, None]
    is_pair = jnp.ravel(index[:, 0] < num_particles)
    (rows,) = jnp.nonzero(is_pair, size=capacity, fill_value=0)
    count = jnp.sum(is_pair, dtype=jnp.int32)
    in_use = jnp.arange(capacity, dtype=jnp.int32) < count
    i, j = (jnp.where(in_use, jnp.ravel(index[:, k] + first)[rows], 0) for k in (0, 1))
    return i.astype(jnp.int32), j.astype(jnp.int32), count
