"""Least squares over one or many measurements, and fits of deterministic models by it.

`Problem` holds the measurements and the unknowns, and returns residuals with their derivatives.
`search` minimises their squares: on the host by scipy around the compiled program of
`jaxgran.models.linearise`; under a transformation, or with a solver that the user gives, by
optimistix.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy
from jaxtyping import Array, Float

from jaxgran._utils.tracing import any_traced, array_module
from jaxgran._utils.validation import Domain
from jaxgran.fitting.parameters import (
    SHARED,
    START_TIME,
    Numbers,
    Priors,
    Unknown,
    domain_of,
    extra_parameters,
    halving_time,
    prior_residuals,
)
from jaxgran.fitting.residuals import CLOCK, CLOCK_TREND, DropTestRows, Measurement, Rows
from jaxgran.models.base import AbstractModel
from jaxgran.scene.gas import Gas

CONVERGED_STEP = 0.01
"""Length of a Gauss-Newton step, in standard errors, below which a search has converged."""

TOLERANCE = 1e-8
"""Relative tolerance of a search, for the parameters and the sum of squares."""

MULTIMODAL_PARAMETER, MULTIMODAL_STARTS = "tangential_restitution", (-0.6, 0.0, 0.6)
"""Parameter in which chi^2 has several minima, and its start values: chi^2 has minima on both sides
of the beta_t at which rotation takes most energy."""

MAX_DISTANCE = 25.0
"""Largest change of an unconstrained parameter in a search: a factor 7e10 of a positive one."""


class Trace(NamedTuple):
    """Course of a gradient descent.

    Attributes:
        loss: chi^2 at each step, with the residuals of priors.
        parameters: free parameters at each step, SI, shape (steps, p).
        reason: why it ended.
    """

    loss: Float[np.ndarray, "steps"]
    parameters: Float[np.ndarray, "steps p"]
    reason: str


Minimum = tuple[Numbers, Numbers, Numbers]
"""Parameters at the end of a search, the number of iterations, and True if it converged."""


@dataclass(frozen=True)
class Problem:
    """Measurements, a deterministic model, and the unknowns that are varied.

    Attributes:
        measurements: curves and drop tests.
        model: computes the curves.
        unknowns: the free parameters, then those that vary because of a prior, then nuisance
            parameters.
        num_free: number of elements of the free parameters.
        priors: of shared parameters (`SHARED`) and of those of one measurement, by its label.
        fixed: SI values of further parameters, by label and name.
        tolerance: factor of the model's tolerance.
    """

    measurements: tuple[Measurement | DropTestRows, ...]
    model: AbstractModel
    unknowns: tuple[Unknown, ...]
    num_free: int
    priors: dict[str, Priors]
    fixed: dict[str, dict[str, Numbers]]
    tolerance: float = 1.0
    _last: dict[bytes, Any] = field(init=False, default_factory=dict, compare=False)

    @classmethod
    def of(
        cls,
        measurements: tuple[Measurement | DropTestRows, ...],
        model: AbstractModel,
        free: tuple[str, ...],
        separate: tuple[str, ...],
        priors: dict[str, Priors],
        *,
        clock_is_free: bool,
    ) -> "Problem":
        """Return the problem of `jaxgran.fit`.

        Args:
            measurements, model, priors: see the class.
            free: names of shared free parameters.
            separate: names of free parameters that each curve has separately.
            clock_is_free: whether the error of the model's clock is a nuisance parameter.
        """
        curves = [m for m in measurements if isinstance(m, Measurement)]
        gas = measurements[0].gas

        def unknown(name: str, label: str | None, gas: Gas) -> Unknown:
            domain = domain_of(gas, name)
            if name != START_TIME:
                return Unknown(name, label, jnp.shape(gas.value(name)), domain)
            unit = halving_time(next(m.curve for m in curves if label in (None, m.label)))
            return Unknown(name, label, (), domain, unit)

        unknowns = [unknown(name, None, gas) for name in free]
        unknowns += [unknown(name, m.label, m.gas) for name in separate for m in curves]
        num_free = sum(u.size for u in unknowns)
        by_label = {SHARED: gas} | {m.label: m.gas for m in measurements}
        for label, some in priors.items():
            known = tuple(u.name for u in unknowns if u.label in (None, label))
            extra = extra_parameters(some, known)
            unknowns += [unknown(name, label or None, by_label[label]) for name in extra]
        for m in curves:
            names = ((CLOCK, CLOCK_TREND) if clock_is_free else ()) + m.nuisances
            unknowns += [Unknown(name, m.label, (), Domain()) for name in names]
        return cls(measurements, model, tuple(unknowns), num_free, priors, {})

    @cached_property
    def _compiled_model(self) -> AbstractModel:
        return self.model.for_fits(*(m.scene for m in self.measurements))

    @property
    def curves(self) -> tuple[Measurement, ...]:
        """The measured curves."""
        return tuple(m for m in self.measurements if isinstance(m, Measurement))

    @property
    def is_traced(self) -> bool:
        """True under a transformation of the measurements or the priors."""
        known = [(m.data, m.gas) for m in self.measurements]
        return any_traced(known, self.priors)

    def check_points(self) -> None:
        """Raise ValueError unless curves have more points with a weight than free parameters."""
        points = sum(m.num_points for m in self.measurements)
        if self.curves and points <= self.num_free:
            raise ValueError(
                f"{points} points (those with an error of 0 not counted) cannot determine "
                f"{self.num_free} parameters; free fewer of them"
            )

    def flat(self, values: dict[str, dict[str, Numbers]]) -> Numbers:
        """Return SI values, by label and name, in their unconstrained scale, in one array.

        The values are those of all floats of the gases, and of `START_TIME` where it is an unknown;
        nuisance parameters are 0.
        """
        xp = jnp if self.is_traced else array_module(values)
        zero = xp.zeros((), xp.asarray(values[self.measurements[0].label]["temperature"]).dtype)
        parts = [xp.zeros(0, zero.dtype)]
        for u in self.unknowns:
            label = self.measurements[0].label if u.label is None else u.label
            value = xp.asarray(values[label].get(u.name, zero))
            parts.append(xp.ravel(u.domain.to_free(value) / u.unit))
        return xp.concatenate(parts)

    def parts(self, flat: Numbers) -> list[tuple[Unknown, Numbers]]:
        """Return each unknown with its SI value."""
        pairs, begin = [], 0
        for u in self.unknowns:
            free = flat[begin : begin + u.size].reshape(u.shape)
            begin += u.size
            pairs.append((u, u.domain.from_free(free * u.unit)))
        return pairs

    def estimates(self, flat: Numbers) -> Numbers:
        """Return SI values of the free parameters in one array."""
        xp = array_module(flat)
        values = [xp.ravel(value) for _, value in self.parts(flat)]
        return xp.concatenate([flat[:0], *values])[: self.num_free]

    def slopes(self, flat: Numbers) -> Numbers:
        """Return the derivative of each SI value in its unconstrained parameter."""
        xp = array_module(flat)
        slopes = [xp.ravel(u.domain.slope(value)) * u.unit for u, value in self.parts(flat)]
        return xp.concatenate([flat[:0], *slopes])

    def values(self, flat: Numbers) -> dict[str, dict[str, Numbers]]:
        """Return SI values of all parameters that are varied, by label and name."""
        values = {m.label: dict(self.fixed.get(m.label, {})) for m in self.measurements}
        for u, value in self.parts(flat):
            for label in values if u.label is None else (u.label,):
                values[label][u.name] = value
        return values

    def evaluate(
        self, flat: Numbers
    ) -> tuple[list[Rows], Numbers, Numbers, dict[str, dict[str, Numbers]]]:
        """Return the residuals by kind, all in one array, their Jacobian, and the curves.

        The curves are dictionaries of their fields, by label.
        """
        if not isinstance(flat, np.ndarray):
            return self._evaluate(flat)
        if (key := flat.tobytes()) not in self._last:
            self._last.clear()
            self._last[key] = self._evaluate(flat)
        return self._last[key]

    def _evaluate(self, flat: Numbers) -> tuple[list[Rows], Numbers, Numbers, dict]:
        values, rows, computed = self.values(flat), [], {}
        model = self._compiled_model
        for m in self.measurements:
            more, curve = m.evaluate(model, values[m.label], tolerance=self.tolerance)
            rows += more
            if curve is not None:
                computed[m.label] = curve
        for label, priors in self.priors.items():
            at = label or self.measurements[0].label
            gas = next(m.gas for m in self.measurements if m.label == at)
            parts = prior_residuals(priors, gas, values[at])
            rows += [Rows(name, label or None, *row, of_prior=True) for name, row in parts.items()]
        xp = array_module(flat, rows)
        jacobian = self._jacobian(xp, flat, rows)
        return rows, xp.concatenate([row.values for row in rows]), jacobian, computed

    def _jacobian(self, xp: Any, flat: Numbers, rows: list[Rows]) -> Numbers:
        def slope(row: Rows, u: Unknown) -> Numbers:
            applies = row.label is None or u.label is None or row.label == u.label
            if applies and u.name in row.slopes:
                return row.slopes[u.name]
            return xp.zeros((row.values.shape[0], u.size), flat.dtype)

        blocks = [[slope(row, u) for u in self.unknowns] for row in rows]
        return xp.block(blocks) * self.slopes(flat)[None]

    def with_scatter_as_error(self, flat: Numbers) -> "Problem":
        """Return the problem with the scatter of ln T as the error of its curve, without errors.

        A curve without errors is the only measurement of a fit.
        """
        (m,), (rows, *_) = self.curves, self.evaluate(flat)
        return replace(self, measurements=(m.with_scatter_as_error(rows, self.num_free),))


def is_converged(residuals: Numbers, jacobian: Numbers) -> Numbers:
    """Return True if the next Gauss-Newton step is shorter than `CONVERGED_STEP` standard errors.

    The components of the step along the right singular vectors of the Jacobian, in standard errors
    for residuals of unit variance, are those of the residuals along the left singular vectors. The
    variance is estimated from the residuals. Singular values at the level of round-off are ignored.
    """
    xp = array_module(residuals, jacobian)
    left, singular, _ = xp.linalg.svd(jacobian, full_matrices=False)
    known = singular > xp.finfo(singular.dtype).eps ** 0.5 * singular[0]
    step = xp.max(xp.where(known, xp.abs(residuals @ left), 0.0))
    return step < CONVERGED_STEP * xp.sqrt(xp.mean(residuals**2))


def is_transformation(solver: Any) -> bool:
    """Tell whether a solver is a gradient transformation of optax."""
    return all(callable(getattr(solver, name, None)) for name in ("init", "update"))


def search(
    problem: Problem,
    first: Numbers,
    max_steps: int,
    solver: Any = None,
    tolerance: float = TOLERANCE,
) -> Minimum:
    """Minimise the sum of squares from a first guess.

    Args:
        problem: of a fit.
        first: the first guess, in the unconstrained scale.
        max_steps: maximum number of steps.
        solver: of optimistix or optax, None for Levenberg-Marquardt; or a function, like this one,
            of problem, first and max_steps.
        tolerance: relative tolerance of the parameters and of the sum of squares.
    """
    if callable(solver):
        minimum: Any = solver(problem, np.asarray(first), max_steps)
        return minimum
    if solver is None and not (problem.is_traced or any_traced(first)):
        return _search_on_host(problem, np.asarray(first), max_steps, tolerance)
    return _search_compiled(problem, jnp.asarray(first), max_steps, solver)


def _search_on_host(
    problem: Problem, first: np.ndarray, max_steps: int, tolerance: float
) -> Minimum:
    def at(flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if np.any(np.abs(flat - first) > MAX_DISTANCE):
            return np.full(size, np.inf), np.zeros((size, first.size))
        _, residuals, jacobian, _ = problem.evaluate(flat.astype(first.dtype))
        return residuals.astype(float), jacobian.astype(float)

    size = problem.evaluate(first)[1].size
    if not all(np.all(np.isfinite(x)) for x in at(first.astype(float))):
        return first, np.asarray(0), np.asarray(False)
    tolerance = max(tolerance, float(np.finfo(first.dtype).eps))
    solution = scipy.optimize.least_squares(
        lambda x: at(x)[0],
        first.astype(float),
        jac=lambda x: at(x)[1],  # type: ignore
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance**1.5,
        max_nfev=max_steps,
    )
    residuals, jacobian = at(solution.x)
    converged = solution.status > 0 or bool(is_converged(residuals, jacobian))
    return solution.x.astype(first.dtype), np.asarray(solution.njev), np.asarray(converged)


def _search_compiled(problem: Problem, first: Array, max_steps: int, solver: Any) -> Minimum:
    @jax.custom_jvp
    def residuals(flat: Array) -> Array:
        return problem.evaluate(flat)[1]

    @residuals.defjvp
    def residuals_jvp(primals, tangents):
        _, value, jacobian, _ = problem.evaluate(primals[0])
        return value, jacobian @ tangents[0]

    tolerance = max(TOLERANCE, float(jnp.finfo(first.dtype).eps))
    options: dict[str, Any] = {"max_steps": max_steps, "throw": False}
    if is_transformation(solver):
        solver = optx.OptaxMinimiser(solver, rtol=tolerance, atol=tolerance)
    if isinstance(solver, optx.AbstractMinimiser):
        _, _, jacobian, _ = problem.evaluate(first)
        scale = jnp.sum(jacobian**2)  # minimisers start with a Hessian of 1
        solution = optx.minimise(
            lambda flat, _: 0.5 * jnp.sum(residuals(flat) ** 2) / scale, solver, first, **options
        )
    else:
        if solver is None:
            solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)
            solver = eqx.tree_at(lambda solver: solver.search, solver, _TrustRegion())
        solution = optx.least_squares(lambda flat, _: residuals(flat), solver, first, **options)
    converged = solution.result == optx.RESULTS.successful
    return jnp.asarray(solution.value), solution.stats["num_steps"], converged


class _TrustRegion(optx.ClassicalTrustRegion):
    """Trust region that stops once the Gauss-Newton step is below `CONVERGED_STEP`.

    That step is accepted and the next one has length 0, which ends the search. Such short steps
    change chi^2 by less than its round-off: the classical rule would reject half of them, and the
    search would not reach its tolerance.
    """

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        step_size, accept, *rest = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        assert isinstance(f_info, optx.FunctionInfo.ResidualJac)
        ended = is_converged(f_info.residual, f_info.jac.as_matrix())
        return jnp.where(ended, 0.0, step_size), accept | ended, *rest


def best_of_starts(
    problem: Problem, first: Numbers, max_steps: int, solver: Any = None
) -> tuple[Minimum, tuple[Numbers, Numbers]]:
    """Search from a first guess and, if beta_t is free, also with other values of beta_t.

    Returns the deepest minimum, and all with their chi^2, which is infinite where it is nan. The
    steps are those of all searches.
    """
    xp = jnp if problem.is_traced else array_module(first)
    names = np.repeat([u.name for u in problem.unknowns], [u.size for u in problem.unknowns])
    starts = [first]
    for domain in [u.domain for u in problem.unknowns if u.name == MULTIMODAL_PARAMETER][:1]:
        values = domain.to_free(np.asarray(MULTIMODAL_STARTS)).astype(first.dtype)
        starts += [xp.where(names == MULTIMODAL_PARAMETER, x, first) for x in values]

    def search_from(start: Numbers) -> tuple[Minimum, Numbers]:
        minimum = search(problem, start, max_steps, solver)
        chi2 = xp.sum(problem.evaluate(minimum[0])[1] ** 2)
        return minimum, xp.where(xp.isnan(chi2), xp.inf, chi2)

    if xp is jnp:
        (flats, steps, converged), chi2 = jax.lax.map(search_from, xp.stack(starts))
    else:
        ends = [search_from(start) for start in starts]
        (flats, steps, converged), chi2 = jax.tree.map(lambda *x: np.stack(x), *ends)
    best = xp.argmin(chi2)
    return (flats[best], xp.sum(steps), converged[best]), (flats, chi2)
