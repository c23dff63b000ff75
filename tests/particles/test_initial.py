"""Random starts: places on the host and in compiled code."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran import explain_status
from jaxgran.particles import setup
from tests.beads import least_distance

N, REPLICAS, KEY = 60, 2, jax.random.key(1)
CLOSEST = 1 + 0.5e-3
"""Overlapping spheres are pushed to 1 + 1e-3 diameters; those farther apart than this are not."""


def side_of(packing, dimension):
    spheres = N * {2: np.pi / 4, 3: np.pi / 6}[dimension]
    return float((spheres / packing) ** (1 / dimension))


@partial(jax.jit, static_argnames=("size", "capacity"))
def relaxed(key, side, size, region=None, capacity=(1000, 120), fault=0):
    return setup.relaxed_positions(key, side, size, 0.4, capacity, region, fault)


def on_host(side, size=(REPLICAS, N, 3), region=None):
    return setup.host_positions(KEY, side, *size, region)


def compiled(side, size=(REPLICAS, N, 3), region=None):
    x, fault = relaxed(KEY, side, size, region)
    assert fault == 0
    return x


PLACES = pytest.mark.parametrize("place", [on_host, compiled])


@PLACES
@pytest.mark.parametrize("dimension, packing", [(3, 0.02), (3, 0.47), (2, 0.64)])
def test_no_spheres_overlap_and_boxes_differ(place, dimension, packing):
    side, size = side_of(packing, dimension), (REPLICAS, N, dimension)
    x = np.asarray(place(side, size))
    assert x.shape == (REPLICAS * N, dimension) and np.all((x >= 0) & (x < side))
    boxes = x.reshape(size)
    assert all(least_distance(box, side) >= CLOSEST for box in boxes)
    assert np.max(np.abs(boxes[0] - boxes[1])) > 1
    np.testing.assert_array_equal(place(side, size), x)


@PLACES
def test_dilute_spheres_stay_at_their_uniform_points(place):
    side = side_of(0.02, 3)
    moved = np.abs(np.asarray(place(side)) - side * setup.uniform_points(KEY, REPLICAS * N, 3))
    assert np.mean(np.all(moved < 1e-12, axis=1)) > 0.7


@PLACES
def test_spheres_stay_within_their_room(place):
    side, region = 8.0, jnp.array([3.0, 4.0, 5.5])
    x = np.asarray(place(side, (1, 50, 3), region))
    assert np.all((x >= 0) & (x <= region[None]))
    assert least_distance(x, 1e6) >= CLOSEST


def test_two_spheres_in_the_smallest_box():
    x = np.asarray(on_host(2.0, (20, 2, 3)))
    assert np.all((x >= 0) & (x < 2.0))
    assert all(least_distance(pair, 2.0) > 1 for pair in x.reshape(20, 2, 3))


def test_one_point_for_all_is_parted(monkeypatch):
    monkeypatch.setattr(setup, "uniform_points", lambda *_: jnp.ones((3, 3)))
    assert least_distance(np.asarray(on_host(8.0, (1, 3, 3))), 8.0) >= CLOSEST


@pytest.mark.slow
def test_where_there_is_no_room_or_the_list_is_full_it_says_so(monkeypatch):
    monkeypatch.setattr(setup, "MAX_PUSHES", 50)
    for dimension, packing in ((3, 0.8), (2, 0.95)):
        with pytest.raises(RuntimeError, match="60 spheres .* after 50 pushes. Lower the packing"):
            on_host(side_of(packing, dimension), (1, N, dimension))
    _, fault = relaxed(KEY, side_of(0.8, 3), (1, N, 3), capacity=(2000, 60))
    assert "still overlap" in explain_status(fault)
    # All pairs are within the cutoff, 3540, and there is room for 1000.
    full = partial(relaxed, KEY, 3.0, (REPLICAS, N, 3))
    assert "the neighbour list is full" in explain_status(full()[1])
    x, fault = full(fault=1024)
    assert fault == 1024 and np.all(np.isfinite(x))
