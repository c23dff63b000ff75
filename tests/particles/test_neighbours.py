import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import KDTree

from jaxgran.particles.neighbours.cells import expected_run, pairs_by_cells
from jaxgran.particles.neighbours.lists import (
    MAX_LOOKAHEAD,
    check_engine,
    choose_engine,
    compiled_engine,
    search_pairs,
)
from jaxgran.particles.neighbours.pairs import with_offsets
from jaxgran.particles.neighbours.sweep import pairs_by_sweep


def find_pairs(position, side, cutoff, *, replicas=1, capacity, by="cells"):
    """All pairs with their offsets; a sweep may look ahead over all particles of a replica."""
    pairs = search_pairs(
        position,
        side,
        cutoff,
        replicas=replicas,
        capacity=capacity,
        ahead=len(position) // replicas,
        engine=by,
    )
    return with_offsets(position, side, pairs)


def brute_force(position, side, cutoff, replicas):
    """Shortest x_i - x_j of every pair i < j closer than the cutoff."""
    i, j = np.triu_indices(len(position), 1)
    apart = position[i] - position[j]
    apart -= side * np.round(apart / side)
    n = len(position) // replicas
    near = (i // n == j // n) & (np.linalg.norm(apart, axis=1) < cutoff)
    return dict(zip(zip(i[near].tolist(), j[near].tolist(), strict=True), apart[near], strict=True))


def listed(i, j, count):
    return list(zip(i[:count].tolist(), j[:count].tolist(), strict=True))


def awkward(dimension, replicas, side, n=30):
    """Random points, points on faces and corners of the box, and points on top of each other."""
    rng = np.random.default_rng(dimension)
    last = np.nextafter(side, 0)
    boxes = side * rng.random((replicas, n, dimension))
    corners = np.array(list(itertools.product([0.0, last], repeat=dimension)))
    boxes[:, : len(corners)] = corners
    boxes[:, 10, 0], boxes[:, 11, 0], boxes[:, 12, -1], boxes[:, 13, -1] = 0.0, last, 0.0, last
    boxes[:, 15] = boxes[:, 14]
    boxes[:, 17:19] = 0.0
    return boxes.reshape(-1, dimension)


@pytest.mark.filterwarnings("ignore:scatter inputs have incompatible types")  # of jax-md's integers
@pytest.mark.parametrize(
    "dimension, by, fraction",
    [
        *((d, "cells", fraction) for d in (2, 3) for fraction in (0.15, 0.3, 0.4999, 0.5)),
        *((d, "sweep", 0.5) for d in (2, 3)),
        *(pytest.param(d, "jax-md", 0.15, marks=pytest.mark.slow) for d in (2, 3)),
    ],
)
def test_pairs_are_those_of_brute_force(dimension, by, fraction):
    side, replicas, cutoff = 3.7, 2, 3.7 * fraction
    position = awkward(dimension, replicas, side)
    expected = brute_force(position, side, cutoff, replicas)
    capacity = len(expected) + 7
    search = partial(find_pairs, replicas=replicas, capacity=capacity, by=by)
    pairs = search(jnp.asarray(position), side, cutoff)
    found = listed(pairs.i, pairs.j, int(pairs.count))
    assert int(pairs.count) == len(expected)  # each once
    assert set(found) == set(expected)  # and with i < j
    assert pairs.i.dtype == pairs.j.dtype == jnp.int32 and pairs.i.shape == (capacity,)
    assert not np.any(pairs.i[-7:]) and not np.any(pairs.j[-7:])
    offset = np.asarray(pairs.offset)[: len(found)]
    np.testing.assert_array_equal(offset, side * np.round(offset / side))
    i, j = np.array(found).T
    # Not component by component, as half a box has two shortest ways. Round-off of the side.
    np.testing.assert_allclose(
        np.linalg.norm(position[i] - position[j] - offset, axis=1),
        [np.linalg.norm(expected[pair]) for pair in found],
        atol=1e-14 * side,
    )


@pytest.mark.slow
@pytest.mark.parametrize("dimension, by", [(2, "cells"), (3, "cells"), (3, "sweep")])
def test_jit_and_vmap(dimension, by):
    rng = np.random.default_rng(3)
    batch = jnp.asarray(rng.random((3, 40, dimension)))
    search = partial(find_pairs, replicas=2, capacity=120, by=by)
    sides = jnp.array([1.0, 2.0, 4.0])
    scaled = batch * sides[:, None, None]
    together = jax.jit(jax.vmap(search))(scaled, sides, 0.2 * sides)
    for k in range(3):
        alone = search(scaled[k], sides[k], 0.2 * sides[k])
        assert 0 < alone.count <= 120
        for all_three, one in zip(together, alone, strict=True):
            np.testing.assert_array_equal(all_three[k], one)


def test_pairs_carry_no_derivatives():
    position = jnp.array([[0.1, 2.0], [3.9, 2.5], [2.0, 2.0]])

    def square(position):
        pairs = find_pairs(position, 4.0, 1.0, capacity=1)
        return jnp.sum((position[pairs.i] - position[pairs.j] - pairs.offset) ** 2)

    for gradient in (jax.grad(square)(position), jax.jit(jax.grad(square))(position)):
        # d/dx of 0.2^2 + 0.5^2, rounded.
        np.testing.assert_allclose(gradient, [[0.4, -1.0], [-0.4, 1.0], [0.0, 0.0]], atol=1e-14)


@pytest.mark.parametrize("by", ["cells", "sweep"])
def test_numbers_that_are_not_finite_have_no_pairs(by):
    for bad in (jnp.nan, jnp.inf):
        position = jnp.ones((4, 3)).at[2, 1].set(bad)
        assert find_pairs(position, 4.0, 1.0, capacity=3, by=by).count == 0


def test_engine_follows_the_device_and_the_gas(monkeypatch):
    with pytest.raises(ValueError, match="auto, sweep, cells, jax-md, got 'scipy'"):
        check_engine("scipy")
    assert compiled_engine("cells", 1.0) == "cells" and compiled_engine("sweep", 1e6) == "sweep"
    for name in ("auto", "jax-md"):
        assert compiled_engine(name, float(MAX_LOOKAHEAD)) == "sweep"
        assert compiled_engine(name, MAX_LOOKAHEAD + 1.0) == "cells"
    for device, auto in (("cpu", "cells"), ("gpu", "jax-md")):
        monkeypatch.setattr(jax, "default_backend", lambda device=device: device)
        assert choose_engine("auto", "cells", traced=False) == auto
        assert choose_engine("auto", "cells", traced=True) == "cells"
        assert choose_engine("sweep", "sweep", traced=False) == "sweep"
        assert choose_engine("jax-md", "sweep", traced=False) == "jax-md"


def tree_pairs(boxes, side, cutoff):
    """The pairs of a k-d tree in each of several periodic boxes."""
    boxes = np.asarray(boxes, float)
    n = boxes.shape[1]
    trees = [KDTree(box, boxsize=side).query_pairs(cutoff) for box in boxes]
    return {(i + n * k, j + n * k) for k, tree in enumerate(trees) for i, j in tree}


def gases(side, dimension, n=300):
    """Two boxes of points that are distributed in several ways, by name."""
    rng = np.random.default_rng(dimension)
    gas = side * rng.random((2, n, dimension))
    clusters = gas[:, ::30].repeat(30, axis=1) + rng.normal(size=gas.shape)
    flat, long = gas.copy(), gas.copy()
    flat[..., 0] = 0.1 * gas[..., 0] + 0.97 * side  # across the boundary of the box
    long[..., :-1] = 0.05 * gas[..., :-1]
    sites = int(np.ceil(n ** (1 / dimension)))
    lattice = np.stack(np.meshgrid(*[np.arange(sites)] * dimension), -1).reshape(-1, dimension)
    lattice = np.stack([side / sites * lattice[:n]] * 2)
    different = np.stack([gas[0], clusters[0]])
    named = {"gas": gas, "clusters": clusters, "flat": flat, "long": long, "one point": 0 * gas}
    named |= {"lattice": lattice, "different": different}
    return {name: np.mod(boxes, side) % side for name, boxes in named.items()}


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_cells_lose_no_pair_and_say_how_many_they_need(dimension):
    # Cells limited by the number of particles, some around the box, just three, and one.
    for side, cutoff in ((30.0, 1.01), (14.0, 3.1), (10.0, 3.1), (10.0, 3.6), (10.0, 5.0)):
        for name, boxes in gases(side, dimension).items():
            least, largest = (tree_pairs(boxes, side, r) for r in (cutoff, cutoff + 1e-6 * side))
            n = boxes.shape[1]
            flat = jnp.asarray(boxes.reshape(-1, dimension))
            search = partial(pairs_by_cells, flat, side, cutoff, replicas=2, capacity=n * n)
            i, j, count, longest = search(ahead=n)
            found = listed(i, j, count)
            assert len(set(found)) == len(found), (name, side)  # each once
            assert least <= set(found) <= largest, (name, side)
            assert 0 <= longest < n and not np.any(i[count:]) and not np.any(j[count:])
            *_, short_count, told = search(ahead=32)
            assert told == longest and (short_count == count or longest > 32), (name, side)
            assert short_count < count or name != "one point"
            if name == "gas":
                mean = expected_run(n, cutoff / side, dimension)
                assert longest < mean + 6 * mean**0.5  # fluctuations of 600 particles


@pytest.mark.slow
def test_cells_count_pairs_beyond_their_capacity():
    position = jnp.asarray(10 * np.random.default_rng(1).random((300, 3)))
    *_, count, _ = pairs_by_cells(position, 10.0, 2.0, replicas=1, capacity=4000, ahead=300)
    i, j, told, _ = pairs_by_cells(position, 10.0, 2.0, replicas=1, capacity=100, ahead=300)
    assert told == count > 100
    assert np.all(np.asarray(i) < np.asarray(j))  # all of them pairs


@pytest.mark.slow
def test_a_sweep_looks_as_far_as_it_must():
    # A gas, the same gas squeezed into a slab, and all of it in one plane across the sweep.
    rng = np.random.default_rng(6)
    side, n = 10.0, 1000
    gas = side * rng.random((2, n, 3))
    for squeezed, crowd in ((1.0, 1), (0.1, 10), (0.0, n)):
        position = gas * np.array([squeezed, 1.0, 1.0])
        expected = tree_pairs(position, side, 1.0)
        flat = jnp.asarray(position.reshape(-1, 3))
        look = partial(pairs_by_sweep, flat, side, 1.0, replicas=2, capacity=len(expected) + 9)
        i, j, count, ahead = look(ahead=n)
        found = listed(i, j, count)
        assert set(found) == expected and len(found) == len(expected)
        # Within .1 of the box, evenly: 100, and up to five standard errors more.
        assert min(100 * crowd, n - 1) <= ahead <= min(150 * crowd + 32, n - 1)
        *_, short_count, told = look(ahead=int(ahead) // 2)
        assert told == ahead and short_count < count
        *_, enough, told = look(ahead=int(ahead))
        assert told == ahead and enough == count


@pytest.mark.slow
@pytest.mark.parametrize("search", [pairs_by_sweep, pairs_by_cells])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_pair_just_within_the_cutoff_is_missed(dtype, search):
    # Far apart, so that a whole number of steps of the side is many of the cutoff's round-off.
    rng = np.random.default_rng(8)
    side, n, cutoff = 1000.0, 20_000, 0.5
    first = side * rng.random((n, 3))
    way = rng.normal(size=(n, 3))
    second = first + cutoff * way / np.linalg.norm(way, axis=1)[:, None]
    position = (np.concatenate([first, second]) % side).astype(dtype)
    position = np.where(position >= side, dtype(0), position)
    apart = position[:n].astype(float) - position[n:]
    apart -= side * np.round(apart / side)
    within = np.flatnonzero(np.sum(apart**2, axis=1) < cutoff**2)
    assert 0.3 * n < len(within) < 0.7 * n
    look = partial(search, replicas=1, capacity=3 * n, ahead=200)
    found = set(listed(*look(jnp.asarray(position), side, cutoff)[:3]))
    assert {(k, k + n) for k in within.tolist()} <= found
    # As documented: 1e-6 of the cutoff and of the side.
    tree = KDTree(position.astype(float), boxsize=side)
    assert tree.query_pairs(cutoff) <= found <= tree.query_pairs(cutoff + 1e-6 * (cutoff + side))


@pytest.mark.parametrize(
    "search, name, possible", [(pairs_by_sweep, "sweep", 992), (pairs_by_cells, "cells", 192)]
)
def test_a_search_over_too_many_is_refused(search, name, possible):
    position = jax.ShapeDtypeStruct((2**26, 3), jnp.float32)
    look = partial(search, side=1000.0, cutoff=1.0, replicas=1, capacity=9, ahead=2**10)
    message = f"{name}.*1024.* allow {possible}"
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(look, position)
