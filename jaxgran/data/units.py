"""Units of header keys and columns, and their values in SI, which pint computes."""

import re
from functools import cache
from typing import Any, NamedTuple

from jaxgran.data.quantities import QUANTITIES
from jaxgran.scene.parameters import BY_SYMBOL

UNIT_KEYS = {"length_unit": "m", "time_unit": "s", "speed_unit": "m/s"}
"""Header keys of units, and the units that they replace. T is in the square of speed_unit."""

HEADER_UNITS = {
    **UNIT_KEYS,
    **{symbol: parameter.unit or "1" for symbol, parameter in BY_SYMBOL.items()},
    **dict.fromkeys(("localisation_error", "box_side"), "m"),
    "frame_rate": "1/s",
    "timestep": "s",
    "T_scale": "1",
}
"""Unit of each header key; a standard error, x_err, has the unit of x."""

COLUMN_UNITS = {
    **{quantity.column: quantity.unit for quantity in QUANTITIES.values()},
    **dict.fromkeys(("x", "y", "z"), "m"),
    **dict.fromkeys(("mean_speed", "mean_speed_xyz", "mean_speed_xy", "mean_speed_x", "v"), "m/s"),
    **dict.fromkeys(("vx2", "v2_xy", "v2"), "m^2/s^2"),
    **dict.fromkeys(("energy", "total_energy"), "J"),
    **dict.fromkeys(("v_n", "v_t"), "m/s"),
    **{f"v{x}{end}": "m/s" for x in "xyz" for end in ("", "_after")},
    **{f"w{x}{end}": "rad/s" for x in "xyz" for end in ("", "_after")},
    "w": "rad/s",
    "angle": "deg",
    **dict.fromkeys(("eps", "eps_t", "eps_t_center"), "1"),
}
"""Unit of each column; a standard error, x_err, has the unit of x."""

UNITS = HEADER_UNITS | COLUMN_UNITS
"""Unit of each header key and column."""

ANGLES = ("deg", "degree", "degrees", "°", "rad", "mrad", "arcmin", "arcsec", "grad", "turn")
"""Units of angles: an error in one of them is not relative, unlike an error in %."""

MAX_UNIT = 60
"""Largest number of characters of a unit."""

NAME = re.compile(r"(?P<name>\w+)\s*(?:[(\[](?P<bracket>.*)[)\]]|/\s*(?P<slash>.+))?")
"""A name with a unit behind it, in brackets or after a slash."""

_POWER = re.compile(r"\^(?:-?\d|\(-?\d\))(?![\d.^])")


class UnitError(ValueError):
    """A unit that is refused for a reason of its own."""


class Units(NamedTuple):
    """Units of the numbers of a table, or of its header.

    Attributes:
        given: the unit that stands behind each name, "" without one.
        usual: the units of numbers without one, by SI unit; SI where one is not listed.
        kind: of the names, for messages.
    """

    given: dict[str, str]
    usual: dict[str, str]
    kind: str

    def factor(self, name: str) -> float:
        """Return the value in SI of the unit of a name: an error without one has its value's unit.

        Raises:
            ValueError: for a unit that is not known, or not one of the name.
        """
        base = base_unit(name)
        if base is None:
            return 1.0
        # Frames are counted per second in files whose times are in ms, too.
        inherited = base if name == "frame_rate" else self.usual.get(base, base)
        unit = self.given[name] or self.given.get(name.removesuffix("_err")) or inherited
        if self.is_relative(name):
            return unit_in(unit, "1")
        if unit in (base, base.replace("m^2/s^2", "(m/s)^2")):
            return 1.0
        try:
            return unit_in(unit, base)
        except UnitError as error:
            raise ValueError(f"{self.kind} {name}: {error}") from None
        except Exception:  # pint raises errors of many types for text that is not a unit
            advice = f"write a unit such as {base}, or leave it out"
            if base == "m^2/s^2":
                advice = "T is <v^2>/d, in m^2/s^2: multiply kelvin by 1.38e-23 J/K over the mass"
            raise ValueError(
                f"{self.kind} {name}: {unit!r} is not known as a unit of {base}; {advice}"
            ) from None

    def is_relative(self, name: str) -> bool:
        """Return whether a standard error is a part of its value, as one in % is.

        It is not if the value has the same unit.
        """
        unit = self.given.get(name, "")
        value = self.given.get(name.removesuffix("_err"), "")
        if not name.endswith("_err") or unit == value or unit in ANGLES:
            return False
        return is_dimensionless(unit)


def base_unit(name: str, units: dict[str, str] = UNITS) -> str | None:
    """Return the SI unit of a column or header key, also of a standard error; None if unknown.

    Args:
        name: of the column or header key.
        units: of those that are looked up.
    """
    return units.get(name.removesuffix("_err"))


def is_dimensionless(unit: str) -> bool:
    """Return whether a text is a unit without a dimension, such as %."""
    try:
        return bool(unit) and unit != "1" and unit_in(unit, "1") != 1
    except Exception:  # see `Units.factor`
        return False


def unit_in(unit: str, base: str) -> float:
    """Return the value of a unit in terms of another one.

    >>> from jaxgran.data.units import unit_in
    >>> unit_in("g/cm^3", "kg/m^3")
    1000.0
    """
    text = re.sub(r"([A-Za-z])(\d)", r"\1^\2", unit.replace("**", "^"))
    if len(text) > MAX_UNIT or "^" in _POWER.sub("", text):
        raise UnitError(f"{unit!r} is not a unit of {base}: powers have one digit")
    parsed = _registry().parse_units(text)
    if "pixel" in str(parsed):  # which pint takes for 1/96 inch
        raise UnitError(f"{unit!r} is not a unit of {base}: multiply by the metres of one pixel")
    factor = _registry().Quantity(1.0, parsed).to("" if base == "1" else base).magnitude
    return float(f"{factor:.15g}")  # without the rounding errors of several factors


@cache
def _registry() -> Any:
    """Return pint's table of units, which takes half a second to load."""
    import pint

    return pint.UnitRegistry()
