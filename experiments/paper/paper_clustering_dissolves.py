"""Do clusters of viscoelastic disks dissolve as the coefficient of restitution approaches 1?

    python experiments/paper/paper_clustering_dissolves.py [--smoke] [--out DIR]

Viscoelastic disks and disks of constant restitution with the same initial cooling rate, in a box
two to three times as long as L_c, up to which a gas stays homogeneous. L_c of the viscoelastic gas
grows as the gas cools and its impacts lose less energy; once it exceeds the box, clusters should
dissolve. The box is small because the number of collisions until then is proportional to the number
of disks. Writes a picture and a JSON file.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from tqdm import tqdm

import jaxgran
from experiments.support.clustering import (
    COLOURS,
    LAWS,
    PER_CELL,
    dissipation,
    follow,
    homogeneous,
    mean_error,
    viscoelastic_like,
)
from experiments.support.record import add_recording, write_picture, write_results
from experiments.support.scenes import hard_beads


@dataclasses.dataclass(frozen=True)
class Config:
    packing_fraction: float = 0.05
    restitution: float = 0.6
    num_particles: int = 2000
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    until: tuple[float, float] = (26.0, 400.0)  # collisions per particle, of each law
    fields: tuple[float, ...] = (5.0, 50.0, 120.0, 400.0)


SMOKE = Config(num_particles=300, seeds=(0, 1), until=(8.0, 60.0), fields=(4.0, 60.0))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--smoke", action="store_true", help="few disks, few collisions")
    parser.add_argument("--out", type=Path, default=Path("results") / "paper_clustering_dissolves")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    config = SMOKE if options.smoke else Config()
    options.out.mkdir(parents=True, exist_ok=True)
    runs = simulate(config)
    figures = analyse(config, runs)
    name = "paper_clustering_dissolves"
    path = options.out / f"{name}.json"
    write_results(name, options, path, config=dataclasses.asdict(config), **figures)
    write_picture(draw(config, runs, figures), name, options, dpi=100)
    print(f"written to {options.out}")


def gases(config: Config) -> dict[str, jaxgran.Gas]:
    constant = hard_beads(config.packing_fraction, config.restitution, dimension=2)
    return dict(zip(LAWS, (constant, viscoelastic_like(constant)), strict=True))


def simulate(config: Config) -> dict[str, list[dict]]:
    """Return the runs of each law, one per seed."""
    runs = {law: [] for law in LAWS}
    for (law, gas), until in zip(gases(config).items(), config.until, strict=True):
        for seed in config.seeds:
            keep = [x for x in config.fields if x <= until] if seed == config.seeds[0] else []
            with tqdm(total=until, desc=f"{law}, seed {seed}", delay=1) as bar:

                def show(collisions, bar=bar):
                    bar.update(min(collisions, bar.total) - bar.n)

                run = follow(gas, seed, config.num_particles, until, keep, show)
            by_collisions, _ = homogeneous(gas, run)
            runs[law].append(run | {"excess": np.log(run["temperature"]) - by_collisions})
    return runs


def critical_boxes(config: Config, run: dict) -> np.ndarray:
    """Return L_c in box sides, at each temperature of a run of viscoelastic disks."""
    gas = gases(config)["viscoelastic"]
    lengths = jax.vmap(lambda t: gas.replace(temperature=t).critical_box)(run["temperature"])
    return np.asarray(lengths / gas.box_side(config.num_particles))


def analyse(config: Config, runs: dict[str, list[dict]]) -> dict:
    """Return and print means and errors over the seeds, at common numbers of collisions."""
    elastic = mean_error(run["unevenness"][0] for each in runs.values() for run in each)
    figures = {"elastic_unevenness": elastic, "cells_of": PER_CELL}
    print(f"unevenness of the elastic fluid {elastic[0]:.3f} +- {elastic[1]:.3f}")
    for law, each in runs.items():
        grid = np.geomspace(1.0, min(run["collisions"][-1] for run in each), 60)
        curves = {}
        for name in ("unevenness", "flow", "temperature", "excess"):
            values = np.array([smooth(grid, run["collisions"], run[name]) for run in each])
            if name == "unevenness":
                values /= elastic[0]
            curves[name] = values.mean(axis=0).tolist()
            curves[f"{name}_error"] = (values.std(axis=0, ddof=1) / len(each) ** 0.5).tolist()
        share = mean_error(run["regularised"][-1] / run["collisions"][-1] for run in each)
        figures[law] = {
            "gamma_0": dissipation(gases(config)[law]),
            "collisions": grid.tolist(),
            "regularised_share": share,
            "seconds": [[run["start_s"], run["run_s"]] for run in each],
            **curves,
        }
        print(f"{law}: regularised {share[0]:.2g} of the collisions")
        print(f"{'N':>8} {'T/T_0':>9} {'unevenness/elastic':>20} {'flow':>17}")
        for i in np.unique(np.linspace(0, len(grid) - 1, 16).astype(int)):
            row = [curves[name][i] for name in ("unevenness", "unevenness_error", "flow")]
            temperature = curves["temperature"][i] / runs[law][0]["temperature"][0]
            print(
                f"{grid[i]:8.1f} {temperature:9.2e} {row[0]:11.2f} +- {row[1]:5.2f} "
                f"{row[2]:9.3f} +- {curves['flow_error'][i]:.3f}"
            )
    passes = []
    for run in runs["viscoelastic"]:
        beyond = np.flatnonzero(critical_boxes(config, run) > 1)
        passes.append(float(run["collisions"][beyond[0]]) if beyond.size else None)
    figures["critical_box_passes_at"] = passes
    print(f"L_c, of a dilute gas at T, exceeds the box from N = {passes} on (None: not reached)")
    return figures


def smooth(grid: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Average y over points within 10 % of each grid point; interpolate if there are none."""
    near = [np.abs(np.log(np.maximum(x, 1e-9) / at)) < 0.1 for at in grid]
    return np.array(
        [y[i].mean() if i.any() else np.interp(at, x, y) for i, at in zip(near, grid, strict=True)]
    )


def draw(config: Config, runs: dict[str, list[dict]], figures: dict) -> Figure:
    """Draw density fluctuations and flow over the collisions, and disks at some times."""
    columns = len(config.fields)
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    grid = figure.add_gridspec(2, 2 * columns, height_ratios=[1.15, 1])
    top = [figure.add_subplot(grid[0, i * columns : (i + 1) * columns]) for i in range(2)]
    bottom = [figure.add_subplot(grid[1, 2 * i : 2 * i + 2]) for i in range(columns)]
    panels = zip(
        top,
        ("unevenness", "flow"),
        ("density fluctuations / elastic", "share of the energy in the flow"),
        strict=True,
    )
    for axis, name, label in panels:
        for law, colour in zip(LAWS, COLOURS, strict=True):
            found = figures[law]
            x, y = np.array(found["collisions"]), np.array(found[name])
            error = np.array(found[f"{name}_error"])
            axis.plot(x, y, color=colour, lw=1.6, label=law)
            axis.fill_between(x, y - error, y + error, color=colour, alpha=0.25, lw=0)
        if None not in figures["critical_box_passes_at"]:
            at = np.mean(figures["critical_box_passes_at"])
            axis.axvline(at, color="0.5", ls="--", lw=1, label="$L_c$ exceeds the box")
        axis.set(xscale="log", xlabel="collisions per particle N", ylabel=label)
        axis.spines[["top", "right"]].set_visible(False)
    top[0].axhline(1, color="0.7", lw=0.8)
    top[0].legend(frameon=False)
    run = runs["viscoelastic"][0]
    gas = gases(config)["viscoelastic"]
    size = float(gas.diameter / gas.box_side(config.num_particles))
    for mark, axis in zip(config.fields, bottom, strict=True):
        place = run["positions"][mark] % 1.0
        axis.add_collection(
            EllipseCollection(
                np.full(len(place), size),
                np.full(len(place), size),
                np.zeros(len(place)),
                units="xy",
                offsets=place,
                offset_transform=axis.transData,
                color=COLOURS[1],
                lw=0,
            )
        )
        temperature = np.interp(mark, run["collisions"], run["temperature"] / run["temperature"][0])
        axis.set(xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[], aspect="equal")
        axis.set_title(f"viscoelastic, $N$ = {mark:g}, $T/T_0$ = {temperature:.0e}", fontsize=9)
    return figure


if __name__ == "__main__":
    main()
