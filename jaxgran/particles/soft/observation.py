"""The records of soft spheres, with their derivatives where tangents are followed."""

from functools import partial

import jax
from jaxtyping import Array

from jaxgran.particles import observables
from jaxgran.particles.soft.frame import rotational_temperature
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.state import State, derivatives_of_records, records
from jaxgran.tangents import rule, thermal
from jaxgran.tangents.rates import ratio


@partial(jax.jit, static_argnames="replicas")
def observe(state: State, scene: SoftScene, replicas: int) -> dict[str, Array]:
    """The records of a state; with tangents, also those that `rule.with_tangents` adds.

    T is followed but for the projection; the rest is estimated from it. The elastic energy goes as
    ``T^(7/5) alpha^(-2/5)``.
    """
    values, travelled, velocity = records(state, scene.side, replicas)
    values["elastic_energy"] = state.own.elastic / velocity.shape[1]
    if scene.walls is not None:  # which stop what moves as a whole, and keep spheres from going far
        velocity = state.velocity.reshape(velocity.shape)
        values["temperature"] = observables.temperature(velocity)
        values["sonine"] = observables.sonine(velocity)
        values["velocity_correlation"] = observables.velocity_correlation(
            state.first_velocity.reshape(velocity.shape), velocity
        )
    if state.own.spin is not None:  # not so in the melt
        values["rotational_temperature"] = rotational_temperature(scene, state.own.spin, replicas)
    along = state.tangents
    if along is None:
        return _known(values, scene)
    T, U = values["temperature"], values["elastic_energy"]
    cooling, meeting = along.cooling(T), along.rates.collision(T)
    c, clock, paths = thermal.projected(along, velocity.reshape(state.velocity.shape))
    kept, rates = derivatives_of_records(values, travelled, velocity, c, paths, cooling, meeting)
    stiffer = (along.alpha / scene.alpha)[:, None]
    kept["elastic_energy"] = (1.4 * c - 0.4 * stiffer) * U[None]
    rates["elastic_energy"] = -1.4 * cooling * U
    values, unknown = _known(values, scene), {}
    if along.rotation is not None:
        known = "rotational_temperature"
        kept[known], rates[known] = _of_rotation(state, scene, values)
        # The paths are known of smooth spheres.
        names = {"displacement", "velocity_correlation"} & set(values)
        unknown = {name: values.pop(name) for name in names}
    return rule.with_tangents(values, kept, rates, clock) | unknown


def _of_rotation(state: State, scene: SoftScene, values: dict[str, Array]) -> tuple[Array, Array]:
    """Derivatives of T_rot along the directions at a fixed place, and in time."""
    along, spin, T = state.tangents, state.own.spin, values["temperature"]
    assert scene.surface is not None and spin is not None
    rotation, T_rot = along.rotation, values["rotational_temperature"]
    logs = rotation.log_temperature(spin, scene.surface.inertia, along.log_temperature)
    d, d_rot = state.velocity.shape[1], spin.shape[1]
    rate = d / d_rot * rotation.turned.at(ratio(T_rot, T)) * scene.collision_frequency * T**1.5
    if (slowing := scene.of_elements.spin_drag) is not None:
        rate -= 2 * slowing * T_rot
    return logs * T_rot[None], rate


def _known(values: dict[str, Array], scene: SoftScene) -> dict[str, Array]:
    """The records without those that mean nothing in a scene: between walls no sphere goes far, and
    there are no periodic waves."""
    if scene.walls is None:
        return values
    unknown = "displacement", "flow_share"
    return {name: value for name, value in values.items() if name not in unknown}
