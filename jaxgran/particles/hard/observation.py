"""The records of hard spheres, with their derivatives where tangents are followed."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles import observables
from jaxgran.particles.hard.scene import HardScene
from jaxgran.particles.state import State, derivatives_of_records, records
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
def observe(state: State, scene: HardScene, replicas: int) -> dict[str, Array]:
    """The records of a state; with tangents, also those that `rule.with_tangents` adds."""
    values, travelled, velocity = records(state, scene.side, replicas)
    if scene.walls is not None:  # which stop what moves as a whole, and keep spheres from going far
        velocity = state.velocity.reshape(velocity.shape)
        values["temperature"] = observables.temperature(velocity)
        values["sonine"] = observables.sonine(velocity)
        del values["displacement"]
    values["regularised"] = 2 / velocity.shape[1] * state.own.regularised
    if scene.surface is not None and state.own.spin is not None:  # not so in the melt
        spin = state.own.spin.reshape(replicas, -1)
        values["rotational_temperature"] = scene.surface.inertia * jnp.mean(spin**2, axis=1)
    along = state.tangents
    if along is None:
        return values
    T = values["temperature"]
    cooling = along.rates.cooling(cooling_trend(scene.law, T, velocity.shape[-1]))
    meeting, c = along.rates.collision(T), along.log_temperature
    kept, rates = derivatives_of_records(
        values, travelled, velocity, c, along.paths, cooling, meeting
    )
    return rule.with_tangents(values, kept, rates, along.clock)
