"""Fits through a deterministic model, whose residuals have no noise of their own."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.comparison import QUANTITIES, Comparison
from jaxgran.fitting.least_squares import deepest, least_squares, quasi_newton
from jaxgran.fitting.minima import Minima, starts
from jaxgran.fitting.priors import NO_PRIORS, Priors
from jaxgran.fitting.residuals import correlation_factor, neighbour_correlation
from jaxgran.fitting.result import Fit, misfit
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

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
    `jaxgran.fitting.few_replicas.smooth_errors`; clock_accuracy is the relative accuracy of the
    model's clock at each time, which is fitted along where there are priors.
    """
    known = num_particles, replicas, priors, clock_accuracy
    comparison = Comparison.of(gas, curve, model, names, *known)
    first = comparison.best(guesses)
    search = SEARCHES[method]
    several = first[None]
    if "rotation" in comparison.weights:
        here = comparison.of_gas(first)
        several = starts(comparison.parameters, here, first[here.size :])
    found = deepest(comparison.residuals, search, several, max_steps)
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
        beyond=jnp.zeros(comparison.num_free, flat.dtype),
        start=comparison.estimates(first),
        gas=comparison.parameters.gas(comparison.of_gas(flat)),
        began=jnp.asarray(comparison.parameters.start(comparison.of_gas(flat)), flat.dtype),
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
