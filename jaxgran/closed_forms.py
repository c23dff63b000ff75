"""Closed forms: the paper's truncated averages, its laws of cooling and of spreading, corrected.

Times are in mean free times of the start, tau = nu_0 t; temperatures in T_0. Equations are numbered
as LaTeX numbers the authors' preprint.
"""

from math import gamma, pi, sqrt

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.gas import sphere_surface
from jaxgran.restitution import C1, C_CLIP, ReducedLaw, ReducedViscoelastic


def _moment(power: float) -> float:
    """``int_0^inf g^(1 + power) exp(-g^2/2) dg``."""
    return 2 ** (power / 2) * gamma(1 + power / 2)


COOLING_RATE = {d: 9 / 5 / d * 2**0.2 * C1 * gamma(2.1) for d in (2, 3)}
"""``tau_c(0) / (tau_0 delta)``: 0.83193 in 3D, the paper's Eq. (39)."""

TWO_TERM = 33 / 20 * 2**0.2 * C1 * gamma(2.2) / gamma(2.1)
"""q, the paper's b_2 over b_1 at T_0 and delta = 1: 2.3018."""

SLOWING = 3 / 4 * gamma(2.1) * C1 * 4**0.1
"""c, by how much impacts lengthen tau_v: ``tau_E/tau_v = 1 - c delta``, 1.03992; Eq. (32)."""

SONINE = 3 / 20 * C1 * _moment(2.2) * 1.5 * 2**0.1
"""s in ``a_2 = -s delta (T/T_0)^(1/10)``, the excess kurtosis to first order in 3D: 0.62395."""


def paper_averages(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, "3 3"]:
    """The paper's own truncated averages: Maxwellian, two terms of the restitution series.

    ``dT/dt = -b_1 T^(8/5) + b_2 T^(17/10)`` and ``1/tau_v`` to order delta^2.

    Args, returns: as `jaxgran.kinetics.averages`; the law must be `Viscoelastic`, the paper prints
        d = 3.

    Raises:
        ValueError: for another law.

    Reference: Brilliantov & Poeschel, Eqs. (32) and (36).
    """
    if not isinstance(law, ReducedViscoelastic):
        raise ValueError(
            f"the paper's truncated averages need the Viscoelastic law, got {type(law).__name__}"
        )
    beta = law.beta * speed**0.2
    cooling = C1 * beta * _moment(2.2) - 11 / 10 * C1**2 * beta**2 * _moment(2.4)
    slowing = 2 * _moment(2) - C1 * _moment(2.2) * beta + 3 / 5 * C1**2 * _moment(2.4) * beta**2
    column = jnp.stack([cooling, jnp.zeros_like(beta), slowing / dimension])
    maxwellian = jnp.asarray([1.0, 0.0, 0.0], beta.dtype)
    return sphere_surface(dimension) / sqrt(8 * pi) * jnp.outer(column, maxwellian)


def haff(tau: ArrayLike, coefficient: ArrayLike, dimension: int = 3) -> Float[Array, "..."]:
    """Haff's law ``T/T_0 = (1 + gamma_0 tau)^(-2)``, ``gamma_0 = (1 - e^2) / (2 d)``.

    Args:
        tau: ``nu_0 t``, any shape.
        coefficient: constant restitution e.
        dimension: d.

    Reference: Brilliantov & Poeschel, Eq. (44); Maxwellian (a_2 = 0).
    """
    loss = (1 - jnp.asarray(coefficient) ** 2) / (2 * dimension)
    return (1 + loss * jnp.asarray(tau)) ** -2.0


def haff_collisions(
    tau: ArrayLike, coefficient: ArrayLike, dimension: int = 3
) -> Float[Array, "..."]:
    """Collisions per particle under Haff's law, ``N = ln(1 + gamma_0 tau) / gamma_0``.

    Args, validity: as `haff`; e in [0, 1).
    """
    loss = (1 - jnp.asarray(coefficient) ** 2) / (2 * dimension)
    return jnp.log1p(loss * jnp.asarray(tau)) / loss


def constant_displacement(
    collisions: ArrayLike, coefficient: ArrayLike, dimension: int = 3
) -> Float[Array, "..."]:
    """<dr^2> of a gas of constant restitution, in units of ``T_0 tau_c(0)^2``; ballistic start too.

    ``<dr^2> = (2 d / k) (N - (1 - exp(-k N)) / k)``, ``k = (1 + e)^2 / (2 d)``: linear in the
    collisions per particle, hence logarithmic in time. Solves ``dD/dt = T - D/tau_v`` with
    ``1/tau_v = nu (1 + e)/d``; Maxwellian, first Sonine order of D.

    Args:
        collisions: N per particle, any shape; see `haff_collisions`.
        coefficient: e, in [0, 1].
        dimension: d.

    Reference: Brilliantov & Poeschel, Eqs. (45) and (46); their ``D = T tau_v``, Eq. (34), forgets
    the cooling during tau_v and has ``k = (1 + e) / d``.
    """
    k = (1 + jnp.asarray(coefficient)) ** 2 / (2 * dimension)
    n = jnp.asarray(collisions)
    return 2 * dimension / k * (n + jnp.expm1(-k * n) / k)


def paper_temperature(
    tau: ArrayLike, delta: ArrayLike, *, corrected: bool = True, clipped: bool = True
) -> Float[Array, "..."]:
    """The expansion of T/T_0 in delta, in 3D, to order delta^2; Maxwellian.

    ``u^(-5/3) + 2 q delta (u^(-11/6) - u^(-8/3)) + ...`` with ``u = 1 + t/tau_0``.

    Args:
        tau: ``nu_0 t``, any shape.
        delta: ``A alpha^(2/5) T_0^(1/10)``.
        corrected: include the homogeneous terms, without which T(0) is not T_0. False gives the
            form as printed, ``u^(-5/3) + a_1 delta u^(-11/6)`` with ``a_1 = 2 q``, of which the
            coefficient of delta^2 is left out: no two-term equation can give it.
        clipped: include the delta^(3/2) term of contacts that end at zero force.

    Reference: Brilliantov & Poeschel, Eq. (38), corrected.
    """
    u = 1 + COOLING_RATE[3] * jnp.asarray(delta) * jnp.asarray(tau)
    q = TWO_TERM
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
    """<dr^2> of viscoelastic spheres to order delta, in 3D, in units of ``T_0 tau_c(0)^2``.

    ``6 D_0 tau_0 {6 (u^(1/6) - 1) + delta [a_3 ln u - (6/5) (q' (1 - u^(-5/6)) + c)]}`` for times
    beyond tau_v, with ``D_0 = T_0 tau_E(0) = 3/2``, ``a_3 = q' + (c + 3 s/16) + c = 4.648`` and
    ``q' = q + 0.24 s``: of cooling, of slower relaxation, of cooling during the relaxation (the
    memory, which also takes the last c), each with the a_2 that is of the same order.

    Args:
        tau: ``nu_0 t``, any shape.
        delta: ``A alpha^(2/5) T_0^(1/10)``.
        corrected: False gives the paper's D integrated from 0: ``a_3 = q + c = 3.342``, without
            memory, a_2 and the terms that keep T(0) = T_0.

    Reference: Brilliantov & Poeschel, Eqs. (40) and (42), corrected: (41) prints 1/tau_E in place
    of D_0, and (42) leaves out the factor 6 of u^(1/6) and the constant, which hides the power law
    until u = 2e6.
    """
    rate = COOLING_RATE[3] * jnp.asarray(delta)
    u = 1 + rate * jnp.asarray(tau)
    if corrected:
        cooling = TWO_TERM + 0.24 * SONINE
        first = (cooling + 2 * SLOWING + 3 / 16 * SONINE) * jnp.log(u)
        first -= 6 / 5 * (cooling * (1 - u ** (-5 / 6)) + SLOWING)
    else:
        first = (TWO_TERM + SLOWING) * jnp.log(u)
    return 9 / rate * (6 * (u ** (1 / 6) - 1) + delta * first)


def _relative(power: float, coefficient: float) -> float:
    # Coefficient of delta^(power-1) beside the leading loss 2 C1 beta, averaged over impacts.
    scale = (1.5 * 2**0.1) ** (power - 1)
    return coefficient / (2 * C1) * scale * _moment(2 + power / 5) / _moment(2.2)


EXPANSION_P = _relative(2.5, 2 * C_CLIP)
"""p: weight of delta^(3/2) in the cooling rate, 0.56613; absent if contacts are not clipped."""

EXPANSION_R = _relative(3.0, 2 * 0.522882568 + 2 * C1 * 3 / 5 * C1**2)
"""r: weight of delta^2 in the cooling rate, 4.14272."""


def two_term_time(theta: ArrayLike, delta: ArrayLike) -> Float[Array, "..."]:
    """Exact solution tau(T/T_0) of the paper's two-term cooling equation, in 3D.

    With ``x = (T/T_0)^(1/10)`` and ``k = q delta`` the equation
    ``dT/dt = -b_1 T^(8/5) + b_2 T^(17/10)`` integrates to ``tau = 6/(c delta) [
    sum_{j<6} k^j (x^(j-6) - 1)/(6 - j) - k^6 ln x + k^6 ln((1 - k x)/(1 - k))]``, c = 0.83193.

    Args:
        theta: T/T_0, in (0, 1], any shape.
        delta: in (0, 1/q): beyond, the truncated equation no longer cools.

    Returns:
        tau = nu_0 t.

    Raises:
        ValueError: for delta >= 1/q.

    Reference: Brilliantov & Poeschel, Eq. (36), integrated by partial fractions.
    """
    limit = 1 / TWO_TERM
    if np.any(np.asarray(delta) >= limit):
        raise ValueError(f"delta must lie in (0, {limit:.4f}), got {delta}; use KineticTheory")
    x, k = jnp.asarray(theta) ** 0.1, TWO_TERM * jnp.asarray(delta)
    powers = sum(k**j * (x ** (j - 6) - 1) / (6 - j) for j in range(6))
    logs = k**6 * (jnp.log1p(-k * x) - jnp.log1p(-k) - jnp.log(x))
    return jnp.asarray(6 / (COOLING_RATE[3] * jnp.asarray(delta)) * (powers + logs))
