"""The estimate of a fit and its result."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxgran._utils import status
from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve, above_noise
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.alternatives import Explanations, compare_alternatives
from jaxgran.fitting.conclusions import with_conclusions
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
from jaxgran.fitting.messages import Message
from jaxgran.fitting.outliers import without_outliers
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.prediction import TINY
from jaxgran.fitting.problem import Evaluation, Problem, unknown_of
from jaxgran.fitting.profiles import ALLOWED
from jaxgran.fitting.result import Fit, by_label
from jaxgran.fitting.rows import SCATTER, WHITE, CurveRows, has_no_measured_errors
from jaxgran.fitting.search import Descent, Minimum, best_of_starts, minimise
from jaxgran.fitting.setup import Request, build_problem, problem_with_rate_errors
from jaxgran.models.checks import describe_walls
from jaxgran.models.scales import scales_at
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import symbol_of

ROUGHNESS_LIMITS = (1e-4, 1.0)
"""Range of the first guess of independent errors of T; less than two differences give the first."""

MAX_DISTANCE = 3.0
"""Factor between measured and fitted T. If `DISTANT_SHARE` of the values differ by more, the scale
of T or of time is wrong."""

DISTANT_SHARE = 0.8
"""Share of such values: where T has fallen most, a curve in another unit may come near."""


class _Ends(NamedTuple):
    """Where the searches of a fit end.

    Attributes:
        problem: of the fit, with the errors of T that the data show.
        best: the deepest minimum.
        minima: all minima.
        given: the problem without these errors, with the errors of the cooling rate.
        goodness: of the fit without these errors.
    """

    problem: Problem
    best: Minimum
    minima: list[Minimum]
    given: Problem
    goodness: dict[str, Any]


def fit_without_noise(request: Request, max_steps: int, descent: Descent | None = None) -> Fit:
    """Fit a model without noise, starting at the best of some guesses."""
    problem, first, notes = build_problem(request)
    problem.check_points()
    ends = _search(problem, first, max_steps, descent)
    found = ends.problem.evaluate(ends.best.flat)
    distant = distant_curves(ends.problem, found)
    explanations = None
    if ends.best.converged and not (request.quick or distant):
        is_driven = any(m.scene.drive is not None for m in problem.curves)
        noise = np.zeros(problem.num_free)
        explanations = compare_alternatives(ends.problem, ends.minima, noise, is_driven)
    result = assembled(request, ends.problem, ends.best, ends.minima, explanations)
    result = replace(result, **ends.goodness)
    if distant:
        notes.append(str(Message("distant", ratio=MAX_DISTANCE)))
    elif result.p_value < SIGNIFICANCE and not request.quick:
        notes += _outlier_notes(ends.given, first, max_steps)
    if found.scatter_of_eps is not None:
        notes.append(str(Message("scatter of eps", scatter=found.scatter_of_eps)))
    share = measurement_share(ends.problem, found)
    return with_messages(request, result, explanations, notes, share)


def _search(problem: Problem, first: np.ndarray, max_steps: int, descent: Descent | None) -> _Ends:
    """Return where the searches end, with errors of T if the data show them."""
    if descent is not None:  # it keeps the errors of the cooling rate that it began with
        best, minima = best_of_starts(problem, first, max_steps, descent)
        check_computed(problem, best)
        return _Ends(problem, best, minima, problem, goodness(problem, problem.evaluate(best.flat)))
    given, best, minima = _found_by_two_searches(problem, first, max_steps)
    check_computed(given, best)
    known = goodness(given, given.evaluate(best.flat))
    if best.converged and known["p_value"] >= SIGNIFICANCE:
        return _Ends(given, best, minima, given, known)
    has_ended = best.converged
    problem, best, minima = _with_errors_of_T(given, first, best, minima, max_steps)
    if not has_ended:
        known = goodness(given, given.evaluate(best.flat[: first.size]))
    return _Ends(problem, best, minima, given, known)


def _with_errors_of_T(
    problem: Problem, first: np.ndarray, best: Minimum, minima: list[Minimum], max_steps: int
) -> tuple[Problem, Minimum, list[Minimum]]:
    """Return the problem with independent errors of T that the data show, and its minima.

    Where a curve scatters more than its grains can, and has no errors, the estimates would follow
    its noise. Without such a curve, or errors, the problem and its minima are returned.
    """
    bare = [m for m in problem.curves if has_no_measured_errors(m)]
    if not bare:
        return problem, best, minima
    computed = problem.evaluate(first).curves
    unknowns = [unknown_of(WHITE, m.label, m.scene, problem.curves) for m in bare]
    sizes = [_roughness(m, computed[m.label]["temperature"]) for m in bare]
    wider = replace(problem, unknowns=(*problem.unknowns, *unknowns))
    wider, end, others = _found_by_two_searches(wider, np.append(first, np.log(sizes)), max_steps)
    if end.value > best.value - ALLOWED or not end.converged:
        return problem, best, minima
    return wider, end, others


def _roughness(m: CurveRows, computed: np.ndarray) -> float:
    """Return the standard deviation of ln T about a smooth curve, from second differences."""
    used = (m.used[:, 0] > 0) & (m.values[:, 0] > 0)
    residuals = np.log(m.values[used, 0] / computed[used])
    second = np.diff(residuals, 2)
    variance = np.mean(second**2) / 6 if second.size else 0.0
    return float(np.clip(np.sqrt(variance), *ROUGHNESS_LIMITS))


def distant_curves(problem: Problem, found: Evaluation) -> list[str]:
    """Return the labels of curves that no fit and no alternative comes near.

    All alternatives begin at the same T_0: values that are far off are in another unit, and the
    search for an alternative would not end.
    """
    labels = []
    for m in problem.curves:
        T = m.values[:, 0][m.used[:, 0] > 0]
        computed = found.curves[m.label]["temperature"][m.used[:, 0] > 0]
        distances = np.abs(np.log(np.maximum(T, TINY) / computed))
        if np.mean(distances > np.log(MAX_DISTANCE)) >= DISTANT_SHARE:
            labels.append(m.label)
    return labels


def _outlier_notes(problem: Problem, first: np.ndarray, max_steps: int) -> Iterator[str]:
    """Yield a clause on far outliers, and the first parameter of a fit without them."""
    rest, end, left_out = without_outliers(problem, first, max_steps)
    found = rest.evaluate(end.flat)
    if not left_out or goodness(rest, found)["p_value"] < SIGNIFICANCE:
        return
    times = {m.label: np.asarray(m.curve.times) for m in problem.curves}
    places = [
        f"{x.label}: " * bool(x.label) + f"t = {times[x.label][x.time]:.3g} s (row {x.time + 1})"
        for x in sorted(left_out)
    ]
    error = np.sqrt(inverse(found.information)[0, 0]) * rest.slopes(end.flat)[0]
    message = Message(
        "outliers",
        places=", ".join(places),
        symbol=symbol_of(problem.unknowns[0].name),
        value=rest.estimates(end.flat)[0],
        error=error,
    )
    yield str(message)


def _found_by_two_searches(
    problem: Problem, first: np.ndarray, max_steps: int
) -> tuple[Problem, Minimum, list[Minimum]]:
    """Return the deepest minimum, and those that are nearly as deep, with the problem there.

    The first search has the scatter that N gives. The second one finds it, too, with the errors of
    the model's cooling rate in the gas that the first one found.
    """
    held, is_left = problem.holding(SCATTER)
    begun, minima = best_of_starts(held, first[is_left], max_steps)
    check_computed(held, begun)

    def whole(flat: np.ndarray) -> np.ndarray:
        full = first.copy()
        full[is_left] = flat
        return full

    problem = problem_with_rate_errors(problem, whole(begun.flat))
    near = [whole(m.flat) for m in minima if m.value < begun.value + DEGENERATE]
    minima = [minimise(problem, flat, max_steps) for flat in near]
    end = min(minima, key=lambda minimum: minimum.value)
    steps = begun.steps + sum(m.steps for m in minima)
    best = end._replace(steps=steps)
    return problem, best, minima


def check_computed(problem: Problem, end: Minimum) -> None:
    """Raise RuntimeError if one of the curves was not computed where a search ended."""
    for curve in problem.evaluate(end.flat).curves.values():
        fault = int(curve.get("status", status.OK))
        if fault != status.OK:
            names = [u.title for u in problem.unknowns]
            values = zip(names, problem.estimates(end.flat), strict=False)
            at = ", ".join(f"{name} = {value:.3g}" for name, value in values)
            raise RuntimeError(
                f"{type(problem.model).__name__} could not compute the curve at {at}, where the "
                f"search ended: {status.explain(fault)}"
            )
    if not np.isfinite(end.value):
        raise RuntimeError(
            "the likelihood is not a number where the search begins, at "
            f"{problem.estimates(end.flat)}: give start, a gas nearer to the measured one"
        )


def assembled(
    request: Request,
    problem: Problem,
    end: Minimum,
    minima: list[Minimum],
    explanations: Explanations | None,
) -> Fit:
    """Return the result of a fit without words.

    Args:
        request: of the user.
        problem: at its minimum.
        end: the deepest minimum.
        minima: all minima.
        explanations: the fitted law and its alternatives; None if they were not compared.
    """
    found = problem.evaluate(end.flat)
    p = problem.num_free
    scale = problem.slopes(end.flat)
    covariance = inverse(found.information)
    parts = information_by_source(problem, end.flat, found)
    to_si = scale[:, None] * covariance
    covariances = {name: (to_si @ part @ to_si.T)[:p, :p] for name, part in parts.items()}
    spread = covariance_of_minima(problem, end, minima, covariance)
    if np.any(spread > 0):
        covariances["other minima"] = spread
    values = problem.values(end.flat)
    gases = {}
    curves: dict[str, CoolingCurve | None] = {}
    for m in problem.measurements:
        floats = {n: x for n, x in values[m.label].items() if n in m.scene.domains}
        gases[m.label] = with_parameters(m.scene, as_jax_arrays(as_floats(floats)))
        curves[m.label] = None
        if isinstance(m, CurveRows):
            curves[m.label] = _as_curve(m, found.curves[m.label])
    names = titles(problem)
    is_single = [*gases] == [""]
    errors = np.sqrt(np.diag(covariance))
    elements = problem.elements(end.flat)
    scatter = {
        e.label or "": (float(np.exp(end.flat[e.place])), float(errors[e.place]))
        for e in elements
        if e.name == SCATTER
    }
    errors_of_T = {
        u.label or "": float(error) for u, error in problem.parts(end.flat) if u.name == WHITE
    }
    return Fit(
        names=names,
        model=problem.model,
        model_name=problem.model.name,
        measurements=request.measurements,
        gas=gases[""] if is_single else gases,
        curve=curves[""] if is_single else curves,
        estimate=problem.estimates(end.flat),
        covariances=covariances,
        ranges=parameter_ranges(problem, explanations),
        alternatives=() if explanations is None else explanations.alternatives,
        **goodness(problem, found),
        log_likelihood=-0.5 * found.value,
        residuals=_residuals(problem, found),
        scatter=scatter,
        errors_of_T=errors_of_T,
        scales={m.label: describe_gas(gases[m.label], m) for m in problem.curves},
        start_time={m.label: float(values[m.label].get(START_TIME, 0.0)) for m in problem.curves},
        weights=weights_of_measurements(problem, found),
        undetermined=undetermined(problem, found),
        other_minima=equally_good_minima(problem, end, minima, covariance),
        converged=end.converged,
        iterations=end.steps,
        trace=end.trace,
    )


def titles(problem: Problem) -> tuple[str, ...]:
    """Return the names of the free parameters."""
    ends = np.cumsum([u.size for u in problem.unknowns])
    free = zip(problem.unknowns, ends, strict=True)
    return tuple(u.title for u, end in free if end <= problem.num_free)


def parameter_ranges(
    problem: Problem, explanations: Explanations | None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the range of each free parameter over all explanations; {} without them."""
    if explanations is None:
        return {}
    low, high = explanations.ranges()
    sizes = [u.size for u in problem.unknowns if u.title in titles(problem)]
    ends = np.cumsum(sizes)
    places = zip(titles(problem), ends, sizes, strict=False)
    return {name: (low[end - n : end], high[end - n : end]) for name, end, n in places}


def _residuals(problem: Problem, found: Evaluation) -> dict[str, dict[str, np.ndarray]]:
    residuals: dict[str, dict[str, np.ndarray]] = {m.label: {} for m in problem.measurements}
    by_label = {m.label: m for m in problem.curves}
    for row in found.rows:
        if row.is_prior or row.label is None:
            continue
        if row.name != "curve":
            residuals[row.label][row.name] = row.values
            continue
        of_T, of_rotation = np.split(row.values, 2)
        residuals[row.label]["temperature"] = of_T
        if by_label[row.label].uses_rotation:
            residuals[row.label]["rotational_temperature"] = of_rotation
    return residuals


def _as_curve(m: CurveRows, computed: dict[str, Any]) -> CoolingCurve:
    """Return a computed curve without the quantities that the scene does not have."""
    absent = () if m.scene.surface is not None else ("rotational_temperature",)
    if m.scene.container is not None:
        absent += ("displacement", "diffusion")
    fields = {name: x for name, x in computed.items() if name not in absent}
    fields["status"] = np.zeros((), int)
    return CoolingCurve(times=m.curve.times, **as_jax_arrays(fields))


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


def with_messages(
    request: Request,
    result: Fit,
    explanations: Explanations | None,
    notes: Iterable[str],
    share: float,
) -> Fit:
    """Return a result with its first line, verdict and reasons; see `measurement_share`."""
    limitations = []
    notes = list(notes)
    gases = by_label(result.gas)
    for label, m in request.measurements.items():
        if isinstance(m.data, DropTest):
            continue
        gas = gases[label]
        N = m.num_particles
        for limitation in request.model.limitations(gas, N):
            if limitation.words not in {known.words for known in limitations}:
                limitations.append(limitation)
        if gas.container is not None:
            notes.append(str(Message("gravity")))
        if N is not None and gas.container is None and "walls" not in m.absent:
            box = Message("box", of=label, number=N, walls=describe_walls(gas, N))
            notes.append(str(box))
    return with_conclusions(
        result,
        explanations,
        tuple(limitations),
        notes,
        quick=request.quick,
        measurement_share=share,
    )
