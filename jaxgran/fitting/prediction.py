"""A curve by a model as it is compared with a measured one, with its derivatives in the unknowns.

The curve comes, with its derivatives in all parameters, from the one compiled program of
`jaxgran.models.linearise`. What is compared is ln T and ln T_rot at the times of the data, on the
clock and with the definition of T of the measurement.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgran._utils.tracing import grid_size
from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.guesses import power_of_line
from jaxgran.fitting.parameters import as_floats, with_parameters
from jaxgran.fitting.rows import CALIBRATION, FLOOR, ROTATION, SCATTER, WHITE, CurveRows
from jaxgran.models.base import AbstractModel
from jaxgran.models.linearise import LinearisedCurve, linearise
from jaxgran.scene.gas import Gas
from jaxgran.theory.sizes import energy_ratio, energy_slope

MAX_LINE_BEFORE = 1.9
"""Largest value of the line ``(T(t)/T(0))^-p`` that is continued before the start, to 2 minus its
value: at 2 the continued T diverges."""

MAX_LOG_STEP = 0.25
"""Longest step between two times at which a curve is computed, in ln(1 + t/tau_c): ln T falls by at
most .4 in a step."""

TINY = float(np.finfo(np.float32).tiny)


class Element(NamedTuple):
    """One number of an unknown.

    Attributes:
        name, label: of the unknown.
        number: its place in the value of the unknown.
        place: its place among all unknowns.
        slope: derivative of its SI value in the unconstrained parameter.
    """

    name: str
    label: str | None
    number: int
    place: int
    slope: float


class Prediction(NamedTuple):
    """A curve at the nodes, which are the times of the data and times between them.

    The same class holds its derivatives in one unknown.

    Attributes:
        log_T, rotation, collisions: ln T, T_rot/T, collisions per particle, shape (nodes,).
        compared: ln T and ln T_rot that are compared with the data, shape (nodes, 2).
        displacement: ln <dr^2>, shape (nodes,).
        parameters: of the gas, by name.
        size_ratio: q of spheres of unequal sizes, shape (nodes,); None for equal spheres.
        scatter: logarithm of the scatter of N grains over what theory gives.
        floor: what is added to the computed T, m^2/s^2.
        white: relative standard deviation of further independent errors of T.
    """

    log_T: np.ndarray
    rotation: np.ndarray
    collisions: np.ndarray
    compared: np.ndarray
    displacement: np.ndarray
    parameters: dict[str, np.ndarray]
    size_ratio: np.ndarray | None = None
    scatter: float = 0.0
    floor: float = 0.0
    white: float = 0.0


@dataclass(frozen=True)
class _Continuation:
    """Logarithms of temperatures, continued to times before the start.

    A power of T is nearly a straight line in time: ``(T(-t)/T(0))^-p = 2 - (T(t)/T(0))^-p``.

    Attributes:
        logs: ln T and ln T_rot at the times |t|, the first of which is 0.
        is_before: whether the time is -|t|.
        power: p for which T^(-p) is a straight line.
    """

    logs: Float[np.ndarray, "nodes 2"]
    is_before: Bool[np.ndarray, "nodes"]
    power: float

    @cached_property
    def line(self) -> Float[np.ndarray, "nodes 2"]:
        """``(T(t)/T(0))^-p`` at |t|."""
        line = np.exp(-self.power * (self.logs - self.logs[:1]))
        return np.minimum(line, MAX_LINE_BEFORE)

    def values(self) -> Float[np.ndarray, "nodes 2"]:
        """Return the logarithms at the times t."""
        continued = self.logs[:1] - np.log(2 - self.line) / self.power
        return np.where(self.is_before[:, None], continued, self.logs)

    def changes(self, of_logs: Float[np.ndarray, "nodes 2"]) -> Float[np.ndarray, "nodes 2"]:
        """Return the derivatives of `values` from the derivatives of the logarithms at |t|."""
        steepness = self.line / (2 - self.line)
        continued = of_logs[:1] - steepness * (of_logs - of_logs[:1])
        return np.where(self.is_before[:, None], continued, of_logs)


@dataclass(frozen=True)
class _ExpandedCurve:
    """A computed curve with its derivatives, from which predictions are made.

    Attributes:
        rows: the measurement.
        gas: the gas, with all elements.
        times: |t| of the nodes, s.
        place: place of each time of the data among the nodes.
        is_before: whether a node is before the start.
        linear: the curve, whose values include `collisions`.
    """

    rows: CurveRows
    gas: Gas
    times: Float[np.ndarray, "nodes"]
    place: Int[np.ndarray, "times"]
    is_before: Bool[np.ndarray, "nodes"]
    linear: LinearisedCurve

    def value(self, name: str) -> Float[np.ndarray, "nodes"]:
        """Return a field of the curve; 0 for one that it does not have."""
        return self.linear.values.get(name, self.nothing)

    @cached_property
    def nothing(self) -> Float[np.ndarray, "nodes"]:
        """0 at all nodes."""
        return np.zeros_like(self.times)

    @cached_property
    def size_ratio(self) -> Float[np.ndarray, "nodes"] | None:
        """q of spheres of unequal sizes; None for equal spheres."""
        if "size_ratio" not in self.linear.values:
            return None
        return np.log(self.value("size_ratio"))

    @cached_property
    def _energy_slopes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """ln of the measured T over T, and its derivatives in the spread of sizes and in q."""
        if self.size_ratio is None or not self.rows.measurement.of_energy:
            return self.nothing, self.nothing, self.nothing
        return energy_slopes(spread_of(self.gas), self.size_ratio)

    @cached_property
    def measured(self) -> _Continuation:
        """ln T, as it is measured, and ln T_rot."""
        log_T = np.log(self.value("temperature")) + self._energy_slopes[0]
        log_rotation = np.log(np.maximum(self.value("rotational_temperature"), TINY))
        logs = np.stack([log_T, log_rotation], axis=1)
        return _Continuation(logs, self.is_before, power_of_line(self.gas))

    def prediction(self, values: dict[str, Any]) -> Prediction:
        """Return the prediction at some values of the parameters and nuisance parameters."""
        T = self.value("temperature")
        common = values.get(CALIBRATION, 0.0)
        factors = np.array([common, common + values.get(ROTATION, 0.0)])
        compared = self.measured.values() + factors
        compared[self.place] += self.rows.offset
        names = values.keys() & self.gas.domains.keys()
        return Prediction(
            log_T=np.log(T),
            rotation=self.value("rotational_temperature") / T,
            collisions=self.value("collisions"),
            compared=compared,
            displacement=np.log(np.maximum(self.value("displacement"), TINY)),
            parameters=as_floats({name: values[name] for name in names}),
            size_ratio=self.size_ratio,
            scatter=values.get(SCATTER, 0.0),
            floor=values.get(FLOOR, 0.0),
            white=values.get(WHITE, 0.0),
        )

    def tangent(self, element: Element, prediction: Prediction) -> Prediction:
        """Return the derivatives of a prediction in the unconstrained parameter of an element."""
        slopes = self._slopes(element)

        def change(name: str, over: Any) -> np.ndarray:
            slope = slopes.get(name, self.nothing)
            return slope * element.slope / np.maximum(over, TINY)

        def change_of_log(name: str) -> np.ndarray:
            return change(name, self.value(name))

        of_T = change_of_log("temperature")
        of_rotation = change_of_log("rotational_temperature")
        of_measured = of_T
        of_size_ratio = None
        if self.size_ratio is not None:
            of_size_ratio = change_of_log("size_ratio")
            _, in_spread, in_ratio = self._energy_slopes
            of_measured = of_T + in_ratio * of_size_ratio + in_spread * self._of_spread(element)
        of_logs = np.stack([of_measured, of_rotation], axis=1)
        factors = {ROTATION: np.array([0.0, 1.0]), CALIBRATION: np.ones(2)}
        of_factors = element.slope * factors.get(element.name, np.zeros(2))
        own_slope = {element.name: element.slope}
        of_parameters = {name: np.zeros_like(x) for name, x in prediction.parameters.items()}
        if element.name in of_parameters:
            of_parameters[element.name].flat[element.number] = element.slope
        return Prediction(
            log_T=of_T,
            rotation=prediction.rotation * (of_rotation - of_T),
            collisions=change("collisions", 1.0),
            compared=self.measured.changes(of_logs) + of_factors,
            displacement=change_of_log("displacement"),
            parameters=of_parameters,
            size_ratio=of_size_ratio,
            scatter=own_slope.get(SCATTER, 0.0),
            floor=own_slope.get(FLOOR, 0.0),
            white=own_slope.get(WHITE, 0.0),
        )

    def _slopes(self, element: Element) -> dict[str, np.ndarray]:
        """Return the derivatives of the fields in the SI value of an element, by name."""
        if element.name == START_TIME:
            shift = shift_of_nodes(self.times, self.place, self.rows.unit_time, self.is_before)
            moved = self.rows.faster * shift
            return {name: moved * x for name, x in self.linear.by_time.items()}
        by_number = self.linear.by_float.get(element.name, {})
        return {name: x[:, element.number] for name, x in by_number.items()}

    def _of_spread(self, element: Element) -> float:
        """Return the derivative of the relative spread of the diameters."""
        by_name = {"diameter_sd": 1.0, "diameter": -spread_of(self.gas)}
        return by_name.get(element.name, 0.0) * element.slope / float(self.gas.diameter)


@dataclass(frozen=True)
class PredictedCurve:
    """A curve by a model beside the measurement with which it is compared.

    Attributes:
        rows: the measurement.
        gas: the gas at these values, with all elements.
        values: SI values of the parameters, by name.
        times: of the nodes, s.
        sonine: a_2 at the nodes.
        place: place of each time of the data among the nodes.
        prediction: the curve.
        tangents: its derivatives in the unknowns, each in its unconstrained scale.
        elements: the unknowns.
        fields: the computed curve at the times of the data.
    """

    rows: CurveRows
    gas: Gas
    values: dict[str, Any]
    times: Float[np.ndarray, "nodes"]
    sonine: Float[np.ndarray, "nodes"]
    place: Int[np.ndarray, "times"]
    prediction: Prediction
    tangents: list[Prediction]
    elements: list[Element]
    fields: dict[str, Any]

    def by_size_ratio(self, gas: Gas, size_ratio: np.ndarray | None) -> np.ndarray | None:
        """Return the derivative of ln T as measured in q; None for equal spheres.

        Args:
            gas: one gas, or many whose parameters have a first axis.
            size_ratio: q, shape (nodes, gases).
        """
        if size_ratio is None:
            return None
        if not self.rows.measurement.of_energy:
            return np.zeros_like(size_ratio)
        return np.asarray(energy_slope(spread_of(gas), size_ratio))


@np.errstate(divide="ignore", invalid="ignore", over="ignore")  # nan where a curve fails
def predicted_curve(
    rows: CurveRows,
    model: AbstractModel,
    values: dict[str, Any],
    elements: list[Element],
    tolerance: float = 1.0,
    linearise: Callable[..., LinearisedCurve] = linearise,
) -> PredictedCurve:
    """Compute the curve of a measurement, with its derivatives.

    Args:
        rows: the measurement.
        model: without noise.
        values: SI values of parameters of the gas, of t0 and of nuisance parameters.
        elements: the unknowns of this measurement.
        tolerance: factor of the model's tolerance.
        linearise: computes the curve.
    """
    names = values.keys() & rows.gas.domains.keys()
    gas = with_parameters(rows.gas, as_floats({name: values[name] for name in names}))
    elapsed = np.asarray(rows.curve.times) - float(values.get(START_TIME, 0.0))
    elapsed = elapsed * rows.faster
    times, place = times_with_nodes(np.abs(elapsed), rows.unit_time)
    is_before = np.zeros(times.size, bool)
    is_before[place] = elapsed < 0
    linear = linearise(model, gas, times, {e.name for e in elements}, tolerance)
    fields = {name: x[place] if np.ndim(x) else x for name, x in linear.values.items()}
    if "collisions" not in linear.values:
        counted = _collisions(gas, times, linear.values["temperature"])
        linear = linear._replace(values=linear.values | {"collisions": counted})
    curve = _ExpandedCurve(rows, gas, times, place, is_before, linear)
    prediction = curve.prediction(values)
    return PredictedCurve(
        rows,
        gas,
        values,
        times,
        curve.value("sonine"),
        place,
        prediction,
        [curve.tangent(element, prediction) for element in elements],
        elements,
        fields,
    )


def steady_curve(
    model: AbstractModel, gas: Gas, times: np.ndarray, names: Collection[str], tolerance: float
) -> LinearisedCurve:
    """Return a curve of a gas that does not cool, in place of `linearise`.

    It has the shapes of a computed curve, for which the programs after it are compiled.
    """
    one = np.ones_like(times)
    values = {"temperature": one, "sonine": one, "collisions": times / times[-1]}
    if gas.diameter_sd is not None:
        values["size_ratio"] = one
    return LinearisedCurve(values, {}, {})


def spread_of(gas: Gas) -> np.ndarray:
    """Return `Gas.size_spread`; for many gases with a first axis of nodes, shape (1, gases)."""
    spread = np.asarray(gas.size_spread)
    return spread[None] if spread.ndim else spread


def energy_slopes(
    spread: np.ndarray, size_ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the logarithm of `energy_ratio`, and its derivatives in the spread and in q."""
    ratio = np.asarray(energy_ratio(spread, size_ratio))
    in_spread = -3 * ((1 - spread**2) / (1 + 3 * spread**2)) ** 2 * np.tanh(size_ratio / 2) / ratio
    return np.log(ratio), in_spread, np.asarray(energy_slope(spread, size_ratio))


def times_with_nodes(times: np.ndarray, mean_free_time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times from 0 on that contain those given, and the places of these.

    Neighbours are at most `MAX_LOG_STEP` apart in ``ln(1 + t/tau_c)``. They are padded to a length
    of the grid by repeating the last one.
    """
    order = np.argsort(times, kind="stable")
    known = np.append(0.0, np.log1p(times[order] / mean_free_time))
    # As many nodes between two times as if the first one were 0: not fewer with another t0.
    since_first = np.log1p((times[order] - times[order[0]]) / mean_free_time)
    lengths = np.append(known[1], np.diff(since_first))
    parts = np.maximum(np.ceil(lengths / MAX_LOG_STEP).astype(int), 1)
    at = np.cumsum(parts)
    logs = np.interp(np.arange(at[-1] + 1), np.append(0, at), known)
    merged = np.expm1(logs) * mean_free_time
    merged[at] = times[order]
    place = np.empty(times.size, int)
    place[order] = at
    padding = grid_size(merged.size) - merged.size
    return np.append(merged, np.full(padding, merged[-1])), place


def shift_of_nodes(
    times: np.ndarray, place: np.ndarray, unit_time: float, is_before: np.ndarray
) -> np.ndarray:
    """Return the derivative of the times of `times_with_nodes` in t0.

    Data before the start move away from it, those after it move nearer. The start itself stays, and
    nodes between are shifted in proportion to ``ln(1 + t/tau_c)``.
    """
    logs = np.log1p(times / unit_time)
    data = np.sort(place)
    shifts = np.where(is_before[data], 1.0, -1.0) / (unit_time + times[data])
    shifts = np.interp(logs, np.append(0.0, logs[data]), np.append(0.0, shifts))
    return shifts * (unit_time + times)


def _collisions(gas: Gas, times: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return collisions per particle of a Maxwellian gas, for a model that does not count them."""
    speed = np.sqrt(T / float(gas.temperature))
    steps = np.diff(times) * (speed[1:] + speed[:-1]) / 2
    return np.append(0.0, np.cumsum(steps)) * float(gas.collision_frequency)
