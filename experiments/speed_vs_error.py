"""How fast and how wrong is each model? Run time against the error of T(t), every knob swept.

    python experiments/speed_vs_error.py [--scenes dilute dense clustering]
        [--models KineticTheory DSMC HardSpheres SoftSpheres] [--smoke] [--out DIR]

The error is the largest relative difference of T from an independent reference over the whole
curve: LAMMPS for the dilute and the dense gas, for the clustering one soft spheres in four boxes
with twice the steps and all its particles. Each row is run twice, so that compilation can be told
apart. Scenes and models not asked for keep the rows of an older run in the same folder.
"""

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from record import save, seconds
from scenes import beads
from tqdm import tqdm

import jaxgran
from jaxgran.choice import words
from jaxgran.curve import header_number

DATA_FOLDER = Path(__file__).parent / "data"
KEY = 1  # of the rows; the reference has another
COLOURS = {
    "KineticTheory": "#222222",
    "DSMC": "#2a9d8f",
    "HardSpheres": "#20639b",
    "SoftSpheres": "#d1495b",
}
SIZES = {
    "dilute": (500, 2000, 8000),
    "dense": (500, 2000, 8000),
    "clustering": (1000, 3000, 12_000),
}
REPLICAS = 4
DSMC_SIZES = (1000, 10_000, 100_000)
STEPS = (10, 20, 80)
SOFTER = (4, 16)  # times, at fixed A alpha^(2/5)
CLUSTERING = (0.2, 0.5, 0.02)  # packing fraction, beta, contact fraction
CLUSTERING_TIMES = np.geomspace(0.5, 60, 30)  # mean free times


@dataclass
class Scene:
    gas: jaxgran.Gas
    times: np.ndarray
    temperature: np.ndarray  # of the reference
    error: np.ndarray  # one standard deviation
    reference: str


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", choices=SIZES, default=list(SIZES))
    parser.add_argument("--models", nargs="+", choices=COLOURS, default=list(COLOURS))
    parser.add_argument("--smoke", action="store_true", help="a row a model, early times only")
    parser.add_argument("--out", type=Path, default=Path("results") / "speed_vs_error")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    stem = "speed_vs_error_smoke" if options.smoke else "speed_vs_error"
    file, found = options.out / f"{stem}.json", {}
    if file.exists():
        found = json.loads(file.read_text(encoding="utf-8"))["scenes"]
    for name in ("dense",) if options.smoke else options.scenes:
        jax.clear_caches()  # every scene compiles anew
        scene = clustering() if name == "clustering" else measured(name, options.smoke)
        before = found[name]["rows"] if name in found else []
        kept = [row for row in before if row["model"] not in options.models]
        runs = few_runs(scene.gas) if options.smoke else all_runs(scene.gas, SIZES[name])
        runs = [run for run in runs if type(run.model).__name__ in options.models]
        rows = [measure(scene, run) for run in tqdm(runs, disable=True if options.smoke else None)]
        rows = sorted(kept + rows, key=lambda row: list(COLOURS).index(row["model"]))
        estimates = jaxgran.choose_model(
            scene.gas, scene.times, num_particles=SIZES[name][-1], replicas=REPLICAS
        ).errors
        found[name] = {"reference": scene.reference, "estimates": estimates, "rows": rows}
        print(table(name, found[name]))
        save(file, scenes=found, key=KEY, replicas=REPLICAS)
    found = {name: found[name] for name in SIZES if name in found}
    draw(found, file.with_suffix(".png"))
    text = "\n\n".join(table(name, results) for name, results in found.items())
    file.with_suffix(".md").write_text(text + "\n", encoding="utf-8")
    print(f"written to {options.out}")


def measured(name: str, smoke: bool) -> Scene:
    """A gas that was measured in LAMMPS."""
    curve, header = jaxgran.read_curve(DATA_FOLDER / f"lammps_cooling_{name}.csv")
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
    """A box of four L_c, and soft spheres in it by finer steps."""
    gas = beads(*CLUSTERING)
    size, times = SIZES["clustering"][-1], CLUSTERING_TIMES * float(gas.mean_free_time)
    key = jax.random.key(KEY + 1)
    model = jaxgran.SoftSpheres(size, replicas=3 * REPLICAS, steps_per_contact=80, key=key)
    curve = jaxgran.cool(gas, times, model=model)
    assert curve.temperature_error is not None
    label = f"soft spheres, N = {size}, {3 * REPLICAS} replicas, 80 steps a contact"
    return Scene(
        gas, times, np.asarray(curve.temperature), np.asarray(curve.temperature_error), label
    )


class Run(NamedTuple):
    knob: str
    model: jaxgran.KineticTheory | jaxgran.DSMC | jaxgran.HardSpheres | jaxgran.SoftSpheres
    gas: jaxgran.Gas
    double: bool = True


def few_runs(gas: jaxgran.Gas) -> list[Run]:
    few = {"num_particles": 100, "replicas": 2, "progress": False}
    return [
        Run("rtol 1e-03", jaxgran.KineticTheory(rtol=1e-3), gas),
        Run("rtol 1e-05, float32", jaxgran.KineticTheory(rtol=1e-5), gas, double=False),
        *(
            Run("N 100", model(**few), gas)
            for model in (jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres)
        ),
    ]


def all_runs(gas: jaxgran.Gas, sizes: tuple[int, ...]) -> list[Run]:
    few = {"replicas": REPLICAS, "key": jax.random.key(KEY), "progress": False}
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
        curves.append(jaxgran.cool(gas, scene.times, model=row.model))
        return curves[-1].temperature

    compile_s, run_s = seconds(run, repeats=1)
    T = np.asarray(curves[-1].temperature, float)
    own = curves[-1].temperature_error
    jax.config.update("jax_enable_x64", True)
    miss = np.abs(T / scene.temperature - 1)
    worst = int(np.argmax(miss))
    noise = scene.error[worst] if own is None else np.hypot(own[worst], scene.error[worst])
    return {
        "model": type(row.model).__name__,
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
        "| model | knob | compile s | run s | largest error of T | at t/τ_c |",
        "|---|---|---|---|---|---|",
    ]
    for row in results["rows"]:
        error = f"{100 * row['error']:.2g} ± {100 * row['standard_error']:.1g} %"
        lines.append(
            f"| {words(row['model'])} | {row['knob']} | {row['compile_s']:.1f} | "
            f"{row['run_s']:.3g} | {error} | {row['worst_at']:.3g} |"
        )
    said = (f"{words(model)} {100 * x:.2g} %" for model, x in results["estimates"].items())
    lines += ["", f"`choose_model` estimates, for the most particles: {', '.join(said)}."]
    return "\n".join(lines)


def draw(found: dict, path: Path) -> None:
    figure = Figure(figsize=(4.4 * len(found), 4.6), layout="constrained")
    grid = figure.subplots(1, len(found), sharey=True, squeeze=False)
    for axes, (name, results) in zip(grid[0], found.items(), strict=True):
        panel(axes, results["rows"])
        axes.set(title=f"{name}\n(against {results['reference'].split(', ')[0]})")
        axes.set(xlabel="run time without compilation, s")
    grid[0][0].set(ylabel="largest error of T(t), %")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    figure.savefig(path, dpi=130)


def panel(axes: Axes, rows: list[dict]) -> None:
    for name, colour in COLOURS.items():
        mine = [row for row in rows if row["model"] == name]
        for double, marker in ((True, "o"), (False, "x")):
            some = [row for row in mine if row["float64"] == double]
            axes.errorbar(
                [row["run_s"] for row in some],
                [100 * row["error"] for row in some],
                [100 * row["standard_error"] for row in some],
                fmt=marker,
                ms=5,
                lw=0.8,
                color=colour,
                label=words(name) if double else None,
            )
    # The front: who is not both slower and more wrong than another.
    best = np.inf
    front = []
    for row in sorted(rows, key=lambda row: row["run_s"]):
        if row["error"] < best:
            best = row["error"]
            front.append(row)
    t, e = ([row[key] for row in front] for key in ("run_s", "error"))
    axes.step(t, 100 * np.asarray(e), where="post", color="#8d99ae", lw=1, label="front")
    axes.plot([], [], "x", color="#555555", label="float32")
    axes.set(xscale="log", yscale="log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.grid(alpha=0.25)


if __name__ == "__main__":
    main()
