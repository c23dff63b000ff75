"""Hard spheres with elements: rough, dragged, and in a container."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils import status
from jaxgran.models import error_model
from jaxgran.particles.hard.impacts import ImpactEvents, impact_effect
from jaxgran.scene.gas import ReducedDrag, ReducedRough, ReducedScene, SphereScene
from tests.beads import SI, glass_beads, hard_gas


def run(gas, num_particles, replicas, taus):
    times = jnp.asarray(taus) * gas.mean_free_time
    return jaxgran.cool(gas, times, model=jaxgran.HardSpheres(num_particles, replicas=replicas))


def test_laws_see_the_speeds_that_drag_has_left():
    n, gamma = 20, 0.3
    speed, time = jnp.linspace(0.1, 2.0, n), jnp.linspace(0.0, 2.5, n)
    law = glass_beads(0.5).reduced_law
    material = ReducedScene(law, drag=ReducedDrag(jnp.asarray(gamma / 2), None))
    scene = SphereScene(jnp.zeros(()), None, jnp.asarray(2.0), jnp.zeros(()), material)
    normal = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (n, 1))
    impact = ImpactEvents(time, normal, speed[:, None] * normal, speed, None, jnp.zeros(n, bool))
    eps = law.restitution(speed * (1 - gamma * time) / 2**0.5)
    np.testing.assert_allclose(
        impact_effect(scene, impact).lost, (1 - eps**2) * speed**2 / 8, rtol=1e-9
    )


@pytest.mark.slow
def test_drag_takes_energy_of_perfectly_rough_spheres_at_its_rate_alone():
    # In a box of three sides: impacts, on walls too, keep the energy, drag takes exp(-2 gamma t).
    sides = np.array([0.02, 0.03, 0.05])
    n = 150
    gas = hard_gas(1.0, **SI).replace(packing_fraction=n * np.pi / 6 * 8e-9 / sides.prod())
    gas = dataclasses.replace(
        gas,
        surface=jaxgran.Rough(1.0, rotational_temperature=4e-3),
        container=jaxgran.Walls(sides, restitution=1.0, tangential_restitution=1.0),
        drag=jaxgran.StokesDrag(1.5, rotational_rate=1.5),
    )
    curve = run(gas, n, 2, [0.0, 2.0, 10.0])
    assert float(curve.times[-1]) * 1.5 > 0.5
    energy = curve.temperature + curve.rotational_temperature
    kept = energy * jnp.exp(3.0 * curve.times)
    np.testing.assert_allclose(kept, 0.014, rtol=1e-12)  # sums of 300 numbers, some 1000 impacts
    total = energy + curve.dissipated_energy / (1.5 * gas.mass)
    np.testing.assert_allclose(total, 0.014, rtol=1e-12)
    final = curve.particles
    places = np.asarray(final.position)
    assert np.all(places >= 1e-3 * (1 - 1e-9))
    assert np.all(places <= (sides - 1e-3) * (1 + 1e-9))
    assert np.all(places.max(axis=(0, 1)) > 0.85 * sides)  # all of the box is in use
    T_rot = 0.4 * 1e-6 * jnp.mean(final.angular_velocity**2, axis=(0, 1)).sum() / 3
    assert float(T_rot) == pytest.approx(float(curve.rotational_temperature[-1]), rel=1e-12)
    T = jnp.mean(final.velocity**2)
    assert float(T) == pytest.approx(float(curve.temperature[-1]), rel=1e-12)


@pytest.mark.parametrize("beta", [-1.0, 0.7])
@pytest.mark.parametrize("dimension", [2, 3])
def test_impacts_keep_angular_momentum_and_follow_the_rule(dimension, beta):
    # Unit masses and diameters, I = q/4, spins s = w/2. In 2D as spheres in a plane.
    q, eps, n = 0.4, 0.8, 50
    normal, relative, spin = np.random.default_rng(1).normal(size=(3, n, 3))
    if dimension == 2:
        normal[:, 2] = relative[:, 2] = 0
        spin[:, :2] = 0
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    speed = np.abs(np.sum(relative * normal, -1))
    relative *= -np.sign(np.sum(relative * normal, -1, keepdims=True))  # they approach
    plane, axes = (slice(2), slice(2, 3)) if dimension == 2 else (slice(3), slice(3))
    zero = jnp.zeros(())
    surface = ReducedRough(jnp.asarray(beta), jnp.asarray(q), zero)
    material = ReducedScene(jaxgran.ConstantRestitution(eps), surface)
    effect = impact_effect(
        SphereScene(zero, None, zero, zero, material),
        ImpactEvents(
            time=jnp.zeros(n),
            normal=-jnp.asarray(normal[:, plane]),
            relative=jnp.asarray(relative[:, plane]),
            speed=jnp.asarray(speed),
            spin=jnp.asarray(spin[:, axes]),  # the sum of both
            elastic=jnp.zeros(n, bool),
        ),
    )
    kick, spin_change = np.zeros((2, n, 3))
    kick[:, plane], spin_change[:, axes] = effect.kick, effect.spin_change

    def slip_and_approach(relative, spin):
        at_contact = relative - np.cross(spin, normal)
        along = np.sum(at_contact * normal, -1, keepdims=True) * normal
        return at_contact - along, along

    before = slip_and_approach(relative, spin)
    after = slip_and_approach(relative + 2 * kick, spin + 2 * spin_change)
    np.testing.assert_allclose(after[0], -beta * before[0], atol=1e-12)
    np.testing.assert_allclose(after[1], -eps * before[1], atol=1e-12)
    # Angular momentum of each sphere about the point of contact.
    torque = np.cross(normal / 2, kick)
    np.testing.assert_allclose(torque + q / 2 * spin_change, 0, atol=1e-12)
    translation = np.sum((relative + kick) * kick, -1)
    rotation = q * np.sum((spin + spin_change) * spin_change, -1)
    np.testing.assert_allclose(-translation, 2 * effect.lost, atol=1e-12)
    np.testing.assert_allclose(rotation, 2 * effect.rotational_gain, atol=1e-12)
    slip, approach = (np.sum(x**2, -1) for x in before)
    lost = 0.25 * (1 - eps**2) * approach + 0.25 * q / (1 + q) * (1 - beta**2) * slip
    np.testing.assert_allclose(2 * (effect.lost - effect.rotational_gain), lost, atol=1e-12)


@pytest.mark.slow
def test_energy_of_rough_disks_is_conserved():
    surface = jaxgran.Rough(0.3, rotational_temperature=2e-3)
    gas = dataclasses.replace(glass_beads(dimension=2), surface=surface)
    curve = run(gas, 60, 2, [0.0, 1.0, 10.0])
    energy = 2 * curve.temperature + curve.rotational_temperature
    total = 0.5 * gas.mass * energy + curve.dissipated_energy
    np.testing.assert_allclose(total, total[0], rtol=1e-12)
    assert float(curve.rotational_temperature[0]) == pytest.approx(2e-3, rel=1e-12)


SIDE = 0.05


def contained(walls, beta=0.15, sides=1.0) -> jaxgran.Gas:
    """A gas of 50 spheres in a cube of 50 mm, or in a box of the same volume."""
    phi = 50 * np.pi / 6 * 8e-9 / SIDE**3
    walls = jaxgran.Walls(SIDE * np.asarray(sides), restitution=walls)
    return dataclasses.replace(glass_beads(beta, packing_fraction=phi), container=walls)


def boxed(beta) -> jaxgran.Gas:
    walls = jaxgran.Viscoelastic(5e7, 0.22, 3e-5)
    return contained(walls, beta, sides=(1.0, 0.8, 1.25))


def cooled(gas, times, start=None) -> jaxgran.CoolingCurve:
    model = jaxgran.HardSpheres(50, start=start)
    return jaxgran.cool(gas, jnp.asarray(times), model=model, save="particles")


@pytest.mark.slow
def test_viscoelastic_walls_bounce_by_their_own_law():
    # Elastic spheres: what is lost, is lost to the walls, at the eps of their speeds.
    gas = boxed(0.0)
    curve = cooled(gas, [0.0, 1.0])
    total = 1.5 * gas.mass * curve.temperature + curve.dissipated_energy
    np.testing.assert_allclose(total, total[0], rtol=1e-12)
    # Some 5 bounces across each axis in a second, of 1 - eps^2 = .2 to .3 at 1 to 10 cm/s.
    assert 0.05 < float(curve.temperature[-1] / gas.temperature) < 0.7


def test_a_run_goes_on_from_its_own_particles():
    gas = boxed(0.15)
    whole = cooled(gas, [0.1, 0.2])  # some bounces, and few impacts that would let paths part
    middle = jax.tree.map(lambda x: x[0], whole.saved)
    curve = cooled(gas.replace(temperature=whole.temperature[0]), [0.05, 0.1], middle)
    assert float(whole.temperature[1]) < 0.99 * float(whole.temperature[0])
    np.testing.assert_allclose(curve.temperature[-1], whole.temperature[1], rtol=1e-6)
    last = curve.particles
    np.testing.assert_allclose(last.position, whole.particles.position, atol=1e-6 * SIDE)


def at_rest(side=SIDE):
    """50 spheres at rest on a lattice with 12.5 mm between them, off the walls."""
    place = (np.argwhere(np.ones((4, 4, 4)))[None, :50] + 0.5) * SIDE / 4
    return jaxgran.Particles(place, np.zeros_like(place), side)


def test_what_does_not_stand_between_the_walls_is_refused():
    gas, start = contained(1.0), at_rest()

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
        wrong = jaxgran.HardSpheres(50, start=at_rest(1.1 * SIDE))
        jaxgran.cool(gas, [1e-3], model=wrong)
    spinning = start._replace(angular_velocity=np.ones((1, 50, 3)))
    with pytest.raises(ValueError, match="HardSpheres draws the angular velocities of a start"):
        jaxgran.cool(gas, [1e-3], model=jaxgran.HardSpheres(50, start=spinning))


@pytest.mark.slow
def test_a_start_beyond_a_wall_has_a_status_where_it_cannot_be_looked_at():
    gas, start = contained(1.0), at_rest()
    model = jaxgran.HardSpheres(50).sized_for(gas)

    @jax.jit
    def faults(position):
        own = dataclasses.replace(model, start=start._replace(position=position))
        return jaxgran.cool(gas, [1e-3], model=own).status

    assert faults(jnp.asarray(start.position)) == 0
    beyond = start.position.copy()
    beyond[0, 7, 1] = 0.9e-3
    assert faults(jnp.asarray(beyond)) == status.OVERLAPPING.bit


@pytest.mark.slow
def test_walls_take_from_elastic_spheres_what_theory_says():
    phi, eps = 0.02, 0.6
    # Haff's law: T^(-1/2) grows linearly. The slope after the first sound times, to 1/5 of T^(1/2).
    gas = glass_beads(packing_fraction=phi)
    walls = jaxgran.Walls(gas.box_side(500), restitution=eps)
    gas = dataclasses.replace(gas, law=jaxgran.ConstantRestitution(1.0), container=walls)
    theory = jaxgran.cool(gas, jnp.array([20.0]) * gas.mean_free_time)
    rate = ((theory.temperature[0] / gas.temperature) ** -0.5 - 1) / theory.times[0]
    times = jnp.array([0.5, 1.0, 2.5, 4.0]) / rate
    hard = jaxgran.cool(gas, times, model=jaxgran.HardSpheres(500, replicas=8))
    slopes = np.diff((hard.temperature / gas.temperature) ** -0.5) / np.diff(times * rate)
    # Four standard errors of a slope, .8 sqrt(2/(N replicas)), and error_model.WALL_ERROR.
    assert np.all(np.abs(slopes - 1) < 4 * 0.8 * (2 / (500 * 8)) ** 0.5 + 0.04), slopes


@pytest.mark.slow
@pytest.mark.parametrize("beta", [None, -0.3])
def test_beads_between_walls_cool_as_theory_says(beta):
    gas = glass_beads(packing_fraction=0.03)
    walls = jaxgran.Walls(gas.box_side(250), restitution=0.9, tangential_restitution=beta)
    surface = None if beta is None else jaxgran.Rough(beta)
    gas = dataclasses.replace(gas, container=walls, surface=surface)
    times = jnp.array([8.0, 20.0, 40.0]) * gas.mean_free_time
    theory = jaxgran.cool(gas, times, model=jaxgran.KineticTheory(softness=False))
    hard = jaxgran.cool(gas, times, model=jaxgran.HardSpheres(250, replicas=24))
    off = np.log(hard.temperature / theory.temperature)
    # Three standard errors, and the measured error of the rate times d ln T/d ln t < 2.
    error = 2 * (error_model.WALL_ERROR if beta is None else error_model.ROUGH_WALL_ERROR)
    assert np.all(np.abs(off) < 3 * hard.temperature_error / hard.temperature + error), off
    np.testing.assert_allclose(hard.collisions, theory.collisions, rtol=0.04)
