"""Hard spheres that may touch within one window of time.

Units here: the diameter is 1.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran.particles.capacity import Capacity
from jaxgran.particles.compaction import rows_where
from jaxgran.particles.hard.prediction import Rows, Slots, first_impacts
from jaxgran.particles.hard.walls import HardWalls
from jaxgran.particles.neighbours import Pairs


class Selection(NamedTuple):
    """The pairs that may touch in a window, and the particles that belong to them, its members.

    Attributes:
        members: the particle in each slot, in increasing order; n where a slot is empty.
        rows: the pairs.
        replica: of each member.
        needed: number of rows that each array of the run would need, in the order of its
            capacities; where one exceeds the capacity, pairs or particles are missing.
    """

    members: Int[Array, "members"]
    rows: Rows
    replica: Int[Array, "members"]
    needed: Int[Array, "kinds"]


def select_reachable(
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    pairs: Pairs,
    duration: ArrayLike,
    bound: Float[Array, "replicas"],
    capacity: Capacity,
    walls: HardWalls | None = None,
) -> Selection:
    """The pairs that touch in free flight, and all that may touch once paths have changed.

    Args:
        x, v: positions and velocities of all particles of all replicas.
        pairs: a neighbour list, with all pairs that may touch.
        duration: of the window.
        bound: an upper bound on the speeds in each replica during the window.
        capacity: sizes of the arrays.
        walls: of a container; who meets them is a member, too.
    """
    n, size = len(x), len(x) // len(bound)
    rows, num_near = _reachable_pairs(x, pairs, duration, bound, capacity.near)
    free = first_impacts(Slots(x, v, jnp.zeros(n, x.dtype)), rows, duration, walls)
    i, j = rows.a, rows.b
    disturbed = jnp.minimum(jnp.minimum(free.final[i], free.final[j]), duration)
    closer = free.motion.gap(disturbed) < 2 * rows.bound * (duration - disturbed)
    chosen = rows.real & (jnp.isfinite(free.times) | closer)

    picked, num_chosen = rows_where(chosen, capacity.contacts)
    real = jnp.arange(capacity.contacts) < num_chosen
    picked = jnp.where(real, picked, 0)
    i, j = i[picked], j[picked]
    ends = jnp.where(real[None], jnp.stack([i, j]), n)
    present = jnp.zeros(n, bool).at[ends].set(True, mode="drop")
    if free.bounces is not None:
        present |= jnp.isfinite(free.bounces.times)
    members, num_members = rows_where(present, capacity.members)
    own = jnp.arange(capacity.members, dtype=jnp.int32)
    slot = jnp.zeros(n, jnp.int32).at[members].set(own, mode="drop")
    a, b = (jnp.where(real, slot[k], 0) for k in (i, j))
    rows = Rows(a, b, rows.offset[picked], rows.bound[picked], real)
    needed = jnp.stack([pairs.count, pairs.lookahead, num_near, num_chosen, num_members])
    return Selection(members, rows, members // size, needed)


def _reachable_pairs(
    x: Float[Array, "n d"],
    pairs: Pairs,
    duration: ArrayLike,
    bound: Float[Array, "replicas"],
    capacity: int,
) -> tuple[Rows, Int[Array, ""]]:
    """The listed pairs that can touch at the largest speeds, a small part of the list, and their
    number; as slots the indices of the particles."""
    size = len(x) // len(bound)
    apart = x[pairs.i] - x[pairs.j] - pairs.offset
    gap = jnp.sqrt(jnp.sum(apart * apart, -1)) - 1
    gap = jnp.where(jnp.arange(gap.size) < pairs.count, gap, jnp.inf)
    near, num_near = rows_where(gap < 2 * bound[pairs.i // size] * duration, capacity)
    real = jnp.arange(capacity) < num_near
    near = jnp.where(real, near, 0)
    i, j = pairs.i[near], pairs.j[near]
    return Rows(i, j, pairs.offset[near], bound[i // size], real), num_near
