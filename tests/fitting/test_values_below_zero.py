"""Fits of values that lie below 0 after noise was subtracted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.innovations import log_density_change, log_ratio
from tests.beads import glass_beads
from tests.fitting.curves import fitted, rough_beads

A = "dissipative_constant"
GAS = glass_beads(0.15)


def noisy(seed, number=60):
    """A curve half of whose values are those of the noise, which was subtracted."""
    times = np.arange(1, number + 1) * 20 * float(GAS.mean_free_time)
    T = np.asarray(jaxgran.cool(GAS, times).temperature)
    error = np.hypot(0.01 * T, 2 * T[number // 3])
    values = T + error * np.random.default_rng(seed).normal(size=number)
    return jaxgran.CoolingCurve(times, values, temperature_error=error)


@pytest.mark.slow
def test_values_below_zero_leave_A_unbiased():
    fits = [fitted(GAS, noisy(seed), quick=True) for seed in range(20)]
    values, errors = np.transpose([fit.value(A) for fit in fits])
    true = float(GAS.value(A))
    scatter = values.std(ddof=1)
    print(values.mean() / true, scatter / true / 20**0.5)
    assert abs(values.mean() - true) < 2 * scatter / 20**0.5
    assert 0.6 < scatter / errors.mean() < 1.5  # 20 seeds: 16 %


@pytest.mark.minutes
def test_values_below_zero_are_fitted():
    curve = noisy(0)
    assert np.sum(curve.temperature < 0) > 5
    fit = fitted(GAS, curve, quick=True)
    value, error = fit.value(A)
    assert fit.converged and abs(value - GAS.value(A)) < 3 * error
    gas = GAS.replace(dissipative_constant=value)
    measurement = jaxgran.Measurement(GAS, curve, errors_measured=True)
    slope = jax.grad(
        lambda x: jaxgran.log_likelihood(gas.replace(dissipative_constant=x), measurement)
    )(jnp.asarray(value))
    assert abs(slope * error) < 0.1  # both are the same likelihood
    with pytest.raises(ValueError, match="T below 0 .*kinetic theory"):
        fitted(GAS, curve, model=jaxgran.DSMC(50, replicas=2))


def test_spins_below_zero_are_not_fitted_through_particles():
    gas = rough_beads()
    times = np.array([1.0, 2.0, 3.0, 4.0]) * float(gas.mean_free_time)
    T = np.full(4, float(gas.temperature))
    curve = jaxgran.CoolingCurve(
        times,
        T,
        rotational_temperature=np.array([1.0, 1.0, 1.0, -0.1]) * T,
        rotational_temperature_error=0.2 * T,
    )
    with pytest.raises(ValueError, match="T_rot of 0 or less .*kinetic theory"):
        fitted(gas, curve, model=jaxgran.DSMC(50, replicas=2))


def test_the_density_of_a_value_is_normalised():
    error = 1.0
    values = np.linspace(-8.0, 60.0, 200_001)
    for computed in (0.1, 1.0, 4.0, 6.0, 8.0, 20.0):
        log_computed = jnp.full(values.shape, np.log(computed))
        errors = jnp.full(values.shape, error)
        measured = jnp.asarray(values)
        residuals = log_ratio(measured, log_computed, errors)
        change = log_density_change(measured, log_computed, errors)
        # The density of the residual times its slope; the unit is that of `log_density_change`.
        unit = np.where(values > error, values, error)
        density = np.exp(-0.5 * (residuals * computed / error) ** 2 - 0.5 * change)
        density *= computed / error / unit / np.sqrt(2 * np.pi)
        whole = np.trapezoid(np.where(values > -7, density, 0.0), values)
        assert whole == pytest.approx(1.0, abs=0.02), computed


def test_the_density_of_a_small_value_has_no_jump_where_ln_T_is_compared():
    # -2 ln L fell by 1 where the computed T rose past 10 errors, and the search stopped there.
    below, above = (
        float(log_density_change(jnp.asarray(3.0), jnp.log(x), jnp.asarray(1.0)))
        for x in (9.9999, 10.0001)
    )
    assert below == pytest.approx(above, abs=1e-3)
    assert above == pytest.approx(-2 * np.log(0.6), rel=1e-3)


def test_ln_T_is_compared_far_from_zero_bit_for_bit():
    values, errors = jnp.asarray([10.5, 200.0]), jnp.asarray([1.0, 0.0])
    log_computed = jnp.log(jnp.asarray([10.4, 180.0]))
    assert np.all(log_density_change(values, log_computed, errors) == 0)
    assert np.all(
        log_ratio(values, log_computed, errors) == jnp.log(values / jnp.exp(log_computed))
    )


@pytest.mark.slow
def test_displacements_below_zero_are_left_out_and_counted():
    times = np.geomspace(0.1, 100, 30) * float(GAS.mean_free_time)
    exact = jaxgran.cool(GAS, times)
    T, displacement = np.asarray(exact.temperature), np.asarray(exact.displacement)
    error = np.hypot(0.02 * displacement, displacement[10])
    measured = displacement + error * np.random.default_rng(1).normal(size=30)
    assert np.any(measured < 0)
    curve = jaxgran.CoolingCurve(
        times,
        T,
        temperature_error=0.01 * T,
        displacement=measured,
        displacement_error=error,
    )
    number = np.sum(measured < 3 * error)
    with pytest.warns(UserWarning, match=f"below 0 .* {number} of 30 values"):
        fit = fitted(GAS, curve, quick=True)
    assert np.sum(fit.residuals[""]["displacement"] == 0) == number
    value, error_of_A = fit.value(A)
    assert abs(value - GAS.value(A)) < 3 * error_of_A
