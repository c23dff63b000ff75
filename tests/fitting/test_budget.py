"""The whole error of an estimate, part by part."""

import dataclasses

import numpy as np
import pytest

import jaxgran
from jaxgran.models.choose import predict_error_model
from tests.beads import glass_beads, soft_beads
from tests.fitting.curves import BOTH, cooled_beads, fitted, in_range, synthetic


def relative(result, part):
    return float(result.error_budget[part][0] / result.estimate[0])


def test_the_parts_add_up():
    gas, curve = cooled_beads()
    result = fitted(gas, curve, free=BOTH, num_particles=500)
    squares = sum(part**2 for part in result.error_budget.values())
    np.testing.assert_allclose(result.standard_error**2, squares, rtol=1e-12)
    assert set(result.error_budget) == {"measurement", "model", "few particles"}
    # The parts are those of the curve, whole and without the grains' own scatter.
    many = fitted(gas, curve, free=BOTH, num_particles=10**9)
    assert many.error_budget["few particles"][0] < 0.03 * result.error_budget["few particles"][0]


TRUE_A = {"dilute": 3e-6}
"""Of the spheres that LAMMPS simulated, s."""

DIAMETER = 2.13
"""d ln A / d ln of the diameter (the density of the material fixed, not the mass): known from
refits of the dilute curve at other values."""


@pytest.mark.slow
def test_inputs_are_propagated():
    # <dr^2> would tell the diameter, too: the mean free path is proportional to it.
    m = jaxgran.example_measurement("dilute")
    m = dataclasses.replace(m, data=dataclasses.replace(m.data, displacement=None))
    values, part = {"diameter": float(m.gas.diameter), "density": float(m.gas.density)}, "diameter"

    def fit_with(errors, **options):
        priors = {name: (values[name], x * values[name]) for name, x in errors.items()}
        return jaxgran.fit(dataclasses.replace(m, priors=priors), **options)

    # The density is known a thousand times better.
    result = fit_with({"diameter": 0.01, "density": 1e-5})
    alone = fit_with({}, quick=True)
    assert relative(result, part) == pytest.approx(0.01 * DIAMETER, rel=0.05)
    # The curve tells little of the input: A stays where it was.
    assert abs(result.estimate[0] / alone.estimate[0] - 1) < 0.3 * relative(result, part)
    # Each part is independent of the others. The curve tells a little of an input that is as open
    # as this.
    whole = np.hypot(alone.standard_error, relative(result, part) * result.estimate)[0]
    assert float(result.standard_error[0]) == pytest.approx(float(whole), rel=0.05)
    # Of an input that is known well it tells nothing.
    sharp = fit_with({name: 1e-3 for name in values}, quick=True)
    assert relative(sharp, "model") == pytest.approx(relative(alone, "model"), rel=0.05)
    assert in_range(result, TRUE_A["dilute"])


def test_a_prior_and_a_curve_share_what_they_know():
    """Both measurements contain T_0: the estimate is the mean by inverse variances."""
    gas, curve = cooled_beads(1, relative_error=0.05)
    alone = fitted(gas, curve, free=BOTH, num_particles=10**9)
    T_0 = float(gas.temperature)
    given, error = 1.05 * T_0, 0.02 * T_0
    priors = {"temperature": (given, error)}
    result = fitted(gas, curve, free=BOTH, priors=priors, num_particles=10**9)
    curve_alone = float(np.log(alone.estimate[1] / T_0))
    variance = float(alone.standard_error[1] / alone.estimate[1]) ** 2
    prior = np.log(1.05), (0.02 / 1.05) ** 2
    expected = (curve_alone / variance + prior[0] / prior[1]) / (1 / variance + 1 / prior[1])
    found = float(np.log(result.estimate[1] / T_0))
    assert found == pytest.approx(expected, abs=0.05 * variance**0.5)
    assert result.standard_error[1] < 0.95 * min(error, float(alone.standard_error[1]))


@pytest.mark.slow
def test_the_rate_error_is_that_of_the_scene():
    """A box of 297 diameters at phi = .2: the flow that grows there is no heat."""
    gas = glass_beads(0.18).replace(packing_fraction=0.2)
    n = round(297**3 * float(gas.number_density * gas.diameter**3))
    curve = synthetic(gas)
    unknown, known = (fitted(gas, curve, num_particles=x) for x in (None, n))
    assert relative(unknown, "model") < 0.01 < 3 * relative(unknown, "model")
    assert 3 * relative(unknown, "model") < relative(known, "model")


@pytest.mark.slow
def test_the_budget_of_a_particle_fit():
    gas = glass_beads(0.15)
    curve = synthetic(gas, num_points=20, end=30.0)
    phi = float(gas.packing_fraction)
    options = {"priors": {"packing_fraction": (phi, 0.04 * phi)}, "num_particles": 1000}
    model = jaxgran.DSMC(2000, replicas=3)
    result = fitted(gas, curve, model=model, progress=False, **options)
    theory = fitted(gas, curve, **options)
    for part in ("packing_fraction", "measurement", "few particles"):
        assert relative(result, part) == pytest.approx(relative(theory, part), rel=0.1)
    assert set(result.error_budget) >= {"simulation", "model"}
    assert relative(result, "model") > 0.002  # DSMC has Enskog's rate too


def test_derivatives_through_a_flow_are_known_worse():
    """0 in boxes below L_c, and the measured biases of a clustering gas within a factor of 2."""
    measured = {3.0: 0.026, 10.0: 0.069, 30.0: 0.16, 100.0: 0.78}
    gas = soft_beads(0.05, 0.2, packing_fraction=0.3)
    end = 3000 * float(gas.mean_free_time)
    for model in (jaxgran.SoftSpheres(1000), jaxgran.HardSpheres(1000)):
        error_model = predict_error_model(gas, end, 1000)
        error = model.derivative_error(error_model)
        bias = np.interp([*measured], error_model.collisions, error)
        assert np.all(np.abs(np.log(bias / [*measured.values()])) < np.log(2))
    small = predict_error_model(gas, end, 100)
    assert float(gas.box_side(100)) < float(gas.critical_box)
    assert not np.any(jaxgran.SoftSpheres(100).derivative_error(small))
    assert jaxgran.DSMC(1000).derivative_error(predict_error_model(gas, end, 1000)) == 0


def test_errors_between_walls_are_those_measured():
    gas = glass_beads(packing_fraction=0.03)
    walled = dataclasses.replace(gas, container=jaxgran.Walls(gas.box_side(250), restitution=0.9))
    elastic = walled.replace(wall_coefficient=1.0)
    walled, elastic = (
        predict_error_model(x, end=0.1, num_particles=250) for x in (walled, elastic)
    )
    at_walls, at_elastic_walls = np.asarray(walled.mixing), np.asarray(elastic.mixing)
    assert 0.012 < at_walls[0] < 0.013 and 0.004 < at_elastic_walls[0] < 0.005
    fallen = np.exp(walled.log_temperature[-1])
    assert fallen < 0.9 and 0.9 < at_walls[-1] / 0.012 / fallen**0.5 < 1.1
