"""How fast is DSMC, and what does a derivative cost?

    python experiments/speed/benchmark_dsmc.py [--sizes 10000 100000 1000000] [--smoke] [--out FILE]

A homogeneous gas of viscoelastic spheres cools for some collisions per particle. Times are medians
of repeated runs; compilation is timed separately. The derivative of the whole curve in A is
computed by forward mode; it and the plain run are each compiled as one program. For comparison the
speed of DynamO, an event-driven code with positions, is quoted from an earlier measurement; DynamO
is not run here.
"""

import argparse
import resource
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.record import add_recording, seconds, write_results
from experiments.support.scenes import beads

SIZES = (10_000, 100_000, 1_000_000)
BETA = 0.15
COLLISIONS = 2e6  # per run, or one per particle where that is more
REPEATS = 3
DYNAMO = {"N=4000": 81_000, "N=32000": 52_000}
"""Collisions per second of DynamO on one core, phi = .1: quoted, measured on a two-core machine."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", nargs="+", type=int, default=SIZES)
    parser.add_argument("--dimension", type=int, choices=(2, 3), default=3)
    parser.add_argument("--precision", choices=("float64", "float32"), default="float64")
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.precision == "float64")
    sizes, collisions, repeats = options.sizes, COLLISIONS, REPEATS
    if options.smoke:
        sizes, collisions, repeats = (1000,), 1e4, 1
    print(f"{jax.devices()[0].device_kind}, {options.precision}, d = {options.dimension}")
    print(f"{'N':>9}{'compile s':>11}{'run s':>8}{'coll/s':>11}{'derivative / run':>18}")
    rows = []
    for size in sizes:
        row = measure(size, options.dimension, collisions, repeats)
        rows.append(row)
        print(
            f"{size:9d}{row['compile_s']:11.1f}{row['run_s']:8.2f}{row['collisions_per_s']:11.0f}"
            f"{row['derivative_ratio']:18.2f}",
            flush=True,
        )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak:.2f} GiB")
    print("DynamO, quoted: " + ", ".join(f"{n} {rate} coll/s" for n, rate in DYNAMO.items()))
    write_results(
        "benchmark_dsmc",
        options,
        options.out,
        rows=rows,
        peak_memory_GiB=peak,
        dynamo_quoted_collisions_per_s=DYNAMO,
        dimension=options.dimension,
    )


def measure(size: int, dimension: int, collisions: float, repeats: int) -> dict:
    gas = beads(0.1, BETA, dimension=dimension)
    model = jaxgran.DSMC(size)
    # Kinetic theory gives the time at which each particle has made these collisions.
    each = max(2 * collisions / size, 2.0)
    trial = np.geomspace(0.1, 1e6, 400) * float(gas.mean_free_time)
    theory = jaxgran.cool(gas, trial)
    assert theory.collisions is not None
    times = jnp.asarray([np.interp(each, np.asarray(theory.collisions), trial)])

    def cooled(gas):
        return jaxgran.cool(gas, times, model=model, progress=False)

    def temperature(a):
        return cooled(gas.replace(dissipative_constant=a)).temperature

    a = gas.value("dissipative_constant")
    compile_s, run_s = seconds(lambda: cooled(gas).temperature, repeats)
    plain, derivative = jax.jit(temperature), jax.jit(jax.jacfwd(temperature))
    _, plain_s = seconds(lambda: plain(a), repeats)
    _, derivative_s = seconds(lambda: derivative(a), repeats)
    curve = cooled(gas)
    assert curve.collisions is not None
    return {
        "num_particles": size,
        "compile_s": compile_s,
        "run_s": run_s,
        "collisions_per_s": float(curve.collisions[-1]) * size / 2 / run_s,
        "derivative_run_s": derivative_s,
        "derivative_ratio": derivative_s / plain_s,
        "temperature_ratio": float(curve.temperature[-1] / gas.temperature),
    }


if __name__ == "__main__":
    main()
