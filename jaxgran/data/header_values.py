"""Numbers of the header of a file, whose values are texts."""

from collections.abc import Mapping
from typing import Any

import numpy as np

MAX_COUNT = 10**12
"""Largest whole number in a header."""


def header_number(header: Mapping[str, Any], key: str) -> float:
    """Return the value of a key in the header of a curve, as a number.

    Raises:
        ValueError: if the value is not a finite number.
        KeyError: if there is no such key.
    """
    try:
        number = float("nan") if "_" in str(header[key]) else float(header[key])
    except (TypeError, ValueError):
        number = float("nan")
    if not np.isfinite(number):
        raise ValueError(f"header line {key}: {header[key]!r} is not a finite number")
    return number


def positive_number(header: Mapping[str, Any], key: str) -> float:
    """Return the value of a key that must be a positive number: see `header_number`."""
    number = header_number(header, key)
    if number <= 0:
        raise ValueError(f"header line {key}: must be a positive number, got {header[key]!r}")
    return number


def header_count(header: Mapping[str, Any], key: str) -> int | None:
    """Return the value of a key in the header of a curve, such as N, as a positive whole number.

    Returns:
        The number, or None if there is no such key.

    Raises:
        ValueError: if the value is not a positive whole number.
    """
    if key not in header:
        return None
    number = header_number(header, key)
    if not (1 <= number <= MAX_COUNT and number.is_integer()):
        raise ValueError(
            f"header line {key}: must be a whole number from 1 to {MAX_COUNT:g}, got "
            f"{header[key]!r}"
        )
    return int(number)


def header_dimension(header: Mapping[str, Any]) -> int:
    """Return the dimension of the gas, 3 unless the header gives another one."""
    return header_count(header, "dimension") or 3


def header_sides(header: Mapping[str, Any]) -> float | list[float]:
    """Return the side of a cubic or square container, or its d sides, m."""
    sides = [
        header_number({"container_side": part.strip()}, "container_side")
        for part in str(header["container_side"]).split("x")
    ]
    return sides if len(sides) > 1 else sides[0]
