"""Soft spheres between walls, in a gas that drags, and with friction."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import hadamard

import jaxgran
from jaxgran.models.soft_spheres import SoftSpheres
from jaxgran.particles.soft.forces import SERIES_LIMIT, flight_time
from jaxgran.scene.parameters import domains_of
from tests.beads import glass_beads, soft_beads

DATA = Path(__file__).parents[2] / "experiments" / "data"
NUM = 100


def soft(fraction=0.05, beta=0.15, num=NUM, law=None, **elements) -> jaxgran.Gas:
    """Soft beads between walls of N beads by a law."""
    gas = soft_beads(fraction, beta)
    if law is not None:
        walls = jaxgran.Walls(gas.box_side(num), restitution=gas.law if law == "own" else law)
        elements["container"] = walls
    return dataclasses.replace(gas, **elements)


def energy(gas, curve):
    """Energy per particle with all that was lost, over that at t = 0."""
    T = curve.temperature
    if curve.rotational_temperature is not None:
        T = T + curve.rotational_temperature
    total = gas.dimension / 2 * gas.mass * T + curve.elastic_energy + curve.dissipated_energy
    return np.asarray(total / total[0])


FRICTIONAL_WALLS = {"tangential_damping": 0.8, "friction": 0.4}
LAW = glass_beads().law


def cooled(gas) -> jaxgran.CoolingCurve:
    return jaxgran.cool(gas, [0.1], model=SoftSpheres(NUM))


def with_all(num=NUM) -> jaxgran.Gas:
    """Frictional spheres between frictional walls of three sides, with drag."""
    surface = jaxgran.Frictional(0.5, 0.3, rotational_temperature=3e-3)
    drag = jaxgran.StokesDrag(0.3, rotational_rate=0.5)
    gas = soft(num=num, law="own", drag=drag, surface=surface)
    sides = float(gas.box_side(num)) * np.array([1.25, 1.0, 0.8])
    walls = jaxgran.Walls(sides, restitution=gas.law, **FRICTIONAL_WALLS)
    return dataclasses.replace(gas, container=walls)


def two_spheres(gas, position, velocity, replicas=1):
    shape = replicas, 2, gas.dimension
    side = gas.box_side(2) if gas.container is None else gas.container.side
    place, speed = (jnp.broadcast_to(jnp.asarray(a, float), shape) for a in (position, velocity))
    return jaxgran.Particles(place, speed, jnp.asarray(side))


def after(gas, position, velocity, end):
    """The curve of two spheres at 0 and at the end."""
    start = two_spheres(gas, position, velocity)
    return jaxgran.cool(gas, [0.0, end], model=SoftSpheres(2, start=start, steps_per_contact=100))


def between_walls(fraction, beta, law, friction=0.0, tangential_damping=0.0) -> jaxgran.Gas:
    """Two spheres without friction between walls of a law that may have some."""
    surface = jaxgran.Frictional(0.0, 0.0, inertia=0.5)
    gas = soft(fraction, beta, num=2, law=law, surface=surface)
    walls = {"friction": friction, "tangential_damping": tangential_damping}
    return dataclasses.replace(gas, container=dataclasses.replace(gas.container, **walls))


def test_impact_on_a_wall_has_the_restitution_of_its_law():
    # Another material than that of the spheres, at the corner: three walls at once.
    law = jaxgran.Viscoelastic(2e9, 0.3, 4e-6)
    gas = between_walls(1e-3, 0.0, law)
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


def test_a_wall_on_which_a_sphere_slides_obeys_coulomb():
    # The other sphere is at rest in the middle.
    mu = 0.05
    gas = between_walls(1e-5, 0.15, "own", friction=mu, tangential_damping=1e4)
    side, sigma = float(gas.container.side), float(gas.diameter)
    velocity = np.array([[0.2, 0.0, 0.15], [0.0, 0.0, 0.0]])
    first = np.array([side - sigma / 2, 0.25 * side, 0.5 * side]) - 5e-5 * velocity[0]
    curve = after(gas, [first, [0.3 * side, 0.75 * side, 0.5 * side]], velocity, 2e-4)
    impulse = np.asarray(curve.particles.velocity[0, 0]) - velocity[0]
    assert impulse[2] / impulse[0] == pytest.approx(mu, rel=1e-9)
    assert impulse[1] == 0.0 and impulse[0] < -0.2
    # The torque of the same force: I w = l n x F, with l = sigma/2 less the overlap, 2e-5 of it.
    spin = np.asarray(curve.particles.angular_velocity[0, 0]) * sigma / 2
    spin_expected = [0.0, -impulse[2] / gas.value("inertia"), 0.0]
    np.testing.assert_allclose(spin, spin_expected, rtol=1e-3, atol=1e-12)
    np.testing.assert_allclose(energy(gas, curve), 1.0, atol=2e-5)


def dragged(drag_rate=0.0, damping=0.0, friction=0.0) -> jaxgran.Gas:
    """Two stiff spheres with friction, in a gas that drags."""
    surface = jaxgran.Frictional(damping, friction, inertia=0.5)
    return soft(1e-5, num=2, surface=surface, drag=jaxgran.StokesDrag(drag_rate))


def test_flight_with_drag_is_exact():
    rate, time = 3e3, 2e-4
    gas = dragged(rate)
    side = float(gas.box_side(2))
    velocity = np.array([[0.1, 0.2, 0.0], [0.1, 0.2, 0.0]])  # side by side: they never meet
    place = np.array([[0.25 * side] * 3, [0.75 * side] * 3])
    end = after(gas, place, velocity, time).particles
    # Sums of some 1e3 blocks round to 1e-13.
    np.testing.assert_allclose(end.velocity[0], velocity * np.exp(-rate * time), rtol=1e-11)
    apart = end.position[0] - place + velocity * np.expm1(-rate * time) / rate
    np.testing.assert_allclose(apart - side * np.round(apart / side), 0.0, atol=1e-12 * side)


def test_sliding_impact_obeys_coulomb_and_conserves_momentum():
    # So slippery that it slides to the end: the tangential impulse is mu times the normal one.
    mu = 0.05
    gas = dragged(damping=1e4, friction=mu)  # so stiff that the normal does not turn
    side, sigma = float(gas.box_side(2)), float(gas.diameter)
    normal = np.array([np.cos(0.6), np.sin(0.6), 0.0])
    velocity = np.array([[0.2, 0.0, 0.05], [0.0, 0.0, 0.0]])
    contact = side / 2 + np.array([-normal, normal]) * sigma / 2
    curve = after(gas, contact - 5e-5 * velocity, velocity, 2e-4)  # they meet after 50 us
    assert float(curve.collisions[-1]) == 1.0
    final = np.asarray(curve.particles.velocity[0])
    np.testing.assert_allclose(final.sum(0), velocity.sum(0), atol=1e-14)
    impulse = final[0] - velocity[0]
    along = impulse @ normal
    sideways = np.linalg.norm(impulse - along * normal)
    # The normal turns by 2e-5 during the contact.
    assert sideways / abs(along) == pytest.approx(mu, rel=1e-3)
    np.testing.assert_allclose(energy(gas, curve), 1.0, atol=2e-5)  # the onset at 100 steps


@pytest.mark.parametrize("z", [0.0, 1e-9, 0.99 * SERIES_LIMIT, 1.01 * SERIES_LIMIT, 2.0])
def test_shortened_duration_and_its_derivative(z):
    value, slope = jax.value_and_grad(lambda rate: flight_time(rate, 2.0))(z / 2)
    exact = 2 * (-np.expm1(-z) / z if z else 1.0)
    small = -2.0 * (1 - 2 * z / 3 + z**2 / 4 - z**3 / 15 + z**4 / 72)
    derivative = small if z < 0.1 else 4 * (np.exp(-z) * (1 + z) - 1) / z**2
    assert float(value) == pytest.approx(exact, rel=1e-14)
    assert float(slope) == pytest.approx(derivative, rel=1e-9)


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


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: jaxgran.Frictional(0.5, -0.1), "friction must lie in"),
        (lambda: jaxgran.Frictional(-0.5, 0.1), "tangential_damping must lie in"),
        (lambda: jaxgran.Walls(0.1, restitution=LAW, friction=0.1), "no tangential_damping.*Give"),
        (
            lambda: jaxgran.Walls(0.1, restitution=LAW, tangential_damping=0.5, friction=-0.1),
            "friction of the walls must lie in",
        ),
        (
            lambda: soft(container=jaxgran.Walls(0.1, restitution=LAW, **FRICTIONAL_WALLS)),
            "friction of the walls needs frictional spheres",
        ),
        (
            lambda: SoftSpheres(NUM).check(
                soft(
                    container=jaxgran.Walls(
                        soft().box_side(NUM), restitution=LAW, tangential_restitution=0.5
                    ),
                    surface=jaxgran.Rough(0.1),
                )
            ),
            "belongs to instantaneous impacts.*tangential_damping",
        ),
        (lambda: cooled(soft(law=0.9)), "needs walls of the Viscoelastic law.*Use HardSpheres"),
        (
            lambda: cooled(soft(law="own", num=120)),
            "spheres of packing_fraction 0.05 need a container 0.833",
        ),
    ],
)
def test_what_it_cannot_take_is_refused_in_words(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_start_with_spins_is_refused():
    spinning = two_spheres(soft(num=2), [[1e-3] * 3, [4e-3] * 3], 0.0)._replace(
        angular_velocity=jnp.ones((1, 2, 3))
    )
    gas = soft(num=2, surface=jaxgran.Frictional(0.5, 0.3))
    with pytest.raises(ValueError, match="draws the angular velocities of a start"):
        jaxgran.cool(gas, [0.1], model=SoftSpheres(2, start=spinning))


FRICTION_FLOATS = [
    "dissipative_constant",
    "tangential_damping",
    "friction",
    "inertia",
    "rotational_temperature",
    "wall_dissipative_constant",
    "wall_tangential_damping",
    "wall_friction",
    "drag_rate",
    "drag_rotational_rate",
]


@pytest.mark.slow  # compiles derivatives in ten floats
def test_derivatives_with_friction_of_a_short_run_are_differences():
    h, gas = 1e-6, with_all()
    times = np.array([0.1, 0.2]) * float(gas.mean_free_time)  # before chaos
    model = SoftSpheres(NUM, projection=100.0, steps_per_contact=30)

    def logs(values):
        changed = gas.replace(**dict(zip(FRICTION_FLOATS, jnp.exp(values), strict=True)))
        curve = jaxgran.cool(changed, times, model=model)
        return jnp.log(jnp.stack([curve.temperature, curve.rotational_temperature]))

    # Values and derivatives by one program.
    slopes_and_logs = jax.jacfwd(lambda values: (logs(values),) * 2, has_aux=True)
    at = jnp.log(jnp.stack([gas.value(name) for name in FRICTION_FLOATS]))
    found = np.asarray(slopes_and_logs(at)[0])
    # Along three directions in all floats, of mixed signs.
    for move in hadamard(16)[:3, 1 : 1 + len(at)].astype(float):
        more, less = (slopes_and_logs(at + step * move)[1] for step in (h, -h))
        # The clock of a record takes the change of ln T for one that came evenly. It is off by t/4
        # of that change, and ln T_rot by its rate times this: .05 * .02 * .3 = 3e-4. From T the
        # tangents leave out spheres in contact, of which there are many so soon.
        expected = (more - less) / (2 * h)
        np.testing.assert_allclose(found[1] @ move, expected[1], atol=5e-4, rtol=0)
    assert np.all(np.any(np.abs(found) > 1e-5, axis=(0, 1)))


def test_derivatives_that_are_not_known_are_refused():
    gas = soft(law="own")
    model = SoftSpheres(NUM).sized_for(gas)

    def curve(side):
        return jaxgran.cool(gas.replace(wall_side=side), [1e-3], model=model)

    with pytest.raises(ValueError, match="side of a container.*not known.*KineticTheory"):
        jax.eval_shape(jax.jacfwd(curve), gas.value("wall_side"))


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
        surface=jaxgran.Frictional(*(data[name] for name in domains_of("Frictional"))),
        container=jaxgran.Walls(
            data["wall_side"],
            restitution=wall,
            tangential_damping=data["wall_tangential_damping"],
            friction=data["wall_friction"],
        ),
    )
    first = (jnp.asarray(data[f"first_{name}"]) for name in ("position", "velocity"))
    start = jaxgran.Particles(*first, gas.container.side)
    model = SoftSpheres(64, steps_per_contact=200, start=start)
    last = jaxgran.cool(gas, data["t"], model=model).particles
    sigma, speed = float(gas.diameter), float(gas.temperature) ** 0.5
    # The time steps leave 1e-4. LAMMPS takes sigma/2 for the distance to the contact in the slip:
    # a share of the overlap, 1 %, of the spins, which hold .1 of the energy.
    velocity = last.velocity[0] - data["velocity"][-1]
    spin = (last.angular_velocity[0] - data["omega"][-1]) * sigma / 2
    assert np.sqrt(np.mean(velocity**2)) < 1e-3 * speed
    assert np.sqrt(np.mean(spin**2)) < 2e-3 * speed
    assert np.max(np.abs(last.position[0] - data["position"][-1])) < 5e-4 * sigma
    # Friction did something: as smooth spheres they end elsewhere.
    assert np.sqrt(np.mean(data["omega"][-1] ** 2)) * sigma / 2 > 0.1 * speed
