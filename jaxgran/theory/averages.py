"""Averages over the impacts of a gas with a Maxwell-Sonine velocity distribution.

Units: `Gas.impact_speed`, sqrt(2 T_0), and `Gas.path_length`, 1 / (n g_2 sigma^(d-1)); the unit of
time ("reduced time") is their ratio. In these units the averages depend on the reduced law, the
dimension and T/T_0 only.
"""

from collections.abc import Callable
from math import pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.restitution import ReducedLaw

SOFTNESS = {2: 0.970, 3: 1.937}
"""c in ``1 - c X_T/sigma``, the factor by which soft contacts reduce the cooling rate."""


def _quadrature(num_nodes: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes g and weights for ``int_0^inf g exp(-g^2/2) f(g) dg``.

    Gauss-Legendre in sqrt(g), since laws of restitution are smooth in small powers of g. The
    integral beyond `top` is neglected.
    """
    x, w = np.polynomial.legendre.leggauss(num_nodes)
    root = (x + 1) / 2
    g = top * root**2
    return g, w * top * root * g * np.exp(-(g**2) / 2)


_NODES, _NODE_WEIGHTS = _quadrature(num_nodes=32, top=9.0)


def impact_average(function: Callable[[Array], Array], like: Float[Array, ""]) -> Float[Array, ""]:
    """``int_0^inf g exp(-g^2/2) f(g) dg``, the average over the normal speeds of impacts.

    Args:
        function: f, of an array of g.
        like: a number of the precision that is wanted.
    """
    nodes, weights = (jnp.asarray(x, like.dtype) for x in (_NODES, _NODE_WEIGHTS))
    return jnp.sum(weights * function(nodes))


class Rates(NamedTuple):
    """Rates of a gas at one temperature, per unit of reduced time and divided by sqrt(T/T_0).

    Attributes:
        cooling: mu_2, in ``d ln T/dt = -(2/d) mu_2``.
        fourth_moment: mu_4, in ``d a_2/dt = (4/d) mu_2 (1 + a_2) - 4 mu_4 / (d (d + 2))``.
        relaxation: nu_v, relaxation rate of the velocity autocorrelation function.
    """

    cooling: Float[Array, ""]
    fourth_moment: Float[Array, ""]
    relaxation: Float[Array, ""]

    @classmethod
    def of(cls, averages: Float[Array, "3 3"], sonine: Float[Array, ""]) -> "Rates":
        """The rates at a given a_2.

        Args:
            averages: coefficients of the polynomials in a_2, as the function `averages` returns
                them.
            sonine: a_2.
        """
        return cls(*(averages[:, 0] + sonine * (averages[:, 1] + sonine * averages[:, 2])))


def collision_rate(sonine: ArrayLike, dimension: int) -> Float[Array, "..."]:
    """Collisions per particle and per unit of reduced time, divided by sqrt(T/T_0).

    ``S_d / sqrt(2 pi) (1 - a_2/16)``.

    Args:
        sonine: a_2, any shape.
        dimension: d.
    """
    return sphere_surface(dimension) / sqrt(2 * pi) * (1 - jnp.asarray(sonine) / 16)


def _integrands(e: float, g: np.ndarray, d: int) -> np.ndarray:
    """Coefficients of 1, a_2, a_2^2 in the integrands of mu_2, mu_4, nu_v: shape (3, 3, nodes)."""
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


def _averaging_matrix(dimension: int) -> np.ndarray:
    """Matrix from the powers 0 to 4 of 1 - eps at the nodes to `averages`: (3, 3, 5, nodes).

    The integrands are polynomials of fourth degree in eps, here found by interpolation.
    """
    samples = np.linspace(0, 2, 5)
    values = np.stack([_integrands(1 - x, _NODES, dimension) for x in samples], axis=-2)
    inverse = np.linalg.inv(np.vander(samples, increasing=True))
    coefficients = np.einsum("ps,absn->abpn", inverse, values)
    return sphere_surface(dimension) / sqrt(8 * pi) * coefficients * _NODE_WEIGHTS


_AVERAGING_MATRICES = {d: _averaging_matrix(d) for d in (2, 3)}


def averages(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, "3 3"]:
    """Averages over the impacts of a Maxwell-Sonine gas, exact in eps(v), to second order in a_2.

    ``mu_p = -(S_d / 2 sqrt(2 pi)) int_0^inf g exp(-g^2/2) P_p(g, eps(g), a_2) dg`` by Gauss
    quadrature with 32 nodes in sqrt(g): relative error below 1e-9 for the laws of this package.

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d.

    Returns:
        Coefficients of the polynomials in a_2, shape (3, 3): the rows are mu_2, mu_4 and nu_v, the
        columns the coefficients of 1, a_2 and a_2^2; see `Rates`.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution.
    """
    loss = law.loss(jnp.asarray(_NODES, speed.dtype) * speed)
    powers = jnp.stack([jnp.ones_like(loss), loss, loss**2, loss**3, loss**4])
    return jnp.tensordot(jnp.asarray(_AVERAGING_MATRICES[dimension], speed.dtype), powers, 2)


def softness_factor(law: ReducedLaw, speed: Float[Array, ""], dimension: int) -> Float[Array, ""]:
    """Factor ``1 - c X_T/sigma`` by which soft contacts reduce the cooling rate.

    ``X_T = (v^2/alpha)^(2/5)`` at the speed v = sqrt(2 T) is the length scale of the overlap, and
    c = `SOFTNESS`. Valid to first order in X_T/sigma. Against soft-sphere simulations it corrects
    errors of 0.9 %, 2.4 % and 8.2 % at X_T/sigma = .005, .02 and .06 to within 0.3 %.

    Args:
        law: law of restitution in units of the diameter and of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d.
    """
    return 1 - SOFTNESS[dimension] * law.impact_length(speed)
