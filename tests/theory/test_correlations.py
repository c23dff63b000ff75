"""Correlated velocities: modes of the flow by a sum of their own, and hard spheres."""

from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from jaxgran.theory.equations import MAX_WAVENUMBER, correlation_build_up, correlation_slowdown
from tests.beads import hard_gas


@pytest.mark.parametrize("dimension, phi, eps", [(3, 0.1, 0.9), (3, 0.3, 0.8), (2, 0.2, 0.7)])
def test_slowing_is_the_integral_over_the_modes(dimension, phi, eps):
    gas = hard_gas(eps, phi, dimension)
    k_c = 2 * pi / float(gas.critical_box)
    a, b = MAX_WAVENUMBER[dimension]
    shell = {2: 2 * pi, 3: 4 * pi}[dimension]

    # d - 1 shear modes a wave; d N kinetic degrees of freedom; the rate goes as T^(3/2) of heat.
    # The leading term up to K, what a mode holds beyond it over all waves.
    def beyond(k):
        return shell * k ** (dimension - 1) * (1 / ((k / k_c) ** 2 - 1) - (k_c / k) ** 2)

    leading, _ = quad(lambda k: shell * k ** (dimension - 3) * k_c**2, 2 * k_c, a + b * phi)
    energy, n = leading + quad(beyond, 2 * k_c, np.inf)[0], float(gas.number_density)
    expected = 1.5 * (dimension - 1) / (dimension * n) * energy / (2 * pi) ** dimension
    found = correlation_slowdown(jnp.asarray(phi), jnp.asarray(1 - eps**2), dimension)
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # of the quadrature


@pytest.mark.parametrize("dimension", [2, 3])
def test_slowing_of_elastic_and_of_strongly_dissipating_spheres(dimension):
    def of(inelasticity):
        return correlation_slowdown(jnp.asarray(0.3), inelasticity, dimension)

    value, slope = jax.value_and_grad(of)(jnp.zeros(()))
    assert value == 0 and jnp.isfinite(slope) and slope > 0
    # Where 2 k_c passes the shortest wave none is left; nothing turns negative.
    every = jax.vmap(of)(jnp.linspace(0.0, 1.0, 101))
    assert jnp.all(every >= 0) and jnp.max(every) < 0.04
    assert of(jnp.asarray(0.5)) > 0


def test_correlations_build_up_from_none():
    np.testing.assert_allclose(
        correlation_build_up(jnp.array([0.0, 4.0, 400.0])), [0.0, 1 - 1 / np.e, 1.0]
    )
