"""The likelihood of a run of N grains."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.comparison import Comparison
from jaxgran.fitting.kalman import SAMPLE_DECAY_RATE, Nodes, filtered
from jaxgran.fitting.measured_rows import curve_rows
from jaxgran.fitting.prediction import predicted_curve
from jaxgran.fitting.rows import Noise
from jaxgran.fitting.search import minimise
from jaxgran.fitting.setup import Request, build_problem, problem_with_rate_errors
from tests.beads import glass_beads, soft_beads
from tests.fitting.curves import NUM_PARTICLES, A, cooled_beads, drawn

THEORY = jaxgran.KineticTheory()
ROUGH = jaxgran.Rough(0.2, rotational_temperature=3e-3)
WALLS = jaxgran.Walls(0.05, restitution=0.9)

SCENES = {
    "smooth": ({}, 0.0),
    "errors of the measurement": ({}, 0.02),
    "rough": ({"surface": ROUGH}, 0.0),
    "rough between walls": ({"surface": ROUGH, "container": WALLS}, 0.01),
    "driven": ({"drive": jaxgran.WhiteNoise(1e-2)}, 0.0),
}


@pytest.mark.parametrize("name", [pytest.param(x, marks=pytest.mark.slow) for x in SCENES])
def test_the_filter_is_the_dense_covariance(name):
    elements, error = SCENES[name]
    gas = dataclasses.replace(glass_beads(), **elements)
    curve, residuals, covariance = drawn(gas, error, np.random.default_rng(0))
    known = {"num_particles": NUM_PARTICLES, "errors_measured": True}
    measurement = jaxgran.Measurement(gas, curve, **known)
    rows, _ = curve_rows("", measurement, THEORY, fits_T_0=False, fits_t0=False)
    rows = dataclasses.replace(rows, faster=1.0)
    (row,) = Comparison(predicted_curve(rows, THEORY, {}, [])).residuals(0)
    found = np.sum(row.values**2) + np.sum(row.log_variance)
    log_determinant = np.linalg.slogdet(covariance)[1]
    expected = residuals @ np.linalg.solve(covariance, residuals) + log_determinant
    # The filter takes Gaussian spins for the noise of rough spheres.
    assert found == pytest.approx(expected, abs=1.0 if gas.surface is not None else 0.02)


@pytest.mark.slow
def test_the_likelihood_is_that_of_the_fit():
    gas, curve = cooled_beads()
    measurement = jaxgran.Measurement(gas, curve, num_particles=10**6)
    request = Request({"": measurement}, THEORY, (A,), (), {}, None, quick=True)
    problem, first, _ = build_problem(request)
    # The error of theory is that of the first guess of A, here as in `log_likelihood`.
    problem = problem_with_rate_errors(problem, first)
    best = minimise(problem, first, 100)
    error = problem.evaluate(best.flat).information[0, 0] ** -0.5

    @jax.jit
    @jax.value_and_grad
    def at(shift):
        constant = jnp.exp(best.flat[0] + error * shift)
        return jaxgran.log_likelihood(gas.replace(dissipative_constant=constant), measurement)

    most, _ = at(0.0)
    for shift in (-2.0, -0.5, 0.0, 0.5, 2.0):
        value, slope = at(shift)
        found = problem.evaluate(best.flat + np.array([error * shift, 0.0]))
        assert float(value - most) == pytest.approx((best.value - found.value) / 2, abs=0.01)
        assert float(slope) == pytest.approx(-found.gradient[0] * error / 2, abs=0.01)


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


@pytest.mark.slow
def test_the_error_of_a_sample_of_grains_is_remembered():
    # A Gaussian process of the covariance S exp(-k |tau_i - tau_j|), and nothing else.
    size = 12
    variance = 0.01
    tau = np.geomspace(0.1, 6.0, size)
    values = 0.1 * np.random.default_rng(0).standard_normal(size)
    column = np.zeros((size, 1))
    nodes = Nodes(column, column, column[:, 0], tau[:, None])
    noise = Noise(np.zeros(1), 0.0, np.zeros(size), variance, 0.0)
    residuals = np.zeros((size, 2, 1, 1))
    residuals[:, 0, 0, 0] = values
    used = np.repeat([[1.0, 0.0]], size, axis=0)
    gas = jax.tree.map(lambda x: x[None], glass_beads())
    arguments = nodes, residuals, np.zeros((size, 2, 1)), column + 1, used, noise
    found, spread = filtered(gas, *jax.tree.map(jnp.asarray, arguments))
    innovation, of_innovation = (np.asarray(x)[:, 0].ravel() for x in (found, spread))
    covariance = variance * np.exp(-SAMPLE_DECAY_RATE * np.abs(tau[:, None] - tau))
    square = values @ np.linalg.solve(covariance, values)
    # The filter adds a variance of 1e-12 to each value.
    assert np.sum(innovation**2 / of_innovation) == pytest.approx(square, rel=1e-8)
    determinant = np.linalg.slogdet(covariance)[1]
    assert np.sum(np.log(of_innovation)) == pytest.approx(determinant, rel=1e-8)


@pytest.mark.slow
def test_the_filter_has_the_covariance_of_soft_spheres():
    gas = soft_beads(0.1, 0.3)
    taus = np.concatenate([[0.0, 0.02], np.geomspace(0.05, 20.0, 40)])
    times = taus * float(gas.mean_free_time)
    curve = jaxgran.cool(gas, times)

    def one(x):
        return jnp.asarray(x)[:, None]

    log_T = one(jnp.log(curve.temperature))
    nodes = Nodes(log_T, 0 * log_T, curve.sonine, one(curve.collisions))
    residual = 0.01 * np.random.default_rng(0).normal(size=times.size)
    residuals = np.zeros((times.size, 2, 1, 1))
    residuals[:, 0, 0, 0] = residual
    error = 1e-3
    variances = np.full((times.size, 2, 1), error**2)
    used = np.repeat([[1.0, 0.0]], times.size, axis=0)
    zero = jnp.zeros(())
    noise = Noise(jnp.full(1, 1 / 250), zero, jnp.zeros(times.size), zero, zero)
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], gas)
    arguments = nodes, residuals, variances, jnp.ones_like(log_T), used, noise
    found, spread = filtered(batch, *jax.tree.map(jnp.asarray, arguments))
    square = np.sum(np.asarray(found)[:, 0, 0, 0] ** 2 / np.asarray(spread)[:, 0, 0])
    C = np.asarray(THEORY.covariance(gas, times, 250)) + error**2 * np.eye(times.size)
    # Both interpolate rates, between these nodes and between 97 times.
    assert square == pytest.approx(residual @ np.linalg.solve(C, residual), rel=0.02)
