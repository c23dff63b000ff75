"""Atomic writing of files."""

import errno
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


def write_whole(path: str | Path, write: Callable[[Any], Any]) -> None:
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
            error.errno, f"cannot write ({error.strerror}); any earlier file is unharmed", str(path)
        ) from error


def _permissions(path: Path) -> int:
    """The permissions of a file, or those of a new one."""
    try:
        return stat.S_IMODE(path.stat().st_mode)
    except OSError:
        mask = os.umask(0)
        os.umask(mask)
        return 0o666 & ~mask


def check_writable(path: str | Path) -> None:
    """Check that a file could be written, before a long run whose result it is to hold.

    Raises:
        OSError: naming the path, if its folder does not exist or cannot be written to, or if it is
            a folder itself.
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


def read_text(path: Path, columns: str) -> str:
    """The text of a CSV file; ValueError if it cannot be read, is empty or is no text.

    Args:
        path: the file.
        columns: that it should have, for the message.
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
    """The numbers of line i; ValueError unless there is a finite one for each column."""
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
