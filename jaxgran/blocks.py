"""Soft spheres in blocks of time steps: who may touch, the steps of those, free flight of the rest.

Units here: diameter, mass and first temperature are 1.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran import neighbours, status
from jaxgran.contact import contact_force, midpoint_rate
from jaxgran.neighbours import Pairs

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


def rewrapped(state: State, side: ArrayLike) -> State:
    """The same state with every position moved into the box; the list must then be built anew."""
    inside = neighbours.wrap(side, state.position)
    image = state.image + jnp.round((state.position - inside) / side).astype(jnp.int32)
    return state._replace(position=inside, image=image)


class Room(NamedTuple):
    """How many rows the arrays of a compiled run have."""

    pairs: int
    near: int
    contacts: int
    members: int

    def grown(self, needed: Sequence[int]) -> "Room":
        """With more rows than needed where there are fewer."""
        return Room(
            *(r if n <= r else int(1.3 * n) + 32 for r, n in zip(self, needed, strict=True))
        )


class Plan(NamedTuple):
    """What is fixed when a run is compiled."""

    replicas: int
    steps_per_contact: int
    steps_per_block: int
    clipped: bool
    room: Room


class _Selection(NamedTuple):
    """The pairs that may touch in a block, and their particles."""

    members: Int[Array, "members"]  # particle of a slot; n where the slot is empty
    a: Int[Array, "contacts"]  # slots
    b: Int[Array, "contacts"]
    offset: Float[Array, "contacts d"]
    replica: Int[Array, "contacts"]
    expected: Bool[Array, "contacts"]  # both partners' neighbours are looked at too
    needed: Int[Array, "kinds"]  # how many rows of each of Room there would have to be


def rows_where(mask: Array, size: int) -> tuple[Array, Array]:
    """Indices where a mask holds, filled up with its length, and how many there are."""
    ranks = jnp.cumsum(mask, dtype=jnp.int32)
    places = jnp.where(mask, ranks - 1, size)
    indices = jnp.arange(mask.size, dtype=jnp.int32)
    rows = jnp.full(size, mask.size, jnp.int32).at[places].set(indices, mode="drop")
    return rows, ranks[-1]


def _select(state, pairs: Pairs, duration, margin, extra, replicas: int, room: Room):
    x, v = state.position, state.velocity
    n = len(x)

    def relative(i, j, offset):
        r, u = x[i] - x[j] - offset, v[i] - v[j]
        return jnp.sum(r * r, -1), jnp.sum(r * u, -1), jnp.sum(u * u, -1)

    apart = x[pairs.i] - x[pairs.j] - pairs.offset
    near = jnp.sum(apart * apart, -1) < (1 + margin) ** 2
    near &= jnp.arange(near.size) < pairs.count
    rows, num_near = rows_where(near, room.near)
    real = jnp.arange(room.near) < num_near
    i, j, offset = pairs.i[rows], pairs.j[rows], pairs.offset[rows]

    # Who would touch in free flight, who is near to those, and whoever is near to these.
    distance2, approach, speed2 = relative(i, j, offset)
    closest = jnp.clip(-approach / jnp.where(speed2 > 0, speed2, 1.0), 0.0, duration)
    touch = real & (distance2 + (2 * approach + speed2 * closest) * closest < 1.0)

    def spread(active, mask):
        ends = jnp.where(mask[None], jnp.stack([i, j]), n)
        return active.at[ends].set(True, mode="drop")

    active = spread(extra, touch)
    active = spread(active, real & (active[i] | active[j]))
    chosen = real & (active[i] | active[j])
    present = spread(jnp.zeros(n, bool), chosen)
    rows, num_contacts = rows_where(chosen, room.contacts)
    real = jnp.arange(room.contacts) < num_contacts
    rows = jnp.where(real, rows, 0)
    i, j, offset = i[rows], j[rows], offset[rows]
    members, num_members = rows_where(present, room.members)
    slot = jnp.cumsum(present, dtype=jnp.int32) - 1
    return _Selection(
        members=members,
        a=jnp.where(real, slot[i], 0),
        b=jnp.where(real, slot[j], 0),
        offset=jnp.where(real[:, None], offset, 2.0),  # an empty row is a pair too far apart
        replica=i // (n // replicas),
        expected=active[i] & active[j],
        needed=jnp.stack([pairs.count, num_near, num_contacts, num_members]),
    )


class _Work(NamedTuple):
    """What the contacts of a block did, one row a pair."""

    dissipated: Array
    exchanged: Array  # work done against and by the elastic force
    begun: Array
    touching: Array


def _contacts(x, v, scene: Scene, chosen: _Selection, duration, num_steps, clipped):
    """Positions and velocities of the members after `num_steps` drift-kick-drift steps."""
    rho, dt = 0.5 * scene.alpha, duration / num_steps
    a, b, offset = chosen.a, chosen.b, chosen.offset

    def overlap(x):
        r = x[a] - x[b] - offset
        distance2 = jnp.sum(r * r, -1)
        touching = distance2 < 1
        distance = jnp.sqrt(jnp.where(touching, distance2, 1.0))
        return 1 - distance, r / distance[:, None], touching

    def step(carry, _):
        x, v, work = carry
        xi, normal, touching = overlap(x)
        xi_dot = -jnp.sum((v[a] - v[b]) * normal, -1)
        rate = midpoint_rate(xi, xi_dot, scene.alpha, scene.dissipative_constant, dt)
        force = contact_force(xi, rate, rho, scene.dissipative_constant, clipped=clipped)
        elastic = contact_force(xi, 0.0, rho, 0.0)
        kick = (dt * force)[:, None] * normal
        v = v.at[a].add(kick).at[b].add(-kick)
        # The midpoint sum of sqrt(xi) xi_dot^2 errs to the other side of the trapezoidal one.
        mean = xi_dot - dt * force
        viscous = contact_force(xi, 1.0, rho, scene.dissipative_constant) - elastic
        lost = (force - elastic) * mean + 0.5 * viscous * (dt * force) ** 2
        work = _Work(
            dissipated=work.dissipated + dt * lost,
            exchanged=work.exchanged + dt * elastic * jnp.abs(mean),
            begun=work.begun + (touching & ~work.touching),
            touching=touching,
        )
        return (x + dt * v, v, work), None

    zeros = jnp.zeros(len(a), x.dtype)
    work = _Work(zeros, zeros, jnp.zeros(len(a), jnp.int32), overlap(x)[2])
    begun_before = work.touching
    (x, v, work), _ = jax.lax.scan(step, (x + 0.5 * dt * v, v, work), length=num_steps)
    x = x - 0.5 * dt * v
    touched = (work.begun > 0) | begun_before
    xi, _, touching = overlap(x)
    work = work._replace(begun=work.begun + (touching & ~work.touching))  # after the last kick
    stored = 0.4 * rho * jnp.where(touching, xi, 0.0) ** 2.5
    return x, v, work, stored, touched


def _elastic_energy(
    x: Array, scene: Scene, pairs: Pairs, replicas: int
) -> Float[Array, "replicas"]:
    """``(2/5) rho xi^(5/2)`` of all contacts, by replica."""
    r = x[pairs.i] - x[pairs.j] - pairs.offset
    distance2 = jnp.sum(r * r, -1)
    touching = (distance2 < 1) & (jnp.arange(len(r)) < pairs.count)
    xi = 1 - jnp.sqrt(jnp.where(touching, distance2, 1.0))
    replica = pairs.i // (len(x) // replicas)
    return jnp.zeros(replicas, x.dtype).at[replica].add(0.2 * scene.alpha * xi**2.5)


class Progress(NamedTuple):
    state: State
    extra: Array  # particles found to take part only when the block had been stepped
    widen: Array
    stale: Array  # the neighbour list must be built anew
    status: Array
    needed: Array  # the most rows of each of Room
    num_blocks: Array
    num_failed: Array


@partial(jax.jit, static_argnames=("plan", "max_blocks"))
def advance(
    state: State,
    pairs: Pairs,
    scene: Scene,
    end: ArrayLike,
    plan: Plan,
    max_blocks: int = 1_000_000,
) -> Progress:
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
        chosen = _select(state, pairs, duration, 2 * reach, now.extra, replicas, plan.room)
        before = x.at[chosen.members].get(mode="fill", fill_value=0.0)
        v_before = v.at[chosen.members].get(mode="fill", fill_value=0.0)
        after, v_after, work, stored, touched = _contacts(
            before, v_before, scene, chosen, duration, plan.steps_per_block, plan.clipped
        )

        def by_replica(values):
            zeros = jnp.zeros(replicas, values.dtype)
            return zeros.at[chosen.replica].add(values)

        new = state._replace(
            time=jnp.where(num_left > 1, state.time + duration, end),
            position=(x + v * duration).at[chosen.members].set(after, mode="drop"),
            velocity=v.at[chosen.members].set(v_after, mode="drop"),
            dissipated=state.dissipated + by_replica(work.dissipated),
            contacts=state.contacts + by_replica(work.begun),
            elastic=by_replica(stored),
        )

        # A sphere outside the chosen ones was hit, or one went farther than was looked.
        surprise = touched & ~chosen.expected
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
        full = chosen.needed > jnp.array(plan.room)
        no_room = status.flag(status.LIST_FULL, full[0])
        no_room |= status.flag(status.CONTACTS_FULL, jnp.any(full[1:]))
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
            num_failed=now.num_failed + ~done,
        )

    def unfinished(now: Progress):
        going = (now.state.time < end) & ~now.stale & (now.status == status.OK)
        return going & (now.num_blocks < max_blocks)

    zero = jnp.zeros((), jnp.int32)
    first = Progress(
        state=state._replace(elastic=_elastic_energy(state.position, scene, pairs, replicas)),
        extra=jnp.zeros(len(state.position), bool),
        widen=jnp.ones((), state.position.dtype),
        stale=jnp.zeros((), bool),
        status=zero,
        needed=jnp.zeros(len(plan.room), jnp.int32),
        num_blocks=zero,
        num_failed=zero,
    )
    return jax.lax.while_loop(unfinished, block, first)


def stretch(
    state: State, scene: Scene, end: ArrayLike, plan: Plan, neighbours_by: str = "vesin"
) -> Progress:
    """A fresh list of pairs, blocks until it is used up, and what can be mended of a failure.

    A step too large is halved and an outrun skin lengthened; the state is then the last good one
    and the status ok. A status that is not ok is beyond this: rows are missing, or a number is
    not finite, or a step cannot become shorter.
    """
    began = rewrapped(state, scene.side)
    pairs = neighbours.find_pairs(
        began.position,
        scene.side,
        1 + began.skin,
        replicas=plan.replicas,
        room=plan.room.pairs,
        by=neighbours_by,
    )
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


def longest_skin(side: ArrayLike) -> Float[Array, ""]:
    """The longest skin, in diameters, in whose reach a sphere meets no sphere and its image."""
    return 0.5 * jnp.asarray(side) * (1 - 1e-6) - 1
