"""Averages over the Maxwell-Sonine velocity distribution, and the closed forms that follow.

Units: the impact speed sqrt(2 T_0) and the path length 1 / (n g_2 sigma^(d-1)), hence the time
``path_length / impact_speed``. In these a gas is known by its reduced law and its dimension alone.
"""

from collections.abc import Callable
from functools import cache
from math import gamma, pi, sqrt
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.gas import sphere_surface
from jaxgran.restitution import C1, C_CLIP, ReducedLaw, ReducedViscoelastic

SOFTNESS = {2: 0.970, 3: 1.937}
"""c in ``dT/dt -> dT/dt (1 - c X_T/sigma)``: soft contacts cool more slowly, by so much."""


def _quadrature(num_nodes: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    # Gauss-Legendre in sqrt(g): laws are smooth in small powers of g; exp(-top^2/2) is nothing.
    x, w = np.polynomial.legendre.leggauss(num_nodes)
    root = (x + 1) / 2
    g = top * root**2
    return g, w * top * root * g * np.exp(-(g**2) / 2)


_G, _W = _quadrature(num_nodes=32, top=9.0)


class Rates(NamedTuple):
    """Dimensionless rates of a gas at one temperature, per reduced time and per sqrt(T/T_0).

    Attributes:
        cooling: mu_2; ``d ln T/dt = -(2/d) mu_2``.
        fourth_moment: mu_4; ``d a_2/dt = (4/d) mu_2 (1 + a_2) - 4 mu_4 / (d (d + 2))``.
        relaxation: nu_v of the velocity autocorrelation.
    """

    cooling: Float[Array, ""]
    fourth_moment: Float[Array, ""]
    relaxation: Float[Array, ""]

    @classmethod
    def of(cls, averages: Float[Array, "3 3"], sonine: Float[Array, ""]) -> "Rates":
        """The rates at a_2, of the polynomials in a_2 that `averages` returns."""
        return cls(*(averages[:, 0] + sonine * (averages[:, 1] + sonine * averages[:, 2])))


def collision_rate(sonine: ArrayLike, dimension: int) -> Float[Array, ""]:
    """Collisions per particle, per reduced time and per sqrt(T/T_0), of a gas with a given a_2."""
    return sphere_surface(dimension) / sqrt(2 * pi) * (1 - jnp.asarray(sonine) / 16)


def _integrands(e: float, g: np.ndarray, d: int) -> np.ndarray:
    """Integrands of mu_2, mu_4, nu_v and their factors of 1, a_2, a_2^2: shape (3, 3, nodes)."""
    loss, gain = 1 - e**2, 1 + e**2
    sonine_1 = (g**6 - 6 * g**4 + 3 * g**2) / 16
    sonine_2 = (g**10 - 28 * g**8 + 210 * g**6 - 420 * g**4 + 105 * g**2) / 1024
    cooling = [loss * g**2 / 2, loss * sonine_1 / 2, loss * sonine_2 / 2]
    fourth_0 = loss * (gain * g**4 / 8 + (2 * d + 1) * g**2 / 4)
    fourth_1 = (
        loss * gain * g**8 / 128
        + loss * (2 * d - 2 - 3 * e**2) * g**6 / 64
        - loss * (8 * d - 47 - 3 * e**2) * g**4 / 128
        + (1 + e) * (2 * d * e + 30 * d + 25 * e - 57) * g**2 / 64
    )
    slow, slower = 90 * d * e - 58 * d + 300 * e - 332, 48 * d * e + 208 * d + 867 * e - 1123
    fourth_2 = (
        loss * gain * g**12 / 8192
        + loss * (2 * d - 14 * e**2 - 13) * g**10 / 4096
        - loss * (40 * d - 105 * e**2 - 37) * g**8 / 4096
        - (1 + e) * (slow - 105 * e**3 + 105 * e**2) * g**6 / 2048
        + 5 * (1 + e) * (slower - 21 * e**3 + 21 * e**2) * g**4 / 8192
        + 15 * (1 + e) * (2 * d * e - 66 * d - 47 * e + 111) * g**2 / 4096
    )
    relaxation = [(1 + e) * g**2 / d, (1 + e) * sonine_1 / d, (1 + e) * sonine_2 / d]
    return np.array([cooling, [fourth_0, fourth_1, fourth_2], relaxation])


def _weights(dimension: int) -> np.ndarray:
    """The quadrature as a matrix on powers 0 to 4 of 1 - eps at the nodes: (3, 3, 5, nodes)."""
    samples = np.linspace(0, 2, 5)
    values = np.stack([_integrands(1 - x, _G, dimension) for x in samples], axis=-2)
    inverse = np.linalg.inv(np.vander(samples, increasing=True))
    return (
        sphere_surface(dimension) / sqrt(8 * pi) * np.einsum("ps,absn->abpn", inverse, values) * _W
    )


_WEIGHTS = {d: _weights(d) for d in (2, 3)}


def averages(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, "3 3"]:
    """Averages over the impacts of a Maxwell-Sonine gas, exact in eps(v), to second order in a_2.

    ``mu_p = -(S_d / 2 sqrt(2 pi)) int_0^inf g exp(-g^2/2) P_p(g, eps(g), a_2) dg`` by Gauss
    quadrature (32 nodes in sqrt(g); relative error below 1e-9 for the laws of this package).

    Args:
        law: reduced law.
        speed: sqrt(T/T_0).
        dimension: d.

    Returns:
        Row by row mu_2, mu_4, nu_v; column by column the factors of 1, a_2, a_2^2.
    """
    lost = law.loss(jnp.asarray(_G, speed.dtype) * speed)
    powers = jnp.stack([jnp.ones_like(lost), lost, lost**2, lost**3, lost**4])
    return jnp.tensordot(jnp.asarray(_WEIGHTS[dimension], speed.dtype), powers, 2)


def _moment(power: float) -> float:
    """``int_0^inf g^(1 + power) exp(-g^2/2) dg``."""
    return 2 ** (power / 2) * gamma(1 + power / 2)


def paper_averages(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, "3 3"]:
    """The paper's own truncated averages: Maxwellian, two terms of the restitution series.

    ``dT/dt = -b_1 T^(8/5) + b_2 T^(17/10)`` and ``1/tau_v`` to order delta^2.

    Args, returns: as `averages`; the law must be `Viscoelastic`, the paper prints d = 3.

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


_SCAN = 16


@cache
def _chebyshev(num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in [-1, 1] and the matrix from values there to coefficients."""
    angles = (np.arange(num_nodes) + 0.5) * pi / num_nodes
    matrix = 2 / num_nodes * np.cos(np.outer(np.arange(num_nodes), angles))
    matrix[0] /= 2
    return np.cos(angles), matrix


class RateTable(eqx.Module):
    """The averages of one gas as Chebyshev series in ln T, for all temperatures it will pass.

    Laws are smooth in ln T, so a few quadratures at the start replace one in every solver stage.

    Attributes:
        coefficients: of mu_2, mu_4, nu_v and their factors of a_2, shape (nodes, 3, 3).
        lowest: the lowest ln(T/T_0) of the table; the highest is 0.
    """

    coefficients: Float[Array, "nodes 3 3"]
    lowest: Float[Array, ""]

    @classmethod
    def of(
        cls,
        averages: Callable[[Float[Array, ""]], Float[Array, "3 3"]],
        duration: Float[Array, ""],
        dimension: int,
        num_nodes: int,
    ) -> "RateTable":
        """Tabulate over all that a gas can cool in a time.

        Args:
            averages: of sqrt(T/T_0).
            duration: reduced time; the table ends below the lowest temperature the gas can reach
                in it, bounded by plastic spheres (Haff, e = 0) and by the law's own loss.
            dimension: d.
            num_nodes: terms of the series; see `ReducedLaw.num_nodes`.
        """
        duration = jax.lax.stop_gradient(duration)
        share = sphere_surface(dimension) / sqrt(2 * pi)
        bound = -2 * jnp.log1p(1.1 * share / (2 * dimension) * duration)
        # Laws that lose little at low speed never get there; a table that did would lose digits.
        scan = bound * jnp.linspace(0, 1, _SCAN, dtype=bound.dtype)
        speeds = jnp.exp(scan / 2)
        loss = jax.lax.stop_gradient(jax.vmap(averages)(speeds)[:, 0, 0])
        rate = jnp.maximum(2.2 / dimension * loss * speeds, jnp.finfo(bound.dtype).tiny)
        soonest = jnp.cumsum(-jnp.diff(scan) / jnp.maximum(rate[1:], rate[:-1]))
        passed = jnp.min(jnp.where(soonest < duration, scan[1:], 0.0))
        lowest = passed + scan[1]
        lowest = jnp.minimum(jnp.maximum(lowest, bound), -1e-3)
        nodes, to_coefficients = (jnp.asarray(x, lowest.dtype) for x in _chebyshev(num_nodes))
        values = jax.vmap(averages)(jnp.exp(lowest * (1 - nodes) / 4))
        return cls(jnp.tensordot(to_coefficients, values, 1), lowest)

    def __call__(self, log_theta: Float[Array, ""]) -> Float[Array, "3 3"]:
        """The averages at ln(T/T_0), as `averages` returns them."""
        x = 2 * (1 - log_theta / self.lowest) - 1
        ahead = behind = jnp.zeros_like(self.coefficients[0])
        for row in self.coefficients[:0:-1]:
            ahead, behind = row + 2 * x * ahead - behind, ahead
        return self.coefficients[0] + x * ahead - behind


def softness_factor(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, ""]:
    """``1 - c X_T/sigma``, by which soft contacts slow the cooling; X_T at the speed sqrt(2 T).

    Valid to first order in the overlap; measured against soft-sphere simulation it removes an
    error of 0.9 %, 2.4 %, 8.2 % at X_T/sigma = .005, .02, .06 to within 0.3 %.
    """
    return 1 - SOFTNESS[dimension] * law.impact_length(speed)


# Closed forms. Times are in mean free times of the start, tau = nu_0 t; temperatures in T_0.
# Equations are numbered as LaTeX numbers the authors' preprint.

COOLING_RATE = {d: 9 / 5 / d * 2**0.2 * C1 * gamma(2.1) for d in (2, 3)}
"""``tau_c(0) / (tau_0 delta)``: 0.83193 in 3D, the paper's Eq. (39)."""

TWO_TERM = 33 / 20 * 2**0.2 * C1 * gamma(2.2) / gamma(2.1)
"""q, the paper's b_2 over b_1 at T_0 and delta = 1: 2.3018."""


SLOWING = 3 / 4 * gamma(2.1) * C1 * 4**0.1
"""c, by how much impacts lengthen tau_v: ``tau_E/tau_v = 1 - c delta``, 1.03992; Eq. (32)."""

SONINE = 3 / 20 * C1 * _moment(2.2) * 1.5 * 2**0.1
"""s in ``a_2 = -s delta (T/T_0)^(1/10)``, the excess kurtosis to first order in 3D: 0.62395."""


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
