"""Steps of direct simulation Monte Carlo (DSMC): random collisions in a homogeneous gas.

A step draws candidate pairs, decides which of them collide, and changes their velocities. It also
applies walls and a drive, and updates the tangents of the run. Spins are ``s = (sigma/2) w``, a
velocity. With drag the velocities, spins and time are transformed: see `jaxgran.particles.state`.

Candidates are a Poisson process, as collisions of a gas are: a step has a fixed number of them, and
takes the time in which so many happen (`waiting_time`). In steps of fixed length T of a run would
scatter less: by .87 of the variance.

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
from functools import cache, partial
from math import gcd, pi, sqrt
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt, UInt32

from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles.state import (
    MAX_KICK,
    DragDecay,
    drag_decay,
    kick_variance,
    random_kicks,
    tangential_impulse,
    threefry_key,
)
from jaxgran.scene.elements import wall_impact_ratio
from jaxgran.scene.gas import ReducedScene
from jaxgran.scene.geometry import sphere_surface
from jaxgran.theory.averages import collision_rate

CEILING = 5.0
"""Relative speed, in sqrt(2 T), up to which the collision rate is right; beyond it is constant.

A Maxwellian gas misses 2e-6 of its collisions and 1e-5 of its losses by this. A run counts the
missed collisions.
"""


class Scheme(NamedTuple):
    """Static sizes of one step.

    Attributes:
        dimension: d.
        num_particles: N.
        first: number of disjoint random pairs, the first pairs.
        second: number of second pairs, each of a particle of a first pair and a new particle.
    """

    dimension: int
    num_particles: int
    first: int
    second: int

    @classmethod
    def of(cls, dimension: int, num_particles: int, step: float) -> "Scheme":
        """Return the scheme with a number `step` of collisions per particle and step.

        If M pairs were drawn one after the other with replacement, ``2 M (M - 1) / N`` of them
        would on average share a particle with an earlier pair. The scheme has the same number of
        second pairs, which makes the step second order.
        """
        accepted = sphere_surface(dimension) / sqrt(2 * pi) / (2 ** (dimension - 1) * CEILING)
        pairs = max(round(step * num_particles / (2 * accepted)), 1)
        second = round(2 * pairs * (pairs - 1) / num_particles)
        return cls(dimension, num_particles, pairs - second, second)

    @property
    def scaled_step(self) -> float:
        """Mean length ``dt sqrt(T/T_0)`` of a step in scaled time.

        Each particle collides with any of the N - 1 others.
        """
        candidates = 2 * self.candidates / (self.num_particles - 1)
        return candidates / (2 ** (self.dimension - 1) * CEILING)

    @property
    def candidates(self) -> int:
        """Number of candidate pairs of a step."""
        return self.first + self.second


def waiting_time(
    key: PRNGKeyArray, candidates: int, like: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Draw the time in which a Poisson process has so many events, over the mean time.

    Its distribution is the gamma distribution. The cube of a normal number (Wilson & Hilferty) has
    the same mean and variance within 1e-2 for one event, 1e-5 for ten. The mean number of the
    events that come before the last one, in a share s of this time, is ``s (candidates - 1)``.

    Args:
        key: of random numbers.
        candidates: number of events, >= 1.
        like: an array whose shape and dtype the result has.
    """
    normal = jax.random.normal(key, like.shape, like.dtype)
    root = 1 - 1 / (9 * candidates) + normal / (3 * sqrt(candidates))
    return jnp.maximum(root, 1e-3) ** 3


class DSMCState(NamedTuple):
    """State of R replicas of N particles. Units: the impact speed sqrt(2 T_0) and the path length.

    Attributes:
        time: time that all replicas have reached.
        clock: start of the step of each replica that ends beyond `time`.
        clock_rest: rounding error of `clock`, for a compensated sum.
        duration: length of the next step over its mean, see `waiting_time`.
        temperature: T/T_0, updated by the losses, recomputed every `RECOUNT_INTERVAL` steps.
        particles: the 2 d components of v and of x - v t, which only collisions change, and the
            spins of rough spheres. With drag they are transformed: see `jaxgran.particles.state`.
        collisions: number of pairs that collided.
        missed: number of collisions missed because of the `CEILING`.
        steps: number of steps.
        tangents: of the energies, see `ExchangeTangents`; None without them.
    """

    time: Float[Array, ""]
    clock: Float[Array, "*replicas"]
    clock_rest: Float[Array, "*replicas"]
    duration: Float[Array, "*replicas"]
    temperature: Float[Array, "*replicas"]
    particles: Float[Array, "*replicas N components"]
    collisions: Float[Array, "*replicas"]
    missed: Float[Array, "*replicas"]
    steps: UInt32[Array, "*replicas"]
    tangents: Any = None


@cache
def _strides(num_particles: int) -> np.ndarray:
    """Return numbers coprime to N, so small that their product with N fits into 32 bits."""
    top = min(num_particles, 2**32 // num_particles - 1)
    return np.array([s for s in range(1, max(top, 2)) if gcd(s, num_particles) == 1], np.uint32)


def draw_pairs(
    bits: UInt[Array, "4"], scheme: Scheme
) -> tuple[Int[Array, "first"], Int[Array, "first"], Int[Array, "second"]]:
    """Draw the indices of both particles of the first pairs, and of new ones for second pairs.

    Since particles are exchangeable, evenly spaced indices are sufficient if any two particles form
    a pair with about the same probability: the first particles of the pairs are a + s l for random
    a and s, their partners are a random number of places further on. Every particle is drawn with
    the same probability, and every pair, too, if N is prime. Otherwise pairs whose distance shares
    a large divisor with N (one in a hundred at N = 1000) are up to 1.7 times as likely, and the
    probabilities scatter by 6 % (14 % at N = 64).
    """
    n, first, second = scheme.num_particles, scheme.first, scheme.second
    strides = jnp.asarray(_strides(n))
    stride = strides[bits[0] % len(strides)]
    apart = first + second + bits[1] % (n - 2 * first - second + 1)

    def particle(place):
        return ((bits[2] % n + stride * place) % n).astype(jnp.int32)

    place = jnp.arange(first, dtype=jnp.uint32)
    # The new particles are in between, also at a random distance.
    new = first + bits[3] % (apart - (first + second) + 1) + jnp.arange(second, dtype=jnp.uint32)
    return particle(place), particle(place + apart), particle(new)


class Outcome(NamedTuple):
    """Outcome of the collisions of candidate pairs: kicks, and sums over the collisions.

    Attributes:
        kick: change of the velocity of the first particle of each pair; that of the second is
            opposite.
        num: number of collisions.
        missed: number of collisions missed because of the ceiling of the collision rate.
        loss: decrease of sum v^2.
        rotational_gain: increase of q sum s^2 of rough spheres.
        spin_change: change of the spins of both particles of each pair.
    """

    kick: Float[Array, "pairs d"]
    num: Float[Array, ""]
    missed: Float[Array, ""]
    loss: Float[Array, ""]
    rotational_gain: Float[Array, ""] | float
    spin_change: Float[Array, "pairs spins"]


def collide(
    relative: Float[Array, "pairs d"],
    bits: UInt32[Array, "2 pairs"],
    ceiling: Float[Array, ""],
    share: Float[Array, ""],
    scene: ReducedScene,
    spin: Float[Array, "pairs spins"],
    drag_factor: Float[Array, ""] | float = 1.0,
) -> Outcome:
    """Let candidate pairs collide at a rate proportional to |g|, with normals weighted by g.n.

    Args:
        relative: g = v_i - v_j of equal masses.
        bits: random bits.
        ceiling: |g| at which a candidate collides with probability 1 in a whole step.
        share: fraction of the step to be done.
        scene: in reduced units.
        spin: s_i + s_j; smooth spheres have no components.
        drag_factor: ratio of physical velocities to these.
    """
    d, dtype = relative.shape[-1], relative.dtype
    g = [relative[:, k] for k in range(d)]
    square = sum(x * x for x in g)
    speed = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    axis = [x / speed for x in g]
    # The impact parameter is uniform in a disk (an interval for d = 2), drawn from its square.
    offset = [((b >> 11).astype(dtype) + 0.5) * 2.0**-20 - 1 for b in bits[: d - 1]]
    chance = ((bits[0] & 2047) << 11 | (bits[1] & 2047)).astype(dtype) + 0.5
    sine_square = sum(b * b for b in offset)
    in_disk = (sine_square < 1) & (square > 0)
    hit = in_disk & (chance * 2.0**-22 * ceiling < speed * share)
    cosine = jnp.sqrt(jnp.where(in_disk, 1 - sine_square, 1.0))
    sideways = _perpendicular(axis)
    normal_speed = jnp.where(hit, speed * cosine, ceiling)
    eps = scene.law.restitution(normal_speed * drag_factor)
    square = jnp.where(hit, normal_speed**2, 0.0)
    push = jnp.where(hit, (1 + eps) / 2 * normal_speed, 0.0)
    normal = [
        cosine * axis[k] + sum(b * e[k] for b, e in zip(offset, sideways, strict=True))
        for k in range(d)
    ]
    outcome = Outcome(
        kick=jnp.stack([-push * n for n in normal], axis=-1),
        num=jnp.sum(hit, dtype=dtype),
        missed=share * jnp.sum(jnp.where(in_disk, jnp.maximum(speed / ceiling - 1, 0.0), 0.0)),
        loss=jnp.sum((1 - eps**2) / 2 * square),
        rotational_gain=0.0,
        spin_change=spin,
    )
    if (surface := scene.surface) is None:
        return outcome
    normal = jnp.stack(normal, axis=-1)
    across, kick, spin_change = tangential_impulse(
        relative, spin, normal, hit, surface.eta, surface, push
    )
    loss = -2 * jnp.sum(kick * (across + kick))  # of translation alone
    return outcome._replace(
        kick=outcome.kick + kick,
        loss=outcome.loss + loss,
        rotational_gain=2 * surface.inertia * jnp.sum(spin_change * (spin + spin_change)),
        spin_change=spin_change,
    )


def _perpendicular(axis: list[Float[Array, "pairs"]]) -> list[list[Float[Array, "pairs"]]]:
    """Return unit vectors perpendicular to unit vectors: one in a plane, two in space."""
    if len(axis) == 2:
        return [[-axis[1], axis[0]]]
    x, y, z = axis
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    return [
        [1 + sign * x * x * a, sign * x * y * a, -sign * x],
        [x * y * a, sign + y * y * a, -y],
    ]


def slopes_along(gradient: Any, directions: Any) -> Float[Array, "p"]:
    """Return the derivatives along some directions, from the derivatives in all numbers."""
    products = jax.tree.map(lambda g, x: jnp.tensordot(x, g, g.ndim), gradient, directions)
    return sum(jax.tree.leaves(products), start=jnp.zeros(1))  # a law may have no floats


FASTEST_SPEED = 3.5
"""Speed along an axis, in sqrt(2 T), up to which the rate of impacts on walls is right; one of 1e6
particles is faster."""

RECOUNT_INTERVAL = 32
"""Number of steps between computations of T from the velocities.

In between the losses update T. The rounding errors of this sum do not shrink as T falls, and in
float32 they would dominate T once it has fallen to 1e-7 of its initial value.
"""

MAX_SUBSETS = 16
"""Number of subsets of many particles."""

MIN_SUBSET_SIZE = 16
"""Minimum number of particles in a subset, whose kicks together conserve its momentum."""


def num_subsets(num_particles: int) -> int:
    return max(min(MAX_SUBSETS, num_particles // MIN_SUBSET_SIZE), 1)


Sums = TypeVar("Sums")


def change_subsets(
    particles: Float[Array, "N components"],
    first: Int[Array, ""],
    count: Int[Array, ""],
    largest: Int[Array, ""],
    change: Callable[..., tuple[Array, Sums]],
    zero: Sums,
) -> tuple[Float[Array, "N components"], Sums]:
    """Change some subsets of the particles of one replica; return them and sums over the changes.

    A subset consists of neighbouring rows; each particle belongs to exactly one.

    Args:
        particles: the particles of the replica.
        first: number of the first subset; they follow each other periodically.
        count: number of subsets.
        largest: the largest such number of all replicas, which share the loop.
        change: a function of the number of the subset, rows of particles and a mask of those that
            belong to the subset. It returns the changed rows and the sums.
        zero: sums without changes.
    """
    n, parts = len(particles), num_subsets(len(particles))
    size = -(-n // parts)

    def change_one(i: Int[Array, ""], carry: tuple[Array, Sums]) -> tuple[Array, Sums]:
        particles, sums = carry
        index = ((first + i) & (2**30 - 1)) % parts
        begin, end = index * n // parts, (index + 1) * n // parts
        top = jnp.minimum(begin, n - size)
        row = top + jnp.arange(size, dtype=top.dtype)
        belongs = (row >= begin) & (row < end) & (i < count)
        rows, more = change(i, jax.lax.dynamic_slice_in_dim(particles, top, size), belongs)
        particles = jax.lax.dynamic_update_slice_in_dim(particles, rows, top, 0)
        return particles, jax.tree.map(jnp.add, sums, more)

    return jax.lax.fori_loop(0, largest, change_one, (particles, zero))


SubsetCounts = tuple[Int[Array, "*replicas"] | None, Int[Array, "*replicas"] | None]
"""Numbers of subsets that a drive kicks in half of a step, and of those that may hit walls in the
step; None without a drive or walls."""

CandidatePairs = tuple[Array, Array, Array]
"""Candidate pairs of a step: relative velocities, sums of the spins in the state, random bits."""


class EnergyGains(NamedTuple):
    """Gains of sum v^2 and, of spheres that rotate, of q sum s^2, and their tangents.

    Attributes:
        values: of both energies, or of one.
        by_direction: along directions in the scene, of which the last is the direction of time.
        by_scale: in the logarithms of all velocities and of all spins.
    """

    values: Float[Array, "energies"]
    by_direction: Float[Array, "directions energies"]
    by_scale: Float[Array, "energies energies"]


class DSMCDynamics(eqx.Module):
    """The steps of a gas.

    Attributes:
        scene: the gas in reduced units.
        scheme: sizes of a step.
    """

    scene: ReducedScene
    scheme: Scheme = eqx.field(static=True)

    def drag_decay(self, time: Float[Array, "..."]) -> DragDecay:
        """Return the decay by drag until a time; ones without drag."""
        if self.scene.drag is None:
            return DragDecay(*[jnp.ones_like(time)] * 3)
        return drag_decay(self.scene.drag, time)

    def kick_growth(
        self, start: Float[Array, "*replicas"], ds: Float[Array, "*replicas"], place: float
    ) -> Float[Array, "*replicas"]:
        """Return the growth of T/T_0 by half of the kicks of a step.

        They come at its start (place 0) or end (1).
        """
        return kick_variance(self.scene.drive, self.scene.drag, start, ds, place)

    def max_wall_impacts(
        self, state: DSMCState, ds: Float[Array, "*replicas"]
    ) -> Float[Array, "*replicas"]:
        """Return the number of wall impacts in a step of a sphere of the speed `FASTEST_SPEED`."""
        walls, d = self.scene.walls, self.scheme.dimension
        speed = FASTEST_SPEED * jnp.sqrt(state.temperature)
        eps = walls.law.restitution(speed * self.drag_decay(state.clock).velocity)[..., None]
        frequency = jnp.broadcast_to(walls.frequency, (*eps.shape[:-1], d))
        ratio = wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)
        return jnp.max(ratio * frequency, axis=-1) * (d * sqrt(pi)) * speed * ds

    def full_step(self, state: DSMCState) -> Float[Array, "*replicas"]:
        """Return the time in which all candidates of the next step happen."""
        return state.duration * self.scheme.scaled_step / jnp.sqrt(state.temperature)

    def step_length(self, state: DSMCState) -> Float[Array, "*replicas"]:
        """Return the length of a step: spheres hit at most one wall, and kicks are small."""
        ds = self.full_step(state)
        if self.scene.walls is not None:
            ds = ds / jnp.maximum(self.max_wall_impacts(state, ds), 1.0)
        if self.scene.drive is None:
            return ds
        growth = self.scene.drive / self.drag_decay(state.clock).velocity ** 3
        safe = jnp.where(growth > 0, growth, 1.0)
        return jnp.where(growth > 0, jnp.minimum(ds, MAX_KICK * state.temperature / safe), ds)

    def subsets_per_step(self, state: DSMCState, share: Float[Array, "*replicas"]) -> SubsetCounts:
        """Return the numbers of subsets that take part in a share of a step.

        A drive kicks so many subsets in half of it that T of none grows by more than the share
        `MAX_KICK`. Particles that are kicked in turn then have temperatures that differ by up to
        w T, by which a_2 of all particles is too large by ``w^2/12``, at most 2e-4. So many subsets
        may hit walls that one of the fastest spheres hits at most one.
        """
        parts, temperature = num_subsets(self.scheme.num_particles), state.temperature
        ds = share * self.full_step(state)

        def at_least(needed: Array) -> Array:
            return jnp.clip(jnp.ceil(needed), 1, parts).astype(jnp.int32)

        kicks = walls = None
        if self.scene.drive is not None:
            growth = self.kick_growth(state.clock, ds, 0.0)
            safe = jnp.where(temperature > 0, temperature, 1.0)
            kicks = at_least(parts * growth / (MAX_KICK * safe))
        if self.scene.walls is not None:
            walls = at_least(parts * self.max_wall_impacts(state, ds))
        return kicks, walls

    def step(
        self,
        state: DSMCState,
        key: UInt32[Array, "2"],
        share: Float[Array, "replicas"],
        chance: Float[Array, "replicas"],
    ) -> DSMCState:
        """Do a share, 0 to 1, of the next step of each replica, with a chance of each candidate."""
        replicas = jnp.arange(len(state.clock), dtype=jnp.uint32)
        keys = jax.vmap(jax.random.fold_in, (None, 0))(threefry_key(key), replicas)
        subsets = self.subsets_per_step(state, share)
        largest = jax.tree.map(jnp.max, subsets)
        step_replica = partial(self._step, largest=largest)
        axes = jax.tree.map(lambda _: 0, state._replace(tangents=None))._replace(time=None)
        if state.tangents is not None:
            along = jax.tree.map(lambda _: -1, state.tangents._replace(directions=None))
            axes = axes._replace(tangents=along)
        state = jax.vmap(step_replica, (axes, 0, 0, 0, 0), axes)(
            state, keys, subsets, share, chance
        )
        due = state.steps % RECOUNT_INTERVAL == 0

        def recount(temperature):
            velocity = state.particles[..., : self.scheme.dimension]
            from_velocities = 2 * jnp.mean(velocity**2, axis=(1, 2))
            return jnp.where(due, from_velocities, temperature)

        temperature = jax.lax.cond(jnp.any(due), recount, lambda x: x, state.temperature)
        return state._replace(temperature=temperature)

    def _step(
        self,
        state: DSMCState,
        key: PRNGKeyArray,
        subsets: SubsetCounts,
        share: Float[Array, ""],
        chance: Float[Array, ""],
        largest: SubsetCounts,
    ) -> DSMCState:
        """Do a share, 0 to 1, of a step of one replica; random numbers do not depend on the share.

        Each collision of the whole step takes place with the probability `chance`, so that the
        state within a step is as accurate as at its end. `largest` are the largest numbers of
        subsets of all replicas.
        """
        scheme, before = self.scheme, state
        key = jax.random.fold_in(key, state.steps)
        dt = share * self.full_step(state)
        kicks, walls = zip(subsets, largest, strict=True)
        kick = partial(self._kick, key=key, dt=dt, counts=kicks, clock=state.clock)
        state = kick(state, place=0)
        particles, sums, pairs = self._collide(state, key, dt, chance)
        loss, wall_gains = sums.loss, None
        if self.scene.walls is not None:
            particles, wall_loss, wall_gains = self._hit_walls(state, key, dt, particles, walls)
            loss = loss + wall_loss
        energy = scheme.num_particles * scheme.dimension / 2  # sum v^2 at T_0
        temperature = state.temperature - loss / energy
        passed = state.clock_rest + dt
        clock = state.clock + passed
        next_duration = waiting_time(jax.random.fold_in(key, 4), scheme.candidates, state.duration)
        new = state._replace(
            clock=clock,
            clock_rest=passed - (clock - state.clock),
            duration=jnp.where(share > 0, next_duration, state.duration),
            temperature=temperature,
            particles=particles,
            collisions=state.collisions + sums.num,
            missed=state.missed + sums.missed,
            steps=state.steps + (share > 0).astype(state.steps.dtype),
        )
        new = kick(new, place=1)
        if before.tangents is None:
            return new
        ceiling = CEILING * jnp.sqrt(state.temperature)
        tangents = self._tangents_after(before, ceiling, chance, dt, pairs, wall_gains, sums.num)
        return new._replace(tangents=tangents)

    def _kick(
        self,
        state: DSMCState,
        key: PRNGKeyArray,
        dt: Float[Array, ""],
        counts: tuple[Int[Array, ""] | None, Int[Array, ""] | None],
        clock: Float[Array, ""],
        place: int,
    ) -> DSMCState:
        """Apply half of the kicks of a step, at its start (place 0) or end (1).

        `counts` are the number of subsets of this replica and the largest of any replica.
        """
        kicked, largest = counts
        if kicked is None or largest is None:
            return state
        d, parts = self.scheme.dimension, num_subsets(self.scheme.num_particles)
        growth = self.kick_growth(clock, dt, float(place))
        key, at_rest = jax.random.fold_in(key, 2 + place), self.scene.walls is None
        size, time = jnp.sqrt(growth / 2 * (parts / kicked)), state.clock

        def kick(i: Array, rows: Array, belongs: Array) -> tuple[Array, Array]:
            v = rows[:, :d]
            kicks = random_kicks(jax.random.fold_in(key, i), v, at_rest, belongs)
            kicks = jnp.where(belongs[:, None], size * kicks, 0.0)
            after = [v + kicks, rows[:, d : 2 * d] - time * kicks, rows[:, 2 * d :]]
            return jnp.concatenate(after, axis=-1), jnp.sum(kicks * (2 * v + kicks))

        first = kicked * (2 * state.steps + place).astype(jnp.int32)
        zero = jnp.zeros((), growth.dtype)
        particles, gain = change_subsets(state.particles, first, kicked, largest, kick, zero)
        grown = 2 * gain / (self.scheme.num_particles * d)
        return state._replace(particles=particles, temperature=state.temperature + grown)

    def _collide(
        self, state: DSMCState, key: PRNGKeyArray, dt: Float[Array, ""], chance: Float[Array, ""]
    ) -> tuple[Float[Array, "N components"], Outcome, tuple[CandidatePairs, CandidatePairs]]:
        """Return the particles after the collisions of a step, sums over them, and candidates."""
        d, first, second = self.scheme.dimension, self.scheme.first, self.scheme.second
        bits = jax.random.bits(key, (2, first + second + 2), jnp.uint32)
        i, j, k = draw_pairs(bits[:, -2:].ravel(), self.scheme)
        index = jnp.concatenate([i, j, k])
        options = {"mode": "promise_in_bounds", "unique_indices": True}
        old = state.particles.at[index].get(**options)
        # Collisions happen at the middle of the step, on average: x - v t changes by -kick t.
        middle = state.clock + dt / 2
        decay = self.drag_decay(middle)
        v, spin, spin_factor = old[:, :d], old[:, 2 * d :] * decay.spin, decay.spin
        rule = partial(
            collide,
            ceiling=CEILING * jnp.sqrt(state.temperature),
            share=chance,
            scene=self.scene,
            drag_factor=decay.velocity,
        )
        firsts = v[:first] - v[first : 2 * first]
        first_spins = spin[:first] + spin[first : 2 * first]
        one = rule(firsts, bits[:, :first], spin=first_spins)
        kick, turn = one.kick, one.spin_change
        seconds = v[:second] + kick[:second] - v[2 * first :]
        second_spins = spin[:second] + turn[:second] + spin[2 * first :]
        two = rule(seconds, bits[:, first:-2], spin=second_spins)
        kicks = jnp.concatenate([kick[:second] + two.kick, kick[second:], -kick, -two.kick])
        turns = [turn[:second] + two.spin_change, turn[second:], turn, two.spin_change]
        changes = [kicks, -middle * kicks, jnp.concatenate(turns) / spin_factor]
        sums = jax.tree.map(jnp.add, *(x._replace(kick=0.0, spin_change=0.0) for x in (one, two)))
        new = old + jnp.concatenate(changes, axis=-1)
        pairs = (
            (firsts, first_spins / spin_factor, bits[:, :first]),
            (seconds, second_spins / spin_factor, bits[:, first:-2]),
        )
        return state.particles.at[index].set(new, **options), sums, pairs

    def _hit_walls(
        self,
        state: DSMCState,
        key: PRNGKeyArray,
        dt: Float[Array, ""],
        particles: Float[Array, "N components"],
        counts: tuple[Any, Any],
    ) -> tuple[Float[Array, "N components"], Float[Array, ""], EnergyGains | None]:
        """Let particles hit walls in a step, independent of their places.

        A sphere between two walls hits one of them ``|v| ds/(L - sigma)`` times in a step, times
        the ratio of the density before walls to the mean (`wall_impact_ratio`). Each step has walls
        across one axis, in turn, with d times this number of impacts.

        Returns the particles, the loss of sum v^2, and the gains, None without tangents.
        """
        d, middle = self.scheme.dimension, state.clock + dt / 2
        axis, one = (state.steps % d).astype(jnp.int32), jnp.ones(())
        across = (jnp.arange(d) == axis).astype(particles.dtype)[None]
        key, (drawn, largest) = jax.random.fold_in(key, 1), counts
        parts = num_subsets(len(particles))

        def hit_rows(i: Array, rows: Array, belongs: Array) -> tuple[Array, tuple]:
            bits = jax.random.bits(jax.random.fold_in(key, i), belongs.shape, jnp.uint16)
            chance = (bits.astype(particles.dtype) + 0.5) * 2.0**-16 * (drawn / parts)
            chance = jnp.where(belongs, chance, jnp.inf)

            def hit(scene: ReducedScene, decay: DragDecay, faster: Array, turning: Array) -> tuple:
                """Return velocities and spins after impacts, and the gains of both energies."""
                velocity, spin = rows[:, :d] * faster, rows[:, 2 * d :] * turning
                walls, surface = scene.walls, scene.surface
                frequency = walls.frequency[axis]
                normal = jnp.sum(velocity * across, axis=1)
                speed, outwards = jnp.abs(normal), jnp.sign(normal)[:, None] * across
                eps = walls.law.restitution(jnp.where(speed > 0, speed * decay.velocity, 1.0))
                ratio = wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)
                often = ratio * (frequency * (d * sqrt(pi)) * dt) * speed
                hits = (chance < often) & (speed > 0)
                push = jnp.where(hits, (1 + eps) * speed, 0.0)
                kick, spin_change = -push[:, None] * outwards, jnp.zeros_like(spin)
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
                return velocity + kick, spin + spin_change, jnp.stack(gains)

            def gained(dynamics: DSMCDynamics, *options: Any) -> Array:
                return hit(dynamics.scene, *options)[2]

            decay = self.drag_decay(middle)
            velocity, spin, gain = hit(self.scene, decay, one, decay.spin)
            gains = None
            if state.tangents is not None:
                gains = self._energy_gains(gained, middle, state.tangents.directions)
            after = [velocity, rows[:, d : 2 * d], spin / decay.spin]
            return jnp.concatenate(after, axis=-1), (-gain[0], gains)

        shapes = jax.eval_shape(hit_rows, jnp.int32(0), particles[:1], jnp.ones(1, bool))[1]
        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        bits = jax.random.bits(jax.random.fold_in(key, MAX_SUBSETS), (), jnp.uint16)
        first = (bits % parts).astype(jnp.int32)
        particles, (loss, gains) = change_subsets(particles, first, drawn, largest, hit_rows, zero)
        return particles, loss, gains

    def _tangents_after(
        self,
        before: DSMCState,
        ceiling: Float[Array, ""],
        share: Float[Array, ""],
        ds: Float[Array, ""],
        candidates: tuple[CandidatePairs, CandidatePairs],
        wall_gains: EnergyGains | None,
        collisions: Float[Array, ""],
    ) -> ExchangeTangents:
        """Return the tangents after a step; see `collide` for its ceiling and share."""
        d, start, directions = self.scheme.dimension, before.clock, before.tangents.directions
        surface = self.scene.surface
        num_energies = 1 if surface is None else 2

        def by_collisions(
            dynamics: DSMCDynamics, decay: DragDecay, faster: Array, turning: Array
        ) -> Array:
            scene, total = dynamics.scene, jnp.zeros(num_energies, ds.dtype)
            for relative, spins, bits in candidates:
                relative, spins = relative * faster, spins * turning
                outcome = collide(relative, bits, ceiling, share, scene, spins, decay.velocity)
                gained = [-outcome.loss, outcome.rotational_gain / decay.spin**2]
                total = total + jnp.stack(gained[:num_energies])
            return total

        def by_drive(dynamics: DSMCDynamics, *_: Any) -> Array:
            growth = sum(dynamics.kick_growth(start, ds, place) for place in (0.0, 1.0))
            heat = self.scheme.num_particles * d / 2 * growth
            return jnp.zeros(num_energies, ds.dtype).at[0].set(heat)

        sources = [self._energy_gains(by_collisions, start + ds / 2, directions)]
        if self.scene.drive is not None:
            kicks = self._energy_gains(by_drive, start + ds / 2, directions)
            # The rate of impacts depends on the speeds; kicks do not depend on them.
            held = kicks.by_scale.at[0].add(-kicks.values)
            sources.append(kicks._replace(by_scale=held))
        if wall_gains is not None:
            sources.append(wall_gains)
        gains = jax.tree.map(lambda *each: sum(each[1:], start=each[0]), *sources)
        energies = [jnp.sum(before.particles[:, :d] ** 2)]
        if surface is not None:
            energies.append(surface.inertia * jnp.sum(before.particles[:, 2 * d :] ** 2))
        return before.tangents.after(jnp.stack(energies), *gains, collisions)

    def _energy_gains(
        self,
        gained: Callable[..., Float[Array, "energies"]],
        middle: Float[Array, ""],
        directions: ReducedScene,
    ) -> EnergyGains:
        """Return the gains and tangents of a function at the middle of a step.

        It is a function of the dynamics, the decay by drag, and factors of velocities and spins.
        """
        num_energies = 1 if self.scene.surface is None else 2

        def gains(scene: ReducedScene, log_scales: Float[Array, "energies"]) -> Array:
            dynamics = DSMCDynamics(scene, self.scheme)
            decay = dynamics.drag_decay(middle)
            faster, turning = jnp.exp(log_scales[0]), decay.spin
            if scene.surface is not None:  # at a given energy a larger inertia has smaller spins
                inertia = scene.surface.inertia
                smaller = jnp.sqrt(jax.lax.stop_gradient(inertia) / inertia)
                turning = turning * jnp.exp(log_scales[1]) * smaller
            return gained(dynamics, decay, faster, turning)

        values, pull = jax.vjp(gains, self.scene, jnp.zeros(num_energies, middle.dtype))

        def slopes(weights: Array) -> tuple[Array, Array]:
            in_scene, in_scales = pull(weights)
            return slopes_along(in_scene, directions), in_scales

        by_direction, by_scale = jax.vmap(slopes)(jnp.eye(num_energies, dtype=middle.dtype))
        return EnergyGains(values, by_direction.T, by_scale.T)


def advance(
    dynamics: DSMCDynamics,
    state: DSMCState,
    end: Float[Array, ""],
    key: UInt32[Array, "2"],
    max_steps: Int[Array, ""],
    in_part: Bool[Array, ""],
) -> DSMCState:
    """Advance each replica by whole steps to the last one that ends before a time.

    Or do one step in part, exactly up to this time, which whole steps have reached: both are one
    program, because the step takes nearly all of the time of its compilation.

    Args:
        dynamics: of the gas.
        state: the initial state.
        end: the time.
        key: two 32-bit words of a key of random numbers.
        max_steps: maximum number of whole steps; `time` of the result is the time that they reach.
        in_part: whether to do the step in part.
    """
    scene, length, num = dynamics.scene, dynamics.step_length, dynamics.scheme.candidates
    max_steps = jnp.where(in_part, 1, max_steps)

    def left(state):
        return (end - state.clock) - state.clock_rest

    def due(state):
        return length(state) <= left(state)

    def unfinished(carry):
        state, steps_left = carry
        return (in_part | jnp.any(due(state))) & (steps_left > 0)

    def step_due(carry):
        state, steps_left = carry
        share = due(state).astype(state.clock.dtype)
        if scene.drive is not None or scene.walls is not None:
            share = share * length(state) / dynamics.full_step(state)
        part = jnp.clip(left(state) / dynamics.full_step(state), 0.0, 1.0)
        # A step ends with its last candidate, which does not happen within the step.
        chance = jnp.where(in_part, part * (1 - 1 / num), share)
        return dynamics.step(state, key, jnp.where(in_part, part, share), chance), steps_left - 1

    state, _ = jax.lax.while_loop(unfinished, step_due, (state, max_steps))
    time = jnp.where(jnp.any(due(state)), jnp.min(state.clock), end)
    return state._replace(time=jnp.maximum(time, state.time))
