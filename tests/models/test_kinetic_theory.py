"""Kinetic theory against the reference solutions, and its numerics over many decades."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import KineticTheory
from tests.beads import curves_of, glass_beads, without

# d, beta_T0, tau, T/T_0, T/T_0 with a_2 = 0, a_2, <dr^2>: independent solution of the same
# equations, clipped restitution, Gaussian start, no softness correction.
REFERENCE = """
3 .05 1 .9611838 .9611565 -.005641 .04808981
3 .05 10 .6984981 .6979185 -.013184 1.437598
3 .05 100 .1289209 .1284777 -.011842 10.42569
3 .15 1 .9037366 .9036523 -.007574 .04770303
3 .15 10 .4431792 .4422072 -.018296 1.347421
3 .15 100 .03485851 .03464156 -.018733 7.40483
3 .15 1000 .0008602316 .000854318 -.016810 18.50849
2 .15 1 .861079 .8608634 -.013827 .1148266
2 .15 10 .3299659 .3283514 -.032185 2.37369
2 .15 100 .01899688 .01877722 -.033265 10.74937
"""
HARD = KineticTheory(corrections=without("softness", "correlations"), order=2)


@pytest.mark.slow
@pytest.mark.parametrize("row", REFERENCE.split("\n")[1:-1])
@pytest.mark.figures
def test_reference_table(row, record):
    d, beta, tau, theta, maxwellian, a2, displacement = (float(x) for x in row.split())
    gas = glass_beads(beta, dimension=int(d))
    maxwellian_model = KineticTheory(corrections=without("softness", "sonine", "correlations"))
    curve, no_a2 = curves_of(gas, [tau], HARD, maxwellian_model)
    found = curve.temperature[0] / gas.temperature, curve.displacement[0] / gas.path_length**2
    errors = np.abs(np.array(found) / np.array([theta, displacement]) - 1)
    # Asked: 2e-4. Reached: 8e-6 in T and 3e-6 in <dr^2>, the accuracy of the table's own eps(v).
    assert np.all(errors < [1e-5, 5e-6])
    np.testing.assert_allclose(curve.sonine[0], a2, atol=1e-6)
    np.testing.assert_allclose(no_a2.temperature[0] / gas.temperature, maxwellian, rtol=1e-5)
    record("kinetic_theory", row=row, temperature=float(errors[0]), displacement=float(errors[1]))


@pytest.mark.slow
@pytest.mark.figures
def test_sensitivity_table(record):
    gas = glass_beads(0.15)
    times = jnp.array([1.0, 5, 10, 50, 100, 1000]) * gas.mean_free_time

    def log_temperature(log_a):
        cooled = jaxgran.cool(gas.replace(dissipative_constant=jnp.exp(log_a)), times, model=HARD)
        return jnp.log(cooled.temperature)

    log_a = jnp.log(gas.value("dissipative_constant"))
    table = [-0.07813, -0.3193, -0.52054, -1.05837, -1.22284, -1.4631]
    # Asked: 1e-3. Reached: 5e-5, the last digit of the table.
    found = jax.jacfwd(log_temperature)(log_a)
    np.testing.assert_allclose(found, table, rtol=1e-4)
    record("derivative", error=float(np.max(np.abs(found / np.array(table) - 1))))


def test_twelve_decades_of_cooling():
    gas = glass_beads(0.15)
    tau = jnp.geomspace(1e-3, 3e8, 200)
    (curve,) = curves_of(gas, tau, HARD)
    assert curve.temperature[-1] / gas.temperature < 1e-12
    for field in jax.tree.leaves(curve):
        assert jnp.all(jnp.isfinite(field))
    # Late exponent: -5/3 + O(u^(-1/6)); two decades before the end the loss of b_2 still shows.
    slope = jnp.diff(jnp.log(curve.temperature))[-1] / jnp.diff(jnp.log(tau))[-1]
    np.testing.assert_allclose(slope, -5 / 3, atol=0.01)


@pytest.mark.slow
def test_tolerance_is_met():
    gas = glass_beads(0.15)
    taus, rtols = np.geomspace(0.01, 1e5, 50), (1e-12, 1e-4, 1e-6, 1e-9)
    exact, *curves = curves_of(gas, taus, *(KineticTheory(rtol=x) for x in rtols))
    for curve, rtol in zip(curves, rtols[1:], strict=True):
        np.testing.assert_allclose(curve.temperature, exact.temperature, rtol=10 * rtol)


def test_ballistic_start_and_diffusive_end():
    gas = glass_beads(0.0)
    (curve,) = curves_of(gas, [1e-4, 1e3], KineticTheory(order=2, rtol=1e-9))
    free_flight = 3 * gas.temperature * curve.times[0] ** 2
    # Collisions take (2/9) tau of it: 7e-5... of t/tau_c = 1e-4; the solver 1e-9 of mfp^2.
    np.testing.assert_allclose(curve.displacement[0], free_flight, rtol=1e-3)
    # Elastic Enskog, first Sonine: D = T tau_E with tau_E = 3/2 tau_c (the paper's D_0, put right).
    enskog = gas.temperature * 1.5 * gas.mean_free_time
    np.testing.assert_allclose(curve.diffusion[1], enskog, rtol=1e-8)
    np.testing.assert_allclose(curve.collisions[1], 1e3, rtol=1e-8)


@pytest.mark.parametrize("drive", [None, jaxgran.WhiteNoise(1e-4)])
def test_a_known_gas_is_checked_while_times_are_traced(drive):
    gas = dataclasses.replace(glass_beads(0.15), drive=drive)
    times = jnp.array([0.0, 1.0]) * gas.mean_free_time
    curve = jaxgran.cool(gas, times)
    traced = jax.jit(lambda t: jaxgran.cool(gas, t).temperature)(times)
    np.testing.assert_allclose(traced, curve.temperature, rtol=1e-6)


def test_another_number_of_times_compiles_nothing(caplog):
    gas = glass_beads(0.15)
    times = np.geomspace(0.01, 10.0, 32)
    half = jaxgran.cool(gas, times[1::2])
    whole = jaxgran.cool(gas, times)
    with jax.log_compiles():
        for size in (1, 9, 15, 17, 31):
            jaxgran.cool(gas, times[:size])
    assert not [record for record in caplog.records if "ompil" in record.message]
    # Both are interpolated within the same steps, by two programs.
    np.testing.assert_allclose(half.temperature, whole.temperature[1::2], rtol=1e-12)
    assert half.temperature.shape == half.displacement.shape == (16,)


@pytest.mark.slow
def test_derivatives_and_batches_outside_of_jit_are_compiled_once(caplog):
    gas = glass_beads(0.15)

    def final(T):
        return jaxgran.cool(gas.replace(temperature=T), [1.0]).temperature[-1]

    batch = jax.vmap(jax.grad(final))
    batch(jnp.array([0.01, 0.02]))
    with jax.log_compiles():
        batch(jnp.array([0.02, 0.03]))
    assert not caplog.records


def test_displacement_accuracy_covers_dense_hard_spheres():
    # Speedy's D over Enskog's first Sonine order, evaluated apart; rounded, so 15 % of the excess.
    for phi, excess in ((0.05, 0.0407), (0.1, 0.0844), (0.2, 0.1883)):
        accuracy = KineticTheory().displacement_accuracy(glass_beads(0.1, packing_fraction=phi))
        np.testing.assert_allclose(np.sqrt(accuracy**2 - 0.017**2), excess, rtol=0.15)
    assert KineticTheory().displacement_accuracy(glass_beads(0.1, packing_fraction=1e-6)) < 0.0171
