"""How often does a 95 % interval contain the true A, for single runs of few particles?

    python experiments/fit/interval_coverage.py [--runs 600] [--models dsmc hard-spheres]
        [--numbers 100 500] [--phis 0.02 0.05] [--record] [--out FILE]

Each run is one realisation of N particles (beta_T0 = .18, t_c/tau_c = .001) for 100 mean free
times, in which T falls to a few per cent. It gives 30 values of T without errors, as one film of
one experiment does. Kinetic theory is fitted to each run with A and T_0 free and N given. DSMC
chooses new partners for each collision, so that its runs are fitted by kinetic theory of molecular
chaos (`correlations=False`). The standard error of the mean of 600 runs (200 of soft spheres) is
.04 (.07) of that of one run.

Prints the bias of ln A and its standard error, the scatter of ln A, the scatter that the error
budget predicts without the model's clock, which is the same in all runs, and the coverage by the
whole budget.
"""

import argparse
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.record import add_recording, figures, write_results
from experiments.support.scenes import beads

BETA, CONTACT, END, POINTS = 0.18, 0.001, 100.0, 30
KINDS = {
    "dsmc": jaxgran.DSMC,
    "hard-spheres": jaxgran.HardSpheres,
    "soft-spheres": jaxgran.SoftSpheres,
}
RUNS = {"soft-spheres": 200}  # which take an hour for 600
THEORIES = {"dsmc": jaxgran.KineticTheory(correlations=False)}
HEADINGS = (
    "model of the runs",
    "N",
    "φ",
    "bias of A, %",
    "bias over σ",
    "scatter of A, %",
    "expected scatter, %",
    "95 % intervals that contain A",
)
IN_CLUSTERS = """\
Soft spheres with derivatives by differences, fitted to LAMMPS runs of 1000 spheres at φ = .3,
β = .2, in which a flow grows (`python experiments/fit/coverage_in_clusters.py`):"""
HEAD = "\n".join((" | ".join(("", *HEADINGS, "")).strip(), "|" + "---|" * len(HEADINGS)))


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--runs", type=int, help="runs of each gas (default: 600; 200 of soft spheres)"
    )
    parser.add_argument("--models", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--numbers", nargs="+", type=int, default=[100, 500])
    parser.add_argument("--phis", nargs="+", type=float, default=[0.02, 0.05])
    parser.add_argument("--out", type=Path, help="file for the table")
    add_recording(parser)
    options = parser.parse_args()
    rows = []
    print(HEAD, flush=True)
    for name in options.models:
        for number in options.numbers:
            for phi in options.phis:
                runs = options.runs or RUNS.get(name, 600)
                found = coverage(name, number, phi, runs)
                rows.append({"model": name, "num_particles": number, "phi": phi, **found})
                print(row(rows[-1]), flush=True)
                write_results("interval_coverage", options, None, rows=with_recorded(rows))
    if options.out is not None:
        options.out.write_text(table({"rows": rows}), encoding="utf-8")


def with_recorded(rows: list[dict]) -> list[dict]:
    """Return these rows and the recorded rows of other gases, in the order of the table."""

    def gas(row: dict) -> tuple:
        return list(KINDS).index(row["model"]), row["num_particles"], row["phi"]

    try:
        recorded = figures("interval_coverage")["rows"]
    except FileNotFoundError:
        recorded = []
    return sorted(({gas(x): x for x in (*recorded, *rows)}).values(), key=gas)


def table(results: dict) -> str:
    """Return the table of all rows."""
    return "\n".join([HEAD, *map(row, results["rows"])]) + "\n"


def coverage(name: str, num_particles: int, phi: float, runs: int) -> dict[str, float]:
    """Return statistics of the fits of single runs of a model, one of `KINDS`."""
    gas = beads(phi, BETA, CONTACT)
    times = jnp.geomspace(0.3, END, POINTS) * gas.mean_free_time
    model = KINDS[name](num_particles, replicas=runs)
    theory = THEORIES.get(name, jaxgran.KineticTheory())
    key = jax.random.key(num_particles)
    curve = jaxgran.cool(gas, times, model=model, key=key, progress=False)
    assert curve.replicas is not None
    truth = float(gas.value("dissipative_constant"))
    ratio, error, chance = [], [], []
    for T in np.asarray(curve.replicas.temperature):
        single = jaxgran.CoolingCurve(times=times, temperature=T)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            result = jaxgran.fit(gas, single, model=theory, num_particles=num_particles)
        parts = {name: float(part[0]) / truth for name, part in result.error_budget.items()}
        ratio.append(float(result.estimate[0]) / truth)
        error.append(float(result.standard_error[0]) / truth)
        chance.append(np.hypot(parts["measurement"], parts["few particles"]))
    ratio, error = np.array(ratio), np.array(error)
    log_ratio = np.log(ratio)
    return {
        "bias": float(log_ratio.mean()),
        "bias_error": float(log_ratio.std() / runs**0.5),
        "bias_over_error": float(np.mean((ratio - 1) / error)),
        "scatter": float(log_ratio.std()),
        "expected_scatter": float(np.sqrt(np.mean(np.square(chance)))),
        "coverage": float(np.mean(np.abs(ratio - 1) < 1.959964 * error)),
        "runs": runs,
    }


def row(found: dict) -> str:
    """Format a line of the table."""
    cells = (
        found["model"].replace("-", " "),
        f"{found['num_particles']}",
        f"{found['phi']:g}",
        f"{100 * found['bias']:+.1f} ± {100 * found['bias_error']:.1f}",
        f"{found['bias_over_error']:+.2f}",
        f"{100 * found['scatter']:.1f}",
        f"{100 * found['expected_scatter']:.1f}",
        f"{100 * found['coverage']:.1f} %",
    )
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
