"""A DSMC run: its initial state, its records, and the run as a pure function.

The units are the impact speed sqrt(2 T_0) and the path length, also of times and reduced laws of
restitution. A key of random numbers is two 32-bit words.
"""

from collections.abc import Callable
from functools import partial
from math import sqrt
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, UInt32

from jaxgran._utils import status
from jaxgran.data.curve import Particles
from jaxgran.gradients.rule import first_order_only, nan_tangent, nan_tangent_like
from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles import observables, snapshot
from jaxgran.particles.dsmc import collisions
from jaxgran.particles.dsmc.collisions import DSMCDynamics, DSMCState, DSMCTangents, Scheme
from jaxgran.particles.setup import maxwellian_velocities
from jaxgran.particles.snapshot import Units
from jaxgran.particles.state import (
    centred,
    copy_buffers,
    drag_decay,
    maxwellian_spins,
    threefry_key,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedScene
from jaxgran.theory import averages


@partial(jax.jit, static_argnames=("replicas", "num_parameters"))
def initial_dsmc_state(
    dynamics: DSMCDynamics, key: UInt32[Array, "2"], replicas: int, num_parameters: int
) -> DSMCState:
    """Return the state at t = 0, with Maxwellian velocities and tangents in some parameters.

    T is then 1, and T_rot that of the scene.
    """
    scene, (d, n, *_) = dynamics.scene, dynamics.scheme
    key = jax.random.fold_in(threefry_key(key), 2**32 - 1)
    v = maxwellian_velocities(key, replicas, n, d).reshape(replicas, -1, d)
    parts = [v / sqrt(2), jnp.zeros_like(v)]
    if scene.surface is not None:
        key = jax.random.fold_in(key, 0)
        mean_square = (scene.surface.ratio / (2 * scene.surface.inertia)).astype(v.dtype)
        parts.append(maxwellian_spins(key, (replicas, n, NUM_SPIN_COMPONENTS[d]), mean_square))
    zero, along = jnp.zeros(replicas, v.dtype), jnp.zeros((replicas, num_parameters), v.dtype)
    tangents = DSMCTangents(*[along] * len(DSMCTangents._fields))
    if num_parameters and scene.has_elements:  # and the last tangent is that in time

        def rotational_energy(scene: ReducedScene) -> Array:
            return n * NUM_SPIN_COMPONENTS[d] / 2 * scene.surface.ratio

        energies = jnp.zeros((num_parameters + 1, 2), v.dtype)
        if scene.surface is not None:
            slopes = ravel_pytree(jax.grad(rotational_energy)(scene))[0]
            energies = energies.at[:-1, 1].set(slopes)
        many = jnp.broadcast_to(energies, (replicas, *energies.shape))
        tangents = ExchangeTangents(many, many[:, :, 0] * 0)
    return DSMCState(
        time=jnp.zeros((), v.dtype),
        clock=zero,
        clock_rest=zero,
        temperature=zero + 1,
        particles=jnp.concatenate(parts, axis=-1),
        collisions=zero,
        missed=zero,
        steps=jnp.zeros(replicas, jnp.uint32),
        mobility=zero,
        tangents=tangents,
    )


ALLOWED_MISSED = 1e-4
"""Largest share of collisions that a run may miss because of the ceiling of the collision rate."""

CHUNK = 4_000_000
"""Candidate pairs in one call of compiled code by the host driver, which takes about a second."""


@partial(jax.jit, static_argnames=("tangents", "save"))
def dsmc_records(
    dynamics: DSMCDynamics,
    state: DSMCState,
    first: Float[Array, "replicas N d"],
    key: UInt32[Array, "2"],
    *,
    tangents: bool = False,
    units: Units | None = None,
    save: Callable[[Particles], Any] | None = None,
) -> dict[str, Any]:
    """Return the records of each replica at the time of a state, with their status as "fault".

    The next step of each replica is done in part, up to this time, and then discarded.

    Args:
        dynamics, key: of the run.
        state: the state of the gas.
        first: velocities at t = 0.
        tangents: return three dictionaries instead: "values", the "rates" of their change with
            time, and "along", their tangents in the parameters of the law at this time.
        units, save: units of the particles, and a user's function of them.
    """
    scene, scheme, replicas = dynamics.scene, dynamics.scheme, len(state.clock)
    left = (state.time - state.clock) - state.clock_rest
    share = left * jnp.sqrt(state.temperature) / scheme.scaled_step
    state = dynamics.step(state, key, jnp.clip(share, 0.0, 1.0), tangents)
    d = scheme.dimension

    velocity = v = state.particles[..., :d]
    if scene.walls is None:  # walls stop the gas as a whole
        velocity = centred(v, replicas)
    position = state.particles[..., d : 2 * d] + state.clock[:, None, None] * v
    displacement = centred(position, replicas)
    theta = 2 * observables.temperature(velocity)
    values = {
        "temperature": theta,
        "sonine": observables.sonine(velocity),
        "displacement": observables.mean_square_displacement(displacement),
        "velocity_correlation": 2 * observables.velocity_correlation(first, velocity),
        "collisions": 2 / scheme.num_particles * state.collisions,
    }
    if scene.surface is not None:
        spin = jnp.mean(state.particles[..., 2 * d :] ** 2, axis=(1, 2))
        values["rotational_temperature"] = 2 * scene.surface.inertia * spin
    if scene.drag is not None:
        left = drag_decay(scene.drag, state.time)  # true instead of transformed velocities
        powers = {"temperature": left.velocity**2, "velocity_correlation": left.velocity}
        powers["rotational_temperature"] = left.true_spin**2
        values |= {name: powers[name] * values[name] for name in powers.keys() & values.keys()}
    fast = status.flag(status.TOO_FAST, state.missed > ALLOWED_MISSED * state.collisions + 1)
    values["fault"] = fast | status.flag(status.NOT_FINITE, ~jnp.isfinite(theta))
    if save is not None and units is not None:
        values |= snapshot.saved_records(save, _to_particles(state, scene, d, units))
    if not tangents:
        return values
    if isinstance(state.tangents, ExchangeTangents):
        return {"values": values} | _exchange_derivatives(values, state, scene, scheme)
    spreading = 2 * jnp.mean(jnp.sum(displacement * velocity, axis=-1), axis=-1)
    rates = _rates(values, scene.law, d) | {"displacement": spreading}
    along = _tangents_at_time(values, rates, state.tangents)
    return {"values": values, "rates": rates, "along": along}


def _to_particles(state: DSMCState, scene: ReducedScene, d: int, units: Units) -> Particles:
    """Return particles in SI, with nan for positions, which do not exist."""
    velocity, spin = state.particles[..., :d], state.particles[..., 2 * d :]
    if scene.drag is not None:
        left = drag_decay(scene.drag, state.time)
        velocity, spin = velocity * left.velocity, spin * left.true_spin
    return Particles(
        position=jnp.full_like(velocity, jnp.nan),
        velocity=velocity * units.velocity,
        box_side=units.box_side,
        angular_velocity=None if scene.surface is None else spin * units.spin,
    )


def _rates(values: dict[str, Array], law: ReducedLaw, d: int) -> dict[str, Array]:
    """Return the rates of change with time of all records but <dr^2>, in a Maxwell-Sonine gas."""
    theta, a2 = values["temperature"], values["sonine"]
    speed = jnp.sqrt(theta)

    @jax.vmap
    def rates_of(speed, a2):
        return averages.Rates.from_averages(averages.impact_moments(law, speed, d), a2)

    rates = rates_of(speed, a2)
    cooling = 2 / d * rates.cooling * speed
    return {
        "temperature": -cooling * theta,
        "sonine": 2 * cooling * (1 + a2) - 4 / (d * (d + 2)) * rates.fourth_moment * speed,
        "velocity_correlation": -rates.relaxation * speed * values["velocity_correlation"],
        "collisions": averages.collision_rate(a2, d) * speed,
    }


def _exchange_derivatives(
    values: dict[str, Array], state: DSMCState, scene: ReducedScene, scheme: Scheme
) -> dict[str, dict[str, Array]]:
    """Return "rates" and "along" of T, T_rot and collisions of a scene with elements.

    The rates come from the last direction of the tangents, in which time is scaled.
    """
    time = state.time

    def logarithms(scene: ReducedScene, time_scale: Array) -> Array:
        if scene.drag is None:
            return jnp.zeros(2)
        left = drag_decay(jax.tree.map(lambda rate: rate * (1 + time_scale), scene.drag), time)
        return jnp.log(jnp.stack([left.velocity, left.true_spin]))

    decay, pull = jax.vjp(logarithms, scene, jnp.zeros(()))
    decay_along = jax.vmap(lambda weights: ravel_pytree(pull(weights))[0])(jnp.eye(2)).T
    tangents = jax.tree.map(lambda x: jnp.moveaxis(x, 0, -1), state.tangents)
    along, rates = tangents.of_records(
        values, decay, decay_along, time, scheme.num_particles, scheme.dimension
    )
    return {"rates": rates, "along": jax.tree.map(jnp.transpose, along)}


def _tangents_at_time(
    values: dict[str, Array], rates: dict[str, Array], tangents: DSMCTangents
) -> dict[str, Array]:
    """Return tangents of the records at a fixed time, from those at a fixed scaled time."""
    theta, c = values["temperature"], tangents.log_temperature
    correlation = values["velocity_correlation"]
    at_scaled_time = {
        "temperature": theta[:, None] * c,
        "velocity_correlation": correlation[:, None] * (c / 2 + tangents.persistence),
        "displacement": tangents.displacement,
    }
    return {
        name: at_scaled_time.get(name, 0.0) - rate[:, None] * tangents.clock
        for name, rate in rates.items()
    }


@partial(jax.jit, static_argnames=("replicas", "tangents", "save"))
def run_traced(
    dynamics: DSMCDynamics,
    times: Float[Array, "times"],
    key: UInt32[Array, "2"],
    *,
    replicas: int,
    tangents: bool,
    units: Units | None = None,
    save: Callable[[Particles], Any] | None = None,
) -> dict[str, Any]:
    """Return `dsmc_records` at all times, with a first axis of times. A pure function."""
    num_parameters = ravel_pytree(dynamics)[0].size if tangents else 0
    state = initial_dsmc_state(dynamics, key, replicas, num_parameters)
    first = state.particles[..., : dynamics.scheme.dimension]
    max_steps, options = jnp.asarray(2**31 - 1, jnp.int32), {"units": units, "save": save}

    def advance_to(state, end):
        state = collisions.advance(dynamics, state, end, key, max_steps, tangents)
        return state, dsmc_records(dynamics, state, first, key, tangents=tangents, **options)

    return jax.lax.scan(advance_to, state, times)[1]


def differentiable_run(
    dynamics: DSMCDynamics,
    times: Float[Array, "times"],
    key: UInt32[Array, "2"],
    *,
    replicas: int,
    units: Units,
    save: Callable[[Particles], Any] | None,
) -> dict[str, Array]:
    """Return the records of `run_traced` with a linear rule for forward and reverse mode.

    The rule uses the tangents of the state.
    """
    parameters, unravel = ravel_pytree(dynamics)

    def simulate(parameters, times, key, units, tangents):
        options = {"replicas": replicas, "units": units, "save": save}
        return run_traced(unravel(parameters), times, key, tangents=tangents, **options)

    @jax.custom_jvp
    def solve(parameters, times, key, units):
        return simulate(parameters, times, key, units, False)

    @solve.defjvp
    def solve_jvp(at, along):
        parameters, times, key, units = first_order_only(at)
        out = simulate(parameters, times, key, units, True)
        values = out["values"]
        tangents = {
            name: rate * along[1][:, None] + out["along"][name] @ along[0]
            for name, rate in out["rates"].items()
        }
        if not dynamics.scene.has_elements:
            in_time = out["rates"]["sonine"] * along[1][:, None]
            tangents["sonine"] = in_time + nan_tangent(in_time.shape, along[0])
        for name in set(values) - set(tangents) - {"fault"}:
            tangents[name] = nan_tangent_like(values[name], *along[:2])
        return values, tangents | {"fault": np.zeros(values["fault"].shape, jax.dtypes.float0)}

    return solve(parameters, times, key, units)


def host_run_parts(
    dynamics: DSMCDynamics, key: UInt32[Array, "2"], *, replicas: int, donate: bool
) -> tuple[DSMCState, Callable[[DSMCState, float], DSMCState], Callable[..., dict]]:
    """Return the parts of a run for the host: a state, and functions to advance and observe it.

    With `donate` a call to advance deletes its initial state.
    """
    state, scheme = copy_buffers(initial_dsmc_state(dynamics, key, replicas, 0)), dynamics.scheme
    pairs = replicas * (scheme.first + scheme.second)
    max_steps = jnp.asarray(max(CHUNK // pairs, 16), jnp.int32)
    first = state.particles[..., : scheme.dimension]
    compiled = collisions.compiled_advance(donate)

    def advance(state: DSMCState, end: float) -> DSMCState:
        return compiled(dynamics, state, jnp.asarray(end, state.clock.dtype), key, max_steps)

    def observe(state: DSMCState, **options: Any) -> dict[str, Array]:
        return dsmc_records(dynamics, state, first, key, **options)

    return state, advance, observe
