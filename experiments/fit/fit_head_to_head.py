"""How many simulations does a fit need, with derivatives and without?

    python experiments/fit/fit_head_to_head.py [--scenes stochastic soft-spheres]
        [--smoke] [--record] [--out DIR]

A, and then A and T_0 together, are estimated from a cooling curve: by `jaxgran.fit`, whose
simulations compute tangents, and by searches without derivatives (SciPy's bounded scalar search,
Nelder-Mead and differential evolution). All searches run the same simulator, minimise the same
chi^2 of ln T, and start from half the true A and 1.2 times the true T_0. The bounds, for searches
that need them, are a factor 3 in A and 1.5 in T_0 to either side of the start. Searches without
derivatives use the same random numbers in every simulation, so that chi^2 is a function of the
parameters; `jaxgran.fit` uses new random numbers each time.

The table gives the number of simulations after which the best guess of a search stays within 2 % of
the true values. A simulation with tangents counts as one.

- stochastic: DSMC of the dense gas; the curve is a DSMC run with other random numbers. Its noise is
  far below 2 %.
- soft-spheres: the curve measured in LAMMPS, up to 24 mean free times. According to the scatter of
  24 boxes of 1000 spheres, the noise of one simulation gives A an error of 3 %, that of the LAMMPS
  curve nearly 2 %. Whether one search with fixed random numbers ends within 2 % is partly chance.
"""

import argparse
import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

import jaxgran
from experiments.support.record import run_parts
from experiments.support.scenes import cool, of_lammps

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
class Problem:
    """A curve to be fitted: the gas with the true values, the curve, and the simulator."""

    gas: jaxgran.Gas
    curve: jaxgran.CoolingCurve
    model: jaxgran.AbstractModel

    def at(self, point: np.ndarray) -> jaxgran.Gas:
        """Return the gas at a point: logarithms of the ratios of parameters to the true ones."""
        factors = zip(PARAMETERS, jnp.exp(jnp.asarray(point)), strict=False)
        return self.gas.replace(**{name: self.gas.value(name) * x for name, x in factors})

    def simulated(self, point: np.ndarray) -> jaxgran.CoolingCurve:
        """Return the curve at a point, always with the same random numbers."""
        return cool(self.at(point), self.curve.times, self.model, KEY)


def dense() -> tuple[jaxgran.Gas, jaxgran.CoolingCurve]:
    gas, curve, _ = of_lammps("dense")
    keep = np.asarray(curve.times) < END * float(gas.mean_free_time)
    return gas, jax.tree.map(lambda x: x[keep], curve)


def stochastic(options: argparse.Namespace) -> Problem:
    gas, curve = dense()
    size = 1000 if options.smoke else 20_000
    model, other = (jaxgran.DSMC(size, replicas=replicas) for replicas in (2, 8))
    made = cool(gas, curve.times, other, KEY + 1)
    columns = made.times, made.temperature, made.temperature_error
    # All replicas start from the same temperature.
    times, T, error = (x[made.times > 0] for x in columns if x is not None)
    return Problem(gas, jaxgran.CoolingCurve(times, T, temperature_error=error), model)


def soft_spheres(options: argparse.Namespace) -> Problem:
    gas, curve = dense()
    hottest = gas.replace(temperature=gas.temperature * np.exp(OFF[1] + REACH[1]))
    model = jaxgran.SoftSpheres(1000, replicas=options.replicas, steps_per_contact=20)
    # One capacity for all parameters: nothing compiles again.
    return Problem(gas, curve, model.sized_for(hottest))


PROBLEMS: dict[str, Callable[[argparse.Namespace], Problem]] = {
    "stochastic": stochastic,
    "soft-spheres": soft_spheres,
}


def fit_head_to_head(options: argparse.Namespace) -> dict:
    rows = []
    for scene in ["stochastic"] if options.smoke else options.scenes:
        problem = PROBLEMS[scene](options)
        for count in (1, 2):
            rows += compare(scene, problem, count, options.smoke)
    return {"rows": rows}


def compare(scene: str, problem: Problem, count: int, smoke: bool) -> list[dict]:
    # Measures the scatter of the replicas.
    warm, curve = problem.simulated(OFF[:count]), problem.curve
    scatter = np.asarray(warm.temperature_error / warm.temperature)[1:]
    error = np.asarray(curve.temperature_error / curve.temperature)[1:]
    sigma = np.hypot(error, np.sqrt(np.mean(scatter**2)))
    searches: dict[str, Callable] = {"jaxgran.fit": with_derivatives}
    for name, search in WITHOUT.items():
        if count == 1 or search is not bounded:
            searches[name] = without(search, sigma)
    rows = []
    for name, search in searches.items():
        guesses = search(problem, count, 3 if smoke else None)
        outside = [k for k, guess in enumerate(guesses) if np.abs(guess).max() >= WITHIN]
        first = outside[-1] + 1 if outside else 0  # from here on all guesses are within 2 %
        row = {
            "scene": scene,
            "search": name,
            "free": PARAMETERS[:count],
            "simulations": first + 1 if first < len(guesses) else None,
            "all_simulations": len(guesses),
            "last_error": np.exp(guesses[-1]) - 1,
            "guesses": np.exp(guesses),
        }
        rows.append(row)
        print(row, flush=True)
    return rows


def with_derivatives(problem: Problem, count: int, most: int | None) -> list[np.ndarray]:
    """Return the guess of `jaxgran.fit` after each simulation."""
    names, guesses = PARAMETERS[:count], []
    true = np.asarray([float(problem.gas.value(name)) for name in names])
    for simulations in range(1, (most or MOST[count]) + 1):
        fitted = jaxgran.fit(
            problem.gas,
            problem.curve,
            model=problem.model,
            free=names,
            start=problem.at(OFF[:count]),
            max_steps=simulations,
            key=jax.random.key(KEY),
            progress=False,
        )
        if fitted.iterations < simulations:
            break
        guesses.append(np.log(np.asarray(fitted.estimate) / true))
    return guesses


def without(search: Callable, sigma: np.ndarray) -> Callable:
    """Return a function that runs a search by values of chi^2 only, as `with_derivatives`."""

    def run(problem: Problem, count: int, most: int | None) -> list[np.ndarray]:
        guesses, values = [], []
        measured = np.log(np.asarray(problem.curve.temperature))[1:]

        def chi2(point) -> float:
            point = np.atleast_1d(np.asarray(point, float))
            computed = np.asarray(problem.simulated(point).temperature)
            misfit = (measured - np.log(computed)[1:]) / sigma
            value = float(misfit @ misfit)
            guesses.append(point if not guesses or value < min(values) else guesses[-1])
            values.append(value)
            return value

        first, reach = OFF[:count], REACH[:count]
        bounds = list(zip(first - reach, first + reach, strict=True))
        search(chi2, first, bounds, most or MOST[count])
        return guesses

    return run


def bounded(chi2, first, bounds, most) -> None:
    options = {"xatol": TOLERANCE, "maxiter": most}
    scipy.optimize.minimize_scalar(chi2, bounds=bounds[0], method="bounded", options=options)


def nelder_mead(chi2, first, bounds, most) -> None:
    simplex = np.vstack([first, first + np.diag([0.3, 0.1][: len(first)])])
    options = {"xatol": TOLERANCE, "fatol": 0.1, "maxfev": most, "initial_simplex": simplex}
    scipy.optimize.minimize(chi2, first, method="Nelder-Mead", bounds=bounds, options=options)


def differential_evolution(chi2, first, bounds, most) -> None:
    generations = max(most // (FAMILY * len(first)) - 1, 0)
    options = {"popsize": FAMILY, "maxiter": generations, "polish": False, "rng": 0}
    scipy.optimize.differential_evolution(chi2, bounds, x0=first, **options)


WITHOUT = {
    "bounded scalar": bounded,
    "Nelder-Mead": nelder_mead,
    "differential evolution": differential_evolution,
}


if __name__ == "__main__":
    run_parts(
        __doc__,
        {"fit_head_to_head": fit_head_to_head},
        scenes={"nargs": "+", "choices": list(PROBLEMS), "default": list(PROBLEMS)},
        replicas={"type": int, "default": 4, "help": "replicas of N = 1000 soft spheres"},
    )
