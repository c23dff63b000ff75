"""Measured curves and drop tests as a fit compares them with a model."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy  # which imports scipy.optimize at its first use
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.tracing import grid_size
from jaxgran._utils.validation import float_array
from jaxgran.data.curve import NOISE, CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.parameters import with_parameters
from jaxgran.models.base import AbstractModel
from jaxgran.models.choose import error_model_of_curve
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import (
    curve_of_program,
    with_coulomb_limit,
    with_neutral_elements,
    with_variant_law,
)
from jaxgran.models.scales import scales_at
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.gas import Gas

SCATTER = "scatter of N"
"""Nuisance parameter: the logarithm of the scatter of N grains over what theory gives."""

ROTATION = "model of T_rot"
"""Nuisance parameter: the logarithm of a common factor of all T_rot, over theory's accuracy."""

DISPLACEMENT = "model of <dr^2>"
"""The same of the diffusive part of <dr^2>."""

MAX_LOG_STEP = 0.25
"""Longest step between two times at which a curve is computed, in ln(1 + t/tau_c): ln T falls by at
most .4 in a step."""

TINY = float(np.finfo(np.float32).tiny)

CALIBRATION = "calibration"
"""The logarithm of a common factor of all measured T and T_rot."""

WEAK_SCATTER = 1.5
"""Standard error of ln N where N is not known. Far fewer grains than `UNKNOWN_NUMBER` are a misfit;
more may be any number."""

UNKNOWN_NUMBER = 1e3
"""First guess of N where it is not known."""

SCATTER_ERROR = 0.05
"""Relative error of the variance that theory gives to a run of N grains."""

MIN_SCATTER = 1e-3
"""Smallest scatter of eps that is searched, over the smallest error."""

ERRORS_OF_PARTICLES = 0.1
"""Relative difference up to which T_err is taken for the fluctuation of independent samples."""


class Observed(NamedTuple):
    """Measured values at the nodes: T in the first column and T_rot in the second.

    All arrays have the shape (nodes, 2).

    Attributes:
        values: m^2/s^2; any value where nothing was measured.
        errors: standard errors of the measurement, m^2/s^2, 0 where there is none.
        used: 1 where a value counts, 0 elsewhere.
        simulation: variances of the computed ln T and ln T_rot by simulations.
    """

    values: Any
    errors: Any
    used: Any
    simulation: Any


class Grains(NamedTuple):
    """What makes values of a finite number of grains scatter.

    Attributes:
        inverse_number: 1/N over all runs; where N is not known, a value about which it is searched.
        log_error: standard error of the logarithm of the variance by N grains.
        sample: variance of ln T where some of the grains are tracked.
        first: variance of ln T at t = 0 over `inverse_number`: 0 where T_0 is the run's own.
    """

    inverse_number: float
    log_error: float
    sample: float = 0.0
    first: float = 0.0


class Noise(NamedTuple):
    """What makes the measured values scatter about theory, apart from their own errors.

    Attributes:
        inverse_number: 1/N over all runs, times a factor that a fit may vary.
        first: variance of ln T at t = 0 over `inverse_number`: 0 where T_0 is the run's own.
        rate_error: relative standard error of theory's cooling rate at the nodes, shape (nodes,).
        sample: variance of ln T by the sampling of some of the grains.
        white: relative standard deviation of further errors, independent at each time.
    """

    inverse_number: Any
    first: Any
    rate_error: Any
    sample: Any
    white: Any


class Displacement(NamedTuple):
    """A measured <dr^2>.

    Attributes:
        values: m^2.
        errors: relative standard errors, with the accuracy of the model at each time; 0 where a
            value does not count.
        accuracy: relative accuracy of the model, which applies to a common factor, too.
    """

    values: Float[np.ndarray, "times"]
    errors: Float[np.ndarray, "times"]
    accuracy: float


@dataclass(frozen=True)
class CurveRows:
    """A measured curve, to be compared with a model.

    Attributes:
        label: in a fit of several measurements, otherwise "".
        measurement: the measured curve and its scene.
        gas: the scene with all elements that the model supports.
        values: measured T and T_rot, m^2/s^2, shape (times, 2).
        errors: their standard errors, with the rounding of the file; 0 where they have none.
        used: 1 where a value counts, 0 elsewhere.
        grains: what makes values of a finite number of grains scatter.
        faster: factor by which the measured gas cools faster because N is small.
        unit_time: mean free time of the scene, s.
        rate_error: times, s, and the relative error of the model's cooling rate at them.
        rotation_accuracy: relative accuracy of the model's T_rot.
        displacement: <dr^2>; None where it is not used.
        offset: ln T and ln T_rot of the fitted model minus those of the model that is evaluated,
            at the times of the data.
        simulation: variances of ln T and ln T_rot by simulations, shape (times, 2).
    """

    label: str
    measurement: Measurement
    gas: Gas
    values: Float[np.ndarray, "times 2"]
    errors: Float[np.ndarray, "times 2"]
    used: Float[np.ndarray, "times 2"]
    grains: Grains
    faster: float
    unit_time: float
    rate_error: tuple[np.ndarray, np.ndarray]
    rotation_accuracy: float = 0.0
    displacement: Displacement | None = None
    offset: np.ndarray | float = 0.0
    simulation: np.ndarray | float = 0.0

    @property
    def scene(self) -> Gas:
        """The gas of the measurement."""
        return self.measurement.gas

    @property
    def curve(self) -> CoolingCurve:
        """The measured curve."""
        return self.measurement.curve

    @property
    def num_points(self) -> int:
        """Number of times at which T counts."""
        return int(np.sum(self.used[:, 0]))

    @property
    def uses_rotation(self) -> bool:
        """Whether T_rot is compared."""
        return bool(np.any(self.used[:, 1]))

    def at_nodes(self, count: int, place: np.ndarray, error_factor: float = 1.0) -> Observed:
        """Return the measured values among the nodes of a computed curve.

        Args:
            count: number of nodes.
            place: place of each time of the data among them.
            error_factor: factor of the errors.
        """

        def among(values: Any, elsewhere: float) -> np.ndarray:
            whole = np.full((count, 2), elsewhere)
            whole[place] = values
            return whole

        return Observed(
            among(self.values, 1.0),
            error_factor * among(self.errors, 0.0),
            among(self.used, 0.0),
            among(self.simulation, 0.0),
        )

    def noise(
        self, times: np.ndarray, factor: Any, white: float = 0.0, model: float = 1.0
    ) -> Noise:
        """Return what makes the values scatter.

        Args:
            times: of the nodes, s.
            factor: of the variance by N grains.
            white: see `Noise`.
            model: factor of the error of the cooling rate.
        """
        known, error = self.rate_error
        return Noise(
            inverse_number=self.grains.inverse_number * factor,
            first=np.asarray(self.grains.first),
            rate_error=model * np.interp(times, known, error),
            sample=np.asarray(self.grains.sample),
            white=np.asarray(white),
        )

    @property
    def nuisances(self) -> dict[str, float]:
        """Its nuisance parameters, with their standard errors."""
        errors = {SCATTER: self.grains.log_error}
        if self.measurement.calibration_error:
            errors[CALIBRATION] = self.measurement.calibration_error
        if self.uses_rotation:
            errors[ROTATION] = self.rotation_accuracy
        if self.displacement is not None:
            errors[DISPLACEMENT] = self.displacement.accuracy
        return errors


@dataclass(frozen=True)
class DropRows:
    """A drop test of spheres of a gas, among the measurements of a fit."""

    label: str
    measurement: Measurement

    @property
    def gas(self) -> Gas:
        """The gas of the spheres, with the law and the friction that alternatives change."""
        return with_variant_law(with_coulomb_limit(self.measurement.gas))

    @property
    def scene(self) -> Gas:
        """The gas that was measured."""
        return self.measurement.gas

    @property
    def data(self) -> DropTest:
        """The impacts."""
        assert isinstance(self.measurement.data, DropTest)
        return self.measurement.data

    def scatter_of_eps(self, values: dict[str, Any], residuals: np.ndarray) -> float:
        """Return the standard deviation of eps from impact to impact.

        Args:
            values: parameters of the gas, by name; "spread" is the scatter of eps. Without it the
                most likely scatter is taken where eps scatters (`DropTest.scatters`).
            residuals: measured minus computed values, over their errors.
        """
        if "spread" in values:
            return float(values["spread"])
        if not self.data.scatters:
            return 0.0
        errors = self._errors(values)
        return most_likely_scatter(residuals[: errors.size], errors)

    def widening(self, values: dict[str, Any], scatter: float) -> np.ndarray:
        """Return the factor by which the scatter of eps widens each error.

        A scatter that is found from few impacts widens them more, see `few_values_factor`.

        Args:
            values: see `scatter_of_eps`.
            scatter: the standard deviation.
        """
        factors = np.ones(self.data.num_values)
        if scatter > 0:
            errors = self._errors(values)
            few = 1.0 if "spread" in values else few_values_factor(errors.size)
            factors[: errors.size] = np.hypot(1.0, few * scatter / errors)
        return factors

    def _errors(self, values: dict[str, Any]) -> np.ndarray:
        return np.asarray(self.data.errors(with_parameters(self.gas, values)))

    @property
    def num_points(self) -> int:
        """Number of measured values of restitution."""
        return self.data.num_values

    @property
    def nuisances(self) -> dict[str, float]:
        """It has no nuisance parameters."""
        return {}


def few_values_factor(number: int) -> float:
    """Return the factor of a standard deviation found from a few values, for error bars.

    With it 1.96 of the resulting standard errors of a mean are a 95 % interval by Student's t.
    """
    if number < 2:
        return 1.0
    degrees = number - 1
    ratio = scipy.stats.t.ppf(0.975, degrees) / scipy.stats.norm.ppf(0.975)
    return float(ratio * (number / degrees) ** 0.5)


def most_likely_scatter(residuals: np.ndarray, errors: np.ndarray) -> float:
    """Return the standard deviation of the scatter of values beyond their errors, >= 0.

    It maximises the likelihood of Gaussian values; -2 ln L then has no slope in it.

    Args:
        residuals: differences over their errors.
        errors: standard errors.
    """
    square = (residuals * errors) ** 2

    def misfit(log_variance: float) -> float:
        variance = errors**2 + np.exp(log_variance)
        return float(np.sum(square / variance + np.log(variance)))

    largest = np.log(np.max(square) + np.max(errors) ** 2)
    least = 2 * np.log(MIN_SCATTER * np.min(errors))
    found = scipy.optimize.minimize_scalar(misfit, bounds=(least, largest), method="bounded")
    return float(np.exp(found.x / 2))


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
    errors, notes = _errors(measurement, values)
    accuracy = float(model.rotation_accuracy(gas)) if _has_rotation(measurement) else 0.0
    rows = CurveRows(
        label=label,
        measurement=measurement,
        gas=with_neutral_elements(gas, model),
        values=values,
        errors=errors,
        used=_used(measurement, values, fits_T_0),
        grains=_grains(measurement, fits_T_0),
        faster=_finite_size_factor(measurement),
        unit_time=float(scales_at(gas).mean_free_time),
        rate_error=(np.zeros(1), np.zeros(1)),
        rotation_accuracy=accuracy,
        displacement=None if fits_t0 else _displacement(measurement, model),
    )
    return rows, notes


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


def _errors(
    measurement: Measurement, values: Float[np.ndarray, "times 2"]
) -> tuple[Float[np.ndarray, "times 2"], list[str]]:
    """Return the standard errors of T and T_rot with the rounding of the file, and notes."""
    dimension = measurement.gas.dimension
    notes: list[str] = []
    given = measurement.curve.temperature_error
    of_T = _errors_of_measurement("T_err", measurement, given, values[:, 0], dimension, notes)
    given = measurement.curve.rotational_temperature_error if _has_rotation(measurement) else None
    spins = NUM_SPIN_COMPONENTS[dimension]
    of_rotation = _errors_of_measurement(
        "T_rot_err", measurement, given, values[:, 1], spins, notes
    )
    digits = measurement.rounding
    of_T = np.hypot(of_T, np.asarray(digits.get("temperature", 0.0)) / 12**0.5)
    digit = np.asarray(digits.get("rotational_temperature", 0.0))
    of_rotation = np.hypot(of_rotation, digit / 12**0.5)
    return np.stack([of_T, of_rotation], axis=1), notes


def _used(
    measurement: Measurement, values: Float[np.ndarray, "times 2"], fits_T_0: bool
) -> Float[np.ndarray, "times 2"]:
    """Return 1 where a value counts, 0 elsewhere.

    A value at t = 0 without an error is the T_0 of the run.
    """
    curve = measurement.curve
    used = np.ones_like(values)
    used[:, 1] = float(_has_rotation(measurement))
    if np.asarray(curve.times)[0] == 0 and not _has_error_at_first(measurement):
        used[0, 0] = float(fits_T_0)
        used[0, 1] = 0.0
    error = curve.rotational_temperature_error
    used[:, 1] *= (values[:, 1] > 0) | (np.asarray(0.0 if error is None else error) > 0)
    return used


def _grains(measurement: Measurement, fits_T_0: bool) -> Grains:
    N = measurement.num_particles
    runs = measurement.replicas
    dimension = measurement.gas.dimension
    tracked = measurement.tracked
    sample = 0.0
    if tracked is not None:
        left = 1 - (0 if N is None else tracked / N)
        sample = 2 / (dimension * tracked * runs) * left
    return Grains(
        inverse_number=1 / ((UNKNOWN_NUMBER if N is None else N) * runs),
        log_error=WEAK_SCATTER if N is None else SCATTER_ERROR,
        sample=sample,
        first=2 / dimension if measurement.ensemble_start and not fits_T_0 else 0.0,
    )


def _finite_size_factor(measurement: Measurement) -> float:
    """Return the factor by which the measured gas cools faster because N is small."""
    N = measurement.num_particles
    return 1.0 if N is None else float(finite_size_cooling_factor(measurement.gas, float_array(N)))


def _has_error_at_first(measurement: Measurement) -> bool:
    error = measurement.curve.temperature_error
    counts = measurement.replicas == 1 or measurement.errors_measured
    return error is not None and counts and float(error[0]) > 0


def _errors_of_measurement(
    name: str,
    measurement: Measurement,
    given: Any,
    values: np.ndarray,
    components: int,
    notes: list[str],
) -> np.ndarray:
    """Return the standard errors of a measured quantity apart from the fluctuations of N grains.

    The errors of a mean over runs are those of the grains, which the likelihood knows. So are
    errors of one run that equal ``sqrt(2/(d N))`` of the values, the fluctuation of independent
    samples of N grains; those of a sample of the grains are computed, too.
    """
    nothing = np.zeros_like(values)
    if given is None:
        return nothing
    error = np.asarray(given)
    if measurement.errors_measured:
        return error
    if measurement.replicas > 1:
        return nothing
    if measurement.tracked is not None:
        notes.append(f"{name} is not used: the sampling of {measurement.tracked} grains is known")
        return nothing
    N = measurement.num_particles
    if N is not None:
        ratio = error[error > 0] / (2 / (components * N)) ** 0.5 / values[error > 0]
        if ratio.size and np.all(np.abs(ratio - 1) < ERRORS_OF_PARTICLES):
            notes.append(
                f"{name} equals the fluctuation of independent samples of {N} grains and is not "
                "used: the energy of all grains of one run fluctuates less. If these are errors of "
                "the measurement, say so: `errors: measured`"
            )
            return nothing
    return error


def _displacement(measurement: Measurement, model: AbstractModel) -> Displacement | None:
    """Return <dr^2> if it was measured with errors, or of N grains, and the model knows it.

    ln <dr^2> is compared. If a value is below 0, as after noise was subtracted, only values more
    than `NOISE` errors above 0 count.
    """
    curve = measurement.curve
    gas = measurement.gas
    N = measurement.num_particles
    if curve.displacement is None:
        return None
    accuracy = model.displacement_accuracy(gas)
    if accuracy is None:
        return None
    values = np.asarray(curve.displacement)
    if curve.displacement_error is None:
        if N is None:
            return None
        relative = np.full(values.shape, (2 / (gas.dimension * N * measurement.replicas)) ** 0.5)
    else:
        relative = np.asarray(curve.displacement_error) / np.maximum(values, TINY)
    used = (values > 0) & (relative > 0)
    if np.any(values < 0):
        used &= NOISE * relative < 1
    errors = np.where(used, np.hypot(relative, float(accuracy)), 0.0)
    return Displacement(values, errors, float(accuracy))


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


@eqx.filter_jit
def finite_size_cooling_factor(gas: Gas, num_particles: ArrayLike) -> Float[Array, ""]:
    """Factor by which N particles without total momentum cool faster than many, at the same T.

    Their relative velocities are those of the temperature ``T' = T N/(N-1)``, and each particle
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


def with_rate_error(rows: CurveRows, model: AbstractModel, gas: Gas) -> CurveRows:
    """Return a curve with the error of a model's cooling rate in a gas.

    Args:
        rows: the measured curve.
        model: of the fit; kinetic theory gives the curve on which the error of a stochastic one
            depends.
        gas: the scene, with values of the unknowns.
    """
    known = np.asarray(rows.curve.times) * rows.faster
    times, _ = times_with_nodes(known, rows.unit_time)
    exact = KineticTheory() if model.stochastic else model
    curve = curve_of_program(exact, gas, times, rows.displacement is not None)
    if not np.all(np.isfinite(np.asarray(curve.temperature))):
        return rows
    error_model = error_model_of_curve(gas, curve, rows.measurement.num_particles)
    error = np.broadcast_to(model.rate_error(error_model), times.shape)
    return replace(rows, rate_error=(times, np.asarray(error, float)))


def times_with_nodes(times: np.ndarray, mean_free_time: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times from 0 on that contain those given, and the places of these.

    Neighbours are at most `MAX_LOG_STEP` apart in ``ln(1 + t/tau_c)``. They are padded to a length
    of the grid by repeating the last one.
    """
    order = np.argsort(times, kind="stable")
    known = np.append(0.0, np.log1p(times[order] / mean_free_time))
    # As many nodes between two times as if the first one were 0: not fewer with another t0.
    since_first = np.log1p((times[order] - times[order[0]]) / mean_free_time)
    lengths = np.append(known[1], np.diff(since_first))
    parts = np.maximum(np.ceil(lengths / MAX_LOG_STEP).astype(int), 1)
    at = np.cumsum(parts)
    logs = np.interp(np.arange(at[-1] + 1), np.append(0, at), known)
    merged = np.expm1(logs) * mean_free_time
    merged[at] = times[order]
    place = np.empty(times.size, int)
    place[order] = at
    padding = grid_size(merged.size) - merged.size
    return np.append(merged, np.full(padding, merged[-1])), place
