"""Pictures of recorded results: a dot for each row, with its range, and a reference line.

``python -m experiments.support.dot_plots`` draws them all; the entries of the gallery show them.
"""

import re
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments.support.plots import caption
from experiments.support.record import PICTURES, figures
from jaxgran.plotting import COLOURS, INK, colour_of

PLOTS: dict[str, tuple[Callable[[dict], Iterable["Dot"]], Callable[..., Figure]]] = {}
"""A function that gives the dots for recorded figures, and one that draws them, by the name of the
file of the figures; its last part is the name of the picture."""


class Dot(NamedTuple):
    """A row of a picture.

    Attributes:
        label: text to the left.
        value: position of the dot.
        low, high: ends of its bar; None for no bar.
        model: whose colour is used; by default the colour of measurements.
        hollow: whether it is of the second kind in the legend.
    """

    label: str
    value: float
    low: float | None = None
    high: float | None = None
    model: str = "measured"
    hollow: bool = False


def with_error(label: str, value: float, error: float | None, **kind: Any) -> Dot:
    ends = (None, None) if error is None else (value - error, value + error)
    return Dot(label, value, *ends, **kind)


def named(model: str) -> str:
    """Return the name of a model in the pictures, from that in the figures."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|-", " ", model).lower()
    return {"dsmc": "DSMC"}.get(words, words if words in COLOURS else model)


def drawn(
    dots: Iterable[Dot],
    axis: str,
    reference: Any = None,
    logarithmic: bool = False,
    kinds: Any = (),
) -> Figure:
    """Draw dots from top to bottom.

    Args:
        dots: dots with the same label share a line.
        axis: label of the axis.
        reference: position and label of a vertical line; None for no line.
        logarithmic: whether the axis is logarithmic.
        kinds: legend of full and of hollow dots; () if there is one kind only.
    """
    dots = list(dots)
    labels = list(dict.fromkeys(dot.label for dot in dots))
    figure = Figure(figsize=(7.0, 1.1 + 0.27 * len(labels)), layout="constrained")
    axes = figure.subplots()
    for dot in dots:
        y, colour = labels.index(dot.label), colour_of(dot.model)
        if dot.low is not None and dot.high is not None:
            axes.plot([dot.low, dot.high], [y, y], color=colour, lw=1.4, zorder=2)
        face = "white" if dot.hollow else colour
        axes.plot(dot.value, y, "s" if dot.hollow else "o", color=colour, mfc=face, ms=6, zorder=3)
    if reference is not None:
        at, words = reference
        axes.axvline(at, color=COLOURS["guide"], ls="--", lw=1, zorder=1)
        style = {"ha": "center", "va": "bottom", "fontsize": 8, "clip_on": False}
        axes.text(at, -0.75, words, color=COLOURS["guide"], **style)
    if logarithmic:
        axes.set_xscale("log")
    axes.set_yticks(range(len(labels)), labels, fontsize=8)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.tick_params(axis="x", labelsize=8)
    caption(axes, legend="none", xlabel=axis)
    if kinds:
        for words, marker, face in zip(kinds, "os", (INK, "white"), strict=True):
            axes.plot([], [], marker, color=INK, mfc=face, ms=6, label=words)
        figure.legend(loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    return figure


def picture(axis: str, reference: Any = None, of_rows: bool = True, **options: Any) -> Callable:
    """Add a function to `PLOTS` that gives dots of each row of the figures, or of all figures."""

    def add(function: Callable[[dict], Iterable[Dot]]) -> Callable:
        def dots(found: dict) -> Iterable[Dot]:
            return [dot for row in found["rows"] for dot in function(row)]

        draw = partial(drawn, axis=axis, reference=reference, **options)
        PLOTS[function.__name__] = dots if of_rows else function, draw
        return function

    return add


@picture("A over the true A (bar: median range)", (1.0, ""), logarithmic=True)
def wrong_physics(row: dict) -> Iterable[Dot]:
    low, high = (None if end is None else max(end, 0.01) for end in row["range"])
    yield Dot(f"{row['name']}; told: {row['told']}", row["A"], low, high)


@picture("runs whose 95 % interval contains A, %", (95.0, "95 %"))
def interval_coverage(row: dict) -> Iterable[Dot]:
    share, model = row["coverage"], named(row["model"])
    label = f"{model}, N = {row['num_particles']}, φ = {row['phi']:g}"
    error = 100 * (share * (1 - share) / row["runs"]) ** 0.5
    yield with_error(label, 100 * share, error, model=model)


SEARCHES = ("with derivatives", "without")


@picture("simulations until A is known to 2 %", logarithmic=True, kinds=SEARCHES)
def fit_head_to_head(row: dict) -> Iterable[Dot]:
    model = named(row["scene"].replace("stochastic", "dsmc"))
    free, search = ("A", "A and T₀")[len(row["free"]) - 1], row["search"]
    if row["simulations"]:
        hollow = "jaxgran" not in search
        yield Dot(f"{model}, {free}: {search}", row["simulations"], model=model, hollow=hollow)


CLAIMS = ("agrees within its accuracy", "the paper's is corrected")


@picture("measured value over the paper's value", (1.0, "as printed"), kinds=CLAIMS)
def paper_claims(row: dict) -> Iterable[Dot]:
    for words, ratio, error in row["ratios"]:
        label = words if row["equation"] == "text" else f"Eq. {row['equation']}: {words}"
        yield with_error(label, ratio, error, hollow=row["verdict"] == "corrected")


@picture("seconds", of_rows=False, logarithmic=True, kinds=("jaxgran", "SciPy"))
def benchmark_kinetic_theory(found: dict) -> Iterable[Dot]:
    sweep, slope = found["sweep"], found["derivative"]
    seconds = {
        "one curve": slope["solve_ms"] / 1e3,
        "its derivative, forward": slope["forward_ms"] / 1e3,
        "its derivative, reverse": slope["reverse_ms"] / 1e3,
        f"{sweep['num_curves']} curves, vmap": sweep["vmap_run_s"],
        f"{sweep['num_curves']} curves, SciPy LSODA": sweep["scipy_s"],
    }
    for name, x in seconds.items():
        yield Dot(name, x, model="kinetic theory", hollow="SciPy" in name)


@picture("collisions per second on two CPU devices, over one core", (1.0, "one core"))
def benchmark_replicas(row: dict) -> Iterable[Dot]:
    yield Dot(named(row["model"]), row["ratio"], model=named(row["model"]))


@picture("microseconds per collision, 10⁶ disks (or half of them)", logarithmic=True)
def benchmark_million(row: dict) -> Iterable[Dot]:
    for case in ("one core", "two cores", "half on one core", "two devices"):
        if case in row:
            model, took = named(row["model"]), row[case]["s_per_collision"]
            yield Dot(f"{model}, {case}", 1e6 * took, model=model)


@picture("seconds", of_rows=False, logarithmic=True, kinds=("first run", "again"))
def benchmark_compilation(found: dict) -> Iterable[Dot]:
    rows = found["rows"] | {"jaxgran fit, each in a new process": found["main_job"]}
    for name, row in rows.items():
        first, *more = name.split(" ", 1)
        model = "kinetic theory" if first == "jaxgran" else named(first)
        dot = Dot(" ".join([named(first), *more]), row["first_s"], model=model)
        yield from (dot, dot._replace(value=row["again_s"], hollow=True))


@picture("collisions per second", logarithmic=True)
def benchmark_dsmc(row: dict) -> Iterable[Dot]:
    yield Dot(f"N = {row['num_particles']}", row["collisions_per_s"], model="DSMC")


OVER_LAMMPS = "collisions per second, over those of LAMMPS on one core"


@picture(OVER_LAMMPS, (1.0, "LAMMPS"), logarithmic=True)
def benchmark_hard_spheres(row: dict) -> Iterable[Dot]:
    if row["lammps"]:
        label, ratio = f"N = {row['num_particles']}", row["lammps"]["ratio"]
        yield Dot(label, ratio, model="hard spheres")


@picture(OVER_LAMMPS, (1.0, "LAMMPS"), logarithmic=True)
def benchmark_particles(row: dict) -> Iterable[Dot]:
    label = f"N = {row['num_particles']}, t_c/τ_c = {row['contact_fraction']:g}"
    yield Dot(label, row["lammps"]["1"]["ratio"], model="soft spheres")


@picture("time over that of the plain run", (1.0, "plain run"))
def benchmark_derivatives(row: dict) -> Iterable[Dot]:
    model, *scene = row["title"].split(", ")
    for way, cost in row["ways"].items():
        if way != "plain":
            label = ", ".join([named(model), *scene, way])
            yield Dot(label, cost["ratio"], model=named(model))


CONTACTS = ("per collision of particles", "per contact, walls included")


@picture("time over that of the smooth gas", (1.0, "smooth"), kinds=CONTACTS)
def benchmark_elements(row: dict) -> Iterable[Dot]:
    if row["scene"] != "smooth":
        model, ratio, of_contacts = named(row["model"]), row["ratio"], row["ratio_of_contacts"]
        dot = Dot(f"{model}, {row['scene']}", ratio, model=model)
        yield dot
        if of_contacts != ratio:
            yield dot._replace(value=of_contacts, hollow=True)


@picture("time now over time before", (1.0, "no change"))
def benchmark_versions(row: dict) -> Iterable[Dot]:
    what, *first = row["model"].split(", ")
    is_slope = what in ("forward", "reverse")
    model = "kinetic theory" if is_slope else named(what)
    label = ", ".join([f"{model}, {what} derivative" if is_slope else model, *first])
    yield with_error(label, row["ratio"], row["error"], model=model)


ALLOWED = "error over the error allowed: median and range of the rows"


@picture(ALLOWED, (1.0, "allowed"), of_rows=False, logarithmic=True)
def hard_cases(found: dict) -> Iterable[Dot]:
    shares: dict[str, list[float]] = {}
    for row in found["rows"]:
        shares.setdefault(row["case"], []).append(max(row["error"] / row["allowed"], 1e-8))
    for name, x in shares.items():
        yield Dot(name, float(np.median(x)), min(x), max(x))


PLOTS["tests/hard_cases"] = PLOTS.pop("hard_cases")


def main() -> None:
    """Draw all pictures."""
    for name, (dots, draw) in PLOTS.items():
        draw(dots(figures(name))).savefig(PICTURES / f"{Path(name).name}.png", dpi=110)


if __name__ == "__main__":
    main()
