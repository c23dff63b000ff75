"""Dynamics of hard spheres in windows of time, with a drive, records and tangents.

Many impacts are executed at once in each window. White noise drives the spheres by random kicks:
each window begins and ends with half of its kicks. Units as in `jaxgran.particles.hard.impacts`.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray, UInt32

from jaxgran._utils import status
from jaxgran.gradients import rule
from jaxgran.gradients.tangents import ImpactTangents, update_rates
from jaxgran.particles import neighbours, observables
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import (
    AbstractDynamics,
    Progress,
    accept_if,
    initial_progress,
    repeat_until,
)
from jaxgran.particles.hard.impacts import (
    MAX_ROUNDS,
    HardScene,
    HardTangents,
    ImpactWork,
    execute_impacts,
)
from jaxgran.particles.hard.prediction import ImpactCandidates, select_impact_candidates
from jaxgran.particles.neighbours import Pairs
from jaxgran.particles.setup import min_distance, overlap_by_rounding
from jaxgran.particles.state import (
    MAX_KICK,
    State,
    advance_time,
    common_records,
    derivatives_of_records,
    drag_decay,
    fastest,
    initial_spins,
    kinetic_energy,
    random_kicks,
    temperature,
    threefry_key,
    time_left,
    true_duration,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedDrag
from jaxgran.theory import averages

MIN_IMPACTS = 8
"""Smallest number of impacts that a window should have, in all replicas together."""

WINDOW_EXPONENT = 0.3
"""Damping exponent of the window-length controller.

The length changes by ``(wanted / executed impacts)^0.3``, as the number of impacts scatters.
"""

SPEED_MARGIN = 1.15
"""Bound on the speeds within a window, over the speed of the fastest sphere before it."""

MAX_LISTED_PER_PARTICLE = 20.0
"""Listed pairs per particle from which on the skin is shortened, as in dense clusters."""

MIN_SKIN = 0.2
"""Skin in diameters below which it is not shortened."""


class HardState(NamedTuple):
    """Internal state of hard spheres, see `State`.

    Attributes:
        age: time since the last impact.
        regularised: impacts made elastic because they followed the last one too soon.
        window: length of the next window.
        spin: of rough spheres, transformed where there is drag; None of smooth ones.
        rotational_gain: gain of the energy of these spins since t = 0; None of smooth ones.
        key: of the random numbers of a drive, with the number of kicks made; None without a drive.
    """

    age: Float[Array, "n"]
    regularised: Int[Array, "replicas"]
    window: Float[Array, ""]
    spin: Float[Array, "n spins"] | None = None
    rotational_gain: Float[Array, "replicas"] | None = None
    key: UInt32[Array, "3"] | None = None


class HardDynamics(AbstractDynamics):
    """Dynamics of hard spheres in windows of time.

    Attributes:
        scene, replicas, capacity: see `AbstractDynamics`.
        share: impacts per particle in a window.
        overlap: largest overlap of positions given by a user that are accepted as those of hard
            spheres.
    """

    scene: HardScene
    replicas: int = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    share: float = eqx.field(static=True)
    overlap: float = eqx.field(static=True, default=1e-9)

    def initial_internal(self, num_rows, dtype) -> HardState:
        # The first window is short: at random positions many spheres are near contact.
        rate = self.scene.collision_frequency
        if self.scene.walls is not None:
            rate = rate + 2 / jnp.min(self.scene.walls.sides - 1)
        return HardState(
            age=jnp.full(num_rows, jnp.inf, dtype),
            regularised=jnp.zeros(self.replicas, jnp.result_type(int)),
            window=jnp.asarray(self.share / (8 * rate), dtype),
        )

    def elastic(self) -> "HardDynamics":
        return dataclasses.replace(self, scene=self.scene.for_equilibration())

    @property
    def region(self) -> Array | None:
        walls = self.scene.walls
        return None if walls is None else walls.sides - 1

    @property
    def galilean_invariant(self) -> bool:
        return self.scene.walls is None and self.scene.drag is None

    def sample_spins(self, state: State, key: PRNGKeyArray) -> State:
        n, d = state.velocity.shape
        internal, surface = state.internal, self.scene.surface
        if surface is not None:
            spin = initial_spins(
                key, state.velocity, self.replicas, surface.ratio / surface.inertia
            )
            gain = jnp.zeros(self.replicas, spin.dtype)
            internal = internal._replace(spin=spin, rotational_gain=gain)
        if self.scene.drive is not None:
            words = jax.random.bits(jax.random.fold_in(key, 3), (2,), jnp.uint32)
            internal = internal._replace(key=jnp.concatenate([words, jnp.zeros(1, jnp.uint32)]))
        return state._replace(internal=internal)

    def to_lab_frame(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        spin, drag = state.internal.spin, self.scene.drag
        if drag is None:
            return velocity, spin
        decay = drag_decay(self.scene.decay_rates, state.time + state.time_rest)
        return velocity * decay.velocity, None if spin is None else spin * decay.true_spin

    def with_tangents(self, state: State, directions: ReducedLaw | HardScene) -> State:
        velocity = state.velocity
        if isinstance(directions, HardScene):
            n, d = len(velocity) // self.replicas, velocity.shape[1]
            tangents = HardTangents.at_start(self.scene, directions, self.replicas, n, d)
        else:
            tangents = ImpactTangents.initial(directions, self.replicas, velocity.dtype)
        return state._replace(tangents=tangents)

    def observe(self, state: State) -> dict[str, Array]:
        return hard_records(state, self.scene, self.replicas)

    def check_start(self, state: State) -> Int[Array, ""]:
        x, side = state.position, self.scene.side
        closest = min_distance(x, side, self.replicas, self.capacity[:2], "sweep")
        tolerance = overlap_by_rounding(x, side, self.overlap)
        if self.scene.walls is not None:  # a sphere and its image beyond a wall
            image = 2 * jnp.min(jnp.minimum(x, self.scene.walls.sides[None] - x))
            closest = jnp.minimum(closest, image)
        return status.flag(status.OVERLAPPING, closest < 1 - tolerance)

    @jax.jit
    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, Array]:
        """Prepare a neighbour list of the positions in the middle of its life.

        Free flight leads there, and the list lives twice as long as one of the current positions.
        """
        side, walls = self.scene.side, self.scene.walls
        speed = jnp.max(fastest(state.velocity, self.replicas))
        life = 0.95 * state.skin / jnp.maximum(speed, jnp.finfo(speed.dtype).tiny)
        time_until_end = time_left(state, end)
        flown = 0.5 * jnp.minimum(life, time_until_end) * state.velocity
        if walls is not None:
            inside = jnp.clip(state.position + flown, 0.5, walls.sides[None] - 0.5)
            flown = inside - state.position
        listed = neighbours.wrap(side, state.position + flown)
        image = jnp.round((state.position + flown - listed) / side).astype(jnp.int32)
        prepared = state._replace(position=listed - flown, image=state.image + image)
        return prepared, listed, jnp.where(life < time_until_end, state.time + life, end)

    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        bound_factor = jnp.ones((), state.position.dtype)
        first = initial_progress(state, pairs, self.capacity, bound_factor)
        window = partial(self._advance_window, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, window, first)

    def _advance_window(
        self, now: Progress, listed: Array, pairs: Pairs, end: ArrayLike
    ) -> Progress:
        """Run one window, and accept it if no sphere exceeded the speed bound and no check failed.

        `Progress.internal` is the factor by which the bound on speeds is raised.
        """
        old, bound_factor = now.state, now.internal
        time_until_end, scene = time_left(old, end), self.scene
        window = window_length(old, scene, self.replicas)
        num_left = jnp.maximum(jnp.ceil(time_until_end / window * (1 - 1e-9)), 1.0)
        duration = time_until_end / num_left
        kicked = apply_drive(old, scene, self.replicas, duration, 0.0)
        bound = SPEED_MARGIN * bound_factor * fastest(kicked.velocity, self.replicas)
        candidates = select_impact_candidates(
            old.position, kicked.velocity, pairs, duration, bound, self.capacity, scene.walls
        )
        work = execute_impacts(kicked, listed, candidates, scene, duration, self.replicas)
        member_bound = bound[jnp.minimum(candidates.replica, self.replicas - 1)]
        too_fast = jnp.any(work.max_speed2 > member_bound**2)
        new = self._state_after_window(kicked, candidates, work, duration)
        new = apply_drive(new, scene, self.replicas, duration, 1.0)
        new = advance_time(new, duration, end, num_left <= 1)

        list_status = self.capacity.exceeded_by(candidates.needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        distance2 = jnp.max(jnp.sum((new.position - listed) ** 2, -1))
        exceeded = jnp.maximum(distance2, jnp.max(work.max_distance2)) > (0.5 * old.skin) ** 2
        fault = status.flag(status.SKIN_EXCEEDED, exceeded)
        fault |= status.flag(status.STALLED, work.num_rounds >= MAX_ROUNDS)
        fault = jnp.where(finite, fault, status.NOT_FINITE.bit)
        # A window whose arrays were too short lacks pairs or particles.
        fault = jnp.where(list_status > 0, list_status, fault)
        accepted = (fault == status.OK) & ~too_fast
        repeat = too_fast & finite & (list_status == 0)
        state = accept_if(accepted, new, old)
        next_duration = jnp.minimum(state.internal.window, time_left(state, end))
        next_position = state.position + state.velocity * next_duration
        next_distance2 = jnp.max(jnp.sum((next_position - listed) ** 2, -1))
        return Progress(
            state=state,
            stale=accepted & (next_distance2 > (0.5 * old.skin) ** 2),
            status=jnp.where(repeat, status.OK, fault).astype(jnp.int32),
            needed=jnp.maximum(now.needed, candidates.needed),
            internal=jnp.where(repeat, 1.3 * bound_factor, 1.0),
        )

    def _state_after_window(
        self, state: State, candidates: ImpactCandidates, work: ImpactWork, duration: Array
    ) -> State:
        """Return the state after a window at its old time, with the length of the next window."""

        def by_replica(values):
            return _sum_by_replica(values, candidates, self.replicas)

        def to_members(values, new):
            return values.at[candidates.members].set(new, mode="drop")

        impacts, lost = by_replica(work.impacts) // 2, by_replica(work.dissipated)
        wanted = max(0.5 * self.share * len(state.position), MIN_IMPACTS)
        num_impacts = jnp.sum(impacts)
        if work.wall_impacts is not None:  # each of one sphere, not of two
            num_impacts = num_impacts + jnp.sum(work.wall_impacts) / 2
        ratio = jnp.clip((wanted / jnp.maximum(num_impacts, 1)) ** WINDOW_EXPONENT, 0.5, 1.5)
        paths, internal = work.paths, state.internal
        regularised = internal.regularised + by_replica(work.regularised) // 2
        rotational_gain = None
        if work.rotational_gain is not None:
            rotational_gain = internal.rotational_gain + by_replica(work.rotational_gain)
        # The last, short window before an end says nothing about the rate of impacts.
        full_length = duration > 0.5 * internal.window
        new = state._replace(
            position=to_members(
                state.position + state.velocity * duration, paths.x + paths.v * duration
            ),
            velocity=to_members(state.velocity, paths.v),
            dissipated=state.dissipated + lost,
            collisions=state.collisions + impacts,
            internal=HardState(
                age=to_members(internal.age + duration, duration - paths.last),
                regularised=regularised,
                window=jnp.where(full_length, duration * ratio, internal.window),
                spin=None if internal.spin is None else to_members(internal.spin, paths.spin),
                rotational_gain=rotational_gain,
                key=internal.key,
            ),
        )
        if isinstance(state.tangents, HardTangents):
            tangents = exchange_tangents_after(state, self.scene, candidates, work, duration)
        elif state.tangents is not None:
            tangents = projected_tangents_after(new, self.scene, candidates, work, duration)
        else:
            return new
        return new._replace(tangents=tangents)

    def recover(self, now: Progress, before: State) -> tuple[State, Int[Array, ""]]:
        """Shorten the window if the skin was exceeded at once, and the skin of a crowded list."""
        state = now.state
        fresh = state.time == before.time  # otherwise a new neighbour list is enough
        shorten = status.has(now.status, status.SKIN_EXCEEDED) & fresh
        # Only with enough capacity, so that a resumed run with another capacity does the same.
        crowded = now.needed[0] > MAX_LISTED_PER_PARTICLE * len(state.position)
        crowded &= now.status == status.OK
        shorter = jnp.maximum(0.8 * state.skin, jnp.minimum(state.skin, MIN_SKIN))
        fatal = status.LIST_FULL.bit | status.CONTACTS_FULL.bit
        fatal |= status.NOT_FINITE.bit | status.STALLED.bit
        window = jnp.where(shorten, 0.5 * state.internal.window, state.internal.window)
        recovered = state._replace(
            skin=jnp.where(crowded, shorter, state.skin),
            internal=state.internal._replace(window=window),
        )
        return recovered, now.status & fatal


def apply_drive(
    state: State, scene: HardScene, replicas: int, duration: ArrayLike, place: float
) -> State:
    """Return the state with half of the kicks of a window, made at its begin (place 0) or end (1).

    Time and window are those before the window; the velocities may already have had kicks.
    """
    counted_key = state.internal.key
    if scene.drive is None or counted_key is None:
        return state
    variance = kick_variance(scene, state.time + state.time_rest, duration, place)
    keys = jax.random.split(
        jax.random.fold_in(threefry_key(counted_key[:2]), counted_key[2]), replicas
    )
    by_replica = state.velocity.reshape(replicas, -1, state.velocity.shape[-1])
    kicks = jax.vmap(random_kicks, (0, 0, None))(keys, by_replica, scene.walls is None)
    velocity = (by_replica + jnp.sqrt(variance) * kicks).reshape(state.velocity.shape)
    internal = state.internal._replace(key=counted_key.at[2].add(jnp.uint32(1)))
    return state._replace(velocity=velocity, internal=internal)


def kick_variance(
    scene: HardScene, start_time: Float[Array, ""], duration: ArrayLike, place: float
) -> Float[Array, ""]:
    """Return the variance of half of the kicks of a window, made at its begin (place 0) or end (1).

    With drag a kick decays as a velocity does, and time is transformed.
    """
    assert scene.drive is not None
    strength = scene.drive.strength * scene.collision_frequency
    if scene.drag is None:
        return strength * duration / 2
    rates = scene.decay_rates
    true_time = true_duration(rates, start_time, jnp.asarray(duration))
    return strength * true_time / 2 / drag_decay(rates, start_time + place * duration).velocity ** 2


def window_length(state: State, scene: HardScene, replicas: int) -> Float[Array, ""]:
    """Return the length of a window, so short that its kicks are small compared to the
    velocities."""
    if scene.drive is None:
        return state.internal.window
    lowest = jnp.min(temperature(state.velocity, replicas))
    growth = 2 * kick_variance(scene, state.time + state.time_rest, jnp.ones_like(lowest), 0.0)
    safe_growth = jnp.where(growth > 0, growth, 1.0)
    longest = jnp.where(growth > 0, MAX_KICK * lowest / safe_growth, jnp.inf)
    return jnp.minimum(state.internal.window, longest)


def projected_tangents_after(
    new: State, scene: HardScene, candidates: ImpactCandidates, work: ImpactWork, duration: Array
) -> ImpactTangents:
    """Return the tangents of smooth spheres after a window.

    Args:
        new: the state after it, with the tangents before it.
        scene: the gas.
        candidates, work: the impacts of the window.
        duration: of the window.
    """
    tangents, d = new.tangents, new.velocity.shape[1]
    replicas = len(new.dissipated)
    num_particles = len(new.velocity) // replicas
    lost = _sum_by_replica(work.dissipated, candidates, replicas)
    impacts = _sum_by_replica(work.impacts, candidates, replicas)
    T = temperature(new.velocity, replicas)
    energy = 0.5 * d * num_particles * T
    trend = cooling_trend(scene.law, T, d)
    rates = update_rates(
        tangents.rates,
        lost=lost,
        collisions=impacts / num_particles,
        energy=energy,
        temperature=T,
        trend=trend,
        duration=duration,
        collision_frequency=scene.collision_frequency,
    )
    gains = jnp.zeros((len(work.gains), replicas), energy.dtype)
    gains = gains.at[:, candidates.replica[candidates.rows.a]].add(work.gains, mode="drop")
    return tangents.after(gains, energy + 0.5 * lost, T, duration, rates, trend, d)


def cooling_trend(
    law: ReducedLaw, temperature: Float[Array, "replicas"], dimension: int
) -> Float[Array, "replicas"]:
    """Return the cooling rate of a Maxwellian gas as a function of T, up to a factor."""

    def rate(speed):
        return averages.impact_moments(law, speed, dimension)[0, 0] * speed

    return jax.vmap(rate)(jnp.sqrt(temperature))


def exchange_tangents_after(
    old: State, scene: HardScene, candidates: ImpactCandidates, work: ImpactWork, duration: Array
) -> HardTangents:
    """Return the tangents of a gas with elements after a window.

    Args:
        old: the state before it.
        scene, candidates, work, duration: as for `projected_tangents_after`.
    """
    tangents, replicas = old.tangents, len(old.dissipated)
    n, d = len(old.velocity) // replicas, old.velocity.shape[1]
    before = jnp.stack([kinetic_energy(old.velocity, replicas), jnp.zeros(replicas)])
    gained = -_sum_by_replica(work.dissipated, candidates, replicas)[None]
    gained = jnp.concatenate([gained, jnp.zeros_like(gained)])
    if scene.surface is not None and work.rotational_gain is not None:
        spins = jnp.sum(old.internal.spin.reshape(replicas, -1) ** 2, axis=1)
        before = before.at[1].set(scene.surface.inertia / 2 * spins)
        gained = gained.at[1].set(_sum_by_replica(work.rotational_gain, candidates, replicas))
    gains = jnp.zeros((tangents.num_changes, 2, replicas), before.dtype)
    gains = gains.at[:, :, candidates.replica[candidates.rows.a]].add(work.gains, mode="drop")
    if scene.walls is not None:
        gains = gains.at[:, :, candidates.replica].add(work.wall_gains, mode="drop")
    if scene.drive is not None:

        def heating(material: HardScene) -> Array:
            changed, start_time = scene.with_material(material), old.time + old.time_rest
            halves = [kick_variance(changed, start_time, duration, place) for place in (0.0, 1.0)]
            return n * d / 2 * (halves[0] + halves[1])

        heating_energy, linear = jax.linearize(heating, scene.material)
        # Heating does not depend on the speeds, unlike the frequency of impacts.
        gains = gains.at[:-2, 0].add(jax.vmap(linear)(tangents.directions)[:, None])
        gains = gains.at[-2, 0].add(-heating_energy)
        gained = gained.at[0].add(heating_energy)
    impacts = _sum_by_replica(work.impacts, candidates, replicas) / 2
    return tangents._replace(exchange=tangents.exchange.after(before, gained, gains, impacts))


def _sum_by_replica(values: Array, candidates: ImpactCandidates, replicas: int) -> Array:
    """Return the sums over the slots of each replica; an empty slot belongs to none."""
    sums = jnp.zeros(replicas, values.dtype)
    return sums.at[candidates.replica].add(values, mode="drop")


@partial(jax.jit, static_argnames="replicas")
def hard_records(state: State, scene: HardScene, replicas: int) -> dict[str, Array]:
    """Return the records of a state; with tangents, also those that `rule.with_tangents` adds."""
    values, travelled, velocity = common_records(state, scene.side, replicas)
    values["regularised"] = 2 / velocity.shape[1] * state.internal.regularised
    if scene.has_elements:
        return _records_with_elements(values, velocity, state, scene, replicas)
    tangents = state.tangents
    if tangents is None:
        return values
    T = values["temperature"]
    cooling = tangents.rates.cooling(cooling_trend(scene.law, T, velocity.shape[-1]))
    collision_rate, c = tangents.rates.collision(T), tangents.log_temperature
    derivatives, rates = derivatives_of_records(
        values, travelled, velocity, c, tangents.paths, cooling, collision_rate
    )
    return rule.with_tangents(values, derivatives, rates, tangents.clock)


def _records_with_elements(
    values: dict[str, Array],
    velocity: Float[Array, "replicas N d"],
    state: State,
    scene: HardScene,
    replicas: int,
) -> dict[str, Array]:
    """Return the records of a scene with elements.

    The dissipated energy includes all losses in impacts and to drag.
    """
    n, d = velocity.shape[1:]
    initial_kinetic = kinetic_energy(state.first_velocity, replicas) / n
    if scene.walls is not None:  # the frame is that of the walls, and displacements are bounded
        velocity = state.velocity.reshape(velocity.shape)
        values["temperature"] = observables.temperature(velocity)
        values["sonine"] = observables.sonine(velocity)
        del values["displacement"], values["flow_share"]
    velocity_factor = spin_factor = jnp.ones(())
    if scene.drag is not None:
        velocity_factor, _, spin_factor = drag_decay(
            scene.decay_rates, state.time + state.time_rest
        )
    lost = initial_kinetic - velocity_factor**2 * (initial_kinetic - state.dissipated / n)
    values["temperature"] = values["temperature"] * velocity_factor**2
    values["velocity_correlation"] = values["velocity_correlation"] * velocity_factor
    if scene.surface is not None and state.internal.spin is not None:  # None in equilibration
        spin = state.internal.spin.reshape(replicas, -1)
        rotational = scene.surface.inertia * jnp.mean(spin**2, axis=1)
        values["rotational_temperature"] = rotational * spin_factor**2
        initial_rotational = NUM_SPIN_COMPONENTS[d] / 2 * scene.surface.ratio
        lost = (
            lost
            + initial_rotational
            - spin_factor**2 * (initial_rotational + state.internal.rotational_gain / n)
        )
    values["dissipated_energy"] = lost
    if state.tangents is None:
        return values
    return values | _element_derivatives(values, state, scene, n, d)


def _element_derivatives(
    values: dict[str, Array], state: State, scene: HardScene, n: int, d: int
) -> dict[str, Array]:
    """Return the derivatives of T, T_rot and collisions, as `rule.with_tangents` names them.

    Derivatives in time follow from the last direction, in which everything happens sooner by the
    same share of time.
    """
    directions, (energies, collisions) = state.tangents
    time = state.time + state.time_rest
    log_decay, decay_tangents = jnp.zeros(2), jnp.zeros((len(collisions), 2))
    if scene.drag is not None:

        def logarithms(drag: ReducedDrag) -> Array:
            decay = drag_decay(scene._replace(drag=drag).decay_rates, time)
            return jnp.log(jnp.stack([decay.velocity, decay.true_spin]))

        log_decay, linear = jax.linearize(logarithms, scene.drag)
        decay_tangents = jax.vmap(linear)(directions.drag)
    elapsed = jnp.where(time > 0, time, 1.0)
    per_particle = 2 / n * collisions
    derivatives = {
        "collisions.along": per_particle[:-1],
        "collisions.rate": per_particle[-1] / elapsed,
    }
    for k, name in enumerate(("temperature", "rotational_temperature")):
        if name not in values:
            continue
        size = n * (d, NUM_SPIN_COMPONENTS[d])[k] / 2
        along = jnp.exp(2 * log_decay[k]) * energies[:, k] / size
        along = along + 2 * decay_tangents[:, k, None] * values[name][None]
        derivatives |= {f"{name}.along": along[:-1], f"{name}.rate": along[-1] / elapsed}
    return derivatives
