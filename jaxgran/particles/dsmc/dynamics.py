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
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.elements import (
    MAX_KICK,
    DragDecay,
    drag_decay,
    exchange_slopes,
    kick_variance,
    random_kicks,
    random_words,
    tangential_impulse,
    threefry_key,
)
from jaxgran.particles.start import maxwellian_spins, maxwellian_velocities
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS, wall_impact_ratio
from jaxgran.scene.gas import ReducedScene
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


SubsetCounts = tuple[Int[Array, "*replicas"] | None, Int[Array, "*replicas"] | None]
"""Numbers of subsets that a drive kicks in half of a step, and of those that may hit walls in the
step; None without a drive or walls."""


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
        parts = [v / sqrt(2)]
        if scene.surface is not None:
            key = jax.random.fold_in(key, 0)
            mean_square = (scene.surface.ratio / (2 * scene.surface.inertia)).astype(v.dtype)
            spins = maxwellian_spins(key, (replicas, n, NUM_SPIN_COMPONENTS[d]), mean_square)
            parts.append(spins)
        parts.append(jnp.zeros_like(v))
        tangents = None
        if directions is not None:
            tangents = ExchangeTangents.initial(directions, scene, velocity, replicas)
        zero = jnp.zeros(replicas, v.dtype)
        gas = DSMCGas(
            time=zero,
            time_rest=zero,
            duration=waiting_time(jax.random.fold_in(key, 1), self.scheme.candidates, zero),
            temperature=zero + 1,
            particles=jnp.concatenate(parts, axis=-1),
            collisions=zero,
            missed=zero,
            steps=jnp.zeros(replicas, jnp.uint32),
            tangents=tangents,
        )
        return DSMCState(
            time=jnp.zeros((), v.dtype),
            status=jnp.zeros(replicas, jnp.int32),
            key=words,
            first_velocity=parts[0],
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
        particles = state.shown.particles
        decay = drag_decay(self.scene.drag, state.time)
        velocity = particles[..., :d] * decay.velocity
        spin = None
        if self.scene.surface is not None:
            spins = particles[..., d:-d] * decay.true_spin
            spin = spins.reshape(-1, spins.shape[-1])
        velocity = velocity.reshape(-1, d)
        return jnp.full_like(velocity, jnp.nan), velocity, spin

    def kick_growth(
        self, start: Float[Array, "*replicas"], ds: Float[Array, "*replicas"], place: float
    ) -> Float[Array, "*replicas"]:
        """Return the growth of T/T_0 by half of the kicks of a step.

        They come at its start (place 0) or end (1).
        """
        return kick_variance(self.scene.drive, self.scene.drag, start, ds, place)

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
        ratio = wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)
        return jnp.max(ratio * frequency, axis=-1) * (d * sqrt(pi)) * speed * ds

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

    def subsets_per_step(self, gas: DSMCGas, share: Float[Array, "*replicas"]) -> SubsetCounts:
        """Return the numbers of subsets that take part in a share of a step.

        A drive kicks so many subsets in half of it that T of none grows by more than the share
        `MAX_KICK`. Particles that are kicked in turn then have temperatures that differ by up to
        w T, by which a_2 of all particles is too large by ``w^2/12``, at most 2e-4. So many subsets
        may hit walls that one of the fastest spheres hits at most one.
        """
        parts = num_subsets(self.scheme.num_particles)
        ds = share * self.full_step(gas)

        def at_least(needed: Array) -> Array:
            return jnp.clip(jnp.ceil(needed), 1, parts).astype(jnp.int32)

        kicks = walls = None
        if self.scene.drive is not None:
            growth = self.kick_growth(gas.time, ds, 0.0)
            safe = jnp.where(gas.temperature > 0, gas.temperature, 1.0)
            kicks = at_least(parts * growth / (MAX_KICK * safe))
        if self.scene.walls is not None:
            walls = at_least(parts * self.max_wall_impacts(gas, ds))
        return kicks, walls

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
            share = self.is_due(gas, until).astype(gas.time.dtype)
            if scene.drive is not None or scene.walls is not None:
                share = share * self.step_length(gas) / full
            part = jnp.clip(time_left(gas, until) / full, 0.0, 1.0)
            # A step ends with its last candidate, which does not happen within the step.
            part_chance = part * (1 - 1 / self.scheme.candidates)
            chance = jnp.where(in_part, part_chance, share)
            return self.step(gas, key, jnp.where(in_part, part, share), chance), steps_left - 1

        return jax.lax.while_loop(unfinished, step_due, (gas, num_steps))[0]

    def step(
        self,
        gas: DSMCGas,
        key: UInt32[Array, "2"],
        share: Float[Array, "replicas"],
        chance: Float[Array, "replicas"],
    ) -> DSMCGas:
        """Do a share, 0 to 1, of the next step of each replica, with a chance of each candidate."""
        replicas = jnp.arange(self.shape[0], dtype=jnp.uint32)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(threefry_key(key), replicas)
        subsets = self.subsets_per_step(gas, share)
        largest = jax.tree.map(jnp.max, subsets)
        step_replica = partial(self._step, largest=largest)
        axes = jax.tree.map(lambda _: 0, gas._replace(tangents=None))
        if gas.tangents is not None:
            last = jax.tree.map(lambda _: -1, gas.tangents._replace(directions=None))
            axes = axes._replace(tangents=last)
        gas = jax.vmap(step_replica, (axes, 0, 0, 0, 0), axes)(gas, keys, subsets, share, chance)
        due = gas.steps % RECOUNT_INTERVAL == 0

        def recount(temperature: Array) -> Array:
            velocity = gas.particles[..., : self.scheme.dimension]
            from_velocities = 2 * jnp.mean(velocity**2, axis=(1, 2))
            return jnp.where(due, from_velocities, temperature)

        temperature = jax.lax.cond(jnp.any(due), recount, lambda x: x, gas.temperature)
        return gas._replace(temperature=temperature)

    def _step(
        self,
        gas: DSMCGas,
        key: PRNGKeyArray,
        subsets: SubsetCounts,
        share: Float[Array, ""],
        chance: Float[Array, ""],
        largest: SubsetCounts,
    ) -> DSMCGas:
        """Do a share, 0 to 1, of a step of one replica; random numbers do not depend on the share.

        Each collision of the whole step takes place with the probability `chance`, so that the
        state within a step is as accurate as at its end. `largest` are the largest numbers of
        subsets of all replicas.
        """
        scheme = self.scheme
        before = gas
        key = jax.random.fold_in(key, gas.steps)
        dt = share * self.full_step(gas)
        kicks, walls = zip(subsets, largest, strict=True)
        kick = partial(self._kick, key=key, dt=dt, counts=kicks, time=gas.time)
        gas = kick(gas, place=0)
        particles, outcome, gains = self._collide(gas, key, dt, chance)
        if self.scene.walls is not None:
            particles, more = self._hit_walls(gas, key, dt, particles, walls)
            gains = jax.tree.map(jnp.add, gains, more)
        energy = scheme.num_particles * scheme.dimension / 2  # sum v^2 at T_0
        passed = gas.time_rest + dt
        after = gas.time + passed
        next_duration = waiting_time(jax.random.fold_in(key, 4), scheme.candidates, gas.duration)
        gas = gas._replace(
            time=after,
            time_rest=passed - (after - gas.time),
            duration=jnp.where(share > 0, next_duration, gas.duration),
            temperature=gas.temperature + gains.values[0] / energy,
            particles=particles,
            collisions=gas.collisions + outcome.num,
            missed=gas.missed + outcome.missed,
            steps=gas.steps + (share > 0).astype(gas.steps.dtype),
        )
        gas = kick(gas, place=1)
        if before.tangents is None:
            return gas
        return gas._replace(tangents=self._tangents_after(before, gains, dt, outcome.num))

    def _kick(
        self,
        gas: DSMCGas,
        key: PRNGKeyArray,
        dt: Float[Array, ""],
        counts: tuple[Int[Array, ""] | None, Int[Array, ""] | None],
        time: Float[Array, ""],
        place: int,
    ) -> DSMCGas:
        """Apply half of the kicks of a step, at its start (place 0) or end (1).

        `counts` are the number of subsets of this replica and the largest of any replica.
        """
        kicked, largest = counts
        if kicked is None or largest is None:
            return gas
        d = self.scheme.dimension
        parts = num_subsets(self.scheme.num_particles)
        growth = self.kick_growth(time, dt, float(place))
        key = jax.random.fold_in(key, 2 + place)
        at_rest = self.scene.walls is None
        size = jnp.sqrt(growth / 2 * (parts / kicked).astype(growth.dtype))
        time = gas.time

        def kick(i: Array, rows: Array, belongs: Array) -> tuple[Array, Array]:
            v = rows[:, :d]
            kicks = random_kicks(jax.random.fold_in(key, i), v, at_rest, belongs)
            kicks = jnp.where(belongs[:, None], size * kicks, 0.0)
            after = [v + kicks, rows[:, d:-d], rows[:, -d:] - time * kicks]
            return jnp.concatenate(after, axis=-1), jnp.sum(kicks * (2 * v + kicks))

        first = kicked * (2 * gas.steps + place).astype(jnp.int32)
        zero = jnp.zeros((), growth.dtype)
        particles, gain = change_subsets(gas.particles, first, kicked, largest, kick, zero)
        grown = 2 * gain / (self.scheme.num_particles * d)
        return gas._replace(particles=particles, temperature=gas.temperature + grown)

    def _collide(
        self, gas: DSMCGas, key: PRNGKeyArray, dt: Float[Array, ""], chance: Float[Array, ""]
    ) -> tuple[Float[Array, "N components"], Outcome, EnergyGains]:
        """Return the particles after the collisions of a step, sums over them, and gains."""
        d = self.scheme.dimension
        first = self.scheme.first
        second = self.scheme.second
        bits = random_words(jax.random.fold_in(key, 0), first + second + 2)
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
                scene: ReducedScene, decay: DragDecay, faster: Array, turning: Array
            ) -> tuple[Array, Outcome]:
                outcome = collide(
                    relative * faster, bits, ceiling, chance, scene, spins * turning, decay.velocity
                )
                gains = outcome.gains.at[1:].divide(decay.spin**2)
                return gains, outcome._replace(spin_change=outcome.spin_change / decay.spin)

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
        sums = one._replace(num=one.num + two.num, missed=one.missed + two.missed)
        particles = gas.particles.at[index].add(jnp.concatenate(changes, axis=-1), **options)
        return particles, sums, jax.tree.map(jnp.add, gains, more)

    def _hit_walls(
        self,
        gas: DSMCGas,
        key: PRNGKeyArray,
        dt: Float[Array, ""],
        particles: Float[Array, "N components"],
        counts: tuple[Any, Any],
    ) -> tuple[Float[Array, "N components"], EnergyGains]:
        """Let particles hit walls in a step, independent of their places.

        A sphere between two walls hits one of them ``|v| ds/(L - sigma)`` times in a step, times
        the ratio of the density before walls to the mean (`wall_impact_ratio`). Each step has walls
        across one axis, in turn, with d times this number of impacts.

        Returns the particles and the gains.
        """
        d = self.scheme.dimension
        middle = gas.time + dt / 2
        axis = (gas.steps % d).astype(jnp.int32)
        across = (jnp.arange(d, dtype=jnp.int32) == axis).astype(particles.dtype)[None]
        key = jax.random.fold_in(key, 1)
        (drawn, largest) = counts
        parts = num_subsets(len(particles))

        def hit_rows(i: Array, rows: Array, belongs: Array) -> tuple[Array, EnergyGains]:
            bits = jax.random.bits(jax.random.fold_in(key, i), belongs.shape, jnp.uint16)
            share = (drawn / parts).astype(particles.dtype)
            chance = (bits.astype(particles.dtype) + 0.5) * 2.0**-16 * share
            chance = jnp.where(belongs, chance, jnp.inf)

            def of_scene(
                scene: ReducedScene, decay: DragDecay, faster: Array, turning: Array
            ) -> tuple[Array, tuple[Array, Array]]:
                """Return the gains, and velocities and spins after impacts."""
                velocity = rows[:, :d] * faster
                spin = rows[:, d:-d] * turning
                walls = scene.walls
                surface = scene.surface
                frequency = walls.frequency[axis]
                normal = jnp.sum(velocity * across, axis=1)
                speed = jnp.abs(normal)
                outwards = jnp.sign(normal)[:, None] * across
                eps = walls.law.restitution(jnp.where(speed > 0, speed * decay.velocity, 1.0))
                ratio = wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)
                often = ratio * (frequency * (d * sqrt(pi)) * dt) * speed
                hits = (chance < often) & (speed > 0)
                push = jnp.where(hits, (1 + eps) * speed, 0.0)
                kick = -push[:, None] * outwards
                spin_change = jnp.zeros_like(spin)
                if surface is not None and walls.surface is not None:
                    eta = surface.eta_on_wall(walls.surface)
                    _, sliding_kick, spin_change = tangential_impulse(
                        velocity, spin, outwards, hits, eta, surface, push
                    )
                    kick = kick + sliding_kick
                # The number of impacts is not differentiable, so weights of value 1 carry its
                # derivative.
                weight = frequency * ratio
                weight = (weight / jax.lax.stop_gradient(weight))[:, None]
                gains = [jnp.sum(weight * kick * (2 * velocity + kick))]
                if surface is not None:
                    gain = jnp.sum(weight * spin_change * (2 * spin + spin_change))
                    gains.append(surface.inertia * gain / decay.spin**2)
                after = velocity + kick, (spin + spin_change) / decay.spin
                return jnp.stack(gains), after

            gains, (velocity, spin) = self._exchanged(of_scene, middle, gas.tangents)
            return jnp.concatenate([velocity, spin, rows[:, -d:]], axis=-1), gains

        shapes = jax.eval_shape(hit_rows, jnp.int32(0), particles[:1], jnp.ones(1, bool))[1]
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        bits = jax.random.bits(jax.random.fold_in(key, MAX_SUBSETS), (), jnp.uint16)
        first = (bits % parts).astype(jnp.int32)
        return change_subsets(particles, first, drawn, largest, hit_rows, zero)

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
        if tangents is None:
            decay = drag_decay(self.scene.drag, middle)
            gains, others = of_scene(self.scene, decay, jnp.ones_like(middle), decay.spin)
            return EnergyGains(gains), others

        def gained(scene: ReducedScene, log_scales: Float[Array, "energies"]) -> tuple[Array, Any]:
            decay = drag_decay(scene.drag, middle)
            faster = jnp.exp(log_scales[0])
            turning = decay.spin
            if scene.surface is not None:  # at a given energy a larger inertia has smaller spins
                inertia = scene.surface.inertia
                smaller = jnp.sqrt(jax.lax.stop_gradient(inertia) / inertia)
                turning = turning * jnp.exp(log_scales[1]) * smaller
            return of_scene(scene, decay, faster, turning)

        same = jnp.zeros(self.num_energies, middle.dtype)
        gains, pull, others = jax.vjp(gained, self.scene, same, has_aux=True)

        def slopes(weights: Array) -> tuple[Array, Array]:
            in_scene, in_scales = pull(weights)
            return directional_slopes(in_scene, tangents.directions), in_scales

        by_direction, by_scale = jax.vmap(slopes)(jnp.eye(self.num_energies, dtype=same.dtype))
        return EnergyGains(gains, by_direction.T, by_scale.T), others

    def _tangents_after(
        self, before: DSMCGas, gains: EnergyGains, ds: Array, collisions: Array
    ) -> ExchangeTangents:
        """Return the tangents after a step with some gains by impacts, and the kicks of a drive."""
        d = self.scheme.dimension
        scene = self.scene
        values, by_direction, by_scale = gains
        assert by_direction is not None and by_scale is not None
        if scene.drive is not None:

            def heating(scene: ReducedScene) -> Array:
                kicks = partial(kick_variance, scene.drive, scene.drag, before.time, ds)
                return self.scheme.num_particles * d / 2 * (kicks(0.0) + kicks(1.0))

            heat, pull = jax.vjp(heating, scene)
            (in_scene,) = pull(jnp.ones_like(heat))
            slopes = directional_slopes(in_scene, before.tangents.directions)
            values = values.at[0].add(heat)
            by_direction = by_direction.at[:, 0].add(slopes)
            # The rate of impacts depends on the speeds; kicks do not depend on them.
            by_scale = by_scale.at[0, 0].add(-heat)
        energies = [jnp.sum(before.particles[:, :d] ** 2)]
        if scene.surface is not None:
            energies.append(scene.surface.inertia * jnp.sum(before.particles[:, d:-d] ** 2))
        return before.tangents.after(
            jnp.stack(energies), values, by_direction, by_scale, collisions
        )


def time_left(gas: DSMCGas, until: ArrayLike) -> Float[Array, "*replicas"]:
    """Return the time from each replica to a time."""
    return (jnp.asarray(until) - gas.time) - gas.time_rest


@jax.jit
def dsmc_records(dynamics: DSMCDynamics, state: DSMCState) -> Records:
    """Return the records of a state."""
    scene = dynamics.scene
    gas = state.shown
    replicas, n, d = dynamics.shape
    velocity = v = gas.particles[..., :d]
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
        position = gas.particles[..., -d:] + gas.time[:, None, None] * v
        displacement = position - jnp.mean(position, axis=1, keepdims=True)
        values["displacement"] = observables.mean_square_displacement(displacement)
    if scene.surface is not None:
        energy = 2 * scene.surface.inertia * jnp.mean(gas.particles[..., d:-d] ** 2, (1, 2))
        values["rotational_temperature"] = energy * decay.true_spin**2
    tangents = gas.tangents
    if tangents is None:
        return Records(values, {}, {})
    rates, slopes = exchange_slopes(
        values, tangents, scene.drag, tangents.directions.drag, state.time, (n, d)
    )
    return Records(values, rates, slopes)
