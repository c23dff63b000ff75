"""Random starts: places on the host and in compiled code, and velocities."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran import explain_status
from jaxgran import observables as obs
from jaxgran.particles import setup

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


def closest(x, side, periodic=True):
    apart = x[:, None] - x[None]
    if periodic:
        apart -= side * np.round(apart / side)
    return np.min(np.linalg.norm(apart, axis=-1) + 9.0 * np.eye(len(x)))


@PLACES
@pytest.mark.parametrize("dimension, packing", [(3, 0.02), (3, 0.47), (2, 0.64)])
def test_no_spheres_overlap_and_boxes_differ(place, dimension, packing):
    side, size = side_of(packing, dimension), (REPLICAS, N, dimension)
    x = np.asarray(place(side, size))
    assert x.shape == (REPLICAS * N, dimension) and np.all((x >= 0) & (x < side))
    boxes = x.reshape(size)
    assert all(closest(box, side) >= CLOSEST for box in boxes)
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
    assert closest(x, side, periodic=False) >= CLOSEST


def test_two_spheres_in_the_smallest_box():
    x = np.asarray(on_host(2.0, (20, 2, 3)))
    assert np.all((x >= 0) & (x < 2.0))
    assert all(closest(pair, 2.0) > 1 for pair in x.reshape(20, 2, 3))


@PLACES
def test_one_point_for_all_is_parted(place, monkeypatch):
    monkeypatch.setattr(setup, "uniform_points", lambda *_: jnp.ones((3, 3)))
    assert closest(np.asarray(place(8.0, (1, 3, 3))), 8.0) >= CLOSEST


def test_where_there_is_no_room_or_the_list_is_full_it_says_so(monkeypatch):
    monkeypatch.setattr(setup, "MAX_PUSHES", 50)
    for dimension, packing in ((3, 0.8), (2, 0.95)):
        with pytest.raises(RuntimeError, match="60 spheres .* after 50 pushes. Lower the packing"):
            on_host(side_of(packing, dimension), (1, N, dimension))
    _, fault = relaxed(KEY, side_of(0.8, 3), (1, N, 3), capacity=(2000, 60))
    assert "still overlap" in explain_status(fault)
    short = partial(relaxed, KEY, size=(1, N, 3), capacity=(20, 60))
    assert "the neighbour list is full" in explain_status(short(side_of(0.4, 3))[1])
    x, fault = short(1.0, fault=1024)
    assert fault == 1024 and np.all(np.isfinite(x))


@pytest.mark.parametrize("dimension", [2, 3])
def test_velocities_are_maxwellian(dimension):
    n, replicas = 5000, 20
    v = setup.maxwellian_velocities(jax.random.key(6), replicas, n, dimension)
    assert v.shape == (replicas * n, dimension)
    boxes = v.reshape(replicas, n, dimension)
    np.testing.assert_allclose(jnp.mean(boxes, axis=1), 0.0, atol=1e-15)  # round-off
    np.testing.assert_allclose(obs.temperature(boxes), 1.0, rtol=1e-14)  # round-off
    # a_2 of n scatters by sqrt(8 / (d (d + 2) n)), here over 20 boxes; it is low by some 1/n.
    error = np.sqrt(8 / (dimension * (dimension + 2) * n * replicas))
    assert abs(np.mean(obs.sonine(boxes))) < 4 * error + 2 / n
    covariance = jnp.einsum("pa,pb->ab", v, v) / len(v)
    # The same for products of two components.
    np.testing.assert_allclose(covariance, np.eye(dimension), atol=5 / np.sqrt(len(v)))
    with pytest.raises(ValueError, match="num_particles must be at least 2, got 1"):
        setup.maxwellian_velocities(KEY, 1, 1, dimension)
