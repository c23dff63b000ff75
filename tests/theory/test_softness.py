"""Contacts that last, by quadratures of their own."""

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import jaxgran
from tests.beads import hard_gas, without

LENGTH = 0.2
"""X_T of the gases, the length scale of overlaps at sqrt(2 T_0), in diameters."""

DILUTE = 1e-12
"""A packing fraction at which spheres meet two at a time."""


def soft_gas(beta, phi, dimension):
    alpha = 2 * LENGTH**-2.5
    A = beta / (1.5 * alpha**0.4 * 2**0.1)
    return hard_gas(jaxgran.Viscoelastic(1.5 * alpha, 0.0, A), phi, dimension)


def slowing(gas):
    """Cooling rate at T_0 over that of instantaneous impacts, (1 - c X_T)/(1 + k X_T)."""
    theory = jaxgran.KineticTheory(corrections=without("sonine", "correlations"), rtol=1e-12)
    short = 1e-3 * np.array([0.25, 0.5, 0.75, 1.0])
    T = jaxgran.cool(gas, short / theory.cooling_rate(gas), model=theory).temperature
    return np.polyfit(short, -np.log(T) / short, 3)[-1]  # at t = 0


def softness(beta, dimension=3):
    """c of a gas in which k is 0."""
    return (1 - slowing(soft_gas(beta, DILUTE, dimension))) / LENGTH


def mean(power):
    """Of the overlap in X_T."""
    return quad(lambda x: x**power * np.exp(-0.4 * x**2.5), 0, 8)[0]


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
    np.testing.assert_allclose(softness(beta), expected, rtol=1e-3)


@pytest.mark.parametrize("dimension", [2, 3])
def test_softness_of_a_weakly_dissipating_contact(dimension):
    # Velocities are then independent of positions: the loss is the mean of sqrt(xi) (1 - xi)^(d-1).
    expected = (dimension - 1) * mean(1.5) / mean(0.5)
    betas = 1e-4 * np.array([1.0, 2.0, 3.0])
    found = np.polyfit(betas, [softness(beta, dimension) for beta in betas], 2)[-1]  # at beta = 0
    np.testing.assert_allclose(found, expected, rtol=1e-8)


@pytest.mark.parametrize(
    "dimension, phi, by_diameter, by_distance",
    [
        # d times 5/2 and 25/16, of the third virial coefficient. Both are together the slope in d
        # of the volume that two spheres of radius d exclude both: 2 pi n = 12 phi for spheres,
        # (4 pi/3) n = (16/3) phi for disks.
        (3, 1e-6, 7.5, 4.5),
        (2, 1e-6, 25 / 8, 53 / 24),
        (3, 0.2, 1.91667 / 0.2, 1.2 / 0.2),  # by hand
    ],
)
def test_crowding_is_the_loss_of_the_equilibrium_fluid(dimension, phi, by_diameter, by_distance):
    gas, dilute = soft_gas(0.1, phi, dimension), soft_gas(0.1, DILUTE, dimension)
    # The diameter that excludes the same volume, the mean overlap, and the energy of contacts.
    reduction, overlap = mean(0.0), mean(1.5) / mean(0.5)
    expected = phi * (reduction * by_diameter + (reduction - overlap) * by_distance)
    expected += 0.56 / dimension * gas.contact_fraction / LENGTH
    found = (slowing(dilute) / slowing(gas) - 1) / LENGTH
    np.testing.assert_allclose(found, expected, rtol=1e-5)
