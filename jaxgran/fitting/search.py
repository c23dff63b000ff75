"""The search for the maximum of a likelihood by Newton's method, and the results of all searches.

The alternative is gradient descent (`jaxgran.fitting.descent`).
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxgran.fitting.evaluation import Evaluation
from jaxgran.fitting.problem import Problem

LAST_STEP = 0.01
"""A search ends where the next Newton step is shorter than this, in standard errors."""

CONVERGED_STEP = 0.03
"""A search has converged if the next Newton step is shorter than this, in standard errors."""

STALLED_STEP = 0.3
"""A search that has stalled has converged if the next Newton step is shorter than this, in standard
errors. It stalls at a kink of -2 ln L, where a measured point passes t0, or by a learning rate."""

MAX_STALLED = 6
"""A search has stalled after this number of successive steps that hardly lower -2 ln L."""

MIN_FALL_OF_STEP = 1e-4
"""A step hardly lowers -2 ln L if it lowers it by less than this, which may be round-off."""

NEGLIGIBLE_STEP = 1e-4
"""After a search a further Newton step is tried if it is longer than this, in standard errors, and
shorter than `CONVERGED_STEP`."""

FIRST_RADIUS = 1.0
"""Radius at first of the trust region, in the unconstrained parameters: a factor e of a positive
one."""

MAX_DISTANCE = {"dissipative_constant": 7.0}
"""Largest change of an unconstrained parameter in a search. It is a factor 1000 of A: far beyond,
impacts lose all energy, and T does not depend on A."""

MAX_DISTANCE_OF_OTHERS = 25.0
"""Largest change of an unconstrained parameter that `MAX_DISTANCE` does not list: a factor 7e10 of
a positive one."""

MULTIMODAL_PARAMETER = "tangential_restitution"
"""Parameter in which the likelihood has several maxima: on both sides of the beta_t at which
rotation takes most energy."""

MULTIMODAL_STARTS = (-0.6, 0.0, 0.6)
"""Further values of it from which a search starts."""


class Trace(NamedTuple):
    """Course of a gradient descent.

    Attributes:
        loss: -2 ln L at each step.
        parameters: free parameters at each step, SI.
        reason: why it ended.
    """

    loss: Float[np.ndarray, "steps"]
    parameters: Float[np.ndarray, "steps p"]
    reason: str


class Minimum(NamedTuple):
    """End of a search.

    Attributes:
        flat: the unknowns, in their unconstrained scale.
        value: -2 ln L there; inf where it cannot be computed.
        steps: number of steps.
        converged: whether the search reached its tolerance.
        trace: course of a gradient descent; None for other searches.
    """

    flat: Float[np.ndarray, "unknowns"]
    value: float
    steps: int
    converged: bool
    trace: Trace | None = None


class Solution(NamedTuple):
    """Where the searches of a problem end.

    Attributes:
        problem: of a fit.
        best: the deepest minimum.
        minima: all minima.
    """

    problem: Problem
    best: Minimum
    minima: list[Minimum]

    def evaluate(self) -> Evaluation:
        """Return -2 ln L at the deepest minimum."""
        return self.problem.evaluate(self.best.flat)


Minimiser = Callable[[Problem, np.ndarray, int], Minimum]
"""A search of a problem from a first guess, with a maximum number of steps."""


class NewtonStep(NamedTuple):
    """A step of Newton's method.

    Attributes:
        change: of the unknowns, in their unconstrained scale.
        length: in standard errors.
    """

    change: Float[np.ndarray, "unknowns"]
    length: float


def newton_step(found: Evaluation) -> NewtonStep:
    """Return the next step of Newton's method.

    Second derivatives are replaced by their expectation (Fisher's scoring), which is positive.
    """
    change = -np.linalg.pinv(found.information, hermitian=True) @ found.gradient / 2
    return NewtonStep(change, float(np.sqrt(max(-found.gradient @ change / 2, 0.0))))


@dataclass(frozen=True)
class Objective:
    """-2 ln L inside a region.

    Outside, it takes the value at the nearest point of the region, so its slope there is 0.

    Attributes:
        problem: of a fit.
        origin: centre of the region, in which each unknown is at most `MAX_DISTANCE` away from it.
    """

    problem: Problem
    origin: Float[np.ndarray, "unknowns"]

    def nearest(self, flat: Float[np.ndarray, "unknowns"]) -> Float[np.ndarray, "unknowns"]:
        """Return the nearest unknowns in this region."""
        limits = [MAX_DISTANCE.get(u.name, MAX_DISTANCE_OF_OTHERS) for u in self.problem.unknowns]
        farthest = self.problem.repeat_per_element(limits)
        return np.clip(flat, self.origin - farthest, self.origin + farthest)

    def evaluate(self, flat: np.ndarray) -> Evaluation:
        """Return -2 ln L and its derivatives at the nearest point of the region."""
        near = self.nearest(flat)
        found = self.problem.evaluate(near)
        outside = flat != near
        if not np.any(outside):
            return found
        inside = np.outer(~outside, ~outside)
        information = np.where(inside, found.information, np.diag(outside.astype(float)))
        return found._replace(
            gradient=np.where(outside, 0.0, found.gradient), information=information
        )

    def value(self, flat: np.ndarray) -> float:
        """Return -2 ln L; inf where it cannot be computed."""
        found = self.evaluate(flat)
        return found.value if found.is_finite else np.inf

    def gradient(self, flat: np.ndarray) -> np.ndarray:
        """Return its first derivatives."""
        return np.nan_to_num(self.evaluate(flat).gradient)

    def hessian(self, flat: np.ndarray) -> np.ndarray:
        """Return its expected second derivatives."""
        found = self.evaluate(flat)
        return 2 * found.information if found.is_finite else np.eye(flat.size)

    def newton_length(self, flat: np.ndarray) -> float:
        """Return the length of the next Newton step, in standard errors."""
        return newton_step(self.evaluate(flat)).length


@dataclass
class _StoppingRule:
    """Ends a search after a step if the next one is short or -2 ln L no longer falls.

    It is called after each step: scipy ends a search where its callback raises StopIteration.

    Attributes:
        objective: of the search.
        tolerance: length of a short step, in standard errors.
        last: -2 ln L after the step before.
        num_stalled: number of steps in succession that hardly lowered it.
    """

    objective: Objective
    tolerance: float
    last: float = np.inf
    num_stalled: int = 0

    @property
    def has_stalled(self) -> bool:
        """Whether -2 ln L no longer falls."""
        return self.num_stalled >= MAX_STALLED

    def __call__(self, flat: np.ndarray) -> None:
        value = self.objective.value(flat)
        has_fallen = value <= self.last - MIN_FALL_OF_STEP
        self.num_stalled = 0 if has_fallen else self.num_stalled + 1
        self.last = value
        if self.objective.newton_length(flat) < self.tolerance or self.has_stalled:
            raise StopIteration


def minimise(
    problem: Problem,
    first: np.ndarray,
    max_steps: int,
    tolerance: float = LAST_STEP,
    origin: np.ndarray | None = None,
) -> Minimum:
    """Minimise -2 ln L from a first guess by Newton's method (`newton_step`) in a trust region.

    Args:
        problem: of a fit.
        first: the first guess, in the unconstrained scale.
        max_steps: maximum number of steps.
        tolerance: length of a Newton step, in standard errors, at which the search ends.
        origin: to whose region the unknowns are moved (`Objective`); by default the first guess.
    """
    objective = Objective(problem, first if origin is None else origin)
    first = objective.nearest(first)
    if not np.isfinite(objective.value(first)):
        return Minimum(first, np.inf, steps=0, converged=False)
    if objective.newton_length(first) < tolerance:
        return Minimum(first, objective.value(first), steps=0, converged=True)
    rule = _StoppingRule(objective, tolerance)
    solution = scipy.optimize.minimize(
        objective.value,
        first,
        jac=objective.gradient,
        hess=objective.hessian,
        method="trust-exact",
        callback=rule,
        options={
            "gtol": 0.0,
            "maxiter": max_steps,
            "initial_trust_radius": FIRST_RADIUS,
            "max_trust_radius": 2 * FIRST_RADIUS,
        },
    )
    end = objective.nearest(np.asarray(solution.x))
    step = newton_step(problem.evaluate(end))
    limit = max(tolerance, STALLED_STEP if rule.has_stalled else CONVERGED_STEP)
    if NEGLIGIBLE_STEP < step.length < CONVERGED_STEP:
        end = _with_last_step(objective, end, step)
    return Minimum(end, objective.value(end), int(solution.nit), step.length < limit)


def _with_last_step(objective: Objective, end: np.ndarray, step: NewtonStep) -> np.ndarray:
    """Return the unknowns after a further step, or as they are if it raises -2 ln L."""
    further = objective.nearest(end + step.change)
    is_no_higher = objective.value(further) < objective.value(end) + MIN_FALL_OF_STEP
    return further if is_no_higher else end


def minima_from_starts(
    problem: Problem, first: np.ndarray, max_steps: int, search: Minimiser = minimise
) -> list[Minimum]:
    """Search from a first guess and, if beta_t is free, also with other values of beta_t.

    Of these a search that raises RuntimeError, as a descent that diverges, is left out.
    """
    minima = [search(problem, first, max_steps)]
    domains = {u.name: u.domain for u in problem.unknowns}
    if MULTIMODAL_PARAMETER not in domains:
        return minima
    names = problem.repeat_per_element([u.name for u in problem.unknowns])
    for value in domains[MULTIMODAL_PARAMETER].to_free(np.asarray(MULTIMODAL_STARTS)):
        start = np.where(names == MULTIMODAL_PARAMETER, value, first)
        with contextlib.suppress(RuntimeError):
            minima.append(search(problem, start, max_steps))
    return minima


def deepest(minima: list[Minimum]) -> Minimum:
    """Return the deepest minimum, with the number of steps of all searches."""
    best = min(minima, key=lambda minimum: minimum.value)
    return best._replace(steps=sum(minimum.steps for minimum in minima))
