"""Errors of an estimate by a search through simulations: their parts by cause."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import Priors
from jaxgran.fitting.information import resolved_inverse
from jaxgran.fitting.parameters import SMOOTHNESS
from jaxgran.fitting.prior_effects import prior_effects
from jaxgran.fitting.rows import (
    CALIBRATION,
    FEW_PARTICLES,
    MEASUREMENT,
    MODEL,
    SAMPLING,
    SIMULATION,
    SLOPE,
)
from jaxgran.fitting.simulations import SearchResult, Simulations, information_by
from jaxgran.models.error_model import ErrorModel
from jaxgran.scene.gas import Gas


class Expansion(NamedTuple):
    """Measured values beside the mean of the simulations near an estimate.

    Values are ln T at all times, followed by ln T_rot.

    Attributes:
        computed: values of the mean simulation at the estimate, shape (values,).
        slopes: their derivatives in the parameters, shape (values, p).
        residuals: measured minus computed values, independent and of unit variance.
        sensitivity: derivatives of the computed ones, whitened alike, shape (values, p).
        num_used: number of values that count.
        scatter: mean square of the residuals before they were divided by it, where N is not known:
            it tells how many grains there were; otherwise 1.
    """

    computed: Float[np.ndarray, "values"]
    slopes: Float[np.ndarray, "values p"]
    residuals: Float[np.ndarray, "values"]
    sensitivity: Float[np.ndarray, "values p"]
    num_used: int
    scatter: float

    @property
    def degrees_of_freedom(self) -> int:
        """Number of values less the number of parameters, at least 1."""
        return max(self.num_used - self.slopes.shape[1], 1)


def expand(sims: Simulations, search: SearchResult) -> Expansion:
    """Return the values and slopes of the simulations near an estimate."""
    flat = search.average.flat
    differences = [sims.measured - s.values - s.slope @ (flat - s.flat) for s in search.near]
    difference = np.mean(differences, axis=0)
    slopes = np.mean([s.slope for s in search.near], axis=0)
    columns = np.concatenate([difference[:, None], slopes], axis=1)
    whitened = search.average.comparison.whiten(columns)
    found = Expansion(
        computed=sims.measured - difference,
        slopes=slopes,
        residuals=whitened[:, 0],
        sensitivity=whitened[:, 1:],
        num_used=int(np.sum(sims.rows.used)),
        scatter=1.0,
    )
    if sims.rows.measurement.num_particles is not None:
        return found
    square = float(found.residuals @ found.residuals)
    scatter = max(square / found.degrees_of_freedom, 1e-12)
    return found._replace(
        residuals=found.residuals / scatter**0.5,
        sensitivity=found.sensitivity / scatter**0.5,
        scatter=scatter,
    )


class SimulatedEstimate(NamedTuple):
    """An estimate by a search through simulations.

    Attributes:
        sims: the simulations and the measurement.
        search: where the search ended.
        expansion: of the simulations near the estimate.
        gas: the fitted gas.
    """

    sims: Simulations
    search: SearchResult
    expansion: Expansion
    gas: Gas

    @property
    def scale(self) -> Float[np.ndarray, "p 1"]:
        """Derivatives of the parameters, SI, in the unconstrained ones."""
        return self.sims.problem.compute_slopes(self.search.average.flat)[:, None]


def covariances_of(
    estimate: SimulatedEstimate, priors: Priors, bias: float
) -> dict[str, np.ndarray]:
    """Return the parts of the covariance of an estimate, SI, by cause.

    Args:
        estimate: the estimate.
        priors: priors of the fit.
        bias: relative bias of the derivatives, see `derivative_bias`.
    """
    smoothness = _smoothness_slopes(estimate)
    sensitivity = estimate.expansion.sensitivity
    information = sensitivity.T @ sensitivity + smoothness.T @ smoothness
    # The change of the estimate, SI, with the derivatives of ln L.
    gain = estimate.scale * resolved_inverse(information, estimate.sims.model.derivative_accuracy)
    parts = _parts_of_data(estimate, gain)
    parts[SIMULATION] = estimate.scale * estimate.search.average.noise * estimate.scale.T
    parts[SMOOTHNESS] = gain @ smoothness.T @ smoothness @ gain.T
    parts |= _parts_of_priors(estimate, priors, gain)
    parts[SLOPE] = _part_of_slope(estimate, parts, bias)
    return {name: part for name, part in parts.items() if np.any(part)}


def _smoothness_slopes(estimate: SimulatedEstimate) -> Float[np.ndarray, "residuals p"]:
    """Return the derivatives of the law's own prior in the parameters."""
    flat = estimate.search.average.flat
    if not estimate.gas.law.prior_residuals().size:
        return np.zeros((0, flat.size))
    slopes = jax.jacfwd(lambda flat: estimate.sims.gas_at(flat).law.prior_residuals())
    return np.asarray(slopes(jnp.asarray(flat)))


def _parts_of_data(estimate: SimulatedEstimate, gain: np.ndarray) -> dict[str, np.ndarray]:
    """Return the parts by the errors and the scatter of the measured values, and the model's."""
    comparison = estimate.search.average.comparison
    expansion = estimate.expansion
    parts = {}
    for name in (MEASUREMENT, FEW_PARTICLES, SAMPLING, MODEL):
        by_source = information_by(comparison, expansion.slopes, name) / expansion.scatter
        parts[name] = gain @ by_source @ gain.T
    # The rest of the scatter is the noise of the simulations, a part of its own.
    measured = estimate.sims.theory.grains.inverse_number
    parts[FEW_PARTICLES] *= measured / comparison.curve.rows.grains.inverse_number
    return parts


def _parts_of_priors(
    estimate: SimulatedEstimate, priors: Priors, gain: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the parts by the errors of what is known of the gas, and of the scale of T."""
    sims, search, expansion, gas = estimate
    others = {name: prior for name, prior in priors.items() if name != SMOOTHNESS}
    effects = prior_effects(gas, others, search.curve, sims.rows.uses_rotation)
    calibration_error = sims.rows.measurement.calibration_error
    effects[CALIBRATION] = np.full((expansion.computed.size, 1), calibration_error)
    parts = {}
    for name, change in effects.items():
        whitened = search.average.comparison.whiten(change) / expansion.scatter**0.5
        moved = gain @ expansion.sensitivity.T @ whitened
        parts[name] = moved @ moved.T
    return parts


def _part_of_slope(
    estimate: SimulatedEstimate, parts: dict[str, np.ndarray], bias: float
) -> np.ndarray:
    """Return the part by a relative bias of the derivatives.

    Too large a slope widens the statistical error, and moves the estimate in proportion to its
    distance from the simulations.
    """
    search = estimate.search
    center = np.mean([s.flat for s in search.near], axis=0)
    distance = estimate.scale[:, 0] * (search.average.flat - center)
    statistical = sum(parts[x] for x in (MEASUREMENT, SIMULATION, FEW_PARTICLES, SAMPLING))
    return ((1 + bias) ** 2 - 1) * statistical + bias**2 * np.outer(distance, distance)


def derivative_bias(estimate: SimulatedEstimate) -> float:
    """Return the relative bias of the derivatives of particles, as a weighted mean over the points.

    It comes from the curve of the last run or, if this has none, from an estimate by the model.
    """
    model = estimate.sims.model
    curve = estimate.search.curve
    bias = curve.derivative_bias
    if bias is None:
        N = estimate.sims.num_particles
        error_model = ErrorModel.from_curve(estimate.gas, _from_start(estimate.gas, curve), N)
        since_start = np.broadcast_to(model.derivative_error(error_model), error_model.time.shape)
        bias = since_start[-curve.times.size :]
    weights = np.sum(estimate.expansion.sensitivity[: curve.times.size] ** 2, axis=1)
    total = max(float(np.sum(weights)), np.finfo(float).tiny)
    return abs(float(np.sum(weights * np.asarray(bias)) / total))


def _from_start(gas: Gas, curve: CoolingCurve) -> CoolingCurve:
    """Return T, a_2, collisions and T_rot of a curve from t = 0 on, where a_2 is 0."""
    starts = {"times": 0.0, "temperature": gas.temperature, "sonine": 0.0, "collisions": 0.0}
    if curve.rotational_temperature is not None:
        starts["rotational_temperature"] = gas.value("rotational_temperature")
    known = {name: x for name in starts if (x := getattr(curve, name)) is not None}
    if float(curve.times[0]) > 0:
        known = {name: np.append(np.asarray(starts[name]), x) for name, x in known.items()}
    return CoolingCurve(**as_jax_arrays(known | {"status": np.zeros((), int)}))
