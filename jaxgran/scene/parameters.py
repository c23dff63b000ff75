"""The table of the parameters of a scene: names, symbols in files and options, units, ranges.

Elements, laws and `Gas` take the ranges of their fields from it, curve files their header keys, and
the command line the arguments of --free.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxgran._utils import validation
from jaxgran._utils.validation import ANY, FRACTION, NON_NEGATIVE, POSITIVE, Domain

SCENE = "scene"
MATERIAL = "material"
TANGENTIAL = Domain(-1.0, 1.0, low_allowed=True, high_allowed=True)
INERTIA = Domain(0.0, 1.0, high_allowed=True)


class Parameter(NamedTuple):
    """A number that describes a scene.

    Attributes:
        name: of the parameter in `Gas`, as in ``gas.replace(wall_side=0.05)``.
        symbol: key of the header of a curve file and argument of --free; "" if it has none.
        unit: SI; "" for a number without one.
        domain: allowed values.
        belongs_to: `MATERIAL`, which several measurements may share, or the `SCENE` of one.
        owners: classes that have it as a field, under its name without the prefix in `PREFIXES`.
    """

    name: str
    symbol: str
    unit: str
    domain: Domain
    belongs_to: str
    owners: tuple[str, ...]


# fmt: off
_ROWS = (
    # name, symbol, unit, domain, of, owners. `Gas` allows packing_fraction up to close packing.
    ("youngs_modulus", "Y", "Pa", POSITIVE, MATERIAL, "Viscoelastic"),
    ("poisson_ratio", "nu", "", Domain(-1.0, 0.5), MATERIAL, "Viscoelastic"),
    ("dissipative_constant", "A", "s", NON_NEGATIVE, MATERIAL, "Viscoelastic"),
    ("diameter", "diameter", "m", POSITIVE, SCENE, "Gas"),
    ("mass", "", "kg", POSITIVE, SCENE, "Gas"),
    ("diameter_sd", "diameter_sd", "m", NON_NEGATIVE, SCENE, "Gas"),
    ("density", "density", "kg/m^3", POSITIVE, MATERIAL),
    ("temperature", "T0", "m^2/s^2", POSITIVE, SCENE, "Gas"),
    ("packing_fraction", "eta", "", FRACTION, SCENE, "Gas"),
    ("t0", "t0", "s", ANY, SCENE),
    ("coefficient", "eps", "", FRACTION, MATERIAL, "ConstantRestitution"),
    ("tangential_restitution", "beta_t", "", TANGENTIAL, MATERIAL, "Rough"),
    ("tangential_damping", "tangential_damping", "", NON_NEGATIVE, MATERIAL, "Frictional"),
    ("friction", "friction", "", NON_NEGATIVE, MATERIAL, "Frictional", "Rough"),
    ("inertia", "reduced_inertia", "", INERTIA, MATERIAL, "Rough", "Frictional"),
    ("rotational_temperature", "T_rot_0", "m^2/s^2", NON_NEGATIVE, SCENE, "Rough", "Frictional"),
    ("wall_side", "container_side", "m", POSITIVE, SCENE, "Walls"),
    ("wall_coefficient", "wall_restitution", "", FRACTION, MATERIAL),
    ("wall_tangential_restitution", "wall_beta_t", "", TANGENTIAL, MATERIAL, "Walls"),
    ("wall_tangential_damping", "", "", NON_NEGATIVE, MATERIAL, "Walls"),
    ("wall_friction", "", "", NON_NEGATIVE, MATERIAL, "Walls"),
    ("drag_rate", "gamma", "1/s", NON_NEGATIVE, SCENE, "StokesDrag"),
    ("drag_rotational_rate", "", "1/s", NON_NEGATIVE, SCENE, "StokesDrag"),
    ("drive_strength", "drive_strength", "m^2/s^3", NON_NEGATIVE, SCENE, "WhiteNoise"),
)
# fmt: on

PARAMETERS = {row[0]: Parameter(*row[:5], owners=row[5:]) for row in _ROWS}
"""Parameters by name; the parameters of a class are in the order of the table.

Three are no fields: t0, the time at which the gas began to cool; density, the mass of a grain over
its volume; and wall_coefficient, which is the coefficient of the law of the walls."""

BY_SYMBOL = {p.symbol: p for p in PARAMETERS.values() if p.symbol}
"""Parameters that files and options name, by symbol."""

PARAMETER_UNITS = {p.name: p.unit for p in PARAMETERS.values() if p.unit}
"""Unit of each parameter that has one."""

REQUIRED = ("eta", "diameter", "density", "Y", "nu", "T0")
"""Symbols that a curve file must give; eps, a constant restitution, may replace Y and nu."""

PREFIXES = {"Walls": "wall_", "StokesDrag": "drag_", "WhiteNoise": "drive_"}
"""Prefix of the names of the parameters of an element in `Gas`, by class."""

ADVICE = {
    "dissipative_constant": "Give A in seconds; A = 0 makes the spheres elastic.",
    "temperature": "Give <v^2>/d in m^2/s^2.",
    "youngs_modulus": "Give Young's modulus in Pa (glass has about 7e10).",
    "poisson_ratio": "Most solids lie between 0.2 and 0.45.",
    "packing_fraction": "It is the fraction of the volume (of the area if dimension = 2) that the "
    "spheres occupy; the upper end is close packing.",
    "diameter": "Give it in metres.",
    "diameter_sd": "Give the standard deviation of the diameters in metres.",
    "mass": "Give it in kilograms; sphere_mass(diameter, density) computes it.",
    "coefficient": "1 is an elastic impact; 0 removes the normal relative velocity.",
    "tangential_restitution": "-1 is a smooth surface, 1 a perfectly rough one.",
    "inertia": "It is 4 I/(m sigma^2): 0.4 for solid spheres.",
    "rotational_temperature": "Give I <w^2>/(d_rot m) at t = 0 in m^2/s^2.",
    "wall_side": "Give it in metres.",
    "tangential_damping": "It is relative to the normal damping: 0 to 1 is usual.",
    "friction": "It is Coulomb's coefficient: glass has 0.1 to 0.5.",
    "drag_rate": "Give it in 1/s.",
    "drag_rotational_rate": "Give it in 1/s.",
    "drive_strength": "Give the growth of T = <v^2>/d in time, m^2/s^3.",
}
"""A sentence that ends the message on a value outside its domain, by name."""


def symbol_of(name: str) -> str:
    """Return the symbol of a parameter, which may begin with a label: "thin: T0"; else its name."""
    label, separator, short = name.rpartition(": ")
    symbol = PARAMETERS[short].symbol if short in PARAMETERS else ""
    return f"{label}{separator}{symbol or short}"


def unit_of(name: str) -> str:
    """Return the unit of a parameter, which may begin with a label; "" if it has none."""
    return PARAMETER_UNITS.get(name.rpartition(": ")[2], "")


def number_named(name: str) -> Callable[[Any], Any]:
    """Return a converter of `equinox.field` to a float array, in the unit of a parameter."""
    return validation.number_named(name, unit_of(name))


def optional_number_named(name: str) -> Callable[[Any], Any]:
    """Return the same converter for a field that is a number or None."""
    converter = number_named(name)
    return lambda value: None if value is None else converter(value)


def fields_of(owner: str) -> dict[str, Parameter]:
    """Return the parameters that are fields of a class, by the name of the field."""
    prefix = PREFIXES.get(owner, "")
    return {p.name.removeprefix(prefix): p for p in PARAMETERS.values() if owner in p.owners}


def domains_of(owner: str) -> dict[str, Domain]:
    """Return the allowed values of the fields of a class."""
    return {field: parameter.domain for field, parameter in fields_of(owner).items()}
