import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import status
from jaxgran.models import soft_spheres
from jaxgran.particles import run as compiled_programs
from jaxgran.particles.capacity import Capacity, Grid, Neighbourhood


@pytest.mark.parametrize("num_particles", [200, 2000, 20_000])
def test_the_grid_is_geometric(num_particles):
    grid = Grid.of(num_particles)
    ratio = grid.ratio
    values = np.geomspace(1e-3, 1e3, 2000)
    rounded = np.array([grid.round_up(x) for x in values])
    assert np.all(rounded >= values) and np.all(rounded <= ratio * values * (1 + 1e-9))
    steps = np.log(np.unique(rounded.round(12))) / np.log(ratio)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    np.testing.assert_allclose([grid.round_up(x) for x in rounded], rounded, rtol=1e-9)


def test_a_capacity_grows_where_it_must():
    capacity = Capacity(pairs=100, lookahead=10, near=50, contacts=20, members=20)
    needed = jnp.array([80, 30, 50, 10, 21], jnp.int32)
    fault = capacity.exceeded_by(needed)
    assert status.has(fault, status.LIST_FULL) and status.has(fault, status.CONTACTS_FULL)
    grown = capacity.grown([int(x) for x in needed])
    assert grown.pairs == 100 and grown.near == 50 and grown.contacts == 20
    assert grown.lookahead > 30 and grown.members > 21
    assert grown.exceeded_by(needed) == status.OK


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_neighbourhood_is_that_of_the_gas(beads, dimension):
    gas = beads(packing_fraction=0.1, dimension=dimension)
    side = float(gas.box_side(1000) / gas.diameter)
    around = Neighbourhood.of(side, 1000, 1, dimension, listed_more=3.0)
    rate = float(gas.collision_frequency * gas.diameter / jnp.sqrt(gas.temperature))
    # The density is rounded up by 20 % at most; the pair correlation and the rate follow it.
    for rounded, exact in (
        (around.in_contact, 0.1 * 2 ** (dimension - 1)),
        (around.collision_frequency, rate),
        (around.contact_value, float(gas.contact_value)),
    ):
        assert exact * (1 - 1e-9) <= rounded < 1.5 * exact
    assert around.listed == pytest.approx(around.in_contact + 3.0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [jaxgran.SoftSpheres, jaxgran.HardSpheres])
def test_thirty_densities_share_four_programs(beads, kind):
    compiled = []

    def count(event, duration, **_):
        if event.endswith("backend_compile_duration"):
            compiled.append(duration)

    jax.monitoring.register_event_duration_secs_listener(count)
    before, arrays = len(compiled_programs._PROGRAMS), []
    try:
        for phi in np.linspace(0.05, 0.10, 30):
            gas = beads(packing_fraction=phi)
            jaxgran.cool(gas, [0.02 * float(gas.mean_free_time)], model=kind(200))
            gc.collect()
            arrays.append((len(compiled), sum(x.nbytes for x in jax.live_arrays())))
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    programs = len(compiled_programs._PROGRAMS) - before
    print(f"\n{kind.__name__}: {programs} programs, {len(compiled)} compilations in all")
    assert programs <= 4
    # Beside these, small functions are compiled for the first gas only.
    assert arrays[-1][0] - arrays[0][0] < 8
    assert arrays[-1][1] <= arrays[0][1] + 100_000


@pytest.mark.parametrize("kind", [jaxgran.SoftSpheres, jaxgran.HardSpheres])
def test_a_loop_over_the_material_shares_programs(beads, kind):
    model = kind(200)

    def plans(name, values):
        gas = beads(packing_fraction=0.2)
        scenes = [model.scene(gas.replace(**{name: value})) for value in values]
        return {model.planned(scene, 3) for scene in scenes}

    assert len(plans("dissipative_constant", np.geomspace(1e-7, 1e-5, 30))) == 1
    # Contact durations within a factor of 2.5: 4 points of the grid of capacities, 6 of blocks.
    assert len(plans("youngs_modulus", np.geomspace(1e6, 1e7, 30))) <= 4 + 6


@pytest.mark.parametrize("duration", np.geomspace(1e-3, 0.1, 7))
def test_a_block_is_no_longer_than_a_contact_or_a_flight(duration):
    # In a block the fastest sphere flies BLOCK_FLIGHT at most, unless a block has its least steps.
    steps = jaxgran.SoftSpheres(200)._steps_per_block(duration)
    longest = min(40.0, 40 * soft_spheres.BLOCK_FLIGHT / (soft_spheres.MAX_SPEED * duration))
    assert 8 <= steps <= max(round(longest), 8)
    assert steps >= min(longest / soft_spheres.BLOCK_LENGTHS.ratio - 0.5, 40)  # 0.5 by rounding


def test_compiled_runs_of_few_hard_spheres_have_room(beads):
    # Windows of 8 impacts scatter in length: of 60 keys 3 needed more pairs than they had.
    gas = beads(packing_fraction=0.05, youngs_modulus=5e5)
    model = jaxgran.HardSpheres(50).sized_for(gas)
    times = 0.5 * gas.mean_free_time[None]
    run = jax.jit(jax.vmap(lambda key: jaxgran.cool(gas, times, model=model, key=key).status))
    assert not np.any(run(jax.random.split(jax.random.key(0), 60)))
