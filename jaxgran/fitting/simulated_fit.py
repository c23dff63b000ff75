"""Fits of stochastic models: the estimate of a search through simulations, as a `Fit`."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.alternatives import Explanations, compare_alternatives
from jaxgran.fitting.assemble import describe_gas, parameter_ranges
from jaxgran.fitting.comparison import Residuals
from jaxgran.fitting.conclusions import with_conclusions
from jaxgran.fitting.descent import Descent
from jaxgran.fitting.estimate import fit_without_noise
from jaxgran.fitting.evaluation import sum_residuals
from jaxgran.fitting.goodness import goodness
from jaxgran.fitting.information import undetermined
from jaxgran.fitting.measured_rows import curve_rows, with_rate_error
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.prediction import predicted_curve
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.result import Fit
from jaxgran.fitting.rows import SLOPE
from jaxgran.fitting.search import Minimum
from jaxgran.fitting.setup import (
    Request,
    build_problem,
    with_values_of,
)
from jaxgran.fitting.simulated_errors import (
    Expansion,
    SimulatedEstimate,
    covariances_of,
    derivative_bias,
    expand,
)
from jaxgran.fitting.simulations import (
    MAX_LINEARISED,
    SearchResult,
    Simulations,
    by_descent,
    by_gauss_newton,
)
from jaxgran.models.kinetic_theory import KineticTheory
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
    """Fit a stochastic model, starting at the fit of kinetic theory or at a given gas.

    Args:
        request: of one curve and a stochastic model.
        key: of the random numbers.
        progress: whether to show progress bars.
        max_simulations: largest number of simulations of the search.
        descent: how to descend along gradients; None for Gauss-Newton steps.
    """
    (measurement,) = request.measurements.values()
    model = request.model
    gas = measurement.gas
    of_theory = _request_of_theory(request, measurement)
    guess = request.start or _guess_of_theory(of_theory, gas)
    model.check_scene(guess)
    fits_T_0 = "temperature" in request.names
    # As if t0 were fitted: <dr^2> is not compared.
    rows, notes = curve_rows("", measurement, model, fits_T_0=fits_T_0, fits_t0=True)
    problem = Problem.build((replace(rows, gas=gas),), model, request.names, (), {})
    # Nuisance parameters belong to fits by kinetic theory.
    problem = replace(problem, unknowns=problem.unknowns[: len(request.names)])
    problem.check_points()
    first = problem.flatten({"": guess.parameters})
    problem.check_start(first)
    (known_to_theory,) = of_theory.measurements.values()
    theory, _ = curve_rows("", known_to_theory, KineticTheory(), fits_T_0=fits_T_0, fits_t0=True)
    theory = with_rate_error(replace(theory, used=rows.used), model, _gas_of_theory(guess))
    sims = Simulations(problem, theory, key, progress)
    if descent is None:
        search = by_gauss_newton(sims, first, max_simulations)
    else:
        search = by_descent(sims, first, max_simulations, descent)
    return _result(request, of_theory, sims, search, notes)


def _request_of_theory(request: Request, measurement: Measurement) -> Request:
    """Return a quick fit of a measurement by kinetic theory, without priors."""
    gas = _gas_of_theory(measurement.gas)
    known_to_theory = eqx.tree_at(lambda m: (m.gas, m.priors), measurement, (gas, {}))
    return replace(
        request,
        measurements={"": known_to_theory},
        model=KineticTheory(),
        priors={},
        start=None,
        separate=(),
        quick=True,
    )


def _gas_of_theory(gas: Gas) -> Gas:
    """Return a gas without lasting friction, which kinetic theory does not support."""
    return replace(gas, surface=None) if "friction" in gas.elements else gas


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


def _result(
    request: Request,
    of_theory: Request,
    sims: Simulations,
    search: SearchResult,
    notes: Sequence[str],
) -> Fit:
    """Return the result of a search through simulations."""
    problem = sims.problem
    flat = search.average.flat
    p = flat.size
    expansion = expand(sims, search)
    gas = with_parameters(sims.rows.scene, as_jax_arrays(as_floats(problem.unflatten(flat)[""])))
    estimate = SimulatedEstimate(sims, search, expansion, gas)
    bias = derivative_bias(estimate)
    priors = request.priors.get("", {})
    covariances = covariances_of(estimate, priors, bias)
    # The range, by kinetic theory, knows all other parts.
    further = [covariances[x] for x in (*priors, SLOPE) if x in covariances]
    scale = problem.compute_slopes(flat)
    noise = sum(further, np.zeros((p, p))) / np.outer(scale, scale)
    if p > MAX_LINEARISED:
        covariances = {name: np.full_like(part, np.nan) for name, part in covariances.items()}
    explanations = None
    if search.converged and not request.quick:
        if set(request.names) <= of_theory.measurements[""].gas.domains.keys():
            explanations = _explanations(of_theory, search, expansion.computed, noise)
        else:
            notes = [*notes, NOT_COMPARED]
    if bias >= MIN_REPORTED_BIAS:
        note = (
            "the error of the derivatives through particles is estimated as "
            f"{100 * bias:.2g} %, which the standard error includes: use more replicas or, if the "
            "gas has a flow, differences=0.3 (in Python)"
        )
        notes = [*notes, note]
    rows = _residuals(search, expansion)
    found = sum_residuals([rows], {})
    scatter_error = (2 / expansion.degrees_of_freedom) ** 0.5
    result = Fit(
        names=tuple(problem.places),
        model=problem.model,
        model_name=problem.model.name,
        measurements=request.measurements,
        gas=gas,
        curve=search.curve,
        estimate=problem.to_estimates(flat),
        covariances=covariances,
        ranges=parameter_ranges(problem, explanations),
        alternatives=() if explanations is None else explanations.alternatives,
        **goodness(problem, found)._asdict(),
        log_likelihood=-0.5 * found.value,
        residuals={"": _residuals_by_field(sims, rows)},
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
    share = _share_of_errors(sims, search, rows)
    return with_conclusions(request, result, explanations, notes, share)


def _residuals(search: SearchResult, expansion: Expansion) -> Residuals:
    """Return the residuals of the measured values and their derivatives in the unknowns."""
    (whole,) = search.average.comparison.residuals(0)
    return Residuals(
        name="curve",
        label="",
        values=expansion.residuals,
        slopes=-expansion.sensitivity,
        log_variance=whole.log_variance + np.log(expansion.scatter),
        log_slopes=np.zeros_like(expansion.sensitivity),
    )


def _residuals_by_field(sims: Simulations, rows: Residuals) -> dict[str, np.ndarray]:
    of_T, of_rotation = np.split(rows.values, 2)
    by_field = {"temperature": of_T}
    if sims.rows.uses_rotation:
        by_field["rotational_temperature"] = of_rotation
    return by_field


def _share_of_errors(sims: Simulations, search: SearchResult, rows: Residuals) -> float:
    """Return the mean share of the variance of ln T that the errors of the measurement have."""
    used = sims.theory.used[:, 0] > 0
    relative = sims.theory.errors[:, 0] / np.asarray(search.curve.temperature)
    variance = np.exp(rows.log_variance[: relative.size])
    return float(np.mean((relative**2 / variance)[used]))


def _explanations(
    of_theory: Request,
    search: SearchResult,
    model_values: np.ndarray,
    noise: np.ndarray,
) -> Explanations | None:
    """Compare alternatives by kinetic theory, shifted to the curve of the fitted particles."""
    problem, first, _ = build_problem(of_theory)
    flat = search.average.flat
    start = first.copy()
    start[: flat.size] = flat
    # The shift places theory on the curve of the particles, whose errors count.
    of_particles = search.average.comparison.curve.rows
    rows = replace(
        problem.curves[0],
        grains=of_particles.grains,
        simulation=of_particles.simulation,
        rate_error=of_particles.rate_error,
    )
    values = problem.unflatten(start)[""]
    predicted = predicted_curve(rows, problem.model.simplified_for(rows.scene), values, [])
    compared = predicted.prediction.compared[predicted.place]
    offset = np.where(rows.used > 0, model_values.reshape(2, -1).T - compared, 0.0)
    problem = replace(problem, measurements=(replace(rows, offset=offset),))
    errors = np.sqrt(np.diag(noise))
    minimum = Minimum(start, value=0.0, steps=0, converged=True)
    return compare_alternatives(problem, [minimum], errors)
