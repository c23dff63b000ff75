"""The pairs of hard spheres that may touch in a window of time.

Their spheres, and those that reach a wall, are the members of the window. All others fly freely.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxgran.particles.bit_masks import rows_where
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.hard.prediction import PairRows, Paths, first_impacts
from jaxgran.particles.neighbours.pairs import Pairs
from jaxgran.particles.neighbours.selection import select_members
from jaxgran.particles.spheres import SphereState


class ImpactCandidates(NamedTuple):
    """Pairs that may touch in a window, and the particles that belong to them, its members.

    Attributes:
        members: the particle in each slot, in increasing order; n where a slot is empty.
        rows: the pairs.
        replica: of each member.
        needed: number of rows that each array of the run would need, in the order of its
            capacities; where one exceeds the capacity, pairs or particles are missing.
    """

    members: Int[Array, "members"]
    rows: PairRows
    replica: Int[Array, "members"]
    needed: Int[Array, "kinds"]


def select_candidates(
    state: SphereState,
    container: Float[Array, "d"] | None,
    pairs: Pairs,
    capacity: Capacity,
    duration: Float[Array, ""],
    bound: Float[Array, "replicas"],
) -> ImpactCandidates:
    """Return the pairs that touch in free flight, and all that may touch once paths have changed.

    Particles that reach a wall are members, too.

    Args:
        state: at the start of the window.
        container: sides of a container; None for a periodic box.
        pairs: a neighbour list, with all pairs that may touch.
        capacity: lengths of the arrays.
        duration: of the window.
        bound: an upper bound on the speeds in each replica during the window.
    """
    x = state.position
    v = state.velocity
    n = len(x)
    size = n // len(bound)
    # The listed pairs that can touch at the largest speeds are a small part of the list.
    displacement = x[pairs.i] - x[pairs.j] - pairs.offset
    gap = jnp.sqrt(jnp.sum(displacement * displacement, -1)) - 1
    gap = jnp.where(pairs.in_use, gap, jnp.inf)
    is_near = gap < 2 * bound[pairs.i // size] * duration
    row, real, num_near = rows_where(is_near, capacity.near)
    i = pairs.i[row]
    near = PairRows(i, pairs.j[row], pairs.offset[row], bound[i // size], real)

    free = first_impacts(Paths(x, v, jnp.zeros(n, x.dtype)), near, duration, container)
    final = jnp.minimum(free.final[near.a], free.final[near.b])
    disturbed = jnp.minimum(final, duration)
    may_touch = free.motion.gap(disturbed) < 2 * near.bound * (duration - disturbed)
    selected = near.real & (jnp.isfinite(free.times) | may_touch)
    hits_wall = jnp.zeros(n, bool) if free.walls is None else jnp.isfinite(free.walls.times)
    found = select_members(
        selected,
        near.a,
        near.b,
        hits_wall,
        max_rows=capacity.contacts,
        max_members=capacity.members,
    )
    return ImpactCandidates(
        members=found.members,
        rows=PairRows(
            a=found.first,
            b=found.second,
            offset=near.offset[found.rows],
            bound=near.bound[found.rows],
            real=found.real,
        ),
        replica=found.members // size,
        needed=jnp.stack(
            [pairs.count, pairs.lookahead, num_near, found.num_rows, found.num_members]
        ),
    )
