"""Format numbers for the documents; define a row of their tables."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Row(NamedTuple):
    """A row of accuracy.md or speed.md.

    Attributes:
        what, against: the measured quantity, and its reference.
        source: names of files in figures/ without extension, separated by blanks.
        measured: returns the text of the third column from the contents of these files.
        command: the command that makes the figures.
    """

    what: str
    against: str
    source: str
    measured: Callable[..., str]
    command: str


def power(value: float, digits: int = 1) -> str:
    """Write a number with significant digits and a power of ten: 7·10⁻⁶."""
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return minus(f"{mantissa}·10{str(int(exponent)).translate(RAISED)}")


def percent(share: float, digits: int = 1) -> str:
    """Write a fraction in per cent, with its sign and without the unit."""
    return minus(f"{100 * share:+.{digits}f}")


def minus(text: str) -> str:
    """Replace hyphens by minus signs."""
    return text.replace("-", "−")


def each(values: Iterable[Any], style: str = "{:.1f}") -> str:
    """Write numbers one after another: 1.0 / 2.0."""
    return " / ".join(minus(style.format(value)) for value in values)


def between(values: Iterable[float], style: str = "{:.2g}") -> str:
    """Write the range of numbers, or one number if both ends read alike."""
    values = list(values)
    low, high = style.format(min(values)), style.format(max(values))
    return low if low == high else f"{low} to {high}"


def of(rows: list[dict], **wanted) -> list[dict]:
    """Return the rows with these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def thousands(rate: float) -> str:
    """Write a rate in thousands: 22 k."""
    return f"{rate / 1e3:.0f} k"
