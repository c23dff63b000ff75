"""The records of hard spheres, with their derivatives where tangents are followed."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.hard.impacts import Scene
from jaxgran.particles.state import State, records
from jaxgran.scene.restitution import ReducedLaw
from jaxgran.tangents import rule
from jaxgran.theory import averages


def cooling_trend(
    law: ReducedLaw, temperature: Float[Array, "replicas"], dimension: int
) -> Float[Array, "replicas"]:
    """The cooling rate of a Maxwellian gas as a function of T, up to a factor."""

    def rate(speed):
        return averages.averages(law, speed, dimension)[0, 0] * speed

    return jax.vmap(rate)(jnp.sqrt(temperature))


@partial(jax.jit, static_argnames="replicas")
def observe(state: State, scene: Scene, replicas: int) -> dict[str, Array]:
    """The records of a state; with tangents, also those that `rule.with_tangents` adds.

    At a fixed place in the sequence of collisions the paths are the same, and ``<v(0).v>`` goes as
    sqrt(T).
    """
    values, travelled, velocity = records(state, scene.side, replicas)
    num_particles, d = velocity.shape[1:]
    values["regularised"] = 2 / num_particles * state.own.regularised
    along = state.tangents
    if along is None:
        return values
    T, C = values["temperature"], values["velocity_correlation"]
    cooling = along.rates.cooling(cooling_trend(scene.law, T, d))
    meeting, c = along.rates.collision(T), along.log_temperature
    kept = {"temperature": c * T[None], "velocity_correlation": 0.5 * c * C[None]}
    rates = {
        "temperature": -cooling * T,
        "displacement": 2 * jnp.mean(jnp.sum(travelled * velocity, -1), axis=1),
        "velocity_correlation": -2 / d * meeting * C,
        "collisions": meeting,
    }
    return rule.with_tangents(values, kept, rates, along.clock)
