"""Soft spheres in blocks of time steps: those that may touch are stepped, the rest flies freely.

Free flight is exact, and which spheres may touch is decided once a block: indices are fixed within
it, which keeps them out of the derivative.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from jaxgran.checks import status
from jaxgran.particles import spins
from jaxgran.particles.capacity import Capacity, longest_skin
from jaxgran.particles.dynamics import (
    AbstractDynamics,
    Progress,
    first_progress,
    kept_if,
    repeat_until,
)
from jaxgran.particles.neighbours import Pairs
from jaxgran.particles.soft import candidates, elements, linearised, steps, walls
from jaxgran.particles.soft.candidates import Encounters
from jaxgran.particles.soft.elements import ElementSums, Moving
from jaxgran.particles.soft.energy import energy_error
from jaxgran.particles.soft.followed import after_block, at_start
from jaxgran.particles.soft.frame import agitation, rotational_temperature
from jaxgran.particles.soft.observation import observe
from jaxgran.particles.soft.progress import SoftProgress, SoftState
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.soft.steps import ContactWork
from jaxgran.particles.state import (
    State,
    fastest,
    later,
    rewrapped,
    time_left,
)

MAX_REFINE = 4096.0
"""Largest factor by which the step may become shorter than asked before the run fails."""

DRIFT_TOLERANCE = 0.05
"""Sum of the relative energy errors of all blocks, which is an error of ln T, that is allowed."""

RECOVERY = 200
"""Good blocks after which a step that was halved is doubled again."""

REACH_MARGIN = 1.5
"""How much farther than the fastest sphere would fly a sphere may get in a block."""


class _Stepped(NamedTuple):
    """The result of one block, not yet accepted."""

    state: State
    work: ContactWork
    distance: Array  # square of the largest distance that a member moved
    sums: ElementSums | None  # energies by walls and drag
    hit_walls: Array | None  # particles that touched a wall without being expected to


class SoftDynamics(AbstractDynamics):
    """Viscoelastic spheres in blocks of equal time steps.

    Attributes:
        scene, replicas, capacity: see `AbstractDynamics`.
        steps_per_contact: steps in the mean contact duration at the current temperature.
        steps_per_block: steps in which the candidates for contact are fixed.
        projection: mean free times between thermal projections of tangents.
    """

    scene: SoftScene
    replicas: int = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    steps_per_contact: int = eqx.field(static=True)
    steps_per_block: int = eqx.field(static=True)
    projection: Float[Array, ""]

    def own_state(self, num_rows, dtype) -> SoftState:
        # The elastic energy of the start is counted by the first `advance`.
        zeros = jnp.zeros(self.replicas, dtype)
        return SoftState(zeros, jnp.ones((), dtype), jnp.zeros((), jnp.int32), zeros)

    def elastic(self) -> "SoftDynamics":
        return dataclasses.replace(self, scene=self.scene.lossless())

    def with_tangents(self, state: State, directions: tuple[Any, ...]) -> State:
        along = at_start(self.scene, state, directions, self.projection)
        return state._replace(tangents=along)

    @property
    def room(self) -> Array | None:
        walls = self.scene.walls
        return None if walls is None else walls.sides - 1

    @property
    def inertial(self) -> bool:
        return self.scene.inertial

    def seen(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        return velocity, state.own.spin

    def drawn(self, state: State, key: PRNGKeyArray, melted: State) -> State:
        surface = self.scene.surface
        if surface is None:
            return state
        spin = spins.maxwellian(key, state.velocity, self.replicas, surface.ratio / surface.inertia)
        return state._replace(own=state.own._replace(spin=spin))

    def observe(self, state: State) -> dict[str, Array]:
        return observe(state, self.scene, self.replicas)

    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, ArrayLike]:
        began = rewrapped(state, self.scene.side)
        return began, began.position, end

    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        xi, _, touching = steps.overlap(state.position, pairs.i, pairs.j, pairs.offset)
        touching &= jnp.arange(len(xi)) < pairs.count
        stored = steps.elastic_energy(jnp.where(touching, xi, 0.0), self.scene.alpha)
        replica = pairs.i // (len(state.position) // self.replicas)
        elastic = jnp.zeros_like(state.own.elastic).at[replica].add(stored)
        if self.scene.walls is not None:
            at_walls = walls.stored(self.scene.walls, state.position)
            elastic += jnp.sum(at_walls.reshape(self.replicas, -1), axis=1)
        own = SoftProgress(
            extra=jnp.zeros(len(state.position), bool),
            widen=jnp.ones((), state.position.dtype),
            num_blocks=jnp.zeros((), jnp.int32),
        )
        state = state._replace(own=state.own._replace(elastic=elastic))
        first = first_progress(state, pairs, self.capacity, own)
        block = partial(self._block, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, block, first)

    def _block(self, now: Progress, listed: Array, pairs: Pairs, end: ArrayLike) -> Progress:
        """One block, accepted if all that took part in it was expected and nothing went wrong."""
        old, more = now.state, now.own
        duration, num_left, hottest = self._duration(old, end)
        # Of all replicas: they share their blocks.
        speed = jnp.max(fastest(old.velocity, self.replicas))
        # From rest the first reach is 0, and the next one is that of the energy in contacts.
        reach = REACH_MARGIN * speed * more.widen + (more.widen - 1) * jnp.sqrt(hottest)
        reach = reach * duration
        chosen = candidates.select_encounters(
            old.position,
            old.velocity,
            pairs,
            duration,
            2 * reach,
            more.extra,
            self.replicas,
            self.capacity[2:],
            walls.near(self.scene.walls, old.position, old.velocity, duration),
        )
        stepped = self._stepped(old, chosen, duration)
        new = stepped.state
        new = later(new, duration, end, num_left <= 1)
        if old.tangents is not None:
            spin = old.own.spin
            along = after_block(new, spin, chosen, stepped.work, stepped.sums, duration, self.scene)
            new = new._replace(tangents=along)
        work = stepped.work

        # A sphere outside the chosen ones was hit, or one went farther than was looked.
        surprise = work.touched & ~chosen.expected
        partners = chosen.members[jnp.stack([chosen.a, chosen.b], 1)]
        hit = jnp.where(surprise[:, None], partners, len(old.position))
        extra = more.extra.at[hit].set(True, mode="drop")
        too_far = stepped.distance > reach**2
        again = jnp.any(surprise) | too_far
        if stepped.hit_walls is not None:
            extra = extra.at[stepped.hit_walls].set(True, mode="drop")
            again |= jnp.any(stepped.hit_walls < len(old.position))

        moved = jnp.sqrt(jnp.max(jnp.sum((new.position - listed) ** 2, -1)))
        by_replica = partial(chosen.by_replica, replicas=self.replicas)
        error, allowed = energy_error(self.scene, old, new, work, by_replica, stepped.sums)
        new = self._with_ledger(new, error)
        fault = self._fault(old, new, error, allowed, chosen, moved)
        done = (fault == status.OK) & ~again
        return Progress(
            state=kept_if(done, new, old),
            stale=done & (moved + 2 * speed * duration > 0.5 * old.skin),
            status=fault,
            needed=jnp.maximum(now.needed, chosen.needed),
            own=SoftProgress(
                extra=jnp.where(done, False, extra),
                widen=jnp.where(done, 1.0, jnp.where(too_far, 2 * more.widen, more.widen)),
                num_blocks=more.num_blocks + 1,
            ),
        )

    def _duration(self, state: State, end: ArrayLike) -> tuple[Array, Array, Array]:
        """Duration of the next block, how many as long are left until the end, and the temperature
        of the hottest replica, with the energy in its contacts."""
        # With the energy in contacts, or a step would lengthen while all of it is stored there.
        stored = 2 * self.replicas / state.position.size * state.own.elastic
        hottest = jnp.max(agitation(self.scene, state.velocity, self.replicas) + stored)
        if state.own.spin is not None:
            spins = rotational_temperature(self.scene, state.own.spin, self.replicas)
            hottest = jnp.maximum(hottest, jnp.max(spins))
        per_contact = self.steps_per_contact * state.own.refine
        longest_step = self.scene.shortest_contact * hottest**-0.1 / per_contact
        longest = self.steps_per_block * longest_step
        left = time_left(state, end)
        num_left = jnp.maximum(jnp.ceil(left / longest * (1 - 1e-9)), 1.0)
        return left / num_left, num_left, hottest

    def _stepped(self, state: State, chosen: Encounters, duration: Array) -> _Stepped:
        """The state after the block, but for its time; tangents are followed, not projected."""
        everyone = Moving(state.position, state.velocity, state.own.spin)
        before = elements.members_of(self.scene, everyone, chosen.members)
        found = linearised.follow(
            *(before, everyone, self.scene, chosen, duration, self.steps_per_block, state.tangents)
        )

        def put(values, new):
            return values.at[chosen.members].set(new, mode="drop")

        by_replica = partial(chosen.by_replica, replicas=self.replicas)
        own = state.own._replace(elastic=by_replica(found.work.stored))
        flown, dragged = elements.flown(self.scene, everyone, duration, self.scene.of_elements)
        new = state._replace(
            position=put(flown.x, found.x),
            velocity=put(flown.v, found.v),
            dissipated=state.dissipated + by_replica(found.work.dissipated),
            collisions=state.collisions + by_replica(found.work.begun),
            own=own,
            tangents=found.along,
        )
        sums = hit = None
        if found.more is not None:
            sums = ElementSums.of(found.more, chosen.members, dragged, self.replicas, len(flown.x))
            spin = None if flown.spin is None else put(flown.spin, found.spin)
            own = own._replace(elastic=own.elastic + sums.stored, spin=spin)
            new = new._replace(own=own, dissipated=new.dissipated + sums.lost)
            if chosen.sure is not None:
                hit = jnp.where(found.more.touched & ~chosen.sure, chosen.members, len(flown.x))
        moved = jnp.max(jnp.sum((found.x - before.x) ** 2, -1))
        return _Stepped(new, found.work, moved, sums, hit)

    def _with_ledger(self, new: State, error: Float[Array, "replicas"]) -> State:
        """The state with the energy error of its last block, and its step, which recovers."""
        own = new.own
        good = own.good + 1
        recovers = (good >= RECOVERY) & (own.refine > 1)
        own = own._replace(
            good=jnp.where(recovers, 0, good),
            refine=jnp.where(recovers, 0.5 * own.refine, own.refine),
            drift=own.drift + error,
        )
        return new._replace(own=own)

    def _fault(
        self,
        old: State,
        new: State,
        error: Float[Array, "replicas"],
        allowed: Float[Array, "replicas"],
        chosen: Encounters,
        moved: Array,
    ) -> Int[Array, ""]:
        """The status of a block that moved spheres by at most so much since the list was built."""
        wrong = jnp.any(jnp.abs(error) > allowed)
        drifted = jnp.any(jnp.abs(new.own.drift) > DRIFT_TOLERANCE)
        full = self.capacity.exceeded_by(chosen.needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        outrun = status.flag(status.SKIN_OUTRUN, moved > 0.5 * old.skin)
        fault = jnp.where(finite, outrun, status.NOT_FINITE.bit)
        fault |= status.flag(status.STEP_TOO_LARGE, wrong & finite)
        fault |= status.flag(status.ENERGY_DRIFT, drifted & ~wrong & finite)
        return jnp.where(full > 0, full, fault)  # a block with too short arrays is no block

    def mend(self, now: Progress, began: State) -> tuple[State, Int[Array, ""]]:
        """A step that is too large is halved, and a skin that was outrun lengthened."""
        state, longest = now.state, longest_skin(self.scene.side)
        fresh = state.time == began.time  # else a new list is all that an outrun skin needs
        outrun = status.has(now.status, status.SKIN_OUTRUN) & fresh
        shorten = status.has(now.status, status.STEP_TOO_LARGE)
        shorten |= outrun & (state.skin >= longest)
        hopeless = shorten & (state.own.refine >= MAX_REFINE)
        beyond = status.LIST_FULL.bit | status.CONTACTS_FULL.bit | status.NOT_FINITE.bit
        beyond |= status.STALLED.bit | status.ENERGY_DRIFT.bit
        halve = shorten & ~hopeless
        finer = jnp.where(halve, 2 * state.own.refine, state.own.refine)
        good = jnp.where(halve, 0, state.own.good)
        longer = jnp.where(outrun, jnp.minimum(1.5 * state.skin, longest), state.skin)
        mended = state._replace(skin=longer, own=state.own._replace(refine=finer, good=good))
        return mended, jnp.where(hopeless, now.status, now.status & beyond)
