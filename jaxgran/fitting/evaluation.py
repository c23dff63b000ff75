"""-2 ln L of a problem with its derivatives, and the residuals that it is the sum of."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran.data.drop_test import SPHERE
from jaxgran.data.measurement import Priors
from jaxgran.fitting.comparison import Residuals
from jaxgran.fitting.parameters import SHARED, prior_residuals, residuals_and_slopes
from jaxgran.fitting.prediction import Element
from jaxgran.fitting.rows import CurveRows, DropRows
from jaxgran.scene.gas import Gas


class Evaluation(NamedTuple):
    """-2 ln L at some values of the unknowns.

    Attributes:
        value: -2 ln L, up to a constant.
        gradient: its derivatives, at the scatter of eps that is found.
        information: half of its expected second derivatives.
        rows: the residuals.
        curves: the computed curves at the times of the data, dictionaries of their fields.
        scatter_of_eps: standard deviation of eps that impacts of two spheres show; None without
            such impacts.
    """

    value: float
    gradient: Float[np.ndarray, "unknowns"]
    information: Float[np.ndarray, "unknowns unknowns"]
    rows: list[Residuals]
    curves: dict[str, dict[str, Any]]
    scatter_of_eps: float | None = None

    @property
    def is_finite(self) -> bool:
        """Whether the model could compute the curves."""
        return bool(np.isfinite(self.value) and np.all(np.isfinite(self.information)))


def sum_residuals(
    rows: list[Residuals],
    curves: dict[str, dict[str, Any]],
    scatter_of_eps: float | None = None,
) -> Evaluation:
    """Return -2 ln L of independent residuals, with its derivatives.

    Args:
        rows, curves, scatter_of_eps: see `Evaluation`.
    """
    value = 0.0
    size = rows[0].slopes.shape[1]
    gradient = np.zeros(size)
    information = np.zeros((size, size))
    for row in rows:
        value += float(np.sum(row.values**2) + np.sum(row.log_variance))
        gradient += 2 * row.values @ row.slopes + (1 - row.values**2) @ row.log_slopes
        information += row.information
    return Evaluation(value, gradient, information, rows, curves, scatter_of_eps)


class ComparedDrops(NamedTuple):
    """Drop tests beside the impacts of their gases.

    Attributes:
        rows: the residuals of each drop test.
        scatter_of_eps: see `Evaluation`.
    """

    rows: list[Residuals]
    scatter_of_eps: float | None


def compare_drops(
    drops: list[DropRows], values: dict[str, dict[str, Any]], elements: list[Element]
) -> ComparedDrops:
    """Compare drop tests with the impacts of their gases.

    Args:
        drops: the drop tests.
        values: SI values of all parameters that are varied, by label and name.
        elements: the unknowns.
    """
    impacts = [(m, _compare_impacts(m, values[m.label])) for m in drops]
    rows = [_residuals_of_impacts(m, found, elements) for m, found in impacts]
    return ComparedDrops(rows, _common_scatter(impacts))


class _ComparedImpacts(NamedTuple):
    """Measured impacts beside the impacts of a gas.

    Attributes:
        residuals: measured minus computed values over their errors, shape (values,).
        slopes: derivatives of the residuals in SI values, by parameter.
        scatter: standard deviation of eps from impact to impact.
        widening: factor by which this widens each error, shape (values,).
    """

    residuals: np.ndarray
    slopes: dict[str, Any]
    scatter: float
    widening: np.ndarray


def _compare_impacts(m: DropRows, values: dict[str, Any]) -> _ComparedImpacts:
    parameters = {name: jnp.asarray(x) for name, x in values.items() if name in m.gas.domains}
    residuals, slopes = residuals_and_slopes(m.data.residuals, m.gas, parameters)
    residuals = np.asarray(residuals)
    scatter = m.scatter_of_eps(parameters, residuals)
    return _ComparedImpacts(residuals, slopes, scatter, m.widening(parameters, scatter))


def _common_scatter(impacts: list[tuple[DropRows, _ComparedImpacts]]) -> float | None:
    """Return the standard deviation of eps over all impacts of two spheres whose eps scatters."""
    found = [(m, x) for m, x in impacts if m.data.onto == SPHERE and m.data.scatters]
    if not found:
        return None
    squares = [x.scatter**2 for _, x in found]
    return float(np.average(squares, weights=[m.num_points for m, _ in found]) ** 0.5)


def _residuals_of_impacts(
    m: DropRows, found: _ComparedImpacts, elements: list[Element]
) -> Residuals:
    """Return the residuals of a drop test, whose errors the scatter of eps widens."""
    values = found.residuals / found.widening
    slopes = {name: x / found.widening[:, None] for name, x in found.slopes.items()}
    row = _of_unit_variance("drop test", m.label, values, slopes, elements, is_prior=False)
    return row._replace(log_variance=2 * np.log(found.widening))


def residuals_of_nuisances(
    m: CurveRows, values: dict[str, Any], elements: list[Element]
) -> list[Residuals]:
    """Return the residuals of the nuisance parameters of a curve, whose expected value is 0.

    Args:
        m: the curve.
        values: SI values of its parameters, by name.
        elements: the unknowns.
    """
    rows = []
    for name, error in m.nuisances.items():
        slopes = {name: np.ones((1, 1)) / error}
        row = np.atleast_1d(values[name]) / error
        rows.append(_of_unit_variance(name, m.label, row, slopes, elements))
    return rows


def residuals_of_priors(
    label: str, priors: Priors, gas: Gas, values: dict[str, Any], elements: list[Element]
) -> list[Residuals]:
    """Return the residuals of priors, see `jaxgran.fitting.parameters.prior_residuals`.

    Args:
        label: of the measurement with these priors, or `SHARED`.
        priors: the known values.
        gas: of this measurement, or of one that shares them.
        values: SI values of the parameters of this gas, by name.
        elements: the unknowns.
    """
    return [
        _of_unit_variance(name, label, row, slopes, elements)
        for name, (row, slopes) in prior_residuals(priors, gas, values).items()
    ]


def _of_unit_variance(
    name: str,
    label: str,
    values: Any,
    slopes: dict[str, Any],
    elements: list[Element],
    is_prior: bool = True,
) -> Residuals:
    """Return residuals of variance 1, from their derivatives in SI values by parameter."""
    values = np.asarray(values, float)
    matrix = np.zeros((values.size, len(elements)))
    for e in elements:
        applies = label == SHARED or e.applies_to(label)
        if applies and e.name in slopes:
            matrix[:, e.place] = np.asarray(slopes[e.name])[:, e.number] * e.slope
    return Residuals(
        name,
        label,
        values=values,
        slopes=matrix,
        log_variance=np.zeros(values.size),
        log_slopes=np.zeros_like(matrix),
        is_prior=is_prior,
    )
