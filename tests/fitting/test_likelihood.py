"""The likelihood of a run of N grains."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.prediction import predicted_curve
from jaxgran.fitting.rows import curve_rows
from tests.beads import glass_beads
from tests.fitting.curves import A, cooled_beads, fitted

THEORY = jaxgran.KineticTheory()
NUM_PARTICLES = 250
ROUGH = jaxgran.Rough(0.2, rotational_temperature=3e-3)
WALLS = jaxgran.Walls(0.05, restitution=0.9)

SCENES = {
    "smooth": ({}, 0.0),
    "errors of the measurement": ({}, 0.02),
    "rough": ({"surface": ROUGH}, 0.0),
    "rough between walls": ({"surface": ROUGH, "container": WALLS}, 0.01),
    "driven": ({"drive": jaxgran.WhiteNoise(1e-2)}, 0.0),
}


def drawn(gas, error, rng):
    """A run of the covariance of theory: its curve, its residuals, and their covariance."""
    times = np.geomspace(0.3, 60, 25) * float(gas.mean_free_time)
    rotation = gas.surface is not None
    exact = jaxgran.cool(gas, times)
    covariance = np.asarray(THEORY.covariance(gas, times, NUM_PARTICLES, rotation=rotation))
    covariance = covariance + np.diag(np.full(len(covariance), error**2 + 1e-14))
    residuals = np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance))
    fields = {"temperature": exact.temperature * np.exp(residuals[:25])}
    if rotation:
        fields["rotational_temperature"] = exact.rotational_temperature * np.exp(residuals[25:])
    if error > 0:
        names = tuple(fields)
        fields |= {f"{name}_error": error * getattr(exact, name) for name in names}
    return jaxgran.CoolingCurve(times, **fields), residuals, covariance


@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow) for x in SCENES])
def test_the_filter_is_the_dense_covariance(name):
    elements, error = SCENES[name]
    gas = dataclasses.replace(glass_beads(), **elements)
    curve, residuals, covariance = drawn(gas, error, np.random.default_rng(0))
    known = {"num_particles": NUM_PARTICLES, "errors_measured": True}
    measurement = jaxgran.Measurement(gas, curve, **known)
    rows, _ = curve_rows("", measurement, THEORY, fits_T_0=False, fits_t0=False)
    rows = dataclasses.replace(rows, faster=1.0)
    (row,) = predicted_curve(rows, THEORY, {}, []).residuals(0)
    found = np.sum(row.values**2) + np.sum(row.log_variance)
    log_determinant = np.linalg.slogdet(covariance)[1]
    expected = residuals @ np.linalg.solve(covariance, residuals) + log_determinant
    # The filter takes Gaussian spins for the noise of rough spheres.
    assert found == pytest.approx(expected, abs=1.0 if gas.surface is not None else 0.02)


def test_the_likelihood_is_that_of_the_fit():
    gas, curve = cooled_beads()
    result = fitted(gas, curve, num_particles=10**6)
    measurement = result.measurements[""]
    error = result.standard_error[0] / result.estimate[0]

    @jax.jit
    @jax.value_and_grad
    def at(shift):
        constant = result.estimate[0] * jnp.exp(error * shift)
        return jaxgran.log_likelihood(gas.replace(dissipative_constant=constant), measurement)

    # In standard errors the slope at the best fit is 0, and the second derivative is -1.
    (low, lower_slope), (best, slope), (high, upper_slope) = (at(x) for x in (-0.5, 0.0, 0.5))
    # (The scatter is integrated out here, and is a parameter of the fit.)
    assert abs(float(slope)) < 0.1
    assert float(upper_slope - lower_slope) == pytest.approx(-1.0, rel=0.03)
    assert float(low + high - 2 * best) == pytest.approx(-0.25, rel=0.03)


def test_the_scatter_tells_N_where_it_is_not_known():
    gas = glass_beads()
    curve, *_ = drawn(gas, 0.0, np.random.default_rng(1))
    result = jaxgran.fit(jaxgran.Measurement(gas, curve), free=(A,), quick=True)
    factor, error = result.scatter[""]  # over that of 1000 grains
    assert abs(np.log(factor / (1000 / NUM_PARTICLES))) < 3 * error < 1.5


def test_likelihoods_that_cannot_be():
    gas, curve = cooled_beads()
    with pytest.raises(ValueError, match="DSMC, which is stochastic"):
        jaxgran.log_likelihood(gas, jaxgran.Measurement(gas, curve), model=jaxgran.DSMC(100))
    with pytest.raises(ValueError, match="must be a jaxgran.Measurement"):
        jaxgran.log_likelihood(gas, curve)
