"""Files that the commands write, and header values given as arguments."""

import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxgran.data.curve_file import GAS_KEYS, PRIOR_KEYS
from jaxgran.data.scene_keys import ELEMENT_KEYS


def environment() -> dict:
    """Versions and device."""
    return {
        "versions": {name: version(name) for name in ("jaxgran", "jax", "diffrax", "optimistix")},
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }


def plain(rival) -> dict[str, Any]:
    """A rival as JSON has it."""
    fields = rival._asdict().items()
    return {key: x.tolist() if isinstance(x, np.ndarray) else x for key, x in fields}


def finite_or_null(value: Any) -> Any:
    """The same lists and dictionaries with None, which is null in JSON, for nan and inf."""
    if isinstance(value, dict):
        return {key: finite_or_null(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite_or_null(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def settings(pairs: list[str]) -> dict[str, str]:
    """Header values out of KEY=VALUE."""
    known = (*GAS_KEYS, "t0", *PRIOR_KEYS, *ELEMENT_KEYS, "N", "A", "dimension", "replicas")
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in known:
            raise ValueError(f"--set {pair}: give KEY=VALUE with KEY one of {', '.join(known)}")
        values[key] = value
    return values


def outputs(options: Any) -> tuple[Path, Path]:
    """Where to write; a new folder unless one is named, and nothing is written over unasked."""
    stem = f"{options.curve.stem}-{options.model}"
    folder = options.out
    if folder is None:
        folder, i = Path("results") / stem, 2
        while folder.exists():
            folder, i = Path("results") / f"{stem}-{i}", i + 1
    existing = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ValueError(f"{existing} is no folder to write to; name another --out")
    files = folder / f"{stem}.png", folder / f"{stem}.json"
    for file in files:
        if file.exists() and not options.overwrite:
            raise ValueError(f"{file} exists; name another --out or say --overwrite")
    return files
