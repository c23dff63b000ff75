"""Random collisions of DSMC: candidate pairs, their outcome, and subsets of the particles.

Candidates are a Poisson process, as collisions of a gas are: a step has a fixed number of them, and
takes the time in which so many happen (`waiting_time`). In steps of fixed length T of a run would
scatter less.
"""

from collections.abc import Callable
from functools import cache
from math import factorial, gcd, pi, sqrt
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt, UInt32

from jaxgran.particles.elements import tangential_impulse
from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.reduced import ReducedScene

CEILING = 5.0
"""Relative speed, in sqrt(2 T), up to which the collision rate is right; beyond it is constant.

A Maxwellian gas misses 2e-6 of its collisions and 1e-5 of its losses by this. A run counts the
missed collisions.
"""


def candidate_rate(dimension: int) -> float:
    """Return the number of candidates of a particle in the unit of scaled time.

    It is the cross-section in square diameters, 2 in a plane and pi in space, times the ceiling.
    """
    return sphere_surface(dimension - 1) / (dimension - 1) * CEILING


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
    def build(cls, dimension: int, num_particles: int, step: float) -> "Scheme":
        """Return the scheme with a number `step` of collisions per particle and step.

        If M pairs were drawn one after the other with replacement, ``2 M (M - 1) / N`` of them
        would on average share a particle with an earlier pair. The scheme has the same number of
        second pairs, which makes the step second order.
        """
        accepted = sphere_surface(dimension) / sqrt(2 * pi) / candidate_rate(dimension)
        pairs = max(round(step * num_particles / (2 * accepted)), 1)
        second = round(2 * pairs * (pairs - 1) / num_particles)
        return cls(dimension, num_particles, pairs - second, second)

    @property
    def scaled_step(self) -> float:
        """Mean length ``dt sqrt(T/T_0)`` of a step in scaled time.

        Each particle collides with any of the N - 1 others.
        """
        candidates = 2 * self.candidates / (self.num_particles - 1)
        return candidates / candidate_rate(self.dimension)

    @property
    def candidates(self) -> int:
        """Number of candidate pairs of a step."""
        return self.first + self.second


def waiting_time(
    key: PRNGKeyArray, candidates: int, like: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Draw the time in which a Poisson process has so many events, over the mean time.

    Its distribution is the gamma distribution. The cube of a normal number (Wilson & Hilferty) has
    the same mean and variance within 1e-2 for one event, 1e-5 for ten.

    Args:
        key: of random numbers.
        candidates: number of events, >= 1.
        like: an array whose shape and dtype the result has.
    """
    normal = jax.random.normal(key, like.shape, like.dtype)
    root = 1 - 1 / (9 * candidates) + normal / (3 * sqrt(candidates))
    return jnp.maximum(root, 1e-3) ** 3


MIN_BLOCKS = 2048
"""Least number of blocks of several consecutive rows from which pairs are drawn."""

MAX_BLOCK = 64
"""Most rows of a block. Of a million particles, single rows take several times as long to read."""


@cache
def _strides(num_blocks: int) -> np.ndarray:
    """Return numbers coprime to `num_blocks` whose product with it fits into 32 bits."""
    top = min(num_blocks, 2**32 // num_blocks - 1)
    return np.array([s for s in range(1, max(top, 2)) if gcd(s, num_blocks) == 1], np.uint32)


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

    From N = 4096 on blocks of consecutive rows are evenly spaced in place of single ones. Pairs
    within the length of a block, at most one in a thousand, are drawn half as often.
    """
    n = scheme.num_particles
    first = scheme.first
    second = scheme.second
    size = min(max(n // MIN_BLOCKS, 1), MAX_BLOCK)
    num_blocks = n // size
    places = num_blocks * size
    strides = jnp.asarray(_strides(num_blocks))
    stride = strides[bits[0] % len(strides)]
    apart = first + second + bits[1] % (places - 2 * first - second + 1)

    def particle(place):
        row = stride * (place // size) % num_blocks * size + place % size
        return ((bits[2] % n + row) % n).astype(jnp.int32)

    place = jnp.arange(first, dtype=jnp.uint32)
    # The new particles are in between, also at a random distance.
    new = first + bits[3] % (apart - (first + second) + 1) + jnp.arange(second, dtype=jnp.uint32)
    return particle(place), particle(place + apart), particle(new)


class Outcome(NamedTuple):
    """Outcome of the collisions of candidate pairs.

    Attributes:
        kick: change of the velocity of the first particle of each pair; the change of the second is
            opposite.
        spin_change: change of the spins of both particles of each pair.
        num: number of collisions.
        missed: number of collisions missed because of the ceiling of the collision rate.
        gains: increase of sum v^2 and, of spheres that rotate, of q sum s^2.
    """

    kick: Float[Array, "pairs d"]
    spin_change: Float[Array, "pairs spins"]
    num: Float[Array, ""]
    missed: Float[Array, ""]
    gains: Float[Array, "energies"]


def collide(
    relative: Float[Array, "pairs d"],
    bits: UInt32[Array, "2 pairs"],
    ceiling: Float[Array, ""],
    chance: Float[Array, ""],
    scene: ReducedScene,
    spin: Float[Array, "pairs spins"],
    drag_factor: Float[Array, ""] | float = 1.0,
) -> Outcome:
    """Let candidate pairs collide at a rate proportional to |g|, with normals weighted by g.n.

    Args:
        relative: g = v_i - v_j of equal masses.
        bits: random bits.
        ceiling: |g| at which a candidate collides with probability 1 in a whole step.
        chance: probability of each collision of the whole step.
        scene: in reduced units.
        spin: s_i + s_j; smooth spheres have no components.
        drag_factor: ratio of physical velocities to these.
    """
    impacts = _draw_impacts(relative, bits, ceiling, chance)
    square = jnp.sum(impacts.along**2, axis=-1)
    hit = impacts.hit & (square > 0)
    speed = jnp.sqrt(jnp.where(hit, square, ceiling**2))
    eps = scene.law.restitution(speed * drag_factor)
    transfer = jnp.where(hit, (1 + eps) / 2, 0.0)
    lost = jnp.where(hit, (1 - eps**2) / 2 * square, 0.0)
    outcome = Outcome(
        kick=-transfer[:, None] * impacts.along,
        spin_change=spin,
        num=jnp.sum(hit, dtype=relative.dtype),
        missed=impacts.missed,
        gains=-jnp.sum(lost)[None],
    )
    surface = scene.surface
    if surface is None:
        return outcome
    normal = impacts.along / speed[:, None]
    across, kick, spin_change = tangential_impulse(
        relative, spin, normal, hit, surface.eta, surface, transfer * speed
    )
    gain = 2 * jnp.sum(kick * (across + kick))  # of translation alone
    rotational_gain = 2 * surface.inertia * jnp.sum(spin_change * (spin + spin_change))
    return outcome._replace(
        kick=outcome.kick + kick,
        spin_change=spin_change,
        gains=jnp.stack([outcome.gains[0] + gain, rotational_gain]),
    )


class _Impacts(NamedTuple):
    """Impacts that candidate pairs have, drawn at random.

    Attributes:
        hit: whether a pair collides, if its impact is not exactly grazing.
        along: the relative velocity along the normal of the impact.
        missed: number of collisions missed because of the ceiling.
    """

    hit: Bool[Array, "pairs"]
    along: Float[Array, "pairs d"]
    missed: Float[Array, ""]


def _draw_impacts(
    relative: Float[Array, "pairs d"],
    bits: UInt32[Array, "2 pairs"],
    ceiling: Float[Array, ""],
    chance: Float[Array, ""],
) -> _Impacts:
    """Draw impacts at a rate proportional to |g|, with normals weighted by g.n: see `collide`."""
    dtype = relative.dtype
    g = [relative[:, k] for k in range(relative.shape[-1])]
    square = sum(x * x for x in g)
    speed = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    uniform = (((bits[0] & 2047) << 11 | (bits[1] & 2047)).astype(dtype) + 0.5) * 2.0**-22
    hit = (square > 0) & (uniform * ceiling < speed * chance)
    signed = [((b >> 11).astype(dtype) + 0.5) * 2.0**-20 - 1 for b in bits]  # in (-1, 1)
    if len(g) == 2:
        # The impact parameter is uniform.
        sine = signed[0]
        cosine = jnp.sqrt(1 - sine**2)
        along = [cosine * (cosine * g[0] - sine * g[1]), cosine * (cosine * g[1] + sine * g[0])]
    else:
        # Elastic impacts would scatter g in a random direction.
        along = [(x - speed * n) / 2 for x, n in zip(g, _random_direction(*signed), strict=True)]
    beyond = jnp.where(square > 0, jnp.maximum(speed / ceiling - 1, 0.0), 0.0)
    return _Impacts(hit, jnp.stack(along, axis=-1), chance * jnp.sum(beyond))


SINE = [(-1) ** k * (pi / 2) ** (2 * k + 1) / factorial(2 * k + 1) for k in range(8)]
"""Taylor series of sin(pi x/2) in odd powers of x, within 6e-12 and below 1 for |x| <= 1."""


def _random_direction(
    up: Float[Array, "pairs"], turn: Float[Array, "pairs"]
) -> list[Float[Array, "pairs"]]:
    """Return random unit vectors from two numbers that are uniform in (-1, 1)."""
    x = 2 * jnp.abs(turn) - 1
    sine = x * jnp.polyval(jnp.asarray(SINE[::-1], x.dtype), x**2, unroll=len(SINE))
    # In float32 the sine may exceed 1 by rounding.
    cosine = jnp.copysign(jnp.sqrt(jnp.maximum(1 - sine**2, 0.0)), turn)
    across = jnp.sqrt(1 - up**2)
    return [across * sine, across * cosine, up]


MAX_SUBSETS = 16
"""Number of subsets of many particles."""

MIN_SUBSET_SIZE = 16
"""Minimum number of particles in a subset, whose kicks together conserve its momentum."""


def num_subsets(num_particles: int) -> int:
    """Return the number of subsets into which particles are divided."""
    return max(min(MAX_SUBSETS, num_particles // MIN_SUBSET_SIZE), 1)


Sums = TypeVar("Sums")


def change_subsets(
    particles: Float[Array, "N components"],
    first: Int[Array, ""],
    count: Int[Array, ""],
    largest: Int[Array, ""],
    change: Callable[..., tuple[Array, Sums]],
    sums: Sums,
) -> tuple[Float[Array, "N components"], Sums]:
    """Change some subsets of the particles of one replica; return all particles, and sums.

    A subset consists of neighbouring rows; each particle belongs to exactly one.

    Args:
        particles: the particles of the replica.
        first: index of the first subset; they follow each other periodically.
        count: number of subsets.
        largest: largest `count` of all replicas, which share the loop.
        change: a function of the index of the subset, rows of particles and a mask of those that
            belong to the subset. It returns the changed rows, and what this adds to the sums.
        sums: before the changes.
    """
    n = len(particles)
    subsets = num_subsets(n)
    size = -(-n // subsets)

    def change_one(i: Int[Array, ""], carry: tuple[Array, Sums]) -> tuple[Array, Sums]:
        particles, sums = carry
        index = ((first + i) & (2**30 - 1)) % subsets  # >= 0 where the sum overflows, too
        begin = index * n // subsets
        end = (index + 1) * n // subsets
        top = jnp.minimum(begin, n - size)
        row = top + jnp.arange(size, dtype=top.dtype)
        belongs = (row >= begin) & (row < end) & (i < count)
        rows, more = change(i, jax.lax.dynamic_slice_in_dim(particles, top, size), belongs)
        particles = jax.lax.dynamic_update_slice_in_dim(particles, rows, top, 0)
        return particles, jax.tree.map(jnp.add, sums, more)

    return jax.lax.fori_loop(0, largest, change_one, (particles, sums))
