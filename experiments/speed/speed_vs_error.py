"""How fast and how accurate is each model? Run time and error of T(t) for all its settings.

    python experiments/speed/speed_vs_error.py [--scenes dilute dense clustering]
        [--smoke] [--record] [--out DIR]

The error is the largest relative difference of T from an independent reference over the whole
curve: LAMMPS for the dilute and the dense gas; for the clustering gas soft spheres with 80 steps
per contact, in the largest box of the table and with three times the replicas. Each row is run
twice, to separate compilation from run time. With --record, other scenes keep their recorded rows.
"""

import datetime
import re
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.ticker import FuncFormatter
from tqdm import tqdm

import jaxgran
from experiments.support.plots import GUIDE, INK, caption, panels
from experiments.support.record import Options, figures, run_parts, seconds
from experiments.support.scenes import beads, cool, of_lammps
from jaxgran.plotting import COLOURS

MARKERS = {"kinetic theory": "D", "DSMC": "v", "hard spheres": "s", "soft spheres": "^"}
KEY = 1  # key of the rows; the reference has another key
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


class Scene(NamedTuple):
    """A gas, the times, T of a reference and its standard error, and the reference in words."""

    gas: jaxgran.Gas
    times: np.ndarray
    temperature: np.ndarray
    error: np.ndarray
    reference: str


def speed_vs_error(options: Options) -> dict:
    found = figures("speed_vs_error")["scenes"] if options.record else {}
    for name in ("dense",) if options.smoke else options.scenes:
        jax.clear_caches()  # so that every scene compiles separately
        scene = clustering() if name == "clustering" else measured(name, options.smoke)
        runs = all_runs(scene.gas, (100,) if options.smoke else SIZES[name])
        if options.smoke:
            runs = list({run.model.name: run for run in reversed(runs)}.values())
        most = SIZES[name][-1]
        choice = jaxgran.choose_model(scene.gas, scene.times, num_particles=most, replicas=REPLICAS)
        found[name] = {
            "date": datetime.date.today().isoformat(),
            "reference": scene.reference,
            "estimates": {c.model.name: c.error for c in choice.candidates if c.error is not None},
            "rows": [measure(scene, run) for run in tqdm(runs, disable=options.smoke)],
        }
    return {"scenes": found, "key": KEY, "replicas": REPLICAS, "picture": draw(found)}


def measured(name: str, smoke: bool) -> Scene:
    """Return a gas whose curve was simulated in LAMMPS."""
    lammps = of_lammps(name)
    last = 6 if smoke else None
    # At t = 0 nothing is measured.
    curve = jax.tree.map(lambda x: np.asarray(x)[1:last], lammps.curve)
    label = f"LAMMPS, N = {lammps.num_particles}, {lammps.replicas} replicas"
    return Scene(lammps.gas, curve.times, curve.temperature, curve.temperature_error, label)


def clustering() -> Scene:
    """Return a gas in a box of four L_c, with soft spheres of finer time steps as reference."""
    gas = beads(*CLUSTERING)
    size, times = SIZES["clustering"][-1], CLUSTERING_TIMES * float(gas.mean_free_time)
    model = jaxgran.SoftSpheres(size, replicas=3 * REPLICAS, steps_per_contact=80)
    curve = cool(gas, times, model, KEY + 1)
    label = f"soft spheres, N = {size}, {3 * REPLICAS} replicas, 80 steps a contact"
    T, error = map(np.asarray, (curve.temperature, curve.temperature_error))
    return Scene(gas, times, T, error, label)


class Run(NamedTuple):
    """A row: its settings in words, the model, the gas (or a softer one), and the precision."""

    knob: str
    model: jaxgran.extend.AbstractModel
    gas: jaxgran.Gas
    double: bool = True


def all_runs(gas: jaxgran.Gas, sizes: tuple[int, ...]) -> list[Run]:
    few: dict = {"replicas": REPLICAS}
    middle, many = sizes[len(sizes) // 2], DSMC_SIZES[1]
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
        curves.append(cool(gas, scene.times, row.model, KEY))
        return curves[-1].temperature

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


def draw(found: dict):
    """Draw the largest error over the run time; symbols grow with N."""
    figure, places = panels(len(found), size=(5.0, 5.6), sharey=True)
    for axes, (name, results) in zip(places, found.items(), strict=True):
        panel(axes, results["rows"])
        title = f"{name} gas, against {results['reference'].split(', ')[0]}"
        axes.set(xlabel="run time without compilation (s)", ylabel="largest error of T(t) (%)")
        caption(axes, title, "none")
    handles, labels = places[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    return figure


def panel(axes, rows: list[dict]) -> None:
    """Draw a panel: full points grow with N; hollow points have the middle N and other steps.

    Rows of the table that differ in something else (float32, the tolerance, DSMC's step, softer
    spheres) are left out.
    """
    sizes = {}
    for name, marker in MARKERS.items():
        mine = [row for row in rows if row["model"] == name]
        usual = [row for row in mine if steps_of(row) == 40]
        sizes[name] = ", ".join(row["knob"].split(",")[0].removeprefix("N ") for row in usual)
        others = [row for row in mine if steps_of(row) not in (None, 40)]
        for k, row in enumerate([*usual, *others]):
            is_full = k < len(usual)
            label = name[:1].upper() + name[1:] if k == len(usual) - 1 else None
            look = {"ms": 4 + 3 * k if is_full else 6, "mfc": COLOURS[name] if is_full else "none"}
            look |= {"fmt": marker, "lw": 0.7, "label": label, "color": COLOURS[name]}
            (x,), (y,) = coordinates([row])
            axes.errorbar(x, y, 100 * row["standard_error"], **look)
            if not is_full:
                look = {"fontsize": 8, "ha": "right" if k == len(usual) else "left", "va": "top"}
                axes.annotate(f"  {steps_of(row)} steps  ", (x, y), color=COLOURS[name], **look)
        axes.plot(*coordinates(usual), color=COLOURS[name], lw=0.8, alpha=0.6)
    words = f"N = {sizes['soft spheres']}\nDSMC: {sizes['DSMC']}"
    axes.text(0.02, 0.03, words, transform=axes.transAxes, fontsize=8.5, color=INK)
    # The Pareto front: the smallest error of the rows that are not slower.
    run_s, error = coordinates(sorted(rows, key=lambda row: row["run_s"]))
    look = {"color": GUIDE, "lw": 1, "zorder": 0, "label": "Pareto front"}
    axes.step(run_s, np.minimum.accumulate(error), where="post", **look)
    axes.set(xscale="log", yscale="log", ylim=(0.2, 60))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def coordinates(rows: list[dict]) -> tuple[list[float], list[float]]:
    return [row["run_s"] for row in rows], [100 * row["error"] for row in rows]


def steps_of(row: dict) -> int | None:
    """Return the steps per contact, 40 without contacts; None if more than N and they differ."""
    found = re.fullmatch(r"(N \d+(, (\d+) steps)?|rtol 1e-06)", row["knob"])
    return int(found[3] or 40) if found and row["float64"] else None


if __name__ == "__main__":
    run_parts(__doc__, speed_vs_error, scenes=list(SIZES))
