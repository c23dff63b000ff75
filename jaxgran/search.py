"""How a fit looks for its answer: on exact residuals, or on those of a simulation with noise."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int
from tqdm import tqdm

from jaxgran.curve import CoolingCurve

LONGEST_STEP = 0.7
"""Of a parameter in its free scale (a factor of two), in one run of a simulation."""

NEAR = 0.1
"""Runs within this of the last, in every parameter's free scale, count for the answer."""

QUIET = 0.5
"""A search through simulations ends when their noise is so much of the standard error."""

AT_REST = 0.01
"""Standard errors to go at which a least-squares search takes its last step."""

NOISE_WINDOW = 9
"""Neighbouring times over which the variance between replicas is averaged."""

Residuals = Callable[[Float[Array, "p"]], Float[Array, "residuals"]]
Found = tuple[Float[Array, "p"], Int[Array, ""], Bool[Array, ""]]


def at_rest(residuals: Float[Array, "n"], jacobian: Float[Array, "n p"]) -> Bool[Array, ""]:
    """Whether the Gauss-Newton step from here is nothing beside the standard errors.

    In standard errors, as the scatter of the residuals tells them, the step's parts along the
    singular vectors of the Jacobian are those of the residuals along the left ones. Changes that
    alter the residuals by round-off only do not count.
    """
    left, singular, _ = jnp.linalg.svd(jacobian, full_matrices=False)
    known = singular > jnp.finfo(singular.dtype).eps ** 0.5 * singular[0]
    step = jnp.max(jnp.where(known, jnp.abs(residuals @ left), 0.0))
    return step < AT_REST * jnp.sqrt(jnp.mean(residuals**2))


class _TrustRegion(optx.ClassicalTrustRegion):
    """That ends a search where it is at rest: there the next step is taken, and the one after is 0.

    Steps there raise the sum by round-off as often as not; refused, the search would go on in vain.
    """

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        step_size, accept, *rest = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        assert isinstance(f_info, optx.FunctionInfo.ResidualJac)
        ended = at_rest(f_info.residual, f_info.jac.as_matrix())
        return jnp.where(ended, 0.0, step_size), accept | ended, *rest


def least_squares(residuals: Residuals, first: Float[Array, "p"], max_steps: int) -> Found:
    """Where the sum of squares is least, after how many steps, and whether at the tolerance."""
    solver = optx.LevenbergMarquardt(rtol=1e-7, atol=1e-7)
    solution = optx.least_squares(
        lambda flat, _: residuals(flat),
        eqx.tree_at(lambda solver: solver.search, solver, _TrustRegion()),
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
    computed: CoolingCurve  # the curve of the last run
    residuals: Float[np.ndarray, "times"]  # at `flat`, by the tangents
    sensitivity: Float[np.ndarray, "times p"]  # of the residuals
    error_covariance: Float[np.ndarray, "p p"]  # of `flat`, by the measured errors
    noise_covariance: Float[np.ndarray, "p p"]  # and by the simulation's own noise
    num_runs: int
    converged: bool


class _Run(NamedTuple):
    """One simulation at some parameters, at the times that are used."""

    flat: np.ndarray
    log_temperature: np.ndarray
    slope: np.ndarray
    deviation: np.ndarray  # of each replica from their mean


def by_simulation(
    simulate: Callable[[Array, int], CoolingCurve],
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

    Every run has random numbers of its own, and those that began near its end say independently
    where the end is: the answer is their mean. Residuals are weighted by the measured error and the
    noise of the mean, alike if no error is known; that noise is told by what the replicas, one by
    one, would have moved the answer by. The search goes on until it adds little to the measured
    error.

    A derivative that is wrong by some per cent slows the search and tilts the error bar by as much,
    but does not move the end, which is where the residuals say.

    Args:
        simulate: the cooling curve, with replicas, of the parameters and the number of the run.
        first: where to begin.
        measured, error: ln T and its standard error; if that is 0 everywhere it is not known.
        used: the times that carry weight.
        resolution: changes that alter the curve less than this, relative to the change that alters
            it most, are not followed.
        max_runs: the most runs.
        progress: show a bar.
    """
    runs: list[_Run] = []
    flat, measured, error = np.asarray(first, float), measured[used], error[used]
    known = bool(error.any())

    def log_temperature(flat):
        curve = simulate(flat, len(runs))
        value = jnp.log(curve.temperature)
        return value, (value, curve)

    derivative = jax.jacfwd(log_temperature, has_aux=True)
    bar = tqdm(total=max_runs, disable=None if progress else True, desc="fit", unit="run")
    with bar:
        while True:
            slope, (value, curve) = derivative(jnp.asarray(flat))
            each = np.log(np.asarray(curve.replicas.temperature))[:, used]
            value, slope = np.asarray(value)[used], np.asarray(slope)[used]
            runs.append(_Run(flat, value, slope, each - each.mean(axis=0)))
            near = [run for run in runs if np.abs(run.flat - flat).max() < NEAR]
            noise = np.sqrt(np.mean([_variance(run.deviation) for run in near], axis=0) / len(near))
            sigma = np.hypot(error, noise) if known else np.ones_like(error)
            ends, scatter = [], []
            for run in near:
                sensitivity = run.slope / sigma[:, None]
                inverse = np.linalg.pinv(sensitivity, rcond=resolution)
                ends.append(run.flat + inverse @ ((measured - run.log_temperature) / sigma))
                replicas = len(run.deviation)
                moved = (run.deviation / sigma) @ inverse.T / (replicas * (replicas - 1)) ** 0.5
                scatter.append(moved.T @ moved)
            share = inverse * (error / sigma if known else np.ones_like(sigma))
            errors, noises = share @ share.T, np.mean(scatter, axis=0) / len(near)
            step = np.mean(ends, axis=0) - flat
            step *= min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-300))
            settled = bool(np.abs(step).max() < NEAR)
            flat = flat + step
            spread = np.sqrt(np.diag(errors + noises))
            quiet = np.all(np.diag(noises) <= QUIET**2 * np.diag(errors + noises))
            bar.update()
            bar.set_postfix_str(f"last step {np.abs(step / spread).max():.2g} standard errors")
            if len(runs) == max_runs or (settled and len(near) > 1 and (quiet or not known)):
                break
    residuals = [measured - run.log_temperature - run.slope @ (flat - run.flat) for run in near]
    slope = np.mean([run.slope for run in near], axis=0)
    all_residuals, sensitivity = np.zeros(len(used)), np.zeros((len(used), len(flat)))
    all_residuals[used] = np.mean(residuals, axis=0) / sigma
    sensitivity[used] = slope / sigma[:, None]
    return Simulated(flat, curve, all_residuals, sensitivity, errors, noises, len(runs), settled)


def _variance(deviation: Float[np.ndarray, "replicas times"]) -> Float[np.ndarray, "times"]:
    """Of the mean over replicas, averaged over neighbouring times."""
    replicas, num_times = deviation.shape
    variance = np.sum(deviation**2, axis=0) / (replicas * (replicas - 1))
    window = np.ones(min(NOISE_WINDOW, num_times))
    parts = np.convolve(np.ones(num_times), window, "same")
    return np.convolve(variance, window, "same") / parts
