"""When does a gas depart from Haff's law, and does clustering begin later in a viscoelastic gas?

    python experiments/paper/paper_clustering.py [--smoke] [--out DIR]

The last argument of Brilliantov & Poeschel's self-diffusion paper: clustering begins in two gases
of disks after different numbers of collisions per particle, N_c = 70 and 23, but at nearly the same
temperature, T_c/T_0 = .0031 and .0027, so that temperature would be the better clock. Both gases
and viscoelastic gases with the same initial cooling rates are simulated with several seeds. Writes
two pictures and a JSON file.

A gas departs from Haff's law when its T, that of all kinetic energy, first exceeds by a given
factor the T of kinetic theory (Enskog, Sonine a_2) at the same number of collisions per particle,
or at the same time, or when ln T first falls half as fast per collision. T_c is T at this point.
"""

import argparse
import dataclasses
from collections.abc import Iterable
from pathlib import Path

import jax
import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter
from tqdm import tqdm

from experiments.support.clustering import (
    COLOURS,
    FACTORS,
    LAWS,
    departures,
    dissipation,
    follow,
    homogeneous,
    mean_error,
    slope,
    viscoelastic_like,
)
from experiments.support.record import add_recording, write_picture, write_results
from experiments.support.scenes import hard_beads
from jaxgran.plotting import COLOURS as COLOURS_OF


@dataclasses.dataclass(frozen=True)
class Scene:
    packing_fraction: float
    restitution: float
    until: tuple[float, float]  # collisions per particle, of each law
    paper: tuple[float, float]  # N_c and T_c/T_0 that the paper quotes

    @property
    def name(self) -> str:
        return f"phi = {self.packing_fraction:g}, e = {self.restitution:g}"


@dataclasses.dataclass(frozen=True)
class Config:
    num_particles: int = 20_000
    seeds: tuple[int, ...] = (0, 1, 2)
    scenes: tuple[Scene, ...] = (
        Scene(0.245, 0.9, (130.0, 170.0), (70.0, 0.0031)),
        Scene(0.05, 0.6, (36.0, 60.0), (23.0, 0.0027)),
    )
    fields: tuple[float, ...] = (20.0, 60.0, 95.0, 128.0)  # collisions at which density is drawn


SMOKE = Config(
    num_particles=500,
    seeds=(0, 1),
    scenes=(Scene(0.245, 0.6, (14.0, 14.0), (70.0, 0.0031)),),
    fields=(4.0, 12.0),
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--smoke", action="store_true", help="few disks, one scene with more dissipation"
    )
    parser.add_argument("--out", type=Path, default=Path("results") / "paper_clustering")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    config = SMOKE if options.smoke else Config()
    options.out.mkdir(parents=True, exist_ok=True)
    runs = simulate(config)
    figures = analyse(config, runs)
    report(config, figures)
    path = options.out / "paper_clustering.json"
    write_results("paper_clustering", options, path, config=dataclasses.asdict(config), **figures)
    write_picture(draw_curves(config, runs, figures), "paper_clustering", options, dpi=110)
    write_picture(draw_fields(config, runs), "paper_clustering_fields", options, dpi=110)
    print(f"written to {options.out}")


def simulate(config: Config) -> dict:
    """Return every run, by scene, law and seed, compared with kinetic theory."""
    runs = {}
    for i, scene in enumerate(config.scenes):
        constant = hard_beads(scene.packing_fraction, scene.restitution, dimension=2)
        gases = constant, viscoelastic_like(constant)
        for law, gas, until in zip(LAWS, gases, scene.until, strict=True):
            for seed in config.seeds:
                first = i == 0 and seed == config.seeds[0]
                keep = [x for x in config.fields if first and x < until]
                with tqdm(total=until, desc=f"{scene.name}, {law}, seed {seed}", delay=1) as bar:

                    def show(collisions, bar=bar):
                        bar.update(min(collisions, bar.total) - bar.n)

                    run = follow(gas, seed, config.num_particles, until, keep, show)
                by_collisions, by_time = homogeneous(gas, run)
                log_t = np.log(run["temperature"])
                runs[scene.name, law, seed] = run | {
                    "excess": log_t - by_collisions,
                    "excess_in_time": log_t - by_time,
                    "clock": float(gas.temperature) / run["temperature"],
                    "tau": run["t"] * float(gas.collision_frequency),
                    "slope": slope(run["collisions"], log_t),
                    "theory_slope": slope(run["collisions"], by_collisions),
                    "gamma_0": dissipation(gas),
                }
    return runs


def analyse(config: Config, runs: dict) -> dict:
    """Return means and errors over the seeds, and ratios between the scenes and the laws."""
    scenes = {}
    for scene in config.scenes:
        found = {}
        start = [runs[scene.name, law, s]["unevenness"][0] for law in LAWS for s in config.seeds]
        for law in LAWS:
            each = [runs[scene.name, law, seed] for seed in config.seeds]
            left = [departures(run, float(np.mean(start))) for run in each]
            grid = np.linspace(0.0, min(run["collisions"][-1] for run in each), 200)
            names = "temperature", "excess", "unevenness", "flow"
            n_c = scene.paper[0]
            reached = [run for run in each if run["collisions"][-1] >= n_c]
            found[law] = {
                "gamma_0": each[0]["gamma_0"],
                "departures": {
                    name: {clock: found_in_all(x[name][clock] for x in left) for clock in row}
                    for name, row in left[0].items()
                },
                "T_at_the_papers_N": mean_error(
                    np.exp(-np.interp(n_c, run["collisions"], np.log(run["clock"])))
                    for run in reached
                )
                if len(reached) > 1
                else None,
                "regularised_share": mean_error(
                    run["regularised"][-1] / run["collisions"][-1] for run in each
                ),
                "last_collisions": float(grid[-1]),
                "last_flow": mean_error(run["flow"][-1] for run in each),
                "seconds": [[run["start_s"], run["run_s"]] for run in each],
                "collisions": grid.tolist(),
                "curves": {name: mean_curve(each, grid, name) for name in names},
            }
        scenes[scene.name] = found | {
            "elastic_unevenness": mean_error(start),
            "viscoelastic_over_constant": {
                name: ratios(found["viscoelastic"]["departures"][name], one)
                for name, one in found["constant"]["departures"].items()
            },
        }
    figures = {"scenes": scenes}
    if len(config.scenes) == 2:
        one, other = (scenes[scene.name]["constant"]["departures"] for scene in config.scenes)
        figures["first_scene_over_second"] = {name: ratios(one[name], other[name]) for name in one}
    return figures


def found_in_all(values: Iterable[float]) -> list[float] | None:
    """Return mean and standard error, or None if not every seed departed."""
    found = mean_error(values)
    return found if np.isfinite(found[0]) else None


def mean_curve(runs: list[dict], grid: np.ndarray, name: str) -> list[float]:
    return np.mean([np.interp(grid, x["collisions"], x[name]) for x in runs], axis=0).tolist()


def ratios(one: dict, other: dict) -> dict[str, list[float] | None]:
    """Return the ratio of two departures in each clock, with its error; None if one is missing."""

    def ratio(x, y):
        if x is None or y is None:
            return None
        (a, a_error), (b, b_error) = x, y
        return [a / b, a / b * float(np.hypot(a_error / a, b_error / b))]

    return {clock: ratio(one[clock], other[clock]) for clock in one}


def report(config: Config, figures: dict) -> None:
    def text(value):
        if value is None:
            return f"{'not reached':>20}"
        return f"{value[0]:9.4g} +- {value[1]:7.2g}"

    for scene in config.scenes:
        found = figures["scenes"][scene.name]
        print(f"\n{scene.name}; the paper: N_c = {scene.paper[0]:g}, T_c/T_0 = {scene.paper[1]:g}")
        for law in LAWS:
            print(f"{law}: regularised {text(found[law]['regularised_share'])} of the collisions")
            if found[law]["T_at_the_papers_N"]:
                print(f"  T/T_0 at the paper's N_c: {text(found[law]['T_at_the_papers_N'])}")
            for name, row in found[law]["departures"].items():
                print(f"  {name:32} N {text(row['N'])}   T/T_0 {text(row['T'])}")
        print("viscoelastic over constant")
        for name, row in found["viscoelastic_over_constant"].items():
            print(f"  {name:32} N {text(row['N'])}   T {text(row['T'])}   t {text(row['tau'])}")
    if "first_scene_over_second" in figures:
        print("\nfirst scene over second, constant (the paper: N 3.04, T 1.15)")
        for name, row in figures["first_scene_over_second"].items():
            print(f"  {name:32} N {text(row['N'])}   T {text(row['T'])}")


def draw_curves(config: Config, runs: dict, figures: dict) -> Figure:
    """Draw T over N, and its ratio to that of kinetic theory over N and over T_0/T.

    Colours show laws, line styles densities; each thin line is a seed.
    """
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    axes = figure.subplots(1, 3)
    for scene, style in zip(config.scenes, ("-", "--"), strict=False):
        for law, colour in zip(LAWS, COLOURS, strict=True):
            for seed in config.seeds:
                run = runs[scene.name, law, seed]
                name = f"ε = {scene.restitution:g}" if law == "constant" else "viscoelastic"
                label = f"φ = {scene.packing_fraction:g}, {name}"
                look = {"color": colour, "ls": style, "lw": 1.1}
                look["label"] = label if seed == config.seeds[0] else None
                axes[0].plot(run["collisions"], 1 / run["clock"], **look)
                if seed == config.seeds[0]:
                    haff = np.exp(-run["excess"]) / run["clock"]
                    axes[0].plot(run["collisions"], haff, color=colour, ls=":", lw=1)
                axes[1].plot(run["collisions"], np.exp(run["excess"]), **look)
                axes[2].plot(run["clock"], np.exp(run["excess"]), **look)
        left = figures["scenes"][scene.name]["constant"]["departures"]
        at = left[f"T over theory's of N by {FACTORS[-1]:g}"]
        point = [at[clock][0] if at[clock] else float("nan") for clock in ("N", "T")]
        marks = {"color": COLOURS[0], "mec": "k", "ls": "none"}
        ours = axes[0].plot(*point, "o", ms=7, zorder=5, **marks)
        star = axes[0].plot(*scene.paper, "*", ms=13, zorder=4, **marks)
    axes[0].plot([], [], ":", color=COLOURS_OF["guide"], label="kinetic theory of the same gas")
    ours[0].set_label(f"T is {FACTORS[-1]:g} times that of theory")
    star[0].set_label("the paper's $N_c$, $T_c$")
    low = min(float(np.min(1 / run["clock"])) for run in runs.values())
    axes[0].set(yscale="log", ylabel="$T/T_0$", ylim=(low / 8, 1.5))
    axes[0].set_title("Disks cool more slowly than kinetic theory", fontsize=10, loc="left")
    for axis in axes[1:]:
        axis.set(yscale="log", ylim=(0.9, 20), ylabel="T / T of theory at the same N")
        axis.axhline(FACTORS[-1], color=COLOURS_OF["guide"], lw=0.8, zorder=0)
        axis.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axis.set_yticks([], minor=True)
    axes[1].set_title("... after different numbers of collisions", fontsize=10, loc="left")
    axes[2].set(xscale="log", xlabel="$T_0/T$")
    axes[2].set_title("... but below nearly the same temperature", fontsize=10, loc="left")
    for axis in axes[:2]:
        axis.set_xlabel("collisions per particle N")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def draw_fields(config: Config, runs: dict) -> Figure:
    """Draw the density of the first scene, smoothed over 1.5 mean distances of disks."""
    scene, seed = config.scenes[0], config.seeds[0]
    figure = Figure(figsize=(2.6 * len(config.fields) + 0.8, 5.6), layout="constrained")
    axes = figure.subplots(2, len(config.fields))
    shown = ScalarMappable(Normalize(0.0, 2.5), cmap=colormaps["magma"].resampled(25))
    for law, row in zip(LAWS, axes, strict=True):
        run = runs[scene.name, law, seed]
        for mark, axis in zip(config.fields, row, strict=True):
            place = run["positions"][mark]
            pixels = int(len(place) ** 0.5)  # as large as the mean distance of disks
            number = np.histogram2d(*place.T % 1.0, bins=pixels, range=[[0, 1], [0, 1]])[0]
            density = gaussian_filter(number, 1.5, mode="wrap") / number.mean()
            axis.imshow(
                density.T, norm=shown.norm, cmap=shown.cmap, origin="lower", interpolation="nearest"
            )
            temperature = 1 / np.interp(mark, run["collisions"], run["clock"])
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"$N$ = {mark:g},  $T/T_0$ = {temperature:.1e}", fontsize=9)
        row[0].set_ylabel(
            f"$\\varepsilon$ = {scene.restitution:g}" if law == "constant" else "viscoelastic"
        )
    figure.colorbar(shown, ax=axes, shrink=0.7, label="density / mean")
    return figure


if __name__ == "__main__":
    main()
