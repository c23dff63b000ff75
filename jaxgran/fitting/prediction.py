"""A curve by a model as it is compared with a measured one, with its derivatives in the unknowns.

The curve comes, with its derivatives in all parameters, from the one compiled program of
`jaxgran.models.linearise`. What is compared is ln T and ln T_rot at the times of the data, on the
clock and with the definition of T of the measurement.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.guesses import power_of_line
from jaxgran.fitting.parameters import SHARED, as_floats, with_values
from jaxgran.fitting.rows import CALIBRATION, FLOOR, ROTATION, SCATTER, WHITE, CurveRows
from jaxgran.fitting.time_grid import TimeGrid, shift_with_t0, time_grid
from jaxgran.models.base import AbstractModel
from jaxgran.models.linearise import LinearisedCurve, linearise
from jaxgran.scene.gas import Gas
from jaxgran.theory.sizes import energy_ratio, energy_slope

MAX_LINE_BEFORE = 1.9
"""Largest value of the line ``(T(t)/T(0))^-p`` that is continued before the start, to 2 minus its
value: at 2 the continued T diverges."""

COMMON_FACTORS = {ROTATION: (0.0, 1.0), CALIBRATION: (1.0, 1.0)}
"""Nuisance parameters that are logarithms of common factors: whether they apply to T and T_rot."""

TINY = float(np.finfo(np.float32).tiny)
"""Smallest normal number of float32, which takes the place of 0 in logarithms and quotients."""


class Element(NamedTuple):
    """One number of an unknown.

    Attributes:
        name, label: of the unknown.
        number: its place in the value of the unknown.
        place: its place among all unknowns.
        slope: derivative of its SI value in the unconstrained parameter.
    """

    name: str
    label: str
    number: int
    place: int
    slope: float

    def applies_to(self, label: str) -> bool:
        """Tell whether it is an unknown of the measurement with a label."""
        return self.label in (SHARED, label)


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
class PredictedCurve:
    """A curve by a model beside the measurement with which it is compared.

    Attributes:
        rows: the measurement.
        gas: the gas at these values, with all elements.
        values: SI values of the parameters, by name.
        times: of the nodes, s.
        sonine: a_2 at the nodes.
        place: place of each time of the data among the nodes.
        is_before: whether the time of the data at a node is before the start.
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
    is_before: Bool[np.ndarray, "nodes"]
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
        return np.asarray(energy_slope(_spread_of(gas), size_ratio))


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
    gas = with_values(rows.gas, {name: values[name] for name in names})
    elapsed = np.asarray(rows.curve.times) - float(values.get(START_TIME, 0.0))
    elapsed = elapsed * rows.faster
    grid = time_grid(np.abs(elapsed), rows.unit_time)
    is_before = np.zeros(grid.times.size, bool)
    is_before[grid.place] = elapsed < 0
    linear = linearise(model, gas, grid.times, {e.name for e in elements}, tolerance)
    fields = {name: x[grid.place] if np.ndim(x) else x for name, x in linear.values.items()}
    if "collisions" not in linear.values:
        counted = maxwellian_collisions(gas, grid.times, linear.values["temperature"])
        linear = linear._replace(values=linear.values | {"collisions": np.asarray(counted)})
    curve = _ExpandedCurve(rows, gas, grid, is_before, linear)
    prediction = curve.prediction(values)
    return PredictedCurve(
        rows=rows,
        gas=gas,
        values=values,
        times=grid.times,
        sonine=curve.value("sonine"),
        place=grid.place,
        is_before=is_before,
        prediction=prediction,
        tangents=[curve.tangent(element, prediction) for element in elements],
        elements=elements,
        fields=fields,
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


def maxwellian_collisions(gas: Gas, times: ArrayLike, T: ArrayLike) -> Float[Array, "times"]:
    """Return the collisions per particle of a Maxwellian gas, for a model that does not count them.

    They are the integral of ``omega_0 sqrt(T/T_0)`` over time, by the trapezoidal rule for sqrt(T).

    Args:
        gas: at t = 0, with its temperature T_0 and its collision frequency omega_0.
        times: from 0 on, s, shape (times,).
        T: temperature at these times, m^2/s^2, shape (times,).
    """
    speed = jnp.sqrt(jnp.asarray(T) / gas.temperature)
    steps = jnp.diff(jnp.asarray(times)) * (speed[1:] + speed[:-1]) / 2
    return jnp.append(0.0, jnp.cumsum(steps * gas.collision_frequency))


def diffusive_share(collisions: Any) -> Any:
    """Return ``C/(1 + C)``, the part of ln <dr^2> that follows an error of ln D.

    The ballistic flight before the first collision has no such error.

    Args:
        collisions: C, per particle since t = 0, an array of numpy or JAX.
    """
    return collisions / (1 + collisions)


class _EnergyRatio(NamedTuple):
    """The measured temperature over T, where it is given by the energy of unequal spheres.

    Attributes:
        log: its logarithm, shape (nodes,).
        by_spread: the derivative of `log` in the relative spread of the diameters.
        by_size_ratio: the derivative of `log` in q.
    """

    log: Float[np.ndarray, "nodes"]
    by_spread: Float[np.ndarray, "nodes"]
    by_size_ratio: Float[np.ndarray, "nodes"]

    @classmethod
    def build(cls, s: np.ndarray, q: Float[np.ndarray, "nodes"]) -> "_EnergyRatio":
        """Compute it from the relative spread s and the size ratio q (`jaxgran.theory.sizes`)."""
        ratio = np.asarray(energy_ratio(s, q))
        by_spread = -3 * ((1 - s**2) / (1 + 3 * s**2)) ** 2 * np.tanh(q / 2) / ratio
        return cls(np.log(ratio), by_spread, np.asarray(energy_slope(s, q)))


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
        grid: the nodes, times |t|.
        is_before: whether a node is before the start.
        linear: the curve, whose values include `collisions`.
    """

    rows: CurveRows
    gas: Gas
    grid: TimeGrid
    is_before: Bool[np.ndarray, "nodes"]
    linear: LinearisedCurve

    def value(self, name: str) -> Float[np.ndarray, "nodes"]:
        """Return a field of the curve; 0 for one that it does not have."""
        return self.linear.values.get(name, self.nothing)

    @cached_property
    def nothing(self) -> Float[np.ndarray, "nodes"]:
        """0 at all nodes."""
        return np.zeros_like(self.grid.times)

    @cached_property
    def size_ratio(self) -> Float[np.ndarray, "nodes"] | None:
        """q of spheres of unequal sizes; None for equal spheres."""
        if "size_ratio" not in self.linear.values:
            return None
        return np.log(self.value("size_ratio"))

    @cached_property
    def energy(self) -> _EnergyRatio:
        """The measured T over T: 1 unless spheres are unequal and T is given by the energy."""
        if self.size_ratio is None or not self.rows.measurement.of_energy:
            return _EnergyRatio(self.nothing, self.nothing, self.nothing)
        return _EnergyRatio.build(_spread_of(self.gas), self.size_ratio)

    @cached_property
    def measured(self) -> _Continuation:
        """ln T, as it is measured, and ln T_rot."""
        log_T = np.log(self.value("temperature")) + self.energy.log
        log_rotation = np.log(np.maximum(self.value("rotational_temperature"), TINY))
        logs = np.stack([log_T, log_rotation], axis=1)
        return _Continuation(logs, self.is_before, power_of_line(self.gas))

    def prediction(self, values: dict[str, Any]) -> Prediction:
        """Return the prediction at some values of the parameters and nuisance parameters."""
        T = self.value("temperature")
        factors = np.zeros(2)
        for name, applies in COMMON_FACTORS.items():
            factors += values.get(name, 0.0) * np.asarray(applies)
        compared = self.measured.values() + factors
        compared[self.grid.place] += self.rows.offset
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

        def slope_of(name: str) -> np.ndarray:
            return slopes.get(name, self.nothing) * element.slope

        def slope_of_log(name: str) -> np.ndarray:
            return slope_of(name) / np.maximum(self.value(name), TINY)

        of_T = slope_of_log("temperature")
        of_rotation = slope_of_log("rotational_temperature")
        of_measured = of_T
        of_size_ratio = None
        if self.size_ratio is not None:
            of_size_ratio = slope_of_log("size_ratio")
            of_spread = self.energy.by_spread * self._slope_of_spread(element)
            of_measured = of_T + self.energy.by_size_ratio * of_size_ratio + of_spread
        of_logs = np.stack([of_measured, of_rotation], axis=1)
        of_factors = element.slope * np.asarray(COMMON_FACTORS.get(element.name, (0.0, 0.0)))
        own_slope = {element.name: element.slope}
        return Prediction(
            log_T=of_T,
            rotation=prediction.rotation * (of_rotation - of_T),
            collisions=slope_of("collisions"),
            compared=self.measured.changes(of_logs) + of_factors,
            displacement=slope_of_log("displacement"),
            parameters=_slopes_of_parameters(element, prediction.parameters),
            size_ratio=of_size_ratio,
            scatter=own_slope.get(SCATTER, 0.0),
            floor=own_slope.get(FLOOR, 0.0),
            white=own_slope.get(WHITE, 0.0),
        )

    def _slopes(self, element: Element) -> dict[str, np.ndarray]:
        """Return the derivatives of the fields in the SI value of an element, by name."""
        if element.name == START_TIME:
            shift = shift_with_t0(self.grid, self.rows.unit_time, self.is_before)
            moved = self.rows.faster * shift
            return {name: moved * x for name, x in self.linear.by_time.items()}
        by_number = self.linear.by_float.get(element.name, {})
        return {name: x[:, element.number] for name, x in by_number.items()}

    def _slope_of_spread(self, element: Element) -> float:
        """Return the derivative of the relative spread of the diameters."""
        by_name = {"diameter_sd": 1.0, "diameter": -_spread_of(self.gas)}
        return by_name.get(element.name, 0.0) * element.slope / float(self.gas.diameter)


def _slopes_of_parameters(
    element: Element, parameters: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return the derivatives of the parameters of a gas in an element, one of them or another."""
    slopes = {name: np.zeros_like(x) for name, x in parameters.items()}
    if element.name in slopes:
        slopes[element.name].flat[element.number] = element.slope
    return slopes


def _spread_of(gas: Gas) -> np.ndarray:
    """Return `Gas.size_spread`; for many gases with a first axis of nodes, shape (1, gases)."""
    spread = np.asarray(gas.size_spread)
    return spread[None] if spread.ndim else spread
