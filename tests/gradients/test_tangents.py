"""Derivatives through particles: exact between projections, right on average across them."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import SoftSpheres
from tests.beads import lattice, soft_beads, spheres


def slope(f, at=0.0):
    return jax.jvp(f, (jnp.asarray(at),), (jnp.ones(()),))[1]


def followed(gas, position, velocity, replicas, end, interval):
    """A state in reduced units after some time, with its tangent in A."""
    model = SoftSpheres(len(position) // replicas, replicas=replicas, projection=interval)
    model = model.sized_for(gas, spare=4.0)
    scene = model.scene(gas)
    dynamics = model.dynamics(scene, gas.dimension, replicas)
    along = {"alpha": jnp.zeros(1), "dissipative_constant": jnp.ones(1)}
    law = dataclasses.replace(scene.material.law, **along)
    start = jnp.asarray(position), jnp.asarray(velocity)
    directions = scene.material._replace(law=law)
    state = dynamics.initial(start, jax.random.key(0), directions)
    advance = eqx.filter_jit(dynamics.advance)
    while dynamics.unfinished(state, jnp.asarray(end)):
        state = advance(state, end)
    assert int(state.status) == 0
    return state, scene


def pairs_that_meet(gas, angle, gaps, speed=2.0):
    """One head-on or oblique pair a replica, its gap before contact different in each."""
    side = float(gas.box_side(2) / gas.diameter)
    normal = np.array([np.cos(angle), np.sin(angle), 0.0])
    relative = -(normal[None] + np.asarray(gaps)[:, None] * np.array([[1.0, 0.0, 0.0]]))
    position = np.stack([side / 2 + relative / 2, side / 2 - relative / 2], axis=1)
    velocity = np.zeros_like(position)
    velocity[:, 0, 0], velocity[:, 1, 0] = speed / 2, -speed / 2
    return position.reshape(-1, 3), velocity.reshape(-1, 3)


def loss_slope(gas, angle, speed):
    """d ln T / d ln A of two spheres after their impact, from the law alone."""

    def temperature(log_scale):
        constant = gas.value("dissipative_constant") * jnp.exp(log_scale)
        eps = gas.replace(dissipative_constant=constant).restitution(speed * np.cos(angle))
        return jnp.log((eps * np.cos(angle)) ** 2 + np.sin(angle) ** 2)

    return float(slope(temperature))


@pytest.mark.slow
def test_one_impact_has_the_slope_of_its_law():
    beta, angle = 0.5, 1.2
    gas = soft_beads(1e-7, beta, packing_fraction=0.02)
    gaps = 1e-4 * (1 + np.arange(16) / 16)
    scene = SoftSpheres(2).scene(gas)
    position, velocity = pairs_that_meet(gas, angle, gaps)
    end = 6 * float(scene.contact_duration) / np.cos(angle) ** 0.2 + 2e-4
    # Projected many times during contact, only before and after it, and not at all.
    for interval in (1e-9, 1e-4, 1e3):
        state, scene = followed(gas, position, velocity, len(gaps), end, interval)
        assert bool(jnp.all(state.tangents.free))
        c = state.tangents.projected(state.velocity).log_temperature
        got = float(jnp.mean(c) * scene.material.law.dissipative_constant)
        speed = 2.0 * float(jnp.sqrt(gas.temperature))
        # The onset's sqrt(xi) in steps of t_c/40 leaves 1e-3 of a slope on average over its phase.
        assert got == pytest.approx(loss_slope(gas, angle, speed), rel=5e-3)


@pytest.mark.slow
def test_the_tangent_is_exact_between_projections():
    gas = soft_beads(0.05, 0.2, packing_fraction=0.15)
    times = [0.8 * float(gas.mean_free_time)]
    start = lattice(gas, 100)
    position = np.asarray(start.position[0] / gas.diameter)
    velocity = np.asarray(start.velocity[0] / jnp.sqrt(gas.temperature))
    scene = SoftSpheres(100).scene(gas)
    end = 0.8 / float(scene.collision_frequency)

    def plain(constant):
        pieces = SoftSpheres(100, start=start, projection=None)
        a = gas.value("dissipative_constant") * constant / scene.material.law.dissipative_constant
        curve = jaxgran.cool(gas.replace(dissipative_constant=a), times, model=pieces)
        return curve.particles.velocity[0] / jnp.sqrt(gas.temperature)

    exact = slope(plain, scene.material.law.dissipative_constant)
    state, _ = followed(gas, position, velocity, 1, end, 1e3)
    # Two codes for one derivative, round-off grown by the chaos of one collision time: 1e-12.
    scale = float(jnp.max(jnp.abs(exact)))
    np.testing.assert_allclose(state.tangents.velocity[0], exact, atol=1e-8 * scale)


@pytest.mark.slow
@pytest.mark.minutes
def test_touching_two_and_three_bodies_have_finite_slopes():
    gas = soft_beads(0.02, 0.2, packing_fraction=0.02)
    scene = SoftSpheres(3).scene(gas)
    side = float(scene.side)
    middle = np.full(3, side / 2)
    e = np.eye(3)
    # The middle one is exactly touched, and struck from two sides at nearly the same moment.
    position = np.stack([middle - e[0], middle, middle + e[1] * (1 + 1e-9)]) % side
    velocity = np.stack([e[0], 0 * e[0], -e[1]])
    velocity -= velocity.mean(axis=0)
    velocity *= float(gas.temperature) ** 0.5 / np.sqrt(np.mean(velocity**2))
    sigma = float(gas.diameter)
    start = spheres(position * sigma, velocity, side * sigma)
    end = float(gas.contact_duration) * 8

    def f(log_scale, interval):
        a = gas.value("dissipative_constant") * jnp.exp(log_scale)
        model = SoftSpheres(3, start=start, projection=interval, steps_per_contact=200)
        curve = jaxgran.cool(gas.replace(dissipative_constant=a), [end], model=model)
        return jnp.log(curve.temperature[0])

    plain = slope(partial(f, interval=None))
    h = 1e-3
    difference = (f(h, None) - f(-h, None)) / (2 * h)
    assert float(plain) == pytest.approx(float(difference), rel=1e-4)
    for interval in (1e-6, 0.5):
        # Three bodies are no gas: who is hit next how fast is forgotten, the loss itself is not.
        assert float(slope(partial(f, interval=interval))) == pytest.approx(float(plain), rel=0.3)
