"""Soft spheres that may touch in a block of time steps: who they are, and their steps.

Units here: diameter and mass are 1.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.contact import contact_force, midpoint_rate
from jaxgran.neighbours import Pairs
from jaxgran.rows import rows_where


class Encounters(NamedTuple):
    """The pairs that may touch in a block, and their particles."""

    members: Int[Array, "members"]  # particle of a slot; n where the slot is empty
    a: Int[Array, "contacts"]  # slots
    b: Int[Array, "contacts"]
    offset: Float[Array, "contacts d"]
    replica: Int[Array, "contacts"]
    expected: Bool[Array, "contacts"]  # both partners' neighbours are looked at too
    needed: Int[Array, "kinds"]  # how many rows of each of Room there would have to be


def select(
    position: Float[Array, "n d"],
    velocity: Float[Array, "n d"],
    pairs: Pairs,
    duration: ArrayLike,
    margin: ArrayLike,
    extra: Bool[Array, "n"],
    replicas: int,
    rooms: tuple[int, int, int],
) -> Encounters:
    """Whoever would touch in free flight of a duration, or is near to those.

    Args:
        position, velocity: of all particles.
        pairs: all that are closer than 1 + margin, and more.
        duration: of the block.
        margin: how far a pair's distance may change in it.
        extra: particles known to take part besides.
        replicas: the particles are those of so many boxes, one after another.
        rooms: rows for near pairs, contacts and members.
    """
    x, v = position, velocity
    n = len(x)
    room_near, room_contacts, room_members = rooms

    apart = x[pairs.i] - x[pairs.j] - pairs.offset
    near = jnp.sum(apart * apart, -1) < (1 + margin) ** 2
    near &= jnp.arange(near.size) < pairs.count
    rows, num_near = rows_where(near, room_near)
    real = jnp.arange(room_near) < num_near
    i, j, offset = pairs.i[rows], pairs.j[rows], pairs.offset[rows]

    # Who would touch in free flight, who is near to those, and whoever is near to these.
    r, u = apart[rows], v[i] - v[j]
    distance2, approach, speed2 = jnp.sum(r * r, -1), jnp.sum(r * u, -1), jnp.sum(u * u, -1)
    closest = jnp.clip(-approach / jnp.where(speed2 > 0, speed2, 1.0), 0.0, duration)
    touch = real & (distance2 + (2 * approach + speed2 * closest) * closest < 1.0)

    def spread(active, mask):
        ends = jnp.where(mask[None], jnp.stack([i, j]), n)
        return active.at[ends].set(True, mode="drop")

    active = spread(extra, touch)
    active = spread(active, real & (active[i] | active[j]))
    chosen = real & (active[i] | active[j])
    present = spread(jnp.zeros(n, bool), chosen)
    rows, num_contacts = rows_where(chosen, room_contacts)
    real = jnp.arange(room_contacts) < num_contacts
    rows = jnp.where(real, rows, 0)
    i, j, offset = i[rows], j[rows], offset[rows]
    members, num_members = rows_where(present, room_members)
    slot = jnp.cumsum(present, dtype=jnp.int32) - 1
    return Encounters(
        members=members,
        a=jnp.where(real, slot[i], 0),
        b=jnp.where(real, slot[j], 0),
        offset=jnp.where(real[:, None], offset, 2.0),  # an empty row is a pair too far apart
        replica=i // (n // replicas),
        expected=active[i] & active[j],
        needed=jnp.stack([pairs.count, pairs.ahead, num_near, num_contacts, num_members]),
    )


def overlap(x: Float[Array, "n d"], a: Array, b: Array, offset: Array) -> tuple[Array, ...]:
    """xi (0 where pairs do not touch), the normal from b to a, and which pairs touch."""
    r = x[a] - x[b] - offset
    distance2 = jnp.sum(r * r, -1)
    touching = distance2 < 1
    distance = jnp.sqrt(jnp.where(touching, distance2, 1.0))
    return 1 - distance, r / distance[:, None], touching


def elastic_energy(xi: Float[Array, "contacts"], alpha: ArrayLike) -> Float[Array, "contacts"]:
    """``(2/5) rho xi^(5/2)`` with ``rho = alpha / 2``, of spheres of mass 1."""
    return 0.2 * jnp.asarray(alpha) * xi**2.5


class Work(NamedTuple):
    """What the contacts of a block did, one row a pair."""

    dissipated: Array
    exchanged: Array  # work done against and by the elastic force
    begun: Array
    touched: Array  # at any time
    stored: Array  # elastic energy at the end
    touching: Array  # at the end


def follow(
    x: Float[Array, "members d"],
    v: Float[Array, "members d"],
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    chosen: Encounters,
    duration: ArrayLike,
    num_steps: int,
    clipped: bool,
) -> tuple[Array, Array, Work]:
    """Positions and velocities of the members after equal drift-kick-drift steps.

    alpha and A are one for all or one for each contact.
    """
    rho, dt = 0.5 * alpha, duration / num_steps
    a, b, offset = chosen.a, chosen.b, chosen.offset

    def step(carry, _):
        x, v, dissipated, exchanged, begun, before = carry
        xi, normal, touching = overlap(x, a, b, offset)
        xi_dot = -jnp.sum((v[a] - v[b]) * normal, -1)
        rate = midpoint_rate(xi, xi_dot, alpha, dissipative_constant, dt)
        force = contact_force(xi, rate, rho, dissipative_constant, clipped=clipped)
        elastic = contact_force(xi, 0.0, rho, 0.0)
        kick = (dt * force)[:, None] * normal
        v = v.at[a].add(kick).at[b].add(-kick)
        # The midpoint sum of sqrt(xi) xi_dot^2 errs to the other side of the trapezoidal one.
        mean = xi_dot - dt * force
        viscous = contact_force(xi, 1.0, rho, dissipative_constant) - elastic
        lost = (force - elastic) * mean + 0.5 * viscous * (dt * force) ** 2
        dissipated += dt * lost
        exchanged += dt * elastic * jnp.abs(mean)
        begun += touching & ~before
        return (x + dt * v, v, dissipated, exchanged, begun, touching), None

    zeros = jnp.zeros(len(a), x.dtype)
    first = overlap(x, a, b, offset)[2]
    carry = x + 0.5 * dt * v, v, zeros, zeros, jnp.zeros(len(a), jnp.int32), first
    (x, v, dissipated, exchanged, begun, touching), _ = jax.lax.scan(step, carry, length=num_steps)
    x = x - 0.5 * dt * v
    xi, _, last = overlap(x, a, b, offset)
    work = Work(
        dissipated=dissipated,
        exchanged=exchanged,
        begun=begun + (last & ~touching),  # after the last kick
        touched=(begun > 0) | first,
        stored=elastic_energy(xi, alpha),
        touching=last,
    )
    return x, v, work
