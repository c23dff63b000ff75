"""Soft spheres in blocks of time steps: those that may touch are stepped, the rest flies freely.

Units here: diameter, mass and first temperature are 1.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxgran import encounters, neighbours, status, tangents
from jaxgran.encounters import Encounters, Work
from jaxgran.neighbours import Found, Pairs
from jaxgran.room import Room, longest_skin
from jaxgran.tangents import Tangents

MAX_REFINE = 64.0
"""How much shorter than asked a step may become before the run gives up."""

EXCHANGE_TOLERANCE = 0.1
"""Energy that a block may gain or lose by its steps, over the work done in its contacts."""

START_TOLERANCE = 1e-3
"""And over all energy: a contact that has begun since the last kick holds what was not yet paid."""


class Scene(NamedTuple):
    """The gas in units of its diameter, mass and first temperature."""

    side: Array  # of the box
    alpha: Array
    dissipative_constant: Array
    contact_duration: Array  # mean, elastic, at T = 1
    collision_frequency: Array  # at T = 1


class State(NamedTuple):
    """All particles of all replicas, replica after replica (n = replicas * N)."""

    time: Float[Array, ""]
    position: Float[Array, "n d"]  # since the last list build, not wrapped
    velocity: Float[Array, "n d"]
    image: Int[Array, "n d"]  # whole box sides to add
    origin: Float[Array, "n d"]  # at t = 0
    first_velocity: Float[Array, "n d"]
    elastic: Float[Array, "replicas"]  # energy in contacts
    dissipated: Float[Array, "replicas"]
    contacts: Int[Array, "replicas"]  # begun, each pair once
    skin: Float[Array, ""]  # reach of the neighbour list beyond contact
    refine: Float[Array, ""]  # steps are shorter than asked by this factor
    tangents: Tangents | None = None  # of position and velocity, where they are followed


def at_start(position, velocity, scene: Scene, skin: ArrayLike, replicas: int) -> State:
    """Particles at t = 0. Their elastic energy is counted by the first `advance`."""
    zeros = jnp.zeros(replicas, position.dtype)
    return State(
        time=jnp.zeros((), position.dtype),
        position=neighbours.wrap(scene.side, position),
        velocity=velocity,
        image=jnp.zeros(position.shape, jnp.int32),
        origin=neighbours.wrap(scene.side, position),
        first_velocity=velocity,
        elastic=zeros,
        dissipated=zeros,
        contacts=jnp.zeros(replicas, jnp.result_type(int)),
        skin=jnp.asarray(skin, position.dtype),
        refine=jnp.ones((), position.dtype),
    )


@jax.jit
def rewrapped(state: State, side: ArrayLike) -> State:
    """The same state with every position moved into the box; the list must then be built anew."""
    inside = neighbours.wrap(side, state.position)
    image = state.image + jnp.round((state.position - inside) / side).astype(jnp.int32)
    return state._replace(position=inside, image=image)


class Plan(NamedTuple):
    """What is fixed when a run is compiled."""

    replicas: int
    steps_per_contact: int
    steps_per_block: int
    clipped: bool
    room: Room
    melting: Room


class Progress(NamedTuple):
    state: State
    extra: Array  # particles found to take part only when the block had been stepped
    widen: Array
    stale: Array  # the neighbour list must be built anew
    status: Array
    needed: Array  # the most rows of each of Room
    num_blocks: Array


@partial(jax.jit, static_argnames="plan")
def advance(state: State, pairs: Pairs, scene: Scene, end: ArrayLike, plan: Plan) -> Progress:
    """Step until `end`, or until the pair list is used up, or something goes wrong.

    The gas moves in blocks of `steps_per_block` steps. In a block only particles that may touch are
    stepped; all others fly freely, which is exact.
    """
    reference, replicas = state.position, plan.replicas

    def kinetic(v):
        return 0.5 * jnp.sum(v.reshape(replicas, -1) ** 2, axis=-1)

    def thermal(v):
        boxes = v.reshape(replicas, -1, v.shape[-1])
        centred = boxes - jnp.mean(boxes, axis=1, keepdims=True)
        return jnp.mean(centred**2, axis=(1, 2))

    def carried(along: Tangents, new: State, chosen, work: Work, duration, by_replica) -> Tangents:
        """The tangents after a block, projected where it is time to."""
        partners = chosen.members[jnp.stack([chosen.a, chosen.b], 1)]
        ends = jnp.where(work.touching[:, None], partners, len(new.position))
        temperature = thermal(new.velocity)
        along = along._replace(
            free=jnp.ones_like(along.free).at[ends].set(False, mode="drop"),
            rates=tangents.remembered(
                along.rates,
                lost=by_replica(work.dissipated),
                met=2 * replicas / len(new.position) * by_replica(work.begun),
                energy=kinetic(new.velocity) + new.elastic,
                temperature=temperature,
                trend=along.trend(temperature),
                duration=duration,
                collision_frequency=scene.collision_frequency,
            ),
        )
        passed = (new.time - along.since) * jnp.sqrt(jnp.mean(temperature))
        due = passed * scene.collision_frequency >= along.interval
        return tangents.project(along, new.velocity, new.time, due)

    def block(now: Progress) -> Progress:
        state = now.state
        x, v = state.position, state.velocity
        # With the energy in contacts, or a step would lengthen while all of it is stored there.
        hottest = jnp.max(thermal(v) + 2 * replicas / x.size * state.elastic)
        longest_step = (
            scene.contact_duration * hottest**-0.1 / (plan.steps_per_contact * state.refine)
        )
        longest = plan.steps_per_block * longest_step
        left = end - state.time
        num_left = jnp.maximum(jnp.ceil(left / longest * (1 - 1e-9)), 1.0)
        duration = left / num_left
        fastest = jnp.sqrt(jnp.max(jnp.sum(v * v, -1)))
        reach = 1.5 * fastest * duration * now.widen
        chosen = encounters.select(
            x, v, pairs, duration, 2 * reach, now.extra, replicas, plan.room[2:]
        )
        before = x.at[chosen.members].get(mode="fill", fill_value=0.0)
        v_before = v.at[chosen.members].get(mode="fill", fill_value=0.0)
        follow = partial(
            encounters.follow,
            chosen=chosen,
            duration=duration,
            num_steps=plan.steps_per_block,
            clipped=plan.clipped,
        )
        after, v_after, work, along = _followed(follow, before, v_before, scene, chosen, state)

        def by_replica(values):
            zeros = jnp.zeros(replicas, values.dtype)
            return zeros.at[chosen.replica].add(values)

        new = state._replace(
            time=jnp.where(num_left > 1, state.time + duration, end),
            position=(x + v * duration).at[chosen.members].set(after, mode="drop"),
            velocity=v.at[chosen.members].set(v_after, mode="drop"),
            dissipated=state.dissipated + by_replica(work.dissipated),
            contacts=state.contacts + by_replica(work.begun),
            elastic=by_replica(work.stored),
        )
        if along is not None:
            new = new._replace(tangents=carried(along, new, chosen, work, duration, by_replica))

        # A sphere outside the chosen ones was hit, or one went farther than was looked.
        surprise = work.touched & ~chosen.expected
        hit = jnp.where(
            surprise[:, None], chosen.members[jnp.stack([chosen.a, chosen.b], 1)], len(x)
        )
        extra = now.extra.at[hit].set(True, mode="drop")
        too_far = jnp.max(jnp.sum((after - before) ** 2, -1)) > reach**2
        again = jnp.any(surprise) | too_far

        moved = jnp.sqrt(jnp.max(jnp.sum((new.position - reference) ** 2, -1)))
        gain = kinetic(new.velocity) - kinetic(v) + new.elastic - state.elastic
        gain = gain + by_replica(work.dissipated)
        worked, held = by_replica(work.exchanged), kinetic(v) + state.elastic
        wrong = jnp.any(jnp.abs(gain) > EXCHANGE_TOLERANCE * worked + START_TOLERANCE * held)
        no_room = plan.room.outgrown_by(chosen.needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        outrun = status.flag(status.SKIN_OUTRUN, moved > 0.5 * state.skin)
        trouble = jnp.where(finite, outrun, status.NOT_FINITE.bit)
        trouble |= status.flag(status.STEP_TOO_LARGE, wrong & finite)
        trouble = jnp.where(no_room > 0, no_room, trouble)  # a block without room is no block
        done = (trouble == status.OK) & ~again
        state = jax.tree.map(lambda new, old: jnp.where(done, new, old), new, state)
        return Progress(
            state=state,
            extra=jnp.where(done, False, extra),
            widen=jnp.where(done, 1.0, jnp.where(too_far, 2 * now.widen, now.widen)),
            stale=done & (moved + 2 * fastest * duration > 0.5 * state.skin),
            status=jnp.where(again & (trouble == status.OK), status.OK, trouble),
            needed=jnp.maximum(now.needed, chosen.needed),
            num_blocks=now.num_blocks + 1,
        )

    def unfinished(now: Progress):
        return (now.state.time < end) & ~now.stale & (now.status == status.OK)

    zero = jnp.zeros((), jnp.int32)
    needed = jnp.stack([pairs.count, pairs.ahead, zero, zero, zero])
    xi, _, touching = encounters.overlap(state.position, pairs.i, pairs.j, pairs.offset)
    touching &= jnp.arange(len(xi)) < pairs.count
    stored = encounters.elastic_energy(jnp.where(touching, xi, 0.0), scene.alpha)
    replica = pairs.i // (len(state.position) // replicas)
    first = Progress(
        state=state._replace(elastic=jnp.zeros_like(state.elastic).at[replica].add(stored)),
        extra=jnp.zeros(len(state.position), bool),
        widen=jnp.ones((), state.position.dtype),
        stale=jnp.zeros((), bool),
        status=plan.room.outgrown_by(needed),
        needed=needed,
        num_blocks=zero,
    )
    return jax.lax.while_loop(unfinished, block, first)


def _followed(follow, x, v, scene: Scene, chosen: Encounters, state: State):
    """The members after the block's steps, and the tangents of all particles with them."""
    along = state.tangents
    alpha, constant = scene.alpha, scene.dissipative_constant
    if along is None or len(along.alpha) == 0:
        return *follow(x, v, alpha, constant), along
    one = jnp.ones(len(chosen.a), x.dtype)
    at = x, v, alpha * one, constant * one
    rows = jax.vmap(lambda rest: rest.at[chosen.members].get(mode="fill", fill_value=0.0))
    material = (tangent[:, chosen.replica] for tangent in along.material(alpha, constant))

    def push(*tangent):
        def followed(*at):
            x, v, work = follow(*at)
            return (x, v), work

        return jax.jvp(followed, at, tangent, has_aux=True)

    (x, v), (dx, dv), work = jax.vmap(push, out_axes=(None, 0, None))(
        rows(along.position), rows(along.velocity), *material
    )
    duration = follow.keywords["duration"]
    put = jax.vmap(lambda rest, new: rest.at[chosen.members].set(new, mode="drop"))
    along = along._replace(
        position=put(along.position + duration * along.velocity, dx),
        velocity=put(along.velocity, dv),
    )
    return x, v, work, along


def stretch(state: State, scene: Scene, end: ArrayLike, plan: Plan, by: str = "sweep") -> Progress:
    """A fresh list of pairs, blocks until it is used up, and what can be mended of a failure.

    A step too large is halved and an outrun skin lengthened; the state is then the last good one
    and the status ok. A status that is not ok is beyond this: rows are missing, or a number is
    not finite, or a step cannot become shorter.
    """
    began = rewrapped(state, scene.side)
    reach, room = 1 + began.skin, plan.room[:2]
    found = neighbours.search(began.position, scene.side, reach, plan.replicas, room, by)
    return _used_up(began, found, scene, end, plan)


@partial(jax.jit, static_argnames="plan")
def _used_up(began: State, found: Found, scene: Scene, end: ArrayLike, plan: Plan) -> Progress:
    pairs = neighbours.with_offsets(began.position, scene.side, found)
    now = advance(began, pairs, scene, end, plan)
    return now._replace(**_mended(now, began, scene))


def _mended(now: Progress, began: State, scene: Scene) -> dict[str, Any]:
    state = now.state
    longest = longest_skin(scene.side)
    fresh = state.time == began.time  # else a new list is all that an outrun skin needs
    outrun = status.has(now.status, status.SKIN_OUTRUN) & fresh
    shorten = status.has(now.status, status.STEP_TOO_LARGE) | (outrun & (state.skin >= longest))
    hopeless = shorten & (state.refine >= MAX_REFINE)
    beyond = status.LIST_FULL.bit | status.CONTACTS_FULL.bit | status.NOT_FINITE.bit
    return {
        "state": state._replace(
            refine=jnp.where(shorten & ~hopeless, 2 * state.refine, state.refine),
            skin=jnp.where(outrun, jnp.minimum(1.5 * state.skin, longest), state.skin),
        ),
        "status": jnp.where(hopeless, now.status, now.status & beyond),
    }
