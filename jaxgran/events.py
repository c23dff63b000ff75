"""Hard spheres, impact by impact, in windows of time in which many impacts are resolved at once.

Units here: diameter, mass and first temperature are 1. Times within a window count from its start,
and every position is extrapolated back to it: x(s) = x + v s. An impact changes both.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran import kinetics, neighbours, status, tangents
from jaxgran.blocks import Room
from jaxgran.encounters import rows_where
from jaxgran.neighbours import Pairs
from jaxgran.restitution import ReducedLaw
from jaxgran.tangents import ImpactTangents

MAX_ROUNDS = 100_000
"""Rounds of simultaneous impacts in one window before the run counts as stalled."""

LEAST_IMPACTS = 8
"""Impacts that a window should have at least, in all replicas together."""

SPEED_MARGIN = 1.15
"""How much faster than the fastest sphere one may become within a window."""


class Scene(NamedTuple):
    """The gas in units of its diameter, mass and first temperature."""

    side: Array  # of the box
    law: ReducedLaw  # its speeds in units of sqrt(2)
    collision_frequency: Array  # at T = 1
    contact_time: Array  # in mean free times: repeated impacts within it are elastic
    elastic: Bool[Array, ""]  # no impact loses energy


class State(NamedTuple):
    """All particles of all replicas, replica after replica (n = replicas * N)."""

    time: Float[Array, ""]
    position: Float[Array, "n d"]  # since the last list build, not wrapped
    velocity: Float[Array, "n d"]
    image: Int[Array, "n d"]  # whole box sides to add
    origin: Float[Array, "n d"]  # at t = 0
    first_velocity: Float[Array, "n d"]
    age: Float[Array, "n"]  # time since the last impact
    dissipated: Float[Array, "replicas"]
    impacts: Int[Array, "replicas"]  # each pair once
    regularised: Int[Array, "replicas"]  # of them, elastic because they came too soon
    window: Float[Array, ""]  # length to try next
    skin: Float[Array, ""]  # reach of the neighbour list beyond contact
    tangents: ImpactTangents | None = None  # where they are followed


class Plan(NamedTuple):
    """What is fixed when a run is compiled."""

    replicas: int
    share: float  # impacts in a window, per particle
    room: Room


def at_start(position, velocity, scene: Scene, skin: ArrayLike, plan: Plan) -> State:
    """Particles at t = 0."""
    replicas, dtype = plan.replicas, position.dtype
    counts = jnp.zeros(replicas, jnp.result_type(int))
    inside = neighbours.wrap(scene.side, position)
    return State(
        time=jnp.zeros((), dtype),
        position=inside,
        velocity=velocity,
        image=jnp.zeros(position.shape, jnp.int32),
        origin=inside,
        first_velocity=velocity,
        age=jnp.full(len(position), jnp.inf, dtype),
        dissipated=jnp.zeros(replicas, dtype),
        impacts=counts,
        regularised=counts,
        window=jnp.asarray(plan.share / scene.collision_frequency, dtype),
        skin=jnp.asarray(skin, dtype),
    )


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


class _Rows(NamedTuple):
    """Pairs, by the slots of their particles."""

    a: Int[Array, "rows"]
    b: Int[Array, "rows"]
    offset: Float[Array, "rows d"]
    bound: Float[Array, "rows"]  # no sphere of this replica becomes faster
    real: Bool[Array, "rows"]


class _Slots(NamedTuple):
    """Particles, on the path that they have since `last`."""

    x: Float[Array, "slots d"]
    v: Float[Array, "slots d"]
    last: Float[Array, "slots"]  # time of the last impact; negative before the window


def _first_impacts(slots: _Slots, rows: _Rows, end):
    """Relative paths, impact times (inf from `end` on), and the first of each particle.

    Last, until when each particle surely keeps to its path. It does until its first impact with an
    undisturbed particle, or until one that was disturbed before, and is by then as fast as any may
    be, has had the time to come. Disturbances go from pair to pair; these times fall until they
    are consistent.
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
        at_a, at_b = until[a], until[b]
        new = until.at[b].min(arrival(at_a, last[1], closing[1]))
        new = new.at[a].min(arrival(at_b, last[0], closing[0]))
        return new, jnp.any(new < until)

    until, _ = jax.lax.while_loop(lambda carry: carry[1], lower, (first, jnp.array(True)))
    return r, w, motion, times, first, until


class _Selection(NamedTuple):
    """The pairs that may touch in a window, and their particles."""

    members: Int[Array, "members"]  # particle of a slot; n where the slot is empty
    rows: _Rows
    replica: Int[Array, "members"]
    needed: Int[Array, "kinds"]  # how many rows of each of Room there would have to be


def _select(x, v, pairs: Pairs, duration, bound, plan: Plan) -> _Selection:
    """Pairs that touch in free flight, and all that may once those have been disturbed."""
    room, n = plan.room, len(x)
    size = n // plan.replicas
    apart = x[pairs.i] - x[pairs.j] - pairs.offset
    gap = jnp.sqrt(jnp.sum(apart * apart, -1)) - 1
    gap = jnp.where(jnp.arange(gap.size) < pairs.count, gap, jnp.inf)
    speed = jnp.sqrt(jnp.sum(v * v, -1))
    slots = _Slots(x, v, jnp.zeros(n, x.dtype))

    fast, s_i, s_j = bound[pairs.i // size], speed[pairs.i], speed[pairs.j]

    def in_reach(until):
        i, j = until[pairs.i], until[pairs.j]
        early, late = jnp.minimum(i, j), jnp.maximum(i, j)
        reach = (s_i + s_j) * early + (fast + jnp.where(i < j, s_j, s_i)) * (late - early)
        near = gap < reach + 2 * fast * (duration - late)
        return near, jnp.sum(near, dtype=jnp.int32)

    def spread(carry):
        _, near, _, _ = carry
        picked, count = rows_where(near, room.near)
        real = jnp.arange(room.near) < count
        picked = jnp.where(real, picked, 0)
        i, j = pairs.i[picked], pairs.j[picked]
        rows = _Rows(i, j, pairs.offset[picked], bound[i // size], real)
        _, _, motion, times, _, until = _first_impacts(slots, rows, duration)
        until = jnp.minimum(until, duration)
        disturbed = jnp.minimum(until[i], until[j])
        closer = motion.gap(disturbed) < 2 * rows.bound * (duration - disturbed)
        near, wider = in_reach(until)
        found = rows, real & (jnp.isfinite(times) | closer)
        return found, near, count, wider

    def grows(carry):
        _, _, count, wider = carry
        return (wider > count) & (wider <= room.near)

    near = gap < (s_i + s_j) * duration
    count = jnp.sum(near, dtype=jnp.int32)
    index, no = jnp.zeros(room.near, jnp.int32), jnp.zeros(room.near, bool)
    nothing = jnp.zeros(room.near, x.dtype)
    rows = _Rows(index, index, jnp.zeros((room.near, x.shape[1]), x.dtype), nothing, no)
    nobody = (rows, no), near, jnp.int32(-1), count
    (rows, chosen), _, _, num_near = jax.lax.while_loop(grows, spread, nobody)

    picked, num_chosen = rows_where(chosen, room.contacts)
    real = jnp.arange(room.contacts) < num_chosen
    picked = jnp.where(real, picked, 0)
    i, j = rows.a[picked], rows.b[picked]
    ends = jnp.where(real[None], jnp.stack([i, j]), n)
    present = jnp.zeros(n, bool).at[ends].set(True, mode="drop")
    members, num_members = rows_where(present, room.members)
    slot = jnp.cumsum(present, dtype=jnp.int32) - 1
    a, b = (jnp.where(real, slot[k], 0) for k in (i, j))
    rows = _Rows(a, b, rows.offset[picked], rows.bound[picked], real)
    needed = jnp.stack([pairs.count, num_near, num_chosen, num_members])
    return _Selection(members, rows, members // size, needed)


class _Work(NamedTuple):
    """What the impacts of a window did; the arrays have one row a slot."""

    slots: _Slots
    dissipated: Array  # half of it for each of two spheres
    impacts: Array
    regularised: Array
    moved: Array  # square of the distance from where it is listed, at most
    fastest: Array  # square of the speed, at most
    pending: Array
    num_rounds: Array
    gains: Float[Array, "changes rows"]  # of energy, see `ImpactTangents`; if none, no rows


def _impacts(
    slots: _Slots,
    listed,
    chosen: _Selection,
    scene: Scene,
    duration,
    shortest,
    along: ImpactTangents | None,
) -> _Work:
    """All impacts of a window, round by round.

    A round executes every impact that is the first of both its spheres and cannot be forestalled:
    neither sphere may be disturbed before. The earliest of all is always one of them.
    """
    rows = chosen.rows
    a, b = rows.a, rows.b
    num_rows, num_slots = len(a), len(slots.v)
    index, own = jnp.arange(num_rows, dtype=jnp.int32), jnp.arange(num_slots, dtype=jnp.int32)
    shortest = shortest[jnp.minimum(chosen.replica, len(shortest) - 1)]

    def one_round(work: _Work) -> _Work:
        slots = work.slots
        r, w, _, times, first, until = _first_impacts(slots, rows, duration)
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
        return _Work(
            slots=_Slots(slots.x - kick * s[:, None], v, jnp.where(hit, s, slots.last)),
            dissipated=work.dissipated + jnp.where(hit, lost[row], 0.0),
            impacts=work.impacts + hit,
            regularised=work.regularised + (hit & soon[row]),
            moved=jnp.maximum(work.moved, away),
            fastest=jnp.maximum(work.fastest, jnp.sum(v * v, -1)),
            pending=jnp.any(safe),
            num_rounds=work.num_rounds + 1,
            gains=gains,
        )

    def going(work: _Work):
        return work.pending & (work.num_rounds < MAX_ROUNDS)

    count, zeros = jnp.zeros(num_slots, jnp.int32), jnp.zeros(num_slots, slots.x.dtype)
    size = (0, 0) if along is None else (len(along.log_temperature) + 1, num_rows)
    gains = jnp.zeros(size, zeros.dtype)
    work = _Work(slots, zeros, count, count, zeros, zeros, jnp.array(True), jnp.int32(0), gains)
    return jax.lax.while_loop(going, one_round, work)


class Progress(NamedTuple):
    state: State
    widen: Array  # the fastest sphere becomes faster than thought by this factor
    stale: Array  # the neighbour list must be built anew
    status: Array
    needed: Array  # the most rows of each of Room
    num_windows: Array
    num_failed: Array
    num_rounds: Array


def _fastest(v, replicas):
    return jnp.sqrt(jnp.max(jnp.sum(v * v, -1).reshape(replicas, -1), axis=-1))


def _temperature(v, replicas):
    boxes = v.reshape(replicas, -1, v.shape[-1])
    return jnp.mean((boxes - jnp.mean(boxes, axis=1, keepdims=True)) ** 2, axis=(1, 2))


def cooling_trend(
    law: ReducedLaw, temperature: Float[Array, "replicas"], dimension: int
) -> Float[Array, "replicas"]:
    """How the cooling rate of a Maxwellian depends on T, in some unit."""

    def rate(speed):
        return kinetics.averages(law, speed, dimension)[0, 0] * speed

    return jax.vmap(rate)(jnp.sqrt(temperature))


@partial(jax.jit, static_argnames=("plan", "max_windows"))
def advance(
    state: State,
    listed: Float[Array, "n d"],
    pairs: Pairs,
    scene: Scene,
    end: ArrayLike,
    plan: Plan,
    max_windows: int = 1_000_000,
) -> Progress:
    """Windows until `end`, or until the pair list is used up, or something goes wrong.

    Args:
        state: where to start.
        listed: the places for which the list was made; it holds while no sphere is farther than
            half the skin from there.
        pairs: the list.
        scene, plan: the gas, and what is fixed.
        end: time at which to stop.
        max_windows: after which to stop, for tests.
    """
    replicas, n = plan.replicas, len(state.position)
    target = max(0.5 * plan.share * n, LEAST_IMPACTS)

    def carried(
        along: ImpactTangents, velocity, chosen: _Selection, work: _Work, lost, impacts, duration
    ) -> ImpactTangents:
        """The tangents after a window."""
        d = velocity.shape[1]
        temperature = _temperature(velocity, replicas)
        energy = 0.5 * d * n / replicas * temperature
        replica = chosen.replica[chosen.rows.a]
        gains = jnp.zeros((len(work.gains), replicas), energy.dtype)
        rates = tangents.remembered(
            along.rates,
            lost=lost,
            met=2 * replicas / n * impacts,
            energy=energy,
            temperature=temperature,
            trend=cooling_trend(scene.law, temperature, d),
            duration=duration,
            collision_frequency=scene.collision_frequency,
        )
        gains = gains.at[:, replica].add(work.gains, mode="drop")
        return along.after(gains, energy + 0.5 * lost, duration, rates)

    def window(now: Progress) -> Progress:
        state = now.state
        x, v = state.position, state.velocity
        left = end - state.time
        num_left = jnp.maximum(jnp.ceil(left / state.window * (1 - 1e-9)), 1.0)
        duration = left / num_left
        bound = SPEED_MARGIN * now.widen * _fastest(v, replicas)
        heat = jnp.maximum(_temperature(v, replicas), jnp.finfo(v.dtype).tiny)
        shortest = scene.contact_time / (scene.collision_frequency * jnp.sqrt(heat))
        chosen = _select(x, v, pairs, duration, bound, plan)

        def of_members(values):
            return values.at[chosen.members].get(mode="fill", fill_value=0.0)

        slots = _Slots(of_members(x), of_members(v), -of_members(state.age))
        work = _impacts(
            slots, of_members(listed), chosen, scene, duration, shortest, state.tangents
        )
        slots = work.slots

        def by_replica(values):  # an empty slot is of no replica
            return jnp.zeros(replicas, values.dtype).at[chosen.replica].add(values, mode="drop")

        impacts, lost = by_replica(work.impacts) // 2, by_replica(work.dissipated)
        ratio = jnp.clip(target / jnp.maximum(jnp.sum(impacts), 1), 0.5, 1.5)
        most = bound[jnp.minimum(chosen.replica, replicas - 1)]
        too_fast = jnp.any(work.fastest > most**2)

        def to_members(values, new):
            return values.at[chosen.members].set(new, mode="drop")

        new = state._replace(
            time=jnp.where(num_left > 1, state.time + duration, end),
            position=to_members(x + v * duration, slots.x + slots.v * duration),
            velocity=to_members(v, slots.v),
            age=to_members(state.age + duration, duration - slots.last),
            dissipated=state.dissipated + lost,
            impacts=state.impacts + impacts,
            regularised=state.regularised + by_replica(work.regularised) // 2,
            # The last, short window before an end tells nothing.
            window=jnp.where(duration > 0.5 * state.window, duration * ratio, state.window),
        )
        if state.tangents is not None:
            along = carried(state.tangents, new.velocity, chosen, work, lost, impacts, duration)
            new = new._replace(tangents=along)
        away = jnp.max(jnp.sum((new.position - listed) ** 2, -1))
        outrun = jnp.maximum(away, jnp.max(work.moved)) > (0.5 * state.skin) ** 2
        full = chosen.needed > jnp.array(plan.room)
        no_room = status.flag(status.LIST_FULL, full[0])
        no_room |= status.flag(status.CONTACTS_FULL, jnp.any(full[1:]))
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        trouble = status.flag(status.SKIN_OUTRUN, outrun)
        trouble |= status.flag(status.STALLED, work.num_rounds >= MAX_ROUNDS)
        trouble = jnp.where(finite, trouble, status.NOT_FINITE.bit)
        trouble = jnp.where(no_room > 0, no_room, trouble)  # a window without room is no window
        done = (trouble == status.OK) & ~too_fast
        again = too_fast & finite & (no_room == 0)
        state = jax.tree.map(lambda new, old: jnp.where(done, new, old), new, state)
        ahead = state.position + state.velocity * jnp.minimum(state.window, end - state.time)
        ahead = jnp.max(jnp.sum((ahead - listed) ** 2, -1))
        return Progress(
            state=state,
            widen=jnp.where(again, 1.3 * now.widen, 1.0),
            stale=done & (ahead > (0.5 * state.skin) ** 2),
            status=jnp.where(again, status.OK, trouble).astype(jnp.int32),
            needed=jnp.maximum(now.needed, chosen.needed),
            num_windows=now.num_windows + 1,
            num_failed=now.num_failed + ~done,
            num_rounds=now.num_rounds + work.num_rounds,
        )

    def unfinished(now: Progress):
        going = (now.state.time < end) & ~now.stale & (now.status == status.OK)
        return going & (now.num_windows < max_windows)

    zero = jnp.zeros((), jnp.int32)
    first = Progress(
        state=state,
        widen=jnp.ones((), state.position.dtype),
        stale=jnp.zeros((), bool),
        status=zero,
        needed=jnp.zeros(len(plan.room), jnp.int32),
        num_windows=zero,
        num_failed=zero,
        num_rounds=zero,
    )
    return jax.lax.while_loop(unfinished, window, first)


def stretch(
    state: State, scene: Scene, end: ArrayLike, plan: Plan, neighbours_by: str = "vesin"
) -> Progress:
    """A fresh list of pairs, windows until it is used up, and what can be mended of a failure.

    The list is made for the places that free flight leads to at the middle of its life, which
    doubles that. An outrun skin ends it; if it was fresh, the window is shortened.
    """
    began, listed, until = _prepared(state, scene.side, end, plan)
    pairs = neighbours.find_pairs(
        listed,
        scene.side,
        1 + began.skin,
        replicas=plan.replicas,
        room=plan.room.pairs,
        by=neighbours_by,
    )
    now = advance(began, listed, pairs, scene, until, plan)
    return now._replace(**_mended(now, began))


@partial(jax.jit, static_argnames="plan")
def _prepared(state: State, side, end, plan: Plan):
    fastest = jnp.max(_fastest(state.velocity, plan.replicas))
    life = 0.95 * state.skin / jnp.maximum(fastest, jnp.finfo(fastest.dtype).tiny)
    left = end - state.time
    flown = 0.5 * jnp.minimum(life, left) * state.velocity
    listed = neighbours.wrap(side, state.position + flown)
    image = jnp.round((state.position + flown - listed) / side).astype(jnp.int32)
    began = state._replace(position=listed - flown, image=state.image + image)
    return began, listed, jnp.where(life < left, state.time + life, end)


def _mended(now: Progress, began: State) -> dict[str, Any]:
    state = now.state
    fresh = state.time == began.time  # else a new list is all that an outrun skin needs
    shorten = status.has(now.status, status.SKIN_OUTRUN) & fresh
    beyond = status.LIST_FULL.bit | status.CONTACTS_FULL.bit
    beyond |= status.NOT_FINITE.bit | status.STALLED.bit
    return {
        "state": state._replace(window=jnp.where(shorten, 0.5 * state.window, state.window)),
        "status": now.status & beyond,
    }
