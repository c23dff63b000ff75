"""The records of hard spheres, with their derivatives where tangents are followed."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles import observables
from jaxgran.particles.drag import decay
from jaxgran.particles.hard.scene import HardScene
from jaxgran.particles.state import State, derivatives_of_records, kinetic_energy, records
from jaxgran.scene.elements import SPINS
from jaxgran.scene.reduced_scene import ReducedDrag
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
    values["regularised"] = 2 / velocity.shape[1] * state.own.regularised
    if scene.has_elements:
        return _observed_elements(values, velocity, state, scene, replicas)
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


def _observed_elements(
    values: dict[str, Array],
    velocity: Float[Array, "replicas N d"],
    state: State,
    scene: HardScene,
    replicas: int,
) -> dict[str, Array]:
    """The records where there are elements.

    The energy dissipated is all that impacts and drag have taken.
    """
    n, d = velocity.shape[1:]
    first = kinetic_energy(state.first_velocity, replicas) / n
    if scene.walls is not None:  # which stop what moves as a whole, and keep spheres from going far
        velocity = state.velocity.reshape(velocity.shape)
        values["temperature"] = observables.temperature(velocity)
        values["sonine"] = observables.sonine(velocity)
        del values["displacement"], values["flow_share"]
    slowed = kept = jnp.ones(())
    if scene.drag is not None:
        slowed, _, kept = decay(scene.decay_rates, state.time + state.time_rest)
    lost = first - slowed**2 * (first - state.dissipated / n)
    values["temperature"] = values["temperature"] * slowed**2
    values["velocity_correlation"] = values["velocity_correlation"] * slowed
    if scene.surface is not None and state.own.spin is not None:  # not so in the melt
        spin = state.own.spin.reshape(replicas, -1)
        inside = scene.surface.inertia * jnp.mean(spin**2, axis=1)
        values["rotational_temperature"] = inside * kept**2
        at_first = SPINS[d] / 2 * scene.surface.ratio
        lost = lost + at_first - kept**2 * (at_first + state.own.turned / n)
    values["dissipated_energy"] = lost
    if state.tangents is None:
        return values
    return values | _derivatives(values, state, scene, n, d)


def _derivatives(
    values: dict[str, Array], state: State, scene: HardScene, n: int, d: int
) -> dict[str, Array]:
    """The derivatives of T, T_rot and collisions, as `rule.with_tangents` has them.

    Those in time are by the last direction, in which everything is sooner by the same share.
    """
    directions, (energies, collisions) = state.tangents
    time = state.time + state.time_rest
    log_left, along_left = jnp.zeros(2), jnp.zeros((len(collisions), 2))
    if scene.drag is not None:

        def logarithms(drag: ReducedDrag) -> Array:
            left = decay(scene._replace(drag=drag).decay_rates, time)
            return jnp.log(jnp.stack([left.velocity, left.kept]))

        log_left, linear = jax.linearize(logarithms, scene.drag)
        along_left = jax.vmap(linear)(directions.drag)
    after = jnp.where(time > 0, time, 1.0)
    met = 2 / n * collisions
    found = {"collisions.along": met[:-1], "collisions.rate": met[-1] / after}
    for k, name in enumerate(("temperature", "rotational_temperature")):
        if name not in values:
            continue
        size = n * (d, SPINS[d])[k] / 2
        along = jnp.exp(2 * log_left[k]) * energies[:, k] / size
        along = along + 2 * along_left[:, k, None] * values[name][None]
        found |= {f"{name}.along": along[:-1], f"{name}.rate": along[-1] / after}
    return found
