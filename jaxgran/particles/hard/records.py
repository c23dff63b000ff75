"""Records of hard spheres, and their derivatives.

A run stores velocities and spins without their decay by drag (`jaxgran.particles.elements`); the
records are of the true ones. Units as in `jaxgran.particles.hard.impacts`.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.gradients.rule import Records
from jaxgran.particles.elements import DragDecay, drag_decay, exchange_slopes
from jaxgran.particles.spheres import (
    SphereState,
    common_values,
    kinetic_energy,
    with_dissipated_energy,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.reduced import SphereScene


@partial(jax.jit, static_argnames="replicas")
def hard_records(state: SphereState, scene: SphereScene, replicas: int) -> Records:
    """Return the records of a state.

    In a scene with elements the dissipated energy includes all losses in impacts and to drag.
    """
    values, velocity = common_values(state, scene, replicas)
    material = scene.material
    tangents = state.tangents
    _, n, d = velocity.shape
    regularised = state.internal.regularised.astype(jnp.result_type(float))
    values["regularised"] = 2 / n * regularised
    if material.has_elements:
        values |= _values_with_elements(state, scene, values)
    if tangents is None:
        return Records(values, {}, {})
    drag_directions = jax.tree.map(
        lambda x: x * scene.collision_frequency, tangents.directions.drag
    )
    time = state.time + state.time_rest
    rates, slopes = exchange_slopes(values, tangents, scene.drag_rates, drag_directions, time, n, d)
    if not material.has_elements:
        rates = with_dissipated_energy(rates, d)
        slopes = with_dissipated_energy(slopes, d)
    return Records(values, rates, slopes)


def _values_with_elements(
    state: SphereState, scene: SphereScene, values: dict[str, Array]
) -> dict[str, Array]:
    """Return the records of rotation, and the records that drag changes."""
    replicas = len(values["temperature"])
    spin = state.internal.spin
    decay = drag_decay(scene.drag_rates, state.time + state.time_rest)
    changed = {
        "temperature": values["temperature"] * decay.velocity**2,
        "velocity_correlation": values["velocity_correlation"] * decay.velocity,
        "dissipated_energy": _energy_lost(state, scene, decay, replicas),
    }
    if spin is not None:  # None in equilibration
        inertia = scene.material.surface.inertia
        mean_square = jnp.mean(spin.reshape(replicas, -1) ** 2, axis=1)
        changed["rotational_temperature"] = inertia * mean_square * decay.spin**2
    return changed


def _energy_lost(
    state: SphereState, scene: SphereScene, decay: DragDecay, replicas: int
) -> Float[Array, "replicas"]:
    """Return the energy per sphere that impacts and drag took; nan if drag and a drive act.

    Drag then takes an unknown part of the heat of the drive.
    """
    material = scene.material
    n, d = state.velocity.shape
    size = n // replicas
    first = kinetic_energy(state.first_velocity, replicas) / size
    now = decay.velocity**2 * (first - state.dissipated / size)
    lost = first - now
    if state.internal.spin is not None:
        first_of_spins = NUM_SPIN_COMPONENTS[d] / 2 * material.surface.ratio
        now_of_spins = decay.spin**2 * (first_of_spins + state.internal.rotational_gain / size)
        lost = lost + first_of_spins - now_of_spins
    if material.drive is not None:
        dragged = (decay.velocity < 1) | (decay.spin < 1)
        lost = jnp.where(dragged & (material.drive > 0), jnp.nan, lost)
    return lost
