"""Random starts: places without overlap, the same on the host and in compiled code."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import explain_status
from jaxgran.particles import start
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.start import Placement
from tests.beads import glass_beads, hard_gas, least_distance, soft_beads

N, REPLICAS, KEY = 60, 2, jax.random.key(1)
CLOSEST = 1 + 0.5e-3
"""Overlapping spheres are pushed to 1 + 1e-3 diameters; those farther apart than this are not."""


def side_of(packing, dimension):
    spheres = N * {2: np.pi / 4, 3: np.pi / 6}[dimension]
    return float((spheres / packing) ** (1 / dimension))


@jax.jit
def first(placement, key):
    return placement.initial(key)


@jax.jit
def pushed(placement, state):
    until = jnp.zeros(())
    return jax.lax.while_loop(
        lambda state: placement.unfinished(state, until),
        lambda state: placement.advance(state, until),
        state,
    )


def placed(side, shape=(REPLICAS, N, 3), region=None, pairs=1000, engine="sweep", skin=0.4):
    """The first and the last state of a placement."""
    skin = min(skin, 0.499 * side - 1)
    capacity = Capacity(pairs, 2 * N, 0, 0, 0)
    placement = Placement(jnp.asarray(side), region, jnp.asarray(skin), shape, capacity, engine)
    state = first(placement, KEY)
    return state, pushed(placement, state)


@pytest.mark.slow
@pytest.mark.parametrize("dimension, packing", [(3, 0.02), (3, 0.47), (2, 0.64)])
def test_no_spheres_overlap_and_boxes_differ(dimension, packing):
    side, shape = side_of(packing, dimension), (REPLICAS, N, dimension)
    _, state = placed(side, shape)
    x = np.asarray(state.position)
    assert int(state.status) == 0
    assert x.shape == (REPLICAS * N, dimension) and np.all((x >= 0) & (x < side))
    boxes = x.reshape(shape)
    assert all(least_distance(box, side) >= CLOSEST for box in boxes)
    assert np.max(np.abs(boxes[0] - boxes[1])) > 1
    # Whoever finds the pairs, and however long the lists are and live.
    for options in ({"engine": "cells"}, {"pairs": 1300}, {"skin": 0.3}):
        np.testing.assert_allclose(placed(side, shape, **options)[1].position, x, atol=1e-9)


def test_dilute_spheres_stay_at_their_uniform_points():
    before, after = placed(side_of(0.02, 3))
    moved = np.abs(np.asarray(after.position - before.position))
    assert np.mean(np.all(moved < 1e-12, axis=1)) > 0.7


def test_spheres_stay_within_their_room():
    side, region = 8.0, jnp.array([3.0, 4.0, 5.5])
    x = np.asarray(placed(side, (1, 50, 3), region)[1].position)
    assert np.all((x >= 0) & (x <= region[None]))
    assert least_distance(x, 1e6) >= CLOSEST


def test_two_spheres_in_the_smallest_box():
    x = np.asarray(placed(2.1, (20, 2, 3))[1].position)
    assert np.all((x >= 0) & (x < 2.1))
    assert all(least_distance(pair, 2.1) > 1 for pair in x.reshape(20, 2, 3))


def test_one_point_for_all_is_parted():
    capacity = Capacity(10, 10, 0, 0, 0)
    placement = Placement(jnp.asarray(8.0), None, jnp.asarray(0.4), (1, 3, 3), capacity, "sweep")
    state = first(placement, KEY)
    state = pushed(placement, state._replace(position=jnp.ones((3, 3))))
    assert least_distance(np.asarray(state.position), 8.0) >= CLOSEST


@pytest.mark.slow
def test_where_there_is_no_room_or_the_list_is_full_it_says_so(monkeypatch):
    monkeypatch.setattr(start, "MAX_PUSHES", 50)
    jax.clear_caches()
    for dimension, packing in ((3, 0.8), (2, 0.95)):
        _, state = placed(side_of(packing, dimension), (1, N, dimension), pairs=2000)
        assert "still overlap" in explain_status(state.status)
    # All pairs are within the cutoff, 3540, and there is room for 1000.
    _, state = placed(3.0)
    assert "the neighbour list is full" in explain_status(state.status)
    assert np.all(np.isfinite(state.position))
    jax.clear_caches()


@pytest.mark.slow
@pytest.mark.parametrize(
    "gas, kind",
    [
        (hard_gas(0.8, 0.2), jaxgran.HardSpheres),
        (soft_beads(0.02, 0.15, packing_fraction=0.2), jaxgran.SoftSpheres),
        (glass_beads(), jaxgran.DSMC),
    ],
)
def test_a_key_gives_the_same_particles_inside_and_outside_of_jit(gas, kind):
    model = kind(N, replicas=REPLICAS)
    sized = model.sized_for(gas)

    def particles(key, model=model):
        return jaxgran.cool(gas, [0.0], model=model, key=key, save="particles").saved

    found = particles(KEY)
    compiled = jax.jit(lambda key: particles(key, sized))(KEY)
    heat = float(gas.temperature) ** 0.5
    # Rounding is not the same in both programs, and grows by 1.3 to 2 e-folds in each of the ten
    # collisions of the equilibration.
    np.testing.assert_allclose(found.velocity, compiled.velocity, atol=1e-5 * heat)
    other = particles(jax.random.key(2))
    assert np.mean(np.abs(found.velocity - other.velocity)) > 0.5 * heat
