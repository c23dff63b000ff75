"""Hard spheres: impacts, clusters, what compiled runs flag, drag, and walls."""

import dataclasses
import itertools
import time
from functools import partial

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran import HardSpheres
from jaxgran.extend import Run
from jaxgran.particles import run
from jaxgran.particles import spheres as moving
from tests.beads import (
    SI,
    curves_of,
    glass_beads,
    hard_gas,
    lattice,
    least_distance,
    spheres,
    total_energy,
    without,
)


def serial(gas, start, end):
    """A plain event-driven code: find the earliest of all impacts, execute it, begin again.

    Returns positions, velocities and how often each particle collided.
    """
    x, v = np.array(start.position[0]), np.array(start.velocity[0])
    side, now, just = float(start.box_side), 0.0, None
    i, j = np.triu_indices(len(x), 1)
    images = side * np.array(list(itertools.product((-1, 0, 1), repeat=x.shape[1])))
    counts, loss = np.zeros(len(x), int), 0.0
    while True:
        r = (x[i] - x[j])[:, None] - side * np.round((x[i] - x[j]) / side)[:, None] + images
        w = (v[i] - v[j])[:, None]
        b, c, w2 = (r * w).sum(-1), (r * r).sum(-1) - 1, (w * w).sum(-1)
        square = b * b - w2 * c
        hit = (b < 0) & (square > 0)
        if just is not None:
            hit[just] = False  # receding but for round-off
        dt = np.where(hit, c / (np.sqrt(np.where(hit, square, 1.0)) - b), np.inf)
        pair, image = np.unravel_index(np.argmin(dt), dt.shape)
        step = max(dt[pair, image], 0.0)
        if now + step > end:
            return x + v * (end - now), v, counts, loss
        x, now = x + v * step, now + step
        a, b = i[pair], j[pair]
        normal = r[pair, image] + w[pair, 0] * step
        normal /= np.linalg.norm(normal)
        speed = -(v[a] - v[b]) @ normal
        eps = float(gas.restitution(speed))
        kick = 0.5 * (1 + eps) * speed * normal
        v[a], v[b] = v[a] + kick, v[b] - kick
        counts[[a, b]] += 1
        loss += 0.25 * (1 - eps**2) * speed**2
        just = pair


LAW = jaxgran.Viscoelastic(5e7, 0.22, 1e-6)


@pytest.mark.parametrize(
    "dimension, packing_fraction, law",
    [(3, 0.2, LAW), pytest.param(2, 0.6, 0.8, marks=pytest.mark.slow)],
)
def test_impacts_are_those_of_a_serial_code(dimension, packing_fraction, law):
    gas = hard_gas(law, packing_fraction, dimension)
    tau, n = float(gas.mean_free_time), 40
    start = lattice(gas, n)
    num_impacts = 0
    for _ in range(4):
        curve = jaxgran.cool(gas, [3 * tau], model=HardSpheres(n, contact_time=0.0, start=start))
        x, v, counts, loss = serial(gas, start, 3 * tau)
        assert round(float(curve.collisions[-1]) * n) == counts.sum()
        num_impacts += counts.sum() // 2
        # Round-off grows e^2 to e^5 in each of some three impacts of a sphere: 1e-16 to 1e-9.
        heat = float(np.sqrt(curve.temperature[-1]))
        np.testing.assert_allclose(curve.particles.velocity[0], v, atol=1e-7 * heat)
        apart = np.asarray(curve.particles.position[0]) - x
        side = float(start.box_side)
        np.testing.assert_allclose(apart - side * np.round(apart / side), 0.0, atol=1e-7)
        assert float(curve.dissipated_energy[-1]) * n == pytest.approx(loss, abs=1e-7)
        velocity = curve.particles.velocity / heat
        start = curve.particles._replace(velocity=velocity)
    assert num_impacts > 100


@pytest.mark.slow
def test_three_spheres_in_a_row_do_not_collapse():
    # eps below 7 - 4 sqrt(3) = 0.072: infinitely many impacts in a finite time (McNamara & Young,
    # Phys. Fluids A 4, 496 (1992)).
    gas = hard_gas(0.05, 3 * np.pi / 6 / 10.0**3)
    x = [[2.0, 5.0, 5.0], [5.0, 5.0, 5.0], [8.5, 5.0, 5.0]]
    start = spheres(x, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], 10.0)
    curve = jaxgran.cool(gas, [8.0], model=HardSpheres(3, start=start))
    assert curve.regularised[-1] > 0
    assert curve.collisions[-1] < 100
    assert least_distance(curve.particles.position[0], start.box_side) > 1 - 1e-9


@pytest.mark.slow
def test_a_dense_dissipative_cluster_does_not_stall():
    gas = hard_gas(0.3, 0.4, 2)
    (curve,) = curves_of(gas, [20], HardSpheres(300))
    assert curve.temperature[-1] < 0.2  # clusters cool more slowly than Haff says, to 0.03
    assert curve.regularised[-1] < 0.5 * curve.collisions[-1]
    assert least_distance(curve.particles.position[0], gas.box_side(300)) > 1 - 1e-9


def test_a_fast_sphere_outruns_no_list():
    gas = hard_gas(LAW, 0.2)
    still = lattice(gas, 40)
    velocity = (1e-3 * still.velocity).at[0, 0, 0].set(10.0)
    start = still._replace(velocity=velocity)
    curve = jaxgran.cool(gas, [0.5], model=HardSpheres(40, start=start, contact_time=0.0))
    x, v, counts, _ = serial(gas, start, 0.5)
    assert counts.sum() > 4 and round(float(curve.collisions[-1]) * 40) == counts.sum()
    np.testing.assert_allclose(curve.particles.velocity[0], v, atol=1e-8)


@pytest.mark.slow
def test_what_is_too_small_is_grown_without_a_trace(monkeypatch):
    gas = hard_gas(0.8, 0.2)
    sizes = HardSpheres(100).sized_for(gas)._sizes
    tiny = sizes._replace(capacity=jax.tree.map(lambda rows: rows // 3, sizes.capacity))
    small_model = HardSpheres(100, _sizes=tiny)
    (small,) = curves_of(gas, [0.3, 1.0], small_model)
    grown = run._LENGTHENED[tiny.capacity]
    grown_model = HardSpheres(100, _sizes=tiny._replace(capacity=grown))
    at_once, reference = curves_of(gas, [0.3, 1.0], grown_model, HardSpheres(100))
    np.testing.assert_array_equal(small.temperature, at_once.temperature)
    np.testing.assert_array_equal(small.particles.position, at_once.particles.position)
    # The compiler rounds arrays of other lengths differently.
    np.testing.assert_allclose(small.temperature, reference.temperature, rtol=1e-12)
    np.testing.assert_allclose(small.particles.position, reference.particles.position, atol=1e-9)
    monkeypatch.setattr(type(sizes.capacity), "grown", lambda *args: pytest.fail("they grew again"))
    curves_of(gas, [0.3, 1.0], small_model)


@pytest.mark.slow
def test_jit_flags_the_start_of_another_gas_and_what_it_cannot_grow():
    gas = hard_gas(0.8, 0.1)
    model = HardSpheres(100, start=lattice(gas, 100)).sized_for(gas, spare=3.0)
    few = jax.tree.map(lambda rows: max(rows // 30, 1), model._sizes.capacity)
    short = dataclasses.replace(model, _sizes=model._sizes._replace(capacity=few))

    def cooled(packing_fraction, times, model):
        return jaxgran.cool(gas.replace(packing_fraction=packing_fraction), times, model=model)

    late = np.ones(1)
    whole, cut = (jax.jit(partial(cooled, model=x)) for x in (model, short))
    assert whole(0.1, late).status == 0
    for curve, words in (
        (whole(0.05, late), "box of start"),
        # A list that is cut short is no list, though no window needs it at t = 0.
        (cut(0.1, 0 * late), "neighbour list is full"),
        (cut(0.1, late), "neighbour list is full"),
    ):
        assert np.isnan(curve.temperature[0])
        assert words in jaxgran.explain_status(curve.status)


@pytest.mark.slow
def test_lammps_curve():
    measurement = jaxgran.example_measurement("dilute")
    gas, curve = measurement.gas, measurement.curve
    ours = jaxgran.cool(gas, curve.times, model=HardSpheres(1000, replicas=4))
    # LAMMPS resolves contacts, whose softness slows the cooling by 0.5 %.
    soft = jaxgran.cool(gas, curve.times).temperature
    instant = jaxgran.KineticTheory(corrections=without("softness"))
    hard = jaxgran.cool(gas, curve.times, model=instant).temperature
    miss = np.abs(ours.temperature * soft / hard / curve.temperature - 1)
    # The errors of three and four replicas are themselves uncertain by half: theory knows them.
    of_one = np.diag(jaxgran.KineticTheory().covariance(gas, curve.times, 1))
    spheres = measurement.num_particles * measurement.replicas
    error = np.sqrt(of_one * (1 / 4000 + 1 / spheres))
    assert np.all(miss < 0.005 + 3 * error)


SIDE = 0.05


def test_the_dissipated_energy_of_a_driven_gas_with_drag_is_not_known():
    gas = hard_gas(0.9, 0.05, **SI)
    rate = 0.1 / float(gas.mean_free_time)
    drive = jaxgran.WhiteNoise(rate * float(gas.temperature))
    gas = dataclasses.replace(gas, drag=jaxgran.StokesDrag(rate), drive=drive)
    (curve,) = curves_of(gas, [0.5, 1.0], HardSpheres(50))
    assert np.all(np.isfinite(curve.temperature)) and np.all(np.isnan(curve.dissipated_energy[1:]))


@pytest.mark.slow
def test_drag_takes_energy_of_perfectly_rough_disks_at_its_rate_alone():
    # In a box of unequal sides: impacts, on walls too, keep the energy, drag takes exp(-2 gamma t).
    sides, rate, n = np.array([0.02, 0.03]), 1.5, 20
    gas = hard_gas(
        1.0,
        n * np.pi * 1e-6 / sides.prod(),
        2,
        **SI,
        surface=jaxgran.Rough(1.0, rotational_temperature=4e-3),
        container=jaxgran.Walls(sides, restitution=1.0, tangential_restitution=1.0),
        drag=jaxgran.StokesDrag(rate, rotational_rate=rate),
    )
    (curve,) = curves_of(gas, [0.0, 2.0, 10.0], HardSpheres(n, replicas=2))
    assert float(curve.times[-1]) * rate > 0.5
    kept = total_energy(gas, dataclasses.replace(curve, dissipated_energy=np.zeros(3)))
    at_start = 0.5e-5 * (2 * 0.01 + 4e-3)
    # Sums of 40 numbers, some 100 impacts.
    np.testing.assert_allclose(kept * np.exp(2 * rate * curve.times), at_start, rtol=1e-12)
    np.testing.assert_allclose(total_energy(gas, curve), at_start, rtol=1e-12)
    places = np.asarray(curve.particles.position)
    assert np.all(places >= 1e-3 * (1 - 1e-9))
    assert np.all(places <= (sides - 1e-3) * (1 + 1e-9))
    assert np.all(places.max(axis=(0, 1)) > 0.85 * sides)  # all of the box is in use


def contained(law, sides=1.0) -> jaxgran.Gas:
    """A gas of 50 spheres in a cube of 50 mm, or in a box of the same volume."""
    gas = glass_beads(packing_fraction=50 * np.pi / 6 * 8e-9 / SIDE**3)
    walls = jaxgran.Walls(SIDE * np.asarray(sides), restitution=law)
    return dataclasses.replace(gas, container=walls)


def cooled(gas, times, start=None) -> jaxgran.CoolingCurve:
    model = HardSpheres(50, start=start)
    return jaxgran.cool(gas, times, model=model, save="particles")


@pytest.mark.slow
def test_a_run_goes_on_from_its_own_particles():
    gas = contained(jaxgran.Viscoelastic(5e7, 0.22, 3e-5), sides=(1.0, 0.8, 1.25))
    whole = cooled(gas, [0.1, 0.2])  # some bounces, and few impacts that would let paths part
    energy = 1.5 * float(gas.mass * gas.temperature)
    np.testing.assert_allclose(total_energy(gas, whole), energy, rtol=1e-12)
    middle = jax.tree.map(lambda x: x[0], whole.saved)
    curve = cooled(gas.replace(temperature=whole.temperature[0]), [0.05, 0.1], middle)
    assert float(whole.temperature[1]) < 0.99 * float(whole.temperature[0])
    np.testing.assert_allclose(curve.temperature[-1], whole.temperature[1], rtol=1e-6)
    last = curve.particles
    np.testing.assert_allclose(last.position, whole.particles.position, atol=1e-6 * SIDE)


def at_rest(place=None, side=SIDE, **more):
    """50 spheres at rest on a lattice with 12.5 mm between them, off the walls, but for one."""
    position = (np.argwhere(np.ones((4, 4, 4)))[None, :50] + 0.5) * SIDE / 4
    if place is not None:
        position[0, 7] = place
    return jaxgran.Particles(position, np.zeros_like(position), side, **more)


def test_what_does_not_stand_between_the_walls_is_refused():
    gas, middle = contained(1.0), SIDE / 4
    touching = at_rest([middle, SIDE - 1e-3, middle])
    HardSpheres(50, start=touching).check_scene(gas)
    for start, words in (
        (at_rest([-1e-4, middle, middle]), "sphere 7 of replica 0 .* outside of the walls.* 0.05"),
        (at_rest([middle, SIDE - 0.9e-3, middle]), "less than its radius, 0.001 m, from a wall"),
        (at_rest(side=1.1 * SIDE), "start.box_side is .* diameters, but the box of the gas has"),
        (at_rest(angular_velocity=np.ones((1, 50, 3))), "HardSpheres draws the angular velocities"),
    ):
        with pytest.raises(ValueError, match=words):
            HardSpheres(50, start=start).check_scene(gas)


@pytest.mark.slow
def test_a_start_beyond_a_wall_has_a_status_where_it_cannot_be_looked_at():
    gas, middle = contained(1.0), SIDE / 4
    model = HardSpheres(50).sized_for(gas)

    @jax.jit
    def faults(start):
        return jaxgran.cool(gas, [1e-3], model=dataclasses.replace(model, start=start)).status

    assert faults(at_rest()) == 0
    near = jaxgran.explain_status(faults(at_rest([middle, 0.9e-3, middle])))
    assert near.startswith("two spheres of the initial state overlap, or a sphere and a wall")
    assert ";" not in near


@pytest.mark.slow
def test_blocks_that_stand_still_end(monkeypatch):
    monkeypatch.setattr(moving, "MIN_FLIGHT", 1e9)  # no flight is long enough
    monkeypatch.setattr(moving, "MAX_STALLED", 3)
    # No other test has 21 spheres.
    gas = glass_beads(0.3, packing_fraction=0.1)
    curve = HardSpheres(21).simulate(gas, gas.mean_free_time[None], Run())
    jax.clear_caches()
    assert "no longer advances" in jaxgran.explain_status(curve.status)
    assert np.isnan(curve.temperature[0])


@pytest.mark.slow
def test_a_gas_that_never_collides_is_equilibrated_at_once():
    gas = glass_beads(0.3, packing_fraction=1e-12)
    began = time.monotonic()
    curve = jaxgran.cool(gas, [1.0], model=HardSpheres(20), progress=False)
    assert time.monotonic() - began < 100  # compilation included
    np.testing.assert_allclose(curve.temperature, gas.temperature)
