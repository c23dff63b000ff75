"""The problem of a fit: measurements, unknowns, and -2 ln L with its derivatives."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran._utils.validation import POSITIVE, Domain
from jaxgran.data.drop_test import SPHERE
from jaxgran.data.measurement import START_TIME, Priors
from jaxgran.fitting.comparison import Comparison, Residuals
from jaxgran.fitting.guesses import halving_time
from jaxgran.fitting.parameters import (
    SHARED,
    Unknown,
    domain_of,
    extra_parameters,
    prior_residuals,
    residuals_and_slopes,
)
from jaxgran.fitting.prediction import Element, PredictedCurve, predicted_curve, steady_curve
from jaxgran.fitting.rows import FLOOR, WHITE, CurveRows, DropRows
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

MAX_KEPT = 8
"""Number of evaluations that a problem keeps: a search needs the last one again after a rejected
step, and an error budget needs the one at the estimate after the factors of variances varied."""


class Evaluation(NamedTuple):
    """-2 ln L at some values of the unknowns.

    Attributes:
        value: -2 ln L, up to a constant.
        gradient: its derivatives.
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


@dataclass(frozen=True)
class Problem:
    """Measurements, a model without noise, and the unknowns that are varied.

    Attributes:
        measurements: curves and drop tests.
        model: computes the curves.
        simplified_model: the same without what no measurement needs
            (`jaxgran.models.base.AbstractModel.simplified_for`).
        unknowns: the free parameters, then those that vary because of a prior, then nuisance
            parameters.
        num_free: number of elements of the free parameters.
        priors: of shared parameters (`SHARED`) and of single measurements, by label.
        fixed: SI values of further parameters, by label and name.
        tolerance: factor of the model's tolerance.
    """

    measurements: tuple[CurveRows | DropRows, ...]
    model: AbstractModel
    simplified_model: AbstractModel
    unknowns: tuple[Unknown, ...]
    num_free: int
    priors: dict[str, Priors]
    fixed: dict[str, dict[str, Any]] = field(default_factory=dict)
    tolerance: float = 1.0
    _evaluations: dict[tuple[Any, ...], Evaluation] = field(
        init=False, default_factory=dict, compare=False
    )
    _curves: dict[str, tuple[bytes, PredictedCurve]] = field(
        init=False, default_factory=dict, compare=False
    )

    @classmethod
    def build(
        cls,
        measurements: tuple[CurveRows | DropRows, ...],
        model: AbstractModel,
        free: tuple[str, ...],
        separate: tuple[str, ...],
        priors: dict[str, Priors],
    ) -> "Problem":
        """Return the problem of `jaxgran.fit`.

        Args:
            measurements, model, priors: see the class.
            free: names of shared free parameters.
            separate: names of free parameters that each curve has separately.
        """
        curves = [m for m in measurements if isinstance(m, CurveRows)]
        gas = measurements[0].gas

        unknown = partial(build_unknown, curves=curves)
        unknowns = [unknown(name, SHARED, gas) for name in free]
        unknowns += [unknown(name, m.label, m.gas) for name in separate for m in curves]
        num_free = sum(u.size for u in unknowns)
        by_label = {SHARED: gas} | {m.label: m.gas for m in measurements}
        for label, some in priors.items():
            known = tuple(u.name for u in unknowns if u.applies_to(label))
            extra = extra_parameters(some, known)
            unknowns += [unknown(name, label, by_label[label]) for name in extra]
        for m in measurements:
            unknowns += [Unknown(name, m.label, (), Domain()) for name in m.nuisances]
        displacement = any(m.displacement is not None for m in curves)
        scenes = [m.scene for m in measurements]
        simplified = model.simplified_for(*scenes, displacement=displacement)
        return cls(measurements, model, simplified, tuple(unknowns), num_free, priors)

    @property
    def curves(self) -> tuple[CurveRows, ...]:
        """The measured curves."""
        return tuple(m for m in self.measurements if isinstance(m, CurveRows))

    def _first_with(self, label: str) -> CurveRows | DropRows:
        """Return the first measurement with the parameters of a label."""
        return next(m for m in self.measurements if label in (SHARED, m.label))

    @property
    def places(self) -> dict[str, slice]:
        """Places of the free parameters in the array of the unknowns, by their names in a `Fit`."""
        places = {}
        begin = 0
        for u in self.unknowns:
            end = begin + u.size
            if end <= self.num_free:
                places[u.title] = slice(begin, end)
            begin = end
        return places

    def extend_fixed(self, values: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        """Return the fixed values with further ones, by label and name."""
        labels = {*self.fixed, *values}
        return {label: self.fixed.get(label, {}) | values.get(label, {}) for label in labels}

    def hold_at_zero(self, name: str) -> tuple["Problem", np.ndarray]:
        """Return the problem with the unknowns of a name held at 0, and which elements are left."""
        unknowns = tuple(u for u in self.unknowns if u.name != name)
        fixed = {m.label: self.fixed.get(m.label, {}) | {name: 0.0} for m in self.measurements}
        names = self.repeat_per_element([u.name for u in self.unknowns])
        return replace(self, unknowns=unknowns, fixed=fixed), names != name

    def check_points(self) -> None:
        """Raise ValueError unless curves have more points that count than free parameters."""
        points = sum(m.num_points for m in self.measurements)
        if self.curves and points <= self.num_free:
            raise ValueError(
                f"{points} points (those with an error of 0 not counted) cannot determine "
                f"{self.num_free} parameters; free fewer of them"
            )

    def check_start(self, flat: np.ndarray) -> None:
        """Raise ValueError if a search through a logarithm would begin at minus infinity."""
        at_end = [
            f"{unknown.title} = {value}"
            for unknown, value in self.split(flat)
            if not np.all(np.isfinite(unknown.domain.to_free(value)))
        ]
        if at_end:
            raise ValueError(
                f"a fit cannot start at {', '.join(at_end)}, an end of the range: give the gas, or "
                "start, a value inside it"
            )

    def flatten(self, values: dict[str, dict[str, Any]]) -> np.ndarray:
        """Return SI values, by label and name, in their unconstrained scale, in one array.

        They are the values of all parameters of the gases, and of t0 where it is an unknown;
        nuisance parameters are 0.
        """
        parts = []
        for u in self.unknowns:
            m = self._first_with(u.label)
            value = np.asarray(values[m.label].get(u.name, 0.0), float)
            parts.append(np.ravel(u.domain.to_free(value) / u.unit))
        return _concatenated(parts)

    def split(self, flat: Any) -> list[tuple[Unknown, Any]]:
        """Return each unknown with its SI value."""
        pairs = []
        begin = 0
        for u in self.unknowns:
            free = flat[begin : begin + u.size].reshape(u.shape)
            begin += u.size
            pairs.append((u, u.domain.from_free(free * u.unit)))
        return pairs

    def to_estimates(self, flat: np.ndarray) -> np.ndarray:
        """Return SI values of the free parameters in one array."""
        values = [np.ravel(value) for _, value in self.split(flat)]
        return _concatenated(values)[: self.num_free]

    def compute_slopes(self, flat: np.ndarray) -> np.ndarray:
        """Return the derivative of each SI value in its unconstrained parameter."""
        slopes = [np.ravel(u.domain.slope(value)) * u.unit for u, value in self.split(flat)]
        return _concatenated(slopes)

    def repeat_per_element(self, values: Sequence[Any]) -> np.ndarray:
        """Return one value for each unknown, repeated for each of its elements."""
        return np.repeat(values, [u.size for u in self.unknowns])

    def unflatten(self, flat: Any) -> dict[str, dict[str, Any]]:
        """Return SI values of all parameters that are varied, by label and name."""
        values = {m.label: dict(self.fixed.get(m.label, {})) for m in self.measurements}
        for u, value in self.split(flat):
            for label in values:
                if u.applies_to(label):
                    values[label][u.name] = value
        return values

    def list_elements(self, flat: np.ndarray) -> list[Element]:
        """Return each number of the unknowns, with its derivative in the unconstrained scale."""
        places = [(u, number) for u in self.unknowns for number in range(u.size)]
        slopes = self.compute_slopes(flat)
        return [
            Element(u.name, u.label, number, place, float(slopes[place]))
            for place, (u, number) in enumerate(places)
        ]

    def evaluate(self, flat: np.ndarray, **sources: float) -> Evaluation:
        """Return -2 ln L at the unknowns, with its derivatives.

        Args:
            flat: the unknowns, in their unconstrained scale.
            sources: factors of variances, see `jaxgran.fitting.comparison.Comparison`.
        """
        key = (flat.tobytes(), *sources.items())
        kept = self._evaluations
        if key not in kept:
            if len(kept) == MAX_KEPT:
                oldest = next(iter(kept))
                del kept[oldest]
            kept[key] = self._evaluate(flat, sources)
        return kept[key]

    def _evaluate(self, flat: np.ndarray, sources: dict[str, float]) -> Evaluation:
        values = self.unflatten(flat)
        elements = self.list_elements(flat)
        impacts = [
            (m, _compared_impacts(m, values[m.label]))
            for m in self.measurements
            if isinstance(m, DropRows)
        ]
        scatter = _common_scatter(impacts)
        rows = [_impact_residuals(m, found, elements) for m, found in impacts]
        curves: dict[str, dict[str, Any]] = {}
        for m in self.curves:
            own = values[m.label]
            if scatter is not None and "spread" in m.gas.domains:
                own = {"spread": scatter} | own
            curve = self._curve(m, flat, own, elements)
            rows += Comparison(curve, sources).residuals(len(elements))
            rows += _nuisance_residuals(m, own, elements)
            curves[m.label] = curve.fields
        rows += self._prior_residuals(values, elements)
        return summed(rows, curves, scatter)

    def _curve(
        self, m: CurveRows, flat: np.ndarray, values: dict[str, Any], elements: list[Element]
    ) -> PredictedCurve:
        """Return a computed curve: it is computed once for all factors of the variances."""
        known, curve = self._curves.get(m.label, (b"", None))
        if curve is None or known != flat.tobytes():
            own = [e for e in elements if e.applies_to(m.label)]
            curve = predicted_curve(m, self.simplified_model, values, own, self.tolerance)
            self._curves[m.label] = flat.tobytes(), curve
        return curve

    def _prior_residuals(
        self, values: dict[str, dict[str, Any]], elements: list[Element]
    ) -> list[Residuals]:
        rows = []
        for label, priors in self.priors.items():
            m = self._first_with(label)
            for name, (row, slopes) in prior_residuals(priors, m.gas, values[m.label]).items():
                rows.append(_of_unit_variance(name, label, row, slopes, elements))
        return rows

    def compile_innovations(self, flat: np.ndarray) -> None:
        """Compile what an evaluation needs apart from the curves, whatever these are."""
        values = self.unflatten(flat)
        elements = self.list_elements(flat)
        for m in self.curves:
            curve = predicted_curve(
                m,
                self.simplified_model,
                values[m.label],
                [e for e in elements if e.applies_to(m.label)],
                self.tolerance,
                linearise=steady_curve,
            )
            Comparison(curve).residuals(len(elements))


def _concatenated(arrays: list[np.ndarray]) -> np.ndarray:
    """Return arrays as one, which is empty if there are none."""
    return np.concatenate(arrays) if arrays else np.zeros(0)


def build_unknown(name: str, label: str, gas: Gas, curves: Iterable[CurveRows]) -> Unknown:
    """Return a parameter as an unknown.

    Args:
        name: of a parameter of a gas, t0, or an error of T.
        label: of the measurement, or `SHARED`.
        gas: of the measurement.
        curves: all measured curves.
    """
    if name in (FLOOR, WHITE):
        return Unknown(name, label, (), POSITIVE)
    domain = domain_of(gas, name)
    if name != START_TIME:
        return Unknown(name, label, jnp.shape(gas.value(name)), domain)
    unit = halving_time(next(m.curve for m in curves if label in (SHARED, m.label)))
    return Unknown(name, label, (), domain, float(unit))


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


def _compared_impacts(m: DropRows, values: dict[str, Any]) -> _ComparedImpacts:
    floats = {name: jnp.asarray(x) for name, x in values.items() if name in m.gas.domains}
    residuals, slopes = residuals_and_slopes(m.data.residuals, m.gas, floats)
    residuals = np.asarray(residuals)
    scatter = m.scatter_of_eps(floats, residuals)
    return _ComparedImpacts(residuals, slopes, scatter, m.widening(floats, scatter))


def _common_scatter(impacts: list[tuple[DropRows, _ComparedImpacts]]) -> float | None:
    """Return the standard deviation of eps over all impacts of two spheres whose eps scatters."""
    found = [(m, x) for m, x in impacts if m.data.onto == SPHERE and m.data.scatters]
    if not found:
        return None
    squares = [x.scatter**2 for _, x in found]
    return float(np.average(squares, weights=[m.num_points for m, _ in found]) ** 0.5)


def _impact_residuals(m: DropRows, found: _ComparedImpacts, elements: list[Element]) -> Residuals:
    """Return the residuals of a drop test, whose errors the scatter of eps widens."""
    slopes = {name: x / found.widening[:, None] for name, x in found.slopes.items()}
    row = _of_unit_variance(
        "drop test", m.label, found.residuals / found.widening, slopes, elements, is_prior=False
    )
    return row._replace(log_variance=2 * np.log(found.widening))


def _nuisance_residuals(
    m: CurveRows, values: dict[str, Any], elements: list[Element]
) -> list[Residuals]:
    """Return the residuals of nuisance parameters, whose expected value is 0."""
    rows = []
    for name, error in m.nuisances.items():
        slopes = {name: np.ones((1, 1)) / error}
        row = np.atleast_1d(values[name]) / error
        rows.append(_of_unit_variance(name, m.label, row, slopes, elements))
    return rows


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


def summed(
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
