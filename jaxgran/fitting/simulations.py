"""Fits of stochastic models by a Gauss-Newton search through simulations.

Each step uses one simulation with new random numbers, and its derivatives. The estimate is the mean
of the Gauss-Newton estimates of all simulations near it; the noise of the simulations is part of
its error. Residuals are weighted by the covariance that kinetic theory gives to the measured run
(`jaxgran.fitting.likelihood`), the errors of the measurement and the noise of the simulations. By
an optax transformation each step is one simulation with its gradient in reverse mode, and the
estimate is the mean of the last half of the steps (Polyak average).
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.alternatives import Explanations, compare_alternatives
from jaxgran.fitting.comparison import Comparison, Residuals
from jaxgran.fitting.estimate import (
    describe_gas,
    fit_without_noise,
    parameter_ranges,
    titles,
    with_messages,
)
from jaxgran.fitting.goodness import goodness
from jaxgran.fitting.information import (
    FEW_PARTICLES,
    SOURCE_STEP,
    inverse,
    positive,
    undetermined,
)
from jaxgran.fitting.messages import say
from jaxgran.fitting.parameters import (
    SMOOTHNESS,
    Priors,
    as_floats,
    extra_parameters,
    prior_residuals,
    with_parameters,
)
from jaxgran.fitting.prediction import predicted_curve
from jaxgran.fitting.problem import Problem, summed
from jaxgran.fitting.result import Fit
from jaxgran.fitting.rows import CurveRows, curve_rows, with_rate_error
from jaxgran.fitting.search import Descent, Minimum, Trace
from jaxgran.fitting.setup import (
    Request,
    build_problem,
    problem_with_rate_errors,
    with_values_of,
)
from jaxgran.models.base import AbstractModel
from jaxgran.models.choose import error_model_of_curve
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import linearise, with_neutral_elements
from jaxgran.scene.gas import Gas

MAX_STEP = 0.7
"""Longest Gauss-Newton step of a parameter in the unconstrained scale: a factor of two."""

AVERAGING_DISTANCE = 0.1
"""Distance of each parameter, in the unconstrained scale, within which simulations are averaged."""

MAX_NOISE_SHARE = 0.5
"""Share of the standard error up to which the noise needs no further simulations."""

NOISE_WINDOW = 9
"""Number of neighbouring times over which the variance between replicas is averaged."""

MAX_LINEARISED = 30
"""Number of parameters up to which a fit by descent through simulations has errors: more are not
determined one by one."""

NUM_LINEARISED = 2
"""Number of simulations that give these error bars."""

MIN_REPORTED_BIAS = 0.05
"""Smallest relative error of the derivatives of a fit that is reported."""


class Simulation(NamedTuple):
    """One simulation at some parameters, compared with a curve.

    The values are ln T at all times, followed by ln T_rot.

    Attributes:
        flat: the parameters, in their unconstrained scale.
        values: shape (values,).
        slope: their derivatives, shape (values, p).
        deviation: values of each replica minus their mean, shape (replicas, values).
        variance: of the mean over replicas, shape (values,).
    """

    flat: Float[np.ndarray, "p"]
    values: Float[np.ndarray, "values"]
    slope: Float[np.ndarray, "values p"]
    deviation: Float[np.ndarray, "replicas values"]
    variance: Float[np.ndarray, "values"]


class Average(NamedTuple):
    """Mean of the Gauss-Newton estimates of some simulations.

    Attributes:
        flat: the mean.
        information: on the parameters.
        noise: covariance of the mean by the noise of the simulations.
        residuals: of unit variance, at the mean.
        sensitivity: their derivatives.
        comparison: of kinetic theory with the measurement, with the noise of the simulations.
    """

    flat: Float[np.ndarray, "p"]
    information: Float[np.ndarray, "p p"]
    noise: Float[np.ndarray, "p p"]
    residuals: Float[np.ndarray, "values"]
    sensitivity: Float[np.ndarray, "values p"]
    comparison: Comparison


@dataclass(frozen=True)
class Simulations:
    """Simulations by a stochastic model that are compared with a curve.

    Attributes:
        problem: of this model; its only measurement is the curve.
        theory: the same measurement for kinetic theory, which knows how N grains scatter.
        key: of the random numbers.
        progress: whether to show progress bars.
    """

    problem: Problem
    theory: CurveRows
    key: PRNGKeyArray
    progress: bool

    @property
    def rows(self) -> CurveRows:
        """The measured curve."""
        return self.problem.curves[0]

    @property
    def model(self) -> AbstractModel:
        """The stochastic model."""
        return self.problem.model

    def gas_at(self, flat: Any) -> Gas:
        """Return the gas at some parameters, which may be traced."""
        return with_parameters(self.rows.scene, self.problem.values(flat)[""])

    def curve_at(self, flat: Any, number: int) -> CoolingCurve:
        """Return the curve of a simulation; `number` differs between simulations."""
        run = Run(jax.random.fold_in(self.key, number), self.progress)
        computed = self.model.simulate(self.gas_at(flat), self.rows.curve.times, run)
        if computed.replicas is None or len(computed.replicas.temperature) < 2:
            raise ValueError(
                f"a fit of {type(self.model).__name__} needs curves with at least two replicas, "
                "whose scatter gives the noise: simulate must return CoolingCurve.of_replicas(...)"
            )
        return computed

    def logs_of(self, curve: CoolingCurve) -> Float[Array, "*replicas values"]:
        """Return ln T at all times, followed by ln T_rot (0 where it is not compared)."""
        log_T = jnp.log(curve.temperature)
        if not self.rows.uses_rotation:
            return jnp.concatenate([log_T, jnp.zeros_like(log_T)], axis=-1)
        assert curve.rotational_temperature is not None
        return jnp.concatenate([log_T, jnp.log(curve.rotational_temperature)], axis=-1)

    @property
    def measured(self) -> Float[np.ndarray, "values"]:
        """The logarithms of the measured values, 0 where none counts."""
        values = np.where(self.rows.used > 0, self.rows.values, 1.0)
        return np.log(values).T.ravel()

    def run(self, flat: Float[np.ndarray, "p"], number: int) -> tuple[Simulation, CoolingCurve]:
        """Run one simulation with its derivatives; return it and its curve."""

        def values_of(flat):
            curve = self.curve_at(flat, number)
            values = self.logs_of(curve)
            return values, (values, curve)

        slope, (values, curve) = jax.jacfwd(values_of, has_aux=True)(jnp.asarray(flat))
        each = np.asarray(self.logs_of(curve.replicas))
        deviation = each - each.mean(axis=0)
        # T and T_rot are split, because the variance is averaged over neighbouring times.
        parts = [variance_of_mean(part) for part in np.split(deviation, 2, axis=1)]
        simulation = Simulation(
            np.asarray(flat),
            np.asarray(values),
            np.asarray(slope),
            deviation,
            np.concatenate(parts),
        )
        return simulation, curve

    def beside_theory(self, flat: np.ndarray, variance: np.ndarray) -> Comparison:
        """Return the measurement beside kinetic theory, with a variance of the simulations."""
        floats = self.problem.values(flat)[""]
        known = {name: x for name, x in floats.items() if name in self.theory.gas.domains}
        rows = replace(self.theory, simulation=variance.reshape(2, -1).T)
        return Comparison(predicted_curve(rows, KineticTheory(), known, []))

    def average(self, near: list[Simulation]) -> Average:
        """Return the mean of the Gauss-Newton estimates of some simulations, the newest last."""
        resolution = self.model.derivative_accuracy
        variance = np.mean([s.variance for s in near], axis=0) / len(near)
        comparison = self.beside_theory(near[-1].flat, variance)
        estimates = []
        noises = []
        p = near[-1].flat.size
        slopes = np.mean([s.slope for s in near], axis=0)
        for s in near:
            difference = self.measured - s.values
            # The noise of a run's slope goes with that of its values, which would move the
            # estimate: the slope comes from the other runs.
            slope = s.slope
            if len(near) > 1:
                slope = slopes + (slopes - s.slope) / (len(near) - 1)
            columns = np.concatenate([difference[:, None], slope, s.deviation.T], axis=1)
            columns = comparison.whiten(columns)
            gain = np.linalg.pinv(columns[:, 1 : 1 + p], rcond=resolution)
            estimates.append(s.flat + gain @ columns[:, 0])
            replicas = len(s.deviation)
            shift = gain @ columns[:, 1 + p :] / (replicas * (replicas - 1)) ** 0.5
            noises.append(shift @ shift.T)
        flat = np.mean(estimates, axis=0)
        differences = [self.measured - s.values - s.slope @ (flat - s.flat) for s in near]
        columns = np.concatenate([np.mean(differences, axis=0)[:, None], slopes], axis=1)
        columns = comparison.whiten(columns)
        sensitivity = columns[:, 1:]
        information = sensitivity.T @ sensitivity
        noise = np.mean(noises, axis=0) / len(near)
        return Average(flat, information, noise, columns[:, 0], sensitivity, comparison)


def variance_of_mean(deviation: Float[np.ndarray, "replicas used"]) -> Float[np.ndarray, "used"]:
    """Variance of the mean over replicas, averaged over neighbouring times."""
    replicas, num_times = deviation.shape
    variance = np.sum(deviation**2, axis=0) / (replicas * (replicas - 1))
    window = np.ones(min(NOISE_WINDOW, num_times))
    num_averaged = np.convolve(np.ones(num_times), window, "same")
    return np.convolve(variance, window, "same") / num_averaged


class Search(NamedTuple):
    """Result of a search through simulations.

    Attributes:
        average: the estimate and its errors.
        near: the simulations near it.
        curve: of the last simulation.
        number: of simulations.
        converged: whether the last step was below `AVERAGING_DISTANCE`, or the descent ended.
        trace: course of a gradient descent; None for other searches.
    """

    average: Average
    near: list[Simulation]
    curve: CoolingCurve
    number: int
    converged: bool
    trace: Trace | None = None


def fit_through_simulations(
    request: Request,
    key: PRNGKeyArray,
    progress: bool,
    max_simulations: int,
    descent: Descent | None,
) -> Fit:
    """Fit a stochastic model, starting at the fit of kinetic theory or at a given gas."""
    (measurement,) = request.measurements.values()
    model = request.model
    gas = measurement.gas
    smooth = replace(gas, surface=None) if "friction" in gas.elements else gas  # not supported
    of_theory = replace(
        request,
        measurements={"": _with_gas(measurement, smooth)},
        model=KineticTheory(),
        priors={},
        start=None,
        separate=(),
        quick=True,
    )
    guess = request.start or _guess_of_theory(of_theory, gas)
    model.check_scene(guess)
    fits_T_0 = "temperature" in request.names
    rows, notes = curve_rows("", measurement, model, fits_T_0=fits_T_0, fits_t0=True)
    problem = Problem.build((replace(rows, gas=gas),), model, request.names, (), {})
    problem = replace(problem, unknowns=problem.unknowns[: len(request.names)])
    problem.check_points()
    first = problem.flat({"": guess.parameters})
    if not np.all(np.isfinite(first)):
        at = ", ".join(f"{name} = {guess.value(name)}" for name in request.names)
        raise ValueError(
            f"a fit cannot start at {at}: positive parameters are fitted in their logarithm. Give "
            "start inside their ranges, or leave it out"
        )
    alike = _with_gas(measurement, smooth)
    theory, _ = curve_rows("", alike, KineticTheory(), fits_T_0=fits_T_0, fits_t0=True)
    about = replace(guess, surface=None) if "friction" in gas.elements else guess
    theory = with_rate_error(replace(theory, used=rows.used), model, about)
    sims = Simulations(problem, theory, key, progress)
    if descent is None:
        search = _by_gauss_newton(sims, first, max_simulations)
    else:
        search = _by_descent(sims, first, max_simulations, descent)
    return _result(request, of_theory, sims, search, notes)


def _with_gas(measurement: Measurement, gas: Gas) -> Measurement:
    """Return a measurement of another gas, without priors."""
    return eqx.tree_at(lambda m: (m.gas, m.priors), measurement, (gas, {}))


def _guess_of_theory(request: Request, gas: Gas) -> Gas:
    """Return a fit by kinetic theory of those parameters that it determines."""
    (measurement,) = request.measurements.values()
    determined = {"dissipative_constant", "coefficient", "temperature"}
    if measurement.gas.surface is not None and measurement.curve.rotational_temperature is not None:
        determined |= {"tangential_restitution", "rotational_temperature"}
    free = tuple(name for name in request.names if name in determined)
    if not free:
        return gas
    fitted = fit_without_noise(replace(request, names=free), 100)
    return with_values_of(gas, fitted.gas, free)


def _by_gauss_newton(sims: Simulations, first: np.ndarray, max_simulations: int) -> Search:
    """Search by Gauss-Newton steps, each on one simulation and its derivatives.

    Each simulation has different random numbers. The simulations within `AVERAGING_DISTANCE` of the
    last one give independent Gauss-Newton estimates; their mean is the result. The noise of the
    result is estimated from the changes that single replicas would make to it. The search ends when
    a step is below `AVERAGING_DISTANCE` and the noise is below `MAX_NOISE_SHARE` of the standard
    error.
    """
    flat = np.asarray(first, float)
    simulations: list[Simulation] = []
    hidden = None if sims.progress else True  # None hides the bar where there is no terminal
    with tqdm(total=max_simulations, disable=hidden, desc="fit", unit="simulation") as bar:
        while True:
            simulation, curve = sims.run(flat, len(simulations))
            simulations.append(simulation)
            near = [s for s in simulations if np.abs(s.flat - flat).max() < AVERAGING_DISTANCE]
            average = sims.average(near)
            step = average.flat - flat
            step *= min(1.0, MAX_STEP / max(np.abs(step).max(), 1e-300))
            converged = bool(np.abs(step).max() < AVERAGING_DISTANCE)
            flat = flat + step
            noise = np.diag(average.noise)
            variance = np.diag(inverse(average.information)) + noise
            low_noise = np.all(noise <= MAX_NOISE_SHARE**2 * variance)
            in_errors = np.abs(step / np.sqrt(variance)).max()
            bar.update()
            bar.set_postfix_str(f"last step {in_errors:.2g} standard errors")
            ended = converged and len(near) > 1 and low_noise
            if ended or len(simulations) == max_simulations:
                break
    return Search(average._replace(flat=flat), near, curve, len(simulations), converged)


def _by_descent(
    sims: Simulations, first: np.ndarray, max_simulations: int, descent: Descent
) -> Search:
    """Search by gradient descent.

    `NUM_LINEARISED` further simulations at the estimate give its errors.
    """
    used = jnp.asarray(sims.rows.used.T.ravel())
    measured = sims.measured
    errors = (sims.rows.errors / np.where(sims.rows.used > 0, sims.rows.values, 1.0)).T.ravel()
    scale = np.sqrt(errors**2 + 2 * sims.theory.scatter)

    def loss(flat: Array, number: int) -> Array:
        curve = sims.curve_at(flat, number)
        residuals = used * (sims.logs_of(curve) - measured) / scale
        prior = sims.gas_at(flat).law.prior_residuals()
        return jnp.sum(residuals**2) + jnp.sum(prior**2)

    def at(flat: np.ndarray, step: int) -> tuple[Any, Any, bool]:
        return *jax.value_and_grad(loss)(jnp.asarray(flat), step), False

    size = int(np.sum(sims.rows.used))
    course = descent.descend(at, first, max_simulations, size, sims.problem.estimates, noisy=True)
    flats = course.flats
    averaged = 1 if course.diverged else (len(flats) + 1) // 2
    flat = np.mean(flats[-averaged:], axis=0)
    if course.diverged:
        flat = flats[np.argmin(course.losses)]
    numbers = range(len(flats), len(flats) + NUM_LINEARISED)
    runs = [sims.run(flat, n) for n in numbers]
    near = [s for s, _ in runs]
    average = sims.average(near)
    noise = average.noise * NUM_LINEARISED / averaged
    average = average._replace(flat=flat, noise=noise)
    number = len(flats) + NUM_LINEARISED
    return Search(average, near, runs[-1][1], number, course.converged, course.trace)


def _result(
    request: Request,
    of_theory: Request,
    sims: Simulations,
    search: Search,
    notes: list[str],
) -> Fit:
    """Return the result of a search through simulations."""
    problem = sims.problem
    average = search.average
    flat = average.flat
    p = flat.size
    differences = [sims.measured - s.values - s.slope @ (flat - s.flat) for s in search.near]
    slopes = np.mean([s.slope for s in search.near], axis=0)
    columns = np.concatenate([np.mean(differences, axis=0)[:, None], slopes], axis=1)
    comparison = average.comparison
    whitened = comparison.whiten(columns)
    residuals = whitened[:, 0]
    sensitivity = whitened[:, 1:]
    number = int(np.sum(sims.rows.used))
    ratio = 1.0
    if sims.rows.measurement.num_particles is None:  # the scatter tells how many grains there were
        ratio = max(float(residuals @ residuals) / max(number - p, 1), 1e-12)
        residuals = residuals / ratio**0.5
        sensitivity = sensitivity / ratio**0.5
    prior_rows = _smoothness_rows(problem, flat)
    information = sensitivity.T @ sensitivity + prior_rows.T @ prior_rows
    covariance = np.linalg.pinv(information, rcond=problem.model.derivative_accuracy**2)
    scale = problem.slopes(flat)[:, None]
    to_si = scale * covariance

    def linear(**sources: float) -> np.ndarray:
        rows = replace(comparison, sources=sources).whiten(slopes)
        return rows.T @ rows / ratio

    covariances = {}
    for name in ("measurement", FEW_PARTICLES, "model", "simulation"):
        less = linear(**{name: 1 - SOURCE_STEP})
        more = linear(**{name: 1 + SOURCE_STEP})
        covariances[name] = to_si @ positive((less - more) / (2 * SOURCE_STEP)) @ to_si.T
    covariances["simulation"] = scale * average.noise * scale.T
    if prior_rows.size:
        covariances[SMOOTHNESS] = to_si @ prior_rows.T @ prior_rows @ to_si.T
    priors = {k: x for k, x in request.priors.get("", {}).items() if k != SMOOTHNESS}
    gas = with_parameters(sims.rows.scene, as_jax_arrays(as_floats(problem.values(flat)[""])))
    for name, change in prior_effects(gas, priors, search.curve, sims.rows.uses_rotation).items():
        moved = to_si @ sensitivity.T @ (comparison.whiten(change) / ratio**0.5)
        covariances[name] = moved @ moved.T
    extrapolation = scale[:, 0] * (flat - np.mean([s.flat for s in search.near], axis=0))
    bias = derivative_bias(sims, search, gas, sensitivity)
    noise = covariances["measurement"] + covariances["simulation"] + covariances[FEW_PARTICLES]
    covariances["slope"] = ((1 + bias) ** 2 - 1) * noise + bias**2 * np.outer(
        extrapolation, extrapolation
    )
    covariances = {name: part for name, part in covariances.items() if np.any(part)}
    if p > MAX_LINEARISED:
        covariances = {name: np.full_like(part, np.nan) for name, part in covariances.items()}
    explanations = None
    if request.quick or not search.converged:
        pass
    elif set(request.names) <= of_theory.measurements[""].gas.domains.keys():
        model_values = sims.measured - np.mean(differences, axis=0)
        explanations = _explanations(of_theory, sims, flat, model_values, average.noise)
    else:
        notes.append(NOT_COMPARED)
    if bias >= MIN_REPORTED_BIAS:
        notes.append(say("slopes", share=100 * bias))
    if explanations is not None:
        notes.append(say("of particles"))
    rows = Residuals(
        "curve",
        "",
        residuals,
        -sensitivity,
        np.zeros(residuals.size),
        np.zeros_like(sensitivity),
    )
    found = summed([rows], {})
    halves = np.split(residuals, 2)
    by_field = {"temperature": halves[0]}
    if sims.rows.uses_rotation:
        by_field["rotational_temperature"] = halves[1]
    result = Fit(
        names=titles(problem),
        model=problem.model,
        model_name=problem.model.name,
        measurements=request.measurements,
        gas=gas,
        curve=search.curve,
        estimate=problem.estimates(flat),
        covariances=covariances,
        ranges=parameter_ranges(problem, explanations),
        alternatives=() if explanations is None else explanations.alternatives,
        **goodness(problem, found),
        log_likelihood=-0.5 * found.value,
        residuals={"": by_field},
        scatter={"": (ratio, (2 / max(number - p, 1)) ** 0.5)},
        scales={"": describe_gas(gas, sims.rows)},
        start_time={"": 0.0},
        weights={"": np.ones(p)},
        undetermined=undetermined(problem, found),
        other_minima=np.zeros((0, p)),
        converged=search.converged,
        iterations=search.number,
        trace=search.trace,
    )
    return with_messages(request, result, explanations, notes, 0.0)


NOT_COMPARED = (
    "alternatives are not compared: kinetic theory, which computes them, does not know all free "
    "parameters"
)
"""Note of a fit of parameters that only particles know."""


def _smoothness_rows(problem: Problem, flat: np.ndarray) -> np.ndarray:
    """Return derivatives of the law's own prior in the free parameters, shape (residuals, p)."""
    gas = problem.measurements[0].scene

    def prior(flat: Array) -> Array:
        return with_parameters(gas, problem.values(flat)[""]).law.prior_residuals()

    if not gas.law.prior_residuals().size:
        return np.zeros((0, flat.size))
    return np.asarray(jax.jacfwd(prior)(jnp.asarray(flat)))


def _explanations(
    of_theory: Request,
    sims: Simulations,
    flat: np.ndarray,
    model_values: np.ndarray,
    noise: np.ndarray,
) -> Explanations | None:
    """Compare alternatives by kinetic theory, shifted to the curve of the fitted particles."""
    problem, first, _ = build_problem(of_theory)
    start = first.copy()
    start[: flat.size] = flat
    (rows,) = problem.curves
    values = problem.values(start)[""]
    predicted = predicted_curve(rows, problem.model.simplified_for(rows.scene), values, [])
    compared = predicted.prediction.compared[predicted.place]
    offset = np.where(rows.used > 0, model_values.reshape(2, -1).T - compared, 0.0)
    moved = replace(rows, offset=offset, rotation_accuracy=rows.rotation_accuracy)
    problem = problem_with_rate_errors(replace(problem, measurements=(moved,)), start)
    is_driven = rows.scene.drive is not None
    errors = np.sqrt(np.diag(noise))
    minimum = Minimum(start, 0.0, 0, True)
    return compare_alternatives(problem, [minimum], errors, of_theory.absent, is_driven)


def derivative_bias(sims: Simulations, search: Search, gas: Gas, sensitivity: np.ndarray) -> float:
    """Return the relative bias of the derivatives of particles, as a weighted mean over the points.

    It comes from the curve of the last run or, if this has none, from an estimate by the model.
    """
    curve = search.curve
    bias = curve.derivative_bias
    if bias is None:
        N = getattr(sims.model, "num_particles", None)
        error_model = error_model_of_curve(gas, _from_start(gas, curve), N)
        whole = np.broadcast_to(sims.model.derivative_error(error_model), error_model.time.shape)
        bias = whole[-curve.times.size :]
    weights = np.sum(sensitivity[: curve.times.size] ** 2, axis=1)
    whole = max(float(np.sum(weights)), np.finfo(float).tiny)
    return abs(float(np.sum(weights * np.asarray(bias)) / whole))


def _from_start(gas: Gas, curve: CoolingCurve) -> CoolingCurve:
    """Return T, a_2, collisions and T_rot of a curve from t = 0 on."""
    names = ("temperature", "sonine", "collisions", "rotational_temperature")
    known = {name: getattr(curve, name) for name in names if getattr(curve, name) is not None}
    known |= {"times": curve.times, "status": np.zeros((), int)}
    if float(curve.times[0]) > 0:
        firsts = {name: gas.parameters.get(name, 0.0) for name in known if name != "status"}
        known |= {name: np.append(np.asarray(first), known[name]) for name, first in firsts.items()}
    return CoolingCurve(**as_jax_arrays(known))


def prior_effects(
    gas: Gas, priors: Priors, computed: CoolingCurve, rotation: bool
) -> dict[str, Float[np.ndarray, "values size"]]:
    """Return the changes of ln T and ln T_rot by one standard error of each prior.

    Kinetic theory gives the changes.

    Args:
        gas: the fitted gas.
        priors: the priors of the fit.
        computed: the computed curve of the fit.
        rotation: True if the fit uses T_rot.
    """
    if not priors:
        return {}
    model = KineticTheory()
    varied = extra_parameters(priors, ())
    times = np.asarray(computed.times)
    complete = with_neutral_elements(gas, model)
    linear = linearise(model.simplified_for(gas), complete, times, varied)

    def of_logs(part: dict[str, Any]) -> np.ndarray:
        first = (part["temperature"].T / linear.values["temperature"]).T
        if not rotation:
            return np.concatenate([first, np.zeros_like(first)])
        name = "rotational_temperature"
        return np.concatenate([first, (part[name].T / linear.values[name]).T])

    values = {name: np.asarray(gas.value(name)) for name in varied}
    by_parameter = np.concatenate([of_logs(linear.by_float[n]) for n in varied], axis=1)
    rows = prior_residuals(priors, gas, values)
    by_residual = np.block(
        [
            [slopes.get(n, np.zeros((row.size, values[n].size))) for n in varied]
            for row, slopes in rows.values()
        ]
    )
    changes = by_parameter @ np.linalg.pinv(by_residual)
    ends = np.cumsum([given.size for given, _ in priors.values()])[:-1]
    return dict(zip(priors, np.split(changes, ends, axis=1), strict=True))
