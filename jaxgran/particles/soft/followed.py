"""The tangents of a gas of soft spheres after a block of time steps."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import ArrayLike

from jaxgran.particles.soft.candidates import Encounters
from jaxgran.particles.soft.elements import ElementSums
from jaxgran.particles.soft.frame import at_rest, heat
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.soft.steps import ContactWork
from jaxgran.particles.state import State, kinetic_energy
from jaxgran.tangents import thermal
from jaxgran.tangents.thermal import ThermalTangents
from jaxgran.theory import closed_forms


def at_start(
    scene: SoftScene, state: State, directions: tuple[Any, ...], interval: ArrayLike
) -> ThermalTangents:
    """The tangents of an initial state, along directions in `SoftScene.material`.

    Raises:
        ValueError: for a gas with friction, whose temperature of rotation they would leave out.
    """
    if scene.surface is not None:
        raise ValueError(
            "derivatives of SoftSpheres runs with friction are not known: use differences of runs, "
            "or KineticTheory() with surface=jaxgran.Rough(...)"
        )
    alpha, constant, *more = directions
    damping = closed_forms.COOLING_CORRECTION * scene.dissipative_constant * scene.alpha**0.4
    replicas, along, drag = len(state.own.elastic), None, scene.of_elements.drag
    if more:
        (along,) = more
        if drag is not None:  # gamma, of which the material has gamma over the collision frequency
            along = along._replace(drag=along.drag * scene.collision_frequency)
    return thermal.at_start(
        *(alpha, constant, state.velocity, replicas, interval, damping, along, drag)
    )


def after_block(
    new: State,
    chosen: Encounters,
    work: ContactWork,
    sums: ElementSums | None,
    duration: ArrayLike,
    scene: SoftScene,
) -> ThermalTangents:
    """The tangents after a block, projected if it is time to.

    Args:
        new: the state after the block; its tangents are followed, not projected.
        chosen: the pairs of the block.
        work: of the pairs.
        sums: energies by walls and drag; None where the gas has no elements.
        duration: of the block.
        scene: the gas.
    """
    along, replicas = new.tangents, len(new.own.elastic)
    partners = chosen.members[jnp.stack([chosen.a, chosen.b], 1)]
    ends = jnp.where(work.touching[:, None], partners, len(new.position))
    velocity = at_rest(scene, new.velocity, replicas)
    warmth = heat(scene, velocity, replicas)
    lost = chosen.by_replica(work.dissipated, replicas)
    rates = thermal.remembered(
        along.rates,
        lost=lost if sums is None else lost + sums.to_walls,
        met=2 * replicas / len(new.position) * chosen.by_replica(work.begun, replicas),
        energy=kinetic_energy(velocity, replicas) + new.own.elastic,
        temperature=warmth,
        trend=along.trend(warmth),
        duration=duration,
        collision_frequency=scene.collision_frequency,
    )
    free = jnp.ones_like(along.free).at[ends].set(False, mode="drop")
    if sums is not None:
        free &= ~sums.at_walls
    along = along._replace(
        free=free,
        rates=rates,
        elapsed=along.elapsed + duration,
        own_elapsed=along.own_elapsed + duration * jnp.sqrt(warmth),
    )
    passed = along.elapsed * jnp.sqrt(jnp.mean(warmth))
    due = passed * scene.collision_frequency >= along.interval
    return thermal.project(along, velocity, due)
