"""What do rough spheres, walls, drag and a drive cost, compared with a smooth gas?

    python experiments/speed/benchmark_elements.py [--soft] [--repeats 7] [--smoke] [--out FILE]

Beads (phi = .05, beta_T0 = .15) cool for some mean free times, with each element that a model
supports. Prints seconds of a first run, the median of repeats in which all scenes run alternately,
and the ratio of the time per collision to that of the smooth gas, since gases with other losses
make other numbers of collisions (for kinetic theory, the ratio of the time per run). In a small box
between walls, particles also collide with walls: "each contact" is the ratio of times per collision
with a particle or a wall. Wall collisions are counted by the flux of a homogeneous gas.
"""

import argparse
import dataclasses
import statistics
import time
from pathlib import Path

import jax
import numpy as np

import jaxgran
from experiments.support.record import add_recording, write_results
from experiments.support.scenes import beads

NUM_HARD, NUM_DSMC, NUM_SOFT = 4096, 100_000, 2000
FRICTION = {"surface": jaxgran.Frictional(0.5, 0.3, rotational_temperature=4e-3)}
ELEMENTS = {
    "smooth": {},
    "rough": {"surface": jaxgran.Rough(0.0, rotational_temperature=4e-3)},
    "walls": {"container": None},  # of the size of the gas
    "rough, walls": {"surface": jaxgran.Rough(0.0, rotational_temperature=4e-3), "container": None},
    "drag": {"drag": jaxgran.StokesDrag(0.5)},
    "drive": {"drive": None},  # of .02 T_0 in a mean free time
    "friction": FRICTION,
    "friction, walls": FRICTION | {"container": None},
}


def scene(elements: dict, soft: bool) -> jaxgran.Gas:
    gas = beads(packing_fraction=0.05, beta=0.15, contact_fraction=0.02 if soft else None)
    if "container" in elements:
        side = float(gas.box_side(NUM_SOFT if soft else NUM_HARD))
        walls = jaxgran.Walls(side, restitution=gas.law if soft else 0.9)
        elements = elements | {"container": walls}
    if "drive" in elements:
        strength = 0.02 * gas.temperature / gas.mean_free_time
        elements = elements | {"drive": jaxgran.WhiteNoise(strength)}
    return dataclasses.replace(gas, **elements)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--soft", action="store_true", help="soft spheres instead")
    parser.add_argument("--smoke", action="store_true", help="one short repeat")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    repeats, until = (1, 1.0) if options.smoke else (options.repeats, 10.0)
    models = (
        jaxgran.KineticTheory(),
        jaxgran.DSMC(NUM_DSMC),
        jaxgran.HardSpheres(NUM_HARD),
    )
    if options.soft:
        models = (jaxgran.SoftSpheres(NUM_SOFT),)
    print(f"{jax.devices()[0].device_kind}, float64, {until:g} mean free times")
    print(
        f"{'model':>16} {'scene':>16} {'first run s':>12} {'run s':>9} {'ratio':>7} "
        f"{'each contact':>13}"
    )
    rows = []
    for model in models:
        for row in measured(model, until, repeats):
            rows.append(row)
            print(
                f"{row['model']:>16} {row['scene']:>16} {row['first_s']:12.2f} {row['run_s']:9.4f}"
                f" {row['ratio']:7.2f} {row['ratio_of_contacts']:13.2f}",
                flush=True,
            )
    name = "benchmark_elements_soft" if options.soft else "benchmark_elements"
    write_results(name, options, options.out, rows=rows)


def measured(model, until: float, repeats: int) -> list[dict]:
    """Measure a row for each scene that the model supports; the scenes run alternately."""
    soft = isinstance(model, jaxgran.SoftSpheres)
    gases = {name: scene(elements, soft) for name, elements in ELEMENTS.items()}
    gases = {name: gas for name, gas in gases.items() if set(gas.elements) <= set(model.elements)}
    times = np.linspace(0, until, 6)[1:]
    seconds: dict[str, list[float]] = {name: [] for name in gases}
    collisions = {}
    for _ in range(1 + repeats):
        for name, gas in gases.items():
            began = time.perf_counter()
            curve = jaxgran.cool(gas, times * float(gas.mean_free_time), model=model)
            jax.block_until_ready(curve.temperature)
            seconds[name].append(time.perf_counter() - began)
            made = curve.collisions if model.stochastic else None
            collisions[name] = 1.0 if made is None else float(made[-1])
    first = {name: each[0] for name, each in seconds.items()}
    cost = {name: statistics.median(each[1:]) / collisions[name] for name, each in seconds.items()}
    return [
        {
            "model": model.name,
            "scene": name,
            "first_s": first[name],
            "run_s": statistics.median(seconds[name][1:]),
            "ratio": cost[name] / cost["smooth"],
            "ratio_of_contacts": cost[name] / cost["smooth"] / (1 + wall_hits(gas, model)),
        }
        for name, gas in gases.items()
    ]


def wall_hits(gas: jaxgran.Gas, model) -> float:
    """Return wall collisions per collision of a pair.

    ``2 tau_c sum_i 2/(L - sigma) sqrt(T/(2 pi))`` over the axes i; 0 for kinetic theory, whose cost
    does not depend on them.
    """
    if gas.container is None or not model.stochastic:
        return 0.0
    room = np.asarray(gas.container.side) - float(gas.diameter)
    flux = 2 * np.sum(np.broadcast_to(1 / room, gas.dimension))
    flux *= (float(gas.temperature) / (2 * np.pi)) ** 0.5
    return float(2 * gas.mean_free_time * flux)


if __name__ == "__main__":
    main()
