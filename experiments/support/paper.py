"""Common parts of the scripts of the paper: options, timing, local slopes, result files."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import script_parser, write_picture, write_results
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


def run_parts(doc: str | None, parts: dict[str, Callable]) -> None:
    """Run the parts of a script that --only names, by default all, and write what they find.

    A part takes whether the run is a small one, and returns its picture, its settings and what it
    found, which are written to NAME.png and NAME.json.
    """
    parser = script_parser(doc, "paper")
    parser.add_argument("--only", nargs="+", choices=parts, default=list(parts))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for name in options.only:
        clock = Clock()
        figure, config, found = parts[name](options.smoke)
        write_picture(figure, name, options, DPI)
        results = {"config": config, "found": found, **clock.times}
        write_results(name, options, options.out / f"{name}.json", **results)
        print(f"{options.out / name}.png and .json, {sum(clock.times.values()):.0f} s")


@dataclass
class Compared:
    """A quantity of a gas over time: theory at many times, and DSMC at some.

    Attributes:
        tau, theory: times in mean free times, and kinetic theory there.
        where, local: midpoints of these times, and d ln theory / d ln t there.
        at, each: times of DSMC, and its values in each replica.
        mean, error: their mean and standard error.
        middle, exponent, exponent_error: midpoints of these times, local exponents and errors.
    """

    tau: np.ndarray
    theory: np.ndarray
    at: np.ndarray
    each: np.ndarray

    def __post_init__(self) -> None:
        self.mean, self.error = mean_and_error(self.each)
        self.where, self.local = slope(self.tau, self.theory)
        self.middle, exponents = slope(self.at, self.each)
        self.exponent, self.exponent_error = mean_and_error(exponents)

    @property
    def miss(self) -> np.ndarray:
        """Return DSMC over theory, minus 1."""
        return self.mean / np.exp(interpolate(self.at, self.tau, np.log(self.theory))) - 1

    def draw(
        self, values: Axes, exponents: Axes | None, color: str, label: str, of_exponents: str
    ) -> None:
        """Draw theory as a line and DSMC as points, and their local exponents."""
        style = {"fmt": "o", "ms": 3.5, "color": color}
        values.plot(self.tau, self.theory, color=color, label=label)
        values.errorbar(self.at, self.mean, self.error, **style)
        if exponents is not None:
            exponents.plot(self.where, self.local, color=color, label=of_exponents)
            exponents.errorbar(self.middle, self.exponent, self.exponent_error, **style)


def draw_forms(axes: Axes, of: Compared, forms: dict[str, tuple], powers: tuple[int, int]) -> dict:
    """Draw relative errors of closed forms, and return them at powers of ten, by the short label.

    Args:
        forms: values at the times of the theory, and line styles, by label.
        powers: the first power of ten, and the one after the last.
    """
    rows = {}
    for label, (values, style) in forms.items():
        miss = np.asarray(values) / of.theory - 1
        axes.plot(of.tau, miss, style, color=VISCOELASTIC, label=label)
        rows[label.split(":")[0].replace("$^2$", "^2")] = at_powers(*powers, of.tau, miss)
    return rows


def interpolate(x: Any, where: np.ndarray, values: np.ndarray) -> Any:
    """Interpolate linearly in ln x."""
    return np.interp(np.log(x), np.log(where), values)


def at_powers(first: int, last: int, where: np.ndarray, values: np.ndarray) -> dict[str, float]:
    """Return the values at powers of ten, from the first to before the last."""
    return {f"{10.0**k:g}": float(interpolate(10.0**k, where, values)) for k in range(first, last)}


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
