"""Dynamics of hard spheres in windows of time.

Many impacts are executed at once in each window. A window begins and ends with half of the kicks of
a drive. Units as in `jaxgran.particles.hard.impacts`.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, DTypeLike, Float, Int, PRNGKeyArray, UInt32

from jaxgran._utils import status
from jaxgran.gradients.rule import Records
from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import time_left
from jaxgran.particles.elements import drag_decay
from jaxgran.particles.hard.candidates import ImpactCandidates, select_candidates
from jaxgran.particles.hard.drive import (
    heat_of_kicks,
    initial_kick_key,
    kick_at_end,
    kick_at_start,
    window_of_small_kicks,
)
from jaxgran.particles.hard.records import hard_records
from jaxgran.particles.hard.window import (
    MAX_ROUNDS,
    WindowProgress,
    WindowSums,
    execute_impacts,
)
from jaxgran.particles.hard.window_length import WindowController
from jaxgran.particles.neighbours.pairs import Pairs
from jaxgran.particles.spheres import (
    FATAL,
    AbstractSphereDynamics,
    Segment,
    SphereState,
    advance_to_end,
    fastest,
    kinetic_energy,
    next_block,
    repeat_until,
)
from jaxgran.particles.start import initial_spins
from jaxgran.scene.geometry import wrap
from jaxgran.scene.reduced import ReducedScene, SphereScene

SPEED_MARGIN = 1.15
"""Bound on the speeds within a window, over the speed of the fastest sphere before it."""

BOUND_GROWTH = 1.3
"""Factor on the bound on the speeds in a window that is repeated, as a sphere exceeded it."""

LIST_LIFE = 0.95
"""Life of a neighbour list, over the time in which the fastest sphere flies through the skin."""

MAX_LISTED_PER_PARTICLE = 20
"""Listed pairs per particle above which the skin is shortened, as in dense clusters."""

SKIN_REDUCTION = 0.8
"""Factor by which the skin is shortened."""

MIN_SKIN = 0.2
"""Skin in diameters below which it is not shortened."""

ALLOWED_OVERLAP = 1e-9
"""Overlap in diameters that is allowed in a given start."""


class HardState(NamedTuple):
    """Internal state of hard spheres, see `SphereState`.

    Attributes:
        age: time since the last impact.
        regularised: impacts made elastic because they followed the last one too soon.
        window: length of the next window.
        spin: of rough spheres, transformed where there is drag; None for smooth ones.
        rotational_gain: gain of the energy of these spins since t = 0; None for smooth ones.
        key: of the random numbers of a drive, with the number of kicks made; None without a drive.
    """

    age: Float[Array, "n"]
    regularised: Int[Array, "replicas"]
    window: Float[Array, ""]
    spin: Float[Array, "n spins"] | None = None
    rotational_gain: Float[Array, "replicas"] | None = None
    key: UInt32[Array, "3"] | None = None


class HardDynamics(AbstractSphereDynamics):
    """Hard spheres in windows of time.

    Attributes:
        scene, shape, capacity, equilibration_capacity, listed_by_skin, engine, compiled_engine: see
            `AbstractSphereDynamics`.
        share: wanted impacts of a sphere in a window.
        contact_time: in mean free times; the impact of a sphere within this time of its last one is
            elastic.
        all_elastic: whether all impacts are elastic and smooth.
    """

    scene: SphereScene
    shape: tuple[int, int, int] = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    equilibration_capacity: Capacity = eqx.field(static=True)
    listed_by_skin: float = eqx.field(static=True)
    engine: str = eqx.field(static=True)
    compiled_engine: str = eqx.field(static=True)
    share: float = eqx.field(static=True)
    contact_time: Float[Array, ""]
    all_elastic: Bool[Array, ""]

    @property
    def window_lengths(self) -> WindowController:
        """The controller of the lengths of windows."""
        return WindowController(self.share, self.replicas * self.shape[1])

    def elastic(self) -> "HardDynamics":
        """Return the dynamics of smooth elastic spheres and walls, without drag or a drive.

        Zero drag and a zero law keep the structure of a run of smooth spheres, whose compiled
        program is reused.
        """
        material = self.scene.material
        walls = material.walls
        if walls is not None:
            walls = walls._replace(surface=None)
        material = material._replace(
            law=jax.tree.map(lambda x: 0 * x, material.law),
            surface=None,
            walls=walls,
            drag=jax.tree.map(lambda x: 0 * x, material.drag),
            drive=None,
        )
        scene = self.scene._replace(material=material)
        return dataclasses.replace(self, scene=scene, all_elastic=jnp.ones((), bool))

    def initial_internal(self, velocity: Float[Array, "n d"], key: PRNGKeyArray) -> HardState:
        dtype = velocity.dtype
        material = self.scene.material
        frequency = self.scene.collision_frequency
        if self.region is not None:  # impacts on walls
            frequency = frequency + 2 / jnp.min(self.region)
        spin = None
        rotational_gain = None
        kick_key = None
        if material.surface is not None:
            mean_square = (material.surface.ratio / material.surface.inertia).astype(dtype)
            spin = initial_spins(key, self.shape, mean_square)
            rotational_gain = jnp.zeros(self.replicas, dtype)
        if material.drive is not None:
            kick_key = initial_kick_key(key)
        return HardState(
            age=jnp.full(len(velocity), jnp.inf, dtype),
            regularised=jnp.zeros(self.replicas, jnp.result_type(int)),
            window=jnp.asarray(self.window_lengths.first(frequency), dtype),
            spin=spin,
            rotational_gain=rotational_gain,
            key=kick_key,
        )

    def initial_tangents(self, state: SphereState, directions: ReducedScene) -> ExchangeTangents:
        material = self.scene.material
        return ExchangeTangents.initial(directions, material, state.velocity, self.replicas)

    @jax.jit
    def prepare(self, state: SphereState, end: ArrayLike) -> tuple[SphereState, Array, Array]:
        """Prepare a neighbour list of the positions in the middle of its life.

        Free flight leads there, and the list lives twice as long as one of the current positions.
        """
        side = self.scene.side
        container = self.scene.container
        speed = jnp.max(fastest(state.velocity, self.replicas))
        life = LIST_LIFE * state.skin / jnp.maximum(speed, jnp.finfo(speed.dtype).tiny)
        time_until_end = time_left(state, end)
        flown = 0.5 * jnp.minimum(life, time_until_end) * state.velocity
        if container is not None:
            inside = jnp.clip(state.position + flown, 0.5, container[None] - 0.5)
            flown = inside - state.position
        listed = wrap(state.position + flown, side)
        image = jnp.round((state.position + flown - listed) / side).astype(jnp.int32)
        prepared = state._replace(position=listed - flown, image=state.image + image)
        return prepared, listed, jnp.where(life < time_until_end, state.time + life, end)

    def run_blocks(
        self, state: SphereState, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Segment:
        overlapping = jax.lax.cond(
            state.fresh, lambda: self._overlaps(state, pairs), lambda: jnp.zeros((), bool)
        )
        fault = state.status | status.flag(status.OVERLAPPING, overlapping)
        first = Segment(
            state=state._replace(status=fault),
            stale=jnp.zeros((), bool),
            retry=jnp.ones((), state.position.dtype),
        )
        window = partial(self._run_window, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, window, first)

    def _overlaps(self, state: SphereState, pairs: Pairs) -> Bool[Array, ""]:
        """Return whether spheres of a start overlap others or a wall by more than rounding."""
        x = state.position
        side = self.scene.side
        container = self.scene.container
        separation = x[pairs.i] - x[pairs.j] - pairs.offset
        square = jnp.sum(separation * separation, -1)
        closest = jnp.sqrt(jnp.min(jnp.where(pairs.in_use, square, 1.0), initial=1.0))
        if container is not None:  # a sphere and its image beyond a wall
            closest = jnp.minimum(closest, 2 * jnp.min(jnp.minimum(x, container[None] - x)))
        return closest < 1 - allowed_overlap(x.dtype, side)

    def _run_window(self, now: Segment, listed: Array, pairs: Pairs, end: ArrayLike) -> Segment:
        """Run one window, and accept it if no sphere exceeded the speed bound and no check failed.

        `Segment.retry` is the factor by which the bound on speeds is raised.
        """
        old = now.state
        bound_factor = now.retry
        scene = self.scene
        window = old.internal.window
        longest = jnp.minimum(window, window_of_small_kicks(old, scene))
        duration, is_last = next_block(old, longest, end)
        kicked = kick_at_start(old, scene, duration)
        bound = SPEED_MARGIN * bound_factor * fastest(kicked.velocity, self.replicas)
        candidates = select_candidates(
            kicked, scene.container, pairs, self.capacity, duration, bound
        )
        progress = execute_impacts(
            kicked, listed, candidates, scene, duration, self.contact_time, self.all_elastic
        )
        new = self._after_impacts(kicked, candidates, progress, duration)
        new = kick_at_end(new, scene, duration)
        new = advance_to_end(new, duration, end, is_last)
        next_window = self.window_lengths.after(window, duration, progress.total_impacts)
        new = new._replace(internal=new.internal._replace(window=next_window))

        fault, repeat = self._judge(new, listed, candidates, progress, bound)
        accepted = (fault == status.OK) & ~repeat
        state = jax.tree.map(partial(jnp.where, accepted), new, old)
        needed = jnp.maximum(old.needed, candidates.needed)
        return Segment(
            state=state._replace(status=fault, needed=needed),
            stale=accepted & self._will_leave_skin(state, listed, end),
            retry=jnp.where(repeat, BOUND_GROWTH * bound_factor, 1.0),
        )

    def _after_impacts(
        self,
        state: SphereState,
        candidates: ImpactCandidates,
        progress: WindowProgress,
        duration: Array,
    ) -> SphereState:
        """Return the state after the impacts of a window, with the time at its start.

        Args:
            state: at the start of the window, after the first half of the kicks.
            candidates: pairs and particles of the window.
            progress: after the last impact.
            duration: of the window.
        """

        def with_members(values: Array, of_members: Any) -> Array:
            return values.at[candidates.members].set(of_members, mode="drop")

        paths = progress.paths
        sums = progress.sums(candidates, self.replicas)
        flown = state.position + state.velocity * duration
        internal = state.internal
        more_regularised = sums.regularised.astype(internal.regularised.dtype)
        spin = None
        rotational_gain = None
        tangents = None
        if internal.spin is not None:
            spin = with_members(internal.spin, paths.spin)
            rotational_gain = internal.rotational_gain + sums.rotational_gain
        if state.tangents is not None:
            tangents = self._tangents_after(state, sums, duration)
        return state._replace(
            position=with_members(flown, paths.x + paths.v * duration),
            velocity=with_members(state.velocity, paths.v),
            dissipated=state.dissipated + sums.dissipated,
            collisions=state.collisions + sums.collisions.astype(state.collisions.dtype),
            internal=internal._replace(
                age=with_members(internal.age + duration, duration - paths.last),
                regularised=internal.regularised + more_regularised,
                spin=spin,
                rotational_gain=rotational_gain,
            ),
            tangents=tangents,
        )

    def _tangents_after(
        self, state: SphereState, sums: WindowSums, duration: Array
    ) -> ExchangeTangents:
        """Return the tangents after a window, with the heat of its kicks.

        Args:
            state: at the start of the window, after the first half of the kicks.
            sums: over the impacts of the window.
            duration: of the window.
        """
        tangents = state.tangents
        material = self.scene.material
        before = [kinetic_energy(state.velocity, self.replicas)]
        gained = [-sums.dissipated]
        if sums.rotational_gain is not None:
            spin_energy = kinetic_energy(state.internal.spin, self.replicas)
            before.append(material.surface.inertia * spin_energy)
            gained.append(sums.rotational_gain)
        num_energies = len(gained)
        by_direction = sums.gains[:-num_energies]
        by_scale = sums.gains[-num_energies:]
        if material.drive is not None:
            heat, slopes = heat_of_kicks(state, self.scene, duration, tangents.directions)
            gained[0] = gained[0] + heat
            by_direction = by_direction.at[:, 0].add(slopes[:, None])
            # Heating does not depend on the speeds, unlike the frequency of impacts.
            by_scale = by_scale.at[0, 0].add(-heat)
        return tangents.after(
            jnp.stack(before),
            jnp.stack(gained),
            by_direction,
            by_scale,
            sums.collisions.astype(sums.gains.dtype),
        )

    def _judge(
        self,
        new: SphereState,
        listed: Float[Array, "n d"],
        candidates: ImpactCandidates,
        progress: WindowProgress,
        bound: Float[Array, "replicas"],
    ) -> tuple[Int[Array, ""], Bool[Array, ""]]:
        """Return the faults of a window, and whether to repeat it with a larger bound on speeds."""
        distance2 = jnp.max(jnp.sum((new.position - listed) ** 2, -1))
        distance2 = jnp.maximum(distance2, jnp.max(progress.max_distance2))
        left_skin = distance2 > (0.5 * new.skin) ** 2
        member_bound = bound[jnp.minimum(candidates.replica, self.replicas - 1)]
        too_fast = jnp.any(progress.max_speed2 > member_bound**2)
        invalid = self.invalid_block(new, candidates.needed)
        repeat = too_fast & (invalid == 0)
        fault = status.flag(status.SKIN_EXCEEDED, left_skin)
        fault |= status.flag(status.STALLED, progress.num_rounds >= MAX_ROUNDS)
        # A window to be repeated has no fault; one that lacks pairs or is not finite, that alone.
        fault = jnp.where(repeat, status.OK, fault)
        fault = jnp.where(invalid > 0, invalid, fault)
        return fault.astype(jnp.int32), repeat

    def _will_leave_skin(
        self, state: SphereState, listed: Float[Array, "n d"], end: ArrayLike
    ) -> Bool[Array, ""]:
        """Return whether free flight in the next window makes the neighbour list stale."""
        duration = jnp.minimum(state.internal.window, time_left(state, end))
        position = state.position + state.velocity * duration
        distance2 = jnp.max(jnp.sum((position - listed) ** 2, -1))
        return distance2 > (0.5 * state.skin) ** 2

    def recover(self, now: Segment, before: SphereState) -> SphereState:
        """Shorten the window if the skin was exceeded at once, and the skin of a crowded list."""
        state = now.state
        has_not_moved = state.time == before.time  # otherwise a new neighbour list is enough
        shorten = status.has(state.status, status.SKIN_EXCEEDED) & has_not_moved
        # Only with enough capacity, so that a resumed run with another capacity does the same.
        crowded = state.needed[0] > MAX_LISTED_PER_PARTICLE * len(state.position)
        crowded &= state.status == status.OK
        shorter = jnp.maximum(SKIN_REDUCTION * state.skin, jnp.minimum(state.skin, MIN_SKIN))
        window = jnp.where(shorten, 0.5 * state.internal.window, state.internal.window)
        return state._replace(
            skin=jnp.where(crowded, shorter, state.skin),
            internal=state.internal._replace(window=window),
            status=state.status & FATAL,
        )

    def true_velocities(self, state: SphereState) -> tuple[Array, Array | None]:
        decay = drag_decay(self.scene.drag_rates, state.time + state.time_rest)
        spin = state.internal.spin
        if spin is not None:
            spin = spin * decay.spin
        return state.velocity * decay.velocity, spin

    def observe(self, state: SphereState) -> Records:
        return hard_records(state, self.scene, self.replicas)


def allowed_overlap(dtype: DTypeLike, side: ArrayLike) -> Array:
    """Return the overlap up to which spheres of a start count as hard.

    It is at least the overlap of spheres in contact by rounding of positions.
    """
    return jnp.maximum(ALLOWED_OVERLAP, 10 * side * jnp.finfo(dtype).eps)
