"""The Kalman filter of a measured curve, which `log_likelihood` and every fit call.

The residuals of a run of N grains are a Gaussian process. Between two times the fluctuations about
kinetic theory obey a linear stochastic equation (`jaxgran.theory.covariance`); its solution is
compared with the measured values one after the other. Each value then has an innovation, its
residual minus what is expected from all values before it, and the variance of that:
``-2 ln L = sum innovation^2/variance + ln variance``. No matrix of all points is formed, so that a
curve of a thousand points costs no more than its points.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxgran.fitting.rows import Noise
from jaxgran.scene.gas import Gas
from jaxgran.theory.contact_noise import contact_noise
from jaxgran.theory.covariance import (
    NUM_DOUBLINGS,
    ROTATION_OFFSET,
    Mean,
    product,
    propagators,
    run_process,
    transposed,
)
from jaxgran.theory.moments import Spins

LOG_T = 0
"""Place of ln T among the variables of a run (`jaxgran.theory.covariance`)."""

RATIO = 1
"""Place of y of rough spheres, or of q of spheres of unequal sizes, among them."""

RATE_ERROR_LENGTH = 1.0
"""Change of ln T over which the error of theory's cooling rate is correlated."""

SAMPLE_DECAY_RATE = 0.57
"""Rate at which the sampling error of T is forgotten, per collision of a grain.

Measured: 60 of 250 spheres, eps = .9, 400 replicas: correlations .75, .56, .42, .33, .26, .20 after
.5, 1, ..., 3 collisions."""

SMALLEST_VARIANCE = 1e-12
"""Relative variance that is added to each value, so that exact ones do not divide by 0."""


class Nodes(NamedTuple):
    """Curves of some neighbouring gases at nodes.

    Nodes are times from 0 on, which include the times of the data. Arrays have the shape
    (nodes, gases): operations on small matrices are fast where the last axis is long.

    Attributes:
        log_temperature: ln T, T in m^2/s^2.
        rotation: T_rot/T; 0 for smooth spheres.
        sonine: a_2, shape (nodes,).
        collisions: per particle.
        size_ratio: q of spheres of unequal sizes (`jaxgran.theory.sizes`); None for equal spheres.
        by_size_ratio: derivative of ln T in q, for the measured T: 0 unless T is given by the
            energy; None for equal spheres.
        is_before: whether the measured time is before the start, as far from it as the node; shape
            (nodes,). None if no time is.
    """

    log_temperature: Any
    rotation: Any
    sonine: Any
    collisions: Any
    size_ratio: Any = None
    by_size_ratio: Any = None
    is_before: Any = None


class Filtered(NamedTuple):
    """Innovations of columns of residuals, which share their variances.

    Attributes:
        values: of T and of T_rot, 0 where nothing is used, shape (nodes, 2, columns, gases).
        variances: of the innovations; where nothing is used, the variance that a value would
            have; shape (nodes, 2, gases).
    """

    values: Any
    variances: Any


def filtered(
    gas: Gas,
    nodes: Nodes,
    residuals: Float[Array, "nodes 2 columns gases"],
    variances: Float[Array, "nodes 2 gases"],
    sensitivity: Float[Array, "nodes gases"],
    used: Float[Array, "nodes 2"],
    noise: Noise,
    *,
    differentiable: bool = False,
) -> Filtered:
    """Return the innovations of columns of residuals, and the variances that they share.

    The second axis of arrays is T, T_rot. More columns cost little, since covariances do not depend
    on residuals.

    Args:
        gas: neighbouring scenes: its floats have an axis (gases,).
        nodes: their curves by kinetic theory.
        residuals: of T and of T_rot, relative.
        variances: of their independent errors.
        sensitivity: derivative of the computed ln T in ln T of the gas: 1 without a noise floor.
        used: 1 where a value counts, 0 elsewhere.
        noise: what makes them scatter beside these errors; its `inverse_number` has the shape
            (gases,), and its `white` is part of the variances.
        differentiable: whether derivatives in reverse mode are taken.
    """
    with jax.numpy_rank_promotion("allow"):  # the gases are the last axis of all arrays
        steps = _steps(gas, nodes, noise, differentiable)
        start = _start(steps, noise, residuals)
        unit = jnp.eye(len(start.mean), dtype=residuals.dtype)[..., None]
        turning = nodes.rotation > 0
        positive = jnp.where(turning, nodes.rotation, jnp.inf)  # a slope of 0 without rotation
        at_nodes = _AtNode(
            growth=steps.growth,
            increment=steps.increment,
            rotation_slope=(nodes.rotation + ROTATION_OFFSET) / positive,
            by_size_ratio=nodes.by_size_ratio,
            residuals=residuals,
            variances=variances + SMALLEST_VARIANCE,
            sensitivity=sensitivity,
            sizes=steps.sizes,
            used=used,
        )
        _, found = jax.lax.scan(partial(_filter_step, unit), start, at_nodes)
    return found


class _Steps(NamedTuple):
    """What happens to the variables of a run from each node's predecessor to it.

    The k variables of the run (`jaxgran.theory.covariance.process`) are followed by the relative
    error of theory's cooling rate and by the passing errors of ln T, each over its standard
    deviation: n variables in all.

    Attributes:
        start: covariance of the variables of the run at its start, shape (k, k, gases).
        growth: F - 1 with the propagator F, shape (nodes, n, n, gases).
        increment: what a step adds to the covariance, shape (nodes, n, n, gases).
        sizes: standard deviations of the passing errors, shape (nodes, n - k - 1, gases).
        at_start: their variances at t = 0 over those in the long run, shape (n - k - 1,).
    """

    start: Array
    growth: Array
    increment: Array
    sizes: Array
    at_start: np.ndarray


def _steps(gas: Gas, nodes: Nodes, noise: Noise, differentiable: bool) -> _Steps:
    """Return the steps of all variables; the passing errors are independent of all others."""
    process = _process(gas, nodes, noise)
    shape = process.drift.shape
    doublings = NUM_DOUBLINGS if differentiable else _needed_doublings(process.drift)
    flat = (*shape[:2], -1)  # nodes and gases are one axis of `propagators`
    drift = process.drift.reshape(flat)
    diffusion = process.diffusion.reshape(flat)
    growth, increment = propagators(drift, diffusion, doublings)
    errors = _passing_errors(gas, nodes, noise)
    growth = _with_more_variables(growth.reshape(shape), len(errors))
    increment = _with_more_variables(increment.reshape(shape), len(errors))
    # Each passing error is an Ornstein-Uhlenbeck process, of variance 1 in the long run.
    decays = jnp.stack([error.decay for error in errors], axis=1)
    places = shape[0] + np.arange(len(errors))
    return _Steps(
        start=process.start,
        growth=growth.at[:, places, places].set(jnp.expm1(-decays)),
        increment=increment.at[:, places, places].set(-jnp.expm1(-2 * decays)),
        sizes=jnp.stack([error.size for error in errors], axis=1),
        at_start=np.array([error.at_start for error in errors]),
    )


class _PassingError(NamedTuple):
    """A scatter of the measured ln T that is forgotten exponentially.

    Attributes:
        decay: of its logarithm since the node before, shape (nodes, gases).
        size: its standard deviation in the long run, of the same shape.
        at_start: its variance at t = 0 over that in the long run.
    """

    decay: Array
    size: Array
    at_start: float


def _passing_errors(gas: Gas, nodes: Nodes, noise: Noise) -> list[_PassingError]:
    """Return the sampling error, and the scatter by contacts of soft spheres."""
    collisions = _change(nodes.collisions)
    size = jnp.broadcast_to(jnp.sqrt(noise.sample), collisions.shape)
    errors = [_PassingError(SAMPLE_DECAY_RATE * collisions, size, at_start=1.0)]
    log_T = nodes.log_temperature - nodes.log_temperature[:1]
    contacts = jax.vmap(contact_noise, in_axes=(0, -1), out_axes=-1)(gas, log_T)
    if contacts is not None:
        size = jnp.sqrt(noise.inverse_number * noise.contacts) * contacts.size
        decay = _forgotten_across_start(collisions / contacts.memory, nodes.is_before)
        errors.append(_PassingError(decay, size, at_start=0.0))
    return errors


def _forgotten_across_start(
    decay: Float[Array, "nodes gases"], is_before: Bool[Array, "nodes"] | None
) -> Array:
    """Return a decay that is complete next to nodes whose times are before the start.

    Nodes are ordered by their distance from the start: two on either side of it are farther apart.
    """
    if is_before is None:
        return decay
    is_next_to_one = is_before | jnp.append(False, is_before[:-1])
    return jnp.where(is_next_to_one[:, None], jnp.inf, decay)


class _Process(NamedTuple):
    """The linear stochastic equation of the variables of a run and of the error of the rate.

    Attributes:
        start: covariance of the variables of the run at its start, see `_Steps`.
        drift: matrix J of the equation times each step, shape (k + 1, k + 1, nodes, gases).
        diffusion: matrix Q of its random term times each step, of the same shape.
    """

    start: Array
    drift: Array
    diffusion: Array


def _process(gas: Gas, nodes: Nodes, noise: Noise) -> _Process:
    """Return the equation, whose coefficients are constant from a node to the next one."""
    means = Mean(
        nodes.log_temperature - nodes.log_temperature[:1],
        jnp.broadcast_to(nodes.sonine[:, None], nodes.rotation.shape),
        nodes.collisions,
        Spins(nodes.rotation, None, None),
        nodes.size_ratio,
    )
    process_of_gases = jax.vmap(run_process, in_axes=(0, -1), out_axes=-1)
    jacobian, diffusion, starts = process_of_gases(gas, jax.tree.map(_middle, means))
    collisions = _change(nodes.collisions)
    rate_error = len(jacobian)
    size = rate_error + 1
    zeros = jnp.zeros((size, size, *nodes.rotation.shape), jacobian.dtype)
    diffusion = noise.inverse_number * diffusion * collisions
    diffusion = zeros.at[:rate_error, :rate_error].set(diffusion)
    drift = zeros.at[:rate_error, :rate_error].set(jacobian * collisions)
    # An error of the rate moves all temperatures along their mean course.
    error = _middle(noise.rate_error)[:, None]
    change_of_T = _change(nodes.log_temperature)
    drift = drift.at[LOG_T, rate_error].set(error * change_of_T)
    if gas.surface is not None:
        change_of_y = _change(jnp.log(nodes.rotation + ROTATION_OFFSET))
        drift = drift.at[RATIO, rate_error].set(error * change_of_y)
    if nodes.size_ratio is not None:
        drift = drift.at[RATIO, rate_error].set(error * _change(nodes.size_ratio))
    decay = jnp.abs(change_of_T) / RATE_ERROR_LENGTH
    return _Process(
        start=noise.inverse_number * starts[:, :, 0],
        drift=drift.at[rate_error, rate_error].set(-decay),
        diffusion=diffusion.at[rate_error, rate_error].set(2 * decay),
    )


def _needed_doublings(drift: Array) -> Array:
    """Return the doublings of a step in which no variable changes by more than 1/64 of itself."""
    longest = jnp.max(jnp.abs(drift))
    return jnp.clip(jnp.ceil(jnp.log2(64 * longest)), 1, NUM_DOUBLINGS).astype(int)


def _with_more_variables(x: Float[Array, "n n nodes gases"], count: int) -> Array:
    """Return matrices with `count` more rows and columns of 0, the axis of nodes first."""
    padded = jnp.pad(x, [(0, count), (0, count), (0, 0), (0, 0)])
    return jnp.moveaxis(padded, 2, 0)


def _middle(x: Array) -> Array:
    """Return the mean of each row and the row before it; the first row as it is."""
    return jnp.concatenate([x[:1], (x[1:] + x[:-1]) / 2])


def _change(x: Array) -> Array:
    """Return the difference of each row to the row before it, 0 for the first."""
    return jnp.diff(x, prepend=x[:1], axis=0)


class _State(NamedTuple):
    """What is expected of the n variables of a run, given all values so far.

    Attributes:
        mean: shape (n, columns, gases).
        covariance: shape (n, n, gases).
    """

    mean: Array
    covariance: Array


def _start(steps: _Steps, noise: Noise, residuals: Array) -> _State:
    """Return the state at t = 0, before any of some residuals."""
    size = steps.growth.shape[1]
    rate_error = len(steps.start)
    mean = jnp.zeros((size, *residuals.shape[2:]), residuals.dtype)
    # The error of the rate and passing errors are over their standard deviations.
    variances = np.concatenate([np.ones(rate_error + 1), steps.at_start])
    diagonal = jnp.asarray(np.diag(variances), residuals.dtype)[..., None]
    covariance = jnp.broadcast_to(diagonal, (size, size, residuals.shape[-1]))
    covariance = covariance.at[:rate_error, :rate_error].set(steps.start)
    covariance = covariance.at[LOG_T, LOG_T].add(noise.inverse_number * noise.first)
    return _State(mean, covariance)


class _AtNode(NamedTuple):
    """One node in the filter: the way to it, and what is measured there.

    Attributes:
        growth, increment: see `_Steps`.
        rotation_slope: derivative of ln T_rot in y, 0 for smooth spheres.
        by_size_ratio: see `Nodes`.
        residuals, variances, sensitivity, used: see `filtered`.
        sizes: see `_Steps`.
    """

    growth: Array
    increment: Array
    rotation_slope: Array
    by_size_ratio: Array | None
    residuals: Array
    variances: Array
    sensitivity: Array
    sizes: Array
    used: Array


def _filter_step(unit: Array, state: _State, at: _AtNode) -> tuple[_State, Filtered]:
    """Return the state after the values of a node, and their innovations and variances.

    Args:
        unit: unit vectors of the variables, shape (n, n, 1).
        state: at the node before.
        at: the node.
    """
    state = _predict(state, at.growth, at.increment)
    innovations = []
    variances = []
    for quantity, weights in enumerate(_weights(unit, at)):
        state, innovation, variance = _update(
            state, weights, at.residuals[quantity], at.variances[quantity], at.used[quantity]
        )
        innovations.append(innovation)
        variances.append(variance)
    return state, Filtered(jnp.stack(innovations), jnp.stack(variances))


def _predict(state: _State, growth: Array, increment: Array) -> _State:
    """Return the state at the next node, before its values: F x and F C F^T + the increment."""
    mean = state.mean + jnp.sum(growth[:, :, None] * state.mean[None], axis=1)
    moved = state.covariance + product(growth, state.covariance)
    covariance = moved + product(moved, transposed(growth)) + increment
    return _State(mean, covariance)


def _weights(unit: Array, at: _AtNode) -> tuple[Array, Array]:
    """Return the weights of the variables in the measured ln T and ln T_rot, shape (n, gases)."""
    first = len(unit) - len(at.sizes)
    passing = jnp.sum(unit[first:] * at.sizes[:, None], axis=0)
    of_T = at.sensitivity * unit[LOG_T] + passing
    if at.by_size_ratio is not None:  # T by the energy also depends on q
        of_T = of_T + at.sensitivity * at.by_size_ratio * unit[RATIO]
    of_T_rot = unit[LOG_T] + at.rotation_slope * unit[RATIO]  # ln T_rot = ln T + ln(T_rot/T)
    return of_T, of_T_rot


def _update(
    state: _State, weights: Array, value: Array, variance: Array, used: Array
) -> tuple[_State, Array, Array]:
    """Return the state after a value, its innovation and its variance.

    The value is the sum of the variables with these weights, shape (n, gases), and an independent
    error of the given variance. It changes nothing where `used` is 0.
    """
    mean, covariance = state
    with_value = jnp.sum(covariance * weights, axis=1)
    innovation_variance = jnp.sum(weights * with_value, axis=0) + variance
    innovation = used * (value - jnp.sum(weights[:, None] * mean, axis=0))
    gain = used * with_value / innovation_variance
    mean = mean + gain[:, None] * innovation[None]
    covariance = covariance - innovation_variance * gain[:, None] * gain[None]
    return _State(mean, covariance), innovation, innovation_variance
