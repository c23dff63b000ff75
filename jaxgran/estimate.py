"""What a fit found: estimates, their errors, and how well the model explains the curve."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.curve import CoolingCurve
from jaxgran.gas import Gas

SIGNIFICANCE = 0.01
"""A model is said not to explain a curve if chance alone would misfit as badly less often."""


class Fit(eqx.Module):
    """What a fit found. p is the number of free parameters; under `jax.vmap` all fields batch.

    Attributes:
        names: the free parameters.
        model: the name of the model.
        accuracy: relative, of kinetic theory's clock, or of a particle model's derivatives.
        estimate: their values, SI, shape (p,).
        standard_error: one standard deviation of each, SI, shape (p,): the measurement errors
            carried through, times sqrt(reduced chi^2) if the model does not explain the curve or
            the curve has no errors; and a simulation's own noise.
        model_error: by how much each would move if the model's clock were wrong by its known
            accuracy, SI, shape (p,); 0 for a particle model, of which `jaxgran.diagnose` says in
            words what it leaves out. Not part of `standard_error`.
        covariance: of the estimates, SI, shape (p, p), scaled alike.
        sensitivity: derivative of the weighted residuals in the parameters' free scale (their
            logarithm, for positive ones), shape (residuals, p).
        start: the values the search began with, SI, shape (p,).
        gas: the fitted gas.
        curve: its cooling curve at the measured times; of a particle model, that of its last run,
            one step before the estimate.
        residuals: (ln T_measured - ln T_model) over its error; 0 where a point carries no weight.
        displacement_residuals: the same of <dr^2>; None if it was not used.
        chi2, degrees_of_freedom, reduced_chi2, p_value: of the weighted residuals; p_value is nan
            if the curve carries no errors (then errors are scaled so that reduced chi^2 is 1).
        iterations: of the least-squares or quasi-Newton search; runs of a particle model.
        converged: whether the search ended at its tolerance; through a particle model, whether its
            last step was under 0.1 in the parameters' free scale.
        simulation_error: the part of `standard_error` that is a particle model's own noise, by its
            replicas, shape (p,); None for kinetic theory, which has none.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    model: str = eqx.field(static=True)
    accuracy: float = eqx.field(static=True)
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

    def value(self, name: str) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Estimate and standard error of one parameter."""
        if name not in self.names:
            raise ValueError(f"{name!r} was not free; free were {', '.join(self.names)}")
        i = self.names.index(name)
        return self.estimate[..., i], self.standard_error[..., i]

    def undetermined(self) -> tuple[str, ...]:
        """Parameters that the curve does not determine, alone or apart; empty if it does.

        Some change of them together must be left open by more than a factor e, or alter the curve
        less than the model's `accuracy` times as much as the best determined change does.
        """
        known = not bool(jnp.isnan(self.p_value))
        error = 1.0 if known else float(self.reduced_chi2) ** 0.5
        _, singular, rotation = jnp.linalg.svd(self.sensitivity, full_matrices=False)
        apart = float(singular[-1]) >= self.accuracy * float(singular[0])
        if float(singular[-1]) > error and apart:
            return ()
        share = [abs(float(x)) for x in rotation[-1]]
        sized = [n for n in self.names for _ in range(self.gas.value(n).size)]
        open_ended = {n: 0 for n, x in zip(sized, share, strict=True) if x > 0.05 * max(share)}
        return tuple(open_ended)


class Misfit(NamedTuple):
    chi2: Array
    reduced: Array
    p_value: Array  # nan where no errors are known
    inflation: Array  # of the covariance


def misfit(residuals: ArrayLike, degrees_of_freedom: ArrayLike, *, errors_known: bool) -> Misfit:
    """Of weighted residuals; errors grow by sqrt(inflation) where chance does not explain them."""
    chi2 = jnp.sum(jnp.asarray(residuals) ** 2)
    reduced = chi2 / degrees_of_freedom
    if not errors_known:
        return Misfit(chi2, reduced, jnp.full((), jnp.nan), reduced)
    p_value = jax.scipy.stats.chi2.sf(chi2, degrees_of_freedom)
    unexplained = p_value < SIGNIFICANCE
    inflation = jnp.where(unexplained, jnp.maximum(reduced, 1.0), 1.0)
    return Misfit(chi2, reduced, p_value, inflation)


class Parameters:
    """Free parameters of a gas in one array, in a scale without bounds (logarithms, mostly)."""

    def __init__(self, gas: Gas, names: tuple[str, ...]):
        self._gas, self._names = gas, names
        self._domains = [gas.domains[name] for name in names]
        self._unravel = ravel_pytree(self._of(gas))[1]

    def _of(self, gas: Gas) -> list[Array]:
        pairs = zip(self._names, self._domains, strict=True)
        return [domain.to_free(gas.value(name)) for name, domain in pairs]

    def flat(self, gas: Gas) -> Float[Array, "p"]:
        """Where a gas is in this scale."""
        return ravel_pytree(self._of(gas))[0]

    def values(self, flat: Float[Array, "p"]) -> dict[str, Array]:
        """SI values by name."""
        found = zip(self._names, self._domains, self._unravel(flat), strict=True)
        return {name: domain.from_free(free) for name, domain, free in found}

    def gas(self, flat: Float[Array, "p"]) -> Gas:
        """The gas with these values."""
        return self._gas.replace(**self.values(flat))

    def estimates(self, flat: Float[Array, "p"]) -> Float[Array, "p"]:
        """SI values in one array."""
        return jnp.concatenate([jnp.ravel(value) for value in self.values(flat).values()])
