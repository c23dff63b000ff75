"""Least squares for residuals without noise, and fits of deterministic models by it."""

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
from jaxgran.fitting.result import Fit, Minima, goodness_of_fit, search_starts
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

CONVERGED_STEP = 0.01
"""Length of a Gauss-Newton step, in standard errors, below which a search has converged."""

TOLERANCE = 1e-7
"""Relative and absolute tolerance of the minimisers, for the parameters and the objective."""

Residuals = Callable[[Float[Array, "p"]], Float[Array, "residuals"]]


Minimum = tuple[Float[Array, "p"], Int[Array, ""], Bool[Array, ""]]
"""Parameters at the end of a search, the number of iterations, and True if it converged."""

Search = Callable[[Residuals, Float[Array, "p"], int], Minimum]


def least_squares(residuals: Residuals, first: Float[Array, "p"], max_steps: int) -> Minimum:
    """Minimise the sum of squares by Levenberg-Marquardt, with forward-mode Jacobians.

    Args:
        residuals: function of the parameters.
        first: the initial guess.
        max_steps: maximum number of iterations.
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
    """Minimise the sum of squares by L-BFGS, with reverse-mode gradients.

    The first step goes along the gradient to the minimum for residuals linearised at the initial
    guess (the Cauchy step), but no further than 1: a factor e of a positive parameter. The
    objective is scaled accordingly, because L-BFGS starts with a Hessian of 1.

    Args:
        residuals, first: as for `least_squares`.
        max_steps: maximum number of evaluations, including those of line searches.
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


SEARCHES = {"levenberg-marquardt": least_squares, "lbfgs": quasi_newton}
"""Minimisers by the name of their method."""


def is_converged(residuals: Float[Array, "n"], jacobian: Float[Array, "n p"]) -> Bool[Array, ""]:
    """Return True if the next Gauss-Newton step is shorter than `CONVERGED_STEP` standard errors.

    The components of the step along the right singular vectors of the Jacobian, in standard errors
    for residuals of unit variance, are those of the residuals along the left singular vectors. The
    variance is estimated from the residuals. Singular values at the level of round-off are ignored.
    """
    left, singular, _ = jnp.linalg.svd(jacobian, full_matrices=False)
    known = singular > jnp.finfo(singular.dtype).eps ** 0.5 * singular[0]
    step = jnp.max(jnp.where(known, jnp.abs(residuals @ left), 0.0))
    return step < CONVERGED_STEP * jnp.sqrt(jnp.mean(residuals**2))


class _TrustRegion(optx.ClassicalTrustRegion):
    """Trust region that stops once the Gauss-Newton step is below `CONVERGED_STEP`.

    That step is accepted and the next one has length 0, which ends the search. Such short steps
    change chi^2 by less than its round-off: the classical rule would reject half of them, and the
    search would not reach its tolerance.
    """

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        step_size, accept, *rest = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        assert isinstance(f_info, optx.FunctionInfo.ResidualJac)
        ended = is_converged(f_info.residual, f_info.jac.as_matrix())
        return jnp.where(ended, 0.0, step_size), accept | ended, *rest


def _minimum(solution: optx.Solution) -> Minimum:
    converged = solution.result == optx.RESULTS.successful
    return jnp.asarray(solution.value), solution.stats["num_steps"], converged


class SearchEnds(NamedTuple):
    """Parameters at the end of several searches, and chi^2 there; infinite if it is nan."""

    flats: Float[Array, "starts p"]
    chi2: Float[Array, "starts"]


def best_of_starts(
    residuals: Residuals, search: Search, starts: Float[Array, "starts p"], max_steps: int
) -> tuple[Minimum, SearchEnds]:
    """Search from several starts; return the deepest minimum, with the steps of all searches.

    Args:
        residuals: function of the parameters.
        search: `least_squares` or `quasi_newton`.
        starts: initial guesses.
        max_steps: maximum number of iterations from each start.
    """

    def search_from(start: Array) -> tuple[Minimum, Array]:
        minimum = search(residuals, start, max_steps)
        chi2 = jnp.sum(residuals(minimum[0]) ** 2)
        return minimum, jnp.where(jnp.isnan(chi2), jnp.inf, chi2)

    if len(starts) == 1:
        minimum, chi2 = search_from(starts[0])
        return minimum, SearchEnds(minimum[0][None], chi2[None])
    (flats, steps, converged), chi2 = jax.lax.map(search_from, starts)
    best = jnp.argmin(chi2)
    return (flats[best], jnp.sum(steps), converged[best]), SearchEnds(flats, chi2)


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
    error_degrees: dict[str, Float[Array, ""]] | None = None,
    clock_accuracy: Float[Array, "times"] | None = None,
) -> Fit:
    """Fit a deterministic model, starting at the best of some guesses.

    Arguments and result are those of `jaxgran.fit`. `error_degrees` are the degrees of freedom of
    the errors, see `jaxgran.fitting.residuals.smooth_errors`. `clock_accuracy` is the relative
    accuracy of the model's clock at each time; the clock is a free parameter if there are priors.
    """
    comparison = Comparison.of(
        gas, curve, model, names, num_particles, replicas, priors, clock_accuracy
    )
    first = comparison.best_guess(guesses)
    search = SEARCHES[method]
    starts = first[None]
    if "rotation" in comparison.weights:
        of_gas = comparison.gas_parameters(first)
        starts = search_starts(comparison.parameters, of_gas, first[of_gas.size :])
    minimum, ends = best_of_starts(comparison.residuals, search, starts, max_steps)
    flat, iterations, converged = minimum
    if curve.temperature_error is None:
        comparison = comparison.with_scatter_as_error(flat)
        if priors.names:  # search again with the correct weight of the priors
            flat, more, converged = search(comparison.residuals, flat, max_steps)
            comparison, iterations = comparison.with_scatter_as_error(flat), iterations + more
    result = _deterministic_result(
        comparison, names, error_degrees or {}, first, flat, iterations, converged
    )
    if len(starts) == 1:
        return result
    estimates = jax.vmap(comparison.estimates)(ends.flats)
    return dataclasses.replace(result, minima=Minima(estimates, ends.chi2))


def _deterministic_result(
    comparison: Comparison,
    names: tuple[str, ...],
    error_degrees: dict[str, Float[Array, ""]],
    first: Float[Array, "q"],
    flat: Float[Array, "q"],
    iterations: Int[Array, ""],
    converged: Bool[Array, ""],
) -> Fit:
    """Return the fit of a search that started at `first` and ended at `flat`."""
    derivatives = jax.jacfwd(comparison.evaluate, argnums=(0, 1), has_aux=True)
    (jacobian, clock_slope), (residuals, computed) = derivatives(flat, jnp.ones(()))
    parts = comparison.split(residuals)
    gain = _gain(comparison, flat, jacobian)
    gains = comparison.split(gain)
    used = jnp.sum(jnp.concatenate([*comparison.weights.values()]) > 0)
    num_priors = residuals.size - comparison.num_measured
    degrees_of_freedom = used + num_priors - flat.size
    num_used = {name: jnp.sum(weights > 0) for name, weights in comparison.weights.items()}
    degrees = num_used["measurement"] - comparison.num_free
    tested = [(parts["measurement"], degrees, error_degrees.get("measurement"))]
    for name in comparison.accuracies:
        with_prior = jnp.concatenate([parts[name], parts[f"model of {QUANTITIES[name]}"]])
        tested.append((with_prior, num_used[name], error_degrees.get(name)))
    errors_known = comparison.curve.temperature_error is not None
    goodness = goodness_of_fit(tested, degrees_of_freedom, errors_known=errors_known)
    clock_gain = _clock_gain(comparison.split(clock_slope), gains)
    shape = comparison.curve.times.shape
    clock_error = jnp.broadcast_to(jnp.asarray(comparison.clock_accuracy, flat.dtype), shape)
    shift = clock_gain @ clock_error
    covariances = {"model": jnp.outer(shift, shift)}
    covariances |= _covariances(comparison, gains, parts["measurement"], goodness.inflation)
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
        gas=comparison.parameters.gas(comparison.gas_parameters(flat)),
        start_time=jnp.asarray(
            comparison.parameters.start(comparison.gas_parameters(flat)), flat.dtype
        ),
        priors=comparison.priors,
        curve=dataclasses.replace(computed, times=comparison.curve.times),
        weights=comparison.weights["measurement"],
        residuals=parts["measurement"],
        displacement_residuals=parts.get("displacement"),
        rotation_residuals=parts.get("rotation"),
        scatter=comparison.scatter,
        chi2=goodness.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=goodness.reduced,
        p_value=goodness.p_value,
        iterations=iterations,
        converged=converged & jnp.isfinite(goodness.chi2),
    )


def _gain(
    comparison: Comparison, flat: Float[Array, "q"], jacobian: Float[Array, "residuals q"]
) -> Float[Array, "p residuals"]:
    """Derivative of each estimate, SI, in the residuals at fixed parameters."""
    left, singular, right = jnp.linalg.svd(jacobian, full_matrices=False)
    spread = right.T / jnp.maximum(singular, jnp.finfo(flat.dtype).tiny ** 0.5)[None]
    return -jax.jacfwd(comparison.estimates)(flat) @ spread @ left.T


def _clock_gain(
    slope: dict[str, Float[Array, "part"]], gains: dict[str, Float[Array, "p part"]]
) -> Float[Array, "p times"]:
    """Derivative of each estimate, SI, in a relative change of the model's clock at each time.

    Args:
        slope: derivatives of the residuals in a factor of all times.
        gains: derivatives of the estimates in the residuals.
    """
    measured = [name for name in ("measurement", "rotation", "displacement") if name in slope]
    shifts = [gains[name] * slope[name][None] for name in measured]
    return sum(shifts[1:], shifts[0])


def _covariances(
    comparison: Comparison,
    gains: dict[str, Float[Array, "p part"]],
    residuals: Float[Array, "times"],
    inflation: Float[Array, ""],
) -> dict[str, Float[Array, "p p"]]:
    """Return the parts of the covariance, without that of a clock that is not a free parameter."""
    covariances = {name: part @ part.T for name, part in gains.items()}
    correlation = neighbour_correlation(residuals, comparison.weights["measurement"] > 0)
    measured = correlation_factor(correlation) ** 2 * covariances["measurement"]
    for name in {"rotation", "displacement"} & covariances.keys():
        measured = measured + covariances.pop(name)
    return covariances | {"measurement": inflation * measured}
