"""Fits by gradient descent with a transformation of optax.

Through a stochastic model each step is one simulation with new random numbers and its gradient in
reverse mode, and the estimate is the mean of the last half of the steps (Polyak average).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from tqdm import tqdm

from jaxgran.fitting.optimise import MAX_DISTANCE, Minimum, Problem, Trace, is_converged
from jaxgran.fitting.residuals import log_temperatures
from jaxgran.fitting.stochastic import (
    Search,
    Simulations,
    average_estimates,
    run_simulation,
    variance_of_mean,
)

MAX_GROWTH = 10.0
"""Ratio to the first loss (or to the number of residuals, if this is more) at which a descent is
taken to diverge."""

WINDOW = 20
"""Number of steps whose mean loss is compared with that of as many steps before; a descent with
noise ends if the two differ by less than it."""

PATIENCE, MIN_FALL = 50, 0.01
"""A descent without noise ends if this many steps have lowered chi^2 by less than this."""

MAX_LINEARISED = 30
"""Number of parameters up to which a fit by descent through simulations has errors: more are not
determined one by one."""

NUM_LINEARISED = 2
"""Number of simulations that give these error bars."""


@dataclass
class Descent:
    """A gradient descent, and its course once it has run.

    Attributes:
        solver: gradient transformation of optax.
        progress: show a progress bar.
        throw: raise RuntimeError for a descent that diverges.
        trace: its course.
    """

    solver: Any
    progress: bool
    throw: bool
    trace: Trace | None = None

    def __call__(self, problem: Problem, first: np.ndarray, max_steps: int) -> Minimum:
        """Minimise chi^2 of a deterministic model; a search as `jaxgran.fitting.optimise` has."""

        def at(flat: np.ndarray, step: int) -> tuple[Any, Any, bool]:
            if np.any(np.abs(flat - first) > MAX_DISTANCE):
                return np.inf, np.zeros_like(flat), False
            _, residuals, jacobian, _ = problem.evaluate(flat.astype(first.dtype))
            finite = np.all(np.isfinite(residuals)) and np.all(np.isfinite(jacobian))
            at_minimum = bool(finite) and bool(is_converged(residuals, jacobian))
            return residuals @ residuals, 2 * residuals @ jacobian, at_minimum

        size = problem.evaluate(first)[1].size
        flats, losses, converged, _ = self._descend(
            at, first, max_steps, size, False, problem.estimates
        )
        best = flats[np.argmin(losses)]
        return best.astype(first.dtype), np.asarray(len(flats)), np.asarray(converged)

    def by_simulation(self, sims: Simulations, max_simulations: int) -> Search:
        """Search as `jaxgran.fitting.stochastic.search_by_simulation`, by gradient descent.

        The residuals of each simulation are weighted by the measured error and its own noise.
        `NUM_LINEARISED` further simulations at the estimate give its errors.
        """
        size, points = int(np.sum(sims.used)), np.flatnonzero(sims.used)

        def loss(flat: Array, number: int) -> Array:
            curve = sims.simulate(flat, number)
            weight = jnp.ones(size)
            if sims.error is not None:
                replicas: Any = jax.lax.stop_gradient(curve.replicas)
                values = np.asarray(log_temperatures(replicas, sims.rotation))[:, sims.used]
                weight = 1 / np.sqrt(sims.error**2 + variance_of_mean(values - values.mean(0)))
            residuals = (log_temperatures(curve, sims.rotation)[points] - sims.measured) * weight
            return jnp.sum(residuals**2) + jnp.sum(sims.prior(flat) ** 2)

        def at(flat: np.ndarray, step: int) -> tuple[Any, Any, bool]:
            return *jax.value_and_grad(loss)(jnp.asarray(flat), step), False

        flats, losses, converged, diverged = self._descend(
            at, sims.first, max_simulations, size, True, sims.estimates
        )
        averaged = 1 if diverged else (len(flats) + 1) // 2
        flat = np.mean(flats[-averaged:], axis=0)
        if diverged:
            flat = flats[np.argmin(losses)]
        numbers = range(len(flats), len(flats) + NUM_LINEARISED)
        runs = [run_simulation(sims, flat, n) for n in numbers]
        near = [s for s, _ in runs]
        _, sigma, _, noise = average_estimates(near, sims)
        noise, number = noise * NUM_LINEARISED / averaged, len(flats) + NUM_LINEARISED
        return Search(flat, near, sigma, noise, runs[-1][1], number, converged)

    def _descend(
        self,
        loss_and_gradient: Callable[[np.ndarray, int], tuple[Any, Any, bool]],
        first: np.ndarray,
        max_steps: int,
        size: int,
        noisy: bool,
        estimates: Callable[[np.ndarray], np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray, bool, bool]:
        """Return parameters and losses of all steps, and whether they converged and diverged.

        Losses of nan are returned as inf. `loss_and_gradient` also returns True at a minimum;
        `size` is the number of residuals.
        """
        import optax  # the user has imported it to make the solver

        transform: Any = optax.with_extra_args_support(self.solver)
        update = eqx.filter_jit(
            lambda gradient, state, flat, loss: transform.update(
                gradient, state, flat, value=loss, grad=gradient
            )
        )
        flat, state = jnp.asarray(first), transform.init(jnp.asarray(first))
        losses, flats, converged, growth = [], [], False, ""
        reason = f"the largest number of steps, {max_steps}, was reached"
        hidden = None if self.progress else True  # None hides the bar where there is no terminal
        with tqdm(total=max_steps, disable=hidden, desc="fit", unit="step") as bar:
            for step in range(max_steps):
                loss, gradient, at_minimum = loss_and_gradient(np.asarray(flat), step)
                losses.append(float(loss))
                flats.append(np.asarray(flat))
                bar.update()
                bar.set_postfix_str(f"chi^2 {losses[-1]:.4g}")
                if not (np.isfinite(losses[-1]) and np.all(np.isfinite(gradient))):
                    growth = ", not finite"
                elif losses[-1] > MAX_GROWTH * max(losses[0], size):
                    growth = f", {losses[0]:.3g} at first"
                if growth:
                    reason = (
                        f"the descent diverges: chi^2 is {losses[-1]:.3g} at step {step}{growth}. "
                        "Lower the learning rate, or limit the gradient, as in optax.chain("
                        "optax.clip_by_global_norm(1.0), optax.sgd(0.1))"
                    )
                    break
                converged = at_minimum or _has_ceased(losses, noisy)
                if converged:
                    reason = "the next Gauss-Newton step is below .01 standard errors"
                    if not at_minimum:
                        reason = f"chi^2 no longer falls, in {WINDOW if noisy else PATIENCE} steps"
                    break
                try:
                    changes, state = update(jnp.asarray(gradient), state, flat, jnp.asarray(loss))
                except TypeError as error:
                    raise ValueError(
                        "this transformation of optax needs more than gradients, such as a line "
                        "search. Use optax.adam(0.05), or optimistix.LBFGS(rtol, atol)"
                    ) from error
                flat = flat + changes
        self.trace = Trace(np.asarray(losses), np.stack([estimates(x) for x in flats]), reason)
        if growth and self.throw:
            raise RuntimeError(f"{reason}; throw=False returns the best step so far")
        finite = np.nan_to_num(losses, nan=np.inf)
        return np.stack(flats), finite, converged, bool(growth)


def _has_ceased(losses: list[float], noisy: bool) -> bool:
    if not noisy:
        return len(losses) > PATIENCE and min(losses[:-PATIENCE]) - min(losses) < MIN_FALL
    if len(losses) < 2 * WINDOW:
        return False
    before, last = np.split(np.asarray(losses[-2 * WINDOW :]), 2)
    noise = np.std(np.diff(losses[-2 * WINDOW :])) / WINDOW**0.5  # a trend has no part in it
    return bool(abs(before.mean() - last.mean()) < noise)
