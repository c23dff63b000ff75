"""Contact of two viscoelastic spheres: the normal force, and the solution of one impact."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.validation import NON_NEGATIVE

ELASTIC_CONTACT_TIME = 3.21806546
"""Duration of an elastic Hertz impact in units of ``X/v = (alpha^2 v)^(-1/5)``."""

ELASTIC_OVERLAP = 1.09336207
"""Largest overlap of an elastic Hertz impact in units of ``X = (v^2/alpha)^(2/5)``."""


def elastic_constant(
    youngs_modulus: ArrayLike, poisson_ratio: ArrayLike, diameter: ArrayLike
) -> Float[Array, ""]:
    """Hertz constant of two equal spheres, rho in ``F = rho xi^(3/2)``.

    ``rho = 2 Y sqrt(R_eff) / (3 (1 - nu^2))`` with ``R_eff = sigma / 4``.

    Args:
        youngs_modulus: Y, Pa, > 0.
        poisson_ratio: nu, in (-1, 0.5).
        diameter: sigma, m, > 0.

    Returns:
        rho, N / m^(3/2).

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eq. (2) times m_eff.

    >>> f"{float(jaxgran.elastic_constant(5e7, 0.22, 2e-3)):.3g}"
    '7.83e+05'
    """
    y = jnp.asarray(youngs_modulus)
    nu = jnp.asarray(poisson_ratio)
    sigma = jnp.asarray(diameter)
    return 2 * y * jnp.sqrt(sigma / 4) / (3 * (1 - nu**2))


def contact_force(
    overlap: ArrayLike,
    overlap_rate: ArrayLike,
    elastic_constant: ArrayLike,
    dissipative_constant: ArrayLike,
    *,
    clipped: bool = True,
) -> Float[Array, "..."]:
    """Normal force between two viscoelastic spheres, positive if it is repulsive.

    ``F = rho sqrt(xi) (xi + (3/2) A xi_dot)`` for xi > 0, otherwise 0. Unless ``clipped=False``,
    negative values are replaced by 0, since spheres without adhesion cannot attract each other.

    Args:
        overlap: xi = sigma - r, m, any shape.
        overlap_rate: xi_dot, m/s, same shape, positive while the spheres approach.
        elastic_constant: rho, N / m^(3/2), see `jaxgran.elastic_constant`.
        dissipative_constant: A, s, >= 0.
        clipped: whether the contact ends at F = 0 (True) or at xi = 0 (False).

    Returns:
        F, N, same shape. Values and derivatives are finite at xi = 0, where the derivative is
        taken as 0.

    Reference: Brilliantov, Spahn, Hertzsch & Poeschel, Phys. Rev. E 53, 5382 (1996).

    >>> rho = jaxgran.elastic_constant(5e7, 0.22, 2e-3)
    >>> f"{float(jaxgran.contact_force(1e-6, 0.0, rho, 3e-6)):.3g} N"
    '0.000783 N'
    """
    xi = jnp.asarray(overlap)
    touching = xi > 0
    root = jnp.sqrt(jnp.where(touching, xi, 1.0))
    # F over rho sqrt(xi); a contact between spheres without adhesion ends where it is 0.
    scaled_force = xi + 1.5 * jnp.asarray(dissipative_constant) * jnp.asarray(overlap_rate)
    if clipped:
        scaled_force = jnp.maximum(scaled_force, 0.0)
    return jnp.where(touching, elastic_constant * root * scaled_force, 0.0)


def midpoint_rate(
    overlap: ArrayLike,
    overlap_rate: ArrayLike,
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    dt: ArrayLike,
) -> Float[Array, "..."]:
    """Mean of the overlap rates before and after a velocity update at fixed overlap.

    The update is ``xi_dot' = xi_dot - dt alpha sqrt(xi) (xi + (3/2) A r)`` with the mean
    ``r = (xi_dot + xi_dot')/2``: the implicit midpoint rule, of second order. Its solution is
    ``r = (xi_dot - h xi) / (1 + (3/2) A h)`` with ``h = dt alpha sqrt(xi) / 2``. The work of the
    force at this rate, ``F r dt``, is exactly the change of the kinetic energy.

    Args:
        overlap: xi, any shape; for xi <= 0 the rate is returned unchanged.
        overlap_rate: xi_dot before the update, same shape.
        alpha: elastic constant over effective mass.
        dissipative_constant: A, >= 0.
        dt: time step of the update.

    Returns:
        r, same shape.
    """
    xi = jnp.asarray(overlap)
    touching = xi > 0
    half = 0.5 * dt * alpha * jnp.sqrt(jnp.where(touching, xi, 1.0))
    rate = jnp.asarray(overlap_rate)
    mean = (rate - half * xi) / (1 + half * 1.5 * jnp.asarray(dissipative_constant))
    return jnp.where(touching, mean, rate)


class Impact(NamedTuple):
    """Result of one head-on impact, in units of its initial speed v and ``X = (v^2/alpha)^(2/5)``.

    Attributes:
        restitution: coefficient of restitution eps.
        duration: contact duration, in X/v.
        largest_overlap: largest overlap, in X.

    >>> jaxgran.Impact._fields
    ('restitution', 'duration', 'largest_overlap')
    """

    restitution: Float[Array, ""]
    duration: Float[Array, ""]
    largest_overlap: Float[Array, ""]


def impact(
    beta: ArrayLike, *, clipped: bool = True, rtol: float = 1e-11, max_steps: int = 1_000_000
) -> Impact:
    """Solve one head-on impact of two viscoelastic spheres, from first contact to separation.

    With ``xi = X y^2`` and ``t = (X/v) int 2y ds`` the equation of motion
    ``xi'' = -alpha sqrt(xi) (xi + (3/2) A xi')`` becomes ``y' = w``,
    ``w' = -2 y^2 (y^2 + beta w)`` from ``(y, w) = (0, 1)``. These equations are polynomial and have
    no square-root singularity at first contact. Compression ends at ``w = 0``, the contact ends at
    ``y^2 + beta w = 0`` (clipped) or ``y = 0``.

    Args:
        beta: ``(3/2) A alpha^(2/5) v^(1/5)``, dimensionless, >= 0, a scalar (use `jax.vmap` for
            more). Derivatives (forward mode only) need beta > 0.
        clipped: whether the contact ends at zero force (True, the default) or at zero overlap.
        rtol: relative tolerance of the adaptive eighth-order solver, at least ten roundings of the
            type of floats.
        max_steps: largest number of steps of each half of the impact. The default suffices for
            beta <= 1e4 (clipped) and for beta <= 1e3 (unclipped, where the slow rebound takes
            seconds to compute).

    Returns:
        `jaxgran.Impact` with the restitution, the duration in X/v and the largest overlap in X.

    Raises:
        ValueError: for a negative beta, unless it is traced.

    >>> impact = jaxgran.impact(0.1)
    >>> round(float(impact.restitution), 4), round(float(impact.duration), 3)
    (0.8929, 3.157)
    """
    NON_NEGATIVE.check("beta", beta, "It is 1.5 A alpha^0.4 v^0.2.")
    beta = jnp.asarray(beta, dtype=jnp.result_type(float))
    rtol = max(rtol, 10 * float(jnp.finfo(beta.dtype).eps))
    zero = jnp.zeros_like(beta)
    one = jnp.ones_like(beta)
    # Order of magnitude of the rebound speed; the absolute tolerance must be much smaller.
    rebound_speed = (1 + jax.lax.stop_gradient(beta)) ** (-5 / 3 if clipped else -5)
    integrate = partial(
        _integrate_until, beta=beta, rtol=rtol, atol=rtol * rebound_speed, max_steps=max_steps
    )
    compressed = integrate(lambda state, beta: state.w, ContactState(y=zero, w=one, time=zero))
    separation = _scaled_stress if clipped else lambda state, beta: state.y
    # Exactly 0, and not only within the tolerance.
    parted = integrate(separation, compressed._replace(w=zero))
    largest_overlap = compressed.y * compressed.y
    return Impact(restitution=-parted.w, duration=parted.time, largest_overlap=largest_overlap)


class ContactState(NamedTuple):
    """State within an impact, in the variables of `impact`.

    Attributes:
        y: root of the overlap over X.
        w: derivative of y in s.
        time: since first contact, in X/v.
    """

    y: Float[Array, ""]
    w: Float[Array, ""]
    time: Float[Array, ""]


def _rates(state: ContactState, beta: Float[Array, ""]) -> ContactState:
    # xi = X y^2 and dt = (X/v) 2 y ds turn xi'' = -sqrt(xi) (xi + beta xi') into polynomials.
    y, w, _ = state
    return ContactState(y=w, w=-2 * y * y * (y * y + beta * w), time=2 * y)


def _scaled_stress(state: ContactState, beta: Float[Array, ""]) -> Float[Array, ""]:
    # sqrt(xi) - sqrt(-beta w) has the same root as the stress xi + beta w, and always a simple one.
    attraction = jnp.maximum(-beta * state.w, 0.0)
    positive = attraction > 0
    return state.y - jnp.where(positive, jnp.sqrt(jnp.where(positive, attraction, 1.0)), 0.0)


def _integrate_until(
    end: Callable[[ContactState, Array], Array],
    state: ContactState,
    *,
    beta: Float[Array, ""],
    rtol: float,
    atol: Float[Array, ""],
    max_steps: int,
) -> ContactState:
    """Integrate the state of an impact until `end(state, beta)` is 0."""
    solve = partial(
        diffrax.diffeqsolve,
        solver=diffrax.Dopri8(),
        dt0=None,
        args=beta,
        adjoint=diffrax.ForwardMode(),
        max_steps=max_steps,
    )
    overshot = solve(
        diffrax.ODETerm(lambda s, state, beta: _rates(state, beta)),
        t0=0.0,
        t1=jnp.inf,
        y0=state,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol, dtmax=0.25 + beta),
        event=diffrax.Event(lambda t, y, args, **_: end(y, args) <= 0),
    )
    beyond = jax.tree.map(lambda leaf: leaf[-1], overshot.ys)

    # The event stops the solver up to one step after the root. A second integration, backwards with
    # `end` as the independent variable, reaches the root within the tolerance of the solver and
    # needs no interpolation (Henon, Physica D 5, 412 (1982)).
    def rates_per_end(_, state: ContactState, beta: Float[Array, ""]) -> ContactState:
        rates = _rates(state, beta)
        _, slope = jax.jvp(lambda state: end(state, beta), (state,), (rates,))
        return jax.tree.map(lambda rate: rate / slope, rates)

    exact = solve(
        diffrax.ODETerm(rates_per_end),
        t0=end(beyond, beta),
        t1=0.0,
        y0=beyond,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
    )
    return jax.tree.map(lambda leaf: leaf[-1], exact.ys)
