"""Averages over the impacts of a gas with a Maxwell-Sonine velocity distribution.

Units: `Gas.impact_speed`, sqrt(2 T_0), and `Gas.path_length`, 1 / (n g_2 sigma^(d-1)); the unit of
time ("reduced time") is their ratio. In these units the averages depend on the reduced law, the
dimension and T/T_0 only.

Two spheres meet with the normal speed g. The other components of their velocities (of the velocity
of their centre along the normal and across it, and of their relative velocity across it) have the
distribution of a Maxwellian gas times ``(1 + a_2 S_2 + a_3 S_3 + a_4 S_4)`` for each sphere. The
averages over them are integrals of polynomials with Gaussian weights, for which Gauss quadrature is
exact. Velocities c are in units of sqrt(2 T), S_k are the Laguerre polynomials L_k^(d/2 - 1)(c^2).
`impact_moments` integrates over g; `jaxgran.theory.rate_table` tabulates the result for the
temperatures that a gas reaches. Averages over the slip and the spins of rough spheres:
`jaxgran.theory.rough_impacts`.

References: Brilliantov & Poeschel, Europhys. Lett. 74, 424 (2006), and Santos & Montanero, Granular
Matter 11, 157 (2009), for mu_2, mu_4, mu_6 with a_3 at constant eps; Garzo & Montanero, Phys. Rev.
E 69, 021301 (2004), for the second Sonine approximation of D.
"""

from functools import cache, partial
from math import pi, sqrt

import jax.numpy as jnp
import numpy as np
import scipy  # imports scipy.special at its first use
from jaxtyping import Array, ArrayLike, Float

from jaxgran.scene.geometry import NODES, WEIGHTS, sphere_surface
from jaxgran.scene.laws import ReducedLaw

NUM_RESTITUTIONS = 7
"""Number of values of eps that determine the polynomials of sixth degree in 1 - eps."""

# Nodes that integrate polynomials of degree 18 in the velocities exactly.
_NUM_NORMAL = 10
_NUM_TANGENTIAL = 5
_NUM_ANGLES = 6

CLOSURE = {2: (0.1127, 0.2725, 4.1658, -2.8628), 3: (0.0667, 0.2452, 4.8105, -1.4002)}
"""p, q, r, s of ``a_4 = p a_2 + q a_3 + r a_2^2 + s a_2 a_3`` by dimension.

The Sonine series of an inelastic gas is asymptotic, since its velocity distribution falls off
exponentially: cut off behind a_3 it gives an a_2 that is 6 % (3D) and 11 % (2D) too small at
eps = .5 and 28 % and 40 % at 0, and cut off behind a_4 one that is too large. A gas whose
temperature varies in space or time has the term in a_2^2. The numbers were chosen so that a_2 and
a_3 of the homogeneous cooling state agree with direct simulation by an independent code (constant
eps from 0 to .95); ``experiments/accuracy/particle_statistics.py`` measures how well they agree
with DSMC.
"""


TERMS = {2: ((0, 1, 2), (0, 0, 0)), 3: ((0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2))}
"""Powers of a_2 and of a_3 of the columns of a matrix of averages, by order: 1, a_2, a_2^2 at order
2; 1, a_2, a_3, a_2^2, a_2 a_3, a_3^2 at order 3."""


@cache
def _impact_nodes(dimension: int) -> tuple[Float[np.ndarray, "nodes"], ...]:
    """Velocities before impacts of one normal speed, and the weights of the average over them.

    They are the velocity of the centre along the normal; the squares of its tangential part and of
    the tangential relative velocity; the scalar product of these two vectors; and weights with the
    sum 1.
    """
    normal, weight = np.polynomial.hermite_e.hermegauss(_NUM_NORMAL)
    square, weight_of_square = scipy.special.roots_genlaguerre(_NUM_TANGENTIAL, (dimension - 3) / 2)
    if dimension == 2:
        cosine = np.array([-1.0, 1.0])
    else:
        cosine = np.cos((np.arange(_NUM_ANGLES) + 0.5) * pi / _NUM_ANGLES)
    n, u, w, c = np.meshgrid(normal / 2, square / 2, 2 * square, cosine, indexing="ij")
    weights = np.einsum("a,b,c->abc", weight, weight_of_square, weight_of_square)
    weights = np.repeat(weights[..., None], cosine.size, axis=-1)
    values = (n, u, w, np.sqrt(u * w) * c, weights / weights.sum())
    return tuple(x.ravel() for x in values)


def _term_coefficients(bilinear: np.ndarray, dimension: int, order: int) -> np.ndarray:
    """Coefficients of `TERMS` from coefficients of a_i a_j, with a_4 by its closure."""
    pairs = bilinear + np.swapaxes(bilinear, -1, -2)
    one = pairs[..., 0, :]
    square = bilinear[..., 1, 1]
    if order == 2:
        return np.stack([bilinear[..., 0, 0], one[..., 1], square], axis=-1)
    fourth = one[..., 3, None] * np.asarray(CLOSURE[dimension])
    terms = [
        bilinear[..., 0, 0],
        one[..., 1] + fourth[..., 0],
        one[..., 2] + fourth[..., 1],
        square + fourth[..., 2],
        pairs[..., 1, 2] + fourth[..., 3],
        bilinear[..., 2, 2],
    ]
    return np.stack(terms, axis=-1)


@cache
def collision_changes(
    dimension: int, order: int, speeds: tuple[float, ...]
) -> Float[np.ndarray, "rows terms powers speeds"]:
    """Return the mean changes of velocity moments by impacts, as polynomial coefficients.

    Args:
        dimension: d.
        order: of the Sonine expansion, 2 (a_2) or 3 (a_2 and a_3).
        speeds: normal speeds g in units of sqrt(2 T).

    Returns:
        Coefficients in 1 - eps and the Sonine terms, shape (rows, terms, 7 powers of 1 - eps,
        speeds). The first `order` rows are losses, minus the change of ``c_1^(2p) + c_2^(2p)`` for
        p = 1 to order. The others are the relaxation of the velocity of a labelled sphere, minus
        the change of ``(4/d) c.c' S_j(c'^2)`` with the weight ``S_k(c^2)``, S_j = L_j^(d/2), for
        (j, k) from (0, 0) to (order - 2, order - 2), row by row. Columns as in `TERMS`.
    """
    laguerre = scipy.special.eval_genlaguerre
    centre, centre_across, relative_across, product, weights = _impact_nodes(dimension)

    def squared_velocities(g: float) -> tuple[np.ndarray, np.ndarray]:
        """Squares of the two velocities, whose relative normal velocity is g."""
        mean = centre**2 + centre_across + relative_across / 4 + g**2 / 4
        half = centre * g + product
        return mean + half, mean - half

    def sonine_polynomials(square: np.ndarray) -> np.ndarray:
        """1, S_2 at the squares of velocities; at order 3 also S_3 and S_4."""
        degrees = (0, 2) if order == 2 else (0, 2, 3, 4)
        return np.stack([laguerre(k, dimension / 2 - 1, square) for k in degrees])

    def changes_at(g: float, eps: float) -> Float[np.ndarray, "rows i j"]:
        """Rows at one g and eps, by pairs of the two Sonine polynomials."""
        square_1, square_2 = squared_velocities(g)
        after_1, after_2 = squared_velocities(-eps * g)
        losses = [square_1**p + square_2**p - after_1**p - after_2**p for p in range(1, order + 1)]
        kept = square_1 - (1 + eps) / 2 * g * (centre + g / 2)  # velocity before times after
        label = [partial(laguerre, j, dimension / 2) for j in range(order - 1)]
        relaxation = [
            4 / dimension * (square_1 * s_j(square_1) - kept * s_j(after_1)) * s_k(square_1)
            for s_j in label
            for s_k in label
        ]
        rows = np.stack(losses + relaxation)
        first = sonine_polynomials(square_1)
        second = sonine_polynomials(square_2)
        return np.einsum("rn,in,jn->rij", rows, first * weights, second, optimize=True)

    epsilons = 1 - np.linspace(0, 2, NUM_RESTITUTIONS)
    bilinear = np.array([[changes_at(g, eps) for g in speeds] for eps in epsilons])
    terms = _term_coefficients(bilinear, dimension, order)
    inverse = np.linalg.inv(np.vander(1 - epsilons, increasing=True))
    powers = np.einsum("ps,snrt->rtpn", inverse, terms)
    powers[0, :, 0] = 0.0  # elastic impacts conserve the energy and a Maxwellian distribution
    powers[:order, 0, 0] = 0.0
    return powers


@cache
def averaging_matrix(dimension: int, order: int) -> np.ndarray:
    """Return the matrix from the powers 0 to 6 of 1 - eps at the nodes to `impact_moments`."""
    changes = collision_changes(dimension, order, tuple(NODES))
    return sphere_surface(dimension) / sqrt(8 * pi) * changes * WEIGHTS


def impact_moments(
    law: ReducedLaw,
    speed: Float[Array, ""],
    dimension: int,
    order: int = 2,
    relaxation: bool = True,
) -> Float[Array, "rows terms"]:
    """Return averages over the impacts of a Maxwell-Sonine gas, exact in eps(v).

    ``mu_2p = (S_d / 2 sqrt(2 pi)) int_0^inf g exp(-g^2/2) L_p(g, eps(g)) dg`` with the loss L_p of
    ``c_1^(2p) + c_2^(2p)`` in an impact, and likewise the relaxation of a labelled sphere's
    velocity, by Gauss quadrature with 32 nodes in sqrt(g): relative error below 1e-9 for the laws
    of this package.

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        dimension: d.
        order: of the Sonine expansion: 2 has a_2, 3 also a_3.
        relaxation: whether the relaxation of velocities, for D, is asked for.

    Returns:
        Coefficients of polynomials in a_2 (and a_3), with the columns of `TERMS`. Order 2: mu_2,
        mu_4 and nu_v, the relaxation rate of the velocity autocorrelation, shape (3, 3). Order 3:
        mu_2, mu_4, mu_6 and nu_00, nu_01, nu_10, nu_11, shape (7, 6). See
        `jaxgran.theory.equations`.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution; see the
    references of this module.
    """
    powers = law.loss_powers(jnp.asarray(NODES, speed.dtype) * speed, NUM_RESTITUTIONS - 1)
    matrix = averaging_matrix(dimension, order)
    matrix = matrix if relaxation else matrix[:order]
    return jnp.tensordot(jnp.asarray(matrix, speed.dtype), powers, 2)


def mean_inelasticity(law: ReducedLaw, speed: Float[Array, ""]) -> Float[Array, ""]:
    """Return <1 - eps^2> in a Maxwellian gas, weighted by the energy of the normal motion.

    It is ``2 sqrt(2 pi)/S_d mu_2`` of `impact_moments`, by the same quadrature.

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
    """
    nodes = jnp.asarray(NODES, speed.dtype)
    weights = jnp.asarray(WEIGHTS, speed.dtype) * nodes**2 / 2
    _, loss, square = law.loss_powers(speed * nodes, 2)
    return jnp.sum(weights * (2 * loss - square))


def collision_rate(
    sonine: ArrayLike, dimension: int, third_sonine: ArrayLike = 0.0
) -> Float[Array, "..."]:
    """Return the collisions per particle and unit of reduced time, over sqrt(T/T_0).

    ``S_d / sqrt(2 pi) (1 - a_2/16 - a_3/64)``.

    Args:
        sonine: a_2, any shape.
        dimension: d.
        third_sonine: a_3, the same shape.
    """
    factor = 1 - jnp.asarray(sonine) / 16 - jnp.asarray(third_sonine) / 64
    return sphere_surface(dimension) / sqrt(2 * pi) * factor


@cache
def _loss_nodes() -> tuple[Float[np.ndarray, "nodes"], Float[np.ndarray, "nodes"]]:
    square, weight = scipy.special.roots_genlaguerre(8, 1.0)
    return np.sqrt(2 * square), 2 * weight


def loss_nodes(like: Float[Array, ""]) -> tuple[Float[Array, "nodes"], Float[Array, "nodes"]]:
    """Return normal speeds g and weights of ``int_0^inf g^3 exp(-g^2/2) f(g) dg``.

    By Gauss and Laguerre; the arrays have the dtype of `like`.
    """
    nodes, weights = _loss_nodes()
    return jnp.asarray(nodes, like.dtype), jnp.asarray(weights, like.dtype)


def loss_moments(
    law: ReducedLaw, speed: Float[Array, ""], sonine: ArrayLike = 0.0
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the mean and the mean square of the normal energy that an impact takes.

    ``<x^k> = int_0^inf g exp(-g^2/2) (1 + a_2 (g^4 - 6 g^2 + 3)/16) x^k dg`` with the loss ``x = (1
    - eps^2) g^2``, by 8 nodes of Gauss and Laguerre: relative error below 1e-3 for the laws of this
    package. The ratio ``r = <x^2>/<x>^2`` is 2 for constant restitution, 2.21 where ``1 - eps^2``
    grows as v^(1/5).

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
        sonine: a_2.

    Returns:
        <x> and <x^2> per impact of a Maxwellian gas; (m/2) T x is the energy of a pair.
    """
    g, weights = loss_nodes(speed)
    _, one, two, three, four = law.loss_powers(g * speed, 4)
    share = 2 * one - two
    square_of_share = 4 * (two - three) + four
    square = g**2
    weights = weights * (1 + sonine / 16 * (square * (square - 6) + 3))
    return jnp.sum(weights * share), jnp.sum(weights * square_of_share * square)
