"""How many simulations does a fit need, with derivatives and without?

    python experiments/fit/fit_head_to_head.py [--only fit_head_to_head fit_laws]
        [--scenes stochastic soft-spheres] [--smoke] [--record] [--out DIR]

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
- laws (--only fit_laws): A, and then `RestitutionSpline` laws of 3, 10 and 30 knots, through hard
  spheres of a dense gas, from a law with twice the losses. `jaxgran.fit` descends by optax (reverse
  mode). The others are Nelder-Mead and Gauss-Newton steps by finite differences. Counted are the
  simulations until the distance from the true law stays below 1.5 times the statistical bound of
  Cramer and Rao: by kinetic theory, ``sum(((ln T - ln T_true)/sigma)^2)``, with the prior, is p if
  an estimate of p parameters is as good as the errors of the curve allow.
"""

import argparse
import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.optimize

import jaxgran
from experiments.support.record import collected, run_parts
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
    model = jaxgran.SoftSpheres(1000, replicas=4, steps_per_contact=20)
    # One capacity for all parameters: nothing compiles again.
    return Problem(gas, curve, model.sized_for(hottest))


def laws(smoke: bool) -> Iterator[dict]:
    """Compare searches of laws with 1, 3, 10 and 30 parameters through hard spheres."""
    size, counts, most = (60, (1, 3), (4, 10)) if smoke else (1000, (1, 3, 10, 30), (60, 100))
    beads = jaxgran.Viscoelastic(5e7, 0.22, 5e-6)
    gas = jaxgran.Gas(beads, diameter=2e-3, mass=1e-5, packing_fraction=0.25, temperature=0.01)
    times = np.linspace(0.25, 8.0, 32) * float(gas.mean_free_time)
    model = jaxgran.HardSpheres(size, replicas=2)
    made = cool(gas, times, jaxgran.HardSpheres(size, replicas=8), KEY + 1)
    curve = jaxgran.CoolingCurve(times, made.temperature, temperature_error=made.temperature_error)
    measured = np.log(np.asarray(curve.temperature))
    sigma = 1.2 * np.asarray(curve.temperature_error / curve.temperature)  # and 1/8 of a run's
    for count in counts:
        law, names = beads, ("dissipative_constant",)
        if count > 1:
            knots = np.geomspace(
                *jaxgran.RestitutionSpline.visited_speeds(curve.temperature), count
            )
            law = jaxgran.RestitutionSpline(knots, gas.restitution(knots))
            names = ("drops",)
        true = dataclasses.replace(gas, law=law)
        best = np.ravel(np.log(np.asarray(true.value(names[0]))))

        def at(flat: np.ndarray, true=true, names=names) -> jaxgran.Gas:
            values = jnp.exp(jnp.asarray(flat)).reshape(np.shape(true.value(names[0])))
            return true.replace(**{names[0]: values})

        def residuals(flat: np.ndarray, model=None, at=at) -> np.ndarray:
            computed = np.log(np.asarray(cool(at(flat), times, model, KEY).temperature))
            return np.append((measured - computed) / sigma, at(flat).law.prior_residuals())

        def distance(flat: np.ndarray, residuals=residuals, best=best) -> float:
            apart = residuals(flat) - residuals(best)
            return float(np.sqrt(apart @ apart / best.size))

        first = best + np.log(2.0)
        options = {"max_steps": most[0], "solver": optax.adam(0.1), "progress": False}
        options |= {"model": model, "free": names, "start": at(first), "key": jax.random.key(KEY)}
        course = np.log(jaxgran.fit(true, curve, **options).minima.trace.parameters)
        guesses = {
            "jaxgran.fit, optax": [course[k // 2 : k + 1].mean(0) for k in range(len(course))]
        }
        for name, search in {"Nelder-Mead": simplex, "finite differences": differences}.items():
            guesses[name] = search(lambda x, f=residuals: f(x, model), first, most[1])
        for name, of_search in guesses.items():
            apart = [distance(guess) for guess in of_search]
            yield {
                "search": name,
                "parameters": count,
                "simulations": needed([x < 1.5 for x in apart]),
                "all_simulations": len(apart),
                "distance": [apart[0], apart[-1]],
            }


def needed(inside: list[bool]) -> int | None:
    """Return the number of simulations after which a search stays inside; None for never."""
    outside = [k for k, x in enumerate(inside) if not x]
    first = outside[-1] + 1 if outside else 0
    return first + 1 if first < len(inside) else None


def recorded(function: Callable) -> tuple[Callable, list[np.ndarray]]:
    """Return the function, and a list of its best point after each call."""
    guesses, values = [], []

    def chi2(point) -> float:
        point = np.array(np.atleast_1d(point), float)
        value = function(point)
        guesses.append(point if not values or value < min(values) else guesses[-1])
        values.append(value)
        return value

    return chi2, guesses


def simplex(residuals: Callable, first: np.ndarray, most: int) -> list[np.ndarray]:
    """Return the best point of Nelder and Mead's search after each simulation."""
    chi2, guesses = recorded(lambda flat: float(np.sum(residuals(flat) ** 2)))
    nelder_mead(chi2, first, None, most, -0.3 * np.ones(first.size))
    return guesses


def differences(residuals: Callable, first: np.ndarray, most: int) -> list[np.ndarray]:
    """Return the point of Gauss-Newton steps by finite differences after each simulation."""
    guesses, flat = [], first
    while len(guesses) + first.size < most:
        values = residuals(flat)
        slopes = [(residuals(flat + 0.1 * x) - values) / 0.1 for x in np.eye(first.size)]
        guesses += [flat] * (1 + first.size)
        step = -np.linalg.lstsq(np.stack(slopes, axis=1), values)[0]
        flat = flat + step * min(1.0, 0.7 / np.abs(step).max())
    return [*guesses, flat]


PROBLEMS: dict[str, Callable[[argparse.Namespace], Problem]] = {
    "stochastic": stochastic,
    "soft-spheres": soft_spheres,
}


def fit_head_to_head(options: argparse.Namespace) -> dict:
    scenes = ["stochastic"] if options.smoke else options.scenes
    problems = {scene: PROBLEMS[scene](options) for scene in scenes}
    rows = (
        row
        for scene, problem in problems.items()
        for count in (1, 2)
        for row in compare(scene, problem, count, options.smoke)
    )
    return {"rows": collected(rows)}


def fit_laws(options: argparse.Namespace) -> dict:
    return {"rows": collected(laws(options.smoke))}


def compare(scene: str, problem: Problem, count: int, smoke: bool) -> Iterator[dict]:
    # Measures the scatter of the replicas.
    warm, curve = problem.simulated(OFF[:count]), problem.curve
    scatter = np.asarray(warm.temperature_error / warm.temperature)[1:]
    error = np.asarray(curve.temperature_error / curve.temperature)[1:]
    sigma = np.hypot(error, np.sqrt(np.mean(scatter**2)))
    searches: dict[str, Callable] = {"jaxgran.fit": with_derivatives}
    for name, search in WITHOUT.items():
        if count == 1 or search is not bounded:
            searches[name] = without(search, sigma)
    for name, search in searches.items():
        guesses = search(problem, count, 3 if smoke else None)
        yield {
            "scene": scene,
            "search": name,
            "free": PARAMETERS[:count],
            "simulations": needed([np.abs(guess).max() < WITHIN for guess in guesses]),
            "all_simulations": len(guesses),
            "last_error": np.exp(guesses[-1]) - 1,
            "guesses": np.exp(guesses),
        }


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
        measured = np.log(np.asarray(problem.curve.temperature))[1:]

        def misfit(point) -> float:
            computed = np.asarray(problem.simulated(point).temperature)
            return float(np.sum(((measured - np.log(computed)[1:]) / sigma) ** 2))

        chi2, guesses = recorded(misfit)
        first, reach = OFF[:count], REACH[:count]
        bounds = list(zip(first - reach, first + reach, strict=True))
        search(chi2, first, bounds, most or MOST[count])
        return guesses

    return run


def bounded(chi2, first, bounds, most) -> None:
    options = {"xatol": TOLERANCE, "maxiter": most}
    scipy.optimize.minimize_scalar(chi2, bounds=bounds[0], method="bounded", options=options)


def nelder_mead(chi2, first, bounds, most, steps=(0.3, 0.1)) -> None:
    simplex = np.vstack([first, first + np.diag(steps[: len(first)])])
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
    settings = {"nargs": "+", "choices": list(PROBLEMS), "default": list(PROBLEMS)}
    parts = {"fit_head_to_head": fit_head_to_head, "fit_laws": fit_laws}
    run_parts(__doc__, parts, scenes=settings)
