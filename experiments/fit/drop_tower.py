"""What could a published drop-tower experiment say about A? Its numbers, and a simulation.

    python experiments/fit/drop_tower.py [--runs 6] [--out DIR]

Published (T. Trittel, D. Puzyrev, K. Harth & R. Stannarius, npj Microgravity (2024),
doi 10.1038/s41526-024-00420-5, abstract): equal spheres in a drop tower; after the excitation stops
the kinetic energy falls to about 5 % in three Haff times; the rotational degrees of freedom hold
about 2/3 of the energy of the translational ones, and cool at the same rate.

The abstract does not give these values, which are assumed: 300 polymer spheres of 6 mm in a cube of
100 mm, T_0 = .01 m^2/s^2, Y = 2 GPa, an A for which eps is .85 at the initial thermal speed, walls
of eps = .85, and beta_t = 0 of spheres and walls, for which T_rot/T stays near 2/3 in kinetic
theory.

Prints the values that the published numbers alone allow. Then simulates single runs of hard, rough
spheres between walls, adds errors of 5 % to T and T_rot, and fits each run twice with kinetic
theory: as smooth spheres without walls, and as rough spheres between walls with beta_t free.
"""

import argparse
import dataclasses
import sys
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import add_recording, write_picture, write_results
from jaxgran.plotting import COLOURS

NUM_PARTICLES, DIAMETER, SIDE = 300, 6e-3, 0.1
EPS, BETA_T, RATIO = 0.85, 0.0, 2 / 3
POINTS, ERROR = 30, 0.05


def scene() -> jaxgran.Gas:
    """Return the simulated gas."""
    law = jaxgran.Viscoelastic(2e9, 0.4, 1e-6)
    gas = jaxgran.Gas(
        law,
        diameter=DIAMETER,
        mass=jaxgran.sphere_mass(DIAMETER, 1050.0),
        packing_fraction=NUM_PARTICLES * np.pi / 6 * (DIAMETER / SIDE) ** 3,
        temperature=0.01,
        surface=jaxgran.Rough(BETA_T, rotational_temperature=RATIO * 0.01),
        container=jaxgran.Walls(SIDE, restitution=EPS, tangential_restitution=BETA_T),
    )
    low, high = 1e-9, 1e-2  # of A: eps falls with it
    for _ in range(60):
        A = (low * high) ** 0.5
        eps = float(gas.replace(dissipative_constant=A).restitution(gas.impact_speed))
        low, high = (A, high) if eps > EPS else (low, A)
    return gas.replace(dissipative_constant=A)


def steady_ratio(eps: float, beta: np.ndarray, q: float = 0.4) -> np.ndarray:
    """Return the steady T_rot/T of constant eps and beta_t: Santos, Kremer & Garzo (2010)."""
    c = (1 + q) ** 2 / (2 * q * (1 + beta) ** 2)
    c *= 1 - eps**2 - (1 - q) / (1 + q) * (1 - beta**2)
    return c + np.sqrt(1 + c * c)


def allowed_pairs() -> list[tuple[float, list[float]]]:
    """Return, for each eps, the beta_t at which the steady T_rot/T is the published value."""
    grid = np.linspace(-0.95, 1.0, 4000)
    found = []
    for eps in (1.0, 0.95, 0.9, 0.85, 0.8, 0.7):
        ratio = steady_ratio(eps, grid) - RATIO
        crossings = np.flatnonzero(ratio[1:] * ratio[:-1] < 0)
        found.append((eps, [float(grid[i]) for i in crossings]))
    return found


def twin(gas: jaxgran.Gas, key: int) -> jaxgran.CoolingCurve:
    """Simulate a single run of hard spheres, with errors of T and T_rot."""
    theory = jaxgran.cool(gas, np.geomspace(0.01, 100.0, 400))
    fallen = np.asarray(theory.temperature) < 0.05 * float(gas.temperature)
    end = float(theory.times[np.argmax(fallen)])
    times = np.linspace(end / POINTS, end, POINTS)
    model = jaxgran.HardSpheres(NUM_PARTICLES)
    exact = jaxgran.cool(gas, times, model=model, key=jax.random.key(key))
    rng = np.random.default_rng(key)
    T, T_rot = (
        jnp.asarray(x) * np.exp(ERROR * rng.standard_normal(POINTS))
        for x in (exact.temperature, exact.rotational_temperature)
    )
    return jaxgran.CoolingCurve(
        times=jnp.asarray(times),
        temperature=T,
        temperature_error=ERROR * T,
        rotational_temperature=T_rot,
        rotational_temperature_error=ERROR * T_rot,
    )


def main() -> int:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=6, help="single runs (default: 6)")
    parser.add_argument(
        "--out", type=Path, default=Path("results") / "drop_tower", help="folder of the picture"
    )
    add_recording(parser)
    options = parser.parse_args()
    start_time, gas = time.perf_counter(), scene()
    A = float(gas.value("dissipative_constant"))
    print("T_rot/T = 2/3 alone allows these pairs (constant eps, Maxwellian):")
    for eps, betas in allowed_pairs():
        print(f"  eps = {eps:4.2f}: beta_t = {' or '.join(f'{b:.2f}' for b in betas) or 'none'}")
    print(
        f"simulation: phi = {float(gas.packing_fraction):.3f}, mean free path "
        f"{1e3 * float(gas.mean_free_path):.0f} mm in a cube of {1e3 * SIDE:.0f} mm, A = {A:.3g} s"
    )
    rows, curves = [], []
    for key in range(options.runs):
        curve = twin(gas, key)
        curves.append(curve)
        rows.append(row(gas, curve))
        smooth, complete = rows[-1]
        print(
            f"run {key}: smooth, no walls: A = {in_words(smooth, A)}; "
            f"complete scene: A = {in_words(complete, A)}, beta_t = {complete.estimate[1]:.2f} +- "
            f"{complete.standard_error[1]:.2f} (p = {float(complete.p_value):.2g})"
        )
    ratio = np.asarray(curves[0].rotational_temperature / curves[0].temperature)
    print(f"T_rot/T of run 0: {ratio.mean():.2f} +- {ratio.std():.2f}, published value about .67")
    held = [
        abs(float(complete.estimate[0]) - A) < 1.96 * float(complete.standard_error[0])
        for _, complete in rows
    ]
    right = [float(complete.estimate[0]) / A for _, complete in rows]
    none = sum(bool(smooth.undetermined()) for smooth, _ in rows)
    print(
        f"smooth, no walls: A is not determined in {none} of {len(rows)} runs, since such spheres"
    )
    print("  do not cool so fast, however inelastic they are;")
    print(
        f"complete scene: {np.mean(right):.2f} times the true A; 95 % intervals hold it in "
        f"{sum(held)} of {len(held)}"
    )
    write_picture(draw(gas, curves[0], rows[0]), "drop_tower", options)
    write_results(
        "drop_tower",
        options,
        None,
        A_over_true=right,
        error_over_true=[float(complete.standard_error[0]) / A for _, complete in rows],
        held=sum(held),
        runs=len(rows),
        smooth_undetermined=none,
        smooth_over_true=[float(s.estimate[0]) / A for s, _ in rows if not s.undetermined()],
    )
    print(f"{time.perf_counter() - start_time:.0f} s")
    return 0


def in_words(result: jaxgran.Fit, A: float) -> str:
    """Format A and its error over the true A."""
    if "dissipative_constant" in result.undetermined():
        return "not determined"
    return f"{result.estimate[0] / A:.2f} +- {result.standard_error[0] / A:.2f}"


def row(gas: jaxgran.Gas, curve: jaxgran.CoolingCurve) -> tuple[jaxgran.Fit, jaxgran.Fit]:
    """Fit a run as smooth spheres without walls, and with the complete scene."""
    smooth = dataclasses.replace(gas, surface=None, container=None)
    alone = dataclasses.replace(
        curve, rotational_temperature=None, rotational_temperature_error=None
    )
    free = ("dissipative_constant", "temperature")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that A is not determined is printed
        first = jaxgran.fit(
            smooth.replace(dissipative_constant=0.0), alone, free=free, num_particles=NUM_PARTICLES
        )
        unknown = gas.replace(dissipative_constant=0.0, tangential_restitution=0.0)
        free = ("dissipative_constant", "tangential_restitution", "rotational_temperature")
        complete = jaxgran.fit(unknown, curve, free=free, num_particles=NUM_PARTICLES)
    return first, complete


def draw(gas, curve, fits) -> Figure:
    """Draw T and T_rot of a run, with both fits."""
    smooth, complete = fits
    A = float(gas.value("dissipative_constant"))
    figure = Figure(figsize=(7.0, 4.6), layout="constrained")
    axis = figure.subplots()
    bars = {"fmt": "o", "markersize": 4, "capsize": 2}
    for values, error, color, label in (
        (
            curve.temperature,
            curve.temperature_error,
            COLOURS["measured"],
            "$T$, one simulated run",
        ),
        (
            curve.rotational_temperature,
            curve.rotational_temperature_error,
            COLOURS["guide"],
            r"$T_\mathrm{rot}$, the same run",
        ),
    ):
        axis.errorbar(curve.times, values, error, color=color, label=label, **bars)
    found = [in_words(fit, A).replace("+-", "±") for fit in (complete, smooth)]
    label = f"rough spheres between walls: A over the true A {found[0]}"
    axis.plot(curve.times, complete.curve.temperature, color=COLOURS["kinetic theory"], label=label)
    axis.plot(
        curve.times,
        complete.curve.rotational_temperature,
        color=COLOURS["kinetic theory"],
        linestyle=":",
    )
    label = f"smooth spheres, no walls: A over the true A {found[1]}"
    axis.plot(
        curve.times,
        smooth.curve.temperature,
        color=COLOURS["kinetic theory"],
        linestyle="--",
        lw=1,
        label=label,
    )
    axis.set_yscale("log")
    axis.set_xlabel("t (s)")
    axis.set_ylabel("temperature (m²/s²)")
    axis.legend(frameon=False, fontsize=9)
    axis.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    sys.exit(main())
