"""Correlated velocities: the rate of cooling beside a sum of its own over the modes of the flow."""

from math import pi

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from tests.beads import hard_gas, theory_curve, without

MAX_WAVENUMBER = {2: (0.181, 3.10), 3: (0.926, 2.19)}
"""a, b of ``K sigma = a + b phi``, fitted to experiments/accuracy/measure_correlations.py."""


def slowdown(gas):
    """h of spheres all of whose impacts dissipate alike, seen after 4 and 40 collisions each."""
    loss = (1 - gas.coefficient**2) / gas.dimension
    taus = jnp.expm1(loss / 2 * jnp.array([4.0, 40.0])) / (loss / 2)
    curve = theory_curve(gas, taus, corrections=without("sonine"), rtol=1e-10)
    # dln T/dn = -(1 - e^2)/d (1 - h B(n)): correlations have built up as B = 1 - exp(-n/4).
    n = curve.collisions
    return np.asarray((n + jnp.log(curve.temperature) / loss) / (n + 4 * jnp.expm1(-n / 4)))


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
    # Of the quadrature, and of ln T, 1e-10, by which the correlations change it.
    np.testing.assert_allclose(slowdown(gas), expected, rtol=1e-6)


@pytest.mark.parametrize("dimension", [2, 3])
def test_slowing_of_elastic_and_of_strongly_dissipating_spheres(dimension):
    # Where 2 k_c passes the shortest wave none is left; nothing turns negative.
    every = [slowdown(hard_gas(e, 0.3, dimension))[1] for e in np.sqrt(np.linspace(0, 0.99, 23))]
    # Of the solver: 1e-8.
    assert min(every) > -1e-8 and max(every) < 0.04 and every[11] > 0
    gas, taus = hard_gas(1.0, 0.3, dimension), np.array([4.0, 40.0])
    elastic = theory_curve(gas, taus, corrections=without("sonine"), rtol=1e-10)
    assert np.all(elastic.temperature == 1.0)


def test_elastic_spheres_have_a_derivative():
    def temperature(e):
        return theory_curve(
            hard_gas(e, 0.3), jnp.array([2.0]), corrections=without("sonine")
        ).temperature[0]

    _, slope = jax.jit(lambda e: jax.jvp(temperature, (e,), (1.0,)))(1.0)
    np.testing.assert_allclose(slope, 4 / 3, rtol=1e-7)  # two collisions each, of 1 - e^2 over d
