"""CSV tables as people write them: encodings, separators, decimal commas, units, header lines.

A table has header lines ``# key: value``, a line with the names of the columns, and rows of
numbers. Units in names, as ``T (mm^2/s^2)``, in header values, as ``diameter: 2 mm``, and in the
header keys length_unit, time_unit and speed_unit are converted to SI.
"""

import codecs
import csv
import math
import re
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.data.files import read_bytes
from jaxgran.data.header_lines import (
    BLANKS,
    COMMENT_SIGNS,
    add_header_line,
    convert_header,
    split_units,
    text_of_comment,
    with_usual_keys,
)
from jaxgran.data.quantities import QUANTITIES
from jaxgran.data.units import NAME, Units
from jaxgran.data.written_numbers import NUMBER, contains_error, number_or_nan

ALIASES = {
    "time": "t",
    **{quantity.field: quantity.column for quantity in QUANTITIES.values()},
    **{name: name for name in ("id", "particle", "track_id", "frame", "x", "y", "z")},
    **{f"position_{name}": name for name in "xyzt"},
    **dict.fromkeys(("total_energy", "trakineticenergy", "ene_kin", "kineng"), "total_energy"),
}
"""Further names of columns, in any case."""

SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas", "|": "bars", " ": "blanks"}
"""Separators of columns, in order of preference, and their names in messages."""

NO_IDENTITY = ("", "none", "nan")
"""Cells, in small letters, of a particle that belongs to no track."""

_MARKS = {
    "utf-32": (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE),
    "utf-16": (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE),
}

_BINARY = re.compile(r"[\x00-\x08\x0e-\x1f]")

_NAMES_BETWEEN_BLANKS = re.compile(r"[^\s(\[]+(?:\s*[(\[][^)\]]*[)\]])?")


class Table(NamedTuple):
    """Content of a CSV file, in SI.

    Attributes:
        header: values of the lines ``# key: value``, by key, without units.
        columns: numbers of each column, by its name.
        lines: line number of each row, counted from 1.
        cells: the columns as they were written.
        factors: the value in SI of the unit of each column.
        units: the unit that stands behind the name of each column, or "".
        num_left_out: number of rows that were left out as they have no identity.
    """

    header: dict[str, str]
    columns: dict[str, Float[np.ndarray, "rows"]]
    lines: list[int]
    cells: dict[str, list[str]]
    factors: dict[str, float]
    units: dict[str, str]
    num_left_out: int

    def last_digits(self, name: str) -> Float[np.ndarray, "rows"]:
        """Return the last digit with which the numbers of a column were written, in SI.

        Zeros at the end may be missing: all numbers have as many decimals, or as many significant
        digits, as the one that has most of them.
        """
        places = np.array([_places(cell) for cell in self.cells[name]])
        decimals, first = places.T
        significant = np.max(decimals + first)
        return self.factors[name] * np.maximum(
            10.0 ** -np.max(decimals), 10.0 ** (first - significant)
        )


def read_text(path: Path, columns: str) -> str:
    """Return the text of a CSV file in UTF-8, UTF-16, UTF-32 or Latin-1, also compressed (.gz).

    Args:
        path: the file.
        columns: names of the columns that it should have, for the message.

    Raises:
        ValueError: if the file is empty or not a text file.
        OSError: if it cannot be read.
    """
    content = read_bytes(path)
    encoding = next((x for x, marks in _MARKS.items() if content.startswith(marks)), "utf-8-sig")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    if _BINARY.search(text):
        raise ValueError(
            f"not a text file but a binary one; give a CSV file with the columns {columns}, saved "
            "as UTF-8"
        )
    if not text.strip():
        raise ValueError(f"the file is empty; it needs the columns {columns}")
    return text


def read_table(
    path: Path,
    wanted: str,
    columns_to_read: Callable[[list[str]], Iterable[str]],
    given: dict[str, str],
    identities: Collection[str],
) -> Table:
    """Read header lines, a line of names, and rows of finite numbers.

    Args:
        path: the file.
        wanted: the names of its columns, for messages.
        columns_to_read: from the names of the columns without units, those whose numbers are read;
            raises ValueError for wrong names.
        given: entries of the header, with or without units, that replace entries of the file.
        identities: names of columns that identify particles: rows without a number there, as of
            particles that belong to no track, are left out.

    Raises:
        ValueError: saying what is wrong, in which line, and what to do.
        OSError: if the file cannot be read.
    """
    lines = _lines_of_text(read_text(path, wanted), wanted)
    header, usual = split_units(lines.header | with_usual_keys(given))
    units_of_rows, rows = _split_head_rows(lines.rows)
    names: list[str] = []
    units_given: dict[str, str] = {}
    for k, written in enumerate(lines.names):
        name, unit = _name_and_unit(written)
        names.append(name)
        units_given[name] = unit or units_of_rows.get(k, "")
    try:
        chosen = list(columns_to_read([name for name in names if name]))
    except ValueError as error:
        raise ValueError(f"line {lines.first}: {error}") from None
    if not rows:
        raise ValueError(f"line {lines.first}: no rows follow the names of the columns")
    units = Units(units_given, usual, "column")
    factors = {name: units.factor(name) for name in names}
    places = {name: names.index(name) for name in chosen}
    identity = [k for name, k in places.items() if name in identities]
    kept = {i: row for i, row in rows.items() if not _lacks(row, identity, len(names))}
    comma = _decimal_comma(kept, places.values(), lines.separator)
    values = [_numbers(i, row, places.values(), comma, lines) for i, row in kept.items()]
    columns = {}
    for name, numbers in zip(places, np.reshape(values, (len(kept), len(places))).T, strict=True):
        columns[name] = numbers * factors[name]
    try:
        columns |= _absolute_errors(columns, units)
    except ValueError as error:
        raise ValueError(f"line {lines.first}: {error}") from None
    return Table(
        header=convert_header(header, usual, comma=comma),
        columns=columns,
        lines=list(kept),
        cells={name: [row[k] for row in kept.values()] for name, k in places.items()},
        factors={name: factors[name] for name in places},
        units={name: units_given[name] for name in places},
        num_left_out=len(rows) - len(kept),
    )


class _Lines(NamedTuple):
    """Lines of a CSV file, before any number is read.

    Attributes:
        header: entries of the header lines, as written.
        names: of the columns, with their units.
        first: number of the line of names, counted from 1.
        separator: of the cells.
        rows: cells of the lines below the names, by line number.
    """

    header: dict[str, str]
    names: list[str]
    first: int
    separator: str
    rows: dict[int, list[str]]


def _lines_of_text(text: str, wanted: str) -> _Lines:
    header: dict[str, str] = {}
    names: list[str] = []
    rows: dict[int, list[str]] = {}
    separator = ""
    first = 0
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    for i, line in enumerate(lines, start=1):
        bare = line.strip(BLANKS)
        if bare[:1] and bare[0] in COMMENT_SIGNS:
            add_header_line(header, i, text_of_comment(line))
        elif bare and not names:
            if not re.match(r"[\w\"'.+-]", bare):
                raise ValueError(
                    f"line {i} begins with {bare[0]!r}: header lines and comments begin with # or %"
                )
            separator = next((mark for mark in SEPARATORS if mark in line), " ")
            first = i
            names = _names(i, line, separator, wanted)
        elif bare:
            rows[i] = _split(line, separator, len(names))
    if not names:
        raise ValueError(f"line {len(lines)}: the file ends without columns; it needs {wanted}")
    return _Lines(header, names, first, separator, rows)


def _lacks(row: list[str], places: list[int], length: int) -> bool:
    """Return whether a row of `length` cells has no number at one of some places."""
    return len(row) == length and any(row[k].lower() in NO_IDENTITY for k in places)


def _numbers(
    i: int, row: list[str], places: Collection[int], comma: bool, lines: _Lines
) -> list[float]:
    """Return the numbers of line i at some places.

    Raises:
        ValueError: for a row of another length, or a cell that is not a finite number.
    """
    names = lines.names
    if len(row) == len(names):
        numbers = [number_or_nan(row[k], comma) for k in places]
        if all(map(math.isfinite, numbers)):
            return numbers
    advice = "correct or remove this row"
    if any(map(contains_error, row)):
        advice = f"write errors into a column of their own, such as {names[-1]}_err"
    if len(row) > len(names) and lines.separator == ",":
        advice += "; if numbers have decimal commas, separate the columns by semicolons"
    raise ValueError(
        f"line {i}: expected {len(names)} finite numbers ({','.join(names)}) between "
        f"{SEPARATORS[lines.separator]}, got {lines.separator.join(row)!r}; {advice}"
    )


def _absolute_errors(columns: dict[str, np.ndarray], units: Units) -> dict[str, np.ndarray]:
    """Return the errors that are given as parts of their values, in units of the values."""
    absolute = {}
    for name in columns:
        if not units.is_relative(name):
            continue
        value = name.removesuffix("_err")
        if value not in columns:
            raise ValueError(
                f"{name} is a part of {value}, which is not among the columns: name it after its "
                "column, or give it in a unit"
            )
        absolute[name] = columns[name] * np.abs(columns[value])
    return absolute


def _names(i: int, line: str, separator: str, wanted: str) -> list[str]:
    """Return the names of the columns, with their units, from line i."""
    blanks = separator == " "
    names = _NAMES_BETWEEN_BLANKS.findall(line) if blanks else _split(line, separator, 0)
    if all(NUMBER.fullmatch(name) for name in names if name):
        raise ValueError(
            f"line {i}: numbers without names of the columns; add a line above them, without #, "
            f"such as {wanted}"
        )
    return names


def _split(line: str, separator: str, length: int) -> list[str]:
    """Return the cells of a line, without empty ones beyond a length, as spreadsheets add them."""
    cells = line.split()
    if separator != " ":
        try:
            (cells,) = csv.reader([line], delimiter=separator, skipinitialspace=True)
        except csv.Error as error:
            raise ValueError(f"a line that begins {line[:20]!r}: {error}") from None
    cells = [cell.strip(' \t"') for cell in cells]
    while len(cells) > length and not cells[-1]:
        cells.pop()
    return cells


def _decimal_comma(rows: dict[int, list[str]], places: Collection[int], separator: str) -> bool:
    """Return whether the numbers of some columns have decimal commas."""
    read = [(i, row[k]) for i, row in rows.items() for k in places if k < len(row)]
    comma = next(((i, cell) for i, cell in read if "," in cell), None)
    point = next(((i, cell) for i, cell in read if "." in cell), None)
    if comma is not None and (point is not None or separator == ","):
        other = f", and {point[1]!r} in line {point[0]} a point" if point else ""
        raise ValueError(
            f"line {comma[0]}: {comma[1]!r} has a comma{other}, between {SEPARATORS[separator]}: "
            "is it a decimal comma or a separator of thousands? Write decimal points alone, or "
            "decimal commas alone between semicolons"
        )
    return comma is not None


def _split_head_rows(
    rows: dict[int, list[str]],
) -> tuple[dict[int, str], dict[int, list[str]]]:
    """Return units in brackets, by the place of the column, and the rows below them.

    Rows of words below the names are units, and further names above a row of units, as TrackMate
    writes them.
    """
    units_of_rows = {}
    for i, row in rows.items():
        if any(NUMBER.fullmatch(cell) for cell in row):
            break
        units_of_rows[i] = _units_in_brackets(row)
    last = max((i for i, units in units_of_rows.items() if units), default=0)
    return units_of_rows.get(last, {}), {i: row for i, row in rows.items() if i > last}


def _units_in_brackets(row: list[str]) -> dict[int, str]:
    cells = {k: cell for k, cell in enumerate(row) if cell}
    if not cells or not all(cell[0] + cell[-1] in ("()", "[]") for cell in cells.values()):
        return {}
    return {k: cell[1:-1] for k, cell in cells.items()}


def _name_and_unit(name: str) -> tuple[str, str]:
    """Return the name of a column, or its usual name, and the unit that stands behind it."""
    match = NAME.fullmatch(name)
    if match is None:
        return name, ""
    bare = match["name"]
    stem = bare.lower().removesuffix("_err").removesuffix("_error")
    if stem in ALIASES:
        bare = ALIASES[stem] + ("_err" if "_err" in bare.lower() else "")
    return bare, match["bracket"] or match["slash"] or ""


def _places(cell: str) -> tuple[int, int]:
    """Return the number of decimals of a number, and the place of its first digit before them.

    Of 12.30 these are 2 and 2, of 0.0123 they are 4 and -1, of 1.2e-3 also 4 and -2.
    """
    mantissa, _, exponent = cell.lower().replace("d", "e").replace(",", ".").partition("e")
    whole, _, decimals = mantissa.strip("+-").partition(".")
    power = int(exponent or 0)
    digits = (whole + decimals).lstrip("0")
    return len(decimals) - power, len(digits) - len(decimals) + power
