import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgran.particles.observables import sonine, temperature
from jaxgran.particles.setup import (
    _push_apart,
    host_positions,
    maxwellian_velocities,
)

BALL = {2: np.pi / 4, 3: np.pi / 6}


def box_side(packing, n, dimension):
    return (n * BALL[dimension] / packing) ** (1 / dimension)


def smallest_distance(x, side):
    apart = x[:, None] - x[None]
    apart = apart - side * np.round(apart / side)
    return np.sqrt(np.min(np.sum(apart**2, axis=-1) + np.diag(np.full(len(x), np.inf))))


@pytest.mark.parametrize("dimension, packing", [(3, 0.1), (3, 0.45), (2, 0.6)])
def test_spheres_do_not_overlap(dimension, packing):
    n, replicas = 500, 2
    side = box_side(packing, n, dimension)
    x = np.asarray(host_positions(jax.random.key(1), side, replicas, n, dimension))
    assert x.shape == (replicas * n, dimension)
    assert np.all(x >= 0) and np.all(x < side)
    boxes = x.reshape(replicas, n, dimension)
    assert all(smallest_distance(box, side) > 1 for box in boxes)
    assert not np.any(boxes[0] == boxes[1])


def test_dilute_positions_fill_the_box_evenly():
    n, side = 4000, 60.0
    x = np.asarray(host_positions(jax.random.key(3), side, 1, n, 3))
    counts = np.histogramdd(x, bins=3 * [np.linspace(0, side, 4)])[0]
    # 27 cells; chi^2 of independent points is 26 +- 7, of spheres slightly less.
    assert np.sum((counts - n / 27) ** 2) / (n / 27) < 26 + 5 * 7


def test_two_spheres_in_the_smallest_box():
    x = np.asarray(host_positions(jax.random.key(5), 2.0, 20, 2, 3))
    assert np.all(x >= 0) and np.all(x < 2.0)
    assert all(smallest_distance(pair, 2.0) > 1 for pair in x.reshape(20, 2, 3))


def test_coincident_points_are_parted():
    x = _push_apart(np.full((3, 3), 4.0), 8.0, None)
    assert smallest_distance(x, 8.0) > 1


@pytest.mark.parametrize("dimension, packing", [(3, 0.8), (2, 0.95)])
def test_too_dense_is_refused(dimension, packing, monkeypatch):
    monkeypatch.setattr("jaxgran.particles.setup.MAX_PUSHES", 50)
    uniform, side = (
        np.random.default_rng(0).random((60, dimension)),
        box_side(packing, 60, dimension),
    )
    with pytest.raises(RuntimeError, match="60 spheres .* after 50 pushes. Lower the packing"):
        _push_apart(side * uniform, side, None)


@pytest.mark.parametrize("dimension", [2, 3])
def test_velocities_are_maxwellian(dimension):
    n, replicas = 5000, 20
    v = maxwellian_velocities(jax.random.key(6), replicas, n, dimension)
    assert v.shape == (replicas * n, dimension)
    boxes = v.reshape(replicas, n, dimension)
    np.testing.assert_allclose(jnp.mean(boxes, axis=1), 0.0, atol=1e-15)  # round-off
    np.testing.assert_allclose(temperature(boxes), 1.0, rtol=1e-14)  # round-off
    # a_2 of n scatters by sqrt(8 / (d (d + 2) n)), here over 20 boxes; it is low by some 1/n.
    error = np.sqrt(8 / (dimension * (dimension + 2) * n * replicas))
    assert abs(np.mean(sonine(boxes))) < 4 * error + 2 / n
    covariance = jnp.einsum("pa,pb->ab", v, v) / len(v)
    # The same for products of two components.
    np.testing.assert_allclose(covariance, np.eye(dimension), atol=5 / np.sqrt(len(v)))


@pytest.mark.parametrize("n", [-1, 0, 1])
def test_too_few_particles_are_refused(n):
    with pytest.raises(ValueError, match=f"num_particles must be at least 2, got {n}"):
        maxwellian_velocities(jax.random.key(0), 1, n, 3)
