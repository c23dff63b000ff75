"""A film of a gas that clusters, from a trajectory in one run and one compilation.

    python experiments/paper/clustering_film.py [--disks 20000] [--restitution .85] [--smoke]
        [--record] [--out DIR]
    python experiments/paper/clustering_film.py --trajectory FILE.gsd [--out DIR]

Simulates hard disks of constant restitution, writes their trajectory (GSD, which OVITO, freud and
VMD read, too) and draws its density: a film, and a picture of four frames. At each frame the run
also saves the structure factor and the spectrum of the flow (``cool(save=...)``), which the picture
shows too: the flow grows first, the clusters later. With --trajectory only the film of another
trajectory is made.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.animation import FuncAnimation
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import add_recording, write_picture, write_results
from experiments.support.scenes import hard_beads
from jaxgran import observables

PACKING_FRACTION = 0.245
COLLISIONS = 100.0
"""Collisions per particle until the end."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--disks", type=int, default=20_000)
    parser.add_argument("--restitution", type=float, default=0.85)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--smoke", action="store_true", help="few disks, few frames")
    parser.add_argument("--trajectory", type=Path, help="trajectory to film, without a simulation")
    parser.add_argument("--out", type=Path, default=Path("results") / "clustering_film")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.smoke:
        options.disks, options.frames = 500, 4
    options.out.mkdir(parents=True, exist_ok=True)
    if options.trajectory is not None:
        film(options.trajectory, options.out)
        return
    path = options.out / "run.gsd"
    path.unlink(missing_ok=True)  # the trajectory of an earlier film in this folder
    results = simulate(options, path)
    write_results("clustering_film", options, options.out / "clustering_film.json", **results)
    draw(path, results, options)
    film(path, options.out)


def simulate(options: argparse.Namespace, path: Path) -> dict:
    """Write the trajectory; return the spectra at its frames and the seconds of the run."""
    gas = hard_beads(PACKING_FRACTION, options.restitution, dimension=2)
    # Haff's law: collisions per particle N, T/T_0 = exp(-2 N/N_0), 1 + t/t_0 = exp(N/N_0).
    N_0 = 2 * gas.dimension / (1 - options.restitution**2)
    collisions = jnp.linspace(0.0, COLLISIONS, options.frames)
    times = N_0 * jnp.expm1(collisions / N_0) * gas.mean_free_time

    def spectra(particles: jaxgran.Particles) -> dict:
        where = particles.position, particles.box_side
        k, across, along = observables.flow_spectrum(
            particles.position, particles.velocity, particles.box_side, 8
        )
        T = observables.temperature(particles.velocity)
        S = observables.structure_factor(*where, 8)[1]
        return {"k": k * gas.diameter, "S": S, "across": across / T, "along": along / T}

    begin = time.perf_counter()
    curve = jaxgran.cool(
        gas, times, model=jaxgran.HardSpheres(options.disks), save=spectra, trajectory=path
    )
    seconds = time.perf_counter() - begin
    print(f"{options.disks} disks, {len(times)} frames in {seconds:.0f} s, compilation included")
    saved = {name: np.asarray(values).tolist() for name, values in curve.saved.items()}
    return {
        "disks": options.disks,
        "restitution": options.restitution,
        "collisions": np.asarray(curve.collisions).tolist(),
        "temperature": (np.asarray(curve.temperature) / float(gas.temperature)).tolist(),
        "critical_box": float(gas.critical_box / gas.diameter),
        "box": float(gas.box_side(options.disks) / gas.diameter),
        "seconds": seconds,
        **saved,
    }


def density(path: Path, frame: int) -> np.ndarray:
    """Return the density over its mean, in cells of some 9 disks."""
    particles = jaxgran.read_particles(path, frame=frame)
    cells = max(4, int((particles.position.shape[1] / 9) ** 0.5))
    return np.asarray(observables.cell_density(particles.position[0], particles.box_side, cells))


def number_of_frames(path: Path) -> int:
    k = 0
    while True:
        try:
            jaxgran.read_particles(path, frame=k)
        except ValueError:
            return k
        k += 1


def show(axes, values: np.ndarray):
    axes.set(xticks=[], yticks=[])
    return axes.imshow(values.T, origin="lower", cmap="cividis", vmin=0.0, vmax=3.0)


def draw(path: Path, results: dict, options: argparse.Namespace) -> None:
    """Draw four frames and, below, the growth of flow and clusters."""
    figure = Figure(figsize=(9, 6.2), layout="constrained")
    above, below = np.asarray(figure.subfigures(2, height_ratios=(1, 1.15)), dtype=object)
    panels = above.subplots(1, 4)
    found = np.asarray(results["collisions"])
    for axes, share in zip(panels, (0.0, 0.2, 0.5, 1.0), strict=True):
        k = np.argmin(np.abs(found - share * found[-1]))
        image = show(axes, density(path, int(k)))
        axes.set_title(f"{results['collisions'][k]:.0f} collisions per disk", fontsize=10)
    above.colorbar(image, ax=panels, label="density over its mean", shrink=0.8)
    growth, spectrum = below.subplots(1, 2)
    x = results["collisions"]
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
    spectrum.axvline(2 * np.pi / results["critical_box"], color="0.6", linewidth=1)
    place = 2 * np.pi / results["critical_box"], 0.95
    spectrum.annotate("2π/L_c ", place, xycoords=("data", "axes fraction"), ha="right")
    write_picture(figure, "clustering_film", options)


def film(path: Path, folder: Path) -> None:
    """Write an animated picture of the density, ``film.gif``."""
    count = number_of_frames(path)
    figure = Figure(figsize=(4, 4), layout="constrained")
    axes = figure.subplots()
    image = show(axes, density(path, 0))

    def draw_frame(k: int):
        image.set_data(density(path, k).T)
        return (image,)

    FuncAnimation(figure, draw_frame, count).save(folder / "film.gif", writer="pillow", fps=8)
    print(f"written {folder / 'film.gif'}, {count} frames")


if __name__ == "__main__":
    main()
