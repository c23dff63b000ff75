"""Fits of stochastic models by a Gauss-Newton search through simulations.

Each step uses one simulation with new random numbers, and its derivatives. The estimate is the mean
of the Gauss-Newton estimates of all simulations near it; the noise of the simulations is part of
its error.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.fitting.error_budget import parameter_effects
from jaxgran.fitting.optimise import Problem
from jaxgran.fitting.parameters import SMOOTHNESS, Priors, with_floats
from jaxgran.fitting.residuals import Measurement, Rows, log_temperatures
from jaxgran.fitting.result import Fit, assemble_fit
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

MAX_STEP = 0.7
"""Longest Gauss-Newton step of a parameter in the unconstrained scale: a factor of two."""

AVERAGING_DISTANCE = 0.1
"""Distance of each parameter, in the unconstrained scale, within which simulations are averaged."""

MAX_NOISE_SHARE = 0.5
"""Share of the standard error up to which the noise needs no further simulations."""

NOISE_WINDOW = 9
"""Number of neighbouring times over which the variance between replicas is averaged."""


class Simulations(NamedTuple):
    """Simulations that are compared with a curve, of p parameters in their unconstrained scale.

    The points are those of `log_temperatures`.

    Attributes:
        simulate: function of the parameters and of a number that differs between simulations;
            returns a cooling curve with replicas.
        first: the initial guess.
        measured: values of `log_temperatures` at the used points.
        error: their standard errors; None if these are not known.
        used: True for points that have a weight.
        rotation: True if T_rot is used too.
        resolution: ratio to the largest singular value of the sensitivity below which singular
            values are ignored: the parameters do not change in those directions.
        prior: residuals of prior knowledge, a function of the parameters.
        estimates: SI values of parameters.
    """

    simulate: Callable[[Array, int], CoolingCurve]
    first: Float[np.ndarray, "p"]
    measured: Float[np.ndarray, "used"]
    error: Float[np.ndarray, "used"] | None
    used: Bool[np.ndarray, "points"]
    rotation: bool
    resolution: float
    prior: Callable[[Any], Array]
    estimates: Callable[[np.ndarray], np.ndarray]


class Search(NamedTuple):
    """Result of a search through simulations.

    Attributes:
        flat: the estimate.
        near: the simulations near it.
        sigma: standard error of each residual at the used points.
        noise_covariance: covariance of `flat` due to the noise of the simulations.
        computed: the curve of the last simulation.
        num_simulations: the number of simulations.
        converged: True if the last step was below `AVERAGING_DISTANCE`.
    """

    flat: Float[np.ndarray, "p"]
    near: "list[Simulation]"
    sigma: Float[np.ndarray, "used"]
    noise_covariance: Float[np.ndarray, "p p"]
    computed: CoolingCurve
    num_simulations: int
    converged: bool


def fit_stochastic(
    m: Measurement,
    model: AbstractModel,
    names: tuple[str, ...],
    guess: Gas,
    key: PRNGKeyArray,
    progress: bool,
    max_simulations: int,
    priors: Priors,
    search_by: Callable[[Simulations, int], Search] | None = None,
) -> Fit:
    """Fit a stochastic model, starting at a guess.

    The other arguments, result and errors are those of `jaxgran.fit`.

    Args:
        m: the curve, the only measurement.
        search_by: another search than `search_by_simulation`, which also uses the prior residuals
            of the law.
    """
    m, curve = dataclasses.replace(m, accuracies={}), m.curve
    problem = Problem.of((m,), model, names, (), {}, clock_is_free=False)
    problem.check_points()
    first = np.asarray(problem.flat({"": guess.floats}))

    def gas_at(flat: Any) -> Gas:
        return with_floats(m.scene, problem.values(flat)[""])

    if not np.all(np.isfinite(first)):
        at = ", ".join(f"{name} = {guess.value(name)}" for name in names)
        raise ValueError(
            f"a fit cannot start at {at}: positive parameters are fitted in their logarithm. Give "
            "start inside their ranges, or leave it out"
        )
    model.check_scene(gas_at(first))

    def simulate(flat, number):
        run = Run(jax.random.fold_in(key, number), progress)
        computed = model.simulate(gas_at(flat), curve.times, run)
        if computed.replicas is None or len(computed.replicas.temperature) < 2:
            raise ValueError(
                f"a fit of {type(model).__name__} needs curves with at least two replicas, whose "
                "scatter gives the noise: simulate must return CoolingCurve.of_replicas(...)"
            )
        return computed

    known, size = np.concatenate(list(m.weights.values())), len(m.weights)
    used = (known > 0) & (np.tile(np.asarray(curve.times), size) > 0)
    has_errors = curve.temperature_error is not None
    error = np.where(used, 1 / np.where(used, known, 1.0), 0.0) if has_errors else 0 * known

    def prior(flat: Any) -> Any:
        return gas_at(flat).law.prior_residuals()

    sims = Simulations(
        simulate,
        first,
        np.asarray(log_temperatures(curve, size > 1))[used],
        error[used] if np.any(error[used]) else None,
        used,
        size > 1,
        model.derivative_accuracy,
        prior,
        problem.estimates,
    )
    if search_by is None:
        search = search_by_simulation(sims, max_simulations, progress)
    else:
        search = search_by(sims, max_simulations)
    flat, near, sigma, scatter = search.flat, search.near, search.sigma, None
    weights, residuals = np.zeros(len(used)), np.zeros(len(used))
    sensitivity = np.zeros((len(used), len(flat)))
    weights[used] = 1 / sigma
    # Extrapolated from each simulation, and averaged.
    differences = [sims.measured - s.values - s.slope @ (flat - s.flat) for s in near]
    residuals[used] = np.mean(differences, axis=0) / sigma
    sensitivity[used] = np.mean([s.slope for s in near], axis=0) / sigma[:, None]
    if not has_errors:
        scatter = np.sqrt(np.sum(residuals**2) / (np.sum(residuals != 0) - flat.size))
        residuals, sensitivity, weights = (x / scatter for x in (residuals, sensitivity, weights))
    slope, changes = parameter_effects(gas_at(flat), priors, search.computed, size > 1)
    share = weights * error if has_errors else np.ones_like(weights)
    parts = [np.split(x, size) for x in (residuals, weights, -weights * slope, share)]
    rows = [
        Rows(name, "", values, {}, by_clock, of_measurement)
        for name, values, _, by_clock, of_measurement in zip(m.weights, *parts, strict=True)
    ]
    m = dataclasses.replace(m, weights=dict(zip(m.weights, parts[1], strict=True)), scatter=scatter)
    jacobian = -sensitivity
    if search_by is not None and prior(flat).size:
        rows.append(Rows(SMOOTHNESS, None, np.asarray(prior(flat)), {}))
        along = np.asarray(jax.jacfwd(prior)(jnp.asarray(flat)))
        jacobian = np.concatenate([jacobian, along])
    result = assemble_fit(
        dataclasses.replace(problem, measurements=(m,)),
        flat,
        (rows, jacobian, {"": search.computed}),
        ends=(flat[None], np.asarray([np.sum(residuals**2)])),
        iterations=np.asarray(search.num_simulations),
        converged=np.asarray(search.converged),
        resolution=model.derivative_accuracy,
    )
    scale = problem.slopes(flat)[:, None]
    gain = scale * np.linalg.pinv(sensitivity, rcond=model.derivative_accuracy) * weights[None]
    covariances = {"simulation": scale * search.noise_covariance * scale.T}
    covariances |= {name: gain @ x @ x.T @ gain.T for name, x in changes.items()}
    extrapolation = flat - np.mean([s.flat for s in near], axis=0)
    extrapolation = as_jax_arrays(scale[:, 0] * extrapolation)
    return dataclasses.replace(
        result,
        covariances=result.covariances | as_jax_arrays(covariances),
        priors={"": priors} if priors else {},
        minima=result.minima._replace(extrapolation=extrapolation),
    )


class Simulation(NamedTuple):
    """One simulation at some parameters, at the used points."""

    flat: Float[np.ndarray, "p"]
    values: Float[np.ndarray, "used"]
    slope: Float[np.ndarray, "used p"]  # derivative of the values
    deviation: Float[np.ndarray, "replicas used"]  # values of each replica minus their mean
    variance: Float[np.ndarray, "used"]  # variance of the mean over replicas


def search_by_simulation(sims: Simulations, max_simulations: int, progress: bool) -> Search:
    """Search by Gauss-Newton steps, each on one simulation and its derivatives.

    Each simulation has different random numbers. The simulations within `AVERAGING_DISTANCE` of the
    last one give independent Gauss-Newton estimates; their mean is the result. Residuals are
    weighted by the measured error and the noise of the mean of these simulations, or equally if no
    error is known. The noise of the result is estimated from the changes that single replicas
    would make to it. The search ends when a step is below `AVERAGING_DISTANCE` and the noise is
    below `MAX_NOISE_SHARE` of the standard error.

    `jaxgran.fit` describes the effect of biased derivatives.
    """
    flat, simulations = np.asarray(sims.first, float), []
    hidden = None if progress else True  # None hides the bar where there is no terminal
    with tqdm(total=max_simulations, disable=hidden, desc="fit", unit="simulation") as bar:
        while True:
            simulation, curve = run_simulation(sims, flat, len(simulations))
            simulations.append(simulation)
            near = [s for s in simulations if np.abs(s.flat - flat).max() < AVERAGING_DISTANCE]
            estimate, sigma, error_covariance, noise_covariance = average_estimates(near, sims)
            step = estimate - flat
            step *= min(1.0, MAX_STEP / max(np.abs(step).max(), 1e-300))
            converged = bool(np.abs(step).max() < AVERAGING_DISTANCE)
            flat = flat + step
            variance = np.diag(error_covariance + noise_covariance)
            low_noise = np.all(np.diag(noise_covariance) <= MAX_NOISE_SHARE**2 * variance)
            in_errors = np.abs(step / np.sqrt(variance)).max()
            bar.update()
            bar.set_postfix_str(f"last step {in_errors:.2g} standard errors")
            ended = converged and len(near) > 1 and (low_noise or sims.error is None)
            if ended or len(simulations) == max_simulations:
                break
    return Search(flat, near, sigma, noise_covariance, curve, len(simulations), converged)


def run_simulation(
    sims: Simulations, flat: Float[np.ndarray, "p"], number: int
) -> tuple[Simulation, CoolingCurve]:
    """Run one simulation with its derivatives; return it and its curve."""
    used, rotation = sims.used, sims.rotation

    def values_of(flat):
        curve = sims.simulate(flat, number)
        value = log_temperatures(curve, rotation)
        return value, (value, curve)

    slope, (value, curve) = jax.jacfwd(values_of, has_aux=True)(jnp.asarray(flat))
    replicas: Any = curve.replicas  # checked by the caller
    replica_values = np.asarray(log_temperatures(replicas, rotation))
    # T and T_rot are split, because the variance is averaged over neighbouring times.
    parts = np.split(replica_values, 1 + rotation, axis=1), np.split(used, 1 + rotation)
    used_values = [part[:, used_part] for part, used_part in zip(*parts, strict=True)]
    deviations = [part - part.mean(axis=0) for part in used_values]
    variance = np.concatenate([variance_of_mean(part) for part in deviations])
    value, slope = np.asarray(value)[used], np.asarray(slope)[used]
    return Simulation(flat, value, slope, np.concatenate(deviations, axis=1), variance), curve


def average_estimates(
    near: list[Simulation], sims: Simulations
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean of the Gauss-Newton estimates of some simulations.

    With it come the standard error of each residual (1 if errors are unknown), and the covariances
    of the mean by the errors of the measurement and by the noise of the simulations. The newest
    simulation is the last one.
    """
    measured, error, resolution = sims.measured, sims.error, sims.resolution
    noise = np.sqrt(np.mean([s.variance for s in near], axis=0) / len(near))
    sigma = np.ones_like(measured) if error is None else np.hypot(error, noise)
    estimates, noise_covariances = [], []
    for simulation in near:
        sensitivity = simulation.slope / sigma[:, None]
        inverse = np.linalg.pinv(sensitivity, rcond=resolution)
        estimates.append(simulation.flat + inverse @ ((measured - simulation.values) / sigma))
        replicas = len(simulation.deviation)
        shift = (simulation.deviation / sigma) @ inverse.T / (replicas * (replicas - 1)) ** 0.5
        noise_covariances.append(shift.T @ shift)
    # The errors of the measurement are common to all estimates: the newest simulation gives them.
    newest = near[-1].slope / sigma[:, None]
    share = np.linalg.pinv(newest, rcond=resolution) * (1.0 if error is None else error / sigma)
    noise_covariance = np.mean(noise_covariances, axis=0) / len(near)
    return np.mean(estimates, axis=0), sigma, share @ share.T, noise_covariance


def variance_of_mean(deviation: Float[np.ndarray, "replicas used"]) -> Float[np.ndarray, "used"]:
    """Variance of the mean over replicas, averaged over neighbouring times."""
    replicas, num_times = deviation.shape
    variance = np.sum(deviation**2, axis=0) / (replicas * (replicas - 1))
    window = np.ones(min(NOISE_WINDOW, num_times))
    num_averaged = np.convolve(np.ones(num_times), window, "same")
    return np.convolve(variance, window, "same") / num_averaged
