"""Seconds or numbers of one version of jaxgran.

    python version.py TASK CURVE NUM_PARTICLES

`experiments.support.record.of_version` runs a task in a separate process, with any version:
nothing else of this repository is imported here. Prints JSON: the seconds of each step, or, for the
task numbers, the arrays of each case.
"""

import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

BEGAN = time.perf_counter()

import jaxgran  # noqa: E402

STEPS: dict[str, Any] = {"import": time.perf_counter() - BEGAN}

A, BOTH = "dissipative_constant", ("dissipative_constant", "temperature")
SPEED = {"DSMC": 100_000, "HardSpheres": 4096, "SoftSpheres": 2000}
"""Numbers of particles of the task speed, for 500 or more."""


def step(name: str, call: Any, repeats: int = 1) -> Any:
    """Record the median seconds of a call, and return its result."""
    took, result = [], None
    for _ in range(repeats):
        begin = time.perf_counter()
        result = jax.block_until_ready(call())
        took.append(time.perf_counter() - begin)
    STEPS[name] = statistics.median(took)
    return result


def first_run(name: str, gas: Any, num: int) -> None:
    """Run a particle model for one mean free time, and continue where it ended."""
    times = np.array([0.5, 1.0]) * float(gas.mean_free_time)

    def run(**start):
        model = getattr(jaxgran, name)(num, **start)
        return jaxgran.cool(gas, times, model=model, progress=False).particles

    particles = step(name, run)
    step(f"{name} again", run)
    if particles is not None:
        step(f"{name} from a start", lambda: run(start=particles))
        step(f"{name} from a start again", lambda: run(start=particles))


def speed(gas: Any, _: Any, num: int) -> None:
    """Run larger gases and kinetic theory repeatedly, compiled before."""
    times = np.linspace(0, 10.0, 6)[1:] * float(gas.mean_free_time)
    for name, size in SPEED.items():
        model = getattr(jaxgran, name)(min(size, 200 * num))

        def run(model=model):
            return jaxgran.cool(gas, times, model=model, progress=False).temperature

        run()
        step(f"speed of {name}", run, repeats=7)
    late = np.geomspace(0.1, 1e5, 50) * float(gas.mean_free_time)

    def theory(constant):
        return jaxgran.cool(gas.replace(dissipative_constant=constant), late).temperature

    ways = {"KineticTheory": theory, "forward": lambda a: jax.jvp(theory, (a,), (1.0,))[1]}
    ways["reverse"] = jax.grad(lambda a: np.log(late) @ theory(a))
    for name, way in ways.items():
        compiled = jax.jit(way)
        jax.block_until_ready(compiled(3e-6))
        step(f"speed of {name}", lambda call=compiled: call(3e-6), repeats=100)


def beads(beta: float = 0.15, phi: float = 0.05, dimension: int = 3, **elements: Any) -> Any:
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, 1e-6),
        diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0),
        packing_fraction=phi,
        temperature=0.01,
        dimension=dimension,
    )
    gas = gas.replace(dissipative_constant=1e-6 * beta / float(gas.thermal_beta))
    return replace(gas, **elements)


def cool(gas: Any, last: float, model: Any = None, **options: Any) -> Any:
    times = np.linspace(0, last, 5)[1:] * float(gas.mean_free_time)
    return jaxgran.cool(gas, times, model=model, key=jax.random.key(3), progress=False, **options)


def slope(gas: Any, last: float, model: Any = None) -> Any:
    def temperature(constant):
        return cool(gas.replace(dissipative_constant=constant), last, model).temperature

    return jax.jvp(temperature, (float(gas.value(A)),), (1.0,))


def flow(particles: Any) -> Any:
    where = particles.position, particles.velocity, particles.box_side
    return jaxgran.observables.flow_share(*where)


def fitted(model: Any) -> Any:
    gas = beads()
    curve = cool(gas, 20.0, jaxgran.DSMC(2000, replicas=2))
    start = gas.replace(dissipative_constant=1.2 * gas.value(A))
    return jaxgran.fit(start, curve, model=model, key=jax.random.key(1), progress=False)


def fitted_jointly(model: Any) -> Any:
    gases = {str(phi): beads(phi=phi) for phi in (0.02, 0.1)}
    curves = {name: cool(gas, 20.0, model) for name, gas in gases.items()}
    if hasattr(jaxgran, "fit_jointly"):  # of versions before 0.2.0
        return jaxgran.fit_jointly({name: (gases[name], curves[name]) for name in gases})
    return jaxgran.fit(gases, curves)


def cases(gas: Any, curve: Any) -> dict[str, Callable]:
    """Return what the task numbers computes, by name; the gas and the curve are of the file."""
    DSMC, Hard, Soft = jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres
    side, drag, noise = beads().box_side(200), jaxgran.StokesDrag(0.5), jaxgran.WhiteNoise(1e-2)
    walls, soft_walls = (
        {"container": jaxgran.Walls(side, restitution=x)}
        for x in (0.9, jaxgran.Viscoelastic(5e7, 0.22, 1e-6))
    )
    rough = walls | {"surface": jaxgran.Rough(0.5, rotational_temperature=0.002), "drag": drag}
    grains = soft_walls | {"surface": jaxgran.Frictional(20.0, 0.3), "drag": drag}
    series = {"dimension": 2, "law": jaxgran.RestitutionSeries([-0.1, -0.02], [0.2, 0.4])}
    disks = {"dimension": 2, "law": jaxgran.ConstantRestitution(0.8), "drive": noise}

    def fit_and_diagnose():
        result = jaxgran.fit(gas, curve, free=BOTH)
        return result, jaxgran.diagnose(result, curve)

    dense = {"phi": 0.2}
    return {
        "theory, smooth": lambda: (cool(beads(), 50.0), slope(beads(), 50.0)),
        "theory, rough, walls, drag": lambda: cool(beads(**rough), 20.0),
        "theory, disks, series, driven": lambda: cool(beads(**series, drive=noise), 20.0),
        "DSMC, smooth": lambda: (
            cool(beads(), 20.0, DSMC(1000, replicas=2)),
            slope(beads(), 20.0, DSMC(500)),
        ),
        "DSMC, rough, walls, drag, drive": lambda: cool(
            beads(**rough, drive=noise), 5.0, DSMC(500)
        ),
        "hard spheres": lambda: (
            cool(beads(0.3), 20.0, Hard(200, replicas=2), save=flow),
            slope(beads(0.3), 5.0, Hard(200)),
        ),
        "hard spheres, rough, walls, drag": lambda: cool(beads(**rough), 5.0, Hard(200)),
        "hard disks, constant restitution, driven": lambda: cool(
            beads(**disks), 5.0, Hard(200), save="particles"
        ),
        "soft spheres": lambda: (
            cool(beads(**dense), 3.0, Soft(100)),
            slope(beads(**dense), 2.0, Soft(100)),
        ),
        "soft spheres, friction, walls, drag": lambda: cool(beads(**grains), 2.0, Soft(200)),
        "fit by kinetic theory, diagnosis": fit_and_diagnose,
        "fit by DSMC": lambda: fitted(DSMC(1000, replicas=2)),
        "joint fit": lambda: fitted_jointly(DSMC(1000, replicas=2)),
    }


def numbers(gas: Any, curve: Any, _: int) -> None:
    """Record the arrays of all cases, with their types."""
    for name, run in cases(gas, curve).items():
        leaves = jax.tree.leaves(run())
        arrays = [x for x in leaves if isinstance(x, jax.Array | np.ndarray | float | int)]
        STEPS[name] = []
        for x in arrays:
            is_key = jax.numpy.issubdtype(getattr(x, "dtype", None), jax.dtypes.prng_key)
            x = np.asarray(jax.random.key_data(x) if is_key else x)
            STEPS[name].append((x.tolist(), str(x.dtype)))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    task, file, number = sys.argv[1:]
    measured, header = jaxgran.read_curve(file)
    measured_gas = jaxgran.read_gas(header)
    tasks = {"speed": speed, "numbers": numbers}
    if task != "numbers":
        measured_gas = measured_gas.replace(dissipative_constant=3e-6)
    if task in tasks:
        tasks[task](measured_gas, measured, int(number))
    else:
        first_run(task, measured_gas, int(number))
    print(json.dumps({"package": jaxgran.__file__, "steps": STEPS}))
