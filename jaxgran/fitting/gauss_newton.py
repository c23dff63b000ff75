"""Gauss-Newton search through simulations, whose residuals have noise of their own.

Every step is made from one simulation with fresh random numbers and its derivatives. The answer is
the mean of the Gauss-Newton estimates of all simulations near it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from tqdm import tqdm

from jaxgran.data.curve import CoolingCurve

LONGEST_STEP = 0.7
"""Longest Gauss-Newton step of a parameter in its unbounded scale: a factor of two."""

NEAR = 0.1
"""Distance in every parameter's unbounded scale within which simulations are averaged."""

QUIET = 0.5
"""Share of the standard error below which the noise needs no further simulations."""

NOISE_WINDOW = 9
"""Neighbouring times over which the variance between replicas is averaged."""


def log_temperatures(curve: CoolingCurve, rotation: bool) -> Float[Array, "*replicas points"]:
    """ln T at all times, and after it ln T_rot if a search uses it."""
    values = [jnp.log(curve.temperature)]
    if rotation:
        assert curve.rotational_temperature is not None
        values.append(jnp.log(curve.rotational_temperature))
    return jnp.concatenate(values, axis=-1)


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
    beyond: Float[np.ndarray, "p"]
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


def by_simulation(
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
            near = [s for s in simulations if np.abs(s.flat - flat).max() < NEAR]
            average = _average(near, measured, error if known else None, resolution)
            step = average.flat - flat
            step *= min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-300))
            settled = bool(np.abs(step).max() < NEAR)
            flat = flat + step
            variance = np.diag(average.covariance)
            quiet = np.all(np.diag(average.noises) <= QUIET**2 * variance)
            in_errors = np.abs(step / np.sqrt(variance)).max()
            bar.update()
            bar.set_postfix_str(f"last step {in_errors:.2g} standard errors")
            ended = settled and len(near) > 1 and (quiet or not known)
            if ended or len(simulations) == max_simulations:
                break
    weighted = _residuals_at(flat, near, measured, average.sigma, used)
    beyond = flat - np.mean([s.flat for s in near], axis=0)
    parts = *weighted, beyond, _spread(average.gain, used), average.noises
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
