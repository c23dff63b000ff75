"""Whether a fitted model explains the data."""

from typing import NamedTuple

import numpy as np
import scipy

from jaxgran.fitting.comparison import Residuals
from jaxgran.fitting.evaluation import Evaluation
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import SCATTER

SIGNIFICANCE = 0.005
"""Level of significance of the test of the misfit, on each side."""


class Goodness(NamedTuple):
    """The test of a fit: see the fields of `jaxgran.fitting.result.Fit` with these names."""

    chi2: float
    degrees_of_freedom: int
    p_value: float
    smooth_p_value: float


def goodness(problem: Problem, found: Evaluation) -> Goodness:
    """Return chi^2, its degrees of freedom, and its probabilities by chance.

    T and T_rot, <dr^2> and each drop test are tested separately, so that many points of one do not
    hide a misfit of the other: the p-value is the smallest of theirs, corrected for the choice.
    Where N is not known, its scatter explains any curve: then it is tested that N is not too small.
    """
    chi2 = sum(float(np.sum(row.values**2)) for row in found.rows)
    counts = {id(row): _count(problem, row) for row in found.rows}
    size = found.gradient.size
    degrees = max(sum(counts.values()) - size, 1)
    measured = [row for row in found.rows if not row.is_prior]
    upper = []
    lower = []
    for row in measured:
        own = problem.num_free if len(measured) == 1 else 0
        number = max(counts[id(row)] - own, 1)
        square = float(np.sum(row.values**2))
        upper.append(float(scipy.stats.chi2.sf(square, number)))
        if row.name == "curve":
            lower.append(float(scipy.stats.chi2.cdf(square, number)))

    unknown = [m.label for m in problem.curves if m.measurement.num_particles is None]
    for row in found.rows:
        if row.name == SCATTER and row.label in unknown:
            upper.append(float(scipy.stats.norm.sf(row.values[0])))

    def corrected_p_value(values: list[float]) -> float:
        if not values:
            return 1.0
        return float(-np.expm1(len(values) * np.log1p(-min(min(values), 1 - 1e-12))))

    return Goodness(chi2, degrees, corrected_p_value(upper), corrected_p_value(lower))


def _count(problem: Problem, row: Residuals) -> int:
    """Return the number of residuals that count."""
    for m in problem.curves:
        if m.label == row.label and row.name == "curve":
            return int(np.sum(m.used))
        if m.label == row.label and row.name == "displacement" and m.displacement is not None:
            return int(np.sum(m.displacement.used))
    return row.values.size


def measurement_share(problem: Problem, found: Evaluation) -> float:
    """Return the share of the errors of the measurement in the variances of T."""
    shares = []
    for m in problem.curves:
        row = next(r for r in found.rows if r.label == m.label and r.name == "curve")
        variance = np.exp(np.split(row.log_variance, 2)[0])
        relative = (m.errors[:, 0] / found.curves[m.label]["temperature"]) ** 2
        shares.append(np.mean((relative / variance)[m.used[:, 0] > 0]))
    return float(max(shares, default=0.0))
