"""The result of a fit: estimates, their errors, and goodness of fit.

Minima of chi^2 besides the deepest one.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils.formatting import Rows, format_quantity, html_table, text_table
from jaxgran._utils.tracing import any_traced, concrete
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.parameters import START_TIME, Parameters, Priors, size_of
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import FLOAT_UNITS, Gas

DEGENERATE_CHI2 = 9.0
"""Difference of chi^2 up to which two minima count as equally good: three standard errors."""

SEVERAL, ROUGHNESSES = "tangential_restitution", (-0.6, 0.0, 0.6)
"""A parameter in which chi^2 has several minima where T_rot is measured, and where to search."""


def search_starts(
    parameters: Parameters, first: Float[Array, "p"], beside: Float[Array, "_"]
) -> Float[Array, "starts q"]:
    """Where to search for minima of chi^2: from the first guess and, where beta_t is free, from
    several beta_t. There are minima on both sides of the beta_t at which rotation takes most.

    Args:
        parameters: those of the gas.
        first: the first guess of these.
        beside: further parameters of the search.
    """
    flats = first[None]
    if SEVERAL in parameters.names:
        gas, start_time = parameters.gas(first), parameters.start(first)
        others = [gas.replace(**{SEVERAL: beta}) for beta in ROUGHNESSES]
        flats = jnp.stack([first, *(parameters.flat(other, start_time) for other in others)])
    return jnp.concatenate([flats, jnp.tile(beside, (len(flats), 1))], axis=1)


class Minima(NamedTuple):
    """Minima of chi^2 at which searches from several starts ended.

    Attributes:
        estimates: of the free parameters, SI.
        chi2: there, of all residuals, those of priors too.
    """

    estimates: Float[Array, "starts p"]
    chi2: Float[Array, "starts"]

    def degenerate_solutions(
        self,
        estimate: Float[Array, "p"],
        standard_error: Float[Array, "p"],
        unit: float,
    ) -> Float[np.ndarray, "others p"]:
        """The estimates at minima that are not told from the deepest one: chi^2 is larger by less
        than `AS_GOOD`, and a parameter differs by more than its square root in standard errors.

        Args:
            estimate, standard_error: of the deepest one.
            unit: of chi^2, where errors turned out to be larger than they were said to be.
        """
        chi2 = np.asarray(self.chi2)
        near = chi2 - np.min(chi2) < DEGENERATE_CHI2 * unit
        away = np.asarray(self.estimates) - np.asarray(estimate)
        apart = np.max(np.abs(away) / np.asarray(standard_error), axis=1) > DEGENERATE_CHI2**0.5
        found: list[np.ndarray] = []
        for other in np.asarray(self.estimates)[near & apart]:
            if not any(np.allclose(other, known, rtol=1e-3) for known in found):
                found.append(other)
        return np.array(found).reshape(-1, away.shape[1])


def describe_minima(names: tuple[str, ...], others: Float[np.ndarray, "others p"]) -> str | None:
    """A clause about minima that are as good as that of a fit; None if there are none."""
    if not len(others):
        return None
    sets = (
        ", ".join(f"{name} = {value:.3g}" for name, value in zip(names, other, strict=False))
        for other in others
    )
    return f"chi^2 has another minimum as good, at {' and at '.join(sets)}"


SIGNIFICANCE = 0.01
"""Level of significance of the chi^2 test: below it a model does not explain the curve."""


class Fit(eqx.Module):
    """Result of a fit of p free parameters. Under `jax.vmap` all arrays have a batch axis.

    Attributes:
        names: the free parameters.
        model: the model that was fitted.
        estimate: estimated values, SI, shape (p,).
        covariances: of the estimates, SI, shape (p, p), a part of the whole error each:
            "measurement", the errors of the curve, increased by the correlation of neighbouring
            residuals, and by sqrt(reduced chi^2) if the model does not explain the curve;
            "model", the error of the model's clock, `clock_error`; "model of <dr^2>" and "model of
            T_rot", those of a factor common to all of these; one part for each of the `priors`,
            under its name; "few particles", what the chance of single collisions adds where N is
            known; and of a stochastic model "simulation", its noise, estimated from its replicas,
            and "slope", what the bias of its derivatives, or their noise, does.
        clock_error: relative error of the model's clock, in this scene, at the measured times.
        gain: derivative of each estimate in each measured ln T, SI, shape (p, times).
        clock_gain: its change over a relative change of the model's clock at each time, SI, shape
            (p, times).
        sensitivity: derivative of the weighted residuals of T, and of <dr^2> if it was used, in the
            parameters' unbounded scale (the logarithm of a positive one), shape (residuals, p).
        beyond: by how much the estimate lies beyond the mean of the simulations from which it was
            extrapolated, SI, shape (p,); 0 of a deterministic model.
        start: the guess at which the search began, SI, shape (p,).
        gas: the fitted gas, with all floats that have priors.
        began: t0, the time at which the gas had T_0 and began to cool, s; 0 unless it was free.
        priors: what was known besides the curve.
        curve: its cooling curve at the measured times; of a stochastic model that of the last
            simulation, one Gauss-Newton step before the estimate.
        weights: of ln T_measured - ln T_model: 1 over its error, which is smooth along a curve of
            few replicas; 0 where a point has none.
        residuals: that difference times its weight.
        displacement_residuals: the same of <dr^2>; None if it was not used.
        rotation_residuals: the same of T_rot; None if it was not used.
        scatter: of ln T about the model, taken for the error of a curve without errors; else None.
        chi2, degrees_of_freedom, reduced_chi2: of all weighted residuals; without errors of the
            curve reduced chi^2 is 1.
        p_value: probability of a chi^2 as large by chance, of T or of <dr^2>, whichever fits worse,
            the errors of few replicas being uncertain themselves; nan if the curve has no errors.
        iterations: steps of Levenberg-Marquardt, evaluations of L-BFGS, or simulations by a
            stochastic model.
        converged: whether the search reached its tolerance; of a stochastic model, whether the last
            step was below 0.1 in the parameters' unbounded scale.
        minima: minima of chi^2 that were found, of which this is the deepest, where it was searched
            from several starts; else None.

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
        return concrete(np.sum(np.stack(parts), axis=0))  # by NumPy: nothing is compiled

    @property
    def standard_error(self) -> Float[Array, "p"]:
        """One standard deviation of each estimate, SI, with everything that is known of its error.

        What it leaves out is what the model leaves out: see `jaxgran.diagnose`.
        """
        return _deviations(self.covariance)

    @property
    def error_budget(self) -> dict[str, Float[Array, "p"]]:
        """The parts of `standard_error`, SI; their squares add up to its square."""
        return {name: _deviations(part) for name, part in self.covariances.items()}

    def __repr__(self) -> str:
        return text_table(*self._words)

    def _repr_html_(self) -> str:
        return html_table(*self._words)

    @property
    def _words(self) -> tuple[str, Rows]:
        """Title and rows: the estimates with their errors, and how well the curve is met."""
        known = not isinstance(self.sensitivity, Tracer) and self.sensitivity.ndim == 2
        rows, open_to = [], self.undetermined() if known else ()
        for name in self.names:
            estimate, error = (format_quantity(x, _unit(name)) for x in self.value(name))
            rows.append((name, "not determined" if name in open_to else f"{estimate} +- {error}"))
        rows.append(
            (
                "reduced chi^2",
                f"{format_quantity(self.reduced_chi2)}, p = {format_quantity(self.p_value)}",
            )
        )
        rows.append(("converged", str(self.converged)))
        return f"Fit of {self.model.name}", rows

    def value(self, name: str) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Estimate and standard error of one parameter."""
        if name not in self.names:
            raise ValueError(f"{name!r} was not free; free were {', '.join(self.names)}")
        i = self.names.index(name)
        found = self.estimate, self.standard_error
        if any_traced(found):
            return found[0][..., i], found[1][..., i]
        return concrete(np.asarray(found[0])[..., i]), concrete(np.asarray(found[1])[..., i])

    def degenerate_solutions(self) -> Float[np.ndarray, "others p"]:
        """Estimates at other minima that the curve does not tell from this one: see
        `jaxgran.fitting.result.Minima.degenerate_solutions`. Of one fit, not of a batch."""
        if self.minima is None:
            return np.zeros((0, len(self.estimate)))
        unit = max(float(self.reduced_chi2), 1.0)
        return self.minima.degenerate_solutions(self.estimate, self.standard_error, unit)

    def undetermined(self) -> tuple[str, ...]:
        """Parameters of which the curve determines no value, or only a combination; () if none.

        These are the parameters in those singular vectors of the sensitivity whose standard error
        exceeds 1 (a factor e), or whose singular value is below ``model.derivative_accuracy`` times
        the largest.
        """
        _, singular, rotation = np.linalg.svd(np.asarray(self.sensitivity), full_matrices=False)
        weak = (singular <= 1) | (singular < self.model.derivative_accuracy * singular[0])
        share = np.abs(rotation[weak])
        found = np.any(share > 0.05 * share.max(axis=1, initial=0.0, keepdims=True), axis=0)
        sized = [name for name in self.names for _ in range(size_of(self.gas, name))]
        return tuple(dict.fromkeys(n for n, yes in zip(sized, found, strict=True) if yes))


def _unit(name: str) -> str:
    return "s" if name == START_TIME else FLOAT_UNITS.get(name, "")


def _deviations(covariance: Float[Array, "p p"]) -> Float[Array, "p"]:
    if any_traced(covariance):
        return jnp.sqrt(jnp.diagonal(covariance, axis1=-2, axis2=-1))
    with np.errstate(invalid="ignore"):  # nan, as JAX has it
        return concrete(np.sqrt(np.diagonal(np.asarray(covariance), axis1=-2, axis2=-1)))


class Misfit(NamedTuple):
    """Goodness of fit.

    Attributes:
        chi2: sum of squared weighted residuals.
        reduced: chi^2 per degree of freedom.
        p_value: probability of a chi^2 as large by chance; nan if the errors are unknown.
        inflation: factor by which the covariance of the measurement is multiplied.
    """

    chi2: Float[Array, ""]
    reduced: Float[Array, ""]
    p_value: Float[Array, ""]
    inflation: Float[Array, ""]


def misfit(
    parts: list[tuple[Float[Array, "_"], Int[Array, ""], Float[Array, ""] | None]],
    degrees_of_freedom: Int[Array, ""],
    *,
    errors_known: bool,
) -> Misfit:
    """Goodness of fit of weighted residuals.

    T and <dr^2> are tested apart, so that many points of one do not hide a misfit of the other: the
    p-value is that of the worse one, corrected for the choice. Residuals over errors that were
    estimated themselves have Student's t distribution, and their chi^2 per degree of freedom has
    the F distribution.

    The covariance is inflated by the reduced chi^2 (at least 1) of the worse one where the p-value
    is below `SIGNIFICANCE`, and always where the errors are unknown.

    Args:
        parts: weighted residuals of each observable, their degrees of freedom, and those of their
            errors; None if these are exact.
        degrees_of_freedom: of all of them.
        errors_known: whether they are.
    """
    each = jnp.stack([jnp.sum(jnp.asarray(residuals) ** 2) for residuals, *_ in parts])
    chi2 = jnp.sum(each)
    reduced = chi2 / degrees_of_freedom
    if not errors_known:
        return Misfit(chi2, reduced, jnp.full((), jnp.nan), reduced)
    degrees = jnp.stack([jnp.maximum(number, 1) for _, number, _ in parts])
    own = [of_errors for *_, of_errors in parts]
    chances = [_chance(x, n, m) for x, n, m in zip(each, degrees, own, strict=True)]
    worst = jnp.min(jnp.stack(chances))
    p_value = -jnp.expm1(len(parts) * jnp.log1p(-worst)) if len(parts) > 1 else worst
    unexplained = p_value < SIGNIFICANCE
    inflation = jnp.where(unexplained, jnp.maximum(jnp.max(each / degrees), 1.0), 1.0)
    return Misfit(chi2, reduced, p_value, inflation)


def _chance(
    chi2: Float[Array, ""], degrees: Int[Array, ""], of_errors: Float[Array, ""] | None
) -> Float[Array, ""]:
    """Probability of a chi^2 as large, over errors of some degrees of freedom, None if exact."""
    if of_errors is None:
        return jax.scipy.stats.chi2.sf(chi2, degrees)
    share = of_errors / (of_errors + chi2)  # of the F distribution
    return jax.scipy.special.betainc(of_errors / 2, degrees / 2, share)
