import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import SI, hard_gas, theory_curve, without

RATE = 3e-3  # of the drive, T_0 per mean free time
LATE = np.array([0.0, 2000.0, 3000.0])


def constant(eps, dimension=3, rate=RATE) -> jaxgran.Gas:
    gas = hard_gas(eps, 0.02, dimension, **SI)
    drive = jaxgran.WhiteNoise(rate * gas.temperature / gas.mean_free_time)
    return dataclasses.replace(gas, drive=drive)


def sonine_of_van_noije_and_ernst(eps, d):
    numerator = 16 * (1 - eps) * (1 - 2 * eps**2)
    return numerator / (73 + 56 * d - 24 * d * eps - 105 * eps + 30 * (1 - eps) * eps**2)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("eps", [0.5, 0.8, 0.95])
def test_the_steady_state_is_that_of_van_noije_and_ernst(eps, dimension):
    gas = constant(eps, dimension)
    curve = theory_curve(gas, LATE, order=2, corrections=without("correlations"))
    expected = sonine_of_van_noije_and_ernst(eps, dimension)
    # They linearise in a_2: what is left out is a_2 of itself, at most .09, by a factor of order 1;
    # 1e-5 is for eps near the zero of a_2.
    assert float(curve.sonine[2]) == pytest.approx(expected, rel=2 * abs(expected), abs=1e-5)
    # zeta = (1 - eps^2)/d nu (1 + 3 a_2/16) to first order in a_2, and zeta T = strength.
    nu = gas.collision_frequency * jnp.sqrt(curve.temperature[2] / gas.temperature)
    loss = (1 - eps**2) / dimension * nu * (1 + 3 / 16 * expected) * curve.temperature[2]
    assert float(loss) == pytest.approx(float(gas.value("drive_strength")), rel=expected**2 + 1e-6)
    np.testing.assert_allclose(curve.temperature[1], curve.temperature[2], rtol=1e-8)


@pytest.mark.slow  # compiles the choice of a driven gas
def test_the_choice_of_a_model_tells_the_error_of_a_steady_state():
    gas = constant(0.9, rate=0.1)
    choice = jaxgran.choose_model(gas, [1000 * float(gas.mean_free_time)])
    assert isinstance(choice.model, jaxgran.KineticTheory)
    assert any("rises to" in reason for reason in choice.reasons)
    # T goes as (zeta/sqrt(T))^(-2/3), and the rate is wrong by .003 + .02 phi and .1 a_2^2.
    assert choice.error == pytest.approx(2 / 3 * 0.0034, rel=0.02)


@pytest.mark.slow
def test_a_batch_has_no_steady_state_where_nothing_is_lost():
    gas = constant(0.9)
    states = jax.vmap(lambda eps: jaxgran.steady_state(gas.replace(coefficient=eps)))
    T = states(jnp.asarray([0.9, 1.0])).temperature
    assert T[0] == pytest.approx(float(jaxgran.steady_state(gas).temperature)) and jnp.isnan(T[1])


@pytest.mark.slow
def test_the_steady_state_is_where_theory_comes_to_rest():
    gas = constant(0.5)
    steady, curve = jaxgran.steady_state(gas), theory_curve(gas, LATE, rtol=1e-10)
    assert curve.sonine[0] == 0.0
    np.testing.assert_allclose(steady.temperature, curve.temperature[1], rtol=1e-8)
    np.testing.assert_allclose(steady.sonine, curve.sonine[1], rtol=1e-6)  # a_2 is about .02
    assert steady.rotational_temperature is None
    slope = jax.grad(lambda x: jaxgran.steady_state(gas.replace(drive_strength=x)).temperature)
    strength = gas.value("drive_strength")
    assert float(slope(strength) * strength / steady.temperature) == pytest.approx(2 / 3, rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("beta", [-1.0, 0.3])
def test_the_steady_spins_are_where_theory_comes_to_rest(beta):
    surface = jaxgran.Rough(beta, rotational_temperature=0.0, friction=0.3)
    gas = dataclasses.replace(constant(0.8), surface=surface)
    steady, curve = jaxgran.steady_state(gas), theory_curve(gas, LATE, rtol=1e-10)
    np.testing.assert_allclose(steady.temperature, curve.temperature[1], rtol=1e-7)
    # That of the solver adds up over thousands of collisions; 0 if nothing turns them.
    rotation = steady.rotational_temperature
    np.testing.assert_allclose(rotation, curve.rotational_temperature[1], rtol=1e-6)
    assert rotation == 0.0 if beta == -1.0 else rotation > 0.0


def test_theory_begins_with_a_given_sonine():
    gas = constant(0.5)
    steady = jaxgran.steady_state(gas)
    gas = gas.replace(temperature=steady.temperature)
    curve = theory_curve(gas, np.array([0.0, 5.0]), initial_sonine=float(steady.sonine))
    assert float(curve.sonine[0]) == float(steady.sonine)
    # Without a_3, and before correlations have built up, a_2 drifts by some percent.
    np.testing.assert_allclose(curve.sonine[1], steady.sonine, rtol=0.1)


@pytest.mark.slow
def test_dsmc_finds_the_steady_state_of_van_noije_and_ernst():
    eps, dimension = 0.8, 2
    gas = constant(eps, dimension, rate=(1 - eps**2) / dimension)
    steady = jaxgran.steady_state(gas)
    times = np.linspace(10.0, 30.0, 21) * float(gas.mean_free_time)
    curve = jaxgran.cool(gas, times, model=jaxgran.DSMC(20_000, replicas=2))
    # 40 000 particles at some 5 times: .2 % of T, .002 of a_2, a few times; terms beyond a_2.
    assert float(jnp.mean(curve.temperature)) == pytest.approx(float(steady.temperature), rel=0.01)
    expected = sonine_of_van_noije_and_ernst(eps, dimension)
    assert float(jnp.mean(curve.sonine)) == pytest.approx(expected, abs=0.006 + 0.1 * abs(expected))
