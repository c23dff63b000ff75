"""Common parts of the scripts of the paper: options, timing, local slopes, result files."""

import argparse
import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import add_recording, write_picture, write_results
from jaxgran.plotting import COLOURS

INK, GUIDE, ELASTIC = (COLOURS[name] for name in ("measured", "guide", "elastic"))
CONSTANT, VISCOELASTIC = (COLOURS[name] for name in ("constant restitution", "viscoelastic"))
DPI = 110


class Clock:
    """Wall time since the clock was created, and the part that JAX spent on compilation."""

    def __init__(self) -> None:
        self.begin, self.compile_s = time.perf_counter(), 0.0
        jax.monitoring.register_event_duration_secs_listener(self._hear)

    def _hear(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event.endswith(("backend_compile_duration", "jaxpr_to_mlir_module_duration")):
            self.compile_s += duration_secs

    @property
    def times(self) -> dict[str, float]:
        """Return the seconds of compilation and of the rest."""
        whole = time.perf_counter() - self.begin
        return {"compile_s": self.compile_s, "run_s": whole - self.compile_s}


def options(doc: str | None, name: str) -> argparse.Namespace:
    """Parse --smoke and --out, which all these scripts take, and switch float64 on."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, default=Path("results") / name)
    add_recording(parser)
    jax.config.update("jax_enable_x64", True)
    return parser.parse_args()


def write(
    figure: Figure,
    options: argparse.Namespace,
    name: str,
    config: Any,
    clock: Clock,
    **found: Any,
) -> None:
    """Write the picture and its data as JSON, and print the paths."""
    folder = options.out
    write_picture(figure, name, options, DPI)
    results = {"config": asdict(config), "found": found, **clock.times}
    write_results(name, options, folder / f"{name}.json", **results)
    print(f"{folder / name}.png and .json, {sum(clock.times.values()):.0f} s")


def figure(title: str, columns: int, rows: int = 1) -> Figure:
    """Return a figure with a title and panels; `Figure.axes` are the panels, row by row."""
    made = Figure(figsize=(4.6 * columns, 0.4 + 4.0 * rows), layout="constrained")
    made.suptitle(title, color=INK)
    made.subplots(rows, columns)
    return made


def from_here(inside: np.ndarray, x: np.ndarray) -> float:
    """Return the first x after which `inside` is always true; nan if the last is false."""
    outside = np.flatnonzero(~inside)
    start = outside[-1] + 1 if outside.size else 0
    return float(x[start]) if start < x.size else float("nan")


def slope(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return midpoints between neighbouring x, and d ln y / d ln x there, on the last axis."""
    x, y = np.log(x), np.log(y)
    return np.exp((x[1:] + x[:-1]) / 2), np.diff(y) / np.diff(x)


def mean_and_error(each: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over the replicas, the first axis, and its standard error."""
    return each.mean(axis=0), each.std(axis=0, ddof=1) / len(each) ** 0.5


def replicas_of(curve: jaxgran.CoolingCurve, name: str) -> np.ndarray:
    """Return a quantity of each replica, shape (replicas, times)."""
    assert curve.replicas is not None
    return np.asarray(getattr(curve.replicas, name))


def caption(axes: Axes, title: str, **settings: Any) -> None:
    """Give a panel its title, labels and legend."""
    axes.set(**settings)
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, frameon=True, framealpha=0.85, edgecolor="none")


def listed(values: Iterable[Any]) -> list[float]:
    """Return a list of floats, for JSON."""
    return [float(x) for x in values]


def alike(gas: jaxgran.Gas) -> float:
    """Return the constant restitution with the initial cooling rate of this Maxwellian gas."""
    rate = jaxgran.KineticTheory().cooling_rate(gas) / gas.collision_frequency
    return float((1 - gas.dimension * rate) ** 0.5)
