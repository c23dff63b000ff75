"""How long do the first curve, fit and run of each model take? Most of it is compilation.

    python experiments/speed/benchmark_compilation.py [CHECKOUT] [--only TASK ...] [--rounds 1]
        [--num 500] [--smoke] [--out FILE] [--record]

Each task runs in a new process without a cache of compiled programs. Prints the seconds of each
step, those of XLA's compiler, the number of programs compiled, and the ratio of the seconds to the
reference: the first call of `jax.jit(jax.jacfwd(...))` of ln T of kinetic theory in A and T_0 in
the same round. With CHECKOUT, the folder of another version (``git worktree add --detach FOLDER
COMMIT``), both versions run in turn, and the last columns are the ratio of seconds, now over
before, and its standard error. Seconds and ratios are medians over the rounds. With --record, a
comparison of the speed of two versions is written to figures/benchmark_versions.json.

The tasks:
    reference: the import, the Jacobian and the curve, their run times, and the numbers of
        equations of their jaxprs.
    fit: fit and diagnosis of a curve with 61 points, then of one with 47, then with other `free`.
    lengths: fit and diagnosis of 20 curves of 20 lengths.
    command: `jaxgran fit` as a process, with an empty cache, again, and without a cache.
    SoftSpheres, HardSpheres, DSMC: runs of one mean free time; the last one of the first two
        continues from the particles of the one before.
    speed: medians of repeated runs of larger gases and of kinetic theory, compiled before.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# A task imports the version that it measures, and nothing else of this repository.
ROOT = Path(__file__).parents[2]
CURVE = ROOT / "experiments" / "data" / "lammps_cooling_dilute.csv"
MODELS = "SoftSpheres", "HardSpheres", "DSMC"
TASKS = "reference", "fit", "lengths", "command", *MODELS, "speed"
SPEED = {"DSMC": 100_000, "HardSpheres": 4096, "SoftSpheres": 2000}
"""Numbers of particles of the task speed."""

REFERENCE = "first Jacobian"
LENGTHS = range(40, 60)
BOTH = "dissipative_constant", "temperature"
JOBS = {"first": "cold", "again": "warm"}
COMMAND = "import sys; from jaxgran.cli.main import main; sys.exit(main(sys.argv[1:]))"


class Steps:
    """The steps of a task: seconds, seconds of XLA's compiler, and number of programs."""

    def __init__(self) -> None:
        self.found: dict[str, dict[str, float]] = {}
        self.compiled: list[float] = []
        jax.monitoring.register_event_duration_secs_listener(self._hear)

    def _hear(self, event: str, duration_secs: float, **_: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.compiled.append(duration_secs)

    def run(self, name: str, call: Any, repeats: int = 1) -> Any:
        """Record the median seconds of a call, and return its result."""
        self.compiled, took, result = [], [], None
        for _ in range(repeats):
            begin = time.perf_counter()
            result = jax.block_until_ready(call())
            took.append(time.perf_counter() - begin)
        row = {"s": statistics.median(took)}
        row |= {"xla_s": sum(self.compiled), "programs": len(self.compiled)}
        self.found[name] = row
        return result


def measured(num_points: int | None = None) -> tuple[Any, Any]:
    """Return the gas and the curve measured in LAMMPS, interpolated to a number of points."""
    import jaxgran

    curve, header = jaxgran.read_curve(CURVE)
    of = curve.times, curve.temperature, curve.temperature_error
    t, T, error = (np.asarray(x)[1:] for x in of)  # at t = 0 nothing is measured
    times = t if num_points is None else np.geomspace(t[0], t[-1], num_points)
    columns = times, np.interp(times, t, T), np.interp(times, t, error)
    times, T, error = map(jax.device_put, columns)  # jnp.asarray compiles for each length
    return jaxgran.read_gas(header), jaxgran.CoolingCurve(times, T, temperature_error=error)


def reference(steps: Steps) -> None:
    import jaxgran

    gas, curve = measured()

    def log_temperature(constant, temperature):
        now = gas.replace(dissipative_constant=constant, temperature=temperature)
        return jnp.log(jaxgran.cool(now, curve.times).temperature)

    at = 3e-6, 0.01
    ways = {"Jacobian": jax.jacfwd(log_temperature, argnums=(0, 1)), "curve": log_temperature}
    for name, way in ways.items():
        compiled = jax.jit(way)
        steps.run(f"first {name}", lambda call=compiled: call(*at))
        steps.run(f"{name} again", lambda call=compiled: call(*at), repeats=100)
    for name, way in ways.items():
        steps.found[f"{name}, jaxpr"] = {"equations": equations(jax.make_jaxpr(way)(*at).jaxpr)}


def equations(jaxpr: Any) -> int:
    """Return the number of equations of a jaxpr and of those inside it."""
    values = [value for equation in jaxpr.eqns for value in equation.params.values()]
    parts = [x for value in values for x in (value if isinstance(value, tuple | list) else [value])]
    inner = [getattr(part, "jaxpr", part) for part in parts]
    return len(jaxpr.eqns) + sum(equations(part) for part in inner if hasattr(part, "eqns"))


def fit(steps: Steps) -> None:
    import jaxgran

    for points, words in ((61, "first"), (47, "47 points,")):
        gas, curve = measured(points)
        names = f"{words} fit", f"{words} diagnose"
        result = steps.run(names[0], lambda g=gas, c=curve: jaxgran.fit(g, c, free=BOTH))
        steps.run(names[1], lambda r=result, c=curve: jaxgran.diagnose(r, c))
        one, two = (steps.found[name] for name in names)
        steps.found[f"{words} fit and diagnose"] = {key: one[key] + two[key] for key in one}
    gas, curve = measured(61)
    steps.run("fit again", lambda: jaxgran.fit(gas, curve, free=BOTH), repeats=5)
    steps.run("other free", lambda: jaxgran.fit(gas, curve, free=BOTH[:1]))


def lengths(steps: Steps) -> None:
    import jaxgran

    def all_of_them():
        for points in LENGTHS:
            gas, curve = measured(points)
            jaxgran.diagnose(jaxgran.fit(gas, curve, free=BOTH), curve)

    steps.run(f"{len(LENGTHS)} lengths, fit and diagnose", all_of_them)


def first_run(steps: Steps, name: str, num: int) -> None:
    import jaxgran

    gas = measured()[0].replace(dissipative_constant=3e-6)
    times = jnp.array([0.5, 1.0]) * gas.mean_free_time

    def run(**start):
        model = getattr(jaxgran, name)(num, **start)
        return jaxgran.cool(gas, times, model=model, progress=False).particles

    particles = steps.run(name, run)
    steps.run(f"{name} again", run)
    if particles is not None:
        steps.run(f"{name} from a start", lambda: run(start=particles))
        steps.run(f"{name} from a start again", lambda: run(start=particles))


def speed(steps: Steps, num: int) -> None:
    import jaxgran

    gas = measured()[0].replace(dissipative_constant=3e-6)
    times = np.linspace(0, 10.0, 6)[1:] * float(gas.mean_free_time)
    for name, size in SPEED.items():
        model = getattr(jaxgran, name)(min(size, num))

        def run(model=model):
            return jaxgran.cool(gas, times, model=model, progress=False).temperature

        jax.block_until_ready(run())
        steps.run(f"speed of {name}", run, repeats=7)
    late = np.geomspace(0.1, 1e5, 50) * float(gas.mean_free_time)

    def cool(constant):
        return jaxgran.cool(gas.replace(dissipative_constant=constant), late).temperature

    ways = {"KineticTheory": cool, "forward": lambda a: jax.jvp(cool, (a,), (1.0,))[1]}
    ways["reverse"] = jax.grad(lambda a: np.log(late) @ cool(a))
    for name, way in ways.items():
        compiled = jax.jit(way)
        jax.block_until_ready(compiled(3e-6))
        steps.run(f"speed of {name}", lambda call=compiled: call(3e-6), repeats=100)


def run_task(name: str, num: int) -> None:
    """Run a task in this process, and print its steps as JSON."""
    begin = time.perf_counter()

    import jaxgran

    imported = time.perf_counter() - begin
    jax.config.update("jax_enable_x64", True)
    steps = Steps()
    if name == "reference":
        steps.found["import"] = {"s": imported}
    if name in MODELS:
        first_run(steps, name, num)
    elif name == "speed":
        speed(steps, 200 * num)
    else:
        {"reference": reference, "fit": fit, "lengths": lengths}[name](steps)
    print(json.dumps({"package": jaxgran.__file__, "steps": steps.found}))


def run_command(folder: Path) -> dict[str, dict[str, float]]:
    """Measure `jaxgran fit` as a process: with an empty cache, with its cache, and without one."""
    found = {}
    with tempfile.TemporaryDirectory() as cache:
        for name, no_cache in (("cold", []), ("warm", []), ("no cache", ["--no-cache"])):
            options = ["fit", CURVE, "--free", "A", "T0", "--out", cache, "--overwrite", *no_cache]
            begin = time.perf_counter()
            done = process(folder, ["-c", COMMAND, *map(str, options)], XDG_CACHE_HOME=cache)
            row = {"s": time.perf_counter() - begin, "characters of stderr": len(done.stderr)}
            found[f"jaxgran fit, {name}"] = row
    return found


def process(folder: Path, arguments: list[str], **variables: str) -> subprocess.CompletedProcess:
    """Run Python with the version in a folder, without settings of JAX and of its caches."""
    bare = {key: x for key, x in os.environ.items() if not key.startswith(("JAX", "XLA"))}
    bare |= {"PYTHONPATH": str(folder.resolve())} | variables
    command = [sys.executable, *arguments]
    done = subprocess.run(
        command, env=bare, cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"the version in {folder} does not run:\n{done.stderr}")
    return done


def measure(folder: Path, tasks: list[str], num: int) -> dict[str, dict[str, float]]:
    """Return the steps of all tasks of the version in a folder."""
    found: dict[str, dict[str, float]] = {}
    for task in tasks:
        if task == "command":
            found |= run_command(folder)
            continue
        done = process(folder, [str(Path(__file__).resolve()), "--task", task, "--num", str(num)])
        result = json.loads(done.stdout.splitlines()[-1])
        if not Path(result["package"]).is_relative_to(folder.resolve()):
            raise SystemExit(f"not the version in {folder} was imported, but {result['package']}")
        found |= result["steps"]
    return found


def median_over(rounds: list[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Return the medians over the rounds, with the ratio of seconds to the reference."""
    for steps in rounds:
        for row in steps.values():
            if "s" in row:
                row["ratio"] = row["s"] / steps[REFERENCE]["s"]
    median = statistics.median
    return {
        name: {key: median([steps[name][key] for steps in rounds]) for key in row}
        for name, row in rounds[0].items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkout", type=Path, nargs="?", help="folder of another version")
    parser.add_argument("--only", nargs="+", choices=TASKS, help="tasks to run")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--num", type=int, default=500, help="number of particles")
    parser.add_argument("--smoke", action="store_true", help="the reference and DSMC of 100")
    parser.add_argument("--task", choices=TASKS, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--record", action="store_true", help="write the figures of the documents")
    options = parser.parse_args()
    if options.task:
        run_task(options.task, options.num)
        return
    from experiments.support.record import write_results

    tasks = [x for x in TASKS if x == "reference" or x in (options.only or TASKS)]
    tasks, num = (["reference", "DSMC"], 100) if options.smoke else (tasks, options.num)
    if options.record and not options.checkout and len(tasks) < len(TASKS):
        parser.error("--record needs all tasks: leave out --only and --smoke")
    folders = [ROOT, *([options.checkout] if options.checkout else [])]
    rounds: dict[Path, list] = {folder: [] for folder in folders}
    for k in range(options.rounds):
        for folder in folders[:: 1 - 2 * (k % 2)]:
            rounds[folder].append(measure(folder, tasks, num))
    now, *other = (median_over(rounds[folder]) for folder in folders)
    compared = {}
    for name, row in now.items():
        text = f"{name:34}" + "".join(f"{key} {x:<9.3g}" for key, x in row.items())
        if other and name in other[0]:
            key = next(iter(row))
            pairs = zip(*(rounds[folder] for folder in folders), strict=True)
            each = [one[name][key] / before[name][key] for one, before in pairs]
            spread = statistics.stdev(each) if len(each) > 1 else float("nan")
            ratio, error = statistics.median(each), spread / len(each) ** 0.5
            compared[name] = {"ratio": ratio, "error": error}
            text += f"  before {other[0][name][key]:<8.3g} now / before {ratio:.3g} +- {error:.2g}"
        print(text)
    jax.config.update("jax_enable_x64", True)  # as in the tasks
    results = {"num_particles": num, "rounds": options.rounds, **tables(now)}
    if not other:
        write_results("benchmark_compilation", options, options.out, **results)
        return
    speeds = {name: x for name, x in compared.items() if name.startswith("speed of ")}
    rows = [{"model": name.removeprefix("speed of "), **x} for name, x in speeds.items()]
    results |= {"rows": rows, "compared": compared, "before": tables(other[0])}
    write_results("benchmark_versions", options, options.out, **results)


def tables(steps: dict[str, dict[str, float]]) -> dict[str, dict]:
    """Return the runs of the particle models, the command, and all other steps."""
    rest, rows, job = dict(steps), {}, {}
    for name in [name for name in steps if name.startswith(MODELS) and f"{name} again" in steps]:
        row = rest.pop(name)
        rows[name] = {"first_s": row.pop("s"), "again_s": rest.pop(f"{name} again")["s"], **row}
    if "jaxgran fit, cold" in steps:
        job = {f"{key}_s": steps[f"jaxgran fit, {x}"]["s"] for key, x in JOBS.items()}
    return {"rows": rows, "main_job": job, "steps": rest}


if __name__ == "__main__":
    main()
