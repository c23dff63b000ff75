"""The differential equations of the homogeneous gas: T, a_2, a_3, D, <dr^2>, collisions, T_rot.

Units as in `jaxgran.theory.averages`.

Closed forms: Haff's law, and the paper's results for viscoelastic spheres with corrections.

Times are in units of the initial mean free time, tau = nu_0 t, temperatures in units of T_0. The
paper is Brilliantov & Poeschel, Self-diffusion in granular gases; its equations are numbered as in
the authors' preprint.

Velocity correlations of dissipating hard spheres, which Enskog's theory leaves out.

What the elements of a scene do to a homogeneous gas: roughness, walls, drag, a drive.

Units as in `jaxgran.theory.averages`.

What contacts of finite duration and overlap do to the cooling rate, to first order in X_T/sigma.

``X_T = (v^2/alpha)^(2/5)`` at the speed v = sqrt(2 T) is the length scale of the overlap.

Steady states of gases that white noise drives, and the states in which it leaves them.

Units as in `jaxgran.theory.averages`, where not of a gas.

The equations of a homogeneous gas to a given order, ready to be integrated.

Units as in `jaxgran.theory.averages`.
"""

from collections.abc import Callable
from functools import partial
from math import gamma, log, pi, sqrt
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxgran.scene.contact import ELASTIC_CONTACT_TIME
from jaxgran.scene.elements import MOST_IMPACTS, NUM_SPIN_COMPONENTS, share_of_impacts
from jaxgran.scene.gas import Gas, unit_wavenumber
from jaxgran.scene.geometry import contact_value_slopes, impact_average, sphere_surface
from jaxgran.scene.laws import C1, ReducedLaw, ReducedViscoelastic
from jaxgran.scene.reduced import ReducedRough, ReducedScene, ReducedWalls, reduced_scene
from jaxgran.theory import averages
from jaxgran.theory.averages import TERMS, Bounds, RateTable, collision_rate, impact_moments


def speed_moment(power: float) -> float:
    """``int_0^inf g^(1 + power) exp(-g^2/2) dg``."""
    return 2 ** (power / 2) * gamma(1 + power / 2)


COOLING_RATE = {d: 9 / 5 / d * 2**0.2 * C1 * gamma(2.1) for d in (2, 3)}
"""``tau_c(0) / (tau_0 delta)`` by dimension, the initial cooling rate: 0.83193 in 3D; Eq. (39)."""

COOLING_CORRECTION = 33 / 20 * 2**0.2 * C1 * gamma(2.2) / gamma(2.1)
"""q, the second term of the cooling rate over the first at T_0 and delta = 1, b_2/b_1: 2.3018."""


def paper_averages(
    law: ReducedLaw, speed: Float[Array, ""], dimension: int, order: int = 2
) -> Float[Array, "3 3"]:
    """The paper's truncated averages: Maxwellian velocities, two terms of the restitution series.

    ``dT/dt = -b_1 T^(8/5) + b_2 T^(17/10)``, and ``1/tau_v`` to order delta^2.

    Args:
        law: a `Viscoelastic` law in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d; the paper has 3.
        order: 2 alone.

    Returns:
        As `jaxgran.theory.averages.averages`; the rows are mu_2, 0 and nu_v, and only the first
        column is not 0.

    Raises:
        ValueError: for another law.

    Reference: Brilliantov & Poeschel, Eqs. (32) and (36).
    """
    if not isinstance(law, ReducedViscoelastic):
        raise ValueError(
            f"the paper's truncated averages need the Viscoelastic law, got {type(law).__name__}; "
            "use the exact averages for other laws"
        )
    beta = law.beta * speed**0.2
    cooling = C1 * beta * speed_moment(2.2) - 11 / 10 * C1**2 * beta**2 * speed_moment(2.4)
    slowing = (
        2 * speed_moment(2.0)
        - C1 * speed_moment(2.2) * beta
        + 3 / 5 * C1**2 * speed_moment(2.4) * beta**2
    )
    column = jnp.stack([cooling, jnp.zeros_like(beta), slowing / dimension])
    maxwellian = jnp.asarray([1.0, 0.0, 0.0], beta.dtype)
    return sphere_surface(dimension) / sqrt(8 * pi) * jnp.outer(column, maxwellian)


SHORTEST = {2: (0.181, 3.10), 3: (0.926, 2.19)}
"""a, b of ``K sigma = a + b phi``, up to which waves count, by dimension.

Fitted to ``experiments/accuracy/measure_correlations.py``: hard spheres of eps = .7 and .9 at phi =
.05 to .3. With two numbers chi^2 is 7 (2D) and 10 (3D) of nine gases. Errors: 2D .05, .24; 3D .07,
.32. With --full gases of eps = .95, to which nothing was fitted, agree in 3D, but those of eps =
.8 and phi >= .2 cool up to 1 % faster than this says, and disks of phi >= .2 up to 2 %.
"""

BUILD_UP = 4.0
"""Collisions per particle in which the correlations arise: 4 +- 2 in boxes below L_c/2."""

LONGEST = 2.0
"""Least wavenumber that is counted, over k_c; longer waves belong to the box, see
`jaxgran.models.error_model`."""

TAIL = LONGEST + log((LONGEST - 1) / (LONGEST + 1)) / 2
"""``LONGEST - int_LONGEST^inf (x^2/(x^2 - 1) - 1) dx``, what is missing of K/k_c."""


def slowing(
    packing_fraction: Float[Array, ""], inelasticity: Float[Array, ""], dimension: int
) -> Float[Array, ""]:
    """Share of the cooling rate that velocity correlations take, once they have arisen.

    Spheres that have met move more in parallel than before, and some of them meet again: their
    normal speed is then lower than that of strangers. In modes of the flow: a shear wave of
    wavenumber k > k_c is cooled by viscosity and not by impacts, and holds ``1/((k/k_c)^2 - 1)`` of
    T above equipartition (`jaxgran.models.error_model`), which takes no part in impacts. All waves
    shorter than L_c/2 take ``(3/2) (d - 1)/(d n) int d^dk/(2 pi)^d 1/((k/k_c)^2 - 1)`` of the rate,
    from 2 k_c on. Short waves are no waves of a fluid: of the leading term k_c^2/k^2, which they
    make with any small I in proportion to it, as much is counted as a fluid would have up to K.
    That is ``k_c^2 (K - 1.451 k_c)/(2 pi^2 n)`` in 3D and ``3 k_c^2 ln(K^2/(3 k_c^2))/(16 pi n)``
    in 2D, at least 0. An elastic gas has none of it: its collision rate is Enskog's but for .4 % at
    phi = .3, by which the virial series exceeds it.

    Reference: Kawahara & Nakanishi, J. Phys. Soc. Jpn. 73 (2004) 68, who found in three-dimensional
    hard spheres an energy decay slower than that of independent collisions from the early stage on,
    and velocity correlations as its reason.

    Args:
        packing_fraction: phi.
        inelasticity: I = <1 - eps^2>, weighted by the energy of the normal motion.
        dimension: d.
    """
    phi = packing_fraction
    a, b = SHORTEST[dimension]
    n = phi * dimension * 2**dimension / sphere_surface(dimension)  # in one diameter^d
    unit, shortest = unit_wavenumber(phi, dimension), a + b * phi
    # Elastic spheres: without the bound the root had no derivative.
    critical = unit * jnp.sqrt(jnp.maximum(inelasticity, 1e-12))
    if dimension == 3:
        taken = jnp.maximum(shortest - TAIL * critical, 0.0) / (2 * pi**2)
    else:
        x = shortest / critical
        taken = 3 * jnp.log(jnp.maximum(x**2 / (LONGEST**2 - 1), 1.0)) / (16 * pi)
    return unit**2 * inelasticity / n * taken


def built_up(collisions: Float[Array, "..."]) -> Float[Array, "..."]:
    """``1 - exp(-N/N_0)`` after N collisions per particle."""
    return -jnp.expm1(-collisions / BUILD_UP)


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


def element_rates(
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
        rotation=-strength
        / NUM_SPIN_COMPONENTS[d]
        * eta
        / inertia
        * ((1 - eta / inertia) * ratio - eta),
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
        rotation = NUM_SPIN_COMPONENTS[dimension] / dimension * scene.surface.ratio
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


MEAN_OVERLAP = 0.4**-0.4 / gamma(0.6)
"""``<xi sqrt(xi)>/<sqrt(xi)>`` over exp(-(2/5) xi^(5/2)), in X_T: where a contact loses energy."""

EXCLUDED = 0.4**-0.4 * gamma(1.4)
"""``int_0^inf exp(-(2/5) xi^(5/2)) dxi``, in X_T: by so much is the diameter of hard spheres that
exclude the same volume smaller than sigma (Barker & Henderson)."""

# c(beta)/(d - 1) over `MEAN_OVERLAP`, fitted by experiments/accuracy/derive_softness.py.
_NUMERATOR = (1.24185842, 0.02178437)
_DENOMINATOR = (1.75563384, 0.33641322)


def softness(beta: Float[Array, "..."], dimension: int) -> Float[Array, "..."]:
    """c(beta) in ``1 - c X_T/sigma``, by which two soft spheres lose less than hard ones.

    While two spheres touch, their tangential velocity w carries them around each other: the
    centrifugal acceleration w^2/sigma shortens the contact and lessens the overlap. To first order
    ``c = -(d - 1) int g^(9/5) e^(-g^2/2) l'(beta g^(1/5)) dg / int g^3 e^(-g^2/2) l(beta g^(1/5))
    dg`` with the loss l = 1 - eps^2 of a head-on impact and its derivative l' in an outward
    acceleration, in units of v^2/X. As beta -> 0 ``c = .96878 (d - 1)``, the mean overlap where
    energy is lost.

    Args:
        beta: of an impact at the speed sqrt(2 T), >= 0, any shape.
        dimension: d.

    Returns:
        c, same shape; in 3D 1.938, 1.847, 1.711, 1.607, 1.418 at beta = 0, .1, .3, .5, 1. The
        fit is good to 5e-4 for beta <= 8.
    """
    (p, p2), (q, q2) = _NUMERATOR, _DENOMINATOR
    fitted = (1 + beta * (p + p2 * beta)) / (1 + beta * (q + q2 * beta))
    return (dimension - 1) * MEAN_OVERLAP * fitted


def crowding(gas: Gas) -> Float[Array, ""]:
    """k in ``1/(1 + k X_T/sigma)``: what else finite contacts do at finite density.

    As beta -> 0 velocities are independent of positions, and the loss is that of the equilibrium
    fluid: proportional to ``int sqrt(xi) exp(-U/T) y(sigma - xi) dxi`` with the cavity function y
    of spheres whose excluded diameter is smaller by ``1.280 X_T``. Besides, contacts hold the
    energy ``U/K = (2/(5 d)) nu t_c``, which goes as T^(2/5) and is lost along with T:
    ``k = 1.280 d ln g_2/d ln sigma + (1.280 - .969) s + (7/5) (2/(5 d)) nu t_c sigma/X_T`` with the
    slope ``s = -d ln g/d ln r`` of the pair correlation at contact. 0 for a dilute gas.

    Args:
        gas: the scene.

    Returns:
        k; in 3D .91, 1.99, 4.8 at phi = .05, .1, .2.
    """
    d = gas.dimension
    by_diameter, by_distance = contact_value_slopes(gas.packing_fraction, d)
    meeting = sphere_surface(d) / sqrt(2 * pi) * gas.diameter / gas.path_length
    held = 1.4 * 0.4 / d * ELASTIC_CONTACT_TIME * 2**-0.1 * gamma(0.9) * meeting
    return EXCLUDED * by_diameter + (EXCLUDED - MEAN_OVERLAP) * by_distance + held


def is_soft(law: ReducedLaw) -> bool:
    """Whether contacts of this law overlap."""
    return type(law).impact_length is not ReducedLaw.impact_length


def softness_factor(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, ""]:
    """Factor ``1 - c X_T/sigma`` by which soft contacts of two spheres reduce the cooling rate.

    Args:
        law: law of restitution in units of the diameter and of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d.
    """
    return 1 - softness(law.dissipation(speed), dimension) * law.impact_length(speed)


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
        crowding: k in ``1/(1 + k X_T/sigma)``, see `jaxgran.theory.equations.crowding`.
        packing_fraction: of correlated velocities, see `jaxgran.theory.equations.slowing`.
    """

    crowding: Float[Array, ""] | None = None
    packing_fraction: Float[Array, ""] | None = None

    @classmethod
    def of(cls, gas: Gas, softness: bool = True, correlations: bool = True) -> "Density":
        """The effects in a gas, unless left out."""
        soft = softness and is_soft(gas.reduced_law)
        return cls(crowding(gas) if soft else None, gas.packing_fraction if correlations else None)


def moment_rates(
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
        changes = element_rates(scene, speed, ratio, a2, d)
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


MAX_LOG_TEMPERATURE = 60.0
"""Largest |ln T/T_0| of a steady state."""

_NEWTON_STEPS = 8
"""From a_2 = 0 to a steady a_2, at most .1, to rounding."""


class SteadyState(NamedTuple):
    """The steady state of a driven gas.

    Attributes:
        temperature: T, m^2/s^2.
        sonine: a_2.
        rotational_temperature: T_rot, m^2/s^2, of rough spheres; None of smooth ones.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> jaxgran.steady_state(driven)._fields
    ('temperature', 'sonine', 'rotational_temperature')
    """

    temperature: Float[Array, ""]
    sonine: Float[Array, ""]
    rotational_temperature: Float[Array, ""] | None


def steady_state(gas: Gas) -> SteadyState:
    """Where a driven gas comes to rest: ``dT/dt = da_2/dt = dT_rot/dt = 0`` of kinetic theory.

    The white noise then returns what impacts, walls and drag take. It does not depend on the first
    temperature of the gas. Differentiable in every float of the gas.

    Args:
        gas: with a `jaxgran.WhiteNoise` drive.

    Raises:
        ValueError: for a gas without a drive, or one that nothing keeps from heating on and on.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution, whose
    first order in a_2 this exceeds by terms of second order.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> round(float(jaxgran.steady_state(driven).temperature), 5)
    0.00128
    """
    if gas.drive is None:
        raise ValueError("a gas without drive has no steady state: add drive=WhiteNoise(strength)")
    log_theta, sonine, ratio, residual = _solve_steady(gas)
    if not isinstance(residual, Tracer) and not float(residual) < 1e-3:
        raise ValueError(
            "no temperature is found at which losses balance the drive: elastic spheres without "
            "drag, or a strength of 0, have none"
        )
    temperature = gas.temperature * jnp.exp(log_theta)
    rotational = None if gas.surface is None else ratio * temperature
    return SteadyState(temperature, sonine, rotational)


@eqx.filter_jit
def _solve_steady(gas: Gas) -> tuple[Array, Array, Array, Array]:
    """ln T/T_0, a_2, T_rot/T, and by what share losses and drive differ."""
    scene, density, d = reduced_scene(gas), Density.of(gas), gas.dimension
    assert scene.drive is not None

    def balance(x: Array, scene: ReducedScene) -> Array:
        return _steady_rates(x, scene, density, d) / jnp.exp(x[0] / 2)

    low = _balanced(scene, gas.temperature, d)
    first = jnp.stack([low, jnp.zeros_like(low), jnp.zeros_like(low)])
    tolerance = jnp.finfo(first.dtype).eps ** 0.75
    solver = optx.Newton(rtol=float(tolerance), atol=float(tolerance))
    x = optx.root_find(balance, solver, first, scene, throw=False, max_steps=32).value
    heating = scene.drive.strength / jnp.exp(1.5 * x[0])
    off = jnp.abs(balance(x, scene)[0]) / heating
    return x[0], x[1], _steady_ratio(jnp.exp(x[0] / 2), x[1], scene, d), off


def _balanced(scene: ReducedScene, like: Array, d: int) -> Float[Array, ""]:
    """ln T/T_0 at which Maxwellian losses balance a drive, within +- `WIDEST`.

    Without softness, whose first order has no meaning in a gas that is far too hot.
    """

    def halved(_, ends):
        middle = (ends[0] + ends[1]) / 2
        maxwellian = jnp.stack([middle, jnp.zeros_like(middle)])
        heats = _steady_rates(maxwellian, scene, Density(), d, softness=False)[0] > 0
        return jnp.where(heats, middle, ends[0]), jnp.where(heats, ends[1], middle)

    widest = jnp.full((), MAX_LOG_TEMPERATURE, like.dtype)
    low, high = jax.lax.fori_loop(0, 40, halved, (-widest, widest))
    return jax.lax.stop_gradient((low + high) / 2)


def hottest_speed(gas: Gas) -> Float[Array, ""]:
    """sqrt(T/T_0) of the steady state of a driven gas, 1 if it cools, or if nothing balances."""
    found = _balanced(reduced_scene(gas), gas.temperature, gas.dimension)
    return jnp.where((found > 0) & (found < 0.99 * MAX_LOG_TEMPERATURE), jnp.exp(found / 2), 1.0)


def _steady_rates(
    x: Float[Array, "variables"],
    scene: ReducedScene,
    density: Density,
    d: int,
    softness: bool = True,
) -> Float[Array, "variables"]:
    """Rates of change of ln T, a_2 and, if it is among them, a_3, where T_rot/T is steady.

    So many collisions have been that all correlations have built up.
    """
    order = len(x)
    speed, zero = jnp.exp(x[0] / 2), jnp.zeros_like(x[0])
    rotation = None if scene.surface is None else _steady_ratio(speed, x[1], scene, d)
    named: dict[str, Array] = dict(
        zip(("log_temperature", "sonine", "third_sonine"), x, strict=False)
    )
    if order > 2:
        named["diffusion_shape"] = zero
    lasting = jnp.full_like(x[0], jnp.inf)
    at = Moments(**named, diffusion=zero, displacement=zero, collisions=lasting, rotation=rotation)
    state = jnp.stack([value for value in at if value is not None])
    rates = impact_moments(scene.law, speed, d, order)
    options = {"order": order, "softness": softness, "maxwellian": False}
    change = Moments.of(moment_rates(state, rates, scene, density, d, **options), order)
    return jnp.stack([getattr(change, name) for name in list(named)[:order]])


def _steady_ratio(speed: Array, sonine: Array, scene: ReducedScene, d: int) -> Array:
    """T_rot/T at which ``dT_rot/dt``, linear in it, is 0; 0 where surfaces are smooth."""
    if scene.surface is None:
        return jnp.zeros_like(speed)
    gain, both = (element_rates(scene, speed, r, sonine, d).rotation for r in (0.0, 1.0))
    loss = gain - both
    return jnp.where(loss > 0, gain / jnp.where(loss > 0, loss, 1.0), 0.0)


def scene_at_start(gas: Gas) -> ReducedScene:
    """The scene of a gas, with T_rot/T of a steady state where white noise has driven it at T_0.

    There is ``dT_rot/dt = 0`` by impacts, on walls too; drag begins at t = 0.
    """
    scene = reduced_scene(gas)
    if scene.prepared is None or scene.surface is None:
        return scene
    undriven, like = scene._replace(drive=None, drag=None), jnp.ones_like(gas.temperature)
    ratio = _steady_ratio(like, jnp.zeros_like(like), undriven, gas.dimension)
    return scene._replace(surface=scene.surface._replace(ratio=ratio))


def steady_moments(
    first: Float[Array, "moments"], scene: ReducedScene, density: Density, d: int, order: int
) -> Float[Array, "moments"]:
    """The moments at the start with a_2 (and a_3) of a gas that white noise has driven at T_0.

    The noise has returned what impacts and walls took.
    """
    undriven = scene._replace(drive=None, drag=None)

    def peaking(sonine: Array) -> Array:
        rate = _steady_rates(
            jnp.concatenate([jnp.zeros_like(sonine[:1]), sonine]), undriven, density, d
        )
        return rate[1:] + rate[0] * jnp.arange(2.0, order + 1, dtype=sonine.dtype) * sonine

    sonine = jnp.zeros(order - 1, first.dtype)
    for _ in range(_NEWTON_STEPS):
        sonine = sonine - jnp.linalg.solve(jax.jacfwd(peaking)(sonine), peaking(sonine))
    at = Moments.of(first, order)._replace(sonine=sonine[0])
    if order > 2:
        at = at._replace(third_sonine=sonine[1])
    return jnp.stack([value for value in at if value is not None])


Scene = tuple[ReducedScene, Density]
"""A scene in reduced units, and the effects of its density."""


class Equations(NamedTuple):
    """What is followed of a gas, and how closely.

    Attributes:
        dimension: d.
        order: of the Sonine expansion: 2 follows a_2, 3 also a_3.
        maxwellian: whether a_2 stays 0.
        softness: whether soft contacts slow the cooling.
        averages: over impacts, a function of law, speed, dimension and order.
    """

    dimension: int
    order: int
    maxwellian: bool
    softness: bool
    averages: Callable[..., Array]

    def start(self, scene: Scene, like: Array) -> Float[Array, "moments"]:
        """The `Moments` at t = 0, as one array of the precision of another."""
        first = Moments.at_start(scene[0], like, self.order)
        if scene[0].prepared is None or self.maxwellian:
            return first
        return steady_moments(first, *scene, self.dimension, self.order)

    def table(self, scene: Scene, duration: Array) -> RateTable:
        """The averages at all temperatures that the gas reaches in a time."""
        law, d = scene[0].law, self.dimension
        averages = partial(self.averages, law, dimension=d, order=self.order)
        bounds = fastest_cooling(scene[0], d)
        return RateTable.of(averages, duration, d, law.num_nodes, bounds)

    def velocity(
        self, state: Float[Array, "moments"], rates: Float[Array, "rows terms"], scene: Scene
    ) -> Float[Array, "moments"]:
        """Time derivative of the moments at given averages over impacts."""
        return moment_rates(
            state,
            rates,
            *scene,
            self.dimension,
            order=self.order,
            softness=self.softness,
            maxwellian=self.maxwellian,
        )
