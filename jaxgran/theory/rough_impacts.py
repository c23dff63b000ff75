"""Averages over the impacts of rough spheres, which may slide.

Units are the same as in `jaxgran.theory.averages`.
"""

from math import pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.laws import ReducedLaw
from jaxgran.scene.reduced import ReducedRough

TYPICAL_IMPACT = 2 * sqrt(2 / pi)
"""Mean normal speed of impacts, weighted by itself, in units of sqrt(2 T)."""

MAX_STICKING = 1e6
"""Bound of `coulomb_limit`, above which no sphere slides in double precision."""


def mean_impulse(law: ReducedLaw, speed: Float[Array, "*points"]) -> Float[Array, "*points"]:
    """Return (1 + eps)/2 of the typical impact: the normal impulse over m times the normal speed.

    The cooling of sliding spheres of ice is then right within 2 %.

    Args:
        law: law of restitution in units of `Gas.impact_speed`.
        speed: sqrt(T/T_0).
    """
    return (1 + law.restitution(TYPICAL_IMPACT * speed)) / 2


def coulomb_limit(
    surface: ReducedRough, eta: Array, impulse: Array, variance: Array
) -> Float[Array, "..."] | None:
    """Return m of `SlipMoments`, ``mu (1 + eps)/2 / (eta sqrt(V/S))``; None without friction.

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


class SlipMoments(NamedTuple):
    """Means over impacts of products of the slip u, the impulse J along it and the normal speed g.

    The components of the slip have the variance V, those of the relative velocity the variance S.
    u is in units of sqrt(V), J in units of eta sqrt(V), and g in units of sqrt(S): u has d - 1
    Gaussian components of variance 1, and g the density ``g exp(-g^2/2)``. Spheres stick or slide,
    with ``J = min(u, m g)``.

    Attributes:
        uJ, J2, u2J2, u3J: of u J, J^2, u^2 J^2 and u^3 J. With ``c = m/sqrt(1 + m^2)`` the first
            two are ``c^2 + m arccot m`` and ``2 c^2`` in 3D, and ``c`` and ``2 c^2/(1 + c)`` in 2D.
        J4, uJ3: of J^4 and u J^3.
        g2uJ, g2J2: of g^2 u J and g^2 J^2.
    """

    uJ: Float[Array, "..."]
    J2: Float[Array, "..."]
    u2J2: Float[Array, "..."]
    u3J: Float[Array, "..."]
    J4: Float[Array, "..."]
    uJ3: Float[Array, "..."]
    g2uJ: Float[Array, "..."]
    g2J2: Float[Array, "..."]


_LARGE_M = 5.0
"""m above which `slip_moments` uses a series in 1/m^2."""

_LARGE_M_SERIES = [2 * (-1) ** n * (n + 1) / (2 * n + 3) for n in range(9, -1, -1)]
"""``m^2 (m arccot m - m^2/(1 + m^2))`` in powers of 1/m^2, the highest first."""


def slip_moments(m: Float[Array, "..."] | None, d: int) -> SlipMoments:
    """Return the means of `SlipMoments`, each of the shape of m.

    Args:
        m: Coulomb's limit of J over g, see `coulomb_limit`, any shape; None where all spheres
            stick, m = infinity.
        d: dimension.
    """
    c = jnp.ones(()) if m is None else m / jnp.sqrt(1 + m**2)
    if d == 2:
        half_J2 = c**2 / (1 + c)
        return SlipMoments(
            uJ=c,
            J2=2 * half_J2,
            u2J2=2 * (half_J2 + c**3),
            u3J=2 * c + c**3,
            J4=4 * half_J2**2 * (2 + c),
            uJ3=3 * c**3,
            g2uJ=3 * c - c**3,
            g2J2=2 * half_J2 * (4 - c - c**2),
        )
    c2 = c**2
    m_arccot = jnp.ones(())
    difference = 2 / 3  # m^2 (m arccot m - c^2), whose terms nearly cancel where m is large
    if m is not None:
        m_arccot = m * jnp.arctan2(1.0, m)
        series = jnp.polyval(jnp.asarray(_LARGE_M_SERIES, c.dtype), jnp.maximum(m, _LARGE_M) ** -2)
        direct = jnp.minimum(m, _LARGE_M) ** 2 * (m_arccot - c2)
        difference = jnp.where(m < _LARGE_M, direct, series)
    return SlipMoments(
        uJ=m_arccot + c2,
        J2=2 * c2,
        u2J2=4 * c2 * (1 + c2),
        u3J=3 * (m_arccot + c2) + 2 * c2**2,
        J4=8 * c2**2,
        uJ3=3 * difference + 6 * c2**2,
        g2uJ=3 * (m_arccot + c2) - 2 * c2**2,
        g2J2=4 * c2 * (2 - c2),
    )


class RoughImpactMeans(NamedTuple):
    """Mean changes of a sphere in an impact, times the impact rate over its value at T = 1.

    Attributes:
        v2_tangential, v2_normal: of v^2 by the tangential and by the normal part of the impulse.
        slipping: the tangential impulse times the slip, over V.
        s2: of s^2.
        v2s2, s4: of v^2 s^2 and of s^4; None where v and s are taken to be Gaussian.
    """

    v2_tangential: Float[Array, "spheres n"]
    v2_normal: Float[Array, "spheres n"]
    slipping: Float[Array, "spheres n"]
    s2: Float[Array, "spheres n"]
    v2s2: Float[Array, "spheres n"] | None = None
    s4: Float[Array, "spheres n"] | None = None


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
) -> RoughImpactMeans:
    """Return mean changes of both spheres in an impact.

    The components of velocities v and of ``s = (sigma/2) w`` are Gaussian. Given the slip u and the
    normal speed g, the components along the slip are Gaussian, around ``(T/V) u`` for v and around
    ``(a/V) u`` for s. The impulse along the slip is the smaller one of eta u and Coulomb's limit.

    Args:
        T: variances of the components of v of both spheres.
        a: variances of the components of s of both spheres.
        S: variance of the components of the relative velocity, the sum of the two T.
        V: variance of the components of the slip, the sum of S and of the two a.
        m: see `coulomb_limit`; None without a limit.
        impulse: (1 + eps)/2.
        eta: coefficient of `Rough`.
        inertia: q.
        d: dimension.
        gaussian: leave out the changes of v^2 s^2 and s^4.
    """
    num_spins = NUM_SPIN_COMPONENTS[d]
    # Along the slip, s changes by r times the change of v.
    r = 1 / inertia
    slip = slip_moments(m, d)
    eta_s = eta * r
    normal = impulse * (impulse * S - 2 * T)
    of_v2 = eta * (eta * V * slip.J2 - 2 * T * slip.uJ)
    of_s2 = eta_s * (eta_s * V * slip.J2 - 2 * a * slip.uJ)
    rate = jnp.sqrt(S / 2)
    slipping = jnp.broadcast_to(eta * slip.uJ, T.shape)
    means = RoughImpactMeans(rate * of_v2, rate * (2 * normal), rate * slipping, rate * of_s2)
    if gaussian:
        return means
    per_S = 1 / S
    per_V = 1 / V
    Ta = T * a
    a_and_rT = a + r * T
    # Square of the normal velocity over g^2 of `SlipMoments`, as far as g determines it.
    normal_v2 = T * T * per_S
    normal_v2_after = normal_v2 + normal
    of_v2s2 = (
        2 * num_spins * a * normal
        + eta
        * (2 * Ta * (((d + 1) * a_and_rT) * per_V - (num_spins + r * d)) + 2 * r * a * normal_v2)
        * slip.uJ
        - 2 * eta * Ta * a_and_rT * per_V * slip.u3J
        + eta**2 * (num_spins * a * V - (d - 1) * (a**2) - 4 * r * Ta) * slip.J2
        + eta_s**2 * (d * T * V - (d - 1) * T**2 - normal_v2 * V) * slip.J2
        + eta**2 * (a_and_rT**2 + 2 * r * Ta) * slip.u2J2
        + eta_s**2 * eta**2 * V**2 * slip.J4
        - 2 * eta_s * eta**2 * V * a_and_rT * slip.uJ3
        + eta_s * normal_v2_after * (eta_s * V * slip.g2J2 - 2 * a * slip.g2uJ)
    )
    across = a * ((num_spins + 2) * V - (d + 1) * a)
    of_s4 = (
        -4 * eta_s * a * per_V * (across * slip.uJ + a**2 * slip.u3J)
        + 2 * eta_s**2 * (across * slip.J2 + 3 * a**2 * slip.u2J2)
        + eta_s**4 * V**2 * slip.J4
        - 4 * eta_s**3 * a * V * slip.uJ3
    )
    return means._replace(v2s2=rate * of_v2s2, s4=rate * of_s4)


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

    The energies are the translational one, ``e = -x/2 + z^2 - z v``, and the rotational one,
    ``e' = z^2/q - z s``. Here x is the loss of the normal motion; v and s are the relative
    tangential velocities of the centres and of the surfaces about them, along the slip u = v + s;
    z is the impulse along it, the smaller one of eta u and Coulomb's limit. Velocities are
    Gaussian: given u the means of v and s are ``(S/V) u`` and ``(A/V) u``, with V = S + A.

    Args:
        losses: <x> and <x^2>, see `loss_moments`.
        m: see `coulomb_limit`; None without a limit.
        eta: coefficient of `Rough`.
        inertia: q.
        S: variance of the components of the relative velocity over T, 2 of two Maxwellian spheres.
        A: the same for the sum of both (sigma/2) w, 2 T_rot/(q T).
        d: dimension.

    Returns:
        <e> and <e'>; and the matrix <e^2>, <e e'>; <e e'>, <e'^2>.
    """
    slip = slip_moments(m, d)
    loss, loss_square = losses
    q = inertia
    V = S + A
    mean = -loss / 2 + eta * (eta * V * slip.J2 - S * slip.uJ)
    mean_of_spin = eta * (eta / q * V * slip.J2 - A * slip.uJ)
    z4 = eta**4 * V**2 * slip.J4
    z3u = eta**3 * V * slip.uJ3
    # z^2 times the square of v or s: by their means at a slip, and by the deviations from these.
    by_deviation = eta**2 * S * A * slip.J2
    by_mean = eta**2 * slip.u2J2
    # -x/2 over g^2, as for a constant eps: then only g correlates x with z.
    normal = -loss / 4
    z2g2 = eta**2 * V * slip.g2J2
    square = z4 - 2 * S * z3u + S**2 * by_mean + by_deviation
    square = square + loss_square / 4 + 2 * normal * (z2g2 - eta * S * slip.g2uJ)
    both = z4 / q - (A + S / q) * z3u + S * A * by_mean - by_deviation
    both = both + normal * (z2g2 / q - eta * A * slip.g2uJ)
    square_of_spin = z4 / q**2 - 2 * A / q * z3u + A**2 * by_mean + by_deviation
    squares = jnp.stack([jnp.stack([square, both]), jnp.stack([both, square_of_spin])])
    return jnp.stack([mean, mean_of_spin]), squares
