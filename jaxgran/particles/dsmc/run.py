"""A DSMC run: its initial state, its records, and the run in compiled code or from the host.

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
from jaxtyping import Array, Float, Int, UInt32

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced
from jaxgran.data.checkpoint import describe_run
from jaxgran.data.curve import Particles, Run
from jaxgran.gradients.rule import Records, Result
from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles import observables, snapshot
from jaxgran.particles.dsmc.collisions import (
    DSMCDynamics,
    DSMCState,
    advance,
    waiting_time,
)
from jaxgran.particles.run import (
    Inputs,
    block_until_ready,
    compiled_for_host,
    compiling,
    run_through_times,
)
from jaxgran.particles.setup import maxwellian_velocities
from jaxgran.particles.snapshot import Units
from jaxgran.particles.state import (
    centred,
    copy_buffers,
    exchange_derivatives,
    maxwellian_spins,
    threefry_key,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.gas import ReducedScene


@partial(jax.jit, static_argnames="replicas")
def initial_dsmc_state(
    dynamics: DSMCDynamics, key: UInt32[Array, "2"], directions: ReducedScene | None, replicas: int
) -> DSMCState:
    """Return the state at t = 0, with Maxwellian velocities, and tangents along any directions.

    T is then 1, and T_rot that of the scene.
    """
    scene, (d, n, *_), tangents = dynamics.scene, dynamics.scheme, None
    key = jax.random.fold_in(threefry_key(key), 2**32 - 1)
    velocity = maxwellian_velocities(key, replicas, n, d)
    v = velocity.reshape(replicas, -1, d)
    parts = [v / sqrt(2), jnp.zeros_like(v)]
    if scene.surface is not None:
        key = jax.random.fold_in(key, 0)
        mean_square = (scene.surface.ratio / (2 * scene.surface.inertia)).astype(v.dtype)
        parts.append(maxwellian_spins(key, (replicas, n, NUM_SPIN_COMPONENTS[d]), mean_square))
    if directions is not None:
        tangents = ExchangeTangents.initial(directions, scene, velocity, replicas)
    zero = jnp.zeros(replicas, v.dtype)
    duration = waiting_time(jax.random.fold_in(key, 1), dynamics.scheme.candidates, zero)
    return DSMCState(
        time=jnp.zeros((), v.dtype),
        clock=zero,
        clock_rest=zero,
        duration=duration,
        temperature=zero + 1,
        particles=jnp.concatenate(parts, axis=-1),
        collisions=zero,
        missed=zero,
        steps=jnp.zeros(replicas, jnp.uint32),
        tangents=tangents,
    )


ALLOWED_MISSED = 1e-4
"""Largest share of collisions that a run may miss because of the ceiling of the collision rate."""

CHUNK = 4_000_000
"""Candidate pairs in one call of compiled code by the host driver, which takes about a second."""


@partial(jax.jit, static_argnames="save")
def dsmc_records(
    dynamics: DSMCDynamics,
    state: DSMCState,
    first: Float[Array, "replicas N d"],
    *,
    units: Units | None = None,
    save: Callable[[Particles], Any] | None = None,
) -> Records:
    """Return the records of each replica, with their status as "fault".

    Args:
        dynamics: of the run.
        state: the gas, whose clocks have reached the time.
        first: velocities at t = 0.
        units, save: units of the particles, and a user's function of them.
    """
    scene, scheme, replicas = dynamics.scene, dynamics.scheme, len(state.clock)
    d = scheme.dimension
    velocity = v = state.particles[..., :d]
    if scene.walls is None:  # walls stop the gas as a whole
        velocity = centred(v, replicas)
    position = state.particles[..., d : 2 * d] + state.clock[:, None, None] * v
    displacement = centred(position, replicas)
    theta = 2 * observables.temperature(velocity)
    left = dynamics.drag_decay(state.time)  # true over transformed velocities
    correlation = 2 * observables.velocity_correlation(first, velocity) * left.velocity
    values = {
        "temperature": theta * left.velocity**2,
        "sonine": observables.sonine(velocity),
        "velocity_correlation": correlation,
        "collisions": 2 / scheme.num_particles * state.collisions,
    }
    if scene.walls is None:  # walls would limit <dr^2>
        values["displacement"] = observables.mean_square_displacement(displacement)
    if scene.surface is not None:
        energy = 2 * scene.surface.inertia * jnp.mean(state.particles[..., 2 * d :] ** 2, (1, 2))
        values["rotational_temperature"] = energy * left.true_spin**2
    fast = status.flag(status.TOO_FAST, state.missed > ALLOWED_MISSED * state.collisions + 1)
    values["fault"] = fast | status.flag(status.NOT_FINITE, ~jnp.isfinite(theta))
    saved = None
    if save is not None and units is not None:
        spin = None if scene.surface is None else state.particles[..., 2 * d :] * left.true_spin
        arrays = jnp.full_like(v, jnp.nan), v * left.velocity, spin  # there are no positions
        saved = snapshot.saved(save, snapshot.particles(units, replicas, *arrays))
    tangents = state.tangents
    if tangents is None:
        return Records(values, {}, {}, saved)
    size = scheme.num_particles, d
    rates, slopes = exchange_derivatives(
        values, tangents, scene.drag, tangents.directions.drag, state.time, size
    )
    return Records(values, rates, slopes, saved)


def run_dsmc(
    dynamics: DSMCDynamics,
    inputs: Inputs,
    directions: ReducedScene | None,
    replicas: int,
    run: Run,
    settings: dict[str, Any],
) -> Result:
    """Run from the host if all numbers are known, otherwise in compiled code.

    A replica is nan from its first fault on.

    Args:
        dynamics: of the gas.
        inputs: of the run.
        directions: of tangents in the scene; None for no tangents.
        replicas: number of gases.
        run: options of the run.
        settings: further settings that determine the result, by name, for the checkpoint.
    """
    key = jax.random.key(0) if inputs.key is None else inputs.key
    words, save = jax.random.bits(key, (2,), jnp.uint32), snapshot.save_function(run.save)
    state = initial_dsmc_state(dynamics, words, directions, replicas)
    if any_traced(inputs):
        options: dict[str, Any] = {"units": inputs.units, "save": save}
        records: Any = _run_traced(dynamics, inputs.times, state, words, **options)
        fault = status.OK
    else:
        scheme, dtype = dynamics.scheme, state.clock.dtype
        pairs = replicas * (scheme.first + scheme.second)
        max_steps = jnp.asarray(max(CHUNK // pairs, 16), jnp.int32)
        compiled = compiled_for_host(advance)
        first = state.particles[..., : scheme.dimension]
        state = copy_buffers(state)

        def advance_towards(state: DSMCState, end: float) -> DSMCState:
            arguments = dynamics, state, np.asarray(end, dtype), words, max_steps
            return block_until_ready(compiled(*arguments, False))

        def observe(state: DSMCState, **options: Any) -> Records:
            arguments = dynamics, copy_buffers(state), state.time, words, max_steps
            return dsmc_records(dynamics, compiled(*arguments, True), first, **options)

        recorded = partial(observe, units=inputs.units, save=save)

        program = jax.tree.structure((dynamics, state)), state.particles.shape, dtype
        with compiling(program, run.progress) as new:
            if new:  # compile with a call of zero steps, which may delete its state
                jax.block_until_ready(recorded(advance_towards(copy_buffers(state), 0.0)))
        given = inputs._asdict() | settings | {"directions": directions, "save": run.save}
        _, records, fault = run_through_times(
            state,
            np.asarray(inputs.times),
            advance_towards,
            recorded,
            shown=observe,
            scene={} if run.checkpoint is None else describe_run(**given),
            progress=run.progress,
            path=run.checkpoint,
        )
        records = jax.tree.map(jnp.asarray, records)
    return _nan_from_faults(records, jnp.asarray(fault, jnp.int32))


@jax.jit
def _nan_from_faults(records: Records, fault: Int[Array, ""]) -> Result:
    """Return the results of a run, with nan in a replica from its first fault on."""
    values = dict(records.values)
    faults = values.pop("fault")
    failed = jnp.cumsum(faults != status.OK, axis=0) > 0
    values, saved = jax.tree.map(partial(snapshot.nan_where, failed), (values, records.saved))
    fault = fault | jnp.bitwise_or.reduce(faults, axis=None)
    return Result(records._replace(values=values, saved=saved), None, fault.astype(jnp.int32))


@partial(jax.jit, static_argnames="save")
def _run_traced(
    dynamics: DSMCDynamics, times: Array, state: DSMCState, words: Array, **options: Any
) -> Records:
    first = state.particles[..., : dynamics.scheme.dimension]
    max_steps, in_parts = jnp.asarray(2**31 - 1, jnp.int32), jnp.array([False, True])

    def record_at(state, end):
        def advance_to(states, in_part):
            after = advance(dynamics, states[0], end, words, max_steps, in_part)
            return jax.tree.map(
                partial(jnp.where, in_part), (states[0], after), (after, after)
            ), None

        (state, ahead), _ = jax.lax.scan(advance_to, (state, state), in_parts)
        return state, dsmc_records(dynamics, ahead, first, **options)

    return jax.lax.scan(record_at, state, times)[1]
