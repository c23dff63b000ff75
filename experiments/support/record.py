"""Timing of experiments, files of their results, and the figures that the documents quote.

A script run with ``--record`` writes its results to ``experiments/figures/NAME.json``, with the
version, the date, the machine and the precision of the run. The documents are generated from these
files only (``python experiments/documents.py``).
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
    """Return seconds of compilation (first call less a later one) and the median of later calls."""
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
        "--record", action="store_true", help="write the figures and pictures of the documents"
    )


def script_parser(doc: str | None, name: str, smoke: bool = True) -> argparse.ArgumentParser:
    """Return a parser with --smoke, --record and --out, a folder, by default ``results/NAME``."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if smoke:
        parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, default=Path("results") / name)
    add_recording(parser)
    return parser


def write_results(name: str, options: argparse.Namespace, path: Path | None, **results) -> None:
    """Write results to `path`, if there is one, and with --record to ``figures/NAME.json``.

    Raises:
        SystemExit: for --record with --smoke, since smoke runs are too small for the documents.
    """
    if path is not None:
        save(path, **results)
    if options.record:
        if getattr(options, "smoke", False):
            raise SystemExit("A smoke run is too small for the documents. Leave out --record.")
        save(FIGURES / f"{name}.json", **results)
        print(f"recorded in experiments/figures/{name}.json: run python experiments/documents.py")


def write_picture(figure: Any, name: str, options: argparse.Namespace, dpi: int = 130) -> None:
    """Write a picture to the folder --out, and with --record to ``pictures/NAME.png`` too."""
    for folder in [options.out, *([PICTURES] if options.record else [])]:
        folder.mkdir(parents=True, exist_ok=True)
        figure.savefig(folder / f"{name}.png", dpi=dpi)


def figures(name: str) -> dict[str, Any]:
    """Return the last recorded results of the script of this name."""
    return json.loads((FIGURES / f"{name}.json").read_text(encoding="utf-8"))


def save(path: Path, **results) -> None:
    """Write results as JSON, with versions, date, machine, precision and seconds of the run.

    If writing fails, an older file is unchanged and an OSError names the path.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"made_by": made_by()} | results, indent=1) + "\n"
    write_atomically(path, lambda f: f.write(text.encode()))


def made_by() -> dict[str, Any]:
    """Return version, date, machine, precision, seconds since the script began, and packages."""
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
