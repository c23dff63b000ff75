"""Reading and atomic writing of files."""

import errno
import gzip
import os
import shutil
import uuid
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

MAX_BYTES = 2**30
"""Largest size of a file, unpacked."""


def checked_path(path: Any, kind: str) -> Path:
    """Return the path of a file; raise ValueError if it is not the name of a file."""
    if not isinstance(path, str | Path):
        raise ValueError(f"path must be the name of a file, got {path!r:.60}; give {kind}")
    return Path(path)


@contextmanager
def name_in_errors(path: Path) -> Iterator[None]:
    """Name a file in the errors of reading it, all of which become ValueError."""
    try:
        yield
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except IsADirectoryError:
        raise ValueError(f"{path}: not a text file but a folder; name a file") from None
    except (EOFError, gzip.BadGzipFile, zlib.error):
        raise ValueError(f"{path}: an incomplete or damaged .gz file; pack it again") from None
    except PermissionError as error:
        raise ValueError(f"{path}: {error.strerror}; check its permissions") from None
    except UnicodeDecodeError:
        raise ValueError(f"{path}: not a text file; GSD files end in .gsd") from None
    except (ValueError, OSError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from None


def read_bytes(path: Path) -> bytes:
    """Return the content of a file, unpacked if its name ends in .gz.

    Raises:
        ValueError: for more than `MAX_BYTES`.
    """
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"it has more than {MAX_BYTES:g} bytes; keep fewer times or columns")
    return content


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
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}")
    try:
        with temporary.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        if target.exists():
            shutil.copymode(target, temporary)
        os.replace(temporary, target)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if not isinstance(error, OSError):
            raise
        raise OSError(
            error.errno,
            f"could not write ({error.strerror}); an existing file was not changed",
            str(path),
        ) from error


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
