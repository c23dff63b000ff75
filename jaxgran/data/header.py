"""Numbers in the header of a curve."""

import numpy as np

LARGEST_COUNT = 10**12
"""The largest whole number of a header."""


def header_number(header: dict[str, str], key: str) -> float:
    """The value of a key in the header of a curve, as a number.

    Raises:
        ValueError: if the value is not a finite number.
        KeyError: if there is no such key.
    """
    try:
        number = float(header[key])
    except ValueError:
        number = float("nan")
    if not np.isfinite(number):
        raise ValueError(f"header line {key}: {header[key]!r} is not a finite number")
    return number


def header_count(header: dict[str, str], key: str) -> int | None:
    """The value of a key in the header of a curve, such as N, as a positive whole number.

    Returns:
        The number, or None if there is no such key.

    Raises:
        ValueError: if the value is not a positive whole number.
    """
    if key not in header:
        return None
    number = header_number(header, key)
    if not (1 <= number <= LARGEST_COUNT and number.is_integer()):
        raise ValueError(
            f"header line {key}: must be a whole number from 1 to {LARGEST_COUNT:g}, got "
            f"{header[key]!r}"
        )
    return int(number)
