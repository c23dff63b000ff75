"""Direct simulation Monte Carlo: the velocities of a homogeneous gas, by random collisions."""

from functools import cache, partial
from math import gcd, pi, sqrt
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran import initial, kinetics, observables, status
from jaxgran.checkpoint import fingerprint
from jaxgran.curve import CoolingCurve
from jaxgran.gas import Gas, sphere_surface
from jaxgran.restitution import ReducedLaw
from jaxgran.simulation import simulate

CEILING = 5.5
"""Relative speed in sqrt(2 T) up to which the collision rate is right; beyond, it stays level.

A Maxwellian has one collision in 1e7 beyond. What a run missed is counted and judged."""

LONGEST_STEP = 0.1
"""Most collisions per particle in one step: a particle can be drawn at most twice in it."""

MISSED = 1e-4
"""Share of collisions that a run may miss beyond the ceiling before it is declared wrong."""

_CHUNK = 4_000_000  # candidate pairs between two looks at the clock: about a second


class _State(NamedTuple):
    # Units: the impact speed sqrt(2 T_0) and the path length, as in kinetics. R replicas.
    time: Array  # to which every replica has come
    clock: Array  # (R,) start of the step that reaches beyond `time`
    temperature: Array  # (R,) T/T_0, kept by the losses
    particles: Array  # (R, N, 2d): v, and x - v t, which changes in collisions alone
    collisions: Array  # (R,) pairs
    missed: Array  # (R,) pairs beyond the ceiling
    steps: Array  # (R,)
    log_tangent: Array  # (R, P) d ln T / d parameter at fixed own time
    clock_tangent: Array  # (R, P)


class _Scheme(NamedTuple):
    """Static sizes of one step of N particles.

    `first` disjoint random pairs, then `second` pairs of one particle drawn before and one fresh.
    """

    dimension: int
    num_particles: int
    first: int
    second: int
    max_steps: int | None = None

    @classmethod
    def of(cls, dimension: int, num_particles: int, step: float) -> "_Scheme":
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


def _draw(bits: Array, scheme: _Scheme) -> tuple[Array, Array, Array]:
    """Indices of the particles of the first pairs, and of the fresh ones of the second pairs.

    Labels carry no physics, so that evenly spread ones will do as long as any two particles are
    equally likely to meet: particles a + s l for random a and s, the partners j places further on.
    """
    n, first, second = scheme.num_particles, scheme.first, scheme.second
    strides = jnp.asarray(_strides(n))
    stride = strides[bits[0] % len(strides)]
    apart = first + second + bits[1] % (n - 2 * first - second + 1)

    def particle(place):
        return ((bits[2] % n + stride * place) % n).astype(jnp.int32)

    place = jnp.arange(first, dtype=jnp.uint32)
    # Backwards, or the second partners of a stride would all stand at one distance.
    fresh = jnp.arange(first + second - 1, first - 1, -1, dtype=jnp.uint32)
    return particle(place), particle(place + apart), particle(fresh)


class _Impacts(NamedTuple):
    """What collisions of pairs do: kicks (pairs, d) to the first of each, and sums over them."""

    kick: Array
    num: Array
    missed: Array
    loss: Array  # of sum v^2
    gain_along: Array  # (P,) tangent of sum v^2 in the law's parameters
    gain_along_speed: Array  # and in the logarithm of all speeds


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
        law_along, along_speed = pull(jnp.where(hit, eps * normal_speed**2, 0.0))
        along = ravel_pytree(law_along)[0]
    else:
        eps, along, along_speed = restitution(law, zero), jnp.zeros(0, dtype), zero
    push = jnp.where(hit, (1 + eps) / 2 * normal_speed, 0.0)
    loss = jnp.where(hit, (1 - eps**2) / 2 * normal_speed**2, 0.0)
    normal = [
        cosine * axis[k] + sum(b * e[k] for b, e in zip(offset, sideways, strict=True))
        for k in range(d)
    ]
    return _Impacts(
        kick=jnp.stack([-push * n for n in normal], axis=-1),
        num=jnp.sum(hit, dtype=dtype),
        missed=share * jnp.sum(jnp.where(met, jnp.maximum(speed / ceiling - 1, 0.0), 0.0)),
        loss=jnp.sum(loss),
        gain_along=along,
        gain_along_speed=along_speed,
    )


def _step(
    state: _State, key: Array, share: Array, law: ReducedLaw, scheme: _Scheme, tangents: bool
) -> _State:
    """A share, 0 to 1, of one step of one replica, always with the same random numbers.

    A share does each collision of the whole step with that probability, so that the state within
    a step is as right as at its end.
    """
    n, d, first, second = scheme.num_particles, scheme.dimension, scheme.first, scheme.second
    key = jax.random.fold_in(key, state.steps)
    bits = jax.random.bits(key, (2 * (first + second) + 3,), jnp.uint32)
    chances = bits[3:].reshape(2, -1)
    i, j, k = _draw(bits, scheme)
    index = jnp.concatenate([i, j, k])
    options = {"mode": "promise_in_bounds", "unique_indices": True}
    old = state.particles.at[index].get(**options)
    v = old[:, :d]

    speed = jnp.sqrt(state.temperature)
    dt = share * scheme.own_step / speed
    collide = partial(_impacts, ceiling=CEILING * speed, share=share, law=law, tangents=tangents)
    one = collide(v[:first] - v[first : 2 * first], chances[:, :first])
    kicks = jnp.concatenate([one.kick, -one.kick, jnp.zeros((second, d), v.dtype)])
    if second:
        two = collide(v[:second] + one.kick[:second] - v[2 * first :], chances[:, first:])
        kicks = kicks.at[:second].add(two.kick).at[2 * first :].set(-two.kick)
        one = jax.tree.map(jnp.add, one._replace(kick=0.0), two._replace(kick=0.0))
    # Collisions at the middle of the step, on average: x - v t jumps by -kick t.
    middle = state.clock + dt / 2
    new = old + jnp.concatenate([kicks, -middle * kicks], axis=-1)

    energy = n * d / 2  # sum v^2 at T_0
    temperature = state.temperature - one.loss / energy
    c = state.log_tangent
    # Velocities have the tangent (c/2) v; the law adds to it at every impact.
    gain = one.gain_along + one.gain_along_speed * c / 2
    return state._replace(
        clock=state.clock + dt,
        temperature=temperature,
        particles=state.particles.at[index].set(new, **options),
        collisions=state.collisions + one.num,
        missed=state.missed + one.missed,
        steps=state.steps + (share > 0).astype(state.steps.dtype),
        log_tangent=c + gain / (energy * temperature),
        clock_tangent=state.clock_tangent - c / 2 * dt,
    )


def _replica_keys(key: Array, replicas: int) -> Array:
    return jax.vmap(jax.random.fold_in, (None, 0))(
        jax.random.wrap_key_data(key), jnp.arange(replicas, dtype=jnp.uint32)
    )


_AXES = _State(**{name: None if name == "time" else 0 for name in _State._fields})


def _all_step(state, key, share, law, scheme, tangents) -> _State:
    keys = _replica_keys(key, len(state.clock))
    one = partial(_step, law=law, scheme=scheme, tangents=tangents)
    return jax.vmap(one, (_AXES, 0, 0), _AXES)(state, keys, share)


@partial(jax.jit, static_argnames=("scheme", "tangents"))
def _advance(state: _State, end, law, key, *, scheme: _Scheme, tangents: bool = False) -> _State:
    """Whole steps towards `end`, each replica up to its last that ends before it."""

    def due(state):
        return state.clock + scheme.own_step / jnp.sqrt(state.temperature) <= end

    def unfinished(carry):
        state, left = carry
        return jnp.any(due(state)) & (left > 0)

    def further(carry):
        state, left = carry
        share = due(state).astype(state.clock.dtype)
        less = 0 if scheme.max_steps is None else 1
        return _all_step(state, key, share, law, scheme, tangents), left - less

    most = 1 if scheme.max_steps is None else scheme.max_steps
    state, _ = jax.lax.while_loop(unfinished, further, (state, jnp.asarray(most, jnp.int32)))
    time = jnp.where(jnp.any(due(state)), jnp.min(state.clock), end)
    return state._replace(time=jnp.maximum(time, state.time))


@partial(jax.jit, static_argnames=("scheme", "tangents"))
def _observe(state: _State, first, law, key, *, scheme: _Scheme, tangents: bool = False) -> dict:
    """Each replica at `time`: its next step is done in part, and then forgotten."""
    share = (state.time - state.clock) * jnp.sqrt(state.temperature) / scheme.own_step
    state = _all_step(state, key, jnp.clip(share, 0.0, 1.0), law, scheme, tangents)
    d = scheme.dimension

    def centred(x):
        return x - jnp.mean(x, axis=1, keepdims=True)

    velocity = centred(state.particles[..., :d])
    travelled = centred(
        state.particles[..., d:] + state.clock[:, None, None] * state.particles[..., :d]
    )
    theta = 2 * observables.temperature(velocity)
    values = {
        "temperature": theta,
        "sonine": observables.sonine(velocity),
        "displacement": observables.mean_square_displacement(travelled),
        "velocity_correlation": 2 * observables.velocity_correlation(first, velocity),
        "collisions": 2 / scheme.num_particles * state.collisions,
    }
    fast = status.flag(status.TOO_FAST, state.missed > MISSED * state.collisions + 1)
    values["fault"] = fast | status.flag(status.NOT_FINITE, ~jnp.isfinite(theta))
    if not tangents:
        return values

    # How fast each changes, so that a shift of the clock can be turned into one of the value.
    speed = jnp.sqrt(theta)
    averages = jax.vmap(lambda s: kinetics.averages(law, s, d), out_axes=2)(speed)
    rates = kinetics.Rates.of(averages, values["sonine"])
    cooling = 2 / d * rates.cooling * speed
    a2, c = values["sonine"], state.log_tangent
    correlation = values["velocity_correlation"]
    per_time = {
        "temperature": -cooling * theta,
        "sonine": 2 * cooling * (1 + a2) - 4 / (d * (d + 2)) * rates.fourth_moment * speed,
        "displacement": 2 * jnp.mean(jnp.sum(travelled * velocity, axis=-1), axis=-1),
        "velocity_correlation": -rates.relaxation * speed * correlation,
        "collisions": kinetics.collision_rate(a2, d) * speed,
    }
    at_own_time = {
        "temperature": theta[:, None] * c,
        "velocity_correlation": correlation[:, None] * c / 2,
    }
    along = {
        name: at_own_time.get(name, 0.0) - rate[:, None] * state.clock_tangent
        for name, rate in per_time.items()
    }
    return {"values": values, "rates": per_time, "along": along}


def _start(key: Array, replicas: int, scheme: _Scheme, num_parameters: int) -> _State:
    d = scheme.dimension
    key = jax.random.fold_in(jax.random.wrap_key_data(key), 2**32 - 1)
    v = initial.velocities(key, replicas, scheme.num_particles, d).reshape(replicas, -1, d)
    each, along = jnp.zeros(replicas, v.dtype), jnp.zeros((replicas, num_parameters), v.dtype)
    return _State(
        time=jnp.zeros((), v.dtype),
        clock=each,
        temperature=each + 1,
        particles=jnp.concatenate([v / sqrt(2), jnp.zeros_like(v)], axis=-1),
        collisions=each,
        missed=each,
        steps=jnp.zeros(replicas, jnp.uint32),
        log_tangent=along,
        clock_tangent=along,
    )


@partial(jax.jit, static_argnames=("replicas", "scheme", "tangents"))
def _run(law: ReducedLaw, times, key, *, replicas: int, scheme: _Scheme, tangents: bool):
    """Records at all times, as arrays of shape (times, replicas, ...), in compiled code alone."""
    num_parameters = ravel_pytree(law)[0].size if tangents else 0
    state = _start(key, replicas, scheme, num_parameters)
    first = state.particles[..., : scheme.dimension]

    def to(state, end):
        state = _advance(state, end, law, key, scheme=scheme, tangents=tangents)
        return state, _observe(state, first, law, key, scheme=scheme, tangents=tangents)

    return jax.lax.scan(to, state, times)[1]


class DSMC(eqx.Module):
    """Homogeneous gas of hard spheres by direct simulation Monte Carlo: velocities, no positions.

    Solves the Enskog-Boltzmann equation of the homogeneous gas with any law of restitution:
    pairs collide at the rate ``sigma^(d-1) g_2 / V`` times ``g.n`` for each normal n with
    ``g.n > 0``, ``v_i -> v_i - (1 + eps)/2 (g.n) n``, ``v_j -> v_j + (1 + eps)/2 (g.n) n``.
    Exact in the velocity distribution where kinetic theory takes two Sonine terms. Leaves out
    correlations, clustering and the duration of contacts.

    A step takes a fixed share of the current mean free time. Its error is of second order: a
    step draws disjoint random pairs, and then pairs that share a particle with those, as often as
    drawing one pair after the other would. Means of N particles err by O(1/N).

    The curve is differentiable in every float of the gas and in the times, forward and reverse.
    The derivatives are estimates: at fixed own time (dt = dtau / sqrt(T), so that the order of
    collisions does not depend on the speeds) the gas is taken to remember its temperature alone;
    the law's direct influence on a_2 and on how long velocities persist, and through it on
    <dr^2>, is left out. Rates of change with time are those of the Maxwell-Sonine distribution.

    Args:
        num_particles: N, >= 2.
        replicas: independent gases run side by side; two or more give error bars.
        key: of the random numbers; `jax.random.key(0)` by default.
        step: collisions per particle in one step, in (0, 0.1].
        progress: show a progress bar on a terminal.
        checkpoint: a file to save the run to each minute and to resume it from. The resumed run
            gives the same numbers bit for bit.

    Raises:
        ValueError: for numbers out of range.

    Reference: G. A. Bird, Molecular Gas Dynamics (1994); J. M. Montanero & A. Santos, PRE 54, 438
    (1996) for dense gases; Brilliantov & Poeschel for the granular gas.
    """

    num_particles: int = eqx.field(static=True)
    replicas: int = eqx.field(static=True, default=1)
    key: PRNGKeyArray | None = None
    step: float = eqx.field(static=True, default=0.05)
    progress: bool = eqx.field(static=True, default=True)
    checkpoint: str | Path | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        for name, least in (("num_particles", 2), ("replicas", 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
        if not isinstance(self.step, float | int) or not 0 < self.step <= LONGEST_STEP:
            raise ValueError(
                f"step must lie in (0, {LONGEST_STEP}] collisions per particle, got {self.step!r}; "
                "a particle collides at most twice in a step"
            )

    def cool(self, gas: Gas, times: Float[Array, "times"]) -> CoolingCurve:
        """The cooling curve at the given times, s; see `jaxgran.cool`, which checks them.

        Raises:
            RuntimeError: if impacts were too fast for the ceiling of the collision rate.
        """
        scheme = _Scheme.of(gas.dimension, self.num_particles, self.step)
        law = gas.reduced_law
        key = jax.random.key_data(jax.random.key(0) if self.key is None else self.key)
        reduced = times * gas.impact_speed / gas.path_length
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((gas, times, key))):
            records = self._traced(law, reduced, key, scheme)
        else:
            records = self._driven(law, reduced, key, scheme)
        return self._curve(gas, times, records)

    def _driven(self, law: ReducedLaw, times: Array, key: Array, scheme: _Scheme) -> dict:
        """Run by a loop on the host, which shows progress and writes checkpoints."""
        pairs = self.replicas * (scheme.first + scheme.second)
        scheme = scheme._replace(max_steps=max(_CHUNK // pairs, 16))
        start = _start(key, self.replicas, scheme, 0)
        first = start.particles[..., : scheme.dimension]

        def advance(state: _State, end: float) -> _State:
            return _advance(state, jnp.asarray(end, times.dtype), law, key, scheme=scheme)

        _, records = simulate(
            start,
            np.asarray(times),
            advance,
            partial(_observe, first=first, law=law, key=key, scheme=scheme),
            scene=fingerprint(law, times, start, key, scheme),
            progress=self.progress,
            path=self.checkpoint,
        )
        fault = int(np.bitwise_or.reduce(records["fault"], axis=None))
        if fault != status.OK:
            raise RuntimeError(status.explain(fault))
        return {name: jnp.asarray(value) for name, value in records.items()}

    def _traced(self, law: ReducedLaw, times: Array, key: Array, scheme: _Scheme) -> dict:
        """The same inside `jax.jit`, `jax.vmap` or a derivative."""
        parameters, unravel = ravel_pytree(law)
        run = partial(_run, replicas=self.replicas, scheme=scheme)

        # One linear rule for forward and reverse mode, from tangents carried beside the state.
        @jax.custom_jvp
        def solve(parameters, times, key):
            return run(unravel(parameters), times, key, tangents=False)

        @solve.defjvp
        def solve_jvp(at, along):
            parameters, times, key = at
            out = run(unravel(parameters), times, key, tangents=True)
            values = out["values"]
            tangents = {
                name: rate * along[1][:, None] + out["along"][name] @ along[0]
                for name, rate in out["rates"].items()
            }
            return values, tangents | {"fault": np.zeros(values["fault"].shape, jax.dtypes.float0)}

        return solve(parameters, times, key)

    def _curve(self, gas: Gas, times: Array, records: dict) -> CoolingCurve:
        fault = records["fault"]
        units = {
            "temperature": gas.temperature,
            "sonine": 1.0,
            "displacement": gas.path_length**2,
            "velocity_correlation": gas.temperature,
            "collisions": 1.0,
        }
        each = {
            name: jnp.where(fault == status.OK, records[name], jnp.nan).T * unit
            for name, unit in units.items()
        }
        mean = {name: jnp.mean(values, axis=0) for name, values in each.items()}
        errors = {}
        if self.replicas > 1:
            for name in ("temperature", "displacement"):
                # Where all replicas agree, at t = 0, a root has no derivative.
                deviation = jnp.std(jax.lax.stop_gradient(each[name]), axis=0, ddof=1)
                errors[f"{name}_error"] = deviation / self.replicas**0.5
        return CoolingCurve(
            times=times,
            **mean,
            **errors,
            replicas=CoolingCurve(times=times, **each),
            status=jnp.bitwise_or.reduce(fault, axis=None),
        )

