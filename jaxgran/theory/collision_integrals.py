"""How one impact changes the velocity moments of a gas, averaged over all but its normal speed.

Two spheres meet with the normal speed g. What else their velocities are, the velocity of their
centre along the normal and across it and their relative velocity across it, is distributed as in a
Maxwellian gas times ``(1 + a_2 S_2 + a_3 S_3 + a_4 S_4)`` for each sphere. The averages over it are
integrals of polynomials with Gaussian weights, here done by Gauss quadrature, which is exact for
them. Velocities c are in units of sqrt(2 T), S_k are the Laguerre polynomials L_k^(d/2 - 1)(c^2).

References: Brilliantov & Poeschel, Europhys. Lett. 74, 424 (2006), and Santos & Montanero, Granular
Matter 11, 157 (2009), for mu_2, mu_4, mu_6 with a_3 at constant eps; Garzo & Montanero, Phys. Rev.
E 69, 021301 (2004), for the second Sonine approximation of D.
"""

from functools import cache
from math import pi
from typing import NamedTuple

import numpy as np
import scipy  # whose scipy.special is imported when it is first used
from jaxtyping import Float

SAMPLES = 7
"""Values of eps from which the polynomials in 1 - eps, of sixth degree, are found."""

# Nodes that integrate polynomials of degree 18 in the velocities exactly.
_ALONG, _ACROSS, _ANGLES = 10, 5, 6

CLOSURE = {2: (0.1127, 0.2725, 4.1658, -2.8628), 3: (0.0667, 0.2452, 4.8105, -1.4002)}
"""p, q, r, s of ``a_4 = p a_2 + q a_3 + r a_2^2 + s a_2 a_3`` by dimension.

The Sonine series of an inelastic gas is asymptotic, since its velocity distribution falls off
exponentially: cut off behind a_3 it gives an a_2 that is 6 % (3D) and 11 % (2D) too small at
eps = .5 and 28 % and 40 % at 0, and cut off behind a_4 one that is too large. The term in a_2^2 is
that of a gas whose temperature varies in space or time. The numbers were chosen so that a_2 and a_3
of the homogeneous cooling state agree with direct simulation by a code of its own (constant eps
from 0 to .95); ``experiments/accuracy/sonine_coefficients.py`` tells how well they do for other
gases.
"""


class Terms(NamedTuple):
    """Powers of a_2 and a_3 of the columns of a matrix of averages."""

    sonine: tuple[int, ...]
    third_sonine: tuple[int, ...]


TERMS = {
    2: Terms((0, 1, 2), (0, 0, 0)),
    3: Terms((0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)),
}
"""1, a_2, a_2^2 of a gas followed to a_2; and 1, a_2, a_3, a_2^2, a_2 a_3, a_3^2."""


class _Impacts(NamedTuple):
    """Velocities before impacts of one normal speed, and the weights of the average over them.

    Attributes:
        centre: velocity of the centre along the normal.
        centre_across: square of the part of it across.
        relative_across: square of the relative velocity across.
        product: scalar product of the two last vectors.
        weights: with the sum 1.
    """

    centre: Float[np.ndarray, "nodes"]
    centre_across: Float[np.ndarray, "nodes"]
    relative_across: Float[np.ndarray, "nodes"]
    product: Float[np.ndarray, "nodes"]
    weights: Float[np.ndarray, "nodes"]


@cache
def _impacts(dimension: int) -> _Impacts:
    along, weight = np.polynomial.hermite_e.hermegauss(_ALONG)
    square, weight_of_square = scipy.special.roots_genlaguerre(_ACROSS, (dimension - 3) / 2)
    if dimension == 2:
        cosine = np.array([-1.0, 1.0])
    else:
        cosine = np.cos((np.arange(_ANGLES) + 0.5) * pi / _ANGLES)
    n, u, w, c = np.meshgrid(along / 2, square / 2, 2 * square, cosine, indexing="ij")
    weights = np.einsum("a,b,c->abc", weight, weight_of_square, weight_of_square)
    weights = np.repeat(weights[..., None], cosine.size, axis=-1)
    values = (n, u, w, np.sqrt(u * w) * c, weights / weights.sum())
    return _Impacts(*(x.ravel() for x in values))


def _squares(at: _Impacts, g: float) -> tuple[np.ndarray, np.ndarray]:
    """Squares of the two velocities, whose relative normal velocity is g."""
    mean = at.centre**2 + at.centre_across + at.relative_across / 4 + g**2 / 4
    half = at.centre * g + at.product
    return mean + half, mean - half


def _distribution(square: np.ndarray, dimension: int, highest: int) -> np.ndarray:
    """1, S_2, ... up to S_highest at the squares of velocities."""
    orders = [0, *range(2, highest + 1)]
    return np.stack([scipy.special.eval_genlaguerre(k, dimension / 2 - 1, square) for k in orders])


def _of_terms(bilinear: np.ndarray, dimension: int, order: int) -> np.ndarray:
    """Coefficients of `TERMS` out of those of the products a_i a_j, with a_4 by its closure."""
    pairs = bilinear + np.swapaxes(bilinear, -1, -2)
    one, square = pairs[..., 0, :], bilinear[..., 1, 1]
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
def changes(dimension: int, order: int, speeds: tuple[float, ...]) -> Float[np.ndarray, "..."]:
    """Mean changes of velocity moments by impacts, as polynomials in 1 - eps and the Sonine terms.

    Args:
        dimension: d.
        order: of the Sonine expansion, 2 (a_2) or 3 (a_2 and a_3).
        speeds: normal speeds g in units of sqrt(2 T).

    Returns:
        Shape (rows, terms, 7 powers of 1 - eps, speeds). The first `order` rows are losses, minus
        the change of ``c_1^(2p) + c_2^(2p)`` for p = 1 to order. The others are the relaxation of
        the velocity of a labelled sphere, minus the change of ``(4/d) c.c' S_j(c'^2)`` with the
        weight ``S_k(c^2)``, S_j = L_j^(d/2), for (j, k) from (0, 0) to (order - 2, order - 2), row
        by row. Columns as in `TERMS`.
    """
    at, epsilons = _impacts(dimension), 1 - np.linspace(0, 2, SAMPLES)
    highest = 2 if order == 2 else 4
    sampled = np.stack(
        [
            np.stack([_changes(at, g, e, dimension, order, highest) for e in epsilons], axis=-1)
            for g in speeds
        ],
        axis=-1,
    )
    inverse = np.linalg.inv(np.vander(1 - epsilons, increasing=True))
    powers = np.einsum("ps,rtsn->rtpn", inverse, _of_terms_first(sampled, dimension, order))
    powers[0, :, 0] = 0.0  # elastic impacts keep the energy, and a Maxwellian gas as it is
    powers[:order, 0, 0] = 0.0
    return powers


def _of_terms_first(sampled: np.ndarray, dimension: int, order: int) -> np.ndarray:
    bilinear = np.moveaxis(sampled, (1, 2), (-2, -1))
    return np.moveaxis(_of_terms(bilinear, dimension, order), -1, 1)


def _changes(
    at: _Impacts, g: float, eps: float, dimension: int, order: int, highest: int
) -> Float[np.ndarray, "rows i j"]:
    """The rows of `changes` at one g and eps, by the pairs of Sonine polynomials of the spheres."""
    one, other = _squares(at, g)
    after, other_after = _squares(at, -eps * g)
    first = _distribution(one, dimension, highest) * at.weights
    second = _distribution(other, dimension, highest)
    losses = [one**p + other**p - after**p - other_after**p for p in range(1, order + 1)]
    # The scalar product of a velocity before and after.
    kept = one - (1 + eps) / 2 * g * (at.centre + g / 2)
    of_label = [
        lambda x, j=j: scipy.special.eval_genlaguerre(j, dimension / 2, x) for j in range(order - 1)
    ]
    relaxation = [
        4 / dimension * (one * s_j(one) - kept * s_j(after)) * s_k(one)
        for s_j in of_label
        for s_k in of_label
    ]
    rows = np.stack(losses + relaxation)
    return np.einsum("rn,in,jn->rij", rows, first, second, optimize=True)
