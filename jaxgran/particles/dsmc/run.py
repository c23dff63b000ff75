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
from jaxgran.particles.dsmc.collisions import (
    DSMCState,
    DSMCTangents,
    Scheme,
    initial_exchange_tangents,
)
from jaxgran.particles.setup import maxwellian_velocities
from jaxgran.particles.snapshot import Units
from jaxgran.particles.state import (
    DragDecay,
    copy_buffers,
    drag_decay,
    maxwellian_spins,
    threefry_key,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedDrag, ReducedScene
from jaxgran.theory import averages


@partial(jax.jit, static_argnames=("replicas", "scheme", "num_parameters"))
def initial_dsmc_state(
    key: UInt32[Array, "2"],
    replicas: int,
    scheme: Scheme,
    num_parameters: int,
    scene: ReducedScene | None = None,
) -> DSMCState:
    """Return the state at t = 0, with Maxwellian velocities and tangents in some parameters."""
    d = scheme.dimension
    key = jax.random.fold_in(threefry_key(key), 2**32 - 1)
    v = maxwellian_velocities(key, replicas, scheme.num_particles, d).reshape(replicas, -1, d)
    parts = [v / sqrt(2), jnp.zeros_like(v)]
    if scene is not None and scene.surface is not None:
        shape = (replicas, scheme.num_particles, NUM_SPIN_COMPONENTS[d])
        key = jax.random.fold_in(key, 0)
        mean_square = (scene.surface.ratio / (2 * scene.surface.inertia)).astype(v.dtype)
        parts.append(maxwellian_spins(key, shape, mean_square))
    zero, along = jnp.zeros(replicas, v.dtype), jnp.zeros((replicas, num_parameters), v.dtype)
    tangents = DSMCTangents(*[along] * len(DSMCTangents._fields))
    if scene is not None and num_parameters and has_elements(scene):
        tangents = initial_exchange_tangents(
            scene, num_parameters, scheme.num_particles, d, replicas
        )
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


def has_elements(scene: ReducedScene) -> bool:
    """Return False for smooth spheres in free flight."""
    return any(element is not None for element in scene[1:])


ALLOWED_MISSED = 1e-4
"""Largest share of collisions that a run may miss because of the ceiling of the collision rate."""

CHUNK = 4_000_000
"""Candidate pairs in one call of compiled code by the host driver, which takes about a second."""


@partial(jax.jit, static_argnames=("scheme", "tangents", "save"))
def dsmc_records(
    state: DSMCState,
    first: Float[Array, "replicas N d"],
    scene: ReducedScene,
    key: UInt32[Array, "2"],
    *,
    scheme: Scheme,
    tangents: bool = False,
    units: Units | None = None,
    save: Callable[[Particles], Any] | None = None,
) -> dict[str, Any]:
    """Return the records of each replica at the time of a state, with their status as "fault".

    The next step of each replica is done in part, up to this time, and then discarded.

    Args:
        state: the state of the gas.
        first: velocities at t = 0.
        scene, key, scheme: the scene, key and scheme of the run.
        tangents: return three dictionaries instead: "values", the "rates" of their change with
            time, and "along", their tangents in the parameters of the law at this time.
        units, save: units of the particles, and a user's function of them.
    """
    left = (state.time - state.clock) - state.clock_rest
    share = left * jnp.sqrt(state.temperature) / scheme.scaled_step
    state = collisions.step(state, key, jnp.clip(share, 0.0, 1.0), scene, scheme, tangents)
    d = scheme.dimension

    velocity = state.particles[..., :d]
    if scene.walls is None:  # walls stop the gas as a whole
        velocity = _centred(velocity)
    displacement = _centred(
        state.particles[..., d : 2 * d] + state.clock[:, None, None] * state.particles[..., :d]
    )
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
        values |= _without_drag(values, drag_decay(scene.drag, state.time))
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


def _centred(x: Float[Array, "replicas N d"]) -> Float[Array, "replicas N d"]:
    return x - jnp.mean(x, axis=1, keepdims=True)


def _without_drag(values: dict[str, Array], left: DragDecay) -> dict[str, Array]:
    """Return the records that depend on velocities, in true instead of transformed velocities."""
    powers = {"temperature": left.velocity**2, "velocity_correlation": left.velocity}
    powers["rotational_temperature"] = left.true_spin**2
    return {name: powers[name] * values[name] for name in powers.keys() & values.keys()}


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
    n, d, time = scheme.num_particles, scheme.dimension, state.time
    assert isinstance(state.tangents, ExchangeTangents)
    energies, collided = state.tangents

    def logarithms(scene: ReducedScene, time_scale: Array) -> Array:
        if scene.drag is None:
            return jnp.zeros(2)
        rates = ReducedDrag(*(rate * (1 + time_scale) for rate in scene.drag))
        left = drag_decay(rates, time)
        return jnp.log(jnp.stack([left.velocity, left.true_spin]))

    log_left, pull = jax.vjp(logarithms, scene, jnp.zeros(()))
    along_left = jax.vmap(lambda weights: ravel_pytree(pull(weights))[0])(jnp.eye(2))
    along = {"collisions": 2 / n * collided}
    for k, name in enumerate(("temperature", "rotational_temperature")):
        if name in values:
            size = n * (d, NUM_SPIN_COMPONENTS[d])[k] / 2
            moved = jnp.exp(2 * log_left[k]) / size * energies[:, :, k]
            along[name] = moved + 2 * along_left[k][None] * values[name][:, None]
    after = jnp.where(time > 0, time, 1.0)
    return {
        "rates": {name: x[:, -1] / after for name, x in along.items()},
        "along": {name: x[:, :-1] for name, x in along.items()},
    }


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


@partial(jax.jit, static_argnames=("replicas", "scheme", "tangents", "save"))
def run_traced(
    scene: ReducedScene,
    times: Float[Array, "times"],
    key: UInt32[Array, "2"],
    *,
    replicas: int,
    scheme: Scheme,
    tangents: bool,
    units: Units | None = None,
    save: Callable[[Particles], Any] | None = None,
) -> dict[str, Any]:
    """Return `dsmc_records` at all times, with a first axis of times. A pure function."""
    num_parameters = ravel_pytree(scene)[0].size if tangents else 0
    state = initial_dsmc_state(key, replicas, scheme, num_parameters, scene)
    first = state.particles[..., : scheme.dimension]
    max_steps = jnp.asarray(2**31 - 1, jnp.int32)

    def advance_to(state, end):
        options = {"scheme": scheme, "tangents": tangents}
        state = collisions.advance(state, end, scene, key, max_steps, **options)
        return state, dsmc_records(state, first, scene, key, units=units, save=save, **options)

    return jax.lax.scan(advance_to, state, times)[1]


def differentiable_run(
    scene: ReducedScene,
    times: Float[Array, "times"],
    key: UInt32[Array, "2"],
    *,
    replicas: int,
    scheme: Scheme,
    units: Units,
    save: Callable[[Particles], Any] | None,
) -> dict[str, Array]:
    """Return the records of `run_traced` with a linear rule for forward and reverse mode.

    The rule uses the tangents of the state.
    """
    parameters, unravel = ravel_pytree(scene)

    def simulate(parameters, times, key, units, tangents):
        options = {"replicas": replicas, "scheme": scheme, "units": units, "save": save}
        return run_traced(unravel(parameters), times, key, tangents=tangents, **options)

    @jax.custom_jvp
    def solve(parameters, times, key, units):
        return simulate(parameters, times, key, units, False)

    @solve.defjvp
    def solve_jvp(at, along):
        scene, (parameters, times, key, units) = unravel(at[0]), first_order_only(at)
        out = simulate(parameters, times, key, units, True)
        values = out["values"]
        tangents = {
            name: rate * along[1][:, None] + out["along"][name] @ along[0]
            for name, rate in out["rates"].items()
        }
        if not has_elements(scene):
            in_time = out["rates"]["sonine"] * along[1][:, None]
            tangents["sonine"] = in_time + nan_tangent(in_time.shape, along[0])
        for name in set(values) - set(tangents) - {"fault"}:
            tangents[name] = nan_tangent_like(values[name], *along[:2])
        return values, tangents | {"fault": np.zeros(values["fault"].shape, jax.dtypes.float0)}

    return solve(parameters, times, key, units)


def host_run_parts(
    scene: ReducedScene,
    key: UInt32[Array, "2"],
    *,
    replicas: int,
    scheme: Scheme,
    donate: bool,
) -> tuple[DSMCState, Callable[[DSMCState, float], DSMCState], Callable[..., dict]]:
    """Return the parts of a run for the host: a state, and functions to advance and observe it.

    With `donate` a call to advance deletes its initial state.
    """
    state = copy_buffers(initial_dsmc_state(key, replicas, scheme, 0, scene))
    pairs = replicas * (scheme.first + scheme.second)
    max_steps = jnp.asarray(max(CHUNK // pairs, 16), jnp.int32)
    first = state.particles[..., : scheme.dimension]
    compiled = collisions.compiled_advance(donate)

    def advance(state: DSMCState, end: float) -> DSMCState:
        end_array = jnp.asarray(end, state.clock.dtype)
        return compiled(state, end_array, scene, key, max_steps, scheme=scheme)

    return state, advance, partial(dsmc_records, first=first, scene=scene, key=key, scheme=scheme)
