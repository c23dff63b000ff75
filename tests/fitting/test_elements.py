"""Fits of scenes with rough spheres, walls and drag."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.residuals import finite_size_cooling_factor
from tests.beads import glass_beads

THEORY = jaxgran.KineticTheory()


def measured(gas, model=THEORY, error=0.02, end=80.0) -> jaxgran.CoolingCurve:
    """A curve of a model with errors of T and, of rough spheres, of T_rot."""
    times = np.geomspace(0.3, end, 40) * float(gas.mean_free_time)
    exact = jaxgran.cool(gas, times, model=model, key=jax.random.key(5))
    rng = np.random.default_rng(1)

    def noisy(values):
        return np.asarray(values) * np.exp(error * rng.normal(size=times.size))

    T, fields = noisy(exact.temperature), {}
    if gas.surface is not None:
        T_rot = noisy(exact.rotational_temperature)
        fields = {
            "rotational_temperature": T_rot,
            "rotational_temperature_error": error * T_rot,
        }
    return jaxgran.CoolingCurve(times=times, temperature=T, temperature_error=error * T, **fields)


ROUGH = jaxgran.Rough(0.0, rotational_temperature=3e-3)
FREE = ("dissipative_constant", "tangential_restitution", "rotational_temperature")


def unknown(gas) -> jaxgran.Gas:
    """Return the gas before its A, beta_t and initial T_rot are known."""
    gas = gas.replace(dissipative_constant=0.0, rotational_temperature=0.0)
    return gas.replace(tangential_restitution=-1.0)


def within(result, gas, name):
    estimate, error = result.value(name)
    return abs(float(estimate) - float(gas.value(name))) < 2 * float(error)


OF_PARTICLES = pytest.param(jaxgran.DSMC(10_000), marks=pytest.mark.slow)


@pytest.mark.parametrize("model", [THEORY, OF_PARTICLES])
def test_roughness_and_A_are_found_together(model):
    gas = dataclasses.replace(glass_beads(), surface=ROUGH)
    curve = measured(gas, model)
    result = jaxgran.fit(unknown(gas), curve, free=FREE)
    assert bool(result.converged) and float(result.p_value) > 0.01
    assert all(within(result, gas, name) for name in FREE)
    assert not result.undetermined()
    # Errors must be of use, too: .06 of A and .04 of beta_t by DSMC, and half as much again.
    assert float(result.standard_error[0] / result.estimate[0]) < 0.1
    assert float(result.standard_error[1]) < 0.08
    assert "model of T_rot" in result.error_budget
    diagnosis = jaxgran.diagnose(result, curve)
    assert "rough spheres of constant beta_t, far from walls" in " ".join(diagnosis.reasons)
    low, high = diagnosis.ranges[FREE[0]]  # with beta_t free there is a range, too
    assert low[0] < float(gas.value(FREE[0])) < high[0]


def test_of_two_minima_in_beta_t_the_deeper_one_is_found_and_said_where_as_deep():
    # Rotation takes most energy at some beta_t: on both sides of it T and T_rot look alike, with
    # half of A on the other side.
    gas = dataclasses.replace(glass_beads(), surface=ROUGH).replace(tangential_restitution=-0.5)
    names, other = FREE[:2], gas.replace(tangential_restitution=0.3)
    curve = measured(gas)
    result = jaxgran.fit(other, curve, free=names)
    assert all(within(result, gas, name) for name in names)
    assert result.minima.chi2.shape == (4,) and not len(result.degenerate_solutions())
    assert jaxgran.diagnose(result, curve).grade != "not consistent"
    assert np.ptp(result.minima.chi2) > 9.0
    gas = gas.replace(tangential_restitution=-0.42)
    curve = measured(gas, error=0.05)
    with pytest.warns(UserWarning, match="chi.2 has another, equally good minimum at A = "):
        result = jaxgran.fit(other, curve, free=names)
    assert float(result.degenerate_solutions()[0, 0] / result.estimate[0]) < 0.7
    found = jaxgran.diagnose(result, curve)
    assert found.grade == "not determined" and "other parameters fit this curve" in found.verdict
    # The range holds both.
    (low,), (high,) = found.ranges[names[0]]
    assert low < float(result.degenerate_solutions()[0, 0]) < float(result.estimate[0]) < high
    assert any("has another, equally good minimum" in reason for reason in found.reasons)


def test_a_T_rot_that_theory_misses_as_a_whole_is_no_misfit():
    # Theory knows T_rot within 7 %: a common factor of 1.05 is within that, errors are 2 %.
    gas = dataclasses.replace(glass_beads(), surface=ROUGH)
    curve = measured(gas)
    more = {
        "rotational_temperature": 1.05 * curve.rotational_temperature,
        "rotational_temperature_error": 1.05 * curve.rotational_temperature_error,
    }
    # With the parameters of the test above, whose program is compiled.
    result = jaxgran.fit(gas, dataclasses.replace(curve, **more), free=FREE)
    assert float(result.p_value) > 0.05
    assert all(within(result, gas, name) for name in FREE)


@pytest.mark.slow
def test_A_is_right_where_the_scene_is_known():
    # The same curve, fitted without walls, gives an A wrong by 1.3.
    gas = dataclasses.replace(glass_beads(), container=jaxgran.Walls(0.05, restitution=0.8))
    curve = measured(gas, jaxgran.DSMC(10_000))
    free = ("dissipative_constant", "temperature")
    result = jaxgran.fit(gas.replace(dissipative_constant=0.0), curve, free=free)
    assert within(result, gas, "dissipative_constant")
    assert float(result.p_value) > 0.01


def test_between_walls_few_particles_have_all_their_energy_in_T():
    # Without walls N particles of no momentum are hotter by N/(N - 1), and cool faster.
    gas, count = glass_beads(), jnp.asarray(50.0)
    factor = float(finite_size_cooling_factor(gas, count))
    assert factor == pytest.approx(1 + 0.6 / 50, rel=2e-3)
    between = dataclasses.replace(gas, container=jaxgran.Walls(0.05, restitution=0.9))
    assert float(finite_size_cooling_factor(between, count)) == 1.0
