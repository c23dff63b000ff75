"""Timing of experiments, and files of their results."""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import jax

from jaxgran.data.files import write_whole

PACKAGES = ("jaxgran", "jax", "jax-md", "diffrax", "optimistix", "vesin", "numpy", "scipy")


def seconds(run: Callable, repeats: int = 3) -> tuple[float, float]:
    """Seconds of compilation (the first call less a later one), and the median of later calls."""
    took = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        jax.block_until_ready(run())
        took.append(time.perf_counter() - begin)
    run_time = statistics.median(took[1:])
    return max(took[0] - run_time, 0.0), run_time


def save(path: Path, **figures) -> None:
    """Write results as JSON, with the versions of the packages and the device that made them.

    The file is replaced as a whole; if that fails, an older file is unchanged and an OSError names
    the path.
    """
    made_by = {
        "versions": {name: found for name in PACKAGES if (found := _version(name))},
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(figures | made_by, indent=2) + "\n"
    write_whole(path, lambda f: f.write(text.encode()))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
