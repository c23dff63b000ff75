"""Usual values of header keys and columns, and questions about others, mostly by their units."""

from collections.abc import Iterator

import numpy as np

from jaxgran.data.units import UNITS, unit_in

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


def ask_about_header(values: dict[str, float]) -> Iterator[str]:
    """Yield questions about unusual values of header keys, in SI."""
    for key, value in values.items():
        if not is_usual(key, value):
            yield unit_question(key, value, is_column=False)
        error = values.get(f"{key}_err", 0.0)
        if key == "T0" and value == 1:
            yield (
                "T0 is 1 m^2/s^2: is the temperature divided by its first value? Then give T0 in "
                "m^2/s^2, and multiply T by it"
            )
        if key != "t0" and error > value > 0:
            yield _error_question(key, value, error)


def _error_question(key: str, value: float, error: float) -> str:
    """Return the question on an error that is larger than its value."""
    unit = UNITS[key]
    if unit == "1":
        return f"{key}_err is {error:.6g}, larger than {key} itself, {value:.6g}: check it"
    return (
        f"{key}_err is {error:.6g} {unit}, larger than {key} itself, {value:.6g} {unit}: an error "
        f"without a unit is read in the unit of {key}. If it is in {unit}, write {unit} after it"
    )


def ask_about_speeds(columns: dict[str, np.ndarray]) -> Iterator[str]:
    """Yield questions about unusual speeds among the columns of a drop test."""
    for name in sorted(SPEEDS & columns.keys()):
        largest = float(np.max(np.abs(columns[name])))
        if not is_usual(name, largest):
            yield unit_question(name, largest, is_column=True)


def unit_question(name: str, value: float, *, is_column: bool) -> str:
    """Return the question on an unusual value, with the unit in which it would be usual.

    Args:
        name: of a header key or a column.
        value: in SI.
        is_column: where a unit is written: after the name of a column, or after a value.
    """
    low, high = USUAL_RANGES[name]
    base = UNITS[name]
    question = "check its unit"
    if base == "m^2/s^2":
        question += " (kelvin times 1.38e-23 J/K over the mass are m^2/s^2)"
    for unit in OTHER_UNITS[base]:
        in_si = unit_in(unit, base) * value
        if is_usual(name, in_si):
            advice = f"{name}: {in_si:.6g}, or {name}: {value:g} {unit}"
            if is_column:
                advice = f"{name} ({unit}) as the name of the column"
            question = f"is it in {unit}? Then write {advice}"
            break
    return f"{name} is {value:.6g} {base}, where usual values are {low:g} to {high:g}: {question}"


def is_usual(name: str, value: float) -> bool:
    """Return whether a value in SI lies in the usual range, or its key or column has none."""
    low, high = USUAL_RANGES.get(name, (-np.inf, np.inf))
    return low <= value <= high
