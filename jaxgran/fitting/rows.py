"""Rows of data that a fit compares with a model: rows of measured curves and of drop tests."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
import scipy  # which imports scipy.optimize at its first use
from jaxtyping import Bool, Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.parameters import with_parameters
from jaxgran.models.linearise import with_coulomb_limit, with_variant_law
from jaxgran.scene.gas import Gas

BEYOND_ROUNDING = 1.001
"""Ratio of an error to the one of rounding, above which a value has an error of measurement."""

SCATTER = "scatter of N"
"""Nuisance parameter: the logarithm of the scatter of N grains over what theory gives."""

ROTATION = "model of T_rot"
"""Nuisance parameter: the logarithm of a common factor of all T_rot, over theory's accuracy."""

DISPLACEMENT = "model of <dr^2>"
"""The same of the diffusive part of <dr^2>."""

FLOOR = "floor"
"""Noise floor, m^2/s^2, added to the computed T: a parameter of an alternative explanation."""

WHITE = "white"
"""Relative standard deviation of further independent errors of T: a parameter of an alternative
explanation, too."""

CALIBRATION = "calibration"
"""The logarithm of a common factor of all measured T and T_rot."""

MEASUREMENT = "measurement"
"""Part of an error by the errors of the measured values."""

FEW_PARTICLES = "few particles"
"""Part of an error by the randomness of collisions of N grains."""

SAMPLING = "sampling"
"""Part of an error by T of some tracked grains in place of all."""

MODEL = "model"
"""Part of an error by the error of the model's cooling rate."""

SIMULATION = "simulation"
"""Part of an error by the noise of simulations."""

SLOPE = "slope"
"""Part of an error by the bias of the derivatives of simulations."""

MIN_SCATTER = 1e-3
"""Smallest scatter of eps that is searched, over the smallest error."""


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
        contacts: factor of the variance by contacts of soft spheres: 0 for a model without them.
    """

    inverse_number: float
    log_error: float
    sample: float = 0.0
    first: float = 0.0
    contacts: float = 1.0


class Noise(NamedTuple):
    """What makes the measured values scatter about theory, apart from their own errors.

    Attributes:
        inverse_number: 1/N over all runs, times a factor that a fit may vary.
        first: variance of ln T at t = 0 over `inverse_number`: 0 where T_0 is the run's own.
        rate_error: relative standard error of theory's cooling rate at the nodes, shape (nodes,).
        sample: variance of ln T by the sampling of some of the grains.
        white: relative standard deviation of further errors of T, independent at each time.
        contacts: factor of the variance by contacts of soft spheres.
    """

    inverse_number: Any
    first: Any
    rate_error: Any
    sample: Any
    white: Any
    contacts: Any = 1.0


class RateError(NamedTuple):
    """Relative standard error of a model's cooling rate along a curve.

    Attributes:
        times: at which it is known, s.
        error: at these times.
    """

    times: Float[np.ndarray, "nodes"]
    error: Float[np.ndarray, "nodes"]


class Displacement(NamedTuple):
    """A measured <dr^2>.

    Attributes:
        logs: ln <dr^2>, <dr^2> in m^2; 0 where a value does not count.
        whitening: matrix that makes residuals of `logs` independent, of variance 1; its rows and
            columns are 0 where a value does not count.
        accuracy: relative accuracy of the model, which applies to a common factor, too.
    """

    logs: Float[np.ndarray, "times"]
    whitening: Float[np.ndarray, "times times"]
    accuracy: float

    @property
    def used(self) -> Bool[np.ndarray, "times"]:
        """Whether a value counts."""
        return np.diag(self.whitening) > 0


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
        rate_error: of the model.
        rotation_accuracy: relative accuracy of the model's T_rot.
        displacement: <dr^2>; None where it is not used.
        offset: ln T and ln T_rot of the fitted model minus the values of the evaluated model,
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
    rate_error: RateError
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

    def gases(self, count: int) -> Gas:
        """Return the gas `count` times: its floats have a first axis."""
        if count not in self._known_gases:
            self._known_gases[count] = jax.tree.map(
                lambda x: np.broadcast_to(x, (count, *np.shape(x))), self.gas
            )
        return self._known_gases[count]

    @cached_property
    def _known_gases(self) -> dict[int, Gas]:
        return {}

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

    def noise(self, times: np.ndarray, factor: Any, white: Any = 0.0, model: float = 1.0) -> Noise:
        """Return what makes the values scatter.

        Args:
            times: of the nodes, s.
            factor: of the variance by N grains.
            white: see `Noise`.
            model: factor of the error of the cooling rate.
        """
        return Noise(
            inverse_number=self.grains.inverse_number * factor,
            first=np.asarray(self.grains.first),
            rate_error=model * np.interp(times, *self.rate_error),
            sample=np.asarray(self.grains.sample),
            white=np.asarray(white),
            contacts=np.asarray(self.grains.contacts),
        )

    def with_wider_rate_error(self, error: float) -> "CurveRows":
        """Return the curve with a larger relative error of the model's cooling rate."""
        wider = self.rate_error._replace(error=self.rate_error.error + error)
        return replace(self, rate_error=wider)

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
        """Return the errors of eps."""
        errors = self.data.errors(with_parameters(self.gas, values))
        return np.asarray(errors)[: np.size(self.data.restitution)]

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


def rounding_errors(measurement: Measurement) -> Float[np.ndarray, "times 2"]:
    """Return the standard errors of T and T_rot by the rounding of the file, 0 without a file."""
    digits = measurement.rounding
    times = measurement.curve.times.shape
    names = ("temperature", "rotational_temperature")
    each = [np.broadcast_to(np.asarray(digits.get(name, 0.0)), times) for name in names]
    return np.stack(each, axis=1) / 12**0.5


def has_no_measured_errors(rows: CurveRows) -> bool:
    """Tell whether no T of a curve has an error beyond its rounding."""
    rounding = rounding_errors(rows.measurement)[:, 0]
    return not np.any(rows.errors[:, 0] > BEYOND_ROUNDING * rounding)
