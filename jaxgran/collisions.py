"""Random collisions of a homogeneous gas: one step of direct simulation Monte Carlo."""

from functools import cache, partial
from math import gcd, pi, sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jaxgran.gas import sphere_surface
from jaxgran.restitution import ReducedLaw

CEILING = 5.0
"""Relative speed in sqrt(2 T) up to which the collision rate is right; beyond, it stays level.

A Maxwellian misses 2e-6 of its collisions, 1e-5 of its losses. What a run misses is counted.
"""

RECOUNTED = 32
"""Steps after which T is taken from the velocities anew.

Between, losses are subtracted from it. Their round-off stays while T falls, and in float32 would
be all that is left of T at 1e-7 of its start.
"""


class Tangents(NamedTuple):
    """Derivatives at fixed own time s (ds = sqrt(T/T_0) dt) in P parameters of the law.

    The velocities' is c v / 2. That of <dr^2> follows ``d<dr^2>/ds = 2 d M``,
    ``dM/ds = 1/2 - kappa M``, kinetic theory's equation for ``M = D / sqrt(T/T_0)``, with the rate
    kappa of velocity relaxation less half the cooling rate measured on the impacts themselves.
    """

    log_temperature: Array  # (R, P) c of ln T
    clock: Array  # (R, P)
    mobility: Array  # (R, P) of M
    displacement: Array  # (R, P) of <dr^2>
    persistence: Array  # (R, P) of the logarithm of <v(0).v> / sqrt(T)


class State(NamedTuple):
    """R replicas of N particles. Units: the impact speed sqrt(2 T_0) and the path length."""

    time: Array  # to which every replica has come
    clock: Array  # (R,) start of the step that reaches beyond `time`
    temperature: Array  # (R,) T/T_0, kept by the losses and recounted now and then
    particles: Array  # (R, N, 2d): v, and x - v t, which changes in collisions alone
    collisions: Array  # (R,) pairs
    missed: Array  # (R,) pairs beyond the ceiling
    steps: Array  # (R,)
    mobility: Array  # (R,) D / sqrt(T/T_0), followed where there are tangents
    tangents: Tangents


class Scheme(NamedTuple):
    """Static sizes of one step of N particles.

    `first` disjoint random pairs, then `second` pairs of one particle drawn before and one fresh.
    """

    dimension: int
    num_particles: int
    first: int
    second: int

    @classmethod
    def of(cls, dimension: int, num_particles: int, step: float) -> "Scheme":
        # Of M pairs drawn one after the other with return, 2 M (M - 1) / N follow, on average, one
        # with which they share a particle. As many do here, which makes the step second order.
        accepted = sphere_surface(dimension) / sqrt(2 * pi) / (2 ** (dimension - 1) * CEILING)
        pairs = max(round(step * num_particles / (2 * accepted)), 1)
        second = round(2 * pairs * (pairs - 1) / num_particles)
        return cls(dimension, num_particles, pairs - second, second)

    @property
    def own_step(self) -> float:
        """``dt sqrt(T/T_0)`` of a step."""
        candidates = 2 * (self.first + self.second) / self.num_particles
        return candidates / (2 ** (self.dimension - 1) * CEILING)


@cache
def _strides(num_particles: int) -> np.ndarray:
    # Coprime to N, and so small that stride * N fits 32 bits.
    top = min(num_particles, 2**32 // num_particles - 1)
    return np.array([s for s in range(1, max(top, 2)) if gcd(s, num_particles) == 1], np.uint32)


def _draw(bits: Array, scheme: Scheme) -> tuple[Array, Array, Array]:
    """Indices of the particles of the first pairs, and of the fresh ones of the second pairs.

    Labels carry no physics, so that evenly spread ones will do as long as any two particles are
    about equally likely to meet: particles a + s l for random a and s, the partners j places
    further on. Each particle is drawn as often as any other. Pairs are, too, if N is prime; else
    those whose distance shares a large divisor with N, one in a hundred at N = 1000, are up to 1.7
    times as likely, and the likelihoods scatter by 6 % (14 % at N = 64).
    """
    n, first, second = scheme.num_particles, scheme.first, scheme.second
    strides = jnp.asarray(_strides(n))
    stride = strides[bits[0] % len(strides)]
    apart = first + second + bits[1] % (n - 2 * first - second + 1)

    def particle(place):
        return ((bits[2] % n + stride * place) % n).astype(jnp.int32)

    place = jnp.arange(first, dtype=jnp.uint32)
    # The fresh ones stand between, also at a random distance.
    fresh = first + bits[3] % (apart - (first + second) + 1) + jnp.arange(second, dtype=jnp.uint32)
    return particle(place), particle(place + apart), particle(fresh)


class _Impacts(NamedTuple):
    """What collisions of pairs do: kicks (pairs, d) to the first of each, and sums over them."""

    kick: Array
    num: Array
    missed: Array
    loss: Array  # of sum v^2
    memory: Array  # sum (1 + eps)^2 (g.n)^2 / 4: what D/sqrt(T) forgets
    along: Array  # (2, P) tangents of -loss and of memory in the law's parameters
    along_speed: Array  # (2,) and in the logarithm of all speeds


def _impacts(
    relative: Array, bits: Array, ceiling: Array, share: Array, law: ReducedLaw, tangents: bool
) -> _Impacts:
    """Let candidate pairs collide, at rates as |g|, with normals as g.n; equal masses.

    Args:
        relative: g = v_i - v_j, shape (pairs, d).
        bits: 32 random ones, shape (2, pairs).
        ceiling: |g| at which a candidate surely collides.
        share: of the step to be done.
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
    if d == 2:
        sideways = [[-axis[1], axis[0]]]
    else:
        x, y, z = axis
        sign = jnp.where(z < 0, -1.0, 1.0)
        a = -1 / (sign + z)
        sideways = [
            [1 + sign * x * x * a, sign * x * y * a, -sign * x],
            [x * y * a, sign + y * y * a, -y],
        ]
    normal_speed = jnp.where(hit, speed * cosine, ceiling)

    def restitution(law, log_scale):
        return law.restitution(normal_speed * jnp.exp(log_scale))

    zero = jnp.zeros((), dtype)
    if tangents:
        eps, pull = jax.vjp(restitution, law, zero)
        weights = [jnp.where(hit, x * normal_speed**2, 0.0) for x in (eps, (1 + eps) / 2)]
        in_law, along_speed = jax.vmap(pull)(jnp.stack(weights))
        along = jnp.zeros((2, 0), dtype)
        if jax.tree.leaves(in_law):  # a law may have no floats
            along = jax.vmap(lambda x: ravel_pytree(x)[0])(in_law)
    else:
        eps, along, along_speed = restitution(law, zero), jnp.zeros((2, 0), dtype), zero
    square = jnp.where(hit, normal_speed**2, 0.0)
    push = jnp.where(hit, (1 + eps) / 2 * normal_speed, 0.0)
    normal = [
        cosine * axis[k] + sum(b * e[k] for b, e in zip(offset, sideways, strict=True))
        for k in range(d)
    ]
    return _Impacts(
        kick=jnp.stack([-push * n for n in normal], axis=-1),
        num=jnp.sum(hit, dtype=dtype),
        missed=share * jnp.sum(jnp.where(met, jnp.maximum(speed / ceiling - 1, 0.0), 0.0)),
        loss=jnp.sum((1 - eps**2) / 2 * square),
        memory=jnp.sum((1 + eps) ** 2 / 4 * square),
        along=along,
        along_speed=along_speed,
    )


def _step(
    state: State, key: Array, share: Array, law: ReducedLaw, scheme: Scheme, tangents: bool
) -> State:
    """A share, 0 to 1, of one step of one replica, always with the same random numbers.

    A share does each collision of the whole step with that probability, so that the state within
    a step is as right as at its end.
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
    collide = partial(_impacts, ceiling=CEILING * speed, share=share, law=law, tangents=tangents)
    one = collide(v[:first] - v[first : 2 * first], bits[:, :first])
    twice = one.kick[:second]
    two = collide(v[:second] + twice - v[2 * first :], bits[:, first:-2])
    kicks = jnp.concatenate([twice + two.kick, one.kick[second:], -one.kick, -two.kick])
    one = jax.tree.map(jnp.add, one._replace(kick=0.0), two._replace(kick=0.0))
    # Collisions at the middle of the step, on average: x - v t jumps by -kick t.
    middle = state.clock + dt / 2
    new = old + jnp.concatenate([kicks, -middle * kicks], axis=-1)

    energy = n * d / 2  # sum v^2 at T_0
    temperature = state.temperature - one.loss / energy
    state = state._replace(
        clock=state.clock + dt,
        temperature=temperature,
        particles=state.particles.at[index].set(new, **options),
        collisions=state.collisions + one.num,
        missed=state.missed + one.missed,
        steps=state.steps + (share > 0).astype(state.steps.dtype),
    )
    if not tangents:
        return state
    return _carry_tangents(state, one, dt, share * scheme.own_step, energy * temperature)


def _carry_tangents(state: State, sums: _Impacts, dt: Array, ds: Array, energy: Array) -> State:
    """Tangents through one step, of length dt in time and ds in own time; energy is sum v^2."""
    old = state.tangents
    c = old.log_temperature
    # Velocities have the tangent (c/2) v; the law adds to it at every impact.
    gain, fading = (sums.along + sums.along_speed[:, None] * (c / 2)[None]) / energy
    # dM/ds = 1/2 - kappa M and its tangent, by the implicit midpoint rule.
    half = sums.memory / energy / 2
    before = state.mobility
    mobility = ((1 - half) * before + ds / 2) / (1 + half)
    along = ((1 - half) * old.mobility - fading * (before + mobility) / 2) / (1 + half)
    tangents = Tangents(
        log_temperature=c + gain,
        clock=old.clock - c / 2 * dt,
        mobility=along,
        displacement=old.displacement + state.particles.shape[-1] / 2 * ds * (old.mobility + along),
        persistence=old.persistence - fading,
    )
    return state._replace(mobility=mobility, tangents=tangents)


def wrapped(words: Array) -> Array:
    """Two 32-bit words as a key; threefry, whose numbers do not change under `jax.vmap`."""
    return jax.random.wrap_key_data(words, impl="threefry2x32")


def step(
    state: State, key: Array, share: Array, law: ReducedLaw, scheme: Scheme, tangents: bool
) -> State:
    """A share, 0 to 1, of the next step of each replica; shape (replicas,)."""
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
    state: State,
    end: Array,
    law: ReducedLaw,
    key: Array,
    max_steps: Array,
    *,
    scheme: Scheme,
    tangents: bool = False,
) -> State:
    """Whole steps towards `end`, each replica up to its last one that ends before it."""

    def due(state):
        return state.clock + scheme.own_step / jnp.sqrt(state.temperature) <= end

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
