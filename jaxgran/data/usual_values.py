"""Usual values of header keys and columns, and questions about others, mostly by their units."""

from collections.abc import Iterator

import numpy as np

from jaxgran.data.questions import ask, part
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
            yield unit_question(key, value, "unit of a key")
        error = values.get(f"{key}_err", 0.0)
        if key == "T0" and value == 1:
            yield ask("T0 is 1")
        if key != "t0" and error > value > 0:
            unit = UNITS[key]
            yield ask(
                "large error of a number" if unit == "1" else "large error",
                key=key,
                error=error,
                unit=unit,
                value=value,
            )


def ask_about_speeds(columns: dict[str, np.ndarray]) -> Iterator[str]:
    """Yield questions about unusual speeds among the columns of a drop test."""
    for name in sorted(SPEEDS & columns.keys()):
        largest = float(np.max(np.abs(columns[name])))
        if not is_usual(name, largest):
            yield unit_question(name, largest, "unit of a column")


def unit_question(name: str, value: float, advice: str) -> str:
    """Return the question on an unusual value, with the unit in which it would be usual.

    Args:
        name: of a header key or a column.
        value: in SI.
        advice: the name in `PARTS` of what to write if such a unit is found.
    """
    low, high = USUAL_RANGES[name]
    base = UNITS[name]
    question = part("any unit of T" if base == "m^2/s^2" else "any unit")
    for unit in OTHER_UNITS[base]:
        in_si = unit_in(unit, base) * value
        if is_usual(name, in_si):
            question = part(advice, name=name, unit=unit, value=value, in_si=in_si)
            break
    return ask("unusual", name=name, value=value, base=base, low=low, high=high, question=question)


def is_usual(name: str, value: float) -> bool:
    """Return whether a value in SI lies in the usual range, or its key or column has none."""
    low, high = USUAL_RANGES.get(name, (-np.inf, np.inf))
    return low <= value <= high
