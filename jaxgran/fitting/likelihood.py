"""The likelihood of a measured curve: one function, which `log_likelihood` and every fit call.

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
import numpy as np
from jaxtyping import Array, Float

from jaxgran.data.curve import DEFAULTS, CoolingCurve
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.parameters import guess_from_data
from jaxgran.fitting.rows import (
    CALIBRATION,
    ROTATION,
    Displacement,
    Noise,
    Observed,
    curve_rows,
    times_with_nodes,
    with_rate_error,
)
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_model
from jaxgran.models.kinetic_theory import KineticTheory
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
from jaxgran.theory.sizes import energy_ratio, energy_slope

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

STEPS_OF_KNOWN_N = np.linspace(-3.0, 3.0, 7)
"""Values of the logarithm of N over which a likelihood is integrated, in standard errors of its
prior."""

STEPS_OF_UNKNOWN_N = np.linspace(-2.5, 2.5, 25)
"""The same where N is not known."""

LAW_CONSTANTS = ("dissipative_constant", "coefficient", "drops")
"""Parameters of laws that `guess_from_data` knows."""

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
        noise: what makes them scatter; its `scatter` has the shape (gases,).
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
    first = first.at[0, 0].add(noise.scatter * noise.first)
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

    The variables are those of the run (`jaxgran.theory.covariance.process`), followed by the
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
    noises = drift.at[:rate_error, :rate_error].set(noise.scatter * spread * collisions)
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
    return noise.scatter * starts[:, :, 0], changes, increments, of_rotation


def _middle(x: Array) -> Array:
    """Return means of neighbours along the first axis, from a predecessor of the first on."""
    return jnp.concatenate([x[:1], (x[1:] + x[:-1]) / 2])


def _change(x: Array) -> Array:
    """Return differences of neighbours along the first axis, 0 for the first."""
    return jnp.diff(x, prepend=x[:1], axis=0)


def log_likelihood(
    gas: Gas, measurement: Measurement, *, model: AbstractModel | None = None
) -> Float[Array, ""]:
    """Logarithm of the likelihood of a measured curve, up to a constant.

    It is the likelihood that `jaxgran.fit` maximises, without priors: ``-(r^T C^-1 r + ln det
    C)/2`` with the residuals r of ln T, and of ln T_rot and <dr^2> where they are compared, and
    their covariance C by the collisions of N grains, the errors of the measurement and the error
    of theory's cooling rate. Common factors of T_rot and of <dr^2>, the scale of T, and the
    scatter of N grains (any N, where it is not known) are integrated out.

    This is a pure function of the gas, for `jax.jit`, `jax.vmap` and `jax.grad`;
    `experiments/fit/sample_posterior.py` adds priors and samples it.

    Args:
        gas: the scene; its values may be traced.
        measurement: of a curve.
        model: a model without noise, by default `jaxgran.KineticTheory()`.

    Returns:
        The logarithm; -inf if the model cannot compute the curve.

    Raises:
        ValueError: for a drop test, a scene that the model does not support, or a stochastic model,
            whose noise differs between calls.

    >>> measurement = jaxgran.Measurement(gas, curve, num_particles=1000)
    >>> other = gas.replace(dissipative_constant=4e-6)
    >>> likelihood = jaxgran.log_likelihood(gas, measurement)
    >>> bool(likelihood > jaxgran.log_likelihood(other, measurement))
    True
    """
    model = KineticTheory() if model is None else model
    if checked_model(model).stochastic:
        raise ValueError(
            f"a likelihood needs a model without noise, got {type(model).__name__}, which is "
            "stochastic. Use jaxgran.KineticTheory()"
        )
    if not isinstance(measurement, Measurement):
        raise ValueError(f"measurement must be a jaxgran.Measurement, got {measurement!r:.60}")
    model.check_scene(gas)
    with jax.ensure_compile_time_eval():  # the measurement is known, where the gas is traced
        rows, _ = curve_rows("", measurement, model, fits_T_0=False, fits_t0=False)
        times, place = times_with_nodes(np.asarray(rows.curve.times) * rows.faster, rows.unit_time)
        guess = guess_from_data(measurement.gas, rows.curve, LAW_CONSTANTS)
        rows = with_rate_error(rows, model, guess)
    computed = model.simulate(gas, jnp.asarray(times), DEFAULTS)
    nothing = jnp.zeros_like(computed.temperature)
    log_T = jnp.log(computed.temperature)
    T_rot = computed.rotational_temperature
    ratio = nothing if T_rot is None else T_rot / computed.temperature
    speed = jnp.sqrt(computed.temperature / gas.temperature)
    steps = jnp.diff(times) * (speed[1:] + speed[:-1]) / 2 * gas.collision_frequency
    collisions = jnp.append(0.0, jnp.cumsum(steps))
    collisions = collisions if computed.collisions is None else computed.collisions
    observed = jax.tree.map(jnp.asarray, rows.at_nodes(times.size, place))
    logs = jnp.stack([log_T, log_T + jnp.log(jnp.where(ratio > 0, ratio, 1.0))], axis=1)
    size_ratio = by_size_ratio = None
    if computed.size_ratio is not None:
        size_ratio = jnp.log(computed.size_ratio)
        spread = gas.size_spread
        by_size_ratio = nothing
        if measurement.of_energy:
            logs = logs.at[:, 0].add(jnp.log(energy_ratio(spread, size_ratio)))
            by_size_ratio = energy_slope(spread, size_ratio)
    residuals = log_ratio(observed.values, logs, observed.errors)
    variances = (observed.errors / jnp.exp(logs)) ** 2
    density_change = log_density_change(observed.values, logs, observed.errors)
    columns = [residuals]
    widths = []
    for name, shape in ((ROTATION, (0.0, 1.0)), (CALIBRATION, (1.0, 1.0))):
        if name in rows.nuisances:
            columns.append(jnp.broadcast_to(jnp.asarray(shape), residuals.shape))
            widths.append(rows.nuisances[name])
    is_known = measurement.num_particles is not None
    log_scatters = STEPS_OF_KNOWN_N if is_known else STEPS_OF_UNKNOWN_N
    count = log_scatters.size

    def for_each(x: Array) -> Array:
        return jnp.broadcast_to(x[..., None], (*x.shape, count))

    nodes = Nodes(
        jnp.asarray(times),
        for_each(log_T),
        for_each(ratio),
        nothing if computed.sonine is None else computed.sonine,
        for_each(collisions),
        None if size_ratio is None else for_each(size_ratio),
        None if by_size_ratio is None else for_each(by_size_ratio),
    )
    values, spread = filtered(
        jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *jnp.shape(x))), gas),
        nodes,
        for_each(jnp.stack(columns, axis=-1)),
        for_each(variances),
        for_each(jnp.ones_like(log_T)),
        observed.used,
        jax.tree.map(
            jnp.asarray,
            rows.noise(times, rows.scatter * jnp.exp(rows.scatter_error * log_scatters)),
        ),
        differentiable=True,
    )
    used = observed.used

    def of_scatter(values: Array, spread: Array, step: Array) -> Array:
        found = _without_factors(values, used / spread, jnp.asarray(widths))
        return -0.5 * (found + jnp.sum(used * jnp.log(spread)) + step**2)

    value = jax.scipy.special.logsumexp(
        jax.vmap(of_scatter, in_axes=(-1, -1, 0))(values, spread, jnp.asarray(log_scatters))
    )
    value = value - 0.5 * jnp.sum(used * density_change)
    if rows.displacement is not None:
        assert computed.displacement is not None
        counts = collisions[place]
        value = value - 0.5 * _of_displacement(rows.displacement, counts, computed, place)
    return jnp.where(jnp.isnan(value), -jnp.inf, value)


def _without_factors(values: Array, weights: Array, widths: Array) -> Array:
    """Return ``r^T W r`` of the first column r, with its common factors integrated out.

    The factors have the shapes of the other columns, and are Gaussian about 0 with these widths.
    """
    flat = values.reshape(-1, values.shape[-1])
    weights = weights.reshape(-1)
    square = jnp.sum(weights * flat[:, 0] ** 2)
    if not widths.size:
        return square
    others = flat[:, 1:] * widths[None]
    projection = others.T @ (weights * flat[:, 0])
    matrix = jnp.eye(widths.size) + others.T @ (weights[:, None] * others)
    return (
        square - projection @ jnp.linalg.solve(matrix, projection) + jnp.linalg.slogdet(matrix)[1]
    )


def _of_displacement(
    measured: Displacement, collisions: Array, computed: CoolingCurve, place: np.ndarray
) -> Array:
    assert computed.displacement is not None
    used = measured.errors > 0
    errors = np.where(used, measured.errors, 1.0)
    diffusive = collisions / (1 + collisions)
    values = jnp.log(np.where(used, measured.values, 1.0))
    difference = values - jnp.log(jnp.where(used, computed.displacement[place], 1.0))
    columns = jnp.stack([difference, diffusive], axis=-1)
    weights = jnp.asarray(used / errors**2)
    return _without_factors(columns, weights, jnp.asarray([measured.accuracy]))
