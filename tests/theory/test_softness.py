"""Contacts that last, by quadratures of their own."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from jaxgran.scene.geometry import contact_value_slopes
from jaxgran.theory.equations import DIAMETER_REDUCTION, crowding_coefficient, softness_coefficient


def loss_and_slope(beta):
    """1 - eps^2 of an impact, and its derivative in an outward acceleration, in units v^2/X."""

    def rates(s, z):
        y, w, _, dy, dw, _ = z
        stress = y * y + beta * w
        slower = -4 * y * dy * stress - 2 * y * y * (2 * y * dy + beta * dw) - 2 * y
        lost = 4 * beta * (y * w) ** 2
        return [w, -2 * y * y * stress, lost, dw, slower, 8 * beta * y * w * (dy * w + y * dw)]

    def apart(s, z):
        return z[0] - max(-beta * z[1], 0.0) ** 0.5

    apart.terminal, apart.direction = True, -1
    start, close = [0, 1, 0, 0, 0, 0], {"rtol": 1e-10, "atol": 1e-13, "max_step": 0.2}
    found = solve_ivp(rates, (0, 100), start, "DOP853", events=apart, first_step=1e-3, **close)
    y, _, lost, dy, _, lost_more = found.y_events[0][0]
    # The energy of the last overlap is lost; the total does not depend on when contact ends.
    return lost + 0.8 * y**5, lost_more + 4 * y**4 * dy


@pytest.mark.parametrize("beta", [0.03, 0.5, 3.0])
def test_softness_is_the_average_over_oblique_impacts(beta):
    x, weights = np.polynomial.legendre.leggauss(12)
    g, weights = 3 * (x + 1), 3 * weights * np.exp(-((3 * (x + 1)) ** 2) / 2)
    loss, slope = np.array([loss_and_slope(beta * v**0.2) for v in g]).T
    expected = -2 * np.sum(weights * g**1.8 * slope) / np.sum(weights * g**3 * loss)
    # The fit is good to 5e-4, twelve nodes to 3e-4.
    np.testing.assert_allclose(softness_coefficient(jnp.asarray(beta), 3), expected, rtol=1e-3)


def test_softness_of_a_weakly_dissipating_contact():
    # Velocities are then independent of positions: the loss is the mean of sqrt(xi) (1 - xi)^(d-1).
    def mean(power):
        return quad(lambda x: x**power * np.exp(-0.4 * x**2.5), 0, 8)[0]

    for d in (2, 3):
        expected = (d - 1) * mean(1.5) / mean(0.5)
        np.testing.assert_allclose(softness_coefficient(jnp.zeros(()), d), expected, rtol=1e-8)
    np.testing.assert_allclose(DIAMETER_REDUCTION, mean(0.0), rtol=1e-8)
    # 0.96878 (d - 1), and in 3D 1.84, 1.71, 1.60, 1.42: oblique impacts, integrated apart.
    found = softness_coefficient(jnp.asarray([0.1, 0.3, 0.5, 1.0]), 3)
    np.testing.assert_allclose(found, [1.84, 1.71, 1.60, 1.42], atol=8e-3)


@pytest.mark.parametrize("dimension, expected", [(3, [7.5, 4.5]), (2, [25 / 8, 53 / 24])])
def test_slopes_of_a_dilute_gas_are_those_of_the_excluded_volume(dimension, expected):
    # Their sum over phi is the slope in d of the volume that two spheres of radius d exclude both:
    # 2 pi n = 12 phi for spheres, (4 pi/3) n = (16/3) phi for disks.
    slopes = contact_value_slopes(jnp.asarray(1e-7), dimension)
    np.testing.assert_allclose(np.array(slopes) / 1e-7, expected, rtol=1e-5)
    np.testing.assert_allclose(sum(slopes) / 1e-7, {3: 12, 2: 16 / 3}[dimension], rtol=1e-5)


def test_crowding_is_the_loss_of_the_equilibrium_fluid(beads):
    gas = beads(0.1, packing_fraction=0.2)
    # 1.2801 (1.9170) + .3113 (1.2003) + .56/3 t_c/tau_c sigma/X_T, worked out by hand.
    length = gas.reduced_law.impact_length(jnp.ones(()))
    held = 0.56 / 3 * gas.contact_fraction / length
    expected = 1.28011 * 1.91667 + 0.31133 * 1.2 + held
    np.testing.assert_allclose(crowding_coefficient(gas), expected, rtol=1e-3)
    assert crowding_coefficient(beads(0.1, packing_fraction=1e-6)) < 2e-5
