"""Functions of the particles during a run: `cool(save=...)`."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import observables

HARD = jaxgran.HardSpheres(100, replicas=2)
STOCHASTIC = jaxgran.DSMC(100, replicas=2)


def save(particles):
    assert particles.velocity.shape == (100, 3)
    k, S = observables.structure_factor(particles.position, particles.box_side, 2)
    v = particles.velocity
    return {"T": observables.temperature(v), "forward": jnp.sum(v[:, 0] > 0), "S": (k, S)}


@pytest.fixture
def gas(beads):
    return beads(0.15)


def times(gas):
    return gas.mean_free_time * jnp.array([0.0, 1.0, 3.0])


@pytest.mark.slow
def test_is_of_the_particles_at_each_time(gas):
    curve = jaxgran.cool(gas, times(gas), model=HARD, save=save, progress=False)
    plain = jaxgran.cool(gas, times(gas), model=HARD, progress=False)
    for name in ("temperature", "sonine", "collisions", "displacement", "status"):
        np.testing.assert_array_equal(getattr(curve, name), getattr(plain, name))
    # Round-off of the units; each replica is at rest.
    np.testing.assert_allclose(curve.saved["T"], curve.temperature, rtol=1e-10)
    np.testing.assert_allclose(curve.saved_error["T"][1:], curve.temperature_error[1:], rtol=1e-8)
    np.testing.assert_allclose(curve.replicas.saved["T"], curve.replicas.temperature, rtol=1e-10)
    forward = curve.replicas.saved["forward"]
    assert forward.shape == (2, 3) and jnp.issubdtype(forward.dtype, jnp.integer)
    np.testing.assert_allclose(curve.saved["forward"], jnp.mean(forward, axis=0))
    k, S = curve.saved["S"]
    first = 2 * np.pi / gas.box_side(100)
    np.testing.assert_allclose(k, first * np.sqrt([[1.0, 2.0]] * 3), rtol=1e-12)
    last = curve.particles
    own = [observables.structure_factor(x, last.box_side, 2)[1] for x in last.position]
    np.testing.assert_allclose(curve.replicas.saved["S"][1][:, -1], own, rtol=1e-10)


@pytest.mark.slow
def test_spins_of_rough_spheres(gas):
    surface = jaxgran.Rough(tangential_restitution=-0.5, rotational_temperature=0.002)
    rough = dataclasses.replace(gas, surface=surface)

    def rotation(particles):
        inertia = 0.4 * (gas.diameter / 2) ** 2  # over the mass
        return inertia * jnp.mean(particles.angular_velocity**2)

    for model in (HARD, STOCHASTIC):
        curve = jaxgran.cool(rough, times(gas), model=model, save=rotation, progress=False)
        np.testing.assert_allclose(curve.saved, curve.rotational_temperature, rtol=1e-10)


def test_a_file_keeps_what_was_saved(gas, tmp_path):
    curve = jaxgran.cool(gas, times(gas), model=STOCHASTIC, save=save, progress=False)
    jaxgran.write_curve(tmp_path / "curve.npz", curve, {})
    same, _ = jaxgran.read_curve(tmp_path / "curve.npz")
    assert jax.tree.structure(same) == jax.tree.structure(curve)
    jax.tree.map(np.testing.assert_array_equal, same, curve)
    whole = jaxgran.Particles(*(jnp.ones((3, 2, 9, 3)) for _ in range(2)), 2 * jnp.ones(3))
    jaxgran.write_curve(tmp_path / "particles.npz", dataclasses.replace(curve, saved=whole), {})
    same, _ = jaxgran.read_curve(tmp_path / "particles.npz")
    assert isinstance(same.saved, jaxgran.Particles)
    np.testing.assert_array_equal(same.saved.velocity, whole.velocity)
