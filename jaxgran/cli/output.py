"""What several commands do with the files that they write."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np


def check_new(file: Path, overwrite: bool) -> None:
    """Raise ValueError if a file exists that may not be replaced."""
    if file.exists() and not overwrite:
        raise ValueError(f"{file} exists. Name another --out, or add --overwrite.")


def title_of(path: Path) -> str:
    """Return the title of what a file holds: its name in words."""
    return path.stem.replace("_", " ")


def list_written(files: Sequence[Path]) -> str:
    """Return lines that name the files which a command has written."""
    return "written  " + "\n         ".join(map(str, files))


def as_json(value: Any) -> Any:
    """Return dictionaries and lists as JSON takes them: lists for arrays, None for nan and inf."""
    if isinstance(value, dict):
        return {key: as_json(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        value = np.asarray(value).tolist()
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
