"""Atomic writing of files, and reading of CSV files whose header lines hold values."""

import errno
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float


def write_atomically(path: str | Path, write: Callable[[Any], Any]) -> None:
    """Write a file atomically: it replaces `path` only once it is complete.

    An existing file keeps its permissions, a new one gets those that the user gives new files. A
    symbolic link is followed.

    Args:
        path: the file; an existing one is replaced.
        write: writes the content to a binary file that is open for writing.

    Raises:
        OSError: naming the path, if it cannot be written; an existing file is then unchanged.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    name = None
    try:
        with tempfile.NamedTemporaryFile(
            dir=target.parent, prefix=f".{target.name}.", delete=False
        ) as f:
            name = f.name
            write(f)
            f.flush()
            os.chmod(name, _permissions(target))
            os.fsync(f.fileno())
        os.replace(name, target)
    except BaseException as error:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise OSError(
            error.errno,
            f"could not write ({error.strerror}); an existing file was not changed",
            str(path),
        ) from error


def _permissions(path: Path) -> int:
    """Return the permissions of a file, or those of a new one."""
    try:
        return stat.S_IMODE(path.stat().st_mode)
    except OSError:
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def check_writable(path: str | Path) -> None:
    """Check that a file can be written, before a long run that ends with writing it.

    Raises:
        OSError: naming the path, if its folder does not exist or is not writable, or if it is a
            folder itself.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        code = errno.EISDIR
    elif not target.parent.is_dir():
        code = errno.ENOENT
    elif not os.access(target.parent, os.W_OK):
        code = errno.EACCES
    else:
        return
    raise OSError(code, f"cannot write ({os.strerror(code)}); name another file", str(path))


MAX_COUNT = 10**12
"""Largest whole number in a header."""


def header_number(header: dict[str, str], key: str) -> float:
    """Return the value of a key in the header of a curve, as a number.

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
    """Return the value of a key in the header of a curve, such as N, as a positive whole number.

    Returns:
        The number, or None if there is no such key.

    Raises:
        ValueError: if the value is not a positive whole number.
    """
    if key not in header:
        return None
    number = header_number(header, key)
    if not (1 <= number <= MAX_COUNT and number.is_integer()):
        raise ValueError(
            f"header line {key}: must be a whole number from 1 to {MAX_COUNT:g}, got "
            f"{header[key]!r}"
        )
    return int(number)


def read_text(path: Path, columns: str) -> str:
    """Return the text of a CSV file.

    Args:
        path: the file.
        columns: names of the columns that it should have, for the message.

    Raises:
        ValueError: if the file cannot be read, is empty or is no text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets begin with a byte-order mark
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except (UnicodeDecodeError, IsADirectoryError):
        raise ValueError(
            f"{path}: not a text file; give a CSV file with the columns {columns}"
        ) from None
    except OSError as error:
        raise ValueError(
            f"{path}: cannot be read ({error.strerror}); check its permissions"
        ) from None
    if "\x00" in text:
        raise ValueError(f"{path}: a binary file; give a CSV file with the columns {columns}")
    if not text.strip():
        raise ValueError(f"{path}: the file is empty; it needs the columns {columns}")
    return text


def number_row(path: Path, i: int, line: str, names: list[str]) -> list[float]:
    """Return the numbers of line i; raise ValueError unless each column has a finite one."""
    cells = line.split(",")
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != len(names) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"{path}, line {i}: expected {len(names)} finite numbers ({','.join(names)}), "
            f"got {line!r}; correct or remove this row"
        )
    return values


class Table(NamedTuple):
    """Content of a CSV file.

    Attributes:
        header: values of the lines ``# key: value``, by key.
        columns: numbers of each column, by its name.
        lines: line number of each row, counted from 1.
    """

    header: dict[str, str]
    columns: dict[str, Float[np.ndarray, "rows"]]
    lines: list[int]


def read_table(path: Path, wanted: str, check_names: Callable[[int, list[str]], None]) -> Table:
    """Read header lines ``# key: value``, a line of names, and rows of finite numbers.

    Args:
        path: the file.
        wanted: the names of its columns, for messages.
        check_names: raises ValueError for wrong names; its arguments are their line and the names.

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
                _add_header_line(path, i, header, key.strip(), value.strip())
        elif line and not names:
            names = [name.strip() for name in line.split(",")]
            check_names(i, names)
        elif line:
            rows.append(number_row(path, i, line, names))
            lines.append(i)
    values = np.array(rows, dtype=float).reshape(len(rows), len(names))
    return Table(header, dict(zip(names, values.T, strict=True)), lines)


def _add_header_line(path: Path, i: int, header: dict[str, str], key: str, value: str) -> None:
    if key in header:
        raise ValueError(
            f"{path}, line {i}: {key} is given again, as {value} after {header[key]}; remove one"
        )
    header[key] = value
