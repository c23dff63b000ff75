"""How a measured curve becomes rows of a fit: values that count, and what makes them scatter."""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.validation import float_array
from jaxgran.data.curve import NOISE
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.prediction import TINY
from jaxgran.fitting.rows import (
    BEYOND_ROUNDING,
    CurveRows,
    Displacement,
    Grains,
    RateError,
    rounding_errors,
)
from jaxgran.fitting.time_grid import time_grid
from jaxgran.models.base import AbstractModel
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import curve_of_program, with_neutral_elements
from jaxgran.models.scales import scales_at
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.gas import Gas

WEAK_SCATTER = 1.5
"""Standard error of ln N where N is not known. Far fewer grains than `UNKNOWN_NUMBER` are a misfit;
more may be any number."""

UNKNOWN_NUMBER = 1e3
"""First guess of N where it is not known."""

SCATTER_ERROR = 0.05
"""Relative error of the variance that theory gives to a run of N grains."""

ERRORS_OF_PARTICLES = 0.1
"""Relative difference up to which T_err is taken for the fluctuation of independent samples."""


def curve_rows(
    label: str, measurement: Measurement, model: AbstractModel, *, fits_T_0: bool, fits_t0: bool
) -> tuple[CurveRows, list[str]]:
    """Return a measured curve as it is compared with a model, and notes on its errors.

    Args:
        label: of the measurement.
        measurement: of a curve.
        model: without noise.
        fits_T_0: whether T_0 is a free parameter.
        fits_t0: whether the start of the clock is one; <dr^2>, which starts at t = 0 of the curve,
            is not used then.
    """
    gas = measurement.gas
    values = _values(measurement)
    errors, notes = errors_that_count(measurement)
    if _has_rotation(measurement):
        # The filter has no memory of sampled spins: their errors count as those of single values.
        spins = NUM_SPIN_COMPONENTS[gas.dimension]
        sampled = values[:, 1] * sampling_variance(measurement, spins) ** 0.5
        errors[:, 1] = np.hypot(errors[:, 1], sampled)
    displacement = None
    if not fits_t0:
        displacement, notes_on_displacement = _displacement(measurement, model)
        notes = notes + notes_on_displacement
    accuracy = float(model.rotation_accuracy(gas)) if _has_rotation(measurement) else 0.0
    rows = CurveRows(
        label=label,
        measurement=measurement,
        gas=with_neutral_elements(gas, model),
        values=values,
        errors=errors,
        used=_used(measurement, values, errors, fits_T_0),
        grains=_grains(measurement, model, fits_T_0),
        faster=_finite_size_factor(measurement),
        unit_time=float(scales_at(gas).mean_free_time),
        rate_error=RateError(np.zeros(1), np.zeros(1)),
        rotation_accuracy=accuracy,
        displacement=displacement,
    )
    return rows, notes


def with_rate_error(rows: CurveRows, model: AbstractModel, gas: Gas) -> CurveRows:
    """Return a curve with the error of a model's cooling rate in a gas.

    Args:
        rows: the measured curve.
        model: of the fit; kinetic theory gives the curve on which the error of a stochastic one
            depends.
        gas: the scene, with values of the unknowns.
    """
    known = np.asarray(rows.curve.times) * rows.faster
    times = time_grid(known, rows.unit_time).times
    exact = KineticTheory() if model.stochastic else model
    curve = curve_of_program(exact, gas, times, rows.displacement is not None)
    if not np.all(np.isfinite(np.asarray(curve.temperature))):
        return rows
    error_model = ErrorModel.from_curve(gas, curve, rows.measurement.num_particles)
    error = np.broadcast_to(model.rate_error(error_model), times.shape)
    return replace(rows, rate_error=RateError(times, np.asarray(error, float)))


def with_errors_that_count(measurement: Measurement) -> Measurement:
    """Return a measurement whose errors are those that a fit counts, as errors of measurement."""
    exact = replace(measurement, rounding={})
    errors = errors_that_count(exact).errors
    fields: dict[str, Any] = {}
    for column, name in enumerate(("temperature_error", "rotational_temperature_error")):
        known = getattr(measurement.curve, name) is not None and np.any(errors[:, column] > 0)
        fields[name] = jnp.asarray(errors[:, column]) if known else None
    if measurement.curve.displacement is not None:
        error = _displacement_errors(measurement).errors
        fields["displacement_error"] = jnp.asarray(error) if np.any(error > 0) else None
    data = replace(measurement.curve, **fields)
    return replace(measurement, data=data, errors_measured=True)


class CountedErrors(NamedTuple):
    """Standard errors that a fit counts.

    Attributes:
        errors: 0 where a value has none that counts.
        notes: on errors that do not count.
    """

    errors: np.ndarray
    notes: list[str]


def errors_that_count(measurement: Measurement) -> CountedErrors:
    """Return the errors of T and T_rot, with the rounding of the file, shape (times, 2)."""
    values = _values(measurement)
    dimension = measurement.gas.dimension
    given = measurement.curve.temperature_error
    of_T = _errors_of_measurement("T_err", measurement, given, values[:, 0], dimension)
    given = measurement.curve.rotational_temperature_error if _has_rotation(measurement) else None
    spins = NUM_SPIN_COMPONENTS[dimension]
    of_rotation = _errors_of_measurement("T_rot_err", measurement, given, values[:, 1], spins)
    both = np.stack([of_T.errors, of_rotation.errors], axis=1)
    notes = of_T.notes + of_rotation.notes
    return CountedErrors(np.hypot(both, rounding_errors(measurement)), notes)


def _errors_of_measurement(
    name: str,
    measurement: Measurement,
    given: Any,
    values: np.ndarray,
    components: int,
) -> CountedErrors:
    """Return the standard errors of a measured quantity apart from the fluctuations of N grains.

    The errors of a mean over runs come from the grains, and the likelihood knows them. So do
    errors of one run that equal ``sqrt(2/(d N))`` of the values, the fluctuation of independent
    samples of N grains. The errors of a sample of the grains are computed, too.

    Args:
        name: of the column of errors, for notes.
        measurement: of a curve.
        given: errors of the curve, or None.
        values: to which they belong.
        components: of a velocity, in the mean square of which the grains fluctuate.
    """
    nothing = np.zeros_like(values)
    if given is None:
        return CountedErrors(nothing, [])
    error = np.asarray(given)
    if measurement.errors_measured:
        return CountedErrors(error, [])
    N = measurement.num_particles
    if measurement.replicas > 1:
        note = (
            f"{name} is not used: the scatter of the grains of {measurement.replicas} runs is "
            "known. If these are errors of the measurement, say so: `errors: measured`"
        )
    elif measurement.tracked is not None:
        note = f"{name} is not used: the sampling of {measurement.tracked} grains is known"
    elif N is not None and _equals_fluctuation(error, values, components * N):
        note = (
            f"{name} equals the fluctuation of independent samples of {N} grains and is not "
            "used: values of one run are correlated, and energies fluctuate less. If these "
            "are errors of the measurement, say so: `errors: measured`"
        )
    else:
        return CountedErrors(error, [])
    return CountedErrors(nothing, [note])


def _equals_fluctuation(error: np.ndarray, values: np.ndarray, number: int) -> bool:
    """Return whether errors are the fluctuation of a mean square of independent components."""
    ratio = error[error > 0] / (2 / number) ** 0.5 / values[error > 0]
    return bool(ratio.size and np.all(np.abs(ratio - 1) < ERRORS_OF_PARTICLES))


def _has_rotation(measurement: Measurement) -> bool:
    measured = measurement.curve.rotational_temperature
    return measurement.gas.surface is not None and measured is not None


def _values(measurement: Measurement) -> Float[np.ndarray, "times 2"]:
    """Return the measured T and T_rot, which is 1 where it is not compared."""
    T = np.asarray(measurement.curve.temperature)
    T_rot = np.ones_like(T)
    if _has_rotation(measurement):
        T_rot = np.asarray(measurement.curve.rotational_temperature)
    return np.stack([T, T_rot], axis=1)


def _used(
    measurement: Measurement,
    values: Float[np.ndarray, "times 2"],
    errors: Float[np.ndarray, "times 2"],
    fits_T_0: bool,
) -> Float[np.ndarray, "times 2"]:
    """Return 1 where a value counts, 0 elsewhere.

    A value at t = 0 is the T_0 of the run, unless it has an error beyond its rounding.
    """
    curve = measurement.curve
    used = np.ones_like(values)
    used[:, 1] = float(_has_rotation(measurement))
    if np.asarray(curve.times)[0] == 0:
        of_T, of_rotation = errors[0] > BEYOND_ROUNDING * rounding_errors(measurement)[0]
        used[0, 0] = float(of_T or fits_T_0)
        used[0, 1] *= float(of_rotation)
    error = curve.rotational_temperature_error
    used[:, 1] *= (values[:, 1] > 0) | (np.asarray(0.0 if error is None else error) > 0)
    return used


def _grains(measurement: Measurement, model: AbstractModel, fits_T_0: bool) -> Grains:
    N = measurement.num_particles
    is_ensemble = measurement.ensemble_start and not fits_T_0
    return Grains(
        inverse_number=1 / ((UNKNOWN_NUMBER if N is None else N) * measurement.replicas),
        log_error=WEAK_SCATTER if N is None else SCATTER_ERROR,
        sample=sampling_variance(measurement, measurement.gas.dimension),
        first=2 / measurement.gas.dimension if is_ensemble else 0.0,
        contacts=float(model.has_contacts),
    )


def sampling_variance(measurement: Measurement, components: int) -> float:
    """Return the variance of ln T where some of the grains are tracked; 0 if all are.

    Args:
        measurement: of a curve.
        components: of the velocity of a grain, or of its spin for ln T_rot.
    """
    tracked = measurement.tracked
    if tracked is None:
        return 0.0
    N = measurement.num_particles
    left = 1 - (0 if N is None else tracked / N)
    return 2 / (components * tracked * measurement.replicas) * left


def _finite_size_factor(measurement: Measurement) -> float:
    """Return the factor by which the measured gas cools faster because N is small."""
    N = measurement.num_particles
    return 1.0 if N is None else float(finite_size_cooling_factor(measurement.gas, float_array(N)))


@eqx.filter_jit
def finite_size_cooling_factor(gas: Gas, num_particles: ArrayLike) -> Float[Array, ""]:
    """Factor by which N particles without total momentum cool faster than many, at the same T.

    Their relative velocities have the temperature ``T' = T N/(N-1)``, and each particle
    collides with N - 1 others: with ``-d ln T/dt = r(T)`` the factor is r(T')/r(T), here with the
    loss ``1 - eps^2`` at the impact speed sqrt(2 T): 1 + .6/N for viscoelastic spheres, 1 + .5/N
    for a constant eps. It is 1 between walls, which take up momentum.
    """
    if gas.container is not None:
        return jnp.ones_like(gas.temperature)
    hotter = jnp.sqrt(num_particles / jnp.maximum(num_particles - 1, 1.0))
    one = jnp.ones_like(gas.temperature)
    loss = 1 - gas.reduced_law.restitution(one) ** 2
    ratio = (1 - gas.reduced_law.restitution(hotter * one) ** 2) / jnp.where(loss > 0, loss, 1.0)
    return hotter * jnp.where(loss > 0, ratio, 1.0)


def _displacement(
    measurement: Measurement, model: AbstractModel
) -> tuple[Displacement | None, list[str]]:
    """Return <dr^2> if its scatter is known and the model computes it, and notes on its errors.

    ln <dr^2> is compared. If a value is below 0, as after noise was subtracted, only values more
    than `NOISE` errors above 0 count.
    """
    curve = measurement.curve
    gas = measurement.gas
    N = measurement.tracked or measurement.num_particles
    accuracy = model.displacement_accuracy(gas)
    is_known = curve.displacement_error is not None or N is not None
    if curve.displacement is None or accuracy is None or not is_known:
        return None, []
    values = np.asarray(curve.displacement)
    given = curve.displacement_error
    errors, notes = _displacement_errors(measurement)
    is_measured = np.ones(values.shape, bool) if given is None else np.asarray(given) > 0
    of_grains = 0.0 if N is None else 2 / (gas.dimension * N * measurement.replicas)
    used = (values > 0) & is_measured
    if np.any(values < 0):
        used &= NOISE * errors < values
    logs = np.log(np.where(used, values, 1.0))
    relative = np.hypot(errors / np.maximum(values, TINY), float(accuracy))
    covariance = np.diag(relative[used] ** 2) + of_grains * _correlation_of_walks(logs[used])
    whitening = np.zeros((values.size, values.size))
    factor = np.linalg.cholesky(covariance)
    whitening[np.ix_(used, used)] = np.linalg.inv(factor)
    return Displacement(logs, whitening, float(accuracy)), notes


def _displacement_errors(measurement: Measurement) -> CountedErrors:
    """Return the standard errors of <dr^2>.

    Without a number of grains all count: the scatter of <dr^2> does not tell it.
    """
    values = np.asarray(measurement.curve.displacement)
    given = measurement.curve.displacement_error
    if given is not None and (measurement.tracked or measurement.num_particles) is None:
        return CountedErrors(np.asarray(given), [])
    return _errors_of_measurement("msd_err", measurement, given, values, measurement.gas.dimension)


def _correlation_of_walks(logs: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n n"]:
    """Return the correlations of <dr^2> of a number of random walks at some times.

    The displacements at t1 < t2 have the covariance of the first one, so that their squares have
    the correlation <dr^2>(t1)/<dr^2>(t2). Velocities have a memory, so that the true correlation
    is larger and errors by <dr^2> are up to 1.8 times too large. Measured: 200 replicas of 200 hard
    spheres, phi = .05, up to 32 collisions: the mean variance of the residuals is .33.
    """
    return np.exp(-np.abs(logs[:, None] - logs[None]))


def unused_displacements(measurement: Measurement) -> str | None:
    """Return which <dr^2> of a curve a fit ignores; None unless some of them are below 0."""
    curve = measurement.curve
    if curve.displacement is None or curve.displacement_error is None:
        return None
    values = np.asarray(curve.displacement)
    error = np.asarray(curve.displacement_error)
    if not np.any(values < 0):
        return None
    number = int(np.sum((values <= NOISE * error) & (error > 0)))
    return (
        f"<dr^2> is below 0 within its error: its logarithm is compared, and {number} of "
        f"{values.size} values, less than {NOISE:g} errors above 0, are not used"
    )


def unused_rotation(measurement: Measurement) -> str | None:
    """Return why a fit ignores the T_rot of a curve; None if it uses it or if there is none."""
    if measurement.curve.rotational_temperature is None or measurement.gas.surface is not None:
        return None
    return (
        "the measured T_rot is not used: the gas has no surface=jaxgran.Rough(...) (header key "
        "beta_t)"
    )
