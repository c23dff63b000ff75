"""How fast is kinetic theory, how long do first curves, fits and runs take, in which version?

    python experiments/speed/benchmark_theory.py [--only benchmark_kinetic_theory
        benchmark_compilation] [--tasks TASK ...] [--checkout CHECKOUT] [--rounds 1] [--smoke]
        [--record] [--out DIR]
    python experiments/speed/benchmark_theory.py --only benchmark_versions --checkout CHECKOUT
        [--rounds 5] [--record]

benchmark_kinetic_theory: 1000 cooling curves over five decades of time by `jax.vmap`, compared with
a loop over SciPy's solve_ivp (LSODA) on the same equations in NumPy at the same accuracy. The
errors of both are relative to a solution with a tighter tolerance. One derivative, in forward and
in reverse mode, compared with one solution without it. Run times are medians of repeats, without
compilation, which is given separately.

benchmark_compilation: tasks, each in a new process without a cache of compiled programs: seconds
of each step, those of XLA's compiler, the number of programs compiled, and the ratio of the seconds
to the reference in the same round; medians over the rounds. With CHECKOUT, the folder of another
version (``git worktree add --detach CHECKOUT COMMIT``), both versions run in turn and are compared:
ratio of seconds, now over before, and its standard error. The tasks, of which each begins with the
import, are (`support/version.py`)

    reference: the first call of `jax.jit(jax.jacfwd(...))` of ln T of kinetic theory in A and T_0.
    fit: fit with its range of a curve with 61 points, then of one with 47, then with other `free`.
    lengths: fits with their ranges of 20 curves of 20 lengths.
    plan: a fit of 250 grains with errors of 2 %, a plan about it, and 100 imitations of it and of
        its strongest alternative.
    command: `jaxgran fit` as a process, with an empty cache, again, and without a cache.
    SoftSpheres, HardSpheres, DSMC: runs of one mean free time; the last one of the first two
        continues from the particles of the one before.

benchmark_versions: the same for medians of repeated runs of larger gases and of kinetic theory,
compiled before, by this version and by another one.
"""

import tempfile
import time
from collections.abc import Iterator, Sequence
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import jaxgran
from experiments.support.record import (
    EXPERIMENTS,
    Options,
    alternately,
    of_version,
    process,
    run_parts,
    seconds,
)
from experiments.support.scenes import glass
from jaxgran.data.example import EXAMPLE_FILES
from jaxgran.scene.geometry import NODES, sphere_surface
from jaxgran.scene.laws import _CLIPPED, C1
from jaxgran.theory.averages import averaging_matrix

CURVE = EXAMPLE_FILES["dilute"]
TASKS = "reference", "fit", "lengths", "plan", "command", "SoftSpheres", "HardSpheres", "DSMC"
RTOL, SCIPY_RTOL = 1e-7, 1e-9  # both give the same accuracy
REFERENCE = "first Jacobian"
SAME_EQUATIONS = {"order": 2, "corrections": {"sonine", "diffusion", "spin_cumulants"}}
"""Options for which kinetic theory solves the equations that are written here for SciPy."""


@cache
def scene() -> jaxgran.Gas:
    return glass(0.1).replace(dissipative_constant=3e-6)


@cache
def times() -> np.ndarray:
    """Return 50 times over five decades, s."""
    return np.geomspace(1e-1, 1e4, 50) * float(scene().mean_free_time)


def at(constant, model: jaxgran.extend.AbstractModel | None = None) -> jax.Array:
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
    compile_s, run_s = seconds(lambda: ours(constants), 5)
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
    row, batch_s = {}, {}
    for name, run in runs.items():
        row[f"{name}_compile_s"], run_s = seconds(partial(run, jnp.asarray(3e-6)), repeats)
        row[f"{name}_ms"] = 1e3 * run_s
        batch = partial(jax.jit(jax.vmap(run)), jnp.geomspace(3e-7, 3e-5, 100))
        batch_s[name] = seconds(batch, 5)[1]
    row["ratio_forward"] = row["forward_ms"] / row["solve_ms"]
    row["ratio_reverse"] = row["reverse_ms"] / row["solve_ms"]
    row["ratio_forward_in_batches_of_100"] = batch_s["forward"] / batch_s["solve"]
    return row


def benchmark_kinetic_theory(options: Options) -> dict:
    times()  # made here, since they cannot be made under tracing
    sweep = sweep_against_scipy(*((20, 2) if options.smoke else (1000, 50)))
    return {"sweep": sweep, "derivative": derivative_cost(5 if options.smoke else 50)}


def command(folder: Path) -> dict[str, dict[str, float]]:
    """Measure `jaxgran fit` as a process: with an empty cache, with its cache, and without."""
    main = "import jaxgran.cli.main as c; raise SystemExit(getattr(c, 'start', c.main)())"
    with tempfile.TemporaryDirectory() as out:
        arguments = ["-c", main, "fit", CURVE, "--free", "A", "T0", "--out", out, "--overwrite"]
        run = partial(process, *arguments, folder=folder, XDG_CACHE_HOME=out)
        without = partial(run, JAX_ENABLE_COMPILATION_CACHE="false")
        runs = {"jaxgran fit": run, "jaxgran fit again": run, "jaxgran fit, no cache": without}
        return {name: {"s": s} for name, (s,) in alternately(runs, 1).items()}


Steps = dict[str, dict[str, np.ndarray]]


def measured(tasks: Sequence[str], options: Options, num: int) -> list[Steps]:
    """Return the figures of each step in each round, of this version and of the other, if any."""
    folders = [EXPERIMENTS.parent, *([options.checkout] if options.checkout else [])]
    rounds = {folder: [] for folder in folders}
    for k in range(options.rounds):
        for folder in folders[:: 1 - 2 * (k % 2)]:
            steps: dict[str, dict[str, float]] = {}
            for task in tasks:
                is_command = task == "command"
                steps |= command(folder) if is_command else of_version(folder, task, CURVE, num)
            for row in steps.values() if REFERENCE in steps else ():
                row["ratio"] = row["s"] / steps[REFERENCE]["s"]
            rounds[folder].append(steps)
    return [jax.tree.map(lambda *x: np.array(x), *each) for each in rounds.values()]


def compared(now: Steps, before: Steps) -> Iterator[dict]:
    for name, row in now.items():
        ratio = row["s"] / before[name]["s"]
        error = np.std(ratio, ddof=1) / len(ratio) ** 0.5 if len(ratio) > 1 else np.nan
        yield {"model": name.removeprefix("speed of "), "ratio": np.median(ratio), "error": error}


def benchmark_compilation(options: Options) -> dict:
    tasks, num = (["reference", "DSMC"], 100) if options.smoke else (options.tasks, 500)
    versions = measured(tasks, options, num)
    steps, rows = jax.tree.map(np.median, versions[0]), {}
    for name in [name for name in steps if f"{name} again" in steps]:
        row = steps.pop(name)
        rows[name] = {"first_s": row.pop("s"), "again_s": steps.pop(f"{name} again")["s"], **row}
    return {
        "num_particles": num,
        "rounds": options.rounds,
        "main_job": rows.pop("jaxgran fit", {}),
        "rows": rows,
        "steps": steps,
        "compared": list(compared(*versions)) if options.checkout else [],
    }


def benchmark_versions(options: Options) -> Iterator[dict]:
    versions = measured(["speed"], options, 1 if options.smoke else 500)
    return (row for row in compared(*versions) if row["model"] != "import")


if __name__ == "__main__":
    parts = benchmark_kinetic_theory, benchmark_compilation, benchmark_versions
    usual = ("benchmark_kinetic_theory", "benchmark_compilation")
    run_parts(__doc__, *parts, default=usual, tasks=list(TASKS), checkout=Path, rounds=1)
