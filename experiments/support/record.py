"""Timing of experiments, files of their results, and the figures that the documents quote.

A script run with ``--record`` writes what it found to ``experiments/figures/NAME.json``, beside
the version, the date, the machine and the precision that made it. The documents are made from
these files (``python experiments/documents.py``) and from nothing else.
"""

import argparse
import datetime
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

from jaxgran.data.files import write_atomically

EXPERIMENTS = Path(__file__).parents[1]
DATA = EXPERIMENTS / "data"
PICTURES = EXPERIMENTS / "pictures"
FIGURES = EXPERIMENTS / "figures"
PACKAGES = ("jaxgran", "jax", "jax-md", "diffrax", "optimistix", "numpy", "scipy")
COUNTS = {1: "one", 2: "two", 4: "four", 8: "eight", 16: "sixteen"}
BEGAN = time.perf_counter()


def seconds(run: Callable, repeats: int = 3) -> tuple[float, float]:
    """Seconds of compilation (the first call less a later one), and the median of later calls."""
    took = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        jax.block_until_ready(run())
        took.append(time.perf_counter() - begin)
    run_time = statistics.median(took[1:])
    return max(took[0] - run_time, 0.0), run_time


def add_recording(parser: argparse.ArgumentParser) -> None:
    """Give a script the option --record."""
    parser.add_argument(
        "--record", action="store_true", help="write the figures that the documents quote"
    )


def write_results(name: str, options: argparse.Namespace, path: Path | None, **results) -> None:
    """Write results to `path`, if there is one, and with --record to ``figures/NAME.json``.

    Raises:
        SystemExit: for --record with --smoke, whose figures no document may quote.
    """
    if path is not None:
        save(path, **results)
    if options.record:
        if getattr(options, "smoke", False):
            raise SystemExit("a smoke run is too small for the documents: leave out --record")
        save(FIGURES / f"{name}.json", **results)
        print(f"recorded in experiments/figures/{name}.json: run python experiments/documents.py")


def write_picture(figure: Any, name: str, options: argparse.Namespace, dpi: int = 130) -> None:
    """Write a picture to the folder --out, and with --record to ``pictures/NAME.png`` too."""
    for folder in [options.out, *([PICTURES] if options.record else [])]:
        folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(folder / f"{name}.png", dpi=dpi)


def figures(name: str) -> dict[str, Any]:
    """What the script of this name recorded last."""
    return json.loads((FIGURES / f"{name}.json").read_text(encoding="utf-8"))


def save(path: Path, **results) -> None:
    """Write results as JSON, with what made them: versions, date, machine, precision, seconds.

    The file is replaced as a whole; if that fails, an older file is unchanged and an OSError names
    the path.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"made_by": made_by()} | results, indent=1) + "\n"
    write_atomically(path, lambda f: f.write(text.encode()))


def made_by() -> dict[str, Any]:
    """Version, date, machine and precision in words, seconds since the script began, packages."""
    device = jax.devices()[0]
    cores = os.cpu_count() or 1
    of_cores = f"{COUNTS.get(cores, cores)}-core CPU"
    return {
        "version": version("jaxgran"),
        "date": datetime.date.today().isoformat(),
        "machine": of_cores if device.platform == "cpu" else f"{device.device_kind}, {of_cores}",
        "precision": "float64" if jax.config.read("jax_enable_x64") else "float32",
        "seconds": round(time.perf_counter() - BEGAN, 1),
        "python": platform.python_version(),
        "packages": {name: found for name in PACKAGES if (found := _version(name))},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
