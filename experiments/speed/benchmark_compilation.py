"""How long does the first run of each particle model, or a fit, take?

    python experiments/speed/benchmark_compilation.py [--smoke]

Each row is a new process without a cache of compiled programs: the seconds of the first call of
`jaxgran.cool` and of the same call again, the seconds that XLA compiles, and the number of
programs, including those of single operations on arrays. "HardSpheres from a start" continues from
the particles of a run in the same process; its first call is that of the second run.

"jaxgran fit" is the main job, `python experiments/fit_cooling_curve.py`, from the start of Python
to its end, with the picture: the first time with an empty cache folder, and the median of three
later times, each in a separate process.
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

import jax
import jax.numpy as jnp

import jaxgran
from experiments.support.record import add_recording, write_results
from experiments.support.scenes import beads

ROOT = Path(__file__).parents[2]
JOB = ROOT / "experiments" / "fit_cooling_curve.py"
NUM = 2000
EVENT = "/jax/core/compile/backend_compile_duration"
ROWS = ("SoftSpheres", "HardSpheres", "HardSpheres from a start", "DSMC")


def first_run(name: str, num: int) -> dict[str, float]:
    """Measure seconds and programs of the first run of a model, of one mean free time."""
    jax.config.update("jax_enable_x64", True)
    gas = beads(0.05, 0.15)
    times = jnp.array([0.5, 1.0]) * gas.mean_free_time
    kind = getattr(jaxgran, name.split()[0])
    model = kind(num)
    if name.endswith("start"):
        model = kind(num, start=jaxgran.cool(gas, times, model=model, progress=False).particles)
    compiled: list[float] = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == EVENT:
            compiled.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    took, row = [], {}
    for _ in range(2):
        begin = time.perf_counter()
        jax.block_until_ready(jaxgran.cool(gas, times, model=model, progress=False).temperature)
        took.append(time.perf_counter() - begin)
        if len(took) == 1:
            row = {"xla_s": sum(compiled), "programs": len(compiled)}
    return {"first_s": took[0], "again_s": took[1]} | row


def in_new_process(name: str, num: int) -> dict[str, float]:
    """Measure the first run of a model in a separate process, without a cache."""
    done = subprocess.run(
        [sys.executable, __file__, "--row", name, "--num", str(num)],
        check=True,
        capture_output=True,
        text=True,
        env=_bare(),
    )
    return json.loads(done.stdout.splitlines()[-1])


def main_job() -> dict[str, float]:
    """Measure the seconds of a fit: the first time, and the median of later times."""
    took = []
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(JOB), "--out", folder, "--overwrite"]
        environment = _bare() | {"XDG_CACHE_HOME": folder}
        for _ in range(4):
            begin = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True, env=environment)
            took.append(time.perf_counter() - begin)
    return {"first_s": took[0], "again_s": statistics.median(took[1:])}


def _bare() -> dict[str, str]:
    """Return the environment without settings of JAX and of its caches."""
    bare = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", "XLA"))}
    return bare | {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="100 particles, DSMC alone")
    parser.add_argument("--row", choices=ROWS, help="measure one row in this process")
    parser.add_argument("--num", type=int, default=NUM, help="number of particles")
    add_recording(parser)
    options = parser.parse_args()
    if options.row is not None:
        print(json.dumps(first_run(options.row, options.num)))
        return
    names, num = (ROWS[-1:], 100) if options.smoke else (ROWS, options.num)
    rows = {}
    for name in names:
        rows[name] = in_new_process(name, num)
        print(f"{name:26}", *(f"{k} {v:8.3g}" for k, v in rows[name].items()))
    job = {} if options.smoke else main_job()
    print(f"{'jaxgran fit':26}", *(f"{k} {v:8.3g}" for k, v in job.items()))
    results = {"num_particles": num, "rows": rows, "main_job": job}
    write_results("benchmark_compilation", options, None, **results)
    print(json.dumps(rows | {"jaxgran fit": job}))


if __name__ == "__main__":
    main()
