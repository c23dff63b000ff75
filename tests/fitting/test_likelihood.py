"""The likelihood of a fit, and errors that come from the scatter of few replicas."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

import jaxgran
from experiments.fit.own_model import HaffLaw
from tests.beads import glass_beads, hard_gas
from tests.fitting.curves import BOTH, cooled_beads, synthetic

R, N = 3, 40
SIGMA = 0.01 * np.exp(np.linspace(0.0, 1.5, N))
"""Relative error of the mean of R replicas, growing along the curve."""


def averaged(seed):
    """A curve of T = 1 whose errors are the scatter of R replicas."""
    noise = SIGMA * R**0.5 * np.random.default_rng(seed).standard_normal((R, N))
    T = np.exp(noise)
    return jaxgran.CoolingCurve(
        times=np.arange(1.0, N + 1),
        temperature=jnp.asarray(T.mean(axis=0)),
        temperature_error=jnp.asarray(T.std(axis=0, ddof=1) / R**0.5),
    )


ELASTIC = hard_gas(1.0)
"""A gas whose T is 1."""


def fitted(curve, replicas=R):
    options = {"model": HaffLaw(), "free": ("temperature",), "replicas": replicas}
    return jaxgran.fit(ELASTIC, curve, **options)


def away(fits):
    """Mean of how far relative errors lie from the true ones, in their logarithm."""
    weights = np.array([fit.comparison.weights["temperature"] for fit in fits])
    return np.mean(np.abs(np.log(weights * SIGMA[None])))


def test_errors_become_smooth():
    curves = [averaged(seed) for seed in range(20)]
    smooth, taken = ([fitted(curve, n) for curve in curves] for n in (R, 1))
    # 40 points of 2 degrees: 80 for 3 coefficients, sqrt(3/160) = 14 % of an error, 25 % at ends.
    assert away(smooth) < 0.14 < 0.4 < away(taken)
    # Taken for exact the same errors refuse nearly every true curve.
    assert np.mean([fit.p_value < 0.01 for fit in taken]) > 0.8
    # Neighbours are independent: what is found of a correlation is chance, 1/sqrt(40).
    for fit in smooth:
        degrees = np.array([0.55, 1.0]) * 2 * N
        least, most = np.sort(scipy.stats.f.sf(fit.chi2 / (N - 1), N - 1, degrees))
        assert least * (1 - 1e-9) < fit.p_value < most * (1 + 1e-9)


def test_a_set_value_stays_without_weight_and_one_run_has_no_scatter():
    curve = averaged(0)
    error = curve.temperature_error.at[0].set(0.0)
    curve = dataclasses.replace(curve, times=curve.times - 1, temperature_error=error)
    smooth, taken = (fitted(curve, n).comparison.weights["temperature"] for n in (R, 1))
    assert smooth[0] == taken[0] == 0 and np.all(smooth[1:] > 0)
    np.testing.assert_allclose(1 / taken[1:], (error / curve.temperature)[1:], rtol=1e-12)


def test_chi2_of_smooth_errors_has_the_F_distribution():
    @jax.jit
    @jax.vmap
    def chi2(curve):
        return -2 * jaxgran.log_likelihood(ELASTIC, curve, model=HaffLaw(), replicas=R)

    curves = [averaged(seed) for seed in range(400)]
    found = scipy.stats.f.sf(chi2(jax.tree.map(lambda *x: jnp.stack(x), *curves)) / N, N, 2 * N)
    # Of 400: 5 +- 1.1 % and 1 +- .5 %, three of each; the F distribution is good to 1 %.
    assert 0.015 < np.mean(found < 0.05) < 0.09 and np.mean(found < 0.01) < 0.035
    assert 0.42 < np.mean(found) < 0.58


@pytest.mark.slow
def test_the_likelihood_is_the_chi2_of_the_fit():
    gas, curve = cooled_beads()
    result = jaxgran.fit(gas, curve, free=BOTH)
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
    assert curvature == pytest.approx(-1 / float(jnp.sum((found * 0.01) ** 2)), rel=0.02)


def test_without_errors_their_size_is_integrated_out():
    gas, curve = cooled_beads(1, num_points=20)
    bare = dataclasses.replace(curve, temperature_error=None)
    off = np.log(curve.temperature / jaxgran.cool(gas, curve.times).temperature)
    expected = -0.5 * 20 * np.log(np.sum(off**2))
    assert float(jaxgran.log_likelihood(gas, bare)) == pytest.approx(expected, rel=1e-9)


def test_a_clock_is_that_of_the_model():
    gas = glass_beads(0.15)
    curve = synthetic(gas)
    curve = dataclasses.replace(curve, times=curve.times / 0.9)
    for clock in (0.9, jnp.full(40, 0.9)):
        assert float(jaxgran.log_likelihood(gas, curve, clock=clock)) == pytest.approx(0, abs=1e-6)
    assert float(jaxgran.log_likelihood(gas, curve)) < -10
