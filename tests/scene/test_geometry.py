import jax
import numpy as np
import pytest

from tests.beads import hard_gas


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
