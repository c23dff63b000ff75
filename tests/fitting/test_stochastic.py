"""Fits through particle models."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxgran
from tests.beads import soft_beads


def with_rotation(gas, model, error=0.02, end=30.0):
    """A curve of T and T_rot of a model."""
    times = np.geomspace(0.3, end, 30) * float(gas.mean_free_time)
    found = jaxgran.cool(gas, times, model=model, key=jax.random.key(5), progress=False)
    return jaxgran.CoolingCurve(
        times=times,
        temperature=found.temperature,
        temperature_error=error * found.temperature,
        rotational_temperature=found.rotational_temperature,
        rotational_temperature_error=error * found.rotational_temperature,
    )


@pytest.mark.slow
def test_T_rot_is_fitted_beside_T(beads):
    gas = dataclasses.replace(beads(0.15), surface=jaxgran.Rough(0.0, rotational_temperature=3e-3))
    model, names = (
        jaxgran.DSMC(5000, replicas=2),
        ("dissipative_constant", "tangential_restitution"),
    )
    curve = with_rotation(gas, model)
    guess = gas.replace(tangential_restitution=-0.3)
    result = jaxgran.fit(guess, curve, free=names, model=model, progress=False)
    assert bool(result.converged) and "rotational_temperature" in result.comparison.residuals
    for name in names:
        estimate, error = result.value(name)
        assert abs(float(estimate) - float(gas.value(name))) < 3 * float(error)
    # Both are known to some per cent; from T alone they are not distinguishable.
    assert float(result.standard_error[0] / result.estimate[0]) < 0.1
    assert float(result.standard_error[1]) < 0.06


def test_fit_through_particles_refuses_what_it_cannot_do(beads):
    gas = beads(0.15)
    times = jnp.geomspace(0.3, 30.0, 20) * gas.mean_free_time
    curve = jaxgran.CoolingCurve(times=times, temperature=jaxgran.cool(gas, times).temperature)
    with pytest.raises(ValueError, match="replicas >= 2"):
        jaxgran.fit(gas, curve, model=jaxgran.SoftSpheres(100))
    with pytest.raises(ValueError, match="projection"):
        jaxgran.fit(gas, curve, model=jaxgran.SoftSpheres(100, replicas=2, projection=None))
    with pytest.raises(ValueError, match="least squares"):
        model = jaxgran.SoftSpheres(100, replicas=2)
        jaxgran.fit(gas, curve, model=model, solver=optx.BFGS(1e-8, 1e-8))
    still = gas.replace(dissipative_constant=0.0)
    with pytest.raises(ValueError, match="cannot start at dissipative_constant = 0.0"):
        jaxgran.fit(gas, curve, model=jaxgran.DSMC(100, replicas=2), start=still)
    with pytest.raises(ValueError, match="one curve at a time"):
        jax.jit(lambda g: jaxgran.fit(g, curve, model=jaxgran.SoftSpheres(9, replicas=2)).chi2)(gas)


@pytest.mark.slow
def test_fit_through_soft_spheres_finds_what_made_the_curve():
    gas = soft_beads(0.1, 0.3, packing_fraction=0.2)
    times = jnp.geomspace(0.3, 6.0, 12) * gas.mean_free_time
    model = jaxgran.SoftSpheres(200, replicas=3, steps_per_contact=20)
    curve = jaxgran.cool(gas, times, model=model, key=jax.random.key(7), progress=False)
    curve = jaxgran.CoolingCurve(
        times=times, temperature=curve.temperature, temperature_error=0.025 * curve.temperature
    )
    result = jaxgran.fit(gas, curve, model=model, max_steps=5, progress=False)
    estimate, error = result.value("dissipative_constant")
    true = float(gas.value("dissipative_constant"))
    # The measured curve is a run of 600 spheres itself, whose noise its 2.5 % stand for.
    assert abs(float(estimate) / true - 1) < 3 * float(error) / true
    assert float(error) < 0.15 * true and bool(result.converged)
    theory = jaxgran.fit(gas, curve)
    assert abs(theory.estimate[0] / true - 1) > abs(estimate / true - 1)
