"""Hard spheres in windows of time, in each of which many impacts are resolved at once."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from jaxgran.checks import status
from jaxgran.particles import neighbours, user_start
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.drag import decay
from jaxgran.particles.dynamics import (
    AbstractDynamics,
    Progress,
    first_progress,
    kept_if,
    repeat_until,
)
from jaxgran.particles.hard.candidates import Selection, select_reachable
from jaxgran.particles.hard.drive import counted, driven, first_draw, restored, shortened
from jaxgran.particles.hard.following import exchanged_after, projected_after
from jaxgran.particles.hard.impacts import MAX_ROUNDS, ImpactWork, resolve
from jaxgran.particles.hard.observation import observe
from jaxgran.particles.hard.own_state import HardProgress, HardState
from jaxgran.particles.hard.prediction import Slots
from jaxgran.particles.hard.scene import HardScene, Material
from jaxgran.particles.hard.tangents import HardTangents
from jaxgran.particles.neighbours import Pairs
from jaxgran.particles.state import State, fastest, later, temperature, time_left
from jaxgran.scene.restitution import ReducedLaw
from jaxgran.tangents.impact import ImpactTangents

LEAST_IMPACTS = 8
"""Impacts that a window should have at least, in all replicas together."""

CROWDED = 20.0
"""Listed pairs per particle from which on the skin is shortened: clusters fill a long cutoff."""

SHORTEST_SKIN = 0.2
"""In diameters; below it the skin is not shortened."""

WINDOW_EXPONENT = 0.3
"""Damping exponent of the window-length controller: the length changes by
``(wanted / found impacts)^0.3``, as their number scatters."""

SPEED_MARGIN = 1.15
"""How much faster than the fastest sphere one may become within a window."""


class HardDynamics(AbstractDynamics):
    """Hard spheres in windows of time.

    Attributes:
        scene, replicas, capacity: see `AbstractDynamics`.
        share: impacts per particle in a window.
        overlap: overlap up to which positions given by a user are those of hard spheres.
        max_windows: with one neighbour list, for tests.
        restores: kicks return the energy that impacts take, and T stays 1.
    """

    scene: HardScene
    replicas: int = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    share: float = eqx.field(static=True)
    overlap: float = eqx.field(static=True, default=1e-9)
    max_windows: int = eqx.field(static=True, default=1_000_000)
    restores: bool = eqx.field(static=True, default=False)

    def own_state(self, num_rows, dtype) -> HardState:
        # Short at first: in random places many spheres are near contact.
        rate = self.scene.collision_frequency
        if self.scene.walls is not None:
            rate = rate + 2 / jnp.min(self.scene.walls.sides - 1)
        return HardState(
            age=jnp.full(num_rows, jnp.inf, dtype),
            regularised=jnp.zeros(self.replicas, jnp.result_type(int)),
            window=jnp.asarray(self.share / (8 * rate), dtype),
        )

    def elastic(self) -> "HardDynamics":
        return dataclasses.replace(self, scene=self.scene.by_impacts(elastic=True))

    @property
    def preparing(self) -> "HardDynamics | None":
        if self.scene.prepared is None:
            return None
        return dataclasses.replace(self, scene=self.scene.by_impacts(elastic=False), restores=True)

    def with_kicks(self, state: State, key: PRNGKeyArray) -> State:
        state = first_draw(state, self.scene, self.replicas, key)
        return state._replace(own=state.own._replace(key=counted(jax.random.fold_in(key, 4))))

    @property
    def room(self) -> Array | None:
        walls = self.scene.walls
        return None if walls is None else walls.sides - 1

    @property
    def inertial(self) -> bool:
        return self.scene.walls is None and self.scene.drag is None

    def drawn(self, state: State, key: PRNGKeyArray, melted: State) -> State:
        state = first_draw(state, self.scene, self.replicas, key)
        if melted.own.spin is None:
            return state
        return state._replace(own=state.own._replace(spin=melted.own.spin))

    def seen(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        spin, drag = state.own.spin, self.scene.drag
        if drag is None:
            return velocity, spin
        left = decay(self.scene.decay_rates, state.time + state.time_rest)
        return velocity * left.velocity, None if spin is None else spin * left.kept

    def with_tangents(self, state: State, directions: ReducedLaw | Material) -> State:
        velocity = state.velocity
        if isinstance(directions, Material):
            n, d = len(velocity) // self.replicas, velocity.shape[1]
            along = HardTangents.at_start(self.scene, directions, self.replicas, n, d)
        else:
            along = ImpactTangents.at_start(directions, self.replicas, velocity.dtype)
        return state._replace(tangents=along)

    def observe(self, state: State) -> dict[str, Array]:
        return observe(state, self.scene, self.replicas)

    def check_start(self, state: State) -> Int[Array, ""]:
        x, side = state.position, self.scene.side
        closest = user_start.closest(x, side, self.replicas, self.capacity[:2], "sweep")
        tolerance = user_start.overlap_by_rounding(x, side, self.overlap)
        if self.scene.walls is not None:  # a sphere and its image beyond a wall
            image = 2 * jnp.min(jnp.minimum(x, self.scene.walls.sides[None] - x))
            closest = jnp.minimum(closest, image)
        return status.flag(status.OVERLAPPING, closest < 1 - tolerance)

    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, ArrayLike]:
        """The neighbour list is of the positions to which free flight leads at the middle of its
        life, which doubles that life."""
        return _prepared(self, state, end)

    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        zero = jnp.zeros((), jnp.int32)
        own = HardProgress(jnp.ones((), state.position.dtype), zero, zero, zero)
        first = first_progress(state, pairs, self.capacity, own)
        window = partial(self._window, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, window, first)

    def _window(self, now: Progress, listed: Array, pairs: Pairs, end: ArrayLike) -> Progress:
        """One window, accepted if no sphere became faster than the bound and nothing went wrong."""
        old, more = now.state, now.own
        left, scene = time_left(old, end), self.scene
        window = shortened(old, scene, self.replicas)
        num_left = jnp.maximum(jnp.ceil(left / window * (1 - 1e-9)), 1.0)
        duration = left / num_left
        began = driven(old, scene, self.replicas, duration, 0.0)
        bound = SPEED_MARGIN * more.widen * fastest(began.velocity, self.replicas)
        chosen = select_reachable(
            old.position, began.velocity, pairs, duration, bound, self.capacity, scene.walls
        )
        work = self._resolved(began, listed, chosen, duration)
        most = bound[jnp.minimum(chosen.replica, self.replicas - 1)]
        too_fast = jnp.any(work.fastest > most**2)
        new = self._moved(began, chosen, work, duration)
        if self.restores:
            new = restored(new, scene, self.replicas, new.dissipated - old.dissipated)
        else:
            new = driven(new, scene, self.replicas, duration, 1.0)
        new = later(new, duration, end, num_left <= 1)

        full = self.capacity.exceeded_by(chosen.needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        away = jnp.max(jnp.sum((new.position - listed) ** 2, -1))
        outrun = jnp.maximum(away, jnp.max(work.moved)) > (0.5 * old.skin) ** 2
        fault = status.flag(status.SKIN_OUTRUN, outrun)
        fault |= status.flag(status.STALLED, work.num_rounds >= MAX_ROUNDS)
        fault = jnp.where(finite, fault, status.NOT_FINITE.bit)
        fault = jnp.where(full > 0, full, fault)  # a window with too short arrays is no window
        done = (fault == status.OK) & ~too_fast
        again = too_fast & finite & (full == 0)
        state = kept_if(done, new, old)
        ahead = jnp.minimum(state.own.window, time_left(state, end))
        ahead = state.position + state.velocity * ahead
        ahead = jnp.max(jnp.sum((ahead - listed) ** 2, -1))
        enough = more.num_windows + 1 >= self.max_windows
        return Progress(
            state=state,
            stale=(done & (ahead > (0.5 * old.skin) ** 2)) | enough,
            status=jnp.where(again, status.OK, fault).astype(jnp.int32),
            needed=jnp.maximum(now.needed, chosen.needed),
            own=HardProgress(
                widen=jnp.where(again, 1.3 * more.widen, 1.0),
                num_windows=more.num_windows + 1,
                num_failed=more.num_failed + ~done,
                num_rounds=more.num_rounds + work.num_rounds,
            ),
        )

    def _resolved(
        self, state: State, listed: Array, chosen: Selection, duration: Array
    ) -> ImpactWork:
        """The impacts of a window."""

        def of_members(values):
            return values.at[chosen.members].get(mode="fill", fill_value=0.0)

        heat = temperature(state.velocity, self.replicas)
        heat = jnp.maximum(heat, jnp.finfo(heat.dtype).tiny)
        scene = self.scene
        shortest = scene.contact_time / (scene.collision_frequency * jnp.sqrt(heat))
        own = state.own
        slots = Slots(
            of_members(state.position),
            of_members(state.velocity),
            -of_members(own.age),
            None if own.spin is None else of_members(own.spin),
        )
        began, along = state.time + state.time_rest, state.tangents
        return resolve(slots, of_members(listed), chosen, scene, began, duration, shortest, along)

    def _moved(self, state: State, chosen: Selection, work: ImpactWork, duration: Array) -> State:
        """The state after a window, but for its time, and the length of the next one."""

        def by_replica(values):  # an empty slot is of no replica
            sums = jnp.zeros(self.replicas, values.dtype)
            return sums.at[chosen.replica].add(values, mode="drop")

        def to_members(values, new):
            return values.at[chosen.members].set(new, mode="drop")

        impacts, lost = by_replica(work.impacts) // 2, by_replica(work.dissipated)
        wanted = max(0.5 * self.share * len(state.position), LEAST_IMPACTS)
        found = jnp.sum(impacts)
        if work.bounces is not None:  # of one sphere, and not of two
            found = found + jnp.sum(work.bounces) / 2
        ratio = jnp.clip((wanted / jnp.maximum(found, 1)) ** WINDOW_EXPONENT, 0.5, 1.5)
        slots, own = work.slots, state.own
        regularised = own.regularised + by_replica(work.regularised) // 2
        # The last, short window before an end says nothing about the rate of impacts.
        full_length = duration > 0.5 * own.window
        new = state._replace(
            position=to_members(
                state.position + state.velocity * duration, slots.x + slots.v * duration
            ),
            velocity=to_members(state.velocity, slots.v),
            dissipated=state.dissipated + lost,
            collisions=state.collisions + impacts,
            own=HardState(
                age=to_members(own.age + duration, duration - slots.last),
                regularised=regularised,
                window=jnp.where(full_length, duration * ratio, own.window),
                spin=None if own.spin is None else to_members(own.spin, slots.spin),
                turned=None if work.turned is None else own.turned + by_replica(work.turned),
                key=own.key,
            ),
        )
        if isinstance(state.tangents, HardTangents):
            along = exchanged_after(state, self.scene, chosen, work, duration)
        elif state.tangents is not None:
            along = projected_after(new, self.scene, chosen, work, duration)
        else:
            return new
        return new._replace(tangents=along)

    def mend(self, now: Progress, began: State) -> tuple[State, Int[Array, ""]]:
        """Where a new list was outrun the window is shortened; where it is crowded, the skin."""
        state = now.state
        fresh = state.time == began.time  # else a new list is all that an outrun skin needs
        shorten = status.has(now.status, status.SKIN_OUTRUN) & fresh
        # Only where the capacity sufficed, so that this does not depend on a resumed run's.
        crowded = (now.needed[0] > CROWDED * len(state.position)) & (now.status == status.OK)
        shorter = jnp.maximum(0.8 * state.skin, jnp.minimum(state.skin, SHORTEST_SKIN))
        beyond = status.LIST_FULL.bit | status.CONTACTS_FULL.bit
        beyond |= status.NOT_FINITE.bit | status.STALLED.bit
        window = jnp.where(shorten, 0.5 * state.own.window, state.own.window)
        mended = state._replace(
            skin=jnp.where(crowded, shorter, state.skin), own=state.own._replace(window=window)
        )
        return mended, now.status & beyond


@jax.jit
def _prepared(dynamics: HardDynamics, state: State, end: ArrayLike) -> tuple[State, Array, Array]:
    side, replicas = dynamics.scene.side, dynamics.replicas
    speed = jnp.max(fastest(state.velocity, replicas))
    life = 0.95 * state.skin / jnp.maximum(speed, jnp.finfo(speed.dtype).tiny)
    left = time_left(state, end)
    flown = 0.5 * jnp.minimum(life, left) * state.velocity
    if dynamics.scene.walls is not None:
        most = dynamics.scene.walls.sides[None] - 0.5
        flown = jnp.clip(state.position + flown, 0.5, most) - state.position
    listed = neighbours.wrap(side, state.position + flown)
    image = jnp.round((state.position + flown - listed) / side).astype(jnp.int32)
    began = state._replace(position=listed - flown, image=state.image + image)
    return began, listed, jnp.where(life < left, state.time + life, end)
