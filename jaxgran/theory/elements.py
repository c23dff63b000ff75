"""Rates of change by the elements of a scene: roughness, walls, drag and a drive.

Units are the same as in `jaxgran.theory.averages`; functions of a `Gas` use SI units.
"""

from math import pi, sqrt
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.geometry import impact_average
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedRough, ReducedScene, ReducedWalls
from jaxgran.scene.walls import MAX_WALL_IMPACT_RATIO, wall_impact_ratio
from jaxgran.theory.averages import ElementBounds, collision_rate, rough_impact_means
from jaxgran.theory.moments import Spins
from jaxgran.theory.sizes import drag_factors, equal_rates

SUPPORTED = ("surface", "container", "drag", "drive", "diameter_sd")
"""Elements of a scene that the equations contain, see `Gas.elements`."""


class ElementRates(NamedTuple):
    """Rates of change by the elements of a scene, or by one of them.

    Attributes:
        cooling: part of ``-d ln T/dt``.
        spins: of `Spins` at constant T.
        relaxation: part of the relaxation rate of the velocity autocorrelation function.
        sonine: part of ``da_2/dt``.
    """

    cooling: Any
    spins: Spins = Spins(0.0, 0.0, 0.0)  # type: ignore[arg-type]
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
    drag = scene.drag
    if surface is not None:
        impulse = mean_impulse(scene.law, speed)
        changes = rough_impact_rates(
            surface, surface.eta, impulse, spins, sonine, dimension, gaussian=gaussian_spins
        )
        # The means over spins that are not Gaussian contain the effect of a_2.
        rate = collision_rate(sonine if gaussian_spins else 0.0, dimension) * speed
        parts.append(jax.tree.map(lambda change: rate * change, changes))
    if scene.walls is not None:
        on_walls = _wall_rates(scene.walls, surface, speed, spins, sonine, dimension)
        parts.append(on_walls)
    if drag is not None:
        parts.append(ElementRates(2 * drag.rate, spins.damped(2 * drag.rotational_rate), drag.rate))
    if scene.drive is not None:
        heating = scene.drive / speed**2
        heated = Spins(zero, -heating * spins.correlation, zero)
        parts.append(ElementRates(-heating, heated, sonine=-2 * sonine * heating))
    return jax.tree.map(lambda *rates: sum(rates), *parts)


TYPICAL_IMPACT = 2 * sqrt(2 / pi)
"""Mean normal speed of impacts, weighted by itself, in units of sqrt(2 T)."""


def mean_impulse(law: ReducedLaw, speed: Float[Array, "*points"]) -> Float[Array, "*points"]:
    """Return (1 + eps)/2 of the typical impact: the normal impulse over m times the normal speed.

    The cooling of sliding spheres of ice is then right within 2 %.
    """
    return (1 + law.restitution(TYPICAL_IMPACT * speed)) / 2


MAX_STICKING = 1e6
"""Bound of the friction over the slip, above which no sphere slides in double precision."""

_STEP = 0.04
"""Steps of variances over S and V: second derivatives are then right to 1e-3."""

A12 = 3.0
"""``a_12/(a_11 a_02)``: 2 to 3 in DSMC with a_02 from .3 to .9. Without a_12 spins of inelastic
spheres (eps = .6, beta_t = -.3) have no cooling state."""

_STENCIL = np.array(
    [
        [0, 0, 0, 1, -1, 1, -1, 1, -1],
        [0, 1, -1, 1, -1, -1, 1, 0, 0],
        [-2, 0, 0, 0, 0, 0, 0, 1, 1],
        [0, 0, 0, 0.25, 0.25, -0.25, -0.25, 0, 0],
        [-2, 1, 1, 0, 0, 0, 0, 0, 0],
        [0, 0, 0, 0.5, -0.5, 0.5, -0.5, -1, 1],
    ]
)[:, None]
"""Steps in T and a, and weights of the differences d_TT, d_Ta, d_aa and d_Taa at these steps."""


def coulomb_limit(
    surface: ReducedRough, eta: Array, impulse: Array, variance: Array
) -> Float[Array, "..."] | None:
    """Return m of `slip_moments`, ``mu (1 + eps)/2 / (eta sqrt(V/S))``; None without friction.

    Args:
        surface: in reduced units.
        eta: coefficient of `Rough`.
        impulse: (1 + eps)/2, see `mean_impulse`.
        variance: V/S, of a component of the slip over one of the relative velocity.
    """
    if surface.friction is None:
        return None
    slip = jnp.sqrt(variance) * jnp.maximum(eta, 1e-9)
    return jnp.minimum(surface.friction * impulse / slip, MAX_STICKING)


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

    The cooling is that by roughness. With the cumulants a_20 = a_2, a_11, a_02 and a_12 = 3 a_11
    a_02 the distribution of a sphere is ``(1 + a_20 T^2/2 d_TT + a_11 T a d_Ta + a_02 a^2/2 d_aa +
    a_12 T a^2/2 d_Taa) f`` with the Gaussian f of the variances T and a of the components of v and
    s = (sigma/2) w, so that means are `rough_impact_means` and their derivatives, here by
    differences. Products of cumulants of two spheres are left out, and directions of v and s are
    taken to be independent.

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
    # The first sphere of a pair has the variances of a step of the stencil, the second one 1 and a.
    stencil = jnp.asarray(_STENCIL[:, :, : 1 if gaussian else None], a.dtype)
    step_T, step_a, of_TT, of_Ta, of_aa, of_Taa = stencil
    size_T = 2 * _STEP
    size_a = 2 * _STEP * (1 + a)
    T1 = 1 + size_T * step_T
    a1 = a + size_a * step_a
    T = jnp.concatenate([T1, jnp.ones_like(T1)])
    variance_of_spin = jnp.concatenate([a1, jnp.full_like(a1, a)])
    S = 1 + T1
    V = 1 + T1 + a + a1
    m = coulomb_limit(surface, eta, impulse, V / S)
    means = rough_impact_means(T, variance_of_spin, S, V, m, impulse, eta, q, d, gaussian)
    # Sums over both spheres: each mean counts half.
    weights = jnp.zeros_like(T1).at[0, 0].set(0.5)
    if not gaussian:
        weights += sonine / (2 * size_T**2) * of_TT
        weights += correlation / (size_T * size_a) * of_Ta
        weights += kurtosis / (2 * size_a**2) * of_aa
        a12 = A12 * correlation * kurtosis * a / jnp.maximum(a**2, 1e-12)
        weights += a12 / (2 * size_T * size_a**2) * of_Taa
    v2, v2_by_normal, slipping, s2, *products = (jnp.sum(x * weights) for x in means)
    rotation = s2 / num_spins
    correlation_rate = jnp.zeros_like(s2)
    kurtosis_rate = jnp.zeros_like(s2)
    if not gaussian:
        v2s2, s4 = products
        cooling = -(v2 + v2_by_normal) / d
        correlation_rate = v2s2 / (d * num_spins) - rotation + (a + correlation) * cooling
        kurtosis_rate = s4 / (num_spins * (num_spins + 2)) - 2 * a * rotation
    changes = Spins(q * rotation, q * correlation_rate, q**2 * kurtosis_rate)
    return ElementRates(-v2 / d, changes, slipping / d)


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
    one, and a wall acts on one sphere only. So friction in an impact on a wall is that of two
    impacts between spheres with half the eta. <dr^2> of a gas between walls is not computed.
    """

    def axis_rates(frequency: Array) -> ElementRates:
        def share(g: Array) -> Array:
            eps = walls.law.restitution(g * speed / sqrt(2))
            return wall_impact_ratio(eps, frequency / collision_rate(0.0, d), d)

        def lost(g: Array) -> Array:
            """Loss of v^2 over T in an impact at the normal speed g sqrt(T)."""
            loss = walls.law.loss(g * speed / sqrt(2))
            return loss * (2 - loss) * g**2

        def lost_fourth(g: Array) -> Array:
            """Loss of v^4 over T^2."""
            return lost(g) * (2 * (g**2 + d - 1) - lost(g))

        squares, fourths = (
            (1 + k * (k - 2) * sonine / 8)
            * frequency
            * impact_average(lambda g, of=of: share(g) * of(g), speed)
            for k, of in ((3, lost), (5, lost_fourth))
        )
        cooling = squares / d
        a2_rate = 2 * (1 + sonine) * cooling - fourths / (d * (d + 2))
        if surface is None or walls.surface is None:
            return ElementRates(cooling, sonine=a2_rate)
        eta = surface.eta_on_wall(walls.surface) / 2
        impulse = mean_impulse(walls.law, speed / sqrt(2))
        changes = rough_impact_rates(surface, eta, impulse, spins, sonine, d, gaussian=True)
        impacts = 2 * frequency * impact_average(share, speed)
        changes = jax.tree.map(lambda change: impacts * change, changes)
        return changes._replace(cooling=cooling + changes.cooling, sonine=a2_rate)

    by_axis = jax.vmap(axis_rates)(walls.frequency)
    return jax.tree.map(lambda x: speed * jnp.sum(x), by_axis)


MAX_SPEED_FACTOR = 1.2
"""Bound of ``1 + 3 a_2/8``, the factor of losses at walls."""


def element_bounds(scene: ReducedScene, dimension: int) -> ElementBounds:
    """Return upper bounds of the cooling and the heating by the elements of a scene.

    Spheres that do not rotate, and that stop at walls, cool fastest. The rotation heats at most by
    the initial energy of the spins.

    Returns:
        the part of ``-d ln T/dt`` over sqrt(T/T_0); its part that does not depend on T; d(T/T_0)/dt
        by a drive, None where nothing heats; T/T_0 that a gas could gain from the spins, None for
        smooth spheres.
    """
    d = dimension
    rate = collision_rate(0.0, d)
    surface = scene.surface
    walls = scene.walls
    by_speed = 0.0
    constant = 0.0
    heating = None
    rotation = None

    def friction(surface: ReducedRough, eta: Array, rate: Array) -> Array:
        return rate * 2 * (d - 1) / d * (eta - eta**2)

    if surface is not None:
        by_speed = by_speed + friction(surface, surface.eta, rate)
        heating = jnp.zeros(())
        rotation = NUM_SPIN_COMPONENTS[d] / d * surface.ratio
    if walls is not None:
        frequency = walls.frequency / rate
        share = wall_impact_ratio(jnp.zeros_like(frequency), frequency, d)
        bound = 2 / d * MAX_SPEED_FACTOR * jnp.sum(walls.frequency * share)
        if surface is not None and walls.surface is not None:
            most = 2 * MAX_WALL_IMPACT_RATIO * jnp.sum(walls.frequency)
            bound += friction(surface, surface.eta_on_wall(walls.surface) / 2, most)
        by_speed = by_speed + bound
    if scene.drag is not None:
        constant = 2 * scene.drag.rate
    if scene.sizes is not None:
        # Impacts cool at most twice as fast, and small spheres have at most all of the energy.
        one = jnp.ones_like(scene.sizes.spread)
        by_speed = by_speed - equal_rates(scene.law, one, 0.0, d)
        small, large = scene.sizes.masses
        heating = jnp.zeros(())
        rotation = (large - small) / (2 * small)
        if scene.drag is not None:
            constant = constant * drag_factors(scene.sizes)[0]
    if scene.drive is not None:
        heating = scene.drive
    return by_speed, constant, heating, rotation
