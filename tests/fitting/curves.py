"""Curves that tests of fits share, and how far a fit is from what made its curve."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from tests.beads import glass_beads

A = "dissipative_constant"
BOTH = (A, "temperature")
NUM_PARTICLES = 250


def synthetic(
    gas,
    key=None,
    num_points=40,
    relative_error=0.01,
    end=300.0,
    model=None,
    quantities=("temperature", "rotational_temperature"),
):
    """A curve of a gas with its errors and, where a key is given, Gaussian noise in ln T.

    It holds those of the quantities that the gas has.
    """
    times = jnp.geomspace(0.3, end, num_points) * gas.mean_free_time
    run = {} if model is None else {"model": model, "key": jax.random.key(5)}
    exact, fields = jaxgran.cool(gas, times, progress=False, **run), {}
    noise = jnp.zeros((3, num_points)) if key is None else jax.random.normal(key, (3, num_points))
    for name, along in zip(quantities, noise, strict=False):
        if (value := getattr(exact, name)) is not None:
            fields[name] = value * jnp.exp(along * relative_error)
            fields[f"{name}_error"] = relative_error * value
    return jaxgran.CoolingCurve(times, **fields)


def drawn(gas, error, rng):
    """A run of `NUM_PARTICLES` grains: its curve, its residuals, and their covariance by theory."""
    times = np.geomspace(0.3, 60, 25) * float(gas.mean_free_time)
    rotation = gas.surface is not None
    exact = jaxgran.cool(gas, times)
    covariance = np.asarray(
        jaxgran.KineticTheory().covariance(gas, times, NUM_PARTICLES, rotation=rotation)
    )
    covariance = covariance + np.diag(np.full(len(covariance), error**2 + 1e-14))
    residuals = np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance))
    fields = {"temperature": exact.temperature * np.exp(residuals[:25])}
    if rotation:
        fields["rotational_temperature"] = exact.rotational_temperature * np.exp(residuals[25:])
    if error > 0:
        names = tuple(fields)
        fields |= {f"{name}_error": error * getattr(exact, name) for name in names}
    return jaxgran.CoolingCurve(times, **fields), residuals, covariance


def cooled_beads(seed=0, **options):
    """Glass beads and a curve of theirs with noise."""
    gas = glass_beads(0.15)
    return gas, synthetic(gas, jax.random.key(seed), **options)


def rough_beads(tangential_restitution=0.0):
    surface = jaxgran.Rough(tangential_restitution, rotational_temperature=3e-3)
    return dataclasses.replace(glass_beads(), surface=surface)


def fitted(gas, curve, free=(A,), **options):
    """The fit of a curve whose errors are those of the measurement, without the range."""
    known = {"num_particles": None, "priors": None, "absent": (), "replicas": 1}
    known |= {name: options.pop(name) for name in known.keys() & options.keys()}
    measurement = jaxgran.Measurement(gas, curve, errors_measured=True, **known)
    return jaxgran.fit(measurement, **({"free": free, "quick": True} | options))


def deviation(result, gas, name=A):
    """How many standard errors an estimate lies from the gas."""
    estimate, error = result.value(name)
    return abs(float(estimate) - float(gas.value(name))) / float(error)


def in_range(result, truth, name=A):
    """Whether a truth lies in the range of a fit."""
    low, high = result.ranges[name]
    return float(low[0]) < float(truth) < float(high[0])
