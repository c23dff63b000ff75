"""A measured curve compared with its prediction: independent residuals and their derivatives.

The innovations of a curve (`jaxgran.fitting.innovations`) depend on the unknowns through the
predicted curve and through the scatter of N grains. They are differentiated by central differences
along the tangents of the prediction: one call for all unknowns, by a program of its own.
"""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxgran._utils.tracing import fast_jit
from jaxgran.fitting.innovations import Innovations, innovations
from jaxgran.fitting.kalman import Nodes, filtered
from jaxgran.fitting.parameters import with_parameters
from jaxgran.fitting.prediction import Element, PredictedCurve, Prediction, diffusive_share
from jaxgran.fitting.rows import (
    DISPLACEMENT,
    FEW_PARTICLES,
    MEASUREMENT,
    MODEL,
    SAMPLING,
    SIMULATION,
    Displacement,
    Noise,
    Observed,
)
from jaxgran.scene.gas import Gas

DIFFERENCE = float(np.finfo(float).eps ** 0.25)
"""Step of central differences in an unconstrained parameter."""


class Residuals(NamedTuple):
    """Independent Gaussian residuals, with their derivatives in all unknowns.

    Attributes:
        name: what they belong to: "curve", "displacement", "drop test", or the name of a prior or
            of a nuisance parameter.
        label: of the measurement; `SHARED` for priors of shared parameters.
        values: over their standard deviation, shape (n,); 0 where nothing was measured.
        slopes: derivatives at fixed standard deviations, shape (n, unknowns).
        log_variance: logarithm of their variances, shape (n,).
        log_slopes: its derivatives, shape (n, unknowns).
        is_prior: whether they are of prior knowledge.
    """

    name: str
    label: str
    values: Float[np.ndarray, "n"]
    slopes: Float[np.ndarray, "n unknowns"]
    log_variance: Float[np.ndarray, "n"]
    log_slopes: Float[np.ndarray, "n unknowns"]
    is_prior: bool = False

    @property
    def information(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """Half of the expected second derivatives of -2 ln L."""
        return self.slopes.T @ self.slopes + 0.5 * self.log_slopes.T @ self.log_slopes


@dataclass(frozen=True)
class Comparison:
    """A predicted curve and the measured one.

    Attributes:
        curve: the predicted curve, with the measurement.
        sources: factors of the variances by "measurement", which includes independent errors that
            a fit finds, "few particles", "sampling", "model" and "simulation"; 1 by default.
    """

    curve: PredictedCurve
    sources: dict[str, float] = field(default_factory=dict)

    @np.errstate(divide="ignore", invalid="ignore", over="ignore")
    def residuals(self, size: int) -> list[Residuals]:
        """Return the residuals, with derivatives in all of `size` unknowns."""
        curve = self.curve
        rows = [self._temperature_residuals(size)]
        if curve.rows.displacement is not None:
            rows.append(_displacement_residuals(curve, curve.rows.displacement, size))
        return rows

    def whiten(
        self, columns: Float[np.ndarray, "values columns"]
    ) -> Float[np.ndarray, "values columns"]:
        """Return residuals that the likelihood makes independent, of variance 1.

        Args:
            columns: of ln T at all times, followed by ln T_rot.
        """
        curve = self.curve
        count = columns.shape[1]
        at_nodes = np.zeros((curve.times.size, 2, count))
        at_nodes[curve.place] = columns.reshape(2, -1, count).swapaxes(0, 1)
        observed = self._observed()
        errors = observed.errors / np.exp(curve.prediction.compared)
        variances = errors**2 + observed.simulation
        # The one gas is the last axis of all arrays, and the first one of its parameters.
        prediction = jax.tree.map(lambda x: np.asarray(x)[..., None], curve.prediction)
        gas = jax.tree.map(lambda x: np.asarray(x)[None], curve.gas)
        compiled = fast_jit(filtered, jax.default_backend())
        found = compiled(
            gas,
            _nodes(curve, prediction, curve.gas),
            at_nodes[..., None],
            variances[..., None],
            np.ones((curve.times.size, 1)),
            observed.used,
            self._noise(prediction.scatter),
        )
        values, spread = (np.asarray(x)[curve.place, ..., 0] for x in found)
        values = values / np.sqrt(spread)[..., None]
        return values.swapaxes(0, 1).reshape(-1, count)

    def _temperature_residuals(self, size: int) -> Residuals:
        """Return the residuals of T, followed by the residuals of T_rot."""
        moving = _elements_that_change_temperatures(self.curve)
        here, *steps = self._innovations_at_neighbours([tangent for _, tangent in moving])
        error = np.sqrt(here.variances)
        values = here.values / error
        slopes = np.zeros((values.size, size))
        log_slopes = np.zeros((values.size, size))
        for (element, _), up, down in zip(moving, steps[::2], steps[1::2], strict=True):
            of_value = (up.values - down.values) / (2 * DIFFERENCE)
            of_log_variance = np.log(up.variances / down.variances) / (2 * DIFFERENCE)
            of_change = (up.density_changes - down.density_changes) / (2 * DIFFERENCE)
            # What -2 ln L gains where T is compared in place of ln T is shared between both, so
            # that slopes become the slopes of (y - T)/error there, and log_slopes 0.
            slopes[:, element.place] = of_value / error + 0.5 * values * of_change
            log_slopes[:, element.place] = of_log_variance + of_change
        return Residuals(
            name="curve",
            label=self.curve.rows.label,
            values=values,
            slopes=slopes,
            log_variance=np.log(here.variances) + here.density_changes,
            log_slopes=log_slopes,
        )

    def _innovations_at_neighbours(self, tangents: list[Prediction]) -> list[Innovations]:
        """Return innovations at the unknowns, then a step up and a step down along each tangent.

        Each has the shape (2 times,): all times of T, then all times of T_rot.
        """
        curve = self.curve
        count = 1 + 2 * len(tangents)
        gases = _batch_size(count)
        steps = np.zeros((len(tangents), gases))
        for k in range(len(tangents)):
            steps[k, 1 + 2 * k] = DIFFERENCE
            steps[k, 2 + 2 * k] = -DIFFERENCE

        def with_neighbours(x: Any, *tangents: Any) -> np.ndarray:
            # The zeros, which are left out again, give the shape if there are no tangents.
            slopes = np.stack([np.zeros_like(x), *tangents], axis=-1)[..., 1:]
            return np.asarray(x)[..., None] + slopes @ steps

        batch: Prediction = jax.tree.map(with_neighbours, curve.prediction, *tangents)
        T = np.exp(batch.compared[:, 0])
        compared = batch.compared.copy()
        compared[:, 0] = np.log(T + batch.floor)
        parameters = {name: np.moveaxis(x, -1, 0) for name, x in batch.parameters.items()}
        gas = with_parameters(curve.rows.gases(gases), parameters)
        compiled = fast_jit(innovations, jax.default_backend())
        found = compiled(
            gas,
            _nodes(curve, batch, gas),
            compared,
            T / (T + batch.floor),
            self._observed(),
            self._noise(batch.scatter, self._error_factor * batch.white),
        )

        def of_data(x: Any) -> np.ndarray:
            return np.asarray(x)[curve.place, :, :count].transpose(2, 1, 0).reshape(count, -1)

        used = curve.rows.used.T.ravel() > 0
        values = of_data(found.values)
        variances = np.where(used, of_data(found.variances), 1.0)
        density_changes = np.where(used, of_data(found.density_changes), 0.0)
        rows = zip(values, variances, density_changes, strict=True)
        return [Innovations(*row) for row in rows]

    @property
    def _error_factor(self) -> float:
        """Factor of the errors of the measurement."""
        return self.sources.get(MEASUREMENT, 1.0) ** 0.5

    def _observed(self) -> Observed:
        curve = self.curve
        observed = curve.rows.at_nodes(curve.times.size, curve.place, self._error_factor)
        simulation = self.sources.get(SIMULATION, 1.0) * observed.simulation
        return observed._replace(simulation=simulation)

    def _noise(self, log_scatter: Any, white: Any = 0.0) -> Noise:
        curve = self.curve
        few_particles = self.sources.get(FEW_PARTICLES, 1.0)
        of_number = few_particles * np.exp(log_scatter)
        factor = self.sources.get(MODEL, 1.0) ** 0.5
        noise = curve.rows.noise(curve.times, of_number, white, factor)
        return noise._replace(sample=self.sources.get(SAMPLING, 1.0) * noise.sample)


def _nodes(curve: PredictedCurve, batch: Prediction, gas: Gas) -> Nodes:
    """Return predictions of some gases, which are the last axis of `batch`, as nodes."""
    return Nodes(
        log_temperature=batch.log_T,
        rotation=batch.rotation,
        sonine=curve.sonine,
        collisions=batch.collisions,
        size_ratio=batch.size_ratio,
        by_size_ratio=curve.by_size_ratio(gas, batch.size_ratio),
        is_before=curve.is_before,
    )


def _elements_that_change_temperatures(curve: PredictedCurve) -> list[tuple[Element, Prediction]]:
    """Return the unknowns on which T and T_rot depend, with their tangents."""
    pairs = zip(curve.elements, curve.tangents, strict=True)
    return [(element, tangent) for element, tangent in pairs if element.name != DISPLACEMENT]


def _displacement_residuals(curve: PredictedCurve, measured: Displacement, size: int) -> Residuals:
    """Return the residuals of <dr^2>."""
    collisions = curve.prediction.collisions[curve.place]
    share = diffusive_share(collisions)
    factor = curve.values.get(DISPLACEMENT, 0.0)
    computed = curve.prediction.displacement[curve.place] + factor * share
    used = measured.used
    values = measured.whitening @ np.where(used, measured.logs - computed, 0.0)
    slopes = np.zeros((values.size, size))
    for element, tangent in zip(curve.elements, curve.tangents, strict=True):
        change = tangent.displacement[curve.place]
        if element.name == DISPLACEMENT:
            change = share * element.slope
        slopes[:, element.place] = -measured.whitening @ np.where(used, change, 0.0)
    return Residuals(
        name="displacement",
        label=curve.rows.label,
        values=values,
        slopes=slopes,
        log_variance=np.zeros(values.size),
        log_slopes=np.zeros_like(slopes),
    )


def _batch_size(count: int) -> int:
    """Return the smallest of 8, 16, 32, ... that is >= `count`, so that few sizes are compiled."""
    return max(8, 1 << (count - 1).bit_length())
