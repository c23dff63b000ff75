"""The differential equations of a homogeneous gas: T, a_2, a_3, D, <dr^2>, collisions and T_rot.

The file defines the state of a gas (`Moments`, `Density`), the equations (`Equations`), the rates
of change by the elements of a scene (roughness, walls, drag, a drive), two corrections of finite
density (correlated velocities and soft contacts), and the steady states of gases that white noise
drives.

Units are those of `jaxgran.theory.averages`; functions of a `Gas` use SI units. "The paper" is
Brilliantov & Poeschel, Self-diffusion in granular gases, Phys. Rev. E 61, 1716 (2000), whose
equations are numbered here as in the authors' preprint.
"""

from functools import partial
from math import gamma, log, pi, sqrt
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxgran.scene.contact import ELASTIC_CONTACT_TIME
from jaxgran.scene.elements import MAX_WALL_IMPACT_RATIO, NUM_SPIN_COMPONENTS, wall_impact_ratio
from jaxgran.scene.gas import (
    Gas,
    ReducedRough,
    ReducedScene,
    ReducedWalls,
    reduced_scene,
    scaled_critical_wavenumber,
)
from jaxgran.scene.geometry import contact_value_slopes, impact_average, sphere_surface
from jaxgran.scene.laws import C1, ReducedLaw
from jaxgran.theory.averages import (
    TERMS,
    ElementBounds,
    RateTable,
    collision_rate,
    impact_moments,
    log_temperature_range,
    rough_impact_means,
)
from jaxgran.theory.sizes import (
    drag_factors,
    equal_rates,
    pair_rates,
    partial_temperatures,
    variable_changes,
)

SUPPORTED = ("surface", "container", "drag", "drive", "diameter_sd")
"""Elements of a scene that the equations contain, see `Gas.elements`."""


class Moments(NamedTuple):
    """State of a homogeneous gas, in variables that stay of order one while T falls by decades.

    Attributes:
        log_temperature: ln(T/T_0).
        sonine: a_2.
        collisions: number of collisions per particle.
        diffusion: D / sqrt(T/T_0), which cooling does not shrink; None where it is not asked for.
        displacement: <dr^2>; None likewise.
        third_sonine: a_3; None at order 2.
        diffusion_shape: ``<S_1(c^2) v.dr>/d`` over sqrt(T/T_0), S_1 = d/2 + 1 - c^2; None at
            order 2.
        rotation: T_rot/T of rough spheres; None for smooth spheres.
        spin_correlation: T_rot/T times ``a_11 = <v^2 w^2>/(<v^2> <w^2>) - 1``; None for smooth
            spheres and Gaussian spins.
        spin_kurtosis: (T_rot/T)^2 times ``a_02 = d_rot/(d_rot + 2) <w^4>/<w^2>^2 - 1``. Both
            products stay finite where the spins begin at 0.
        size_ratio: ``q = ln(T_1/T_2)`` of small and large spheres, see `jaxgran.theory.sizes`; None
            for equal ones.
    """

    log_temperature: Float[Array, "..."]
    sonine: Float[Array, "..."]
    collisions: Float[Array, "..."]
    diffusion: Float[Array, "..."] | None = None
    displacement: Float[Array, "..."] | None = None
    third_sonine: Float[Array, "..."] | None = None
    diffusion_shape: Float[Array, "..."] | None = None
    rotation: Float[Array, "..."] | None = None
    spin_correlation: Float[Array, "..."] | None = None
    spin_kurtosis: Float[Array, "..."] | None = None
    size_ratio: Float[Array, "..."] | None = None

    @property
    def spins(self) -> "Spins | None":
        """T_rot/T and the moments of the spins, 0 where they are Gaussian; None if smooth."""
        if self.rotation is None:
            return None
        if self.spin_correlation is None or self.spin_kurtosis is None:
            return Spins.gaussian(self.rotation)
        return Spins(self.rotation, self.spin_correlation, self.spin_kurtosis)


class Spins(NamedTuple):
    """Moments of the spins of rough spheres, or their rates of change: see `Moments`."""

    rotation: Any
    correlation: Any
    kurtosis: Any

    @classmethod
    def gaussian(cls, rotation: Array) -> "Spins":
        """Return the moments of Gaussian spins."""
        return cls(rotation, jnp.zeros_like(rotation), jnp.zeros_like(rotation))

    def damped(self, rate: Any) -> "Spins":
        """Return the rates of change where T_rot decays at a rate."""
        return Spins(-rate * self.rotation, -rate * self.correlation, -2 * rate * self.kurtosis)


class Density(NamedTuple):
    """Effects of softness and density on the cooling rate; None leaves an effect out.

    Attributes:
        crowding: k in ``(1 - c X_T/sigma)/(1 + k X_T/sigma)``, by which soft contacts slow the
            cooling, see `softness_factor` and `crowding_coefficient`.
        packing_fraction: phi, for correlated velocities, see `correlation_slowdown`.
    """

    crowding: Float[Array, ""] | None = None
    packing_fraction: Float[Array, ""] | None = None

    @classmethod
    def from_gas(cls, gas: Gas, softness: bool = True, correlations: bool = True) -> "Density":
        """Return the effects in a gas; the two flags can leave them out."""
        soft = softness and is_soft(gas.reduced_law)
        return cls(
            crowding_coefficient(gas) if soft else None,
            gas.packing_fraction if correlations else None,
        )

    def factor(
        self, law: ReducedLaw, speed: Array, inelasticity: Array, collisions: Array, dimension: int
    ) -> Float[Array, "*points"]:
        """Return the factor of the cooling by impacts.

        Args:
            law: law of restitution in units of the diameter and of `Gas.impact_speed`.
            speed: sqrt(T/T_0).
            inelasticity: <1 - eps^2>, weighted by the energy of the normal motion.
            collisions: per particle since t = 0.
            dimension: d.
        """
        factor = jnp.ones_like(speed)
        if self.crowding is not None:
            factor = softness_factor(law, speed, dimension)
            factor = factor / (1 + self.crowding * law.impact_length(speed))
        if self.packing_fraction is not None:
            slowdown = correlation_slowdown(self.packing_fraction, inelasticity, dimension)
            factor = factor * (1 - slowdown * correlation_build_up(collisions))
        return factor


SceneAndDensity = tuple[ReducedScene, Density]
"""Scene in reduced units, and the effects of its density."""


COOLING_RATE = {d: 9 / 5 / d * 2**0.2 * C1 * gamma(2.1) for d in (2, 3)}
"""Initial cooling rate ``tau_c(0) / (tau_0 delta)`` by dimension: 0.83193 in 3D; Eq. (39)."""

COOLING_CORRECTION = 33 / 20 * 2**0.2 * C1 * gamma(2.2) / gamma(2.1)
"""q, the ratio b_2/b_1 of the two terms of the cooling rate at T_0 and delta = 1: 2.3018."""


class Equations(NamedTuple):
    """Choice of the equations of a gas.

    Attributes:
        dimension: d.
        order: of the Sonine expansion: 2 has a_2, 3 also a_3.
        maxwellian: if True, a_2 stays 0.
        initial_sonine: a_2 at t = 0.
        gaussian_spins: if True, a_11 and a_02 stay 0.
        spreading: whether D and <dr^2> are asked for.
        sizes: whether the spheres differ in size.
    """

    dimension: int
    order: int
    maxwellian: bool
    initial_sonine: float = 0.0
    gaussian_spins: bool = False
    spreading: bool = True
    sizes: bool = False

    @property
    def names(self) -> list[str]:
        """Names of the `Moments`, without those of spins."""
        names = list(Moments._fields[: 5 if self.spreading else 3])
        if self.order > 2:
            names += ["third_sonine"] + (["diffusion_shape"] if self.spreading else [])
        if self.sizes:
            names.append("size_ratio")
        return names

    @property
    def controlling(self) -> Any:
        """Index of the moments whose errors control the steps; all others follow them."""
        if self.sizes:
            return np.array([0, 1, 2, self.names.index("size_ratio")])
        return slice(5 if self.spreading else 3)

    def moments(self, values: Float[Array, "moments ..."]) -> Moments:
        """Return the moments held by the rows of an array."""
        names = [*self.names, *Moments._fields[7:10]]
        return Moments(**dict(zip(names, values, strict=False)))

    def initial(self, scene: SceneAndDensity, like: Array) -> Float[Array, "moments"]:
        """Return the `Moments` at t = 0 as one array, of the dtype of `like`."""
        start = [jnp.zeros((), like.dtype)] * len(self.names)
        start[1] += self.initial_sonine
        if scene[0].surface is not None:
            spins = Spins.gaussian(scene[0].surface.ratio.astype(like.dtype))
            start += spins[: 1 if self.gaussian_spins else 3]
        return jnp.stack(start)

    def table(self, scene: SceneAndDensity, duration: Array) -> RateTable:
        """Return the averages at all temperatures that the gas reaches in a time."""
        law, d = scene[0].law, self.dimension
        averages = partial(
            impact_moments, law, dimension=d, order=self.order, relaxation=self.spreading
        )
        ends = log_temperature_range(law, duration, d, element_bounds(scene[0], d))
        return RateTable.from_function(averages, *ends, law.num_nodes)

    def derivative(
        self,
        state: Float[Array, "moments"],
        rates: Float[Array, "rows terms"],
        scene: SceneAndDensity,
    ) -> Float[Array, "moments"]:
        """Return the time derivative of the moments.

        Args:
            state: the `Moments` as one array.
            rates: from `jaxgran.theory.averages.impact_moments` at this temperature.
            scene: the gas.
        """
        moments = self.moments(state)
        d = self.dimension
        order = self.order
        gas, density = scene
        a2, speed = moments.sonine, jnp.exp(moments.log_temperature / 2)
        zero = jnp.zeros_like(speed)
        a3 = zero if moments.third_sonine is None else moments.third_sonine
        # The losses mu_2, mu_4, ..., and the matrix nu_jk row by row.
        values = rates @ jnp.stack([a2**i * a3**j for i, j in zip(*TERMS[order], strict=True)])
        losses = values[:order] * speed
        impacts = 2 / d * losses[0]
        a2_rate = 2 * impacts * (1 + a2) - 4 / (d * (d + 2)) * losses[1]
        a3_rate = shape_decay = zero
        if order > 2:
            sixth = 8 / (d * (d + 2) * (d + 4)) * losses[2]
            a3_rate = 3 * a2_rate - 3 * impacts * (1 + 3 * a2 - a3) + sixth
        inelasticity = rates[0, 0] * 2 * sqrt(2 * pi) / sphere_surface(d)  # <1 - eps^2>
        factor = density.factor(gas.law, speed, inelasticity, moments.collisions, d)
        cooling = impacts * factor
        relaxing = zero
        rotating = []
        if gas.has_elements:
            changes = element_rates(gas, speed, moments.spins, a2, d, self.gaussian_spins)
            cooling, relaxing = cooling + changes.cooling, changes.relaxation
            a2_rate = a2_rate + changes.sonine
            if gas.drive is not None:
                shape_decay = gas.drive / speed**2
                a3_rate = a3_rate - 3 * shape_decay * a3
            if (spins := moments.spins) is not None:  # over powers of T, which falls
                growth = zip(changes.spins, spins, (1, 1, 2), strict=True)
                rotating = [change + power * cooling * x for change, x, power in growth]
                rotating = rotating[: 1 if self.gaussian_spins else 3]
        colliding = collision_rate(a2, d, a3) * speed
        exchanging = []
        if gas.sizes is not None:
            assert moments.size_ratio is not None
            of_sizes = size_rates(gas, speed, moments.size_ratio, a2, d)
            cooling = cooling - factor * of_sizes.impacts - of_sizes.drag
            colliding = colliding * of_sizes.collisions
            exchanging = [of_sizes.ratio]
        # Of the terms that cool the gas, only impacts change the shape of the velocity
        # distribution.
        rate = [
            -cooling,
            zero if self.maxwellian else a2_rate,
            colliding,
        ]
        third = [] if order == 2 else [a3_rate]
        if self.spreading:
            assert moments.diffusion is not None
            relaxation = values[order:].reshape(order - 1, -1)
            diffusing = _diffusion_rates(moments, a3, relaxation, impacts, shape_decay, d)
            net_growth = cooling / 2 - relaxing
            diffusion, *shape = [change + net_growth * q for change, q in diffusing]
            rate += [diffusion, 2 * d * speed * moments.diffusion]
            third += shape
        return jnp.stack(rate + third + exchanging + rotating)


def _diffusion_rates(
    moments: Moments, a3: Array, relaxation: Array, impacts: Array, shape_decay: Array, d: int
) -> list[tuple[Array, Array]]:
    """Rates of change of the diffusion moments, without the growth that cooling adds to all, each
    with its moment.

    The mean displacement of labelled spheres at velocity c is ``f(c) c (b_0 + b_1 S_1(c^2))``. Its
    moments ``q_j = <S_j c.dr>/d = sum_k n_jk b_k/2`` with ``n_00 = 1``, ``n_01 = -(h + 1) a_2``,
    ``n_11 = (h + 1) (1 + (h + 4) a_2 - (h + 2) a_3)`` and h = d/2 obey
    ``dq_j/dt = n_j0/2 - sum_k nu_jk b_k/2 + zeta (j q_j - j (j + h) q_(j-1)) + zeta/2 q_j`` with
    the cooling rate zeta. The last term is the growth by cooling.
    """
    half, a2, speed = d / 2, moments.sonine, jnp.exp(moments.log_temperature / 2)
    assert moments.diffusion is not None
    if moments.diffusion_shape is None:
        return [(speed / 2 - relaxation[0, 0] * speed * moments.diffusion, moments.diffusion)]
    q0, q1 = moments.diffusion, moments.diffusion_shape
    mixed = -(half + 1) * a2
    square = (half + 1) * (1 + (half + 4) * a2 - (half + 2) * a3)
    b1 = (q1 - mixed * q0) / (square - mixed**2)
    b0 = q0 - mixed * b1  # half of b_0 and b_1 above
    first = speed * (0.5 - relaxation[0, 0] * b0 - relaxation[0, 1] * b1)
    second = speed * (mixed / 2 - relaxation[1, 0] * b0 - relaxation[1, 1] * b1)
    coupling = impacts * (q1 - (half + 1) * q0) - shape_decay * q1
    return [(first, q0), (second + coupling, q1)]


class SizeRates(NamedTuple):
    """What unequal sizes add to the rates of change of a gas of equal spheres.

    Attributes:
        impacts: d ln T/dt by impacts, minus that of equal spheres.
        drag: the same by drag.
        ratio: dq/dt.
        collisions: number of collisions over that of equal spheres.
    """

    impacts: Float[Array, ""]
    drag: Float[Array, ""]
    ratio: Float[Array, ""]
    collisions: Float[Array, ""]


def size_rates(
    scene: ReducedScene,
    speed: Float[Array, ""],
    ratio: Float[Array, ""],
    sonine: Float[Array, ""],
    d: int,
) -> SizeRates:
    """Return what unequal sizes add to the rates of change of a gas of equal spheres.

    Args:
        scene: in reduced units.
        speed: sqrt(T/T_0).
        ratio: q, see `jaxgran.theory.sizes`.
        sonine: a_2.
        d: dimension.
    """
    pairs = pair_rates(scene.sizes, speed, ratio, sonine, d)
    of_T, of_ratio = variable_changes(ratio, d) @ pairs.changes
    of_drag = jnp.zeros_like(of_T)
    if scene.drag is not None:
        drag = 2 * scene.drag.rate * drag_factors(scene.sizes)
        of_drag = 2 * scene.drag.rate - jnp.mean(drag * partial_temperatures(ratio))
        of_ratio = of_ratio - drag[0] + drag[1]
    return SizeRates(
        impacts=of_T - equal_rates(scene.law, speed, sonine, d),
        drag=of_drag,
        ratio=of_ratio,
        collisions=pairs.impacts / (collision_rate(0.0, d) / 2 * speed),
    )


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
    if (surface := scene.surface) is not None:
        kick = mean_kick(scene.law, speed)
        changes = rough_impact_rates(
            surface, surface.eta, kick, spins, sonine, dimension, gaussian=gaussian_spins
        )
        # The means over spins that are not Gaussian contain the effect of a_2.
        rate = collision_rate(sonine if gaussian_spins else 0.0, dimension) * speed
        parts.append(jax.tree.map(lambda change: rate * change, changes))
    if scene.walls is not None:
        on_walls = _wall_rates(scene.walls, surface, speed, spins, sonine, dimension)
        parts.append(on_walls)
    if (drag := scene.drag) is not None:
        parts.append(ElementRates(2 * drag.rate, spins.damped(2 * drag.rotational_rate), drag.rate))
    if scene.drive is not None:
        heating = scene.drive / speed**2
        heated = Spins(zero, -heating * spins.correlation, zero)
        parts.append(ElementRates(-heating, heated, sonine=-2 * sonine * heating))
    return jax.tree.map(lambda *rates: sum(rates), *parts)


TYPICAL_IMPACT = 2 * sqrt(2 / pi)
"""Mean normal speed of impacts, weighted by itself, in units of sqrt(2 T)."""


def mean_kick(law: ReducedLaw, speed: Float[Array, "*points"]) -> Float[Array, "*points"]:
    """Return (1 + eps)/2 at the typical impact; within 2 % for sliding spheres of ice."""
    return (1 + law.restitution(TYPICAL_IMPACT * speed)) / 2


MAX_STICKING = 1e6
"""Largest friction over the slip at which some spheres slide in double precision."""

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
"""Steps in T and a, and weights of the differences d_TT, d_Ta, d_aa and d_Taa."""


def coulomb_limit(
    surface: ReducedRough, eta: Array, kick: Array, variance: Array
) -> Float[Array, "..."] | None:
    """Return m of `slip_moments`, ``mu (1 + eps)/2 / (eta sqrt(V/S))``; None without friction.

    Args:
        surface: in reduced units.
        eta: coefficient of `Rough`.
        kick: (1 + eps)/2, see `mean_kick`.
        variance: V/S, of a component of the slip over one of the relative velocity.
    """
    if surface.friction is None:
        return None
    slip = jnp.sqrt(variance) * jnp.maximum(eta, 1e-9)
    return jnp.minimum(surface.friction * kick / slip, MAX_STICKING)


def rough_impact_rates(
    surface: ReducedRough,
    eta: Float[Array, ""],
    kick: Float[Array, ""],
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
    s = (sigma/2) w, so that means are those of `rough_impact_means` and their derivatives, here by
    differences. Products of cumulants of two spheres are left out, and directions of v and s are
    taken to be independent.

    Spheres stick where eta times the slip is below mu times the normal kick ``(1 + eps)/2 g``.

    References: Huthmann & Zippelius, Phys. Rev. E 56, R6275 (1997), for Gaussian spins; Santos,
    Kremer & dos Santos, Phys. Fluids 23, 030604 (2011), for cumulants, named as there, of spheres
    that do not slide.

    Args:
        surface: in reduced units.
        eta: coefficient of `Rough`.
        kick: (1 + eps)/2, see `mean_kick`.
        spins: moments of the spins.
        sonine: a_2.
        d: dimension.
        gaussian: take v and s to be Gaussian.
    """
    q, num_spins = surface.inertia, NUM_SPIN_COMPONENTS[d]
    a, correlation, kurtosis = spins.rotation / q, spins.correlation / q, spins.kurtosis / q**2
    # A pair of spheres at each step of the first: sums over both.
    stencil = jnp.asarray(_STENCIL[:, :, : 1 if gaussian else None], a.dtype)
    step_T, step_a, of_TT, of_Ta, of_aa, of_Taa = stencil
    size_T, size_a = 2 * _STEP, 2 * _STEP * (1 + a)
    T1, a1 = 1 + size_T * step_T, a + size_a * step_a
    T, of_spin = (jnp.concatenate([x, jnp.full_like(x, y)]) for x, y in ((T1, 1.0), (a1, a)))
    S = 1 + T1
    V = 1 + T1 + a + a1
    m = coulomb_limit(surface, eta, kick, V / S)
    means = rough_impact_means(T, of_spin, S, V, m, kick, eta, q, d, gaussian)
    weights = jnp.zeros_like(T1).at[0, 0].set(0.5)
    if not gaussian:
        weights += sonine / (2 * size_T**2) * of_TT + correlation / (size_T * size_a) * of_Ta
        weights += kurtosis / (2 * size_a**2) * of_aa
        third = A12 * correlation * kurtosis * a / jnp.maximum(a**2, 1e-12)
        weights += third / (2 * size_T * size_a**2) * of_Taa
    of_v, by_normal, slipping, of_s, *of_cumulants = (jnp.sum(x * weights) for x in means)
    spinning = of_s / num_spins
    turned = spreading = jnp.zeros_like(of_s)
    if not gaussian:
        of_vs, of_ss = of_cumulants
        cooling = -(of_v + by_normal) / d
        turned = of_vs / (d * num_spins) - spinning + (a + correlation) * cooling
        spreading = of_ss / (num_spins * (num_spins + 2)) - 2 * a * spinning
    return ElementRates(-of_v / d, Spins(q * spinning, q * turned, q**2 * spreading), slipping / d)


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
    Z impacts by ``(4/d) Z (1 - eps^2) (a_2 - (2 eps^2 - 1)/(d + 2))``. A mean power k of the speeds
    is that of a Maxwellian gas times ``1 + k (k - 2) a_2/8``.
    Friction at a wall takes from one sphere what friction between two spheres takes from both, each
    of which has half of the mean squared relative velocity. So walls count as twice as many impacts
    between spheres, with half the eta of a wall. Walls reverse velocities: displacements are not
    those of a free gas.
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
        kick = mean_kick(walls.law, speed / sqrt(2))
        changes = rough_impact_rates(surface, eta, kick, spins, sonine, d, gaussian=True)
        impacts = 2 * frequency * impact_average(share, speed)
        changes = jax.tree.map(lambda change: impacts * change, changes)
        return changes._replace(cooling=cooling + changes.cooling, sonine=a2_rate)

    by_axis = jax.vmap(axis_rates)(walls.frequency)
    return jax.tree.map(lambda x: speed * jnp.sum(x), by_axis)


MAX_SPEED_FACTOR = 1.2
"""Bound of ``1 + 3 a_2/8``, the factor of losses at walls."""


def element_bounds(scene: ReducedScene, dimension: int) -> ElementBounds:
    """Return upper bounds of the cooling and the heating by the elements of a scene.

    The bound of the cooling is that of spheres that do not rotate and that stop at walls. The
    rotation heats at most by the initial energy of the spins.

    Returns:
        the part of ``-d ln T/dt`` over sqrt(T/T_0); its part that does not depend on T; d(T/T_0)/dt
        by a drive, None where nothing heats; T/T_0 that a gas could gain from the spins, None for
        smooth spheres.
    """
    by_speed, constant, heating, rotation = 0.0, 0.0, None, None
    surface, walls, d, rate = scene.surface, scene.walls, dimension, collision_rate(0.0, dimension)

    def friction(surface: ReducedRough, eta: Array, rate: Array) -> Array:
        return rate * 2 * (d - 1) / d * (eta - eta**2)

    if surface is not None:
        by_speed = by_speed + friction(surface, surface.eta, rate)
        heating, rotation = jnp.zeros(()), NUM_SPIN_COMPONENTS[d] / d * surface.ratio
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
        # Impacts at most twice as fast, and all energy that of the small spheres.
        one = jnp.ones_like(scene.sizes.spread)
        by_speed = by_speed - equal_rates(scene.law, one, 0.0, d)
        small, large = scene.sizes.masses
        heating, rotation = jnp.zeros(()), (large - small) / (2 * small)
        if scene.drag is not None:
            constant = constant * drag_factors(scene.sizes)[0]
    if scene.drive is not None:
        heating = scene.drive
    return by_speed, constant, heating, rotation


MAX_WAVENUMBER = {2: (0.181, 3.10), 3: (0.926, 2.19)}
"""a, b of ``K sigma = a + b phi``, the largest wavenumber that is counted, by dimension.

Fitted to ``experiments/accuracy/measure_correlations.py``: hard spheres of eps = .7 and .9 at phi =
.05 to .3. With two numbers chi^2 is 7 (2D) and 10 (3D) for nine gases. Errors: 2D .05, .24; 3D .07,
.32. With --full gases of eps = .95, to which nothing was fitted, agree in 3D, but those of eps =
.8 and phi >= .2 cool up to 1 % faster than this predicts, and disks of phi >= .2 up to 2 %.
"""

MIN_WAVENUMBER = 2.0
"""Smallest wavenumber that is counted, over k_c. Longer waves depend on the box, see
`jaxgran.models.error_model`.
"""

WAVE_SUM_OFFSET = MIN_WAVENUMBER + log((MIN_WAVENUMBER - 1) / (MIN_WAVENUMBER + 1)) / 2
"""``MIN_WAVENUMBER - int_MIN_WAVENUMBER^inf (x^2/(x^2 - 1) - 1) dx``, subtracted from K/k_c."""

BUILD_UP_COLLISIONS = 4.0
"""N_0, collisions per particle in which correlations build up: 4 +- 2 in boxes below L_c/2."""


def correlation_slowdown(
    packing_fraction: Float[Array, ""], inelasticity: Float[Array, "*points"], dimension: int
) -> Float[Array, "*points"]:
    """Return the share by which velocity correlations, once built up, reduce the cooling rate.

    Spheres that have collided move more nearly in parallel than before, and some of them collide
    again: their normal speed is then lower than that of uncorrelated spheres. In modes of the flow:
    viscosity, and not impacts, cools a shear wave of wavenumber k > k_c. The wave holds
    ``1/((k/k_c)^2 - 1)`` of T above equipartition (`jaxgran.models.error_model`), and this energy
    takes no part in impacts. All waves shorter than L_c/2 reduce the rate by the share
    ``(3/2) (d - 1)/(d n) int d^dk/(2 pi)^d 1/((k/k_c)^2 - 1)``, with k from 2 k_c.

    The shortest waves are not waves of a fluid. Of the leading term k_c^2/k^2, to which they
    contribute at any small I in proportion to it, as much is counted as a fluid would have up to
    K (`MAX_WAVENUMBER`). The sum is ``k_c^2 (K - 1.451 k_c)/(2 pi^2 n)`` in 3D and
    ``3 k_c^2 ln(K^2/(3 k_c^2))/(16 pi n)`` in 2D, at least 0. An elastic gas has none of it: its
    collision rate is Enskog's, which the virial series exceeds by .4 % at phi = .3.

    Reference: Kawahara & Nakanishi, J. Phys. Soc. Jpn. 73 (2004) 68. In three-dimensional hard
    spheres they measured an energy decay slower than that of independent collisions from the early
    stage on, and explained it by velocity correlations.

    Args:
        packing_fraction: phi.
        inelasticity: I = <1 - eps^2>, weighted by the energy of the normal motion.
        dimension: d.
    """
    phi = packing_fraction
    a, b = MAX_WAVENUMBER[dimension]
    n = phi * dimension * 2**dimension / sphere_surface(dimension)  # per diameter^d
    unit, shortest = scaled_critical_wavenumber(phi, dimension), a + b * phi
    # Without this bound the root would have no derivative for elastic spheres.
    critical = unit * jnp.sqrt(jnp.maximum(inelasticity, 1e-12))
    if dimension == 3:
        waves = jnp.maximum(shortest - WAVE_SUM_OFFSET * critical, 0.0) / (2 * pi**2)
    else:
        x = shortest / critical
        waves = 3 * jnp.log(jnp.maximum(x**2 / (MIN_WAVENUMBER**2 - 1), 1.0)) / (16 * pi)
    return unit**2 * inelasticity / n * waves


def correlation_build_up(collisions: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return ``1 - exp(-N/N_0)``, the share that has built up after N collisions per particle."""
    return -jnp.expm1(-collisions / BUILD_UP_COLLISIONS)


MEAN_OVERLAP = 0.4**-0.4 / gamma(0.6)
"""``<xi sqrt(xi)>/<sqrt(xi)>`` over exp(-(2/5) xi^(5/2)), in X_T: mean overlap where energy is
lost.
"""

DIAMETER_REDUCTION = 0.4**-0.4 * gamma(1.4)
"""``int_0^inf exp(-(2/5) xi^(5/2)) dxi``, in X_T: sigma less the diameter of the hard spheres that
exclude the same volume (Barker & Henderson).
"""

# c(beta)/(d - 1) over `MEAN_OVERLAP`, fitted by experiments/accuracy/derive_coefficients.py.
_NUMERATOR = (1.24185842, 0.02178437)

_DENOMINATOR = (1.75563384, 0.33641322)


def softness_coefficient(beta: Float[Array, "..."], dimension: int) -> Float[Array, "..."]:
    """Return c(beta) in ``1 - c X_T/sigma``, by which soft spheres lose less energy than hard ones.

    During a contact the tangential velocity w of two spheres carries them around each other: the
    centrifugal acceleration w^2/sigma shortens the contact and reduces the overlap. To first order
    ``c = -(d - 1) int g^(9/5) e^(-g^2/2) l'(beta g^(1/5)) dg / int g^3 e^(-g^2/2) l(beta g^(1/5))
    dg`` with the loss l = 1 - eps^2 of a head-on impact and its derivative l' in an outward
    acceleration, in units of v^2/X. ``X_T = (v^2/alpha)^(2/5)`` at the speed v = sqrt(2 T) is the
    length scale of the overlap. As beta -> 0, ``c = .96878 (d - 1)``, the mean overlap at which
    energy is lost.

    Args:
        beta: of an impact at the speed sqrt(2 T), >= 0, any shape.
        dimension: d.

    Returns:
        c, same shape; in 3D 1.938, 1.847, 1.711, 1.607, 1.418 at beta = 0, .1, .3, .5, 1. The
        error of the fit is below 5e-4 for beta <= 8.
    """
    (p, p2), (q, q2) = _NUMERATOR, _DENOMINATOR
    fitted = (1 + beta * (p + p2 * beta)) / (1 + beta * (q + q2 * beta))
    return (dimension - 1) * MEAN_OVERLAP * fitted


def softness_factor(
    law: ReducedLaw, speed: Float[Array, "*points"], dimension: int
) -> Float[Array, "*points"]:
    """Return ``1 - c X_T/sigma``, the factor of the cooling rate by the softness of two spheres.

    Args:
        law: law of restitution in units of the diameter and of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d.
    """
    return 1 - softness_coefficient(law.dissipation(speed), dimension) * law.impact_length(speed)


def is_soft(law: ReducedLaw) -> bool:
    """Return True if contacts of this law overlap."""
    return type(law).impact_length is not ReducedLaw.impact_length


def crowding_coefficient(gas: Gas) -> Float[Array, ""]:
    """Return k in ``1/(1 + k X_T/sigma)``, the effect of soft contacts that needs finite density.

    As beta -> 0, velocities are independent of positions, and the loss is that of the equilibrium
    fluid: proportional to ``int sqrt(xi) exp(-U/T) y(sigma - xi) dxi`` with the cavity function y
    of spheres whose excluded diameter is smaller by ``1.280 X_T``. In addition, contacts hold the
    energy ``U/K = (2/(5 d)) nu t_c``, which is proportional to T^(2/5) and is lost along with T:
    ``k = 1.280 d ln g_2/d ln sigma + (1.280 - .969) s + (7/5) (2/(5 d)) nu t_c sigma/X_T`` with the
    slope ``s = -d ln g/d ln r`` of the pair correlation at contact. It is 0 for a dilute gas.

    Args:
        gas: the scene.

    Returns:
        k; in 3D .91, 1.99, 4.8 at phi = .05, .1, .2.
    """
    d = gas.dimension
    by_diameter, by_distance = contact_value_slopes(gas.packing_fraction, d)
    collision_rate_over_speed = sphere_surface(d) / sqrt(2 * pi) * gas.diameter / gas.path_length
    stored = 1.4 * 0.4 / d * ELASTIC_CONTACT_TIME * 2**-0.1 * gamma(0.9) * collision_rate_over_speed
    return (
        DIAMETER_REDUCTION * by_diameter
        + (DIAMETER_REDUCTION - MEAN_OVERLAP) * by_distance
        + stored
    )


MAX_IMBALANCE = 1e-3
"""Relative difference of losses and drive above which a state is not steady."""

MAX_LOG_TEMPERATURE = 60.0
"""Largest |ln T/T_0| of a steady state."""


class SteadyState(NamedTuple):
    """Steady state of a driven gas.

    Attributes:
        temperature: T, m^2/s^2.
        sonine: a_2.
        rotational_temperature: T_rot, m^2/s^2, of rough spheres; None for smooth spheres.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> jaxgran.steady_state(driven)._fields
    ('temperature', 'sonine', 'rotational_temperature')
    """

    temperature: Float[Array, ""]
    sonine: Float[Array, ""]
    rotational_temperature: Float[Array, ""] | None


def steady_state(gas: Gas) -> SteadyState:
    """Return the steady state of a driven gas by kinetic theory.

    ``dT/dt = da_2/dt = dT_rot/dt = 0``.

    In this state the white noise replaces the energy that impacts, walls and drag take. It does not
    depend on the initial temperature of the gas. Differentiable in every float of the gas.

    Args:
        gas: with a `jaxgran.WhiteNoise` drive.

    Returns:
        The state; nan under a transformation where no loss balances the drive.

    Raises:
        ValueError: for a gas without a drive, or a gas in which no loss balances the drive.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution and to
    first order in a_2; this solution also has terms of second order.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> round(float(jaxgran.steady_state(driven).temperature), 5)
    0.00128
    """
    if gas.drive is None:
        raise ValueError("a gas without drive has no steady state: add drive=WhiteNoise(strength)")
    log_theta, sonine, ratio, imbalance = _solve_steady(gas)
    is_steady = imbalance < MAX_IMBALANCE
    if not isinstance(is_steady, Tracer) and not is_steady:
        raise ValueError(
            "the losses balance the drive at no temperature. Give the gas a drive of strength > 0, "
            "and losses: a restitution below 1, or drag"
        )
    temperature = gas.temperature * jnp.exp(log_theta)
    rotational = None if gas.surface is None else ratio * temperature
    state = SteadyState(temperature, sonine, rotational)
    return jax.tree.map(lambda x: jnp.where(is_steady, x, jnp.nan), state)


@eqx.filter_jit
def _solve_steady(gas: Gas) -> tuple[Array, Array, Array, Array]:
    """ln T/T_0, a_2, T_rot/T, and the relative difference of losses and drive."""
    scene, density, d = reduced_scene(gas), Density.from_gas(gas), gas.dimension
    assert scene.drive is not None

    def balance(x: Array, scene: ReducedScene) -> Array:
        return _steady_rates(x, scene, density, d) / jnp.exp(x[0] / 2)

    start = _at_rest(_balance_log_temperature(scene, gas.temperature, d), scene)
    tolerance = jnp.finfo(start.dtype).eps ** 0.75
    solver = optx.Newton(rtol=float(tolerance), atol=float(tolerance))
    x = optx.root_find(balance, solver, start, scene, throw=False, max_steps=32).value
    heating = scene.drive / jnp.exp(1.5 * x[0])
    imbalance = jnp.abs(balance(x, scene)[0]) / heating
    ratio = jnp.zeros_like(x[0]) if scene.surface is None else x[3]
    return x[0], x[1], ratio, imbalance


def _balance_log_temperature(scene: ReducedScene, like: Array, d: int) -> Float[Array, ""]:
    """ln T/T_0 at which Maxwellian losses balance a drive, within +- `MAX_LOG_TEMPERATURE`.

    Spins are at rest: impacts of rough spheres then take most, and the temperature is too low.
    Softness is left out: its first order has no meaning in a gas that is far too hot.
    """

    def bisect(_, ends):
        middle = (ends[0] + ends[1]) / 2
        heats = _steady_rates(_at_rest(middle, scene), scene, Density(), d)[0] > 0
        return jnp.where(heats, middle, ends[0]), jnp.where(heats, ends[1], middle)

    bound = jnp.full((), MAX_LOG_TEMPERATURE, like.dtype)
    low, high = jax.lax.fori_loop(0, 40, bisect, (-bound, bound))
    return jax.lax.stop_gradient((low + high) / 2)


def max_thermal_speed(gas: Gas) -> Float[Array, ""]:
    """Return sqrt(T/T_0) of the steady state of a driven gas that heats up, and otherwise 1.

    It is 1 if the gas cools, and if no loss balances the drive. That of rough spheres is the one
    without spins, which is lower.
    """
    log_theta = _balance_log_temperature(reduced_scene(gas), gas.temperature, gas.dimension)
    return jnp.where(
        (log_theta > 0) & (log_theta < 0.99 * MAX_LOG_TEMPERATURE), jnp.exp(log_theta / 2), 1.0
    )


def _at_rest(log_theta: Array, scene: ReducedScene) -> Float[Array, "variables"]:
    """Variables of `_steady_rates` of a Maxwellian gas without spins."""
    return jnp.zeros(3 if scene.surface is None else 6, log_theta.dtype).at[0].set(log_theta)


def _steady_rates(
    x: Float[Array, "variables"], scene: ReducedScene, density: Density, d: int
) -> Float[Array, "variables"]:
    """Rates of change of ln T, a_2, a_3 and the spins where all correlations have built up."""
    zero = jnp.zeros_like(x[:1])
    moments = jnp.concatenate([x[:2], zero + jnp.inf, x[2:]])
    equations = Equations(d, 3, maxwellian=False, spreading=False)
    rates = impact_moments(scene.law, jnp.exp(x[0] / 2), d, 3, relaxation=False)
    change = equations.derivative(moments, rates, (scene, density))
    # Spins of smooth spheres, beta_t = -1, do not change: they are 0.
    return jnp.concatenate([change[:2], change[3:4], change[4:] - 1e-30 * x[3:]])
