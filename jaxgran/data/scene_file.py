"""TOML files of a scene, which may describe a planned experiment in a table [experiment]."""

import tomllib
from pathlib import Path
from typing import Any

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

RELATIVE_ERRORS = Domain(0.0, 1.0)

HOW_TO_GIVE_TIMES = "times = [0.1, 0.3, 1.0] or times = {number = 30, first = 0.1, last = 10.0}"


def read_scene_file(path: Path) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the header of a scene, in SI, and the table of a planned experiment.

    Args:
        path: of a TOML file of lines such as ``eta = 0.05``.

    Returns:
        The entries, among them N, replicas and absent of the experiment; the other entries of the
        experiment, {} without one.

    Raises:
        ValueError: for a file that is not TOML, or has other tables.
    """
    try:
        values = tomllib.loads(read_text(path, "eta, diameter, ..."))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not TOML ({error}). Write lines such as eta = 0.05.") from None
    experiment = values.pop(EXPERIMENT, {})
    if tables := [key for key, value in values.items() if isinstance(value, dict)]:
        raise ValueError(
            f"[{tables[0]}] is not read: write all keys without tables, as container_side "
            f"and wall_restitution for walls, before a table [{EXPERIMENT}]"
        )
    if not isinstance(experiment, dict):
        raise ValueError(f"{EXPERIMENT} must be a table [{EXPERIMENT}], got {experiment!r:.60}")
    of_experiment = {key: experiment.pop(key) for key in COUNT_KEYS if key in experiment}
    if both := [key for key in of_experiment if key in values]:
        raise ValueError(f"{both[0]} stands before [{EXPERIMENT}] and in it: keep one")
    values |= of_experiment
    texts = {key: _text(key, value) for key, value in values.items()}
    return header_in_si(texts), experiment


def _text(key: str, value: Any) -> str:
    """Return a value as the text of a header."""
    if not isinstance(value, list):
        return str(value)
    return (", " if key == "absent" else " x ").join(map(str, value))


MAX_TIMES = 100_000
"""Largest number of times of a planned experiment."""


def times_of(experiment: dict[str, Any]) -> np.ndarray:
    """Return the times of a planned experiment, s.

    Args:
        experiment: its ``times`` are a list, or {number, first, last}: a number of times with equal
            distances of their logarithms.

    Raises:
        ValueError: for other times, or numbers out of their range.
    """
    if "times" not in experiment:
        raise ValueError(f"[{EXPERIMENT}] has no times: give {HOW_TO_GIVE_TIMES}")
    times = experiment["times"]
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


def errors_of(experiment: dict[str, Any]) -> dict[str, float]:
    """Return the relative errors of a planned experiment, by field of a curve.

    Raises:
        ValueError: for errors outside of 0 to 1, or unknown keys.
    """
    known = ("times", *ERROR_KEYS)
    if unknown := [key for key in experiment if key not in known]:
        allowed = ", ".join((*known, *COUNT_KEYS))
        raise ValueError(f"[{EXPERIMENT}] {unknown[0]} is not known: give some of {allowed}")
    advice = "It is relative: 0.02 is 2 %."
    return {
        field: checked_float(key, experiment[key], RELATIVE_ERRORS, advice)
        for key, field in ERROR_KEYS.items()
        if key in experiment
    }
