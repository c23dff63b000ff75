"""The layer before walls that take energy, beside hard spheres in a container."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads

N = 500


@pytest.mark.slow
def test_walls_take_from_elastic_spheres_what_theory_says():
    phi, eps = 0.02, 0.6
    # Haff's law: T^(-1/2) grows linearly. The slope after the first sound times, to 1/5 of T^(1/2).
    gas = glass_beads(packing_fraction=phi)
    walls = jaxgran.Walls(gas.box_side(N), restitution=eps)
    gas = dataclasses.replace(gas, law=jaxgran.ConstantRestitution(1.0), container=walls)
    theory = jaxgran.cool(gas, jnp.array([20.0]) * gas.mean_free_time)
    rate = ((theory.temperature[0] / gas.temperature) ** -0.5 - 1) / theory.times[0]
    times = jnp.array([0.5, 1.0, 2.5, 4.0]) / rate
    hard = jaxgran.cool(gas, times, model=jaxgran.HardSpheres(N, replicas=8))
    slopes = np.diff((hard.temperature / gas.temperature) ** -0.5) / np.diff(times * rate)
    # Four standard errors of a slope, .8 sqrt(2/(N replicas)), and error_model.WALL_ERROR.
    assert np.all(np.abs(slopes - 1) < 4 * 0.8 * (2 / (N * 8)) ** 0.5 + 0.04), slopes
