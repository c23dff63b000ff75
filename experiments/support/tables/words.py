"""Numbers as the documents write them, and a row of a table."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


class Row(NamedTuple):
    """A row of accuracy.md or speed.md.

    Attributes:
        what, against: what was measured, and against what.
        source: the files in figures/, without their ends, separated by blanks.
        measured: the words of the third column, out of the contents of these files.
        command: that makes the figures.
    """

    what: str
    against: str
    source: str
    measured: Callable[..., str]
    command: str


def power(value: float, digits: int = 1) -> str:
    """A number with so many digits and a power of ten: 7·10⁻⁶."""
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return minus(f"{mantissa}·10{str(int(exponent)).translate(RAISED)}")


def percent(share: float, digits: int = 1) -> str:
    """A share in per cent, with its sign and without the word."""
    return minus(f"{100 * share:+.{digits}f}")


def minus(text: str) -> str:
    """The same text with true minus signs."""
    return text.replace("-", "−")


def each(values: Iterable[Any], style: str = "{:.1f}") -> str:
    """Numbers one after another: 1.0 / 2.0."""
    return " / ".join(minus(style.format(value)) for value in values)


def between(values: Iterable[float], style: str = "{:.2g}") -> str:
    """The smallest and the largest, or one of them where they are written alike."""
    values = list(values)
    low, high = style.format(min(values)), style.format(max(values))
    return low if low == high else f"{low} to {high}"


def of(rows: list[dict], **wanted) -> list[dict]:
    """Rows with these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def thousands(rate: float) -> str:
    """A rate in thousands: 22 k."""
    return f"{rate / 1e3:.0f} k"
