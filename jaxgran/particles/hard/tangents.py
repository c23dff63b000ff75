"""Tangents of hard spheres with elements: rough ones, between walls, with drag, driven.

See `jaxgran.tangents.exchange`. What is followed at each impact is the energy that it exchanges, as
a function of the numbers of the material and of the scale of all velocities and spins.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxgran.particles.hard.effects import Effect, Impact
from jaxgran.particles.hard.scene import HardScene, Material
from jaxgran.scene.elements import SPINS
from jaxgran.tangents.exchange import ExchangeTangents


class HardTangents(NamedTuple):
    """Tangents of a state along p directions.

    Attributes:
        directions: in the material, stacked along a first axis of each leaf; the last one is that
            of time, in which everything is more frequent.
        exchange: tangents of the energies of translation and of the spins that are kept.
    """

    directions: Any
    exchange: ExchangeTangents

    @classmethod
    def at_start(
        cls, scene: HardScene, directions: Any, replicas: int, num_particles: int, dimension: int
    ) -> "HardTangents":
        """The tangents at t = 0, where T is 1 and T_rot as the material has it."""
        directions = jax.tree.map(_with_another, directions)
        if scene.drag is not None:  # drag is sooner over, too
            rates = jax.tree.map(lambda x, rate: x.at[-1].set(rate), directions.drag, scene.drag)
            directions = directions._replace(drag=rates)
        p = len(jax.tree.leaves(directions)[0])
        energies = jnp.zeros((p, 2, replicas), scene.collision_frequency.dtype)
        if scene.surface is not None:
            each = num_particles * SPINS[dimension] / 2
            energies = energies.at[:, 1].add(each * directions.surface.ratio[:, None])
        return cls(directions, ExchangeTangents(energies, jnp.zeros((p, replicas), energies.dtype)))

    def gains(
        self,
        scene: HardScene,
        impact: Impact,
        happens: Bool[Array, "rows"],
        effect_of: Callable[[HardScene, Impact], Effect],
    ) -> Float[Array, "changes 2 rows"]:
        """Tangents of what both energies gain in impacts, see `ExchangeTangents.after`."""

        def energies(material: Material, velocity: Array, spin: Array) -> Array:
            if scene.surface is not None and material.surface is not None:
                # At a given energy spins are smaller where the inertia is larger.
                spin = spin - 0.5 * jnp.log(material.surface.inertia / scene.surface.inertia)
            effect = effect_of(scene.with_material(material), impact.faster(velocity, spin))
            turned = jnp.zeros_like(effect.lost) if effect.turned is None else effect.turned
            return jnp.where(happens, jnp.stack([-effect.lost, turned]), 0.0)

        zero, one = (jnp.full((), x, impact.speed.dtype) for x in (0.0, 1.0))
        material: Any = scene.material
        _, linear = jax.linearize(energies, material, zero, zero)
        nothing = jax.tree.map(jnp.zeros_like, material)
        along = jax.vmap(lambda direction: linear(direction, zero, zero))(self.directions)
        scales = jnp.stack([linear(nothing, one, zero), linear(nothing, zero, one)])
        return jnp.concatenate([along, scales])

    @property
    def num_changes(self) -> int:
        """Rows of `gains`."""
        return len(self.exchange.energies) + 2


def _with_another(leaf: Array) -> Array:
    """Directions with a last one, along which the number does not change."""
    return jnp.concatenate([leaf, jnp.zeros((1, *leaf.shape[1:]), leaf.dtype)])
