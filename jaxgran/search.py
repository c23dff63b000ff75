"""How a fit looks for its answer: on exact residuals, or on those of a simulation with noise."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from tqdm import tqdm

LONGEST_STEP = 0.7
"""Of a parameter in its free scale (a factor of two), in one run of a simulation."""

SHORTEST_STEP = 0.25
"""Of all parameters, in standard errors, below which a search through simulations ends."""

NOISE_WINDOW = 9
"""Neighbouring times over which the variance between replicas is averaged."""

Residuals = Callable[[Float[Array, "p"]], Float[Array, "residuals"]]
Found = tuple[Float[Array, "p"], Int[Array, ""], Bool[Array, ""]]


def least_squares(residuals: Residuals, first: Float[Array, "p"], max_steps: int) -> Found:
    """Where the sum of squares is least, after how many steps, and whether at the tolerance."""
    solution = optx.least_squares(
        lambda flat, _: residuals(flat),
        optx.LevenbergMarquardt(rtol=1e-7, atol=1e-7),
        first,
        max_steps=max_steps,
        throw=False,
    )
    converged = solution.result == optx.RESULTS.successful
    return jnp.asarray(solution.value), solution.stats["num_steps"], converged


def quasi_newton(residuals: Residuals, first: Float[Array, "p"], max_steps: int) -> Found:
    """The same by L-BFGS and reverse mode."""

    def objective(flat):
        return 0.5 * jnp.sum(residuals(flat) ** 2)

    solver = optax.lbfgs()
    value_and_grad = optax.value_and_grad_from_state(objective)

    def step(carry):
        flat, state, num_steps, _ = carry
        value, grad = value_and_grad(flat, state=state)
        updates, state = solver.update(
            grad, state, flat, value=value, grad=grad, value_fn=objective
        )
        return optax.apply_updates(flat, updates), state, num_steps + 1, optax.tree.norm(updates)

    def unfinished(carry):
        _, _, num_steps, moved = carry
        return (num_steps < max_steps) & (moved > 1e-9)

    carry = first, solver.init(first), jnp.zeros((), int), jnp.full((), jnp.inf)
    flat, _, num_steps, moved = jax.lax.while_loop(unfinished, step, carry)
    return jnp.asarray(flat), num_steps, moved <= 1e-9


class Simulated(NamedTuple):
    """Where a search through simulations ended. p parameters in their free scale."""

    flat: Float[np.ndarray, "p"]
    computed: Any  # the curve of the last run
    residuals: Float[np.ndarray, "times"]  # at `flat`, by the last run's tangent
    sensitivity: Float[np.ndarray, "times p"]  # of the residuals
    error_covariance: Float[np.ndarray, "p p"]  # of `flat`, by the measured errors
    noise_covariance: Float[np.ndarray, "p p"]  # and by the simulation's own noise
    num_runs: int
    converged: bool


def by_simulation(
    log_temperature: Callable[[Array], tuple[Array, Any]],
    first: Float[np.ndarray, "p"],
    measured: Float[np.ndarray, "times"],
    error: Float[np.ndarray, "times"],
    used: Bool[np.ndarray, "times"],
    *,
    resolution: float,
    max_runs: int,
    progress: bool,
) -> Simulated:
    """Gauss-Newton steps, each on one run of a simulation with its tangents.

    Residuals are weighted by the measured error and the simulation's own, from its replicas. A
    derivative that is wrong by some per cent slows the search and tilts the error bar by as much,
    but does not move its end, which is where the residuals say so. The noise of the answer is what
    the replicas, taken one by one, would have moved it by.

    Args:
        log_temperature: of the parameters: ln T at all times, and the curve with its replicas.
        first: where to begin.
        measured, error: ln T and its standard error; if that is 0 everywhere it is not known.
        used: the times that carry weight.
        resolution: changes that alter the curve less than this, relative to the change that alters
            it most, are not followed.
        max_runs: the most runs.
        progress: show a bar.
    """

    def with_value(flat):
        value, curve = log_temperature(flat)
        return value, (value, curve)

    derivative = jax.jacfwd(with_value, has_aux=True)
    flat = np.asarray(first, float)
    bar = tqdm(total=max_runs, disable=None if progress else True, desc="fit", unit="run")
    converged, num_runs = False, 0
    with bar:
        while True:
            slope, (computed_log, computed) = derivative(jnp.asarray(flat))
            num_runs += 1
            each = np.log(np.asarray(computed.replicas.temperature))
            deviation = each - each.mean(axis=0)
            sigma = np.hypot(error, _noise(deviation))[used]
            sensitivity = np.asarray(slope)[used] / sigma[:, None]
            residuals = (measured - np.asarray(computed_log))[used] / sigma
            inverse = np.linalg.pinv(sensitivity, rcond=resolution)
            by_replica = (deviation[:, used] / sigma) @ inverse.T
            replicas = len(each)
            noise = by_replica.T @ by_replica / (replicas * (replicas - 1))
            share = error[used] / sigma if error.any() else np.ones(len(sigma))
            errors = (inverse * share) @ (inverse * share).T
            step = inverse @ residuals
            step *= min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-300))
            flat = flat + step
            spread = np.sqrt(np.diag(errors + noise))
            converged = bool(np.all(np.abs(step) <= SHORTEST_STEP * spread + 1e-9))
            bar.update()
            bar.set_postfix_str(f"last step {np.abs(step / spread).max():.2g} standard errors")
            if converged or num_runs == max_runs:
                break
    full = np.zeros((len(measured), len(flat)))
    left = np.zeros(len(measured))
    full[used], left[used] = sensitivity, residuals - sensitivity @ step
    return Simulated(flat, computed, left, full, errors, noise, num_runs, converged)


def _noise(deviation: Float[np.ndarray, "replicas times"]) -> Float[np.ndarray, "times"]:
    """Standard error of the mean, its variance averaged over neighbouring times."""
    replicas, num_times = deviation.shape
    variance = np.sum(deviation**2, axis=0) / (replicas * (replicas - 1))
    window = np.ones(min(NOISE_WINDOW, num_times))
    return np.sqrt(
        np.convolve(variance, window, "same") / np.convolve(np.ones(num_times), window, "same")
    )
