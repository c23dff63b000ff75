"""When does a gas depart from Haff's law and cluster, and do its clusters dissolve again?

    python experiments/paper/paper_clustering.py [--only paper_clustering paper_clustering_dissolves
        clustering_film] [--smoke] [--record] [--out DIR]
    python experiments/paper/paper_clustering.py --only clustering_film --trajectory FILE.gsd

paper_clustering: the last argument of Brilliantov & Poeschel's self-diffusion paper. Clustering
begins in two gases of disks after different numbers of collisions per particle, N_c = 70 and 23,
but at nearly the same temperature, T_c/T_0 = .0031 and .0027, so that temperature would be the
better clock. Both gases and viscoelastic gases with the same initial cooling rates are simulated
with several seeds. A gas departs from Haff's law when its T, that of all kinetic energy, first
exceeds by a given factor the T of kinetic theory (Enskog, Sonine a_2) at the same number of
collisions per particle, or at the same time, or when ln T first falls half as fast per collision.
T_c is T at this point.

paper_clustering_dissolves: both kinds of disks in a box two to three times as long as L_c, up to
which a gas stays homogeneous. L_c of the viscoelastic gas grows as the gas cools and its impacts
lose less energy; once it exceeds the box, clusters should dissolve. The box is small because the
number of collisions until then is proportional to the number of disks.

clustering_film: a film of hard disks of constant restitution from a trajectory (GSD, which OVITO,
freud and VMD read, too) in one run. At each frame the run also saves the structure factor and the
spectrum of the flow (``cool(save=...)``), which a picture shows with four frames: the flow grows
first, the clusters later. With --trajectory only the film of another trajectory is made.
"""

import argparse
import itertools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import colormaps
from matplotlib.animation import FuncAnimation
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter
from tqdm import tqdm

import jaxgran
from experiments.support.clustering import (
    COLOURS,
    FACTORS,
    LAWS,
    PER_CELL,
    departures,
    dissipation,
    follow,
    homogeneous,
    mean_error,
    slope,
    viscoelastic_like,
)
from experiments.support.record import script_parser, write_picture, write_results
from experiments.support.scenes import hard_beads
from jaxgran import observables
from jaxgran.plotting import COLOURS as COLOURS_OF

PAPER = {(0.245, 0.9): (70.0, 0.0031), (0.05, 0.6): (23.0, 0.0027)}
"""N_c and T_c/T_0 that the paper quotes, by packing fraction and restitution."""


def runs_of(packing: float, e: float, config: dict, until: tuple, fields: tuple) -> dict:
    """Return the runs of each law, one for each seed, compared with kinetic theory.

    The first run of each law keeps the positions at `fields`, in collisions per particle.
    """
    constant, runs = hard_beads(packing, e, dimension=2), {}
    gases = constant, viscoelastic_like(constant)
    for law, gas, last in zip(LAWS, gases, until, strict=True):
        runs[law] = []
        for seed in config["seeds"]:
            keep = [x for x in fields if x <= last] if seed == config["seeds"][0] else []
            with tqdm(total=last, desc=f"phi = {packing:g}, {law}, seed {seed}", delay=1) as bar:

                def show(collisions, bar=bar):
                    bar.update(min(collisions, bar.total) - bar.n)

                run = follow(gas, seed, config["num_particles"], last, keep, show)
            by_collisions, by_time = homogeneous(gas, run)
            log_t = np.log(run["temperature"])
            run |= {"excess": log_t - by_collisions, "excess_in_time": log_t - by_time}
            run |= {"clock": float(gas.temperature) / run["temperature"], "gas": gas}
            run["tau"] = run["t"] * float(gas.collision_frequency)
            run["slope"] = slope(run["collisions"], log_t)
            run["theory_slope"] = slope(run["collisions"], by_collisions)
            runs[law].append(run)
    return runs


def shared_figures(each: list[dict]) -> dict:
    """Return the initial dissipation, the share of regularised collisions and the seconds."""
    return {
        "gamma_0": dissipation(each[0]["gas"]),
        "regularised_share": mean_error(x["regularised"][-1] / x["collisions"][-1] for x in each),
        "seconds": [[run["start_s"], run["run_s"]] for run in each],
    }


def clustering(options: argparse.Namespace) -> dict:
    config: dict[str, Any] = {"num_particles": 20_000, "seeds": (0, 1, 2)}
    scenes = {(0.245, 0.9): (130.0, 170.0), (0.05, 0.6): (36.0, 60.0)}  # the last collisions
    fields = 20.0, 60.0, 95.0, 128.0  # collisions at which the density is drawn
    if options.smoke:
        config = {"num_particles": 500, "seeds": (0, 1)}
        scenes, fields = {(0.245, 0.6): (14.0, 14.0)}, (4.0, 12.0)
    figures: dict[str, Any] = {"scenes": {}}
    runs = {}
    for (packing, e), until in scenes.items():
        runs[packing, e] = runs_of(packing, e, config, until, () if runs else fields)
        found = analyse(runs[packing, e], PAPER.get((packing, e), PAPER[0.245, 0.9])[0])
        figures["scenes"][f"phi = {packing:g}, e = {e:g}"] = found
    if len(scenes) == 2:
        one, other = (scene["constant"]["departures"] for scene in figures["scenes"].values())
        figures["first_scene_over_second"] = {name: ratios(one[name], other[name]) for name in one}
    write_picture(draw_curves(runs, figures), "paper_clustering", options, dpi=110)
    fields = draw_fields(next(iter(runs.values())), fields)
    write_picture(fields, "paper_clustering_fields", options, dpi=110)
    return {"config": config | {"until": [*scenes.values()]}, **figures}


def analyse(runs: dict[str, list[dict]], n_c: float) -> dict:
    """Return means and errors over the seeds, and the ratios between the laws."""
    start = [run["unevenness"][0] for law in LAWS for run in runs[law]]
    found: dict[str, Any] = {}
    for law, each in runs.items():
        left = [departures(run, float(np.mean(start))) for run in each]
        grid = np.linspace(0.0, min(run["collisions"][-1] for run in each), 200)
        names = "temperature", "excess", "unevenness", "flow"
        curves = {
            name: np.mean([np.interp(grid, x["collisions"], x[name]) for x in each], axis=0)
            for name in names
        }
        at_papers = [
            np.exp(-np.interp(n_c, run["collisions"], np.log(run["clock"])))
            for run in each
            if run["collisions"][-1] >= n_c
        ]
        found[law] = shared_figures(each) | {
            "departures": {
                name: {clock: found_in_all([x[name][clock] for x in left]) for clock in row}
                for name, row in left[0].items()
            },
            "T_at_the_papers_N": mean_error(at_papers) if len(at_papers) > 1 else None,
            "last_collisions": float(grid[-1]),
            "last_flow": mean_error(run["flow"][-1] for run in each),
            "collisions": grid.tolist(),
            "curves": {name: curve.tolist() for name, curve in curves.items()},
        }
        at = found[law]["departures"][f"T over theory's of N by {FACTORS[-1]:g}"]
        print(f"{law}: T is {FACTORS[-1]:g} times that of theory at N = {at['N']}, T = {at['T']}")
    one, other = (found[law]["departures"] for law in LAWS)
    return found | {
        "elastic_unevenness": mean_error(start),
        "viscoelastic_over_constant": {name: ratios(other[name], one[name]) for name in one},
    }


def found_in_all(values: list[float]) -> list[float] | None:
    """Return mean and standard error, or None if not every seed departed."""
    return mean_error(values) if np.all(np.isfinite(values)) else None


def ratios(one: dict, other: dict) -> dict[str, list[float] | None]:
    """Return the ratio of two departures in each clock, with its error; None if one is missing."""
    found: dict[str, list[float] | None] = dict.fromkeys(one)
    for clock in one:
        if one[clock] is not None and other[clock] is not None:
            (a, a_error), (b, b_error) = one[clock], other[clock]
            found[clock] = [a / b, a / b * float(np.hypot(a_error / a, b_error / b))]
    return found


def draw_curves(runs: dict, figures: dict) -> Figure:
    """Draw T over N, and its ratio to that of kinetic theory over N and over T_0/T.

    Colours show laws, line styles densities; each thin line is a seed.
    """
    figure = Figure(figsize=(13, 4.6), layout="constrained")
    axes = figure.subplots(1, 3)
    marks = {"color": COLOURS[0], "mec": "k", "ls": "none"}
    for ((packing, e), laws), found, style in zip(
        runs.items(), figures["scenes"].values(), ("-", "--"), strict=False
    ):
        for (law, each), colour in zip(laws.items(), COLOURS, strict=True):
            name = f"ε = {e:g}" if law == "constant" else "viscoelastic"
            for k, run in enumerate(each):
                label = f"φ = {packing:g}, {name}" if k == 0 else None
                look = {"color": colour, "ls": style, "lw": 1.1, "label": label}
                excess = np.exp(run["excess"])
                axes[0].plot(run["collisions"], 1 / run["clock"], **look)
                axes[1].plot(run["collisions"], excess, **look)
                axes[2].plot(run["clock"], excess, **look)
                if k == 0:
                    haff = 1 / excess / run["clock"]
                    axes[0].plot(run["collisions"], haff, color=colour, ls=":", lw=1)
        at = found["constant"]["departures"][f"T over theory's of N by {FACTORS[-1]:g}"]
        point = [at[clock][0] if at[clock] else float("nan") for clock in ("N", "T")]
        ours = axes[0].plot(*point, "o", ms=7, zorder=5, **marks)
        if (packing, e) in PAPER:
            star = axes[0].plot(*PAPER[packing, e], "*", ms=13, zorder=4, **marks)
            star[0].set_label("the paper's $N_c$, $T_c$" if style == "--" else None)
    ours[0].set_label(f"T is {FACTORS[-1]:g} times that of theory")
    axes[0].plot([], [], ":", color=COLOURS_OF["guide"], label="kinetic theory of the same gas")
    every = [run for laws in runs.values() for each in laws.values() for run in each]
    low = min(float(np.min(1 / run["clock"])) for run in every)
    titles = (
        "Disks cool more slowly than kinetic theory",
        "... after different numbers of collisions",
        "... but below nearly the same temperature",
    )
    for axis, title in zip(axes, titles, strict=True):
        axis.set_title(title, fontsize=10, loc="left")
        axis.set(xlabel="collisions per particle N", ylabel="T / T of theory at the same N")
        axis.set(yscale="log", ylim=(0.9, 20))
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set(ylabel="$T/T_0$", ylim=(low / 8, 1.5))
    for axis in axes[1:]:
        axis.axhline(FACTORS[-1], color=COLOURS_OF["guide"], lw=0.8, zorder=0)
        axis.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axis.set_yticks([], minor=True)
    axes[2].set(xscale="log", xlabel="$T_0/T$")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def draw_fields(runs: dict[str, list[dict]], fields: tuple) -> Figure:
    """Draw the density of a scene, smoothed over 1.5 mean distances of disks."""
    figure = Figure(figsize=(2.6 * len(fields) + 0.8, 5.6), layout="constrained")
    axes = figure.subplots(2, len(fields))
    shown = ScalarMappable(Normalize(0.0, 2.5), cmap=colormaps["magma"].resampled(25))
    for (law, (run, *_)), row in zip(runs.items(), axes, strict=True):
        for mark, axis in zip(fields, row, strict=True):
            place = run["positions"][mark]
            pixels = int(len(place) ** 0.5)  # as large as the mean distance of disks
            number = np.histogram2d(*place.T % 1.0, bins=pixels, range=[[0, 1], [0, 1]])[0]
            density = gaussian_filter(number, 1.5, mode="wrap") / number.mean()
            look = {"norm": shown.norm, "cmap": shown.cmap, "origin": "lower"}
            axis.imshow(density.T, interpolation="nearest", **look)
            temperature = 1 / np.interp(mark, run["collisions"], run["clock"])
            axis.set(xticks=[], yticks=[])
            axis.set_title(f"$N$ = {mark:g},  $T/T_0$ = {temperature:.1e}", fontsize=9)
        row[0].set_ylabel("constant $\\varepsilon$" if law == "constant" else "viscoelastic")
    figure.colorbar(shown, ax=axes, shrink=0.7, label="density / mean")
    return figure


def dissolves(options: argparse.Namespace) -> dict:
    config: dict[str, Any] = {"num_particles": 2000, "seeds": (0, 1, 2, 3, 4, 5)}
    until, fields = (26.0, 400.0), (5.0, 50.0, 120.0, 400.0)
    if options.smoke:
        config = {"num_particles": 300, "seeds": (0, 1)}
        until, fields = (8.0, 60.0), (4.0, 60.0)
    runs = runs_of(0.05, 0.6, config, until, fields)
    elastic = mean_error(run["unevenness"][0] for each in runs.values() for run in each)
    figures: dict[str, Any] = {"elastic_unevenness": elastic, "cells_of": PER_CELL}
    for law, each in runs.items():
        grid = np.geomspace(1.0, min(run["collisions"][-1] for run in each), 60)
        figures[law] = shared_figures(each) | {"collisions": grid.tolist()}
        for name in ("unevenness", "flow", "temperature", "excess"):
            values = np.array([smooth(grid, run["collisions"], run[name]) for run in each])
            values /= elastic[0] if name == "unevenness" else 1.0
            figures[law][name] = values.mean(axis=0).tolist()
            error = values.std(axis=0, ddof=1) / len(each) ** 0.5
            figures[law][f"{name}_error"] = error.tolist()
    passes = []
    for run in runs["viscoelastic"]:
        gas = run["gas"]
        lengths = jax.vmap(lambda t, g=gas: g.replace(temperature=t).critical_box)(
            run["temperature"]
        )
        beyond = np.flatnonzero(lengths > gas.box_side(config["num_particles"]))
        passes.append(float(run["collisions"][beyond[0]]) if beyond.size else None)
    figures["critical_box_passes_at"] = passes
    print(f"L_c, of a dilute gas at T, exceeds the box from N = {passes} on (None: not reached)")
    figure = draw_dissolution(runs["viscoelastic"][0], config["num_particles"], fields, figures)
    write_picture(figure, "paper_clustering_dissolves", options, dpi=100)
    return {"config": config | {"until": until}, **figures}


def smooth(grid: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Average y over points within 10 % of each grid point; interpolate if there are none."""
    near = [np.abs(np.log(np.maximum(x, 1e-9) / at)) < 0.1 for at in grid]
    return np.array(
        [y[i].mean() if i.any() else np.interp(at, x, y) for i, at in zip(near, grid, strict=True)]
    )


def draw_dissolution(run: dict, size: int, fields: tuple, figures: dict) -> Figure:
    """Draw density fluctuations and flow over the collisions, and disks at some times."""
    columns = len(fields)
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    grid = figure.add_gridspec(2, 2 * columns, height_ratios=[1.15, 1])
    top = [figure.add_subplot(grid[0, i * columns : (i + 1) * columns]) for i in range(2)]
    labels = "density fluctuations / elastic", "share of the energy in the flow"
    for axis, name, label in zip(top, ("unevenness", "flow"), labels, strict=True):
        for law, colour in zip(LAWS, COLOURS, strict=True):
            x, y, error = (
                np.array(figures[law][key]) for key in ("collisions", name, f"{name}_error")
            )
            axis.plot(x, y, color=colour, lw=1.6, label=law)
            axis.fill_between(x, y - error, y + error, color=colour, alpha=0.25, lw=0)
        if None not in figures["critical_box_passes_at"]:
            at = np.mean(figures["critical_box_passes_at"])
            axis.axvline(at, color="0.5", ls="--", lw=1, label="$L_c$ exceeds the box")
        axis.set(xscale="log", xlabel="collisions per particle N", ylabel=label)
        axis.spines[["top", "right"]].set_visible(False)
    top[0].axhline(1, color="0.7", lw=0.8)
    top[0].legend(frameon=False)
    for i, mark in enumerate(fields):
        axis, place = figure.add_subplot(grid[1, 2 * i : 2 * i + 2]), run["positions"][mark] % 1.0
        width = np.full(len(place), float(run["gas"].diameter / run["gas"].box_side(size)))
        where = {"units": "xy", "offsets": place, "offset_transform": axis.transData}
        disks = EllipseCollection(width, width, 0 * width, color=COLOURS[1], lw=0, **where)
        axis.add_collection(disks)
        temperature = 1 / np.interp(mark, run["collisions"], run["clock"])
        axis.set(xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[], aspect="equal")
        axis.set_title(f"viscoelastic, $N$ = {mark:g}, $T/T_0$ = {temperature:.0e}", fontsize=9)
    return figure


def clustering_film(options: argparse.Namespace) -> dict:
    disks, frames, e = (500, 4, 0.85) if options.smoke else (20_000, 40, 0.85)
    path = options.out / "run.gsd"
    path.unlink(missing_ok=True)  # the trajectory of an earlier film in this folder
    gas = hard_beads(0.245, e, dimension=2)
    # Haff's law: collisions per particle N, T/T_0 = exp(-2 N/N_0), 1 + t/t_0 = exp(N/N_0).
    N_0 = 2 * gas.dimension / (1 - e**2)
    times = N_0 * jnp.expm1(jnp.linspace(0.0, 100.0, frames) / N_0) * gas.mean_free_time

    def spectra(particles: jaxgran.Particles) -> dict:
        where = particles.position, particles.box_side
        k, across, along = observables.flow_spectrum(where[0], particles.velocity, where[1], 8)
        T = observables.temperature(particles.velocity)
        S = observables.structure_factor(*where, 8)[1]
        return {"k": k * gas.diameter, "S": S, "across": across / T, "along": along / T}

    model = jaxgran.HardSpheres(disks)
    curve = jaxgran.cool(gas, times, model=model, save=spectra, trajectory=path)
    results = {
        "disks": disks,
        "restitution": e,
        "collisions": np.asarray(curve.collisions).tolist(),
        "temperature": (np.asarray(curve.temperature) / float(gas.temperature)).tolist(),
        "critical_box": float(gas.critical_box / gas.diameter),
        "box": float(gas.box_side(disks) / gas.diameter),
        **{name: np.asarray(values).tolist() for name, values in curve.saved.items()},
    }
    write_picture(draw_growth(path, results), "clustering_film", options)
    film(path, options.out)
    return results


def density(path: Path, frame: int) -> np.ndarray:
    """Return the density over its mean, in cells of some 9 disks."""
    particles = jaxgran.read_particles(path, frame=frame)
    cells = max(4, int((particles.position.shape[1] / 9) ** 0.5))
    return np.asarray(observables.cell_density(particles.position[0], particles.box_side, cells)).T


def show(axes, values: np.ndarray):
    axes.set(xticks=[], yticks=[])
    return axes.imshow(values, origin="lower", cmap="cividis", vmin=0.0, vmax=3.0)


def draw_growth(path: Path, results: dict) -> Figure:
    """Draw four frames and, below, the growth of flow and clusters."""
    figure = Figure(figsize=(9, 6.2), layout="constrained")
    above, below = np.asarray(figure.subfigures(2, height_ratios=(1, 1.15)), dtype=object)
    panels, x = above.subplots(1, 4), np.asarray(results["collisions"])
    for axes, share in zip(panels, (0.0, 0.2, 0.5, 1.0), strict=True):
        k = int(np.argmin(np.abs(x - share * x[-1])))
        image = show(axes, density(path, k))
        axes.set_title(f"{x[k]:.0f} collisions per disk", fontsize=10)
    above.colorbar(image, ax=panels, label="density over its mean", shrink=0.8)
    growth, spectrum = below.subplots(1, 2)
    for name, label, style in (
        ("across", "flow, transverse", "-"),
        ("along", "flow, longitudinal", "--"),
        ("S", "density, S(k)", ":"),
    ):
        values = np.asarray(results[name])
        growth.plot(x, values[:, :3].mean(axis=1), style, color="black", label=label)
        spectrum.plot(results["k"][0], values[-1], style, color="black", marker=".")
    growth.set(xlabel="collisions per disk", ylabel="mean of the three longest waves", yscale="log")
    growth.legend(frameon=False)
    spectrum.set(xlabel="wavenumber, diameter k", ylabel="at the last frame", yscale="log")
    place = 2 * np.pi / results["critical_box"]
    spectrum.axvline(place, color="0.6", linewidth=1)
    spectrum.annotate("2π/L_c ", (place, 0.95), xycoords=("data", "axes fraction"), ha="right")
    return figure


def film(path: Path, folder: Path) -> None:
    """Write an animated picture of the density, ``film.gif``."""
    frames = []
    for k in itertools.count():
        try:
            frames.append(density(path, k))
        except ValueError:  # past the last frame
            break
    figure = Figure(figsize=(4, 4), layout="constrained")
    image = show(figure.subplots(), frames[0])

    def draw_frame(k: int):
        image.set_data(frames[k])
        return (image,)

    animation = FuncAnimation(figure, draw_frame, len(frames))
    animation.save(folder / "film.gif", writer="pillow", fps=8)
    print(f"written {folder / 'film.gif'}, {len(frames)} frames")


PARTS = {
    "paper_clustering": clustering,
    "paper_clustering_dissolves": dissolves,
    "clustering_film": clustering_film,
}


def main() -> None:
    parser = script_parser(__doc__, "paper_clustering")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--trajectory", type=Path, help="trajectory to film, without a simulation")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    options.out.mkdir(parents=True, exist_ok=True)
    if options.trajectory is not None:
        film(options.trajectory, options.out)
        return
    for name in options.only:
        write_results(name, options, options.out / f"{name}.json", **PARTS[name](options))
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
