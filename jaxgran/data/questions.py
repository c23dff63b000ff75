"""Questions about unusual values of a measured curve and its header, most of them by their units.

Each question names the value, what is usual, and the factor that would make it usual. The reader
turns it into a warning; the values are used as they are.
"""

from collections.abc import Iterator
from math import sqrt
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from jaxgran.data import files
from jaxgran.data.curve import MIN_POINTS, CoolingCurve, above_noise
from jaxgran.data.definitions import Scene, other_definitions
from jaxgran.data.quantities import QUANTITIES
from jaxgran.data.units import UNITS, unit_in
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_mass
from jaxgran.scene.parameters import REQUIRED

SPEEDS = {"v", "v_n", "v_t", "vx", "vy", "vz"}
"""Columns of speeds before impacts."""

USUAL_RANGES = {
    "diameter": (1e-7, 0.1),
    "density": (10.0, 2.5e4),
    "Y": (1e3, 1e13),
    "T0": (1e-12, 900.0),  # a thermal speed of 30 m/s
    "T_rot_0": (0.0, 900.0),
    "A": (0.0, 0.1),
    "container_side": (1e-6, 100.0),
    "gamma": (0.0, 1e4),
    "drive_strength": (0.0, 1e4),
    "t": (0.0, 1e7),
    "T": (0.0, 900.0),
    "msd": (0.0, 1e4),
    "T_rot": (0.0, 900.0),
    **dict.fromkeys(SPEEDS, (0.0, 8.0)),  # a drop from 3 m
}
"""Smallest and largest usual value of header keys and columns in granular gases."""

OTHER_UNITS = {
    "m": ("mm", "cm", "um"),
    "m^2": ("mm^2", "cm^2", "um^2"),
    "m/s": ("cm/s", "mm/s"),
    "s": ("ms", "us", "min"),
    "1/s": ("1/ms", "1/min"),
    "m^2/s^2": ("mm^2/s^2", "cm^2/s^2"),
    "m^2/s^3": ("mm^2/s^3", "cm^2/s^3"),
    "kg/m^3": ("g/cm^3",),
    "Pa": ("GPa", "MPa", "kPa"),
}
"""Units in which values are often given, by SI unit."""

MAX_RATIO = 1.3
"""Ratio of T at t = 0 to T0, or of T0 to it, above which a question is asked."""

MAX_LATENESS = 0.3
"""Delay of the clock over the time in which T halves, above which a question is asked."""

USUAL_LOSS = (1e-3, 3.0)
"""Usual loss ``d (-dT/dt)/(nu_0 T)`` at first: 1 - eps^2 of smooth spheres in a box."""

MAX_ERROR_RATIO = 10.0
"""Ratio of T_err to the scatter of N particles, or its inverse, above which a question is asked."""

QUESTIONS = {
    # units
    "unusual": "{name} is {value:.6g} {base}, where usual values are {low:g} to {high:g}: "
    "{question}",
    "any unit": "check its unit",
    "any unit of T": "check its unit (kelvin times 1.38e-23 J/K over the mass are m^2/s^2)",
    "unit of a key": "is it in {unit}? Then write {name}: {in_si:.6g}, or {name}: {value:g} {unit}",
    "unit of a column": "is it in {unit}? Then write {name} ({unit}) as the name of the column",
    "T0 is 1": "T0 is 1 m^2/s^2: is the temperature divided by its first value? Then give T0 in "
    "m^2/s^2, and multiply T by it",
    "large error": "{key}_err is {error:.6g} {unit}, more than {key}, {value:.6g}: a number "
    "without a unit is in the unit of {key}. Is it in {unit}? Then write it behind",
    # errors
    "T_err and N": "T_err is at least {ratio:.2g} times {word} than the scatter of T of N = "
    "{number:g} particles in {replicas:g} run(s): do N, replicas and T_err belong to this curve, "
    "and is T_err a standard error of the mean?",
    "digits": "{column}_err, {error:.2g}, is less than the digits of {column} tell, "
    "{digit:.2g}/sqrt(12): the rounding counts as an error in addition. Write more digits of "
    "{column}",
    # the start and the loss
    "late start": "by the first rows T is T0 = {T0:g} m^2/s^2 at t = {begin:.6g} s and not at 0: "
    "does the clock of the file start earlier than the gas? Then subtract that time, or fit it: "
    "--free A t0",
    "loss": "T falls to a half in {halving:.3g} mean free times of the header's gas (eta, "
    "diameter, T0), where usual values are {low:.2g} to {high:.2g}: {question}",
    "unit of t": "is t in {units}? Then name the column t ({unit})",
    "any unit of the header": "are t, eta, diameter and T0 in the units that the file says?",
    "steps": "; is it in steps or frames? Then multiply it by their duration",
    # the definition of T
    "mean_speed": "mean_speed is read as the speed in three dimensions. If it contains only the "
    "two components that one camera sees, T is 0.62 of the true one and A 37 % too large: name the "
    "column mean_speed_xy then, and mean_speed_xyz otherwise",
    "scale": "T is {first:.4g} at first, {ratio:.3g} times the header's T0 = {T0:g} m^2/s^2: "
    "{question}. If T is right, correct T0",
    "definition": "is the column {words}? Then {rename}multiply {what} by {factor:.6g}",
    "rename": "name the column {column}, or ",
    "any definition": "are both <v^2>/d of one grain, in m^2/s^2? (Neither kelvin, nor the energy "
    "of all N grains, nor T over its first value)",
}
"""Questions and their parts by name, with places for values."""


def _ask(name: str, /, **values: Any) -> str:
    return QUESTIONS[name].format(**values)


def _is_usual(name: str, value: float) -> bool:
    low, high = USUAL_RANGES.get(name, (-np.inf, np.inf))
    return low <= value <= high


def ask_about_header(values: dict[str, float]) -> Iterator[str]:
    """Yield questions about unusual values of header keys, in SI."""
    for key, value in values.items():
        if not _is_usual(key, value):
            yield _unit_question(key, value, "unit of a key")
        error = values.get(f"{key}_err", 0.0)
        if key == "T0" and value == 1:
            yield _ask("T0 is 1")
        if key != "t0" and error > value > 0:
            yield _ask("large error", key=key, error=error, unit=UNITS[key], value=value)


def _unit_question(name: str, value: float, advice: str) -> str:
    """Return the question on an unusual value, with the unit in which it would be usual.

    Args:
        name: of a header key or a column.
        value: in SI.
        advice: the name in `QUESTIONS` of what to write if such a unit is found.
    """
    low, high = USUAL_RANGES[name]
    base = UNITS[name]
    question = _ask("any unit of T" if base == "m^2/s^2" else "any unit")
    for unit in OTHER_UNITS[base]:
        in_si = unit_in(unit, base) * value
        if _is_usual(name, in_si):
            question = _ask(advice, name=name, unit=unit, value=value, in_si=in_si)
            break
    return _ask("unusual", name=name, value=value, base=base, low=low, high=high, question=question)


def ask_about_speeds(columns: dict[str, np.ndarray]) -> Iterator[str]:
    """Yield questions about unusual speeds among the columns of a drop test."""
    for name in SPEEDS & columns.keys():
        largest = float(np.max(np.abs(columns[name])))
        if not _is_usual(name, largest):
            yield _unit_question(name, largest, "unit of a column")


def scene_of(header: dict[str, str]) -> Scene:
    """Return what the factors of definitions of T depend on."""
    known = {"diameter", "density"} <= header.keys()
    size, density = (files.header_number(header, k) if known else np.nan for k in _SIZE)
    spread = files.header_number({"diameter_sd": "0"} | header, "diameter_sd") / size
    mean_cube = 1 + 3 * spread**2  # of diameters, over the cube of their mean
    return Scene(
        d=files.header_count(header, "dimension") or 3,
        mass=float(sphere_mass(size, density)) * mean_cube if known else np.nan,
        number=files.header_count(header, "N") or np.nan,
        T0=files.header_number({"T0": "0"} | header, "T0") or np.nan,
    )


_SIZE = ("diameter", "density")


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
    if column == "mean_speed" and scene_of(header).d == 3:
        yield _ask("mean_speed")
    yield from _ask_about_digits(curve, rounding or {})
    for quantity in QUANTITIES.values():
        values = getattr(curve, quantity.field)
        if quantity.measured and values is not None and not quantity.column.endswith("_err"):
            largest = float(np.max(np.asarray(values)))
            if largest > 0 and not _is_usual(quantity.column, largest):
                yield _unit_question(quantity.column, largest, "unit of a column")
    if gas is None or gas.drive is not None:
        return
    if not all(_is_usual(key, float(header[key])) for key in REQUIRED if key in header):
        return  # `ask_about_header` asks first
    number = files.header_count(header, "N")
    yield from _ask_about_start(curve, header, gas, number, column)
    if number is not None and curve.temperature_error is not None:
        replicas = files.header_count(header, "replicas") or 1
        rows = above_noise(curve)
        share = np.asarray(curve.temperature_error)[rows] / np.asarray(curve.temperature)[rows]
        expected = sqrt(2 / (gas.dimension * number * replicas))
        ratios = {"larger": share[1:].min() / expected, "smaller": expected / share.max()}
        for word, ratio in ratios.items():
            if ratio > MAX_ERROR_RATIO:
                yield _ask("T_err and N", ratio=ratio, word=word, number=number, replicas=replicas)


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
            yield _ask("digits", column=column, error=errors[i], digit=digit[i])


def _ask_about_start(
    curve: CoolingCurve, header: dict[str, str], gas: Gas, number: int | None, column: str
) -> Iterator[str]:
    """Compare T at first with T0, the clock with T0, and the loss with the mean free time."""
    header = {"t0": "0", "T0_err": "0"} | header
    positive = above_noise(curve)
    times = np.asarray(curve.times)[positive] - files.header_number(header, "t0")
    T = np.asarray(curve.temperature)[positive]
    T0 = float(gas.temperature)
    if len(T) < MIN_POINTS:
        return
    rows = slice(0, max(4, int(np.sum(0.4 * T[0] < T))))
    line = (T[rows] / T0) ** -0.6  # straight in time for viscoelastic spheres
    slope, origin = np.polyfit(times[rows] - times[0], line, 1, w=1 / line)
    if slope <= 0 or not np.isfinite(slope):
        return
    first = origin ** (-1 / 0.6)
    begin = times[0] + (1 - origin) / slope  # where the line reaches T0
    halving = (2**0.6 - 1) * max(origin, 0.1) / slope
    chance = 4 * sqrt(2 / (gas.dimension * number)) if number else 0.0
    known = 3 * files.header_number(header, "T0_err") / T0
    at_zero = max(origin - slope * times[0], 1e-9) ** (-1 / 0.6)
    if first > MAX_RATIO + chance + known:
        yield _scale_question(first, gas, header, column)
    elif begin > MAX_LATENESS * halving and begin > 0.5 * times[0]:
        yield _ask("late start", T0=T0, begin=begin)
    elif at_zero < 1 / (MAX_RATIO + chance + known):
        yield _scale_question(at_zero, gas, header, column)
    loss = gas.dimension * slope / (0.6 * origin) / float(_collision_frequency(gas))
    if T[-1] < 0.8 * T[0] and not USUAL_LOSS[0] <= loss <= USUAL_LOSS[1]:
        units = [unit for unit in OTHER_UNITS["s"] if 1e-3 < loss / unit_in(unit, "s") < 1]
        question = _ask("any unit of the header")
        if units:
            question = _ask("unit of t", units=" or ".join(units), unit=units[0])
        if loss < 1:
            question += _ask("steps")
        halving = halving / float(gas.mean_free_time)
        high, low = (halving * loss / usual for usual in USUAL_LOSS)
        yield _ask("loss", halving=halving, low=low, high=high, question=question)


@eqx.filter_jit
def _collision_frequency(gas: Gas) -> Array:
    return gas.collision_frequency


def _scale_question(ratio: float, gas: Gas, header: dict[str, str], column: str) -> str:
    """Return the question for T that begins at another value than T0.

    T0 is not offered for a fit: a fit would take the wrong scale for a hotter or colder gas.
    """
    T0 = float(gas.temperature)
    causes = []
    for definition, factor in other_definitions(ratio, column, scene_of(header)):
        rename = _ask("rename", column=definition.column) if definition.column else ""
        what = "it" if definition.power == 1 else "T"
        causes.append(
            _ask("definition", words=definition.words, rename=rename, what=what, factor=factor)
        )
    question = ". Or ".join(causes) or _ask("any definition")
    return _ask("scale", first=ratio * T0, ratio=ratio, T0=T0, question=question)
