"""npz files of cooling curves: every array of a curve, and the header as JSON."""

import io
import json
import zipfile
import zlib
from math import prod
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxgran.data import files
from jaxgran.data.curve import CoolingCurve, from_arrays
from jaxgran.data.curve_arrays import to_arrays
from jaxgran.data.header import checked_header

ARCHIVE_SUFFIX = ".npz"
"""Suffix of files that hold every array of a curve."""

HEADER_ENTRY = "header"
"""Entry of an npz file that holds the header, as JSON; all others are arrays."""


def write_archive(path: Path, curve: CoolingCurve, header: dict[str, str]) -> None:
    """Write all arrays of a curve, and a header, to an npz file."""
    arrays: dict[str, Any] = {name: np.asarray(x) for name, x in to_arrays(curve).items()}
    arrays[HEADER_ENTRY] = np.array(json.dumps(header))
    files.write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def read_archive(path: Path) -> tuple[CoolingCurve, dict[str, str]]:
    """Return the curve and the header of a file that `write_archive` wrote.

    Raises:
        ValueError: for another file.
    """
    content = io.BytesIO(files.read_bytes(path))
    try:
        _check_sizes(content)
        content.seek(0)
        with np.load(content, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = checked_header(json.loads(str(arrays.pop(HEADER_ENTRY))))
        return from_arrays({name: jnp.asarray(x) for name, x in arrays.items()}), header
    except (
        OSError,
        EOFError,
        ValueError,
        KeyError,
        TypeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ValueError(
            f"not a file that this version of jaxgran.write_curve wrote ({error}); give such a "
            "file, or a CSV file"
        ) from None


def _check_sizes(content: io.BytesIO) -> None:
    """Raise ValueError for an array larger than its entry of an npz file, or too much in all."""
    with zipfile.ZipFile(content) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > files.MAX_BYTES:
            raise ValueError(f"more than {files.MAX_BYTES:g} bytes unpacked")
        for entry in archive.infolist():
            with archive.open(entry) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0
                read = read if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
            if prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} is shorter than its header says")
