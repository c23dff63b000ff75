import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_neighbourhood_is_that_of_the_gas(beads, dimension):
    gas = beads(packing_fraction=0.1, dimension=dimension)
    model = jaxgran.SoftSpheres(1000)
    around = model.neighbourhood(model.scene(gas), dimension)
    rate = float(gas.collision_frequency * gas.diameter / jnp.sqrt(gas.temperature))
    # The density is rounded up by 20 % at most; the pair correlation and the rate follow it.
    for rounded, exact in (
        (around.in_contact, 0.1 * 2 ** (dimension - 1)),
        (around.collision_frequency, rate),
        (around.contact_value, float(gas.contact_value)),
    ):
        assert exact * (1 - 1e-9) <= rounded < 1.5 * exact
    assert around.listed == pytest.approx(around.in_contact + model.listed_by_skin)


@pytest.mark.slow
def test_compiled_runs_of_few_hard_spheres_have_room(beads):
    # Windows of 8 impacts scatter in length: of 60 keys 3 needed more pairs than they had.
    gas = beads(packing_fraction=0.05, youngs_modulus=5e5)
    model = jaxgran.HardSpheres(50).sized_for(gas)
    times = 0.5 * gas.mean_free_time[None]
    run = jax.jit(jax.vmap(lambda key: jaxgran.cool(gas, times, model=model, key=key).status))
    assert not np.any(run(jax.random.split(jax.random.key(0), 60)))
