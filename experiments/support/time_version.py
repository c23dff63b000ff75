"""Seconds of first and later calls of one version of jaxgran.

    python time_version.py TASK CURVE NUM_PARTICLES

`experiments/speed/benchmark_theory.py` runs each task in a process of its own, with the version
that it measures: nothing else of this repository is imported here. Prints JSON: the steps with
their seconds, those of XLA's compiler, and the number of programs compiled.
"""

import json
import statistics
import sys
import time
from typing import Any

import jax
import numpy as np

BEGAN = time.perf_counter()

import jaxgran  # noqa: E402

IMPORTED = time.perf_counter() - BEGAN
BOTH = "dissipative_constant", "temperature"
LENGTHS = range(40, 60)
SPEED = {"DSMC": 100_000, "HardSpheres": 4096, "SoftSpheres": 2000}
"""Numbers of particles of the task speed, for 500 or more."""

STEPS: dict[str, dict[str, float]] = {"import": {"s": IMPORTED}}
COMPILED: list[float] = []


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
    for points, words in ((61, "first"), (47, "47 points,")):
        measured = with_points(curve, points)
        result = step(f"{words} fit", lambda c=measured: jaxgran.fit(gas, c, free=BOTH))
        step(f"{words} diagnose", lambda r=result, c=measured: jaxgran.diagnose(r, c))
        one, two = (STEPS[f"{words} {name}"] for name in ("fit", "diagnose"))
        STEPS[f"{words} fit and diagnose"] = {key: one[key] + two[key] for key in one}
    step("fit again", lambda: jaxgran.fit(gas, measured, free=BOTH), repeats=5)
    step("other free", lambda: jaxgran.fit(gas, measured, free=BOTH[:1]))


def lengths(gas: Any, curve: Any, _: int) -> None:
    """Fit and diagnose curves of 20 lengths."""

    def all_of_them():
        for points in LENGTHS:
            measured = with_points(curve, points)
            jaxgran.diagnose(jaxgran.fit(gas, measured, free=BOTH), measured)

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

    def cool(constant):
        return jaxgran.cool(gas.replace(dissipative_constant=constant), late).temperature

    ways = {"KineticTheory": cool, "forward": lambda a: jax.jvp(cool, (a,), (1.0,))[1]}
    ways["reverse"] = jax.grad(lambda a: np.log(late) @ cool(a))
    for name, way in ways.items():
        compiled = jax.jit(way)
        jax.block_until_ready(compiled(3e-6))
        step(f"speed of {name}", lambda call=compiled: call(3e-6), repeats=100)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    jax.monitoring.register_event_duration_secs_listener(hear)
    task, file, number = sys.argv[1:]
    measured, header = jaxgran.read_curve(file)
    beads = jaxgran.read_gas(header).replace(dissipative_constant=3e-6)
    tasks = {"reference": reference, "fit": fit, "lengths": lengths, "speed": speed}
    if task in tasks:
        tasks[task](beads, measured, int(number))
    else:
        first_run(task, beads, int(number))
    print(json.dumps({"package": jaxgran.__file__, "steps": STEPS}))
