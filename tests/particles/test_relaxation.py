"""Random starts in compiled code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran._utils import status
from jaxgran.particles.setup import GAP, relaxed_positions, uniform_points
from jaxgran.scene.geometry import sphere_surface

N, REPLICAS = 60, 2


def side_of(packing, dimension):
    volume = N * sphere_surface(dimension) / dimension / 2**dimension / packing
    return volume ** (1 / dimension)


@jax.jit
def in_a_box(key, side):
    return relaxed_positions(key, side, (REPLICAS, N, 3), 0.4, (1000, 120))


@jax.jit
def in_a_square(key, side):
    return relaxed_positions(key, side, (REPLICAS, N, 2), 0.4, (1000, 120))


def closest(x, side, periodic=True):
    apart = x[:, None] - x[None]
    if periodic:
        apart -= side * np.round(apart / side)
    return np.min(np.linalg.norm(apart, axis=-1) + 9.0 * np.eye(len(x)))


@pytest.mark.parametrize(
    ("place", "dimension", "packing"),
    [(in_a_box, 3, 0.02), (in_a_box, 3, 0.47), (in_a_square, 2, 0.64)],
)
def test_no_spheres_overlap_and_boxes_differ(place, dimension, packing):
    side = side_of(packing, dimension)
    x, fault = place(jax.random.key(1), side)
    assert fault == status.OK and np.all((x >= 0) & (x < side))
    boxes = np.asarray(x).reshape(REPLICAS, N, dimension)
    # All are pushed to 1 + GAP, and taken as apart from half of the gap on.
    assert all(closest(box, side) >= 1 + GAP / 2 for box in boxes)
    assert np.max(np.abs(boxes[0] - boxes[1])) > 1
    np.testing.assert_array_equal(place(jax.random.key(1), side)[0], x)


def test_dilute_spheres_stay_where_they_are_put():
    # Pushes move few: most places are the uniform ones that the host begins with, too.
    side = side_of(0.02, 3)
    x, _ = in_a_box(jax.random.key(1), side)
    places = side * uniform_points(jax.random.key(1), REPLICAS * N, 3)
    assert np.mean(np.all(np.abs(x - places) < 1e-12, axis=1)) > 0.7


def test_spheres_stay_within_their_room():
    side, region = 8.0, jnp.array([3.0, 4.0, 5.5])
    x, fault = relaxed_positions(jax.random.key(0), side, (1, 50, 3), 0.4, (1000, 60), region)
    assert fault == status.OK and np.all((x >= 0) & (x <= region[None]))
    assert closest(np.asarray(x), side, periodic=False) >= 1 + GAP / 2


def test_where_there_is_no_room_or_the_list_is_full_the_status_says_so(monkeypatch):
    monkeypatch.setattr("jaxgran.particles.setup.MAX_PUSHES", 50)
    _, fault = relaxed_positions(jax.random.key(0), side_of(0.8, 3), (1, N, 3), 0.3, (2000, 60))
    assert fault == status.OVERLAPS_REMAIN.bit
    _, fault = relaxed_positions(jax.random.key(0), side_of(0.4, 3), (1, N, 3), 0.3, (20, 60))
    assert fault == status.LIST_FULL.bit
    x, fault = relaxed_positions(jax.random.key(0), 1.0, (1, N, 3), 0.3, (20, 60), None, 1024)
    assert fault == 1024 and np.all(np.isfinite(x))


def test_one_point_for_all_is_parted(monkeypatch):
    monkeypatch.setattr("jaxgran.particles.setup.uniform_points", lambda *_: jnp.ones((3, 3)))
    x, fault = relaxed_positions(jax.random.key(3), 8.0, (1, 3, 3), 0.4, (50, 3))
    assert fault == status.OK
    assert closest(np.asarray(x), 8.0) >= 1 + GAP / 2
