"""How does the speed of a smooth periodic gas compare with another version of the package?

    python experiments/speed/benchmark_versions.py CHECKOUT [--rounds 5] [--repeats 7] [--smoke]
        [--out FILE] [--record]

CHECKOUT is the folder of the other version (``git worktree add --detach FOLDER COMMIT``). Both
versions run the same gas (phi = .05, beta_T0 = .15, 10 mean free times) in alternating processes.
Prints, for each particle model, the ratio of the shortest times per collision, now over before:
the median over the rounds, with its standard error. Also prints these ratios for a curve of kinetic
theory over six decades of time, its derivative in A, forward and reverse, and their first calls,
which trace and compile. The seconds of both versions are recorded too.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from experiments.support.record import EXPERIMENTS, add_recording, write_results

# The scene is written out because other versions have theirs in other modules.
MEASURE = """
import json, sys, time
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxgran

def beads(contact_fraction=None):
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(1e7, 0.22, 1e-6), diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0), packing_fraction=0.05, temperature=0.01,
        dimension=3)
    if contact_fraction is not None:
        stiffer = (float(gas.contact_fraction) / contact_fraction) ** 2.5
        gas = gas.replace(youngs_modulus=stiffer * gas.value("youngs_modulus"))
    return gas.replace(dissipative_constant=1e-6 * 0.15 / float(gas.thermal_beta))

repeats, until = int(sys.argv[1]), float(sys.argv[2])
found = {}
for model in (jaxgran.DSMC(100_000), jaxgran.HardSpheres(4096), jaxgran.SoftSpheres(2000)):
    gas = beads(0.02 if isinstance(model, jaxgran.SoftSpheres) else None)
    times = np.linspace(0, until, 6)[1:] * float(gas.mean_free_time)
    took = []
    for _ in range(1 + repeats):
        began = time.perf_counter()
        curve = jaxgran.cool(gas, times, model=model)
        jax.block_until_ready(curve.temperature)
        took.append(time.perf_counter() - began)
    found[type(model).__name__] = min(took[1:]) / float(curve.collisions[-1])

gas = beads()
times = np.geomspace(0.1, 1e5, 50) * float(gas.mean_free_time)
cool = jax.jit(lambda a: jaxgran.cool(gas.replace(dissipative_constant=a), times).temperature)
slope = jax.jit(lambda a: jax.jvp(cool, (a,), (1.0,))[1])
back = jax.jit(jax.grad(lambda a: np.log(times) @ cool(a)))
for name, call in {"KineticTheory": cool, "forward": slope, "reverse": back}.items():
    took = []
    for _ in range(2 + 20 * repeats):
        began = time.perf_counter()
        jax.block_until_ready(call(float(gas.value("dissipative_constant"))))
        took.append(time.perf_counter() - began)
    found[name] = min(took[1:])
    found[name + ", first call"] = took[0]
print(json.dumps(found | {"package": jaxgran.__file__}))
"""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkout", type=Path, help="folder of the other version")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=7, help="runs of each model in a process")
    parser.add_argument("--smoke", action="store_true", help="one short run each")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    add_recording(parser)
    options = parser.parse_args()
    if not (options.checkout / "jaxgran" / "__init__.py").is_file():
        parser.error(f"{options.checkout} holds no folder jaxgran: give a checkout of a version")
    rounds, repeats, until = (
        (1, 1, 0.5) if options.smoke else (options.rounds, options.repeats, 10.0)
    )
    ratios: dict[str, list[float]] = {}
    seconds: list[dict] = []
    for k in range(rounds):
        order = [options.checkout, EXPERIMENTS.parent]
        turn = {folder: measured(folder, repeats, until) for folder in order[:: 1 - 2 * (k % 2)]}
        before, now = (turn[folder] for folder in order)
        for model in now:
            ratios.setdefault(model, []).append(now[model] / before[model])
        seconds.append({"before": before, "now": now})
    rows = []
    for model, each in ratios.items():
        spread = statistics.stdev(each) if len(each) > 1 else float("nan")
        error = spread / len(each) ** 0.5
        rows.append({"model": model, "ratio": statistics.median(each), "error": error})
        print(f"{model:>25}: now over before {statistics.median(each):.3f} +- {error:.3f}")
    write_results("benchmark_versions", options, options.out, rows=rows, seconds=seconds)


def measured(folder: Path, repeats: int, until: float) -> dict[str, float]:
    """Return seconds by model (per collision, for particles) of the version in a folder."""
    environment = os.environ | {"PYTHONPATH": str(folder.resolve())}
    command = [sys.executable, "-c", MEASURE, str(repeats), str(until)]
    done = subprocess.run(
        command, env=environment, cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"the version in {folder} does not run:\n{done.stderr}")
    found = json.loads(done.stdout.splitlines()[-1])
    package = Path(found.pop("package"))
    if not package.is_relative_to(folder.resolve()):
        raise SystemExit(f"the version in {folder} was not imported, but {package}")
    return found


if __name__ == "__main__":
    main()
