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
- laws (--only fit_laws): A, and then `RestitutionSpline` laws of 3, 10 and 30 knots, are fitted to
  each of four runs of 1000 hard spheres of a dense gas, from a law with twice the losses.
  `jaxgran.fit` descends by optax (reverse mode). The others are Nelder-Mead and Gauss-Newton steps
  by finite differences. Counted are the simulations until the root mean square distance from the
  true law stays within 1.5 times the statistical bound of Cramer and Rao. The distance is that of
  curves and priors of kinetic theory,
  ``d^2 = (x - x_true)^T (F + P) (x - x_true) / tr(F (F + P)^-1)``, with the information F of the
  curve and P of the prior: its mean is 1 for an estimate at the bound. F takes T of a run to differ
  from the mean by a clock whose steps are independent, of a variance proportional to the time
  between collisions and adjusted to the scatter of eight runs.
"""

import dataclasses
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.optimize

import jaxgran
from experiments.support.analysis import from_here
from experiments.support.record import Options, each_alone, run_parts, seconds
from experiments.support.scenes import cool, of_lammps, temperature_only

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
    """A curve to be fitted, with the true values of its gas, and the simulator."""

    measurement: jaxgran.Measurement
    model: jaxgran.extend.AbstractModel

    @property
    def gas(self) -> jaxgran.Gas:
        return self.measurement.gas

    @property
    def curve(self) -> jaxgran.CoolingCurve:
        return self.measurement.curve

    def at(self, point: np.ndarray) -> jaxgran.Gas:
        """Return the gas at a point: logarithms of the ratios of parameters to the true ones."""
        factors = zip(PARAMETERS, jnp.exp(jnp.asarray(point)), strict=False)
        return self.gas.replace(**{name: self.gas.value(name) * x for name, x in factors})

    def simulated(self, point: np.ndarray) -> jaxgran.CoolingCurve:
        """Return the curve at a point, always with the same random numbers."""
        return cool(self.at(point), self.curve.times, self.model, KEY)


def dense() -> jaxgran.Measurement:
    measurement = of_lammps("dense")
    keep = np.asarray(measurement.curve.times) < END * float(measurement.gas.mean_free_time)
    early = jax.tree.map(lambda x: x[keep], measurement.curve)
    return dataclasses.replace(measurement, data=early)


def stochastic(options: Options) -> Problem:
    lammps = dense()
    size = 1000 if options.smoke else 20_000
    made = cool(lammps.gas, lammps.curve.times, jaxgran.DSMC(size, replicas=8), KEY + 1)
    # All replicas start from the same temperature.
    later = jax.tree.map(lambda x: x[1:], temperature_only(made))
    measurement = jaxgran.Measurement(lammps.gas, later, num_particles=size, replicas=8)
    return Problem(measurement, jaxgran.DSMC(size, replicas=2))


def soft_spheres(options: Options) -> Problem:
    lammps = dense()
    gas = lammps.gas
    hottest = gas.replace(temperature=gas.temperature * np.exp(OFF[1] + REACH[1]))
    model = jaxgran.SoftSpheres(1000, replicas=4, steps_per_contact=20)
    # One capacity for all parameters: nothing compiles again.
    return Problem(lammps, model.sized_for(hottest))


def search_law(count: int, number: int, size: int, *most: int) -> dict:
    """Search a law of some parameters for one curve; return distances after each simulation."""
    beads = jaxgran.Viscoelastic(5e7, 0.22, 5e-6)
    gas = jaxgran.Gas(beads, diameter=2e-3, mass=1e-5, packing_fraction=0.25, temperature=0.01)
    times = np.linspace(0.25, 8.0, 32) * float(gas.mean_free_time)
    model = jaxgran.HardSpheres(size, replicas=2)
    made = cool(gas, times, jaxgran.HardSpheres(size, replicas=8), KEY + 1)
    error = np.sqrt(8.0) * made.temperature_error  # of one run, which is the measured curve
    T = made.replicas.temperature[number]
    curve = jaxgran.CoolingCurve(times, T)
    log_mean = np.log(np.asarray(made.temperature))
    slope = np.gradient(log_mean, times, edge_order=2)
    steps = np.diff(times, prepend=0.0) * np.exp(-log_mean / 2)  # of the variance of a clock
    share = np.mean((error / made.temperature / slope) ** 2 / np.cumsum(steps))

    law, name = beads, "dissipative_constant"
    if count > 1:
        knots = np.geomspace(*jaxgran.RestitutionSpline.visited_speeds(T), count)
        law, name = jaxgran.RestitutionSpline(knots, gas.restitution(knots)), "drops"
    true = dataclasses.replace(gas, law=law)
    best = np.ravel(np.log(np.asarray(true.value(name))))

    def at(flat) -> jaxgran.Gas:
        return true.replace(**{name: jnp.exp(flat).reshape(np.shape(true.value(name)))})

    def log_T(flat, model=None) -> jax.Array:
        return jnp.log(cool(at(flat), times, model, KEY).temperature)

    def residuals(flat: np.ndarray) -> np.ndarray:
        apart = np.log(np.asarray(T)) - np.asarray(log_T(flat, model))
        # The noise of the two replicas of a simulation is half of the variance of one run.
        weighted = apart / (np.sqrt(1.5) * error / T)
        return np.append(weighted, at(flat).law.prior_residuals())

    def of_theory(flat) -> jax.Array:
        """Return steps of the clock, in standard errors, and the prior."""
        steps_of_clock = jnp.diff(log_T(flat) / slope, prepend=0.0)
        return jnp.append(steps_of_clock / np.sqrt(share * steps), at(flat).law.prior_residuals())

    jacobian = np.asarray(jax.jacfwd(of_theory)(jnp.asarray(best)))
    by_data = jacobian[: times.size].T @ jacobian[: times.size]
    determined = float(np.trace(np.linalg.solve(jacobian.T @ jacobian, by_data)))
    gradient = jax.value_and_grad(lambda x: jnp.sum(log_T(x, model) ** 2))
    slower = seconds(lambda: gradient(best))[1] / seconds(lambda: log_T(best, model))[1]
    first = best + np.log(2.0)
    options = {"max_steps": most[0], "solver": optax.adam(0.1), "progress": False}
    options |= {"model": model, "free": (name,), "start": at(first), "key": jax.random.key(KEY)}
    measurement = jaxgran.Measurement(true, curve, num_particles=size)
    course = np.log(jaxgran.fit(measurement, **options).trace.parameters)
    chi2, of_simplex = recorded(lambda flat: float(np.sum(residuals(flat) ** 2)))
    nelder_mead(chi2, first, None, most[1], -0.3 * np.ones(count))
    guesses = {
        "jaxgran.fit, optax": [course[k // 2 : k + 1].mean(0) for k in range(len(course))],
        "Nelder-Mead": of_simplex,
        "finite differences": differences(residuals, first, most[1]),
    }
    exact = of_theory(best)

    def distance(flat) -> float:
        return float(np.linalg.norm(of_theory(flat) - exact)) / determined**0.5

    found = {search: list(map(distance, course)) for search, course in guesses.items()}
    return {"gradient_over_run": slower} | found


def needed(inside: np.ndarray) -> int | None:
    """Return the number of simulations after which a search stays inside; None for never."""
    first = from_here(inside, np.arange(1, inside.size + 1))
    return None if np.isnan(first) else int(first)


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


PROBLEMS = {"stochastic": stochastic, "soft-spheres": soft_spheres}


def fit_head_to_head(options: Options) -> Iterator[dict]:
    for scene in ["stochastic"] if options.smoke else options.scenes:
        problem = PROBLEMS[scene](options)
        for count in (1, 2):
            yield from compare(scene, problem, count, options.smoke)


def fit_laws(options: Options) -> Iterator[dict]:
    counts, curves, *settings = (1, 3, 10, 30), range(4), 1000, 60, 100
    if options.smoke:
        counts, curves, *settings = (3,), range(1), 60, 4, 10
    for count in counts:
        each = list(each_alone(search_law, [(count, number, *settings) for number in curves]))
        gradient_over_run = float(np.median([x.pop("gradient_over_run") for x in each]))
        for search in each[0]:
            most = max(len(x[search]) for x in each)
            square = [np.square(x[search] + x[search][-1:] * (most - len(x[search]))) for x in each]
            distance = np.sqrt(np.mean(square, axis=0))
            row = {"search": search, "parameters": count, "simulations": needed(distance < 1.5)}
            row |= {"all_simulations": most, "distance": distance[[0, -1]]}
            yield row | {"gradient_over_run": gradient_over_run}


def compare(scene: str, problem: Problem, count: int, smoke: bool) -> Iterator[dict]:
    first, reach, most = OFF[:count], REACH[:count], 3 if smoke else MOST[count]
    # The simulation measures the scatter of the replicas.
    both = problem.simulated(first), problem.curve
    scatter, error = (np.asarray(x.temperature_error / x.temperature)[1:] for x in both)
    sigma = np.hypot(error, np.sqrt(np.mean(scatter**2)))
    measured = np.log(np.asarray(problem.curve.temperature))[1:]

    def misfit(point) -> float:
        computed = np.asarray(problem.simulated(point).temperature)
        return float(np.sum(((measured - np.log(computed)[1:]) / sigma) ** 2))

    searches = {"bounded scalar": bounded} if count == 1 else {}
    searches |= {"Nelder-Mead": nelder_mead, "differential evolution": differential_evolution}
    found = {"jaxgran.fit": with_derivatives(problem, count, most)}
    for name, search in searches.items():
        chi2, found[name] = recorded(misfit)
        search(chi2, first, list(zip(first - reach, first + reach, strict=True)), most)
    for name, guesses in found.items():
        row = {"scene": scene, "search": name, "free": PARAMETERS[:count]}
        row["simulations"] = needed(np.abs(guesses).max(axis=1) < WITHIN)
        row |= {"all_simulations": len(guesses), "last_error": np.exp(guesses[-1]) - 1}
        yield row | {"guesses": np.exp(guesses)}


def with_derivatives(problem: Problem, count: int, most: int) -> list[np.ndarray]:
    """Return the guess of `jaxgran.fit` after each simulation."""
    names, guesses = PARAMETERS[:count], []
    true = np.asarray([float(problem.gas.value(name)) for name in names])
    options = {"model": problem.model, "free": names, "start": problem.at(OFF[:count])}
    options |= {"key": jax.random.key(KEY), "progress": False, "quick": True}
    for simulations in range(1, most + 1):
        fitted = jaxgran.fit(problem.measurement, max_steps=simulations, **options)
        if fitted.iterations < simulations:
            break
        guesses.append(np.log(np.asarray(fitted.estimate) / true))
    return guesses


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


if __name__ == "__main__":
    run_parts(__doc__, fit_head_to_head, fit_laws, scenes=list(PROBLEMS))
