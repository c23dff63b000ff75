"""What a column of a file means, and in which units: conversion to T and to SI."""

import warnings
from math import pi

import numpy as np

from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_mass

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
"""Units that the header keys ``length_unit`` and ``time_unit`` may name, in SI."""

DIMENSIONS = {
    "t": (0, 1),
    "T": (2, -2),
    "msd": (2, 0),
    "D": (2, -1),
    "velocity_correlation": (2, -2),
    "x": (1, 0),
    "y": (1, 0),
    "z": (1, 0),
    "localisation_error": (1, 0),
    "T_rot": (2, -2),
    "mean_speed": (1, -1),
    "vx2": (2, -2),
    "v2_xy": (2, -2),
    "diameter": (1, 0),
    "diameter_err": (1, 0),
    "T0": (2, -2),
    "T0_err": (2, -2),
    "t0": (0, 1),
    "t0_err": (0, 1),
    "T_rot_0": (2, -2),
    "container_side": (1, 0),
    "gamma": (0, -1),
    "A": (0, 1),
}
"""Powers of length and time in columns, with their errors, and header values; all others are SI."""

STAND_INS = {
    "mean_speed": "mean speed <|v|>",
    "vx2": "mean square <v_x^2> of one component of the velocity",
    "v2_xy": "mean square <v_x^2 + v_y^2> of two components, as a camera sees them",
    "energy": "translational energy of a particle (m/2) <v^2>, in J",
}
"""Columns from which T = <v^2>/d is computed, and what they are."""


USUAL = {
    "diameter": (1e-7, 0.1, "m"),
    "temperature": (0.0, 900.0, "m^2/s^2, a thermal speed of 30 m/s"),
    "youngs_modulus": (1e3, 1e13, "Pa"),
}
"""Least and largest values of a granular gas that are not warned of, and their unit."""


def warn_of_units(gas: Gas) -> None:
    """Warn of values that no granular gas has, mostly slips of units."""
    for name, (least, largest, unit) in USUAL.items():
        value = float(gas.value(name))
        if not least <= value <= largest:
            warnings.warn(
                f"{name} is {value:.3g}, outside {least:g} to {largest:g} {unit}: check its unit; "
                "files may name theirs by length_unit and time_unit",
                stacklevel=3,
            )


def in_si(
    columns: dict[str, np.ndarray], header: dict[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Columns and header in SI, T in place of what stands in for it.

    The header's units are then gone from it, and its entry T_from says how T was computed.

    Raises:
        ValueError: for a unit that is not known, or an energy of particles of unknown mass.
    """
    units = _unit(header, "length_unit", LENGTHS), _unit(header, "time_unit", TIMES)
    named = ("length_unit", "time_unit")
    header = {key: value for key, value in header.items() if key not in named}
    for key in DIMENSIONS.keys() & header.keys():
        factor = _power(units, key)
        if factor != 1 and (value := _number(header[key])) is not None:
            header[key] = repr(factor * value)
    columns = {name: _power(units, name) * column for name, column in columns.items()}
    for name in STAND_INS.keys() & columns.keys():
        values = columns.pop(name)
        error = columns.pop(f"{name}_err", None)
        columns["T"], power, header["T_from"] = temperature_of(name, values, header)
        if error is not None:
            share = np.divide(error, values, out=np.zeros_like(error), where=values != 0)
            columns["T_err"] = power * columns["T"] * share
    return columns, header


def _power(units: tuple[float, float], name: str) -> float:
    length, time = DIMENSIONS.get(name.removesuffix("_err"), (0, 0))
    return units[0] ** length * units[1] ** time


def _unit(header: dict[str, str], key: str, units: dict[str, float]) -> float:
    name = header.get(key, next(iter(units)))
    if name not in units:
        raise ValueError(f"header line {key}: {name!r} is not known; use {', '.join(units)}")
    return units[name]


def _number(text: str) -> float | None:
    """The number that a text is; None if it is none, which is said where it is used."""
    try:
        return float(text)
    except ValueError:
        return None


def temperature_of(
    name: str, values: np.ndarray, header: dict[str, str]
) -> tuple[np.ndarray, float, str]:
    """T = <v^2>/d of a column that stands in for it, for isotropic Maxwellian velocities.

    Args:
        name: of the column, one of `STAND_INS`.
        values: in SI.
        header: with dimension (3 if it is left out) and, for an energy, diameter and density.

    Returns:
        T, m^2/s^2; the power of the column in it; and the equation, in words.

    Raises:
        ValueError: for an energy of particles of unknown mass.
    """
    three = _number(header.get("dimension", "3")) == 3
    if name == "mean_speed":
        factor, words = (pi / 8, "pi/8") if three else (2 / pi, "2/pi")
        return factor * values**2, 2.0, f"T = ({words}) mean_speed^2, of Maxwellian velocities"
    if name == "vx2":
        return values, 1.0, "T = vx2, of isotropic velocities"
    if name == "v2_xy":
        return values / 2, 1.0, "T = v2_xy / 2, of isotropic velocities"
    diameter, density = (_number(header.get(key, "")) for key in ("diameter", "density"))
    if diameter is None or density is None:
        raise ValueError(
            "a column energy needs the mass of a particle: add diameter and density to the header, "
            "or give T = <v^2>/d itself"
        )
    mass = float(sphere_mass(diameter, density))
    d = 3 if three else 2
    return 2 * values / (d * mass), 1.0, f"T = 2 energy / ({d} m), of energies in J per particle"
