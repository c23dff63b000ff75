"""The search for the maximum of a likelihood by gradient descent, with transformations of optax.

One loop serves both kinds of models: -2 ln L of a model without noise is lowered until it hardly
falls, a loss with noise until its changes are as small as its noise.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from jaxgran.fitting.problem import Problem
from jaxgran.fitting.search import (
    LAST_STEP,
    STALLED_STEP,
    Minimum,
    Objective,
    Trace,
    newton_step,
)

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


class Loss(NamedTuple):
    """What a gradient descent lowers, at one step.

    Attributes:
        value: -2 ln L.
        gradient: its derivatives.
        newton_length: length of the next Newton step, in standard errors; inf if not known.
    """

    value: float
    gradient: Any
    newton_length: float = np.inf


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
        """Minimise -2 ln L of a model without noise: a `jaxgran.fitting.search.Minimiser`."""
        objective = Objective(problem, first)

        def loss(flat: np.ndarray, step: int) -> Loss:
            found = objective.evaluate(flat)
            if not found.is_finite:
                return Loss(np.inf, np.zeros_like(flat))
            return Loss(found.value, found.gradient, newton_step(found).length)

        size = sum(row.values.size for row in problem.evaluate(first).rows)
        course = self.descend(loss, first, max_steps, size, problem.to_estimates, noisy=False)
        best = int(np.argmin(course.losses))
        return Minimum(
            flat=course.flats[best],
            value=float(course.losses[best]),
            steps=len(course.flats),
            converged=course.converged,
            trace=course.trace,
        )

    def descend(
        self,
        loss_at: Callable[[np.ndarray, int], Loss],
        first: np.ndarray,
        max_steps: int,
        size: int,
        to_estimates: Callable[[np.ndarray], np.ndarray],
        *,
        noisy: bool,
    ) -> Course:
        """Descend until the loss ceases to fall.

        Args:
            loss_at: the loss at some unknowns, at a step.
            first: the first guess.
            max_steps: maximum number of steps.
            size: number of residuals.
            to_estimates: gives SI values of the free parameters at some unknowns.
            noisy: whether the loss has noise.

        Raises:
            RuntimeError: for a descent that diverges, if `throw`.
            ValueError: for a transformation that needs more than gradients.
        """
        update = self._compiled_update()
        flat = jnp.asarray(first)
        state = self._transformation.init(flat)
        losses: list[Loss] = []
        flats = []
        ending = None
        hidden = None if self.progress else True  # None hides the bar where there is no terminal
        with tqdm(total=max_steps, disable=hidden, desc="fit", unit="step") as bar:
            for step in range(max_steps):
                loss = loss_at(np.asarray(flat), step)
                losses.append(loss)
                flats.append(np.asarray(flat))
                bar.update()
                bar.set_postfix_str(f"-2 ln L {loss.value:.4g}")
                ending = _ending(losses, size, noisy)
                if ending is not None:
                    break
                changes, state = update(
                    jnp.asarray(loss.gradient), state, flat, jnp.asarray(loss.value)
                )
                flat = flat + changes
        if ending is None:
            ending = _Ending(f"the largest number of steps, {max_steps}, was reached")
        if ending.diverged and self.throw:
            raise RuntimeError(f"{ending.reason}; throw=False returns the best step so far")
        values = np.array([loss.value for loss in losses])
        return Course(
            flats=np.stack(flats),
            losses=np.where(np.isnan(values), np.inf, values),
            converged=ending.converged,
            diverged=ending.diverged,
            trace=Trace(values, np.stack([to_estimates(x) for x in flats]), ending.reason),
        )

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


def is_transformation(solver: Any) -> bool:
    """Tell whether a solver is a gradient transformation of optax."""
    return all(callable(getattr(solver, name, None)) for name in ("init", "update"))


class _Ending(NamedTuple):
    """Why a descent ends.

    Attributes:
        reason: in words.
        converged: whether it is at a minimum.
        diverged: whether the loss grew, or ceased to be finite.
    """

    reason: str
    converged: bool = False
    diverged: bool = False


def _ending(losses: list[Loss], size: int, noisy: bool) -> _Ending | None:
    """Return why a descent ends with its last step; None if it continues.

    Args:
        losses: at all steps.
        size: number of residuals.
        noisy: whether the loss has noise.
    """
    values = [loss.value for loss in losses]
    first = values[0]
    last = values[-1]
    if not np.isfinite(last):
        return _divergence(values, "not finite")
    if not np.all(np.isfinite(losses[-1].gradient)):
        return _divergence(values, "where its gradient is not finite")
    if last > first + MAX_GROWTH * size and last > 2 * first:
        return _divergence(values, f"{first:.3g} at first")
    if losses[-1].newton_length < LAST_STEP:
        reason = f"the next Newton step is below {LAST_STEP:g} standard errors"
        return _Ending(reason, converged=True)
    if noisy and _falls_less_than_noise(values):
        return _Ending(f"-2 ln L no longer falls, in {WINDOW} steps", converged=True)
    if not noisy and _hardly_falls(values):
        return _flat_end(min(losses, key=lambda loss: loss.value))
    return None


def _flat_end(best: Loss) -> _Ending:
    """Return whether a descent without noise that hardly falls is at a minimum.

    By a small learning rate it hardly falls anywhere.
    """
    reason = f"-2 ln L no longer falls, in {PATIENCE} steps"
    if best.newton_length < STALLED_STEP:
        return _Ending(reason, converged=True)
    return _Ending(
        f"{reason}, but the next Newton step is {best.newton_length:.2g} standard errors. Change "
        "the learning rate"
    )


def _divergence(values: list[float], detail: str) -> _Ending:
    reason = (
        f"the descent diverges: -2 ln L is {values[-1]:.3g} at step {len(values) - 1}, {detail}."
        " Lower the learning rate, or limit the gradient, as in optax.chain("
        "optax.clip_by_global_norm(1.0), optax.sgd(0.1))"
    )
    return _Ending(reason, diverged=True)


def _hardly_falls(values: list[float]) -> bool:
    return len(values) > PATIENCE and min(values[:-PATIENCE]) - min(values) < MIN_FALL


def _falls_less_than_noise(values: list[float]) -> bool:
    if len(values) < 2 * WINDOW:
        return False
    before, last = np.split(np.asarray(values[-2 * WINDOW :]), 2)
    # The noise is taken from differences, which a trend does not widen.
    noise = np.std(np.diff(values[-2 * WINDOW :])) / WINDOW**0.5
    return bool(abs(before.mean() - last.mean()) < noise)
