"""Random errors of a measurement, with which runs of a model are imitations of it."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import DENSITY, START_TIME, Measurement, Priors, prior_domain
from jaxgran.fitting.innovations import SAMPLE_MEMORY
from jaxgran.fitting.measured_rows import errors_that_count, sampling_variance
from jaxgran.fitting.result import Fit

QUANTITIES = ("temperature", "rotational_temperature")


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
        measurement: what is imitated, of one curve.
        result: its fit; errors keep their size relative to the fitted values.
        curve: by a particle model, with the curves of all replicas.
        runs: number of imitations.
        rng: random numbers.
    """
    used, _ = errors_that_count(measurement)
    factors = np.exp(measurement.calibration_error * rng.normal(size=(runs, 1)))
    fields = {}
    for number, name in enumerate(QUANTITIES):
        if getattr(measurement.curve, name) is None:
            continue
        each = np.asarray(getattr(curve.replicas, name)).reshape(runs, measurement.replicas, -1)
        values = each.mean(axis=1)
        fitted = np.asarray(getattr(result.curve, name))
        relative = used[:, number] / fitted
        if name == "temperature":
            relative = np.hypot(relative, result.errors_of_T.get("", 0.0))
            values = values * np.exp(_sampling_errors(measurement, curve, runs, rng))
        values = values * (1 + relative * rng.normal(size=values.shape))
        error = getattr(measurement.curve, f"{name}_error")
        if error is not None:
            fields[f"{name}_error"] = np.asarray(error) / fitted * values * factors
        fields[name] = values * factors
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
    variance = sampling_variance(measurement)
    shape = runs, measurement.curve.times.size
    if variance == 0:
        return np.zeros(shape)
    collisions = np.asarray(curve.collisions)
    distance = np.abs(collisions[:, None] - collisions[None])
    correlation = np.exp(-SAMPLE_MEMORY * distance) + 1e-9 * np.eye(collisions.size)
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
