"""Random errors of a measurement, with which runs of a model are imitations of it."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import DENSITY, START_TIME, Measurement, Priors, prior_domain
from jaxgran.fitting.kalman import SAMPLE_DECAY_RATE
from jaxgran.fitting.measured_rows import sampling_variance
from jaxgran.fitting.result import Fit
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS

TEMPERATURES = ("temperature", "rotational_temperature")


def imitations(
    measurement: Measurement,
    result: Fit,
    curve: CoolingCurve,
    runs: int,
    rng: np.random.Generator,
) -> list[Measurement]:
    """Return runs of a model as they would be measured.

    Errors are drawn of each value, of the sampling of tracked grains, of the scale of T, and of all
    that is known of the scene.

    Args:
        measurement: what is imitated, of one curve, with the errors that count.
        result: its fit; errors keep their size relative to the fitted values.
        curve: by a particle model, with the curves of all replicas.
        runs: number of imitations.
        rng: random numbers.
    """
    scale = np.exp(measurement.calibration_error * rng.normal(size=(runs, 1)))
    fields = {}
    for name in TEMPERATURES:
        if getattr(measurement.curve, name) is None:
            continue
        each = np.asarray(getattr(curve.replicas, name)).reshape(runs, measurement.replicas, -1)
        values = each.mean(axis=1)
        found = 0.0
        if name == "temperature":
            values = values * np.exp(_sampling_errors(measurement, curve, runs, rng))
            found = result.errors_of_T.get("", 0.0)
        else:
            spins = NUM_SPIN_COMPONENTS[measurement.gas.dimension]
            found = sampling_variance(measurement, spins) ** 0.5
        error = getattr(measurement.curve, f"{name}_error")
        noise = np.expm1(found * rng.normal(size=values.shape)) * values
        if error is not None:
            fitted = np.asarray(getattr(result.curve, name))
            ratio = np.divide(values, fitted, out=np.ones_like(values), where=fitted > 0)
            errors = np.asarray(error) * ratio
            noise += errors * rng.normal(size=values.shape)
            fields[f"{name}_error"] = errors * scale
        fields[name] = (values + noise) * scale
    curves = [
        replace(measurement.curve, **as_jax_arrays({name: x[run] for name, x in fields.items()}))
        for run in range(runs)
    ]
    return [
        replace(measurement, data=data, priors=_drawn_priors(measurement, result, rng))
        for data in curves
    ]


def _sampling_errors(
    measurement: Measurement, curve: CoolingCurve, runs: int, rng: np.random.Generator
) -> Float[np.ndarray, "runs times"]:
    """Return errors of ln T of some tracked grains in place of all."""
    variance = sampling_variance(measurement, measurement.gas.dimension)
    shape = runs, measurement.curve.times.size
    if variance == 0:
        return np.zeros(shape)
    collisions = np.asarray(curve.collisions)
    distance = np.abs(collisions[:, None] - collisions[None])
    correlation = np.exp(-SAMPLE_DECAY_RATE * distance) + 1e-9 * np.eye(collisions.size)
    return variance**0.5 * rng.normal(size=shape) @ np.linalg.cholesky(correlation).T


def _drawn_priors(measurement: Measurement, result: Fit, rng: np.random.Generator) -> Priors:
    """Return what is known of the scene, with errors about its true values."""
    gas = measurement.gas
    drawn: dict[str, Any] = {}
    for name, (given, error) in measurement.priors.items():
        if name == START_TIME:
            truth = np.asarray(result.start_time[""])
        elif name == DENSITY:
            truth = 6 / np.pi * np.asarray(gas.mass) / np.asarray(gas.diameter) ** 3
        else:
            truth = np.asarray(gas.value(name))
        domain = prior_domain(gas, name)
        width = np.asarray(error) / domain.slope(np.asarray(given))
        value = domain.from_free(domain.to_free(truth) + width * rng.normal(size=truth.shape))
        drawn[name] = value, width * domain.slope(value)
    return as_jax_arrays(drawn)
