"""What does a gas of a million particles cost until it clusters, on one and on two cores?

    python experiments/speed/benchmark_million.py [--models hard-spheres soft-spheres dsmc]
        [--size 1000000] [--cases "two cores" clusters] [--smoke] [--out FILE] [--record]

Disks of phi = .05, of constant restitution .6 (hard), or viscoelastic with the same first cooling
rate and contacts of .01 mean free times (soft), cool in one periodic box. Every case runs in a
separate process and reports its peak memory. Four cases are short runs, without compilation and
set-up, from a disturbed lattice: the whole gas on one core and on all cores, half of the gas on one
core, and two replicas of half the gas on two CPU devices. In "clusters" the gas is equilibrated as
hard disks and then simulated until the number of disks in cells of 20 varies twice as much as in an
elastic fluid, which takes 7 to 10 collisions per disk. DSMC has no clusters. With --record, models
that are not run keep their rows. Each row contains its date and the load of the machine before the
run.
"""

import argparse
import datetime
import json
import os
import resource
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.apart import alone
from experiments.support.clustering import PER_CELL, crossing, viscoelastic_like
from experiments.support.record import FIGURES, add_recording, figures, write_results
from experiments.support.scenes import beads, hard_beads

NAME = "benchmark_million"
MODELS = {
    "hard-spheres": jaxgran.HardSpheres,
    "soft-spheres": jaxgran.SoftSpheres,
    "dsmc": jaxgran.DSMC,
}
PACKING, RESTITUTION, CONTACT_FRACTION = 0.05, 0.6, 0.01
SHORT = {"hard-spheres": 0.5, "soft-spheres": 0.5, "dsmc": 10.0}
"""Collisions per particle of the short runs."""

SCALING = ("one core", "two cores", "half on one core", "two devices")
CLUSTERS = "clusters"
UNTIL = {"hard-spheres": 10.0, "soft-spheres": 13.0}
"""Collisions per disk, in a homogeneous gas, of the run in which clusters form."""

FLUID = 0.798
"""Variance over mean of the number of disks in the cells of the elastic fluid
(`experiments/paper/paper_clustering.py`)."""

DEVICES_GB = (16, 80, 141)
"""Memory of devices for which the largest number of particles is estimated."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", nargs="+", choices=tuple(MODELS), default=tuple(MODELS))
    parser.add_argument("--size", type=int, default=1_000_000)
    parser.add_argument("--cases", nargs="+", choices=(*SCALING, CLUSTERS))
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    add_recording(parser)
    options = parser.parse_args()
    if options.smoke:
        options.size, options.models = 400, ["hard-spheres"]
    if options.measure:
        case, model = options.measure
        print(json.dumps(measure(case, model, options.size)))
        return
    jax.config.update("jax_enable_x64", True)  # as in the processes that measure
    rows = []
    for model in options.models:
        cases = options.cases or (*SCALING, *([CLUSTERS] if model in UNTIL else []))
        row = {"model": model, "size": options.size, "date": datetime.date.today().isoformat()}
        row["load"] = os.getloadavg()[0]
        for case in cases:
            if case == CLUSTERS and model not in UNTIL:
                continue
            row[case] = alone(__file__, "--size", str(options.size), "--measure", case, model)
            print(f"{model}, {case}: {words(row[case])}", flush=True)
        rows.append(row | derived(row))
        print(f"{model}: {derived(row)}", flush=True)
    write_results(NAME, options, options.out, rows=merged(rows) if options.record else rows)


def merged(rows: list[dict]) -> list[dict]:
    """Return the rows, completed by recorded rows of other models and cases."""
    known = figures(NAME)["rows"] if (FIGURES / f"{NAME}.json").exists() else []
    each = {row["model"]: row for row in known}
    for row in rows:
        whole = each.get(row["model"], {}) | row
        each[row["model"]] = whole | derived(whole)
    return [each[model] for model in MODELS if model in each]


def words(found: dict) -> str:
    text = f"{1e6 * found['s_per_collision']:.3g} us per collision, {found['peak_GiB']:.2f} GiB"
    if "clusters_at" in found:
        text += f", clusters after {found['clusters_at']:.1f} collisions, "
        text += f"equilibration {found['melt_s']:.0f} s, run {found['run_s']:.0f} s"
    return text


def derived(row: dict) -> dict:
    """Return ratios of rates, and memory per particle."""
    known = {case: row[case] for case in SCALING if case in row}
    rate = {case: 1 / found["s_per_collision"] for case, found in known.items()}
    found = {}
    if {"one core", "two cores"} <= set(rate):
        found["strong"] = rate["two cores"] / rate["one core"]
    if {"half on one core", "two cores"} <= set(rate):
        found["weak"] = rate["two cores"] / rate["half on one core"]
    if {"half on one core", "two devices"} <= set(rate):
        found["replicas"] = rate["two devices"] / rate["half on one core"]
    if "two cores" in known:
        taken = known["two cores"]["peak_GiB"] - known["two cores"]["before_GiB"]
        each = taken * 2**30 / row["size"]
        found["bytes_per_particle"] = each
        found["largest"] = {str(gb): gb * 1e9 / each for gb in DEVICES_GB}
    return found


def peak_memory() -> float:
    """Return the peak memory of this process so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def measure(case: str, name: str, size: int) -> dict:
    if case.endswith("one core"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if case == "two devices":
        jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_enable_x64", True)
    gas = gas_of(name)
    before = peak_memory()
    if case == CLUSTERS:
        found = to_clusters(gas, name, size)
    else:
        whole = case in ("one core", "two cores")
        replicas = 2 if case == "two devices" else 1
        found = short(gas, name, size if whole else size // 2, replicas)
    return found | {"before_GiB": before, "peak_GiB": peak_memory()}


def gas_of(name: str) -> jaxgran.Gas:
    hard = hard_beads(PACKING, RESTITUTION, 2)
    if name != "soft-spheres":
        return hard
    return beads(PACKING, float(viscoelastic_like(hard).thermal_beta), CONTACT_FRACTION, 2)


def times_of(gas: jaxgran.Gas, collisions: np.ndarray) -> np.ndarray:
    """Return the times of given collisions per particle, by kinetic theory."""
    trial = np.concatenate([[0.0], np.geomspace(1e-3, 1e4, 400)]) * float(gas.mean_free_time)
    theory = jaxgran.cool(gas, trial)
    assert theory.collisions is not None
    return np.interp(collisions, np.asarray(theory.collisions), trial)


def disturbed_lattice(gas: jaxgran.Gas, size: int, replicas: int) -> jaxgran.Particles:
    """Return disks at random places in the cells of a square lattice, with random velocities."""
    rng, side = np.random.default_rng(0), float(gas.box_side(size))
    per_side = int(np.ceil(size**0.5))
    spacing = side / per_side
    place = np.stack(np.divmod(rng.permuted(np.arange(per_side**2))[:size], per_side), -1)
    free = spacing - 1.001 * float(gas.diameter)
    shift = free * rng.random((replicas, size, 2))
    velocity = float(gas.temperature) ** 0.5 * rng.standard_normal((replicas, size, 2))
    velocity -= velocity.mean(axis=1, keepdims=True)
    position = spacing * place[None] + shift
    return jaxgran.Particles(jnp.asarray(position), jnp.asarray(velocity), gas.box_side(size))


def short(gas: jaxgran.Gas, name: str, size: int, replicas: int) -> dict:
    """Return seconds per collision of a short run, without compilation and set-up."""
    more = {}
    if name != "dsmc":
        more["start"] = disturbed_lattice(gas, size, replicas)
    model = MODELS[name](size, replicas=replicas, **more)

    def cooled(collisions: float) -> tuple[float, float]:
        times = times_of(gas, np.array([collisions]))
        begin = time.perf_counter()
        curve = jaxgran.cool(gas, times, model=model, progress=False)
        assert curve.collisions is not None
        made = float(curve.collisions[-1])
        return time.perf_counter() - begin, made

    first_s, _ = cooled(SHORT[name])  # also finds the capacities, which may take compilations
    set_up_s, _ = cooled(0.0)
    run_s, made = cooled(SHORT[name])
    pairs = made * size * replicas / 2
    return {
        "first_s": first_s,
        "set_up_s": set_up_s,
        "run_s": run_s,
        "collisions_per_particle": made,
        "s_per_collision": (run_s - set_up_s) / pairs,
    }


def to_clusters(gas: jaxgran.Gas, name: str, size: int) -> dict:
    """Run an equilibrated gas until it clusters, compilation included."""
    cells = max(2, round((size / PER_CELL) ** 0.5))

    def unevenness(particles: jaxgran.Particles) -> jax.Array:
        where = particles.position, particles.box_side
        return jaxgran.observables.number_fluctuation(*where, cells)

    begin = time.perf_counter()
    equilibration = jaxgran.HardSpheres(size)
    start = jaxgran.cool(gas, [0.0], model=equilibration, progress=False).particles
    assert start is not None
    equilibrated = time.perf_counter()
    model = MODELS[name](size, start=start)
    times = times_of(gas, np.linspace(0.0, UNTIL[name], 14))
    curve = jaxgran.cool(gas, times, model=model, save=unevenness, progress=False)
    assert curve.collisions is not None
    collisions, uneven = np.asarray(curve.collisions), np.asarray(curve.saved)
    run_s = time.perf_counter() - equilibrated
    return {
        "melt_s": equilibrated - begin,
        "run_s": run_s,
        "s_per_collision": run_s / (float(collisions[-1]) * size / 2),
        "clusters_at": crossing(collisions, uneven, 2 * FLUID),
        "collisions": collisions.tolist(),
        "unevenness": uneven.tolist(),
        "temperature": (np.asarray(curve.temperature) / float(gas.temperature)).tolist(),
    }


if __name__ == "__main__":
    main()
