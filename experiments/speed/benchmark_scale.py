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
short runs, without compilation and set-up, from random places: the whole gas on one core and
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
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.analysis import crossing
from experiments.support.record import Options, alone, alternately, figures, run_parts, seconds
from experiments.support.scenes import beads, cool, hard_beads, times_of, viscoelastic_like
from jaxgran import DSMC, HardSpheres, SoftSpheres
from jaxgran.particles.start import maxwellian_velocities

MODELS = {"hard-spheres": HardSpheres, "soft-spheres": SoftSpheres, "dsmc": DSMC}
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
    rate = {case: 1 / row[case]["s_per_collision"] for case in SCALING}
    taken = row["two cores"]["peak_GiB"] - row["two cores"]["before_GiB"]
    each = taken * 2**30 / row["size"]
    return {
        "strong": rate["two cores"] / rate["one core"],
        "weak": rate["two cores"] / rate["half on one core"],
        "replicas": rate["two devices"] / rate["half on one core"],
        "bytes_per_particle": each,
        "largest": {str(gb): gb * 1e9 / each for gb in DEVICES_GB},
    }


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

    run = partial(cool, gas, times, model)
    compile_s, run_s = seconds(run, repeats)
    collisions = float(run().collisions[-1]) + (0 if name == "dsmc" else 10)
    rate = collisions * size / run_s
    return {"compile_s": compile_s, "run_s": run_s, "collisions_per_s": rate}


def random_start(gas: jaxgran.Gas, size: int, replicas: int) -> jaxgran.Particles:
    """Return disks at random places that do not overlap, not equilibrated."""
    model = HardSpheres(size, replicas=replicas)
    placement = model.dynamics(model.scene(gas), 2, replicas).placement()
    state = eqx.filter_jit(placement.initial)(jax.random.key(0))
    push = eqx.filter_jit(placement.advance)
    while placement.unfinished(state, jnp.zeros(())):
        state = push(state, jnp.zeros(()))
    assert int(state.status) == 0
    shape = replicas, size, 2
    velocity = maxwellian_velocities(jax.random.key(1), shape) * jnp.sqrt(gas.temperature)
    position = state.position * gas.diameter
    return jaxgran.Particles(position.reshape(shape), velocity.reshape(shape), gas.box_side(size))


def short(gas: jaxgran.Gas, name: str, size: int, replicas: int) -> dict:
    """Return seconds per collision of a short run, without compilation and set-up."""
    start = {} if name == "dsmc" else {"start": random_start(gas, size, replicas)}
    model = MODELS[name](size, replicas=replicas, **start)

    run = partial(cool, gas, times_of(gas, [SHORT[name]]), model)
    # The first run also finds the capacities, which may take compilations.
    runs = {"first_s": run, "set_up_s": partial(cool, gas, [0.0], model)}
    took = alternately(runs | {"run_s": run}, 1)
    row = {name: each for name, (each,) in took.items()}
    made = float(run().collisions[-1])
    each = (row["run_s"] - row["set_up_s"]) / (made * size * replicas / 2)
    return row | {"collisions_per_particle": made, "s_per_collision": each}


def to_clusters(gas: jaxgran.Gas, name: str, size: int) -> dict:
    """Run an equilibrated gas until it clusters, compilation included."""
    cells = max(2, round((size / PER_CELL) ** 0.5))

    def unevenness(particles: jaxgran.Particles) -> jax.Array:
        where = particles.position, particles.box_side
        return jaxgran.observables.number_fluctuation(*where, cells)

    begin = time.perf_counter()
    start = cool(gas, [0.0], HardSpheres(size)).particles
    equilibrated = time.perf_counter()
    times = times_of(gas, np.linspace(0.0, UNTIL[name], 14))
    model = MODELS[name](size, start=start)
    curve = cool(gas, times, model, save=unevenness)
    collisions, uneven = np.asarray(curve.collisions), curve.saved
    run_s = time.perf_counter() - equilibrated
    return {
        "melt_s": equilibrated - begin,
        "run_s": run_s,
        "s_per_collision": run_s / (float(collisions[-1]) * size / 2),
        "clusters_at": crossing(collisions, uneven, 2 * FLUID),
        "collisions": collisions,
        "unevenness": uneven,
        "temperature": curve.temperature / gas.temperature,
    }


if __name__ == "__main__":
    run_parts(__doc__, replicas, million, prefix="benchmark_", models=list(MODELS))
