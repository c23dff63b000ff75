"""Searches through simulations by a stochastic model.

Each step uses one simulation with new random numbers, and its derivatives. The estimate is the mean
of the Gauss-Newton estimates of all simulations near it; the noise of the simulations is part of
its error. Residuals are weighted by the covariance that kinetic theory gives to the measured run
(`jaxgran.fitting.kalman`), the errors of the measurement and the noise of the simulations.
With an optax transformation each step is one simulation with its gradient in reverse mode, and the
estimate is the mean of the last half of the steps (Polyak average).
"""

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from tqdm import tqdm

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run_options import Run
from jaxgran.fitting.comparison import Comparison
from jaxgran.fitting.descent import Descent, Loss
from jaxgran.fitting.information import decrease_with_variance, inverse, resolved_inverse
from jaxgran.fitting.parameters import with_parameters
from jaxgran.fitting.prediction import predicted_curve
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import FEW_PARTICLES, CurveRows
from jaxgran.fitting.search import Trace
from jaxgran.models.base import AbstractModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas

MAX_STEP = 0.7
"""Longest Gauss-Newton step of a parameter in the unconstrained scale: a factor of two."""

AVERAGING_DISTANCE = 0.1
"""Distance of each parameter, in the unconstrained scale, within which simulations are averaged."""

MAX_NOISE_SHARE = 0.5
"""Share of the standard error up to which the noise needs no further simulations."""

THEORY_DEGREES = 8
"""Degrees of freedom of replicas that tell the noise of a simulation as well as kinetic theory
does. By two or three replicas alone a search would end whenever they happen to agree."""

NOISE_WINDOW = 9
"""Number of neighbouring times over which the variance between replicas is averaged."""

MAX_LINEARISED = 30
"""Number of parameters up to which a fit through simulations has errors: more are not determined
one by one."""

NUM_LINEARISED = 2
"""Number of simulations at the estimate of a descent, which give its errors."""


class Simulation(NamedTuple):
    """One simulation at some parameters, compared with a curve.

    The values are ln T at all times, followed by ln T_rot.

    Attributes:
        flat: the parameters, in their unconstrained scale.
        values: shape (values,).
        slope: their derivatives, shape (values, p).
        deviation: values of each replica minus their mean, shape (replicas, values).
        variance: of the mean over replicas, shape (values,).
    """

    flat: Float[np.ndarray, "p"]
    values: Float[np.ndarray, "values"]
    slope: Float[np.ndarray, "values p"]
    deviation: Float[np.ndarray, "replicas values"]
    variance: Float[np.ndarray, "values"]


class _Estimate(NamedTuple):
    """Gauss-Newton estimate of one simulation.

    Attributes:
        flat: the estimate.
        noise: its covariance by the scatter of the replicas.
    """

    flat: Float[np.ndarray, "p"]
    noise: Float[np.ndarray, "p p"]


class Average(NamedTuple):
    """Mean of the Gauss-Newton estimates of some simulations.

    Attributes:
        flat: the mean.
        information: on the parameters.
        noise: covariance of the mean by the noise of the simulations.
        comparison: of kinetic theory with the measurement, with the noise of the simulations.
    """

    flat: Float[np.ndarray, "p"]
    information: Float[np.ndarray, "p p"]
    noise: Float[np.ndarray, "p p"]
    comparison: Comparison


@dataclass(frozen=True)
class Simulations:
    """Simulations by a stochastic model that are compared with a curve.

    Attributes:
        problem: of this model; its only measurement is the curve.
        theory: the same measurement for kinetic theory, which knows how N grains scatter.
        key: of the random numbers.
        progress: whether to show progress bars.
        starts: of equilibrated spheres, which all runs share and add to (`jaxgran.extend.Run`).
            They depend on no parameter of the law, and velocities are drawn anew.
    """

    problem: Problem
    theory: CurveRows
    key: PRNGKeyArray
    progress: bool
    starts: dict[str, Any] = field(default_factory=dict)

    @property
    def rows(self) -> CurveRows:
        """The measured curve."""
        return self.problem.curves[0]

    @property
    def model(self) -> AbstractModel:
        """The stochastic model."""
        return self.problem.model

    @property
    def num_particles(self) -> int | None:
        """N of each simulated gas; None for a model that does not tell it."""
        return getattr(self.model, "num_particles", None)

    def gas_at(self, flat: Any) -> Gas:
        """Return the gas at some parameters, which may be traced."""
        return with_parameters(self.rows.scene, self.problem.unflatten(flat)[""])

    def curve_at(self, flat: Any, stream: int) -> CoolingCurve:
        """Return the curve of a simulation; each has another stream of random numbers."""
        run = Run(jax.random.fold_in(self.key, stream), self.progress, starts=self.starts)
        computed = self.model.simulate(self.gas_at(flat), self.rows.curve.times, run)
        if computed.replicas is None or len(computed.replicas.temperature) < 2:
            raise ValueError(
                f"a fit of {type(self.model).__name__} needs curves with at least two replicas, "
                "whose scatter gives the noise: simulate must return CoolingCurve.of_replicas(...)"
            )
        return computed

    def logs_of(self, curve: CoolingCurve) -> Float[Array, "*replicas values"]:
        """Return ln T at all times, followed by ln T_rot, or 0 where there is none."""
        T = curve.temperature
        rotation = jnp.ones_like(T)
        if self.rows.uses_rotation:
            assert curve.rotational_temperature is not None
            rotation = curve.rotational_temperature
        values = jnp.concatenate([T, rotation], axis=-1)
        return jnp.log(jnp.where(values == 0, 1.0, values))

    @property
    def measured(self) -> Float[np.ndarray, "values"]:
        """The logarithms of the measured values, 0 where none counts."""
        values = np.where(self.rows.used > 0, self.rows.values, 1.0)
        return np.log(values).T.ravel()

    def run(self, flat: Float[np.ndarray, "p"], stream: int) -> tuple[Simulation, CoolingCurve]:
        """Run one simulation with its derivatives; return it and its curve."""

        def values_of(flat):
            curve = self.curve_at(flat, stream)
            values = self.logs_of(curve)
            return values, (values, curve)

        slope, (values, curve) = jax.jacfwd(values_of, has_aux=True)(jnp.asarray(flat))
        each = np.asarray(self.logs_of(curve.replicas))
        deviation = each - each.mean(axis=0)
        # T and T_rot are split, because the variance is averaged over neighbouring times.
        parts = [variance_of_mean(part) for part in np.split(deviation, 2, axis=1)]
        simulation = Simulation(
            flat=np.asarray(flat),
            values=np.asarray(values),
            slope=np.asarray(slope),
            deviation=deviation,
            variance=np.concatenate(parts),
        )
        return simulation, curve

    def compare_with_theory(self, flat: np.ndarray, rows: CurveRows) -> Comparison:
        """Compare kinetic theory with the measured rows."""
        values = self.problem.unflatten(flat)[""]
        known = {name: x for name, x in values.items() if name in rows.gas.domains}
        return Comparison(predicted_curve(rows, KineticTheory(), known, []))

    def with_noise(self, near: list[Simulation]) -> CurveRows:
        """Return the measured curve for kinetic theory, with the noise of a mean of simulations.

        Simulated grains scatter as measured ones do, but for contacts, which only soft spheres
        have. Where a model does not tell its number of grains, the scatter of its replicas gives
        the noise, independent at each time.
        """
        if self.num_particles is None:
            variance = np.mean([s.variance for s in near], axis=0) / len(near)
            return replace(self.theory, simulation=variance.reshape(2, -1).T)
        simulated = self.num_particles * sum(len(s.deviation) for s in near)
        grains = self.theory.grains
        inverse_number = grains.inverse_number + 1 / simulated
        contacts = grains.contacts
        if not self.model.has_contacts:
            contacts *= grains.inverse_number / inverse_number
        grains = grains._replace(inverse_number=inverse_number, contacts=contacts)
        return replace(self.theory, grains=grains)

    def average(self, near: list[Simulation]) -> Average:
        """Return the mean of the Gauss-Newton estimates of some simulations, the newest last."""
        comparison = self.compare_with_theory(near[-1].flat, self.with_noise(near))
        estimates = []
        for s in near:
            # Slope and values of one run share their noise, whose product would move the estimate:
            # each run takes the mean slope of the others.
            others = [x.slope for x in near if x is not s] or [s.slope]
            estimates.append(self._estimate(s, np.mean(others, axis=0), comparison))
        slope = np.mean([s.slope for s in near], axis=0)
        sensitivity = comparison.whiten(slope)
        information = sensitivity.T @ sensitivity
        noise = np.mean([x.noise for x in estimates], axis=0)
        expected = self.expected_noise(comparison, slope, information, len(near[-1].deviation))
        if expected is not None:
            degrees = sum(len(s.deviation) - 1 for s in near)
            total = THEORY_DEGREES + degrees
            noise = (THEORY_DEGREES * expected + degrees * noise) / total
        flat = np.mean([x.flat for x in estimates], axis=0)
        return Average(flat, information, noise / len(near), comparison)

    def _estimate(
        self, s: Simulation, slope: Float[np.ndarray, "values p"], comparison: Comparison
    ) -> _Estimate:
        """Return the Gauss-Newton estimate of one simulation, by some slope of its values."""
        p = s.flat.size
        difference = self.measured - s.values
        columns = np.concatenate([difference[:, None], slope, s.deviation.T], axis=1)
        whitened = comparison.whiten(columns)
        difference, slope, deviation = np.split(whitened, [1, 1 + p], axis=1)
        gain = resolved_inverse(slope.T @ slope, self.model.derivative_accuracy) @ slope.T
        replicas = deviation.shape[1]
        shift = gain @ deviation / (replicas * (replicas - 1)) ** 0.5
        return _Estimate(s.flat + (gain @ difference)[:, 0], shift @ shift.T)

    def expected_noise(
        self,
        comparison: Comparison,
        slope: Float[np.ndarray, "values p"],
        information: Float[np.ndarray, "p p"],
        replicas: int,
    ) -> Float[np.ndarray, "p p"] | None:
        """Return the covariance that kinetic theory gives to the estimate of one simulation.

        It is the part of the covariance by the scatter of all grains, measured and simulated, times
        its share of one simulation; None where a model does not tell its number of grains.
        """
        if self.num_particles is None:
            return None
        covariance = resolved_inverse(information, self.model.derivative_accuracy)
        by_grains = covariance @ information_by(comparison, slope, FEW_PARTICLES) @ covariance
        inverse_number = comparison.curve.rows.grains.inverse_number
        return by_grains / (inverse_number * self.num_particles * replicas)


def information_by(
    comparison: Comparison, slope: Float[np.ndarray, "values p"], source: str
) -> Float[np.ndarray, "p p"]:
    """Return the decrease of the information with the logarithm of the variance by one source."""

    def information(factor: float) -> np.ndarray:
        whitened = replace(comparison, sources={source: factor}).whiten(slope)
        return whitened.T @ whitened

    return decrease_with_variance(information)


def variance_of_mean(deviation: Float[np.ndarray, "replicas used"]) -> Float[np.ndarray, "used"]:
    """Variance of the mean over replicas, averaged over neighbouring times."""
    replicas, num_times = deviation.shape
    variance = np.sum(deviation**2, axis=0) / (replicas * (replicas - 1))
    window = np.ones(min(NOISE_WINDOW, num_times))
    num_averaged = np.convolve(np.ones(num_times), window, "same")
    return np.convolve(variance, window, "same") / num_averaged


class SearchResult(NamedTuple):
    """Where a search through simulations ended.

    Attributes:
        average: the estimate and its errors.
        near: the simulations near the estimate.
        curve: curve of the last simulation.
        num_simulations: number of all simulations.
        converged: whether the last step was below `AVERAGING_DISTANCE`, or the loss ceased to fall.
        trace: course of a gradient descent; None for other searches.
    """

    average: Average
    near: list[Simulation]
    curve: CoolingCurve
    num_simulations: int
    converged: bool
    trace: Trace | None = None


def by_gauss_newton(sims: Simulations, first: np.ndarray, max_simulations: int) -> SearchResult:
    """Search by Gauss-Newton steps, each on one simulation and its derivatives.

    Each simulation has different random numbers. The simulations within `AVERAGING_DISTANCE` of the
    last one give independent Gauss-Newton estimates; their mean is the result. Its noise follows
    from the changes that single replicas would make to it, averaged with the one that kinetic
    theory expects (`THEORY_DEGREES`). The search ends when there are two simulations near, a step
    is below `AVERAGING_DISTANCE`, and the noise is below `MAX_NOISE_SHARE` of the standard error.
    """
    flat = np.asarray(first, float)
    simulations: list[Simulation] = []
    hidden = None if sims.progress else True  # None hides the bar where there is no terminal
    with tqdm(total=max_simulations, disable=hidden, desc="fit", unit="simulation") as bar:
        for stream in range(max_simulations):
            simulation, curve = sims.run(flat, stream)
            simulations.append(simulation)
            near = [s for s in simulations if np.abs(s.flat - flat).max() < AVERAGING_DISTANCE]
            average = sims.average(near)
            step = average.flat - flat
            step *= min(1.0, MAX_STEP / max(np.abs(step).max(), 1e-300))
            converged = bool(np.abs(step).max() < AVERAGING_DISTANCE)
            flat = flat + step
            noise = np.diag(average.noise)
            variance = np.diag(inverse(average.information))
            low_noise = np.all(noise <= MAX_NOISE_SHARE**2 * variance)
            in_errors = np.abs(step / np.sqrt(variance)).max()
            bar.update()
            bar.set_postfix_str(f"last step {in_errors:.2g} standard errors")
            if converged and len(near) > 1 and low_noise:
                break
    return SearchResult(average._replace(flat=flat), near, curve, len(simulations), converged)


def by_descent(
    sims: Simulations, first: np.ndarray, max_simulations: int, descent: Descent
) -> SearchResult:
    """Search by gradient descent.

    Each step takes the gradient of |W (y - f)|^2, plus that of the prior, through a simulation with
    different random numbers. Here y and f are the measured and simulated ln T and ln T_rot, and W
    whitens them as kinetic theory does at the first parameters. The estimate is the mean of the
    last half of the steps; of a descent that diverges it is the step with the smallest loss.
    `NUM_LINEARISED` further simulations at the estimate give its errors.
    """
    measured = sims.measured
    theory = sims.compare_with_theory(first, sims.theory)
    whitening = jnp.asarray(theory.whiten(np.eye(measured.size)))

    def loss(flat: Array, stream: int) -> Array:
        residuals = whitening @ (sims.logs_of(sims.curve_at(flat, stream)) - measured)
        prior = sims.gas_at(flat).law.prior_residuals()
        return jnp.sum(residuals**2) + jnp.sum(prior**2)

    def at(flat: np.ndarray, step: int) -> Loss:
        value, gradient = jax.value_and_grad(loss)(jnp.asarray(flat), step)
        return Loss(float(value), gradient)

    used = int(np.sum(sims.rows.used))
    to_estimates = sims.problem.to_estimates
    course = descent.descend(at, first, max_simulations, used, to_estimates, noisy=True)
    flats = course.flats
    averaged = (len(flats) + 1) // 2
    flat = np.mean(flats[-averaged:], axis=0)
    if course.diverged:
        averaged = 1
        flat = flats[np.argmin(course.losses)]
    streams = range(len(flats), len(flats) + NUM_LINEARISED)
    runs = [sims.run(flat, stream) for stream in streams]
    near = [s for s, _ in runs]
    average = sims.average(near)
    noise = average.noise * NUM_LINEARISED / averaged
    average = average._replace(flat=flat, noise=noise)
    num_simulations = len(flats) + NUM_LINEARISED
    return SearchResult(average, near, runs[-1][1], num_simulations, course.converged, course.trace)
