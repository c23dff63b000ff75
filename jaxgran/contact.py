"""Two viscoelastic spheres in contact: the normal force, and one impact from touch to release."""

from functools import partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxgran.domain import NOT_NEGATIVE


def elastic_constant(
    youngs_modulus: ArrayLike, poisson_ratio: ArrayLike, diameter: ArrayLike
) -> Float[Array, ""]:
    """Hertz constant rho of two equal spheres, in ``F = rho xi^(3/2)``.

    ``rho = 2 Y sqrt(R_eff) / (3 (1 - nu^2))`` with ``R_eff = diameter / 4``.

    Args:
        youngs_modulus: Y, Pa, > 0.
        poisson_ratio: nu, in (-1, 0.5).
        diameter: sigma, m, > 0.

    Returns:
        rho, N / m^(3/2).

    Reference: Brilliantov & Poeschel, Self-diffusion in granular gases, Eq. (2) times m_eff.
    """
    y, nu, sigma = jnp.asarray(youngs_modulus), jnp.asarray(poisson_ratio), jnp.asarray(diameter)
    return 2 * y * jnp.sqrt(sigma / 4) / (3 * (1 - nu**2))


def stress(
    overlap: ArrayLike, overlap_rate: ArrayLike, relaxation_time: ArrayLike
) -> Float[Array, "..."]:
    """Force over ``rho sqrt(xi)``: ``xi + (3/2) A xi_dot``; its zero is the end of contact.

    Args:
        overlap: xi = sigma - r, positive in contact.
        overlap_rate: xi_dot, positive while approaching.
        relaxation_time: (3/2) A.
    """
    return jnp.asarray(overlap) + relaxation_time * jnp.asarray(overlap_rate)


def contact_force(
    overlap: ArrayLike,
    overlap_rate: ArrayLike,
    elastic_constant: ArrayLike,
    dissipative_constant: ArrayLike,
    *,
    clipped: bool = True,
) -> Float[Array, "..."]:
    """Normal force between two spheres, positive when it pushes them apart.

    ``F = rho sqrt(xi) (xi + (3/2) A xi_dot)`` for xi > 0, else 0; clipped at zero from below
    unless ``clipped=False``, since spheres without adhesion cannot pull.

    Args:
        overlap: xi, m, any shape.
        overlap_rate: xi_dot, m/s, same shape; positive while approaching.
        elastic_constant: rho, N / m^(3/2), see `elastic_constant`.
        dissipative_constant: A, s, >= 0.
        clipped: end the contact where F = 0 (True) or where xi = 0 (False).

    Returns:
        F, N. Values and derivatives are finite at xi = 0, where the derivative is taken as 0.
    """
    xi = jnp.asarray(overlap)
    touching = xi > 0
    root = jnp.sqrt(jnp.where(touching, xi, 1.0))
    strength = stress(xi, overlap_rate, 1.5 * jnp.asarray(dissipative_constant))
    if clipped:
        strength = jnp.maximum(strength, 0.0)
    return jnp.where(touching, elastic_constant * root * strength, 0.0)


def midpoint_rate(
    overlap: ArrayLike,
    overlap_rate: ArrayLike,
    alpha: ArrayLike,
    dissipative_constant: ArrayLike,
    dt: ArrayLike,
) -> Float[Array, "..."]:
    """Mean of the overlap rates before and after a kick of two spheres on each other, xi fixed.

    The kick takes ``xi_dot`` to ``xi_dot' = xi_dot - dt alpha sqrt(xi) (xi + (3/2) A r)`` with the
    mean ``r = (xi_dot + xi_dot')/2`` itself in it (implicit midpoint rule, second order); solved,
    ``r = (xi_dot - h xi) / (1 + (3/2) A h)``, ``h = dt alpha sqrt(xi) / 2``. With this rate the
    work of the force, ``F r dt``, is exactly the kinetic energy that the kick takes.

    Args:
        overlap: xi >= 0, any shape; the rate is returned unchanged for xi < 0.
        overlap_rate: xi_dot before the kick, same shape.
        alpha: elastic constant over effective mass.
        dissipative_constant: A, >= 0.
        dt: duration of the kick.
    """
    xi = jnp.asarray(overlap)
    touching = xi > 0
    half = 0.5 * dt * alpha * jnp.sqrt(jnp.where(touching, xi, 1.0))
    rate = jnp.asarray(overlap_rate)
    mean = (rate - half * xi) / (1 + half * 1.5 * jnp.asarray(dissipative_constant))
    return jnp.where(touching, mean, rate)


class Impact(NamedTuple):
    """One head-on impact in the units of its own speed v and length ``X = (v^2/alpha)^(2/5)``.

    Attributes:
        restitution: epsilon, speed after over speed before.
        duration: contact time, in X / v.
        largest_overlap: in X.
    """

    restitution: Float[Array, ""]
    duration: Float[Array, ""]
    largest_overlap: Float[Array, ""]


def _rates(state, beta):
    # xi = X y^2 and dt = (X/v) 2 y ds turn xi'' = -sqrt(xi) (xi + beta xi') into polynomials.
    y, w, _ = state
    return w, -2 * y * y * stress(y * y, w, beta), 2 * y


def _compression_left(state, beta):
    return state[1]


def _overlap_left(state, beta):
    return state[0]


def _stress_left(state, beta):
    # sqrt(xi) - sqrt(-beta w) vanishes with the stress xi + beta w; its root is always simple.
    y, w, _ = state
    pull = jnp.maximum(-beta * w, 0.0)
    pulling = pull > 0
    return y - jnp.where(pulling, jnp.sqrt(jnp.where(pulling, pull, 1.0)), 0.0)


def _until(left, beta, state, smallest, rtol, max_steps):
    """Follow the impact until `left(state, beta)` has fallen to zero."""
    solve = partial(
        diffrax.diffeqsolve,
        solver=diffrax.Dopri8(),
        dt0=None,
        args=beta,
        adjoint=diffrax.ForwardMode(),
        max_steps=max_steps,
    )
    controller = diffrax.PIDController(rtol=rtol, atol=rtol * smallest, dtmax=0.25 + beta)
    past = solve(
        diffrax.ODETerm(lambda s, y, beta: _rates(y, beta)),
        t0=0.0,
        t1=jnp.inf,
        y0=state,
        stepsize_controller=controller,
        event=diffrax.Event(lambda t, y, args, **_: left(y, args) <= 0),
    )
    state = jax.tree.map(lambda leaf: leaf[-1], past.ys)

    # The event fires up to one step late. Stepping back with `left` itself as the independent
    # variable ends on the root to the solver's tolerance, without interpolation (Henon, 1982).
    def rates_per_left(_, state, beta):
        rates = _rates(state, beta)
        _, slope = jax.jvp(lambda state: left(state, beta), (state,), (rates,))
        return jax.tree.map(lambda rate: rate / slope, rates)

    exact = solve(
        diffrax.ODETerm(rates_per_left),
        t0=left(state, beta),
        t1=0.0,
        y0=state,
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol * smallest),
    )
    return jax.tree.map(lambda leaf: leaf[-1], exact.ys)


def impact(
    beta: ArrayLike, *, clipped: bool = True, rtol: float = 1e-11, max_steps: int = 1_000_000
) -> Impact:
    """Integrate one head-on impact from first touch to release.

    With ``xi = X y^2`` and ``t = (X/v) int 2y ds`` the equation of motion
    ``xi'' = -alpha sqrt(xi) (xi + (3/2) A xi')`` becomes ``y' = w``,
    ``w' = -2 y^2 (y^2 + beta w)`` from ``(y, w) = (0, 1)``: polynomial, hence without the
    square-root singularity at first touch. Compression ends at ``w = 0``; release is at
    ``y^2 + beta w = 0`` (clipped) or ``y = 0``.

    Args:
        beta: ``(3/2) A alpha^(2/5) v^(1/5)``, >= 0, a scalar (use `jax.vmap` for more).
            Derivatives (forward mode) need beta > 0.
        clipped: whether contact ends where the force vanishes (default) or where the overlap does.
        rtol: relative tolerance of the adaptive eighth-order solver.
        max_steps: the most steps of either half of the impact; the default serves beta <= 1e4
            (clipped) and beta <= 1e3 (unclipped, whose rebound creeps: seconds there).

    Returns:
        `Impact` with restitution, duration in X/v and largest overlap in X.

    Raises:
        ValueError: for a negative beta given as a plain number.
    """
    NOT_NEGATIVE.check("beta", beta, "It is 1.5 A alpha^0.4 v^0.2.")
    beta = jnp.asarray(beta, dtype=jnp.result_type(float))
    zero, one = jnp.zeros_like(beta), jnp.ones_like(beta)

    # A heavily damped rebound is as weak as this; its digits must survive the absolute tolerance.
    smallest = (1 + jax.lax.stop_gradient(beta)) ** (-5 / 3 if clipped else -5)
    solve = partial(_until, smallest=smallest, rtol=rtol, max_steps=max_steps)
    y, _, half_time = solve(_compression_left, beta, (zero, one, zero))
    released = _stress_left if clipped else _overlap_left
    _, w, time = solve(released, beta, (y, zero, half_time))
    return Impact(restitution=-w, duration=time, largest_overlap=y * y)
