"""Fits of stochastic models: the estimate of a search through simulations, and its errors."""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import Measurement, Priors
from jaxgran.fitting.alternatives import Explanations, compare_alternatives
from jaxgran.fitting.comparison import Residuals
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
    SAMPLING,
    undetermined,
)
from jaxgran.fitting.measured_rows import curve_rows, with_rate_error
from jaxgran.fitting.messages import say
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.prediction import predicted_curve
from jaxgran.fitting.priors import SMOOTHNESS, extra_parameters, prior_residuals
from jaxgran.fitting.problem import Problem, summed
from jaxgran.fitting.result import Fit
from jaxgran.fitting.search import Descent, Minimum
from jaxgran.fitting.setup import (
    Request,
    build_problem,
    problem_with_rate_errors,
    with_values_of,
)
from jaxgran.fitting.simulations import (
    MAX_LINEARISED,
    Search,
    Simulations,
    by_descent,
    by_gauss_newton,
    information_by,
)
from jaxgran.models.choose import error_model_of_curve
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import linearise, with_neutral_elements
from jaxgran.scene.gas import Gas

NOT_COMPARED = (
    "alternatives are not compared: kinetic theory, which computes them, does not know all free "
    "parameters"
)
"""Note of a fit of parameters that only particles know."""


MIN_REPORTED_BIAS = 0.05
"""Smallest relative error of the derivatives of a fit that is reported."""


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
    known_to_theory = _with_gas(measurement, _gas_of_theory(gas))
    of_theory = replace(
        request,
        measurements={"": known_to_theory},
        model=KineticTheory(),
        priors={},
        start=None,
        separate=(),
        quick=True,
    )
    guess = request.start or _guess_of_theory(of_theory, gas)
    model.check_scene(guess)
    fits_T_0 = "temperature" in request.names
    # As if t0 were fitted: <dr^2> is not compared.
    rows, notes = curve_rows("", measurement, model, fits_T_0=fits_T_0, fits_t0=True)
    problem = Problem.build((replace(rows, gas=gas),), model, request.names, (), {})
    # Nuisance parameters belong to fits by kinetic theory.
    problem = replace(problem, unknowns=problem.unknowns[: len(request.names)])
    problem.check_points()
    first = problem.flat({"": guess.parameters})
    problem.check_start(first)
    theory, _ = curve_rows("", known_to_theory, KineticTheory(), fits_T_0=fits_T_0, fits_t0=True)
    theory = with_rate_error(replace(theory, used=rows.used), model, _gas_of_theory(guess))
    sims = Simulations(problem, theory, key, progress)
    if descent is None:
        search = by_gauss_newton(sims, first, max_simulations)
    else:
        search = by_descent(sims, first, max_simulations, descent)
    return _result(request, of_theory, sims, search, notes)


def _gas_of_theory(gas: Gas) -> Gas:
    """Return a gas without lasting friction, which kinetic theory does not support."""
    return replace(gas, surface=None) if "friction" in gas.elements else gas


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


class Expansion(NamedTuple):
    """Measured values beside the mean of the simulations near an estimate.

    Values are ln T at all times, followed by ln T_rot.

    Attributes:
        computed: values of the mean simulation at the estimate, shape (values,).
        slopes: their derivatives in the parameters, shape (values, p).
        residuals: measured minus computed values, independent and of unit variance.
        sensitivity: derivatives of the computed ones, whitened alike, shape (values, p).
        num_used: number of values that count.
        scatter: mean square of the residuals before they were divided by it, where N is not known:
            it tells how many grains there were; otherwise 1.
    """

    computed: Float[np.ndarray, "values"]
    slopes: Float[np.ndarray, "values p"]
    residuals: Float[np.ndarray, "values"]
    sensitivity: Float[np.ndarray, "values p"]
    num_used: int
    scatter: float

    @property
    def degrees_of_freedom(self) -> int:
        """Number of values less the number of parameters, at least 1."""
        return max(self.num_used - self.slopes.shape[1], 1)


def _expansion(sims: Simulations, search: Search) -> Expansion:
    """Return the values and slopes of the simulations near an estimate."""
    flat = search.average.flat
    differences = [sims.measured - s.values - s.slope @ (flat - s.flat) for s in search.near]
    difference = np.mean(differences, axis=0)
    slopes = np.mean([s.slope for s in search.near], axis=0)
    columns = np.concatenate([difference[:, None], slopes], axis=1)
    whitened = search.average.comparison.whiten(columns)
    found = Expansion(
        computed=sims.measured - difference,
        slopes=slopes,
        residuals=whitened[:, 0],
        sensitivity=whitened[:, 1:],
        num_used=int(np.sum(sims.rows.used)),
        scatter=1.0,
    )
    if sims.rows.measurement.num_particles is not None:
        return found
    square = float(found.residuals @ found.residuals)
    scatter = max(square / found.degrees_of_freedom, 1e-12)
    return found._replace(
        residuals=found.residuals / scatter**0.5,
        sensitivity=found.sensitivity / scatter**0.5,
        scatter=scatter,
    )


def _covariances(
    priors: Priors, sims: Simulations, search: Search, expansion: Expansion, gas: Gas, bias: float
) -> dict[str, np.ndarray]:
    """Return the parts of the covariance of the estimate, SI, by cause.

    Args:
        priors: priors of the fit.
        sims: simulations and the measurement.
        search: search that ended at the estimate.
        expansion: of the simulations near the estimate.
        gas: fitted gas.
        bias: relative bias of the derivatives, see `derivative_bias`.
    """
    average = search.average
    comparison = average.comparison
    sensitivity = expansion.sensitivity
    prior_rows = _smoothness_rows(sims.problem, average.flat)
    information = sensitivity.T @ sensitivity + prior_rows.T @ prior_rows
    covariance = np.linalg.pinv(information, rcond=sims.model.derivative_accuracy**2)
    scale = sims.problem.slopes(average.flat)[:, None]
    to_si = scale * covariance

    parts = {}
    for name in ("measurement", FEW_PARTICLES, SAMPLING, "model"):
        by_source = information_by(comparison, expansion.slopes, name) / expansion.scatter
        parts[name] = to_si @ by_source @ to_si.T
    parts["simulation"] = scale * average.noise * scale.T
    if prior_rows.size:
        parts[SMOOTHNESS] = to_si @ prior_rows.T @ prior_rows @ to_si.T
    others = {name: prior for name, prior in priors.items() if name != SMOOTHNESS}
    effects = prior_effects(gas, others, search.curve, sims.rows.uses_rotation)
    scale_of_T = sims.rows.measurement.calibration_error
    effects["calibration"] = np.full((expansion.computed.size, 1), scale_of_T)
    for name, change in effects.items():
        whitened = comparison.whiten(change) / expansion.scatter**0.5
        moved = to_si @ sensitivity.T @ whitened
        parts[name] = moved @ moved.T
    # A slope that is too large by the bias widens the statistical error, and moves the estimate in
    # proportion to its distance from the simulations.
    distance = scale[:, 0] * (average.flat - np.mean([s.flat for s in search.near], axis=0))
    statistical = sum(parts[x] for x in ("measurement", "simulation", FEW_PARTICLES, SAMPLING))
    parts["slope"] = ((1 + bias) ** 2 - 1) * statistical + bias**2 * np.outer(distance, distance)
    return {name: part for name, part in parts.items() if np.any(part)}


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
    expansion = _expansion(sims, search)
    gas = with_parameters(sims.rows.scene, as_jax_arrays(as_floats(problem.values(flat)[""])))
    bias = derivative_bias(sims, search, gas, expansion.sensitivity)
    priors = request.priors.get("", {})
    covariances = _covariances(priors, sims, search, expansion, gas, bias)
    # The range, by kinetic theory, knows all other parts.
    further = [covariances[x] for x in (*priors, "slope") if x in covariances]
    scale = problem.slopes(flat)
    noise = average.noise + sum(further, np.zeros((p, p))) / np.outer(scale, scale)
    if p > MAX_LINEARISED:
        covariances = {name: np.full_like(part, np.nan) for name, part in covariances.items()}
    explanations = None
    if search.converged and not request.quick:
        if set(request.names) <= of_theory.measurements[""].gas.domains.keys():
            explanations = _explanations(of_theory, sims, flat, expansion.computed, noise)
        else:
            notes.append(NOT_COMPARED)
    if bias >= MIN_REPORTED_BIAS:
        notes.append(say("slopes", share=100 * bias))
    residuals = expansion.residuals
    (whole,) = average.comparison.residuals(0)
    log_variance = whole.log_variance + np.log(expansion.scatter)
    rows = Residuals(
        "curve",
        "",
        residuals,
        -expansion.sensitivity,
        log_variance,
        np.zeros_like(expansion.sensitivity),
    )
    found = summed([rows], {})
    of_T, of_rotation = np.split(residuals, 2)
    by_field = {"temperature": of_T}
    if sims.rows.uses_rotation:
        by_field["rotational_temperature"] = of_rotation
    scatter_error = (2 / expansion.degrees_of_freedom) ** 0.5
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
        scatter={"": (expansion.scatter, scatter_error)},
        errors_of_T={},
        scales={"": describe_gas(gas, sims.rows)},
        start_time={"": 0.0},
        weights={"": np.ones(p)},
        undetermined=undetermined(problem, found),
        other_minima=np.zeros((0, p)),
        converged=search.converged,
        iterations=search.num_simulations,
        trace=search.trace,
    )
    used = sims.theory.used[:, 0] > 0
    relative = sims.theory.errors[:, 0] / np.asarray(search.curve.temperature)
    share = np.mean((relative**2 / np.exp(log_variance[: relative.size]))[used])
    return with_messages(request, result, explanations, notes, float(share))


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
    moved = replace(rows, offset=offset)
    problem = problem_with_rate_errors(replace(problem, measurements=(moved,)), start)
    is_driven = rows.scene.drive is not None
    errors = np.sqrt(np.diag(noise))
    minimum = Minimum(start, 0.0, 0, True)
    return compare_alternatives(problem, [minimum], errors, is_driven)


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
    gas: Gas, priors: Priors, computed: CoolingCurve, uses_rotation: bool
) -> dict[str, Float[np.ndarray, "values size"]]:
    """Return the changes of ln T and ln T_rot by one standard error of each prior.

    Kinetic theory gives the changes.

    Args:
        gas: the fitted gas.
        priors: the priors of the fit.
        computed: the computed curve of the fit.
        uses_rotation: whether the fit uses T_rot.
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
        if not uses_rotation:
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
