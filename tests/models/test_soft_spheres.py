"""Soft spheres: LAMMPS, steps, walls, drag and friction."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import hadamard

import jaxgran
from jaxgran import SoftSpheres
from jaxgran.particles.elements import flight_time
from tests.beads import curves_of, lattice, soft_beads, spheres, total_energy

DATA = Path(__file__).parents[2] / "experiments" / "data"


def last_of_lammps(gas, data, position, velocity):
    """The last particles of a run from a start of LAMMPS, which are near those of LAMMPS."""
    side = gas.box_side(64) if gas.container is None else gas.container.side
    model = SoftSpheres(64, steps_per_contact=200, start=spheres(position, velocity, side))
    last = jaxgran.cool(gas, data["t"][-1:], model=model).particles
    # As printed: 6e-5 at 400 steps a contact, 2e-5 at 1600.
    difference, speed = last.velocity[0] - data["velocity"][-1], float(gas.temperature) ** 0.5
    assert np.sqrt(np.mean(difference**2)) < 9e-4 * speed
    apart = last.position[0] - data["position"][-1]
    apart -= side * np.round(apart / side)
    assert np.max(np.abs(apart)) < 5e-4 * gas.diameter
    return last


@pytest.mark.slow
def test_follows_the_lammps_trajectory_particle_by_particle():
    data = dict(np.load(DATA / "lammps_trajectory_n64.npz"))
    side, diameter = float(data["box_side"]), float(data["diameter"])
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(*(data[name] for name in jaxgran.Viscoelastic.domains)),
        diameter=diameter,
        mass=jaxgran.sphere_mass(diameter, data["density"]),
        packing_fraction=64 * np.pi / 6 * (diameter / side) ** 3,
        temperature=np.mean(data["velocity"][0] ** 2),
    )
    last_of_lammps(gas, data, data["position"][0], data["velocity"][0])


@pytest.mark.slow
def test_a_fast_sphere_outruns_no_list():
    gas = soft_beads(0.02, 0.1, packing_fraction=0.3)
    still = lattice(gas, 64)
    velocity = (1e-3 * still.velocity).at[0, 0, 0].set(10.0)  # a hundred thermal speeds
    start = still._replace(velocity=velocity)
    times = [0.0, 2 * float(gas.diameter) / 10.0]
    curve = jaxgran.cool(gas, times, model=SoftSpheres(64, start=start, steps_per_contact=100))
    assert curve.collisions[-1] > 1 / 64
    # A contact that is found late begins with an overlap, whose energy comes from nowhere.
    total = total_energy(gas, curve)
    np.testing.assert_allclose(total, total[0], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.minutes
def test_a_step_too_large_is_shortened():
    gas = soft_beads(0.001, 0.1, packing_fraction=0.1)
    cold = lattice(gas, 64)
    # Two spheres half inside each other hold more energy than the rest of the gas.
    position = cold.position.at[0, 1].set(cold.position[0, 0] + jnp.array([1e-3, 0.0, 0.0]))
    start = cold._replace(position=jnp.mod(position, cold.box_side))
    model = SoftSpheres(64, start=start, steps_per_contact=10)
    with pytest.warns(UserWarning, match="start overlap"):
        curve = jaxgran.cool(gas, [1e-6, 1e-4], model=model)
    total = total_energy(gas, curve)
    assert total[-1] > 10 * 1.5 * gas.mass * gas.temperature  # the energy was there
    np.testing.assert_allclose(total[0], total[-1], rtol=0.05)


@pytest.mark.slow
def test_whoever_finds_the_pairs_the_run_is_the_same():
    gas = soft_beads(0.05, 0.2, packing_fraction=0.1)
    model = SoftSpheres(64, replicas=2, start=lattice(gas, 64, replicas=2))
    engines = "cells", "sweep", "jax-md"
    models = (dataclasses.replace(model, neighbours=by) for by in engines)
    a, *others = curves_of(gas, [0.5], *models)
    for b in others:
        np.testing.assert_allclose(a.particles.velocity, b.particles.velocity, atol=1e-9)


@pytest.mark.slow
def test_single_precision():
    gas = soft_beads(0.05, 0.2, packing_fraction=0.1)
    times = [0.5 * float(gas.mean_free_time)]
    start = lattice(gas, 64)
    fine = jaxgran.cool(gas, times, model=SoftSpheres(64, start=start))
    with jax.enable_x64(False):
        single = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), (gas, start))
        coarse = jaxgran.cool(single[0], times, model=SoftSpheres(64, start=single[1]))
        assert coarse.temperature.dtype == jnp.float32
    np.testing.assert_allclose(coarse.temperature, fine.temperature, rtol=1e-3)


NUM = 100
MODEL = SoftSpheres(NUM)
FRICTIONLESS = {"friction": 0.0, "tangential_damping": 0.0}
FRICTIONAL = {"friction": 0.4, "tangential_damping": 0.8}
SLIPPERY = jaxgran.Frictional(0.0, 0.0, inertia=0.5)


def soft(fraction=0.05, beta=0.15, num=NUM, law=None, walls=None, **elements) -> jaxgran.Gas:
    """Soft beads between walls of N beads by a law, if one is given."""
    gas = soft_beads(fraction, beta)
    if law is not None:
        law = gas.law if law == "own" else law
        elements["container"] = jaxgran.Walls(gas.box_side(num), restitution=law, **(walls or {}))
    return dataclasses.replace(gas, **elements)


def two_spheres(gas, position, velocity) -> jaxgran.Particles:
    side = gas.box_side(2) if gas.container is None else gas.container.side
    return spheres(position, velocity, side)


def after(gas, position, velocity, end):
    """The curve of two spheres at 0 and at the end."""
    model = SoftSpheres(2, start=two_spheres(gas, position, velocity), steps_per_contact=100)
    return jaxgran.cool(gas, [0.0, end], model=model)


def check_energy(gas, curve):
    total = total_energy(gas, curve)
    np.testing.assert_allclose(total, total[0], rtol=2e-5)  # the onset at 100 steps


@pytest.mark.slow
def test_impact_on_a_wall_has_the_restitution_of_its_law():
    # Another material than that of the spheres, at the corner: three walls at once.
    law = jaxgran.Viscoelastic(2e9, 0.3, 4e-6)
    gas = soft(1e-3, 0.0, 2, law, FRICTIONLESS, surface=SLIPPERY)
    side, sigma = float(gas.container.side), float(gas.diameter)
    velocity = np.array([[0.3, -0.1, 0.2], [0.0, 0.0, 0.0]])
    gap = np.array([1e-4, 2e-4, 3e-4])
    corner = np.array([side - sigma / 2, sigma / 2, side - sigma / 2]) - np.sign(velocity[0]) * gap
    curve = after(gas, np.array([corner, side - corner]), velocity, 0.006)
    final = np.asarray(curve.particles.velocity[0, 0])
    expected = law.on_wall(diameter=gas.diameter, mass=gas.mass, speed=1.0)
    eps = np.asarray(expected.restitution(jnp.abs(velocity[0])))
    # At 100 steps of a contact at the mean speed, here 1/2 to 1 times as long: 1e-4 by the onset.
    np.testing.assert_allclose(-final / velocity[0], eps, atol=5e-4)
    assert np.all(eps < 0.99)
    np.testing.assert_array_equal(curve.particles.velocity[0, 1], 0.0)
    assert float(curve.collisions[-1]) == 0.0


@pytest.mark.parametrize("on_wall", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_sliding_impact_obeys_coulomb_and_conserves_momentum(on_wall):
    # So slippery that it slides to the end: the tangential impulse is mu times the normal one. So
    # stiff that the normal turns by 2e-5 only.
    mu, damping, radius = 0.05, 1e4, 1e-3
    side = float(soft().box_side(2))
    if on_wall:  # the other sphere is at rest in the middle
        walls = {"friction": mu, "tangential_damping": damping}
        gas = soft(1e-5, 0.15, 2, "own", walls, surface=SLIPPERY)
        normal, sideways_speed = np.array([1.0, 0.0, 0.0]), 0.15
        contact = side * np.array([[1.0, 0.25, 0.5], [0.3, 0.75, 0.5]])
        contact[0, 0] -= radius
    else:
        surface = jaxgran.Frictional(damping, mu, inertia=0.5)
        gas = soft(1e-5, surface=surface, drag=jaxgran.StokesDrag(0.0))
        normal, sideways_speed = np.array([np.cos(0.6), np.sin(0.6), 0.0]), 0.05
        contact = side / 2 + np.array([-normal, normal]) * radius
    velocity = np.array([[0.2, 0.0, sideways_speed], [0.0, 0.0, 0.0]])
    curve = after(gas, contact - 5e-5 * velocity, velocity, 2e-4)  # they meet after 50 us
    final = np.asarray(curve.particles.velocity[0])
    impulse = final[0] - velocity[0]
    along = impulse @ normal
    sideways = np.linalg.norm(impulse - along * normal)
    assert sideways / abs(along) == pytest.approx(mu, rel=1e-9 if on_wall else 1e-3)
    assert along < -0.1
    if not on_wall:
        assert float(curve.collisions[-1]) == 1.0
        np.testing.assert_allclose(final.sum(0), velocity.sum(0), atol=1e-14)
    # The torque of the same force: I w = l n x F, with l = sigma/2 less the overlap, 2e-5 of it.
    spin = np.asarray(curve.particles.angular_velocity[0, 0]) * radius
    torque = np.cross(normal, impulse) / gas.value("inertia")
    np.testing.assert_allclose(spin, torque, atol=1e-3 * np.linalg.norm(torque))
    check_energy(gas, curve)


def test_flight_with_drag_is_exact():
    rate, time = 3e3, 2e-4
    gas = soft(1e-5, surface=SLIPPERY, drag=jaxgran.StokesDrag(rate))
    side = float(gas.box_side(2))
    velocity = np.array([[0.1, 0.2, 0.0], [0.1, 0.2, 0.0]])  # side by side: they never meet
    place = np.array([[0.25 * side] * 3, [0.75 * side] * 3])
    end = after(gas, place, velocity, time).particles
    # Sums of some 1e3 blocks round to 1e-13.
    np.testing.assert_allclose(end.velocity[0], velocity * np.exp(-rate * time), rtol=1e-11)
    apart = end.position[0] - place + velocity * np.expm1(-rate * time) / rate
    np.testing.assert_allclose(apart - side * np.round(apart / side), 0.0, atol=1e-12 * side)
    # Without drag, too, the way has a derivative in it: (1 - exp(-z))/rate is t - rate t^2/2.
    assert jax.grad(lambda rate: flight_time(rate, 2.0))(0.0) == pytest.approx(-2.0, rel=1e-12)


@pytest.mark.slow
def test_steps_with_friction_are_of_second_order():
    # Within one contact, which has begun already: its onset would leave dt^(3/2).
    gas = soft(1e-3, 0.3, num=2, surface=jaxgran.Frictional(0.5, 100.0))
    sigma, along = float(gas.diameter), np.array([1.0, 0.0, 0.0])
    apart = (1 - 0.5 * float(gas.mean_overlap)) * sigma * along
    place = float(gas.box_side(2)) / 2 + np.array([-apart, apart]) / 2
    start = two_spheres(gas, place, [[0.1, 0.06, 0.0], [-0.1, -0.06, 0.0]])
    ends = []
    for steps in (20, 40, 80):
        model = SoftSpheres(2, start=start, steps_per_contact=steps)
        end = jaxgran.cool(gas, [0.3 * float(gas.contact_duration)], model=model).particles
        spin = np.asarray(end.angular_velocity[0, 0, 2:]) * sigma / 2
        ends.append(np.concatenate([end.velocity[0, 0, :2], spin]))
    # Terms of fourth order: 2 % of the error at 20 steps.
    np.testing.assert_allclose((ends[0] - ends[1]) / (ends[1] - ends[2]), 4.0, rtol=0.04)


@pytest.mark.minutes  # compiles derivatives in six floats
def test_derivatives_with_friction_of_a_short_run_are_differences():
    # Frictional spheres between frictional walls of three sides, with drag.
    h, gas = 1e-6, soft()
    sides = float(gas.box_side(NUM)) * np.array([1.25, 1.0, 0.8])
    gas = dataclasses.replace(
        gas,
        surface=jaxgran.Frictional(0.5, 0.3, rotational_temperature=3e-3),
        container=jaxgran.Walls(sides, restitution=gas.law, **FRICTIONAL),
        drag=jaxgran.StokesDrag(0.3, rotational_rate=0.5),
    )
    given = "diameter", "mass", "packing_fraction", "temperature", "wall_side"
    left_out = "youngs_modulus", "poisson_ratio", "friction", "tangential_damping", "inertia"
    floats = [x for x in gas.domains if x not in given and not x.endswith(left_out)]
    times = np.array([0.1, 0.2]) * float(gas.mean_free_time)  # before chaos
    model = SoftSpheres(NUM, projection=100.0, steps_per_contact=30)

    def logs(values):
        changed = gas.replace(**dict(zip(floats, jnp.exp(values), strict=True)))
        curve = jaxgran.cool(changed, times, model=model)
        return jnp.log(jnp.stack([curve.temperature, curve.rotational_temperature]))

    # Values and derivatives by one program.
    slopes_and_logs = jax.jacfwd(lambda values: (logs(values),) * 2, has_aux=True)
    at = jnp.log(jnp.stack([gas.value(name) for name in floats]))
    found = np.asarray(slopes_and_logs(at)[0])
    # Along three directions in all floats, of mixed signs.
    for move in hadamard(8)[:3, 1 : 1 + len(at)].astype(float):
        more, less = (slopes_and_logs(at + step * move)[1] for step in (h, -h))
        # The clock of a record takes the change of ln T for one that came evenly. It is off by t/4
        # of that change, and ln T_rot by its rate times this: .05 * .02 * .3 = 3e-4. From T the
        # tangents leave out spheres in contact, of which there are many so soon.
        expected = (more - less) / (2 * h)
        np.testing.assert_allclose(found[1] @ move, expected[1], atol=5e-4, rtol=0)
    assert np.all(np.any(np.abs(found) > 1e-5, axis=(0, 1)))


def test_derivatives_that_are_not_known_are_refused():
    gas = soft(law="own", walls=FRICTIONAL, surface=SLIPPERY)
    model = MODEL.sized_for(gas)

    def curve(value, name):
        return jaxgran.cool(gas.replace(**{name: value}), [1e-3], model=model)

    for name, words in {
        "wall_side": "side of a container.*not known.*KineticTheory",
        "friction": "tangential_damping, friction or inertia of contacts is not known",
        "inertia": "tangential_damping, friction or inertia of contacts is not known",
        "wall_tangential_damping": "tangential_damping, friction or inertia of contacts",
    }.items():
        with pytest.raises(ValueError, match=words):
            jax.eval_shape(jax.jacfwd(partial(curve, name=name)), gas.value(name))


@pytest.mark.slow
def test_follows_lammps_with_friction_between_walls_particle_by_particle():
    # Written by `python experiments/accuracy/compare_lammps_elements.py --store`.
    data = dict(np.load(DATA / "lammps_elements_n64.npz"))
    law, wall = (
        jaxgran.Viscoelastic(*(data[prefix + name] for name in jaxgran.Viscoelastic.domains))
        for prefix in ("", "wall_")
    )
    gas = jaxgran.Gas(
        law,
        **{name: data[name] for name in ("diameter", "mass", "packing_fraction", "temperature")},
        surface=jaxgran.Frictional(*(data[x.name] for x in dataclasses.fields(jaxgran.Frictional))),
        container=jaxgran.Walls(
            data["wall_side"],
            restitution=wall,
            tangential_damping=data["wall_tangential_damping"],
            friction=data["wall_friction"],
        ),
    )
    last = last_of_lammps(gas, data, data["first_position"][0], data["first_velocity"][0])
    # LAMMPS takes sigma/2 for the distance to the contact in the slip: a share of the overlap, 1 %,
    # of the spins, which hold .1 of the energy.
    sigma, speed = float(gas.diameter), float(gas.temperature) ** 0.5
    spin = (last.angular_velocity[0] - data["omega"][-1]) * sigma / 2
    assert np.sqrt(np.mean(spin**2)) < 2e-3 * speed
    # Friction did something: as smooth spheres they end elsewhere.
    assert np.sqrt(np.mean(data["omega"][-1] ** 2)) * sigma / 2 > 0.1 * speed
