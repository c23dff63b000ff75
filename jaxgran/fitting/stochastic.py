"""Fits of stochastic models by a Gauss-Newton search through simulations, and gradient descent.

Each step uses one simulation with new random numbers, and its derivatives. The estimate is the mean
of the Gauss-Newton estimates of all simulations near it; the noise of the simulations is part of
its error.

`Descent` is gradient descent by a transformation of optax, for stochastic and deterministic models.
Through a stochastic model each step is one simulation with new random numbers and its gradient in
reverse mode, and the estimate is the mean of the last half of the steps (Polyak average).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.fitting.error_budget import parameter_effects
from jaxgran.fitting.optimise import MAX_DISTANCE, Minimum, Problem, Trace, is_converged
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

MAX_GROWTH = 10.0
"""Ratio to the first loss (or to the number of residuals, if this is more) at which a descent is
taken to diverge."""

WINDOW = 20
"""Number of steps whose mean loss is compared with that of as many steps before; a descent with
noise ends if the two differ by less than it."""

PATIENCE, MIN_FALL = 50, 0.01
"""A descent without noise ends if this many steps have lowered chi^2 by less than this."""

MAX_LINEARISED = 30
"""Number of parameters up to which a fit by descent through simulations has errors: more are not
determined one by one."""

NUM_LINEARISED = 2
"""Number of simulations that give these error bars."""


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


@dataclass
class Descent:
    """A gradient descent, and its course once it has run.

    Attributes:
        solver: gradient transformation of optax.
        progress: show a progress bar.
        throw: raise RuntimeError for a descent that diverges.
        trace: its course.
    """

    solver: Any
    progress: bool
    throw: bool
    trace: Trace | None = None

    def __call__(self, problem: Problem, first: np.ndarray, max_steps: int) -> Minimum:
        """Minimise chi^2 of a deterministic model; a search as `jaxgran.fitting.optimise` has."""

        def at(flat: np.ndarray, step: int) -> tuple[Any, Any, bool]:
            if np.any(np.abs(flat - first) > MAX_DISTANCE):
                return np.inf, np.zeros_like(flat), False
            _, residuals, jacobian, _ = problem.evaluate(flat.astype(first.dtype))
            finite = np.all(np.isfinite(residuals)) and np.all(np.isfinite(jacobian))
            at_minimum = bool(finite) and bool(is_converged(residuals, jacobian))
            return residuals @ residuals, 2 * residuals @ jacobian, at_minimum

        size = problem.evaluate(first)[1].size
        flats, losses, converged, _ = self._descend(
            at, first, max_steps, size, False, problem.estimates
        )
        best = flats[np.argmin(losses)]
        return best.astype(first.dtype), np.asarray(len(flats)), np.asarray(converged)

    def by_simulation(self, sims: Simulations, max_simulations: int) -> Search:
        """Search as `jaxgran.fitting.stochastic.search_by_simulation`, by gradient descent.

        The residuals of each simulation are weighted by the measured error and its own noise.
        `NUM_LINEARISED` further simulations at the estimate give its errors.
        """
        size, points = int(np.sum(sims.used)), np.flatnonzero(sims.used)

        def loss(flat: Array, number: int) -> Array:
            curve = sims.simulate(flat, number)
            weight = jnp.ones(size)
            if sims.error is not None:
                replicas: Any = jax.lax.stop_gradient(curve.replicas)
                values = np.asarray(log_temperatures(replicas, sims.rotation))[:, sims.used]
                weight = 1 / np.sqrt(sims.error**2 + variance_of_mean(values - values.mean(0)))
            residuals = (log_temperatures(curve, sims.rotation)[points] - sims.measured) * weight
            return jnp.sum(residuals**2) + jnp.sum(sims.prior(flat) ** 2)

        def at(flat: np.ndarray, step: int) -> tuple[Any, Any, bool]:
            return *jax.value_and_grad(loss)(jnp.asarray(flat), step), False

        flats, losses, converged, diverged = self._descend(
            at, sims.first, max_simulations, size, True, sims.estimates
        )
        averaged = 1 if diverged else (len(flats) + 1) // 2
        flat = np.mean(flats[-averaged:], axis=0)
        if diverged:
            flat = flats[np.argmin(losses)]
        numbers = range(len(flats), len(flats) + NUM_LINEARISED)
        runs = [run_simulation(sims, flat, n) for n in numbers]
        near = [s for s, _ in runs]
        _, sigma, _, noise = average_estimates(near, sims)
        noise, number = noise * NUM_LINEARISED / averaged, len(flats) + NUM_LINEARISED
        return Search(flat, near, sigma, noise, runs[-1][1], number, converged)

    def _descend(
        self,
        loss_and_gradient: Callable[[np.ndarray, int], tuple[Any, Any, bool]],
        first: np.ndarray,
        max_steps: int,
        size: int,
        noisy: bool,
        estimates: Callable[[np.ndarray], np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, bool, bool]:
        """Return parameters and losses of all steps, and whether they converged and diverged.

        Losses of nan are returned as inf. `loss_and_gradient` also returns True at a minimum;
        `size` is the number of residuals.
        """
        import optax  # the user has imported it to make the solver

        transform: Any = optax.with_extra_args_support(self.solver)
        update = eqx.filter_jit(
            lambda gradient, state, flat, loss: transform.update(
                gradient, state, flat, value=loss, grad=gradient
            )
        )
        flat, state = jnp.asarray(first), transform.init(jnp.asarray(first))
        losses, flats, converged, growth = [], [], False, ""
        reason = f"the largest number of steps, {max_steps}, was reached"
        hidden = None if self.progress else True  # None hides the bar where there is no terminal
        with tqdm(total=max_steps, disable=hidden, desc="fit", unit="step") as bar:
            for step in range(max_steps):
                loss, gradient, at_minimum = loss_and_gradient(np.asarray(flat), step)
                losses.append(float(loss))
                flats.append(np.asarray(flat))
                bar.update()
                bar.set_postfix_str(f"chi^2 {losses[-1]:.4g}")
                if not (np.isfinite(losses[-1]) and np.all(np.isfinite(gradient))):
                    growth = ", not finite"
                elif losses[-1] > MAX_GROWTH * max(losses[0], size):
                    growth = f", {losses[0]:.3g} at first"
                if growth:
                    reason = (
                        f"the descent diverges: chi^2 is {losses[-1]:.3g} at step {step}{growth}. "
                        "Lower the learning rate, or limit the gradient, as in optax.chain("
                        "optax.clip_by_global_norm(1.0), optax.sgd(0.1))"
                    )
                    break
                converged = at_minimum or _has_ceased(losses, noisy)
                if converged:
                    reason = "the next Gauss-Newton step is below .01 standard errors"
                    if not at_minimum:
                        reason = f"chi^2 no longer falls, in {WINDOW if noisy else PATIENCE} steps"
                    break
                try:
                    changes, state = update(jnp.asarray(gradient), state, flat, jnp.asarray(loss))
                except TypeError as error:
                    raise ValueError(
                        "this transformation of optax needs more than gradients, such as a line "
                        "search. Use optax.adam(0.05), or optimistix.LBFGS(rtol, atol)"
                    ) from error
                flat = flat + changes
        self.trace = Trace(np.asarray(losses), np.stack([estimates(x) for x in flats]), reason)
        if growth and self.throw:
            raise RuntimeError(f"{reason}; throw=False returns the best step so far")
        finite = np.nan_to_num(losses, nan=np.inf)
        return np.stack(flats), finite, converged, bool(growth)


def _has_ceased(losses: list[float], noisy: bool) -> bool:
    if not noisy:
        return len(losses) > PATIENCE and min(losses[:-PATIENCE]) - min(losses) < MIN_FALL
    if len(losses) < 2 * WINDOW:
        return False
    before, last = np.split(np.asarray(losses[-2 * WINDOW :]), 2)
    noise = np.std(np.diff(losses[-2 * WINDOW :])) / WINDOW**0.5  # a trend has no part in it
    return bool(abs(before.mean() - last.mean()) < noise)
