"""Errors of a fit that depend on the fitted gas: of clock, few particles, derivatives, priors."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.data.curve import CoolingCurve, Run
from jaxgran.fitting.parameters import Parameters, Priors
from jaxgran.fitting.residuals import log_temperatures
from jaxgran.fitting.result import Fit
from jaxgran.models.base import AbstractModel
from jaxgran.models.choose import error_model_along
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas

MIN_REPORTED_BIAS = 0.05
"""Smallest relative error of the derivatives of a fit that a diagnosis reports."""


def with_scene_errors(result: Fit, num_particles: int | None, replicas: int) -> Fit:
    """Return a fit with the errors of its model's clock in this scene, and of few particles.

    Args:
        result: a fit of one curve, not traced.
        num_particles: N of each measured run, if known.
        replicas: number of measured runs over which the curve is a mean.
    """
    error_model = _error_model(result, num_particles)
    clock_error = error_model.clock_error(result.model.rate_error(error_model))[
        -result.curve.times.size :
    ]
    clock_error = np.asarray(clock_error, result.clock_error.dtype)
    is_clock_free = bool(result.priors.names) and not result.model.stochastic
    # The error of a free clock is that at the first guess: only what exceeds it is added.
    excess = np.maximum(clock_error**2 - is_clock_free * np.asarray(result.clock_error) ** 2, 0.0)
    shift = np.asarray(result.clock_gain) @ np.sqrt(excess)
    covariances = {name: np.asarray(part) for name, part in result.covariances.items()}
    model = covariances["model"] if is_clock_free else 0.0
    covariances["model"] = model + np.outer(shift, shift)
    if result.model.stochastic:
        covariances["slope"] = np.asarray(_derivative_bias_covariance(result))
    if num_particles is not None:
        noise = _collision_noise_covariance(result, error_model, num_particles * replicas)
        covariances["few particles"] = _excess_covariance(noise, covariances["measurement"])
    parts = {name: jnp.asarray(part) for name, part in covariances.items()}
    return dataclasses.replace(result, clock_error=jnp.asarray(clock_error), covariances=parts)


def clock_accuracy(
    guess: Gas, curve: CoolingCurve, model: AbstractModel, num_particles: int | None = None
) -> Float[Array, "times"]:
    """Relative accuracy of a model's clock in the scene of a curve, at each of its times.

    Args:
        guess: a guess of the gas.
        curve: the curve with the times.
        model: a deterministic model.
        num_particles: N of each measured run, if known.
    """
    times = np.asarray(curve.times)
    times = jnp.asarray(np.concatenate([np.zeros(int(times[0] > 0), times.dtype), times]))
    error_model = error_model_along(guess, model.simulate(guess, times, Run()), num_particles)
    return jnp.asarray(error_model.clock_error(model.rate_error(error_model))[-curve.times.size :])


def _error_model(result: Fit, num_particles: int | None) -> ErrorModel:
    """Return the error model of the fitted gas, at its start and at the measured times."""
    curve, times = result.curve, _times_since_start(result)
    before = np.zeros(int(times[0] > 0), times.dtype)

    def with_start(values: ArrayLike, first: Any = 0.0) -> Array:
        return jnp.asarray(np.concatenate([before + np.asarray(first), np.asarray(values)]))

    curve_from_start = CoolingCurve(
        times=with_start(times),
        temperature=with_start(curve.temperature, result.gas.temperature),
        sonine=None if curve.sonine is None else with_start(curve.sonine),
        collisions=None if curve.collisions is None else with_start(curve.collisions),
    )
    return error_model_along(result.gas, curve_from_start, num_particles)


def _times_since_start(result: Fit) -> Float[np.ndarray, "times"]:
    """Return the measured times minus t0, or 0 if they are earlier."""
    times = np.asarray(result.curve.times)
    return np.maximum(times - np.asarray(result.start_time, times.dtype), 0.0)


def _collision_noise_covariance(
    result: Fit, error_model: ErrorModel, num_particles: int
) -> Float[np.ndarray, "p p"]:
    """Covariance of the estimates due to the randomness of single collisions of N particles.

    The delay of the clock accumulates: the covariance of its delays at two times is the variance at
    the earlier one.
    """
    times = _times_since_start(result)
    variance = error_model.chance_of_clock(num_particles)[-times.size :]
    common = np.minimum(variance[:, None], variance[None, :])
    gain = np.asarray(result.clock_gain) / np.where(times > 0, times, 1.0)[None]
    return gain @ common @ gain.T


def _derivative_bias_covariance(result: Fit) -> Float[Array, "p p"]:
    """Covariance of the estimates due to a relative bias b of the derivatives.

    The true errors are larger by the factor 1 + b, and the last extrapolation is too short by its
    fraction b.
    """
    b = abs(mean_derivative_bias(result))
    noise = result.covariances["measurement"] + result.covariances["simulation"]
    return ((1 + b) ** 2 - 1) * noise + b**2 * jnp.outer(result.extrapolation, result.extrapolation)


def mean_derivative_bias(result: Fit) -> float:
    """Relative bias of the derivatives of a fit of particles, as a weighted mean over the points.

    It is that of the curve of the last run or, if this has none, an estimate by the model.
    """
    bias = result.curve.derivative_bias
    if bias is None:
        error_model = _error_model(result, getattr(result.model, "num_particles", None))
        bias = np.broadcast_to(result.model.derivative_error(error_model), error_model.time.shape)
    times = result.curve.times.size
    weights = np.sum(np.asarray(result.sensitivity)[:times] ** 2, axis=1)
    whole = max(np.sum(weights), np.finfo(float).tiny)
    return float(np.sum(weights * np.asarray(bias)[-times:]) / whole)


def describe_derivative_bias(result: Fit) -> Iterator[str]:
    """Yield a clause about derivatives whose bias or noise exceeds `MIN_REPORTED_BIAS`."""
    b = mean_derivative_bias(result) if result.model.stochastic else 0.0
    if abs(b) < MIN_REPORTED_BIAS:
        return
    if getattr(result.model, "differences", None) is not None:
        yield (
            f"the derivatives are differences of runs, with an estimated noise of {100 * b:.2g} %, "
            "which the standard error includes: more replicas reduce it"
        )
        return
    share = result.curve.flow_share
    flow = "a flow"
    if share is not None:
        flow += f" with up to {100 * float(jnp.max(share)):.2g} % of the energy"
    yield (
        f"the projected derivatives are too large by an estimated {100 * b:.2g} %, because of "
        f"{flow}; the standard error includes this bias, and {type(result.model).__name__}(..., "
        "differences=0.3) avoids it"
    )


def _excess_covariance(
    whole: Float[np.ndarray, "p p"], measured: Float[np.ndarray, "p p"]
) -> Float[np.ndarray, "p p"]:
    """Return the part of a covariance that exceeds that of the measured errors."""
    share = 1 - np.diag(measured) / np.maximum(np.diag(whole), np.finfo(whole.dtype).tiny)
    factor = np.sqrt(np.clip(share, 0.0, 1.0))
    return np.asarray(whole * np.outer(factor, factor), measured.dtype)


def parameter_effects(
    gas: Gas, priors: Priors, computed: CoolingCurve, rotation: bool
) -> tuple[Float[Array, "points"], dict[str, Float[Array, "points size"]]]:
    """Return the changes of ln T, and of ln T_rot if it is used, with the clock and each prior.

    Kinetic theory gives the changes. It does not support friction: for spheres with friction, the
    change of T_rot with the clock is the slope of the computed curve.

    Args:
        gas: the fitted gas.
        priors: the priors of the fit.
        computed: the computed curve of the fit.
        rotation: True if the fit uses T_rot.

    Returns:
        ``d ln T/d ln t``, and for each prior the changes by one standard error of its numbers.
    """
    model, varied, times = KineticTheory(), priors.extra_parameters(()), computed.times
    parameters, is_supported = Parameters(gas, varied), "friction" not in gas.elements

    def logarithms(flat: Array, clock: Array) -> Array:
        elapsed = (times - parameters.start(flat)) * clock
        curve = model.simulate(parameters.gas(flat), elapsed, Run())
        return log_temperatures(curve, rotation and is_supported)

    flat, clock = parameters.flat(gas), jnp.ones_like(times)
    slope = jax.jvp(lambda x: logarithms(flat, x), (clock,), (clock,))[1]
    if rotation and not is_supported:
        log_T_rot = np.log(np.asarray(computed.rotational_temperature))
        rotation_slope = np.gradient(log_T_rot, np.asarray(times)) * np.asarray(times)
        slope = jnp.concatenate([slope, jnp.asarray(rotation_slope, slope.dtype)])
    if not varied:
        return slope, {}
    by_parameter = jax.jacfwd(logarithms)(flat, clock)
    by_residual = jax.jacfwd(lambda x: priors.residuals(parameters.gas(x), parameters.start(x)))(
        flat
    )
    changes = by_parameter @ jnp.linalg.pinv(by_residual)
    ends = np.cumsum([given.size for given in priors.given])[:-1]
    return slope, dict(zip(priors.names, jnp.split(changes, ends, axis=1), strict=True))
