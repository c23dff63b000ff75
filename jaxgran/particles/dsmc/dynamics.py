"""DSMC as a kind of particles: the steps of a run, with walls, a drive and drag.

A step lets random pairs collide (`jaxgran.particles.dsmc.collisions`), applies walls and a drive,
and updates the tangents of the run. The units are the impact speed sqrt(2 T_0) and the path length.
Spins are ``s = (sigma/2) w``, a velocity. With drag the velocities, spins and time are transformed:
see `jaxgran.particles.elements`.

Walls and a drive act on subsets of the particles. The kicks of a drive in one step are far smaller
than the velocities. So each half of a step kicks only some of the subsets, in turn, with the
variance of all steps until their next turn: the mean energy of a step is the same, at a lower cost.
The energy of a kick is limited; under a strong drive each half of a step kicks all particles.

Subsets that hit walls are drawn at random in each step, so that spheres hit walls with their
current velocity. With fixed turns, a mean free time apart, spheres that have lost speed would not
come later, and the loss would be .9 % of T too large. A step draws as many subsets as the fastest
spheres need, and a sphere in them hits a wall with a larger probability.
"""

from collections.abc import Callable
from functools import partial
from math import pi, sqrt
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.random import threefry_2x32
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray, UInt32

from jaxgran._utils import status
from jaxgran.gradients.rule import Records
from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles import observables
from jaxgran.particles.dsmc.collisions import (
    CEILING,
    MAX_SUBSETS,
    Outcome,
    Scheme,
    change_subsets,
    collide,
    draw_pairs,
    num_subsets,
    waiting_time,
)
from jaxgran.particles.dynamics import AbstractDynamics, advance_time, time_left
from jaxgran.particles.elements import (
    MAX_KICK,
    DragDecay,
    drag_decay,
    exchange_slopes,
    kick_growth,
    random_kicks,
    tangential_impulse,
    threefry_key,
)
from jaxgran.particles.start import maxwellian_spins, maxwellian_velocities
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.reduced import ReducedScene
from jaxgran.scene.walls import wall_impact_ratio
from jaxgran.theory.averages import collision_rate

FASTEST_SPEED = 3.5
"""Speed along an axis, in sqrt(2 T), up to which the rate of impacts on walls is right; one of 1e6
particles is faster."""

RECOUNT_INTERVAL = 32
"""Number of steps between computations of T from the velocities.

In between the losses update T. The rounding errors of this sum do not shrink as T falls, and in
float32 they would dominate T once it has fallen to 1e-7 of its initial value.
"""

ALLOWED_MISSED = 1e-4
"""Largest share of collisions that a run may miss because of the ceiling of the collision rate."""

CHUNK = 4_000_000
"""Candidate pairs in one call of `DSMCDynamics.advance`, which takes about a second."""

MIN_STEPS = 16
"""Least number of steps in one call of `DSMCDynamics.advance`."""

COLLISION_STREAM = 0
WALL_STREAM = 1
KICK_STREAMS = 2, 3
DURATION_STREAM = 4
"""Streams of the random numbers of a step. Those of kicks are of its start and of its end."""


class DSMCGas(NamedTuple):
    """Particles of all replicas, each at its own time.

    Attributes:
        time: time of each replica.
        time_rest: rounding error of `time`, for a compensated sum.
        duration: length of the next step over its mean, see `waiting_time`.
        temperature: T/T_0, updated by the losses, recomputed every `RECOUNT_INTERVAL` steps.
        particles: the d components of v, the spins of rough spheres, and the d components of
            x - v t, which only collisions change. With drag they are transformed, see `elements`.
        collisions: number of pairs that collided.
        missed: number of collisions missed because of the `CEILING`.
        steps: number of steps.
        tangents: of the energies, see `ExchangeTangents`; None without them.
    """

    time: Float[Array, "*replicas"]
    time_rest: Float[Array, "*replicas"]
    duration: Float[Array, "*replicas"]
    temperature: Float[Array, "*replicas"]
    particles: Float[Array, "*replicas N components"]
    collisions: Float[Array, "*replicas"]
    missed: Float[Array, "*replicas"]
    steps: UInt32[Array, "*replicas"]
    tangents: Any = None


class DSMCState(NamedTuple):
    """State of R replicas of N particles.

    Attributes:
        time: time that all replicas have reached.
        status: faults of each replica, known once it has reached a time.
        key: two 32-bit words of a key of random numbers.
        first_velocity: velocities at t = 0.
        gas: particles at the beginnings of the steps that end beyond `time`.
        shown: particles at `time`, after a part of these steps.
    """

    time: Float[Array, ""]
    status: Int[Array, "replicas"]
    key: UInt32[Array, "2"]
    first_velocity: Float[Array, "replicas N d"]
    gas: DSMCGas
    shown: DSMCGas


def split_columns(
    particles: Float[Array, "*rows components"], d: int
) -> tuple[Float[Array, "*rows d"], Float[Array, "*rows spins"], Float[Array, "*rows d"]]:
    """Return the velocities, the spins and x - v t of particles, see `DSMCGas`."""
    return particles[..., :d], particles[..., d:-d], particles[..., -d:]


class SubsetCounts(NamedTuple):
    """Numbers of subsets that take part in a step.

    Attributes:
        kicked: those that a drive kicks in half of the step; None without a drive.
        at_walls: those that may hit walls in the step; None without walls.
    """

    kicked: Int[Array, "*replicas"] | None = None
    at_walls: Int[Array, "*replicas"] | None = None


class EnergyGains(NamedTuple):
    """Gains of sum v^2 and, of spheres that rotate, of q sum s^2, and their tangents.

    Attributes:
        values: of both energies, or of one.
        by_direction: along directions in the scene, of which the last is the direction of time;
            None without tangents.
        by_scale: in the logarithms of all velocities and of all spins; None without tangents.
    """

    values: Float[Array, "energies"]
    by_direction: Float[Array, "directions energies"] | None = None
    by_scale: Float[Array, "energies energies"] | None = None


def directional_slopes(gradient: Any, directions: Any) -> Float[Array, "p"]:
    """Return the derivatives along some directions, from the derivatives in all numbers."""
    products = jax.tree.map(lambda g, x: jnp.tensordot(x, g, g.ndim), gradient, directions)
    return sum(jax.tree.leaves(products), start=jnp.zeros(1))  # a law may have no floats


def wall_impact_rate(
    eps: Float[Array, "*#rows"], frequency: Float[Array, "*#rows"], dimension: int
) -> Float[Array, "..."]:
    """Return the rate of impacts of a sphere on walls in a step, over its speed along the axis.

    A sphere between two walls hits one of them at the rate ``|v|/(L - sigma)``, times the ratio of
    the density before walls to the mean (`wall_impact_ratio`). A gas at T_0 has a mean |v| of
    ``1/sqrt(pi)``, and hits them with the given frequency: ``1/(L - sigma)`` is
    ``sqrt(pi) frequency``. Each step has walls across one axis, in turn, with d times this rate.

    Args:
        eps: restitution of the walls at the speed of an impact.
        frequency: `ReducedWalls.frequency` of the axis.
        dimension: d.
    """
    ratio = wall_impact_ratio(eps, frequency / collision_rate(0.0, dimension), dimension)
    return dimension * sqrt(pi) * ratio * frequency


def wall_impacts(
    scene: ReducedScene,
    decay: DragDecay,
    velocity_factor: Float[Array, ""],
    spin_factor: Float[Array, ""],
    *,
    rows: Float[Array, "rows components"],
    axis: Int[Array, ""],
    uniform: Float[Array, "rows"],
    dt: Float[Array, ""],
) -> tuple[Float[Array, "energies"], tuple[Float[Array, "rows d"], Float[Array, "rows spins"]]]:
    """Return the gains by impacts on walls in a step, and the velocities and spins after it.

    Args:
        scene, decay, velocity_factor, spin_factor: see `DSMCDynamics._exchanged`.
        rows: particles.
        axis: across which the walls are.
        uniform: random numbers; a particle hits a wall if its number is below the expected number
            of its impacts.
        dt: length of the step.
    """
    walls = scene.walls
    surface = scene.surface
    d = walls.frequency.size
    velocity, spin, _ = split_columns(rows, d)
    velocity = velocity * velocity_factor
    spin = spin * spin_factor
    across = (jnp.arange(d, dtype=jnp.int32) == axis).astype(rows.dtype)[None]
    normal = jnp.sum(velocity * across, axis=1)
    speed = jnp.abs(normal)
    outwards = jnp.sign(normal)[:, None] * across
    eps = walls.law.restitution(jnp.where(speed > 0, speed * decay.velocity, 1.0))
    rate = wall_impact_rate(eps, walls.frequency[axis], d)
    num_impacts = rate * speed * dt
    hits = (uniform < num_impacts) & (speed > 0)
    push = jnp.where(hits, (1 + eps) * speed, 0.0)
    kick = -push[:, None] * outwards
    spin_change = jnp.zeros_like(spin)
    if surface is not None and walls.surface is not None:
        eta = surface.eta_on_wall(walls.surface)
        _, sliding_kick, spin_change = tangential_impulse(
            velocity, spin, outwards, hits, eta, surface, push
        )
        kick = kick + sliding_kick
    # The number of impacts is not differentiable, so weights of value 1 carry its derivative.
    weight = (rate / jax.lax.stop_gradient(rate))[:, None]
    gains = [jnp.sum(weight * kick * (2 * velocity + kick))]
    if surface is not None:
        gain = jnp.sum(weight * spin_change * (2 * spin + spin_change))
        gains.append(surface.inertia * gain / decay.spin_over_velocity**2)
    return jnp.stack(gains), (velocity + kick, (spin + spin_change) / decay.spin_over_velocity)


class DSMCDynamics(AbstractDynamics):
    """A homogeneous gas by steps of random collisions.

    Attributes:
        scene: the gas in reduced units.
        scheme: sizes of a step.
        shape: number of replicas, of particles in each, and dimension d.
    """

    scene: ReducedScene
    scheme: Scheme = eqx.field(static=True)
    shape: tuple[int, int, int] = eqx.field(static=True)

    capacity: ClassVar[None] = None

    @property
    def calls_host(self) -> bool:
        """False: all is compiled."""
        return False

    @property
    def num_energies(self) -> int:
        """Number of energies that particles exchange: 2 if they rotate."""
        return 1 if self.scene.surface is None else 2

    def random_start(self, key: Any, each: Callable, reach: Callable) -> tuple[None, Any]:
        """Return no start: velocities are drawn by `initial`."""
        return None, jnp.zeros(key.shape, jnp.int32)

    @property
    def equilibrium(self) -> None:
        """None: particles have no places."""
        return None

    def with_new_velocities(self, start: None, key: PRNGKeyArray) -> None:
        """Return no start, see `random_start`."""
        return None

    def initial(self, start: Any, key: PRNGKeyArray, directions: Any) -> DSMCState:
        """Return the state at t = 0, with Maxwellian velocities.

        T is then 1, and T_rot as in the scene.
        """
        scene = self.scene
        (replicas, n, d) = self.shape
        words = jax.random.bits(key, (2,), jnp.uint32)
        key = jax.random.fold_in(threefry_key(words), 2**32 - 1)
        velocity = maxwellian_velocities(key, self.shape)
        v = velocity.reshape(replicas, -1, d)
        columns = [v / sqrt(2)]
        if scene.surface is not None:
            key = jax.random.fold_in(key, 0)
            mean_square = (scene.surface.ratio / (2 * scene.surface.inertia)).astype(v.dtype)
            spins = maxwellian_spins(key, (replicas, n, NUM_SPIN_COMPONENTS[d]), mean_square)
            columns.append(spins)
        columns.append(jnp.zeros_like(v))
        tangents = None
        if directions is not None:
            tangents = ExchangeTangents.initial(directions, scene, velocity, replicas)
        zero = jnp.zeros(replicas, v.dtype)
        gas = DSMCGas(
            time=zero,
            time_rest=zero,
            duration=waiting_time(jax.random.fold_in(key, 1), self.scheme.candidates, zero),
            temperature=zero + 1,
            particles=jnp.concatenate(columns, axis=-1),
            collisions=zero,
            missed=zero,
            steps=jnp.zeros(replicas, jnp.uint32),
            tangents=tangents,
        )
        return DSMCState(
            time=jnp.zeros((), v.dtype),
            status=jnp.zeros(replicas, jnp.int32),
            key=words,
            first_velocity=columns[0],
            gas=gas,
            shown=gas,
        )

    def unfinished(self, state: DSMCState, until: ArrayLike) -> Bool[Array, ""]:
        return jnp.any(state.status == status.OK) & (state.time < until)

    def advance(self, state: DSMCState, until: ArrayLike) -> DSMCState:
        """Advance each replica by whole steps to the last one that ends before a time.

        Once all have reached it, they do the next step in part, exactly up to this time. Both are
        one program, because the step takes nearly all of the time of its compilation.
        """
        candidates = self.shape[0] * self.scheme.candidates
        most = jnp.asarray(max(CHUNK // candidates, MIN_STEPS), jnp.int32)

        def move(gases: tuple[DSMCGas, DSMCGas], in_part: Array) -> tuple:
            gas, shown = gases
            reached = ~jnp.any(self.is_due(gas, until))
            num_steps = jnp.where(in_part, reached.astype(jnp.int32), most)
            after = self._steps(gas, state.key, until, num_steps, in_part)
            moved = jax.tree.map(partial(jnp.where, in_part), (gas, after), (after, shown))
            return moved, None

        in_parts = jnp.array([False, True])
        (gas, shown), _ = jax.lax.scan(move, (state.gas, state.shown), in_parts)
        reached = ~jnp.any(self.is_due(gas, until))
        time = jnp.where(reached, until, jnp.min(gas.time))
        too_fast = shown.missed > ALLOWED_MISSED * shown.collisions + 1
        finite = jnp.isfinite(jnp.sum(shown.particles, axis=(1, 2)))
        fault = status.flag(status.TOO_FAST, too_fast) | status.flag(status.NOT_FINITE, ~finite)
        return state._replace(
            time=jnp.maximum(time, state.time),
            status=jnp.where(reached, state.status | fault, state.status),
            gas=gas,
            shown=shown,
        )

    def observe(self, state: DSMCState) -> Records:
        return dsmc_records(self, state)

    def to_lab_frame(self, state: DSMCState) -> tuple[Array, Array, Array | None]:
        d = self.scheme.dimension
        velocity, spins, _ = split_columns(state.shown.particles, d)
        decay = drag_decay(self.scene.drag, state.time)
        velocity = (velocity * decay.velocity).reshape(-1, d)
        spin = None
        if self.scene.surface is not None:
            spin = (spins * decay.spin).reshape(-1, spins.shape[-1])
        return jnp.full_like(velocity, jnp.nan), velocity, spin

    def max_wall_impacts(
        self, gas: DSMCGas, ds: Float[Array, "*replicas"]
    ) -> Float[Array, "*replicas"]:
        """Return the number of wall impacts in a step of a sphere of the speed `FASTEST_SPEED`."""
        walls = self.scene.walls
        d = self.scheme.dimension
        speed = FASTEST_SPEED * jnp.sqrt(gas.temperature)
        true_speed = speed * drag_decay(self.scene.drag, gas.time).velocity
        eps = walls.law.restitution(true_speed)[..., None]
        frequency = jnp.broadcast_to(walls.frequency, (*eps.shape[:-1], d))
        return jnp.max(wall_impact_rate(eps, frequency, d), axis=-1) * speed * ds

    def full_step(self, gas: DSMCGas) -> Float[Array, "*replicas"]:
        """Return the time in which all candidates of the next step happen."""
        return gas.duration * self.scheme.scaled_step / jnp.sqrt(gas.temperature)

    def step_length(self, gas: DSMCGas) -> Float[Array, "*replicas"]:
        """Return the length of a step: spheres hit at most one wall, and kicks are small."""
        ds = self.full_step(gas)
        if self.scene.walls is not None:
            ds = ds / jnp.maximum(self.max_wall_impacts(gas, ds), 1.0)
        if self.scene.drive is None:
            return ds
        growth = self.scene.drive / drag_decay(self.scene.drag, gas.time).velocity ** 3
        safe = jnp.where(growth > 0, growth, 1.0)
        return jnp.where(growth > 0, jnp.minimum(ds, MAX_KICK * gas.temperature / safe), ds)

    def is_due(self, gas: DSMCGas, until: ArrayLike) -> Bool[Array, "*replicas"]:
        """Return whether the next step of each replica ends before a time."""
        return self.step_length(gas) <= time_left(gas, until)

    def subset_counts(self, gas: DSMCGas, step_share: Float[Array, "*replicas"]) -> SubsetCounts:
        """Return the numbers of subsets that take part in a share of a step.

        A drive kicks so many subsets in half of it that T of none grows by more than the share
        `MAX_KICK`. Particles that are kicked in turn then have temperatures that differ by up to
        w T, by which a_2 of all particles is too large by ``w^2/12``, at most 2e-4. So many subsets
        may hit walls that one of the fastest spheres hits at most one.
        """
        scene = self.scene
        subsets = num_subsets(self.scheme.num_particles)
        ds = step_share * self.full_step(gas)

        def at_least(needed: Array) -> Array:
            return jnp.clip(jnp.ceil(needed), 1, subsets).astype(jnp.int32)

        counts = SubsetCounts()
        if scene.drive is not None:
            growth = kick_growth(scene.drive, scene.drag, gas.time, ds).at_start
            safe = jnp.where(gas.temperature > 0, gas.temperature, 1.0)
            counts = counts._replace(kicked=at_least(subsets * growth / (MAX_KICK * safe)))
        if scene.walls is not None:
            impacts = self.max_wall_impacts(gas, ds)
            counts = counts._replace(at_walls=at_least(subsets * impacts))
        return counts

    def _steps(
        self,
        gas: DSMCGas,
        key: UInt32[Array, "2"],
        until: ArrayLike,
        num_steps: Int[Array, ""],
        in_part: Bool[Array, ""],
    ) -> DSMCGas:
        """Do whole steps that end before a time, or one in part up to it, at most `num_steps`."""
        scene = self.scene

        def unfinished(carry: tuple) -> Array:
            gas, steps_left = carry
            return (in_part | jnp.any(self.is_due(gas, until))) & (steps_left > 0)

        def step_due(carry: tuple) -> tuple:
            gas, steps_left = carry
            full = self.full_step(gas)
            due = self.is_due(gas, until).astype(gas.time.dtype)
            if scene.drive is not None or scene.walls is not None:
                due = due * self.step_length(gas) / full
            last = jnp.clip(time_left(gas, until) / full, 0.0, 1.0)
            step_share = jnp.where(in_part, last, due)
            # A step ends with its last candidate, which does not happen within the step.
            chance = jnp.where(in_part, last * (1 - 1 / self.scheme.candidates), due)
            return self.step(gas, key, step_share, chance), steps_left - 1

        return jax.lax.while_loop(unfinished, step_due, (gas, num_steps))[0]

    def step(
        self,
        gas: DSMCGas,
        key: UInt32[Array, "2"],
        step_share: Float[Array, "replicas"],
        chance: Float[Array, "replicas"],
    ) -> DSMCGas:
        """Do a share, 0 to 1, of the next step of each replica, with a chance of each candidate."""
        replicas = jnp.arange(self.shape[0], dtype=jnp.uint32)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(threefry_key(key), replicas)
        counts = self.subset_counts(gas, step_share)
        largest = jax.tree.map(jnp.max, counts)
        step_replica = partial(self._step, largest=largest)
        axes = jax.tree.map(lambda _: 0, gas._replace(tangents=None))
        if gas.tangents is not None:
            last = jax.tree.map(lambda _: -1, gas.tangents._replace(directions=None))
            axes = axes._replace(tangents=last)
        step_all = jax.vmap(step_replica, (axes, 0, 0, 0, 0), axes)
        gas = step_all(gas, keys, counts, step_share, chance)
        due = gas.steps % RECOUNT_INTERVAL == 0

        def recount(temperature: Array) -> Array:
            velocity, _, _ = split_columns(gas.particles, self.scheme.dimension)
            from_velocities = 2 * jnp.mean(velocity**2, axis=(1, 2))
            return jnp.where(due, from_velocities, temperature)

        temperature = jax.lax.cond(jnp.any(due), recount, lambda x: x, gas.temperature)
        return gas._replace(temperature=temperature)

    def _step(
        self,
        gas: DSMCGas,
        key: PRNGKeyArray,
        counts: SubsetCounts,
        step_share: Float[Array, ""],
        chance: Float[Array, ""],
        largest: SubsetCounts,
    ) -> DSMCGas:
        """Do a share, 0 to 1, of a step of one replica; random numbers do not depend on the share.

        Each collision of the whole step takes place with the probability `chance`, so that the
        state within a step is as accurate as at its end. `largest` are the largest `counts` of all
        replicas.
        """
        scheme = self.scheme
        start = gas
        key = jax.random.fold_in(key, start.steps)
        dt = step_share * self.full_step(start)
        kick = partial(self._kick, start=start, key=key, dt=dt, counts=counts, largest=largest)
        gas = kick(start, place=0)
        particles, gains, num, missed = self._collide(gas, key, dt, chance)
        gas = gas._replace(particles=particles)
        particles, gains = self._hit_walls(gas, key, dt, counts, largest, gains)
        energy = scheme.num_particles * scheme.dimension / 2  # sum v^2 at T_0
        duration_key = jax.random.fold_in(key, DURATION_STREAM)
        next_duration = waiting_time(duration_key, scheme.candidates, gas.duration)
        gas = advance_time(gas, dt)._replace(
            duration=jnp.where(step_share > 0, next_duration, gas.duration),
            temperature=gas.temperature + gains.values[0] / energy,
            particles=particles,
            collisions=gas.collisions + num,
            missed=gas.missed + missed,
            steps=gas.steps + (step_share > 0).astype(gas.steps.dtype),
        )
        gas = kick(gas, place=1)
        if start.tangents is None:
            return gas
        return gas._replace(tangents=self._tangents_after(start, gains, dt, num))

    def _kick(
        self,
        gas: DSMCGas,
        start: DSMCGas,
        key: PRNGKeyArray,
        dt: Float[Array, ""],
        counts: SubsetCounts,
        largest: SubsetCounts,
        place: int,
    ) -> DSMCGas:
        """Apply half of the kicks of a step, at its start (place 0) or end (1).

        `start` is the gas before the step.
        """
        count = counts.kicked
        if count is None or largest.kicked is None:
            return gas
        scene = self.scene
        d = self.scheme.dimension
        subsets = num_subsets(self.scheme.num_particles)
        growth = kick_growth(scene.drive, scene.drag, start.time, dt)[place]
        key = jax.random.fold_in(key, KICK_STREAMS[place])
        zero_momentum = scene.walls is None
        size = jnp.sqrt(growth / 2 * (subsets / count).astype(growth.dtype))

        def kick(i: Array, rows: Array, belongs: Array) -> tuple[Array, Array]:
            v, spin, at_zero = split_columns(rows, d)
            kicks = random_kicks(jax.random.fold_in(key, i), v, zero_momentum, belongs)
            kicks = jnp.where(belongs[:, None], size * kicks, 0.0)
            after = [v + kicks, spin, at_zero - gas.time * kicks]
            return jnp.concatenate(after, axis=-1), jnp.sum(kicks * (2 * v + kicks))

        first = count * (2 * gas.steps + place).astype(jnp.int32)
        zero = jnp.zeros((), growth.dtype)
        particles, gain = change_subsets(gas.particles, first, count, largest.kicked, kick, zero)
        grown = 2 * gain / (self.scheme.num_particles * d)
        return gas._replace(particles=particles, temperature=gas.temperature + grown)

    def _collide(
        self, gas: DSMCGas, key: PRNGKeyArray, dt: Float[Array, ""], chance: Float[Array, ""]
    ) -> tuple[Float[Array, "N components"], EnergyGains, Float[Array, ""], Float[Array, ""]]:
        """Return the particles after the collisions of a step, gains, and numbers of collisions.

        The numbers are of collisions that happened, and of missed ones.
        """
        d = self.scheme.dimension
        first = self.scheme.first
        second = self.scheme.second
        bits = random_words(jax.random.fold_in(key, COLLISION_STREAM), first + second + 2)
        i, j, k = draw_pairs(bits[:, -2:].ravel(), self.scheme)
        index = jnp.concatenate([i, j, k])
        options = {"mode": "promise_in_bounds", "unique_indices": True}
        old = gas.particles.at[index, :-d].get(**options)
        v = old[:, :d]
        spin = old[:, d:]
        # Collisions happen at the middle of the step, on average: x - v t changes by -kick t.
        middle = gas.time + dt / 2
        ceiling = CEILING * jnp.sqrt(gas.temperature)

        def collided(relative: Array, spins: Array, bits: Array) -> tuple[EnergyGains, Outcome]:
            def of_scene(
                scene: ReducedScene, decay: DragDecay, velocity_factor: Array, spin_factor: Array
            ) -> tuple[Array, Outcome]:
                outcome = collide(
                    relative * velocity_factor,
                    bits,
                    ceiling,
                    chance,
                    scene,
                    spins * spin_factor,
                    decay.velocity,
                )
                gains = outcome.gains.at[1:].divide(decay.spin_over_velocity**2)
                return gains, outcome._replace(
                    spin_change=outcome.spin_change / decay.spin_over_velocity
                )

            return self._exchanged(of_scene, middle, gas.tangents)

        firsts = v[:first] - v[first : 2 * first]
        gains, one = collided(firsts, spin[:first] + spin[first : 2 * first], bits[:, :first])
        kick = one.kick
        turn = one.spin_change
        seconds = v[:second] + kick[:second] - v[2 * first :]
        second_spins = spin[:second] + turn[:second] + spin[2 * first :]
        more, two = collided(seconds, second_spins, bits[:, first:-2])
        kicks = jnp.concatenate([kick[:second] + two.kick, kick[second:], -kick, -two.kick])
        turns = [turn[:second] + two.spin_change, turn[second:], turn, two.spin_change]
        changes = [kicks, jnp.concatenate(turns), -middle * kicks]
        particles = gas.particles.at[index].add(jnp.concatenate(changes, axis=-1), **options)
        gains = jax.tree.map(jnp.add, gains, more)
        return particles, gains, one.num + two.num, one.missed + two.missed

    def _hit_walls(
        self,
        gas: DSMCGas,
        key: PRNGKeyArray,
        dt: Float[Array, ""],
        counts: SubsetCounts,
        largest: SubsetCounts,
        gains: EnergyGains,
    ) -> tuple[Float[Array, "N components"], EnergyGains]:
        """Let particles hit walls in a step, independent of their places.

        Args:
            gas: after the collisions of the step, at the time before it.
            key: of the random numbers of the step.
            dt: length of the step.
            counts: numbers of subsets of this replica.
            largest: the largest of all replicas.
            gains: by the collisions of the step.

        Returns:
            The particles, and the gains of the step.
        """
        count = counts.at_walls
        if count is None or largest.at_walls is None:
            return gas.particles, gains
        d = self.scheme.dimension
        key = jax.random.fold_in(key, WALL_STREAM)
        subsets = num_subsets(self.scheme.num_particles)
        middle = gas.time + dt / 2
        axis = (gas.steps % d).astype(jnp.int32)

        def hit_rows(i: Array, rows: Array, belongs: Array) -> tuple[Array, EnergyGains]:
            bits = jax.random.bits(jax.random.fold_in(key, i), belongs.shape, jnp.uint16)
            drawn_share = (count / subsets).astype(rows.dtype)
            uniform = (bits.astype(rows.dtype) + 0.5) * 2.0**-16 * drawn_share
            uniform = jnp.where(belongs, uniform, jnp.inf)
            of_scene = partial(wall_impacts, rows=rows, axis=axis, uniform=uniform, dt=dt)
            gains, (velocity, spin) = self._exchanged(of_scene, middle, gas.tangents)
            return jnp.concatenate([velocity, spin, rows[:, -d:]], axis=-1), gains

        bits = jax.random.bits(jax.random.fold_in(key, MAX_SUBSETS), (), jnp.uint16)
        first = (bits % subsets).astype(jnp.int32)
        return change_subsets(gas.particles, first, count, largest.at_walls, hit_rows, gains)

    def _exchanged(
        self,
        of_scene: Callable[..., tuple[Float[Array, "energies"], Any]],
        middle: Float[Array, ""],
        tangents: ExchangeTangents | None,
    ) -> tuple[EnergyGains, Any]:
        """Return the gains by impacts at the middle of a step, and other results.

        Args:
            of_scene: returns both, as a function of the scene, the decay by drag, and factors of
                velocities and spins.
            middle: the time.
            tangents: of the gas; None for gains without tangents.
        """

        def gained(scene: ReducedScene, log_scales: Float[Array, "energies"]) -> tuple[Array, Any]:
            decay = drag_decay(scene.drag, middle)
            spin_factor = decay.spin_over_velocity
            if scene.surface is not None:  # at a given energy a larger inertia has smaller spins
                inertia = scene.surface.inertia
                inertia_factor = jnp.sqrt(jax.lax.stop_gradient(inertia) / inertia)
                spin_factor = spin_factor * jnp.exp(log_scales[1]) * inertia_factor
            return of_scene(scene, decay, jnp.exp(log_scales[0]), spin_factor)

        same = jnp.zeros(self.num_energies, middle.dtype)
        if tangents is None:
            gains, others = gained(self.scene, same)
            return EnergyGains(gains), others
        gains, pull, others = jax.vjp(gained, self.scene, same, has_aux=True)

        def slopes(weights: Array) -> tuple[Array, Array]:
            in_scene, in_scales = pull(weights)
            return directional_slopes(in_scene, tangents.directions), in_scales

        by_direction, by_scale = jax.vmap(slopes)(jnp.eye(self.num_energies, dtype=same.dtype))
        return EnergyGains(gains, by_direction.T, by_scale.T), others

    def _tangents_after(
        self, start: DSMCGas, gains: EnergyGains, ds: Array, collisions: Array
    ) -> ExchangeTangents:
        """Return the tangents after a step with some gains by impacts, and the kicks of a drive."""
        d = self.scheme.dimension
        scene = self.scene
        values, by_direction, by_scale = gains
        assert by_direction is not None and by_scale is not None
        if scene.drive is not None:

            def heating(scene: ReducedScene) -> Array:
                growth = kick_growth(scene.drive, scene.drag, start.time, ds)
                return self.scheme.num_particles * d / 2 * (growth.at_start + growth.at_end)

            heat, pull = jax.vjp(heating, scene)
            (in_scene,) = pull(jnp.ones_like(heat))
            slopes = directional_slopes(in_scene, start.tangents.directions)
            values = values.at[0].add(heat)
            by_direction = by_direction.at[:, 0].add(slopes)
            # The rate of impacts depends on the speeds; kicks do not depend on them.
            by_scale = by_scale.at[0, 0].add(-heat)
        velocity, spin, _ = split_columns(start.particles, d)
        energies = [jnp.sum(velocity**2)]
        if scene.surface is not None:
            energies.append(scene.surface.inertia * jnp.sum(spin**2))
        return start.tangents.after(jnp.stack(energies), values, by_direction, by_scale, collisions)


def random_words(key: PRNGKeyArray, count: int) -> UInt32[Array, "2 count"]:
    """Return two random 32-bit words for each of `count` calls of threefry.

    `jax.random.bits` makes one word of 32 bits of each call.
    """
    first, second = jax.random.key_data(key)
    counters = jnp.arange(2 * count, dtype=jnp.uint32)
    return threefry_2x32((first, second), counters).reshape(2, count)


@jax.jit
def dsmc_records(dynamics: DSMCDynamics, state: DSMCState) -> Records:
    """Return the records of a state."""
    scene = dynamics.scene
    gas = state.shown
    _, n, d = dynamics.shape
    v, spin, at_zero = split_columns(gas.particles, d)
    velocity = v
    if scene.walls is None:  # walls stop the gas as a whole
        velocity = v - jnp.mean(v, axis=1, keepdims=True)
    decay = drag_decay(scene.drag, state.time)
    theta = 2 * observables.temperature(velocity)
    correlation = 2 * observables.velocity_correlation(state.first_velocity, velocity)
    values = {
        "temperature": theta * decay.velocity**2,
        "sonine": observables.sonine(velocity),
        "velocity_correlation": correlation * decay.velocity,
        "collisions": 2 / n * gas.collisions,
    }
    if scene.walls is None:  # walls would limit <dr^2>
        position = at_zero + gas.time[:, None, None] * v
        displacement = position - jnp.mean(position, axis=1, keepdims=True)
        values["displacement"] = observables.mean_square_displacement(displacement)
    if scene.surface is not None:
        rotational = 2 * scene.surface.inertia * jnp.mean(spin**2, (1, 2))
        values["rotational_temperature"] = rotational * decay.spin**2
    tangents = gas.tangents
    if tangents is None:
        return Records(values, {}, {})
    rates, slopes = exchange_slopes(
        values, tangents, scene.drag, tangents.directions.drag, state.time, n, d
    )
    return Records(values, rates, slopes)
