"""The likelihood that samplers follow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads
from tests.fitting.curves import synthetic


@pytest.mark.slow
def test_is_the_chi2_of_the_fit():
    gas = glass_beads(0.15)
    curve = synthetic(gas, jax.random.key(0))
    result = jaxgran.fit(gas, curve, free=("dissipative_constant", "temperature"))
    likelihood = jax.jit(lambda gas: jaxgran.log_likelihood(gas, curve))
    assert float(likelihood(result.gas)) == pytest.approx(-0.5 * float(result.chi2), rel=1e-6)

    def moved(shift):
        A = result.estimate[0] * jnp.exp(shift)
        return likelihood(result.gas.replace(dissipative_constant=A))

    # At the best fit the slope is 0, and the curvature is that of the error of A at fixed T_0.
    slope, scale = jax.grad(moved)(0.0), float(result.estimate[0] / result.standard_error[0])
    assert abs(float(slope)) < 1e-3 * scale
    step = 1e-3
    curvature = float(moved(step) - 2 * moved(0.0) + moved(-step)) / step**2
    alone = jaxgran.fit(gas.replace(temperature=result.estimate[1]), curve)
    found = alone.comparison.gain[0] / alone.estimate[0]
    variance = float(jnp.sum((found * 0.01) ** 2))
    assert curvature == pytest.approx(-1 / variance, rel=0.02)


def test_without_errors_their_size_is_integrated_out():
    gas = glass_beads(0.15)
    curve = synthetic(gas, jax.random.key(1), num_points=20)
    bare = jaxgran.CoolingCurve(times=curve.times, temperature=curve.temperature)
    off = np.log(curve.temperature / jaxgran.cool(gas, curve.times).temperature)
    expected = -0.5 * 20 * np.log(np.sum(off**2))
    assert float(jaxgran.log_likelihood(gas, bare)) == pytest.approx(expected, rel=1e-9)


def test_a_clock_is_that_of_the_model():
    gas = glass_beads(0.15)
    times = jnp.geomspace(0.3, 300.0, 40) * gas.mean_free_time
    slow = jaxgran.cool(gas, 0.9 * times).temperature
    curve = jaxgran.CoolingCurve(times=times, temperature=slow, temperature_error=0.01 * slow)
    for clock in (0.9, jnp.full(40, 0.9)):
        assert float(jaxgran.log_likelihood(gas, curve, clock=clock)) == pytest.approx(0, abs=1e-6)
    assert float(jaxgran.log_likelihood(gas, curve)) < -10


@pytest.mark.parametrize(
    "change, message",
    [
        ({"model": jaxgran.DSMC(10)}, "a likelihood needs a model without noise, got DSMC"),
        ({"model": "theory"}, "model"),
        ({"clock": 0.0}, "clock must lie in"),
        ({"curve": 3}, "curve must be a jaxgran.CoolingCurve"),
    ],
)
def test_bad_requests_are_refused(change, message):
    gas = glass_beads(0.15)
    asked = {"curve": synthetic(gas, jax.random.key(0))} | change
    with pytest.raises(ValueError, match=message):
        jaxgran.log_likelihood(gas, asked.pop("curve"), **asked)
