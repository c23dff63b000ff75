"""Fits through a deterministic model, whose residuals have no noise of their own."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.run import Run
from jaxgran.fitting.least_squares import least_squares, quasi_newton
from jaxgran.fitting.parameters import Parameters
from jaxgran.fitting.result import Fit, misfit
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

SEARCHES = {"levenberg-marquardt": least_squares, "lbfgs": quasi_newton}
"""Minimisers by the name of the method."""


@eqx.filter_jit
def fit_deterministic(
    gas: Gas,
    curve: CoolingCurve,
    model: AbstractModel,
    names: tuple[str, ...],
    guesses: list[Gas],
    num_particles: int | None = None,
    method: str = "levenberg-marquardt",
    max_steps: int = 100,
) -> Fit:
    """Fit through a deterministic model, from the best of some guesses.

    Args, returns: as `jaxgran.fit`.
    """
    comparison = Comparison.of(gas, curve, model, names, num_particles)
    first = comparison.best(guesses)
    flat, iterations, converged = SEARCHES[method](comparison.residuals, first, max_steps)
    return _fit_at(comparison, names, first, flat, iterations, converged)


@dataclass(frozen=True)
class Comparison:
    """Weighted residuals of a measured curve as a function of the parameters of a model.

    The parameters ``flat`` are the free ones in their unbounded scale and, if <dr^2> is used, the
    logarithm of a factor common to all values of D, to which the model's accuracy gives a prior.

    Attributes:
        curve: the measured curve.
        model: of the computed curve.
        parameters: the free parameters.
        weights: of ln T and, if it is used, of ln <dr^2>; the inverse relative errors.
        displacement_accuracy: relative accuracy of the model's <dr^2>; None if it is not used.
    """

    curve: CoolingCurve
    model: AbstractModel
    parameters: Parameters
    weights: list[Array]
    displacement_accuracy: Float[Array, ""] | None

    @classmethod
    def of(
        cls,
        gas: Gas,
        curve: CoolingCurve,
        model: AbstractModel,
        names: tuple[str, ...],
        num_particles: int | None,
    ) -> "Comparison":
        """Compare T and, where its errors are known on both sides, <dr^2>."""
        T, T_error = curve.temperature, curve.temperature_error
        weights = [_weights(T, T if T_error is None else T_error)]
        accuracy = _displacement_accuracy(gas, curve, model, num_particles)
        if accuracy is not None:
            assert curve.displacement is not None
            sampling = (2 / (gas.dimension * (num_particles or 1))) ** 0.5 * curve.displacement
            error = sampling if curve.displacement_error is None else curve.displacement_error
            error = jnp.where(error > 0, jnp.hypot(error, accuracy * curve.displacement), 0.0)
            weights.append(_weights(curve.displacement, error))
        return cls(curve, model, Parameters(gas, names), weights, accuracy)

    def free(self, flat: Float[Array, "q"]) -> Float[Array, "p"]:
        """The free parameters of the gas, without the factor of D."""
        return flat if self.displacement_accuracy is None else flat[:-1]

    def estimates(self, flat: Float[Array, "q"]) -> Float[Array, "p"]:
        """SI values of the free parameters."""
        return self.parameters.estimates(self.free(flat))

    def evaluate(
        self, flat: Float[Array, "q"], clock: Float[Array, ""] | float = 1.0
    ) -> tuple[Float[Array, "residuals"], tuple[Float[Array, "residuals"], CoolingCurve]]:
        """The weighted residuals, twice, and the computed curve, as `jax.jacfwd` takes them.

        Args:
            flat: the parameters.
            clock: factor by which all times of the model are multiplied.
        """
        gas = self.parameters.gas(self.free(flat))
        computed = self.model.simulate(gas, self.curve.times * clock, Run())
        parts = [self.weights[0] * _log_ratio(self.curve.temperature, computed.temperature)]
        if self.displacement_accuracy is not None:
            assert self.curve.displacement is not None
            assert computed.displacement is not None and computed.collisions is not None
            # The common factor is one of D: the ballistic flight before collisions is exact.
            diffusive = computed.collisions / (1 + computed.collisions)
            ratio = _log_ratio(self.curve.displacement, computed.displacement)
            ratio = ratio - flat[-1] * diffusive
            parts += [self.weights[1] * ratio, flat[-1:] / self.displacement_accuracy]
        residuals = jnp.concatenate(parts)
        return residuals, (residuals, computed)

    def residuals(self, flat: Float[Array, "q"]) -> Float[Array, "residuals"]:
        """The weighted residuals of ln T, of ln <dr^2>, and of the factor of D."""
        return self.evaluate(flat)[0]

    def best(self, guesses: list[Gas]) -> Float[Array, "q"]:
        """Of some guesses the one with the least chi^2."""
        flats = jnp.stack([self.parameters.flat(guess) for guess in guesses])
        if self.displacement_accuracy is not None:
            flats = jnp.pad(flats, ((0, 0), (0, 1)))
        if len(guesses) == 1:
            return flats[0]
        costs = jnp.stack([jnp.sum(self.residuals(flat) ** 2) for flat in flats])
        return flats[jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))]


def _fit_at(
    comparison: Comparison,
    names: tuple[str, ...],
    first: Float[Array, "q"],
    flat: Float[Array, "q"],
    iterations: Int[Array, ""],
    converged: Bool[Array, ""],
) -> Fit:
    """The fit whose search began at one and ended at another point."""
    derivatives = jax.jacfwd(comparison.evaluate, argnums=(0, 1), has_aux=True)
    (jacobian, clock_slope), (residuals, computed) = derivatives(flat, jnp.ones(()))
    use_displacement = comparison.displacement_accuracy is not None
    num_used = jnp.sum(jnp.concatenate(comparison.weights) > 0) + int(use_displacement)
    degrees_of_freedom = num_used - flat.size
    errors_known = comparison.curve.temperature_error is not None
    num_times = comparison.curve.times.size
    of_temperature = jnp.sum(comparison.weights[0] > 0) - comparison.free(flat).size
    parts = [(residuals[:num_times], of_temperature)]
    if use_displacement:
        parts.append((residuals[num_times:], jnp.sum(comparison.weights[1] > 0)))
    chance = misfit(parts, degrees_of_freedom, errors_known=errors_known)
    root, clock_error = _propagated(comparison, flat, jacobian, clock_slope)
    covariance = chance.inflation * root @ root.T
    free = comparison.free(flat)
    return Fit(
        names=names,
        model=comparison.model,
        estimate=comparison.estimates(flat),
        standard_error=jnp.sqrt(jnp.diag(covariance)),
        model_error=comparison.model.derivative_accuracy * clock_error,
        covariance=covariance,
        sensitivity=jacobian[:, : free.size],
        start=comparison.estimates(first),
        gas=comparison.parameters.gas(free),
        curve=computed,
        residuals=residuals[:num_times],
        displacement_residuals=residuals[num_times:-1] if use_displacement else None,
        chi2=chance.chi2,
        degrees_of_freedom=degrees_of_freedom,
        reduced_chi2=chance.reduced,
        p_value=chance.p_value,
        iterations=iterations,
        converged=converged & jnp.isfinite(chance.chi2),
    )


def _propagated(
    comparison: Comparison,
    flat: Float[Array, "q"],
    jacobian: Float[Array, "residuals q"],
    clock_slope: Float[Array, "residuals"],
) -> tuple[Float[Array, "p q"], Float[Array, "p"]]:
    """Errors propagated to the estimates, SI.

    Returns:
        A square root R of their covariance ``R R^T`` for residuals of unit variance, and by how
        much each estimate changes per relative change of all times of the model.
    """
    _, singular, rotation = jnp.linalg.svd(jacobian, full_matrices=False)
    spread = rotation.T / jnp.maximum(singular, jnp.finfo(flat.dtype).tiny ** 0.5)[None]
    root = jax.jacfwd(comparison.estimates)(flat) @ spread
    return root, jnp.abs(root @ (spread.T @ (jacobian.T @ clock_slope)))


def _displacement_accuracy(
    gas: Gas, curve: CoolingCurve, model: AbstractModel, num_particles: int | None
) -> Float[Array, ""] | None:
    """Relative accuracy of the model's <dr^2>; None if the fit cannot use <dr^2>.

    It must be measured and computed, and its error be known, and that of T to weigh it with.
    """
    if curve.displacement is None or curve.temperature_error is None:
        return None
    if curve.displacement_error is None and num_particles is None:
        return None
    accuracy = model.displacement_accuracy(gas)
    if accuracy is not None:
        computed = eqx.filter_eval_shape(model.simulate, gas, curve.times, Run())
        if computed.displacement is None or computed.collisions is None:
            return None
    return accuracy


def _weights(values: Float[Array, "times"], error: Float[Array, "times"]) -> Float[Array, "times"]:
    """Inverse relative errors; 0 where the error is 0: a value that was set, not measured."""
    known = (values > 0) & (error > 0)
    return jnp.where(known, values / jnp.where(known, error, 1.0), 0.0)


def _log_ratio(
    measured: Float[Array, "times"], computed: Float[Array, "times"]
) -> Float[Array, "times"]:
    # Not `computed > 0`: a curve that could not be computed, nan, must not count as a perfect fit.
    positive = (measured > 0) & ~(computed <= 0)
    safe = jnp.where(positive, measured, 1.0), jnp.where(positive, computed, 1.0)
    return jnp.log(safe[0]) - jnp.log(safe[1])
