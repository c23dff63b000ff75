"""The whole error of an estimate, part by part."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.models.choose import error_model_of
from tests.beads import glass_beads, soft_beads
from tests.fitting.curves import BOTH, cooled_beads, in_range, measured, synthetic


def relative(result, part):
    return float(result.error_budget[part][0] / result.estimate[0])


def test_the_parts_add_up():
    gas, curve = cooled_beads()
    result = jaxgran.fit(gas, curve, free=BOTH, num_particles=500)
    squares = sum(part**2 for part in result.error_budget.values())
    np.testing.assert_allclose(result.standard_error**2, squares, rtol=1e-12)
    assert set(result.error_budget) == {"measurement", "model", "few particles"}
    # A wrong clock is a wrong A, by a little more, since the rate grows less than A.
    clock = float(jnp.max(result.comparison.clock_error))
    assert 0.003 < clock < 0.02 and clock < relative(result, "model") < 1.4 * clock


DIAMETER = 2.13
"""d ln A / d ln of the diameter (the density of the material fixed, not the mass): known from
refits of the dilute curve at other values."""


@pytest.mark.slow
def test_inputs_are_propagated():
    gas, curve, a_true, *_ = measured("dilute")
    values, part = {"diameter": float(gas.diameter), "density": float(gas.density)}, "diameter"
    # The density is known four thousand times better.
    errors = {"diameter": 0.04, "density": 1e-5}
    priors = {name: (value, errors[name] * value) for name, value in values.items()}
    result = jaxgran.fit(gas, curve, priors=priors)
    assert relative(result, part) == pytest.approx(0.04 * DIAMETER, rel=0.05)
    alone = jaxgran.fit(gas, curve)
    # The input is not known better than before: A stays where it was.
    assert abs(result.estimate[0] / alone.estimate[0] - 1) < 0.2 * relative(result, part)
    # Each part is independent of the others. The curve tells a little of an input that is as open
    # as this, so that some of its part goes to the measurement's and the clock's.
    whole = np.hypot(alone.standard_error, relative(result, part) * result.estimate)[0]
    assert float(result.standard_error[0]) == pytest.approx(float(whole), rel=0.05)
    # Of an input that is known well it tells nothing. The clock is fitted along, within its error
    # in this scene.
    sharp = {name: (value, 1e-3 * value) for name, value in values.items()}
    clock = relative(jaxgran.fit(gas, curve, priors=sharp), "model")
    assert clock == pytest.approx(relative(alone, "model"), rel=0.05)
    assert in_range(jaxgran.diagnose(result, curve), a_true)


def test_a_prior_and_a_curve_share_what_they_know():
    """Both measurements contain T_0: the estimate is the mean by inverse variances."""
    gas, curve = cooled_beads(1, relative_error=0.05)
    alone = jaxgran.fit(gas, curve, free=BOTH)
    T_0 = float(gas.temperature)
    given, error = 1.05 * T_0, 0.02 * T_0
    result = jaxgran.fit(gas, curve, free=BOTH, priors={"temperature": (given, error)})
    curve_alone = float(np.log(alone.estimate[1] / T_0))
    variance = float(alone.error_budget["measurement"][1] / alone.estimate[1]) ** 2
    prior = np.log(1.05), (0.02 / 1.05) ** 2
    expected = (curve_alone / variance + prior[0] / prior[1]) / (1 / variance + 1 / prior[1])
    # The clock, which is fitted too where there are priors, and neighbours' chance correlation
    # change the weights by some per cent.
    found = float(np.log(result.estimate[1] / T_0))
    assert found == pytest.approx(expected, abs=0.15 * variance**0.5)
    assert result.standard_error[1] < 0.95 * min(error, float(alone.standard_error[1]))


@pytest.mark.slow
def test_the_clock_is_that_of_the_scene():
    """A box of 297 diameters at phi = .2: the flow that grows there is no heat."""
    gas = glass_beads(0.18).replace(packing_fraction=0.2)
    n = round(297**3 * float(gas.number_density * gas.diameter**3))
    curve = synthetic(gas)
    unknown, known = (jaxgran.fit(gas, curve, num_particles=x) for x in (None, n))
    models = [jaxgran.KineticTheory()]
    choice = jaxgran.choose_model(gas, curve.times, num_particles=n, models=models)
    assert relative(unknown, "model") < 0.04 < 0.09 < relative(known, "model") < 0.13
    # T errs by more than the clock: by |d ln T / d ln t|, at most 5/3 (the grids of times differ).
    clock_error = float(jnp.max(known.comparison.clock_error))
    assert 1.3 < choice.error / clock_error < 1.8, (choice.error, clock_error)


@pytest.mark.slow
def test_the_budget_of_a_particle_fit():
    gas = glass_beads(0.15)
    curve = synthetic(gas, num_points=20, end=30.0)
    phi = float(gas.packing_fraction)
    priors = {"packing_fraction": (phi, 0.04 * phi)}
    options = {"priors": priors, "num_particles": 1000}
    model = jaxgran.DSMC(2000, replicas=3)
    result = jaxgran.fit(gas, curve, model=model, progress=False, **options)
    theory = jaxgran.fit(gas, curve, **options)
    part, expected = (relative(x, "packing_fraction") for x in (result, theory))
    assert part == pytest.approx(expected, rel=0.05)
    # That of few particles is what they add to the measured errors, which are larger where the
    # clock is fitted along.
    chance, expected = (
        np.hypot(relative(x, "measurement"), relative(x, "few particles")) for x in (result, theory)
    )
    assert chance == pytest.approx(expected, rel=0.1)
    assert set(result.error_budget) >= {"simulation", "model"}
    assert relative(result, "model") > 0.005  # DSMC has Enskog's rate too


def test_derivatives_through_a_flow_are_known_worse():
    """0 in boxes below L_c, and the measured biases of a clustering gas within a factor of 2."""
    measured = {3.0: 0.026, 10.0: 0.069, 30.0: 0.16, 100.0: 0.78}
    gas = soft_beads(0.05, 0.2, packing_fraction=0.3)
    end = 3000 * float(gas.mean_free_time)
    for model in (jaxgran.SoftSpheres(1000), jaxgran.HardSpheres(1000)):
        error_model = error_model_of(gas, end, 1000)
        error = model.derivative_error(error_model)
        bias = np.interp([*measured], error_model.collisions, error)
        assert np.all(np.abs(np.log(bias / [*measured.values()])) < np.log(2))
    small = error_model_of(gas, end, 100)
    assert float(gas.box_side(100)) < float(gas.critical_box)
    assert not np.any(jaxgran.SoftSpheres(100).derivative_error(small))
    assert jaxgran.DSMC(1000).derivative_error(error_model_of(gas, end, 1000)) == 0


def test_between_walls_only_impacts_between_spheres_are_random():
    gas = glass_beads(packing_fraction=0.03)
    walled = dataclasses.replace(gas, container=jaxgran.Walls(gas.box_side(250), restitution=0.9))
    elastic = walled.replace(wall_coefficient=1.0)
    walled, elastic = (error_model_of(x, end=0.1, num_particles=250) for x in (walled, elastic))
    rates = [-m.log_temperature[1] / m.time[1] for m in (walled, elastic)]
    np.testing.assert_allclose(walled.impact_share[0], rates[1] / rates[0], rtol=0.04)
    np.testing.assert_allclose(elastic.impact_share, 1.0, rtol=1e-12)
    chance = [m.chance_of_clock(250)[-1] for m in (walled, elastic)]
    assert 0.3 < chance[0] / chance[1] < 0.6
    # The error of the rate is what was measured for such a box.
    at_walls, at_elastic_walls = np.asarray(walled.mixing), np.asarray(elastic.mixing)
    assert 0.012 < at_walls[0] < 0.013 and 0.004 < at_elastic_walls[0] < 0.005
    fallen = np.exp(walled.log_temperature[-1])
    assert fallen < 0.9 and 0.9 < at_walls[-1] / 0.012 / fallen**0.5 < 1.1


@pytest.mark.slow
def test_slip_makes_the_losses_of_rough_spheres_more_regular():
    gas = glass_beads(packing_fraction=0.03)
    rough = dataclasses.replace(gas, surface=jaxgran.Rough(-0.3))
    smooth, rough = (error_model_of(x, 0.001, num_particles=250) for x in (gas, rough))
    n = smooth.log_temperature[1] / rough.log_temperature[1]
    np.testing.assert_allclose(rough.normal_share[0], n, rtol=0.02)
    ratio = rough.chance_of_clock(250)[1] / smooth.chance_of_clock(250)[1]
    # Mean squares of a sum of two independent exponential losses, n and 1 - n, and of one.
    assert ratio == pytest.approx((1 + n**2 + (1 - n) ** 2) / 2, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("A, beta, hotter", [(0.0, -1.0, 0.0), (0.0, 1.0, 1.0), (1e-6, -0.3, 30.0)])
def test_rough_spheres_that_lose_nothing_or_are_heated_by_spins_have_finite_errors(A, beta, hotter):
    gas = glass_beads(packing_fraction=0.03, dissipative_constant=A)
    surface = jaxgran.Rough(beta, rotational_temperature=hotter * gas.temperature)
    error_model = error_model_of(dataclasses.replace(gas, surface=surface), 0.1, 250)
    shares = np.stack([error_model.impact_share, error_model.normal_share])
    assert np.all((shares >= 0) & (shares <= 1))
    # At most that of smooth spheres at the lowest temperature, which collide least.
    slowest = float(gas.collision_frequency) * np.exp(error_model.log_temperature.min() / 2)
    most = 4 / (250 * slowest) * error_model.time
    assert np.all(error_model.chance_of_clock(250) <= most * (1 + 1e-12))  # round-off
