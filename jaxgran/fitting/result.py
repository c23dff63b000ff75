"""Result of a fit: estimates, their errors, goodness of fit, and other minima of chi^2."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils.formatting import TableRows, format_quantity, html_table, text_table
from jaxgran._utils.tracing import any_traced, concrete_array
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.parameters import START_TIME, Parameters, Priors, size_of
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import FLOAT_UNITS, Gas

DEGENERATE_CHI2 = 9.0
"""Difference of chi^2 up to which two minima are equally good: three standard errors."""

MULTIMODAL_PARAMETER, MULTIMODAL_STARTS = "tangential_restitution", (-0.6, 0.0, 0.6)
"""Parameter in which chi^2 has several minima if T_rot is measured, and its start values."""

SIGNIFICANCE = 0.01
"""Level of significance of the chi^2 test: a model with a smaller p-value is rejected."""


class Minima(NamedTuple):
    """Minima of chi^2 at which searches from several starts ended.

    Attributes:
        estimates: estimates of the free parameters, SI.
        chi2: chi^2 of all residuals, including those of priors.
    """

    estimates: Float[Array, "starts p"]
    chi2: Float[Array, "starts"]

    def degenerate_solutions(
        self,
        estimate: Float[Array, "p"],
        standard_error: Float[Array, "p"],
        unit: float,
    ) -> Float[np.ndarray, "others p"]:
        """Return the estimates at other minima that are as good as the deepest one.

        There chi^2 is larger by less than `DEGENERATE_CHI2`, and a parameter differs by more than
        the square root of that, in standard errors.

        Args:
            estimate, standard_error: estimate at the deepest minimum, and its standard error.
            unit: unit of chi^2; above 1 if the errors of the curve are too small.
        """
        chi2 = np.asarray(self.chi2)
        as_good = chi2 - np.min(chi2) < DEGENERATE_CHI2 * unit
        distance = np.asarray(self.estimates) - np.asarray(estimate)
        apart = np.max(np.abs(distance) / np.asarray(standard_error), axis=1) > DEGENERATE_CHI2**0.5
        solutions: list[np.ndarray] = []
        for other in np.asarray(self.estimates)[as_good & apart]:
            if not any(np.allclose(other, known, rtol=1e-3) for known in solutions):
                solutions.append(other)
        return np.array(solutions).reshape(-1, distance.shape[1])


class Fit(eqx.Module):
    """Result of a fit of p free parameters. Under `jax.vmap` all arrays have a batch axis.

    Attributes:
        names: names of the free parameters.
        model: the fitted model.
        estimate: estimates of the free parameters, SI, shape (p,).
        covariances: covariances of the estimates, SI, shape (p, p), by the source of the error:
            "measurement", the errors of the curve, increased by the correlation of neighbouring
            residuals, and by sqrt(reduced chi^2) if the model does not explain the curve;
            "model", the error of the model's clock, `clock_error`; "model of <dr^2>" and "model of
            T_rot", the error of a common factor of all these values; the name of a prior, for each
            of the `priors`; "few particles", the randomness of single collisions, if N is known;
            and for a stochastic model "simulation", its noise, estimated from its replicas, and
            "slope", the bias or the noise of its derivatives.
        clock_error: relative error of the model's clock, in this scene, at the measured times.
        gain: derivative of each estimate in each measured ln T, SI, shape (p, times).
        clock_gain: derivative of each estimate in a relative change of the model's clock at each
            time, SI, shape (p, times).
        sensitivity: derivative of the weighted residuals of T, and of <dr^2> if it was used, in the
            unconstrained parameters (the logarithm of a positive one), shape (residuals, p).
        extrapolation: difference of the estimate and the mean of the simulations from which it was
            extrapolated, SI, shape (p,); 0 for a deterministic model.
        start: the guess at which the search started, SI, shape (p,).
        gas: the fitted gas, including fitted values of all floats that have priors.
        start_time: t0, the time at which the gas had T_0 and began to cool, s; 0 unless free.
        priors: the known values of other floats.
        curve: the cooling curve of the fitted gas at the measured times; for a stochastic model
            that of the last simulation, one Gauss-Newton step before the estimate.
        weights: inverse error of ln T_measured - ln T_model, smooth along a curve of few replicas;
            0 for a point without weight.
        residuals: ln T_measured - ln T_model times its weight.
        displacement_residuals: weighted residuals of <dr^2>; None if it was not used.
        rotation_residuals: weighted residuals of T_rot; None if it was not used.
        scatter: scatter of ln T about the model, used as the error of a curve without errors; None
            for a curve with errors.
        chi2, degrees_of_freedom, reduced_chi2: goodness of fit of all weighted residuals; without
            errors of the curve reduced chi^2 is 1.
        p_value: probability of a chi^2 as large by chance, of T or of <dr^2>, whichever fits worse,
            including the uncertainty of errors from few replicas; nan if the curve has no errors.
        iterations: steps of Levenberg-Marquardt, evaluations of L-BFGS, or simulations by a
            stochastic model.
        converged: True if the search reached its tolerance; for a stochastic model, if the last
            step was below 0.1 in the unconstrained scale.
        minima: minima of chi^2 from several starts, of which the fit is the deepest; None if there
            was a single start.

    >>> A, error = result.value("dissipative_constant")
    >>> f"{float(A):.3g} s", sorted(result.error_budget)
    ('3e-06 s', ['measurement', 'model'])
    """

    names: tuple[str, ...] = eqx.field(static=True)
    model: AbstractModel
    estimate: Float[Array, "p"]
    covariances: dict[str, Float[Array, "p p"]]
    clock_error: Float[Array, "times"]
    gain: Float[Array, "p times"]
    clock_gain: Float[Array, "p times"]
    sensitivity: Float[Array, "residuals p"]
    extrapolation: Float[Array, "p"]
    start: Float[Array, "p"]
    gas: Gas
    start_time: Float[Array, ""]
    priors: Priors
    curve: CoolingCurve
    weights: Float[Array, "times"]
    residuals: Float[Array, "times"]
    displacement_residuals: Float[Array, "times"] | None
    rotation_residuals: Float[Array, "times"] | None
    scatter: Float[Array, ""] | None
    chi2: Float[Array, ""]
    degrees_of_freedom: Int[Array, ""]
    reduced_chi2: Float[Array, ""]
    p_value: Float[Array, ""]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]
    minima: Minima | None = None

    @property
    def covariance(self) -> Float[Array, "p p"]:
        """Covariance of the estimates, SI: the sum of all parts."""
        parts = [*self.covariances.values()]
        if any_traced(parts):
            return sum(parts[1:], parts[0])
        return concrete_array(np.sum(np.stack(parts), axis=0))  # by NumPy: nothing is compiled

    @property
    def standard_error(self) -> Float[Array, "p"]:
        """One standard deviation of each estimate, SI, from all known sources of error.

        It does not include the limitations of the model: see `jaxgran.diagnose`.
        """
        return _deviations(self.covariance)

    @property
    def error_budget(self) -> dict[str, Float[Array, "p"]]:
        """The parts of `standard_error`, SI; their squares add up to its square."""
        return {name: _deviations(part) for name, part in self.covariances.items()}

    def __repr__(self) -> str:
        return text_table(*self._summary)

    def _repr_html_(self) -> str:
        return html_table(*self._summary)

    @property
    def _summary(self) -> tuple[str, TableRows]:
        """Title and rows of a table of the estimates and the goodness of fit."""
        is_single = not isinstance(self.sensitivity, Tracer) and self.sensitivity.ndim == 2
        rows, undetermined = [], self.undetermined() if is_single else ()
        for name in self.names:
            estimate, error = (format_quantity(x, _unit(name)) for x in self.value(name))
            rows.append(
                (name, "not determined" if name in undetermined else f"{estimate} +- {error}")
            )
        rows.append(
            (
                "reduced chi^2",
                f"{format_quantity(self.reduced_chi2)}, p = {format_quantity(self.p_value)}",
            )
        )
        rows.append(("converged", str(self.converged)))
        return f"Fit of {self.model.name}", rows

    def value(self, name: str) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the estimate and the standard error of one parameter."""
        if name not in self.names:
            raise ValueError(f"{name!r} was not free; free were {', '.join(self.names)}")
        i = self.names.index(name)
        estimate, error = self.estimate, self.standard_error
        if any_traced((estimate, error)):
            return estimate[..., i], error[..., i]
        return (
            concrete_array(np.asarray(estimate)[..., i]),
            concrete_array(np.asarray(error)[..., i]),
        )

    def degenerate_solutions(self) -> Float[np.ndarray, "others p"]:
        """Return the estimates at other, equally good minima of chi^2.

        See `jaxgran.fitting.result.Minima.degenerate_solutions`. Not for a batch of fits.
        """
        if self.minima is None:
            return np.zeros((0, len(self.estimate)))
        unit = max(float(self.reduced_chi2), 1.0)
        return self.minima.degenerate_solutions(self.estimate, self.standard_error, unit)

    def undetermined(self) -> tuple[str, ...]:
        """Return the parameters that the curve does not determine, or only in a combination.

        These are the parameters in those singular vectors of the sensitivity whose standard error
        exceeds 1 (a factor e), or whose singular value is below ``model.derivative_accuracy`` times
        the largest.
        """
        _, singular, rotation = np.linalg.svd(np.asarray(self.sensitivity), full_matrices=False)
        weak = (singular <= 1) | (singular < self.model.derivative_accuracy * singular[0])
        share = np.abs(rotation[weak])
        is_weak = np.any(share > 0.05 * share.max(axis=1, initial=0.0, keepdims=True), axis=0)
        names = [name for name in self.names for _ in range(size_of(self.gas, name))]
        return tuple(dict.fromkeys(n for n, w in zip(names, is_weak, strict=True) if w))


def _unit(name: str) -> str:
    return "s" if name == START_TIME else FLOAT_UNITS.get(name, "")


def _deviations(covariance: Float[Array, "p p"]) -> Float[Array, "p"]:
    if any_traced(covariance):
        return jnp.sqrt(jnp.diagonal(covariance, axis1=-2, axis2=-1))
    with np.errstate(invalid="ignore"):  # nan, as JAX has it
        return concrete_array(np.sqrt(np.diagonal(np.asarray(covariance), axis1=-2, axis2=-1)))


def describe_minima(names: tuple[str, ...], others: Float[np.ndarray, "others p"]) -> str | None:
    """Return a clause about other minima that are equally good; None if there are none."""
    if not len(others):
        return None
    sets = (
        ", ".join(f"{name} = {value:.3g}" for name, value in zip(names, other, strict=False))
        for other in others
    )
    return f"chi^2 has another, equally good minimum at {' and at '.join(sets)}"


def search_starts(
    parameters: Parameters, first: Float[Array, "p"], nuisance: Float[Array, "_"]
) -> Float[Array, "starts q"]:
    """Return the starts of a search: the first guess and, if beta_t is free, several beta_t.

    chi^2 has minima on both sides of the beta_t at which rotation takes most energy.

    Args:
        parameters: parameters of the gas.
        first: their first guess.
        nuisance: first guess of the nuisance parameters.
    """
    flats = first[None]
    if MULTIMODAL_PARAMETER in parameters.names:
        gas, start_time = parameters.gas(first), parameters.start(first)
        others = [gas.replace(**{MULTIMODAL_PARAMETER: beta}) for beta in MULTIMODAL_STARTS]
        flats = jnp.stack([first, *(parameters.flat(other, start_time) for other in others)])
    return jnp.concatenate([flats, jnp.tile(nuisance, (len(flats), 1))], axis=1)


class GoodnessOfFit(NamedTuple):
    """Goodness of fit.

    Attributes:
        chi2: sum of squared weighted residuals.
        reduced: chi^2 per degree of freedom.
        p_value: probability of a chi^2 as large by chance; nan if the errors are unknown.
        inflation: factor of the covariance of the measurement.
    """

    chi2: Float[Array, ""]
    reduced: Float[Array, ""]
    p_value: Float[Array, ""]
    inflation: Float[Array, ""]


def goodness_of_fit(
    parts: list[tuple[Float[Array, "_"], Int[Array, ""], Float[Array, ""] | None]],
    degrees_of_freedom: Int[Array, ""],
    *,
    errors_known: bool,
) -> GoodnessOfFit:
    """Test the goodness of fit of weighted residuals.

    T and <dr^2> are tested separately, so that many points of one do not hide a misfit of the
    other: the p-value is that of the worse one, corrected for the choice. Residuals over estimated
    errors have Student's t distribution, and their chi^2 per degree of freedom has the F
    distribution.

    The covariance is inflated by the reduced chi^2 (at least 1) of the worse one if the p-value is
    below `SIGNIFICANCE`, and always if the errors are unknown.

    Args:
        parts: for each observable the weighted residuals, their degrees of freedom, and the degrees
            of freedom of their errors, None if these are exact.
        degrees_of_freedom: degrees of freedom of all residuals.
        errors_known: True if the errors of the curve are known.
    """
    parts_chi2 = jnp.stack([jnp.sum(jnp.asarray(residuals) ** 2) for residuals, *_ in parts])
    chi2 = jnp.sum(parts_chi2)
    reduced = chi2 / degrees_of_freedom
    if not errors_known:
        return GoodnessOfFit(chi2, reduced, jnp.full((), jnp.nan), reduced)
    degrees = jnp.stack([jnp.maximum(number, 1) for _, number, _ in parts])
    error_degrees = [of_errors for *_, of_errors in parts]
    p_values = [
        _p_value(x, n, m) for x, n, m in zip(parts_chi2, degrees, error_degrees, strict=True)
    ]
    worst = jnp.min(jnp.stack(p_values))
    p_value = -jnp.expm1(len(parts) * jnp.log1p(-worst)) if len(parts) > 1 else worst
    unexplained = p_value < SIGNIFICANCE
    inflation = jnp.where(unexplained, jnp.maximum(jnp.max(parts_chi2 / degrees), 1.0), 1.0)
    return GoodnessOfFit(chi2, reduced, p_value, inflation)


def _p_value(
    chi2: Float[Array, ""], degrees: Int[Array, ""], error_degrees: Float[Array, ""] | None
) -> Float[Array, ""]:
    """Probability of a chi^2 as large; `error_degrees` is None for exact errors."""
    if error_degrees is None:
        return jax.scipy.stats.chi2.sf(chi2, degrees)
    share = error_degrees / (error_degrees + chi2)  # of the F distribution
    return jax.scipy.special.betainc(error_degrees / 2, degrees / 2, share)
