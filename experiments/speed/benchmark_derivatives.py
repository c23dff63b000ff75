"""What does a derivative through a particle simulation cost, in time and in memory?

    python experiments/speed/benchmark_derivatives.py [--smoke] [--record] [--out FILE]

ln T at the end of a run is computed in four ways: without a derivative, with its derivative in A in
forward mode, with the same derivative in reverse mode, and with its Jacobian in A and Y. The runs
are soft spheres, which start from equilibrated particles, and DSMC. The four ways run alternately
in one process. Prints the median run times without compilation; the compilation time of a
way excludes programs that the ways above it have already compiled.

Then measures the increase of the peak memory by reverse mode through soft spheres, in a
process that has already compiled it, for runs of increasing length, beside the memory that
storing the state after every block would need (Linux only).
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.apart import alone
from experiments.support.record import add_recording, write_results
from experiments.support.scenes import beads
from jaxgran.data.curve import Particles

PACKING, BETA, STEPS_PER_CONTACT = 0.1, 0.15, 30
FREE_TIMES = 3.0  # length of a run, in mean free times at T_0
STATUS = Path("/proc/self/status")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--smoke", action="store_true", help="a small run of some seconds")
    parser.add_argument("--out", type=Path, help="JSON file for the figures")
    parser.add_argument("--memory-worker", nargs=2, help=argparse.SUPPRESS)
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.memory_worker:
        memory_worker(Path(options.memory_worker[0]), float(options.memory_worker[1]))
        return
    fractions, repeats, blocks = (0.01, 0.1), 5, (1, 10, 100, 1000)
    soft, stochastic = 4096, 100_000
    if options.smoke:
        fractions, repeats, blocks, soft, stochastic = (0.1,), 1, (4,), 100, 1000
    rows = []
    for fraction in fractions:
        gas = beads(PACKING, BETA, fraction)
        title = f"SoftSpheres, N={soft}, t_c/tau_c={fraction:g}"
        rows.append(measure(title, gas, equilibrated(gas, soft), repeats, compiled=False))
    gas, model = beads(PACKING, BETA, fractions[0]), jaxgran.DSMC(stochastic)
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
    took = {name: [] for name in ways}
    for _ in range(1 + repeats):
        for name, way in ways.items():
            begin = time.perf_counter()
            jax.block_until_ready(way(*at))
            took[name].append(time.perf_counter() - begin)
    median = {name: float(np.median(each[1:])) for name, each in took.items()}
    row = {"title": title, "ways": {}}
    for name, run_s in median.items():
        ratio = run_s / median["plain"]
        row["ways"][name] = {"compile_s": took[name][0] - run_s, "run_s": run_s, "ratio": ratio}
        print(title, name, row["ways"][name], flush=True)
        row["ways"][name]["all_s"] = took[name][1:]
    forward, reverse = (ways[name](*at)[1] for name in ("forward, A", "reverse, A"))
    return row | {"reverse_over_forward": float(reverse / forward)}


def measure_memory(fraction: float, size: int, blocks: tuple[int, ...]) -> dict | None:
    """Measure the peak memory of reverse mode by number of blocks of one contact duration."""
    if not STATUS.exists():
        print("no /proc here: peak memory is not measured")
        return None
    start = equilibrated(beads(PACKING, BETA, fraction), size).start
    assert start is not None
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "start.npz"
        known = {name: x for name, x in start._asdict().items() if x is not None}
        np.savez(file, fraction=fraction, **known)
        for count in blocks:
            row = alone(__file__, "--memory-worker", str(file), str(count))
            rows.append({"blocks": count, **row})
            print(rows[-1], flush=True)
    state = 2 * np.asarray(start.position).nbytes / 2**20  # positions and velocities
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
