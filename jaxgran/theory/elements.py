"""Rates of change by the elements of a scene: roughness, walls, drag and a drive.

Units are the same as in `jaxgran.theory.averages`; functions of a `Gas` use SI units.
"""

from collections.abc import Callable
from math import sqrt
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.geometry import impact_average
from jaxgran.scene.reduced import ReducedRough, ReducedScene, ReducedWalls
from jaxgran.scene.walls import MAX_WALL_IMPACT_RATIO, wall_impact_ratio
from jaxgran.theory.averages import collision_rate
from jaxgran.theory.moments import Spins
from jaxgran.theory.rough_impacts import coulomb_limit, mean_impulse, rough_impact_means
from jaxgran.theory.sizes import drag_factors, equal_rates

SUPPORTED = ("surface", "container", "drag", "drive", "diameter_sd")
"""Elements of a scene that the equations contain, see `Gas.elements`."""


class ElementRates(NamedTuple):
    """Rates of change by the elements of a scene, or by one of them.

    Attributes:
        cooling: part of ``-d ln T/dt``.
        spins: rates of change of `Spins` at constant T.
        relaxation: part of the relaxation rate of the velocity autocorrelation function.
        sonine: part of ``da_2/dt``.
    """

    cooling: Any
    spins: Spins = Spins(0.0, 0.0, 0.0)
    relaxation: Any = 0.0
    sonine: Any = 0.0


def element_rates(
    scene: ReducedScene,
    speed: Float[Array, ""],
    spins: Spins | None,
    sonine: Float[Array, ""],
    dimension: int,
    gaussian_spins: bool = False,
) -> ElementRates:
    """Return the sum of the rates of change by all elements of a scene.

    Args:
        scene: in reduced units.
        speed: sqrt(T/T_0).
        spins: of rough spheres; None where the spheres are smooth.
        sonine: a_2.
        dimension: d.
        gaussian_spins: take spins and velocities of rough spheres to be independent and Gaussian.
    """
    zero = jnp.zeros_like(speed)
    spins = spins or Spins.gaussian(zero)
    parts = [ElementRates(zero)]
    surface = scene.surface
    if surface is not None:
        impulse = mean_impulse(scene.law, speed)
        changes = rough_impact_rates(
            surface, surface.eta, impulse, spins, sonine, dimension, gaussian=gaussian_spins
        )
        # The means over spins that are not Gaussian contain the effect of a_2.
        rate = collision_rate(sonine if gaussian_spins else 0.0, dimension) * speed
        parts.append(jax.tree.map(lambda change: rate * change, changes))
    if scene.walls is not None:
        parts.append(_wall_rates(scene.walls, surface, speed, spins, sonine, dimension))
    if scene.drag is not None:
        drag = scene.drag
        damping = spins.damped(2 * drag.rotational_rate)
        parts.append(ElementRates(2 * drag.rate, damping, relaxation=drag.rate))
    if scene.drive is not None:
        heating = scene.drive / speed**2
        decorrelation = Spins(zero, -heating * spins.correlation, zero)
        parts.append(ElementRates(-heating, decorrelation, sonine=-2 * sonine * heating))
    return jax.tree.map(lambda *rates: sum(rates), *parts)


A12_RATIO = 3.0
"""``a_12/(a_11 a_02)``: 2 to 3 in DSMC with a_02 from .3 to .9. Without a_12 spins of inelastic
spheres (eps = .6, beta_t = -.3) have no cooling state."""

_RELATIVE_STEP = 0.04
"""Step of T over S, and of a over V, of differences: second derivatives are right to 1e-3."""

_DIFFERENCE_STEPS = np.array(
    [
        [0, 0, 0, 1, -1, 1, -1, 1, -1],
        [0, 1, -1, 1, -1, -1, 1, 0, 0],
    ]
)[:, None]
"""Steps of T and of a to each of the points at which means are computed."""

_DIFFERENCE_WEIGHTS = np.array(
    [
        [-2, 0, 0, 0, 0, 0, 0, 1, 1],
        [0, 0, 0, 0.25, 0.25, -0.25, -0.25, 0, 0],
        [-2, 1, 1, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0.5, -0.5, 0.5, -0.5, -1, 1],
    ]
)[:, None]
"""Weights of the means at these points in the central differences d_TT, d_Ta, d_aa and d_Taa."""


def rough_impact_rates(
    surface: ReducedRough,
    eta: Float[Array, ""],
    impulse: Float[Array, ""],
    spins: Spins,
    sonine: Float[Array, ""],
    d: int,
    *,
    gaussian: bool,
) -> ElementRates:
    """Return the rates of change in impacts of rough spheres, per impact of a sphere.

    The cooling is only its part by roughness. With the cumulants a_20 = a_2, a_11, a_02 and
    a_12 = 3 a_11 a_02 the distribution of a sphere is

        (1 + a_20 T^2/2 d_TT + a_11 T a d_Ta + a_02 a^2/2 d_aa + a_12 T a^2/2 d_Taa) f

    with the Gaussian f of the variances T and a of the components of v and s = (sigma/2) w. Means
    over it are thus `rough_impact_means` and their derivatives, here by differences. Products of
    cumulants of two spheres are left out, and directions of v and s are taken to be independent.

    Spheres stick where eta times the slip is below ``mu (1 + eps)/2 g``.

    References: Huthmann & Zippelius, Phys. Rev. E 56, R6275 (1997), for Gaussian spins; Santos,
    Kremer & dos Santos, Phys. Fluids 23, 030604 (2011), for cumulants, named as there, of spheres
    that do not slide.

    Args:
        surface: in reduced units.
        eta: coefficient of `Rough`.
        impulse: (1 + eps)/2, see `mean_impulse`.
        spins: moments of the spins.
        sonine: a_2.
        d: dimension.
        gaussian: take v and s to be Gaussian.
    """
    q = surface.inertia
    num_spins = NUM_SPIN_COMPONENTS[d]
    a = spins.rotation / q
    correlation = spins.correlation / q
    kurtosis = spins.kurtosis / q**2
    # Only the first point, which has no step, enters the means over Gaussian v and s.
    num_points = 1 if gaussian else _DIFFERENCE_STEPS.shape[-1]
    step_T, step_a = jnp.asarray(_DIFFERENCE_STEPS[..., :num_points], a.dtype)
    d_TT, d_Ta, d_aa, d_Taa = jnp.asarray(_DIFFERENCE_WEIGHTS[..., :num_points], a.dtype)
    size_T = 2 * _RELATIVE_STEP
    size_a = 2 * _RELATIVE_STEP * (1 + a)
    # The first sphere of a pair has the variances of a point, the second one 1 and a.
    T_first = 1 + size_T * step_T
    a_first = a + size_a * step_a
    T_of_both = jnp.concatenate([T_first, jnp.ones_like(T_first)])
    a_of_both = jnp.concatenate([a_first, jnp.full_like(a_first, a)])
    S = 1 + T_first
    V = 1 + T_first + a + a_first
    m = coulomb_limit(surface, eta, impulse, V / S)
    means = rough_impact_means(T_of_both, a_of_both, S, V, m, impulse, eta, q, d, gaussian)
    # Sums over both spheres: each mean counts half.
    weights = jnp.zeros_like(T_first).at[0, 0].set(0.5)
    if not gaussian:
        weights += sonine / (2 * size_T**2) * d_TT
        weights += correlation / (size_T * size_a) * d_Ta
        weights += kurtosis / (2 * size_a**2) * d_aa
        a12 = A12_RATIO * correlation * kurtosis * a / jnp.maximum(a**2, 1e-12)
        weights += a12 / (2 * size_T * size_a**2) * d_Taa
    changes = jax.tree.map(lambda mean: jnp.sum(mean * weights), means)
    rotation_rate = changes.s2 / num_spins
    correlation_rate = jnp.zeros_like(rotation_rate)
    kurtosis_rate = jnp.zeros_like(rotation_rate)
    if not gaussian:
        cooling = -(changes.v2_tangential + changes.v2_normal) / d
        correlation_rate = (
            changes.v2s2 / (d * num_spins) - rotation_rate + (a + correlation) * cooling
        )
        kurtosis_rate = changes.s4 / (num_spins * (num_spins + 2)) - 2 * a * rotation_rate
    return ElementRates(
        cooling=-changes.v2_tangential / d,
        spins=Spins(q * rotation_rate, q * correlation_rate, q**2 * kurtosis_rate),
        relaxation=changes.slipping / d,
    )


def _wall_rates(
    walls: ReducedWalls,
    surface: ReducedRough | None,
    speed: Array,
    spins: Spins,
    sonine: Array,
    d: int,
) -> ElementRates:
    """Rates of change by impacts on walls, in a well-mixed gas (see `wall_impact_ratio`).

    A wall takes ``(1 - eps^2) v_n^2/2`` in an impact, on average ``(1 - eps^2) T`` at constant eps.
    It takes more from fast spheres, which come more often, and so changes a_2, at constant eps and
    Z impacts in a unit of time:

        da_2/dt = (4/d) Z (1 - eps^2) ((1 + a_2) (1 + 3 a_2/8)
                                       - (1 + 15 a_2/8) (d + 1 + 2 eps^2)/(d + 2)).

    The mean k-th power of the normal speed is ``1 + k (k - 2) a_2/8`` times its value in a
    Maxwellian gas. The relative velocity of two spheres has twice the variance of the velocity of
    one, and a wall acts on one sphere only. So friction in an impact on a wall has the effect of
    two impacts between spheres with half the eta. <dr^2> of a gas between walls is not computed.
    """

    def axis_rates(frequency: Array) -> ElementRates:
        def impact_ratio(g: Array) -> Array:
            """Impacts at the normal speed g sqrt(T), over those in a homogeneous gas."""
            eps = walls.law.restitution(g * speed / sqrt(2))
            return wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)

        def v2_loss(g: Array) -> Array:
            """Loss of v^2 over T in such an impact."""
            loss = walls.law.loss(g * speed / sqrt(2))
            return loss * (2 - loss) * g**2

        def v4_loss(g: Array) -> Array:
            """Loss of v^4 over T^2."""
            return v2_loss(g) * (2 * (g**2 + d - 1) - v2_loss(g))

        def loss_rate(loss: Callable[[Array], Array], k: int) -> Array:
            """Sum over the impacts of a unit of time of a loss in proportion to g^(k - 1)."""
            mean = impact_average(lambda g: impact_ratio(g) * loss(g), speed)
            return (1 + k * (k - 2) * sonine / 8) * frequency * mean

        cooling = loss_rate(v2_loss, 3) / d
        v4_rate = loss_rate(v4_loss, 5)
        a2_rate = 2 * (1 + sonine) * cooling - v4_rate / (d * (d + 2))
        if surface is None or walls.surface is None:
            return ElementRates(cooling, sonine=a2_rate)
        eta = surface.eta_on_wall(walls.surface) / 2
        impulse = mean_impulse(walls.law, speed / sqrt(2))
        changes = rough_impact_rates(surface, eta, impulse, spins, sonine, d, gaussian=True)
        impacts = 2 * frequency * impact_average(impact_ratio, speed)
        changes = jax.tree.map(lambda change: impacts * change, changes)
        return changes._replace(cooling=cooling + changes.cooling, sonine=a2_rate)

    by_axis = jax.vmap(axis_rates)(walls.frequency)
    return jax.tree.map(lambda x: speed * jnp.sum(x), by_axis)


MAX_SPEED_FACTOR = 1.2
"""Bound of ``1 + 3 a_2/8``, the factor of losses at walls."""


class ElementBounds(NamedTuple):
    """Upper bounds of the cooling and the heating by the elements of a scene.

    Attributes:
        cooling_over_speed: of the part of ``-d ln T/dt`` that grows with sqrt(T), over sqrt(T/T_0).
        constant_cooling: of the part of ``-d ln T/dt`` that does not depend on T.
        heating: of d(T/T_0)/dt by a drive; None where T never rises.
        energy_gain: of T/T_0 gained from the spins of rough spheres or, where sizes differ, from
            the large spheres; None where neither exists.
    """

    cooling_over_speed: Any = 0.0
    constant_cooling: Any = 0.0
    heating: Any = None
    energy_gain: Any = None


def element_bounds(scene: ReducedScene, dimension: int) -> ElementBounds:
    """Return upper bounds of the cooling and the heating by the elements of a scene.

    Spheres that do not rotate, and that stop at walls, cool fastest. The rotation heats at most by
    the initial energy of the spins.
    """
    d = dimension
    rate = collision_rate(0.0, d)
    surface = scene.surface
    walls = scene.walls
    cooling_over_speed = 0.0
    constant_cooling = 0.0
    heating = None
    energy_gain = None
    if surface is not None:
        tangential = _max_tangential_cooling(surface.eta, rate, d)
        cooling_over_speed = cooling_over_speed + tangential
        heating = jnp.zeros(())
        energy_gain = NUM_SPIN_COMPONENTS[d] / d * surface.ratio
    if walls is not None:
        frequency = walls.frequency / rate
        ratio = wall_impact_ratio(jnp.zeros_like(frequency), frequency, d)
        at_walls = 2 / d * MAX_SPEED_FACTOR * jnp.sum(walls.frequency * ratio)
        if surface is not None and walls.surface is not None:
            wall_rate = 2 * MAX_WALL_IMPACT_RATIO * jnp.sum(walls.frequency)
            eta = surface.eta_on_wall(walls.surface) / 2
            at_walls = at_walls + _max_tangential_cooling(eta, wall_rate, d)
        cooling_over_speed = cooling_over_speed + at_walls
    if scene.drag is not None:
        constant_cooling = 2 * scene.drag.rate
    if scene.sizes is not None:
        # Impacts cool at most twice as fast, and small spheres have at most all of the energy.
        one = jnp.ones_like(scene.sizes.spread)
        cooling_over_speed = cooling_over_speed - equal_rates(scene.law, one, 0.0, d)
        small, large = scene.sizes.masses
        heating = jnp.zeros(())
        energy_gain = (large - small) / (2 * small)
        if scene.drag is not None:
            drag_factor_of_small, _ = drag_factors(scene.sizes)
            constant_cooling = constant_cooling * drag_factor_of_small
    if scene.drive is not None:
        heating = scene.drive
    return ElementBounds(cooling_over_speed, constant_cooling, heating, energy_gain)


def _max_tangential_cooling(eta: Array, rate: Array, d: int) -> Array:
    """Bound of ``-d ln T/dt`` by the tangential impulses, of spheres without spin that stick."""
    return rate * 2 * (d - 1) / d * (eta - eta**2)
