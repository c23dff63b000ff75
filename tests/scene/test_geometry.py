"""Positions in a periodic box."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.scene.geometry import wrap, wrap_on_host


@pytest.mark.parametrize("side", [1.0, 3.7])
def test_wrap_lands_inside(side):
    edges = [0.0, -1e-20, -1e-300, side, -side, 7 * side, np.nextafter(side, 0), 1.5 * side]
    random = np.random.default_rng(4).uniform(-20, 20, 90)
    position = np.append(edges, random)[:, None] * np.ones((1, 2))
    inside = np.asarray(wrap(jnp.asarray(position), side))
    assert np.all(inside >= 0) and np.all(inside < side)
    sides = np.round((position - inside) / side)
    # Coordinates of up to 26 are rounded at 4e-15.
    np.testing.assert_allclose(inside + sides * side, position, atol=1e-14)
    np.testing.assert_array_equal(wrap(jnp.asarray(inside), side), inside)
    np.testing.assert_array_equal(wrap_on_host(position, side), inside)
