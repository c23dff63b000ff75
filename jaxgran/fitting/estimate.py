"""A fit of a model without noise: its searches, and the tests of what they found."""

from dataclasses import replace

import numpy as np

from jaxgran._utils import status
from jaxgran.fitting.alternatives import compare_alternatives
from jaxgran.fitting.assemble import assemble_fit
from jaxgran.fitting.conclusions import with_conclusions
from jaxgran.fitting.descent import Descent
from jaxgran.fitting.evaluation import Evaluation
from jaxgran.fitting.goodness import SIGNIFICANCE, Goodness, goodness, measurement_share
from jaxgran.fitting.information import DEGENERATE
from jaxgran.fitting.outliers import describe_outliers
from jaxgran.fitting.prediction import TINY
from jaxgran.fitting.problem import Problem, build_unknown
from jaxgran.fitting.profiles import ALLOWED
from jaxgran.fitting.result import Fit
from jaxgran.fitting.rows import SCATTER, WHITE, CurveRows, has_no_measured_errors
from jaxgran.fitting.search import Minimum, Solution, deepest, minima_from_starts, minimise
from jaxgran.fitting.setup import Request, build_problem, problem_with_rate_errors

ERROR_LIMITS = (1e-4, 1.0)
"""Range of the first guess of the relative standard deviation of independent errors of T. A curve
of less than three points gives the lower end."""

DISTANT_FACTOR = 3.0
"""Factor between measured and fitted T. If `DISTANT_SHARE` of the values differ by more, the scale
of T or of time is wrong."""

NEGLIGIBLE_SCATTER = 1e-3
"""Standard deviation of eps from impact to impact up to which it is not reported."""

DISTANT_SHARE = 0.8
"""Share of such values: where T has fallen most, a curve in another unit may come near."""


def fit_without_noise(request: Request, max_steps: int, descent: Descent | None = None) -> Fit:
    """Fit a model without noise, starting at the best of some guesses.

    Args:
        request: of the user.
        max_steps: of each search.
        descent: a gradient descent in place of Newton's method; None for the latter.
    """
    problem, first, notes_on_data = build_problem(request)
    problem.check_points()
    plain = _solve(problem, first, max_steps, descent)
    solution = plain
    if descent is None and not _is_explained(plain):
        solution = _with_errors_of_T(plain, first, max_steps)
    found = solution.evaluate()
    is_distant = _is_distant(solution.problem, found)
    explanations = None
    if solution.best.converged and not (request.quick or is_distant):
        further_errors = np.zeros(problem.num_free)
        explanations = compare_alternatives(solution.problem, solution.minima, further_errors)
    quality = _goodness_without_errors_of_T(plain, solution)
    result = assemble_fit(request, solution, explanations, quality)
    notes = [*notes_on_data]
    if is_distant:
        notes.append(
            "nearly every T differs from the fitted one by more than a factor of "
            f"{DISTANT_FACTOR:g}: alternatives were not compared; check the units, the scale of T "
            "and T0"
        )
    elif quality.p_value < SIGNIFICANCE and not request.quick:
        notes += describe_outliers(plain.problem, first, max_steps)
    scatter = found.scatter_of_eps
    if scatter is not None and scatter > NEGLIGIBLE_SCATTER:
        notes.append(f"eps of the impacts scatters by {scatter:.2g} beyond its errors")
    share = measurement_share(solution.problem, found)
    return with_conclusions(request, result, explanations, notes, share)


# --- the searches


def _solve(
    problem: Problem, first: np.ndarray, max_steps: int, descent: Descent | None
) -> Solution:
    """Return where the searches end; raise RuntimeError if no curve is computed there."""
    if descent is None:
        solution = _solve_by_newton(problem, first, max_steps)
    else:  # it keeps the errors of the cooling rate that it began with
        minima = minima_from_starts(problem, first, max_steps, descent)
        solution = Solution(problem, deepest(minima), minima)
    _check_computed(solution.problem, solution.best)
    return solution


def _solve_by_newton(problem: Problem, first: np.ndarray, max_steps: int) -> Solution:
    """Return the deepest minimum, and those that are nearly as deep, with the problem there.

    The first search has the scatter that N gives. The second one finds it, too, with the errors of
    the model's cooling rate in the gas that the first one found.
    """
    held, is_left = problem.hold_at_zero(SCATTER)
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
    return Solution(problem, best._replace(steps=begun.steps + best.steps), minima)


def _with_errors_of_T(plain: Solution, first: np.ndarray, max_steps: int) -> Solution:
    """Return where the searches end with independent errors of T, if the data show them.

    Where a curve scatters more than its grains can, and has no errors, the estimates would follow
    its noise. Without such a curve, or errors, the given solution is returned.
    """
    problem = plain.problem
    bare = [m for m in problem.curves if has_no_measured_errors(m)]
    if not bare:
        return plain
    computed = problem.evaluate(first).curves
    unknowns = [build_unknown(WHITE, m.label, m.scene, problem.curves) for m in bare]
    sizes = [_guess_of_error(m, computed[m.label]["temperature"]) for m in bare]
    wider = replace(problem, unknowns=(*problem.unknowns, *unknowns))
    try:
        solution = _solve_by_newton(wider, np.append(first, np.log(sizes)), max_steps)
    except RuntimeError:  # no curve is computed where this search ends
        return plain
    is_better = solution.best.value <= plain.best.value - ALLOWED
    return solution if is_better and solution.best.converged else plain


def _guess_of_error(m: CurveRows, computed: np.ndarray) -> float:
    """Return the standard deviation of ln T about a smooth curve, from second differences.

    Those of independent values have 1 + 4 + 1 times their variance.
    """
    used = (m.used[:, 0] > 0) & (m.values[:, 0] > 0)
    residuals = np.log(m.values[used, 0] / computed[used])
    second = np.diff(residuals, 2)
    variance = np.mean(second**2) / 6 if second.size else 0.0
    return float(np.clip(np.sqrt(variance), *ERROR_LIMITS))


def _check_computed(problem: Problem, minimum: Minimum) -> None:
    """Raise RuntimeError if one of the curves was not computed where a search ended."""
    for curve in problem.evaluate(minimum.flat).curves.values():
        fault = int(curve.get("status", status.OK))
        if fault != status.OK:
            values = [np.asarray(value) for _, value in problem.split(minimum.flat)]
            free = zip(problem.places, values, strict=False)
            at = ", ".join(f"{name} = {np.array2string(x, precision=3)}" for name, x in free)
            raise RuntimeError(
                f"{type(problem.model).__name__} could not compute the curve at {at}, where the "
                f"search ended: {status.explain(fault)}"
            )
    if not np.isfinite(minimum.value):
        raise RuntimeError(
            "the likelihood is not a number where the search begins, at "
            f"{problem.to_estimates(minimum.flat)}: give start, a gas nearer to the measured one"
        )


# --- the tests


def _is_explained(solution: Solution) -> bool:
    """Tell whether a search converged at values that are consistent with the data."""
    if not solution.best.converged:
        return False
    return goodness(solution.problem, solution.evaluate()).p_value >= SIGNIFICANCE


def _goodness_without_errors_of_T(plain: Solution, solution: Solution) -> Goodness:
    """Return the test of a fit without the errors of T that it added.

    These errors would explain any misfit.

    Args:
        plain: found without them.
        solution: found last; its values are tested if the first search did not converge.
    """
    flat = plain.best.flat
    if not plain.best.converged:
        flat = solution.best.flat[: flat.size]  # the added errors are the last unknowns
    return goodness(plain.problem, plain.problem.evaluate(flat))


def _is_distant(problem: Problem, found: Evaluation) -> bool:
    """Tell whether no fit and no alternative comes near one of the curves.

    All alternatives begin at the same T_0: values that are far off are in another unit, and the
    search for an alternative would not end.
    """
    for m in problem.curves:
        used = m.used[:, 0] > 0
        T = np.maximum(m.values[used, 0], TINY)
        distances = np.abs(np.log(T / found.curves[m.label]["temperature"][used]))
        if np.mean(distances > np.log(DISTANT_FACTOR)) >= DISTANT_SHARE:
            return True
    return False
