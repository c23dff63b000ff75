"""Hard spheres in windows of time, in each of which many impacts are resolved at once.

Units here: diameter, mass and first temperature are 1.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran import kinetics, neighbours, status, tangents
from jaxgran.impacts import MAX_ROUNDS, Scene, Selection, Slots, Work, resolve, select
from jaxgran.neighbours import Found, Pairs
from jaxgran.restitution import ReducedLaw
from jaxgran.room import Room
from jaxgran.tangents import ImpactTangents

LEAST_IMPACTS = 8
"""Impacts that a window should have at least, in all replicas together."""

CROWDED = 20.0
"""Listed pairs per particle from which on the skin is shortened: clusters fill a long reach."""

SHORTEST_SKIN = 0.2
"""In diameters, below which crowding is borne."""

WINDOW_GAIN = 0.3
"""Power of a window's impacts that the next one's length follows, as they scatter."""

SPEED_MARGIN = 1.15
"""How much faster than the fastest sphere one may become within a window."""


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
    melting: Room


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
        # Short at first: in random places many spheres are near contact.
        window=jnp.asarray(plan.share / (8 * scene.collision_frequency), dtype),
        skin=jnp.asarray(skin, dtype),
    )


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
        along: ImpactTangents, velocity, chosen: Selection, work: Work, lost, impacts, duration
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
        chosen = select(x, v, pairs, duration, bound, plan.room)

        def of_members(values):
            return values.at[chosen.members].get(mode="fill", fill_value=0.0)

        slots = Slots(of_members(x), of_members(v), -of_members(state.age))
        work = resolve(slots, of_members(listed), chosen, scene, duration, shortest, state.tangents)
        slots = work.slots

        def by_replica(values):  # an empty slot is of no replica
            return jnp.zeros(replicas, values.dtype).at[chosen.replica].add(values, mode="drop")

        impacts, lost = by_replica(work.impacts) // 2, by_replica(work.dissipated)
        ratio = (target / jnp.maximum(jnp.sum(impacts), 1)) ** WINDOW_GAIN
        ratio = jnp.clip(ratio, 0.5, 1.5)
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
        no_room = plan.room.outgrown_by(chosen.needed)
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
    needed = jnp.stack([pairs.count, pairs.ahead, zero, zero, zero])
    first = Progress(
        state=state,
        widen=jnp.ones((), state.position.dtype),
        stale=jnp.zeros((), bool),
        status=plan.room.outgrown_by(needed),
        needed=needed,
        num_windows=zero,
        num_failed=zero,
        num_rounds=zero,
    )
    return jax.lax.while_loop(unfinished, window, first)


def stretch(state: State, scene: Scene, end: ArrayLike, plan: Plan, by: str = "sweep") -> Progress:
    """A fresh list of pairs, windows until it is used up, and what can be mended of a failure.

    The list is made for the places that free flight leads to at the middle of its life, which
    doubles that. An outrun skin ends it; if it was fresh, the window is shortened.
    """
    began, listed, until = _prepared(state, scene.side, end, plan)
    reach, room = 1 + began.skin, plan.room[:2]
    found = neighbours.search(listed, scene.side, reach, plan.replicas, room, by)
    return _used_up(began, listed, found, scene, until, plan)


@partial(jax.jit, static_argnames="plan")
def _used_up(began: State, listed, found: Found, scene: Scene, until, plan: Plan) -> Progress:
    pairs = neighbours.with_offsets(listed, scene.side, found)
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
    # Only after a stretch that had room, lest it depend on how much a resumed run has.
    crowded = (now.needed[0] > CROWDED * len(state.position)) & (now.status == status.OK)
    shorter = jnp.maximum(0.8 * state.skin, jnp.minimum(state.skin, SHORTEST_SKIN))
    beyond = status.LIST_FULL.bit | status.CONTACTS_FULL.bit
    beyond |= status.NOT_FINITE.bit | status.STALLED.bit
    return {
        "state": state._replace(
            window=jnp.where(shorten, 0.5 * state.window, state.window),
            skin=jnp.where(crowded, shorter, state.skin),
        ),
        "status": now.status & beyond,
    }
