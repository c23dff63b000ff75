"""How many simulations does a fit need, with derivatives and without?

    python experiments/fit/fit_head_to_head.py [--scenes stochastic soft-spheres]
        [--smoke] [--out DIR]

A, and then A and T_0 together, are estimated from a cooling curve: by `jaxgran.fit`, whose
simulations compute tangents, and by searches without derivatives (SciPy's bounded scalar search,
Nelder-Mead, differential evolution and, for two parameters and if the package cma is installed,
CMA-ES). All searches run the same simulator, minimise the same chi^2 of ln T, and start from half
the true A and 1.2 times the true T_0. The bounds, for searches that need them, are a factor 3 in A
and 1.5 in T_0 to either side of the start. Searches without derivatives use the same random numbers
in every simulation, so that chi^2 is a function of the parameters; `jaxgran.fit` uses new random
numbers each time.

The table gives the number of simulations after which the best guess of a search stays within 2 % of
the true values, and their run time without compilation. A simulation with tangents counts as one.

- stochastic: DSMC of the dense gas; the curve is a DSMC run with other random numbers. Its noise is
  far below 2 %.
- soft-spheres: the curve measured in LAMMPS, up to 24 mean free times. According to the scatter of
  24 boxes of 1000 spheres, the noise of one simulation gives A an error of 3 %, that of the LAMMPS
  curve nearly 2 %. Whether one search with fixed random numbers ends within 2 % is partly chance.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import jaxgran
from experiments.support.record import DATA, add_recording, write_results
from jaxgran.data.files import header_number

try:
    import cma  # type: ignore[import-not-found]
except ImportError:
    cma = None

DENSE = DATA / "lammps_cooling_dense.csv"
SCENES = ("stochastic", "soft-spheres")
PARAMETERS = ("dissipative_constant", "temperature")
OFF = np.log([0.5, 1.2])  # the first guess over the true values, in logarithms
REACH = np.log([3.0, 1.5])  # distance of the bounds from the first guess
WITHIN = np.log(1.02)
TOLERANCE = 0.005  # of ln A and ln T_0, at which searches may stop
MOST = {1: 24, 2: 48}  # simulations allowed, by number of parameters
END = 24.0  # of the curve, in mean free times
FAMILY = 6  # simulations per parameter in a generation of differential evolution
KEY = 1  # of the random numbers of the searches


@dataclasses.dataclass
class Visit:
    """One simulation of a search.

    Attributes:
        point: its parameters, as logarithms of their ratios to the true ones.
        chi2: nan if the search does not use it.
        seconds: time from the start of the search to the end of this simulation.
    """

    point: np.ndarray
    chi2: float
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    parser.add_argument("--replicas", type=int, default=4, help="replicas of N = 1000 soft spheres")
    parser.add_argument("--smoke", action="store_true", help="a small run of seconds, DSMC only")
    parser.add_argument("--out", type=Path, default=Path("results") / "fit_head_to_head")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    options.out.mkdir(parents=True, exist_ok=True)
    jax.monitoring.register_event_duration_secs_listener(COMPILATION.hear)
    begin = time.perf_counter()
    rows = []
    for scene in SCENES[:1] if options.smoke else options.scenes:
        problem = PROBLEMS[scene](options)
        for count in (1, 2):
            rows += compare(scene, problem, count, options.smoke)
    took = time.perf_counter() - begin
    path = options.out / "fit_head_to_head.json"
    write_results("fit_head_to_head", options, path, rows=rows, seconds=took)
    print(f"{took:.0f} s in all; written to {options.out}")


class Compilation:
    """Count the seconds that JAX has spent on compilation."""

    seconds = 0.0

    def hear(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.seconds += duration_secs


COMPILATION = Compilation()


class Clock:
    """Measure the seconds since the clock was created, without compilation."""

    def __init__(self):
        self.begin, self.compiled = time.perf_counter(), COMPILATION.seconds

    def __call__(self) -> float:
        return time.perf_counter() - self.begin - (COMPILATION.seconds - self.compiled)


@dataclasses.dataclass
class Problem:
    """A curve to be fitted.

    Attributes:
        gas: with the true values.
        curve: the measurement.
        model: the simulator.
        description: printed above the table.
    """

    gas: jaxgran.Gas
    curve: jaxgran.CoolingCurve
    model: jaxgran.AbstractModel
    description: str

    def at(self, point: np.ndarray) -> jaxgran.Gas:
        """Return the gas at a point: logarithms of the ratios of parameters to the true ones."""
        names = PARAMETERS[: len(point)]
        factors = jnp.exp(jnp.asarray(point))
        return self.gas.replace(
            **{n: self.gas.value(n) * f for n, f in zip(names, factors, strict=True)}
        )

    def simulated(self, point: np.ndarray) -> jaxgran.CoolingCurve:
        """Return the curve at a point, always with the same random numbers."""
        key = jax.random.key(KEY)
        gas = self.at(point)
        return jaxgran.cool(gas, self.curve.times, model=self.model, key=key, progress=False)


def dense() -> tuple[jaxgran.Gas, jaxgran.CoolingCurve]:
    curve, header = jaxgran.read_curve(DENSE)
    gas = jaxgran.read_gas(header).replace(dissipative_constant=header_number(header, "A"))
    keep = np.asarray(curve.times) < END * float(gas.mean_free_time)
    return gas, jax.tree.map(lambda x: x[keep], curve)


def stochastic(options: argparse.Namespace) -> Problem:
    gas, curve = dense()
    size = 1000 if options.smoke else 20_000
    model, other = (jaxgran.DSMC(size, replicas=replicas) for replicas in (2, 8))
    key = jax.random.key(KEY + 1)
    made = jaxgran.cool(gas, curve.times, model=other, key=key, progress=False)
    assert made.temperature_error is not None
    later = made.times > 0  # all replicas start from the same temperature
    curve = jaxgran.CoolingCurve(
        made.times[later],
        made.temperature[later],
        temperature_error=made.temperature_error[later],
    )
    return Problem(gas, curve, model, f"DSMC, N = {size}, 2 replicas; curve: 8 others")


def soft_spheres(options: argparse.Namespace) -> Problem:
    gas, curve = dense()
    hottest = gas.replace(temperature=gas.temperature * np.exp(OFF[1] + REACH[1]))
    model = jaxgran.SoftSpheres(1000, replicas=options.replicas, steps_per_contact=20)
    model = model.sized_for(hottest)  # one capacity for all parameters: nothing compiles again
    description = f"soft spheres, N = 1000, {options.replicas} replicas; curve: LAMMPS, N = 4000, 3"
    return Problem(gas, curve, model, description)


PROBLEMS: dict[str, Callable[[argparse.Namespace], Problem]] = {
    "stochastic": stochastic,
    "soft-spheres": soft_spheres,
}


def compare(scene: str, problem: Problem, count: int, smoke: bool) -> list[dict]:
    first = OFF[:count]
    # Compiles, and measures the scatter of the replicas.
    warm = problem.simulated(first)
    assert warm.temperature_error is not None and problem.curve.temperature_error is not None
    scatter = np.asarray(warm.temperature_error / warm.temperature)[1:]
    error = np.asarray(problem.curve.temperature_error / problem.curve.temperature)[1:]
    sigma = np.hypot(error, np.sqrt(np.mean(scatter**2)))
    with_derivatives(problem, count, most=1)
    searches: dict[str, Callable] = {"jaxgran.fit": with_derivatives}
    for name, search in WITHOUT.items():
        if count == 1 or search is not bounded:
            searches[name] = without(search, sigma)
    if count == 2 and cma is not None:
        searches["CMA-ES"] = without(evolution_strategy, sigma)
    print(f"\n{problem.description}; free: {'A' if count == 1 else 'A and T_0'}")
    errors = "".join(f"{f'error of {x}, %':>16}" for x in ("A", "T_0")[:count])
    print(f"{'':24}{'to within 2 %':>22}{'whole search':>22}")
    print(f"{'':24}" + 2 * f"{'simulations':>13}{'seconds':>9}" + errors)
    rows = []
    for name, search in searches.items():
        visits, guesses = search(problem, count, 3 if smoke else None)
        inside = [bool(np.abs(guess).max() < WITHIN) for guess in guesses]
        last = len(inside) - inside[::-1].index(False) if False in inside else 0
        settled = last < len(inside)
        row = {
            "scene": scene,
            "search": name,
            "free": PARAMETERS[:count],
            "simulations": last + 1 if settled else None,
            "seconds": visits[last].seconds if settled else None,
            "all_simulations": len(visits),
            "all_seconds": visits[-1].seconds,
            "last_error": (np.exp(guesses[-1]) - 1).tolist(),
            "guesses": [np.exp(guess).tolist() for guess in guesses],
        }
        rows.append(row)
        reached = (
            f"{last + 1:13d}{visits[last].seconds:9.1f}" if settled else f"{'never':>13}{'':9}"
        )
        print(f"{name:24}{reached}{len(visits):13d}{visits[-1].seconds:9.1f}", end="")
        print("".join(f"{100 * e:+16.2f}" for e in row["last_error"]), flush=True)
    return rows


def watched(
    model: jaxgran.AbstractModel, visit: Callable[[jaxgran.Gas], None]
) -> jaxgran.AbstractModel:
    """Return a model that calls `visit` with the gas before every run of the given model."""

    class Watched(jaxgran.AbstractModel):
        stochastic: ClassVar[bool] = model.stochastic
        derivative_accuracy: ClassVar[float] = model.derivative_accuracy

        def check(self, gas):
            model.check(gas)

        def simulate(self, gas, times, run):
            visit(gas)
            return model.simulate(gas, times, run)

        def estimated_error(self, error_model):
            return model.estimated_error(error_model)

        def limitations(self, gas, num_particles=None):
            return model.limitations(gas, num_particles)

    return Watched()


def with_derivatives(problem: Problem, count: int, most: int | None):
    """Return the visits of `jaxgran.fit`, and its guess after each."""
    visited, clock, names = [], Clock(), PARAMETERS[:count]

    def visit(gas: jaxgran.Gas) -> None:
        point = [float(jax.lax.stop_gradient(gas.value(name))) for name in PARAMETERS]
        visited.append((clock(), np.asarray(point)))

    fitted = jaxgran.fit(
        problem.gas,
        problem.curve,
        model=watched(problem.model, visit),
        free=names,
        start=problem.at(OFF[:count]),
        max_steps=most,
        key=jax.random.key(KEY),
        progress=False,
    )
    true = np.asarray([float(problem.gas.value(name)) for name in names])
    # The guess after a simulation is the point of the next one.
    points = [point[:count] for _, point in visited[1:]] + [np.asarray(fitted.estimate)]
    seconds = [begun for begun, _ in visited[1:]] + [clock()]
    guesses = [np.log(point / true) for point in points]
    ends = zip(guesses, seconds, strict=True)
    return [Visit(guess, np.nan, took) for guess, took in ends], guesses


def without(search: Callable, sigma: np.ndarray) -> Callable:
    """Return a function that runs a search by values of chi^2 only, as `with_derivatives`."""

    def run(problem: Problem, count: int, most: int | None):
        visits: list[Visit] = []
        clock = Clock()
        measured = np.log(np.asarray(problem.curve.temperature))[1:]

        def chi2(point) -> float:
            point = np.atleast_1d(np.asarray(point, float))
            computed = np.asarray(problem.simulated(point).temperature)
            misfit = (measured - np.log(computed)[1:]) / sigma
            visits.append(Visit(point, float(misfit @ misfit), clock()))
            return visits[-1].chi2

        first, reach = OFF[:count], REACH[:count]
        search(
            chi2, first, list(zip(first - reach, first + reach, strict=True)), most or MOST[count]
        )
        guesses, best = [], visits[0]
        for visit in visits:
            best = visit if visit.chi2 < best.chi2 else best
            guesses.append(best.point)
        return visits, guesses

    return run


def bounded(chi2, first, bounds, most) -> None:
    scipy.optimize.minimize_scalar(
        chi2, bounds=bounds[0], method="bounded", options={"xatol": TOLERANCE, "maxiter": most}
    )


def nelder_mead(chi2, first, bounds, most) -> None:
    simplex = np.vstack([first, first + np.diag([0.3, 0.1][: len(first)])])
    options = {"xatol": TOLERANCE, "fatol": 0.1, "maxfev": most, "initial_simplex": simplex}
    scipy.optimize.minimize(chi2, first, method="Nelder-Mead", bounds=bounds, options=options)


def differential_evolution(chi2, first, bounds, most) -> None:
    generations = max(most // (FAMILY * len(first)) - 1, 0)
    scipy.optimize.differential_evolution(
        chi2, bounds, x0=first, popsize=FAMILY, maxiter=generations, polish=False, rng=0
    )


def evolution_strategy(chi2, first, bounds, most) -> None:
    assert cma is not None
    options = {
        "bounds": list(zip(*bounds, strict=True)),
        "CMA_stds": [0.5, 0.15],
        "maxfevals": most,
        "tolx": TOLERANCE,
        "seed": 1,
        "verbose": -9,
    }
    cma.fmin2(chi2, first, 1.0, options)


WITHOUT = {
    "bounded scalar": bounded,
    "Nelder-Mead": nelder_mead,
    "differential evolution": differential_evolution,
}


if __name__ == "__main__":
    main()
