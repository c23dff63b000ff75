import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import status
from jaxgran.particles.capacity import Capacity, Neighbourhood


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


def test_compiled_runs_of_few_hard_spheres_have_room(beads):
    # Windows of 8 impacts scatter in length: of 60 keys 3 needed more pairs than they had.
    gas = beads(packing_fraction=0.05, youngs_modulus=5e5)
    model = jaxgran.HardSpheres(50).sized_for(gas)
    times = 0.5 * gas.mean_free_time[None]
    run = jax.jit(jax.vmap(lambda key: jaxgran.cool(gas, times, model=model, key=key).status))
    assert not np.any(run(jax.random.split(jax.random.key(0), 60)))
