"""Seconds or numbers of one version of jaxgran.

    python version.py TASK CURVE NUM_PARTICLES

`experiments.support.record.of_version` runs a task in a separate process, with any version:
nothing else of this repository is imported here. Prints JSON: the seconds of each step, those of
XLA's compiler, and the number of programs compiled; or, for the task numbers, the arrays of each
case.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import numpy as np

BEGAN = time.perf_counter()

import jaxgran  # noqa: E402

STEPS: dict[str, Any] = {"import": {"s": time.perf_counter() - BEGAN}}
COMPILED: list[float] = []

A, BOTH = "dissipative_constant", ("dissipative_constant", "temperature")
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
    STEPS[name] = {"s": float(np.median(took)), "xla_s": sum(COMPILED), "programs": len(COMPILED)}
    return result


ANY_VERSION: Any = jaxgran
IS_OLD = not hasattr(jaxgran, "Measurement")
"""Whether fits take a gas and a curve, and their ranges are a second call, as in version 0.2."""


def fit_of(gas: Any, curve: Any, **options: Any) -> Any:
    """Return a fit of a curve, or of several by label, without its range."""
    if IS_OLD:
        return ANY_VERSION.fit(gas, curve, **options)
    if isinstance(curve, dict):
        measurement: Any = {label: jaxgran.Measurement(gas[label], x) for label, x in curve.items()}
    else:
        measurement = jaxgran.Measurement(gas, curve)
    return jaxgran.fit(measurement, quick=True, **options)


def fit_with_range(gas: Any, curve: Any) -> Any:
    if IS_OLD:
        result = fit_of(gas, curve, free=BOTH)
        return result, ANY_VERSION.diagnose(result, curve)
    return jaxgran.fit(jaxgran.Measurement(gas, curve), free=BOTH)


def estimate_and_curve(result: Any) -> Any:
    """Return what is compared of fits: the estimate, and T of the fitted curve or curves."""
    curves = result.curve if isinstance(result.curve, dict) else {"": result.curve}
    return result.estimate, {label: curve.temperature for label, curve in curves.items()}


def of_points(curve: Any, count: int) -> Any:
    """Return the curve interpolated to a number of points, without that at t = 0."""
    t, T, error = (
        np.asarray(x)[1:] for x in (curve.times, curve.temperature, curve.temperature_error)
    )
    times = np.geomspace(t[0], t[-1], count)
    columns = times, np.interp(times, t, T), np.interp(times, t, error)
    times, T, error = map(jax.device_put, columns)  # jnp.asarray compiles for each length
    return jaxgran.CoolingCurve(times, T, temperature_error=error)


def reference(gas: Any, curve: Any, _: int) -> None:
    """The first and a later call of the Jacobian of kinetic theory."""

    def log_temperature(constant, temperature):
        now = gas.replace(dissipative_constant=constant, temperature=temperature)
        return jax.numpy.log(jaxgran.cool(now, curve.times[1:]).temperature)

    jacobian = partial(jax.jit(jax.jacfwd(log_temperature, argnums=(0, 1))), 3e-6, 0.01)
    step("first Jacobian", jacobian)
    step("Jacobian again", jacobian, repeats=100)


def lengths(gas: Any, curve: Any, _: int) -> None:
    """Fit curves of 20 lengths, with their ranges."""
    curves = [of_points(curve, count) for count in range(40, 60)]
    step("20 lengths, fits with ranges", lambda: [fit_with_range(gas, x) for x in curves])


def fit(gas: Any, curve: Any, _: int) -> None:
    """Fit a curve of 61 points and one of 47 with their ranges, and another free parameter."""
    for points, words in ((61, "first"), (47, "47 points,")):
        some = of_points(curve, points)
        step(f"{words} fit with its range", partial(fit_with_range, gas, some))
    step("fit again", lambda: fit_of(gas, some, free=BOTH), repeats=5)
    step("other free", lambda: fit_of(gas, some, free=BOTH[:1]))


def plan(gas: Any, curve: Any, _: int) -> None:
    """Fit a curve of 250 grains with errors of 2 %, plan an experiment like it, and imitate it."""
    some = of_points(curve, 30)
    some = replace(some, temperature_error=0.02 * some.temperature)
    measurement = jaxgran.Measurement(gas, some, num_particles=250, errors_measured=True)
    result = step("planned fit", partial(jaxgran.fit, measurement))
    step("planned fit again", partial(jaxgran.fit, measurement), repeats=5)
    step("plan", partial(jaxgran.plan, measurement))
    step("plan again", partial(jaxgran.plan, measurement))
    step("200 imitations", partial(jaxgran.imitate, result, runs=100, progress=False))


def first_run(name: str, gas: Any, _: Any, num: int) -> None:
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
    tau = float(gas.mean_free_time)
    early, late = np.linspace(0, 10.0, 6)[1:] * tau, np.geomspace(0.1, 1e5, 50) * tau

    def temperature(constant, times=late, model=None):
        now = gas.replace(dissipative_constant=constant)
        return jaxgran.cool(now, times, model=model, progress=False).temperature

    runs: dict[str, Any] = {
        "KineticTheory": jax.jit(temperature),
        "forward": jax.jit(lambda a: jax.jvp(temperature, (a,), (1.0,))[1]),
        "reverse": jax.jit(jax.grad(lambda a: np.log(late) @ temperature(a))),
    }
    for name, size in SPEED.items():
        model = getattr(jaxgran, name)(min(size, 200 * num))
        runs[name] = partial(temperature, times=early, model=model)
    for name, run in runs.items():
        jax.block_until_ready(run(3e-6))
        step(f"speed of {name}", partial(run, 3e-6), repeats=7 if name in SPEED else 100)


def beads(beta: float = 0.15, phi: float = 0.05, dimension: int = 3, **elements: Any) -> Any:
    law, mass = jaxgran.Viscoelastic(5e7, 0.22, 1e-6), jaxgran.sphere_mass(2e-3, 2500.0)
    of = {"diameter": 2e-3, "mass": mass, "packing_fraction": phi, "temperature": 0.01}
    gas = jaxgran.Gas(law, dimension=dimension, **of)
    gas = gas.replace(dissipative_constant=1e-6 * beta / float(gas.thermal_beta))
    return replace(gas, **elements)


def cool(gas: Any, last: float, model: Any = None, save: Any = None) -> Any:
    times = np.linspace(0, last, 5)[1:] * float(gas.mean_free_time)
    options: dict = {"key": jax.random.key(3), "progress": False, "save": save}
    return jaxgran.cool(gas, times, model=model, **options)


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
    return fit_of(start, curve, model=model, key=jax.random.key(1), progress=False)


def fitted_jointly(model: Any) -> Any:
    gases = {str(phi): beads(phi=phi) for phi in (0.02, 0.1)}
    curves = {name: cool(gas, 20.0, model) for name, gas in gases.items()}
    return fit_of(gases, curves)


def cases(gas: Any, curve: Any) -> dict[str, Callable]:
    """Return what the task numbers computes, by name; the gas and the curve are of the file."""
    DSMC, Hard, Soft = jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres
    smooth, lossy, dense = beads(), beads(0.3), beads(phi=0.2)
    side, drag, noise = smooth.box_side(200), jaxgran.StokesDrag(0.5), jaxgran.WhiteNoise(1e-2)
    wall = jaxgran.Viscoelastic(5e7, 0.22, 1e-6)
    hard, soft = (jaxgran.Walls(side, restitution=law) for law in (0.9, wall))
    surface = jaxgran.Rough(0.5, rotational_temperature=0.002)
    rough = beads(surface=surface, container=hard, drag=drag)
    grains = beads(surface=jaxgran.Frictional(20.0, 0.3), container=soft, drag=drag)
    disks = beads(dimension=2, law=jaxgran.ConstantRestitution(0.8), drive=noise)
    series = replace(disks, law=jaxgran.RestitutionSeries([-0.1, -0.02], [0.2, 0.4]))
    driven = replace(rough, drive=noise)
    return {
        "theory, smooth": lambda: (cool(smooth, 50), slope(smooth, 50)),
        "theory, rough, walls, drag": lambda: cool(rough, 20),
        "theory, disks, series, driven": lambda: cool(series, 20),
        "DSMC, smooth": lambda: (cool(smooth, 20, DSMC(1000, 2)), slope(smooth, 20, DSMC(500))),
        "DSMC, rough, walls, drag, drive": lambda: cool(driven, 5, DSMC(500)),
        "hard spheres": lambda: (cool(lossy, 20, Hard(200, 2), flow), slope(lossy, 5, Hard(200))),
        "hard spheres, rough, walls, drag": lambda: cool(rough, 5, Hard(200)),
        "hard disks, constant restitution, driven": lambda: cool(disks, 5, Hard(200), "particles"),
        "soft spheres": lambda: (cool(dense, 3, Soft(100)), slope(dense, 2, Soft(100))),
        "soft spheres, friction, walls, drag": lambda: cool(grains, 2, Soft(200)),
        "fit by kinetic theory": lambda: estimate_and_curve(fit_of(gas, curve, free=BOTH)),
        "fit by DSMC": lambda: estimate_and_curve(fitted(DSMC(1000, 2))),
        "joint fit": lambda: estimate_and_curve(fitted_jointly(DSMC(1000, 2))),
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
    read_gas = ANY_VERSION.read_gas if IS_OLD else (lambda _: jaxgran.read_measurement(file).gas)
    measured_gas = read_gas(header)
    tasks: dict[str, Any] = {"reference": reference, "fit": fit, "lengths": lengths, "plan": plan}
    tasks |= {"speed": speed, "numbers": numbers}
    tasks |= {name: partial(first_run, name) for name in SPEED}
    constant = 0.0 if task == "numbers" else 3e-6
    measured_gas = measured_gas.replace(dissipative_constant=constant)
    tasks[task](measured_gas, measured, int(number))
    print(json.dumps({"package": jaxgran.__file__, "steps": STEPS}))
