"""One step of direct simulation Monte Carlo: random collisions of a homogeneous gas."""

from functools import cache, partial
from math import gcd, pi, sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt, UInt32

from jaxgran.particles.stochastic.collision_rule import Outcome, collide
from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.restitution import ReducedLaw

CEILING = 5.0
"""Relative speed, in sqrt(2 T), up to which the collision rate is right; beyond, it is constant.

A Maxwellian gas misses 2e-6 of its collisions by this, and 1e-5 of its losses. A run counts what it
misses.
"""

RECOUNTED = 32
"""Steps after which T is computed from the velocities again.

In between it is updated by the losses. The rounding errors of this sum do not shrink as T falls,
and in float32 they would dominate T once it has fallen to 1e-7 of its first value.
"""


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


class DSMCState(NamedTuple):
    """R replicas of N particles. Units: the impact speed sqrt(2 T_0) and the path length.

    Attributes:
        time: which all replicas have reached.
        clock: start of the step of each replica that ends beyond `time`.
        clock_rest: what rounding has left out of `clock`, a compensated sum.
        temperature: T/T_0, updated by the losses and recomputed every `RECOUNTED` steps.
        particles: the 2 d components of v and of x - v t, which only collisions change.
        collisions: number of pairs that collided.
        missed: number of collisions missed because of the `CEILING`.
        steps: number of steps.
        mobility: M = D / sqrt(T/T_0), followed together with the tangents.
        tangents: in the parameters of the law.
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
    tangents: DSMCTangents


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


def _draw(
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


def _step(
    state: DSMCState,
    key: PRNGKeyArray,
    share: Float[Array, ""],
    law: ReducedLaw,
    scheme: Scheme,
    tangents: bool,
) -> DSMCState:
    """A share, 0 to 1, of one step of one replica, always with the same random numbers.

    Each collision of the whole step takes place with this probability, so that the state within
    a step is as accurate as at its end.
    """
    n, d, first, second = scheme.num_particles, scheme.dimension, scheme.first, scheme.second
    key = jax.random.fold_in(key, state.steps)
    bits = jax.random.bits(key, (2, first + second + 2), jnp.uint32)
    i, j, k = _draw(bits[:, -2:].ravel(), scheme)
    index = jnp.concatenate([i, j, k])
    options = {"mode": "promise_in_bounds", "unique_indices": True}
    old = state.particles.at[index].get(**options)
    v = old[:, :d]

    speed = jnp.sqrt(state.temperature)
    dt = share * scheme.own_step / speed
    rule = partial(collide, ceiling=CEILING * speed, share=share, law=law, tangents=tangents)
    one = rule(v[:first] - v[first : 2 * first], bits[:, :first])
    twice = one.kick[:second]
    two = rule(v[:second] + twice - v[2 * first :], bits[:, first:-2])
    kicks = jnp.concatenate([twice + two.kick, one.kick[second:], -one.kick, -two.kick])
    one = jax.tree.map(jnp.add, one._replace(kick=0.0), two._replace(kick=0.0))
    # Collisions happen at the middle of the step, on average: x - v t changes by -kick t.
    middle = state.clock + dt / 2
    new = old + jnp.concatenate([kicks, -middle * kicks], axis=-1)

    energy = n * d / 2  # sum v^2 at T_0
    temperature = state.temperature - one.loss / energy
    passed = state.clock_rest + dt
    clock = state.clock + passed
    state = state._replace(
        clock=clock,
        clock_rest=passed - (clock - state.clock),
        temperature=temperature,
        particles=state.particles.at[index].set(new, **options),
        collisions=state.collisions + one.num,
        missed=state.missed + one.missed,
        steps=state.steps + (share > 0).astype(state.steps.dtype),
    )
    if not tangents:
        return state
    return _carry_tangents(state, one, dt, share * scheme.own_step, energy * temperature)


def _carry_tangents(
    state: DSMCState,
    sums: Outcome,
    dt: Float[Array, ""],
    ds: Float[Array, ""],
    energy: Float[Array, ""],
) -> DSMCState:
    """The tangents after a step of length dt in time and ds in own time; energy is sum v^2."""
    old = state.tangents
    c = old.log_temperature
    # The tangent of the velocities is (c/2) v; the law adds to it at every collision.
    gain, fading = (sums.along + sums.along_speed[:, None] * (c / 2)[None]) / energy
    # dM/ds = 1/2 - kappa M and its tangent, by the implicit midpoint rule.
    half = sums.memory / energy / 2
    before = state.mobility
    mobility = ((1 - half) * before + ds / 2) / (1 + half)
    along = ((1 - half) * old.mobility - fading * (before + mobility) / 2) / (1 + half)
    tangents = DSMCTangents(
        log_temperature=c + gain,
        clock=old.clock - c / 2 * dt,
        mobility=along,
        displacement=old.displacement + state.particles.shape[-1] / 2 * ds * (old.mobility + along),
        persistence=old.persistence - fading,
    )
    return state._replace(mobility=mobility, tangents=tangents)


def wrapped(words: UInt32[Array, "2"]) -> PRNGKeyArray:
    """Two 32-bit words as a key of threefry, whose numbers do not change under `jax.vmap`."""
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def step(
    state: DSMCState,
    key: UInt32[Array, "2"],
    share: Float[Array, "replicas"],
    law: ReducedLaw,
    scheme: Scheme,
    tangents: bool,
) -> DSMCState:
    """A share, 0 to 1, of the next step of each replica."""
    replicas = jnp.arange(len(state.clock), dtype=jnp.uint32)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(wrapped(key), replicas)
    one = partial(_step, law=law, scheme=scheme, tangents=tangents)
    axes = jax.tree.map(lambda _: 0, state)._replace(time=None)
    state = jax.vmap(one, (axes, 0, 0), axes)(state, keys, share)
    due = state.steps % RECOUNTED == 0

    def recounted(temperature):
        velocity = state.particles[..., : scheme.dimension]
        counted = 2 * jnp.mean(velocity**2, axis=(1, 2))
        return jnp.where(due, counted, temperature)

    temperature = jax.lax.cond(jnp.any(due), recounted, lambda x: x, state.temperature)
    return state._replace(temperature=temperature)


@partial(jax.jit, static_argnames=("scheme", "tangents"))
def advance(
    state: DSMCState,
    end: Float[Array, ""],
    law: ReducedLaw,
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
        law: of restitution, in reduced units.
        key: of the random numbers, two 32-bit words.
        max_steps: the most steps to take; `time` of the state tells how far they led.
        scheme: sizes of a step.
        tangents: whether tangents are followed.
    """

    def due(state):
        left = (end - state.clock) - state.clock_rest
        return scheme.own_step / jnp.sqrt(state.temperature) <= left

    def unfinished(carry):
        state, left = carry
        return jnp.any(due(state)) & (left > 0)

    def further(carry):
        state, left = carry
        share = due(state).astype(state.clock.dtype)
        return step(state, key, share, law, scheme, tangents), left - 1

    state, _ = jax.lax.while_loop(unfinished, further, (state, max_steps))
    time = jnp.where(jnp.any(due(state)), jnp.min(state.clock), end)
    return state._replace(time=jnp.maximum(time, state.time))
