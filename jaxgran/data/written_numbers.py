"""Numbers as people write them: with decimal commas, exponents by d, and errors behind them."""

import math
import re

DIGITS = r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eEdD][+-]?\d+)?"

NUMBER = re.compile(DIGITS)
"""A number without an error, with a decimal point or comma."""

PLUS_MINUS = re.compile(r"\s*(?:±|\+/?-)\s*")
"""Sign between a value and its error."""

DIGITS_IN_BRACKETS = re.compile(r"([+-]?\d*[.,]?\d*)\s*\((\d+)\)((?:[eEdD][+-]?\d+)?)(.*)")
"""A value with the error of its last digits in brackets, an exponent and a unit."""


def plain_number(text: str, comma: bool) -> str:
    """Return a number with a decimal point and the exponent e; other text unchanged."""
    if not NUMBER.fullmatch(text) or ("," in text and not comma):
        return text
    return re.sub("[dD]", "e", text.replace(",", "."))


def number_or_nan(text: str, comma: bool) -> float:
    """Return a number of a cell, or nan for other text."""
    try:
        return math.nan if "_" in text else float(text)
    except ValueError:
        plain = plain_number(text, comma)
        return math.nan if plain == text else float(plain)


def contains_error(text: str) -> bool:
    """Return whether a number is written with its error, as "3.00 ± 0.05" or "3.00(5)"."""
    return bool(PLUS_MINUS.search(text) or DIGITS_IN_BRACKETS.fullmatch(text))
