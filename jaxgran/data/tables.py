"""CSV tables as people write them: encodings, separators, decimal commas, units, header lines.

A table has header lines ``# key: value``, a line with the names of the columns, and rows of
numbers. Units in names, as ``T (mm^2/s^2)``, in header values, as ``diameter: 2 mm``, and in the
header keys length_unit, time_unit and speed_unit are converted to SI by pint.
"""

import codecs
import csv
import math
import re
from collections.abc import Callable, Collection, Iterable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.data.files import read_bytes
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

HEADER_ALIASES = {
    **dict.fromkeys(("phi", "packing_fraction"), "eta"),
    **dict.fromkeys(("phi_err", "packing_fraction_err"), "eta_err"),
}
"""Further names of header keys."""

ANGLES = ("deg", "degree", "degrees", "°", "rad", "mrad")
"""Units of angles: an error in one of them is not relative, unlike an error in %."""

COMMENT_SIGNS = "#%"
"""Signs at the beginning of header lines and comments."""

BLANKS = ' "\t,;|'
"""Characters without meaning at both ends of a line."""

ALIASES = {
    "time": "t",
    **{quantity.field: quantity.column for quantity in QUANTITIES.values()},
    **{name: name for name in ("id", "particle", "track_id", "frame", "x", "y", "z")},
    **{f"position_{name}": name for name in "xyzt"},
    **dict.fromkeys(("total_energy", "trakineticenergy", "ene_kin", "kineng"), "total_energy"),
}
"""Further names of columns, in any case."""

SEPARATORS = {"\t": "tabs", ";": "semicolons", ",": "commas", "|": "bars", " ": "blanks"}

NO_IDENTITY = ("", "none", "nan")
"""Cells, in small letters, of a particle that belongs to no track."""

MAX_UNIT = 60
"""Largest number of characters of a unit."""

_MARKS = {
    "utf-32": (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE),
    "utf-16": (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE),
}
_BINARY = re.compile(r"[\x00-\x08\x0e-\x1f]")
_NAME = re.compile(r"(?P<name>\w+)\s*(?:[(\[](?P<bracket>.*)[)\]]|/\s*(?P<slash>.+))?")
_NAMES_BETWEEN_BLANKS = re.compile(r"[^\s(\[]+(?:\s*[(\[][^)\]]*[)\]])?")
_DIGITS = r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eEdD][+-]?\d+)?"
_NUMBER = re.compile(_DIGITS)
_NUMBER_AND_UNIT = re.compile(rf"({_DIGITS})\s*(.*)")
_SIDES = re.compile(rf"{_DIGITS}(?:\s*[x×]\s*{_DIGITS})*")
_PLUS_MINUS = re.compile(r"\s*(?:±|\+/?-)\s*")
_BRACKETED = re.compile(r"\(([^()]*)\)(.*)")
_DIGITS_IN_BRACKETS = re.compile(r"([+-]?\d*[.,]?\d*)\s*\((\d+)\)((?:[eEdD][+-]?\d+)?)(.*)")
_POWER = re.compile(r"\^(?:-?\d|\(-?\d\))(?![\d.^])")


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
    header: dict[str, str] = {}
    names: list[str] = []
    rows: dict[int, list[str]] = {}
    separator = ""
    first = 0
    text = read_text(path, wanted).replace("\r\n", "\n").replace("\r", "\n")
    for i, line in enumerate(text.split("\n"), start=1):
        bare = line.strip(BLANKS)
        if bare[:1] and bare[0] in COMMENT_SIGNS:
            _add_header_line(header, i, text_of_comment(line))
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
        raise ValueError(f"line {i}: the file ends without columns; it needs {wanted}")
    header |= _with_usual_keys(given)
    units = _pop_units(header)
    units_of_rows = _pop_head_rows(rows, names)
    bare_names = []
    units_given = {}
    for k, name in enumerate(names):
        bare, unit = _name_and_unit(name)
        bare_names.append(bare)
        units_given[bare] = unit or units_of_rows.get(k, "")
    try:
        chosen = list(columns_to_read([name for name in bare_names if name]))
    except ValueError as error:
        raise ValueError(f"line {first}: {error}") from None
    if not rows:
        raise ValueError(f"line {first}: no rows follow the names of the columns")
    factors = [_factor(name, units_given, units, "column") for name in bare_names]
    at = [bare_names.index(name) for name in chosen]
    without = _pop_rows_without_identity(
        rows, [k for k in at if bare_names[k] in identities], len(names)
    )
    comma = _decimal_comma(rows, at, separator)
    values = []
    for i, row in rows.items():
        values.append(
            [_number(row[k], comma) for k in at] if len(row) == len(names) else [math.nan]
        )
        if not all(map(math.isfinite, values[-1])):
            advice = "correct or remove this row"
            if any(_PLUS_MINUS.search(cell) or _DIGITS_IN_BRACKETS.fullmatch(cell) for cell in row):
                advice = f"write errors into a column of their own, such as {names[-1]}_err"
            if len(row) > len(names) and separator == ",":
                advice += "; if numbers have decimal commas, separate the columns by semicolons"
            raise ValueError(
                f"line {i}: expected {len(names)} finite numbers ({','.join(names)}) between "
                f"{SEPARATORS[separator]}, got {separator.join(row)!r}; {advice}"
            )
    numbers = np.reshape(values, (len(rows), len(at))).T * np.array([[factors[k]] for k in at])
    columns = dict(zip(chosen, numbers, strict=True))
    for name in chosen:
        if _is_relative(name, units_given):
            value = name.removesuffix("_err")
            if value not in columns:
                raise ValueError(
                    f"line {first}: {name} is a part of {value}, which is not among the columns: "
                    "name it after its column, or give it in a unit"
                )
            columns[name] = columns[name] * np.abs(columns[value])
    return Table(
        _convert_header(header, units, comma),
        columns,
        list(rows),
        {name: [row[k] for row in rows.values()] for name, k in zip(chosen, at, strict=True)},
        {name: factors[k] for name, k in zip(chosen, at, strict=True)},
        {name: units_given[name] for name in chosen},
        without,
    )


def _pop_rows_without_identity(rows: dict[int, list[str]], at: list[int], length: int) -> int:
    """Remove rows of `length` cells with no number in the columns `at`; return how many."""
    without = [
        i
        for i, row in rows.items()
        if len(row) == length and any(row[k].lower() in NO_IDENTITY for k in at)
    ]
    for i in without:
        rows.pop(i)
    return len(without)


def _places(cell: str) -> tuple[int, int]:
    """Return the number of decimals of a number, and the place of its first digit before them.

    Of 12.30 these are 2 and 2, of 0.0123 they are 4 and -1, of 1.2e-3 also 4 and -2.
    """
    mantissa, _, exponent = cell.lower().replace("d", "e").replace(",", ".").partition("e")
    whole, _, decimals = mantissa.strip("+-").partition(".")
    power = int(exponent or 0)
    digits = (whole + decimals).lstrip("0")
    return len(decimals) - power, len(digits) - len(decimals) + power


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


def _names(i: int, line: str, separator: str, wanted: str) -> list[str]:
    """Return the names of the columns, with their units, from line i."""
    blanks = separator == " "
    names = _NAMES_BETWEEN_BLANKS.findall(line) if blanks else _split(line, separator, 0)
    if all(_NUMBER.fullmatch(name) for name in names if name):
        raise ValueError(
            f"line {i}: numbers without names of the columns; add a line above them, without #, "
            f"such as {wanted}"
        )
    return names


def _decimal_comma(rows: dict[int, list[str]], at: list[int], separator: str) -> bool:
    """Return whether the numbers of some columns have decimal commas."""
    read = [(i, row[k]) for i, row in rows.items() for k in at if k < len(row)]
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


def _pop_head_rows(rows: dict[int, list[str]], names: list[str]) -> dict[int, str]:
    """Remove rows of words below the names; return units in brackets, by the place of the column.

    Such rows are units, and further names above a row of units, as TrackMate writes them.
    """
    head = []
    for i, row in rows.items():
        if any(_NUMBER.fullmatch(cell) for cell in row):
            break
        head.append(i)
    found = [(i, _units_in_brackets(rows[i])) for i in head]
    last = max((i for i, units in found if units), default=0)
    for i in head:
        if i <= last:
            rows.pop(i)
    return dict(found).get(last, {})


def _units_in_brackets(row: list[str]) -> dict[int, str]:
    cells = {k: cell for k, cell in enumerate(row) if cell}
    if not cells or not all(cell[0] + cell[-1] in ("()", "[]") for cell in cells.values()):
        return {}
    return {k: cell[1:-1] for k, cell in cells.items()}


def _plain_number(text: str, comma: bool) -> str:
    """Return a number with a decimal point and the exponent e; other text unchanged."""
    if not _NUMBER.fullmatch(text) or ("," in text and not comma):
        return text
    return re.sub("[dD]", "e", text.replace(",", "."))


def _number(text: str, comma: bool) -> float:
    """Return a number of a cell, or nan for other text."""
    try:
        return math.nan if "_" in text else float(text)
    except ValueError:
        plain = _plain_number(text, comma)
        return math.nan if plain == text else float(plain)


def text_of_comment(line: str) -> str:
    """Return a comment without its sign, and without separators and quotes at its ends."""
    return line.strip(BLANKS).lstrip(COMMENT_SIGNS + " ").rstrip("# ")


def header_entry(line: str) -> tuple[str, str] | None:
    """Return key and value of ``key: value``, or ``key = value`` if the key is one word."""
    match = re.match("([^:=]*)([:=])(.*)", line)
    if match is None:
        return None
    key, mark, value = (part.strip() for part in match.groups())
    name = _NAME.fullmatch(key)
    if name is not None and _base_unit(name["name"], HEADER_UNITS) is not None:
        unit = name["bracket"] or name["slash"]
        return name["name"], f"{value} {unit}" if unit else value
    return None if mark == "=" and name is None else (key, value)


def _add_header_line(header: dict[str, str], i: int, line: str) -> None:
    """Add a line that is an entry; skip other comments, and sentences that begin alike."""
    key, value = header_entry(line) or ("", "")
    key = HEADER_ALIASES.get(key, key)
    if key and key not in header:
        header[key] = value
    elif key and _NAME.fullmatch(key):
        raise ValueError(
            f"line {i}: {key} is given again, as {value} after {header[key]}; remove one"
        )


def _with_usual_keys(header: dict[str, str]) -> dict[str, str]:
    return {HEADER_ALIASES.get(key, key): value for key, value in header.items()}


def _base_unit(name: str, units: dict[str, str] = UNITS) -> str | None:
    """Return the SI unit of a column or header key, also of a standard error; None if unknown."""
    return units.get(name.removesuffix("_err"))


def _pop_units(header: dict[str, str]) -> dict[str, str]:
    """Remove the header keys of units; return the unit of numbers without one, by its SI unit."""
    speed_given = "speed_unit" in header
    units_given = {key: header.pop(key, unit) for key, unit in UNIT_KEYS.items()}
    for key in units_given:
        _factor(key, units_given, {}, "header line")
    length, time, speed = units_given.values()
    if not speed_given:
        speed = f"{length}/{time}"
    return {
        "m": length,
        "m^2": f"{length}^2",
        "s": time,
        "1/s": f"1/{time}",
        "m/s": speed,
        "m^2/s^2": f"({speed})^2",
        "m^2/s": f"{length}^2/{time}",
        "m^2/s^3": f"({speed})^2/{time}",
    }


def header_in_si(header: dict[str, str]) -> dict[str, str]:
    """Return a header whose numbers are in SI, without units; other text is unchanged.

    Args:
        header: values with or without a unit behind them, as "2 mm", and possibly the keys
            length_unit, time_unit and speed_unit.

    Raises:
        ValueError: for a unit that is not known, or not one of the key.

    >>> from jaxgran.data.tables import header_in_si
    >>> header_in_si({"diameter": "2 mm", "eta": "0.05"})
    {'diameter': '0.002', 'eta': '0.05'}
    """
    header = _with_usual_keys(header)
    return _convert_header(header, _pop_units(header), comma=False)


def _convert_header(header: dict[str, str], units: dict[str, str], comma: bool) -> dict[str, str]:
    header = _with_own_errors(header)
    parts: dict[str, tuple[str, str]] = {}
    for key, text in header.items():
        match = (_SIDES if key == "container_side" else _NUMBER).match(text)
        if match is not None:
            parts[key] = match[0], text[match.end() :].strip()
    units_given = {key: unit for key, (_, unit) in parts.items()}
    converted = dict(header)
    for key, (text, unit) in parts.items():
        if unit and _base_unit(key, HEADER_UNITS) is None:
            continue
        numbers = [_plain_number(part.strip(), comma) for part in re.split("[x×]", text)]
        if any("," in number for number in numbers):
            continue
        factor = _factor(key, units_given, units, "header line")
        if factor != 1:
            numbers = [repr(factor * float(number)) for number in numbers]
        converted[key] = " x ".join(numbers)
    for key in parts:
        if _base_unit(key, HEADER_UNITS) is None or not _is_relative(key, units_given):
            continue
        value_key = key.removesuffix("_err")
        if value_key == "T_scale":  # whose error is a part of it
            continue
        if value_key not in converted:
            raise ValueError(
                f"header line {key} is a part of {value_key}, which the header lacks: add "
                f"{value_key}, or give the error in a unit"
            )
        value = converted[value_key]
        if _NUMBER.fullmatch(value):
            converted[key] = repr(float(converted[key]) * abs(float(value)))
    return converted


def _with_own_errors(header: dict[str, str]) -> dict[str, str]:
    """Return a header in which errors that stand behind values have keys of their own."""
    split = dict(header)
    for key, text in header.items():
        if _base_unit(key, HEADER_UNITS) is None:
            continue
        value, error = _value_and_error(text)
        if error and f"{key}_err" in header:
            raise ValueError(f"header line {key}: {text!r} gives {key}_err again; remove one")
        if error:
            split |= {key: value, f"{key}_err": error}
    if "T_scale" in split and "T_scale_err" not in header:
        split |= _relative_error_of_scale(split)
    return split


def _relative_error_of_scale(header: dict[str, str]) -> dict[str, str]:
    """Return the error behind T_scale as `T_scale_err`, which is a part of it."""
    error = header.get("T_scale_err", "")
    if not (_NUMBER.fullmatch(error) and _NUMBER.fullmatch(header["T_scale"])):
        return {}
    return {"T_scale_err": repr(float(error) / abs(float(header["T_scale"])))}


def _value_and_error(text: str) -> tuple[str, str]:
    """Return a value and its error, "" if it has none, of "3.00 ± 0.05 mm" or "3.00(5) mm".

    >>> from jaxgran.data.tables import _value_and_error
    >>> _value_and_error("3.00(5) mm"), _value_and_error("0.04 +- 5 %")
    (('3.00 mm', '0.05 mm'), ('0.04', '5 %'))
    """
    if digits := _DIGITS_IN_BRACKETS.fullmatch(text):
        number, error, exponent, unit = digits.groups()
        decimals = len(re.split("[.,]", number)[1]) if re.search("[.,]", number) else 0
        error = f"{int(error) * 10.0**-decimals:.{decimals}f}"
        return f"{number}{exponent}{unit}", f"{error}{exponent}{unit}"
    behind = ""
    if (bracketed := _BRACKETED.fullmatch(text)) and _PLUS_MINUS.search(bracketed[1]):
        text = bracketed[1].strip()
        behind = f" {bracketed[2].strip()}"
    parts = _PLUS_MINUS.split(text)
    numbers = [_NUMBER_AND_UNIT.fullmatch(part) for part in parts]
    if len(parts) != 2 or not all(numbers):
        return text, ""
    (value, unit), (error, unit_of_error) = (m.groups() for m in numbers if m)
    if not behind and not _is_dimensionless(unit_of_error):
        unit = unit or unit_of_error
    unit = unit or behind
    return f"{value} {unit}".strip(), f"{error} {unit_of_error or unit}".strip()


def _is_dimensionless(unit: str) -> bool:
    """Return whether a text is a unit without a dimension, such as %."""
    try:
        return bool(unit) and unit != "1" and unit_in(unit, "1") != 1
    except Exception:  # see `_factor`
        return False


def _is_relative(name: str, units_given: dict[str, str]) -> bool:
    """Return whether a standard error is a part of its value, as one in % is.

    It is not if the value has the same unit.
    """
    unit = units_given.get(name, "")
    value = units_given.get(name.removesuffix("_err"), "")
    if not name.endswith("_err") or unit == value or unit in ANGLES:
        return False
    return _is_dimensionless(unit)


def _name_and_unit(name: str) -> tuple[str, str]:
    """Return the name of a column, or its usual name, and the unit that stands behind it."""
    match = _NAME.fullmatch(name)
    if match is None:
        return name, ""
    bare = match["name"]
    stem = bare.lower().removesuffix("_err").removesuffix("_error")
    if stem in ALIASES:
        bare = ALIASES[stem] + ("_err" if "_err" in bare.lower() else "")
    return bare, match["bracket"] or match["slash"] or ""


def _factor(name: str, units_given: dict[str, str], units: dict[str, str], kind: str) -> float:
    """Return the value in SI of the unit of a name.

    Args:
        name: of a column or a header key; an error without a unit has the unit of its value.
        units_given: the units that stand behind names.
        units: the units of other numbers, by SI unit.
        kind: of the name, for messages.
    """
    base = _base_unit(name)
    if base is None:
        return 1.0
    # Frames are counted per second in files whose times are in ms, too.
    inherited = base if name == "frame_rate" else units.get(base, base)
    unit = units_given[name] or units_given.get(name.removesuffix("_err")) or inherited
    if _is_relative(name, units_given):
        return unit_in(unit, "1")
    if unit in (base, base.replace("m^2/s^2", "(m/s)^2")):
        return 1.0
    try:
        return unit_in(unit, base)
    except UnitError as error:
        raise ValueError(f"{kind} {name}: {error}") from None
    except Exception:  # pint raises errors of many types for text that is not a unit
        advice = f"write a unit such as {base}, or leave it out"
        if base == "m^2/s^2":
            advice = "T is <v^2>/d, in m^2/s^2: multiply kelvin by 1.38e-23 J/K over the mass"
        raise ValueError(
            f"{kind} {name}: {unit!r} is not known as a unit of {base}; {advice}"
        ) from None


class UnitError(ValueError):
    """A unit that is refused for a reason of its own."""


def unit_in(unit: str, base: str) -> float:
    """Return the value of a unit in terms of another one.

    >>> from jaxgran.data.tables import unit_in
    >>> unit_in("g/cm^3", "kg/m^3")
    1000.0
    """
    text = re.sub(r"([A-Za-z])(\d)", r"\1^\2", unit.replace("**", "^"))
    if len(text) > MAX_UNIT or "^" in _POWER.sub("", text):
        raise UnitError(f"{unit!r} is not a unit of {base}: powers have one digit")
    parsed = _units().parse_units(text)
    if "pixel" in str(parsed):  # which pint takes for 1/96 inch
        raise UnitError(f"{unit!r} is not a unit of {base}: multiply by the metres of one pixel")
    factor = _units().Quantity(1.0, parsed).to("" if base == "1" else base).magnitude
    return float(f"{factor:.15g}")  # without the rounding errors of several factors


@cache
def _units() -> Any:
    """Return pint's table of units, which takes half a second to load."""
    import pint

    return pint.UnitRegistry()
