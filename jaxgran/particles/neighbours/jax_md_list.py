"""Neighbour lists by jax-md.

Only this module imports jax_md, and only for a list that jax-md builds: the import takes seconds,
and compiles some hundred programs.
"""

from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def jax_md_pairs(
    position: Float[Array, "particles d"],
    side: Any,
    cutoff: Any,
    replicas: int,
    capacity: int,
) -> tuple[Int[Array, "{capacity}"], Int[Array, "{capacity}"], Int[Array, ""]]:
    """Return i, j and count of `jaxgran.particles.neighbours.lists.Pairs`.

    The values must be known: jax-md chooses the number of its cells from them.

    Raises:
        RuntimeError: if the list of jax-md overflows at the largest capacity that is tried.
    """
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
