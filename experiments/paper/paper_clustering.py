"""When does a gas depart from Haff's law and cluster, and do its clusters dissolve again?

    python experiments/paper/paper_clustering.py [--only paper_clustering paper_clustering_dissolves
        clustering_film] [--smoke] [--record] [--out DIR]

paper_clustering: the last argument of Brilliantov & Poeschel's self-diffusion paper. Clustering
begins in two gases of disks after different numbers of collisions per particle, N_c = 70 and 23,
but at nearly the same temperature, T_c/T_0 = .0031 and .0027, so that temperature would be the
better clock. Both gases and viscoelastic gases with the same initial cooling rates are simulated
in several replicas. A gas departs from Haff's law when its T, that of all kinetic energy, first
exceeds by a given factor the T of kinetic theory (Enskog, Sonine a_2) at the same number of
collisions per particle, or at the same time. T_c is T at this point.

paper_clustering_dissolves: both kinds of disks in a box two to three times as long as L_c, up to
which a gas stays homogeneous. L_c of the viscoelastic gas grows as the gas cools and its impacts
lose less energy; once it exceeds the box, clusters should dissolve. The box is small because the
number of collisions until then is proportional to the number of disks.

clustering_film: density, structure factor and spectrum of the flow of disks of constant
restitution: the flow grows first, the clusters later.
"""

from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import jaxgran
from experiments.support.analysis import crossing, mean_and_error, ratio, replicas_of, with_error
from experiments.support.plots import CONSTANT, GUIDE, VISCOELASTIC, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import cool, hard_beads, viscoelastic_like
from jaxgran import observables

LAWS = {"constant": CONSTANT, "viscoelastic": VISCOELASTIC}
PAPER = {(0.245, 0.9): (70.0, 0.0031), (0.05, 0.6): (23.0, 0.0027)}
"""N_c and T_c/T_0 that the paper quotes, by packing fraction and restitution."""

PER_CELL = 20
"""Mean number of disks in the cells over which density and flow are measured.

Such a cell is smaller than a cluster."""

FACTORS = (1.1, 2.0)
"""Ratios of T to that of kinetic theory at which a gas counts as departed from it."""

TIMES = 100
"""Number of times at which a gas is recorded."""


def measures(particles: jaxgran.Particles) -> dict:
    """Return the unevenness of the density, the share of flow in the energy, and the positions.

    The unevenness is the variance of the number of disks in a cell over its mean: 1 for independent
    points, less for a fluid. The flow is the energy of the mean velocities of the cells over all
    kinetic energy, less the value expected of independent velocities.
    """
    x, v, side = particles.position, particles.velocity, particles.box_side
    cells = max(2, round((len(x) / PER_CELL) ** 0.5))
    number = observables.cell_density(x, side, cells) * len(x) / cells**2
    mean = jnp.nan_to_num(observables.cell_velocity(x, v, side, cells))
    flow = jnp.sum(number[..., None] * mean**2) / jnp.sum(v**2)
    chance = jnp.count_nonzero(number) / len(x)
    uneven = observables.number_fluctuation(x, side, cells)
    share = (flow - chance) / (1 - chance)
    return {"unevenness": uneven, "flow": share, "position": (x / side % 1).astype(jnp.float32)}


def runs_of(packing: float, e: float, size: int, replicas: int, until: tuple) -> dict[str, dict]:
    """Return the replicas of each law until given times, in mean free times, beside theory.

    Quantities have the shape (replicas, times).
    """
    constant, runs = hard_beads(packing, e, dimension=2), {}
    gases = constant, viscoelastic_like(constant)
    for law, gas, last in zip(LAWS, gases, until, strict=True):
        gamma, model = dissipation(gas), jaxgran.HardSpheres(size, replicas=replicas)
        tau = np.expm1(np.linspace(0.0, np.log1p(gamma * last), TIMES)) / gamma
        curve = cool(gas, tau * float(gas.mean_free_time), model, save=measures)
        log_T = np.log(replicas_of(curve, "temperature") / float(gas.temperature))
        collisions = replicas_of(curve, "collisions")
        trial = np.append(0.0, np.geomspace(1e-2, 1e13, 800))
        theory = cool(gas, trial * float(gas.mean_free_time))
        of_theory = np.log(np.asarray(theory.temperature / gas.temperature))
        runs[law] = {
            "gas": gas,
            "tau": np.broadcast_to(tau, log_T.shape),
            "collisions": collisions,
            "T": np.exp(log_T),
            "excess": log_T - np.interp(collisions, np.asarray(theory.collisions), of_theory),
            "excess_in_time": log_T - np.interp(np.log1p(tau), np.log1p(trial), of_theory),
            **jax.tree.map(np.asarray, curve.replicas.saved),
        }
    return runs


def dissipation(gas: jaxgran.Gas) -> float:
    """Return gamma_0, half of the initial decrease of ln T per collision per particle."""
    return float(jaxgran.KineticTheory().cooling_rate(gas) / gas.collision_frequency) / 2


def crossings(run: dict, quantity: str, level: float) -> list[float]:
    """Return the collisions per particle at which each replica reaches a level; nan if never."""
    return [crossing(N, y, level) for N, y in zip(run["collisions"], run[quantity], strict=True)]


def departures(run: dict, elastic: float) -> dict[str, dict[str, tuple]]:
    """Return N, T/T_0 and nu_0 t of the departure from kinetic theory, by each definition.

    Each is a mean and its standard error, nan if not every replica departed.
    """
    kinds = {f"T over theory's of N by {c:g}": ("excess", np.log(c)) for c in FACTORS}
    kinds |= {f"T over theory's of t by {c:g}": ("excess_in_time", np.log(c)) for c in FACTORS}
    kinds["unevenness over elastic by 2"] = ("unevenness", 2 * elastic)
    found = {}
    for name, kind in kinds.items():
        N = crossings(run, *kind)
        there = {"N": N, "T": at(run, "T", N), "tau": at(run, "tau", N)}
        found[name] = {clock: mean_and_error(each) for clock, each in there.items()}
    return found


def at(run: dict, name: str, collisions: list[float]) -> np.ndarray:
    """Return a positive quantity of each replica at a number of collisions per particle."""
    columns = zip(collisions, run["collisions"][:, 1:], np.log(run[name][:, 1:]), strict=True)
    return np.exp([np.interp(n, x, y, right=np.nan) for n, x, y in columns])


def ratios(one: dict, other: dict) -> dict[str, dict[str, tuple]]:
    """Return the ratio of two departures by each definition in each clock, with its error."""
    return {
        name: {clock: ratio(each[clock], other[name][clock]) for clock in each}
        for name, each in one.items()
    }


def paper_clustering(options: Options) -> dict:
    size, replicas, fields = 20_000, 3, (20.0, 60.0, 95.0, 128.0)
    scenes = {(0.245, 0.9): (2300.0, 3200.0), (0.05, 0.6): (600.0, 1800.0)}
    if options.smoke:
        size, replicas, scenes, fields = 500, 2, {(0.245, 0.6): (60.0, 60.0)}, (4.0, 12.0)
    found: dict = {"config": {"num_particles": size, "replicas": replicas}, "scenes": {}}
    runs = {}
    for scene, until in scenes.items():
        runs[scene] = runs_of(*scene, size, replicas, until)
        name = "phi = {:g}, e = {:g}".format(*scene)
        found["scenes"][name] = analyse(runs[scene], PAPER.get(scene, PAPER[0.245, 0.9])[0])
    if len(scenes) == 2:
        one, other = (scene["constant"]["departures"] for scene in found["scenes"].values())
        found["first_scene_over_second"] = ratios(one, other)
    pictures = {"paper_clustering": draw_curves(runs, found)}
    pictures["paper_clustering_fields"] = draw_fields(next(iter(runs.values())), fields)
    return found | {"picture": pictures}


def analyse(runs: dict[str, dict], n_c: float) -> dict:
    """Return means and errors over the replicas, and the ratios between the laws."""
    start = np.concatenate([run["unevenness"][:, 0] for run in runs.values()])
    found = {
        law: {
            "gamma_0": dissipation(run["gas"]),
            "departures": departures(run, float(np.mean(start))),
            "T_at_the_papers_N": mean_and_error(at(run, "T", [n_c] * len(run["tau"]))),
            "last_flow": mean_and_error(run["flow"][:, -1]),
        }
        for law, run in runs.items()
    }
    one, other = (found[law]["departures"] for law in LAWS)
    return found | {"viscoelastic_over_constant": ratios(other, one)}


def draw_curves(runs: dict, found: dict):
    """Draw T over N, and its ratio to that of kinetic theory over N and over T_0/T.

    Colours show laws, line styles densities; each thin line is a replica.
    """
    figure, (cooling, by_number, by_clock) = panels(3, size=(4.4, 4.6))
    for (scene, laws), style in zip(runs.items(), ("-", "--"), strict=False):
        for law, run in laws.items():
            name = f"ε = {scene[1]:g}" if law == "constant" else "viscoelastic"
            N, T, excess = run["collisions"].T, run["T"].T, np.exp(run["excess"]).T
            look = {"color": LAWS[law], "ls": style, "lw": 1.1}
            lines = cooling.plot(N, T, **look)
            lines[0].set_label(f"φ = {scene[0]:g}, {name}")
            by_number.plot(N, excess, **look)
            by_clock.plot(1 / T, excess, **look)
            cooling.plot(N[:, 0], (T / excess)[:, 0], color=LAWS[law], ls=":", lw=1)
    name = f"T over theory's of N by {FACTORS[-1]:g}"
    left = [scene["constant"]["departures"][name] for scene in found["scenes"].values()]
    N, T = ([one[clock][0] for one in left] for clock in "NT")
    marks: dict = {"color": CONSTANT, "mec": "k", "zorder": 5}
    cooling.plot(N, T, "o", ms=7, label="T is twice that of theory", **marks)
    N, T = np.transpose(list(PAPER.values()))
    cooling.plot(N, T, "*", ms=13, label="the paper's $N_c$, $T_c$", **marks)
    cooling.plot([], [], ":", color=GUIDE, label="kinetic theory of the same gas")
    number = {"xlabel": "collisions per particle N"}
    labels = {"ylabel": "$T/T_0$", "yscale": "log", "ylim": (2e-5, 1.5)}
    caption(cooling, "Disks cool more slowly than kinetic theory", "none", **labels, **number)
    labels |= {"ylabel": "T / T of theory at the same N", "ylim": (0.9, 20)}
    caption(by_number, "... after different numbers of collisions", **labels, **number)
    labels |= {"xlabel": "$T_0/T$", "xscale": "log"}
    caption(by_clock, "... but below nearly the same temperature", **labels)
    for axes in (by_number, by_clock):
        axes.axhline(FACTORS[-1], color=GUIDE, lw=0.8, zorder=0)
        axes.set_yticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axes.set_yticks([], minor=True)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return figure


def draw_density(axes, density: np.ndarray, title: str):
    """Draw the density over its mean as an image."""
    image = axes.imshow(density.T, origin="lower", cmap="magma", vmin=0.0, vmax=2.5)
    axes.set(xticks=[], yticks=[])
    axes.set_title(title, fontsize=9)
    return image


def draw_fields(runs: dict[str, dict], fields: tuple):
    """Draw the density of a scene, smoothed over 1.5 mean distances of disks."""
    figure, places = panels(len(fields), 2, size=(2.8, 2.8))
    for axes, ((law, run), mark) in zip(places, product(runs.items(), fields), strict=True):
        place, title = nearest(run, mark)
        pixels = int(len(place) ** 0.5)  # as large as the mean distance of disks
        number = np.histogram2d(*place.T, bins=pixels, range=[[0, 1], [0, 1]])[0]
        density = gaussian_filter(number, 1.5, mode="wrap") / number.mean()
        image = draw_density(axes, density, title)
        if mark == fields[0]:
            axes.set_ylabel(f"{law} ε")
    figure.colorbar(image, ax=places, shrink=0.7, label="density / mean")
    return figure


def nearest(run: dict, collisions: float) -> tuple[np.ndarray, str]:
    """Return the positions of a replica next to a number of collisions, and a title."""
    k = int(np.argmin(np.abs(run["collisions"][0] - collisions)))
    N, T = run["collisions"][0, k], run["T"][0, k]
    return run["position"][0, k], f"$N$ = {N:.0f},  $T/T_0$ = {T:.1e}"


def paper_clustering_dissolves(options: Options) -> dict:
    size, replicas, until, fields = 2000, 6, (260.0, 4e6), (5.0, 50.0, 120.0, 400.0)
    if options.smoke:
        size, replicas, until, fields = 300, 2, (20.0, 800.0), (4.0, 60.0)
    runs = runs_of(0.05, 0.6, size, replicas, until)
    elastic = np.mean([run["unevenness"][:, 0] for run in runs.values()])
    found: dict = {"config": {"num_particles": size, "replicas": replicas}}
    for law, run in runs.items():
        grid = np.geomspace(1.0, run["collisions"][:, -1].min(), 60)
        found[law] = {"gamma_0": dissipation(run["gas"]), "collisions": grid}
        for name, unit in (("unevenness", elastic), ("flow", 1.0), ("excess", 1.0)):
            pairs = zip(run["collisions"], run[name] / unit, strict=True)
            found[law] |= with_error(name, [smooth(grid, x, y) for x, y in pairs])
    run = runs["viscoelastic"]
    gas = run["gas"]
    lengths = jnp.vectorize(lambda T: gas.replace(temperature=T * gas.temperature).critical_box)
    run["critical_box"] = np.asarray(lengths(run["T"]) / gas.box_side(size))
    found["critical_box_passes_at"] = crossings(run, "critical_box", 1.0)
    return found | {"picture": draw_dissolution(run, size, fields, found)}


def smooth(grid: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Average y over points within 10 % of each grid point; interpolate if there are none."""
    near = np.abs(np.log(np.maximum(x, 1e-9) / grid[:, None])) < 0.1
    means = near @ y / np.maximum(near.sum(axis=1), 1)
    return np.where(near.any(axis=1), means, np.interp(grid, x, y))


def draw_dissolution(run: dict, size: int, fields: tuple, found: dict):
    """Draw density fluctuations and flow over the collisions, and disks at some times."""
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    above, below = np.asarray(figure.subfigures(2, height_ratios=(1.15, 1)), dtype=object)
    labels = "density fluctuations / elastic", "share of the energy in the flow"
    for axes, name, label in zip(above.subplots(1, 2), ("unevenness", "flow"), labels, strict=True):
        for law, colour in LAWS.items():
            x, y, error = (found[law][key] for key in ("collisions", name, f"{name}_error"))
            axes.plot(x, y, color=colour, lw=1.6, label=law)
            axes.fill_between(x, y - error, y + error, color=colour, alpha=0.25, lw=0)
        mean = np.mean(found["critical_box_passes_at"])
        axes.axvline(mean, color="0.5", ls="--", lw=1, label="$L_c$ exceeds the box")
        caption(axes, xscale="log", xlabel="collisions per particle N", ylabel=label)
    above.axes[0].axhline(1, color="0.7", lw=0.8)
    for mark, axes in zip(fields, below.subplots(1, len(fields)), strict=True):
        place, title = nearest(run, mark)
        width = np.full(len(place), float(run["gas"].diameter / run["gas"].box_side(size)))
        where = {"units": "xy", "offsets": place, "offset_transform": axes.transData}
        disks = EllipseCollection(width, width, 0 * width, color=VISCOELASTIC, lw=0, **where)
        axes.add_collection(disks)
        axes.set(xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[], aspect="equal")
        axes.set_title(f"viscoelastic, {title}", fontsize=9)
    return figure


def clustering_film(options: Options) -> dict:
    disks, frames, e = (500, 4, 0.85) if options.smoke else (20_000, 40, 0.85)
    gas, cells = hard_beads(0.245, e, dimension=2), max(4, int((disks / 9) ** 0.5))
    # Haff's law: collisions per particle N, T/T_0 = exp(-2 N/N_0), 1 + t/t_0 = exp(N/N_0).
    N_0 = 2 * gas.dimension / (1 - e**2)
    times = N_0 * jnp.expm1(jnp.linspace(0.0, 100.0, frames) / N_0) * gas.mean_free_time

    def spectra(particles: jaxgran.Particles) -> dict:
        x, v, side = particles.position, particles.velocity, particles.box_side
        k, across, along = observables.flow_spectrum(x, v, side, 8)
        T = observables.temperature(v)
        waves = {"k": k * gas.diameter, "across": across / T, "along": along / T}
        waves["S"] = observables.structure_factor(x, side, 8)[1]
        return waves | {"density": observables.cell_density(x, side, cells)}

    curve = cool(gas, times, jaxgran.HardSpheres(disks), save=spectra)
    saved = jax.tree.map(np.asarray, curve.saved)
    density = saved.pop("density")
    results = {
        "disks": disks,
        "restitution": e,
        "collisions": np.asarray(curve.collisions),
        "temperature": curve.temperature / gas.temperature,
        "critical_box": float(gas.critical_box / gas.diameter),
        "box": gas.box_side(disks) / gas.diameter,
        **saved,
    }
    return results | {"picture": draw_growth(density, results)}


def draw_growth(density: np.ndarray, results: dict):
    """Draw four frames and, below, the growth of flow and clusters."""
    figure = Figure(figsize=(9, 6.2), layout="constrained")
    above, below = np.asarray(figure.subfigures(2, height_ratios=(1, 1.15)), dtype=object)
    frames, x = above.subplots(1, 4), results["collisions"]
    for axes, share in zip(frames, (0.0, 0.2, 0.5, 1.0), strict=True):
        k = int(np.argmin(np.abs(x - share * x[-1])))
        image = draw_density(axes, density[k], f"{x[k]:.0f} collisions per disk")
    above.colorbar(image, ax=frames, label="density over its mean", shrink=0.8)
    growth, spectrum = below.subplots(1, 2)
    styles = {"flow, transverse": ("across", "-"), "flow, longitudinal": ("along", "--")}
    for label, (name, style) in (styles | {"density, S(k)": ("S", ":")}).items():
        growth.plot(x, results[name][:, :3].mean(axis=1), style, color="black", label=label)
        spectrum.plot(results["k"][0], results[name][-1], style, color="black", marker=".")
    label = "mean of the three longest waves"
    caption(growth, xlabel="collisions per disk", ylabel=label, yscale="log")
    place = 2 * np.pi / results["critical_box"]
    spectrum.axvline(place, color="0.6", linewidth=1)
    spectrum.annotate("2π/L_c ", (place, 0.95), xycoords=("data", "axes fraction"), ha="right")
    caption(spectrum, xlabel="wavenumber, diameter k", ylabel="at the last frame", yscale="log")
    return figure


if __name__ == "__main__":
    run_parts(__doc__, paper_clustering, paper_clustering_dissolves, clustering_film)
