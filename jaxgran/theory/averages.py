"""Averages over the impacts of a gas with a Maxwell-Sonine velocity distribution.

Units: `Gas.impact_speed`, sqrt(2 T_0), and `Gas.path_length`, 1 / (n g_2 sigma^(d-1)); the unit of
time ("reduced time") is their ratio. In these units the averages depend on the reduced law, the
dimension and T/T_0 only.
"""

from functools import cache
from math import pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.scene.geometry import sphere_surface
from jaxgran.scene.impact_average import NODES, WEIGHTS
from jaxgran.scene.restitution import ReducedLaw
from jaxgran.theory import collision_integrals


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


def collision_rate(
    sonine: ArrayLike, dimension: int, third_sonine: ArrayLike = 0.0
) -> Float[Array, "..."]:
    """Collisions per particle and per unit of reduced time, divided by sqrt(T/T_0).

    ``S_d / sqrt(2 pi) (1 - a_2/16 - a_3/64)``.

    Args:
        sonine: a_2, any shape.
        dimension: d.
        third_sonine: a_3, the same shape.
    """
    factor = 1 - jnp.asarray(sonine) / 16 - jnp.asarray(third_sonine) / 64
    return sphere_surface(dimension) / sqrt(2 * pi) * factor


@cache
def averaging_matrix(dimension: int, order: int) -> np.ndarray:
    """Matrix from the powers 0 to 6 of 1 - eps at the nodes to `averages`."""
    changes = collision_integrals.changes(dimension, order, tuple(NODES))
    return sphere_surface(dimension) / sqrt(8 * pi) * changes * WEIGHTS


def averages(
    law: ReducedLaw, speed: Float[Array, ""], dimension: int, order: int = 2
) -> Float[Array, "rows terms"]:
    """Averages over the impacts of a Maxwell-Sonine gas, exact in eps(v).

    ``mu_2p = (S_d / 2 sqrt(2 pi)) int_0^inf g exp(-g^2/2) L_p(g, eps(g)) dg`` with the loss L_p of
    ``c_1^(2p) + c_2^(2p)`` in an impact, and likewise the relaxation of a labelled sphere's
    velocity, by Gauss quadrature with 32 nodes in sqrt(g): relative error below 1e-9 for the laws
    of this package.

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d.
        order: of the Sonine expansion: 2 follows a_2, 3 also a_3.

    Returns:
        Coefficients of polynomials in a_2 (and a_3), whose columns `collision_integrals.TERMS`
        lists. Order 2: mu_2, mu_4 and nu_v, shape (3, 3), see `Rates`. Order 3: mu_2, mu_4, mu_6
        and nu_00, nu_01, nu_10, nu_11, shape (7, 6), see `jaxgran.theory.moments`.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution; see
    `jaxgran.theory.collision_integrals`.
    """
    loss = law.loss(jnp.asarray(NODES, speed.dtype) * speed)
    powers = jnp.stack([loss**0 * 1.0, loss, *(loss**k for k in range(2, 7))])
    return jnp.tensordot(jnp.asarray(averaging_matrix(dimension, order), speed.dtype), powers, 2)
