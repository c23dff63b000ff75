"""The energy balance of a block of time steps."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.particles.soft.steps import ContactWork
from jaxgran.particles.state import State, kinetic_energy

WORK_TOLERANCE = 0.1
"""Energy error of a block that is allowed, over the work done by elastic forces in it."""

ENERGY_TOLERANCE = 1e-3
"""And over all energy: a contact that began after the last kick holds energy not yet accounted."""


def energy_error(
    old: State, new: State, work: ContactWork, by_replica: Callable[[Array], Array]
) -> tuple[Float[Array, "replicas"], Float[Array, "replicas"]]:
    """The energy that a block added over all energy, and how much is allowed.

    Args:
        old, new: the state before and after the block.
        work: done in it.
        by_replica: sums values of pairs over each replica.
    """
    replicas = len(old.own.elastic)
    before = kinetic_energy(old.velocity, replicas) + old.own.elastic
    after = kinetic_energy(new.velocity, replicas) + new.own.elastic
    gain = after - before + by_replica(work.dissipated)
    total = jnp.where(before > 0, before, 1.0)
    exchanged = by_replica(work.exchanged) / total
    return gain / total, WORK_TOLERANCE * exchanged + ENERGY_TOLERANCE
