"""What does a derivative through a particle simulation cost, in time and in memory?

    python experiments/speed/benchmark_derivatives.py [--fractions .01 .1] [--repeats 5] [--smoke]
        [--out FILE]

ln T at the end of a run is computed in four ways: without a derivative, with its derivative in A in
forward mode, with the same derivative in reverse mode, and with its Jacobian in A and Y. The runs
are soft spheres, which start from equilibrated particles, and DSMC. The four ways run alternately
in one process. The table shows the median run times without compilation; the compilation time of a
way excludes programs that the ways above it have already compiled. If other processes use the same
cores, only the ratio of CPU seconds is reliable.

The second table shows the increase of the peak memory by reverse mode through soft spheres, in a
process that has already compiled it, for runs of increasing length, and the memory that storing the
state after every block would need (Linux only).
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.record import add_recording, write_results
from experiments.support.scenes import beads
from jaxgran.data.curve import Particles

PACKING = 0.1
BETA = 0.15
STEPS_PER_CONTACT = 30
CONTACT_FRACTIONS = (0.01, 0.1)
SOFT_SIZE, STOCHASTIC_SIZE = 4096, 100_000
FREE_TIMES = 3.0  # length of a run, in mean free times at T_0
BLOCKS = (1, 10, 100, 1000)
REPEATS = 5
STATUS = Path("/proc/self/status")
LIMITS = {"forward, A": 3.0, "reverse, A": 5.0}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fractions", nargs="+", type=float, default=CONTACT_FRACTIONS)
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    add_recording(parser)
    parser.add_argument("--memory-worker", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.memory_worker:
        memory_worker(Path(options.memory_worker[0]), float(options.memory_worker[1]))
        return
    fractions, repeats, blocks = options.fractions, options.repeats, BLOCKS
    soft, stochastic = SOFT_SIZE, STOCHASTIC_SIZE
    if options.smoke:
        fractions, repeats, blocks, soft, stochastic = (0.1,), 1, (4,), 100, 1000
    print(f"{jax.devices()[0].device_kind}, float64; a run is {FREE_TIMES:g} mean free times")
    head = f"{'':42}{'compile s':>10}{'run s':>8}{'CPU s':>8}"
    print(f"{head}{'ratio':>12}{'of CPU':>8}{'limit':>9}")
    rows = []
    for fraction in fractions:
        gas = beads(PACKING, BETA, fraction)
        model = equilibrated(gas, soft)
        title = f"SoftSpheres, N={soft}, t_c/tau_c={fraction:g}"
        rows.append(measure(title, gas, model, repeats, compiled=False))
    gas = beads(PACKING, BETA, fractions[0])
    model = jaxgran.DSMC(stochastic)
    rows.append(measure(f"DSMC, N={stochastic}", gas, model, repeats, compiled=True))
    memory = measure_memory(fractions[0], soft, blocks)
    write_results("benchmark_derivatives", options, options.out, rows=rows, memory=memory)


def soft_spheres(start: Particles | None, size: int) -> jaxgran.SoftSpheres:
    return jaxgran.SoftSpheres(size, steps_per_contact=STEPS_PER_CONTACT, start=start)


def equilibrated(gas: jaxgran.Gas, size: int) -> jaxgran.SoftSpheres:
    """Return a model that starts from the final particles of an elastic run."""
    elastic = gas.replace(dissipative_constant=0.0)
    end = [0.5 * float(gas.mean_free_time)]
    curve = jaxgran.cool(elastic, end, model=soft_spheres(None, size), progress=False)
    return soft_spheres(curve.particles, size)


def log_temperature(gas: jaxgran.Gas, model, t: float):
    """Return ln T at the time t, as a function of A and Y."""
    times = jnp.asarray([t])

    def function(constant, modulus):
        changed = gas.replace(dissipative_constant=constant, youngs_modulus=modulus)
        curve = jaxgran.cool(changed, times, model=model, progress=False)
        return jnp.log(curve.temperature[-1])

    return function


def measure(title: str, gas: jaxgran.Gas, model, repeats: int, compiled: bool) -> dict:
    """Measure run times of each way; with `compiled` the whole run is one program (DSMC).

    Soft spheres are run by the host driver, which calls compiled functions.
    """
    function = log_temperature(gas, model, FREE_TIMES * float(gas.mean_free_time))
    at = gas.value("dissipative_constant"), gas.value("youngs_modulus")
    one = jnp.ones(())
    ways = {
        "plain": function,
        "forward, A": lambda a, y: jax.jvp(lambda x: function(x, y), (a,), (one,)),
        "reverse, A": jax.value_and_grad(function),
        "forward, A and Y": jax.jacfwd(function, argnums=(0, 1)),
    }
    if compiled:
        ways = {name: jax.jit(way) for name, way in ways.items()}
    jax.clear_caches()
    first, seconds = {}, {name: [] for name in ways}
    for name, way in ways.items():
        first[name], _ = timed(way, at)
    for _ in range(repeats):
        for name, way in ways.items():
            seconds[name].append(timed(way, at))
    median = {name: np.median(took, axis=0) for name, took in seconds.items()}
    print(title)
    row = {"title": title, "ways": {}}
    for name, (run, cpu) in median.items():
        ratios = median[name] / median["plain"]
        row["ways"][name] = {
            "compile_s": float(first[name] - run),
            "run_s": float(run),
            "cpu_s": float(cpu),
            "ratio": float(ratios[0]),
            "cpu_ratio": float(ratios[1]),
            "all_s": seconds[name],
        }
        print(
            f"    {name:38}{first[name] - run:10.1f}{run:8.2f}{cpu:8.2f}{ratios[0]:12.2f}"
            f"{ratios[1]:8.2f}" + (f"{LIMITS[name]:9g}" if name in LIMITS else ""),
            flush=True,
        )
    _, forward = ways["forward, A"](*at)
    _, reverse = ways["reverse, A"](*at)
    row["reverse_over_forward"] = float(reverse / forward)
    return row


def timed(way, at) -> tuple[float, float]:
    """Return wall seconds of a call, and CPU seconds of all its threads."""
    begin, cpu = time.perf_counter(), time.process_time()
    jax.block_until_ready(way(*at))
    return time.perf_counter() - begin, time.process_time() - cpu


def measure_memory(fraction: float, size: int, blocks: tuple[int, ...]) -> dict | None:
    """Measure the peak memory of reverse mode by number of blocks of one contact duration."""
    if not STATUS.exists():
        print("no /proc here: peak memory is not measured")
        return None
    gas = beads(PACKING, BETA, fraction)
    start = equilibrated(gas, size).start
    assert start is not None
    state = 2 * np.asarray(start.position).nbytes / 2**20  # positions and velocities, MiB
    print(f"\nreverse mode, SoftSpheres, N={size}, t_c/tau_c={fraction:g}")
    print(f"{'blocks':>8}{'before, MiB':>13}{'peak':>8}{'growth':>8}{'stored states':>17}")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "start.npz"
        known = {name: x for name, x in start._asdict().items() if x is not None}
        np.savez(file, fraction=fraction, **known)
        for count in blocks:
            command = [sys.executable, __file__, "--memory-worker", str(file), str(count)]
            out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            row = {"blocks": count, **json.loads(out.splitlines()[-1])}
            before, peak = row["before_MiB"], row["peak_MiB"]
            print(
                f"{count:8d}{before:13.0f}{peak:8.0f}{peak - before:+8.0f}{count * state:17.1f}",
                flush=True,
            )
            rows.append(row)
    return {"num_particles": size, "state_MiB": state, "rows": rows}


def memory_worker(file: Path, blocks: float) -> None:
    stored = dict(np.load(file))
    gas = beads(PACKING, BETA, float(stored.pop("fraction")))
    start = Particles(**{name: jnp.asarray(x) for name, x in stored.items()})
    model = soft_spheres(start, start.position.shape[1])
    at = gas.value("dissipative_constant"), gas.value("youngs_modulus")

    def reverse(count: float) -> None:
        function = log_temperature(gas, model, count * float(gas.contact_duration))
        jax.block_until_ready(jax.grad(function)(*at))

    reverse(2.0)  # compiles
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = memory("VmRSS")
    reverse(blocks)
    print(json.dumps({"before_MiB": before, "peak_MiB": memory("VmHWM")}))


def memory(name: str) -> float:
    """Return the memory of this process, MiB; a child inherits the peak of getrusage."""
    (line,) = (x for x in STATUS.read_text().splitlines() if x.startswith(f"{name}:"))
    return int(line.split()[1]) / 2**10


if __name__ == "__main__":
    main()
