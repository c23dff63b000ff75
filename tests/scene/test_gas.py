import copy
import dataclasses
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads, hard_gas


def test_derived_scales():
    # By hand for 2 mm glass beads, phi = .05, T_0 = .01 m^2/s^2, 3D.
    gas = glass_beads(0.0898, dissipative_constant=3e-6)
    n = 0.05 * 6 / (np.pi * 8e-9)
    g2 = 1.95 / (2 * 0.95**3)
    np.testing.assert_allclose(gas.number_density, n, rtol=1e-12)
    np.testing.assert_allclose(gas.contact_value, g2, rtol=1e-12)
    nu_0 = 4 * np.sqrt(np.pi) * g2 * n * 4e-6 * 0.1
    np.testing.assert_allclose(gas.collision_frequency, nu_0, rtol=1e-12)
    np.testing.assert_allclose(gas.mean_free_time * nu_0, 1.0, rtol=1e-12)
    # Mean speed of a Maxwellian gas, sqrt(8 T / pi) or sqrt(pi T / 2), times the mean free time.
    np.testing.assert_allclose(gas.mean_free_path * nu_0, np.sqrt(0.08 / np.pi), rtol=1e-12)
    flat = dataclasses.replace(gas, dimension=2)
    n_2 = 0.05 * 4 / (np.pi * 4e-6)
    nu_2 = 2 * np.sqrt(np.pi) * (1 - 7 * 0.05 / 16) / 0.95**2 * n_2 * 0.002 * 0.1
    speed = np.sqrt(np.pi * 0.01 / 2)
    np.testing.assert_allclose(flat.number_density, n_2, rtol=1e-12)
    np.testing.assert_allclose(flat.collision_frequency, nu_2, rtol=1e-12)
    np.testing.assert_allclose(flat.mean_free_path / flat.mean_free_time, speed, rtol=1e-12)
    mass = np.pi / 6 * 2500 * 8e-9
    alpha = 2 * 5e7 * np.sqrt(0.0005) / (3 * (1 - 0.22**2)) / (mass / 2)
    np.testing.assert_allclose(gas.alpha, alpha, rtol=1e-12)
    np.testing.assert_allclose(gas.delta, 3e-6 * alpha**0.4 * 0.01**0.1, rtol=1e-12)
    # As the header notes of the measured scene have them: beta_T0 = .090, t_c/tau_c = .006.
    assert round(float(gas.thermal_beta), 3) == 0.090
    assert round(float(gas.contact_fraction), 3) == 0.006
    assert float(gas.box_side(4000) / gas.diameter) == pytest.approx(34.73, abs=0.01)


def test_contact_duration_is_the_mean_over_impacts():
    # Sample impacts: normal speeds g exp(-g^2/2) in units of sqrt(2 T).
    gas = glass_beads(0.15)
    g = np.sqrt(-2 * np.log(np.random.default_rng(1).random(400_000)))
    x = float(gas.alpha**2 * gas.impact_speed) ** -0.2
    # 4e5 samples of g^(-1/5), relative scatter 0.2: 3e-4.
    np.testing.assert_allclose(gas.contact_duration, 3.21806546 * x * (g**-0.2).mean(), rtol=1e-3)
    length = float(gas.impact_speed**2 / gas.alpha) ** 0.4
    overlap = 1.09336207 * length * (g**0.8).mean() / float(gas.diameter)
    np.testing.assert_allclose(gas.mean_overlap, overlap, rtol=3e-3)


def test_hard_gas_has_no_stiffness():
    gas = hard_gas(0.9, 0.1)
    assert gas.contact_fraction == 0.0
    assert gas.mean_overlap == 0.0
    k_c = float(gas.number_density) * np.sqrt(32 * np.pi / 15 * (1 - 0.81))
    dilute = gas.replace(packing_fraction=1e-9)
    np.testing.assert_allclose(dilute.critical_box * 1e-8, 2 * np.pi / k_c, rtol=1e-8)
    # True over dilute, of Enskog's viscosity: computed apart, to two digits.
    for phi, ratio in ((0.05, 0.97), (0.2, 1.08), (0.25, 1.17), (0.3, 1.28), (0.4, 1.54)):
        length = gas.replace(packing_fraction=phi).critical_box * phi / 0.1
        np.testing.assert_allclose(length, 2 * np.pi / k_c * ratio, rtol=6e-3)
    assert gas.replace(coefficient=1.0).critical_box == jnp.inf


@pytest.mark.parametrize("dimension", [2, 3])
def test_close_packing(dimension):
    # Per cell of the lattice: one disk in a hexagon of side 1/sqrt(3), four spheres in an fcc cube
    # of side sqrt(2).
    expected = {2: np.pi / 4 / (np.sqrt(3) / 2), 3: 4 * np.pi / 6 / np.sqrt(2) ** 3}[dimension]
    densest = hard_gas(dimension=dimension).domains["packing_fraction"].high
    np.testing.assert_allclose(densest, expected, rtol=1e-14)


@pytest.mark.parametrize("dimension, second_virial", [(2, np.pi / 2), (3, 2 * np.pi / 3)])
def test_contact_value_of_a_dilute_gas(dimension, second_virial):
    def contact_value(packing_fraction):
        return hard_gas(packing_fraction=packing_fraction, dimension=dimension).contact_value

    value, slope = jax.value_and_grad(contact_value)(0.0)
    assert value == 1.0
    # Third virial coefficient over the square of the second (0.7820, 5/8), in powers of n B_2.
    third = {2: 0.782004, 3: 0.625}[dimension]
    per_packing = {2: 4 / np.pi, 3: 6 / np.pi}[dimension]
    # Henderson's formula has 25/16 for 1.5640.
    np.testing.assert_allclose(slope, third * second_virial * per_packing, rtol=2e-3)


def test_repr_of_a_gas_has_units():
    gas = glass_beads()
    words = repr(gas)
    assert "dissipative_constant" in words and "m^2/s^2" in words and "f64[]" not in words
    assert f"{float(gas.mean_free_time):.4g} s" in words
    assert words.startswith("Gas of Viscoelastic spheres, d = 3")


class Dissipating(jaxgran.extend.RestitutionLaw):
    """A law of a user, with a field of the name that the viscoelastic law has, too."""

    dissipative_constant: float

    def restitution(self, normal_speed):
        return 1 / (1 + self.dissipative_constant * normal_speed)


def test_repr_of_a_law_of_a_user_with_a_dissipative_constant():
    words = repr(dataclasses.replace(glass_beads(), law=Dissipating(2.0)))
    assert words.startswith("Gas of Dissipating spheres, d = 3")
    assert "dissipative_constant  2" in words and "beta" not in words


def test_arrays_of_a_copy_have_any_shape_and_the_names_of_the_gas():
    gas = glass_beads()
    A = np.array([1e-6, 1.0])  # the last one is not allowed, which only `replace` checks
    changed = gas.with_arrays({"dissipative_constant": A})
    assert changed.dissipative_constant is A
    assert changed.parameters.keys() == gas.parameters.keys()
    assert float(gas.dissipative_constant) != A[0]
    with pytest.raises(ValueError, match="Gas has no parameter 'viscosity'"):
        gas.with_arrays({"viscosity": A})


def test_repr_marks_batches_and_traced_values():
    gas, shown = glass_beads(), []
    jax.jit(lambda gas: shown.append(repr(gas)) or gas.temperature)(gas)
    assert "traced" in shown[0]
    many = jax.vmap(lambda a: gas.replace(dissipative_constant=a))(jnp.ones(3))
    assert "values of shape (3,)" in repr(many)


def test_floats_of_parts_are_attributes_of_the_gas():
    gas = glass_beads().replace(dissipative_constant=2e-6)
    assert float(gas.dissipative_constant) == 2e-6
    with pytest.raises(AttributeError, match="Gas has no attribute 'viscosity'"):
        _ = gas.viscosity
    for again in (copy.deepcopy(gas), pickle.loads(pickle.dumps(gas))):
        np.testing.assert_array_equal(again.dissipative_constant, gas.dissipative_constant)
