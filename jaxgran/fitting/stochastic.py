"""Fits through a stochastic model, whose noise becomes part of the errors.

Gauss-Newton search through simulations, whose residuals have noise of their own.

Every step is made from one simulation with fresh random numbers and its derivatives. The answer is
the mean of the Gauss-Newton estimates of all simulations near it.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils.tracing import any_traced
from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.fitting.error_budget import parameter_effects
from jaxgran.fitting.optimise import fit_deterministic
from jaxgran.fitting.parameters import NO_PRIORS, Parameters, Priors, guess_from_data
from jaxgran.fitting.residuals import (
    correlation_factor,
    log_temperatures,
    neighbour_correlation,
    uses_rotation,
)
from jaxgran.fitting.result import Fit, misfit
from jaxgran.models.base import AbstractModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas

MAX_STEP = 0.7
"""Longest Gauss-Newton step of a parameter in its unbounded scale: a factor of two."""

NEARBY = 0.1
"""Distance in every parameter's unbounded scale within which simulations are averaged."""

MIN_NOISE_SHARE = 0.5
"""Share of the standard error below which the noise needs no further simulations."""

NOISE_WINDOW = 9
"""Neighbouring times over which the variance between replicas is averaged."""


class Simulated(NamedTuple):
    """Result of a search through simulations, of p parameters in their unbounded scale.

    Points are those of `log_temperatures`.

    Attributes:
        flat: the estimate.
        computed: the curve of the last simulation.
        weights: of the residuals; 0 where not used.
        residuals: weighted, at `flat` extrapolated linearly from the simulations; 0 where not used.
        sensitivity: derivative of the weighted residuals.
        beyond: `flat` less the mean of the simulations' parameters.
        gain: derivative of `flat` in each measured value; 0 where not used.
        noise_covariance: covariance of `flat` by the noise of the simulations.
        num_simulations: how many were made.
        converged: whether the last step was below `NEAR`.
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


class _Simulation(NamedTuple):
    """One simulation at some parameters, at the points that are used."""

    flat: Float[np.ndarray, "p"]
    values: Float[np.ndarray, "used"]
    slope: Float[np.ndarray, "used p"]  # derivative of the values
    deviation: Float[np.ndarray, "replicas used"]  # of each replica's values from their mean
    variance: Float[np.ndarray, "used"]  # of the mean over replicas


class _Average(NamedTuple):
    """The estimate that simulations near each other give together."""

    flat: Float[np.ndarray, "p"]
    sigma: Float[np.ndarray, "used"]  # standard error of each residual; 1 if errors are unknown
    gain: Float[np.ndarray, "p used"]  # derivative of `flat` in the measured values
    errors: Float[np.ndarray, "p p"]  # covariance of `flat` by the errors of the measurement
    noises: Float[np.ndarray, "p p"]  # and by the noise of the simulations

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        return self.errors + self.noises


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
) -> Simulated:
    """Gauss-Newton steps, each on one simulation and its derivatives.

    Every simulation has its own random numbers. Those within `NEAR` of the last give independent
    Gauss-Newton estimates, whose mean is the answer. Residuals are weighted by the measured error
    and the noise of the mean of these simulations, or equally if no error is known. The noise of
    the answer is estimated from the changes that single replicas would make to it. The search ends
    when a step is below `NEAR` and the noise is below `QUIET` of the standard error.

    For wrong derivatives see `jaxgran.fit`.

    Args:
        simulate: makes a cooling curve, with replicas, of the parameters and a number that differs
            between simulations.
        first: the initial guess.
        measured, error: values of `log_temperatures` and their standard errors, which are 0
            everywhere if they are not known.
        used: the points that have a weight.
        rotation: whether T_rot is used beside T.
        resolution: singular values of the sensitivity below this share of the largest are ignored:
            the parameters do not move in those directions.
        max_simulations: the most simulations.
        progress: show a bar.
    """
    flat, measured, error = np.asarray(first, float), measured[used], error[used]
    known, simulations = bool(error.any()), []
    hidden = None if progress else True  # None hides the bar where there is no terminal
    with tqdm(total=max_simulations, disable=hidden, desc="fit", unit="simulation") as bar:
        while True:
            simulation, curve = _simulated(simulate, flat, len(simulations), used, rotation)
            simulations.append(simulation)
            near = [s for s in simulations if np.abs(s.flat - flat).max() < NEARBY]
            average = _average(near, measured, error if known else None, resolution)
            step = average.flat - flat
            step *= min(1.0, MAX_STEP / max(np.abs(step).max(), 1e-300))
            settled = bool(np.abs(step).max() < NEARBY)
            flat = flat + step
            variance = np.diag(average.covariance)
            quiet = np.all(np.diag(average.noises) <= MIN_NOISE_SHARE**2 * variance)
            in_errors = np.abs(step / np.sqrt(variance)).max()
            bar.update()
            bar.set_postfix_str(f"last step {in_errors:.2g} standard errors")
            ended = settled and len(near) > 1 and (quiet or not known)
            if ended or len(simulations) == max_simulations:
                break
    weighted = _residuals_at(flat, near, measured, average.sigma, used)
    extrapolation = flat - np.mean([s.flat for s in near], axis=0)
    parts = *weighted, extrapolation, _spread(average.gain, used), average.noises
    return Simulated(flat, curve, *parts, len(simulations), settled)


def _spread(values: Float[np.ndarray, "p used"], used: Bool[np.ndarray, "points"]) -> np.ndarray:
    """Values at all points, 0 where not used."""
    spread = np.zeros((len(values), len(used)))
    spread[:, used] = values
    return spread


def _simulated(
    simulate: Callable[[Array, int], CoolingCurve],
    flat: Float[np.ndarray, "p"],
    number: int,
    used: Bool[np.ndarray, "points"],
    rotation: bool,
) -> tuple[_Simulation, CoolingCurve]:
    """One simulation with its derivatives, and its curve."""

    def values_of(flat):
        curve = simulate(flat, number)
        value = log_temperatures(curve, rotation)
        return value, (value, curve)

    slope, (value, curve) = jax.jacfwd(values_of, has_aux=True)(jnp.asarray(flat))
    replicas: Any = curve.replicas  # checked by the caller
    each = np.asarray(log_temperatures(replicas, rotation))
    parts = np.split(each, 1 + rotation, axis=1), np.split(used, 1 + rotation)
    kept = [part[:, some] for part, some in zip(*parts, strict=True)]
    kept = [part - part.mean(axis=0) for part in kept]
    variance = np.concatenate([_variance(part) for part in kept])
    value, slope = np.asarray(value)[used], np.asarray(slope)[used]
    return _Simulation(flat, value, slope, np.concatenate(kept, axis=1), variance), curve


def _average(
    near: list[_Simulation],
    measured: Float[np.ndarray, "used"],
    error: Float[np.ndarray, "used"] | None,
    resolution: float,
) -> _Average:
    """The mean of the Gauss-Newton estimates of some simulations, the last of which is the newest.

    Args:
        near: the simulations.
        measured, error: the values and their standard errors, None if these are not known.
        resolution: see `by_simulation`.
    """
    noise = np.sqrt(np.mean([s.variance for s in near], axis=0) / len(near))
    sigma = np.ones_like(measured) if error is None else np.hypot(error, noise)
    ends, scatter = [], []
    for simulation in near:
        sensitivity = simulation.slope / sigma[:, None]
        inverse = np.linalg.pinv(sensitivity, rcond=resolution)
        ends.append(simulation.flat + inverse @ ((measured - simulation.values) / sigma))
        replicas = len(simulation.deviation)
        moved = (simulation.deviation / sigma) @ inverse.T / (replicas * (replicas - 1)) ** 0.5
        scatter.append(moved.T @ moved)
    # The errors of the measurement are the same in all of them: those of the newest stand for all.
    newest = near[-1].slope / sigma[:, None]
    gain = np.linalg.pinv(newest, rcond=resolution) / sigma
    share = gain * (np.ones_like(sigma) if error is None else error)
    noises = np.mean(scatter, axis=0) / len(near)
    return _Average(np.mean(ends, axis=0), sigma, gain, share @ share.T, noises)


def _variance(deviation: Float[np.ndarray, "replicas used"]) -> Float[np.ndarray, "used"]:
    """Variance of the mean over replicas, averaged over neighbouring times."""
    replicas, num_times = deviation.shape
    variance = np.sum(deviation**2, axis=0) / (replicas * (replicas - 1))
    window = np.ones(min(NOISE_WINDOW, num_times))
    parts = np.convolve(np.ones(num_times), window, "same")
    return np.convolve(variance, window, "same") / parts


def _residuals_at(
    flat: Float[np.ndarray, "p"],
    near: list[_Simulation],
    measured: Float[np.ndarray, "used"],
    sigma: Float[np.ndarray, "used"],
    used: Bool[np.ndarray, "points"],
) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points"], Float[np.ndarray, "points p"]]:
    """Weights, weighted residuals, extrapolated from each simulation and averaged, and their
    derivative."""
    each = [measured - s.values - s.slope @ (flat - s.flat) for s in near]
    slope = np.mean([s.slope for s in near], axis=0)
    weights, residuals = np.zeros(len(used)), np.zeros(len(used))
    sensitivity = np.zeros((len(used), len(flat)))
    weights[used] = 1 / sigma
    residuals[used] = np.mean(each, axis=0) / sigma
    sensitivity[used] = slope / sigma[:, None]
    return weights, residuals, sensitivity


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
    of_errors: dict[str, Float[Array, ""]] | None = None,
) -> Fit:
    """Fit through a stochastic model, from a guess, by default the result of kinetic theory.

    Args, returns, raises: as `jaxgran.fit`; of_errors as `fit_deterministic`.
    """
    if any_traced(gas, curve, guess, model, key):
        raise ValueError(
            "a fit through a stochastic model cannot run inside jax.jit or jax.vmap: fit one curve "
            "at a time, outside"
        )
    guess = _guess_of_kinetic_theory(gas, curve, names) if guess is None else guess
    parameters = Parameters(gas, names)
    first = parameters.flat(guess)
    if not np.all(np.isfinite(first)):
        at = ", ".join(f"{name} = {guess.value(name)}" for name in names)
        raise ValueError(
            f"a fit cannot start at {at}: positive parameters are fitted in their logarithm; give "
            "a start inside their ranges, or leave it out"
        )
    model.check_scene(parameters.gas(first))
    key = jax.random.key(0) if key is None else key

    def simulate(flat, number):
        run = Run(jax.random.fold_in(key, number), progress)
        computed = model.simulate(parameters.gas(flat), curve.times, run)
        _check_replicas(model, computed)
        return computed

    rotation = uses_rotation(gas, curve)
    errors_known = curve.temperature_error is not None
    error, used = _errors_of(curve, rotation)
    found = search_by_simulation(
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
    of = model, parameters, names, first, found, priors
    return _fit_of(*of, error if errors_known else None, of_errors or {})


def _errors_of(
    curve: CoolingCurve, rotation: bool
) -> tuple[Float[np.ndarray, "points"], Bool[np.ndarray, "points"]]:
    """Relative errors of T, and of T_rot if it is used, and the points that have a weight."""
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
            f"a fit through {type(model).__name__} needs curves with two replicas at least, whose "
            "scatter gives the noise: CoolingCurve.of_replicas makes them"
        )


def _guess_of_kinetic_theory(gas: Gas, curve: CoolingCurve, names: tuple[str, ...]) -> Gas:
    """The result of kinetic theory's fit of those parameters that it can determine."""
    found_by_theory = {"dissipative_constant", "coefficient", "temperature"}
    if uses_rotation(gas, curve):
        found_by_theory |= {"tangential_restitution", "rotational_temperature"}
    known = tuple(name for name in names if name in found_by_theory)
    if not known:
        return gas
    plain = gas
    if "friction" in gas.elements:  # which theory does not know
        plain = dataclasses.replace(gas, surface=None)
        curve = dataclasses.replace(curve, rotational_temperature=None)
        curve = dataclasses.replace(curve, rotational_temperature_error=None)
    guesses = [guess_from_data(plain, curve, known)]
    found = fit_deterministic(plain, curve, KineticTheory(), known, guesses).gas
    return gas.replace(**{name: found.value(name) for name in known})


def _fit_of(
    model: AbstractModel,
    parameters: Parameters,
    names: tuple[str, ...],
    first: Float[Array, "p"],
    found: Simulated,
    priors: Priors,
    error: Float[np.ndarray, "points"] | None,
    of_errors: dict[str, Float[Array, ""]],
) -> Fit:
    """The fit in SI units of what a search found."""
    flat, num_times = jnp.asarray(found.flat), found.computed.times.size
    own = found.residuals, found.sensitivity, found.weights
    residuals, sensitivity, weights = map(jnp.asarray, own)
    degrees_of_freedom, scatter = jnp.sum(residuals != 0) - flat.size, None
    if error is None:
        scatter = jnp.sqrt(jnp.sum(residuals**2) / degrees_of_freedom)
        residuals, sensitivity, weights = (x / scatter for x in (residuals, sensitivity, weights))
    of_T, of_rotation = residuals[:num_times], residuals[num_times:]
    used = of_T != 0
    tested = [(of_T, jnp.sum(used) - flat.size, of_errors.get("measurement"))]
    if of_rotation.size:
        tested.append((of_rotation, jnp.sum(of_rotation != 0), of_errors.get("rotation")))
    chance = misfit(tested, degrees_of_freedom, errors_known=error is not None)
    scale = jax.jacfwd(parameters.estimates)(flat)
    gain = scale @ jnp.asarray(found.gain)
    gas, rotation = parameters.gas(flat), of_rotation.size > 0
    slope, changes = parameter_effects(gas, priors, found.computed, rotation)
    shares = gain * (scatter if error is None else jnp.asarray(error)[None])
    measured = chance.inflation * _of_errors(shares, of_T, used)
    covariances = {"measurement": measured, "simulation": scale @ found.noise_covariance @ scale.T}
    covariances |= {name: gain @ x @ x.T @ gain.T for name, x in changes.items()}
    delays = -gain * slope[None]
    return Fit(
        names=names,
        model=model,
        estimate=parameters.estimates(flat),
        covariances=covariances,
        clock_error=jnp.zeros(used.shape),
        gain=gain[:, :num_times],
        clock_gain=sum(jnp.split(delays, slope.size // num_times, axis=1), start=jnp.zeros(())),
        sensitivity=sensitivity,
        extrapolation=scale @ jnp.asarray(found.extrapolation),
        start=parameters.estimates(first),
        gas=gas,
        start_time=jnp.zeros(()),
        priors=priors,
        curve=found.computed,
        weights=weights[:num_times],
        residuals=of_T,
        displacement_residuals=None,
        rotation_residuals=of_rotation if of_rotation.size else None,
        scatter=scatter,
        chi2=chance.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=jnp.asarray(found.num_simulations),
        converged=jnp.asarray(found.converged),
    )


def _of_errors(
    shares: Float[Array, "p points"], residuals: Float[Array, "times"], used: Bool[Array, "times"]
) -> Float[Array, "p p"]:
    """Covariance by errors of T, with that of neighbouring ones, and of T_rot, if it was used."""
    factor = correlation_factor(neighbour_correlation(residuals, used)) ** 2
    by_T, by_rotation = shares[:, : residuals.size], shares[:, residuals.size :]
    return factor * by_T @ by_T.T + by_rotation @ by_rotation.T
