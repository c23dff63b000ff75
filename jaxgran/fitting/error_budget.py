"""Errors that follow from the fitted gas: of its model's clock there, and of few particles."""

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
"""Relative error of the derivatives of a fit from which on a diagnosis speaks of it."""


def with_scene_errors(result: Fit, num_particles: int | None, replicas: int) -> Fit:
    """A fit with the errors of its model's clock in this scene, and of few particles.

    Args:
        result: of one curve, of known numbers.
        num_particles: N of each measured run, if known.
        replicas: measured runs over which the curve is a mean.
    """
    error_model = _error_model(result, num_particles)
    own = error_model.clock_error(result.model.rate_error(error_model))[-result.curve.times.size :]
    clock_error = np.asarray(own, result.clock_error.dtype)
    fitted = bool(result.priors.names) and not result.model.stochastic
    # What a clock that was fitted along, within its error at a first guess, does not hold yet.
    extrapolation = np.maximum(clock_error**2 - fitted * np.asarray(result.clock_error) ** 2, 0.0)
    moved = np.asarray(result.clock_gain) @ np.sqrt(extrapolation)
    covariances = {name: np.asarray(part) for name, part in result.covariances.items()}
    model = covariances["model"] if fitted else 0.0
    covariances["model"] = model + np.outer(moved, moved)
    if result.model.stochastic:
        covariances["slope"] = np.asarray(_by_slope(result))
    if num_particles is not None:
        chance = _by_chance(result, error_model, num_particles * replicas)
        covariances["few particles"] = _beyond(chance, covariances["measurement"])
    parts = {name: jnp.asarray(part) for name, part in covariances.items()}
    return dataclasses.replace(result, clock_error=jnp.asarray(clock_error), covariances=parts)


def clock_accuracy(
    guess: Gas, curve: CoolingCurve, model: AbstractModel, num_particles: int | None = None
) -> Float[Array, "times"]:
    """Relative accuracy of a model's clock in the scene of a curve, at each of its times.

    Args:
        guess: the gas, about.
        curve: at whose times.
        model: a deterministic one.
        num_particles: N of each measured run, if known.
    """
    times = np.asarray(curve.times)
    times = jnp.asarray(np.concatenate([np.zeros(int(times[0] > 0), times.dtype), times]))
    error_model = error_model_along(guess, model.simulate(guess, times, Run()), num_particles)
    return jnp.asarray(error_model.clock_error(model.rate_error(error_model))[-curve.times.size :])


def _error_model(result: Fit, num_particles: int | None) -> ErrorModel:
    """The course of the fitted gas, when it began and at the measured times after it."""
    curve, times = result.curve, _since_start(result)
    before = np.zeros(int(times[0] > 0), times.dtype)

    def whole(values: ArrayLike, first: Any = 0.0) -> Array:
        return jnp.asarray(np.concatenate([before + np.asarray(first), np.asarray(values)]))

    along = CoolingCurve(
        times=whole(times),
        temperature=whole(curve.temperature, result.gas.temperature),
        sonine=None if curve.sonine is None else whole(curve.sonine),
        collisions=None if curve.collisions is None else whole(curve.collisions),
    )
    return error_model_along(result.gas, along, num_particles)


def _since_start(result: Fit) -> Float[np.ndarray, "times"]:
    """The measured times after the start of the cooling; 0 before."""
    times = np.asarray(result.curve.times)
    return np.maximum(times - np.asarray(result.start_time, times.dtype), 0.0)


def _by_chance(
    result: Fit, error_model: ErrorModel, num_particles: int
) -> Float[np.ndarray, "p p"]:
    """Covariance of the estimates by the chance of single collisions of N particles.

    The delays of the clock at two times have in common what was gathered until the earlier one.
    """
    times = _since_start(result)
    gathered = error_model.chance_of_clock(num_particles)[-times.size :]
    common = np.minimum(gathered[:, None], gathered[None, :])
    gain = np.asarray(result.clock_gain) / np.where(times > 0, times, 1.0)[None]
    return gain @ common @ gain.T


def _by_slope(result: Fit) -> Float[Array, "p p"]:
    """Covariance of the estimates by derivatives that are too large in a gas with a flow.

    They are so by the share b: errors are larger by 1 + b than their derivatives say, and b of the
    last extrapolation is missing.
    """
    b = abs(bias_of_slope(result))
    found = result.covariances["measurement"] + result.covariances["simulation"]
    return ((1 + b) ** 2 - 1) * found + b**2 * jnp.outer(result.extrapolation, result.extrapolation)


def bias_of_slope(result: Fit) -> float:
    """By which share the derivatives of a fit through particles are too large, in the mean over the
    points by their weight: as the flow of the last run tells, or else as the model estimates it."""
    bias = result.curve.derivative_bias
    if bias is None:
        error_model = _error_model(result, getattr(result.model, "num_particles", None))
        bias = np.broadcast_to(result.model.derivative_error(error_model), error_model.time.shape)
    times = result.curve.times.size
    weights = np.sum(np.asarray(result.sensitivity)[:times] ** 2, axis=1)
    whole = max(np.sum(weights), np.finfo(float).tiny)
    return float(np.sum(weights * np.asarray(bias)[-times:]) / whole)


def describe_slope_bias(result: Fit) -> Iterator[str]:
    """A clause about derivatives through particles that are wrong by more than `WORTH_SAYING`."""
    b = bias_of_slope(result) if result.model.stochastic else 0.0
    if abs(b) < MIN_REPORTED_BIAS:
        return
    if getattr(result.model, "differences", None) is not None:
        yield (
            f"its derivatives, differences of runs, have a noise of {100 * b:.2g} % by estimate, "
            "which the error bar contains: more replicas have less"
        )
        return
    share = result.curve.flow_share
    held = "" if share is None else f", which holds up to {100 * float(jnp.max(share)):.2g} % of "
    held += "the energy" if held else ""
    yield (
        f"its projected derivatives are too large by {100 * b:.2g} % by estimate, because of the "
        f"flow{held}: the error bar contains it; {type(result.model).__name__}(..., "
        "differences=0.3) has derivatives without this bias"
    )


def _beyond(
    whole: Float[np.ndarray, "p p"], measured: Float[np.ndarray, "p p"]
) -> Float[np.ndarray, "p p"]:
    """What a covariance adds to that of measured errors, which may hold it already."""
    share = 1 - np.diag(measured) / np.maximum(np.diag(whole), np.finfo(whole.dtype).tiny)
    factor = np.sqrt(np.clip(share, 0.0, 1.0))
    return np.asarray(whole * np.outer(factor, factor), measured.dtype)


def parameter_effects(
    gas: Gas, priors: Priors, computed: CoolingCurve, rotation: bool
) -> tuple[Float[Array, "points"], dict[str, Float[Array, "points size"]]]:
    """How ln T, and ln T_rot if a fit uses it, change with the clock and with each prior.

    By kinetic theory; of T_rot of spheres with friction, which it does not know, the change with
    the clock is that along the computed curve.

    Args:
        gas: which was fitted.
        priors: of the fit.
        computed: its curve.
        rotation: whether the fit uses T_rot.

    Returns:
        ``d ln T/d ln t``, and for each prior the changes by one standard error of its numbers.
    """
    model, varied, times = KineticTheory(), priors.extra_parameters(()), computed.times
    parameters, known = Parameters(gas, varied), "friction" not in gas.elements

    def logarithms(flat: Array, clock: Array) -> Array:
        since = (times - parameters.start(flat)) * clock
        found = model.simulate(parameters.gas(flat), since, Run())
        return log_temperatures(found, rotation and known)

    flat, clock = parameters.flat(gas), jnp.ones_like(times)
    slope = jax.jvp(lambda x: logarithms(flat, x), (clock,), (clock,))[1]
    if rotation and not known:
        own = np.log(np.asarray(computed.rotational_temperature))
        along = np.gradient(own, np.asarray(times)) * np.asarray(times)
        slope = jnp.concatenate([slope, jnp.asarray(along, slope.dtype)])
    if not varied:
        return slope, {}
    by_parameter = jax.jacfwd(logarithms)(flat, clock)
    by_residual = jax.jacfwd(lambda x: priors.residuals(parameters.gas(x), parameters.start(x)))(
        flat
    )
    changes = by_parameter @ jnp.linalg.pinv(by_residual)
    ends = np.cumsum([given.size for given in priors.given])[:-1]
    return slope, dict(zip(priors.names, jnp.split(changes, ends, axis=1), strict=True))
