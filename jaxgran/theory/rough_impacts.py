"""Averages over the impacts of rough spheres, which may slide.

Units are the same as in `jaxgran.theory.averages`.
"""

from math import pi, sqrt

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedRough

TYPICAL_IMPACT = 2 * sqrt(2 / pi)
"""Mean normal speed of impacts, weighted by itself, in units of sqrt(2 T)."""


def mean_impulse(law: ReducedLaw, speed: Float[Array, "*points"]) -> Float[Array, "*points"]:
    """Return (1 + eps)/2 of the typical impact: the normal impulse over m times the normal speed.

    The cooling of sliding spheres of ice is then right within 2 %.
    """
    return (1 + law.restitution(TYPICAL_IMPACT * speed)) / 2


MAX_STICKING = 1e6
"""Bound of the friction over the slip, above which no sphere slides in double precision."""


def coulomb_limit(
    surface: ReducedRough, eta: Array, impulse: Array, variance: Array
) -> Float[Array, "..."] | None:
    """Return m of `slip_moments`, ``mu (1 + eps)/2 / (eta sqrt(V/S))``; None without friction.

    Args:
        surface: in reduced units.
        eta: coefficient of `Rough`.
        impulse: (1 + eps)/2, see `mean_impulse`.
        variance: V/S, of a component of the slip over one of the relative velocity.
    """
    if surface.friction is None:
        return None
    slip = jnp.sqrt(variance) * jnp.maximum(eta, 1e-9)
    return jnp.minimum(surface.friction * impulse / slip, MAX_STICKING)


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
