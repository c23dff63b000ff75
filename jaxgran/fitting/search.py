"""The search for the maximum of a likelihood by Newton's method, and the results of all searches.

The alternative is gradient descent (`jaxgran.fitting.descent`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxgran.fitting.problem import Evaluation, Problem

LAST_STEP = 0.01
"""Length of a Newton step, in standard errors, below which a search ends."""

CONVERGED_STEP = 0.03
"""Length of the last Newton step, in standard errors, up to which a search has converged."""

STALLED_STEP = 0.3
"""The same of a search in which no step lowers -2 ln L: it stalls at a kink, where a measured point
passes t0."""

NEGLIGIBLE_STEP = 1e-4
"""Length of a Newton step, in standard errors, that is not taken after the last one."""

MAX_STALLED = 6
"""Number of steps in succession that lower -2 ln L by less than `MIN_FALL_OF_STEP`, after which a
search ends."""

MIN_FALL_OF_STEP = 1e-4
"""Largest fall of -2 ln L that counts as round-off."""

MAX_STEP = 1.0
"""Length of the first step of the unconstrained parameters: a factor e of a positive one."""

MAX_DISTANCE = {"dissipative_constant": 7.0}
"""Largest change of an unconstrained parameter in a search: a factor 1000 of A, far beyond which
impacts lose all energy and T does not depend on it."""

MAX_DISTANCE_OF_OTHERS = 25.0
"""The same of others: a factor 7e10 of a positive one."""

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
    """-2 ln L in the region of a search; outside it has its value at the nearest unknowns.

    Attributes:
        problem: of a fit.
        origin: centre of the region, in which each unknown is at most `MAX_DISTANCE` away from it.
    """

    problem: Problem
    origin: Float[np.ndarray, "unknowns"]

    def nearest(self, flat: Float[np.ndarray, "unknowns"]) -> Float[np.ndarray, "unknowns"]:
        """Return the nearest unknowns in this region."""
        limits = [MAX_DISTANCE.get(u.name, MAX_DISTANCE_OF_OTHERS) for u in self.problem.unknowns]
        farthest = self.problem.per_element(limits)
        return np.clip(flat, self.origin - farthest, self.origin + farthest)

    def evaluate(self, flat: np.ndarray) -> Evaluation:
        """Return -2 ln L at the nearest unknowns; it does not depend on those outside."""
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
class _Ending:
    """Ends a search after a step, where the next one is short or -2 ln L no longer falls.

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
    ending = _Ending(objective, tolerance)
    solution = scipy.optimize.minimize(
        objective.value,
        first,
        jac=objective.gradient,
        hess=objective.hessian,
        method="trust-exact",
        callback=ending,
        options={
            "gtol": 0.0,
            "maxiter": max_steps,
            "initial_trust_radius": MAX_STEP,
            "max_trust_radius": 2 * MAX_STEP,
        },
    )
    end = objective.nearest(np.asarray(solution.x))
    value = objective.value(end)
    step = newton_step(problem.evaluate(end))
    limit = max(tolerance, STALLED_STEP if ending.has_stalled else CONVERGED_STEP)
    if NEGLIGIBLE_STEP < step.length < CONVERGED_STEP:
        further = objective.nearest(end + step.change)
        if objective.value(further) < value + MIN_FALL_OF_STEP:
            end = further
            value = objective.value(further)
    return Minimum(end, value, int(solution.nit), step.length < limit)


def minima_from_starts(
    problem: Problem, first: np.ndarray, max_steps: int, search: Minimiser = minimise
) -> list[Minimum]:
    """Search from a first guess and, if beta_t is free, also with other values of beta_t."""
    starts = [first]
    domains = {u.name: u.domain for u in problem.unknowns}
    if MULTIMODAL_PARAMETER in domains:
        names = problem.per_element([u.name for u in problem.unknowns])
        values = domains[MULTIMODAL_PARAMETER].to_free(np.asarray(MULTIMODAL_STARTS))
        starts += [np.where(names == MULTIMODAL_PARAMETER, x, first) for x in values]
    return [search(problem, start, max_steps) for start in starts]


def deepest(minima: list[Minimum]) -> Minimum:
    """Return the deepest minimum, with the number of steps of all searches."""
    best = min(minima, key=lambda minimum: minimum.value)
    return best._replace(steps=sum(minimum.steps for minimum in minima))
