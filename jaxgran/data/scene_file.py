"""TOML files of a scene, which may describe a planned experiment in a table [experiment]."""

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxgran._utils.validation import POSITIVE, Domain, checked_float, checked_int, checked_times
from jaxgran.data.header_lines import header_in_si
from jaxgran.data.tables import read_text

EXPERIMENT = "experiment"
"""Name of the table of a planned experiment."""

ERROR_KEYS = {
    "T_err": "temperature",
    "T_rot_err": "rotational_temperature",
    "msd_err": "displacement",
}
"""Keys of relative errors, and the fields of a curve."""

COUNT_KEYS = ("N", "replicas", "absent")
"""Keys of the experiment that a header has, too."""

LIST_SEPARATORS = {"container_side": " x ", "absent": ", "}
"""Keys whose values may be lists, and what separates the elements in a header."""

PLANNED_ERRORS = Domain(0.0, 1.0)
"""Range of the relative errors of a planned experiment."""

HOW_TO_GIVE_TIMES = "times = [0.1, 0.3, 1.0] or times = {number = 30, first = 0.1, last = 10.0}"
"""Advice in messages."""

MAX_TIMES = 100_000
"""Largest number of times of a planned experiment."""


class Experiment(NamedTuple):
    """A planned experiment.

    Attributes:
        times: s.
        errors: relative errors, by field of a curve.
    """

    times: np.ndarray
    errors: dict[str, float]


def read_scene_file(path: Path) -> tuple[dict[str, str], Experiment | None]:
    """Return the header of a scene, in SI, and the planned experiment, if the file has one.

    The header contains N, replicas and absent of the experiment, too.

    Args:
        path: of a TOML file of lines such as ``eta = 0.05``.

    Raises:
        ValueError: for a file that is not TOML, or has other tables, or values that are no text or
            number.
    """
    try:
        values = tomllib.loads(read_text(path, "eta, diameter, ..."))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not TOML ({error}). Write lines such as eta = 0.05.") from None
    table = values.pop(EXPERIMENT, None)
    if tables := [key for key, value in values.items() if isinstance(value, dict)]:
        raise ValueError(
            f"[{tables[0]}] is not read: write all keys without tables, as container_side "
            f"and wall_restitution for walls, before a table [{EXPERIMENT}]"
        )
    experiment = None
    if table is not None:
        if not isinstance(table, dict):
            raise ValueError(f"{EXPERIMENT} must be a table [{EXPERIMENT}], got {table!r:.60}")
        if both := [key for key in COUNT_KEYS if key in table and key in values]:
            raise ValueError(f"{both[0]} stands before [{EXPERIMENT}] and in it: keep one")
        values |= {key: table.pop(key) for key in COUNT_KEYS if key in table}
        experiment = _experiment(table)
    return header_in_si({key: _text(key, value) for key, value in values.items()}), experiment


def _text(key: str, value: Any) -> str:
    """Return a value as the text of a header."""
    parts = value if isinstance(value, list) and key in LIST_SEPARATORS else [value]
    if not all(type(part) in (str, int, float) for part in parts):
        raise ValueError(f"{key} must be one number or text, got {value!r:.60}")
    return LIST_SEPARATORS.get(key, "").join(map(str, parts))


def _experiment(table: dict[str, Any]) -> Experiment:
    """Return a planned experiment, without its `COUNT_KEYS`, after a check of all entries."""
    known = ("times", *ERROR_KEYS)
    if unknown := [key for key in table if key not in known]:
        allowed = ", ".join((*known, *COUNT_KEYS))
        raise ValueError(f"[{EXPERIMENT}] {unknown[0]} is not known: give some of {allowed}")
    if "times" not in table:
        raise ValueError(f"[{EXPERIMENT}] has no times: give {HOW_TO_GIVE_TIMES}")
    advice = "It is relative: 0.02 is 2 %."
    errors = {
        field: checked_float(key, table[key], PLANNED_ERRORS, advice)
        for key, field in ERROR_KEYS.items()
        if key in table
    }
    return Experiment(_times(table["times"]), errors)


def _times(times: Any) -> np.ndarray:
    """Return the times of a planned experiment, s.

    Args:
        times: a list, or {number, first, last}: a number of times with equal distances of their
            logarithms.
    """
    if isinstance(times, list):
        return np.asarray(checked_times(times))
    if not isinstance(times, dict) or {*times} != {"number", "first", "last"}:
        raise ValueError(f"[{EXPERIMENT}] times: give {HOW_TO_GIVE_TIMES}, got {times!r:.80}")
    number = checked_int("number of times", times["number"], 2)
    if number > MAX_TIMES:
        raise ValueError(f"number of times must be at most {MAX_TIMES}, got {number}")
    first = checked_float("first of times", times["first"], POSITIVE, "Give it in s.")
    last = checked_float("last of times", times["last"], POSITIVE, "Give it in s.")
    if not first < last:
        raise ValueError(f"times: last must lie after first, got first {first:g}, last {last:g}")
    return np.geomspace(first, last, number)
