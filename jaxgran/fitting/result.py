"""The result of a fit: estimates, their errors, and goodness of fit."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxgran.data.curve import CoolingCurve
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

SIGNIFICANCE = 0.01
"""Level of significance of the chi^2 test: below it a model does not explain the curve."""


class Fit(eqx.Module):
    """Result of a fit of p free parameters. Under `jax.vmap` all arrays have a batch axis.

    Attributes:
        names: the free parameters.
        model: the model that was fitted.
        estimate: estimated values, SI, shape (p,).
        standard_error: one standard deviation of each, SI, shape (p,): the errors of the
            measurement propagated to the parameters, times sqrt(reduced chi^2) if the model does
            not explain the curve or the curve has no errors; includes the noise of a stochastic
            model.
        model_error: by how much each estimate changes if the time scale of a deterministic model
            is wrong by its ``derivative_accuracy``, SI, shape (p,). Not part of `standard_error`.
            0 for a stochastic model; `jaxgran.diagnose` says in words what that leaves out.
        covariance: of the estimates, SI, shape (p, p), scaled like `standard_error`.
        sensitivity: derivative of the weighted residuals in the parameters' unbounded scale (the
            logarithm of a positive one), shape (residuals, p).
        start: the guess at which the search began, SI, shape (p,).
        gas: the fitted gas.
        curve: its cooling curve at the measured times; of a stochastic model that of the last
            simulation, one Gauss-Newton step before the estimate.
        residuals: (ln T_measured - ln T_model) over its error; 0 where a point has no weight.
        displacement_residuals: the same of <dr^2>; None if it was not used.
        chi2, degrees_of_freedom, reduced_chi2: of all weighted residuals.
        p_value: probability of a chi^2 as large by chance, of T or of <dr^2>, whichever fits worse;
            nan if the curve has no errors.
        iterations: steps of Levenberg-Marquardt, evaluations of L-BFGS, or simulations by a
            stochastic model.
        converged: whether the search reached its tolerance; of a stochastic model, whether the last
            step was below 0.1 in the parameters' unbounded scale.
        simulation_error: the part of `standard_error` due to the noise of a stochastic model,
            estimated from its replicas, shape (p,); None for a deterministic model.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    model: AbstractModel
    estimate: Float[Array, "p"]
    standard_error: Float[Array, "p"]
    model_error: Float[Array, "p"]
    covariance: Float[Array, "p p"]
    sensitivity: Float[Array, "residuals p"]
    start: Float[Array, "p"]
    gas: Gas
    curve: CoolingCurve
    residuals: Float[Array, "times"]
    displacement_residuals: Float[Array, "times"] | None
    chi2: Float[Array, ""]
    degrees_of_freedom: Int[Array, ""]
    reduced_chi2: Float[Array, ""]
    p_value: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    simulation_error: Float[Array, "p"] | None = None

    def value(self, name: str) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Estimate and standard error of one parameter."""
        if name not in self.names:
            raise ValueError(f"{name!r} was not free; free were {', '.join(self.names)}")
        i = self.names.index(name)
        return self.estimate[..., i], self.standard_error[..., i]

    def undetermined(self) -> tuple[str, ...]:
        """Parameters of which the curve determines no value, or only a combination; () if none.

        These are the parameters in those singular vectors of the sensitivity whose standard error
        exceeds 1 (a factor e), or whose singular value is below ``model.derivative_accuracy`` times
        the largest.
        """
        known = not bool(jnp.isnan(self.p_value))
        error = 1.0 if known else float(self.reduced_chi2) ** 0.5
        _, singular, rotation = np.linalg.svd(np.asarray(self.sensitivity), full_matrices=False)
        weak = (singular <= error) | (singular < self.model.derivative_accuracy * singular[0])
        share = np.abs(rotation[weak])
        found = np.any(share > 0.05 * share.max(axis=1, initial=0.0, keepdims=True), axis=0)
        sized = [name for name in self.names for _ in range(self.gas.value(name).size)]
        return tuple(dict.fromkeys(n for n, yes in zip(sized, found, strict=True) if yes))


class Misfit(NamedTuple):
    """Goodness of fit.

    Attributes:
        chi2: sum of squared weighted residuals.
        reduced: chi^2 per degree of freedom.
        p_value: probability of a chi^2 as large by chance; nan if the errors are unknown.
        inflation: factor by which the covariance is multiplied.
    """

    chi2: Float[Array, ""]
    reduced: Float[Array, ""]
    p_value: Float[Array, ""]
    inflation: Float[Array, ""]


def misfit(
    parts: list[tuple[Float[Array, "_"], Int[Array, ""]]],
    degrees_of_freedom: Int[Array, ""],
    *,
    errors_known: bool,
) -> Misfit:
    """Goodness of fit of weighted residuals.

    T and <dr^2> are tested apart, so that many points of one do not hide a misfit of the other: the
    p-value is that of the worse one, corrected for the choice.

    The covariance is inflated by the reduced chi^2 (at least 1) of the worse one where the p-value
    is below `SIGNIFICANCE`, and always where the errors are unknown.

    Args:
        parts: weighted residuals of each observable, and their degrees of freedom.
        degrees_of_freedom: of all of them.
        errors_known: whether they are.
    """
    each = jnp.stack([jnp.sum(jnp.asarray(residuals) ** 2) for residuals, _ in parts])
    chi2 = jnp.sum(each)
    reduced = chi2 / degrees_of_freedom
    if not errors_known:
        return Misfit(chi2, reduced, jnp.full((), jnp.nan), reduced)
    degrees = jnp.stack([jnp.maximum(number, 1) for _, number in parts])
    worst = jnp.min(jax.scipy.stats.chi2.sf(each, degrees))
    p_value = -jnp.expm1(len(parts) * jnp.log1p(-worst)) if len(parts) > 1 else worst
    unexplained = p_value < SIGNIFICANCE
    inflation = jnp.where(unexplained, jnp.maximum(jnp.max(each / degrees), 1.0), 1.0)
    return Misfit(chi2, reduced, p_value, inflation)
