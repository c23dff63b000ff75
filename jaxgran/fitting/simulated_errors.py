"""Errors of an estimate by a search through simulations: their parts by cause."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import Priors
from jaxgran.fitting.information import FEW_PARTICLES, SAMPLING
from jaxgran.fitting.parameters import (
    SMOOTHNESS,
    extra_parameters,
    prior_residuals,
    with_parameters,
)
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.simulations import Search, Simulations, information_by
from jaxgran.models.error_model import ErrorModel
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.models.linearise import linearise, with_neutral_elements
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


def expand(sims: Simulations, search: Search) -> Expansion:
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


def covariances_of(
    priors: Priors, sims: Simulations, search: Search, expansion: Expansion, gas: Gas, bias: float
) -> dict[str, np.ndarray]:
    """Return the parts of the covariance of an estimate, SI, by cause.

    Args:
        priors: priors of the fit.
        sims: simulations and the measurement.
        search: search that ended at the estimate.
        expansion: of the simulations near the estimate.
        gas: fitted gas.
        bias: relative bias of the derivatives, see `derivative_bias`.
    """
    average = search.average
    comparison = average.comparison
    sensitivity = expansion.sensitivity
    smoothness = _smoothness_slopes(sims.problem, average.flat)
    information = sensitivity.T @ sensitivity + smoothness.T @ smoothness
    covariance = np.linalg.pinv(information, rcond=sims.model.derivative_accuracy**2)
    scale = sims.problem.slopes(average.flat)[:, None]
    to_si = scale * covariance

    parts = {}
    for name in ("measurement", FEW_PARTICLES, SAMPLING, "model"):
        by_source = information_by(comparison, expansion.slopes, name) / expansion.scatter
        parts[name] = to_si @ by_source @ to_si.T
    parts["simulation"] = scale * average.noise * scale.T
    if smoothness.size:
        parts[SMOOTHNESS] = to_si @ smoothness.T @ smoothness @ to_si.T
    others = {name: prior for name, prior in priors.items() if name != SMOOTHNESS}
    effects = prior_effects(gas, others, search.curve, sims.rows.uses_rotation)
    scale_of_T = sims.rows.measurement.calibration_error
    effects["calibration"] = np.full((expansion.computed.size, 1), scale_of_T)
    for name, change in effects.items():
        whitened = comparison.whiten(change) / expansion.scatter**0.5
        moved = to_si @ sensitivity.T @ whitened
        parts[name] = moved @ moved.T
    # A slope that is too large by the bias widens the statistical error, and moves the estimate in
    # proportion to its distance from the simulations.
    distance = scale[:, 0] * (average.flat - np.mean([s.flat for s in search.near], axis=0))
    statistical = sum(parts[x] for x in ("measurement", "simulation", FEW_PARTICLES, SAMPLING))
    parts["slope"] = ((1 + bias) ** 2 - 1) * statistical + bias**2 * np.outer(distance, distance)
    return {name: part for name, part in parts.items() if np.any(part)}


def _smoothness_slopes(problem: Problem, flat: np.ndarray) -> np.ndarray:
    """Return derivatives of the law's own prior in the unknowns, shape (residuals, p)."""
    gas = problem.measurements[0].scene

    def prior(flat: Array) -> Array:
        return with_parameters(gas, problem.values(flat)[""]).law.prior_residuals()

    if not gas.law.prior_residuals().size:
        return np.zeros((0, flat.size))
    return np.asarray(jax.jacfwd(prior)(jnp.asarray(flat)))


def derivative_bias(sims: Simulations, search: Search, gas: Gas, sensitivity: np.ndarray) -> float:
    """Return the relative bias of the derivatives of particles, as a weighted mean over the points.

    It comes from the curve of the last run or, if this has none, from an estimate by the model.
    """
    curve = search.curve
    bias = curve.derivative_bias
    if bias is None:
        N = getattr(sims.model, "num_particles", None)
        error_model = ErrorModel.from_curve(gas, _from_start(gas, curve), N)
        whole = np.broadcast_to(sims.model.derivative_error(error_model), error_model.time.shape)
        bias = whole[-curve.times.size :]
    weights = np.sum(sensitivity[: curve.times.size] ** 2, axis=1)
    whole = max(float(np.sum(weights)), np.finfo(float).tiny)
    return abs(float(np.sum(weights * np.asarray(bias)) / whole))


def _from_start(gas: Gas, curve: CoolingCurve) -> CoolingCurve:
    """Return T, a_2, collisions and T_rot of a curve from t = 0 on."""
    names = ("temperature", "sonine", "collisions", "rotational_temperature")
    known = {name: getattr(curve, name) for name in names if getattr(curve, name) is not None}
    known |= {"times": curve.times, "status": np.zeros((), int)}
    if float(curve.times[0]) > 0:
        firsts = {name: gas.parameters.get(name, 0.0) for name in known if name != "status"}
        known |= {name: np.append(np.asarray(first), known[name]) for name, first in firsts.items()}
    return CoolingCurve(**as_jax_arrays(known))


def prior_effects(
    gas: Gas, priors: Priors, computed: CoolingCurve, uses_rotation: bool
) -> dict[str, Float[np.ndarray, "values size"]]:
    """Return the changes of ln T and ln T_rot by one standard error of each prior.

    Kinetic theory gives the changes.

    Args:
        gas: the fitted gas.
        priors: the priors of the fit.
        computed: the computed curve of the fit.
        uses_rotation: whether the fit uses T_rot.
    """
    if not priors:
        return {}
    model = KineticTheory()
    varied = extra_parameters(priors, ())
    times = np.asarray(computed.times)
    complete = with_neutral_elements(gas, model)
    linear = linearise(model.simplified_for(gas), complete, times, varied)

    def of_logs(part: dict[str, Any]) -> np.ndarray:
        of_T = (part["temperature"].T / linear.values["temperature"]).T
        of_rotation = np.zeros_like(of_T)
        if uses_rotation:
            name = "rotational_temperature"
            of_rotation = (part[name].T / linear.values[name]).T
        return np.concatenate([of_T, of_rotation])

    values = {name: np.asarray(gas.value(name)) for name in varied}
    by_parameter = np.concatenate([of_logs(linear.by_float[n]) for n in varied], axis=1)
    rows = prior_residuals(priors, gas, values)
    by_residual = np.block(
        [
            [slopes.get(n, np.zeros((row.size, values[n].size))) for n in varied]
            for row, slopes in rows.values()
        ]
    )
    changes = by_parameter @ np.linalg.pinv(by_residual)
    ends = np.cumsum([given.size for given, _ in priors.values()])[:-1]
    return dict(zip(priors, np.split(changes, ends, axis=1), strict=True))
