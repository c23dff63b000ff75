"""The differential equations of the homogeneous gas: T, a_2, a_3, D, <dr^2>, collisions, T_rot.

Units as in `jaxgran.theory.averages`.
"""

from math import pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.reduced_scene import ReducedScene
from jaxgran.theory import averages, elements
from jaxgran.theory.collision_integrals import TERMS
from jaxgran.theory.correlations import built_up, slowing
from jaxgran.theory.softness import crowding, is_soft, softness_factor


class Moments(NamedTuple):
    """The state of a homogeneous gas, in variables that stay of order one while T falls by decades.

    Attributes:
        log_temperature: ln(T/T_0).
        sonine: a_2.
        diffusion: D / sqrt(T/T_0), so that cooling does not shrink it.
        displacement: <dr^2>.
        collisions: per particle.
        third_sonine: a_3; None of a gas followed to a_2.
        diffusion_shape: ``<S_1(c^2) v.dr>/d`` over sqrt(T/T_0), S_1 = d/2 + 1 - c^2; None likewise.
        rotation: T_rot/T of rough spheres; None of smooth ones.
    """

    log_temperature: Float[Array, "..."]
    sonine: Float[Array, "..."]
    diffusion: Float[Array, "..."]
    displacement: Float[Array, "..."]
    collisions: Float[Array, "..."]
    third_sonine: Float[Array, "..."] | None = None
    diffusion_shape: Float[Array, "..."] | None = None
    rotation: Float[Array, "..."] | None = None

    @classmethod
    def of(cls, values: Float[Array, "moments ..."], order: int) -> "Moments":
        """The moments out of an array with a first axis of those that are followed."""
        has_rotation = len(values) > 5 + 2 * (order > 2)
        named = dict(zip(cls._fields, values[:5], strict=False))
        if order > 2:
            named |= {"third_sonine": values[5], "diffusion_shape": values[6]}
        return cls(**named, rotation=values[-1] if has_rotation else None)

    @classmethod
    def at_start(cls, scene: ReducedScene, like: Array, order: int) -> Float[Array, "moments"]:
        """The state at t = 0, as one array of the precision of another."""
        start = [jnp.zeros((), like.dtype)] * (5 if order == 2 else 7)
        if scene.surface is not None:
            start.append(scene.surface.ratio.astype(like.dtype))
        return jnp.stack(start)


class Density(NamedTuple):
    """Effects of finite density on the cooling rate; None is what is left out.

    Attributes:
        crowding: k in ``1/(1 + k X_T/sigma)``, see `jaxgran.theory.softness.crowding`.
        packing_fraction: of correlated velocities, see `jaxgran.theory.correlations.slowing`.
    """

    crowding: Float[Array, ""] | None = None
    packing_fraction: Float[Array, ""] | None = None

    @classmethod
    def of(cls, gas: Gas, softness: bool = True, correlations: bool = True) -> "Density":
        """The effects in a gas, unless left out."""
        soft = softness and is_soft(gas.reduced_law)
        return cls(crowding(gas) if soft else None, gas.packing_fraction if correlations else None)


def velocity(
    state: Float[Array, "moments"],
    rates: Float[Array, "rows terms"],
    scene: ReducedScene,
    density: Density,
    dimension: int,
    *,
    order: int,
    softness: bool,
    maxwellian: bool,
) -> Float[Array, "moments"]:
    """Time derivative of the moments.

    Args:
        state: the `Moments` as one array.
        rates: of `jaxgran.theory.averages.averages` at this temperature.
        scene: in reduced units.
        density: its effects on the cooling rate.
        dimension: d.
        order: of the Sonine expansion, 2 or 3.
        softness: whether soft contacts slow the cooling by impacts.
        maxwellian: whether a_2 stays 0.
    """
    at, d = Moments.of(state, order), dimension
    a2 = at.sonine
    a3 = jnp.zeros_like(a2) if at.third_sonine is None else at.third_sonine
    speed = jnp.exp(at.log_temperature / 2)
    losses, relaxation = _rates(rates, a2, a3, order)
    losses = [loss * speed for loss in losses]
    impacts = 2 / d * losses[0]
    a2_rate, a3_rate = _peaking(losses, impacts, a2, a3, d)
    cooling = _reduced(at, impacts, rates, scene, density, d, softness)
    relaxing, rotating = jnp.zeros_like(speed), []
    shape_decay = jnp.zeros_like(speed)
    if any(element is not None for element in scene[1:5]):
        ratio = 0.0 if at.rotation is None else at.rotation
        changes = elements.changes(scene, speed, ratio, a2, d)
        cooling, relaxing = cooling + changes.cooling, changes.relaxation
        a2_rate = a2_rate + changes.peaking
        if scene.drive is not None:
            shape_decay = scene.drive.strength / speed**2
            a3_rate = a3_rate - 3 * shape_decay * a3
        if scene.surface is not None:
            rotating = [changes.rotation + cooling * ratio]
    # Of what makes the gas cool, impacts alone change the form of a distribution of velocities.
    kept = cooling / 2 - relaxing
    diffusing = _diffusing(at, a2, a3, relaxation, speed, impacts, shape_decay, d)
    diffusion, *shape = [rate + kept * q for rate, q in zip(diffusing, _labelled(at), strict=True)]
    rate = [
        -cooling,
        jnp.zeros_like(speed) if maxwellian else a2_rate,
        diffusion,
        2 * d * speed * at.diffusion,
        averages.collision_rate(a2, d, a3) * speed,
    ]
    third = [] if order == 2 else [a3_rate, *shape]
    return jnp.stack(rate + third + rotating)


def _peaking(
    losses: list[Array], impacts: Array, a2: Array, a3: Array, d: int
) -> tuple[Array, Array]:
    """Rates of change of a_2 and a_3 by impacts."""
    a2_rate = 2 * impacts * (1 + a2) - 4 / (d * (d + 2)) * losses[1]
    if len(losses) == 2:
        return a2_rate, jnp.zeros_like(a2_rate)
    sixth = 8 / (d * (d + 2) * (d + 4)) * losses[2]
    return a2_rate, 3 * a2_rate - 3 * impacts * (1 + 3 * a2 - a3) + sixth


def _rates(
    rates: Float[Array, "rows terms"], a2: Array, a3: Array, order: int
) -> tuple[list[Array], list[list[Array]]]:
    """The losses mu_2, mu_4, ... and the matrix nu_jk at given a_2 and a_3."""
    powers = zip(*TERMS[order], strict=True)
    ones = jnp.ones_like(a2)
    products = jnp.stack([_product(ones, a2, i, a3, j) for i, j in powers])
    values = list(rates @ products)
    losses, flat = values[:order], values[order:]
    size = order - 1
    return losses, [flat[j * size : (j + 1) * size] for j in range(size)]


def _product(ones: Array, a2: Array, i: int, a3: Array, j: int) -> Array:
    product = ones
    for factor in [a2] * i + [a3] * j:
        product = product * factor
    return product


def _reduced(
    at: Moments,
    impacts: Array,
    rates: Array,
    scene: ReducedScene,
    density: Density,
    d: int,
    softness: bool,
) -> Array:
    """Cooling rate by impacts that last and are correlated, from that of those that are not."""
    speed = jnp.exp(at.log_temperature / 2)
    if softness:
        impacts = impacts * softness_factor(scene.law, speed, d)
    if density.crowding is not None:
        impacts = impacts / (1 + density.crowding * scene.law.impact_length(speed))
    if density.packing_fraction is not None:
        inelasticity = rates[0, 0] * 2 * sqrt(2 * pi) / sphere_surface(d)  # <1 - eps^2>
        lost = slowing(density.packing_fraction, inelasticity, d) * built_up(at.collisions)
        impacts = impacts * (1 - lost)
    return impacts


def _labelled(at: Moments) -> list[Array]:
    """The moments of the velocity of labelled spheres with their displacement."""
    return [q for q in (at.diffusion, at.diffusion_shape) if q is not None]


def _diffusing(
    at: Moments,
    a2: Array,
    a3: Array,
    relaxation: list[list[Array]],
    speed: Array,
    impacts: Array,
    shape_decay: Array,
    d: int,
) -> list[Array]:
    """Rates of change of the moments of labelled spheres, besides those that cooling makes.

    Their mean displacement at velocity c is ``f(c) c (b_0 + b_1 S_1(c^2))``, of which the moments
    ``q_j = <S_j c.dr>/d = sum_k n_jk b_k/2`` are followed with ``n_00 = 1``,
    ``n_01 = -(h + 1) a_2``, ``n_11 = (h + 1) (1 + (h + 4) a_2 - (h + 2) a_3)``, h = d/2:
    ``dq_j/dt = n_j0/2 - sum_k nu_jk b_k/2 + zeta (j q_j - j (j + h) q_(j-1))`` and, as all,
    ``zeta/2 q_j``, with the cooling rate zeta.
    """
    half = d / 2
    if at.diffusion_shape is None:
        return [speed / 2 - relaxation[0][0] * speed * at.diffusion]
    q0, q1 = at.diffusion, at.diffusion_shape
    mixed = -(half + 1) * a2
    square = (half + 1) * (1 + (half + 4) * a2 - (half + 2) * a3)
    b1 = (q1 - mixed * q0) / (square - mixed**2)
    b0 = q0 - mixed * b1  # both half of what is called b above
    first = speed * (0.5 - relaxation[0][0] * b0 - relaxation[0][1] * b1)
    second = speed * (mixed / 2 - relaxation[1][0] * b0 - relaxation[1][1] * b1)
    turned = impacts * (q1 - (half + 1) * q0) - shape_decay * q1
    return [first, second + turned]
