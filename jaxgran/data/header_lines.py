"""Header lines ``# key: value`` of files, whose values may have units and errors behind them."""

import re

from jaxgran.data.units import HEADER_UNITS, NAME, UNIT_KEYS, Units, base_unit, is_dimensionless
from jaxgran.data.written_numbers import (
    DIGITS,
    DIGITS_IN_BRACKETS,
    NUMBER,
    PLUS_MINUS,
    plain_number,
)

HEADER_ALIASES = {
    **dict.fromkeys(("phi", "packing_fraction"), "eta"),
    **dict.fromkeys(("phi_err", "packing_fraction_err"), "eta_err"),
}
"""Further names of header keys."""

COMMENT_SIGNS = "#%"
"""Signs at the beginning of header lines and comments."""

BLANKS = ' "\t,;|'
"""Characters without meaning at both ends of a line."""

RELATIVE_ERRORS = ("T_scale",)
"""Header keys whose standard errors are parts of their values."""

HEADER_LINE = "header line"
"""What a header key is called in messages."""

_NUMBER_AND_UNIT = re.compile(rf"({DIGITS})\s*(.*)")

_SIDES = re.compile(rf"{DIGITS}(?:\s*[x×]\s*{DIGITS})*")

_BRACKETED = re.compile(r"\(([^()]*)\)(.*)")


def header_in_si(header: dict[str, str]) -> dict[str, str]:
    """Return a header whose numbers are in SI, without units; other text is unchanged.

    Args:
        header: values with or without a unit behind them, as "2 mm", and possibly the keys
            length_unit, time_unit and speed_unit.

    Raises:
        ValueError: for a unit that is not known, or not one of the key.

    >>> from jaxgran.data.header_lines import header_in_si
    >>> header_in_si({"diameter": "2 mm", "eta": "0.05"})
    {'diameter': '0.002', 'eta': '0.05'}
    """
    entries, usual = split_units(with_usual_keys(header))
    return convert_header(entries, usual, comma=False)


def with_usual_keys(header: dict[str, str]) -> dict[str, str]:
    """Return a header in which keys have their usual names: see `HEADER_ALIASES`."""
    return {HEADER_ALIASES.get(key, key): value for key, value in header.items()}


def split_units(header: dict[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return a header without its keys of units, and the unit of numbers without one.

    The latter are by SI unit.

    Raises:
        ValueError: for a unit that is not known, or not one of the key.
    """
    given = {key: header.get(key, unit) for key, unit in UNIT_KEYS.items()}
    units = Units(given, {}, HEADER_LINE)
    for key in given:
        units.factor(key)  # raises for an unknown unit
    length = given["length_unit"]
    time = given["time_unit"]
    speed = given["speed_unit"] if "speed_unit" in header else f"{length}/{time}"
    usual = {
        "m": length,
        "m^2": f"{length}^2",
        "s": time,
        "1/s": f"1/{time}",
        "m/s": speed,
        "m^2/s^2": f"({speed})^2",
        "m^2/s": f"{length}^2/{time}",
        "m^2/s^3": f"({speed})^2/{time}",
    }
    return {key: value for key, value in header.items() if key not in UNIT_KEYS}, usual


def convert_header(header: dict[str, str], usual: dict[str, str], *, comma: bool) -> dict[str, str]:
    """Return a header whose numbers are in SI, and whose errors have keys of their own.

    Args:
        header: without keys of units.
        usual: the unit of numbers without one, by SI unit: see `split_units`.
        comma: whether numbers may have decimal commas.
    """
    converted = _with_own_errors(header)
    numbers: dict[str, str] = {}
    given: dict[str, str] = {}
    for key, text in converted.items():
        match = (_SIDES if key == "container_side" else NUMBER).match(text)
        if match is not None:
            numbers[key] = match[0]
            given[key] = text[match.end() :].strip()
    units = Units(given, usual, HEADER_LINE)
    for key, text in numbers.items():
        if given[key] and base_unit(key, HEADER_UNITS) is None:
            continue  # a comment that begins with a number, as "2 cameras"
        plain = [plain_number(part.strip(), comma) for part in re.split("[x×]", text)]
        if any("," in number for number in plain):
            continue  # text: numbers have no decimal commas here
        factor = units.factor(key)
        if factor != 1:
            plain = [repr(factor * float(number)) for number in plain]
        converted[key] = " x ".join(plain)
    return converted | _absolute_errors(converted, units)


def _absolute_errors(header: dict[str, str], units: Units) -> dict[str, str]:
    """Return the errors that a header gives as parts of their values, in units of the values."""
    absolute = {}
    for key in units.given:
        if base_unit(key, HEADER_UNITS) is None or not units.is_relative(key):
            continue
        value_key = key.removesuffix("_err")
        if value_key in RELATIVE_ERRORS:
            continue
        if value_key not in header:
            raise ValueError(
                f"header line {key} is a part of {value_key}, which the header lacks: add "
                f"{value_key}, or give the error in a unit"
            )
        value = header[value_key]
        if NUMBER.fullmatch(value):
            absolute[key] = repr(float(header[key]) * abs(float(value)))
    return absolute


def _with_own_errors(header: dict[str, str]) -> dict[str, str]:
    """Return a header in which errors that stand behind values have keys of their own."""
    split = dict(header)
    for key, text in header.items():
        if base_unit(key, HEADER_UNITS) is None:
            continue
        value, error = _value_and_error(text)
        if error and f"{key}_err" in header:
            raise ValueError(f"header line {key}: {text!r} gives {key}_err again; remove one")
        if error:
            if key in RELATIVE_ERRORS:
                error = _as_part_of(key, value, error)
            split |= {key: value, f"{key}_err": error}
    return split


def _as_part_of(key: str, value: str, error: str) -> str:
    """Return an error as a part of the value of a key; unchanged if it has a unit such as %."""
    numbers = [plain_number(text, comma=True) for text in (value, error)]
    if not all(map(NUMBER.fullmatch, numbers)):
        return error
    of_value, of_error = map(float, numbers)
    if of_value == 0:
        raise ValueError(f"header line {key}: the value must not be 0, got {value}")
    return repr(of_error / abs(of_value))


def _value_and_error(text: str) -> tuple[str, str]:
    """Return a value and its error, "" if it has none, of "3.00 ± 0.05 mm" or "3.00(5) mm".

    >>> from jaxgran.data.header_lines import _value_and_error
    >>> _value_and_error("3.00(5) mm"), _value_and_error("0.04 +- 5 %")
    (('3.00 mm', '0.05 mm'), ('0.04', '5 %'))
    """
    match = DIGITS_IN_BRACKETS.fullmatch(text)
    if match is None:
        return _around_plus_minus(text)
    return _with_last_digits(*match.groups())


def _with_last_digits(number: str, error: str, exponent: str, unit: str) -> tuple[str, str]:
    """Return value and error of a number and the error of its last digits."""
    decimals = len(re.split("[.,]", number)[1]) if re.search("[.,]", number) else 0
    error = f"{int(error) * 10.0**-decimals:.{decimals}f}"
    return f"{number}{exponent}{unit}", f"{error}{exponent}{unit}"


def _around_plus_minus(text: str) -> tuple[str, str]:
    """Return the value and the error around a sign ±, both of which may be in brackets."""
    behind = ""
    if (bracketed := _BRACKETED.fullmatch(text)) and PLUS_MINUS.search(bracketed[1]):
        text = bracketed[1].strip()
        behind = f" {bracketed[2].strip()}"
    parts = PLUS_MINUS.split(text)
    numbers = [_NUMBER_AND_UNIT.fullmatch(part) for part in parts]
    if len(parts) != 2 or not all(numbers):
        return text, ""
    (value, unit), (error, unit_of_error) = (m.groups() for m in numbers if m)
    if not behind and not is_dimensionless(unit_of_error):
        unit = unit or unit_of_error
    unit = unit or behind
    return f"{value} {unit}".strip(), f"{error} {unit_of_error or unit}".strip()


def add_header_line(header: dict[str, str], i: int, line: str) -> None:
    """Add line i to a header if it is an entry; skip other comments.

    Raise for a key that is given twice; skip a comment of several words before the colon that was
    read before.
    """
    key, value = header_entry(line) or ("", "")
    key = HEADER_ALIASES.get(key, key)
    if key and key not in header:
        header[key] = value
    elif key and NAME.fullmatch(key):
        raise ValueError(
            f"line {i}: {key} is given again, as {value} after {header[key]}; remove one"
        )


def header_entry(line: str) -> tuple[str, str] | None:
    """Return key and value of ``key: value``, or ``key = value`` if the key is one word."""
    match = re.match("([^:=]*)([:=])(.*)", line)
    if match is None:
        return None
    key, mark, value = (part.strip() for part in match.groups())
    name = NAME.fullmatch(key)
    if name is None:
        return None if mark == "=" else (key, value)
    if base_unit(name["name"], HEADER_UNITS) is None:
        return key, value
    unit = name["bracket"] or name["slash"]
    if unit:
        value = f"{value} {unit}"
    return name["name"], value


def text_of_comment(line: str) -> str:
    """Return a comment without its sign, and without separators and quotes at its ends."""
    return line.strip(BLANKS).lstrip(COMMENT_SIGNS + " ").rstrip("# ")
