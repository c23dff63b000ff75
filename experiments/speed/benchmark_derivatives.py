"""What does a derivative through a particle simulation cost, in time and in memory?

    python experiments/speed/benchmark_derivatives.py [--smoke] [--record] [--out DIR]

ln T at the end of a run is computed in four ways: without a derivative, with its derivative in A in
forward mode, with the same derivative in reverse mode, and with its Jacobian in A and Y. The runs
are soft spheres, which start from equilibrated particles, and DSMC. The four ways run alternately
in one process. Prints the median run times without compilation; the compilation time of a
way excludes programs that the ways above it have already compiled.

Then measures the increase of the peak memory by reverse mode through soft spheres, in a
process that has already compiled it, for runs of increasing length, beside the memory that
storing the state after every block would need (Linux only).
"""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.record import Options, alone, alternately, run_parts
from experiments.support.scenes import beads, cool

PACKING, BETA, STEPS_PER_CONTACT = 0.1, 0.15, 30
FREE_TIMES = 3.0  # length of a run, in mean free times at T_0
STATUS = Path("/proc/self/status")


def benchmark_derivatives(options: Options) -> dict:
    fractions, repeats, blocks = (0.01, 0.1), 5, (1, 10, 100, 1000)
    soft, stochastic = 4096, 100_000
    if options.smoke:
        fractions, repeats, blocks, soft, stochastic = (0.1,), 1, (), 100, 1000
    rows = []
    for fraction in fractions:
        gas = beads(PACKING, BETA, fraction)
        title = f"SoftSpheres, N={soft}, t_c/tau_c={fraction:g}"
        rows.append(measure(title, gas, equilibrated(gas, soft), repeats))
    gas, model = beads(PACKING, BETA, fractions[0]), jaxgran.DSMC(stochastic)
    rows.append(measure(f"DSMC, N={stochastic}", gas, model, repeats))
    return {"rows": rows, "memory": measure_memory(fractions[0], soft, blocks)}


def equilibrated(gas: jaxgran.Gas, size: int) -> jaxgran.SoftSpheres:
    """Return a model that starts from the final particles of an elastic run."""
    model = jaxgran.SoftSpheres(size, steps_per_contact=STEPS_PER_CONTACT)
    end = [0.5 * float(gas.mean_free_time)]
    start = cool(gas.replace(dissipative_constant=0.0), end, model).particles
    return dataclasses.replace(model, start=start)


def log_temperature(gas: jaxgran.Gas, model, t: float):
    """Return ln T at the time t, as a function of A and Y."""

    def function(constant, modulus):
        changed = gas.replace(dissipative_constant=constant, youngs_modulus=modulus)
        return jnp.log(cool(changed, [t], model).temperature[-1])

    return function


def measure(title: str, gas: jaxgran.Gas, model, repeats: int) -> dict:
    """Measure run times of each way.

    DSMC is one compiled program. Soft spheres are run by the host, which calls compiled functions.
    """
    function = log_temperature(gas, model, FREE_TIMES * float(gas.mean_free_time))
    at = gas.value("dissipative_constant"), gas.value("youngs_modulus")
    ways = {
        "plain": function,
        "forward, A": lambda a, y: jax.jvp(lambda x: function(x, y), (a,), (jnp.ones(()),)),
        "reverse, A": jax.value_and_grad(function),
        "forward, A and Y": jax.jacfwd(function, argnums=(0, 1)),
    }
    if isinstance(model, jaxgran.DSMC):
        ways = {name: jax.jit(way) for name, way in ways.items()}
    jax.clear_caches()
    took = alternately({name: partial(way, *at) for name, way in ways.items()}, 1 + repeats)
    median = {name: float(np.median(each[1:])) for name, each in took.items()}
    costs = {
        name: {"compile_s": took[name][0] - s, "run_s": s, "ratio": s / median["plain"]}
        for name, s in median.items()
    }
    forward, reverse = (ways[name](*at)[1] for name in ("forward, A", "reverse, A"))
    return {"title": title, "ways": costs, "reverse_over_forward": float(reverse / forward)}


def measure_memory(fraction: float, size: int, blocks: tuple[int, ...]) -> dict | None:
    """Measure the peak memory of reverse mode by number of blocks of one contact duration."""
    if not STATUS.exists():
        print("no /proc here: peak memory is not measured")
        return None
    rows = [{"blocks": n, **alone(memory_of_reverse, fraction, size, n)} for n in blocks]
    state = 2 * 3 * size * 8 / 2**20  # positions and velocities
    return {"num_particles": size, "state_MiB": state, "rows": rows}


def memory_of_reverse(fraction: float, size: int, blocks: float) -> dict:
    """Return the memory of this process before and during a run of some blocks."""
    gas = beads(PACKING, BETA, fraction)
    model = equilibrated(gas, size)
    at = gas.value("dissipative_constant"), gas.value("youngs_modulus")

    def reverse(count: float) -> None:
        function = log_temperature(gas, model, count * float(gas.contact_duration))
        jax.block_until_ready(jax.grad(function)(*at))

    reverse(2.0)  # compiles
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    before = memory("VmRSS")
    reverse(blocks)
    return {"before_MiB": before, "peak_MiB": memory("VmHWM")}


def memory(name: str) -> float:
    """Return the memory of this process, MiB; a child inherits the peak of getrusage."""
    (line,) = (x for x in STATUS.read_text().splitlines() if x.startswith(f"{name}:"))
    return int(line.split()[1]) / 2**10


if __name__ == "__main__":
    run_parts(__doc__, benchmark_derivatives)
