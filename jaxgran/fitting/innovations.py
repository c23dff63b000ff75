"""The innovations of a measured curve: one function, which `log_likelihood` and every fit call.

The residuals of a run of N grains are a Gaussian process. Between two times the fluctuations about
kinetic theory obey a linear stochastic equation (`jaxgran.theory.covariance`); its solution is
compared with the measured values one after the other, as a Kalman filter does. Each value then has
an innovation, its residual minus what is expected from all values before it, and the variance of
that: ``-2 ln L = sum innovation^2/variance + ln variance``. No matrix of all points is formed, so
that a curve of a thousand points costs no more than its points.
"""

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
    """Curves of some neighbouring gases at times that begin at 0 and include those of the data.

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
    that of f times df/dy. Where y is below its error, the error replaces the first y, which no
    parameter changes.
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
        noise: what makes them scatter; its `inverse_number` has the shape (gases,).
    """
    values = observed.values[..., None]
    errors = observed.errors[..., None]
    residuals = log_ratio(values, log_computed, errors)
    variances = (errors / jnp.exp(log_computed)) ** 2 + observed.simulation[..., None]
    variances = variances.at[:, 0].add(noise.white**2)
    found, spread = filtered(
        gas, nodes, residuals[:, :, None], variances, sensitivity, observed.used, noise
    )
    return Innovations(found[:, :, 0], spread, log_density_change(values, log_computed, errors))


def filtered(
    gas: Gas,
    nodes: Nodes,
    residuals: Float[Array, "nodes 2 columns gases"],
    variances: Float[Array, "nodes 2 gases"],
    sensitivity: Float[Array, "nodes gases"],
    used: Float[Array, "nodes 2"],
    noise: Noise,
    differentiable: bool = False,
) -> tuple[Float[Array, "nodes 2 columns gases"], Float[Array, "nodes 2 gases"]]:
    """Return the innovations of columns of residuals, and the variances that they share.

    An innovation is 0 where nothing is used, and the variance is then that which a value would
    have.

    Args:
        residuals: of T and of T_rot, relative.
        variances: of their independent errors.
        gas, nodes, sensitivity, used, noise: see `innovations`.
        differentiable: whether derivatives in reverse mode are taken.
    """
    with jax.numpy_rank_promotion("allow"):  # the gases are the last axis of all arrays
        steps = _steps(gas, nodes, noise, differentiable)
        by_size = nodes.by_size_ratio
        return _run_filter(steps, residuals, variances, sensitivity, used, noise, by_size)


def _run_filter(
    steps: tuple[Array, Array, Array, Array],
    residuals: Float[Array, "nodes 2 columns gases"],
    variances: Float[Array, "nodes 2 gases"],
    sensitivity: Float[Array, "nodes gases"],
    used: Float[Array, "nodes 2"],
    noise: Noise,
    by_size_ratio: Float[Array, "nodes gases"] | None = None,
) -> tuple[Float[Array, "nodes 2 columns gases"], Float[Array, "nodes 2 gases"]]:
    start, changes, increments, of_rotation = steps
    dtype = residuals.dtype
    lanes = residuals.shape[-1]
    size = changes.shape[1]
    rate_error, sample = size - 2, size - 1
    first = jnp.zeros((size, size, lanes), dtype)
    first = first.at[: size - 2, : size - 2].set(start)
    first = first.at[0, 0].add(noise.inverse_number * noise.first)
    first = first.at[rate_error, rate_error].set(1.0)
    first = first.at[sample, sample].set(noise.sample)
    mean = jnp.zeros((size, *residuals.shape[2:]), dtype)
    variances = variances + SMALLEST_VARIANCE
    unit = jnp.eye(size, dtype=dtype)[..., None]

    def update(state, weights, value, variance, is_used):
        """Return the state after a value, its innovation and its variance.

        The value is the sum of the variables with these weights, shape (n, gases), and an
        independent error of the given variance.
        """
        mean, covariance = state
        with_value = jnp.sum(covariance * weights, axis=1)
        whole = jnp.sum(weights * with_value, axis=0) + variance
        innovation = is_used * (value - jnp.sum(weights[:, None] * mean, axis=0))
        gain = is_used * with_value / whole
        mean = mean + gain[:, None] * innovation[None]
        covariance = covariance - whole * gain[:, None] * gain[None]
        return (mean, covariance), innovation, whole

    def step(state, at):
        mean, covariance = state
        change, increment, share, by_rotation, value, variance, is_used, by_size = at
        mean = mean + jnp.sum(change[:, :, None] * mean[None], axis=1)
        moved = covariance + product(change, covariance)
        covariance = moved + product(moved, transposed(change)) + increment
        # Measured: ln T of the gas with the sampling error, and ln T_rot = ln T + ln(T_rot/T).
        of_T = share * unit[0] + unit[sample]
        if by_size is not None:  # T by the energy also depends on q
            of_T = of_T + share * by_size * unit[1]
        of_rotation = unit[0] + by_rotation * unit[1]
        state = mean, covariance
        state, of_first, variance_of_first = update(state, of_T, value[0], variance[0], is_used[0])
        state, of_second, variance_of_second = update(
            state, of_rotation, value[1], variance[1], is_used[1]
        )
        found = jnp.stack([of_first, of_second])
        return state, (found, jnp.stack([variance_of_first, variance_of_second]))

    at = changes, increments, sensitivity, of_rotation, residuals, variances, used, by_size_ratio
    return jax.lax.scan(step, (mean, first), at)[1]


def _steps(
    gas: Gas, nodes: Nodes, noise: Noise, differentiable: bool
) -> tuple[Array, Array, Array, Array]:
    """Return what happens to the variables from each node's predecessor to it.

    The variables of the run (`jaxgran.theory.covariance.process`) are followed by the
    relative error of theory's cooling rate over its standard deviation, and by the sampling error.

    Returns:
        covariance of the run at its start; propagators less 1, and the noise that is added, shape
        (nodes, n, n, gases); and the derivative of ln T_rot in the second variable, shape (nodes,
        gases).
    """
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
    drift = jnp.zeros((size, size, *nodes.rotation.shape), jacobian.dtype)
    noises = drift.at[:rate_error, :rate_error].set(noise.inverse_number * spread * collisions)
    drift = drift.at[:rate_error, :rate_error].set(jacobian * collisions)
    # An error of the rate moves all temperatures along their mean course.
    error = _middle(noise.rate_error)[:, None]
    of_T = _change(nodes.log_temperature)
    drift = drift.at[0, rate_error].set(error * of_T)
    if gas.surface is not None:
        of_ratio = _change(jnp.log(nodes.rotation + ROTATION_OFFSET))
        drift = drift.at[1, rate_error].set(error * of_ratio)
    if nodes.size_ratio is not None:
        drift = drift.at[1, rate_error].set(error * _change(nodes.size_ratio))
    memory = jnp.abs(of_T) / RATE_ERROR_LENGTH
    drift = drift.at[rate_error, rate_error].set(-memory)
    noises = noises.at[rate_error, rate_error].set(2 * memory)
    flat = size, size, -1
    needed: Any = NUM_DOUBLINGS
    if not differentiable:
        # A step is so short that no variable changes by more than 1/64 of itself.
        longest = jnp.max(jnp.abs(drift))
        needed = jnp.clip(jnp.ceil(jnp.log2(64 * longest)), 1, NUM_DOUBLINGS).astype(int)
    found = propagators(drift.reshape(flat), noises.reshape(flat), needed)
    # The sampling error is independent of all others.
    forgotten = jnp.expm1(-SAMPLE_MEMORY * collisions)
    sampled = -noise.sample * jnp.expm1(-2 * SAMPLE_MEMORY * collisions)
    changes, increments = (
        jnp.moveaxis(jnp.pad(x.reshape(drift.shape), [(0, 1), (0, 1), (0, 0), (0, 0)]), 2, 0)
        for x in found
    )
    changes = changes.at[:, size, size].set(forgotten)
    increments = increments.at[:, size, size].set(sampled)
    turning = nodes.rotation > 0
    of_rotation = (nodes.rotation + ROTATION_OFFSET) / jnp.where(turning, nodes.rotation, jnp.inf)
    return noise.inverse_number * starts[:, :, 0], changes, increments, of_rotation


def _middle(x: Array) -> Array:
    """Return means of neighbours along the first axis, from a predecessor of the first on."""
    return jnp.concatenate([x[:1], (x[1:] + x[:-1]) / 2])


def _change(x: Array) -> Array:
    """Return differences of neighbours along the first axis, 0 for the first."""
    return jnp.diff(x, prepend=x[:1], axis=0)
