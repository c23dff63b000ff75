"""Fits of scenes with rough spheres, walls and drag."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.measured_rows import finite_size_cooling_factor
from tests.beads import glass_beads
from tests.fitting.curves import A, deviation, fitted, in_range, rough_beads, synthetic

THEORY = jaxgran.KineticTheory()
FREE = (A, "tangential_restitution", "rotational_temperature")


def curve_of(gas, model=THEORY, relative_error=0.02):
    """A curve of a model with noise in T and, of rough spheres, in T_rot."""
    return synthetic(gas, jax.random.key(0), 40, relative_error, 80.0, model)


def are_found(result, gas, names):
    return all(deviation(result, gas, name) < 3 for name in names)


OF_PARTICLES = pytest.param(jaxgran.DSMC(10_000), marks=pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize("model", [THEORY, OF_PARTICLES])
def test_roughness_and_A_are_found_together(model):
    gas = rough_beads()
    curve = curve_of(gas, model)
    # A, beta_t and the initial T_rot are not known.
    unknown = gas.replace(dissipative_constant=0.0, rotational_temperature=0.0)
    unknown = unknown.replace(tangential_restitution=-1.0)
    result = fitted(unknown, curve, free=FREE, quick=False, num_particles=10_000)
    assert result.converged and result.p_value > 0.01
    assert are_found(result, gas, FREE) and not result.undetermined
    # Errors must be of use, too.
    assert float(result.standard_error[0] / result.estimate[0]) < 0.1
    assert float(result.standard_error[1]) < 0.08
    assert "model of T_rot" in result.error_budget
    assert "rough spheres of constant beta_t, far from walls" in " ".join(result.reasons)
    assert in_range(result, gas.value(A))  # with beta_t free there is a range, too


@pytest.mark.slow
def test_of_two_minima_in_beta_t_the_deeper_one_is_found_and_said_where_as_deep():
    # Rotation takes most energy at some beta_t: on both sides of it T and T_rot look alike, with
    # half of A on the other side.
    gas, other, names = rough_beads(-0.5), rough_beads(0.3), FREE[:2]
    curve = curve_of(gas)
    many = {"num_particles": 10**7, "quick": False}
    result = fitted(other, curve, free=names, **many)
    assert are_found(result, gas, names)
    assert not len(result.other_minima) and result.grade != "not consistent"
    curve = curve_of(rough_beads(-0.42), relative_error=0.05)
    with pytest.warns(UserWarning, match="another minimum .* at A = "):
        result = fitted(other, curve, free=names, **many)
    assert float(result.other_minima[0, 0] / result.estimate[0]) < 0.7
    assert result.grade == "not determined"
    assert "other values of the parameters fit this curve nearly as well" in result.verdict
    # The range holds both, and so does the error bar.
    assert in_range(result, result.estimate[0]) and in_range(result, result.other_minima[0, 0])
    assert "other minima" in result.error_budget
    assert any("another minimum that is nearly as good" in reason for reason in result.reasons)


@pytest.mark.slow
def test_a_T_rot_that_theory_misses_as_a_whole_is_no_misfit():
    # Theory knows T_rot within 7 %: a common factor of 1.05 is within that, errors are 2 %.
    gas = rough_beads()
    curve = curve_of(gas)
    names = "rotational_temperature", "rotational_temperature_error"
    more = {name: 1.05 * getattr(curve, name) for name in names}
    # With the parameters of the test above, whose program is compiled.
    result = fitted(gas, dataclasses.replace(curve, **more), free=FREE, num_particles=10**7)
    assert result.p_value > 0.05
    assert are_found(result, gas, FREE)


def test_between_walls_few_particles_have_all_their_energy_in_T():
    # Without walls N particles of no momentum are hotter by N/(N - 1), and cool faster.
    gas = glass_beads()
    between = dataclasses.replace(gas, container=jaxgran.Walls(0.05, restitution=0.9))
    factors = [float(finite_size_cooling_factor(x, 50.0)) for x in (gas, between)]
    np.testing.assert_allclose(factors, [1 + 0.6 / 50, 1.0], rtol=2e-3)
