"""How fast is kinetic theory? Ratios of times measured in one run.

    python experiments/speed/benchmark_kinetic_theory.py [--smoke]

1. 1000 cooling curves over five decades of time by `jax.vmap`, compared with a loop over SciPy's
   solve_ivp (LSODA) on the same equations in NumPy at the same accuracy. The errors of both are
   relative to a solution with a tighter tolerance.
2. One derivative, in forward and in reverse mode, compared with one solution without it.
3. The first calls in a new process, which compile; the time of `import jaxgran`, and of a whole fit
   by `fit_cooling_curve.py` in a new process, the first time and the second time.

Run times are medians of repeats, without compilation, which is given separately.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxgran
from experiments.support.record import add_recording, write_results
from jaxgran.scene.geometry import NODES, sphere_surface
from jaxgran.theory.averages import averaging_matrix

NUM_CURVES = 1000
NUM_TIMES = 50
DECADES = 5
RTOL = 1e-7  # gives the accuracy that LSODA reaches with SCIPY_RTOL
SCIPY_RTOL = 1e-9
REPEATS = 5
SAME_EQUATIONS = {"order": 2, "softness": False, "correlations": False}
"""Options for which kinetic theory solves the equations that are written here for SciPy."""


def scene() -> jaxgran.Gas:
    return jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, 3e-6),
        diameter=0.002,
        mass=jaxgran.sphere_mass(0.002, 2500.0),
        packing_fraction=0.05,
        temperature=0.01,
    )


def median_seconds(run: Callable, repeats: int) -> tuple[float, float]:
    """Return seconds of compilation (first call less a later one) and the median of later calls."""
    begin = time.perf_counter()
    jax.block_until_ready(run())
    first = time.perf_counter() - begin
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(run())
        seconds.append(time.perf_counter() - begin)
    return first - float(np.median(seconds)), float(np.median(seconds))


def scipy_curve(gas: jaxgran.Gas, a: float, times: np.ndarray) -> np.ndarray:
    """Solve T of one gas by NumPy and SciPy, with averages by quadrature at every step."""
    law = gas.replace(dissipative_constant=a).reduced_law
    beta = float(law.beta)  # pyright: ignore
    g, weights = NODES, averaging_matrix(3, 2).reshape(9, -1)
    powers = np.arange(7)[:, None]
    share = sphere_surface(3) / np.sqrt(2 * np.pi)

    def velocity(s, y):
        log_theta, a2, diffusion, _, _ = y
        speed = np.exp(log_theta / 2)
        lost = 1 - numpy_restitution(beta * (g * speed) ** 0.2)
        averages = (weights @ (lost**powers).ravel()).reshape(3, 3)
        mu2, mu4, nu_v = averages @ np.array([1, a2, a2 * a2])
        cooling = 2 / 3 * mu2 * speed
        peaking = 2 * cooling * (1 + a2) - 4 / 15 * mu4 * speed
        rates = [
            -cooling,
            peaking,
            speed / 2 - (nu_v * speed - cooling / 2) * diffusion,
            6 * speed * diffusion,
            share * (1 - a2 / 16) * speed,
        ]
        return np.exp(s) * np.array(rates)

    s = np.log1p(times * float(gas.impact_speed / gas.path_length))
    solution = solve_ivp(
        velocity,
        (0.0, s[-1]),
        np.zeros(5),
        method="LSODA",
        t_eval=s,
        rtol=SCIPY_RTOL,
        atol=SCIPY_RTOL,
    )
    return float(gas.temperature) * np.exp(solution.y[0])


def numpy_restitution(beta: np.ndarray) -> np.ndarray:
    """Return eps by the rational fit of the clipped restitution law, in NumPy."""
    from jaxgran.scene.laws import _CLIPPED as fit
    from jaxgran.scene.laws import C1

    z = np.sqrt(beta)
    p = fit.decay * fit.kappa - C1 + beta * np.polynomial.polynomial.polyval(z, fit.p)
    q = 1 + beta * np.polynomial.polynomial.polyval(z, fit.q)
    return np.exp(beta * p / q - fit.decay * np.log1p(fit.kappa * beta))


def sweep_against_scipy(num_curves: int, num_scipy: int) -> dict[str, float]:
    gas = scene()
    times = np.geomspace(1e-1, 10 ** (DECADES - 1), NUM_TIMES) * float(gas.mean_free_time)
    constants = np.geomspace(3e-7, 3e-5, num_curves)

    def curves(model):
        def one(a):
            return jaxgran.cool(
                gas.replace(dissipative_constant=a), jnp.asarray(times), model=model
            ).temperature

        return jax.jit(jax.vmap(one))

    ours = curves(jaxgran.KineticTheory(rtol=RTOL, **SAME_EQUATIONS))
    compile_seconds, seconds = median_seconds(lambda: ours(constants), REPEATS)
    exact = np.asarray(curves(jaxgran.KineticTheory(rtol=1e-12, **SAME_EQUATIONS))(constants))
    error = np.max(np.abs(np.asarray(ours(constants)) / exact - 1))

    picked = np.linspace(0, num_curves - 1, num_scipy).astype(int)
    begin = time.perf_counter()
    looped = np.stack([scipy_curve(gas, float(constants[i]), times) for i in picked])
    scipy_seconds = (time.perf_counter() - begin) * num_curves / num_scipy
    scipy_error = np.max(np.abs(looped / exact[picked] - 1))
    return {
        "num_curves": num_curves,
        "vmap_compile_s": compile_seconds,
        "vmap_run_s": seconds,
        "vmap_error": float(error),
        "scipy_curves_timed": num_scipy,
        "scipy_s": scipy_seconds,
        "scipy_error": float(scipy_error),
        "ratio_scipy_over_vmap": scipy_seconds / seconds,
    }


def derivative_cost(repeats: int) -> dict[str, float]:
    gas = scene()
    times = jnp.geomspace(1e-1, 10 ** (DECADES - 1), NUM_TIMES) * gas.mean_free_time

    def log_temperature(a):
        return jnp.log(jaxgran.cool(gas.replace(dissipative_constant=a), times).temperature)

    runs = {
        "solve": jax.jit(log_temperature),
        "forward": jax.jit(jax.jacfwd(log_temperature)),
        "reverse": jax.jit(jax.grad(lambda a: jnp.sum(log_temperature(a)))),
    }
    a = jnp.asarray(3e-6)
    row = {}
    for name, run in runs.items():
        compiled, seconds = median_seconds(lambda run=run: run(a), repeats)
        row[f"{name}_compile_s"], row[f"{name}_ms"] = compiled, 1e3 * seconds
    row["ratio_forward"] = row["forward_ms"] / row["solve_ms"]
    row["ratio_reverse"] = row["reverse_ms"] / row["solve_ms"]
    many = jnp.geomspace(3e-7, 3e-5, 100)
    batch = {name: jax.jit(jax.vmap(runs[name])) for name in runs}
    seconds = {n: median_seconds(lambda f=f: f(many), 5)[1] for n, f in batch.items()}
    row["ratio_forward_in_batches_of_100"] = seconds["forward"] / seconds["solve"]
    return row


FIRST_CALLS = """
import json, time
import jax, jax.numpy as jnp, jaxgran
from experiments.speed.benchmark_kinetic_theory import scene
jax.config.update("jax_enable_x64", True)
gas, seconds = scene(), {}
times = {n: jnp.geomspace(1e-3, 100.0, n) for n in (50, 60)}

def log_temperature(a):
    return jnp.log(jaxgran.cool(gas.replace(dissipative_constant=a), times[50]).temperature)

for name, run in {
    "cool": lambda: jaxgran.cool(gas, times[50]),
    "cool_another_number_of_times": lambda: jaxgran.cool(gas, times[60]),
    "jacfwd": lambda: jax.jacfwd(log_temperature)(3e-6),
    "jacrev": lambda: jax.jacrev(log_temperature)(3e-6),
    "vmap": lambda: jax.vmap(log_temperature)(jnp.geomspace(1e-6, 1e-5, 10)),
}.items():
    begin = time.perf_counter()
    jax.block_until_ready(run())
    seconds[f"first_{name}_s"] = time.perf_counter() - begin
print(json.dumps(seconds))
"""
"""Script of a new process that times first calls, each of which compiles."""


def cold_starts() -> dict[str, float]:
    """Measure seconds of new processes, without earlier compiled programs."""
    bare = {k: v for k, v in os.environ.items() if not k.startswith("JAX")}
    root = Path(__file__).parents[2]
    bare["PYTHONPATH"] = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])

    def seconds(*command, **more):
        begin = time.perf_counter()
        subprocess.run([sys.executable, *command], check=True, capture_output=True, env=bare | more)
        return time.perf_counter() - begin

    done = [
        subprocess.run(
            [sys.executable, "-c", FIRST_CALLS],
            check=True,
            capture_output=True,
            text=True,
            env=bare,
        )
        for _ in range(3)
    ]
    first = [json.loads(one.stdout.splitlines()[-1]) for one in done]
    row = {name: float(np.median([one[name] for one in first])) for name in first[0]}
    script = str(root / "experiments" / "fit_cooling_curve.py")
    with tempfile.TemporaryDirectory() as folder:
        kept = {"XDG_CACHE_HOME": folder}
        for name in ("main_job_s", "main_job_again_s"):  # the second time with cached programs
            row[name] = seconds(script, "--out", folder, "--overwrite", **kept)
    empty = float(np.median([seconds("-c", "pass") for _ in range(3)]))
    light = float(np.median([seconds("-c", "import jaxgran") for _ in range(3)]))
    return row | {"import_s": light - empty}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="a run of seconds instead of a minute")
    add_recording(parser)
    options = parser.parse_args()
    smoke = options.smoke
    jax.config.update("jax_enable_x64", True)
    sweep = sweep_against_scipy(20 if smoke else NUM_CURVES, 2 if smoke else 50)
    derivative = derivative_cost(5 if smoke else 50)
    cold = {} if smoke else cold_starts()
    for title, row in (("sweep", sweep), ("derivative", derivative), ("cold", cold)):
        for name, value in row.items():
            print(f"{title:12}{name:34}{value:12.4g}")
    results = {"sweep": sweep, "derivative": derivative, "cold": cold}
    write_results("benchmark_kinetic_theory", options, None, **results)
    print(json.dumps({"device": jax.devices()[0].device_kind} | sweep | derivative | cold))


if __name__ == "__main__":
    main()
