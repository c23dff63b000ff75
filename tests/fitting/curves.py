"""Curves that tests of fits share."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from tests.data.test_curve import DATA

RELATIVE_ERROR = 0.01

TIMES = np.geomspace(0.1, 100, 40)
TRUTH = np.array([0.3, -0.2])
"""Times and parameters of `exact`."""


def exact(flat):
    """ln T of a power law, whose parameters are logarithms of a rate and of T_0."""
    return flat[1] - 5 / 3 * jnp.log1p(TIMES * jnp.exp(flat[0]))


def synthetic(gas, key, num_points=40, relative_error=RELATIVE_ERROR, displacement=False):
    """A curve of a gas with Gaussian noise in ln T."""
    times = jnp.geomspace(0.3, 300.0, num_points) * gas.mean_free_time
    exact = jaxgran.cool(gas, times)
    noise = jax.random.normal(key, (2, num_points)) * relative_error
    measured = exact.temperature * jnp.exp(noise[0])
    assert exact.displacement is not None
    msd = exact.displacement * jnp.exp(noise[1]) if displacement else None
    return jaxgran.CoolingCurve(
        times=times,
        temperature=measured,
        temperature_error=relative_error * exact.temperature,
        displacement=msd,
        displacement_error=relative_error * exact.displacement if displacement else None,
    )


def measured(name):
    """A curve measured in LAMMPS: the gas, the curve, its A, number of particles and of runs."""
    curve, header = jaxgran.read_curve(DATA / f"lammps_cooling_{name}.csv")
    gas = jaxgran.read_gas(header)
    return gas, curve, float(header["A"]), int(header["N"]), int(header["replicas"])
