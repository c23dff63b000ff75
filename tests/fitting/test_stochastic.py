"""Fits through particle models, and Gauss-Newton through noise on a stand-in."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.stochastic import search_by_simulation
from tests.beads import soft_beads
from tests.fitting.curves import A, deviation, rough_beads, synthetic


@pytest.mark.slow
def test_T_rot_is_fitted_beside_T():
    gas = rough_beads()
    model, names = jaxgran.DSMC(5000, replicas=2), (A, "tangential_restitution")
    curve = synthetic(gas, jax.random.key(0), 30, 0.02, 30.0, model)
    guess = gas.replace(tangential_restitution=-0.3)
    result = jaxgran.fit(guess, curve, free=names, model=model, progress=False)
    assert bool(result.converged) and "rotational_temperature" in result.comparison.residuals
    assert all(deviation(result, gas, name) < 3 for name in names)
    # Both are known to some per cent; from T alone they are not distinguishable.
    assert float(result.standard_error[0] / result.estimate[0]) < 0.1
    assert float(result.standard_error[1]) < 0.06


@pytest.mark.slow
def test_fit_through_soft_spheres_finds_what_made_the_curve():
    gas = soft_beads(0.1, 0.3, packing_fraction=0.2)
    model = jaxgran.SoftSpheres(200, replicas=3, steps_per_contact=20)
    curve = synthetic(gas, None, 12, 0.025, 6.0, model)
    result = jaxgran.fit(gas, curve, model=model, max_steps=5, progress=False)
    (estimate, error), true = result.value(A), gas.value(A)
    # The measured curve is a run of 600 spheres itself, whose noise its 2.5 % stand for.
    assert deviation(result, gas) < 3
    assert float(error) < 0.15 * true and bool(result.converged)
    theory = jaxgran.fit(gas, curve)
    assert abs(theory.estimate[0] / true - 1) > abs(estimate / true - 1)


# --- a stand-in whose parameters are known

TIMES = np.geomspace(0.1, 100, 40)
TRUTH = np.array([0.3, -0.2])
"""Times and parameters of `exact`."""


def exact(flat):
    """ln T of a power law, whose parameters are logarithms of a rate and of T_0."""
    return flat[1] - 5 / 3 * jnp.log1p(TIMES * jnp.exp(flat[0]))


ERROR = 0.005


def simulator(bias=1.0, noise=0.01, replicas=4, seed=0):
    """ln T of Haff's kind, with noise that stays along a run, and slopes wrong by a factor."""

    @jax.custom_jvp
    def biased(flat):
        return exact(flat)

    @biased.defjvp
    def rule(at, along):
        value, slope = jax.jvp(exact, at, along)
        return value, bias * slope

    def simulate(flat, run):
        steps = np.random.default_rng(seed + run).normal(size=(replicas, TIMES.size))
        drift = noise * np.cumsum(steps, axis=1) / TIMES.size**0.5
        each = jnp.exp(biased(flat)[None] + drift)
        each = jaxgran.CoolingCurve(times=jnp.asarray(TIMES), temperature=each)
        mean = jnp.mean(each.temperature, axis=0)
        return jaxgran.CoolingCurve(times=each.times, temperature=mean, replicas=each)

    return simulate


def searched(simulate, measured, first=(0.0, 0.0), **settings):
    settings = {"resolution": 0.01, "max_simulations": 8, "progress": False} | settings
    measured, error = np.asarray(measured), np.full(measured.shape, ERROR)
    used = np.ones(measured.shape, bool)
    return search_by_simulation(simulate, np.array(first), measured, error, used, **settings)


@pytest.mark.parametrize("bias", [0.8, 1.0, 1.2])
def test_a_biased_slope_does_not_move_the_answer(bias):
    measured = exact(TRUTH)
    quiet = searched(simulator(bias, noise=1e-6), measured, first=(-0.6, 0.3))
    # What is left is what a biased step leaves of the last step, 20 % of less than a tenth.
    np.testing.assert_allclose(quiet.flat, TRUTH, atol=0.02)
    assert quiet.converged and quiet.num_simulations <= 8


def test_more_runs_make_it_quieter():
    measured = exact(TRUTH)
    found = searched(simulator(noise=0.03), measured, first=(0.25, -0.2))
    assert found.num_simulations > 2  # the noise of one run is more than half the error bar
    once = searched(simulator(noise=0.03), measured, first=(0.25, -0.2), max_simulations=1)
    assert np.all(np.diag(found.noise_covariance) < np.diag(once.noise_covariance))


def of_sum(flat, run):
    """A curve that depends on the sum of two parameters."""
    return simulator()(jnp.stack([flat[0] + flat[1], jnp.zeros(())]), run)


def test_what_the_curve_does_not_tell_stays_where_it_was():
    found = searched(of_sum, exact(np.array([0.3, 0.0])), first=(0.1, 0.1))
    assert found.flat[0] - found.flat[1] == pytest.approx(0.0, abs=1e-9)
    assert found.flat.sum() == pytest.approx(0.3, abs=0.02)


def test_two_quantities_tell_what_one_does_not():
    # T depends on the sum of two parameters, T_rot on the second one alone.
    def simulate(flat, run):
        T = of_sum(flat, run)
        T_rot = simulator(seed=50)(jnp.stack([flat[1], jnp.zeros(())]), run)
        each = dataclasses.replace(T.replicas, rotational_temperature=T_rot.replicas.temperature)
        return dataclasses.replace(T, rotational_temperature=T_rot.temperature, replicas=each)

    measured = np.concatenate([exact(np.array([x, 0.0])) for x in (0.1, -0.2)])
    found = searched(simulate, measured, rotation=True)
    np.testing.assert_allclose(found.flat, [0.3, -0.2], atol=0.03)
    assert found.residuals.shape == (2 * TIMES.size,)
    # The noise of the mean of four replicas in two runs or more is less than the errors.
    assert np.all((found.weights > 0.5 / ERROR) & (found.weights < 1 / ERROR))
    # T_rot does not depend on the first parameter, which is what remains of T.
    np.testing.assert_allclose(found.sensitivity[TIMES.size :, 0], 0.0, atol=1e-12)
    assert np.all(found.noise_covariance.diagonal() > 0)
