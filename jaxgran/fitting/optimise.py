"""Fits through a deterministic model, whose residuals have no noise of their own.

Minimisers of a sum of squared residuals that have no noise.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.parameters import NO_PRIORS, Priors
from jaxgran.fitting.residuals import (
    QUANTITIES,
    Comparison,
    correlation_factor,
    neighbour_correlation,
)
from jaxgran.fitting.result import Fit, Minima, misfit, search_starts
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

CONVERGED_STEP = 0.01
"""Length of a Gauss-Newton step, in standard errors, below which it is the last one."""

TOLERANCE = 1e-7
"""Relative and absolute tolerance of the minimisers, of the parameters and of the objective."""

Residuals = Callable[[Float[Array, "p"]], Float[Array, "residuals"]]
Minimum = tuple[Float[Array, "p"], Int[Array, ""], Bool[Array, ""]]
"""Where a search ended, after how many iterations, and whether it converged."""
Search = Callable[[Residuals, Float[Array, "p"], int], Minimum]


def is_converged(residuals: Float[Array, "n"], jacobian: Float[Array, "n p"]) -> Bool[Array, ""]:
    """Whether the next Gauss-Newton step is shorter than `AT_REST` standard errors.

    The components of the step along the right singular vectors of the Jacobian, in standard errors
    for residuals of unit variance, are those of the residuals along the left singular vectors. The
    variance is taken from the residuals. Singular values so small that only round-off is left do
    not count.
    """
    left, singular, _ = jnp.linalg.svd(jacobian, full_matrices=False)
    known = singular > jnp.finfo(singular.dtype).eps ** 0.5 * singular[0]
    step = jnp.max(jnp.where(known, jnp.abs(residuals @ left), 0.0))
    return step < CONVERGED_STEP * jnp.sqrt(jnp.mean(residuals**2))


class _TrustRegion(optx.ClassicalTrustRegion):
    """Stops once the Gauss-Newton step is below AT_REST standard errors.

    That step is accepted and the next one has length 0, which ends the search. Steps so short
    change chi^2 by no more than its round-off: the classical rule would reject half of them, and
    the search would not reach its tolerance.
    """

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        step_size, accept, *rest = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        assert isinstance(f_info, optx.FunctionInfo.ResidualJac)
        ended = is_converged(f_info.residual, f_info.jac.as_matrix())
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


class SearchEnds(NamedTuple):
    """Where searches ended, and chi^2 there; infinite where it is not known."""

    flats: Float[Array, "starts p"]
    chi2: Float[Array, "starts"]


def best_of_starts(
    residuals: Residuals, search: Search, starts: Float[Array, "starts p"], max_steps: int
) -> tuple[Minimum, SearchEnds]:
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
        return found, SearchEnds(found[0][None], chi2[None])
    (flats, steps, converged), chi2 = jax.lax.map(one, starts)
    best = jnp.argmin(chi2)
    return (flats[best], jnp.sum(steps), converged[best]), SearchEnds(flats, chi2)


def _minimum(solution: optx.Solution) -> Minimum:
    converged = solution.result == optx.RESULTS.successful
    return jnp.asarray(solution.value), solution.stats["num_steps"], converged


SEARCHES = {"levenberg-marquardt": least_squares, "lbfgs": quasi_newton}
"""Minimisers by the name of the method."""


@eqx.filter_jit
def fit_deterministic(
    gas: Gas,
    curve: CoolingCurve,
    model: AbstractModel,
    names: tuple[str, ...],
    guesses: list[Gas],
    num_particles: Float[Array, ""] | None = None,
    replicas: Float[Array, ""] | float = 1.0,
    method: str = "levenberg-marquardt",
    max_steps: int = 100,
    priors: Priors = NO_PRIORS,
    of_errors: dict[str, Float[Array, ""]] | None = None,
    clock_accuracy: Float[Array, "times"] | None = None,
) -> Fit:
    """Fit through a deterministic model, from the best of some guesses.

    Args, returns: as `jaxgran.fit`; of_errors are the degrees of freedom of the errors, see
    `jaxgran.fitting.residuals.smooth_errors`; clock_accuracy is the relative accuracy of the
    model's clock at each time, which is fitted along where there are priors.
    """
    known = num_particles, replicas, priors, clock_accuracy
    comparison = Comparison.of(gas, curve, model, names, *known)
    first = comparison.best(guesses)
    search = SEARCHES[method]
    several = first[None]
    if "rotation" in comparison.weights:
        here = comparison.of_gas(first)
        several = search_starts(comparison.parameters, here, first[here.size :])
    found = best_of_starts(comparison.residuals, search, several, max_steps)
    flat, iterations, converged = found[0]
    if curve.temperature_error is None:
        comparison = comparison.scaled(flat)
        if priors.names:  # which now have their right weight beside the curve
            flat, more, converged = search(comparison.residuals, flat, max_steps)
            comparison, iterations = comparison.scaled(flat), iterations + more
    result = _fit_at(comparison, names, of_errors or {}, first, flat, iterations, converged)
    if len(several) == 1:
        return result
    estimates = jax.vmap(comparison.estimates)(found[1].flats)
    return dataclasses.replace(result, minima=Minima(estimates, found[1].chi2))


def _fit_at(
    comparison: Comparison,
    names: tuple[str, ...],
    of_errors: dict[str, Float[Array, ""]],
    first: Float[Array, "q"],
    flat: Float[Array, "q"],
    iterations: Int[Array, ""],
    converged: Bool[Array, ""],
) -> Fit:
    """The fit whose search began at one and ended at another point."""
    derivatives = jax.jacfwd(comparison.evaluate, argnums=(0, 1), has_aux=True)
    (jacobian, clock_slope), (residuals, computed) = derivatives(flat, jnp.ones(()))
    parts = comparison.split(residuals)
    gain = _gain(comparison, flat, jacobian)
    gains = comparison.split(gain)
    used = jnp.sum(jnp.concatenate([*comparison.weights.values()]) > 0)
    own = residuals.size - comparison.num_measured
    degrees_of_freedom = used + own - flat.size
    num_used = {name: jnp.sum(weights > 0) for name, weights in comparison.weights.items()}
    degrees = num_used["measurement"] - comparison.num_free
    tested = [(parts["measurement"], degrees, of_errors.get("measurement"))]
    for name in comparison.accuracies:
        own_part = jnp.concatenate([parts[name], parts[f"model of {QUANTITIES[name]}"]])
        tested.append((own_part, num_used[name], of_errors.get(name)))
    known = comparison.curve.temperature_error is not None
    chance = misfit(tested, degrees_of_freedom, errors_known=known)
    clock_gain = _clock_gain(comparison.split(clock_slope), gains)
    shape = comparison.curve.times.shape
    clock_error = jnp.broadcast_to(jnp.asarray(comparison.clock_accuracy, flat.dtype), shape)
    moved = clock_gain @ clock_error
    covariances = {"model": jnp.outer(moved, moved)}
    covariances |= _covariances(comparison, gains, parts["measurement"], chance.inflation)
    return Fit(
        names=names,
        model=comparison.model,
        estimate=comparison.estimates(flat),
        covariances=covariances,
        clock_error=clock_error,
        gain=gains["measurement"] * comparison.weights["measurement"][None],
        clock_gain=clock_gain,
        sensitivity=jacobian[: comparison.num_measured, : comparison.num_free],
        extrapolation=jnp.zeros(comparison.num_free, flat.dtype),
        start=comparison.estimates(first),
        gas=comparison.parameters.gas(comparison.of_gas(flat)),
        start_time=jnp.asarray(comparison.parameters.start(comparison.of_gas(flat)), flat.dtype),
        priors=comparison.priors,
        curve=dataclasses.replace(computed, times=comparison.curve.times),
        weights=comparison.weights["measurement"],
        residuals=parts["measurement"],
        displacement_residuals=parts.get("displacement"),
        rotation_residuals=parts.get("rotation"),
        scatter=comparison.scatter,
        chi2=chance.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=iterations,
        converged=converged & jnp.isfinite(chance.chi2),
    )


def _gain(
    comparison: Comparison, flat: Float[Array, "q"], jacobian: Float[Array, "residuals q"]
) -> Float[Array, "p residuals"]:
    """Change of each estimate, SI, for a change of the residuals at fixed parameters by 1."""
    left, singular, rotation = jnp.linalg.svd(jacobian, full_matrices=False)
    spread = rotation.T / jnp.maximum(singular, jnp.finfo(flat.dtype).tiny ** 0.5)[None]
    return -jax.jacfwd(comparison.estimates)(flat) @ spread @ left.T


def _clock_gain(
    slope: dict[str, Float[Array, "part"]], gains: dict[str, Float[Array, "p part"]]
) -> Float[Array, "p times"]:
    """Change of each estimate, SI, over a relative change of the model's clock at each time.

    Args:
        slope: derivatives of the residuals in a factor of all times.
        gains: changes of the estimates over those of the residuals.
    """
    measured = [name for name in ("measurement", "rotation", "displacement") if name in slope]
    moved = [gains[name] * slope[name][None] for name in measured]
    return sum(moved[1:], moved[0])


def _covariances(
    comparison: Comparison,
    gains: dict[str, Float[Array, "p part"]],
    residuals: Float[Array, "times"],
    inflation: Float[Array, ""],
) -> dict[str, Float[Array, "p p"]]:
    """The parts of the covariance, but for that of a clock that is not fitted."""
    covariances = {name: part @ part.T for name, part in gains.items()}
    correlation = neighbour_correlation(residuals, comparison.weights["measurement"] > 0)
    measured = correlation_factor(correlation) ** 2 * covariances["measurement"]
    for name in {"rotation", "displacement"} & covariances.keys():
        measured = measured + covariances.pop(name)
    return covariances | {"measurement": inflation * measured}
