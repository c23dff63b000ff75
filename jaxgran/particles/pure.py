"""Runs of spheres as a pure function of arrays: for `jax.jit`, `jax.vmap` and derivatives.

Capacities are fixed beforehand; a run that exceeds them ends in nan and a status. There is no I/O.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxgran.checks import status
from jaxgran.particles import neighbours
from jaxgran.particles.dynamics import stretches
from jaxgran.particles.simulation import SMALLEST_BOX, Simulation
from jaxgran.tangents.rule import Outputs


def simulate(sim: Simulation) -> Outputs:
    """Melt and cool; the records at the times of the inputs."""
    dynamics, inputs = sim.dynamics, sim.inputs
    engine = neighbours.engine(sim.engine, dynamics.capacity.lookahead, traced=True)
    side = dynamics.scene.side
    # In a smaller box a new neighbour list is at once stale, and stretches would not end.
    fault = status.flag(status.BOX_TOO_SMALL, side < SMALLEST_BOX)
    state, fault = sim.compiled_first_state(fault)
    if sim.melts:
        melting = dynamics.elastic().with_capacity(sim.melt_capacity)
        state, fault, _ = stretches(melting, state, sim.melt_time, engine, 0, None, fault)
        if (preparing := dynamics.preparing) is not None:
            state, until = preparing.with_kicks(state, sim.key), sim.prepared_time
            state, fault, _ = stretches(preparing, state, until, engine, 0, None, fault)
    else:
        fault |= dynamics.check_start(state)
    # One stretch to t = 0 counts the energy in contacts.
    state = sim.cooling_state(state)
    state, fault, _ = stretches(dynamics, state, jnp.zeros_like(state.time), engine, 1, 1, fault)

    def to(carry, end):
        state, fault, _ = stretches(dynamics, carry[0], end, engine, 0, None, carry[1])
        records, bad = sim.observe(state), fault != status.OK
        return (state, fault), jax.tree.map(partial(_spoilt_if, bad), records)

    (state, fault), records = jax.lax.scan(to, (state, fault), inputs.times)
    return sim.outputs(state, records, fault)


def _spoilt_if(bad: Array, x: Array) -> Array:
    """Nan where a run has failed; numbers that have no nan stay as they are."""
    return jnp.where(bad, jnp.nan, x) if jnp.issubdtype(x.dtype, jnp.inexact) else x
