"""Walls and a drive in DSMC, which act on subsets of the particles in turn."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.particles.dsmc.collisions import MIN_SUBSET_SIZE, change_subsets, num_subsets


@pytest.mark.parametrize("n", [2, 15, 31, 257, 1000, 4096])
def test_every_particle_belongs_to_one_subset(n):
    parts, sizes, one = num_subsets(n), [], jnp.ones((), int)

    def count(i, rows, belongs):
        return rows + belongs[:, None], jnp.sum(belongs)

    seen = jnp.zeros((n, 1))
    for k in range(parts):
        seen, size = change_subsets(seen, jnp.asarray(k), one, one, count, 0 * one)
        sizes.append(int(size))
    assert np.all(seen == 1)
    assert max(sizes) - min(sizes) <= 1 and min(sizes) >= min(n, MIN_SUBSET_SIZE) - 1


def elastic(strength, **elements) -> jaxgran.Gas:
    """A gas without losses, driven by so many T_0 per mean free time."""
    gas = jaxgran.Gas(
        jaxgran.ConstantRestitution(1.0),
        diameter=2e-3,
        mass=1e-5,
        packing_fraction=0.02,
        temperature=0.01,
    )
    drive = jaxgran.WhiteNoise(strength * gas.temperature / gas.mean_free_time)
    return dataclasses.replace(gas, drive=drive, **elements)


@pytest.mark.slow
def test_kicks_heat_by_the_strength_and_leave_the_gas_at_rest():
    gas = elastic(0.01)  # one subset in half a step
    times = jnp.array([1.0, 3.0, 10.0]) * gas.mean_free_time
    model = jaxgran.DSMC(20_000)
    curve = jaxgran.cool(gas, times, model=model, save="particles", progress=False)
    expected = 0.01 + gas.value("drive_strength") * times
    # The heat of 60 000 random numbers, sqrt(2/60 000), and their product with the velocities,
    # twice that: 1.3 % of what is brought, and at most of T.
    error = 3 * 0.013 * jnp.sqrt((expected - 0.01) * expected) / expected
    assert jnp.all(jnp.abs(curve.temperature / expected - 1) < error)
    # T is followed by what kicks bring, and then counted: round-off.
    velocity = curve.saved.velocity[:, 0]
    np.testing.assert_allclose(jnp.mean(velocity**2, (1, 2)), curve.temperature, rtol=1e-9)
    np.testing.assert_allclose(jnp.mean(velocity, 1), 0.0, atol=1e-12)
    # sqrt(8/(15 N)) = .005 for each, and 2e-4 by the turns.
    assert jnp.all(jnp.abs(curve.sonine) < 3 * 0.0052)
    theory = jaxgran.cool(gas, times)
    # <dr^2> of 20 000 particles scatters by sqrt(2/60 000) = .6 %; D of first order: 2 %.
    np.testing.assert_allclose(curve.displacement, theory.displacement, rtol=0.03)


@pytest.mark.slow
def test_walls_a_fraction_of_a_mean_free_path_apart_are_met_by_the_fast_spheres_too():
    # A sphere meets walls up to 9 times in a step of .1 collisions: steps are shorter here.
    gas = elastic(0.0, container=jaxgran.Walls(8e-3, restitution=0.95))
    gas = dataclasses.replace(gas, drive=None, law=jaxgran.ConstantRestitution(0.95))
    gas = gas.replace(packing_fraction=0.005)
    assert float(8e-3 / gas.mean_free_path) < 0.4
    times = jnp.array([0.5, 1.5]) * gas.mean_free_time
    curve, fine = (
        jaxgran.cool(gas, times, model=jaxgran.DSMC(20_000, step=step), progress=False)
        for step in (0.1, 0.01)
    )
    assert float(fine.temperature[-1] / gas.temperature) < 0.8
    # Impacts of 20 000 spheres on walls, some each: sqrt(1/20 000) of a loss of .2, .2 % of T.
    np.testing.assert_allclose(curve.temperature, fine.temperature, rtol=0.006)
