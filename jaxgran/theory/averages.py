"""Averages over the impacts of a gas with a Maxwell-Sonine velocity distribution.

Units: `Gas.impact_speed`, sqrt(2 T_0), and `Gas.path_length`, 1 / (n g_2 sigma^(d-1)); the unit of
time ("reduced time") is their ratio. In these units the averages depend on the reduced law, the
dimension and T/T_0 only.

Two spheres meet with the normal speed g. The other components of their velocities (of the velocity
of their centre along the normal and across it, and of their relative velocity across it) have the
distribution of a Maxwellian gas times ``(1 + a_2 S_2 + a_3 S_3 + a_4 S_4)`` for each sphere. The
averages over them are integrals of polynomials with Gaussian weights, for which Gauss quadrature is
exact. Velocities c are in units of sqrt(2 T), S_k are the Laguerre polynomials L_k^(d/2 - 1)(c^2).
`impact_moments` integrates over g, and `RateTable` tabulates the result for the temperatures that a
gas reaches.

References: Brilliantov & Poeschel, Europhys. Lett. 74, 424 (2006), and Santos & Montanero, Granular
Matter 11, 157 (2009), for mu_2, mu_4, mu_6 with a_3 at constant eps; Garzo & Montanero, Phys. Rev.
E 69, 021301 (2004), for the second Sonine approximation of D.
"""

from collections.abc import Callable
from functools import cache, partial
from math import pi, sqrt

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy  # imports scipy.special at its first use
from jaxtyping import Array, ArrayLike, Float

from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
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


_STEEP = 5.0
"""m above which `slip_moments` uses a series in 1/m^2."""

_STEEP_SERIES = [2 * (-1) ** n * (n + 1) / (2 * n + 3) for n in range(9, -1, -1)]
"""``m^2 (m arccot m - m^2/(1 + m^2))`` in powers of 1/m^2, the highest first."""


def slip_moments(m: Float[Array, "..."] | None, d: int) -> list[Float[Array, "..."]]:
    """Return means of a slip y and an impulse ``z = min(y, m x)`` at the normal speed x of impacts.

    y has d - 1 Gaussian components of variance 1, and x the density ``x exp(-x^2/2)``.

    Args:
        m: any shape; None where all spheres stick, m = infinity.
        d: dimension.

    Returns:
        The means of y z, z^2, y^2 z^2, y^3 z, z^4, y z^3, x^2 y z and x^2 z^2, each of the shape
        of m. With ``c = m/sqrt(1 + m^2)`` the first two are ``c^2 + m arccot m`` and ``2 c^2`` in
        3D, and ``c`` and ``2 c^2/(1 + c)`` in 2D.
    """
    c = jnp.ones(()) if m is None else m / jnp.sqrt(1 + m**2)
    if d == 2:
        w = c**2 / (1 + c)
        return [
            c,
            2 * w,
            2 * (w + c**3),
            2 * c + c**3,
            4 * w**2 * (2 + c),
            3 * c**3,
            3 * c - c**3,
            2 * w * (4 - c - c**2),
        ]
    x = c**2
    g = jnp.ones(())
    h = 2 / 3
    if m is not None:
        g = m * jnp.arctan2(1.0, m)
        series = jnp.polyval(jnp.asarray(_STEEP_SERIES, c.dtype), jnp.maximum(m, _STEEP) ** -2)
        h = jnp.where(m < _STEEP, jnp.minimum(m, _STEEP) ** 2 * (g - x), series)
    return [
        g + x,
        2 * x,
        4 * x * (1 + x),
        3 * (g + x) + 2 * x**2,
        8 * x**2,
        3 * h + 6 * x**2,
        3 * (g + x) - 2 * x**2,
        4 * x * (2 - x),
    ]


def rough_impact_means(
    T: Float[Array, "spheres n"],
    a: Float[Array, "spheres n"],
    S: Float[Array, "1 n"],
    V: Float[Array, "1 n"],
    m: Float[Array, "1 n"] | None,
    impulse: Float[Array, ""],
    eta: Float[Array, ""],
    inertia: Float[Array, ""],
    d: int,
    gaussian: bool = False,
) -> list[Float[Array, "spheres n"]]:
    """Return mean changes of a sphere in an impact, times the impact rate over its value at T = 1.

    The components of velocities v and of ``s = (sigma/2) w`` are Gaussian. Given the slip u and the
    normal speed g, the components along the slip are Gaussian, around ``(T/V) u`` for v and around
    ``(a/V) u`` for s. The impulse along the slip is the smaller one of eta u and Coulomb's limit.

    Args:
        T: variances of the components of v of both spheres.
        a: variances of the components of s of both spheres.
        S: variance of the components of the relative velocity, the sum of the two T.
        V: variance of the components of the slip, the sum of S and of the two a.
        m: see `slip_moments`, with ``m = mu (1 + eps)/2 / eta sqrt(S/V)``; None without a limit.
        impulse: (1 + eps)/2.
        eta: coefficient of `Rough`.
        inertia: q.
        d: dimension.
        gaussian: leave out the changes of v^2 s^2 and s^4.

    Returns:
        The changes of v^2 by the tangential and by the normal part, the impulse times the slip over
        V, the changes of s^2, v^2 s^2 and s^4.
    """
    N = NUM_SPIN_COMPONENTS[d]
    r = 1 / inertia
    uJ, JJ, uuJJ, uuuJ, J4, uJ3, gguJ, ggJJ = slip_moments(m, d)
    z = eta * r
    normal = impulse * (impulse * S - 2 * T)
    of_v = eta * (eta * V * JJ - 2 * T * uJ)
    of_s = z * (z * V * JJ - 2 * a * uJ)
    rate = jnp.sqrt(S / 2)
    slipping = jnp.broadcast_to(eta * uJ, T.shape)
    changes = [rate * x for x in (of_v, 2 * normal, slipping, of_s)]
    if gaussian:
        return changes
    per_S = 1 / S
    per_V = 1 / V
    both = T * a
    rest = a + r * T
    along_n = T * T * per_S
    pushed = along_n + normal
    of_vs = (
        2 * N * a * normal
        + eta * (2 * both * (((d + 1) * rest) * per_V - (N + r * d)) + 2 * r * a * along_n) * uJ
        - 2 * eta * both * rest * per_V * uuuJ
        + eta**2 * (N * a * V - (d - 1) * (a**2) - 4 * r * both) * JJ
        + z**2 * (d * T * V - (d - 1) * T**2 - along_n * V) * JJ
        + eta**2 * (rest**2 + 2 * r * both) * uuJJ
        + z**2 * eta**2 * V**2 * J4
        - 2 * z * eta**2 * V * rest * uJ3
        + z * pushed * (z * V * ggJJ - 2 * a * gguJ)
    )
    spin = a * ((N + 2) * V - (d + 1) * a)
    of_ss = (
        -4 * z * a * per_V * (spin * uJ + a**2 * uuuJ)
        + 2 * z**2 * (spin * JJ + 3 * a**2 * uuJJ)
        + z**4 * V**2 * J4
        - 4 * z**3 * a * V * uJ3
    )
    return [*changes, rate * of_vs, rate * of_ss]


def rough_energy_moments(
    losses: tuple[Float[Array, ""], Float[Array, ""]],
    m: Float[Array, ""] | None,
    eta: Float[Array, ""],
    inertia: Float[Array, ""],
    S: Float[Array, ""],
    A: Float[Array, ""],
    d: int,
) -> tuple[Float[Array, "2"], Float[Array, "2 2"]]:
    """Return moments of the energies that an impact of rough spheres adds, over m T and its square.

    The energies are the translational one, ``e = -x/2 + z^2 - z g``, and the rotational one,
    ``e' = z^2/q - z s``, with the loss x of the normal motion, the tangential velocities g of the
    centres and s of the surfaces along the slip u = g + s, and the impulse z along it, the smaller
    one of eta u and Coulomb's limit. Velocities are Gaussian: given u the means of g and s are
    ``(S/V) u`` and ``(A/V) u``, with V = S + A.

    Args:
        losses: <x> and <x^2>, see `loss_moments`.
        m: see `slip_moments`, with ``m = mu (1 + eps)/2 / eta sqrt(S/V)``; None without a limit.
        eta: coefficient of `Rough`.
        inertia: q.
        S: variance of the components of the relative velocity over T, 2 of two Maxwellian spheres.
        A: the same for the sum of both (sigma/2) w, 2 T_rot/(q T).
        d: dimension.

    Returns:
        <e> and <e'>; and the matrix <e^2>, <e e'>; <e e'>, <e'^2>.
    """
    uJ, JJ, uuJJ, _, J4, uJ3, gguJ, ggJJ = slip_moments(m, d)
    q = inertia
    V = S + A
    means = -losses[0] / 2 + eta * (eta * V * JJ - S * uJ), eta * (eta / q * V * JJ - A * uJ)
    fourth = eta**4 * V**2 * J4
    third = eta**3 * V * uJ3
    second = eta**2 * S * A * JJ
    mixed = eta**2 * uuJJ
    # With a constant eps, x and the slip would depend on each other by the speed alone.
    normal = -losses[0] / 4
    kick = eta**2 * V * ggJJ
    square = fourth - 2 * S * third + S**2 * mixed + second
    square = square + losses[1] / 4 + 2 * normal * (kick - eta * S * gguJ)
    both = fourth / q - (A + S / q) * third + S * A * mixed - second
    both = both + normal * (kick / q - eta * A * gguJ)
    square_of_spin = fourth / q**2 - 2 * A / q * third + A**2 * mixed + second
    squares = jnp.stack([jnp.stack([square, both]), jnp.stack([both, square_of_spin])])
    return jnp.stack(means), squares


ElementBounds = tuple[ArrayLike, ArrayLike, ArrayLike | None, ArrayLike | None]
"""Bounds of the effects of elements on T: `jaxgran.theory.elements.element_bounds`."""

_SCAN_POINTS = 16
"""Temperatures at which the cooling rate is computed to determine the range of a `RateTable`."""


class RateTable(eqx.Module):
    """Averages over the impacts of one gas (`impact_moments`) as a Chebyshev series in ln T.

    The averages are smooth in ln T, so that a few quadratures in advance replace one in every
    stage of the ODE solver.

    Attributes:
        coefficients: of the Chebyshev polynomials, shape (nodes, rows, terms), or (nodes, ...,
            rows, terms) for several such functions over the same range.
        lowest: lower end of the series in ln(T/T_0). The series must not be evaluated outside.
        highest: upper end, 0 unless the gas is heated.
    """

    coefficients: Float[Array, "nodes ... rows terms"]
    lowest: Float[Array, ""]
    highest: Float[Array, ""]

    @classmethod
    def from_function(
        cls,
        averages: Callable[[Float[Array, ""]], Float[Array, "rows terms"]],
        lowest: Float[Array, ""],
        highest: Float[Array, ""],
        num_nodes: int,
    ) -> "RateTable":
        """Return the series in a range of temperatures.

        Args:
            averages: the function to be tabulated, of sqrt(T/T_0).
            lowest, highest: ends of ln(T/T_0), see `log_temperature_range`.
            num_nodes: number of terms; see `ReducedLaw.num_nodes`.
        """
        nodes, to_coefficients = (jnp.asarray(x, lowest.dtype) for x in _chebyshev(num_nodes))
        speeds = jnp.exp(highest / 2 + (lowest - highest) * (1 - nodes) / 4)
        values = jax.vmap(averages)(speeds)
        return cls(jnp.tensordot(to_coefficients, values, 1), lowest, highest)

    def __call__(self, log_theta: Float[Array, ""]) -> Float[Array, "... rows terms"]:
        """Return the averages at ln(T/T_0), as the tabulated function returns them.

        Args:
            log_theta: ln(T/T_0), from `lowest` to `highest`.
        """
        x = 2 * (1 - (log_theta - self.highest) / (self.lowest - self.highest)) - 1
        if self.coefficients.ndim > 3:  # a matrix product is faster for many functions
            polynomials = [jnp.ones_like(x), x]
            for _ in range(2, len(self.coefficients)):
                polynomials.append(2 * x * polynomials[-1] - polynomials[-2])
            return jnp.tensordot(jnp.stack(polynomials), self.coefficients, 1)
        # Clenshaw's recurrence, from the highest term down.
        last = before = jnp.zeros_like(self.coefficients[0])
        for row in self.coefficients[:0:-1]:
            last, before = row + 2 * x * last - before, last
        return self.coefficients[0] + x * last - before

    def with_slopes(self, slopes: Float[Array, "directions nodes rows terms"]) -> "RateTable":
        """Return the function, its slope and its derivatives as one function of ln(T/T_0).

        Args:
            slopes: coefficients of the derivatives of the function in some directions.

        Returns:
            A table of shape (2 + directions, rows, terms) at each temperature: the function, its
            derivative in ln(T/T_0), and those given.
        """
        derivative = jnp.asarray(_derivative_matrix(len(self.coefficients)), self.lowest.dtype)
        width = self.highest - self.lowest
        slope = jnp.tensordot(derivative, self.coefficients, 1) * 2 / width
        both = jnp.stack([self.coefficients, slope], axis=1)
        derivatives = jnp.moveaxis(slopes, 0, 1)
        return RateTable(jnp.concatenate([both, derivatives], 1), self.lowest, self.highest)


@cache
def _chebyshev(num_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Chebyshev nodes in [-1, 1], and the matrix from values at them to coefficients."""
    angles = (np.arange(num_nodes) + 0.5) * pi / num_nodes
    matrix = 2 / num_nodes * np.cos(np.outer(np.arange(num_nodes), angles))
    matrix[0] /= 2
    return np.cos(angles), matrix


@cache
def _derivative_matrix(num_nodes: int) -> np.ndarray:
    """Matrix that takes the coefficients of a Chebyshev series to its derivative."""
    return np.pad(np.polynomial.chebyshev.chebder(np.eye(num_nodes)), ((0, 1), (0, 0)))


def log_temperature_range(
    law: ReducedLaw,
    duration: Float[Array, ""],
    dimension: int,
    bounds: ElementBounds = (0.0, 0.0, None, None),
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Bounds of ln(T/T_0) within a reduced time, the lower one negative and not far below the true
    value, the upper one 0, or positive where the gas is heated. They have no derivatives.

    The first lower bound is Haff's law for e = 0 with 10 % added to the rate. A law with small
    losses at low speed cools much less; a series over the whole range would lose digits. Therefore
    the time to cool is bounded from below by integrating the law's rate, with 10 % added, over
    `_SCAN_POINTS` temperatures, and the range is cut off one point below the temperature reached.

    The first upper bound has no losses, ``T_0 + xi_0^2 t`` and the whole energy of rotation. Smooth
    spheres do not heat up beyond the temperature at which their impacts take the power of the
    drive, with half of the losses to spare for a_2 and soft contacts; the range is cut off one of
    `_SCAN_POINTS` temperatures above it.

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        duration: reduced time.
        dimension: d.
        bounds: of the effects of the elements of the scene on T (`element_bounds`); by default for
            smooth spheres without walls, drag and drive.
    """
    law, duration, bounds = jax.lax.stop_gradient((law, duration, bounds))
    by_speed, constant, heating, rotation = bounds

    def scan_to(bound: Array) -> tuple[Array, Array, Array]:
        scan = bound * jnp.linspace(0, 1, _SCAN_POINTS, dtype=bound.dtype)
        speeds = jnp.exp(scan / 2)
        return scan, speeds, collisions / 2 * jax.vmap(partial(mean_inelasticity, law))(speeds)

    collisions = sphere_surface(dimension) / sqrt(2 * pi)
    haff = 1.1 * collisions / (2 * dimension) + by_speed / 2
    bound = -2 * jnp.log1p(haff * duration) - constant * duration
    scan, speeds, loss = scan_to(bound)
    rate = 2.2 / dimension * loss * speeds + by_speed * speeds + constant
    if heating is not None:
        rate = rate - heating / speeds**2
    rate = jnp.maximum(rate, jnp.finfo(bound.dtype).tiny)
    earliest = jnp.cumsum(-jnp.diff(scan) / jnp.maximum(rate[1:], rate[:-1]))
    reached = jnp.min(jnp.where(earliest < duration, scan[1:], 0.0))
    lowest = jnp.minimum(jnp.maximum(reached + scan[1], bound), -1e-3)
    if heating is None:
        return lowest, jnp.zeros_like(lowest)
    bound = jnp.log1p(heating * duration + (0.0 if rotation is None else rotation))
    if rotation is None:
        scan, speeds, loss = scan_to(bound)
        balanced = loss / dimension * speeds >= heating / speeds**2
        stop = jnp.min(jnp.where(balanced, scan, bound))
        bound = jnp.minimum(bound, stop + scan[1])
    return lowest, jnp.maximum(bound, 1e-3)
