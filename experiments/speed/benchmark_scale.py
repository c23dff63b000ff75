"""What do two cores, two devices and a million particles bring and cost?

    python experiments/speed/benchmark_scale.py [--only replicas million] [--models hard-spheres
        soft-spheres dsmc] [--smoke] [--record] [--out DIR]

Every case runs in a separate process.

replicas: two replicas in three processes: on one core; on all cores with one device, with the
replicas in one array; and on two CPU devices, one replica on each. Soft and hard spheres
equilibrate for 10 mean free times. The cooling time is chosen for runs of one to two seconds; DSMC
simulates a weakly dissipative gas. Times are medians without compilation, and an equilibration
counts as 10 collisions per particle.

million: disks of phi = .05, of constant restitution .6 (hard), or viscoelastic with the same first
cooling rate and contacts of .01 mean free times (soft), cool in one periodic box. Four cases are
short runs, without compilation and set-up, from a disturbed lattice: the whole gas on one core and
on all cores, half of the gas on one core, and two replicas of half the gas on two CPU devices. In
"clusters" the gas is equilibrated as hard disks and then simulated until the number of disks in
cells of 20 varies twice as much as in an elastic fluid, which takes 7 to 10 collisions per disk.
DSMC has no clusters. Models that are not run keep their recorded rows. Each row contains
its date and the load of the machine before the run.
"""

import datetime
import os
import resource
import time
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.analysis import crossing
from experiments.support.record import Options, alone, figures, run_parts, seconds
from experiments.support.scenes import beads, cool, hard_beads, times_of, viscoelastic_like

MODELS = {
    "hard-spheres": jaxgran.HardSpheres,
    "soft-spheres": jaxgran.SoftSpheres,
    "dsmc": jaxgran.DSMC,
}
COOLING = {"soft-spheres": 25.0, "hard-spheres": 100.0, "dsmc": 500.0}
"""Mean free times of cooling of two replicas."""

SHORT = {"hard-spheres": 0.5, "soft-spheres": 0.5, "dsmc": 10.0}
"""Collisions per particle of the short runs of a million."""

REPLICAS = ("one core", "one device", "two devices")
SCALING = ("one core", "two cores", "half on one core", "two devices")
CLUSTERS = "clusters"
UNTIL = {"hard-spheres": 10.0, "soft-spheres": 13.0}
"""Collisions per disk, in a homogeneous gas, of the run in which clusters form."""

PER_CELL, FLUID = 20, 0.798
"""Mean number of disks in a cell; variance over mean of this number in the elastic fluid
(`experiments/paper/paper_clustering.py`)."""

DEVICES_GB = (16, 80, 141)
"""Memory of devices for which the largest number of particles is estimated."""


def apart(part: str, case: str, model: str, size: int, smoke: bool) -> dict:
    """Return what `measure` finds in a separate process."""
    found = alone(measure, part, case, model, size, smoke)
    print(part, case, model, found, flush=True)
    return found


def replicas(options: Options) -> Iterator[dict]:
    size = 100 if options.smoke else 4096
    for name in ["dsmc"] if options.smoke else options.models:
        row: dict = {"model": MODELS[name].__name__, "num_particles": size, "replicas": 2}
        row |= {x: apart("replicas", x, name, size, options.smoke) for x in REPLICAS}
        row["ratio"] = row[REPLICAS[2]]["collisions_per_s"] / row[REPLICAS[0]]["collisions_per_s"]
        yield row


def million(options: Options) -> dict:
    known = figures("benchmark_million")["rows"] if options.record else []
    rows, size = {row["model"]: row for row in known}, 400 if options.smoke else 10**6
    for model in ["hard-spheres"] if options.smoke else options.models:
        row = {"model": model, "size": size, "date": datetime.date.today().isoformat()}
        row["load"] = os.getloadavg()[0]
        for case in (*SCALING, CLUSTERS):
            if case != CLUSTERS or model in UNTIL:
                row[case] = apart("million", case, model, size, options.smoke)
        rows[model] = rows.get(model, {}) | row
        rows[model] |= derived(rows[model])
    return {"rows": [rows[model] for model in MODELS if model in rows]}


def derived(row: dict) -> dict:
    """Return ratios of rates, and memory per particle."""
    rate = {case: 1 / row[case]["s_per_collision"] for case in SCALING if case in row}
    found = {}
    for name, case, base in (
        ("strong", "two cores", "one core"),
        ("weak", "two cores", "half on one core"),
        ("replicas", "two devices", "half on one core"),
    ):
        if {case, base} <= set(rate):
            found[name] = rate[case] / rate[base]
    if "two cores" in row:
        taken = row["two cores"]["peak_GiB"] - row["two cores"]["before_GiB"]
        each = found["bytes_per_particle"] = taken * 2**30 / row["size"]
        found["largest"] = {str(gb): gb * 1e9 / each for gb in DEVICES_GB}
    return found


def peak_memory() -> float:
    """Return the peak memory of this process so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def measure(part: str, case: str, name: str, size: int, smoke: bool) -> dict:
    if case.endswith("one core"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    if case == "two devices":
        jax.config.update("jax_num_cpu_devices", 2)
    if part == "replicas":
        return two_replicas(name, size, 1 if smoke else 3)
    gas = hard_beads(0.05, 0.6, 2)
    if name == "soft-spheres":
        gas = beads(0.05, float(viscoelastic_like(gas).thermal_beta), 0.01, 2)
    before = peak_memory()
    if case == CLUSTERS:
        found = to_clusters(gas, name, size)
    else:
        whole = case in ("one core", "two cores")
        found = short(gas, name, size if whole else size // 2, 2 if case == "two devices" else 1)
    return found | {"before_GiB": before, "peak_GiB": peak_memory()}


def two_replicas(name: str, size: int, repeats: int) -> dict:
    gas = beads(0.1, 0.01 if name == "dsmc" else 0.15, contact_fraction=0.01)
    model, times = MODELS[name](size, replicas=2), [COOLING[name] * float(gas.mean_free_time)]

    def cooled():
        return cool(gas, times, model).collisions

    compile_s, run_s = seconds(cooled, repeats)
    collisions = float(np.asarray(cooled())[-1]) + (0 if name == "dsmc" else 10)
    rate = collisions * size / run_s
    return {"compile_s": compile_s, "run_s": run_s, "collisions_per_s": rate}


def disturbed_lattice(gas: jaxgran.Gas, size: int, replicas: int) -> jaxgran.Particles:
    """Return disks at random places in the cells of a square lattice, with random velocities."""
    rng, side = np.random.default_rng(0), float(gas.box_side(size))
    per_side = int(np.ceil(size**0.5))
    spacing = side / per_side
    place = np.stack(np.divmod(rng.permuted(np.arange(per_side**2))[:size], per_side), -1)
    shift = (spacing - 1.001 * float(gas.diameter)) * rng.random((replicas, size, 2))
    velocity = float(gas.temperature) ** 0.5 * rng.standard_normal((replicas, size, 2))
    velocity -= velocity.mean(axis=1, keepdims=True)
    position = jnp.asarray(spacing * place[None] + shift)
    return jaxgran.Particles(position, jnp.asarray(velocity), gas.box_side(size))


def short(gas: jaxgran.Gas, name: str, size: int, replicas: int) -> dict:
    """Return seconds per collision of a short run, without compilation and set-up."""
    start = {} if name == "dsmc" else {"start": disturbed_lattice(gas, size, replicas)}
    model = MODELS[name](size, replicas=replicas, **start)

    def cooled(collisions: float) -> tuple[float, float]:
        times = times_of(gas, [collisions])
        begin = time.perf_counter()
        made = float(np.asarray(cool(gas, times, model).collisions)[-1])
        return time.perf_counter() - begin, made

    first_s, _ = cooled(SHORT[name])  # also finds the capacities, which may take compilations
    set_up_s, _ = cooled(0.0)
    run_s, made = cooled(SHORT[name])
    return {
        "first_s": first_s,
        "set_up_s": set_up_s,
        "run_s": run_s,
        "collisions_per_particle": made,
        "s_per_collision": (run_s - set_up_s) / (made * size * replicas / 2),
    }


def to_clusters(gas: jaxgran.Gas, name: str, size: int) -> dict:
    """Run an equilibrated gas until it clusters, compilation included."""
    cells = max(2, round((size / PER_CELL) ** 0.5))

    def unevenness(particles: jaxgran.Particles) -> jax.Array:
        where = particles.position, particles.box_side
        return jaxgran.observables.number_fluctuation(*where, cells)

    begin = time.perf_counter()
    start = cool(gas, [0.0], jaxgran.HardSpheres(size)).particles
    equilibrated = time.perf_counter()
    times = times_of(gas, np.linspace(0.0, UNTIL[name], 14))
    model = MODELS[name](size, start=start)
    curve = cool(gas, times, model, save=unevenness)
    collisions, uneven = np.asarray(curve.collisions), np.asarray(curve.saved)
    run_s = time.perf_counter() - equilibrated
    return {
        "melt_s": equilibrated - begin,
        "run_s": run_s,
        "s_per_collision": run_s / (float(collisions[-1]) * size / 2),
        "clusters_at": crossing(collisions, uneven, 2 * FLUID),
        "collisions": collisions.tolist(),
        "unevenness": uneven.tolist(),
        "temperature": np.asarray(curve.temperature / gas.temperature).tolist(),
    }


if __name__ == "__main__":
    run_parts(__doc__, replicas, million, prefix="benchmark_", models=list(MODELS))
