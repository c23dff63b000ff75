"""Definitions of temperature: what a column may hold in place of T = <v^2>/d, and the factors."""

from collections.abc import Callable
from math import nan, pi
from typing import NamedTuple

from jaxgran.data.header_values import header_count, header_dimension, header_number
from jaxgran.scene.geometry import sphere_mass

BOLTZMANN = 1.380649e-23


class GasFacts(NamedTuple):
    """What factors depend on.

    Attributes:
        d: dimension of the gas.
        mass: of a grain, kg; nan if it is not known.
        number: of grains; nan if it is not known.
        T0: of the header, m^2/s^2; nan if it is not known.
    """

    d: int
    mass: float = nan
    number: float = nan
    T0: float = nan


class Definition(NamedTuple):
    """A quantity x from which the temperature follows, ``T = factor x^power``.

    Attributes:
        column: its name in files; "" if files cannot have it.
        words: what it is.
        factor: of T.
        power: of x in T.
    """

    column: str
    words: str
    factor: Callable[[GasFacts], float]
    power: int = 1


DEFINITIONS = (
    Definition("T", "<v^2>/d", lambda s: 1.0),
    Definition("vx2", "<v_x^2>, for isotropic velocities", lambda s: 1.0),
    Definition("v2_xy", "<v_x^2 + v_y^2>, for isotropic velocities, twice T", lambda s: 1 / 2),
    Definition("v2", "<v^2>, not divided by the dimension", lambda s: 1 / s.d),
    Definition("energy", "the energy of a particle, in J", lambda s: 2 / (s.d * s.mass)),
    Definition(
        "total_energy",
        "the energy of all N particles, in J",
        lambda s: 2 / (s.d * s.mass * s.number),
    ),
    Definition(
        "mean_speed",
        "<|v|>, for Maxwellian velocities",
        lambda s: 2 / pi if s.d == 2 else pi / 8,
        power=2,
    ),
    Definition("mean_speed_xyz", "<|v|>, for Maxwellian velocities", lambda s: pi / 8, power=2),
    Definition(
        "mean_speed_xy",
        "the mean of sqrt(v_x^2 + v_y^2), for Maxwellian velocities",
        lambda s: 2 / pi,
        power=2,
    ),
    Definition("mean_speed_x", "<|v_x|>, for Maxwellian velocities", lambda s: pi / 2, power=2),
    Definition("", "T over T0", lambda s: s.T0),
    Definition("", "the energy over the mass", lambda s: 2 / s.d),
    Definition("", "m <v^2>/d, in J", lambda s: 1 / s.mass),
    Definition("", "m <v^2>/d of all N particles, in J", lambda s: 1 / (s.mass * s.number)),
    Definition("", "the sum of v^2 over all N particles", lambda s: 1 / (s.d * s.number)),
    Definition("", "in kelvin, m <v^2>/(d k_B)", lambda s: BOLTZMANN / s.mass),
    Definition("", "in cm^2/s^2", lambda s: 1e-4),
    Definition("", "in mm^2/s^2", lambda s: 1e-6),
    Definition("", "the sum of two components over 3", lambda s: 3 / 2),
    Definition("", "one component over 3", lambda s: 3.0),
    Definition("", "one component over 2", lambda s: 2.0),
)
"""All definitions; the first one is the one of this package."""

BY_COLUMN = {x.column: x for x in DEFINITIONS if x.column}
"""Definitions that files can have, by the name of the column."""

TEMPERATURE_COLUMNS = tuple(name for name in BY_COLUMN if name != "T")
"""Columns from which T is computed."""

MAX_DIFFERENCE = 0.12
"""Relative difference of a ratio from the one of a definition up to which it is named."""


def other_definitions(ratio: float, column: str, facts: GasFacts) -> list[tuple[Definition, float]]:
    """Return the definitions that explain a ratio of T to its expected value, the nearest first.

    Args:
        ratio: T as it was read over the expected one.
        column: from which T was read.
        facts: of the header.

    Returns:
        Each definition, and the factor by which T becomes right.
    """
    read = BY_COLUMN[column]
    found = []
    for other in DEFINITIONS:
        factor = other.factor(facts) / read.factor(facts)
        difference = abs(ratio * factor - 1)  # nan if something is not known
        if other.power == read.power and difference < MAX_DIFFERENCE and factor != 1:
            found.append((difference, other, factor))
    return [(other, factor) for _, other, factor in sorted(found, key=lambda x: x[0])]


def facts_of(header: dict[str, str]) -> GasFacts:
    """Return what a header says of the gas, on which the factors of definitions of T depend."""
    spread = header_number({"diameter_sd": "0"} | header, "diameter_sd")
    mass = nan
    if {"diameter", "density"} <= header.keys():
        size = header_number(header, "diameter")
        sphere = float(sphere_mass(size, header_number(header, "density")))
        mass = sphere * (1 + 3 * (spread / size) ** 2)  # the mean cube over the cube of the mean
    return GasFacts(
        d=header_dimension(header),
        mass=mass,
        number=header_count(header, "N") or nan,
        T0=header_number({"T0": "0"} | header, "T0") or nan,
    )
