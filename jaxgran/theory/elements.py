"""What the elements of a scene do to a homogeneous gas: roughness, walls, drag, a drive.

Units as in `jaxgran.theory.averages`.
"""

from math import sqrt
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.elements import SPINS
from jaxgran.scene.impact_average import impact_average
from jaxgran.scene.reduced_scene import ReducedRough, ReducedScene, ReducedWalls
from jaxgran.scene.wall_layer import MOST_IMPACTS, share_of_impacts
from jaxgran.theory.averages import collision_rate
from jaxgran.theory.rate_table import Bounds


class Changes(NamedTuple):
    """Rates of change by the elements of a scene.

    Attributes:
        cooling: part of ``-d ln T/dt``.
        rotation: ``dT_rot/dt`` over T.
        relaxation: part of the relaxation rate of the velocity autocorrelation function.
        peaking: part of ``da_2/dt``.
    """

    cooling: Float[Array, ""]
    rotation: Float[Array, ""]
    relaxation: Float[Array, ""]
    peaking: Float[Array, ""]


def changes(
    scene: ReducedScene,
    speed: Float[Array, ""],
    ratio: Float[Array, ""] | float,
    sonine: Float[Array, ""],
    dimension: int,
) -> Changes:
    """The changes by all elements of a scene, for Maxwellian velocities and angular velocities.

    Args:
        scene: in reduced units.
        speed: sqrt(T/T_0).
        ratio: T_rot/T; without meaning where the spheres are smooth.
        sonine: a_2, on which the collision rate depends.
        dimension: d.
    """
    total = Changes(*[jnp.zeros_like(speed)] * 4)
    if scene.surface is not None:
        rate = collision_rate(sonine, dimension) * speed
        own = _of_friction(scene.surface.eta, scene.surface.inertia, rate, ratio, dimension)
        total = _sum(total, own)
    if scene.walls is not None:
        own = _of_walls(scene.walls, scene.surface, speed, ratio, dimension)
        total = _sum(total, own)
    if scene.drag is not None:
        drag = scene.drag
        nothing = jnp.zeros_like(speed)
        own = Changes(2 * drag.rate, -2 * drag.rotational_rate * ratio, drag.rate, nothing)
        total = _sum(total, own)
    if scene.drive is not None:
        heating = scene.drive.strength / speed**2
        nothing = jnp.zeros_like(speed)
        total = _sum(total, Changes(-heating, nothing, nothing, -2 * sonine * heating))
    return total


def _sum(a: Changes, b: Changes) -> Changes:
    return Changes(*(x + y for x, y in zip(a, b, strict=True)))


def _of_friction(
    eta: Array, inertia: Array, rate: Array | float, ratio: Array | float, d: int
) -> Changes:
    """Of the tangential part of impacts between spheres, nu a particle and unit of time.

    ``dT/dt = -(2 (d-1)/d) nu (eta (1 - eta) T - eta^2 T_rot/q)``,
    ``dT_rot/dt = -(2 (d-1)/d_rot) nu (eta/q) ((1 - eta/q) T_rot - eta T)``: the mean squares of the
    tangential velocity of two spheres that meet are 2 (d-1) T of the centres and 2 (d-1) T_rot/q of
    the surfaces. Reference: Huthmann & Zippelius, Phys. Rev. E 56, R6275 (1997).
    """
    strength = 2 * (d - 1) * rate
    return Changes(
        cooling=strength / d * (eta * (1 - eta) - eta**2 * ratio / inertia),
        rotation=-strength / SPINS[d] * eta / inertia * ((1 - eta / inertia) * ratio - eta),
        relaxation=strength / (2 * d) * eta,
        peaking=jnp.zeros_like(eta),
    )


def _of_walls(
    walls: ReducedWalls, surface: ReducedRough | None, speed: Array, ratio: Array | float, d: int
) -> Changes:
    """Of impacts on walls, which all parts of a mixed gas meet alike, see `share_of_impacts`.

    A wall takes ``(1 - eps^2) v_n^2/2``, of constant eps ``(1 - eps^2) T`` in the mean. By friction
    it takes from one sphere what the impact of two takes from both, of whose velocities each has
    half the mean square: as many impacts of spheres with half the eta of a wall, twice. Velocities
    are reversed, so that displacements are not those of a free gas.
    """

    def of_axis(frequency: Array) -> tuple[Array, Array]:
        """Energy lost over T, and impacts, a unit of time and sqrt(T/T_0)."""

        def share(g: Array) -> Array:
            eps = walls.law.restitution(g * speed / sqrt(2))
            return share_of_impacts(eps, frequency / collision_rate(0.0, d), d)

        lost = impact_average(lambda g: share(g) * _lost(walls, speed, g), speed)
        return frequency * lost, frequency * impact_average(share, speed)

    lost, impacts = (speed * jnp.sum(x) for x in jax.vmap(of_axis)(walls.frequency))
    nothing = jnp.zeros_like(speed)
    total = Changes(2 / d * lost, nothing, nothing, nothing)
    if surface is None or walls.beta is None:
        return total
    eta = surface.eta_on_wall(walls.beta) / 2
    return _sum(total, _of_friction(eta, surface.inertia, 2 * impacts, ratio, d))


def _lost(walls: ReducedWalls, speed: Array, g: Array) -> Array:
    """Energy lost to a wall over T, at a normal speed of g sqrt(T)."""
    lost = walls.law.loss(g * speed / sqrt(2))
    return lost * (2 - lost) * g**2 / 2


def fastest_cooling(scene: ReducedScene, dimension: int) -> Bounds:
    """Upper bounds of the cooling by elements, and what heats the gas.

    The cooling is that of spheres that do not rotate and that walls stop. The heat of rotation
    is at most all that the spins have at first.
    """
    by_speed, constant = 0.0, 0.0
    one = jnp.ones(())
    if scene.surface is not None:
        rate = collision_rate(0.0, dimension)
        own = _of_friction(scene.surface.eta, scene.surface.inertia, rate, 0.0, dimension)
        by_speed = by_speed + own.cooling
    if scene.walls is not None:
        by_speed = by_speed + _stopped(scene.walls, scene.surface, dimension)
    if scene.drag is not None:
        constant = 2 * scene.drag.rate
    if scene.drive is None and scene.surface is None:
        return Bounds(by_speed, constant)
    heating = jnp.zeros_like(one) if scene.drive is None else scene.drive.strength
    rotation = None
    if scene.surface is not None:
        rotation = SPINS[dimension] / dimension * scene.surface.ratio
    return Bounds(by_speed, constant, heating, rotation)


def _stopped(walls: ReducedWalls, surface: ReducedRough | None, d: int) -> Float[Array, ""]:
    """An upper bound of the cooling by walls: that of walls which stop all spheres."""
    often = walls.frequency / collision_rate(0.0, d)
    share = share_of_impacts(jnp.zeros_like(often), often, d)
    stopped = 2 / d * jnp.sum(walls.frequency * share)
    if surface is None or walls.beta is None:
        return stopped
    eta, rate = surface.eta_on_wall(walls.beta) / 2, MOST_IMPACTS * jnp.sum(walls.frequency)
    return stopped + _of_friction(eta, surface.inertia, 2 * rate, 0.0, d).cooling
