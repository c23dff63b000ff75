"""Direct simulation Monte Carlo: the velocities of a homogeneous gas, by random collisions."""

from functools import partial
from math import sqrt
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran import collisions, initial, kinetics, observables, status
from jaxgran.checkpoint import fingerprint, refuse
from jaxgran.collisions import Scheme, State, Tangents
from jaxgran.curve import CoolingCurve
from jaxgran.gas import Gas
from jaxgran.restitution import ReducedLaw
from jaxgran.simulation import simulate

LONGEST_STEP = 0.1
"""Most collisions per particle in one step: a particle can be drawn at most twice in it."""

MISSED = 1e-4
"""Share of collisions that a run may miss beyond the ceiling before it is declared wrong."""

_CHUNK = 4_000_000  # candidate pairs between two looks at the clock: about a second


@partial(jax.jit, static_argnames=("scheme", "tangents"))
def _observe(state: State, first, law, key, *, scheme: Scheme, tangents: bool = False) -> dict:
    """Each replica at `time`: its next step is done in part, and then forgotten."""
    share = (state.time - state.clock) * jnp.sqrt(state.temperature) / scheme.own_step
    state = collisions.step(state, key, jnp.clip(share, 0.0, 1.0), law, scheme, tangents)
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
    a2, along = values["sonine"], state.tangents

    @jax.vmap
    def rates_of(speed, a2):
        return kinetics.Rates.of(kinetics.averages(law, speed, d), a2)

    rates = rates_of(speed, a2)
    cooling = 2 / d * rates.cooling * speed
    correlation = values["velocity_correlation"]
    per_time = {
        "temperature": -cooling * theta,
        "sonine": 2 * cooling * (1 + a2) - 4 / (d * (d + 2)) * rates.fourth_moment * speed,
        "displacement": 2 * jnp.mean(jnp.sum(travelled * velocity, axis=-1), axis=-1),
        "velocity_correlation": -rates.relaxation * speed * correlation,
        "collisions": kinetics.collision_rate(a2, d) * speed,
    }
    c = along.log_temperature
    at_own_time = {
        "temperature": theta[:, None] * c,
        "velocity_correlation": correlation[:, None] * (c / 2 + along.persistence),
        "displacement": along.displacement,
    }
    shifted = {
        name: at_own_time.get(name, 0.0) - rate[:, None] * along.clock
        for name, rate in per_time.items()
    }
    return {"values": values, "rates": per_time, "along": shifted}


@partial(jax.jit, static_argnames=("replicas", "scheme", "num_parameters"))
def _start(key: Array, replicas: int, scheme: Scheme, num_parameters: int) -> State:
    d = scheme.dimension
    key = jax.random.fold_in(collisions.wrapped(key), 2**32 - 1)
    v = initial.velocities(key, replicas, scheme.num_particles, d).reshape(replicas, -1, d)
    each, along = jnp.zeros(replicas, v.dtype), jnp.zeros((replicas, num_parameters), v.dtype)
    return State(
        time=jnp.zeros((), v.dtype),
        clock=each,
        temperature=each + 1,
        particles=jnp.concatenate([v / sqrt(2), jnp.zeros_like(v)], axis=-1),
        collisions=each,
        missed=each,
        steps=jnp.zeros(replicas, jnp.uint32),
        mobility=each,
        tangents=Tangents(*[along] * len(Tangents._fields)),
    )


@partial(jax.jit, static_argnames=("replicas", "scheme", "tangents"))
def _run(law: ReducedLaw, times, key, *, replicas: int, scheme: Scheme, tangents: bool):
    """Records at all times, as arrays of shape (times, replicas, ...), in compiled code alone."""
    num_parameters = ravel_pytree(law)[0].size if tangents else 0
    state = _start(key, replicas, scheme, num_parameters)
    first = state.particles[..., : scheme.dimension]
    forever = jnp.asarray(2**31 - 1, jnp.int32)

    def to(state, end):
        state = collisions.advance(state, end, law, key, forever, scheme=scheme, tangents=tangents)
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
    collisions does not depend on the speeds) the gas is taken to remember its temperature alone,
    and <dr^2> and the velocity correlation to change by the first Sonine order of diffusion; a_2
    is taken not to change. Rates of change with time are those of the Maxwell-Sonine distribution.

    Args:
        num_particles: N, >= 2.
        replicas: independent gases run side by side; two or more give error bars.
        key: of the random numbers; `jax.random.key(0)` by default.
        step: collisions per particle in one step, in (0, 0.1]; one pair at least, 0.5/N, which
            in a gas of some ten particles is longer than asked.
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
                raise ValueError(f"{name} must be a whole number >= {least}, an int, got {value!r}")
        if not isinstance(self.step, float | int) or not 0 < self.step <= LONGEST_STEP:
            raise ValueError(
                f"step must lie in (0, {LONGEST_STEP}] collisions per particle, got {self.step!r}; "
                "a particle collides at most twice in a step"
            )

    @property
    def accuracy(self) -> float:
        """Relative error of a derivative: what differs by less is not told apart."""
        return 0.01

    def cool(self, gas: Gas, times: Float[Array, "times"]) -> CoolingCurve:
        """The cooling curve at the given times, s; see `jaxgran.cool`, which checks them.

        Raises:
            RuntimeError: if impacts were too fast for the ceiling of the collision rate.
        """
        scheme = Scheme.of(gas.dimension, self.num_particles, self.step)
        law = gas.reduced_law
        # Of any kind of key, two words for the kind that is used here.
        key = jax.random.bits(jax.random.key(0) if self.key is None else self.key, (2,), jnp.uint32)
        reduced = times * gas.impact_speed / gas.path_length
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((gas, times, key))):
            records = self._traced(law, reduced, key, scheme)
        else:
            records = self._driven(law, reduced, key, scheme)
        return self._curve(gas, times, records)

    def _driven(self, law: ReducedLaw, times: Array, key: Array, scheme: Scheme) -> dict:
        """Run by a loop on the host, which shows progress and writes checkpoints."""
        start = _start(key, self.replicas, scheme, 0)
        scene = fingerprint(law, times, start, key, scheme)
        pairs = self.replicas * (scheme.first + scheme.second)
        max_steps = jnp.asarray(max(_CHUNK // pairs, 16), jnp.int32)
        first = start.particles[..., : scheme.dimension]

        def advance(state: State, end: float) -> State:
            end_array = jnp.asarray(end, times.dtype)
            return collisions.advance(state, end_array, law, key, max_steps, scheme=scheme)

        _, records = simulate(
            start,
            np.asarray(times),
            advance,
            partial(_observe, first=first, law=law, key=key, scheme=scheme),
            scene=scene,
            progress=self.progress,
            path=self.checkpoint,
        )
        fault = int(np.bitwise_or.reduce(records["fault"], axis=None))
        if fault != status.OK:
            raise RuntimeError(status.explain(fault))
        return {name: jnp.asarray(value) for name, value in records.items()}

    def _traced(self, law: ReducedLaw, times: Array, key: Array, scheme: Scheme) -> dict:
        """The same inside `jax.jit`, `jax.vmap` or a derivative."""
        refuse(self.checkpoint, "DSMC")
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
        return CoolingCurve.of_replicas(times, each, status=jnp.bitwise_or.reduce(fault, axis=None))
