"""The kicks of driven hard spheres, and their heat."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.hard.drive import (
    heat_of_kicks,
    kick_at_end,
    kick_at_start,
    window_of_small_kicks,
)
from jaxgran.particles.spheres import temperature
from tests.beads import hard_gas, lattice

N = 1000
STRENGTH = 0.3
TIME = 0.5
DURATION = 0.02


def driven(strength=STRENGTH, drag_rate=0.0):
    """The scene of a gas with a drive and drag, and two replicas of it at a time."""
    elements = {"drive": jaxgran.WhiteNoise(strength), "drag": jaxgran.StokesDrag(drag_rate)}
    gas = dataclasses.replace(hard_gas(0.9, 0.05), **elements)
    model = jaxgran.HardSpheres(N, replicas=2)
    scene = model.scene(gas)
    start = lattice(gas, N, replicas=2)
    given = start.position.reshape(-1, 3), start.velocity.reshape(-1, 3)
    state = model.dynamics(scene, 3, 2).initial(given, jax.random.key(0), None)
    return scene, state._replace(time=jnp.array(TIME))


def directions_like(material):
    """One direction in a material: its drive in proportion."""
    direction = jax.tree.map(jnp.zeros_like, material)._replace(drive=material.drive)
    return jax.tree.map(lambda x: x[None], direction)


@pytest.mark.parametrize("drag_rate", [0.0, 0.4])
def test_each_half_of_the_kicks_heats_as_much_as_it_should(drag_rate):
    scene, state = driven(drag_rate=drag_rate)
    kicked = kick_at_start(state, scene, DURATION)
    twice = kick_at_end(kicked, scene, DURATION)
    first = kicked.velocity - state.velocity
    second = twice.velocity - kicked.velocity
    assert int(twice.internal.key[2]) == 2
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.05
    # Drag has left 1 - gamma s of velocities, and makes the true duration longer by as much.
    variance = STRENGTH * DURATION / (1 - drag_rate * TIME) / 2
    of_first = variance / (1 - drag_rate * TIME) ** 2
    of_second = variance / (1 - drag_rate * (TIME + DURATION)) ** 2
    # Three standard errors of 6000 components.
    np.testing.assert_allclose(np.var(first), of_first, rtol=0.055)
    np.testing.assert_allclose(np.var(second), of_second, rtol=0.055)
    heat, slopes = heat_of_kicks(state, scene, DURATION, directions_like(scene.material))
    # The true duration has terms of higher order in DURATION.
    np.testing.assert_allclose(heat, 3 * N / 2 * (of_first + of_second), rtol=0.01)
    np.testing.assert_allclose(slopes, [heat], rtol=1e-12)


def test_a_window_is_as_short_as_the_coldest_replica_needs():
    scene, state = driven()
    cold = state._replace(velocity=state.velocity.at[:N].multiply(0.5))
    coldest = temperature(cold.velocity, 2)[0]
    np.testing.assert_allclose(window_of_small_kicks(cold, scene) * STRENGTH, 0.05 * coldest)


def test_where_nothing_is_kicked_windows_have_no_limit():
    weakest, state = driven(strength=0.0)
    without = weakest._replace(material=weakest.material._replace(drive=None))
    for scene in (weakest, without):
        assert window_of_small_kicks(state, scene) == np.inf
        np.testing.assert_array_equal(kick_at_end(state, scene, DURATION).velocity, state.velocity)
