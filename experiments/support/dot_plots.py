"""Pictures of recorded figures: a dot for each row, with its range, and a reference line.

``python experiments/documents.py --pictures`` draws them all; the entries of the gallery show them.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

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


NAMES = {"dsmc": "DSMC", "DSMC": "DSMC"} | {
    spelled: words
    for words in ("hard spheres", "soft spheres")
    for spelled in (words.replace(" ", "-"), "".join(w.capitalize() for w in words.split()))
}
"""Names of models in the pictures."""


def _named(model: str) -> str:
    return NAMES.get(model, model)


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
    axes.set_xlabel(plot.axis, fontsize=9)
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(axis="x", color="#e6e6e6", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if any(plot.kinds):
        for words, marker, face in zip(plot.kinds, "os", (INK, "white"), strict=True):
            axes.plot([], [], marker, color=INK, mfc=face, ms=6, label=words)
        figure.legend(loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    return figure


def wrong_physics(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        dots.append(Dot(row["name"], row["A"], *row["range"]))
        if row["told"] is not None:
            dots.append(Dot(row["name"], row["told"], hollow=True))
    return DotPlot(
        dots,
        "A of the fit over the true A (bar: range over alternatives)",
        (1.0, ""),
        logarithmic=True,
        kinds=("smooth spheres in a periodic box", "the complete scene"),
    )


def interval_coverage(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        p, n = row["coverage"], row["runs"]
        error = (p * (1 - p) / n) ** 0.5
        label = f"{_named(row['model'])}, N = {row['num_particles']}, φ = {row['phi']:g}"
        low, high = (100 * (p + k * error) for k in (-1, 1))
        dots.append(Dot(label, 100 * p, low, high, _named(row["model"])))
    return DotPlot(dots, "runs whose 95 % interval contains A, %", (95.0, "95 %"))


def fit_head_to_head(found: dict) -> DotPlot:
    scenes = {"stochastic": "DSMC", "soft-spheres": "soft spheres"}
    dots = [
        Dot(
            f"{scenes[row['scene']]}, {'A' if len(row['free']) == 1 else 'A and T₀'}: "
            f"{row['search']}",
            row["simulations"],
            model=scenes[row["scene"]],
            hollow=not row["search"].startswith("jaxgran"),
        )
        for row in found["rows"]
        if row["simulations"]
    ]
    axis = "simulations until A is known to 2 %"
    return DotPlot(dots, axis, logarithmic=True, kinds=("with derivatives", "without"))


def hard_cases(found: dict) -> DotPlot:
    dots = []
    for case in found["cases"]:
        shares = [
            max(row[error] / row[allowed], 1e-6)
            for row in case["rows"]
            for error, allowed in (("error", "allowed"), ("slope_error", "slope_allowed"))
            if row[error] is not None and row[allowed]
        ]
        if shares:
            name = case["case"] if len(case["case"]) < 56 else case["case"][:53] + "..."
            dots.append(Dot(name, float(np.median(shares)), min(shares), max(shares)))
    axis = "error over the error allowed: median and range of the rows"
    return DotPlot(dots, axis, (1.0, "allowed"), logarithmic=True)


def benchmark_kinetic_theory(found: dict) -> DotPlot:
    sweep, slope, cold = found["sweep"], found["derivative"], found["cold"]
    count = sweep["num_curves"]
    dots = [
        Dot("one curve", slope["solve_ms"] / 1e3),
        Dot("its derivative, forward", slope["forward_ms"] / 1e3),
        Dot("its derivative, reverse", slope["reverse_ms"] / 1e3),
        Dot(f"{count} curves, vmap", sweep["vmap_run_s"]),
        Dot(f"{count} curves, SciPy LSODA", sweep["scipy_s"], hollow=True),
        Dot("first curve in a new process, with compilation", cold["first_cool_s"]),
        Dot("a whole fit in a new process, first time", cold["main_job_s"]),
        Dot("a whole fit in a new process, second time", cold["main_job_again_s"]),
    ]
    dots = [dot._replace(model="kinetic theory") for dot in dots]
    return DotPlot(dots, "seconds", logarithmic=True, kinds=("jaxgran", "SciPy"))


def ratios(rows: Iterable[tuple[str, float, str]], axis: str, words: str) -> DotPlot:
    """Return a picture of ratios, with a reference line at 1."""
    return DotPlot([Dot(label, x, model=_named(m)) for label, x, m in rows], axis, (1.0, words))


def benchmark_replicas(found: dict) -> DotPlot:
    rows = [(_named(row["model"]), row["ratio"], row["model"]) for row in found["rows"]]
    return ratios(rows, "collisions per second on two CPU devices, over one core", "one core")


def benchmark_million(found: dict) -> DotPlot:
    cases = ("one core", "two cores", "half on one core", "two devices")
    dots = [
        Dot(
            f"{_named(row['model'])}, {case}",
            1e6 * row[case]["s_per_collision"],
            model=_named(row["model"]),
        )
        for row in found["rows"]
        for case in cases
        if case in row
    ]
    return DotPlot(
        dots, "microseconds per collision, 10⁶ disks (or half of them)", logarithmic=True
    )


def benchmark_compilation(found: dict) -> DotPlot:
    dots = []
    for name, row in found["rows"].items():
        model = _named(name.split()[0])
        label = name.replace(name.split()[0], model, 1)
        dots += [
            Dot(label, row["first_s"], model=model),
            Dot(label, row["again_s"], model=model, hollow=True),
        ]
    command, label = found["main_job"], "jaxgran fit, each in a new process"
    dots.append(Dot(label, command["first_s"], model="kinetic theory"))
    dots.append(Dot(label, command["again_s"], model="kinetic theory", hollow=True))
    kinds = "first run", "again"
    return DotPlot(dots, "seconds", logarithmic=True, kinds=kinds)


def benchmark_dsmc(found: dict) -> DotPlot:
    dots = [
        Dot(f"N = {row['num_particles']}", row["collisions_per_s"], model="DSMC")
        for row in found["rows"]
    ]
    return DotPlot(dots, "collisions per second", logarithmic=True)


def against_lammps(rows: Iterable[tuple[str, float]], model: str) -> DotPlot:
    dots = [Dot(label, ratio, model=model) for label, ratio in rows]
    axis = "collisions per second, over those of LAMMPS on one core"
    return DotPlot(dots, axis, (1.0, "LAMMPS"), logarithmic=True)


def benchmark_hard_spheres(found: dict) -> DotPlot:
    rows = [
        (f"N = {row['num_particles']}", row["lammps"]["ratio"])
        for row in found["rows"]
        if row["lammps"]
    ]
    return against_lammps(rows, "hard spheres")


def benchmark_particles(found: dict) -> DotPlot:
    rows = [
        (
            f"N = {row['num_particles']}, t_c/τ_c = {row['contact_fraction']:g}",
            row["lammps"]["1"]["ratio"],
        )
        for row in found["rows"]
    ]
    return against_lammps(rows, "soft spheres")


def benchmark_derivatives(found: dict) -> DotPlot:
    rows = []
    for row in found["rows"]:
        model, *scene = row["title"].split(", ")
        rows += [
            (", ".join([_named(model), *scene, way]), cost["ratio"], model)
            for way, cost in row["ways"].items()
            if way != "plain"
        ]
    return ratios(rows, "time over that of the plain run", "plain run")


def benchmark_elements(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        if row["scene"] == "smooth":
            continue
        dot = Dot(f"{row['model']}, {row['scene']}", row["ratio"], model=row["model"])
        dots.append(dot)
        if row["ratio_of_contacts"] != row["ratio"]:
            dots.append(dot._replace(value=row["ratio_of_contacts"], hollow=True))
    kinds = "per collision of particles", "per contact, walls included"
    return DotPlot(dots, "time over that of the smooth gas", (1.0, "smooth"), kinds=kinds)


def benchmark_versions(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        what, *first = row["model"].split(", ")
        theory = what not in NAMES
        slope = theory and what != "KineticTheory"
        words = f"kinetic theory, {what} derivative" if slope else _named(what)
        label = ", ".join(["kinetic theory" if what == "KineticTheory" else words, *first])
        x, error = row["ratio"], row["error"]
        model = "kinetic theory" if theory else _named(what)
        dots.append(Dot(label, x, x - error, x + error, model))
    return DotPlot(dots, "time now over time before", (1.0, "no change"))


def paper_claims(found: dict) -> DotPlot:
    dots = []
    for row in found["rows"]:
        for words, ratio, error in row["ratios"]:
            label = words if row["equation"] == "text" else f"Eq. {row['equation']}: {words}"
            ends = (None, None) if error is None else (ratio - error, ratio + error)
            dots.append(Dot(label, ratio, *ends, hollow=row["verdict"] == "corrected"))
    axis = "measured value over the paper's value"
    kinds = "agrees within its accuracy", "the paper's is corrected"
    return DotPlot(dots, axis, (1.0, "as printed"), kinds=kinds)


PLOTS: dict[str, Callable[[dict], DotPlot]] = {
    "hard_cases": hard_cases,
    "wrong_physics": wrong_physics,
    "interval_coverage": interval_coverage,
    "fit_head_to_head": fit_head_to_head,
    "benchmark_kinetic_theory": benchmark_kinetic_theory,
    "benchmark_replicas": benchmark_replicas,
    "benchmark_million": benchmark_million,
    "benchmark_compilation": benchmark_compilation,
    "benchmark_dsmc": benchmark_dsmc,
    "benchmark_hard_spheres": benchmark_hard_spheres,
    "benchmark_particles": benchmark_particles,
    "benchmark_derivatives": benchmark_derivatives,
    "benchmark_elements": benchmark_elements,
    "benchmark_versions": benchmark_versions,
    "paper_claims": paper_claims,
}
"""Functions by the name of the figures, which is also that of the picture."""
