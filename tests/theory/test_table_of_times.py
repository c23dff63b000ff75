"""T(t) by quadrature, against the differential equations and against Haff's law."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.alternatives import (
    cooling_by_roughness,
    log_temperature_by_quadrature,
    relaxed_cooling_rate,
)
from tests.beads import glass_beads

SLOW = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize("beta, dimension", [(0.5, 3), pytest.param(0.05, 2, marks=SLOW)])
def test_is_that_of_kinetic_theory(beta, dimension):
    gas = glass_beads(beta, dimension)
    times = jnp.geomspace(0.1, 1e5, 40) * gas.mean_free_time
    expected = jaxgran.cool(
        gas, times, model=jaxgran.KineticTheory(softness=False, correlations=False)
    ).temperature

    def course(log_scale):
        A = gas.value("dissipative_constant") * jnp.exp(log_scale)
        nodes, rate = relaxed_cooling_rate(gas.replace(dissipative_constant=A), jnp.asarray(18.0))
        return log_temperature_by_quadrature(nodes, rate, times)

    # a_2 has not relaxed in the first collisions, by which the clock is off.
    found, slope = jax.jvp(course, (0.0,), (1.0,))
    np.testing.assert_allclose(found, jnp.log(expected / gas.temperature), atol=0.01 * beta + 5e-4)
    shift = 1e-4
    difference = (course(shift) - course(-shift)) / (2 * shift)
    np.testing.assert_allclose(slope, difference, atol=1e-8)  # 4e-10: of the difference


def test_haffs_law_exactly():
    nodes = -12.0 * jnp.linspace(0.0, 1.0, 192)
    times = jnp.geomspace(1e-3, 100.0, 50)
    # Trapezoids between nodes 12/191 apart err by 2 to 4e-4.
    found = log_temperature_by_quadrature(nodes, 2 * jnp.exp(nodes / 2), times)
    np.testing.assert_allclose(found, -2 * jnp.log1p(times), atol=5e-4)
    # A rate that does not depend on T: an exponential.
    found = log_temperature_by_quadrature(nodes, jnp.full(192, 3.0), jnp.linspace(0.0, 3.0, 20))
    np.testing.assert_allclose(found, -3 * jnp.linspace(0.0, 3.0, 20), atol=5e-4)


@pytest.mark.parametrize("beta", [-0.8, 0.0])
def test_rotation_follows_from_the_course(beads, beta):
    """Rough spheres that begin at rest in rotation, beside the equations of kinetic theory."""
    gas = beads(0.15)
    rough = dataclasses.replace(gas, surface=jaxgran.Rough(beta))
    log_theta, rate = relaxed_cooling_rate(gas, jnp.asarray(6.0))
    whole = rate + cooling_by_roughness(rough, log_theta, rate)
    times = jnp.geomspace(0.1, 80.0, 8) * gas.mean_free_time
    found = jnp.exp(log_temperature_by_quadrature(log_theta, whole, times))
    enskog = jaxgran.KineticTheory(order=2, correlations=False)
    expected = jaxgran.cool(rough, times, model=enskog).temperature / gas.temperature
    # a_2 relaxes at once here: up to .3 %. Without rotation T falls by 30 % (beta_t = -.8) more.
    np.testing.assert_allclose(found, expected, rtol=0.005)
