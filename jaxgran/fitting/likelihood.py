"""The logarithm of the likelihood of a measured curve, a pure function of the gas.

Every fit maximises the same likelihood (`jaxgran.fitting.comparison`), of which it takes the
derivatives by hand, in numpy. Here it is written in jax.numpy, and what a fit treats as nuisance
parameters is integrated out. Its parts are:

- the residuals of ln T and ln T_rot: `log_ratio` of the measured values and of `_log_measured`;
- their covariance C, which `filtered` applies without forming it: the collisions of N grains and
  the error of theory's cooling rate, from `CurveRows.noise`, and the errors of the measurement;
- common factors of T and T_rot: further columns beside the residuals, see `_common_factors`;
- the residuals of ln <dr^2>, with a covariance of their own: `Displacement.whitening`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import START_TIME, Measurement
from jaxgran.data.run_options import Run
from jaxgran.fitting.guesses import guess_from_data
from jaxgran.fitting.innovations import log_density_change, log_ratio
from jaxgran.fitting.kalman import Filtered, Nodes, filtered
from jaxgran.fitting.measured_rows import curve_rows, with_rate_error
from jaxgran.fitting.prediction import COMMON_FACTORS, diffusive_share, maxwellian_collisions
from jaxgran.fitting.rows import CurveRows, Observed
from jaxgran.fitting.time_grid import TimeGrid, time_grid
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
        data = _measured_curve(measurement, model)
    times = data.grid.times
    computed = model.simulate(gas, jnp.asarray(times), Run())
    nodes = _nodes(gas, times, computed, measurement.of_energy)
    value = _likelihood_of_temperatures(gas, nodes, data)
    if data.rows.displacement is not None:
        value = value + _likelihood_of_displacement(nodes, computed, data)
    return jnp.where(jnp.isnan(value), -jnp.inf, value)


class _MeasuredCurve(NamedTuple):
    """A measured curve as a likelihood needs it; nothing here depends on the gas.

    Attributes:
        rows: the curve as it is compared with a model, with the error of the model's cooling rate.
        grid: the times of the nodes, at which the model computes T.
        observed: the measured values, their errors and whether they are used, at the nodes.
        steps_of_N: values of ln N over which a likelihood is integrated, in standard errors of its
            prior.
    """

    rows: CurveRows
    grid: TimeGrid
    observed: Observed
    steps_of_N: Float[np.ndarray, "steps"]


def _measured_curve(measurement: Measurement, model: AbstractModel) -> _MeasuredCurve:
    rows, _ = curve_rows("", measurement, model, fits_T_0=False, fits_t0=False)
    guess = guess_from_data(measurement.gas, rows.curve, LAW_CONSTANTS)
    rows = with_rate_error(rows, model, guess)
    grid = time_grid(np.asarray(rows.curve.times) * rows.faster, rows.unit_time)
    observed = jax.tree.map(jnp.asarray, rows.at_nodes(grid.times.size, grid.place))
    is_known = measurement.num_particles is not None
    return _MeasuredCurve(
        rows, grid, observed, STEPS_OF_KNOWN_N if is_known else STEPS_OF_UNKNOWN_N
    )


def _nodes(gas: Gas, times: np.ndarray, computed: CoolingCurve, of_energy: bool) -> Nodes:
    """Return a computed curve as nodes, without the axis of gases."""
    nothing = jnp.zeros_like(computed.temperature)
    T_rot = computed.rotational_temperature
    collisions = computed.collisions
    if collisions is None:
        collisions = maxwellian_collisions(gas, times, computed.temperature)
    size_ratio = None
    by_size_ratio = None
    if computed.size_ratio is not None:
        size_ratio = jnp.log(computed.size_ratio)
        by_size_ratio = energy_slope(gas.size_spread, size_ratio) if of_energy else nothing
    return Nodes(
        log_temperature=jnp.log(computed.temperature),
        rotation=nothing if T_rot is None else T_rot / computed.temperature,
        sonine=nothing if computed.sonine is None else computed.sonine,
        collisions=collisions,
        size_ratio=size_ratio,
        by_size_ratio=by_size_ratio,
    )


def _likelihood_of_temperatures(gas: Gas, nodes: Nodes, data: _MeasuredCurve) -> Float[Array, ""]:
    """Return the logarithm of the likelihood of T and T_rot."""
    observed = data.observed
    logs = _log_measured(gas, nodes, data.rows.measurement.of_energy)
    residuals = log_ratio(observed.values, logs, observed.errors)
    variances = (observed.errors / jnp.exp(logs)) ** 2
    factors = _common_factors(data.rows, residuals.shape)
    columns = jnp.stack([residuals, *factors.columns], axis=-1)
    filtered_columns = _filtered_for_each_N(gas, nodes, columns, variances, data)

    def at_one_N(one: Filtered, step: Array) -> Array:
        square = _without_factors(one.values, observed.used / one.variances, factors.widths)
        log_determinant = jnp.sum(observed.used * jnp.log(one.variances))
        return -0.5 * (square + log_determinant + step**2)

    each = jax.vmap(at_one_N, in_axes=(-1, 0))(filtered_columns, jnp.asarray(data.steps_of_N))
    change = log_density_change(observed.values, logs, observed.errors)
    return jax.scipy.special.logsumexp(each) - 0.5 * jnp.sum(observed.used * change)


def _log_measured(gas: Gas, nodes: Nodes, of_energy: bool) -> Float[Array, "nodes 2"]:
    """Return ln T, as it is measured, and ln T_rot."""
    log_T = nodes.log_temperature
    ratio = nodes.rotation
    logs = jnp.stack([log_T, log_T + jnp.log(jnp.where(ratio > 0, ratio, 1.0))], axis=1)
    if of_energy and nodes.size_ratio is not None:
        logs = logs.at[:, 0].add(jnp.log(energy_ratio(gas.size_spread, nodes.size_ratio)))
    return logs


class _CommonFactors(NamedTuple):
    """Logarithms of common factors of T and T_rot, Gaussian about 0.

    Attributes:
        columns: derivative of the residuals in each of them.
        widths: their standard deviations.
    """

    columns: list[Float[Array, "nodes 2"]]
    widths: Float[Array, "factors"]


def _common_factors(rows: CurveRows, shape: tuple[int, ...]) -> _CommonFactors:
    names = [name for name in COMMON_FACTORS if name in rows.nuisances]
    columns = [jnp.broadcast_to(jnp.asarray(COMMON_FACTORS[name]), shape) for name in names]
    return _CommonFactors(columns, jnp.asarray([rows.nuisances[name] for name in names]))


def _filtered_for_each_N(
    gas: Gas,
    nodes: Nodes,
    columns: Float[Array, "nodes 2 columns"],
    variances: Float[Array, "nodes 2"],
    data: _MeasuredCurve,
) -> Filtered:
    """Return what `filtered` does with values of N in place of its neighbouring gases."""
    steps = data.steps_of_N

    def with_axis_of_N(x: Array) -> Array:
        return jnp.broadcast_to(x[..., None], (*x.shape, steps.size))

    each = jax.tree.map(with_axis_of_N, nodes)
    each = each._replace(sonine=nodes.sonine)  # the same for all gases: `Nodes`
    noise = data.rows.noise(data.grid.times, jnp.exp(data.rows.grains.log_error * steps))
    return filtered(
        jax.tree.map(lambda x: jnp.broadcast_to(x, (steps.size, *jnp.shape(x))), gas),
        each,
        with_axis_of_N(columns),
        with_axis_of_N(variances),
        with_axis_of_N(jnp.ones_like(nodes.log_temperature)),
        data.observed.used,
        jax.tree.map(jnp.asarray, noise),
        differentiable=True,
    )


def _without_factors(
    columns: Float[Array, "*shape columns"],
    weights: Float[Array, "*shape"],
    widths: Float[Array, "factors"],
) -> Float[Array, ""]:
    """Return -2 ln L of the first column r, ``r^T W r``, with its common factors integrated out.

    The further columns F belong to the factors, which are Gaussian about 0 with the widths s.
    They add ``F s^2 F^T`` to the covariance W^-1, and ``ln det(1 + s F^T W F s)`` to -2 ln L.
    """
    flat = columns.reshape(-1, columns.shape[-1])
    weights = weights.reshape(-1)
    square = jnp.sum(weights * flat[:, 0] ** 2)
    if not widths.size:
        return square
    others = flat[:, 1:] * widths[None]
    projection = others.T @ (weights * flat[:, 0])
    matrix = jnp.eye(widths.size) + others.T @ (weights[:, None] * others)
    explained = projection @ jnp.linalg.solve(matrix, projection)
    return square - explained + jnp.linalg.slogdet(matrix)[1]


def _likelihood_of_displacement(
    nodes: Nodes, computed: CoolingCurve, data: _MeasuredCurve
) -> Float[Array, ""]:
    """Return the logarithm of the likelihood of <dr^2>."""
    measured = data.rows.displacement
    assert measured is not None and computed.displacement is not None
    place = data.grid.place
    of_factor = diffusive_share(nodes.collisions[place])
    known = jnp.where(measured.used, computed.displacement[place], 1.0)
    columns = jnp.stack([measured.logs - jnp.log(known), of_factor], axis=-1)
    columns = jnp.asarray(measured.whitening) @ columns
    weights = jnp.ones(measured.logs.shape)
    return -0.5 * _without_factors(columns, weights, jnp.asarray([measured.accuracy]))
