"""The records of soft spheres, with their derivatives where tangents are followed."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.state import State, records
from jaxgran.tangents import rule, thermal


@partial(jax.jit, static_argnames="replicas")
def observe(state: State, scene: SoftScene, replicas: int) -> dict[str, Array]:
    """The records of a state; with tangents, also those that `rule.with_tangents` adds.

    T is followed but for the projection; the rest is estimated from it. At a fixed place in the
    sequence of collisions the paths are the same, and ``<v(0).v>`` goes as sqrt(T); the elastic
    energy goes as ``T^(7/5) alpha^(-2/5)``.
    """
    values, travelled, velocity = records(state, scene.side, replicas)
    num_particles, d = velocity.shape[1:]
    values["elastic_energy"] = state.own.elastic / num_particles
    along = state.tangents
    if along is None:
        return values
    T, C, U = (values[n] for n in ("temperature", "velocity_correlation", "elastic_energy"))
    cooling, meeting = along.rates.cooling(along.trend(T)), along.rates.collision(T)
    c, clock = thermal.projected(along, state.velocity, state.time)
    stiffer = (along.alpha / scene.alpha)[:, None]
    kept = {
        "temperature": c * T[None],
        "velocity_correlation": 0.5 * c * C[None],
        "elastic_energy": (1.4 * c - 0.4 * stiffer) * U[None],
    }
    rates = {
        "temperature": -cooling * T,
        "displacement": 2 * jnp.mean(jnp.sum(travelled * velocity, -1), axis=1),
        "velocity_correlation": -2 / d * meeting * C,
        "elastic_energy": -1.4 * cooling * U,
        "collisions": meeting,
    }
    return rule.with_tangents(values, kept, rates, clock)
