"""Tables of numbers in CSV files, with a header."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.data.files import number_row, read_text


class Table(NamedTuple):
    """The content of a file.

    Attributes:
        header: values of its lines ``# key: value``.
        columns: their numbers by name.
        lines: where each row stands, counted from 1.
    """

    header: dict[str, str]
    columns: dict[str, Float[np.ndarray, "rows"]]
    lines: list[int]


def read_table(path: Path, wanted: str, check_names: Callable[[int, list[str]], None]) -> Table:
    """Read header lines ``# key: value``, a line of names, and rows of finite numbers.

    Args:
        path: the file.
        wanted: the names of its columns, for messages.
        check_names: is given the line of the names and the names, and raises ValueError.

    Raises:
        ValueError: saying what is wrong, in which line, and what to do.
    """
    header: dict[str, str] = {}
    names: list[str] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for i, line in enumerate(read_text(path, wanted).splitlines(), start=1):
        line = line.strip()
        if line.startswith("#"):
            key, colon, value = line[1:].partition(":")
            if colon:
                _add(path, i, header, key.strip(), value.strip())
        elif line and not names:
            names = [name.strip() for name in line.split(",")]
            check_names(i, names)
        elif line:
            rows.append(number_row(path, i, line, names))
            lines.append(i)
    values = np.array(rows, dtype=float).reshape(len(rows), len(names))
    return Table(header, dict(zip(names, values.T, strict=True)), lines)


def _add(path: Path, i: int, header: dict[str, str], key: str, value: str) -> None:
    if key in header:
        raise ValueError(
            f"{path}, line {i}: {key} is given again, as {value} after {header[key]}; remove one"
        )
    header[key] = value
