"""How fast and how accurate is each model? Run time and error of T(t) for all its settings.

    python experiments/speed/speed_vs_error.py [--scenes dilute dense clustering]
        [--models kinetic-theory dsmc hard-spheres soft-spheres] [--smoke] [--out DIR]

The error is the largest relative difference of T from an independent reference over the whole
curve: LAMMPS for the dilute and the dense gas; for the clustering gas soft spheres with 80 steps
per contact, in the largest box of the table and with three times the replicas. Each row is run
twice, to separate compilation from run time. Scenes and models that are not selected keep the rows
of an older run in the same folder.
"""

import argparse
import datetime
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from tqdm import tqdm

import jaxgran
from experiments.support.record import (
    DATA,
    add_recording,
    save,
    seconds,
    write_picture,
    write_results,
)
from experiments.support.scenes import beads
from jaxgran.data.files import header_number
from jaxgran.plotting import COLOURS, INK

STYLES = {
    "kinetic theory": ("--", "D"),
    "DSMC": ("-.", "v"),
    "hard spheres": (":", "s"),
    "soft spheres": ("-", "^"),
}
"""Line and marker of each model."""


KEY = 1  # key of the rows; the reference has another key
MODELS = "kinetic theory", "DSMC", "hard spheres", "soft spheres"
SIZES = {
    "dilute": (500, 2000, 8000),
    "dense": (500, 2000, 8000),
    "clustering": (1000, 3000, 12_000),
}
REPLICAS = 4
DSMC_SIZES = (1000, 10_000, 100_000)
STEPS = (10, 20, 80)
SOFTER = (4, 16)  # factors by which Y is reduced at fixed A alpha^(2/5)
CLUSTERING = (0.2, 0.5, 0.02)  # packing fraction, beta, contact fraction
CLUSTERING_TIMES = np.geomspace(0.5, 60, 30)  # mean free times


@dataclass
class Scene:
    """A gas with a reference curve.

    Attributes:
        gas, times: what is simulated.
        temperature: of the reference.
        error: standard error of the reference's T.
        reference: description of the reference.
    """

    gas: jaxgran.Gas
    times: np.ndarray
    temperature: np.ndarray
    error: np.ndarray
    reference: str


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", choices=SIZES, default=list(SIZES))
    names = [option(name) for name in MODELS]
    parser.add_argument("--models", nargs="+", choices=names, default=names)
    parser.add_argument("--smoke", action="store_true", help="few rows, early times only")
    parser.add_argument("--out", type=Path, default=Path("results") / "speed_vs_error")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    stem = "speed_vs_error_smoke" if options.smoke else "speed_vs_error"
    file, found = options.out / f"{stem}.json", {}
    if file.exists():
        found = json.loads(file.read_text(encoding="utf-8"))["scenes"]
    for name in ("dense",) if options.smoke else options.scenes:
        jax.clear_caches()  # so that every scene compiles separately
        scene = clustering() if name == "clustering" else measured(name, options.smoke)
        before = found[name]["rows"] if name in found else []
        kept = [row for row in before if option(row["model"]) not in options.models]
        runs = few_runs(scene.gas) if options.smoke else all_runs(scene.gas, SIZES[name])
        runs = [run for run in runs if option(run.model.name) in options.models]
        rows = [measure(scene, run) for run in tqdm(runs, disable=True if options.smoke else None)]
        rows = sorted(kept + rows, key=lambda row: MODELS.index(row["model"]))
        choice = jaxgran.choose_model(
            scene.gas, scene.times, num_particles=SIZES[name][-1], replicas=REPLICAS
        )
        estimates = {c.model.name: c.error for c in choice.candidates if c.error is not None}
        made = datetime.date.today().isoformat()
        found[name] = {
            "date": made,
            "reference": scene.reference,
            "estimates": estimates,
            "rows": rows,
        }
        print(table(name, found[name]))
        save(file, scenes=found, key=KEY, replicas=REPLICAS)
    found = {name: found[name] for name in SIZES if name in found}
    write_picture(draw(found), stem, options)
    write_results("speed_vs_error", options, None, scenes=found, key=KEY, replicas=REPLICAS)
    print(f"written to {options.out}")


def option(name: str) -> str:
    """Return the name of a model on the command line."""
    return name.lower().replace(" ", "-")


def title(name: str) -> str:
    """Return the name of a model in a table."""
    return name[:1].upper() + name[1:]


def measured(name: str, smoke: bool) -> Scene:
    """Return a gas whose curve was simulated in LAMMPS."""
    curve, header = jaxgran.read_curve(DATA / f"lammps_cooling_{name}.csv")
    gas = jaxgran.read_gas(header).replace(dissipative_constant=header_number(header, "A"))
    assert curve.temperature_error is not None
    used = slice(1, 6 if smoke else None)  # at t = 0 nothing is measured
    label = f"LAMMPS, N = {header['N']}, {header['replicas']} replicas"
    return Scene(
        gas,
        np.asarray(curve.times)[used],
        np.asarray(curve.temperature)[used],
        np.asarray(curve.temperature_error)[used],
        label,
    )


def clustering() -> Scene:
    """Return a gas in a box of four L_c, with soft spheres of finer time steps as reference."""
    gas = beads(*CLUSTERING)
    size, times = SIZES["clustering"][-1], CLUSTERING_TIMES * float(gas.mean_free_time)
    key = jax.random.key(KEY + 1)
    model = jaxgran.SoftSpheres(size, replicas=3 * REPLICAS, steps_per_contact=80)
    curve = jaxgran.cool(gas, times, model=model, key=key)
    assert curve.temperature_error is not None
    label = f"soft spheres, N = {size}, {3 * REPLICAS} replicas, 80 steps a contact"
    return Scene(
        gas, times, np.asarray(curve.temperature), np.asarray(curve.temperature_error), label
    )


class Run(NamedTuple):
    """A row of the table.

    Attributes:
        knob: description of the settings of the model.
        model: with these settings.
        gas: that of the scene, or a softer one.
        double: whether it is run in float64.
    """

    knob: str
    model: jaxgran.AbstractModel
    gas: jaxgran.Gas
    double: bool = True


def few_runs(gas: jaxgran.Gas) -> list[Run]:
    few: dict[str, Any] = {"num_particles": 100, "replicas": 2}
    return [
        Run("rtol 1e-03", jaxgran.KineticTheory(rtol=1e-3), gas),
        Run("rtol 1e-05, float32", jaxgran.KineticTheory(rtol=1e-5), gas, double=False),
        *(
            Run("N 100", model(**few), gas)
            for model in (jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres)
        ),
    ]


def all_runs(gas: jaxgran.Gas, sizes: tuple[int, ...]) -> list[Run]:
    few: dict[str, Any] = {"replicas": REPLICAS}
    middle, many = sizes[1], DSMC_SIZES[1]
    dsmc, hard = jaxgran.DSMC(many, **few), jaxgran.HardSpheres(middle, **few)
    soft = jaxgran.SoftSpheres(middle, **few)
    runs = [
        *(Run(f"rtol {r:.0e}", jaxgran.KineticTheory(rtol=r), gas) for r in (1e-3, 1e-6, 1e-9)),
        Run("rtol 1e-05, float32", jaxgran.KineticTheory(rtol=1e-5), gas, double=False),
        *(Run(f"N {n}", jaxgran.DSMC(n, **few), gas) for n in DSMC_SIZES),
        *(Run(f"N {many}, step {s}", replace(dsmc, step=s), gas) for s in (0.1, 0.02)),
        Run(f"N {many}, float32", dsmc, gas, double=False),
        *(Run(f"N {n}", jaxgran.HardSpheres(n, **few), gas) for n in sizes),
        Run(f"N {middle}, float32", hard, gas, double=False),
        *(Run(f"N {n}, 40 steps", jaxgran.SoftSpheres(n, **few), gas) for n in sizes),
        *(Run(f"N {middle}, {s} steps", replace(soft, steps_per_contact=s), gas) for s in STEPS),
    ]
    for times in SOFTER:
        softer = gas.replace(
            youngs_modulus=gas.value("youngs_modulus") / times,
            dissipative_constant=gas.value("dissipative_constant") * times**0.4,
        )
        runs.append(Run(f"N {middle}, {times}x softer", soft, softer))
    return [*runs, Run(f"N {middle}, 40 steps, float32", soft, gas, double=False)]


def measure(scene: Scene, row: Run) -> dict:
    jax.config.update("jax_enable_x64", row.double)
    gas = row.gas
    if not row.double:
        gas = jax.tree.map(lambda x: x.astype(np.float32), gas)
    curves = []

    def run():
        key = jax.random.key(KEY)
        curve = jaxgran.cool(gas, scene.times, model=row.model, key=key, progress=False)
        curves.append(curve)
        return curve.temperature

    compile_s, run_s = seconds(run, repeats=1)
    T = np.asarray(curves[-1].temperature, float)
    own = curves[-1].temperature_error
    jax.config.update("jax_enable_x64", True)
    miss = np.abs(T / scene.temperature - 1)
    worst = int(np.argmax(miss))
    noise = scene.error[worst] if own is None else np.hypot(own[worst], scene.error[worst])
    return {
        "model": row.model.name,
        "knob": row.knob,
        "float64": row.double,
        "compile_s": compile_s,
        "run_s": run_s,
        "error": float(miss[worst]),
        "standard_error": float(noise / scene.temperature[worst]),
        "worst_at": float(scene.times[worst] / float(scene.gas.mean_free_time)),
    }


def table(name: str, results: dict) -> str:
    lines = [
        f"**{name}**, against {results['reference']}",
        "",
        "| model | settings | compilation, s | run, s | largest error of T | at t/τ_c |",
        "|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        error = f"{100 * row['error']:.2g} ± {100 * row['standard_error']:.1g} %"
        lines.append(
            f"| {title(row['model'])} | {row['knob']} | {row['compile_s']:.1f} | "
            f"{row['run_s']:.3g} | {error} | {row['worst_at']:.3g} |"
        )
    each = (f"{title(model)} {100 * x:.2g} %" for model, x in results["estimates"].items())
    lines += ["", f"`choose_model` estimates, for the largest N: {', '.join(each)}."]
    return "\n".join(lines)


def draw(found: dict) -> Figure:
    """Draw the largest error over the run time; symbols grow with N."""
    figure = Figure(figsize=(5.0 * len(found), 5.6), layout="constrained")
    grid = figure.subplots(1, len(found), sharey=True, squeeze=False)
    for axes, (name, results) in zip(grid[0], found.items(), strict=True):
        panel(axes, results["rows"])
        title = f"{name} gas, against {results['reference'].split(', ')[0]}"
        axes.set_title(title, fontsize=11, loc="left")
        axes.set(xlabel="run time without compilation (s)")
        axes.spines[["top", "right"]].set_visible(False)
    grid[0][0].set(ylabel="largest error of T(t) (%)")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    return figure


def panel(axes: Axes, rows: list[dict]) -> None:
    """Draw a panel: full points grow with N; hollow points have the middle N and other steps.

    Rows of the table that differ in something else (float32, the tolerance, DSMC's step, softer
    spheres) are left out.
    """
    for name in MODELS:
        mine = [row for row in rows if row["model"] == name]
        marker = STYLES[name][1]
        by_size = [row for row in mine if is_usual(row)]
        for k, row in enumerate(by_size):
            last = k == len(by_size) - 1
            point(axes, row, marker, 4 + 3 * k, COLOURS[name], title(name) if last else None)
        line = {"color": COLOURS[name], "lw": 0.8, "alpha": 0.6}
        axes.plot(*coordinates(by_size), **line)
        steps = [row for row in mine if (found := steps_of(row)) and found != 40]
        for row in steps:
            point(axes, row, marker, 6, "none", None)
            words = f"{steps_of(row)} steps"
            (x,), (y,) = coordinates([row])
            shift, side = ((-6, 0), "right") if row is steps[0] else ((6, -11), "left")
            shift = (6, 4) if row is steps[-1] else shift
            place = {"xytext": shift, "textcoords": "offset points", "fontsize": 8, "ha": side}
            axes.annotate(words, (x, y), color=COLOURS[name], **place)
    numbers = {name: sizes_of(rows, name) for name in MODELS[1:]}
    words = [f"N = {', '.join(map(str, numbers['soft spheres']))}"]
    words.append(f"DSMC: {', '.join(map(str, numbers['DSMC']))}")
    axes.text(0.02, 0.03, "\n".join(words), transform=axes.transAxes, fontsize=8.5, color=INK)
    # The Pareto front: rows for which no other is both faster and more accurate.
    best = np.inf
    front = []
    for row in sorted(rows, key=lambda row: row["run_s"]):
        if row["error"] < best:
            best = row["error"]
            front.append(row)
    t, e = ([row[key] for row in front] for key in ("run_s", "error"))
    look = {"color": COLOURS["guide"], "lw": 1, "zorder": 0}
    axes.step(t, 100 * np.asarray(e), where="post", label="Pareto front", **look)
    axes.set(xscale="log", yscale="log", ylim=(0.2, 60))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def point(axes: Axes, row: dict, marker: str, size: float, face: str, label) -> None:
    """Draw a row with its error bar."""
    (x,), (y,) = coordinates([row])
    colour = COLOURS[row["model"]]
    look = {"fmt": marker, "ms": size, "mfc": face, "lw": 0.7, "color": colour, "label": label}
    axes.errorbar(x, y, 100 * row["standard_error"], **look)


def coordinates(rows: list[dict]) -> tuple[list[float], list[float]]:
    return [row["run_s"] for row in rows], [100 * row["error"] for row in rows]


def is_usual(row: dict) -> bool:
    """Return whether a row has default settings apart from N."""
    return (
        row["float64"] and re.fullmatch(r"(N \d+(, 40 steps)?|rtol 1e-06)", row["knob"]) is not None
    )


def steps_of(row: dict) -> int | None:
    """Return the steps per contact of a row with otherwise default settings."""
    found = re.fullmatch(r"N \d+, (\d+) steps", row["knob"])
    return int(found[1]) if found else None


def sizes_of(rows: list[dict], name: str) -> list[int]:
    """Return N of the usual rows of a model."""
    mine = [row["knob"] for row in rows if row["model"] == name and is_usual(row)]
    return [int(knob.split(",")[0].split()[1]) for knob in mine]


if __name__ == "__main__":
    main()
