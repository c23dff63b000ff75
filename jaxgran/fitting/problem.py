"""The problem of a fit: measurements, a model, and the unknowns that are varied."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxgran._utils.validation import POSITIVE, Domain
from jaxgran.data.measurement import START_TIME, Priors
from jaxgran.fitting.comparison import Comparison
from jaxgran.fitting.evaluation import (
    Evaluation,
    compare_drops,
    residuals_of_nuisances,
    residuals_of_priors,
    sum_residuals,
)
from jaxgran.fitting.guesses import halving_time
from jaxgran.fitting.parameters import SHARED, Unknown, domain_of, extra_parameters
from jaxgran.fitting.prediction import Element, PredictedCurve, predicted_curve, steady_curve
from jaxgran.fitting.rows import FLOOR, WHITE, CurveRows, DropRows
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

MAX_KEPT = 8
"""Number of evaluations that a problem keeps: a search needs the last one again after a rejected
step, and an error budget needs the one at the estimate after the factors of variances varied."""


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
    _predicted: dict[str, tuple[bytes, PredictedCurve]] = field(
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

    def _first_with(self, label: str) -> CurveRows | DropRows:
        """Return the first measurement with the parameters of a label."""
        return next(m for m in self.measurements if label in (SHARED, m.label))

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
        drops = [m for m in self.measurements if isinstance(m, DropRows)]
        rows, scatter = compare_drops(drops, values, elements)
        curves: dict[str, dict[str, Any]] = {}
        for m in self.curves:
            own = values[m.label]
            if scatter is not None and "spread" in m.gas.domains:
                own = {"spread": scatter} | own
            curve = self._predict(m, flat, own, elements)
            rows += Comparison(curve, sources).residuals(len(elements))
            rows += residuals_of_nuisances(m, own, elements)
            curves[m.label] = curve.fields
        for label, priors in self.priors.items():
            m = self._first_with(label)
            rows += residuals_of_priors(label, priors, m.gas, values[m.label], elements)
        return sum_residuals(rows, curves, scatter)

    def _predict(
        self, m: CurveRows, flat: np.ndarray, values: dict[str, Any], elements: list[Element]
    ) -> PredictedCurve:
        """Return a predicted curve, which is computed once for all factors of the variances."""
        known, curve = self._predicted.get(m.label, (b"", None))
        if curve is None or known != flat.tobytes():
            own = [e for e in elements if e.applies_to(m.label)]
            curve = predicted_curve(m, self.simplified_model, values, own, self.tolerance)
            self._predicted[m.label] = flat.tobytes(), curve
        return curve

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
