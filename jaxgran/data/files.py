"""Atomic writing of files."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any


def write_whole(path: str | Path, write: Callable[[Any], Any]) -> None:
    """Write a file atomically: it replaces `path` only once it is complete.

    Args:
        path: the file; an existing one is replaced.
        write: writes the content to a binary file that is open for writing.

    Raises:
        OSError: naming the path, if it cannot be written; an existing file is then unchanged.
    """
    path = Path(path)
    name = None
    try:
        with tempfile.NamedTemporaryFile(
            dir=path.parent, prefix=f".{path.name}.", delete=False
        ) as f:
            name = f.name
            write(f)
            f.flush()
            os.fsync(f.fileno())
        os.replace(name, path)
    except BaseException as error:
        if name is not None:
            Path(name).unlink(missing_ok=True)
        if not isinstance(error, OSError):
            raise
        raise OSError(
            error.errno, f"cannot write ({error.strerror}); any earlier file is unharmed", str(path)
        ) from error
