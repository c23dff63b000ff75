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

from jaxgran._utils.tracing import any_traced, as_jax_arrays
from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.fitting.error_budget import parameter_effects
from jaxgran.fitting.optimise import Problem, best_of_starts
from jaxgran.fitting.parameters import (
    NO_PRIORS,
    Priors,
    Unknown,
    domain_of,
    guess_from_data,
    with_floats,
)
from jaxgran.fitting.residuals import (
    MODEL_ERROR,
    Measurement,
    correlation_factor,
    log_temperatures,
    neighbour_correlation,
    smooth_errors,
    uses_rotation,
)
from jaxgran.fitting.result import Comparison, Fit, Minima, goodness_of_fit, search_starts
from jaxgran.models.base import AbstractModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas

MAX_STEP = 0.7
"""Longest Gauss-Newton step of a parameter in the unconstrained scale: a factor of two."""

AVERAGING_DISTANCE = 0.1
"""Distance of each parameter, in the unconstrained scale, within which simulations are averaged."""

MAX_NOISE_SHARE = 0.5
"""Share of the standard error up to which the noise needs no further simulations."""

NOISE_WINDOW = 9
"""Number of neighbouring times over which the variance between replicas is averaged."""


class SearchResult(NamedTuple):
    """Result of a search through simulations, of p parameters in their unconstrained scale.

    The points are those of `log_temperatures`.

    Attributes:
        flat: the estimate.
        computed: the curve of the last simulation.
        weights: weights of the residuals; 0 where a point is not used.
        residuals: weighted residuals at `flat`, extrapolated linearly from the simulations; 0 where
            a point is not used.
        sensitivity: derivative of the weighted residuals.
        extrapolation: `flat` minus the mean of the parameters of the simulations.
        gain: derivative of `flat` in each measured value; 0 where a point is not used.
        noise_covariance: covariance of `flat` due to the noise of the simulations.
        num_simulations: the number of simulations.
        converged: True if the last step was below `AVERAGING_DISTANCE`.
    """

    flat: Float[np.ndarray, "p"]
    computed: CoolingCurve
    weights: Float[np.ndarray, "points"]
    residuals: Float[np.ndarray, "points"]
    sensitivity: Float[np.ndarray, "points p"]
    extrapolation: Float[np.ndarray, "p"]
    gain: Float[np.ndarray, "p points"]
    noise_covariance: Float[np.ndarray, "p p"]
    num_simulations: int
    converged: bool


def fit_stochastic(
    gas: Gas,
    curve: CoolingCurve,
    model: AbstractModel,
    names: tuple[str, ...],
    guess: Gas | None = None,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
    max_simulations: int = 8,
    priors: Priors = NO_PRIORS,
    replicas: int = 1,
) -> Fit:
    """Fit a stochastic model, starting at a guess, by default the result of kinetic theory.

    Arguments, result and errors are those of `jaxgran.fit`.
    """
    if any_traced(gas, curve, guess, model, key):
        raise ValueError(
            "a fit of a stochastic model cannot run inside jax.jit or jax.vmap: fit one curve at a "
            "time, outside of them"
        )
    curve, error_degrees = smooth_errors(curve, replicas)
    guess = _guess_of_kinetic_theory(gas, curve, names) if guess is None else guess
    unknowns = tuple(
        Unknown(name, None, gas.value(name).shape, domain_of(gas, name)) for name in names
    )
    problem = Problem((), model, unknowns, sum(u.size for u in unknowns), {}, {})
    first = np.concatenate(
        [np.ravel(u.domain.to_free(np.asarray(guess.value(u.name)))) for u in unknowns]
    )

    def gas_at(flat: Any) -> Gas:
        return with_floats(gas, {u.name: value for u, value in problem.parts(flat)})

    if not np.all(np.isfinite(first)):
        at = ", ".join(f"{name} = {guess.value(name)}" for name in names)
        raise ValueError(
            f"a fit cannot start at {at}: positive parameters are fitted in their logarithm. Give "
            "start inside their ranges, or leave it out"
        )
    model.check_scene(gas_at(first))
    key = jax.random.key(0) if key is None else key

    def simulate(flat, number):
        run = Run(jax.random.fold_in(key, number), progress)
        computed = model.simulate(gas_at(flat), curve.times, run)
        _check_replicas(model, computed)
        return computed

    rotation = uses_rotation(gas, curve)
    errors_known = curve.temperature_error is not None
    error, used = _relative_errors(curve, rotation)
    search = search_by_simulation(
        simulate,
        np.asarray(first),
        np.asarray(log_temperatures(curve, rotation)),
        error,
        used,
        rotation=rotation,
        resolution=model.derivative_accuracy,
        max_simulations=max_simulations,
        progress=progress,
    )
    return _stochastic_result(
        problem,
        gas_at(search.flat),
        curve,
        first,
        search,
        priors,
        error if errors_known else None,
        error_degrees,
    )


def _relative_errors(
    curve: CoolingCurve, rotation: bool
) -> tuple[Float[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
    """Return relative errors of T, and of T_rot if it is used, and which points have a weight."""
    pairs: list[tuple[Any, Any]] = [(curve.temperature, curve.temperature_error)]
    if rotation:
        pairs.append((curve.rotational_temperature, curve.rotational_temperature_error))
    values = np.concatenate([np.asarray(value) for value, _ in pairs])
    used = (np.tile(np.asarray(curve.times), len(pairs)) > 0) & (values > 0)
    if curve.temperature_error is None:
        return np.zeros_like(values), used
    errors = np.concatenate([np.asarray(error) for _, error in pairs])
    return errors / np.where(values > 0, values, 1.0), used & (errors > 0)


def _check_replicas(model: AbstractModel, computed: CoolingCurve) -> None:
    replicas = computed.replicas
    if replicas is None or len(replicas.temperature) < 2:
        raise ValueError(
            f"a fit of {type(model).__name__} needs curves with at least two replicas, whose "
            "scatter gives the noise: simulate must return CoolingCurve.of_replicas(...)"
        )


def _guess_of_kinetic_theory(gas: Gas, curve: CoolingCurve, names: tuple[str, ...]) -> Gas:
    """Fit kinetic theory for those parameters that it can determine."""
    determined = {"dissipative_constant", "coefficient", "temperature"}
    if uses_rotation(gas, curve):
        determined |= {"tangential_restitution", "rotational_temperature"}
    free = tuple(name for name in names if name in determined)
    if not free:
        return gas
    smooth = gas
    if "friction" in gas.elements:  # not supported by kinetic theory
        smooth = dataclasses.replace(gas, surface=None)
        curve = dataclasses.replace(curve, rotational_temperature=None)
        curve = dataclasses.replace(curve, rotational_temperature_error=None)
    model = KineticTheory()
    m = Measurement.of("", smooth, curve, model, None, 1, use_displacement=True)
    problem = Problem.of((m,), model, free, (), {}, clock_is_free=False)
    first = problem.flat({"": guess_from_data(m.gas, curve, free)})
    (flat, *_), _ = best_of_starts(problem, search_starts(problem, first), 100)
    values = problem.values(flat)[""]
    return with_floats(gas, {name: values[name] for name in free})


def _stochastic_result(
    problem: Problem,
    gas: Gas,
    curve: CoolingCurve,
    first: Float[np.ndarray, "p"],
    search: SearchResult,
    priors: Priors,
    error: Float[np.ndarray, "points"] | None,
    error_degrees: dict[str, Any],
) -> Fit:
    """Return the fit, in SI units, from the result of a search."""
    flat, num_times = search.flat, search.computed.times.size
    residuals, sensitivity, weights = search.residuals, search.sensitivity, search.weights
    degrees_of_freedom, scatter = np.sum(residuals != 0) - flat.size, None
    if error is None:
        scatter = np.sqrt(np.sum(residuals**2) / degrees_of_freedom)
        residuals, sensitivity, weights = (x / scatter for x in (residuals, sensitivity, weights))
    names = ["temperature", "rotational_temperature"][: residuals.size // num_times]
    by_name = dict(zip(names, np.split(residuals, len(names)), strict=True))
    used = by_name["temperature"] != 0
    tested = [
        (x, np.sum(x != 0) - (flat.size if name == "temperature" else 0), error_degrees.get(name))
        for name, x in by_name.items()
    ]
    goodness = goodness_of_fit(tested, degrees_of_freedom, errors_known=error is not None)
    scale = problem.slopes(flat)[:, None]
    gain = scale * search.gain
    rotation = len(names) > 1
    slope, changes = parameter_effects(gas, priors, search.computed, rotation)
    shares = gain * (scatter if error is None else error[None])
    measured = goodness.inflation * _measurement_covariance(shares, by_name["temperature"], used)
    covariances = {
        "measurement": measured,
        MODEL_ERROR: np.zeros_like(measured),
        "simulation": scale * search.noise_covariance * scale.T,
    }
    covariances |= {name: gain @ x @ x.T @ gain.T for name, x in changes.items()}
    delays = -gain * slope[None]
    comparison = Comparison(
        residuals=by_name,
        weights=dict(zip(names, np.split(weights, len(names)), strict=True)),
        gain=gain[:, :num_times],
        clock_gain=np.sum(np.split(delays, len(names), axis=1), axis=0),
        clock_error=np.zeros(num_times),
        sensitivity=sensitivity,
        scatter=scatter,
        start_time=np.zeros(()),
    )
    estimate = problem.estimates(flat)
    minima = Minima(
        estimate[None],
        np.asarray([goodness.chi2]),
        problem.estimates(first),
        scale[:, 0] * search.extrapolation,
        np.asarray(search.num_simulations),
    )
    arrays = as_jax_arrays(
        {
            "estimate": estimate,
            "covariances": covariances,
            "comparisons": {"": comparison},
            "goodness": goodness,
            "converged": np.asarray(search.converged),
            "minima": minima,
        }
    )
    return Fit(
        names=tuple(u.name for u in problem.unknowns),
        model=problem.model,
        gas=gas,
        priors={None: priors} if priors.names else {},
        data=curve,
        curve=search.computed,
        **arrays,
    )


def _measurement_covariance(
    shares: Float[np.ndarray, "p points"],
    residuals: Float[np.ndarray, "times"],
    used: Bool[np.ndarray, "times"],
) -> Float[np.ndarray, "p p"]:
    """Covariance by the errors of T, which may be correlated, and by those of T_rot if used."""
    factor = correlation_factor(neighbour_correlation(residuals, used)) ** 2
    by_T, by_rotation = shares[:, : residuals.size], shares[:, residuals.size :]
    return factor * by_T @ by_T.T + by_rotation @ by_rotation.T


class _Simulation(NamedTuple):
    """One simulation at some parameters, at the used points."""

    flat: Float[np.ndarray, "p"]
    values: Float[np.ndarray, "used"]
    slope: Float[np.ndarray, "used p"]  # derivative of the values
    deviation: Float[np.ndarray, "replicas used"]  # values of each replica minus their mean
    variance: Float[np.ndarray, "used"]  # variance of the mean over replicas


class _Average(NamedTuple):
    """Estimate from the mean of simulations near each other."""

    flat: Float[np.ndarray, "p"]
    sigma: Float[np.ndarray, "used"]  # standard error of each residual; 1 if errors are unknown
    gain: Float[np.ndarray, "p used"]  # derivative of `flat` in the measured values
    error_covariance: Float[np.ndarray, "p p"]  # of `flat`, by the errors of the measurement
    noise_covariance: Float[np.ndarray, "p p"]  # of `flat`, by the noise of the simulations

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        return self.error_covariance + self.noise_covariance


def search_by_simulation(
    simulate: Callable[[Array, int], CoolingCurve],
    first: Float[np.ndarray, "p"],
    measured: Float[np.ndarray, "points"],
    error: Float[np.ndarray, "points"],
    used: Bool[np.ndarray, "points"],
    *,
    rotation: bool = False,
    resolution: float,
    max_simulations: int,
    progress: bool,
) -> SearchResult:
    """Search by Gauss-Newton steps, each on one simulation and its derivatives.

    Each simulation has different random numbers. The simulations within `AVERAGING_DISTANCE` of the
    last one give independent Gauss-Newton estimates; their mean is the result. Residuals are
    weighted by the measured error and the noise of the mean of these simulations, or equally if no
    error is known. The noise of the result is estimated from the changes that single replicas
    would make to it. The search ends when a step is below `AVERAGING_DISTANCE` and the noise is
    below `MAX_NOISE_SHARE` of the standard error.

    `jaxgran.fit` describes the effect of biased derivatives.

    Args:
        simulate: function of the parameters and of a number that differs between simulations;
            returns a cooling curve with replicas.
        first: the initial guess.
        measured, error: values of `log_temperatures` and their standard errors, which are all 0 if
            they are not known.
        used: True for points that have a weight.
        rotation: True if T_rot is used too.
        resolution: ratio to the largest singular value of the sensitivity below which singular
            values are ignored: the parameters do not change in those directions.
        max_simulations: maximum number of simulations.
        progress: show a progress bar.
    """
    flat, measured, error = np.asarray(first, float), measured[used], error[used]
    known, simulations = bool(error.any()), []
    hidden = None if progress else True  # None hides the bar where there is no terminal
    with tqdm(total=max_simulations, disable=hidden, desc="fit", unit="simulation") as bar:
        while True:
            simulation, curve = _run_simulation(simulate, flat, len(simulations), used, rotation)
            simulations.append(simulation)
            near = [s for s in simulations if np.abs(s.flat - flat).max() < AVERAGING_DISTANCE]
            average = _average(near, measured, error if known else None, resolution)
            step = average.flat - flat
            step *= min(1.0, MAX_STEP / max(np.abs(step).max(), 1e-300))
            converged = bool(np.abs(step).max() < AVERAGING_DISTANCE)
            flat = flat + step
            variance = np.diag(average.covariance)
            low_noise = np.all(np.diag(average.noise_covariance) <= MAX_NOISE_SHARE**2 * variance)
            in_errors = np.abs(step / np.sqrt(variance)).max()
            bar.update()
            bar.set_postfix_str(f"last step {in_errors:.2g} standard errors")
            ended = converged and len(near) > 1 and (low_noise or not known)
            if ended or len(simulations) == max_simulations:
                break
    weights, residuals, sensitivity = _residuals_at(flat, near, measured, average.sigma, used)
    gain = np.zeros((len(flat), len(used)))
    gain[:, used] = average.gain
    return SearchResult(
        flat=flat,
        computed=curve,
        weights=weights,
        residuals=residuals,
        sensitivity=sensitivity,
        extrapolation=flat - np.mean([s.flat for s in near], axis=0),
        gain=gain,
        noise_covariance=average.noise_covariance,
        num_simulations=len(simulations),
        converged=converged,
    )


def _run_simulation(
    simulate: Callable[[Array, int], CoolingCurve],
    flat: Float[np.ndarray, "p"],
    number: int,
    used: Bool[np.ndarray, "points"],
    rotation: bool,
) -> tuple[_Simulation, CoolingCurve]:
    """Run one simulation with its derivatives; return it and its curve."""

    def values_of(flat):
        curve = simulate(flat, number)
        value = log_temperatures(curve, rotation)
        return value, (value, curve)

    slope, (value, curve) = jax.jacfwd(values_of, has_aux=True)(jnp.asarray(flat))
    replicas: Any = curve.replicas  # checked by the caller
    replica_values = np.asarray(log_temperatures(replicas, rotation))
    # T and T_rot are split, because the variance is averaged over neighbouring times.
    parts = np.split(replica_values, 1 + rotation, axis=1), np.split(used, 1 + rotation)
    used_values = [part[:, used_part] for part, used_part in zip(*parts, strict=True)]
    deviations = [part - part.mean(axis=0) for part in used_values]
    variance = np.concatenate([_variance_of_mean(part) for part in deviations])
    value, slope = np.asarray(value)[used], np.asarray(slope)[used]
    return _Simulation(flat, value, slope, np.concatenate(deviations, axis=1), variance), curve


def _average(
    near: list[_Simulation],
    measured: Float[np.ndarray, "used"],
    error: Float[np.ndarray, "used"] | None,
    resolution: float,
) -> _Average:
    """Return the mean of the Gauss-Newton estimates of some simulations.

    Args:
        near: the simulations, the newest one last.
        measured, error: the values and their standard errors, None if these are not known.
        resolution: see `search_by_simulation`.
    """
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
    gain = np.linalg.pinv(newest, rcond=resolution) / sigma
    share = gain * (np.ones_like(sigma) if error is None else error)
    noise_covariance = np.mean(noise_covariances, axis=0) / len(near)
    return _Average(np.mean(estimates, axis=0), sigma, gain, share @ share.T, noise_covariance)


def _variance_of_mean(deviation: Float[np.ndarray, "replicas used"]) -> Float[np.ndarray, "used"]:
    """Variance of the mean over replicas, averaged over neighbouring times."""
    replicas, num_times = deviation.shape
    variance = np.sum(deviation**2, axis=0) / (replicas * (replicas - 1))
    window = np.ones(min(NOISE_WINDOW, num_times))
    num_averaged = np.convolve(np.ones(num_times), window, "same")
    return np.convolve(variance, window, "same") / num_averaged


def _residuals_at(
    flat: Float[np.ndarray, "p"],
    near: list[_Simulation],
    measured: Float[np.ndarray, "used"],
    sigma: Float[np.ndarray, "used"],
    used: Bool[np.ndarray, "points"],
) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"], Float[np.ndarray, "points p"]]:
    """Return weights, weighted residuals and their derivative at the estimate.

    The residuals are extrapolated from each simulation and averaged.
    """
    differences = [measured - s.values - s.slope @ (flat - s.flat) for s in near]
    slope = np.mean([s.slope for s in near], axis=0)
    weights, residuals = np.zeros(len(used)), np.zeros(len(used))
    sensitivity = np.zeros((len(used), len(flat)))
    weights[used] = 1 / sigma
    residuals[used] = np.mean(differences, axis=0) / sigma
    sensitivity[used] = slope / sigma[:, None]
    return weights, residuals, sensitivity
