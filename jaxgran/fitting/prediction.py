"""A measured curve beside its prediction by a model: independent residuals and their derivatives.

The curve comes, with its derivatives in all parameters, from the one compiled program of
`jaxgran.models.linearise`. Its innovations (`jaxgran.fitting.likelihood`) depend on the parameters
through the curve and through the scatter of N grains. They are differentiated by central
differences along the tangents of the curve: one call for all unknowns, by a second program.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxgran._utils.tracing import fast_jit
from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.likelihood import Nodes, filtered, innovations
from jaxgran.fitting.parameters import as_floats, power_of_line, with_parameters
from jaxgran.fitting.rows import (
    CALIBRATION,
    DISPLACEMENT,
    ROTATION,
    SCATTER,
    CurveRows,
    Displacement,
    Noise,
    Observed,
    times_with_nodes,
)
from jaxgran.models.base import AbstractModel
from jaxgran.models.linearise import LinearisedCurve, linearise
from jaxgran.scene.gas import Gas
from jaxgran.theory.sizes import energy_ratio, energy_slope

FLOOR = "floor"
"""Noise floor, m^2/s^2, added to the computed T: a parameter of an alternative explanation."""

WHITE = "white"
"""Relative standard deviation of further independent errors of T: another one."""

DIFFERENCE = float(np.finfo(float).eps ** 0.25)
"""Step of central differences in an unconstrained parameter."""

MAX_LINE_BEFORE = 1.9
"""Largest ratio of the power of T that is a straight line, to that at the start, which is continued
to times before the start: its continuation is .1 then, and T_0 over it diverges."""

TINY = float(np.finfo(np.float32).tiny)


class Residuals(NamedTuple):
    """Independent Gaussian residuals, with their derivatives in all unknowns.

    Attributes:
        name: what they belong to: "curve", "displacement", "drop test", or the name of a prior or
            of a nuisance parameter.
        label: of the measurement; None for priors of shared parameters.
        values: over their standard deviation, shape (n,); 0 where nothing was measured.
        slopes: derivatives at fixed standard deviations, shape (n, unknowns).
        log_variance: logarithm of their variances, shape (n,).
        log_slopes: its derivatives, shape (n, unknowns).
        is_prior: whether they are of prior knowledge.
    """

    name: str
    label: str | None
    values: Float[np.ndarray, "n"]
    slopes: Float[np.ndarray, "n unknowns"]
    log_variance: Float[np.ndarray, "n"]
    log_slopes: Float[np.ndarray, "n unknowns"]
    is_prior: bool = False

    @property
    def information(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Half of the expected second derivatives of -2 ln L."""
        return self.slopes.T @ self.slopes + 0.5 * self.log_slopes.T @ self.log_slopes


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
    """A curve by a model at the times of the data and at times between them, or its derivatives.

    Attributes:
        log_T, rotation, collisions: ln T, T_rot/T, collisions per particle, shape (nodes,).
        compared: ln T and ln T_rot that are compared with the data, shape (nodes, 2).
        displacement: ln <dr^2>, shape (nodes,).
        floats: of the gas, by name.
        size_ratio: q of spheres of unequal sizes, shape (nodes,); None of equal ones.
        scatter: logarithm of the scatter.
    """

    log_T: np.ndarray
    rotation: np.ndarray
    collisions: np.ndarray
    compared: np.ndarray
    displacement: np.ndarray
    floats: dict[str, np.ndarray]
    size_ratio: np.ndarray | None = None
    scatter: float = 0.0


@dataclass(frozen=True)
class PredictedCurve:
    """A measured curve beside its prediction.

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
    times: np.ndarray
    sonine: np.ndarray
    place: np.ndarray
    prediction: Prediction
    tangents: list[Prediction]
    elements: list[Element]
    fields: dict[str, Any]

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def residuals(self, size: int, **sources: float) -> list[Residuals]:
        """Return the residuals, with derivatives in all of `size` unknowns.

        Args:
            size: number of unknowns of the problem.
            sources: factors of the variances by "measurement", "few particles", "model" and
                "simulation"; 1 by default.
        """
        values, variances, changes = self._around(sources)
        step = DIFFERENCE
        value = values[0]
        variance = variances[0]
        slopes = np.zeros((value.size, size))
        log_slopes = np.zeros((value.size, size))
        whitened = value / np.sqrt(variance)
        moving = [e for e in self.elements if e.name != DISPLACEMENT]
        for k, element in enumerate(moving):
            up = 1 + 2 * k
            down = 2 + 2 * k
            change = values[up] - values[down]
            slopes[:, element.place] = change / (2 * step) / np.sqrt(variance)
            growth = np.log(variances[up] / variances[down])
            log_slopes[:, element.place] = growth / (2 * step)
            # Where T is compared, slopes become those of (y - T)/error, and log_slopes 0.
            change = (changes[up] - changes[down]) / (2 * step)
            slopes[:, element.place] += 0.5 * whitened * change
            log_slopes[:, element.place] += change
        log_variance = np.log(variance) + changes[0]
        rows = [Residuals("curve", self.rows.label, whitened, slopes, log_variance, log_slopes)]
        if self.rows.displacement is not None:
            rows.append(self._displacement(self.rows.displacement, size))
        return rows

    def _moving(self) -> list[Prediction]:
        """Return the tangents in the unknowns on which T and T_rot depend."""
        pairs = zip(self.elements, self.tangents, strict=True)
        return [tangent for element, tangent in pairs if element.name != DISPLACEMENT]

    def _around(self, sources: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the results of `innovations` at the unknowns and at two neighbours of each.

        The shapes are (1 + 2 unknowns, 2 times): those of T are followed by those of T_rot. The
        factor of <dr^2> is left out.
        """
        moving = self._moving()
        count = 1 + 2 * len(moving)
        # Columns: the unknowns themselves, each with a step up and a step down, and padding.
        steps = np.zeros((len(moving), _batch_size(count)))
        for k in range(len(moving)):
            steps[k, 1 + 2 * k] = DIFFERENCE
            steps[k, 2 + 2 * k] = -DIFFERENCE

        def around(x: Any, *along: Any) -> np.ndarray:
            slopes = np.stack([np.zeros_like(x), *along], axis=-1)[..., 1:]
            return np.asarray(x)[..., None] + slopes @ steps

        batch: Prediction = jax.tree.map(around, self.prediction, *moving)
        noise = self._noise(batch.scatter, sources)
        observed = self._observed(sources)
        floor = float(self.values.get(FLOOR, 0.0))
        T = np.exp(batch.compared[:, 0])
        compared = batch.compared.copy()
        compared[:, 0] = np.log(T + floor)
        gases = steps.shape[1]
        gas = jax.tree.map(lambda x: np.broadcast_to(x, (gases, *np.shape(x))), self.gas)
        gas = with_parameters(
            gas, {name: np.moveaxis(x, -1, 0) for name, x in batch.floats.items()}
        )
        nodes = Nodes(
            self.times,
            batch.log_T,
            batch.rotation,
            self.sonine,
            batch.collisions,
            batch.size_ratio,
            self.by_size_ratio(gas, batch.size_ratio),
        )
        compiled = fast_jit(innovations, jax.default_backend())
        found = compiled(gas, nodes, compared, T / (T + floor), observed, noise)
        # Values of T are followed by those of T_rot.
        values, variances, changes = (
            np.asarray(x)[self.place, :, :count].transpose(2, 1, 0).reshape(count, -1)
            for x in found
        )
        used = self.rows.used.T.ravel()
        return values, np.where(used > 0, variances, 1.0), np.where(used > 0, changes, 0.0)

    def whiten(
        self, columns: Float[np.ndarray, "values columns"], **sources: float
    ) -> Float[np.ndarray, "values columns"]:
        """Return columns of residuals as independent ones of unit variance.

        Args:
            columns: of ln T at all times, followed by ln T_rot.
            sources: see `residuals`.
        """
        count = columns.shape[1]
        whole = np.zeros((self.times.size, 2, count))
        whole[self.place] = columns.reshape(2, -1, count).swapaxes(0, 1)
        observed = self._observed(sources)
        errors = observed.errors / np.exp(self.prediction.compared)
        noise = self._noise(np.asarray([self.prediction.scatter]), sources)
        variances = (errors**2 + observed.simulation)[..., None]
        size_ratio = self.prediction.size_ratio
        size_ratio = None if size_ratio is None else size_ratio[:, None]
        nodes = Nodes(
            self.times,
            self.prediction.log_T[:, None],
            self.prediction.rotation[:, None],
            self.sonine,
            self.prediction.collisions[:, None],
            size_ratio,
            self.by_size_ratio(self.gas, size_ratio),
        )
        gas = jax.tree.map(lambda x: np.asarray(x)[None], self.gas)
        one = np.ones((self.times.size, 1))
        columns = whole[..., None]
        compiled = fast_jit(filtered, jax.default_backend())
        found = compiled(gas, nodes, columns, variances, one, observed.used, noise)
        values, spread = (np.asarray(x)[self.place, ..., 0] for x in found)
        values = values / np.sqrt(spread)[..., None]
        return values.swapaxes(0, 1).reshape(-1, count)

    def by_size_ratio(self, gas: Gas, size_ratio: np.ndarray | None) -> np.ndarray | None:
        """Return the derivative of ln T as measured in q; None for equal spheres."""
        if size_ratio is None:
            return None
        if not self.rows.measurement.of_energy:
            return np.zeros_like(size_ratio)
        return np.asarray(energy_slope(spread_of(gas), size_ratio))

    def _observed(self, sources: dict[str, float]) -> Observed:
        factor = sources.get("measurement", 1.0) ** 0.5
        observed = self.rows.at_nodes(self.times.size, self.place, factor)
        simulation = sources.get("simulation", 1.0) * observed.simulation
        return observed._replace(simulation=simulation)

    def _noise(self, log_scatter: Any, sources: dict[str, float]) -> Noise:
        scatter = sources.get("few particles", 1.0) * self.rows.scatter * np.exp(log_scatter)
        white = float(self.values.get(WHITE, 0.0))
        return self.rows.noise(self.times, scatter, white, sources.get("model", 1.0) ** 0.5)

    def _displacement(self, measured: Displacement, size: int) -> Residuals:
        computed = self.prediction.displacement[self.place]
        collisions = self.prediction.collisions[self.place]
        # The common factor is one of D: the ballistic flight before collisions has no error.
        diffusive = collisions / (1 + collisions)
        used = measured.errors > 0
        errors = np.where(used, measured.errors, 1.0)
        computed = computed + self.values.get(DISPLACEMENT, 0.0) * diffusive
        logs = np.log(np.where(used, measured.values, 1.0))
        values = np.where(used, (logs - computed) / errors, 0.0)
        slopes = np.zeros((values.size, size))
        for element, tangent in zip(self.elements, self.tangents, strict=True):
            change = tangent.displacement[self.place]
            if element.name == DISPLACEMENT:
                change = diffusive * element.slope
            slopes[:, element.place] = np.where(used, -change / errors, 0.0)
        nothing = np.zeros(values.size)
        return Residuals(
            "displacement", self.rows.label, values, slopes, nothing, np.zeros_like(slopes)
        )


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
    floats = as_floats({name: values[name] for name in names})
    gas = with_parameters(rows.gas, floats)
    elapsed = np.asarray(rows.curve.times) - float(values.get(START_TIME, 0.0))
    elapsed = elapsed * rows.faster
    times, place = times_with_nodes(np.abs(elapsed), rows.unit_time)
    linear = linearise(model, gas, times, {e.name for e in elements}, tolerance)
    known = linear.values
    T = known["temperature"]
    nothing = np.zeros_like(T)
    T_rot = known.get("rotational_temperature", nothing)
    displacement = known.get("displacement", nothing)
    collisions = known.get("collisions")
    if collisions is None:
        collisions = _collisions(gas, times, T)
    # Before the start T is continued as the power that is a straight line in time.
    before = np.zeros(times.size, bool)
    before[place] = elapsed < 0
    power = power_of_line(gas)

    size_ratio = None
    if "size_ratio" in known:
        size_ratio = np.log(known["size_ratio"])

    log_T = np.log(T)
    log_rotation = np.log(np.maximum(T_rot, TINY))
    log_displacement = np.log(np.maximum(displacement, TINY))
    common = values.get(CALIBRATION, 0.0)
    factors = np.array([common, common + values.get(ROTATION, 0.0)])
    logs = np.stack([log_T, log_rotation], axis=1)
    spread = spread_of(gas)
    slope_in_spread = slope_in_ratio = nothing
    if rows.measurement.of_energy and size_ratio is not None:
        by_energy, slope_in_spread, slope_in_ratio = energy_slopes(spread, size_ratio)
        logs[:, 0] += by_energy
    line = np.minimum(np.exp(-power * (logs - logs[:1])), MAX_LINE_BEFORE)
    continued = logs[:1] - np.log(2 - line) / power
    base = np.where(before[:, None], continued, logs) + factors
    base[place] += rows.offset
    prediction = Prediction(
        log_T,
        T_rot / T,
        collisions,
        base,
        log_displacement,
        floats,
        size_ratio,
        values.get(SCATTER, 0.0),
    )

    def compared(of_T: np.ndarray, of_rotation: np.ndarray) -> np.ndarray:
        """Derivative of the base in a parameter, from those of the logarithms."""
        change = np.stack([of_T, of_rotation], axis=1)
        of_continued = change[:1] - line / (2 - line) * (change - change[:1])
        return np.where(before[:, None], of_continued, change)

    def tangent(element: Element) -> Prediction:
        slopes: dict[str, np.ndarray] = {}
        if element.name == START_TIME:
            moved = rows.faster * shift_of_nodes(times, place, rows.unit_time, before)
            slopes = {name: moved * x for name, x in linear.by_time.items()}
        elif element.name in linear.by_float:
            by_float = linear.by_float[element.name]
            slopes = {name: x[:, element.number] for name, x in by_float.items()}

        def change(name: str, over: np.ndarray) -> np.ndarray:
            if name not in slopes:
                return nothing
            return slopes[name] * element.slope / np.maximum(over, TINY)

        of_T = change("temperature", T)
        of_measured = of_T
        of_size_ratio = None
        if size_ratio is not None:
            of_size_ratio = change("size_ratio", known["size_ratio"])
            by_name = {"diameter_sd": 1.0, "diameter": -spread}
            of_spread = by_name.get(element.name, 0.0) * element.slope / float(gas.diameter)
            of_measured = of_T + slope_in_ratio * of_size_ratio + slope_in_spread * of_spread
        of_rotation = change("rotational_temperature", T_rot)
        factors = {ROTATION: np.array([0.0, 1.0]), CALIBRATION: np.ones(2)}
        of_floats = {name: np.zeros_like(x) for name, x in floats.items()}
        if element.name in floats:
            of_floats[element.name].flat[element.number] = element.slope
        return Prediction(
            of_T,
            T_rot / T * (of_rotation - of_T),
            change("collisions", np.ones_like(T)),
            compared(of_measured, of_rotation)
            + element.slope * factors.get(element.name, np.zeros(2)),
            change("displacement", displacement),
            of_floats,
            of_size_ratio,
            element.slope if element.name == SCATTER else 0.0,
        )

    return PredictedCurve(
        rows,
        gas,
        values,
        times,
        known.get("sonine", nothing),
        place,
        prediction,
        [tangent(element) for element in elements],
        elements,
        {name: x[place] if np.ndim(x) else x for name, x in known.items()},
    )


def steady_curve(
    model: AbstractModel, gas: Gas, times: np.ndarray, names: Collection[str], tolerance: float
) -> LinearisedCurve:
    """Return a curve of the shape of `linearise`, of a gas that does not cool."""
    one = np.ones_like(times)
    values = {"temperature": one, "sonine": one, "collisions": times / times[-1]}
    if gas.diameter_sd is not None:
        values["size_ratio"] = one
    return LinearisedCurve(values, {}, {})


def spread_of(gas: Gas) -> np.ndarray:
    """Return `Gas.size_spread`; of many gases shape (1, gases)."""
    spread = np.asarray(gas.size_spread)
    return spread[None] if spread.ndim else spread


def energy_slopes(
    spread: np.ndarray, size_ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the logarithm of `energy_ratio`, and its derivatives in the spread and in q."""
    ratio = np.asarray(energy_ratio(spread, size_ratio))
    in_spread = -3 * ((1 - spread**2) / (1 + 3 * spread**2)) ** 2 * np.tanh(size_ratio / 2) / ratio
    return np.log(ratio), in_spread, np.asarray(energy_slope(spread, size_ratio))


def shift_of_nodes(
    times: np.ndarray, place: np.ndarray, unit_time: float, before: np.ndarray
) -> np.ndarray:
    """Return the derivative of the times of `times_with_nodes` in t0.

    Data before the start move away from it, those after it move nearer. The start itself stays, and
    nodes between are shifted in proportion to ``ln(1 + t/tau_c)``.
    """
    logs = np.log1p(times / unit_time)
    data = np.sort(place)
    shifts = np.where(before[data], 1.0, -1.0) / (unit_time + times[data])
    shifts = np.interp(logs, np.append(0.0, logs[data]), np.append(0.0, shifts))
    return shifts * (unit_time + times)


def _collisions(gas: Gas, times: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return collisions per particle of a Maxwellian gas, for a model that does not count them."""
    speed = np.sqrt(T / float(gas.temperature))
    steps = np.diff(times) * (speed[1:] + speed[:-1]) / 2
    return np.append(0.0, np.cumsum(steps)) * float(gas.collision_frequency)


def _batch_size(count: int) -> int:
    """Return the smallest of 8, 16, 32, ... that is >= `count`, so that few sizes are compiled."""
    return max(8, 1 << (count - 1).bit_length())
