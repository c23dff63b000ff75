"""Positions without overlap from random points, compiled: what `initial` does on the host."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran.checks import status
from jaxgran.particles import neighbours
from jaxgran.particles.initial import GAP, MOST_PUSHES, largest_gap, uniform_points
from jaxgran.particles.neighbours import Pairs


class _Relaxing(NamedTuple):
    """Spheres that are pushed apart: positions, pushes made, whether some overlapped before the
    last of them, and the status."""

    position: Float[Array, "n d"]
    pushes: Int[Array, ""]
    overlap: Bool[Array, ""]
    fault: Int[Array, ""]


def positions(
    key: PRNGKeyArray,
    side: ArrayLike,
    size: tuple[int, int, int],
    skin: ArrayLike,
    capacity: tuple[int, int],
    room: Float[Array, "d"] | None = None,
    fault: ArrayLike = status.OK,
) -> tuple[Float[Array, "particles d"], Int[Array, ""]]:
    """As `jaxgran.particles.initial.positions`, with random gaps of its own.

    Args:
        key: of the random numbers.
        side: of the boxes in diameters.
        size: replicas, particles in each, dimension.
        skin: of the neighbour list.
        capacity: of the list, in pairs, and of its look-ahead, in particles.
        room: as there.
        fault: the status before; unless it is ok nothing is pushed.

    Returns:
        Positions, replica after replica, and the status: the list is full, or there is no room.
    """
    replicas, num_particles, dimension = size
    number = replicas * num_particles
    volume = jnp.asarray(side) ** dimension if room is None else jnp.prod(room + 1)
    at_random = largest_gap(num_particles, dimension, volume)
    points = uniform_points(key, number, dimension) * (side if room is None else room[None])

    def listed(position: Array) -> Pairs:
        found = neighbours.search(
            position, side, 1 + jnp.asarray(skin), replicas, capacity, "sweep"
        )
        return neighbours.with_offsets(position, side, found)

    def pushed(x: Array, pairs: Pairs, k: Array) -> tuple[Array, Array]:
        """The positions after a push of all overlapping pairs, and whether there are any."""
        apart = x[pairs.i] - x[pairs.j] - pairs.offset
        square = jnp.sum(apart * apart, axis=1)
        real = jnp.arange(capacity[0]) < pairs.count
        distance = jnp.sqrt(jnp.where(square > 0, square, 1e-18))
        # Coincident points part along the first axis.
        along_first = jnp.zeros(dimension, x.dtype).at[0].set(1e-9)
        apart = jnp.where((square > 0)[:, None], apart, along_first)
        close = real & (distance < 1 + GAP / 2)
        more = jax.random.uniform(jax.random.fold_in(key, k), distance.shape, x.dtype)
        target = 1 + GAP + at_random * more
        push = jnp.where(close, 0.5 * (target - distance) / distance, 0.0)[:, None] * apart
        x = x.at[pairs.i].add(push).at[pairs.j].add(-push)
        return x if room is None else jnp.clip(x, 0.0, room[None]), jnp.any(close)

    def until_stale(now: _Relaxing) -> _Relaxing:
        built = neighbours.wrap(side, now.position)
        pairs = listed(built)
        full = (pairs.count > capacity[0]) | (pairs.lookahead > capacity[1])

        def goes_on(carry: tuple[_Relaxing, Array]) -> Array:
            now, stale = carry
            return now.overlap & ~stale & (now.pushes < MOST_PUSHES)

        def push(carry: tuple[_Relaxing, Array]) -> tuple[_Relaxing, Array]:
            now, _ = carry
            x, overlap = pushed(now.position, pairs, now.pushes)
            moved = jnp.sqrt(jnp.max(jnp.sum((x - built) ** 2, axis=1)))
            now = now._replace(position=x, pushes=now.pushes + 1, overlap=overlap)
            return now, 2 * moved > skin - 2 * GAP

        now, _ = jax.lax.while_loop(goes_on, push, (now._replace(position=built), full))
        late = now.overlap & (now.pushes >= MOST_PUSHES)
        fault = status.flag(status.LIST_FULL, full) | status.flag(status.NO_ROOM, late)
        return now._replace(fault=now.fault | fault)

    zero = jnp.zeros((), jnp.int32)
    first = _Relaxing(points, zero, jnp.ones((), bool), jnp.asarray(fault, jnp.int32))
    last = jax.lax.while_loop(
        lambda now: now.overlap & (now.fault == status.OK), until_stale, first
    )
    return neighbours.wrap(side, last.position), last.fault
