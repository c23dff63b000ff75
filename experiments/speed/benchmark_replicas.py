"""How much faster are two replicas on two CPU devices than on one core?

    python experiments/speed/benchmark_replicas.py [--size 4096] [--smoke] [--out FILE] [--record]

Two replicas are run in three processes: on one core; on all cores with one device, with the
replicas in one array; and on two CPU devices, one replica on each. Soft and hard spheres
equilibrate for 10 mean free times. The cooling time is chosen for runs of one to two seconds; DSMC
simulates a weakly dissipative gas. Times are medians without compilation, and an equilibration
counts as 10 collisions per particle.
"""

import argparse
import json
import os
from pathlib import Path

import jax
import numpy as np

from experiments.support.apart import alone
from experiments.support.record import add_recording, seconds, write_results

CASES = ("one core", "one device", "two devices")
MODELS = ("SoftSpheres", "HardSpheres", "DSMC")
COOLING = {"SoftSpheres": 25.0, "HardSpheres": 100.0, "DSMC": 500.0}
"""Mean free times of cooling."""

REPEATS = 3


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=4096, help="particles of a replica")
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    add_recording(parser)
    options = parser.parse_args()
    if options.smoke:
        options.size = 100
    if options.measure:
        case, model = options.measure
        print(json.dumps(measure(case, model, options.size, 1 if options.smoke else REPEATS)))
        return
    jax.config.update("jax_enable_x64", True)
    rows = []
    for model in MODELS[-1:] if options.smoke else MODELS:
        row: dict = {"model": model, "num_particles": options.size, "replicas": 2}
        size = ["--size", str(options.size), *(["--smoke"] if options.smoke else [])]
        row |= {case: alone(__file__, *size, "--measure", case, model) for case in CASES}
        row["ratio"] = row[CASES[2]]["collisions_per_s"] / row[CASES[0]]["collisions_per_s"]
        rows.append(row)
        rates = ", ".join(f"{case} {row[case]['collisions_per_s']:.0f}" for case in CASES)
        print(f"{model}: collisions/s {rates}; two devices {row['ratio']:.2f} times one core")
    write_results("benchmark_replicas", options, options.out, rows=rows)


def measure(case: str, name: str, size: int, repeats: int) -> dict:
    if case == "one core":
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if case == "two devices":
        jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_enable_x64", True)
    import jaxgran
    from experiments.support.scenes import beads

    gas = beads(0.1, 0.01 if name == "DSMC" else 0.15, contact_fraction=0.01)
    model = getattr(jaxgran, name)(size, replicas=2)
    times = np.array([COOLING[name]]) * float(gas.mean_free_time)

    def cooled():
        collisions = jaxgran.cool(gas, times, model=model, progress=False).collisions
        assert collisions is not None
        return collisions

    compile_s, run_s = seconds(cooled, repeats)
    collisions = float(cooled()[-1]) + (0 if name == "DSMC" else 10)
    return {
        "compile_s": compile_s,
        "run_s": run_s,
        "collisions_per_s": collisions * size / run_s,
    }


if __name__ == "__main__":
    main()
