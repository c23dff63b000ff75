"""Measured values that lie far outside of all others, and the fit without them."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from jaxgran.fitting.goodness import SIGNIFICANCE, goodness
from jaxgran.fitting.information import inverse
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.result import prefix_of
from jaxgran.fitting.rows import CurveRows
from jaxgran.fitting.search import Minimum, minimise
from jaxgran.scene.parameters import symbol_of

CHANCE = 1e-3
"""Probability that a fit without outliers has so large a residual."""

LARGEST_SHARE = 0.1
"""Largest share of the values that is left out; more are a misfit of the model."""


class Value(NamedTuple):
    """One measured value of a curve.

    Attributes:
        label: of the measurement.
        time: index of its time.
        column: 0 for T, 1 for T_rot.
    """

    label: str
    time: int
    column: int


def describe_outliers(problem: Problem, first: np.ndarray, max_steps: int) -> Iterator[str]:
    """Yield the far outliers with the first parameter of a fit without them, if it is good.

    Args:
        problem, first, max_steps: see `_without_outliers`.
    """
    rest, end, left_out = _without_outliers(problem, first, max_steps)
    found = rest.evaluate(end.flat)
    if not left_out or goodness(rest, found).p_value < SIGNIFICANCE:
        return
    times = {m.label: np.asarray(m.curve.times) for m in problem.curves}
    places = []
    for value in sorted(left_out):
        time = times[value.label][value.time]
        places.append(f"{prefix_of(value.label)}t = {time:.3g} s (row {value.time + 1})")
    symbol = symbol_of(problem.unknowns[0].name)
    estimate = rest.to_estimates(end.flat)[0]
    error = np.sqrt(inverse(found.information)[0, 0]) * rest.compute_slopes(end.flat)[0]
    yield (
        f"far outliers at {', '.join(places)}: check them and their error bars; without them "
        f"{symbol} is {estimate:.3g} +- {error:.2g}"
    )


def _without_outliers(
    problem: Problem, first: np.ndarray, max_steps: int
) -> tuple[Problem, Minimum, list[Value]]:
    """Leave out the values that fit worst, one by one, while their residuals are too large.

    Args:
        problem: of a fit.
        first: first guess of the unknowns: outliers may have led an earlier fit astray.
        max_steps: of each search.

    Returns:
        The problem without them, where its search ends, and the values that were left out. Without
        any nothing is searched: the end is the first guess.
    """
    count = sum(int(np.sum(m.used)) for m in problem.curves)
    limit = float(scipy.stats.norm.isf(CHANCE / 2 / max(count, 1)))
    end = Minimum(first, np.inf, 0, False)
    left_out: list[Value] = []
    while len(left_out) < LARGEST_SHARE * count:
        worst, residual = _worst(problem, end.flat)
        if not residual > limit:
            break
        # A value is expected from those before it: after an outlier the next residual is large,
        # too, and either value may be the outlier.
        candidates = [worst, *_predecessor(problem, worst)]
        ends = {x: minimise(_without(problem, x), end.flat, max_steps) for x in candidates}
        value = min(ends, key=lambda x: ends[x].value)
        problem = _without(problem, value)
        end = ends[value]
        left_out.append(value)
    return problem, end, left_out


def _predecessor(problem: Problem, value: Value) -> list[Value]:
    """Return the last value in use before another one of the same quantity, if there is one."""
    used = next(m.used for m in problem.curves if m.label == value.label)
    earlier = np.flatnonzero(used[: value.time, value.column])
    return [value._replace(time=int(time)) for time in earlier[-1:]]


def _worst(problem: Problem, flat: np.ndarray) -> tuple[Value, float]:
    """Return the value of the largest residual, and the residual over its standard deviation."""
    found = (Value("", 0, 0), 0.0)
    for row in problem.evaluate(flat).rows:
        if row.name == "curve":
            sizes = np.abs(row.values)
            place = int(np.argmax(sizes))
            column, time = divmod(place, sizes.size // 2)
            if sizes[place] > found[1]:
                found = (Value(row.label, time, column), float(sizes[place]))
    return found


def _without(problem: Problem, value: Value) -> Problem:
    def without(m: CurveRows) -> CurveRows:
        used = m.used.copy()
        used[value.time, value.column] = 0.0
        return replace(m, used=used)

    measurements = tuple(
        without(m) if isinstance(m, CurveRows) and m.label == value.label else m
        for m in problem.measurements
    )
    return replace(problem, measurements=measurements)
