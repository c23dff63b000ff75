import jax
import numpy as np
import pytest

from jaxgran.scene.geometry import CLOSE_PACKING, contact_value, sphere_surface


def test_sphere_surface():
    # Circumference of the unit circle and surface of the unit sphere.
    np.testing.assert_allclose(sphere_surface(2), 2 * np.pi, rtol=1e-15)
    np.testing.assert_allclose(sphere_surface(3), 4 * np.pi, rtol=1e-15)


def test_close_packing():
    # Per cell of the lattice: one disk in a hexagon of side 1/sqrt(3), four spheres in an fcc cube
    # of side sqrt(2).
    np.testing.assert_allclose(CLOSE_PACKING[2], np.pi / 4 / (np.sqrt(3) / 2), rtol=1e-14)
    np.testing.assert_allclose(CLOSE_PACKING[3], 4 * np.pi / 6 / np.sqrt(2) ** 3, rtol=1e-14)


@pytest.mark.parametrize("dimension, second_virial", [(2, np.pi / 2), (3, 2 * np.pi / 3)])
def test_contact_value_of_a_dilute_gas(dimension, second_virial):
    assert contact_value(0.0, dimension) == 1.0
    # Third virial coefficient over the square of the second (0.7820, 5/8), in powers of n B_2.
    third = {2: 0.782004, 3: 0.625}[dimension]
    per_packing = {2: 4 / np.pi, 3: 6 / np.pi}[dimension]
    slope = jax.grad(lambda phi: contact_value(phi, dimension))(0.0)
    # Henderson's formula has 25/16 for 1.5640.
    np.testing.assert_allclose(slope, third * second_virial * per_packing, rtol=2e-3)
