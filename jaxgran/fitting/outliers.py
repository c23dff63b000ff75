"""Measured values that lie far outside of all others, and the fit without them."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import CurveRows
from jaxgran.fitting.search import Minimum, minimise

CHANCE = 1e-3
"""Probability that a curve without outliers has a residual as large."""

MOST = 0.1
"""Share of the values of a curve beyond which they are not outliers but a misfit."""


class Value(NamedTuple):
    """One measured value of a curve.

    Attributes:
        label: of the measurement.
        time: its place among the times.
        column: 0 of T, 1 of T_rot.
    """

    label: str
    time: int
    column: int


def without_outliers(
    problem: Problem, first: np.ndarray, max_steps: int
) -> tuple[Problem, Minimum, list[Value]]:
    """Leave out the values that fit worst, one by one, while their residuals are too large.

    Args:
        problem: of a fit.
        first: the first guess of a fit, which far outliers lead astray.
        max_steps: of each search.

    Returns:
        The problem without them, where its search ends, and the values that were left out.
    """
    count = sum(m.num_points for m in problem.curves)
    limit = float(scipy.stats.norm.isf(CHANCE / 2 / max(count, 1)))
    end = Minimum(first, np.inf, 0, False)
    left_out: list[Value] = []
    while len(left_out) < MOST * count:
        worst, residual = _worst(problem, end.flat)
        if not residual > limit:
            break
        # An outlier makes the residual of its successor large, too.
        both = [worst, worst._replace(time=worst.time - 1)][: 1 + (worst.time > 0)]
        ends = {x: minimise(_without(problem, x), end.flat, max_steps) for x in both}
        value = min(ends, key=lambda x: ends[x].value)
        problem = _without(problem, value)
        end = ends[value]
        left_out.append(value)
    return problem, end, left_out


def _worst(problem: Problem, flat: np.ndarray) -> tuple[Value, float]:
    """Return the value of the largest residual, and the size of the latter."""
    found = (Value("", 0, 0), 0.0)
    for row in problem.evaluate(flat).rows:
        if row.name == "curve" and row.label is not None:
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
