"""How fast is kinetic theory? Ratios of times measured in one run.

    python experiments/speed/benchmark_theory.py [--smoke] [--record]

1. 1000 cooling curves over five decades of time by `jax.vmap`, compared with a loop over SciPy's
   solve_ivp (LSODA) on the same equations in NumPy at the same accuracy. The errors of both are
   relative to a solution with a tighter tolerance.
2. One derivative, in forward and in reverse mode, compared with one solution without it.

Run times are medians of repeats, without compilation, which is given separately. First calls, and
the whole of `jaxgran fit`, are measured by `benchmark_compilation.py`.
"""

import argparse
import json
import time
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxgran
from experiments.support.record import add_recording, seconds, write_results
from jaxgran.scene.geometry import NODES, sphere_surface
from jaxgran.scene.laws import _CLIPPED, C1
from jaxgran.theory.averages import averaging_matrix

RTOL, SCIPY_RTOL = 1e-7, 1e-9  # both give the same accuracy
REPEATS = 5
SAME_EQUATIONS = {"order": 2, "softness": False, "correlations": False}
"""Options for which kinetic theory solves the equations that are written here for SciPy."""


@cache
def scene() -> jaxgran.Gas:
    return jaxgran.Gas(
        jaxgran.Viscoelastic(5e7, 0.22, 3e-6),
        diameter=0.002,
        mass=jaxgran.sphere_mass(0.002, 2500.0),
        packing_fraction=0.05,
        temperature=0.01,
    )


@cache
def times() -> np.ndarray:
    """Return 50 times over five decades, s."""
    return np.geomspace(1e-1, 1e4, 50) * float(scene().mean_free_time)


def at(constant, model: jaxgran.AbstractModel | None = None) -> jax.Array:
    """Return T with a dissipative constant."""
    gas = scene().replace(dissipative_constant=constant)
    return jaxgran.cool(gas, jnp.asarray(times()), model=model).temperature


def scipy_curve(a: float) -> np.ndarray:
    """Solve T of one gas by NumPy and SciPy, with averages by quadrature at every step."""
    beta = float(scene().replace(dissipative_constant=a).reduced_law.beta)  # pyright: ignore
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
        rates = [
            -cooling,
            2 * cooling * (1 + a2) - 4 / 15 * mu4 * speed,
            speed / 2 - (nu_v * speed - cooling / 2) * diffusion,
            6 * speed * diffusion,
            share * (1 - a2 / 16) * speed,
        ]
        return np.exp(s) * np.array(rates)

    s = np.log1p(times() * float(scene().impact_speed / scene().path_length))
    options = {"method": "LSODA", "t_eval": s, "rtol": SCIPY_RTOL, "atol": SCIPY_RTOL}
    solution = solve_ivp(velocity, (0.0, s[-1]), np.zeros(5), **options)
    return float(scene().temperature) * np.exp(solution.y[0])


def numpy_restitution(beta: np.ndarray) -> np.ndarray:
    """Return eps by the rational fit of the clipped restitution law, in NumPy."""
    z, fit = np.sqrt(beta), _CLIPPED
    p = fit.decay * fit.kappa - C1 + beta * np.polynomial.polynomial.polyval(z, fit.p)
    q = 1 + beta * np.polynomial.polynomial.polyval(z, fit.q)
    return np.exp(beta * p / q - fit.decay * np.log1p(fit.kappa * beta))


def sweep_against_scipy(num_curves: int, num_scipy: int) -> dict[str, float]:
    constants = np.geomspace(3e-7, 3e-5, num_curves)

    def curves(rtol: float):
        model = jaxgran.KineticTheory(rtol=rtol, **SAME_EQUATIONS)
        return jax.jit(jax.vmap(lambda a: at(a, model)))

    ours, exact = curves(RTOL), np.asarray(curves(1e-12)(constants))
    compile_s, run_s = seconds(lambda: ours(constants), REPEATS)
    picked = np.linspace(0, num_curves - 1, num_scipy).astype(int)
    begin = time.perf_counter()
    looped = np.stack([scipy_curve(float(constants[i])) for i in picked])
    scipy_s = (time.perf_counter() - begin) * num_curves / num_scipy
    return {
        "num_curves": num_curves,
        "vmap_compile_s": compile_s,
        "vmap_run_s": run_s,
        "vmap_error": float(np.max(np.abs(np.asarray(ours(constants)) / exact - 1))),
        "scipy_curves_timed": num_scipy,
        "scipy_s": scipy_s,
        "scipy_error": float(np.max(np.abs(looped / exact[picked] - 1))),
        "ratio_scipy_over_vmap": scipy_s / run_s,
    }


def derivative_cost(repeats: int) -> dict[str, float]:
    def log_temperature(a):
        return jnp.log(at(a))

    runs = {
        "solve": jax.jit(log_temperature),
        "forward": jax.jit(jax.jacfwd(log_temperature)),
        "reverse": jax.jit(jax.grad(lambda a: jnp.sum(log_temperature(a)))),
    }
    many, row, batches = jnp.geomspace(3e-7, 3e-5, 100), {}, {}
    for name, run in runs.items():
        compiled, took = seconds(lambda run=run: run(jnp.asarray(3e-6)), repeats)
        row[f"{name}_compile_s"], row[f"{name}_ms"] = compiled, 1e3 * took
        batch = jax.jit(jax.vmap(run))
        batches[name] = seconds(lambda batch=batch: batch(many), 5)[1]
    row["ratio_forward"] = row["forward_ms"] / row["solve_ms"]
    row["ratio_reverse"] = row["reverse_ms"] / row["solve_ms"]
    row["ratio_forward_in_batches_of_100"] = batches["forward"] / batches["solve"]
    return row


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--smoke", action="store_true", help="a run of seconds instead of a minute")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    sweep = sweep_against_scipy(*((20, 2) if options.smoke else (1000, 50)))
    derivative = derivative_cost(5 if options.smoke else 50)
    write_results("benchmark_kinetic_theory", options, None, sweep=sweep, derivative=derivative)
    print(json.dumps(sweep | derivative))


if __name__ == "__main__":
    main()
