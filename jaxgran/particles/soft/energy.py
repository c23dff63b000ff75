"""The energy balance of a block of time steps."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.soft.elements import ElementSums
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.soft.steps import ContactWork
from jaxgran.particles.state import State, kinetic_energy

WORK_TOLERANCE = 0.1
"""Energy error of a block that is allowed, over the work done by elastic forces in it."""

ENERGY_TOLERANCE = 1e-3
"""And over all energy: a contact that began after the last kick holds energy not yet accounted."""


def moving_energy(scene: SoftScene, state: State) -> Float[Array, "replicas"]:
    """Kinetic energy of translation and rotation of each replica."""
    replicas, spin = len(state.own.elastic), state.own.spin
    energy = kinetic_energy(state.velocity, replicas)
    if spin is None or scene.surface is None:
        return energy
    return energy + scene.surface.inertia * kinetic_energy(spin, replicas)


def energy_error(
    scene: SoftScene,
    old: State,
    new: State,
    work: ContactWork,
    by_replica: Callable[[Array], Array],
    sums: ElementSums | None,
) -> tuple[Float[Array, "replicas"], Float[Array, "replicas"]]:
    """The energy that a block added over all energy, and how much is allowed.

    Args:
        scene: the gas.
        old, new: the state before and after the block.
        work: done in it.
        by_replica: sums values of pairs over each replica.
        sums: energies by walls and drag; None where the gas has no elements.
    """
    before = moving_energy(scene, old) + old.own.elastic
    after = moving_energy(scene, new) + new.own.elastic
    gain = after - before + by_replica(work.dissipated)
    total = jnp.where(before > 0, before, 1.0)
    exchanged = by_replica(work.exchanged) / total
    if sums is not None:
        gain, exchanged = gain + sums.lost, exchanged + sums.exchanged / total
    return gain / total, WORK_TOLERANCE * exchanged + ENERGY_TOLERANCE
