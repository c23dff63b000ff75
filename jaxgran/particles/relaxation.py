"""Positions without overlap from random points, compiled: what `initial` does on the host."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran.checks import status
from jaxgran.particles import neighbours
from jaxgran.particles.initial import GAP, MOST_PUSHES, largest_gap, uniform_points
from jaxgran.particles.neighbours import Pairs

COINCIDENT = 1e-9
"""Distance from which points at the same place part."""


class _Relaxing(NamedTuple):
    """Spheres that are pushed apart: positions, pushes made, whether some overlapped before the
    last of them, and the status."""

    position: Float[Array, "n d"]
    pushes: Int[Array, ""]
    overlap: Bool[Array, ""]
    fault: Int[Array, ""]


class _Boxes(NamedTuple):
    """What does not change: see the arguments of `positions`; and the largest random gap."""

    key: PRNGKeyArray
    side: ArrayLike
    replicas: int
    skin: ArrayLike
    capacity: tuple[int, int]
    room: Float[Array, "1 d"] | None
    at_random: Float[Array, ""]

    def until_stale(self, now: _Relaxing) -> _Relaxing:
        """A new neighbour list, and pushes until it is stale or none is needed."""
        built, cutoff = neighbours.wrap(self.side, now.position), 1 + jnp.asarray(self.skin)
        found = neighbours.search(built, self.side, cutoff, self.replicas, self.capacity, "sweep")
        pairs = neighbours.with_offsets(built, self.side, found)
        full = (pairs.count > self.capacity[0]) | (pairs.lookahead > self.capacity[1])

        def goes_on(carry: tuple[_Relaxing, Array]) -> Array:
            now, stale = carry
            return now.overlap & ~stale & (now.pushes < MOST_PUSHES)

        def push(carry: tuple[_Relaxing, Array]) -> tuple[_Relaxing, Array]:
            now, _ = carry
            x, overlap = self.pushed(now.position, pairs, now.pushes)
            moved = jnp.sqrt(jnp.max(jnp.sum((x - built) ** 2, axis=1)))
            now = now._replace(position=x, pushes=now.pushes + 1, overlap=overlap)
            return now, 2 * moved > self.skin - 2 * GAP

        now, _ = jax.lax.while_loop(goes_on, push, (now._replace(position=built), full))
        late = now.overlap & (now.pushes >= MOST_PUSHES)
        fault = status.flag(status.LIST_FULL, full) | status.flag(status.NO_ROOM, late)
        return now._replace(fault=now.fault | fault)

    def pushed(self, x: Array, pairs: Pairs, k: Array) -> tuple[Array, Array]:
        """The positions after push k of all overlapping pairs, and whether there are any."""
        apart = x[pairs.i] - x[pairs.j] - pairs.offset
        square = jnp.sum(apart * apart, axis=1)
        distance = jnp.sqrt(jnp.where(square > 0, square, COINCIDENT**2))
        # Coincident points part along the first axis.
        first_axis = jnp.zeros_like(apart).at[:, 0].set(COINCIDENT)
        apart = jnp.where((square > 0)[:, None], apart, first_axis)
        real = jnp.arange(self.capacity[0]) < pairs.count
        close = real & (distance < 1 + GAP / 2)
        more = jax.random.uniform(jax.random.fold_in(self.key, k), distance.shape, x.dtype)
        target = 1 + GAP + self.at_random * more
        push = jnp.where(close, 0.5 * (target - distance) / distance, 0.0)[:, None] * apart
        x = x.at[pairs.i].add(push).at[pairs.j].add(-push)
        return x if self.room is None else jnp.clip(x, 0.0, self.room), jnp.any(close)


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
    volume = jnp.asarray(side) ** dimension if room is None else jnp.prod(room + 1)
    within = None if room is None else room[None]
    at_random = largest_gap(num_particles, dimension, volume)
    boxes = _Boxes(key, side, replicas, skin, capacity, within, at_random)
    points = uniform_points(key, replicas * num_particles, dimension)
    points = points * (jnp.asarray(side) if within is None else within)
    zero = jnp.zeros((), jnp.int32)
    first = _Relaxing(points, zero, jnp.ones((), bool), jnp.asarray(fault, jnp.int32))

    def unfinished(now: _Relaxing) -> Array:
        return now.overlap & (now.fault == status.OK)

    last = jax.lax.while_loop(unfinished, boxes.until_stale, first)
    return neighbours.wrap(side, last.position), last.fault
