"""Fits of scenes with rough spheres, walls and drag."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads
from tests.fitting.curves import A, deviation, in_range, rough_beads, synthetic

THEORY = jaxgran.KineticTheory()
FREE = (A, "tangential_restitution", "rotational_temperature")


def curve_of(gas, model=THEORY, relative_error=0.02):
    """A curve of a model with noise in T and, of rough spheres, in T_rot."""
    return synthetic(gas, jax.random.key(0), 40, relative_error, 80.0, model)


def are_found(result, gas, names):
    return all(deviation(result, gas, name) < 2 for name in names)


OF_PARTICLES = pytest.param(jaxgran.DSMC(10_000), marks=pytest.mark.slow)


@pytest.mark.parametrize("model", [THEORY, OF_PARTICLES])
def test_roughness_and_A_are_found_together(model):
    gas = rough_beads()
    curve = curve_of(gas, model)
    # A, beta_t and the initial T_rot are not known.
    unknown = gas.replace(dissipative_constant=0.0, rotational_temperature=0.0)
    result = jaxgran.fit(unknown.replace(tangential_restitution=-1.0), curve, free=FREE)
    assert bool(result.converged) and float(result.p_value) > 0.01
    assert are_found(result, gas, FREE) and not result.undetermined()
    # Errors must be of use, too: .06 of A and .04 of beta_t by DSMC, and half as much again.
    assert float(result.standard_error[0] / result.estimate[0]) < 0.1
    assert float(result.standard_error[1]) < 0.08
    assert "model of T_rot" in result.error_budget
    diagnosis = jaxgran.diagnose(result, curve)
    assert "rough spheres of constant beta_t, far from walls" in " ".join(diagnosis.reasons)
    assert in_range(diagnosis, gas.value(A))  # with beta_t free there is a range, too


def test_of_two_minima_in_beta_t_the_deeper_one_is_found_and_said_where_as_deep():
    # Rotation takes most energy at some beta_t: on both sides of it T and T_rot look alike, with
    # half of A on the other side.
    gas, other, names = rough_beads(-0.5), rough_beads(0.3), FREE[:2]
    curve = curve_of(gas)
    result = jaxgran.fit(other, curve, free=names)
    assert are_found(result, gas, names)
    assert result.minima.chi2.shape == (4,) and not len(result.degenerate_solutions())
    assert jaxgran.diagnose(result, curve).grade != "not consistent"
    assert np.ptp(result.minima.chi2) > 9.0
    curve = curve_of(rough_beads(-0.42), relative_error=0.05)
    with pytest.warns(UserWarning, match="chi.2 has another, equally good minimum at A = "):
        result = jaxgran.fit(other, curve, free=names)
    assert float(result.degenerate_solutions()[0, 0] / result.estimate[0]) < 0.7
    found = jaxgran.diagnose(result, curve)
    assert found.grade == "not determined" and "other parameters fit this curve" in found.verdict
    # The range holds both.
    assert in_range(found, result.estimate[0])
    assert in_range(found, result.degenerate_solutions()[0, 0])
    assert any("has another, equally good minimum" in reason for reason in found.reasons)


def test_a_T_rot_that_theory_misses_as_a_whole_is_no_misfit():
    # Theory knows T_rot within 7 %: a common factor of 1.05 is within that, errors are 2 %.
    gas = rough_beads()
    curve = curve_of(gas)
    names = "rotational_temperature", "rotational_temperature_error"
    more = {name: 1.05 * getattr(curve, name) for name in names}
    # With the parameters of the test above, whose program is compiled.
    result = jaxgran.fit(gas, dataclasses.replace(curve, **more), free=FREE)
    assert float(result.p_value) > 0.05
    assert are_found(result, gas, FREE)


def test_between_walls_few_particles_have_all_their_energy_in_T():
    # Without walls N particles of no momentum are hotter by N/(N - 1), and cool faster.
    gas = glass_beads()
    between = dataclasses.replace(gas, container=jaxgran.Walls(0.05, restitution=0.9))
    for scene, faster in ((gas, 1 + 0.6 / 50), (between, 1.0)):
        # A clock that is off by .0005 makes chi^2 .1 with 40 points of 1 %.
        likelihood = jaxgran.log_likelihood(
            scene, synthetic(scene), clock=1 / faster, num_particles=50
        )
        assert float(likelihood) > -0.05
