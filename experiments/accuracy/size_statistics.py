"""Does T of spheres of unequal sizes cool and scatter as kinetic theory says?

    python experiments/accuracy/size_statistics.py [--runs 800] [--store] [--record] [--out DIR]

Runs of 250 hard spheres (`experiments.fit.wrong_physics.beads`, phi = .03 for spheres of the mean
diameter) until T has fallen to 3 %, by the serial code unlike_spheres.c, which a C compiler (cc)
must be there for: diameters distributed evenly within 10 % of their mean, or two sizes 1 : 1.2 and
1 : 1.4 in equal numbers, and equal spheres. A row has, for T = <v^2>/d and for T by the energy,

- rate: how much faster the runs cool than theory, the mean of ``delta ln T/(d ln T/d ln t)`` over
  the times at which T has fallen to less than .5, and its error;
- variance, lowest, highest: of ln T of the runs, whitened with the covariance of kinetic theory, in
  the mean over the times, at the worst times; neighbours: correlation of neighbouring times.

--store writes means and covariances to ``experiments/data/size_statistics.npz``, which tests read.
"""

import dataclasses
import subprocess
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.fit.wrong_physics import LAST, NUM_PARTICLES, PHI, THEORY, beads, two_sizes
from experiments.support.record import DATA, Options, run_parts
from experiments.support.scenes import cool
from jaxgran.fitting.measured_rows import finite_size_cooling_factor
from jaxgran.theory.sizes import energy_ratio

STORED = DATA / "size_statistics.npz"
NUM_TIMES, NUM_SPEEDS = 30, 4001
SIZES = {
    "within 10 %": np.linspace(0.9, 1.1, NUM_PARTICLES),
    "1 : 1.2": two_sizes(1.2),
    "1 : 1.4": two_sizes(1.4),
}
"""Diameters over their mean."""


def gas_of(sizes: np.ndarray) -> jaxgran.Gas:
    """Return the gas, with the number density of equal spheres of phi = .03."""
    spread = float(np.std(sizes))
    gas = beads().replace(packing_fraction=PHI * (1 + 3 * spread**2))
    return dataclasses.replace(gas, diameter_sd=spread * gas.diameter)


def times_of(gas: jaxgran.Gas) -> np.ndarray:
    """Return times until T of equal spheres has fallen to its last share."""
    trial = jnp.geomspace(1e-2, 1e4, 400) * gas.mean_free_time
    T = cool(gas, trial, THEORY).temperature / gas.temperature
    end = float(jnp.interp(-np.log(LAST), -jnp.log(T), trial))
    return np.geomspace(end / 300, end, NUM_TIMES)


def simulated(sizes: np.ndarray, runs: int, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return times, and T and T by the energy of each run, shape (runs, times, 2)."""
    folder.mkdir(parents=True, exist_ok=True)
    source = Path(__file__).with_name("unlike_spheres.c")
    program, given, found = (folder / name for name in ("unlike_spheres", "input", "output"))
    subprocess.run(["cc", "-O3", "-o", program, source, "-lm"], check=True)
    gas = beads()
    times = times_of(gas)
    speeds = np.linspace(np.log(1e-9), np.log(1e2), NUM_SPEEDS)
    numbers = float(gas.box_side(NUM_PARTICLES)), float(gas.temperature), times.size
    head = [*numbers, float(gas.diameter), speeds[0], speeds[-1]]
    eps = np.asarray(gas.restitution(np.exp(speeds)))
    np.concatenate([head, times, sizes * float(gas.diameter), eps]).tofile(given)
    subprocess.run([program.resolve(), given, str(runs), "1", found], check=True)
    return times, np.fromfile(found).reshape(runs, times.size, 5)[..., :2]


def statistics_of(times: np.ndarray, each: np.ndarray) -> dict[str, np.ndarray]:
    """Return times, number of runs, and the means and covariances of both ln T."""
    logs = np.log(each)
    covariances = np.stack([np.cov(logs[..., k].T) for k in range(2)])
    means = np.mean(logs, axis=0).T
    return {"times": times, "runs": np.array(len(each)), "mean": means, "covariance": covariances}


def compared(sizes: np.ndarray, found: dict[str, np.ndarray]) -> Iterator[dict]:
    """Yield what is printed of the two temperatures."""
    gas, times, runs = gas_of(sizes), found["times"], int(found["runs"])
    faster = float(finite_size_cooling_factor(gas, jnp.asarray(float(NUM_PARTICLES))))
    curve = cool(gas, times * faster, THEORY)
    log_T = np.log(np.asarray(curve.temperature))
    q = jnp.log(curve.size_ratio)
    log_E = log_T + np.log(np.asarray(energy_ratio(gas.size_spread, q)))
    for k, (name, expected) in enumerate({"T": log_T, "energy": log_E}.items()):
        theory = np.asarray(THEORY.covariance(gas, times, NUM_PARTICLES, energy=name == "energy"))
        slope = np.gradient(expected, np.log(times))
        late = expected < expected[0] + np.log(0.5)
        # The mean of ln T is lower than the logarithm of the mean by half the variance.
        off = (found["mean"][k] - expected + np.diag(theory) / 2)[late] / slope[late]
        error = np.sqrt(np.diag(theory)[late] / runs) / np.abs(slope[late])
        root = np.linalg.inv(np.linalg.cholesky(theory))
        white = root @ found["covariance"][k] @ root.T
        variance = np.diag(white)
        yield {
            "temperature": name,
            "rate": float(np.mean(off)),
            "rate_error": float(np.mean(error)),
            "variance": float(np.mean(variance)),
            "lowest": float(np.min(variance)),
            "highest": float(np.max(variance)),
            "neighbours": float(np.mean(np.diag(white, 1))),
        }


def size_statistics(options: Options) -> Iterator[dict]:
    """Simulate each mixture and compare it with kinetic theory."""
    kept = {}
    for name, sizes in SIZES.items():
        found = statistics_of(*simulated(sizes, options.runs, options.out / name))
        kept |= {f"{name}/{field}": x for field, x in found.items()}
        for row in compared(sizes, found):
            yield {"sizes": name, "runs": options.runs} | row
    if options.store:
        np.savez_compressed(STORED, **kept)


if __name__ == "__main__":
    run_parts(__doc__, size_statistics, smoke=False, runs=800, store=False)
