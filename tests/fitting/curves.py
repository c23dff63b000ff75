"""Curves that tests of fits share."""

import jax
import jax.numpy as jnp

import jaxgran
from tests.data.test_curve import DATA

RELATIVE_ERROR = 0.01


def synthetic(
    gas,
    key=None,
    num_points=40,
    relative_error=RELATIVE_ERROR,
    end=300.0,
    model=None,
    displacement=False,
):
    """A curve of a gas with its errors and, where a key is given, Gaussian noise in ln T.

    Rough spheres have T_rot, too.
    """
    times = jnp.geomspace(0.3, end, num_points) * gas.mean_free_time
    run = {} if model is None else {"model": model, "key": jax.random.key(5)}
    exact, fields = jaxgran.cool(gas, times, progress=False, **run), {}
    names = ["temperature"]
    names += ["displacement"] if displacement else []
    names += ["rotational_temperature"] if gas.surface is not None else []
    noise = jnp.zeros((3, num_points)) if key is None else jax.random.normal(key, (3, num_points))
    for name, along in zip(names, noise, strict=False):
        value = getattr(exact, name)
        fields[name] = value * jnp.exp(along * relative_error)
        fields[f"{name}_error"] = relative_error * value
    return jaxgran.CoolingCurve(times, **fields)


def measured(name):
    """A curve measured in LAMMPS: the gas, the curve, its A, number of particles and of runs."""
    curve, header = jaxgran.read_curve(DATA / f"lammps_cooling_{name}.csv")
    gas = jaxgran.read_gas(header)
    return gas, curve, float(header["A"]), int(header["N"]), int(header["replicas"])
