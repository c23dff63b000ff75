"""Errors of a fit that depend on the fitted gas: of clock, few particles, derivatives, priors."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.parameters import (
    Numbers,
    Priors,
    extra_parameters,
    prior_residuals,
    with_floats,
)
from jaxgran.fitting.residuals import MODEL_ERROR, Measurement
from jaxgran.fitting.result import Comparison, Fit
from jaxgran.models.base import AbstractModel
from jaxgran.models.choose import error_model_along
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import curve_of_program, linearise, with_all_elements
from jaxgran.scene.gas import Gas

MIN_REPORTED_BIAS = 0.05
"""Smallest relative error of the derivatives of a fit that a diagnosis reports."""


def with_scene_errors(result: Fit) -> Fit:
    """Return a fit with the errors of its model's clock in each scene, and of few particles."""
    covariances = {name: np.asarray(part) for name, part in result.covariances.items()}
    is_clock_free = not result.model.stochastic and bool(
        result.priors or len(result.comparisons) > 1
    )
    clock = covariances[MODEL_ERROR] if is_clock_free else np.zeros_like(covariances[MODEL_ERROR])
    chance, comparisons = None, {}
    for label, comparison in result.comparisons.items():
        comparisons[label] = comparison
        curve, gas = curve_and_gas(result, label)
        if curve is None:
            continue
        N = comparison.num_particles
        error_model = _error_model(curve, gas, comparison.start_time, N)
        error = error_model.clock_error(result.model.rate_error(error_model))[-curve.times.size :]
        clock_error = np.asarray(error, np.asarray(comparison.clock_error).dtype)
        # The error of a free clock is that at the first guess: only what exceeds it is added.
        before = is_clock_free * np.asarray(comparison.clock_error) ** 2
        shift = np.asarray(comparison.clock_gain) @ np.sqrt(
            np.maximum(clock_error**2 - before, 0.0)
        )
        clock = clock + np.outer(shift, shift)
        comparisons[label] = comparison._replace(clock_error=clock_error)
        if N is not None:
            noise = _collision_noise_covariance(comparison, error_model, N * comparison.replicas)
            chance = noise if chance is None else chance + noise
    covariances[MODEL_ERROR] = clock
    if result.model.stochastic:
        covariances["slope"] = np.asarray(_derivative_bias_covariance(result))
    if chance is not None:
        covariances["few particles"] = _excess_covariance(chance, covariances["measurement"])
    comparisons, covariances = as_jax_arrays((comparisons, covariances))
    return dataclasses.replace(result, comparisons=comparisons, covariances=covariances)


def curve_and_gas(result: Fit, label: str) -> tuple[CoolingCurve | None, Gas]:
    """Return the fitted curve and gas of one measurement; the curve of a drop test is None."""
    if isinstance(result.gas, dict):
        return result.curve.get(label), result.gas[label]
    return result.curve, result.gas


def clock_accuracy(
    guess: Gas, measurement: Measurement, model: AbstractModel, num_particles: int | None = None
) -> Float[np.ndarray, "times"]:
    """Relative accuracy of a model's clock in the scene of a curve, at each of its times.

    Args:
        guess: a guess of the gas, with all elements that the model supports.
        measurement: the curve with the times.
        model: a deterministic model.
        num_particles: N of each measured run, if known.
    """
    times = np.asarray(measurement.curve.times)
    size, times = times.size, np.concatenate([np.zeros(int(times[0] > 0), times.dtype), times])
    names = [name for name in measurement.scene.domains if name in guess.domains]
    gas = with_floats(measurement.scene, {name: guess.value(name) for name in names})
    error_model = error_model_along(gas, curve_of_program(model, gas, times), num_particles)
    return error_model.clock_error(model.rate_error(error_model))[-size:]


def _error_model(
    curve: CoolingCurve, gas: Gas, start_time: Numbers, num_particles: int | None
) -> ErrorModel:
    """Return the error model of the fitted gas, at its start and at the measured times."""
    times = np.asarray(curve.times)
    # Points before t0 have the state at t0.
    times = np.maximum(times - np.asarray(start_time, times.dtype), 0.0)
    names = "temperature", "sonine", "collisions", "rotational_temperature"
    known = {name: getattr(curve, name) for name in names if getattr(curve, name) is not None}
    if times[0] > 0:
        firsts = {name: np.asarray(gas.floats.get(name, 0.0)) for name in known}
        known = {name: np.append(firsts[name], x) for name, x in known.items()}
        times = np.append(times.dtype.type(0.0), times)
    curve = CoolingCurve(**as_jax_arrays({"times": times} | known))
    return error_model_along(gas, curve, num_particles)


def _collision_noise_covariance(
    comparison: Comparison, error_model: ErrorModel, num_particles: int
) -> Float[np.ndarray, "p p"]:
    """Covariance of the estimates due to the randomness of single collisions of N particles.

    The delay of the clock accumulates: the covariance of its delays at two times is the variance at
    the earlier one.
    """
    clock_gain = np.asarray(comparison.clock_gain)
    times = error_model.time[-clock_gain.shape[1] :]
    variance = error_model.chance_of_clock(num_particles)[-times.size :]
    common = np.minimum(variance[:, None], variance[None, :])
    gain = clock_gain / np.where(times > 0, times, 1.0)[None]
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
        N = getattr(result.model, "num_particles", None)
        error_model = _error_model(result.curve, result.gas, 0.0, N)
        bias = np.broadcast_to(result.model.derivative_error(error_model), error_model.time.shape)
    times = result.curve.times.size
    weights = np.sum(np.asarray(result.comparison.sensitivity)[:times] ** 2, axis=1)
    whole = max(np.sum(weights), np.finfo(float).tiny)
    return float(np.sum(weights * np.asarray(bias)[-times:]) / whole)


def describe_derivative_bias(result: Fit) -> Iterator[str]:
    """Yield a clause about derivatives whose bias or noise exceeds `MIN_REPORTED_BIAS`."""
    b = abs(mean_derivative_bias(result)) if result.model.stochastic else 0.0
    if b >= MIN_REPORTED_BIAS:
        yield (
            f"the derivatives through particles err by an estimated {100 * b:.2g} %, which the "
            "standard error includes: more replicas, or differences=0.3 where the gas has a flow, "
            "reduce it"
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
) -> tuple[Float[np.ndarray, "points"], dict[str, Float[np.ndarray, "points size"]]]:
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
    model, varied, times = KineticTheory(), extra_parameters(priors, ()), np.asarray(computed.times)
    smooth = dataclasses.replace(gas, surface=None) if "friction" in gas.elements else gas
    complete = with_all_elements(smooth, model)
    linear = linearise(model.for_fits(smooth), complete, times)
    names = ["temperature"]
    if rotation and "friction" not in gas.elements:
        names.append("rotational_temperature")

    def of_logarithms(part: dict[str, Any]) -> np.ndarray:
        return np.concatenate([(part[n].T / linear.values[n]).T for n in names])

    slope = of_logarithms(linear.by_time) * np.tile(times, len(names))
    if rotation and len(names) < 2:
        log_T_rot = np.log(np.asarray(computed.rotational_temperature))
        slope = np.concatenate([slope, np.gradient(log_T_rot, times) * times])
    if not varied:
        return slope, {}
    values = {name: np.asarray(gas.value(name)) for name in varied}
    by_parameter = np.concatenate([of_logarithms(linear.by_float[n]) for n in varied], axis=1)
    rows = prior_residuals(priors, gas, values)
    by_residual = np.block(
        [
            [slopes.get(n, np.zeros((row.size, values[n].size))) for n in varied]
            for row, slopes in rows.values()
        ]
    )
    changes = by_parameter @ np.linalg.pinv(by_residual)
    ends = np.cumsum([given.size for given, _ in priors.values()])[:-1]
    return slope, dict(zip(priors, np.split(changes, ends, axis=1), strict=True))
