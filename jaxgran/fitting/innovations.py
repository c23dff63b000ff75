"""The innovations of a measured curve: one function, which `log_likelihood` and every fit call.

The residuals of a run of N grains are a Gaussian process. Between two times the fluctuations about
kinetic theory obey a linear stochastic equation (`jaxgran.theory.covariance`); its solution is
compared with the measured values one after the other, as a Kalman filter does. Each value then has
an innovation, its residual minus what is expected from all values before it, and the variance of
that: ``-2 ln L = sum innovation^2/variance + ln variance``. No matrix of all points is formed, so
that a curve of a thousand points costs no more than its points.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.fitting.rows import Noise, Observed
from jaxgran.scene.gas import Gas
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

SAMPLE_MEMORY = 0.57
"""Decay of the sampling error of T, over the collisions of a grain.

Measured: 60 of 250 spheres, eps = .9, 400 replicas: correlations .75, .56, .42, .33, .26, .20 after
.5, 1, ..., 3 collisions."""

LOG_FROM, LINEAR_TO = 10.0, 5.0
"""T over its error above which ln T is compared, and below which T itself is."""

LOG_RATIO_FROM = 0.5
"""Measured over computed value below which ln is continued by its tangent."""

SMALLEST_VARIANCE = 1e-12
"""Relative variance that is added to each value, so that exact ones do not divide by 0."""


class Nodes(NamedTuple):
    """Curves of some neighbouring gases at times from 0 on that include the times of the data.

    Arrays have the shape (nodes, gases): operations on small matrices are fast where the last axis
    is long.

    Attributes:
        times: t, s, not decreasing, shape (nodes,).
        log_temperature: ln T, T in m^2/s^2.
        rotation: T_rot/T; 0 for smooth spheres.
        sonine: a_2, shape (nodes,).
        collisions: per particle.
        size_ratio: q of spheres of unequal sizes (`jaxgran.theory.sizes`); None for equal spheres.
        by_size_ratio: derivative of ln T in q, for the measured T: 0 unless T is given by the
            energy; None for equal spheres.
    """

    times: Any
    log_temperature: Any
    rotation: Any
    sonine: Any
    collisions: Any
    size_ratio: Any = None
    by_size_ratio: Any = None


class Innovations(NamedTuple):
    """Residuals of measured values minus what is expected from all values before them.

    In their first form all arrays have the shape (nodes, 2, gases).

    Attributes:
        values: innovations of T and of T_rot, relative; 0 where nothing is used.
        variances: of them.
        density_changes: what -2 ln L gains where T is compared in place of ln T
            (`log_density_change`).
    """

    values: Any
    variances: Any
    density_changes: Any


class Filtered(NamedTuple):
    """Innovations of columns of residuals, which share their variances.

    Attributes:
        values: 0 where nothing is used, shape (nodes, 2, columns, gases).
        variances: of the innovations; where nothing is used, the variance that a value would
            have; shape (nodes, 2, gases).
    """

    values: Any
    variances: Any


def innovations(
    gas: Gas,
    nodes: Nodes,
    log_computed: Float[Array, "nodes 2 gases"],
    sensitivity: Float[Array, "nodes gases"],
    observed: Observed,
    noise: Noise,
) -> Innovations:
    """Return the innovations of a measured curve about some gases.

    Args:
        gas: neighbouring scenes: its floats have an axis (gases,).
        nodes: their curves by kinetic theory.
        log_computed: ln T and ln T_rot with which the measured values are compared.
        sensitivity: derivative of the computed ln T in ln T of the gas: 1 without a noise floor.
        observed: the measured values.
        noise: what makes them scatter; its `inverse_number` and `white` have the shape (gases,).
    """
    values = observed.values[..., None]
    errors = observed.errors[..., None]
    residuals = log_ratio(values, log_computed, errors)
    variances = (errors / jnp.exp(log_computed)) ** 2 + observed.simulation[..., None]
    variances = variances.at[:, 0].add(noise.white[None] ** 2)
    found = filtered(
        gas, nodes, residuals[:, :, None], variances, sensitivity, observed.used, noise
    )
    changes = log_density_change(values, log_computed, errors)
    return Innovations(found.values[:, :, 0], found.variances, changes)


def log_ratio(values: Array, log_computed: Array, errors: Array) -> Array:
    """Return the residual of a measured value, relative to the computed one.

    It is ln(measured/computed) where the computed value is many errors above 0, and their
    difference over the computed value where it is within some errors of 0; in between a mean of
    both, so that it is continuous. The choice is by the computed value alone: one by the measured
    value would favour large ones.
    """
    ratio = values / jnp.exp(log_computed)
    # Continued to small and negative ratios by its tangent.
    above = ratio > LOG_RATIO_FROM
    tangent = jnp.log(LOG_RATIO_FROM) + ratio / LOG_RATIO_FROM - 1
    log = jnp.where(above, jnp.log(jnp.maximum(ratio, LOG_RATIO_FROM)), tangent)
    share = _share_of_log(log_computed, errors)
    return jnp.where(share < 1, share * log + (1 - share) * (ratio - 1), log)


def log_density_change(values: Array, log_computed: Array, errors: Array) -> Array:
    """Return what -2 ln L gains as `log_ratio` is not everywhere ln of the measured value.

    It is ``-2 ln(y df/dy)`` for the residual f of a value y, 0 where f is ln y: the density of y is
    the density of f times df/dy. Where y is below its error, the error replaces the first y, which
    no parameter changes.
    """
    ratio = values / jnp.exp(log_computed)
    share = _share_of_log(log_computed, errors)
    slope = share / jnp.maximum(ratio, LOG_RATIO_FROM) + 1 - share
    unit = jnp.where(values > errors, values, errors)
    near_zero = share < 1
    change = -2 * (jnp.log(jnp.where(near_zero, unit * slope, 1.0)) - log_computed)
    return jnp.where(near_zero, change, 0.0)


def _share_of_log(log_computed: Array, errors: Array) -> Array:
    """Return 1 where logarithms are compared, 0 where values are."""
    distance = jnp.exp(log_computed) / jnp.where(errors > 0, errors, jnp.finfo(errors.dtype).tiny)
    share = jnp.clip((distance - LINEAR_TO) / (LOG_FROM - LINEAR_TO), 0.0, 1.0)
    return share**2 * (3 - 2 * share)


def filtered(
    gas: Gas,
    nodes: Nodes,
    residuals: Float[Array, "nodes 2 columns gases"],
    variances: Float[Array, "nodes 2 gases"],
    sensitivity: Float[Array, "nodes gases"],
    used: Float[Array, "nodes 2"],
    noise: Noise,
    differentiable: bool = False,
) -> Filtered:
    """Return the innovations of columns of residuals, and the variances that they share.

    Args:
        residuals: of T and of T_rot, relative.
        variances: of their independent errors.
        gas, nodes, sensitivity, used, noise: see `innovations`.
        differentiable: whether derivatives in reverse mode are taken.
    """
    with jax.numpy_rank_promotion("allow"):  # the gases are the last axis of all arrays
        steps = _steps(gas, nodes, noise, differentiable)
        size = steps.growth.shape[1]
        mean = jnp.zeros((size, *residuals.shape[2:]), residuals.dtype)
        start = _State(mean, _start_covariance(steps, noise, mean))
        at_nodes = _AtNode(
            growth=steps.growth,
            increment=steps.increments,
            sensitivity=sensitivity,
            rotation_slope=steps.rotation_slope,
            values=residuals,
            variances=variances + SMALLEST_VARIANCE,
            used=used,
            by_size_ratio=nodes.by_size_ratio,
        )
        unit = jnp.eye(size, dtype=mean.dtype)[..., None]
        _, found = jax.lax.scan(partial(_filter_step, unit), start, at_nodes)
    return found


class _Steps(NamedTuple):
    """What happens to the variables of a run from each node's predecessor to it.

    The variables of the run (`jaxgran.theory.covariance.process`) are followed by the relative
    error of theory's cooling rate over its standard deviation, and by the sampling error: n
    variables in all.

    Attributes:
        start: covariance of the variables of the run at its start, shape (n - 2, n - 2, gases).
        growth: propagators less 1, shape (nodes, n, n, gases).
        increments: what is added to the covariance, shape (nodes, n, n, gases).
        rotation_slope: derivative of ln T_rot in y, 0 for smooth spheres, shape (nodes, gases).
    """

    start: Any
    growth: Any
    increments: Any
    rotation_slope: Any


class _State(NamedTuple):
    """What is expected of the n variables of a run, given all values so far.

    Attributes:
        mean: shape (n, columns, gases).
        covariance: shape (n, n, gases).
    """

    mean: Array
    covariance: Array


class _AtNode(NamedTuple):
    """One node in the filter: the way to it, and what is measured there.

    Attributes:
        growth, increment, rotation_slope: see `_Steps`.
        sensitivity, values, variances, used: see `filtered`; `values` are its residuals.
        by_size_ratio: see `Nodes`.
    """

    growth: Array
    increment: Array
    sensitivity: Array
    rotation_slope: Array
    values: Array
    variances: Array
    used: Array
    by_size_ratio: Array | None


def _start_covariance(steps: _Steps, noise: Noise, mean: Array) -> Array:
    """Return the covariance of all variables at t = 0."""
    size = len(mean)
    rate_error = size - 2
    sample = size - 1
    first = jnp.zeros((size, size, mean.shape[-1]), mean.dtype)
    first = first.at[:rate_error, :rate_error].set(steps.start)
    first = first.at[LOG_T, LOG_T].add(noise.inverse_number * noise.first)
    first = first.at[rate_error, rate_error].set(1.0)
    return first.at[sample, sample].set(noise.sample)


def _filter_step(unit: Array, state: _State, at: _AtNode) -> tuple[_State, Filtered]:
    """Return the state after the values of a node, and their innovations and variances.

    Args:
        unit: unit vectors of the variables, shape (n, n, 1).
        state: at the node before.
        at: the node.
    """
    growth = at.growth
    mean = state.mean + jnp.sum(growth[:, :, None] * state.mean[None], axis=1)
    moved = state.covariance + product(growth, state.covariance)
    covariance = moved + product(moved, transposed(growth)) + at.increment
    state = _State(mean, covariance)
    # Measured: ln T of the gas with the sampling error, and ln T_rot = ln T + ln(T_rot/T).
    sample = len(mean) - 1
    of_T = at.sensitivity * unit[LOG_T] + unit[sample]
    if at.by_size_ratio is not None:  # T by the energy also depends on q
        of_T = of_T + at.sensitivity * at.by_size_ratio * unit[RATIO]
    of_rotation = unit[LOG_T] + at.rotation_slope * unit[RATIO]
    found = []
    spread = []
    for column, weights in enumerate((of_T, of_rotation)):
        state, innovation, variance = _with_value(
            state, weights, at.values[column], at.variances[column], at.used[column]
        )
        found.append(innovation)
        spread.append(variance)
    return state, Filtered(jnp.stack(found), jnp.stack(spread))


def _with_value(
    state: _State, weights: Array, value: Array, variance: Array, used: Array
) -> tuple[_State, Array, Array]:
    """Return the state after a value, its innovation and its variance.

    The value is the sum of the variables with these weights, shape (n, gases), and an independent
    error of the given variance.
    """
    mean, covariance = state
    with_value = jnp.sum(covariance * weights, axis=1)
    whole = jnp.sum(weights * with_value, axis=0) + variance
    innovation = used * (value - jnp.sum(weights[:, None] * mean, axis=0))
    gain = used * with_value / whole
    mean = mean + gain[:, None] * innovation[None]
    covariance = covariance - whole * gain[:, None] * gain[None]
    return _State(mean, covariance), innovation, whole


def _steps(gas: Gas, nodes: Nodes, noise: Noise, differentiable: bool) -> _Steps:
    process = _process(gas, nodes, noise)
    shape = process.drift.shape
    flat = (*shape[:2], -1)
    doublings = NUM_DOUBLINGS if differentiable else _needed_doublings(process.drift)
    of_run = propagators(process.drift.reshape(flat), process.noise.reshape(flat), doublings)
    growth, increments = (_with_one_more_variable(x.reshape(shape)) for x in of_run)
    # The sampling error is independent of all others.
    sample = shape[0]
    collisions = _change(nodes.collisions)
    forgotten = jnp.expm1(-SAMPLE_MEMORY * collisions)
    sampled = -noise.sample * jnp.expm1(-2 * SAMPLE_MEMORY * collisions)
    turning = nodes.rotation > 0
    slope = (nodes.rotation + ROTATION_OFFSET) / jnp.where(turning, nodes.rotation, jnp.inf)
    return _Steps(
        start=process.start,
        growth=growth.at[:, sample, sample].set(forgotten),
        increments=increments.at[:, sample, sample].set(sampled),
        rotation_slope=slope,
    )


class _Process(NamedTuple):
    """The linear stochastic equation of the variables of a run and of the error of the rate.

    Attributes:
        start: covariance of the variables of the run at its start, see `_Steps`.
        drift: matrix of the equation times each step, shape (n - 1, n - 1, nodes, gases).
        noise: covariance of its noise times each step, of the same shape.
    """

    start: Array
    drift: Array
    noise: Array


def _process(gas: Gas, nodes: Nodes, noise: Noise) -> _Process:
    first = nodes.log_temperature[:1]
    means = Mean(
        nodes.log_temperature - first,
        jnp.broadcast_to(nodes.sonine[:, None], nodes.rotation.shape),
        nodes.collisions,
        Spins(nodes.rotation, None, None),
        nodes.size_ratio,
    )
    rates = jax.vmap(run_process, in_axes=(0, -1), out_axes=-1)
    jacobian, spread, starts = rates(gas, jax.tree.map(_middle, means))
    collisions = _change(nodes.collisions)
    rate_error = len(jacobian)
    size = rate_error + 1
    nothing = jnp.zeros((size, size, *nodes.rotation.shape), jacobian.dtype)
    of_run = noise.inverse_number * spread * collisions
    noises = nothing.at[:rate_error, :rate_error].set(of_run)
    drift = nothing.at[:rate_error, :rate_error].set(jacobian * collisions)
    # An error of the rate moves all temperatures along their mean course.
    error = _middle(noise.rate_error)[:, None]
    change_of_T = _change(nodes.log_temperature)
    drift = drift.at[LOG_T, rate_error].set(error * change_of_T)
    if gas.surface is not None:
        change_of_y = _change(jnp.log(nodes.rotation + ROTATION_OFFSET))
        drift = drift.at[RATIO, rate_error].set(error * change_of_y)
    if nodes.size_ratio is not None:
        drift = drift.at[RATIO, rate_error].set(error * _change(nodes.size_ratio))
    memory = jnp.abs(change_of_T) / RATE_ERROR_LENGTH
    return _Process(
        start=noise.inverse_number * starts[:, :, 0],
        drift=drift.at[rate_error, rate_error].set(-memory),
        noise=noises.at[rate_error, rate_error].set(2 * memory),
    )


def _needed_doublings(drift: Array) -> Array:
    """Return the number of doublings of a step so short that no variable changes by more than 1/64
    of itself."""
    longest = jnp.max(jnp.abs(drift))
    return jnp.clip(jnp.ceil(jnp.log2(64 * longest)), 1, NUM_DOUBLINGS).astype(int)


def _with_one_more_variable(x: Float[Array, "n n nodes gases"]) -> Array:
    """Return matrices with one more row and column of 0, shape (nodes, n + 1, n + 1, gases)."""
    padded = jnp.pad(x, [(0, 1), (0, 1), (0, 0), (0, 0)])
    return jnp.moveaxis(padded, 2, 0)


def _middle(x: Array) -> Array:
    """Return means of neighbours along the first axis, from a predecessor of the first on."""
    return jnp.concatenate([x[:1], (x[1:] + x[:-1]) / 2])


def _change(x: Array) -> Array:
    """Return differences of neighbours along the first axis, 0 for the first."""
    return jnp.diff(x, prepend=x[:1], axis=0)
