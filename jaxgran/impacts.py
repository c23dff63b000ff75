"""Impacts of hard spheres within a window of time: which there may be, and their resolution.

Units here: diameter, mass and first temperature are 1. Times count from the start of the window,
and every position is extrapolated back to it: x(s) = x + v s. An impact changes both.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.neighbours import Pairs
from jaxgran.restitution import ReducedLaw
from jaxgran.room import Room
from jaxgran.rows import rows_where
from jaxgran.tangents import ImpactTangents

MAX_ROUNDS = 100_000
"""Rounds of simultaneous impacts in one window before the run counts as stalled."""


class Scene(NamedTuple):
    """The gas in units of its diameter, mass and first temperature."""

    side: Array  # of the box
    law: ReducedLaw  # its speeds in units of sqrt(2)
    collision_frequency: Array  # at T = 1
    contact_time: Array  # in mean free times: repeated impacts within it are elastic
    elastic: Bool[Array, ""]  # no impact loses energy


class Motion(NamedTuple):
    """Relative motion of pairs, ``r + w s``: the distance is all that their impact time needs."""

    rr: Float[Array, "rows"]
    rw: Float[Array, "rows"]
    ww: Float[Array, "rows"]

    @classmethod
    def of(cls, r: Float[Array, "rows d"], w: Float[Array, "rows d"]) -> "Motion":
        return cls(jnp.sum(r * r, -1), jnp.sum(r * w, -1), jnp.sum(w * w, -1))

    def gap(self, s: ArrayLike) -> Float[Array, "rows"]:
        """Distance of the surfaces at s."""
        return jnp.sqrt(jnp.maximum(self.rr + (2 * self.rw + self.ww * s) * s, 0.0)) - 1

    def impact_time(self, since: ArrayLike) -> Float[Array, "rows"]:
        """When spheres touch: the first s >= `since`, or inf.

        ``s - since = c / (sqrt(b^2 - w^2 c) - b)`` with ``b = r w`` and ``c = r^2 - 1`` at `since`,
        the form without cancellation. Only spheres that approach touch, and at once where round-off
        has left them closer than a diameter. Those that would only graze, to a depth of 1e-16,
        pass.
        """
        b = self.rw + self.ww * since
        c = self.rr + (2 * self.rw + self.ww * since) * since - 1
        graze = jnp.finfo(b.dtype).eps ** 0.5
        square = b * b - self.ww * c
        touch = (b < -graze * jnp.sqrt(self.ww)) & ((c <= 0) | (square > 0))
        root = jnp.sqrt(jnp.where(touch & (c > 0), square, 1.0))
        ahead = jnp.maximum(c, 0.0) / jnp.where(touch, root - b, 1.0)
        return jnp.where(touch, since + ahead, jnp.inf)


class Rows(NamedTuple):
    """Pairs, by the slots of their particles."""

    a: Int[Array, "rows"]
    b: Int[Array, "rows"]
    offset: Float[Array, "rows d"]
    bound: Float[Array, "rows"]  # no sphere of this replica becomes faster
    real: Bool[Array, "rows"]


class Slots(NamedTuple):
    """Particles, on the path that they have since `last`."""

    x: Float[Array, "slots d"]
    v: Float[Array, "slots d"]
    last: Float[Array, "slots"]  # time of the last impact; negative before the window


def firstimpacts(slots: Slots, rows: Rows, end):
    """Relative paths, impact times (inf from `end` on), and the first of each particle.

    Last, until when each particle surely keeps to its path. It does until its first impact with an
    undisturbed particle, or until one that was disturbed before, and is by then as fast as any may
    be, has had the time to come. Disturbances go from pair to pair; these times fall until they
    are consistent, those before `end`.
    """
    a, b = rows.a, rows.b
    r, w = slots.x[a] - slots.x[b] - rows.offset, slots.v[a] - slots.v[b]
    motion = Motion.of(r, w)
    last = slots.last[a], slots.last[b]
    times = motion.impact_time(jnp.maximum(jnp.maximum(*last), 0.0))
    times = jnp.where(rows.real & (times < end), times, jnp.inf)
    first = jnp.full(len(slots.x), jnp.inf, times.dtype).at[a].min(times).at[b].min(times)
    speed = jnp.sqrt(jnp.sum(slots.v**2, -1))
    closing = rows.bound + speed[a], rows.bound + speed[b]

    def arrival(disturbed, last, closing):
        there = rows.real & (disturbed < end)
        disturbed = jnp.where(there, disturbed, 0.0)
        # The target's path is known from its last impact on only.
        seen = jnp.maximum(disturbed, last)
        left = motion.gap(seen) - 2 * rows.bound * (seen - disturbed)
        return jnp.where(there, seen + jnp.maximum(left, 0.0) / closing, jnp.inf)

    def lower(carry):
        until, _ = carry
        new = until.at[b].min(arrival(until[a], last[1], closing[1]))
        new = new.at[a].min(arrival(new[b], last[0], closing[0]))
        return new, jnp.any(new < jnp.minimum(until, end))  # later than the end is never

    until, _ = jax.lax.while_loop(lambda carry: carry[1], lower, (first, jnp.array(True)))
    return r, w, motion, times, first, until


class Selection(NamedTuple):
    """The pairs that may touch in a window, and their particles."""

    members: Int[Array, "members"]  # particle of a slot; n where the slot is empty
    rows: Rows
    replica: Int[Array, "members"]
    needed: Int[Array, "kinds"]  # how many rows of each of Room there would have to be


def select(
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    pairs: Pairs,
    duration: ArrayLike,
    bound: Float[Array, "replicas"],
    room: Room,
) -> Selection:
    """Pairs that touch in free flight, and all that may once those have been disturbed.

    Args:
        x, v: of all particles of all replicas.
        pairs: all that may touch, and more.
        duration: of the window.
        bound: no sphere of a replica becomes faster.
        room: rows of the arrays.
    """
    n = len(x)
    size = n // len(bound)
    apart = x[pairs.i] - x[pairs.j] - pairs.offset
    gap = jnp.sqrt(jnp.sum(apart * apart, -1)) - 1
    gap = jnp.where(jnp.arange(gap.size) < pairs.count, gap, jnp.inf)
    slots = Slots(x, v, jnp.zeros(n, x.dtype))

    # No others can touch, and these are a small part of the list.
    reachable, num_near = rows_where(gap < 2 * bound[pairs.i // size] * duration, room.near)
    real = jnp.arange(room.near) < num_near
    reachable = jnp.where(real, reachable, 0)
    i, j = pairs.i[reachable], pairs.j[reachable]
    rows = Rows(i, j, pairs.offset[reachable], bound[i // size], real)
    _, _, motion, times, _, until = firstimpacts(slots, rows, duration)
    disturbed = jnp.minimum(jnp.minimum(until[i], until[j]), duration)
    closer = motion.gap(disturbed) < 2 * rows.bound * (duration - disturbed)
    chosen = real & (jnp.isfinite(times) | closer)

    picked, num_chosen = rows_where(chosen, room.contacts)
    real = jnp.arange(room.contacts) < num_chosen
    picked = jnp.where(real, picked, 0)
    i, j = i[picked], j[picked]
    ends = jnp.where(real[None], jnp.stack([i, j]), n)
    present = jnp.zeros(n, bool).at[ends].set(True, mode="drop")
    members, num_members = rows_where(present, room.members)
    own = jnp.arange(room.members, dtype=jnp.int32)
    slot = jnp.zeros(n, jnp.int32).at[members].set(own, mode="drop")
    a, b = (jnp.where(real, slot[k], 0) for k in (i, j))
    rows = Rows(a, b, rows.offset[picked], rows.bound[picked], real)
    needed = jnp.stack([pairs.count, pairs.ahead, num_near, num_chosen, num_members])
    return Selection(members, rows, members // size, needed)


class Work(NamedTuple):
    """What the impacts of a window did; the arrays have one row a slot."""

    slots: Slots
    dissipated: Array  # half of it for each of two spheres
    impacts: Array
    regularised: Array
    moved: Array  # square of the distance from where it is listed, at most
    fastest: Array  # square of the speed, at most
    pending: Array
    num_rounds: Array
    gains: Float[Array, "changes rows"]  # of energy, see `ImpactTangents`; if none, no rows


def resolve(
    slots: Slots,
    listed: Float[Array, "slots d"],
    chosen: Selection,
    scene: Scene,
    duration: ArrayLike,
    shortest: Float[Array, "replicas"],
    along: ImpactTangents | None,
) -> Work:
    """All impacts of a window, round by round.

    Args:
        slots: the particles that may touch.
        listed: the places for which the list was made.
        chosen: who they are.
        scene: the gas.
        duration: of the window.
        shortest: time since a sphere's last impact within which the next is elastic.
        along: whether the gains of energy along directions in the law are wanted, and which.

    A round executes every impact that is the first of both its spheres and cannot be forestalled:
    neither sphere may be disturbed before. The earliest of all is always one of them.
    """
    rows = chosen.rows
    a, b = rows.a, rows.b
    num_rows, num_slots = len(a), len(slots.v)
    index, own = jnp.arange(num_rows, dtype=jnp.int32), jnp.arange(num_slots, dtype=jnp.int32)
    shortest = shortest[jnp.minimum(chosen.replica, len(shortest) - 1)]

    def one_round(work: Work) -> Work:
        slots = work.slots
        r, w, _, times, first, until = firstimpacts(slots, rows, duration)
        safe = jnp.isfinite(times)
        for k in (a, b):
            safe &= (times == first[k]) & (times == until[k])
        # Of impacts at the very same time a sphere has the one listed first.
        rank = jnp.where(safe, index, num_rows)
        row = jnp.full(num_slots, num_rows, jnp.int32).at[a].min(rank).at[b].min(rank)
        safe &= (row[a] == index) & (row[b] == index)

        s = jnp.where(safe, times, 0.0)
        r = r + w * s[:, None]
        normal = r / jnp.where(safe, jnp.sqrt(jnp.sum(r * r, -1)), 1.0)[:, None]
        speed = jnp.where(safe, -jnp.sum(w * normal, -1), 1.0)
        soon = s - jnp.maximum(slots.last[a], slots.last[b]) < shortest[a]
        eps = scene.law.restitution(speed * 0.5**0.5)
        eps = jnp.where(soon | scene.elastic, 1.0, eps)
        kick = (0.5 * (1 + eps) * speed)[:, None] * normal
        lost = 0.125 * (1 - eps * eps) * speed**2
        gains = work.gains
        if along is not None:
            # The law's unit of speed is sqrt(2).
            gained = 2 * along.gains(scene.law, speed * 0.5**0.5)
            gains += jnp.where((safe & ~soon & ~scene.elastic)[None], gained, 0.0)

        row = jnp.minimum(row, num_rows - 1)
        hit = safe[row] & ((a[row] == own) | (b[row] == own))
        s = jnp.where(hit, s[row], 0.0)
        kick = jnp.where(hit, jnp.where(a[row] == own, 1.0, -1.0), 0.0)[:, None] * kick[row]
        place = slots.x + slots.v * s[:, None]
        v = slots.v + kick
        away = jnp.where(hit, jnp.sum((place - listed) ** 2, -1), 0.0)
        return Work(
            slots=Slots(slots.x - kick * s[:, None], v, jnp.where(hit, s, slots.last)),
            dissipated=work.dissipated + jnp.where(hit, lost[row], 0.0),
            impacts=work.impacts + hit,
            regularised=work.regularised + (hit & soon[row]),
            moved=jnp.maximum(work.moved, away),
            fastest=jnp.maximum(work.fastest, jnp.sum(v * v, -1)),
            pending=jnp.any(safe),
            num_rounds=work.num_rounds + 1,
            gains=gains,
        )

    def going(work: Work):
        return work.pending & (work.num_rounds < MAX_ROUNDS)

    count, zeros = jnp.zeros(num_slots, jnp.int32), jnp.zeros(num_slots, slots.x.dtype)
    size = (0, 0) if along is None else (len(along.log_temperature) + 1, num_rows)
    gains = jnp.zeros(size, zeros.dtype)
    work = Work(slots, zeros, count, count, zeros, zeros, jnp.array(True), jnp.int32(0), gains)
    return jax.lax.while_loop(going, one_round, work)
