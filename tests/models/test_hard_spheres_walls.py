"""Hard spheres in a container."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import status
from tests.beads import glass_beads

SIDE = 0.05


def contained(num_particles, walls=1.0, gas=None, diameter=2e-3, **elements) -> jaxgran.Gas:
    """A gas of N spheres in a cube of 50 mm."""
    gas = glass_beads() if gas is None else gas
    phi = num_particles * np.pi / 6 * diameter**3 / SIDE**3
    gas = gas.replace(diameter=diameter, packing_fraction=phi)
    wall_beta = elements.pop("wall_beta", None)
    walls = jaxgran.Walls(SIDE, restitution=walls, tangential_restitution=wall_beta)
    return dataclasses.replace(gas, container=walls, **elements)


def run(gas, num_particles, replicas, taus):
    times = jnp.asarray(taus) * gas.mean_free_time
    return jaxgran.cool(gas, times, model=jaxgran.HardSpheres(num_particles, replicas=replicas))


def free_flight(eps, times, speed=0.1, width=SIDE - 5e-4, num=100_000):
    """T/T_0 of particles that meet walls only, bounce after bounce."""
    rng = np.random.default_rng(0)
    first, place = np.abs(rng.normal(size=num)) * speed, rng.uniform(0, width, size=num)
    found = []
    for time in times:
        v, left, ahead = first.copy(), np.full(num, time), width - place
        while np.any(hit := (left > 0) & (ahead < v * left)):
            left = np.where(hit, left - ahead / v, 0.0)
            v, ahead = np.where(hit, eps * v, v), np.where(hit, width, ahead)
        found.append(np.mean(v**2) / speed**2)
    return np.array(found)


@pytest.mark.slow
def test_walls_alone_take_what_free_flight_says():
    # Elastic spheres with a mean free path of 20 sides: 2 +- 1 % of T are those of collisions.
    gas = contained(100, 0.8, glass_beads(0.0), diameter=5e-4)
    times = np.array([0.1, 0.25, 0.5, 1.0])
    curve = jaxgran.cool(gas, times, model=jaxgran.HardSpheres(100, replicas=32))
    ratio = np.asarray(curve.temperature / gas.temperature) / free_flight(0.8, times)
    error = np.asarray(curve.temperature_error / curve.temperature)
    assert np.all(np.abs(ratio - 1) < 3 * error + 0.02)


@pytest.mark.slow
def test_elastic_walls_cool_as_dsmc():
    gas = contained(500)
    taus = [1.0, 5.0, 20.0]
    hard = run(gas, 500, 8, taus)
    times = jnp.asarray(taus) * gas.mean_free_time
    dsmc = jaxgran.cool(gas, times, model=jaxgran.DSMC(20_000))
    error = np.asarray(hard.temperature_error / hard.temperature)
    ratio = np.asarray(hard.temperature / dsmc.temperature)
    assert np.all(np.abs(ratio - 1) < 3 * error + 0.015)  # Enskog's rate, and N = 500
    # Without the collisions that walls add, there would be 7 % fewer.
    assert np.all(np.abs(hard.collisions / dsmc.collisions - 1)[1:] < 0.03)


def test_viscoelastic_walls_bounce_by_their_own_law():
    # Two elastic spheres: what is lost, is lost to the walls, at the eps of their speeds.
    law = jaxgran.Viscoelastic(5e7, 0.22, 3e-5)
    gas = contained(2, law, glass_beads(0.0))
    times = jnp.array([0.0, 1.0, 2.0])
    curve = jaxgran.cool(gas, times, model=jaxgran.HardSpheres(2))
    total = 1.5 * gas.mass * curve.temperature + curve.dissipated_energy
    np.testing.assert_allclose(total, total[0], rtol=1e-12)
    # Some 5 bounces across each axis in a second, of 1 - eps^2 = .2 to .3 at 1 to 10 cm/s.
    assert 0.05 < float(curve.temperature[-1] / gas.temperature) < 0.7


def test_containers_that_do_not_fit_are_refused():
    gas = contained(200).replace(packing_fraction=0.03)
    with pytest.raises(ValueError, match="200 spheres of packing_fraction 0.03 need a container"):
        jaxgran.cool(gas, [1e-3], model=jaxgran.HardSpheres(200))


def lattice(side=SIDE):
    """50 spheres at rest on a lattice with 12.5 mm between them, off the walls."""
    place = (np.argwhere(np.ones((4, 4, 4)))[None, :50] + 0.5) * SIDE / 4
    return jaxgran.Particles(place, np.zeros_like(place), side)


def test_a_run_goes_on_from_its_own_particles():
    gas = contained(50, 0.8)
    walls = jaxgran.Walls([SIDE, 0.8 * SIDE, 1.25 * SIDE], restitution=0.8)
    gas = dataclasses.replace(gas, container=walls)
    times = jnp.array([0.1, 0.2])  # some bounces, and few impacts that would let paths part
    whole = jaxgran.cool(gas, times, model=jaxgran.HardSpheres(50), save="particles")
    middle = jax.tree.map(lambda x: x[0], whole.saved)
    cooler = gas.replace(temperature=whole.temperature[0])
    later = jaxgran.HardSpheres(50, start=middle)
    curve = jaxgran.cool(cooler, times[1:] - times[0], model=later)
    assert float(whole.temperature[1]) < 0.99 * float(whole.temperature[0])
    np.testing.assert_allclose(curve.temperature[-1], whole.temperature[1], rtol=1e-6)
    last = curve.particles
    np.testing.assert_allclose(last.position, whole.particles.position, atol=1e-6 * SIDE)


def test_what_does_not_stand_between_the_walls_is_refused():
    gas, start = contained(50), lattice()

    def moved(place):
        position = start.position.copy()
        position[0, 7] = place
        return jaxgran.HardSpheres(50, start=start._replace(position=position))

    middle = SIDE / 4
    with pytest.raises(ValueError, match="sphere 7 of replica 0 .* outside of the walls.* 0.05"):
        jaxgran.cool(gas, [1e-3], model=moved([-1e-4, middle, middle]))
    near = moved([middle, SIDE - 0.9e-3, middle])
    with pytest.raises(ValueError, match="less than its radius, 0.001 m, from a wall"):
        jaxgran.cool(gas, [1e-3], model=near)
    jaxgran.cool(gas, [1e-3], model=moved([middle, SIDE - 1e-3, middle]))  # it touches the wall
    with pytest.raises(ValueError, match="start.box_side is .* diameters, that of the gas"):
        wrong = jaxgran.HardSpheres(50, start=lattice(1.1 * SIDE))
        jaxgran.cool(gas, [1e-3], model=wrong)
    spinning = start._replace(angular_velocity=np.ones((1, 50, 3)))
    with pytest.raises(ValueError, match="HardSpheres draws the angular velocities of a start"):
        jaxgran.cool(gas, [1e-3], model=jaxgran.HardSpheres(50, start=spinning))


@pytest.mark.slow
def test_a_start_beyond_a_wall_has_a_status_where_it_cannot_be_looked_at():
    gas, start = contained(50), lattice()
    model = jaxgran.HardSpheres(50).sized_for(gas)

    @jax.jit
    def faults(position):
        own = dataclasses.replace(model, start=start._replace(position=position))
        return jaxgran.cool(gas, [1e-3], model=own).status

    assert faults(jnp.asarray(start.position)) == 0
    beyond = start.position.copy()
    beyond[0, 7, 1] = 0.9e-3
    assert faults(jnp.asarray(beyond)) == status.OVERLAPPING.bit
