"""How fast are hard spheres, compared with LAMMPS in the same run?

    python experiments/speed/benchmark_hard_spheres.py [--sizes 1000 4096] [--smoke] [--out FILE]
    python experiments/speed/benchmark_hard_spheres.py --until 100

A gas cools for some mean free times in a periodic box: viscoelastic beads in three dimensions,
disks of constant restitution in two. The beads are also run in LAMMPS from the same equilibrated
particles; their contacts last .01 mean free times and take 30 steps there. Compilation and the
set-up before the first step are timed separately and are left out of the rates of both codes.
Times are medians of repeats in which the two codes run alternately, since the speed of a machine
varies. Small gases are run several times in each repeat, as a single run is too short to be timed.

With `--until`, 50 000 disks (or the last of `--sizes`) are instead simulated until each has made
this number of collisions and the gas clusters.
"""

import argparse
import resource
import statistics
import time
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

import jaxgran
from experiments.speed.benchmark_particles import STEPS_PER_CONTACT, lammps_ranks, time_lammps
from experiments.support.clustering import follow
from experiments.support.record import add_recording, write_results
from experiments.support.scenes import beads, hard_beads

PACKINGS = {3: 0.1, 2: 0.2}
BETA, CONTACT_FRACTION = 0.15, 0.01  # in three dimensions
RESTITUTION = 0.9  # in two
SIZES = (1000, 4096, 16384, 50000)
COLLISION_TIMES = 4.0
REPEATS = 7
TIMED = 10_000  # one timing covers several runs with at least this many particles in total


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", nargs="+", type=int)
    parser.add_argument("--dimensions", nargs="+", type=int, choices=(2, 3), default=(3, 2))
    parser.add_argument("--collision-times", type=float, default=COLLISION_TIMES)
    parser.add_argument("--until", type=float, help="collisions of each of 50 000 disks")
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.until:
        follow_disks((options.sizes or SIZES)[-1], options)
        return
    sizes, repeats = options.sizes or SIZES, REPEATS
    if options.smoke:
        sizes, repeats = (216,), 1
    ranks = lammps_ranks()[:1]
    print(f"{jax.devices()[0].device_kind}, float64")
    head = f"{'d':>2}{'phi':>6}{'N':>8} {'first run s':>12} {'run s':>8} {'set-up':>8}"
    print(head + f" {'coll/s':>8} {'T/T_0':>7} {'LAMMPS, one core: coll/s':>26} {'ratio':>6}")
    rows = []
    for dimension in options.dimensions:
        for size in sizes:
            row = measure(size, dimension, options.collision_times, repeats, ranks)
            rows.append(row)
            line = f"{dimension:2d}{row['packing_fraction']:6.2f}{size:8d} {row['first_s']:12.1f} "
            line += f"{row['run_s']:8.2f} {row['set_up_s']:8.3f} {row['collisions_per_s']:8.0f} "
            line += f"{row['temperature_ratio']:7.3f}"
            if row["lammps"]:
                line += f"{row['lammps']['collisions_per_s']:27.0f} {row['lammps']['ratio']:6.2f}"
            print(line, flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak:.2f} GiB")
    million = "_million" if 1_000_000 in sizes else ""
    name = f"benchmark_hard_spheres{million}"
    write_results(name, options, options.out, rows=rows, peak_memory_GiB=peak)


def follow_disks(size: int, options: argparse.Namespace) -> None:
    until = options.until
    gas = hard_beads(PACKINGS[2], RESTITUTION, 2)
    with tqdm(total=until, unit="collisions", delay=1) as bar:

        def show(done: float) -> None:
            bar.update(min(done, until) - bar.n)

        run = follow(gas, 0, size, until, progress=show)
    shown = np.searchsorted(run["collisions"], np.linspace(0.1, 1, 10) * until)
    print(f"{size} disks, phi = {PACKINGS[2]:g}, e = {RESTITUTION:g}")
    print(f"{'collisions/disk':>16}{'T/T_0':>10}{'unevenness':>12}{'flow':>7}")
    for i in np.minimum(shown, len(run["t"]) - 1):
        theta = run["temperature"][i] / float(gas.temperature)
        print(f"{run['collisions'][i]:16.1f}{theta:10.2e}{run['unevenness'][i]:12.2f}", end="")
        print(f"{run['flow'][i]:7.3f}")
    total = run["collisions"][-1] * size / 2
    print(f"start {run['start_s']:.0f} s, run {run['run_s']:.0f} s with compilation, ", end="")
    regularised = run["regularised"][-1]
    print(f"{total / run['run_s']:.0f} collisions/s; regularised {regularised:.2g} per disk")
    found = {name: np.asarray(x).tolist() for name, x in run.items() if name != "positions"}
    write_results("benchmark_hard_spheres_until", options, options.out, size=size, **found)


def measure(
    size: int, dimension: int, collision_times: float, repeats: int, ranks: list[int]
) -> dict:
    if dimension == 3:
        gas = beads(PACKINGS[3], BETA, CONTACT_FRACTION)
    else:
        gas = hard_beads(PACKINGS[2], RESTITUTION, 2)
    begin = time.perf_counter()
    start = jaxgran.cool(gas, [0.0], model=jaxgran.HardSpheres(size)).particles
    model = jaxgran.HardSpheres(size, start=start)
    times = [collision_times * float(gas.mean_free_time)]
    curve = jaxgran.cool(gas, times, model=model)
    first = time.perf_counter() - begin
    in_a_row = -(-TIMED // size)
    seconds, lammps_s = {0.0: [], times[0]: []}, []
    for _ in range(repeats):
        for end, took in seconds.items():
            begin = time.perf_counter()
            for _ in range(in_a_row):
                curve = jaxgran.cool(gas, [end], model=model)
                jax.block_until_ready(curve.temperature)
            took.append((time.perf_counter() - begin) / in_a_row)
        if dimension == 3 and ranks:
            # The faster of two skins in every repeat, which slightly favours LAMMPS.
            dt = float(gas.contact_duration) / STEPS_PER_CONTACT
            lammps_s.append(time_lammps(gas, start, dt, round(times[0] / dt), 1, ranks[0])[0])
    assert curve.collisions is not None
    set_up, run = (statistics.median(took) for took in seconds.values())
    steps = run - set_up
    collisions = float(curve.collisions[-1]) * size / 2
    lammps = {}
    if lammps_s:
        ratios = [a / (b - set_up) for a, b in zip(lammps_s, seconds[times[0]], strict=True)]
        lammps = {
            "run_s": statistics.median(lammps_s),
            "collisions_per_s": collisions / statistics.median(lammps_s),
            "ratio": statistics.median(ratios),
            "ratios": ratios,
        }
    return {
        "dimension": dimension,
        "packing_fraction": PACKINGS[dimension],
        "num_particles": size,
        "first_s": first,
        "run_s": run,
        "set_up_s": set_up,
        "collisions_per_s": collisions / steps,
        "temperature_ratio": float(curve.temperature[-1] / gas.temperature),
        "lammps": lammps,
    }


if __name__ == "__main__":
    main()
