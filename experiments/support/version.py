"""Seconds or numbers of one version of jaxgran.

    python version.py TASK CURVE NUM_PARTICLES

`experiments.support.record.of_version` runs a task in a separate process, with any version:
nothing else of this repository is imported here. Prints JSON: the seconds of each step, those of
XLA's compiler, and the number of programs compiled; or, for the task numbers, the arrays of each
case.
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

STEPS: dict[str, Any] = {"import": {"s": time.perf_counter() - BEGAN}}
COMPILED: list[float] = []

A, BOTH = "dissipative_constant", ("dissipative_constant", "temperature")
LENGTHS = range(40, 60)
SPEED = {"DSMC": 100_000, "HardSpheres": 4096, "SoftSpheres": 2000}
"""Numbers of particles of the task speed, for 500 or more."""


def hear(event: str, duration_secs: float, **_: str | int) -> None:
    if event == "/jax/core/compile/backend_compile_duration":
        COMPILED.append(duration_secs)


def step(name: str, call: Any, repeats: int = 1) -> Any:
    """Record the median seconds of a call, and return its result."""
    COMPILED.clear()
    took, result = [], None
    for _ in range(repeats):
        begin = time.perf_counter()
        result = jax.block_until_ready(call())
        took.append(time.perf_counter() - begin)
    STEPS[name] = {"s": statistics.median(took), "xla_s": sum(COMPILED), "programs": len(COMPILED)}
    return result


def with_points(curve: Any, count: int) -> Any:
    """Return the curve interpolated to a number of points, without that at t = 0."""
    of = curve.times, curve.temperature, curve.temperature_error
    t, T, error = (np.asarray(x)[1:] for x in of)
    times = np.geomspace(t[0], t[-1], count)
    columns = times, np.interp(times, t, T), np.interp(times, t, error)
    times, T, error = map(jax.device_put, columns)  # jnp.asarray compiles for each length
    return jaxgran.CoolingCurve(times, T, temperature_error=error)


def reference(gas: Any, curve: Any, _: int) -> None:
    """The Jacobian and the curve of kinetic theory, and the sizes of their jaxprs."""

    def log_temperature(constant, temperature):
        now = gas.replace(dissipative_constant=constant, temperature=temperature)
        return jax.numpy.log(jaxgran.cool(now, curve.times[1:]).temperature)

    ways = {"Jacobian": jax.jacfwd(log_temperature, argnums=(0, 1)), "curve": log_temperature}
    for name, way in ways.items():
        compiled = jax.jit(way)
        step(f"first {name}", lambda call=compiled: call(3e-6, 0.01))
        step(f"{name} again", lambda call=compiled: call(3e-6, 0.01), repeats=100)
        jaxpr = jax.make_jaxpr(way)(3e-6, 0.01).jaxpr
        STEPS[f"{name}, jaxpr"] = {"equations": equations(jaxpr)}


def equations(jaxpr: Any) -> int:
    """Return the number of equations of a jaxpr and of those inside it."""
    values = [value for equation in jaxpr.eqns for value in equation.params.values()]
    parts = [x for value in values for x in (value if isinstance(value, tuple | list) else [value])]
    inner = [getattr(part, "jaxpr", part) for part in parts]
    return len(jaxpr.eqns) + sum(equations(part) for part in inner if hasattr(part, "eqns"))


def fit(gas: Any, curve: Any, _: int) -> None:
    """Fit and diagnose a curve of 61 points, one of 47, and with another free parameter."""

    def both(some):
        result = jaxgran.fit(gas, some, free=BOTH)
        return result, jaxgran.diagnose(result)

    for points, words in ((61, "first"), (47, "47 points,")):
        some = with_points(curve, points)
        step(f"{words} fit and diagnose", lambda some=some: both(some))
    step("fit again", lambda: jaxgran.fit(gas, some, free=BOTH), repeats=5)
    step("other free", lambda: jaxgran.fit(gas, some, free=BOTH[:1]))


def lengths(gas: Any, curve: Any, _: int) -> None:
    """Fit and diagnose curves of 20 lengths."""

    def all_of_them():
        for points in LENGTHS:
            jaxgran.diagnose(jaxgran.fit(gas, with_points(curve, points), free=BOTH))

    step(f"{len(LENGTHS)} lengths, fit and diagnose", all_of_them)


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
    jax.monitoring.register_event_duration_secs_listener(hear)
    task, file, number = sys.argv[1:]
    measured, header = jaxgran.read_curve(file)
    measured_gas = jaxgran.read_gas(header)
    tasks = {"reference": reference, "fit": fit, "lengths": lengths}
    tasks |= {"speed": speed, "numbers": numbers}
    if task != "numbers":
        measured_gas = measured_gas.replace(dissipative_constant=3e-6)
    if task in tasks:
        tasks[task](measured_gas, measured, int(number))
    else:
        first_run(task, measured_gas, int(number))
    print(json.dumps({"package": jaxgran.__file__, "steps": STEPS}))
