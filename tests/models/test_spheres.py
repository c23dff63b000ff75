"""Hard and soft spheres alike: they cool as kinetic theory says, and melt."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran import HardSpheres, SoftSpheres
from jaxgran.extend import Run
from tests.beads import curves_of, glass_beads, hard_gas, soft_beads, spheres, without


def between_walls(law, beta=0.15, wall_beta=None) -> jaxgran.Gas:
    gas = glass_beads(beta, packing_fraction=0.03)
    walls = jaxgran.Walls(gas.box_side(250), restitution=law, tangential_restitution=wall_beta)
    surface = None if wall_beta is None else jaxgran.Rough(wall_beta)
    return dataclasses.replace(gas, container=walls, surface=surface)


MANY = HardSpheres(250, replicas=24)
COOLING = {
    # 12 500 impacts scatter by 0.9 % at most: they are less random than independent ones.
    "elastic": (hard_gas(1.0, 0.2), HardSpheres(500, replicas=2), (25,), {"collisions": (0.02, 0)}),
    # The first Sonine order leaves out 2 % of D, and 3000 spheres' <dr^2> scatters by 3 %.
    "hard": (
        glass_beads(packing_fraction=0.02),
        HardSpheres(1000, replicas=3),
        (1, 5, 20),
        {"temperature": (0.01, 2), "displacement": (0.1, 0), "collisions": (0.02, 2)},
    ),
    # Softness weakens impacts by 3 % here, the first Sonine order leaves out 2 %, correlations 4 %
    # at such densities: D has all of them, and the noise of the paths. Contacts that last take 2 %
    # of the time there is for other collisions.
    "soft": (
        soft_beads(0.02, 0.25, packing_fraction=0.04),
        SoftSpheres(400, replicas=3, steps_per_contact=30),
        (0.5, 2, 8),
        {"temperature": (0.015, 2), "displacement": (0.09, 2), "collisions": (0.03, 2)},
    ),
    # The error of the rate, measured by runs of 24 000 spheres, times d ln T/d ln t < 2: .7 %
    # between smooth walls, 5 % between rough ones.
    "walls": (
        between_walls(0.9),
        MANY,
        (8, 20, 40),
        {"temperature": (2 * 0.007, 3), "collisions": (0.04, 0)},
    ),
    "rough walls": (
        between_walls(0.9, wall_beta=-0.3),
        MANY,
        (8, 20, 40),
        {"temperature": (2 * 0.05, 3), "collisions": (0.04, 0)},
    ),
}
"""A gas, its model, mean free times; of each quantity a relative error, with standard errors."""


@pytest.mark.slow
@pytest.mark.parametrize("scene", COOLING)
def test_cools_as_kinetic_theory_says(scene):
    gas, model, taus, allowed = COOLING[scene]
    # Without walls in a box below L_c, so that the gas stays homogeneous.
    assert gas.container is not None or gas.box_side(model.num_particles) < 1.5 * gas.critical_box
    names = () if isinstance(model, SoftSpheres) else ("softness",)
    theory = jaxgran.KineticTheory(corrections=without(*names))
    theory, curve = curves_of(gas, taus, theory, model)
    # The number of impacts scatters as its root.
    impacts = curve.collisions * model.num_particles * model.replicas / 2
    errors = {"collisions": curve.collisions / np.sqrt(impacts)}
    for name, (error, standard_errors) in allowed.items():
        found, expected = getattr(curve, name), getattr(theory, name)
        noise = errors.get(name, getattr(curve, f"{name}_error", None)) / found
        assert np.all(np.abs(found / expected - 1) < error + standard_errors * noise), name
    np.testing.assert_allclose(curve.sonine, theory.sonine, atol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(
    "gas, model",
    [
        (hard_gas(0.8, 0.6, 2), HardSpheres(200)),
        (soft_beads(0.02, 0.1, packing_fraction=0.2), SoftSpheres(200)),
    ],
)
def test_a_dense_random_start_melts_under_jit(gas, model):
    """Many spheres begin near contact, or in contact; the capacity of a run would not do."""
    model, times = model.sized_for(gas), [float(gas.mean_free_time)]
    curve = jax.jit(lambda key: jaxgran.cool(gas, times, model=model, key=key))(jax.random.key(1))
    assert curve.status == 0
    # T has fallen by 11 to 16 %; that of one box scatters by 2 %.
    np.testing.assert_allclose(curve.temperature, jaxgran.cool(gas, times).temperature, rtol=0.05)


def test_large_boxes_are_searched_by_cells():
    gas = hard_gas()
    engines = [HardSpheres(n).sized_for(gas)._sizes.engine for n in (1000, 4096, 50_000)]
    assert engines == ["sweep", "sweep", "cells"]


@pytest.mark.minutes
def test_a_cluster_with_more_spheres_than_a_run_of_cells_holds():
    # All spheres in a corner of the box, 6 times as dense as the gas.
    n, gas = 343, hard_gas(0.9, 0.05)
    rng = np.random.default_rng(2)
    sites = np.stack(np.meshgrid(*[np.arange(7.0)] * 3), -1).reshape(-1, 3)
    position = 1.2 * sites + 0.09 * rng.uniform(-1, 1, (n, 3))
    start = spheres(position % float(gas.box_side(n)), rng.normal(size=(n, 3)), gas.box_side(n))
    times = jnp.array([0.05, 0.2]) * gas.mean_free_time

    def run(by, spare):
        model = HardSpheres(n, start=start, neighbours=by).sized_for(gas, spare)
        return jax.jit(lambda t: jaxgran.cool(gas, t, model=model))(times)

    sweep, cells = run("sweep", 60.0), run("cells", 60.0)
    assert sweep.status == cells.status == 0 and sweep.collisions[-1] > 1
    np.testing.assert_array_equal(sweep.collisions, cells.collisions)
    np.testing.assert_allclose(sweep.particles.velocity, cells.particles.velocity, atol=1e-9)
    # Inside of jit arrays cannot grow: a status, and no pair that is lost silently.
    assert "neighbour list is full" in jaxgran.explain_status(run("cells", 1.0).status)


@pytest.mark.minutes
def test_compiled_runs_of_few_hard_spheres_have_room():
    # Windows of 8 impacts scatter in length: of 60 keys 3 needed more pairs than they had.
    gas = glass_beads(packing_fraction=0.05, youngs_modulus=5e5)
    model = HardSpheres(50).sized_for(gas)
    times = 0.5 * gas.mean_free_time[None]
    run = jax.jit(jax.vmap(lambda key: jaxgran.cool(gas, times, model=model, key=key).status))
    assert not np.any(run(jax.random.split(jax.random.key(0), 60)))


def two_spheres(gas, distance, speed):
    """Two spheres at a distance in diameters that approach each other."""
    side, apart = gas.box_side(2), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    return spheres(0.5 * (side + distance * gas.diameter * apart), -speed * apart, side)


def test_soft_spheres_that_start_overlapping_are_told():
    gas = glass_beads(0.3, packing_fraction=0.02)
    SoftSpheres(2, start=two_spheres(gas, 1.01, 0.1)).check(gas)
    with pytest.warns(UserWarning, match="overlap: .* J"):
        SoftSpheres(2, start=two_spheres(gas, 0.95, 0.1)).check(gas)


@pytest.mark.slow
def test_heavily_damped_impacts_end():
    gas = glass_beads(1e4, packing_fraction=0.02)
    start = two_spheres(gas, 1.05, 0.1)
    times = [0.0, float(glass_beads(0.3, packing_fraction=0.1).mean_free_time)]
    soft, hard = (
        jaxgran.cool(gas, times, model=kind(2, start=start), progress=False)
        for kind in (SoftSpheres, HardSpheres)
    )
    ratio = soft.temperature / hard.temperature
    np.testing.assert_allclose(ratio, 1.0, atol=0.005)
    assert hard.temperature[1] < 1e-8 * hard.temperature[0]
    np.testing.assert_allclose(soft.dissipated_energy, hard.dissipated_energy, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("model", [HardSpheres(40, replicas=2), SoftSpheres(40, replicas=2)])
def test_runs_of_one_search_equilibrate_once(model, monkeypatch):
    """They begin at the same places, with new velocities, whatever A is."""
    gas = soft_beads(0.2, 0.25, packing_fraction=0.1)
    times = jnp.zeros(1)
    kind = type(model.dynamics(model.scene(gas), 3, 2))
    equilibrations = []
    random_start = kind.random_start

    def counted(self, *inputs):
        equilibrations.append(self)
        return random_start(self, *inputs)

    monkeypatch.setattr(kind, "random_start", counted)
    starts = {}
    others = gas.replace(dissipative_constant=2 * gas.dissipative_constant)
    first = model.simulate(gas, times, Run(jax.random.key(0), starts=starts))
    second = model.simulate(others, times, Run(jax.random.key(1), starts=starts))
    assert len(equilibrations) == 1
    np.testing.assert_array_equal(first.particles.position, second.particles.position)
    velocity = np.asarray([curve.particles.velocity for curve in (first, second)])
    assert abs(np.corrcoef(*velocity.reshape(2, -1))[0, 1]) < 0.3
    np.testing.assert_allclose(second.temperature, gas.temperature)
    np.testing.assert_allclose(np.mean(velocity, axis=2), 0, atol=1e-12 * np.max(velocity))
    denser = gas.replace(packing_fraction=0.11)
    model.simulate(denser, times, Run(jax.random.key(1), starts=starts))
    assert len(equilibrations) == 2
