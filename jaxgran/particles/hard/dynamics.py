"""Hard spheres in windows of time, in each of which many impacts are resolved at once.

White noise that drives hard spheres, and the steady state in which a gas can be prepared.

Each window begins and ends with half of its kicks. Units as in `jaxgran.particles.hard.impacts`.

The records of hard spheres, with their derivatives where tangents are followed.

The tangents of hard spheres after a window.

Of smooth ones see `jaxgran.gradients.tangents`, of those with elements `jaxgran.gradients.tangents`.

What hard spheres have besides the state and progress of all spheres.
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
    first_progress,
    kept_if,
    repeat_until,
)
from jaxgran.particles.hard.impacts import (
    MAX_ROUNDS,
    HardScene,
    HardTangents,
    ImpactWork,
    Material,
    resolve,
)
from jaxgran.particles.hard.prediction import Selection, Slots, select_reachable
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
    kinetic_energy,
    maxwellian_spins,
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


def initial_random_state(state: State, scene: HardScene, replicas: int, key: PRNGKeyArray) -> State:
    """The state at t = 0 with random spins of rough spheres, and the key of a drive."""
    n, d = state.velocity.shape
    internal = state.internal
    if scene.surface is not None:
        drawn = jax.random.fold_in(key, 2)  # 0 and 1 are of positions and velocities
        shape = replicas, n // replicas, NUM_SPIN_COMPONENTS[d]
        mean_square = (scene.surface.ratio / scene.surface.inertia).astype(state.velocity.dtype)
        spin = maxwellian_spins(drawn, shape, mean_square).reshape(n, NUM_SPIN_COMPONENTS[d])
        internal = internal._replace(spin=spin, rotational_gain=jnp.zeros(replicas, spin.dtype))
    if scene.drive is not None:
        internal = internal._replace(key=counted_key(jax.random.fold_in(key, 3)))
    return state._replace(internal=internal)


def counted_key(key: PRNGKeyArray) -> Array:
    """Two words of a key, and the number of kicks made with it, none."""
    words = jax.random.bits(key, (2,), jnp.uint32)
    return jnp.concatenate([words, jnp.zeros(1, jnp.uint32)])


def apply_kicks(
    state: State, scene: HardScene, replicas: int, variance: Float[Array, "replicas"]
) -> State:
    """The state with random kicks of a variance for each component of each replica's velocities."""
    if state.internal.key is None:
        return state
    key = jax.random.fold_in(threefry_key(state.internal.key[:2]), state.internal.key[2])
    each = state.velocity.reshape(replicas, -1, state.velocity.shape[-1])
    keys = jax.random.split(key, replicas)
    found = jax.vmap(random_kicks, (0, 0, None))(keys, each, scene.walls is None)
    velocity = each + jnp.sqrt(variance)[:, None, None] * found
    internal = state.internal._replace(key=state.internal.key.at[2].add(jnp.uint32(1)))
    return state._replace(velocity=velocity.reshape(state.velocity.shape), internal=internal)


def kick_variance(
    scene: HardScene, began: Float[Array, ""], duration: ArrayLike, place: float
) -> Float[Array, ""]:
    """Variance of half of the kicks of a window, made at its begin (place 0) or end (1).

    With drag a kick lasts as long as a velocity, and time is transformed.
    """
    assert scene.drive is not None
    strength = scene.drive.strength * scene.collision_frequency
    if scene.drag is None:
        return strength * duration / 2
    rates = scene.decay_rates
    time = true_duration(rates, began, jnp.asarray(duration))
    return strength * time / 2 / drag_decay(rates, began + place * duration).velocity ** 2


def apply_drive(
    state: State, scene: HardScene, replicas: int, duration: ArrayLike, place: float
) -> State:
    """The state with half of the kicks of a window, made at its begin (place 0) or end (1).

    The state is that before the window; it may have had kicks.
    """
    if scene.drive is None:
        return state
    variance = kick_variance(scene, state.time + state.time_rest, duration, place)
    return apply_kicks(state, scene, replicas, jnp.broadcast_to(variance, (replicas,)))


def window_for_drive(state: State, scene: HardScene, replicas: int) -> Float[Array, ""]:
    """Length of a window, so short that its kicks are small beside the velocities."""
    if scene.drive is None:
        return state.internal.window
    heat = jnp.min(temperature(state.velocity, replicas))
    growth = 2 * kick_variance(scene, state.time + state.time_rest, jnp.ones_like(heat), 0.0)
    safe = jnp.where(growth > 0, growth, 1.0)
    most = jnp.where(growth > 0, MAX_KICK * heat / safe, jnp.inf)
    return jnp.minimum(state.internal.window, most)


def window_heating(
    scene: HardScene, material: Material, began: Float[Array, ""], duration: ArrayLike
) -> Float[Array, ""]:
    """Growth of T by the kicks of a window, as a function of the material."""
    here = scene.with_material(material)
    return kick_variance(here, began, duration, 0.0) + kick_variance(here, began, duration, 1.0)


def restore_energy(
    state: State, scene: HardScene, replicas: int, lost: Float[Array, "replicas"]
) -> State:
    """The state with kicks that return the energy lost, scaled to T = 1 exactly.

    A gas that is driven so comes into the steady state of white noise.
    """
    n, d = state.velocity.shape
    # By chance the spins of rough spheres give more than impacts take: velocities are then scaled.
    variance = 2 * jnp.maximum(lost, 0.0) / (n // replicas * d)
    state = apply_kicks(state, scene, replicas, variance)
    each = state.velocity.reshape(replicas, -1)
    size = jnp.sqrt(jnp.mean(each**2, axis=1, keepdims=True))
    return state._replace(velocity=(each / size).reshape(state.velocity.shape))


def cooling_trend(
    law: ReducedLaw, temperature: Float[Array, "replicas"], dimension: int
) -> Float[Array, "replicas"]:
    """The cooling rate of a Maxwellian gas as a function of T, up to a factor."""

    def rate(speed):
        return averages.impact_moments(law, speed, dimension)[0, 0] * speed

    return jax.vmap(rate)(jnp.sqrt(temperature))


@partial(jax.jit, static_argnames="replicas")
def hard_records(state: State, scene: HardScene, replicas: int) -> dict[str, Array]:
    """The records of a state; with tangents, also those that `rule.with_tangents` adds."""
    values, travelled, velocity = common_records(state, scene.side, replicas)
    values["regularised"] = 2 / velocity.shape[1] * state.internal.regularised
    if scene.has_elements:
        return _records_with_elements(values, velocity, state, scene, replicas)
    along = state.tangents
    if along is None:
        return values
    T = values["temperature"]
    cooling = along.rates.cooling(cooling_trend(scene.law, T, velocity.shape[-1]))
    meeting, c = along.rates.collision(T), along.log_temperature
    kept, rates = derivatives_of_records(
        values, travelled, velocity, c, along.paths, cooling, meeting
    )
    return rule.with_tangents(values, kept, rates, along.clock)


def _records_with_elements(
    values: dict[str, Array],
    velocity: Float[Array, "replicas N d"],
    state: State,
    scene: HardScene,
    replicas: int,
) -> dict[str, Array]:
    """The records where there are elements.

    The energy dissipated is all that impacts and drag have taken.
    """
    n, d = velocity.shape[1:]
    first = kinetic_energy(state.first_velocity, replicas) / n
    if scene.walls is not None:  # which stop what moves as a whole, and keep spheres from going far
        velocity = state.velocity.reshape(velocity.shape)
        values["temperature"] = observables.temperature(velocity)
        values["sonine"] = observables.sonine(velocity)
        del values["displacement"], values["flow_share"]
    slowed = kept = jnp.ones(())
    if scene.drag is not None:
        slowed, _, kept = drag_decay(scene.decay_rates, state.time + state.time_rest)
    lost = first - slowed**2 * (first - state.dissipated / n)
    values["temperature"] = values["temperature"] * slowed**2
    values["velocity_correlation"] = values["velocity_correlation"] * slowed
    if scene.surface is not None and state.internal.spin is not None:  # not so in the melt
        spin = state.internal.spin.reshape(replicas, -1)
        inside = scene.surface.inertia * jnp.mean(spin**2, axis=1)
        values["rotational_temperature"] = inside * kept**2
        at_first = NUM_SPIN_COMPONENTS[d] / 2 * scene.surface.ratio
        lost = lost + at_first - kept**2 * (at_first + state.internal.rotational_gain / n)
    values["dissipated_energy"] = lost
    if state.tangents is None:
        return values
    return values | _derivatives(values, state, scene, n, d)


def _derivatives(
    values: dict[str, Array], state: State, scene: HardScene, n: int, d: int
) -> dict[str, Array]:
    """The derivatives of T, T_rot and collisions, as `rule.with_tangents` has them.

    Those in time are by the last direction, in which everything is sooner by the same share.
    """
    directions, (energies, collisions) = state.tangents
    time = state.time + state.time_rest
    log_left, along_left = jnp.zeros(2), jnp.zeros((len(collisions), 2))
    if scene.drag is not None:

        def logarithms(drag: ReducedDrag) -> Array:
            left = drag_decay(scene._replace(drag=drag).decay_rates, time)
            return jnp.log(jnp.stack([left.velocity, left.kept]))

        log_left, linear = jax.linearize(logarithms, scene.drag)
        along_left = jax.vmap(linear)(directions.drag)
    after = jnp.where(time > 0, time, 1.0)
    met = 2 / n * collisions
    found = {"collisions.along": met[:-1], "collisions.rate": met[-1] / after}
    for k, name in enumerate(("temperature", "rotational_temperature")):
        if name not in values:
            continue
        size = n * (d, NUM_SPIN_COMPONENTS[d])[k] / 2
        along = jnp.exp(2 * log_left[k]) * energies[:, k] / size
        along = along + 2 * along_left[:, k, None] * values[name][None]
        found |= {f"{name}.along": along[:-1], f"{name}.rate": along[-1] / after}
    return found


def projected_tangents_after(
    new: State, scene: HardScene, chosen: Selection, work: ImpactWork, duration: Array
) -> ImpactTangents:
    """The tangents of smooth spheres after a window.

    Args:
        new: the state after it, with the tangents before it.
        scene: the gas.
        chosen, work: the impacts of the window.
        duration: of the window.
    """
    along, d = new.tangents, new.velocity.shape[1]
    replicas = len(new.dissipated)
    num_particles = len(new.velocity) // replicas
    lost, met = _sum(work.dissipated, chosen, replicas), _sum(work.impacts, chosen, replicas)
    heat = temperature(new.velocity, replicas)
    energy = 0.5 * d * num_particles * heat
    trend = cooling_trend(scene.law, heat, d)
    rates = update_rates(
        along.rates,
        lost=lost,
        met=met / num_particles,
        energy=energy,
        temperature=heat,
        trend=trend,
        duration=duration,
        collision_frequency=scene.collision_frequency,
    )
    gains = jnp.zeros((len(work.gains), replicas), energy.dtype)
    gains = gains.at[:, chosen.replica[chosen.rows.a]].add(work.gains, mode="drop")
    return along.after(gains, energy + 0.5 * lost, heat, duration, rates, trend, d)


def exchange_tangents_after(
    old: State, scene: HardScene, chosen: Selection, work: ImpactWork, duration: Array
) -> HardTangents:
    """The tangents of a gas with elements after a window.

    Args:
        old: the state before it.
        scene, chosen, work, duration: as for `projected_after`.
    """
    along, replicas = old.tangents, len(old.dissipated)
    n, d = len(old.velocity) // replicas, old.velocity.shape[1]
    before = jnp.stack([kinetic_energy(old.velocity, replicas), jnp.zeros(replicas)])
    gained = -_sum(work.dissipated, chosen, replicas)[None]
    gained = jnp.concatenate([gained, jnp.zeros_like(gained)])
    if scene.surface is not None and work.rotational_gain is not None:
        spins = jnp.sum(old.internal.spin.reshape(replicas, -1) ** 2, axis=1)
        before = before.at[1].set(scene.surface.inertia / 2 * spins)
        gained = gained.at[1].set(_sum(work.rotational_gain, chosen, replicas))
    gains = jnp.zeros((along.num_changes, 2, replicas), before.dtype)
    gains = gains.at[:, :, chosen.replica[chosen.rows.a]].add(work.gains, mode="drop")
    if scene.walls is not None:
        gains = gains.at[:, :, chosen.replica].add(work.wall_gains, mode="drop")
    if scene.drive is not None:
        began = old.time + old.time_rest
        heat = partial(window_heating, scene, began=began, duration=duration)
        total, linear = jax.linearize(lambda material: n * d / 2 * heat(material), scene.material)
        # It does not depend on the speeds, which make impacts more frequent.
        gains = gains.at[:-2, 0].add(jax.vmap(linear)(along.directions)[:, None])
        gains = gains.at[-2, 0].add(-total)
        gained = gained.at[0].add(total)
    impacts = _sum(work.impacts, chosen, replicas) / 2
    return along._replace(exchange=along.exchange.after(before, gained, gains, impacts))


def _sum(values: Array, chosen: Selection, replicas: int) -> Array:
    """Sums over the slots of each replica; an empty slot is of none."""
    sums = jnp.zeros(replicas, values.dtype)
    return sums.at[chosen.replica].add(values, mode="drop")


class HardState(NamedTuple):
    """What hard spheres have besides `State`.

    Attributes:
        age: time since the last impact.
        regularised: impacts made elastic because they followed the last one too soon.
        window: length of the next window.
        spin: of rough spheres, what drag keeps of it; else None.
        turned: gain of the energy of these spins since t = 0; else None.
        key: of the random numbers of a drive, and of how many kicks; else None.
    """

    age: Float[Array, "n"]
    regularised: Int[Array, "replicas"]
    window: Float[Array, ""]
    spin: Float[Array, "n spins"] | None = None
    rotational_gain: Float[Array, "replicas"] | None = None
    key: UInt32[Array, "3"] | None = None


class HardProgress(NamedTuple):
    """What hard spheres have besides `Progress`.

    Attributes:
        widen: factor by which the bound on speeds is raised.
        num_windows, num_failed, num_rounds: made with this neighbour list.
    """

    widen: Float[Array, ""]
    num_windows: Int[Array, ""]
    num_failed: Int[Array, ""]
    num_rounds: Int[Array, ""]


MIN_IMPACTS = 8
"""Impacts that a window should have at least, in all replicas together."""

CROWDED = 20.0
"""Listed pairs per particle from which on the skin is shortened: clusters fill a long cutoff."""

MIN_SKIN = 0.2
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

    def initial_internal(self, num_rows, dtype) -> HardState:
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
        state = initial_random_state(state, self.scene, self.replicas, key)
        return state._replace(
            internal=state.internal._replace(key=counted_key(jax.random.fold_in(key, 4)))
        )

    @property
    def room(self) -> Array | None:
        walls = self.scene.walls
        return None if walls is None else walls.sides - 1

    @property
    def inertial(self) -> bool:
        return self.scene.walls is None and self.scene.drag is None

    def sample_spins(self, state: State, key: PRNGKeyArray, melted: State) -> State:
        state = initial_random_state(state, self.scene, self.replicas, key)
        if melted.internal.spin is None:
            return state
        return state._replace(internal=state.internal._replace(spin=melted.internal.spin))

    def to_lab_frame(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        spin, drag = state.internal.spin, self.scene.drag
        if drag is None:
            return velocity, spin
        left = drag_decay(self.scene.decay_rates, state.time + state.time_rest)
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
        return hard_records(state, self.scene, self.replicas)

    def check_start(self, state: State) -> Int[Array, ""]:
        x, side = state.position, self.scene.side
        closest = min_distance(x, side, self.replicas, self.capacity[:2], "sweep")
        tolerance = overlap_by_rounding(x, side, self.overlap)
        if self.scene.walls is not None:  # a sphere and its image beyond a wall
            image = 2 * jnp.min(jnp.minimum(x, self.scene.walls.sides[None] - x))
            closest = jnp.minimum(closest, image)
        return status.flag(status.OVERLAPPING, closest < 1 - tolerance)

    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, ArrayLike]:
        """The neighbour list is of the positions to which free flight leads at the middle of its
        life, which doubles that life."""
        return _prepare(self, state, end)

    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        zero = jnp.zeros((), jnp.int32)
        internal = HardProgress(jnp.ones((), state.position.dtype), zero, zero, zero)
        first = first_progress(state, pairs, self.capacity, internal)
        window = partial(self._window, listed=listed, pairs=pairs, end=end)
        return repeat_until(end, window, first)

    def _window(self, now: Progress, listed: Array, pairs: Pairs, end: ArrayLike) -> Progress:
        """One window, accepted if no sphere became faster than the bound and nothing went wrong."""
        old, more = now.state, now.internal
        left, scene = time_left(old, end), self.scene
        window = window_for_drive(old, scene, self.replicas)
        num_left = jnp.maximum(jnp.ceil(left / window * (1 - 1e-9)), 1.0)
        duration = left / num_left
        began = apply_drive(old, scene, self.replicas, duration, 0.0)
        bound = SPEED_MARGIN * more.widen * fastest(began.velocity, self.replicas)
        chosen = select_reachable(
            old.position, began.velocity, pairs, duration, bound, self.capacity, scene.walls
        )
        work = self._resolved(began, listed, chosen, duration)
        most = bound[jnp.minimum(chosen.replica, self.replicas - 1)]
        too_fast = jnp.any(work.fastest > most**2)
        new = self._moved(began, chosen, work, duration)
        if self.restores:
            new = restore_energy(new, scene, self.replicas, new.dissipated - old.dissipated)
        else:
            new = apply_drive(new, scene, self.replicas, duration, 1.0)
        new = advance_time(new, duration, end, num_left <= 1)

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
        ahead = jnp.minimum(state.internal.window, time_left(state, end))
        ahead = state.position + state.velocity * ahead
        ahead = jnp.max(jnp.sum((ahead - listed) ** 2, -1))
        enough = more.num_windows + 1 >= self.max_windows
        return Progress(
            state=state,
            stale=(done & (ahead > (0.5 * old.skin) ** 2)) | enough,
            status=jnp.where(again, status.OK, fault).astype(jnp.int32),
            needed=jnp.maximum(now.needed, chosen.needed),
            internal=HardProgress(
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
        internal = state.internal
        slots = Slots(
            of_members(state.position),
            of_members(state.velocity),
            -of_members(internal.age),
            None if internal.spin is None else of_members(internal.spin),
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
        wanted = max(0.5 * self.share * len(state.position), MIN_IMPACTS)
        found = jnp.sum(impacts)
        if work.bounces is not None:  # of one sphere, and not of two
            found = found + jnp.sum(work.bounces) / 2
        ratio = jnp.clip((wanted / jnp.maximum(found, 1)) ** WINDOW_EXPONENT, 0.5, 1.5)
        slots, internal = work.slots, state.internal
        regularised = internal.regularised + by_replica(work.regularised) // 2
        # The last, short window before an end says nothing about the rate of impacts.
        full_length = duration > 0.5 * internal.window
        new = state._replace(
            position=to_members(
                state.position + state.velocity * duration, slots.x + slots.v * duration
            ),
            velocity=to_members(state.velocity, slots.v),
            dissipated=state.dissipated + lost,
            collisions=state.collisions + impacts,
            internal=HardState(
                age=to_members(internal.age + duration, duration - slots.last),
                regularised=regularised,
                window=jnp.where(full_length, duration * ratio, internal.window),
                spin=None if internal.spin is None else to_members(internal.spin, slots.spin),
                rotational_gain=None
                if work.rotational_gain is None
                else internal.rotational_gain + by_replica(work.rotational_gain),
                key=internal.key,
            ),
        )
        if isinstance(state.tangents, HardTangents):
            along = exchange_tangents_after(state, self.scene, chosen, work, duration)
        elif state.tangents is not None:
            along = projected_tangents_after(new, self.scene, chosen, work, duration)
        else:
            return new
        return new._replace(tangents=along)

    def recover(self, now: Progress, began: State) -> tuple[State, Int[Array, ""]]:
        """Where a new list was outrun the window is shortened; where it is crowded, the skin."""
        state = now.state
        fresh = state.time == began.time  # else a new list is all that an outrun skin needs
        shorten = status.has(now.status, status.SKIN_OUTRUN) & fresh
        # Only where the capacity sufficed, so that this does not depend on a resumed run's.
        crowded = (now.needed[0] > CROWDED * len(state.position)) & (now.status == status.OK)
        shorter = jnp.maximum(0.8 * state.skin, jnp.minimum(state.skin, MIN_SKIN))
        beyond = status.LIST_FULL.bit | status.CONTACTS_FULL.bit
        beyond |= status.NOT_FINITE.bit | status.STALLED.bit
        window = jnp.where(shorten, 0.5 * state.internal.window, state.internal.window)
        mended = state._replace(
            skin=jnp.where(crowded, shorter, state.skin),
            internal=state.internal._replace(window=window),
        )
        return mended, now.status & beyond


@jax.jit
def _prepare(dynamics: HardDynamics, state: State, end: ArrayLike) -> tuple[State, Array, Array]:
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
