"""The numbers of a `Fit`, from where its searches ended."""

from typing import Any

import numpy as np

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve, above_noise
from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.alternatives import Explanations
from jaxgran.fitting.evaluation import Evaluation
from jaxgran.fitting.goodness import Goodness
from jaxgran.fitting.information import (
    covariance_of_minima,
    equally_good_minima,
    information_by_source,
    inverse,
    undetermined,
    weights_of_measurements,
)
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.result import Fit
from jaxgran.fitting.rows import SCATTER, WHITE, CurveRows
from jaxgran.fitting.search import Solution
from jaxgran.fitting.setup import Request
from jaxgran.models.scales import scales_at
from jaxgran.scene.gas import Gas


def assemble_fit(
    request: Request, solution: Solution, explanations: Explanations | None, quality: Goodness
) -> Fit:
    """Return the numbers of a fit of a model without noise; its words are missing.

    Args:
        request: of the user.
        solution: where the searches ended.
        explanations: the fitted law and its alternatives; None if they were not compared.
        quality: the test of the fit.
    """
    problem, best, _ = solution
    found = solution.evaluate()
    covariance = inverse(found.information)
    values = problem.unflatten(best.flat)
    gases = {m.label: _fitted_gas(m.scene, values[m.label]) for m in problem.measurements}
    curves: dict[str, CoolingCurve | None] = dict.fromkeys(gases)
    for m in problem.curves:
        curves[m.label] = _fitted_curve(m, found.curves[m.label])
    is_single = [*gases] == [""]
    return Fit(
        names=tuple(problem.places),
        model=problem.model,
        model_name=problem.model.name,
        measurements=request.measurements,
        gas=gases[""] if is_single else gases,
        curve=curves[""] if is_single else curves,
        estimate=problem.to_estimates(best.flat),
        covariances=_covariances(solution, covariance),
        ranges=parameter_ranges(problem, explanations),
        alternatives=() if explanations is None else explanations.alternatives,
        **quality._asdict(),
        log_likelihood=-0.5 * found.value,
        residuals=_residuals(problem, found),
        scatter=_scatter(problem, best.flat, covariance),
        errors_of_T={
            u.label: float(error) for u, error in problem.split(best.flat) if u.name == WHITE
        },
        scales={m.label: describe_gas(gases[m.label], m) for m in problem.curves},
        start_time={m.label: float(values[m.label].get(START_TIME, 0.0)) for m in problem.curves},
        weights=weights_of_measurements(problem, found),
        undetermined=undetermined(problem, found),
        other_minima=equally_good_minima(solution, covariance),
        converged=best.converged,
        iterations=best.steps,
        trace=best.trace,
    )


def _fitted_gas(scene: Gas, values: dict[str, Any]) -> Gas:
    known = {name: x for name, x in values.items() if name in scene.domains}
    return with_parameters(scene, as_jax_arrays(as_floats(known)))


def _fitted_curve(m: CurveRows, computed: dict[str, Any]) -> CoolingCurve:
    """Return a computed curve without the quantities that the scene does not have."""
    absent = set()
    if m.scene.surface is None:
        absent |= {"rotational_temperature"}
    if m.scene.container is not None:
        absent |= {"displacement", "diffusion"}
    fields = {name: x for name, x in computed.items() if name not in absent}
    fields["status"] = np.zeros((), int)
    return CoolingCurve(times=m.curve.times, **as_jax_arrays(fields))


def _covariances(solution: Solution, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Return the covariances of the estimates, SI, by the source of the error.

    Args:
        solution: where the searches ended.
        covariance: of all unknowns, in their unconstrained scale.
    """
    problem = solution.problem
    p = problem.num_free
    to_si = problem.compute_slopes(solution.best.flat)[:, None] * covariance
    parts = information_by_source(solution)
    covariances = {name: (to_si @ part @ to_si.T)[:p, :p] for name, part in parts.items()}
    of_minima = covariance_of_minima(solution, covariance)
    if np.any(of_minima > 0):
        covariances["other minima"] = of_minima
    return covariances


def parameter_ranges(
    problem: Problem, explanations: Explanations | None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the range of each free parameter over all explanations; {} without them."""
    if explanations is None:
        return {}
    low, high = explanations.ranges()
    return {name: (low[place], high[place]) for name, place in problem.places.items()}


def _residuals(problem: Problem, found: Evaluation) -> dict[str, dict[str, np.ndarray]]:
    """Return the residuals by label, and by field of the curve or "drop test"."""
    residuals: dict[str, dict[str, np.ndarray]] = {m.label: {} for m in problem.measurements}
    curves = {m.label: m for m in problem.curves}
    for row in found.rows:
        if row.is_prior:
            continue
        if row.name != "curve":
            residuals[row.label][row.name] = row.values
            continue
        of_T, of_rotation = np.split(row.values, 2)
        residuals[row.label]["temperature"] = of_T
        if curves[row.label].uses_rotation:
            residuals[row.label]["rotational_temperature"] = of_rotation
    return residuals


def _scatter(
    problem: Problem, flat: np.ndarray, covariance: np.ndarray
) -> dict[str, tuple[float, float]]:
    """Return the scatter of each curve over the scatter of N grains, and its standard error."""
    errors = np.sqrt(np.diag(covariance))
    return {
        e.label: (float(np.exp(flat[e.place])), float(errors[e.place]))
        for e in problem.list_elements(flat)
        if e.name == SCATTER
    }


def describe_gas(gas: Gas, m: CurveRows) -> dict[str, float]:
    """Return numbers that describe a fitted gas: see `Fit.scales`."""
    N = m.measurement.num_particles
    coolest = m.values[above_noise(m.curve), 0][-1]
    first = scales_at(gas)
    described = {
        "phi": float(gas.packing_fraction),
        "tau_c": float(first.mean_free_time),
        "contact_fraction": float(first.contact_fraction),
        "eps_first": float(first.restitution),
        "eps_last": float(scales_at(gas, coolest).restitution),
        "mean_free_path": float(first.mean_free_path),
        "side": float("nan") if N is None else first.box_side(N, gas.dimension),
    }
    if np.isfinite(first.beta):
        described["beta"] = float(first.beta)
    return described
