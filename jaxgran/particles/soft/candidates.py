"""Soft spheres that may touch within one block of time steps.

Units here: the diameter is 1.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Shaped

from jaxgran.particles.compaction import rows_where
from jaxgran.particles.neighbours import Pairs


class Encounters(NamedTuple):
    """The pairs that may touch in a block, and the particles that belong to them, its members.

    Attributes:
        members: the particle in each slot, in increasing order; n where a slot is empty.
        a, b: the slots of the two particles of each pair.
        offset: of the pair, as in `Pairs`.
        replica: to which the pair belongs.
        expected: whether all neighbours of both particles are included, so that nothing outside of
            the selection can be hit by a contact of this pair.
        needed: number of rows that each array of the run would need, in the order of its
            capacities; where one exceeds the capacity, pairs or particles are missing.
        sure: whether all neighbours of a member are included; None without walls.
    """

    members: Int[Array, "members"]
    a: Int[Array, "contacts"]
    b: Int[Array, "contacts"]
    offset: Float[Array, "contacts d"]
    replica: Int[Array, "contacts"]
    expected: Bool[Array, "contacts"]
    needed: Int[Array, "kinds"]
    sure: Bool[Array, "members"] | None = None

    def by_replica(self, values: Array, replicas: int) -> Shaped[Array, "replicas"]:
        """Sums of values of the pairs over each replica."""
        return jnp.zeros(replicas, values.dtype).at[self.replica].add(values)


def select_encounters(
    position: Float[Array, "n d"],
    velocity: Float[Array, "n d"],
    pairs: Pairs,
    duration: ArrayLike,
    margin: ArrayLike,
    extra: Bool[Array, "n"],
    replicas: int,
    capacities: tuple[int, int, int],
    near_walls: Bool[Array, "n"] | None = None,
) -> Encounters:
    """The pairs that would touch in free flight, and the pairs near those.

    Args:
        position, velocity: of all particles.
        pairs: a neighbour list, with all pairs closer than 1 + margin.
        duration: of the block.
        margin: largest change of a pair's distance during the block.
        extra: particles that are known to touch another one besides.
        replicas: number of boxes, whose particles follow one another.
        capacities: for the near pairs, the contacts and the members.
        near_walls: particles that may touch a wall, which are members even without a pair.
    """
    n = len(position)
    most_near, most_contacts, most_members = capacities
    near, real, num_near = _near_pairs(position, pairs, margin, most_near)
    i, j, offset = near.i, near.j, near.offset
    touch = real & _touches_in_flight(near.apart, velocity[i] - velocity[j], duration)

    def spread(active, mask):
        ends = jnp.where(mask[None], jnp.stack([i, j]), n)
        return active.at[ends].set(True, mode="drop")

    # The particles that would touch, those near them, and all pairs near these.
    active = spread(extra if near_walls is None else extra | near_walls, touch)
    active = spread(active, real & (active[i] | active[j]))
    chosen = real & (active[i] | active[j])
    present = spread(jnp.zeros(n, bool) if near_walls is None else extra | near_walls, chosen)
    rows, num_contacts = rows_where(chosen, most_contacts)
    real = jnp.arange(most_contacts) < num_contacts
    rows = jnp.where(real, rows, 0)
    i, j, offset = i[rows], j[rows], offset[rows]
    members, num_members = rows_where(present, most_members)
    slot = jnp.cumsum(present, dtype=jnp.int32) - 1
    return Encounters(
        members=members,
        a=jnp.where(real, slot[i], 0),
        b=jnp.where(real, slot[j], 0),
        offset=jnp.where(real[:, None], offset, 2.0),  # an empty row is a pair out of reach
        replica=i // (n // replicas),
        expected=active[i] & active[j],
        needed=jnp.stack([pairs.count, pairs.lookahead, num_near, num_contacts, num_members]),
        sure=None if near_walls is None else active.at[members].get(mode="fill", fill_value=True),
    )


class _Near(NamedTuple):
    """Pairs that are close enough to touch within the block."""

    i: Int[Array, "near"]
    j: Int[Array, "near"]
    offset: Float[Array, "near d"]
    apart: Float[Array, "near d"]  # displacement of i from j


def _near_pairs(
    position: Float[Array, "n d"], pairs: Pairs, margin: ArrayLike, capacity: int
) -> tuple[_Near, Bool[Array, "{capacity}"], Int[Array, ""]]:
    """The listed pairs closer than 1 + margin, which rows hold one, and how many there are."""
    apart = position[pairs.i] - position[pairs.j] - pairs.offset
    near = jnp.sum(apart * apart, -1) < (1 + margin) ** 2
    near &= jnp.arange(near.size) < pairs.count
    rows, count = rows_where(near, capacity)
    real = jnp.arange(capacity) < count
    return _Near(pairs.i[rows], pairs.j[rows], pairs.offset[rows], apart[rows]), real, count


def _touches_in_flight(
    apart: Float[Array, "near d"], relative: Float[Array, "near d"], duration: ArrayLike
) -> Bool[Array, "near"]:
    """Whether pairs come closer than a diameter in free flight of this duration."""
    distance2 = jnp.sum(apart * apart, -1)
    approach, speed2 = jnp.sum(apart * relative, -1), jnp.sum(relative * relative, -1)
    closest = jnp.clip(-approach / jnp.where(speed2 > 0, speed2, 1.0), 0.0, duration)
    return distance2 + (2 * approach + speed2 * closest) * closest < 1.0
