"""The searches for the maximum of a likelihood: Newton's method, and gradient descent by optax."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Float
from tqdm import tqdm

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

MAX_GROWTH = 10.0
"""A descent diverges where -2 ln L exceeds its first value by this number for each residual, and
twice this value."""

WINDOW = 20
"""Number of steps whose mean loss is compared with the mean of as many before; a descent with
noise ends if the two differ by less than it."""

PATIENCE = 50
"""Number of steps after which a descent without noise ends if they have hardly lowered the loss."""

MIN_FALL = 0.01
"""Least fall of the loss in `PATIENCE` steps."""


class Minimum(NamedTuple):
    """End of a search.

    Attributes:
        flat: the unknowns, in their unconstrained scale.
        value: -2 ln L there.
        steps: number of steps.
        converged: whether the search reached its tolerance.
        trace: course of a gradient descent; None for other searches.
    """

    flat: Float[np.ndarray, "unknowns"]
    value: float
    steps: int
    converged: bool
    trace: "Trace | None" = None


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


class Course(NamedTuple):
    """What a gradient descent passed.

    Attributes:
        flats: the unknowns at each step.
        losses: -2 ln L at each step, inf where it is not a number.
        converged: whether it ended at a minimum.
        diverged: whether the loss grew, or ceased to be finite.
        trace: for the user.
    """

    flats: Float[np.ndarray, "steps unknowns"]
    losses: Float[np.ndarray, "steps"]
    converged: bool
    diverged: bool
    trace: Trace


def newton_step(found: Evaluation) -> tuple[np.ndarray, float]:
    """Return the next step of Newton's method, and its length in standard errors."""
    step = -np.linalg.pinv(found.information, hermitian=True) @ found.gradient / 2
    return step, float(np.sqrt(max(-found.gradient @ step / 2, 0.0)))


def minimise(
    problem: Problem,
    first: np.ndarray,
    max_steps: int,
    tolerance: float = LAST_STEP,
    origin: np.ndarray | None = None,
) -> Minimum:
    """Minimise -2 ln L from a first guess by Newton's method in a trust region.

    Second derivatives are replaced by their expectation (Fisher's scoring), which is positive.

    Args:
        problem: of a fit.
        first: the first guess, in the unconstrained scale.
        max_steps: maximum number of steps.
        tolerance: length of a Newton step, in standard errors, at which the search ends.
        origin: to whose region the unknowns are moved (`nearest`); by default the first guess.
    """
    objective = _Objective(problem, first if origin is None else origin)
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
    limit = max(tolerance, STALLED_STEP if ending.has_stalled else CONVERGED_STEP)
    step, length = newton_step(problem.evaluate(end))
    if NEGLIGIBLE_STEP < length < CONVERGED_STEP:
        further = objective.nearest(end + step)
        if objective.value(further) < value + MIN_FALL_OF_STEP:
            end = further
            value = objective.value(further)
    return Minimum(end, value, int(solution.nit), length < limit)


def nearest(
    problem: Problem, flat: Float[np.ndarray, "unknowns"], origin: Float[np.ndarray, "unknowns"]
) -> Float[np.ndarray, "unknowns"]:
    """Return the nearest unknowns in the region of a search: `MAX_DISTANCE` around its origin."""
    limits = [MAX_DISTANCE.get(u.name, MAX_DISTANCE_OF_OTHERS) for u in problem.unknowns]
    farthest = np.repeat(limits, [u.size for u in problem.unknowns])
    return np.clip(flat, origin - farthest, origin + farthest)


@dataclass(frozen=True)
class _Objective:
    """-2 ln L as a function of unknowns that are moved to the region around an origin."""

    problem: Problem
    origin: Float[np.ndarray, "unknowns"]

    def nearest(self, flat: np.ndarray) -> np.ndarray:
        """Return the nearest unknowns in this region."""
        return nearest(self.problem, flat, self.origin)

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
        return newton_step(self.evaluate(flat))[1]


@dataclass
class _Ending:
    """Ends a search after a step, where the next one is short or -2 ln L no longer falls.

    Attributes:
        objective: of the search.
        tolerance: length of a short step, in standard errors.
        last: -2 ln L after the step before.
        num_stalled: number of steps in succession that hardly lowered it.
    """

    objective: _Objective
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


def best_of_starts(
    problem: Problem, first: np.ndarray, max_steps: int, search: Callable[..., Minimum] = minimise
) -> tuple[Minimum, list[Minimum]]:
    """Search from a first guess and, if beta_t is free, also with other values of beta_t.

    Returns the deepest minimum, with the number of steps of all searches, and all minima.
    """
    starts = [first]
    names = np.repeat([u.name for u in problem.unknowns], [u.size for u in problem.unknowns])
    domains = {u.name: u.domain for u in problem.unknowns}
    if MULTIMODAL_PARAMETER in domains:
        values = domains[MULTIMODAL_PARAMETER].to_free(np.asarray(MULTIMODAL_STARTS))
        starts += [np.where(names == MULTIMODAL_PARAMETER, x, first) for x in values]
    found = [search(problem, start, max_steps) for start in starts]
    best = min(found, key=lambda minimum: minimum.value)
    return best._replace(steps=sum(minimum.steps for minimum in found)), found


def is_transformation(solver: Any) -> bool:
    """Tell whether a solver is a gradient transformation of optax."""
    return all(callable(getattr(solver, name, None)) for name in ("init", "update"))


class Loss(NamedTuple):
    """What a gradient descent lowers, at one step.

    Attributes:
        value: -2 ln L.
        gradient: its derivatives.
        at_minimum: whether the next Newton step is short.
    """

    value: Any
    gradient: Any
    at_minimum: bool = False


@dataclass(frozen=True)
class Descent:
    """A gradient descent.

    Attributes:
        solver: gradient transformation of optax.
        progress: show a progress bar.
        throw: raise RuntimeError for a descent that diverges.
    """

    solver: Any
    progress: bool
    throw: bool

    def __call__(self, problem: Problem, first: np.ndarray, max_steps: int) -> Minimum:
        """Minimise -2 ln L of a model without noise: a search as `minimise`."""
        objective = _Objective(problem, first)

        def loss(flat: np.ndarray, step: int) -> Loss:
            found = objective.evaluate(flat)
            if not found.is_finite:
                return Loss(np.inf, np.zeros_like(flat))
            return Loss(found.value, found.gradient, newton_step(found)[1] < LAST_STEP)

        size = sum(row.values.size for row in problem.evaluate(first).rows)
        course = self.descend(loss, first, max_steps, size, problem.estimates, noisy=False)
        best = int(np.argmin(course.losses))
        return Minimum(
            course.flats[best],
            float(course.losses[best]),
            len(course.flats),
            course.converged,
            course.trace,
        )

    def descend(
        self,
        loss_at: Callable[[np.ndarray, int], Loss],
        first: np.ndarray,
        max_steps: int,
        size: int,
        estimates: Callable[[np.ndarray], np.ndarray],
        *,
        noisy: bool,
    ) -> Course:
        """Descend until the loss ceases to fall.

        Args:
            loss_at: the loss at some unknowns, at a step.
            first: the first guess.
            max_steps: maximum number of steps.
            size: number of residuals.
            estimates: SI values of the free parameters at some unknowns.
            noisy: whether the loss has noise.
        """
        update = self._compiled_update()
        flat = jnp.asarray(first)
        state = self._transformation.init(flat)
        losses: list[float] = []
        flats = []
        converged = False
        divergence = ""
        reason = f"the largest number of steps, {max_steps}, was reached"
        hidden = None if self.progress else True  # None hides the bar where there is no terminal
        with tqdm(total=max_steps, disable=hidden, desc="fit", unit="step") as bar:
            for step in range(max_steps):
                loss = loss_at(np.asarray(flat), step)
                losses.append(float(loss.value))
                flats.append(np.asarray(flat))
                bar.update()
                bar.set_postfix_str(f"-2 ln L {losses[-1]:.4g}")
                divergence = _divergence(losses, loss.gradient, size)
                converged = not divergence and (loss.at_minimum or _has_ceased(losses, noisy))
                if converged:
                    reason = _reason_to_end(loss.at_minimum, noisy)
                if divergence or converged:
                    break
                changes, state = update(
                    jnp.asarray(loss.gradient), state, flat, jnp.asarray(loss.value)
                )
                flat = flat + changes
        reason = divergence or reason
        trace = Trace(np.asarray(losses), np.stack([estimates(x) for x in flats]), reason)
        if divergence and self.throw:
            raise RuntimeError(f"{reason}; throw=False returns the best step so far")
        numbers = np.where(np.isnan(losses), np.inf, losses)
        return Course(np.stack(flats), numbers, converged, bool(divergence), trace)

    @cached_property
    def _transformation(self) -> Any:
        import optax  # the user has imported it to make the solver

        return optax.with_extra_args_support(self.solver)

    def _compiled_update(self) -> Callable[..., tuple[Any, Any]]:
        """Return a function that gives the change of the unknowns and the new state."""
        compiled = eqx.filter_jit(
            lambda gradient, state, flat, loss: self._transformation.update(
                gradient, state, flat, value=loss, grad=gradient
            )
        )

        def update(*arguments: Any) -> tuple[Any, Any]:
            try:
                return compiled(*arguments)
            except TypeError as error:
                if "missing" not in str(error):
                    raise
                raise ValueError(
                    "this transformation of optax needs more than gradients, such as a line "
                    "search. Use optax.adam(0.05)"
                ) from error

        return update


def _divergence(losses: list[float], gradient: Any, size: int) -> str:
    """Return how a descent diverges; "" while it does not."""
    last = losses[-1]
    if not (np.isfinite(last) and np.all(np.isfinite(gradient))):
        growth = ", not finite"
    elif last > losses[0] + MAX_GROWTH * size and last > 2 * losses[0]:
        growth = f", {losses[0]:.3g} at first"
    else:
        return ""
    return (
        f"the descent diverges: -2 ln L is {last:.3g} at step {len(losses) - 1}{growth}."
        " Lower the learning rate, or limit the gradient, as in optax.chain("
        "optax.clip_by_global_norm(1.0), optax.sgd(0.1))"
    )


def _reason_to_end(at_minimum: bool, noisy: bool) -> str:
    if at_minimum:
        return f"the next Newton step is below {LAST_STEP:g} standard errors"
    return f"-2 ln L no longer falls, in {WINDOW if noisy else PATIENCE} steps"


def _has_ceased(losses: list[float], noisy: bool) -> bool:
    if not noisy:
        return len(losses) > PATIENCE and min(losses[:-PATIENCE]) - min(losses) < MIN_FALL
    if len(losses) < 2 * WINDOW:
        return False
    before, last = np.split(np.asarray(losses[-2 * WINDOW :]), 2)
    # Of differences, which a trend does not widen.
    noise = np.std(np.diff(losses[-2 * WINDOW :])) / WINDOW**0.5
    return bool(abs(before.mean() - last.mean()) < noise)
