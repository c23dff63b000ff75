"""The effect of impacts of hard spheres, on each other and on walls, and its derivatives.

Units here: the diameter, the mass and the first temperature are 1. Times and positions count as in
`jaxgran.particles.hard.prediction`: an impact changes both the velocity of a path and its position
extrapolated back to the start of the window. With drag, velocities, spins and time are transformed
(`jaxgran.particles.elements`), and drag does not change the transformed spins.

Tangents (`jaxgran.gradients.tangents`) follow the energy that each impact exchanges, as a function
of the numbers of the material and of the scale of all velocities and spins.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.gradients.tangents import ExchangeTangents
from jaxgran.particles.elements import DragDecay, drag_decay, tangential_impulse
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedScene, SphereScene
from jaxgran.scene.walls import wall_impact_ratio


class LawOfReplicas(ReducedLaw):
    """A law for each replica.

    After `of_rows` it is a law for each row, and `restitution` then takes one speed for each row.

    Attributes:
        laws: its numbers have a first axis of replicas, or of rows.
    """

    laws: ReducedLaw

    def of_rows(self, replica: Int[Array, "rows"]) -> "LawOfReplicas":
        """Return the laws of the replicas to which some rows belong."""
        return LawOfReplicas(jax.tree.map(lambda x: x.at[replica].get(mode="clip"), self.laws))

    def restitution(self, normal_speed: Float[Array, "rows"]) -> Float[Array, "rows"]:
        return jax.vmap(lambda law, speed: law.restitution(speed))(self.laws, normal_speed)


class ImpactEvents(NamedTuple):
    """Spheres at impact, on others or on walls; rows without an impact have no meaning.

    Attributes:
        time: of the gas.
        normal: from the first sphere out into the second, or into the wall.
        relative: velocity of the first sphere relative to the second, v_1 - v_2; at a wall, the
            velocity of the sphere.
        speed: its normal part.
        spin: sum of the (transformed) spins of both spheres; at a wall, the spin of the sphere.
            None for smooth spheres.
        elastic: whether the impact is elastic and smooth.
        axis: across which the wall lies; None for impacts of two spheres.
    """

    time: Float[Array, "rows"]
    normal: Float[Array, "rows d"]
    relative: Float[Array, "rows d"]
    speed: Float[Array, "rows"]
    spin: Float[Array, "rows spins"] | None
    elastic: Bool[Array, "rows"]
    axis: Int[Array, "rows"] | None = None

    @property
    def share(self) -> float:
        """Share of the first sphere in the change of velocity: half of two, all at a wall."""
        return 0.5 if self.axis is None else 1.0


class ImpactEffect(NamedTuple):
    """Effect of impacts on the first sphere.

    The second sphere gets the opposite kick and the same change of spin.

    Attributes:
        kick: change of velocity.
        lost: translational energy lost, by each sphere half of what both lose.
        spin_change: change of the (transformed) spin; None for smooth spheres.
        rotational_gain: gain of the energy of these spins, half of it for each sphere; None for
            smooth spheres.
    """

    kick: Float[Array, "rows d"]
    lost: Float[Array, "rows"]
    spin_change: Float[Array, "rows spins"] | None = None
    rotational_gain: Float[Array, "rows"] | None = None


def impact_effect(scene: SphereScene, impact: ImpactEvents) -> ImpactEffect:
    """Return the effect of impacts of two spheres, or on walls; see `jaxgran.Rough`."""
    material = scene.material
    law = material.law if impact.axis is None else material.walls.law
    share = impact.share
    decay = drag_decay(scene.drag_rates, impact.time)
    law_speed = impact.speed * 0.5**0.5  # the law's unit of speed is sqrt(2)
    eps = law.restitution(law_speed * decay.velocity)
    eps = jnp.where(impact.elastic, 1.0, eps)
    push = share * (1 + eps) * impact.speed
    lost = share**2 / 2 * (1 - eps**2) * impact.speed**2
    effect = ImpactEffect(-push[:, None] * impact.normal, lost)
    if material.surface is not None and impact.spin is not None:
        effect = _with_tangential_part(effect, material, impact, impact.spin, push, decay)
    if impact.axis is None:
        return effect
    return _with_frequency(effect, material.walls.frequency[impact.axis], eps)


def _with_tangential_part(
    effect: ImpactEffect,
    material: ReducedScene,
    impact: ImpactEvents,
    spin: Float[Array, "rows spins"],
    push: Float[Array, "rows"],
    decay: DragDecay,
) -> ImpactEffect:
    """Return the effect of an impact of rough spheres from its normal part.

    With the share s of a sphere, 1/2 of two spheres and 1 at a wall, the tangential kick k changes
    the energy by ``s k (v + k/(2 s))`` for each sphere, v being the tangential part of the relative
    velocity, and the change c of the spin changes it by ``I c (2 s w + c)/2``, w being the spin, or
    the sum of both.

    Args:
        effect: of the normal part.
        material: of the scene.
        impact: see `impact_effect`.
        spin: of the impact.
        push: normal change of velocity of the first sphere.
        decay: by drag until the impact.
    """
    surface = material.surface
    share = impact.share
    eta = surface.eta
    if impact.axis is not None:
        if material.walls.surface is None:
            unchanged = jnp.zeros_like(spin)
            return effect._replace(spin_change=unchanged, rotational_gain=unchanged[:, 0])
        eta = surface.eta_on_wall(material.walls.surface)
    spin_factor = decay.spin_over_velocity[:, None]
    sideways, kick, added_spin = tangential_impulse(
        impact.relative,
        spin * spin_factor,
        impact.normal,
        ~impact.elastic,
        eta,
        surface,
        push,
    )
    with_half = sideways + 0.5 / share * kick
    spin_change = added_spin / spin_factor
    before_and_after = spin * 2 * share + spin_change
    gain = surface.inertia / 2 * jnp.sum(spin_change * before_and_after, -1)
    return ImpactEffect(
        kick=effect.kick + kick,
        lost=effect.lost - share * jnp.sum(kick * with_half, -1),
        spin_change=spin_change,
        rotational_gain=gain,
    )


def _with_frequency(
    effect: ImpactEffect, frequency: Float[Array, "rows"], eps: Float[Array, "rows"]
) -> ImpactEffect:
    """Return the effect of impacts on walls with the dependence of their frequency in tangents.

    Walls that are closer together or dissipate more are hit more often, see `wall_impact_ratio`. A
    tangent does not know where walls and spheres are, but only how often a gas meets the walls:
    energies at walls have a factor of value 1 that carries this dependence.
    """
    dimension = effect.kick.shape[1]
    frequency = frequency * wall_impact_ratio(eps, frequency, dimension)
    weight = frequency / jax.lax.stop_gradient(frequency)
    gain = effect.rotational_gain
    gain = None if gain is None else gain * weight
    return effect._replace(lost=effect.lost * weight, rotational_gain=gain)


def exchange_gains(
    scene: SphereScene,
    tangents: ExchangeTangents,
    impact: ImpactEvents,
    happens: Bool[Array, "rows"],
) -> Float[Array, "changes energies rows"]:
    """Return the tangents of the gain of each energy.

    They are along the directions of `tangents`, then in the logarithm of all velocities, and of all
    spins where spheres rotate, as `ExchangeTangents.after` takes them.

    Args:
        scene: the gas.
        tangents: which give the directions and the number of energies.
        impact: the spheres at impacts.
        happens: whether each impact does; the others gain nothing.
    """

    def energies(material: ReducedScene, log_scales: Float[Array, "energies"]) -> Array:
        factor = jnp.exp(log_scales[0])
        scaled = impact._replace(relative=impact.relative * factor, speed=impact.speed * factor)
        if material.surface is not None and impact.spin is not None:
            # At a given energy spins are smaller where the inertia is larger.
            inertia = scene.material.surface.inertia
            log_spin = log_scales[1] - 0.5 * jnp.log(material.surface.inertia / inertia)
            scaled = scaled._replace(spin=impact.spin * jnp.exp(log_spin))
        effect = impact_effect(scene._replace(material=material), scaled)
        gained = [-effect.lost]
        if effect.rotational_gain is not None:
            gained.append(effect.rotational_gain)
        return jnp.where(happens, jnp.stack(gained), 0.0)

    num_directions, num_energies, *_ = tangents.energies.shape
    unscaled = jnp.zeros(num_energies, impact.speed.dtype)
    _, linear = jax.linearize(energies, scene.material, unscaled)

    def padded(directions: Array) -> Array:
        return jnp.pad(directions, [(0, num_energies), *[(0, 0)] * (directions.ndim - 1)])

    # First the directions without a scale, then each scale without a direction.
    directions = jax.tree.map(padded, tangents.directions)
    scales = jnp.concatenate([jnp.zeros((num_directions, num_energies)), jnp.eye(num_energies)])
    return jax.vmap(linear)(directions, scales.astype(unscaled.dtype))
