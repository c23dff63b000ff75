"""The energy that contacts hold: single contacts, and the limits of its scatter."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import jaxgran
from jaxgran.theory.contact_noise import CONTACT_MEMORY, CONTACT_VARIANCE, contact_noise
from tests.beads import glass_beads, hard_gas, without


def missing_energy(dissipation):
    """Times of a Hertz contact, the share of its energy that is missing, and eps."""

    def force(overlap, rate):
        root = np.sqrt(max(overlap, 0.0))
        return root * (overlap + dissipation * rate)

    def motion(_, state):
        overlap, rate = state
        return [rate, -force(overlap, rate)]

    def end(time, state):
        return force(*state) if time > 0.1 else 1.0

    end.terminal = True
    found = scipy.integrate.solve_ivp(
        motion, [0, 10], [0, 1], events=end, rtol=1e-9, atol=1e-12, dense_output=True
    )
    times = np.linspace(0, found.t[-1], 20_001)
    _, rate = found.sol(times)
    return times, 1 - rate**2, rate[-1]


def test_constants_are_those_of_an_elastic_contact():
    times, share, _ = missing_energy(0.0)
    mean = np.trapezoid(share, times) / times[-1]
    square = np.trapezoid(share**2, times) / times[-1]
    # Energies of impacts over m T, each of which lasts energy^(-1/10), over their mean duration.
    energy = np.linspace(0.0, 50.0, 200_001)[1:]
    duration = energy**-0.1 / scipy.special.gamma(0.9)
    weight = np.exp(-energy) * energy**2 * duration
    variance = 2 * square * np.trapezoid(weight, energy)
    assert pytest.approx(variance, rel=5e-3) == CONTACT_VARIANCE
    longer = np.trapezoid(weight * duration, energy) / np.trapezoid(weight, energy)
    assert pytest.approx(longer * mean**2 / (2 * square), rel=0.01) == CONTACT_MEMORY


@pytest.mark.parametrize("dissipation", [0.1, 0.3, 0.5])
def test_a_dissipative_contact_scatters_less_by_the_square_of_eps(dissipation):
    def integral(contact):
        times, share, _ = contact
        return np.trapezoid(share * (share - share[-1]), times)

    contact = missing_energy(dissipation)
    elastic = integral(missing_energy(0.0))
    eps = contact[-1]
    # Within 7 % of the elastic one for eps >= .6.
    assert integral(contact) / elastic == pytest.approx(eps**2, abs=0.07)


def test_only_soft_spheres_have_contacts():
    log_T = jnp.asarray([0.0, -1.0])
    assert contact_noise(hard_gas(0.9), log_T) is None
    gas = glass_beads()
    contacts = contact_noise(gas, log_T)
    assert contacts is not None
    shorter = np.exp(-0.4)  # t_c/tau_c is in proportion to T^(2/5)
    np.testing.assert_allclose(contacts.memory[1] / contacts.memory[0], shorter)
    memory = CONTACT_MEMORY * float(gas.contact_fraction)
    assert float(contacts.memory[0]) == pytest.approx(memory)


def test_contacts_scatter_a_run_of_soft_spheres_from_its_start_on():
    gas = glass_beads()
    soft = replace(gas, law=replace(gas.law, youngs_modulus=jnp.asarray(1e4)))
    assert float(soft.contact_fraction) > 0.01
    times = float(soft.mean_free_time) * np.array([0.0, 0.1, 0.2])
    without_contacts = jaxgran.KineticTheory(corrections=without("softness"))
    added = np.asarray(jaxgran.KineticTheory().covariance(soft, times, 100))
    added = added - np.asarray(without_contacts.covariance(soft, times, 100))
    np.testing.assert_array_equal(added[0], 0.0)
    size = float(contact_noise(soft, jnp.zeros(())).size)
    assert added[1, 1] == pytest.approx(size**2 / 100, rel=0.1)
