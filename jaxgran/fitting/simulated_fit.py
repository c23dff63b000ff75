"""Fits of stochastic models: the estimate of a search through simulations, as a `Fit`."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, PRNGKeyArray

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.measurement import Measurement, Priors
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
from jaxgran.fitting.parameters import SHARED, as_floats, with_parameters
from jaxgran.fitting.prediction import predicted_curve
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.result import Fit
from jaxgran.fitting.rows import SLOPE, CurveRows
from jaxgran.fitting.search import Minimum
from jaxgran.fitting.setup import Request, build_problem, with_values_of
from jaxgran.fitting.simulated_errors import (
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
from jaxgran.models.base import AbstractModel
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
    of_theory = _request_of_theory(request, measurement)
    guess = request.start or _guess_of_theory(of_theory, measurement.gas)
    request.model.check_scene(guess)
    problem, notes = _problem_of_particles(request)
    first = problem.flatten({"": guess.parameters})
    problem.check_start(first)
    (particles,) = problem.curves
    theory, _ = _rows(of_theory)
    theory = replace(theory, used=particles.used)
    theory = with_rate_error(theory, request.model, _gas_of_theory(guess))
    sims = Simulations(problem, theory, key, progress)
    if descent is None:
        search = by_gauss_newton(sims, first, max_simulations)
    else:
        search = by_descent(sims, first, max_simulations, descent)
    return _result(request, of_theory, sims, search, notes)


def _rows(request: Request) -> tuple[CurveRows, list[str]]:
    """Return the measured curve as it is compared with the model, and notes on the data."""
    (measurement,) = request.measurements.values()
    fits_T_0 = "temperature" in request.names
    # As if t0 were fitted: <dr^2> is not compared.
    return curve_rows("", measurement, request.model, fits_T_0=fits_T_0, fits_t0=True)


def _problem_of_particles(request: Request) -> tuple[Problem, list[str]]:
    """Return the problem of the free parameters alone, and notes on the data."""
    (measurement,) = request.measurements.values()
    rows, notes = _rows(request)
    rows = replace(rows, gas=measurement.gas)
    problem = Problem.build((rows,), request.model, request.names, (), {})
    # Nuisance parameters belong to fits by kinetic theory.
    free = tuple(u for u in problem.unknowns if u.name in request.names)
    problem = replace(problem, unknowns=free)
    problem.check_points()
    return problem, notes


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
    values = sims.problem.unflatten(search.average.flat)[""]
    gas = with_parameters(sims.rows.scene, as_jax_arrays(as_floats(values)))
    estimate = SimulatedEstimate(sims, search, expand(sims, search), gas)
    bias = derivative_bias(estimate)
    priors = request.priors.get(SHARED, {})
    covariances = covariances_of(estimate, priors, bias)
    explanations = None
    if search.converged and not request.quick:
        if set(request.names) <= of_theory.measurements[""].gas.domains.keys():
            further_errors = _errors_unknown_to_theory(estimate, priors, covariances)
            explanations = _explanations(of_theory, estimate, further_errors)
        else:
            notes = [*notes, NOT_COMPARED]
    notes = [*notes, *_describe_bias(bias)]
    residuals = _residuals(estimate)
    result = _assemble(request, estimate, covariances, explanations, residuals)
    share = _share_of_errors(estimate, residuals)
    return with_conclusions(request, result, explanations, notes, share)


def _errors_unknown_to_theory(
    estimate: SimulatedEstimate, priors: Priors, covariances: dict[str, np.ndarray]
) -> Float[np.ndarray, "p"]:
    """Return standard errors by priors and slopes, in the unconstrained scale.

    Alternatives are fitted by kinetic theory without priors, which gives all other parts itself.
    """
    p = estimate.search.average.flat.size
    parts = [covariances[name] for name in (*priors, SLOPE) if name in covariances]
    covariance = sum(parts, np.zeros((p, p))) / np.outer(estimate.scale, estimate.scale)
    return np.sqrt(np.diag(covariance))


def _describe_bias(bias: float) -> Iterator[str]:
    if bias >= MIN_REPORTED_BIAS:
        yield (
            "the error of the derivatives through particles is estimated as "
            f"{100 * bias:.2g} %, which the standard error includes: use more replicas or, if the "
            "gas has a flow, differences=0.3 (in Python)"
        )


def _assemble(
    request: Request,
    estimate: SimulatedEstimate,
    covariances: dict[str, np.ndarray],
    explanations: Explanations | None,
    residuals: Residuals,
) -> Fit:
    """Return the numbers of a fit through simulations; its words are missing."""
    sims, search, expansion, gas = estimate
    problem = sims.problem
    flat = search.average.flat
    p = flat.size
    if p > MAX_LINEARISED:
        covariances = {name: np.full_like(part, np.nan) for name, part in covariances.items()}
    found = sum_residuals([residuals], {})
    scatter_error = (2 / expansion.degrees_of_freedom) ** 0.5
    return Fit(
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
        residuals={"": _residuals_by_field(sims, residuals)},
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


def _residuals(estimate: SimulatedEstimate) -> Residuals:
    """Return the residuals of the measured values and their derivatives in the unknowns."""
    expansion = estimate.expansion
    (whole,) = estimate.search.average.comparison.residuals(0)
    return Residuals(
        name="curve",
        label="",
        values=expansion.residuals,
        slopes=-expansion.sensitivity,
        log_variance=whole.log_variance + np.log(expansion.scatter),
        log_slopes=np.zeros_like(expansion.sensitivity),
    )


def _residuals_by_field(sims: Simulations, residuals: Residuals) -> dict[str, np.ndarray]:
    of_T, of_rotation = np.split(residuals.values, 2)
    by_field = {"temperature": of_T}
    if sims.rows.uses_rotation:
        by_field["rotational_temperature"] = of_rotation
    return by_field


def _share_of_errors(estimate: SimulatedEstimate, residuals: Residuals) -> float:
    """Return the mean share of the variance of ln T that the errors of the measurement have."""
    theory = estimate.sims.theory
    used = theory.used[:, 0] > 0
    relative = theory.errors[:, 0] / np.asarray(estimate.search.curve.temperature)
    variance = np.exp(residuals.log_variance[: relative.size])
    return float(np.mean((relative**2 / variance)[used]))


def _explanations(
    of_theory: Request, estimate: SimulatedEstimate, further_errors: Float[np.ndarray, "p"]
) -> Explanations | None:
    """Compare alternatives by kinetic theory, shifted to the curve of the fitted particles."""
    problem, first, _ = build_problem(of_theory)
    flat = estimate.search.average.flat
    start = first.copy()
    start[: flat.size] = flat
    (rows,) = problem.curves
    values = problem.unflatten(start)[""]
    shifted = _shifted_to_particles(rows, problem.model, values, estimate)
    problem = replace(problem, measurements=(shifted,))
    minimum = Minimum(start, value=0.0, steps=0, converged=True)
    return compare_alternatives(problem, [minimum], further_errors)


def _shifted_to_particles(
    rows: CurveRows, model: AbstractModel, values: dict[str, Any], estimate: SimulatedEstimate
) -> CurveRows:
    """Return the measured curve, for theory that is shifted to the curve of the particles.

    Args:
        rows: the curve for kinetic theory.
        model: kinetic theory.
        values: SI values of its parameters at the estimate.
        estimate: by particles, whose errors count.
    """
    of_particles = estimate.search.average.comparison.curve.rows
    rows = replace(
        rows,
        grains=of_particles.grains,
        simulation=of_particles.simulation,
        rate_error=of_particles.rate_error,
    )
    predicted = predicted_curve(rows, model.simplified_for(rows.scene), values, [])
    compared = predicted.prediction.compared[predicted.place]
    computed = estimate.expansion.computed.reshape(2, -1).T
    return replace(rows, offset=np.where(rows.used > 0, computed - compared, 0.0))
