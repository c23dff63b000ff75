"""Result of a fit, and its assembly from the linearised residuals."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils.formatting import format_quantity, text_table
from jaxgran._utils.tracing import any_traced, array_module, as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.optimise import Problem, Trace
from jaxgran.fitting.parameters import START_TIME, Numbers, Priors, with_floats
from jaxgran.fitting.residuals import (
    FACTORS,
    MODEL_ERROR,
    Rows,
    correlation_factor,
    neighbour_correlation,
)
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import law_fields
from jaxgran.scene.parameters import symbol_of, unit_of

DEGENERATE_CHI2 = 9.0
"""Difference of chi^2 up to which two minima are equally good: three standard errors."""

MAX_ROWS = 20
"""Number of estimates up to which a fit lists each element of its vectors."""

SIGNIFICANCE = 0.01
"""Level of significance of the chi^2 test: a model with a smaller p-value is rejected."""

CONDITIONAL = "if nothing else is there"
"""Name of estimates and standard errors that hold if the scene is complete."""


class Minima(NamedTuple):
    """Minima of chi^2 at which searches from several starts ended.

    Attributes:
        estimates: estimates of the free parameters, SI.
        chi2: chi^2 of all residuals, including those of priors.
        extrapolation: difference of the estimate and the mean of the simulations near it.
        iterations: steps of all searches, or simulations by a stochastic model.
        trace: chi^2 and estimates at each step of a gradient descent, and why it ended
            (`jaxgran.fitting.optimise.Trace`); None for other searches.
    """

    estimates: Numbers
    chi2: Numbers
    extrapolation: Numbers
    iterations: Numbers
    trace: Trace | None = None


class Comparison(NamedTuple):
    """Residuals of one measurement at the estimate, and what the estimate owes to them.

    Attributes:
        residuals: weighted residuals by field of the curve, or "drop test".
        weights: inverse relative errors by field; 0 for points without weight.
        gain: derivative of each estimate in each measured ln T, SI, shape (p, times).
        clock_gain: derivative of each estimate in a relative change of the model's clock at each
            time, SI, shape (p, times).
        clock_error: relative error of the model's clock, in this scene, at the measured times.
        sensitivity: derivative of the residuals in the unconstrained free parameters, shape
            (residuals, p).
        scatter: scatter of ln T about the model, used as the error of a curve without errors; None
            for a curve with errors.
        start_time: t0, the time at which the gas had T_0 and began to cool, s; 0 unless free.
        num_particles: N of the measured gas; None if it is unknown.
        replicas: number of runs over which the curve is a mean.
        errors_of_particles: True if errors that the curve lacks are those of N particles.
    """

    residuals: dict[str, Numbers]
    weights: dict[str, Numbers]
    gain: Numbers
    clock_gain: Numbers
    clock_error: Numbers
    sensitivity: Numbers
    scatter: Numbers = None
    start_time: Numbers = 0.0
    num_particles: int | None = None
    replicas: int = 1
    errors_of_particles: bool = False


class GoodnessOfFit(NamedTuple):
    """Goodness of fit.

    Attributes:
        chi2: sum of squared weighted residuals.
        degrees_of_freedom: number of residuals minus that of the parameters.
        p_value: probability of a chi^2 as large by chance, of the quantity that fits worst,
            including the uncertainty of errors from few replicas; nan if the curve has no errors.
        inflation: factor of the covariance of the measurement.
    """

    chi2: Numbers
    degrees_of_freedom: Numbers
    p_value: Numbers
    inflation: Numbers


class Fit(eqx.Module):
    """Result of a fit of p free parameters. Under `jax.vmap` all arrays have a batch axis.

    In a fit of several measurements `gas`, `data` and `curve` are dictionaries by label, and the
    name of a parameter that a measurement has separately begins with its label: "dense: t0".

    Attributes:
        names: names of the free parameters.
        model: the fitted model.
        estimate: estimates of the free parameters, SI, shape (p,).
        covariances: covariances of the estimates, SI, shape (p, p), by the source of the error:
            "measurement", the errors of the data, increased by the correlation of neighbouring
            residuals, and by sqrt(reduced chi^2) if the model does not explain the data;
            "model", the error of the model's clock; "model of <dr^2>" and "model of T_rot", the
            error of a common factor of all these values; the name of a prior, for each of the
            `priors`; "few particles", the randomness of single collisions, if N is known; and for a
            stochastic model "simulation", its noise, estimated from its replicas, and "slope", the
            bias or the noise of its derivatives.
        gas: the fitted gas, including fitted values of all floats that have priors.
        priors: the known values of other floats, by the label of the measurement; "" for all.
        data: the measurement.
        curve: the cooling curve of the fitted gas at the measured times; for a stochastic model
            that of the last simulation, one Gauss-Newton step before the estimate.
        comparisons: residuals, weights and sensitivities of each measurement, by label ("" for a
            single one).
        goodness: chi^2 of all weighted residuals, its degrees of freedom, and its p-value.
        converged: True if the search reached its tolerance; for a stochastic model, if the last
            step was below 0.1 in the unconstrained scale.
        minima: the search: minima of chi^2 at which it ended from several starts, the number of
            iterations, the extrapolation from simulations.
        absent: effects that are known to be absent, as given to `jaxgran.fit`.
        interpret: `jaxgran.diagnose`, whose range comes first where a fit is printed.

    >>> A, error = result.value("dissipative_constant")
    >>> f"{float(A):.3g} s", sorted(result.error_budget)
    ('3e-06 s', ['measurement', 'model'])
    """

    names: tuple[str, ...] = eqx.field(static=True)
    model: AbstractModel
    estimate: Float[Array, "p"]
    covariances: dict[str, Float[Array, "p p"]]
    gas: Any
    priors: dict[str, Priors]
    data: Any
    curve: Any
    comparisons: dict[str, Comparison]
    goodness: GoodnessOfFit
    converged: Bool[Array, ""]
    minima: Minima
    absent: tuple[str, ...] = eqx.field(static=True, default=())
    interpret: Callable[["Fit"], Any] | None = eqx.field(static=True, default=None)

    @property
    def chi2(self) -> Float[Array, ""]:
        """Sum of squares of all weighted residuals."""
        return self.goodness.chi2

    @property
    def degrees_of_freedom(self) -> Int[Array, ""]:
        """Number of residuals minus that of the parameters."""
        return self.goodness.degrees_of_freedom

    @property
    def p_value(self) -> Float[Array, ""]:
        """Probability of a chi^2 as large by chance; nan if the curve has no errors."""
        return self.goodness.p_value

    @property
    def reduced_chi2(self) -> Float[Array, ""]:
        """chi^2 per degree of freedom; 1 if the curve has no errors."""
        return self.chi2 / self.degrees_of_freedom

    @property
    def comparison(self) -> Comparison:
        """The comparison of a fit of one measurement."""
        if len(self.comparisons) > 1:
            raise ValueError(
                "this is a fit of several measurements: use comparisons[label] with the label "
                f"{' or '.join(self.comparisons)}"
            )
        return next(iter(self.comparisons.values()))

    @property
    def residuals(self) -> Float[Array, "times"]:
        """ln T_measured - ln T_model times its weight, of a fit of one measurement."""
        return self.comparison.residuals["temperature"]

    @property
    def start_time(self) -> Float[Array, ""]:
        """t0, s, the time at which the gas had T_0 and began to cool; 0 unless free."""
        return jnp.asarray(self.comparison.start_time)

    @property
    def scatter(self) -> Float[Array, ""] | None:
        """Scatter of ln T about the model, used as the error of a curve without errors."""
        return self.comparison.scatter

    @property
    def iterations(self) -> Int[Array, ""]:
        """Steps of the search, or simulations by a stochastic model."""
        return self.minima.iterations

    @property
    def extrapolation(self) -> Float[Array, "p"]:
        """Difference of the estimate and the mean of the simulations near it, SI; else 0."""
        return self.minima.extrapolation

    @property
    def covariance(self) -> Float[Array, "p p"]:
        """Covariance of the estimates, SI: the sum of all parts."""
        return as_jax_arrays(sum(map(_by_numpy, self.covariances.values())))

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
        """Table of the estimates and the goodness of fit.

        The title is the headline of `jaxgran.diagnose`, which takes about a second: the first
        number is the one that readers copy, and the standard error alone is too small by factors
        of 5 to 12 where the scene contains something that the fit was not told of.
        """
        title, rows, undetermined = f"Fit of {self.model.name}", [], ()
        shown = list(zip(self.names, self.names, strict=True))
        if not any_traced(self.estimate) and self.estimate.ndim == 1:
            undetermined = self.undetermined()
            if len(self.estimate) <= MAX_ROWS:
                shown = list(zip(self.element_names, self._element_names, strict=True))
            if self.interpret is not None and len(self.estimate) == len(self.names):
                diagnosis = self.interpret(self)
                title = diagnosis.headline
                rows = [("", text) for text in (diagnosis.narrowing, diagnosis.verdict) if text]
        rows.append((CONDITIONAL, ""))
        for element, name in shown:
            value = " +- ".join(format_quantity(x, unit_of(name)) for x in self.value(element))
            value = "not determined" if name in undetermined else value
            rows.append((symbol_of(element), value))
        chi2 = f"{format_quantity(self.reduced_chi2)}, p = {format_quantity(self.p_value)}"
        trace = self.minima.trace
        converged = f"{self.converged}{f': {trace.reason}' if trace else ''}"
        return text_table(title, [*rows, ("reduced chi^2", chi2), ("converged", converged)])

    def value(self, name: str) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """Return the estimate and the standard error of a parameter.

        For a vector these are vectors; "coefficients[0]" is the name of one of its elements.
        """
        elements, names = self.element_names, self._element_names
        found = [i for i, both in enumerate(zip(elements, names, strict=True)) if name in both]
        if not found:
            raise ValueError(f"{name!r} was not free; free were {', '.join(self.names)}")
        i = np.asarray(found[0] if elements[found[0]] == name else found)
        estimate, error = (_by_numpy(x) for x in (self.estimate, self.standard_error))
        return as_jax_arrays((estimate[..., i], error[..., i]))

    def degenerate_solutions(self) -> Float[np.ndarray, "others p"]:
        """Return the estimates at other minima that are as good as the deepest one.

        There chi^2, over the reduced chi^2 if this exceeds 1, is larger by less than
        `DEGENERATE_CHI2`, and a parameter differs by more than the square root of that, in standard
        errors. Not for a batch of fits.
        """
        chi2, estimates = np.asarray(self.minima.chi2), np.asarray(self.minima.estimates)
        if len(chi2) < 2:
            return np.zeros((0, len(self.estimate)))
        as_good = chi2 - np.min(chi2) < DEGENERATE_CHI2 * max(float(self.reduced_chi2), 1.0)
        distance = np.abs(estimates - np.asarray(self.estimate)) / np.asarray(self.standard_error)
        apart = np.max(distance, axis=1) > DEGENERATE_CHI2**0.5
        solutions: list[np.ndarray] = []
        for other in estimates[as_good & apart]:
            if not any(np.allclose(other, known, rtol=1e-3) for known in solutions):
                solutions.append(other)
        return np.array(solutions).reshape(-1, estimates.shape[1])

    def undetermined(self) -> tuple[str, ...]:
        """Return the parameters that the data do not determine, or only in a combination.

        These are the parameters in those singular vectors of the sensitivity whose standard error
        exceeds 1 (a factor e), or, with each parameter scaled to a sensitivity of 1, whose singular
        value is below ``model.derivative_accuracy`` times the largest. Parameters of a law with a
        smoothness prior, and arrays in parts of a law, such as a neural network, are not among
        them.
        """
        gas = next(iter(self.gas.values())) if isinstance(self.gas, dict) else self.gas
        without_meaning = law_fields(gas.law).keys() - gas.law.domains.keys()
        left_out = law_fields(gas.law) if gas.law.prior_residuals().size else without_meaning
        sensitivity = np.concatenate([np.asarray(c.sensitivity) for c in self.comparisons.values()])
        size = np.maximum(np.linalg.norm(sensitivity, axis=0), np.finfo(float).tiny)
        is_weak = np.zeros(len(size), bool)
        for scale, limit in ((1.0, 1.0), (size, self.model.derivative_accuracy)):
            _, singular, rotation = np.linalg.svd(sensitivity / scale, full_matrices=False)
            least = limit * (singular[0] if scale is size else 1.0)
            share = np.abs(rotation[singular <= least])
            is_weak |= np.any(share > 0.05 * share.max(axis=1, initial=0.0, keepdims=True), axis=0)
        names = zip(self._element_names, is_weak, strict=True)
        return tuple(dict.fromkeys(name for name, weak in names if weak and name not in left_out))

    @property
    def element_names(self) -> tuple[str, ...]:
        """Name of each element of `estimate`: "coefficients[0]" is the first of a vector."""
        places = [(name, i) for name, shape in self._shapes.items() for i in np.ndindex(shape)]
        return tuple(name + (f"[{','.join(map(str, i))}]" if i else "") for name, i in places)

    @property
    def _element_names(self) -> list[str]:
        """Name of the parameter of each element of `estimate`."""
        return [name for name, shape in self._shapes.items() for _ in range(int(np.prod(shape)))]

    @property
    def _shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parameters, in a batch those of one member."""
        gases = self.gas if isinstance(self.gas, dict) else {"": self.gas}
        shapes = {}
        for name in self.names:
            label, _, short = name.rpartition(": ")
            gas = gases.get(label, next(iter(gases.values())))
            batch = self.estimate.ndim - 1
            shapes[name] = () if short == START_TIME else gas.value(short).shape[batch:]
        return shapes

    def weights(self) -> dict[str, Float[np.ndarray, "p"]]:
        """Return the fraction of the information on each estimate from each measurement, by label.

        The information of a measurement is that on the parameters while all are free.
        """
        parts = {k: np.asarray(c.sensitivity) for k, c in self.comparisons.items()}
        total = np.sum([np.sum(x**2, axis=0) for x in parts.values()], axis=0)
        total = np.maximum(total, np.finfo(float).tiny)
        return {label: np.sum(x**2, axis=0) / total for label, x in parts.items()}


def _deviations(covariance: Float[Array, "p p"]) -> Float[Array, "p"]:
    xp = array_module(covariance)
    with np.errstate(invalid="ignore"):  # nan, as JAX has it
        return as_jax_arrays(xp.sqrt(xp.diagonal(_by_numpy(covariance), axis1=-2, axis2=-1)))


def _by_numpy(values: Numbers) -> Numbers:
    """Return an array of NumPy, with which nothing is compiled, or traced values unchanged."""
    return array_module(values).asarray(values)


def goodness_of_fit(problem: Problem, rows: list[Rows], flat: Numbers) -> GoodnessOfFit:
    """Test the goodness of fit of weighted residuals, of each quantity of each measurement.

    T and <dr^2> are tested separately, so that many points of one do not hide a misfit of the
    other: the p-value is that of the worse one, corrected for the choice. Residuals over estimated
    errors have Student's t distribution, and their chi^2 per degree of freedom has the F
    distribution.

    The covariance is inflated by the reduced chi^2 (at least 1) of the worse one if the p-value is
    below `SIGNIFICANCE`, and always if the errors are unknown.

    Args:
        problem: the measurements and unknowns.
        rows: all residuals, also those of priors.
        flat: the unknowns.
    """
    xp, by_label = array_module(rows, flat), {m.label: m for m in problem.measurements}
    factors: dict[Any, Numbers] = {(row.label, row.kind): row.values for row in rows}
    total, squares, degrees, error_degrees = -flat.shape[0], [], [], []
    for row in rows:
        if row.label is None or not row.measured:
            total = total + row.values.shape[0]
            continue
        m, values = by_label[row.label], row.values
        weights = m.weights.get(row.kind)
        number = values.shape[0] if weights is None else xp.sum(weights > 0)
        own = problem.num_free if row.kind == "temperature" and len(by_label) == 1 else 0
        if (factor := factors.get((row.label, FACTORS.get(row.kind)))) is not None:
            values = xp.concatenate([values, factor])
        total = total + number
        squares.append(xp.sum(values**2))
        degrees.append(xp.maximum(number - own, 1))
        error_degrees.append(m.error_degrees.get(row.kind))
    parts, total = xp.stack(squares), xp.asarray(total)
    chi2 = xp.sum(parts)
    if any(m.curve.temperature_error is None for m in problem.curves):
        return GoodnessOfFit(chi2, total, xp.full((), xp.nan), chi2 / total)
    tested = zip(parts, degrees, error_degrees, strict=True)
    p_value = xp.min(xp.stack([_p_value(xp, *part) for part in tested]))
    if len(parts) > 1:
        p_value = -xp.expm1(len(parts) * xp.log1p(-xp.minimum(p_value, 1 - 1e-12)))
    largest = xp.max(parts / xp.stack(degrees))
    inflation = xp.where(p_value < SIGNIFICANCE, xp.maximum(largest, 1.0), 1.0)
    return GoodnessOfFit(chi2, total, p_value, inflation)


def _p_value(xp: Any, chi2: Numbers, degrees: Numbers, error_degrees: Numbers | None) -> Numbers:
    """Probability of a chi^2 as large; `error_degrees` is None for exact errors."""
    special = jax.scipy.special if xp is jnp else scipy.special
    if error_degrees is None:
        return special.gammaincc(degrees / 2, chi2 / 2)
    share = error_degrees / (error_degrees + chi2)  # of the F distribution
    return special.betainc(error_degrees / 2, degrees / 2, share)


def assemble_fit(
    problem: Problem,
    flat: Numbers,
    linear: tuple[list[Rows], Numbers, dict[str, CoolingCurve]],
    *,
    ends: tuple[Numbers, Numbers],
    iterations: Numbers,
    converged: Numbers,
    resolution: float = 0.0,
) -> Fit:
    """Return a fit from its residuals, linearised where the search ended.

    Args:
        problem: the measurements and unknowns.
        flat: the unknowns at the end of the search.
        linear: the residuals there, their Jacobian, and the computed curves by label.
        ends: unknowns and chi^2 at the ends of all searches.
        iterations, converged: see `Fit`.
        resolution: ratio to the largest singular value of the Jacobian below which others count
            as 0: the parameters have no error in those directions.
    """
    rows, jacobian, computed = linear
    xp, p = array_module(flat, rows), problem.num_free
    # NumPy does not decompose nan; chi^2 and the curve tell of it.
    left, singular, right = xp.linalg.svd(xp.nan_to_num(jacobian), full_matrices=False)
    inverse = 1 / xp.maximum(singular, xp.finfo(flat.dtype).tiny ** 0.5)
    spread = right.T * xp.where(singular < resolution * singular[0], 0.0, inverse)[None]
    gain = -problem.slopes(flat)[:p, None] * (spread @ left.T)[:p]
    ends_of_rows = np.cumsum([row.values.shape[0] for row in rows])[:-1]
    gains = xp.split(gain, ends_of_rows, axis=1)
    jacobians = xp.split(jacobian[:, :p], ends_of_rows, axis=0)
    by_label = {m.label: m for m in problem.measurements}
    goodness = goodness_of_fit(problem, rows, flat)
    covariances: dict[str, Numbers] = {}
    for row, part in zip(rows, gains, strict=True):
        name, part = row.kind, part * _as_row(row.share)
        covariance = part @ part.T
        if row.measured:
            if name == "temperature":
                used = next(m.weights[name] for m in problem.curves if m.label == row.label) > 0
                factor = correlation_factor(neighbour_correlation(row.values, used))
                covariance = factor**2 * covariance
            name, covariance = "measurement", goodness.inflation * covariance
        covariances[name] = covariances.get(name, 0.0) + covariance
    values = problem.values(flat)
    comparisons = {}
    for label, m in by_label.items():
        own = [
            (row, g, j)
            for row, g, j in zip(rows, gains, jacobians, strict=True)
            if row.label == label and row.measured
        ]
        comparisons[label] = Comparison(
            residuals={row.kind: row.values for row, *_ in own},
            weights=m.weights,
            gain=own[0][1] * _as_row(m.weights.get("temperature", 1.0)),
            clock_gain=sum(g * _as_row(row.by_clock) for row, g, _ in own),
            clock_error=m.clock_accuracy + xp.zeros_like(own[0][0].values),
            sensitivity=xp.concatenate([j for *_, j in own]),
            scatter=m.scatter,
            start_time=xp.asarray(values[label].get(START_TIME, 0.0), flat.dtype),
        )
    if MODEL_ERROR not in covariances:  # the clock is not a free parameter
        shifts = [c.clock_gain @ c.clock_error for c in comparisons.values()]
        covariances[MODEL_ERROR] = sum(xp.outer(shift, shift) for shift in shifts)
    gases = {}
    for label, m in by_label.items():
        floats = {name: x for name, x in values[label].items() if name in m.scene.domains}
        gases[label] = with_floats(m.scene, floats)
    data = {label: m.data for label, m in by_label.items()}
    single, sizes = len(by_label) == 1, np.cumsum([u.size for u in problem.unknowns])
    label = next(iter(by_label))
    minima = Minima(
        estimates=xp.stack([problem.estimates(x) for x in ends[0]]),
        chi2=ends[1],
        extrapolation=xp.zeros(p, flat.dtype),
        iterations=iterations,
    )
    arrays = as_jax_arrays(
        {
            "estimate": problem.estimates(flat),
            "covariances": covariances,
            "comparisons": comparisons,
            "goodness": goodness,
            "converged": converged & xp.isfinite(goodness.chi2),
            "minima": minima,
        }
    )
    return Fit(
        names=tuple(u.title for u, end in zip(problem.unknowns, sizes, strict=True) if end <= p),
        model=problem.model,
        gas=gases[label] if single else gases,
        priors=problem.priors,
        data=data[label] if single else data,
        curve=computed.get(label) if single else computed,
        **arrays,
    )


def _as_row(values: Numbers) -> Numbers:
    return values[None] if np.ndim(values) else values
