"""The tangents of a gas of soft spheres after a block of time steps."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.particles.soft.candidates import Encounters
from jaxgran.particles.soft.elements import ElementSums
from jaxgran.particles.soft.frame import at_rest, heat, rotational_temperature
from jaxgran.particles.soft.scene import SoftScene
from jaxgran.particles.soft.steps import ContactWork
from jaxgran.particles.state import State, kinetic_energy
from jaxgran.tangents import rates, thermal
from jaxgran.tangents.rotation import RotationTangents
from jaxgran.tangents.thermal import ThermalTangents
from jaxgran.theory import closed_forms


def at_start(
    scene: SoftScene, state: State, directions: tuple[Any, ...], interval: ArrayLike
) -> ThermalTangents:
    """The tangents of an initial state, along directions in `SoftScene.material`."""
    alpha, constant, *more = directions
    damping = closed_forms.COOLING_CORRECTION * scene.dissipative_constant * scene.alpha**0.4
    replicas, along, drag = len(state.own.elastic), None, scene.of_elements.drag
    if more:
        along, *more = more
        # Rates, of which the material has those over the collision frequency.
        of_drag = {"drag": along.drag, "spin_drag": along.spin_drag}
        of_drag = jax.tree.map(lambda rate: rate * scene.collision_frequency, of_drag)
        along = along._replace(**of_drag)
    found = thermal.at_start(
        *(alpha, constant, state.velocity, replicas, interval, damping, along, drag)
    )
    if scene.surface is None:
        return found
    (rubbing,), surface = more, scene.surface
    at = rubbing, surface.inertia, surface.ratio, state.own.spin, replicas
    return found._replace(rotation=RotationTangents.at_start(*at))


def after_block(
    new: State,
    spin: Array | None,
    chosen: Encounters,
    work: ContactWork,
    sums: ElementSums | None,
    duration: ArrayLike,
    scene: SoftScene,
) -> ThermalTangents:
    """The tangents after a block, projected if it is time to.

    Args:
        new: the state after the block; its tangents are followed, not projected.
        spin: before it; None of smooth spheres.
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
    lost, energy = chosen.by_replica(work.dissipated, replicas), kinetic_energy(velocity, replicas)
    lost = lost if sums is None else lost + sums.to_walls
    if along.rotation is not None:
        turned = _turned(scene, spin, new.own.spin, duration, replicas)
        lost += turned
        passed = duration * jnp.sqrt(warmth) * scene.collision_frequency
        share = rates.ratio(rotational_temperature(scene, new.own.spin, replicas), warmth)
        line = along.rotation.turned.after(passed, turned, energy * passed, share)
        along = along._replace(rotation=along.rotation._replace(turned=line))
    found = rates.remembered(
        along.rates,
        lost=lost,
        met=2 * replicas / len(new.position) * chosen.by_replica(work.begun, replicas),
        energy=energy + new.own.elastic,
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
        rates=found,
        elapsed=along.elapsed + duration,
        own_elapsed=along.own_elapsed + duration * jnp.sqrt(warmth),
    )
    passed = along.elapsed * jnp.sqrt(jnp.mean(warmth))
    due = passed * scene.collision_frequency >= along.interval
    return thermal.project(along, velocity, due, new.own.spin)


def _turned(
    scene: SoftScene, before: Array | None, after: Array, duration: ArrayLike, replicas: int
) -> Float[Array, "replicas"]:
    """Energy that rotation gained in contacts, all that it gained but for what drag took."""
    assert before is not None and scene.surface is not None
    old, new = kinetic_energy(before, replicas), kinetic_energy(after, replicas)
    gained = new - old
    if (rate := scene.of_elements.spin_drag) is not None:
        gained += rate * duration * (old + new)
    return scene.surface.inertia * gained
