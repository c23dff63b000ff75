"""What impacts of hard spheres do, to each other and to walls.

Units here: the diameter, the mass and the first temperature are 1. Where there is drag, velocities,
spins and time are transformed: see `jaxgran.particles.drag`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.particles.drag import Decay, decay
from jaxgran.particles.hard.scene import HardScene
from jaxgran.particles.spins import Rub, rub
from jaxgran.scene.wall_layer import share_of_impacts


class Impact(NamedTuple):
    """Spheres at impact, on others or on walls; rows without an impact have no meaning.

    Attributes:
        time: of the gas.
        normal: from the first sphere out into the second, or into the wall.
        relative: velocity of the first less that of the second, or of the sphere.
        speed: its normal part.
        spin: sum of the spins that are kept, or the sphere's; None of smooth spheres.
        elastic: the impact is elastic and smooth.
    """

    time: Float[Array, "rows"]
    normal: Float[Array, "rows d"]
    relative: Float[Array, "rows d"]
    speed: Float[Array, "rows"]
    spin: Float[Array, "rows spins"] | None
    elastic: Bool[Array, "rows"]

    def faster(self, velocity: Float[Array, ""], spin: Float[Array, ""]) -> "Impact":
        """The same with all velocities and all spins greater by factors exp(...)."""
        factor = jnp.exp(velocity)
        return self._replace(
            relative=self.relative * factor,
            speed=self.speed * factor,
            spin=None if self.spin is None else self.spin * jnp.exp(spin),
        )


class Effect(NamedTuple):
    """What impacts do to the first sphere; the second gets the opposite kick and the same twist.

    Attributes:
        kick: change of velocity.
        lost: translational energy lost, by each sphere half of what both lose.
        twist: change of the spin that is kept; None of smooth spheres.
        turned: gain of the energy of the spins that are kept, likewise; None of smooth spheres.
    """

    kick: Float[Array, "rows d"]
    lost: Float[Array, "rows"]
    twist: Float[Array, "rows spins"] | None = None
    turned: Float[Array, "rows"] | None = None


def of_pairs(scene: HardScene, impact: Impact) -> Effect:
    """The effect of impacts of two spheres, see `jaxgran.Rough`."""
    left = None if scene.drag is None else decay(scene.decay_rates, impact.time)
    eps = _restitution(scene, impact, left)
    kick = (-0.5 * (1 + eps) * impact.speed)[:, None] * impact.normal
    effect = Effect(kick, 0.125 * (1 - eps * eps) * impact.speed**2)
    if scene.surface is None or impact.spin is None:
        return effect
    return _rubbed(effect, impact, left, scene.surface.eta, scene.surface.inertia, shares=2)


def of_walls(scene: HardScene, impact: Impact, axis: Int[Array, "rows"]) -> Effect:
    """The effect of impacts on the walls across an axis, whose law is that of `HardWalls`."""
    walls, surface = scene.walls, scene.surface
    assert walls is not None
    left = None if scene.drag is None else decay(scene.decay_rates, impact.time)
    eps = _restitution(scene._replace(law=walls.law), impact, left)
    kick = -((1 + eps) * impact.speed)[:, None] * impact.normal
    effect = Effect(kick, 0.5 * (1 - eps**2) * impact.speed**2)
    if surface is None or impact.spin is None:
        return effect
    if walls.beta is None:
        nothing = jnp.zeros_like(impact.spin)
        return effect._replace(twist=nothing, turned=nothing[:, 0])
    return _rubbed(effect, impact, left, surface.eta_on_wall(walls.beta), surface.inertia, shares=1)


def of_walls_as_often(scene: HardScene, impact: Impact, axis: Int[Array, "rows"]) -> Effect:
    """The effect of impacts on walls to a derivative: of more where walls are nearer or take more.

    A derivative sees neither where walls are nor where spheres are; it knows how often a gas meets
    them, see `share_of_impacts`.
    """
    assert scene.walls is not None
    effect = of_walls(scene, impact, axis)
    often = scene.walls.frequency[axis]
    eps = -jnp.sum(effect.kick * impact.normal, -1) / impact.speed - 1
    often = often * share_of_impacts(eps, often, impact.normal.shape[1])
    share = often / jax.lax.stop_gradient(often)
    turned = None if effect.turned is None else effect.turned * share
    return effect._replace(lost=effect.lost * share, turned=turned)


def _restitution(scene: HardScene, impact: Impact, left: Decay | None) -> Float[Array, "rows"]:
    speed = impact.speed * 0.5**0.5  # the law's unit of speed is sqrt(2)
    eps = scene.law.restitution(speed if left is None else speed * left.velocity)
    return jnp.where(impact.elastic, 1.0, eps)


def _rubbed(
    effect: Effect,
    impact: Impact,
    left: Decay | None,
    eta: Float[Array, ""],
    inertia: Float[Array, ""],
    shares: int,
) -> Effect:
    """The effect with the tangential part of impacts, of which each sphere bears a share."""
    assert impact.spin is not None
    kept = 1.0 if left is None else left.spin[:, None]
    found: Rub = rub(
        impact.relative, impact.spin * kept, impact.normal, ~impact.elastic, eta, inertia
    )
    if shares == 2:
        lost = -0.5 * jnp.sum(found.kick * (found.sideways + found.kick), -1)
    else:
        lost = -jnp.sum(found.kick * (found.sideways + 0.5 * found.kick), -1)
    twist = found.twist / kept
    turned = inertia / 2 * jnp.sum(twist * (impact.spin * 2 / shares + twist), -1)
    return Effect(effect.kick + found.kick, effect.lost + lost, twist, turned)
