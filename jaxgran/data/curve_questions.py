"""Questions about a measured curve that contradicts its header, or has unusual values."""

from collections.abc import Iterator
from math import sqrt
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array

from jaxgran.data.curve import MIN_POINTS, CoolingCurve, above_noise
from jaxgran.data.definitions import facts_of, other_definitions
from jaxgran.data.header_values import header_count, header_number
from jaxgran.data.quantities import QUANTITIES
from jaxgran.data.units import unit_in
from jaxgran.data.usual_values import OTHER_UNITS, is_usual, unit_question
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import REQUIRED

MAX_RATIO = 1.3
"""Ratio of T at t = 0 to T0, or of T0 to it, above which a question is asked."""

MAX_LATENESS = 0.3
"""Delay of the clock over the time in which T halves, above which a question is asked."""

USUAL_LOSS = (1e-3, 3.0)
"""Usual loss ``d (-dT/dt)/(nu_0 T)`` at first: 1 - eps^2 of smooth spheres in a box."""

MAX_ERROR_RATIO = 10.0
"""Ratio of T_err to the scatter of N particles, or its inverse, above which a question is asked."""


def ask_about_columns(
    curve: CoolingCurve,
    header: dict[str, str],
    gas: Gas | None,
    rounding: dict[str, np.ndarray] | None = None,
    column: str = "T",
) -> Iterator[str]:
    """Yield questions about unusual values of columns, and columns that contradict the header.

    Args:
        curve: the columns, in SI.
        header: in SI.
        gas: of the header, if it describes one.
        rounding: last digits as they were written, by field.
        column: from which T was read.
    """
    if column == "mean_speed" and facts_of(header).d == 3:
        yield (
            "mean_speed is read as the speed in three dimensions. If it contains only the two "
            "components that one camera sees, T is 0.62 of the true one and A 37 % too large: name "
            "the column mean_speed_xy then, and mean_speed_xyz otherwise"
        )
    yield from _ask_about_digits(curve, rounding or {})
    for quantity in QUANTITIES.values():
        values = getattr(curve, quantity.field)
        if quantity.measured and values is not None and not quantity.column.endswith("_err"):
            largest = float(np.max(np.asarray(values)))
            if largest > 0 and not is_usual(quantity.column, largest):
                yield unit_question(quantity.column, largest, is_column=True)
    if gas is None or gas.drive is not None:
        return
    if not all(is_usual(key, float(header[key])) for key in REQUIRED if key in header):
        return  # `ask_about_header` asks first
    number = header_count(header, "N")
    yield from _ask_about_start(curve, header, gas, number, column)
    if number is not None and curve.temperature_error is not None:
        replicas = header_count(header, "replicas") or 1
        yield from _ask_about_errors(curve, gas.dimension, number, replicas)


def _ask_about_digits(curve: CoolingCurve, rounding: dict[str, np.ndarray]) -> Iterator[str]:
    for name, digit in rounding.items():
        errors = getattr(curve, f"{name}_error")
        column = QUANTITIES[name].column
        if errors is None:
            continue
        given = np.asarray(errors) > 0
        coarse = given & (np.asarray(errors) < digit / sqrt(12))
        if np.sum(coarse) > np.sum(given) / 2:
            i = int(np.argmax(coarse))
            yield (
                f"{column}_err = {errors[i]:.2g} is smaller than the rounding error of {column} "
                f"(its last digit, {digit[i]:.2g}, over sqrt(12); both in SI). The fit adds the "
                f"rounding error. Write more digits of {column}"
            )


def _ask_about_errors(
    curve: CoolingCurve, dimension: int, number: int, replicas: int
) -> Iterator[str]:
    """Compare the errors of T with the scatter of N particles."""
    rows = above_noise(curve)
    share = np.asarray(curve.temperature_error)[rows] / np.asarray(curve.temperature)[rows]
    expected = sqrt(2 / (dimension * number * replicas))
    ratios = {"larger": share[1:].min() / expected, "smaller": expected / share.max()}
    for comparison, ratio in ratios.items():
        if ratio > MAX_ERROR_RATIO:
            yield (
                f"T_err is at least {ratio:.2g} times {comparison} than the scatter of T of N = "
                f"{number:g} particles in {replicas:g} run(s): do N, replicas and T_err belong to "
                "this curve, and is T_err a standard error of the mean?"
            )


class _StartLine(NamedTuple):
    """The line ``(T/T0)^(-0.6)`` of the first rows, straight in time for viscoelastic spheres.

    Attributes:
        origin: its value at the first row.
        slope: 1/s.
        begin: time of the first row, s.
    """

    origin: float
    slope: float
    begin: float

    @property
    def ratio(self) -> float:
        """T at the first row over T0."""
        return self.origin ** (-1 / 0.6)

    @property
    def ratio_at_zero(self) -> float:
        """T at t = 0 over T0."""
        return max(self.origin - self.slope * self.begin, 1e-9) ** (-1 / 0.6)

    @property
    def time_of_T0(self) -> float:
        """Time at which T is T0, s."""
        return self.begin + (1 - self.origin) / self.slope

    @property
    def halving_time(self) -> float:
        """Time in which T falls to a half at first, s."""
        return (2**0.6 - 1) * max(self.origin, 0.1) / self.slope


def _start_line(times: np.ndarray, T: np.ndarray, T0: float) -> _StartLine:
    rows = slice(0, max(4, int(np.sum(0.4 * T[0] < T))))
    line = (T[rows] / T0) ** -0.6
    slope, origin = np.polyfit(times[rows] - times[0], line, 1, w=1 / line)
    return _StartLine(origin, slope, times[0])


def _ask_about_start(
    curve: CoolingCurve, header: dict[str, str], gas: Gas, number: int | None, column: str
) -> Iterator[str]:
    """Compare T at first with T0, the clock with T0, and the loss with the mean free time."""
    header = {"t0": "0", "T0_err": "0"} | header
    positive = above_noise(curve)
    times = np.asarray(curve.times)[positive] - header_number(header, "t0")
    T = np.asarray(curve.temperature)[positive]
    T0 = float(gas.temperature)
    if len(T) < MIN_POINTS:
        return
    line = _start_line(times, T, T0)
    if line.slope <= 0 or not np.isfinite(line.slope):
        return
    chance = 4 * sqrt(2 / (gas.dimension * number)) if number else 0.0
    known = 3 * header_number(header, "T0_err") / T0
    max_ratio = MAX_RATIO + chance + known
    begin = line.time_of_T0
    if line.ratio > max_ratio:
        yield _scale_question(line.ratio, gas, header, column)
    elif begin > MAX_LATENESS * line.halving_time and begin > 0.5 * times[0]:
        yield (
            f"by the first rows, extrapolated, T is T0 = {T0:g} m^2/s^2 at t = {begin:.6g} s, not "
            "at t = 0: did the clock start before the gas began to cool? Then subtract this time "
            "from t, or fit it: --free A t0"
        )
    elif line.ratio_at_zero < 1 / max_ratio:
        yield _scale_question(line.ratio_at_zero, gas, header, column)
    if T[-1] < 0.8 * T[0]:
        yield from _ask_about_loss(line, gas)


def _ask_about_loss(line: _StartLine, gas: Gas) -> Iterator[str]:
    """Compare the loss at first with the mean free time."""
    frequency = float(_collision_frequency(gas))
    loss = gas.dimension * line.slope / (0.6 * line.origin) / frequency
    if USUAL_LOSS[0] <= loss <= USUAL_LOSS[1]:
        return
    units = [unit for unit in OTHER_UNITS["s"] if 1e-3 < loss / unit_in(unit, "s") < 1]
    question = "are t, eta, diameter and T0 in the units that the file says?"
    if units:
        question = f"is t in {' or '.join(units)}? Then name the column t ({units[0]})."
    if loss < 1:
        question += " Or is t counted in steps or frames? Then multiply t by the duration of one"
    halving = line.halving_time / float(gas.mean_free_time)
    high, low = (halving * loss / usual for usual in USUAL_LOSS)
    yield (
        f"T falls to a half in {halving:.3g} mean free times of the header's gas (eta, diameter, "
        f"T0), where usual values are {low:.2g} to {high:.2g}: {question}"
    )


@eqx.filter_jit
def _collision_frequency(gas: Gas) -> Array:
    return gas.collision_frequency


def _scale_question(ratio: float, gas: Gas, header: dict[str, str], column: str) -> str:
    """Return the question for T that begins at another value than T0.

    T0 is not offered for a fit: a fit would take the wrong scale for a hotter or colder gas.
    """
    T0 = float(gas.temperature)
    causes = []
    for definition, factor in other_definitions(ratio, column, facts_of(header)):
        rename = f"name the column {definition.column}, or " if definition.column else ""
        what = "it" if definition.power == 1 else "T"
        causes.append(
            f"is the column {definition.words}? Then {rename}multiply {what} by {factor:.6g}"
        )
    question = ". Or ".join(causes) or (
        "are T and T0 both <v^2>/d, averaged over the grains, in m^2/s^2? (Not in kelvin, not the "
        "energy of all N grains, not T over its first value)"
    )
    return (
        f"T is {ratio * T0:.4g} at first, {ratio:.3g} times the header's T0 = {T0:g} m^2/s^2: "
        f"{question}. If T is right, correct T0"
    )
