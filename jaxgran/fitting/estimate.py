"""A fit of a model without noise: searches, tests, and the `Fit` made of them."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxgran._utils import status
from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve, above_noise
from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.alternatives import Explanations, compare_alternatives
from jaxgran.fitting.conclusions import with_conclusions
from jaxgran.fitting.descent import Descent
from jaxgran.fitting.goodness import SIGNIFICANCE, goodness, measurement_share
from jaxgran.fitting.information import (
    DEGENERATE,
    covariance_of_minima,
    equally_good_minima,
    information_by_source,
    inverse,
    undetermined,
    weights_of_measurements,
)
from jaxgran.fitting.outliers import without_outliers
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.prediction import TINY
from jaxgran.fitting.problem import Evaluation, Problem, unknown_of
from jaxgran.fitting.profiles import ALLOWED
from jaxgran.fitting.result import Fit, prefix_of
from jaxgran.fitting.rows import SCATTER, WHITE, CurveRows, has_no_measured_errors
from jaxgran.fitting.search import Minimum, deepest, minima_from_starts, minimise
from jaxgran.fitting.setup import Request, build_problem, problem_with_rate_errors
from jaxgran.models.scales import scales_at
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import symbol_of

ERROR_LIMITS = (1e-4, 1.0)
"""Range of the first guess of the relative standard deviation of independent errors of T. A curve
of less than three points gives the lower end."""

DISTANT_FACTOR = 3.0
"""Factor between measured and fitted T. If `DISTANT_SHARE` of the values differ by more, the scale
of T or of time is wrong."""

DISTANT_SHARE = 0.8
"""Share of such values: where T has fallen most, a curve in another unit may come near."""


class _End(NamedTuple):
    """Where the searches of a problem end.

    Attributes:
        problem: of the fit.
        best: the deepest minimum.
        minima: all minima.
    """

    problem: Problem
    best: Minimum
    minima: list[Minimum]

    def evaluate(self) -> Evaluation:
        """Return -2 ln L at the deepest minimum."""
        return self.problem.evaluate(self.best.flat)


def fit_without_noise(request: Request, max_steps: int, descent: Descent | None = None) -> Fit:
    """Fit a model without noise, starting at the best of some guesses.

    Args:
        request: of the user.
        max_steps: of each search.
        descent: a gradient descent in place of Newton's method; None for the latter.
    """
    problem, first, notes_on_data = build_problem(request)
    problem.check_points()
    plain = _search(problem, first, max_steps, descent)
    end = plain
    if descent is None and not _is_explained(plain):
        end = _with_errors_of_T(plain, first, max_steps)
    quality = _quality_without_errors(plain, end)
    found = end.evaluate()
    distant = _distant_curves(end.problem, found)
    explanations = None
    if end.best.converged and not (request.quick or distant):
        noise = np.zeros(problem.num_free)
        explanations = compare_alternatives(end.problem, end.minima, noise)
    result = _result(request, end, explanations, quality)
    notes = [*notes_on_data]
    if distant:
        notes.append(
            "nearly every T differs from the fitted one by more than a factor of "
            f"{DISTANT_FACTOR:g}: alternatives were not compared; check the units, the scale of T "
            "and T0"
        )
    elif result.p_value < SIGNIFICANCE and not request.quick:
        notes += _outlier_notes(plain.problem, first, max_steps)
    if found.scatter_of_eps is not None:
        notes.append(f"eps of the impacts scatters by {found.scatter_of_eps:.2g} beyond its errors")
    share = measurement_share(end.problem, found)
    return with_conclusions(request, result, explanations, notes, share)


def _search(problem: Problem, first: np.ndarray, max_steps: int, descent: Descent | None) -> _End:
    """Return where the searches end, or raise RuntimeError if no curve is computed there."""
    if descent is None:
        end = _found_by_two_searches(problem, first, max_steps)
    else:  # it keeps the errors of the cooling rate that it began with
        minima = minima_from_starts(problem, first, max_steps, descent)
        end = _End(problem, deepest(minima), minima)
    _check_computed(end.problem, end.best)
    return end


def _found_by_two_searches(problem: Problem, first: np.ndarray, max_steps: int) -> _End:
    """Return the deepest minimum, and those that are nearly as deep, with the problem there.

    The first search has the scatter that N gives. The second one finds it, too, with the errors of
    the model's cooling rate in the gas that the first one found.
    """
    held, is_left = problem.holding(SCATTER)
    minima = minima_from_starts(held, first[is_left], max_steps)
    begun = deepest(minima)
    _check_computed(held, begun)

    def whole(flat: np.ndarray) -> np.ndarray:
        full = first.copy()
        full[is_left] = flat
        return full

    problem = problem_with_rate_errors(problem, whole(begun.flat))
    near = [whole(m.flat) for m in minima if m.value < begun.value + DEGENERATE]
    minima = [minimise(problem, flat, max_steps) for flat in near]
    best = deepest(minima)
    return _End(problem, best._replace(steps=begun.steps + best.steps), minima)


def _with_errors_of_T(end: _End, first: np.ndarray, max_steps: int) -> _End:
    """Return where the searches end with independent errors of T, if the data show them.

    Where a curve scatters more than its grains can, and has no errors, the estimates would follow
    its noise. Without such a curve, or errors, the given end is returned.
    """
    problem = end.problem
    bare = [m for m in problem.curves if has_no_measured_errors(m)]
    if not bare:
        return end
    computed = problem.evaluate(first).curves
    unknowns = [unknown_of(WHITE, m.label, m.scene, problem.curves) for m in bare]
    sizes = [_guess_of_error(m, computed[m.label]["temperature"]) for m in bare]
    wider = replace(problem, unknowns=(*problem.unknowns, *unknowns))
    found = _found_by_two_searches(wider, np.append(first, np.log(sizes)), max_steps)
    if found.best.value > end.best.value - ALLOWED or not found.best.converged:
        return end
    return found


def _is_explained(end: _End) -> bool:
    """Tell whether a search converged at values that are consistent with the data."""
    if not end.best.converged:
        return False
    return goodness(end.problem, end.evaluate())["p_value"] >= SIGNIFICANCE


def _quality_without_errors(plain: _End, end: _End) -> dict[str, Any]:
    """Return the goodness of fit without the errors of T that a fit added.

    These errors would explain any misfit.

    Args:
        plain: end of the search without them.
        end: end of the last search, whose values are judged if the first one did not converge.
    """
    flat = plain.best.flat
    if not plain.best.converged:
        flat = end.best.flat[: flat.size]  # the added errors are the last unknowns
    return goodness(plain.problem, plain.problem.evaluate(flat))


def _guess_of_error(m: CurveRows, computed: np.ndarray) -> float:
    """Return the standard deviation of ln T about a smooth curve, from second differences.

    Those of independent values have 1 + 4 + 1 times their variance.
    """
    used = (m.used[:, 0] > 0) & (m.values[:, 0] > 0)
    residuals = np.log(m.values[used, 0] / computed[used])
    second = np.diff(residuals, 2)
    variance = np.mean(second**2) / 6 if second.size else 0.0
    return float(np.clip(np.sqrt(variance), *ERROR_LIMITS))


def _check_computed(problem: Problem, end: Minimum) -> None:
    """Raise RuntimeError if one of the curves was not computed where a search ended."""
    for curve in problem.evaluate(end.flat).curves.values():
        fault = int(curve.get("status", status.OK))
        if fault != status.OK:
            values = [np.asarray(value) for _, value in problem.parts(end.flat)]
            free = zip(problem.places, values, strict=False)
            at = ", ".join(f"{name} = {np.array2string(x, precision=3)}" for name, x in free)
            raise RuntimeError(
                f"{type(problem.model).__name__} could not compute the curve at {at}, where the "
                f"search ended: {status.explain(fault)}"
            )
    if not np.isfinite(end.value):
        raise RuntimeError(
            "the likelihood is not a number where the search begins, at "
            f"{problem.estimates(end.flat)}: give start, a gas nearer to the measured one"
        )


def _distant_curves(problem: Problem, found: Evaluation) -> list[str]:
    """Return the labels of curves that no fit and no alternative comes near.

    All alternatives begin at the same T_0: values that are far off are in another unit, and the
    search for an alternative would not end.
    """
    labels = []
    for m in problem.curves:
        T = m.values[:, 0][m.used[:, 0] > 0]
        computed = found.curves[m.label]["temperature"][m.used[:, 0] > 0]
        distances = np.abs(np.log(np.maximum(T, TINY) / computed))
        if np.mean(distances > np.log(DISTANT_FACTOR)) >= DISTANT_SHARE:
            labels.append(m.label)
    return labels


def _outlier_notes(problem: Problem, first: np.ndarray, max_steps: int) -> list[str]:
    """Return a clause on far outliers with the first parameter of a fit without them; [] if such a
    fit is no better."""
    rest, end, left_out = without_outliers(problem, first, max_steps)
    found = rest.evaluate(end.flat)
    if not left_out or goodness(rest, found)["p_value"] < SIGNIFICANCE:
        return []
    times = {m.label: np.asarray(m.curve.times) for m in problem.curves}
    places = []
    for value in sorted(left_out):
        time = times[value.label][value.time]
        places.append(f"{prefix_of(value.label)}t = {time:.3g} s (row {value.time + 1})")
    symbol = symbol_of(problem.unknowns[0].name)
    estimate = rest.estimates(end.flat)[0]
    error = np.sqrt(inverse(found.information)[0, 0]) * rest.slopes(end.flat)[0]
    note = (
        f"far outliers at {', '.join(places)}: check them and their error bars; without them "
        f"{symbol} is {estimate:.3g} +- {error:.2g}"
    )
    return [note]


def _result(
    request: Request, end: _End, explanations: Explanations | None, quality: dict[str, Any]
) -> Fit:
    """Return the result of a fit without words.

    Args:
        request: of the user.
        end: of the searches.
        explanations: the fitted law and its alternatives; None if they were not compared.
        quality: the goodness of fit.
    """
    problem = end.problem
    best = end.best
    found = end.evaluate()
    covariance = inverse(found.information)
    values = problem.values(best.flat)
    gases = {m.label: _fitted_gas(m.scene, values[m.label]) for m in problem.measurements}
    curves: dict[str, CoolingCurve | None] = dict.fromkeys(gases)
    for m in problem.curves:
        curves[m.label] = _as_curve(m, found.curves[m.label])
    is_single = [*gases] == [""]
    return Fit(
        names=tuple(problem.places),
        model=problem.model,
        model_name=problem.model.name,
        measurements=request.measurements,
        gas=gases[""] if is_single else gases,
        curve=curves[""] if is_single else curves,
        estimate=problem.estimates(best.flat),
        covariances=_covariances(end, covariance),
        ranges=parameter_ranges(problem, explanations),
        alternatives=() if explanations is None else explanations.alternatives,
        **quality,
        log_likelihood=-0.5 * found.value,
        residuals=_residuals(problem, found),
        scatter=_scatter(problem, best.flat, covariance),
        errors_of_T={
            u.label or "": float(error) for u, error in problem.parts(best.flat) if u.name == WHITE
        },
        scales={m.label: describe_gas(gases[m.label], m) for m in problem.curves},
        start_time={m.label: float(values[m.label].get(START_TIME, 0.0)) for m in problem.curves},
        weights=weights_of_measurements(problem, found),
        undetermined=undetermined(problem, found),
        other_minima=equally_good_minima(problem, best, end.minima, covariance),
        converged=best.converged,
        iterations=best.steps,
        trace=best.trace,
    )


def _fitted_gas(scene: Gas, values: dict[str, Any]) -> Gas:
    known = {name: x for name, x in values.items() if name in scene.domains}
    return with_parameters(scene, as_jax_arrays(as_floats(known)))


def _as_curve(m: CurveRows, computed: dict[str, Any]) -> CoolingCurve:
    """Return a computed curve without the quantities that the scene does not have."""
    absent = set()
    if m.scene.surface is None:
        absent |= {"rotational_temperature"}
    if m.scene.container is not None:
        absent |= {"displacement", "diffusion"}
    fields = {name: x for name, x in computed.items() if name not in absent}
    fields["status"] = np.zeros((), int)
    return CoolingCurve(times=m.curve.times, **as_jax_arrays(fields))


def _covariances(end: _End, covariance: np.ndarray) -> dict[str, np.ndarray]:
    """Return the covariances of the estimates, SI, by the source of the error.

    Args:
        end: of the searches.
        covariance: of all unknowns, in their unconstrained scale.
    """
    problem = end.problem
    flat = end.best.flat
    p = problem.num_free
    parts = information_by_source(problem, flat, end.evaluate())
    to_si = problem.slopes(flat)[:, None] * covariance
    covariances = {name: (to_si @ part @ to_si.T)[:p, :p] for name, part in parts.items()}
    of_minima = covariance_of_minima(problem, end.best, end.minima, covariance)
    if np.any(of_minima > 0):
        covariances["other minima"] = of_minima
    return covariances


def _scatter(
    problem: Problem, flat: np.ndarray, covariance: np.ndarray
) -> dict[str, tuple[float, float]]:
    """Return the scatter of each curve over the scatter of N grains, and its standard error."""
    errors = np.sqrt(np.diag(covariance))
    return {
        e.label or "": (float(np.exp(flat[e.place])), float(errors[e.place]))
        for e in problem.elements(flat)
        if e.name == SCATTER
    }


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
        if row.is_prior or row.label is None:
            continue
        if row.name != "curve":
            residuals[row.label][row.name] = row.values
            continue
        of_T, of_rotation = np.split(row.values, 2)
        residuals[row.label]["temperature"] = of_T
        if curves[row.label].uses_rotation:
            residuals[row.label]["rotational_temperature"] = of_rotation
    return residuals


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
