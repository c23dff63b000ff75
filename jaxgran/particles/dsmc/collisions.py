"""One step of direct simulation Monte Carlo: random collisions of a homogeneous gas.

The collision rule of DSMC: which candidate pairs collide, and what a collision does.

Walls, a drive and drag in a step of DSMC.

Spins are ``s = (sigma/2) w``, a velocity. Where there is drag, velocities, spins and time are
transformed: see `jaxgran.particles.state`.

Tangents of DSMC with elements, by the energies that a step exchanges.

See `jaxgran.gradients.tangents`. Energies here are sum v^2 of translation, and q sum s^2 of the
spins that are kept.

Which pairs of particles are drawn in a step of DSMC.

A drive and walls in a step of DSMC, which act on portions of the particles.

The kicks of a drive in one step are far smaller than the velocities. So each half of a step kicks
a portion of all particles, with the variance of all steps until it has its turn again: the energy
that a step brings is the same, and costs as much less. How much may be brought in one turn limits
the number of portions, down to all particles in each half of a step.

Walls are met by portions that are drawn anew in each step, and so are met by a sphere that moves as
it does now: by turns, a mean free time apart, spheres that have lost speed would not come later,
and the loss be .9 % of T too large. As many portions are drawn as the fastest spheres need, and a
sphere of them meets a wall the more often.

Tangents of a DSMC run in the parameters of the law of restitution.

The state of a DSMC run.
"""

from collections.abc import Callable
from functools import cache, partial
from math import gcd, pi, sqrt
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt, UInt32

from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles.run import cpu_compiler_options
from jaxgran.particles.state import (
    MAX_KICK,
    DragDecay,
    drag_decay,
    random_kicks,
    tangential_impulse,
    threefry_key,
    true_duration,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS, share_of_impacts
from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedDrag, ReducedDrive, ReducedRough, ReducedScene
from jaxgran.theory.averages import collision_rate


class Outcome(NamedTuple):
    """What the collisions of candidate pairs do: kicks, and sums over the collisions.

    Attributes:
        kick: change of the velocity of the first particle of each pair; that of the second is
            opposite.
        num: number of collisions.
        missed: number of collisions missed because of the ceiling of the collision rate.
        loss: decrease of sum v^2.
        memory: ``sum (1 + eps)^2 (g.n)^2 / 4``, by which D/sqrt(T) decays.
        along: tangents of -loss and of memory in the parameters of the law.
        along_speed: their tangents in the logarithm of all speeds.
        turned: increase of q sum s^2 of rough spheres.
        twist: change of the spins of both particles of each pair; None of smooth ones.
    """

    kick: Float[Array, "pairs d"]
    num: Float[Array, ""]
    missed: Float[Array, ""]
    loss: Float[Array, ""]
    memory: Float[Array, ""]
    along: Float[Array, "2 P"]
    along_speed: Float[Array, "..."]  # (2,)
    rotational_gain: Float[Array, ""] | float = 0.0
    spin_change: Float[Array, "pairs spins"] | None = None


def collide(
    relative: Float[Array, "pairs d"],
    bits: UInt32[Array, "2 pairs"],
    ceiling: Float[Array, ""],
    share: Float[Array, ""],
    scene: ReducedScene,
    tangents: bool,
    spin: Float[Array, "pairs spins"] | None = None,
    slowed: Float[Array, ""] | None = None,
) -> Outcome:
    """Let candidate pairs collide at a rate proportional to |g|, with normals weighted by g.n.

    Args:
        relative: g = v_i - v_j of equal masses.
        bits: random ones.
        ceiling: |g| at which a candidate collides with probability 1 in a whole step.
        share: of the step to be done.
        scene: in reduced units.
        tangents: whether the tangents are wanted.
        spin: s_i + s_j of rough spheres.
        slowed: physical velocities over these; None if they are the same.
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
    met = (sine_square < 1) & (square > 0)
    hit = met & (chance * 2.0**-22 * ceiling < speed * share)
    cosine = jnp.sqrt(jnp.where(met, 1 - sine_square, 1.0))
    sideways = _perpendicular(axis)
    normal_speed = jnp.where(hit, speed * cosine, ceiling)
    at_impact = normal_speed if slowed is None else normal_speed * slowed
    eps, along, along_speed = _restitution(at_impact, hit, scene.law, tangents)
    square = jnp.where(hit, normal_speed**2, 0.0)
    push = jnp.where(hit, (1 + eps) / 2 * normal_speed, 0.0)
    normal = [
        cosine * axis[k] + sum(b * e[k] for b, e in zip(offset, sideways, strict=True))
        for k in range(d)
    ]
    outcome = Outcome(
        kick=jnp.stack([-push * n for n in normal], axis=-1),
        num=jnp.sum(hit, dtype=dtype),
        missed=share * jnp.sum(jnp.where(met, jnp.maximum(speed / ceiling - 1, 0.0), 0.0)),
        loss=jnp.sum((1 - eps**2) / 2 * square),
        memory=jnp.sum((1 + eps) ** 2 / 4 * square),
        along=along,
        along_speed=along_speed,
    )
    if scene.surface is None or spin is None:
        return outcome
    return _with_tangential(outcome, scene.surface, relative, spin, jnp.stack(normal, axis=-1), hit)


def _with_tangential(
    outcome: Outcome,
    surface: ReducedRough,
    relative: Float[Array, "pairs d"],
    spin: Float[Array, "pairs spins"],
    normal: Float[Array, "pairs d"],
    hit: Bool[Array, "pairs"],
) -> Outcome:
    """The outcome with the tangential part of the impacts; see `jaxgran.Rough`."""
    found = tangential_impulse(relative, spin, normal, hit, surface.eta, surface.inertia)
    lost = -2 * jnp.sum(found.kick * (found.sideways + found.kick))  # of translation alone
    rotational_gain = 2 * surface.inertia * jnp.sum(found.spin_change * (spin + found.spin_change))
    return outcome._replace(
        kick=outcome.kick + found.kick,
        loss=outcome.loss + lost,
        rotational_gain=rotational_gain,
        spin_change=found.spin_change,
    )


def _perpendicular(axis: list[Float[Array, "pairs"]]) -> list[list[Float[Array, "pairs"]]]:
    """Unit vectors perpendicular to unit vectors: one in a plane, two in space, as components."""
    if len(axis) == 2:
        return [[-axis[1], axis[0]]]
    x, y, z = axis
    sign = jnp.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    return [
        [1 + sign * x * x * a, sign * x * y * a, -sign * x],
        [x * y * a, sign + y * y * a, -y],
    ]


def _restitution(
    normal_speed: Float[Array, "pairs"],
    hit: Bool[Array, "pairs"],
    law: ReducedLaw,
    tangents: bool,
) -> tuple[Float[Array, "pairs"], Float[Array, "2 P"], Float[Array, "..."]]:
    """eps of each pair, and `Outcome.along` and `Outcome.along_speed` of the pairs that collide."""
    zero, along = jnp.zeros((), normal_speed.dtype), jnp.zeros((2, 0), normal_speed.dtype)

    def restitution(law, log_scale):
        return law.restitution(normal_speed * jnp.exp(log_scale))

    if not tangents:
        return restitution(law, zero), along, zero
    eps, pull = jax.vjp(restitution, law, zero)
    weights = [jnp.where(hit, x * normal_speed**2, 0.0) for x in (eps, (1 + eps) / 2)]
    in_law, along_speed = jax.vmap(pull)(jnp.stack(weights))
    if jax.tree.leaves(in_law):  # a law may have no floats
        along = jax.vmap(lambda x: ravel_pytree(x)[0])(in_law)
    return eps, along, along_speed


FASTEST_SPEED = 3.5
"""Speed along an axis, in sqrt(2 T), up to which impacts on walls are as frequent as they should
be; one of 1e6 particles is faster."""


class WallImpacts(NamedTuple):
    """Some particles after impacts on walls.

    Attributes:
        velocity, spin: of each.
        lost: decrease of sum v^2.
        turned: increase of q sum s^2.
    """

    velocity: Float[Array, "N d"]
    spin: Float[Array, "N spins"]
    lost: Float[Array, ""]
    rotational_gain: Float[Array, ""]


def hit_walls(
    scene: ReducedScene,
    chance: Float[Array, "N"],
    axis: Int[Array, ""],
    velocity: Float[Array, "N d"],
    spin: Float[Array, "N spins"],
    ds: Float[Array, ""],
    slowed: Float[Array, ""] | float,
) -> WallImpacts:
    """Particles after a step in which they meet walls, everywhere alike.

    A sphere between two walls meets one of them ``|v| ds/(L - sigma)`` times in a step, times the
    share that tells how dense the gas is before them (`share_of_impacts`). The steps take the axes
    in turns, and each does d times as much.

    Args:
        scene: in reduced units.
        chance: a random number for each; it meets a wall if this is less than that many times.
        axis: across which the walls are.
        velocity, spin: before.
        ds: length of the step.
        slowed: physical velocities over these.
    """
    walls, surface = scene.walls, scene.surface
    assert walls is not None
    n, d = velocity.shape
    frequency = walls.frequency[axis]
    each = frequency * (d * sqrt(pi)) * ds  # over the speed
    across = (jnp.arange(d) == axis).astype(velocity.dtype)[None]
    normal = jnp.sum(velocity * across, axis=1)
    speed, outwards = jnp.abs(normal), jnp.sign(normal)[:, None] * across
    eps = walls.law.restitution(jnp.where(speed > 0, speed * slowed, 1.0))
    often = share_of_impacts(eps, frequency / collision_rate(0.0, d), d)
    hit = (chance < often * each * speed) & (speed > 0)
    kick = -jnp.where(hit, (1 + eps) * speed, 0.0)[:, None] * outwards
    spin_change = jnp.zeros_like(spin)
    if surface is not None and walls.beta is not None:
        eta = surface.eta_on_wall(walls.beta)
        found = tangential_impulse(velocity, spin, outwards, hit, eta, surface.inertia)
        kick, spin_change = kick + found.kick, found.spin_change
    # The number of impacts is not differentiable: they count for more where there are more.
    share = frequency * often
    share = share / jax.lax.stop_gradient(share)
    inertia = 0.0 if surface is None else surface.inertia
    lost = -jnp.sum(share[:, None] * kick * (2 * velocity + kick))
    rotational_gain = inertia * jnp.sum(share[:, None] * spin_change * (2 * spin + spin_change))
    return WallImpacts(velocity + kick, spin + spin_change, lost, rotational_gain)


def fastest_share(
    scene: ReducedScene,
    temperature: Float[Array, "*replicas"],
    slowed: Float[Array, "*replicas"] | float,
    ds: Float[Array, "*replicas"],
    d: int,
) -> Float[Array, "*replicas"]:
    """The probability that a sphere of the speed `REACH` meets a wall in a step, that has its turn
    in each."""
    walls = scene.walls
    assert walls is not None
    speed = FASTEST_SPEED * jnp.sqrt(temperature)
    eps = walls.law.restitution(speed * slowed)[..., None]
    frequency = jnp.broadcast_to(walls.frequency, (*eps.shape[:-1], d))
    often = share_of_impacts(eps, frequency / collision_rate(0.0, d), d)
    return jnp.max(often * frequency, axis=-1) * (d * sqrt(pi)) * speed * ds


def drag_decay_or_one(drag: ReducedDrag | None, time: Float[Array, "..."]) -> DragDecay:
    """What drag has left; all where there is none."""
    if drag is None:
        return DragDecay(*[jnp.ones_like(time)] * 3)
    return drag_decay(drag, time)


def kick_growth(
    drive: ReducedDrive,
    drag: ReducedDrag | None,
    began: Float[Array, "*replicas"],
    ds: Float[Array, "*replicas"],
    place: float,
) -> Float[Array, "*replicas"]:
    """Growth of T/T_0 by half of the kicks of a step, made at its begin (place 0) or end (1)."""
    if drag is None:
        return drive.strength * jnp.maximum(ds, 0.0) / 2
    return (
        drive.strength
        * true_duration(drag, began, ds)
        / 2
        / drag_decay(drag, began + place * ds).velocity ** 2
    )


def limited_step(
    scene: ReducedScene,
    temperature: Float[Array, "*replicas"],
    clock: Float[Array, "*replicas"],
    ds: Float[Array, "*replicas"],
    d: int,
) -> Float[Array, "*replicas"]:
    """The length of a step, so short that a sphere meets one wall at most, and that the kicks of a
    drive are small beside the velocities."""
    if scene.walls is not None:
        slowed = drag_decay_or_one(scene.drag, clock).velocity
        ds = ds / jnp.maximum(fastest_share(scene, temperature, slowed, ds, d), 1.0)
    if scene.drive is None:
        return ds
    growth = scene.drive.strength / drag_decay_or_one(scene.drag, clock).velocity ** 3
    safe = jnp.where(growth > 0, growth, 1.0)
    return jnp.where(growth > 0, jnp.minimum(ds, MAX_KICK * temperature / safe), ds)


def kick_all(
    particles: Float[Array, "N components"],
    key: PRNGKeyArray,
    growth: Float[Array, ""],
    time: Float[Array, ""],
    d: int,
    at_rest: bool,
) -> Float[Array, "N components"]:
    """Particles after random kicks at a time, by which T/T_0 grows.

    Args:
        particles: v, x - v t and spins.
        key: of the random numbers.
        growth: of T/T_0.
        time: t, as in x - v t.
        d: dimension.
        at_rest: whether the kicks leave the momentum as it is.
    """
    change = jnp.sqrt(growth / 2) * random_kicks(key, particles[:, :d], at_rest)
    moved = [particles[:, :d] + change, particles[:, d : 2 * d] - time * change]
    return jnp.concatenate([*moved, particles[:, 2 * d :]], axis=1)


class CandidatePairs(NamedTuple):
    """Candidate pairs of a step.

    Attributes:
        relative: velocities.
        spin: sums of the spins that are kept; None of smooth spheres.
        bits: random ones.
    """

    relative: Float[Array, "pairs d"]
    spin: Float[Array, "pairs spins"] | None
    bits: UInt32[Array, "2 pairs"]


class EnergyGains(NamedTuple):
    """What both energies gain, and its tangents.

    Attributes:
        gains: of translation and rotation.
        along: in the parameters of the scene, in time, and in the logarithms of all velocities and
            of all spins.
    """

    gains: Float[Array, "2"]
    along: Float[Array, "changes 2"]


class StepEvents(NamedTuple):
    """All that happens in a step.

    Attributes:
        pairs: candidates.
        walls: what impacts on them bring; None without walls.
        ceiling, share: as for `collide`.
        began, ds: time at its begin, and its length.
        particles: N.
    """

    pairs: tuple[CandidatePairs, CandidatePairs]
    walls: EnergyGains | None
    ceiling: Float[Array, ""]
    share: Float[Array, ""]
    began: Float[Array, ""]
    ds: Float[Array, ""]
    particles: int


def initial_exchange_tangents(
    scene: ReducedScene, num_parameters: int, num_particles: int, dimension: int, replicas: int
) -> ExchangeTangents:
    """The tangents at t = 0, where T is 1 and T_rot as the scene has it; the last is that in time.

    Returns:
        For each replica, along a first axis.
    """
    zero = jnp.zeros_like(scene.law.restitution(jnp.ones(())))
    energies = jnp.zeros((num_parameters + 1, 2), zero.dtype)
    if scene.surface is not None:

        def rotation(scene):
            return num_particles * NUM_SPIN_COMPONENTS[dimension] / 2 * scene.surface.ratio

        energies = energies.at[:-1, 1].set(ravel_pytree(jax.grad(rotation)(scene))[0])
    many = jnp.broadcast_to(energies, (replicas, *energies.shape))
    return ExchangeTangents(many, many[:, :, 0] * 0)


def energies_of(
    particles: Float[Array, "N components"], scene: ReducedScene, d: int
) -> Float[Array, "2"]:
    """sum v^2, and q sum s^2 of the spins that are kept."""
    inertia = 0.0 if scene.surface is None else scene.surface.inertia
    translation, rotation = particles[:, :d], particles[:, 2 * d :]
    return jnp.stack([jnp.sum(translation**2), inertia * jnp.sum(rotation**2)])


def exchange_tangents_after(
    old: ExchangeTangents,
    scene: ReducedScene,
    before: Float[Array, "2"],
    step: StepEvents,
    collisions: Float[Array, ""],
) -> ExchangeTangents:
    """The tangents after a step.

    Args:
        old: before it.
        scene: in reduced units.
        before: the two energies before it.
        step: what happens.
        collisions: their number.
    """
    pairs = _gained(partial(_impacts, step=step), scene, step.ds)
    kicks = _gained(lambda scene, v, s, sooner: _kicks(scene, sooner, step), scene, step.ds)
    # Kicks do not depend on the speeds, which make impacts more frequent.
    kicks = kicks._replace(along=kicks.along.at[-2].add(-kicks.gains))
    all_of = jax.tree.map(jnp.add, pairs, kicks)
    if step.walls is not None:
        all_of = jax.tree.map(jnp.add, all_of, step.walls)
    return old.after(before, all_of.gains, all_of.along, collisions)


def wall_gains(
    hit: Callable[..., WallImpacts], scene: ReducedScene, middle: Float[Array, ""]
) -> EnergyGains:
    """What impacts on walls bring, at the middle of a step: `hit` of `_bounced`."""

    def by(scene, velocity, spin, sooner):
        scene, left, faster, turning = _scaled(scene, velocity, spin, sooner, middle)
        found = hit(scene, faster, turning, left.velocity)
        return jnp.stack([-found.lost, found.rotational_gain / left.spin**2])

    return _gained(by, scene, middle)


def _gained(
    by: Callable[..., Float[Array, "2"]], scene: ReducedScene, like: Float[Array, ""]
) -> EnergyGains:
    """Gains as a function of the scene, the logarithms of velocities and spins, and of time."""
    zero = jnp.zeros_like(like)
    gains, pull = jax.vjp(by, scene, zero, zero, zero)

    def row(weights):
        in_scene, *others = pull(weights)
        return jnp.concatenate([ravel_pytree(in_scene)[0], jnp.stack(others)])

    slopes = jax.vmap(row)(jnp.eye(2, dtype=zero.dtype)).T
    return EnergyGains(gains, jnp.concatenate([slopes[:-3], slopes[-1:], slopes[-3:-1]]))


def _scaled(
    scene: ReducedScene, velocity: Array, spin: Array, sooner: Array, middle: Array
) -> tuple[ReducedScene, DragDecay, Array, Array]:
    """The scene and what drag has left, if all is sooner; factors of velocities and of spins."""
    scene = scene._replace(drag=_sooner(scene, sooner))
    left = drag_decay_or_one(scene.drag, middle)
    faster, turning = jnp.exp(velocity), left.spin * jnp.exp(spin)
    if scene.surface is not None:  # at a given energy spins are smaller where the inertia is larger
        inertia = scene.surface.inertia
        turning = turning * jnp.sqrt(jax.lax.stop_gradient(inertia) / inertia)
    return scene, left, faster, turning


def _sooner(scene: ReducedScene, share: Array) -> ReducedDrag | None:
    if scene.drag is None:
        return None
    return ReducedDrag(*(rate * (1 + share) for rate in scene.drag))


def _impacts(
    scene: ReducedScene, velocity: Array, spin: Array, sooner: Array, step: StepEvents
) -> Float[Array, "2"]:
    """What both energies gain by impacts, with velocities and spins greater by factors exp(...)."""
    middle = step.began + step.ds / 2
    scene, left, faster, turning = _scaled(scene, velocity, spin, sooner, middle)
    slowed = None if scene.drag is None else left.velocity
    total = jnp.zeros(2, step.ds.dtype)
    for pairs in step.pairs:
        spins = None if pairs.spin is None else pairs.spin * turning
        found = collide(
            pairs.relative * faster,
            pairs.bits,
            step.ceiling,
            step.share,
            scene,
            False,
            spin=spins,
            slowed=slowed,
        )
        total = total + jnp.stack([-found.loss, found.rotational_gain / left.spin**2])
    return total


def _kicks(scene: ReducedScene, sooner: Array, step: StepEvents) -> Float[Array, "2"]:
    """What both energies gain by a drive."""
    if scene.drive is None:
        return jnp.zeros(2, step.ds.dtype)
    drag = _sooner(scene, sooner)
    growth = sum(kick_growth(scene.drive, drag, step.began, step.ds, place) for place in (0.0, 1.0))
    d = step.pairs[0].relative.shape[1]
    return jnp.stack([step.particles * d / 2 * growth, jnp.zeros_like(step.ds)])


CEILING = 5.0
"""Relative speed, in sqrt(2 T), up to which the collision rate is right; beyond, it is constant.

A Maxwellian gas misses 2e-6 of its collisions by this, and 1e-5 of its losses. A run counts what it
misses.
"""


class Scheme(NamedTuple):
    """Static sizes of one step.

    Attributes:
        dimension: d.
        num_particles: N.
        first: number of disjoint random pairs.
        second: number of pairs that are formed next, of a particle of a first pair and a new one.
    """

    dimension: int
    num_particles: int
    first: int
    second: int

    @classmethod
    def of(cls, dimension: int, num_particles: int, step: float) -> "Scheme":
        """The scheme with so many collisions per particle and step.

        Were M pairs drawn one after the other with replacement, ``2 M (M - 1) / N`` of them would
        on average share a particle with an earlier pair. The scheme has as many of these, which
        makes the step second order.
        """
        accepted = sphere_surface(dimension) / sqrt(2 * pi) / (2 ** (dimension - 1) * CEILING)
        pairs = max(round(step * num_particles / (2 * accepted)), 1)
        second = round(2 * pairs * (pairs - 1) / num_particles)
        return cls(dimension, num_particles, pairs - second, second)

    @property
    def own_step(self) -> float:
        """``dt sqrt(T/T_0)`` of a step, in which each particle meets the N - 1 others alike."""
        candidates = 2 * (self.first + self.second) / (self.num_particles - 1)
        return candidates / (2 ** (self.dimension - 1) * CEILING)


@cache
def _strides(num_particles: int) -> np.ndarray:
    """Numbers coprime to N that are so small that their product with N fits into 32 bits."""
    top = min(num_particles, 2**32 // num_particles - 1)
    return np.array([s for s in range(1, max(top, 2)) if gcd(s, num_particles) == 1], np.uint32)


def draw(
    bits: UInt[Array, "4"], scheme: Scheme
) -> tuple[Int[Array, "first"], Int[Array, "first"], Int[Array, "second"]]:
    """Indices of the particles of the first pairs, and of the new particles of the second pairs.

    Since particles are exchangeable, evenly spaced indices will do, as long as any two particles
    meet with about the same probability: the first particles of the pairs are a + s l for random a
    and s, their partners stand a random number of places further on. Every particle is drawn with
    the same probability. Every pair is, too, if N is prime. Else pairs whose distance shares a
    large divisor with N (one in a hundred at N = 1000) are up to 1.7 times as likely, and the
    probabilities scatter by 6 % (14 % at N = 64).
    """
    n, first, second = scheme.num_particles, scheme.first, scheme.second
    strides = jnp.asarray(_strides(n))
    stride = strides[bits[0] % len(strides)]
    apart = first + second + bits[1] % (n - 2 * first - second + 1)

    def particle(place):
        return ((bits[2] % n + stride * place) % n).astype(jnp.int32)

    place = jnp.arange(first, dtype=jnp.uint32)
    # The new ones stand in between, also at a random distance.
    fresh = first + bits[3] % (apart - (first + second) + 1) + jnp.arange(second, dtype=jnp.uint32)
    return particle(place), particle(place + apart), particle(fresh)


Sums = TypeVar("Sums")

MAX_PORTIONS = 16
"""Portions of many particles."""

MIN_ROWS = 16
"""Particles of a portion, whose kicks together leave its momentum as it is."""


class Portion(NamedTuple):
    """Some neighbouring rows of the particles.

    Attributes:
        first: the first of them.
        counted: which of them belong to the portion.
    """

    first: Int[Array, ""]
    counted: Bool[Array, "rows"]

    def of(self, particles: Float[Array, "N components"]) -> Float[Array, "rows components"]:
        """Its rows."""
        return jax.lax.dynamic_slice_in_dim(particles, self.first, len(self.counted))

    def written(self, particles: Float[Array, "N components"], rows: Array) -> Array:
        """All particles with new rows."""
        return jax.lax.dynamic_update_slice_in_dim(particles, rows, self.first, 0)


def num_portions(num_particles: int) -> int:
    """The number of portions."""
    return max(min(MAX_PORTIONS, num_particles // MIN_ROWS), 1)


def portion_of(index: Int[Array, ""], num_particles: int, active: Bool[Array, ""]) -> Portion:
    """A portion of particles, each of which belongs to one."""
    n, parts = num_particles, num_portions(num_particles)
    begin, end = index * n // parts, (index + 1) * n // parts
    rows = -(-n // parts)
    first = jnp.minimum(begin, n - rows)
    row = first + jnp.arange(rows, dtype=first.dtype)
    return Portion(first, (row >= begin) & (row < end) & active)


class Portions(NamedTuple):
    """How many portions of the particles take part in a step; None without what they take part in.

    Attributes:
        kicks: of a drive, in half of the step.
        walls: impacts on walls.
    """

    kicks: Int[Array, "*replicas"] | None
    walls: Int[Array, "*replicas"] | None


def portions_of_step(
    temperature: Float[Array, "*replicas"],
    clock: Float[Array, "*replicas"],
    share: Float[Array, "*replicas"],
    scene: ReducedScene,
    scheme: Scheme,
) -> Portions:
    """The portions that take part in a share of a step.

    So many are kicked in half of it that T of none grows by more than `kicks.LARGEST`: particles
    whose turns are w T apart have at one time temperatures that differ by so much, by which a_2 of
    all is too large by ``w^2/12``, 2e-4 at most. So many may meet walls that one of the fastest
    spheres does so at most once.
    """
    parts = num_portions(scheme.num_particles)
    ds = share * scheme.own_step / jnp.sqrt(temperature)

    def at_least(needed: Array) -> Array:
        return jnp.clip(jnp.ceil(needed), 1, parts).astype(jnp.int32)

    kicked = walled = None
    if scene.drive is not None:
        growth = kick_growth(scene.drive, scene.drag, clock, ds, 0.0)
        safe = jnp.where(temperature > 0, temperature, 1.0)
        kicked = at_least(parts * growth / (MAX_KICK * safe))
    if scene.walls is not None:
        slowed = drag_decay_or_one(scene.drag, clock).velocity
        most = fastest_share(scene, temperature, slowed, ds, scheme.dimension)
        walled = at_least(parts * most)
    return Portions(kicked, walled)


def bounce_portions(
    particles: Float[Array, "N components"],
    key: PRNGKeyArray,
    drawn: Int[Array, ""],
    most: Int[Array, ""],
    meet: Callable[[Array, Array], tuple[Array, Sums]],
    none: Sums,
) -> tuple[Float[Array, "N components"], Sums]:
    """The particles of one replica after their impacts on walls in a step, and sums over these.

    Args:
        particles: of the replica.
        key: of the step.
        drawn: portions that may meet walls.
        most: the largest number of these of all replicas, which share the loop.
        meet: function of particles and of a random number for each; returns them after impacts of
            those whose number is smaller than the impacts that they have in the step, and what is
            summed.
        none: sums of no impacts.
    """
    n, parts = len(particles), num_portions(len(particles))
    bits = jax.random.bits(jax.random.fold_in(key, MAX_PORTIONS), (), jnp.uint16)
    which = (bits % parts).astype(jnp.int32)

    def some(i: Int[Array, ""], done: tuple[Array, Sums]) -> tuple[Array, Sums]:
        particles, sums = done
        own = portion_of((which + i) % parts, n, i < drawn)
        bits = jax.random.bits(jax.random.fold_in(key, i), own.counted.shape, jnp.uint16)
        chance = (bits.astype(particles.dtype) + 0.5) * 2.0**-16 * (drawn / parts)
        rows, more = meet(own.of(particles), jnp.where(own.counted, chance, jnp.inf))
        return own.written(particles, rows), jax.tree.map(jnp.add, sums, more)

    return jax.lax.fori_loop(0, most, some, (particles, none))


def kick_portions(
    particles: Float[Array, "N components"],
    key: PRNGKeyArray,
    turns: Int[Array, ""],
    most: Int[Array, ""],
    half_steps: UInt32[Array, ""],
    growth: Float[Array, ""],
    time: Float[Array, ""],
    d: int,
    at_rest: bool,
) -> tuple[Float[Array, "N components"], Float[Array, ""]]:
    """The particles of one replica after half of the kicks of a step, and how much T/T_0 has grown.

    Args:
        particles: v, x - v t and spins.
        key: of this half of the step.
        turns: portions that have their turn.
        most: the largest number of turns of all replicas, which share the loop.
        half_steps: number of halves before.
        growth: of T/T_0, on average.
        time: t, as in x - v t.
        d: dimension.
        at_rest: whether the kicks leave the momentum as it is.
    """
    n, parts = len(particles), num_portions(len(particles))
    size = jnp.sqrt(growth / 2 * (parts / turns))

    def turn(i: Int[Array, ""], done: tuple[Array, Array]) -> tuple[Array, Array]:
        particles, gained = done
        index = ((turns * half_steps.astype(jnp.int32) + i) & (2**30 - 1)) % parts
        own = portion_of(index, n, i < turns)
        rows = own.of(particles)
        v = rows[:, :d]
        kick = random_kicks(jax.random.fold_in(key, i), v, at_rest, own.counted)
        kick = jnp.where(own.counted[:, None], size * kick, 0.0)
        after = [v + kick, rows[:, d : 2 * d] - time * kick, rows[:, 2 * d :]]
        particles = own.written(particles, jnp.concatenate(after, axis=-1))
        return particles, gained + jnp.sum(kick * (2 * v + kick))

    zero = jnp.zeros((), particles.dtype)
    particles, gained = jax.lax.fori_loop(0, most, turn, (particles, zero))
    return particles, 2 * gained / (n * d)


class DSMCTangents(NamedTuple):
    """Tangents at a fixed own time s, ``ds = sqrt(T/T_0) dt``, in P parameters of the law.

    The tangent of the velocities is c v / 2. That of <dr^2> follows from ``d<dr^2>/ds = 2 d M``,
    ``dM/ds = 1/2 - kappa M``, the equation of kinetic theory for ``M = D / sqrt(T/T_0)``. Here
    kappa is the rate of velocity relaxation less half the cooling rate, and is measured on the
    collisions.

    Attributes:
        log_temperature: c = d ln T.
        clock: of the time.
        mobility: of M.
        displacement: of <dr^2>.
        persistence: of the logarithm of <v(0).v> / sqrt(T).
    """

    log_temperature: Float[Array, "*replicas P"]
    clock: Float[Array, "*replicas P"]
    mobility: Float[Array, "*replicas P"]
    displacement: Float[Array, "*replicas P"]
    persistence: Float[Array, "*replicas P"]


def tangents_after_step(
    old: DSMCTangents,
    before: Float[Array, ""],
    dimension: int,
    sums: Outcome,
    dt: Float[Array, ""],
    ds: Float[Array, ""],
    energy: Float[Array, ""],
) -> tuple[Float[Array, ""], DSMCTangents]:
    """M and the tangents after a step.

    Args:
        old, before: the tangents and M before it.
        dimension: d.
        sums: over its collisions.
        dt, ds: its length in time and in own time.
        energy: sum v^2 after it.
    """
    c = old.log_temperature
    # The tangent of the velocities is (c/2) v; the law adds to it at every collision.
    gain, fading = (sums.along + sums.along_speed[:, None] * (c / 2)[None]) / energy
    # dM/ds = 1/2 - kappa M and its tangent, by the implicit midpoint rule.
    half = sums.memory / energy / 2
    mobility = ((1 - half) * before + ds / 2) / (1 + half)
    along = ((1 - half) * old.mobility - fading * (before + mobility) / 2) / (1 + half)
    tangents = DSMCTangents(
        log_temperature=c + gain,
        clock=old.clock - c / 2 * dt,
        mobility=along,
        displacement=old.displacement + dimension * ds * (old.mobility + along),
        persistence=old.persistence - fading,
    )
    return mobility, tangents


class DSMCState(NamedTuple):
    """R replicas of N particles. Units: the impact speed sqrt(2 T_0) and the path length.

    Attributes:
        time: which all replicas have reached.
        clock: start of the step of each replica that ends beyond `time`.
        clock_rest: what rounding has left out of `clock`, a compensated sum.
        temperature: T/T_0, updated by the losses and recomputed every `collisions.RECOUNTED` steps.
        particles: the 2 d components of v and of x - v t, which only collisions change, and the
            spins of rough spheres. With drag they are transformed: see `jaxgran.particles.state`.
        collisions: number of pairs that collided.
        missed: number of collisions missed because of the `CEILING`.
        steps: number of steps.
        mobility: M = D / sqrt(T/T_0), followed together with the tangents.
        tangents: in the parameters of the law, or of a scene with elements.
    """

    time: Float[Array, ""]
    clock: Float[Array, "*replicas"]
    clock_rest: Float[Array, "*replicas"]
    temperature: Float[Array, "*replicas"]
    particles: Float[Array, "*replicas N components"]
    collisions: Float[Array, "*replicas"]
    missed: Float[Array, "*replicas"]
    steps: UInt32[Array, "*replicas"]
    mobility: Float[Array, "*replicas"]
    tangents: DSMCTangents | ExchangeTangents


RECOUNT_INTERVAL = 32
"""Steps after which T is computed from the velocities again.

In between it is updated by the losses. The rounding errors of this sum do not shrink as T falls,
and in float32 they would dominate T once it has fallen to 1e-7 of its first value.
"""


def _step(
    state: DSMCState,
    key: PRNGKeyArray,
    some: Portions,
    share: Float[Array, ""],
    most: Portions,
    scene: ReducedScene,
    scheme: Scheme,
    tangents: bool,
) -> DSMCState:
    """A share, 0 to 1, of one step of one replica, always with the same random numbers.

    Each collision of the whole step takes place with this probability, so that the state within
    a step is as accurate as at its end.
    """
    key = jax.random.fold_in(key, state.steps)
    dt = share * scheme.own_step / jnp.sqrt(state.temperature)
    kicked = partial(_apply_drive, key=key, dt=dt, scene=scene, scheme=scheme)
    kicked = partial(kicked, turns=(some.kicks, most.kicks))
    before, state = state, kicked(state, clock=state.clock, place=0)
    exchanging = tangents and isinstance(state.tangents, ExchangeTangents)
    particles, sums, pairs = _apply_collisions(
        state, key, dt, share, scene, scheme, tangents and not exchanging
    )
    lost, met = sums.loss, None
    if some.walls is not None and most.walls is not None:
        bounced = partial(
            _apply_walls, drawn=(some.walls, most.walls), scene=scene, d=scheme.dimension
        )
        particles, to_walls, met = bounced(state, key, dt, particles, tangents=exchanging)
        lost = lost + to_walls
    energy = scheme.num_particles * scheme.dimension / 2  # sum v^2 at T_0
    temperature = state.temperature - lost / energy
    passed = state.clock_rest + dt
    clock = state.clock + passed
    new = state._replace(
        clock=clock,
        clock_rest=passed - (clock - state.clock),
        temperature=temperature,
        particles=particles,
        collisions=state.collisions + sums.num,
        missed=state.missed + sums.missed,
        steps=state.steps + (share > 0).astype(state.steps.dtype),
    )
    new = kicked(new, clock=state.clock, place=1)
    if not tangents:
        return new
    if isinstance(before.tangents, ExchangeTangents):
        ceiling = CEILING * jnp.sqrt(state.temperature)
        step = StepEvents(pairs, met, ceiling, share, state.clock, dt, scheme.num_particles)
        energies = energies_of(before.particles, scene, scheme.dimension)
        along = exchange_tangents_after(before.tangents, scene, energies, step, sums.num)
        return new._replace(tangents=along)
    ds, left = share * scheme.own_step, energy * temperature
    mobility, along = tangents_after_step(
        before.tangents, state.mobility, scheme.dimension, sums, dt, ds, left
    )
    return new._replace(mobility=mobility, tangents=along)


def _apply_drive(
    state: DSMCState,
    key: PRNGKeyArray,
    dt: Float[Array, ""],
    turns: tuple[Int[Array, ""] | None, Int[Array, ""] | None],
    scene: ReducedScene,
    scheme: Scheme,
    clock: Float[Array, ""],
    place: int,
) -> DSMCState:
    """The state after half of the kicks of a step, at its begin (place 0) or end (1); `turns` are
    portions of this replica and the most of any."""
    own, most = turns
    if scene.drive is None or own is None or most is None:
        return state
    d = scheme.dimension
    growth = kick_growth(scene.drive, scene.drag, clock, dt, float(place))
    key = jax.random.fold_in(key, 2 + place)
    halves = 2 * state.steps + place
    at_rest = scene.walls is None
    particles, grown = kick_portions(
        state.particles, key, own, most, halves, growth, state.clock, d, at_rest
    )
    return state._replace(particles=particles, temperature=state.temperature + grown)


def _apply_collisions(
    state: DSMCState,
    key: PRNGKeyArray,
    dt: Float[Array, ""],
    share: Float[Array, ""],
    scene: ReducedScene,
    scheme: Scheme,
    tangents: bool,
) -> tuple[Float[Array, "N components"], Outcome, tuple[CandidatePairs, CandidatePairs]]:
    """The particles after a step, sums over its collisions, and the candidates."""
    d, first, second = scheme.dimension, scheme.first, scheme.second
    bits = jax.random.bits(key, (2, first + second + 2), jnp.uint32)
    i, j, k = draw(bits[:, -2:].ravel(), scheme)
    index = jnp.concatenate([i, j, k])
    options = {"mode": "promise_in_bounds", "unique_indices": True}
    old = state.particles.at[index].get(**options)
    v, spin, slowed, kept = old[:, :d], old[:, 2 * d :], None, 1.0
    # Collisions happen at the middle of the step, on average: x - v t changes by -kick t.
    middle = state.clock + dt / 2
    if scene.drag is not None:
        left = drag_decay(scene.drag, middle)
        slowed, kept = left.velocity, left.spin
        spin = spin * kept

    ceiling = CEILING * jnp.sqrt(state.temperature)
    rule = partial(
        collide, ceiling=ceiling, share=share, scene=scene, tangents=tangents, slowed=slowed
    )
    rough = scene.surface is not None
    firsts = v[:first] - v[first : 2 * first]
    turning = spin[:first] + spin[first : 2 * first] if rough else None
    one = rule(firsts, bits[:, :first], spin=turning)
    twice, again = one.kick[:second], one.spin_change
    if again is not None:
        again = spin[:second] + again[:second] + spin[2 * first :]
    seconds = v[:second] + twice - v[2 * first :]
    two = rule(seconds, bits[:, first:-2], spin=again)
    kicks = jnp.concatenate([twice + two.kick, one.kick[second:], -one.kick, -two.kick])
    changes = [kicks, -middle * kicks]
    if one.spin_change is not None and two.spin_change is not None:
        both = one.spin_change[:second] + two.spin_change
        changes.append(
            jnp.concatenate([both, one.spin_change[second:], one.spin_change, two.spin_change])
            / kept
        )
    sums = jax.tree.map(jnp.add, *(x._replace(kick=0.0, spin_change=None) for x in (one, two)))
    new = old + jnp.concatenate(changes, axis=-1)
    pairs = (
        CandidatePairs(firsts, None if turning is None else turning / kept, bits[:, :first]),
        CandidatePairs(seconds, None if again is None else again / kept, bits[:, first:-2]),
    )
    return state.particles.at[index].set(new, **options), sums, pairs


def _apply_walls(
    state: DSMCState,
    key: PRNGKeyArray,
    dt: Float[Array, ""],
    particles: Float[Array, "N components"],
    drawn: tuple[Int[Array, ""], Int[Array, ""]],
    scene: ReducedScene,
    d: int,
    tangents: bool,
) -> tuple[Float[Array, "N components"], Float[Array, ""], EnergyGains | None]:
    """The particles after their impacts on walls in a step, the decrease of sum v^2, and with
    tangents what both energies gain."""
    left = drag_decay_or_one(scene.drag, state.clock + dt / 2)
    axis, one = (state.steps % d).astype(jnp.int32), jnp.ones(())

    def meet(rows: Array, chance: Array) -> tuple[Array, tuple[Array, EnergyGains | None]]:
        velocity, spin = rows[:, :d], rows[:, 2 * d :]

        def hit(scene: ReducedScene, faster: Array, turning: Array, slowed: Array) -> WallImpacts:
            return hit_walls(scene, chance, axis, velocity * faster, spin * turning, dt, slowed)

        found = hit(scene, one, left.spin, left.velocity)
        gained = wall_gains(hit, scene, state.clock + dt / 2) if tangents else None
        after = [found.velocity, rows[:, d : 2 * d], found.spin / left.spin]
        return jnp.concatenate(after, axis=-1), (found.lost, gained)

    shapes = jax.eval_shape(meet, particles[:1], particles[:1, 0])[1]
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    bounced = bounce_portions(particles, jax.random.fold_in(key, 1), *drawn, meet, none)
    return bounced[0], *bounced[1]


def step(
    state: DSMCState,
    key: UInt32[Array, "2"],
    share: Float[Array, "replicas"],
    scene: ReducedScene,
    scheme: Scheme,
    tangents: bool,
) -> DSMCState:
    """A share, 0 to 1, of the next step of each replica."""
    replicas = jnp.arange(len(state.clock), dtype=jnp.uint32)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(threefry_key(key), replicas)
    some = portions_of_step(state.temperature, state.clock, share, scene, scheme)
    most = jax.tree.map(jnp.max, some)
    one = partial(_step, most=most, scene=scene, scheme=scheme, tangents=tangents)
    axes = jax.tree.map(lambda _: 0, state)._replace(time=None)
    state = jax.vmap(one, (axes, 0, 0, 0), axes)(state, keys, some, share)
    due = state.steps % RECOUNT_INTERVAL == 0

    def recounted(temperature):
        velocity = state.particles[..., : scheme.dimension]
        counted = 2 * jnp.mean(velocity**2, axis=(1, 2))
        return jnp.where(due, counted, temperature)

    temperature = jax.lax.cond(jnp.any(due), recounted, lambda x: x, state.temperature)
    return state._replace(temperature=temperature)


def _advanced(
    state: DSMCState,
    end: Float[Array, ""],
    scene: ReducedScene,
    key: UInt32[Array, "2"],
    max_steps: Int[Array, ""],
    *,
    scheme: Scheme,
    tangents: bool = False,
) -> DSMCState:
    """Whole steps towards a time: each replica is taken to its last step that ends before it.

    Args:
        state: where to start.
        end: the time.
        scene: in reduced units.
        key: of the random numbers, two 32-bit words.
        max_steps: the most steps to take; `time` of the state tells how far they led.
        scheme: sizes of a step.
        tangents: whether tangents are followed.
    """

    def length(state):
        whole = scheme.own_step / jnp.sqrt(state.temperature)
        return limited_step(scene, state.temperature, state.clock, whole, scheme.dimension)

    def due(state):
        return length(state) <= (end - state.clock) - state.clock_rest

    def unfinished(carry):
        state, left = carry
        return jnp.any(due(state)) & (left > 0)

    def further(carry):
        state, left = carry
        share = due(state).astype(state.clock.dtype)
        if scene.drive is not None or scene.walls is not None:
            share = share * length(state) * jnp.sqrt(state.temperature) / scheme.own_step
        return step(state, key, share, scene, scheme, tangents), left - 1

    state, _ = jax.lax.while_loop(unfinished, further, (state, max_steps))
    time = jnp.where(jnp.any(due(state)), jnp.min(state.clock), end)
    return state._replace(time=jnp.maximum(time, state.time))


advance = jax.jit(_advanced, static_argnames=("scheme", "tangents"))


@cache
def advancing(donate: bool) -> Callable[..., DSMCState]:
    """`advance` as the host driver calls it, which may write over the state given, and so delete
    it."""
    static, given = ("scheme", "tangents"), "state" if donate else ()
    options = cpu_compiler_options()
    return jax.jit(
        _advanced, static_argnames=static, donate_argnames=given, compiler_options=options
    )
