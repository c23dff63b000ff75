"""The paper's solutions in closed form, as printed and as corrected.

Times are ``tau = nu_0 t``, in units of the initial mean free time ``tau_c(0) = 1/nu_0``;
temperatures are over T_0. The paper is N. V. Brilliantov & T. Poeschel, Self-diffusion in granular
gases, Phys. Rev. E 61, 1716 (2000); its equations are numbered as in the authors' preprint.
"""

from math import gamma, pi, sqrt

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.laws import C1, C_CLIP, ReducedLaw, ReducedViscoelastic
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE


def speed_moment(power: float) -> float:
    """Return ``int_0^inf g^(1 + power) exp(-g^2/2) dg``."""
    return 2 ** (power / 2) * gamma(1 + power / 2)


def paper_averages(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, "3 3"]:
    """Return the paper's truncated averages: Maxwellian velocities, two terms of the series of eps.

    ``dT/dt = -b_1 T^(8/5) + b_2 T^(17/10)``, and ``1/tau_v`` to order delta^2.

    Args:
        law: a `Viscoelastic` law in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d; the paper has 3.

    Returns:
        An array like that of `jaxgran.theory.averages.impact_moments`, with the rows mu_2, 0 and
        nu_v; only the first column is not 0.

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
    relaxation = (
        2 * speed_moment(2.0)
        - C1 * speed_moment(2.2) * beta
        + 3 / 5 * C1**2 * speed_moment(2.4) * beta**2
    )
    column = jnp.stack([cooling, jnp.zeros_like(beta), relaxation / dimension])
    maxwellian = jnp.asarray([1.0, 0.0, 0.0], beta.dtype)
    return sphere_surface(dimension) / sqrt(8 * pi) * jnp.outer(column, maxwellian)


RELAXATION_CORRECTION = 3 / 4 * gamma(2.1) * C1 * 4**0.1
"""c in ``tau_E/tau_v = 1 - c delta`` at T_0, with the velocity relaxation time tau_v and that of
elastic spheres, tau_E: 1.03992; Eq. (32).
"""

SONINE_COEFFICIENT = 3 / 20 * C1 * speed_moment(2.2) * 1.5 * 2**0.1
"""s in ``a_2 = -s delta (T/T_0)^(1/10)``, to first order in delta, in 3D: 0.62395."""


def _expansion_coefficient(power: float, coefficient: float) -> float:
    """Coefficient of delta^(power - 1) in the cooling rate over that of its leading term.

    The term of 1 - eps^2 is ``coefficient beta^power``, the leading one ``2 C1 beta``.
    """
    scale = (1.5 * 2**0.1) ** (power - 1)
    return coefficient / (2 * C1) * scale * speed_moment(2 + power / 5) / speed_moment(2.2)


EXPANSION_P = _expansion_coefficient(2.5, 2 * C_CLIP)
"""p, relative coefficient of delta^(3/2) in the cooling rate: 0.56613; 0 without the clip."""

EXPANSION_R = _expansion_coefficient(3.0, 2 * 0.522882568 + 2 * C1 * 3 / 5 * C1**2)
"""r, relative coefficient of delta^2 in the cooling rate: 4.14272."""


def haff(tau: ArrayLike, coefficient: ArrayLike, dimension: int = 3) -> Float[Array, "..."]:
    """Return Haff's law, ``T/T_0 = (1 + gamma_0 tau)^(-2)`` with ``gamma_0 = (1 - e^2) / (2 d)``.

    Args:
        tau: ``nu_0 t``, >= 0, any shape.
        coefficient: e, in [0, 1].
        dimension: d.

    Returns:
        T/T_0, same shape.

    Valid for constant restitution and Maxwellian velocities (a_2 = 0).

    Reference: Brilliantov & Poeschel, Eq. (44), which has d = 3.
    """
    loss = (1 - jnp.asarray(coefficient) ** 2) / (2 * dimension)
    return (1 + loss * jnp.asarray(tau)) ** -2.0


def paper_temperature(
    tau: ArrayLike, delta: ArrayLike, *, corrected: bool = True, clipped: bool = True
) -> Float[Array, "..."]:
    """Return the temperature of viscoelastic spheres in 3D as an expansion to order delta^2.

    ``T/T_0 = u^(-5/3) + 2 q delta (u^(-11/6) - u^(-8/3)) + ...`` with ``u = 1 + t/tau_0``.

    Args:
        tau: ``nu_0 t``, >= 0, any shape.
        delta: ``A alpha^(2/5) T_0^(1/10)``, small against 1.
        corrected: True includes the homogeneous solutions, without which T(0) is not T_0. False
            gives the printed form, ``u^(-5/3) + a_1 delta u^(-11/6)`` with ``a_1 = 2 q``, without
            its term in delta^2, whose coefficient does not follow from the two-term cooling
            equation.
        clipped: True includes the term in delta^(3/2) of contacts that end at zero force.

    Returns:
        T/T_0, same shape as tau.

    Valid for Maxwellian velocities (a_2 = 0).

    Reference: Brilliantov & Poeschel, Eq. (38), corrected.
    """
    u = 1 + COOLING_RATE[3] * jnp.asarray(delta) * jnp.asarray(tau)
    q = COOLING_CORRECTION
    if not corrected:
        return u ** (-5 / 3) + 2 * q * delta * u ** (-11 / 6)
    p = EXPANSION_P if clipped else 0.0
    r = EXPANSION_R
    second = q**2 * (
        3.7 * u**-2.0 - 2.5 * u ** (-8 / 3) + 3.2 * u ** (-11 / 3) - 4.4 * u ** (-17 / 6)
    ) - 2.5 * r * (u**-2.0 - u ** (-8 / 3))
    return jnp.asarray(
        u ** (-5 / 3)
        + 2 * q * delta * (u ** (-11 / 6) - u ** (-8 / 3))
        + 20 / 9 * p * delta**1.5 * (u ** (-23 / 12) - u ** (-8 / 3))
        + delta**2 * second
    )


def paper_displacement(
    tau: ArrayLike, delta: ArrayLike, *, corrected: bool = True
) -> Float[Array, "..."]:
    """Return the mean square displacement of viscoelastic spheres in 3D, to first order in delta.

    ``<dr^2> = 6 D_0 tau_0 {6 (u^(1/6) - 1) + delta [a_3 ln u - (6/5) (q' (1 - u^(-5/6)) + c)]}``
    with ``u = 1 + t/tau_0``, ``D_0 = T_0 tau_E(0) = (3/2) T_0 tau_c(0)``,
    ``a_3 = q' + (c + 3 s/16) + c = 4.648`` and ``q' = q + 0.24 s``. The three terms of a_3 are due
    to the correction of the temperature, to the slower velocity relaxation, and to the cooling
    during the relaxation (memory), which also gives the last c. Each includes a_2 to that order.

    Args:
        tau: ``nu_0 t``, any shape; times long against tau_v.
        delta: ``A alpha^(2/5) T_0^(1/10)``, small against 1.
        corrected: False gives the integral of the paper's D from t = 0, with
            ``a_3 = q + c = 3.342``, without memory, a_2 and the terms that keep T(0) = T_0.

    Returns:
        <dr^2> in units of ``T_0 tau_c(0)^2``, same shape as tau.

    Reference: Brilliantov & Poeschel, Eqs. (40) and (42), corrected: (41) has 1/tau_E in place of
    D_0, and (42) omits the factor 6 of u^(1/6) and the constant, without which the power law is
    visible only for u > 2e6.
    """
    rate = COOLING_RATE[3] * jnp.asarray(delta)
    u = 1 + rate * jnp.asarray(tau)
    if corrected:
        cooling = COOLING_CORRECTION + 0.24 * SONINE_COEFFICIENT
        first = (cooling + 2 * RELAXATION_CORRECTION + 3 / 16 * SONINE_COEFFICIENT) * jnp.log(u)
        first -= 6 / 5 * (cooling * (1 - u ** (-5 / 6)) + RELAXATION_CORRECTION)
    else:
        first = (COOLING_CORRECTION + RELAXATION_CORRECTION) * jnp.log(u)
    return 9 / rate * (6 * (u ** (1 / 6) - 1) + delta * first)
