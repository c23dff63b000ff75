"""The searches for the maximum of a likelihood: Newton's method, and gradient descent by optax."""

from collections.abc import Callable
from dataclasses import dataclass
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
"""Number of steps whose mean loss is compared with that of as many steps before; a descent with
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
    problem: Problem, first: np.ndarray, max_steps: int, tolerance: float = LAST_STEP
) -> Minimum:
    """Minimise -2 ln L from a first guess by Newton's method in a trust region.

    Second derivatives are replaced by their expectation (Fisher's scoring), which is positive.

    Args:
        problem: of a fit.
        first: the first guess, in the unconstrained scale.
        max_steps: maximum number of steps.
        tolerance: length of a Newton step, in standard errors, at which the search ends.
    """

    farthest = _farthest(problem)

    def value(flat: np.ndarray) -> float:
        if np.any(np.abs(flat - first) > farthest):
            return np.inf
        found = problem.evaluate(flat)
        return found.value if found.is_finite else np.inf

    def length_of_step(flat: np.ndarray) -> float:
        return newton_step(problem.evaluate(flat))[1]

    lowest = np.inf
    stalled = 0

    def stop_at_minimum(flat: np.ndarray) -> None:
        nonlocal lowest, stalled
        stalled = stalled + 1 if value(flat) > lowest - MIN_FALL_OF_STEP else 0
        lowest = value(flat)
        if length_of_step(flat) < tolerance or stalled >= MAX_STALLED:
            raise StopIteration

    if not np.isfinite(value(first)):
        return Minimum(first, np.inf, 0, False)
    if length_of_step(first) < tolerance:
        return Minimum(first, value(first), 0, True)

    def gradient(flat: np.ndarray) -> np.ndarray:
        return np.nan_to_num(problem.evaluate(flat).gradient)

    def hessian(flat: np.ndarray) -> np.ndarray:
        found = problem.evaluate(flat)
        return 2 * found.information if found.is_finite else np.eye(flat.size)

    solution = scipy.optimize.minimize(
        value,
        first,
        jac=gradient,
        hess=hessian,
        method="trust-exact",
        callback=stop_at_minimum,
        options={
            "gtol": 0.0,
            "maxiter": max_steps,
            "initial_trust_radius": MAX_STEP,
            "max_trust_radius": 2 * MAX_STEP,
        },
    )
    end = np.asarray(solution.x)
    limit = max(tolerance, STALLED_STEP if stalled >= MAX_STALLED else CONVERGED_STEP)
    step, length = newton_step(problem.evaluate(end))
    if length < CONVERGED_STEP:
        end = end + step
    return Minimum(end, value(end), int(solution.nit), length < limit)


def _farthest(problem: Problem) -> Float[np.ndarray, "unknowns"]:
    limits = [MAX_DISTANCE.get(u.name, MAX_DISTANCE_OF_OTHERS) for u in problem.unknowns]
    return np.repeat(limits, [u.size for u in problem.unknowns])


def best_of_starts(
    problem: Problem, first: np.ndarray, max_steps: int, search: Callable[..., Minimum] = minimise
) -> tuple[Minimum, list[Minimum]]:
    """Search from a first guess and, if beta_t is free, also with other values of beta_t.

    Returns the deepest minimum, whose steps are those of all searches, and all of them.
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

        farthest = _farthest(problem)

        def loss(flat: np.ndarray, step: int) -> tuple[float, np.ndarray, bool]:
            if np.any(np.abs(flat - first) > farthest):
                return np.inf, np.zeros_like(flat), False
            found = problem.evaluate(flat)
            if not found.is_finite:
                return np.inf, found.gradient, False
            return found.value, found.gradient, newton_step(found)[1] < LAST_STEP

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
        loss_and_gradient: Callable[[np.ndarray, int], tuple[Any, Any, bool]],
        first: np.ndarray,
        max_steps: int,
        size: int,
        estimates: Callable[[np.ndarray], np.ndarray],
        *,
        noisy: bool,
    ) -> Course:
        """Descend until the loss ceases to fall.

        `loss_and_gradient` also returns True at a minimum; `size` is the number of residuals.
        """
        import optax  # the user has imported it to make the solver

        transform: Any = optax.with_extra_args_support(self.solver)
        update = eqx.filter_jit(
            lambda gradient, state, flat, loss: transform.update(
                gradient, state, flat, value=loss, grad=gradient
            )
        )
        flat = jnp.asarray(first)
        state = transform.init(flat)
        losses: list[float] = []
        flats = []
        converged = False
        growth = ""
        reason = f"the largest number of steps, {max_steps}, was reached"
        hidden = None if self.progress else True  # None hides the bar where there is no terminal
        with tqdm(total=max_steps, disable=hidden, desc="fit", unit="step") as bar:
            for step in range(max_steps):
                loss, gradient, at_minimum = loss_and_gradient(np.asarray(flat), step)
                losses.append(float(loss))
                flats.append(np.asarray(flat))
                bar.update()
                bar.set_postfix_str(f"-2 ln L {losses[-1]:.4g}")
                if not (np.isfinite(losses[-1]) and np.all(np.isfinite(gradient))):
                    growth = ", not finite"
                elif losses[-1] > losses[0] + MAX_GROWTH * size and losses[-1] > 2 * losses[0]:
                    growth = f", {losses[0]:.3g} at first"
                if growth:
                    reason = (
                        f"the descent diverges: -2 ln L is {losses[-1]:.3g} at step {step}{growth}."
                        " Lower the learning rate, or limit the gradient, as in optax.chain("
                        "optax.clip_by_global_norm(1.0), optax.sgd(0.1))"
                    )
                    break
                converged = at_minimum or _has_ceased(losses, noisy)
                if converged:
                    reason = f"the next Newton step is below {LAST_STEP:g} standard errors"
                    if not at_minimum:
                        steps = WINDOW if noisy else PATIENCE
                        reason = f"-2 ln L no longer falls, in {steps} steps"
                    break
                try:
                    changes, state = update(jnp.asarray(gradient), state, flat, jnp.asarray(loss))
                except TypeError as error:
                    raise ValueError(
                        "this transformation of optax needs more than gradients, such as a line "
                        "search. Use optax.adam(0.05)"
                    ) from error
                flat = flat + changes
        trace = Trace(np.asarray(losses), np.stack([estimates(x) for x in flats]), reason)
        if growth and self.throw:
            raise RuntimeError(f"{reason}; throw=False returns the best step so far")
        numbers = np.where(np.isnan(losses), np.inf, losses)
        return Course(np.stack(flats), numbers, converged, bool(growth), trace)


def _has_ceased(losses: list[float], noisy: bool) -> bool:
    if not noisy:
        return len(losses) > PATIENCE and min(losses[:-PATIENCE]) - min(losses) < MIN_FALL
    if len(losses) < 2 * WINDOW:
        return False
    before, last = np.split(np.asarray(losses[-2 * WINDOW :]), 2)
    # Of differences, which a trend does not widen.
    noise = np.std(np.diff(losses[-2 * WINDOW :])) / WINDOW**0.5
    return bool(abs(before.mean() - last.mean()) < noise)
