"""Minimisers of a sum of squared residuals that have no noise."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

AT_REST = 0.01
"""Length of a Gauss-Newton step, in standard errors, below which it is the last one."""

TOLERANCE = 1e-7
"""Relative and absolute tolerance of the minimisers, of the parameters and of the objective."""

Residuals = Callable[[Float[Array, "p"]], Float[Array, "residuals"]]
Minimum = tuple[Float[Array, "p"], Int[Array, ""], Bool[Array, ""]]
"""Where a search ended, after how many iterations, and whether it converged."""
Search = Callable[[Residuals, Float[Array, "p"], int], Minimum]


def at_rest(residuals: Float[Array, "n"], jacobian: Float[Array, "n p"]) -> Bool[Array, ""]:
    """Whether the next Gauss-Newton step is shorter than `AT_REST` standard errors.

    The components of the step along the right singular vectors of the Jacobian, in standard errors
    for residuals of unit variance, are those of the residuals along the left singular vectors. The
    variance is taken from the residuals. Singular values so small that only round-off is left do
    not count.
    """
    left, singular, _ = jnp.linalg.svd(jacobian, full_matrices=False)
    known = singular > jnp.finfo(singular.dtype).eps ** 0.5 * singular[0]
    step = jnp.max(jnp.where(known, jnp.abs(residuals @ left), 0.0))
    return step < AT_REST * jnp.sqrt(jnp.mean(residuals**2))


class _TrustRegion(optx.ClassicalTrustRegion):
    """Stops once the Gauss-Newton step is below AT_REST standard errors.

    That step is accepted and the next one has length 0, which ends the search. Steps so short
    change chi^2 by no more than its round-off: the classical rule would reject half of them, and
    the search would not reach its tolerance.
    """

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        step_size, accept, *rest = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        assert isinstance(f_info, optx.FunctionInfo.ResidualJac)
        ended = at_rest(f_info.residual, f_info.jac.as_matrix())
        return jnp.where(ended, 0.0, step_size), accept | ended, *rest


def least_squares(residuals: Residuals, first: Float[Array, "p"], max_steps: int) -> Minimum:
    """Minimum of the sum of squares by Levenberg-Marquardt, with forward-mode Jacobians.

    Args:
        residuals: function of the parameters.
        first: the initial guess.
        max_steps: the most iterations.
    """
    solver = optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE)
    solution = optx.least_squares(
        lambda flat, _: residuals(flat),
        eqx.tree_at(lambda solver: solver.search, solver, _TrustRegion()),
        first,
        max_steps=max_steps,
        throw=False,
    )
    return _minimum(solution)


def quasi_newton(residuals: Residuals, first: Float[Array, "p"], max_steps: int) -> Minimum:
    """The same minimum by L-BFGS, with reverse-mode gradients.

    The first step goes along the gradient, as far as the residuals linearised at the initial guess
    say (the Cauchy step), but no further than 1: a factor e of a positive parameter. The objective
    is scaled for that, as L-BFGS begins with a Hessian of 1.

    Args:
        residuals, first: as for `least_squares`.
        max_steps: the most evaluations, those of line searches included.
    """

    def half_chi2(flat):
        return 0.5 * jnp.sum(residuals(flat) ** 2)

    gradient = jax.grad(half_chi2)(first)
    steepness = jnp.linalg.norm(gradient)
    steepness = jnp.where(steepness > 0, steepness, 1.0)
    _, slope = jax.jvp(residuals, (first,), (gradient / steepness,))
    scale = jnp.maximum(jnp.sum(slope**2), steepness)
    solution = optx.minimise(
        lambda flat, scale: half_chi2(flat) / scale,
        optx.LBFGS(rtol=TOLERANCE, atol=TOLERANCE),
        first,
        scale,
        max_steps=max_steps,
        throw=False,
    )
    return _minimum(solution)


class Ends(NamedTuple):
    """Where searches ended, and chi^2 there; infinite where it is not known."""

    flats: Float[Array, "starts p"]
    chi2: Float[Array, "starts"]


def deepest(
    residuals: Residuals, search: Search, starts: Float[Array, "starts p"], max_steps: int
) -> tuple[Minimum, Ends]:
    """The deepest of the minima that a search finds from several starts, with the steps of all.

    Args:
        residuals: function of the parameters.
        search: `least_squares` or `quasi_newton`.
        starts: initial guesses.
        max_steps: the most iterations from each.
    """

    def one(start: Array) -> tuple[Minimum, Array]:
        found = search(residuals, start, max_steps)
        chi2 = jnp.sum(residuals(found[0]) ** 2)
        return found, jnp.where(jnp.isnan(chi2), jnp.inf, chi2)

    if len(starts) == 1:
        found, chi2 = one(starts[0])
        return found, Ends(found[0][None], chi2[None])
    (flats, steps, converged), chi2 = jax.lax.map(one, starts)
    best = jnp.argmin(chi2)
    return (flats[best], jnp.sum(steps), converged[best]), Ends(flats, chi2)


def _minimum(solution: optx.Solution) -> Minimum:
    converged = solution.result == optx.RESULTS.successful
    return jnp.asarray(solution.value), solution.stats["num_steps"], converged
