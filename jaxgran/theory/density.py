"""Corrections of the cooling rate at finite density: correlated velocities and soft contacts.

Units are the same as in `jaxgran.theory.averages`; functions of a `Gas` use SI units.
"""

from math import gamma, log, pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.contact import ELASTIC_CONTACT_TIME
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import contact_value_slopes, scaled_critical_wavenumber, sphere_surface
from jaxgran.scene.laws import ReducedLaw

MAX_WAVENUMBER = {2: (0.181, 3.10), 3: (0.926, 2.19)}
"""a, b of ``K sigma = a + b phi``, the largest wavenumber that is counted, by dimension.

Fitted to ``experiments/accuracy/measure_correlations.py``: hard spheres of eps = .7 and .9 at phi =
.05 to .3. With two numbers chi^2 is 7 (2D) and 10 (3D) for nine gases. Errors: 2D .05, .24; 3D .07,
.32. Gases of --full to which nothing was fitted: in 3D those with eps = .95 agree, and for eps = .8
and phi >= .2 they cool up to 1 % faster than this predicts; disks of phi >= .2 cool up to 2 %
faster.
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
    again: their normal speed is then lower than without correlations. In modes of the flow:
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
    spheres they measured a slower energy decay than independent collisions give from the early
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

    As beta -> 0, velocities are independent of positions, and the loss is an average over the
    equilibrium fluid. It is proportional to ``int sqrt(xi) exp(-U/T) y(sigma - xi) dxi`` with the
    cavity function y of spheres whose excluded diameter is smaller by ``1.280 X_T``. In addition,
    contacts hold the energy ``U/K = (2/(5 d)) nu t_c``, which is proportional to T^(2/5) and is
    lost along with T: ``k = 1.280 d ln g_2/d ln sigma + (1.280 - .969) s + (7/5) (2/(5 d)) nu t_c
    sigma/X_T`` with the slope ``s = -d ln g/d ln r`` of the pair correlation at contact. It is 0
    for a dilute gas.

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
