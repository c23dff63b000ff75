"""The logarithm of the likelihood of a measured curve, a pure function of the gas.

It is the likelihood of `jaxgran.fitting.innovations`, which every fit maximises. What a fit treats
as nuisance parameters is integrated out.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.data.run_options import DEFAULTS
from jaxgran.fitting.guesses import guess_from_data
from jaxgran.fitting.innovations import Nodes, filtered, log_density_change, log_ratio
from jaxgran.fitting.measured_rows import curve_rows, with_rate_error
from jaxgran.fitting.prediction import times_with_nodes
from jaxgran.fitting.rows import CALIBRATION, ROTATION, CurveRows, Displacement
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import checked_model
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas
from jaxgran.theory.sizes import energy_ratio, energy_slope

STEPS_OF_KNOWN_N = np.linspace(-3.0, 3.0, 7)
"""Values of the logarithm of N over which a likelihood is integrated, in standard errors of its
prior."""

STEPS_OF_UNKNOWN_N = np.linspace(-2.5, 2.5, 25)
"""The same where N is not known."""

LAW_CONSTANTS = ("dissipative_constant", "coefficient", "drops")
"""Parameters of laws that `guess_from_data` knows."""

COMMON_FACTORS = {ROTATION: (0.0, 1.0), CALIBRATION: (1.0, 1.0)}
"""Whether a common factor of known width applies to T and to T_rot."""


def log_likelihood(
    gas: Gas, measurement: Measurement, *, model: AbstractModel | None = None
) -> Float[Array, ""]:
    """Logarithm of the likelihood of a measured curve, up to a constant.

    It is the likelihood that `jaxgran.fit` maximises where T_0 is known, without priors, and
    without the errors of T that a fit finds in a curve without errors: ``-(r^T C^-1 r + ln det
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
        ValueError: for a drop test, a prior of t0, a scene that the model does not support, or a
            stochastic model, whose noise differs between calls.

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
    if START_TIME in measurement.priors:
        raise ValueError(
            "log_likelihood has no t0: give the times since the start of the cooling, and "
            "measurement.priors without t0"
        )
    model.check_scene(gas)
    with jax.ensure_compile_time_eval():  # the measurement is known, where the gas is traced
        data = _data(measurement, model)
    computed = model.simulate(gas, jnp.asarray(data.times), DEFAULTS)
    nodes = _nodes(gas, data.times, computed, measurement.of_energy)
    value = _likelihood_of_temperatures(gas, nodes, data)
    if data.rows.displacement is not None:
        value = value + _likelihood_of_displacement(
            data.rows.displacement, nodes, computed, data.place
        )
    return jnp.where(jnp.isnan(value), -jnp.inf, value)


class _Data(NamedTuple):
    """A measured curve.

    Attributes:
        rows: as it is compared with the model, with the error of its cooling rate.
        times: of the nodes, s.
        place: place of each time of the data among them.
    """

    rows: CurveRows
    times: Float[np.ndarray, "nodes"]
    place: Int[np.ndarray, "times"]


def _data(measurement: Measurement, model: AbstractModel) -> _Data:
    rows, _ = curve_rows("", measurement, model, fits_T_0=False, fits_t0=False)
    guess = guess_from_data(measurement.gas, rows.curve, LAW_CONSTANTS)
    rows = with_rate_error(rows, model, guess)
    times, place = times_with_nodes(np.asarray(rows.curve.times) * rows.faster, rows.unit_time)
    return _Data(rows, times, place)


def _nodes(gas: Gas, times: np.ndarray, computed: CoolingCurve, of_energy: bool) -> Nodes:
    """Return a computed curve as nodes, without the axis of gases."""
    nothing = jnp.zeros_like(computed.temperature)
    T_rot = computed.rotational_temperature
    size_ratio = None
    by_size_ratio = None
    if computed.size_ratio is not None:
        size_ratio = jnp.log(computed.size_ratio)
        by_size_ratio = energy_slope(gas.size_spread, size_ratio) if of_energy else nothing
    return Nodes(
        jnp.asarray(times),
        jnp.log(computed.temperature),
        nothing if T_rot is None else T_rot / computed.temperature,
        nothing if computed.sonine is None else computed.sonine,
        _collisions(gas, times, computed),
        size_ratio,
        by_size_ratio,
    )


def _collisions(gas: Gas, times: np.ndarray, computed: CoolingCurve) -> Array:
    """Return collisions per particle; of a Maxwellian gas for a model that does not count them."""
    if computed.collisions is not None:
        return computed.collisions
    speed = jnp.sqrt(computed.temperature / gas.temperature)
    steps = jnp.diff(times) * (speed[1:] + speed[:-1]) / 2 * gas.collision_frequency
    return jnp.append(0.0, jnp.cumsum(steps))


def _log_measured(gas: Gas, nodes: Nodes, of_energy: bool) -> Float[Array, "nodes 2"]:
    """Return ln T, as it is measured, and ln T_rot."""
    log_T = nodes.log_temperature
    ratio = nodes.rotation
    logs = jnp.stack([log_T, log_T + jnp.log(jnp.where(ratio > 0, ratio, 1.0))], axis=1)
    if of_energy and nodes.size_ratio is not None:
        logs = logs.at[:, 0].add(jnp.log(energy_ratio(gas.size_spread, nodes.size_ratio)))
    return logs


def _likelihood_of_temperatures(gas: Gas, nodes: Nodes, data: _Data) -> Float[Array, ""]:
    """Return the logarithm of the likelihood of T and T_rot."""
    rows = data.rows
    observed = jax.tree.map(jnp.asarray, rows.at_nodes(data.times.size, data.place))
    logs = _log_measured(gas, nodes, rows.measurement.of_energy)
    residuals = log_ratio(observed.values, logs, observed.errors)
    variances = (observed.errors / jnp.exp(logs)) ** 2
    common_factors = {name: x for name, x in COMMON_FACTORS.items() if name in rows.nuisances}
    shapes = [jnp.broadcast_to(jnp.asarray(x), residuals.shape) for x in common_factors.values()]
    widths = jnp.asarray([rows.nuisances[name] for name in common_factors])
    is_known = rows.measurement.num_particles is not None
    steps = STEPS_OF_KNOWN_N if is_known else STEPS_OF_UNKNOWN_N
    factors_of_N = jnp.exp(rows.grains.log_error * steps)

    def with_axis_of_N(x: Any) -> Any:
        """Return an array with a last axis, of values of N."""
        return None if x is None else jnp.broadcast_to(x[..., None], (*x.shape, steps.size))

    each = Nodes(*(with_axis_of_N(x) for x in nodes))
    values, spread = filtered(
        jax.tree.map(lambda x: jnp.broadcast_to(x, (steps.size, *jnp.shape(x))), gas),
        each._replace(times=nodes.times, sonine=nodes.sonine),
        with_axis_of_N(jnp.stack([residuals, *shapes], axis=-1)),
        with_axis_of_N(variances),
        with_axis_of_N(jnp.ones_like(nodes.log_temperature)),
        observed.used,
        jax.tree.map(jnp.asarray, rows.noise(data.times, factors_of_N)),
        differentiable=True,
    )

    def of_scatter(values: Array, spread: Array, step: Array) -> Array:
        square = _without_factors(values, observed.used / spread, widths)
        return -0.5 * (square + jnp.sum(observed.used * jnp.log(spread)) + step**2)

    each_value = jax.vmap(of_scatter, in_axes=(-1, -1, 0))
    value = jax.scipy.special.logsumexp(each_value(values, spread, jnp.asarray(steps)))
    change = log_density_change(observed.values, logs, observed.errors)
    return value - 0.5 * jnp.sum(observed.used * change)


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


def _likelihood_of_displacement(
    measured: Displacement, nodes: Nodes, computed: CoolingCurve, place: np.ndarray
) -> Float[Array, ""]:
    """Return the logarithm of the likelihood of <dr^2>."""
    assert computed.displacement is not None
    collisions = nodes.collisions[place]
    diffusive = collisions / (1 + collisions)
    known = jnp.where(measured.used, computed.displacement[place], 1.0)
    columns = jnp.stack([measured.logs - jnp.log(known), diffusive], axis=-1)
    columns = jnp.asarray(measured.whitening) @ columns
    weights = jnp.ones(measured.logs.shape)
    return -0.5 * _without_factors(columns, weights, jnp.asarray([measured.accuracy]))
