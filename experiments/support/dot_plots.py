"""Pictures of recorded figures: a dot for each row, with its range, and a reference line.

``python experiments/documents.py --pictures`` draws them all; the entries of the gallery show them.
"""

import re
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments.support.plots import caption
from jaxgran.plotting import COLOURS, INK, colour_of


class Dot(NamedTuple):
    """A row of a picture.

    Attributes:
        label: text to the left.
        value: position of the dot.
        low, high: ends of its bar; None for no bar.
        model: model whose colour is used; "" for the colour of measurements.
        hollow: whether it is of the second kind in the legend.
    """

    label: str
    value: float
    low: float | None = None
    high: float | None = None
    model: str = ""
    hollow: bool = False


class DotPlot(NamedTuple):
    """A picture of dots.

    Attributes:
        dots: from top to bottom; dots with the same label share a line.
        axis: label of the axis.
        reference: position and label of a vertical line; None for no line.
        logarithmic: whether the axis is logarithmic.
        kinds: legend of full and hollow dots; "" if there is one kind only.
    """

    dots: list[Dot]
    axis: str
    reference: tuple[float, str] | None = None
    logarithmic: bool = False
    kinds: tuple[str, str] = ("", "")


def named(model: str) -> str:
    """Return the name of a model in the pictures, from that in the figures."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])|-", " ", model).lower()
    return {"dsmc": "DSMC"}.get(words, words if words in COLOURS else model)


def dots_of(rows: list[dict], label: str, value: str, model: str = "") -> list[Dot]:
    """Return a dot for each row: label and model are formats of the fields of the row."""
    rows = [{key: named(x) if isinstance(x, str) else x for key, x in row.items()} for row in rows]
    return [Dot(label.format(**row), row[value], model=model.format(**row)) for row in rows]


def drawn(plot: DotPlot) -> Figure:
    """Draw the picture."""
    labels = list(dict.fromkeys(dot.label for dot in plot.dots))
    figure = Figure(figsize=(7.0, 1.1 + 0.27 * len(labels)), layout="constrained")
    axes = figure.subplots()
    for dot in plot.dots:
        y, colour = labels.index(dot.label), colour_of(dot.model) if dot.model else INK
        if dot.low is not None and dot.high is not None:
            axes.plot([dot.low, dot.high], [y, y], color=colour, lw=1.4, zorder=2)
        face = "white" if dot.hollow else colour
        axes.plot(dot.value, y, "s" if dot.hollow else "o", color=colour, mfc=face, ms=6, zorder=3)
    if plot.reference is not None:
        at, words = plot.reference
        axes.axvline(at, color=COLOURS["guide"], ls="--", lw=1, zorder=1)
        style = {"ha": "center", "va": "bottom", "fontsize": 8, "clip_on": False}
        axes.text(at, -0.75, words, color=COLOURS["guide"], **style)
    if plot.logarithmic:
        axes.set_xscale("log")
    axes.set_yticks(range(len(labels)), labels, fontsize=8)
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.tick_params(axis="x", labelsize=8)
    caption(axes, legend="none", xlabel=plot.axis)
    if any(plot.kinds):
        for words, marker, face in zip(plot.kinds, "os", (INK, "white"), strict=True):
            axes.plot([], [], marker, color=INK, mfc=face, ms=6, label=words)
        figure.legend(loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    return figure


def of_rows(rows: list, label: str, value: str, axis: str, model: str = "", **plot) -> DotPlot:
    """Return a picture with a dot for each row."""
    return DotPlot(dots_of(rows, label, value, model), axis, **plot)


def wrong_physics(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        low, high = (None if end is None else max(end, 0.01) for end in row["range"])
        dots.append(Dot(f"{row['name']}; told: {row['told']}", row["A"], low, high))
    axis = "A over the true A (bar: median range)"
    return DotPlot(dots, axis, (1.0, ""), logarithmic=True)


def interval_coverage(found: dict) -> DotPlot:
    rows = [row | {"percent": 100 * row["coverage"]} for row in found["rows"]]
    dots = dots_of(rows, "{model}, N = {num_particles}, φ = {phi:g}", "percent", "{model}")
    for k, row in enumerate(rows):
        error = 100 * (row["coverage"] * (1 - row["coverage"]) / row["runs"]) ** 0.5
        dots[k] = dots[k]._replace(low=dots[k].value - error, high=dots[k].value + error)
    return DotPlot(dots, "runs whose 95 % interval contains A, %", (95.0, "95 %"))


def fit_head_to_head(found: dict) -> DotPlot:
    rows = [row | {"scene": row["scene"].replace("stochastic", "dsmc")} for row in found["rows"]]
    rows = [row | {"free": ("A", "A and T₀")[len(row["free"]) - 1]} for row in rows]
    rows = [row for row in rows if row["simulations"]]
    dots = dots_of(rows, "{scene}, {free}: {search}", "simulations", "{scene}")
    dots = [dot._replace(hollow="jaxgran" not in dot.label) for dot in dots]
    axis = "simulations until A is known to 2 %"
    return DotPlot(dots, axis, logarithmic=True, kinds=("with derivatives", "without"))


def hard_cases(found: dict) -> DotPlot:
    shares: dict[str, list[float]] = {}
    for row in found["rows"]:
        shares.setdefault(row["case"], []).append(max(row["error"] / row["allowed"], 1e-8))
    dots = [Dot(name, float(np.median(x)), min(x), max(x)) for name, x in shares.items()]
    axis = "error over the error allowed: median and range of the rows"
    return DotPlot(dots, axis, (1.0, "allowed"), logarithmic=True)


def benchmark_kinetic_theory(found: dict) -> DotPlot:
    sweep, slope = found["sweep"], found["derivative"]
    seconds = {
        "one curve": slope["solve_ms"] / 1e3,
        "its derivative, forward": slope["forward_ms"] / 1e3,
        "its derivative, reverse": slope["reverse_ms"] / 1e3,
        f"{sweep['num_curves']} curves, vmap": sweep["vmap_run_s"],
        f"{sweep['num_curves']} curves, SciPy LSODA": sweep["scipy_s"],
    }
    dots = [
        Dot(name, x, None, None, "kinetic theory", "SciPy" in name) for name, x in seconds.items()
    ]
    return DotPlot(dots, "seconds", logarithmic=True, kinds=("jaxgran", "SciPy"))


def benchmark_replicas(found: dict) -> DotPlot:
    axis = "collisions per second on two CPU devices, over one core"
    return of_rows(found["rows"], "{model}", "ratio", axis, "{model}", reference=(1.0, "one core"))


def benchmark_million(found: dict) -> DotPlot:
    cases = ("one core", "two cores", "half on one core", "two devices")
    rows = [
        {"model": row["model"], "case": case, "x": 1e6 * row[case]["s_per_collision"]}
        for row in found["rows"]
        for case in cases
        if case in row
    ]
    axis = "microseconds per collision, 10⁶ disks (or half of them)"
    return of_rows(rows, "{model}, {case}", "x", axis, "{model}", logarithmic=True)


def benchmark_compilation(found: dict) -> DotPlot:
    dots = []
    command = {"jaxgran fit, each in a new process": found["main_job"]}
    for name, row in (found["rows"] | command).items():
        model, *more = name.split(" ", 1)
        known = "kinetic theory" if model == "jaxgran" else named(model)
        label = name if model == "jaxgran" else " ".join([known, *more])
        dot = Dot(label, row["first_s"], model=known)
        dots += [dot, dot._replace(value=row["again_s"], hollow=True)]
    return DotPlot(dots, "seconds", logarithmic=True, kinds=("first run", "again"))


def benchmark_dsmc(found: dict) -> DotPlot:
    columns = "N = {num_particles}", "collisions_per_s", "collisions per second", "DSMC"
    return of_rows(found["rows"], *columns, logarithmic=True)


def over_lammps(rows: list[dict], label: str, model: str) -> DotPlot:
    axis = "collisions per second, over those of LAMMPS on one core"
    reference = (1.0, "LAMMPS")
    return of_rows(rows, label, "over", axis, model, reference=reference, logarithmic=True)


def benchmark_hard_spheres(found: dict) -> DotPlot:
    rows = [row | {"over": row["lammps"]["ratio"]} for row in found["rows"] if row["lammps"]]
    return over_lammps(rows, "N = {num_particles}", "hard spheres")


def benchmark_particles(found: dict) -> DotPlot:
    rows = [row | {"over": row["lammps"]["1"]["ratio"]} for row in found["rows"]]
    label = "N = {num_particles}, t_c/τ_c = {contact_fraction:g}"
    return over_lammps(rows, label, "soft spheres")


def benchmark_derivatives(found: dict) -> DotPlot:
    rows = []
    for row in found["rows"]:
        model, *scene = row["title"].split(", ")
        rows += [
            {"model": model, "way": ", ".join([*scene, way]), "ratio": cost["ratio"]}
            for way, cost in row["ways"].items()
            if way != "plain"
        ]
    axis, reference = "time over that of the plain run", (1.0, "plain run")
    return of_rows(rows, "{model}, {way}", "ratio", axis, "{model}", reference=reference)


def benchmark_elements(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        if row["scene"] != "smooth":
            (dot,) = dots_of([row], "{model}, {scene}", "ratio", "{model}")
            walls = dot._replace(value=row["ratio_of_contacts"], hollow=True)
            dots += [dot, walls] if walls.value != dot.value else [dot]
    kinds = "per collision of particles", "per contact, walls included"
    return DotPlot(dots, "time over that of the smooth gas", (1.0, "smooth"), kinds=kinds)


def benchmark_versions(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        what, *first = row["model"].split(", ")
        is_slope = what in ("forward", "reverse")
        model = "kinetic theory" if is_slope else named(what)
        label = ", ".join([f"{model}, {what} derivative" if is_slope else model, *first])
        x, error = row["ratio"], row["error"]
        dots.append(Dot(label, x, x - error, x + error, model))
    return DotPlot(dots, "time now over time before", (1.0, "no change"))


def paper_claims(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        for words, ratio, error in row["ratios"]:
            label = words if row["equation"] == "text" else f"Eq. {row['equation']}: {words}"
            ends = (None, None) if error is None else (ratio - error, ratio + error)
            dots.append(Dot(label, ratio, *ends, hollow=row["verdict"] == "corrected"))
    kinds = "agrees within its accuracy", "the paper's is corrected"
    return DotPlot(dots, "measured value over the paper's value", (1.0, "as printed"), kinds=kinds)


EACH = (
    (wrong_physics, interval_coverage, fit_head_to_head, paper_claims)
    + (benchmark_kinetic_theory, benchmark_replicas, benchmark_million, benchmark_compilation)
    + (benchmark_dsmc, benchmark_hard_spheres, benchmark_particles, benchmark_derivatives)
    + (benchmark_elements, benchmark_versions)
)
PLOTS = {plot.__name__: plot for plot in EACH} | {"tests/hard_cases": hard_cases}
"""Functions by the name of the file of the figures; its last part is the name of the picture."""
