import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jaxgran
from jaxgran.theory.averages import impact_moments
from tests.beads import SI, glass_beads, hard_gas, theory_curve, without
from tests.data.curve_files import ROUGH, gas_of

TAUS = np.geomspace(1.0, 300.0, 8)


def constant(eps, dimension=3, **elements) -> jaxgran.Gas:
    return hard_gas(eps, 0.02, dimension, **SI, **elements)


@pytest.mark.slow
@pytest.mark.parametrize("dimension, spins", [(3, 3), (2, 1)])
def test_perfectly_rough_elastic_spheres_keep_their_energy(dimension, spins):
    surface = jaxgran.Rough(1.0, rotational_temperature=2e-3)
    gas = constant(1.0, dimension, surface=surface)
    curve = theory_curve(gas, TAUS, corrections=without("correlations"))
    energy = dimension * curve.temperature + spins * curve.rotational_temperature
    np.testing.assert_allclose(energy, dimension * 0.01 + spins * 2e-3, rtol=1e-8)
    # In the end each of the d + d_rot squares of the energy has the same share.
    np.testing.assert_allclose(curve.rotational_temperature[-1], curve.temperature[-1], rtol=1e-6)


@pytest.mark.parametrize("inertia", [0.4, 2 / 3])
@pytest.mark.parametrize("beta", [-0.3, 0.0, 0.5, 0.9])
@pytest.mark.parametrize("eps", [0.6, 0.9, 1.0])
def test_the_temperatures_reach_the_ratio_of_the_literature(eps, beta, inertia):
    # Santos, Kremer & Garzo, Prog. Theor. Phys. Suppl. 184, 31 (2010): the homogeneous cooling
    # state of inelastic rough spheres, Maxwellian.
    q, surface = inertia, jaxgran.Rough(beta, inertia=inertia, rotational_temperature=0.01)
    gas = constant(eps, surface=surface)
    options = {"corrections": without("sonine", "spin_cumulants", "correlations")}
    curve = theory_curve(gas, np.array([1e6]), **options)
    c = (1 + q) ** 2 / (2 * q * (1 + beta) ** 2)
    c *= 1 - eps**2 - (1 - q) / (1 + q) * (1 - beta**2)
    expected = c + np.sqrt(1 + c**2)
    ratio = float(curve.rotational_temperature[0] / curve.temperature[0])
    assert ratio == pytest.approx(expected, rel=2e-3)  # approached as a power of time


def test_spins_of_inelastic_spheres_have_a_cooling_state():
    # DSMC of 40 000 spheres after 1000 mean free times: 2.53 +- .04, and Gaussian spins have 2.85.
    gas = constant(0.6, surface=jaxgran.Rough(-0.3, rotational_temperature=0.01))
    curve = theory_curve(gas, np.array([1e3, 1e6]), corrections=without("correlations"))
    ratios = np.asarray(curve.rotational_temperature / curve.temperature)
    np.testing.assert_allclose(ratios, 2.53, rtol=0.04)
    np.testing.assert_allclose(ratios[0], ratios[1], rtol=0.01)


def test_walls_take_energy_as_haff_has_it():
    # dT/dt = -(4/L) Z F (1 - e^2) sqrt(T/(2 pi)) T in a cube of free width L - sigma, where the
    # layer before the wall brings 2/(1 + e) of the impacts, warmer by the heat that flows to it
    # (.8634/5), and colder by its conduction over the width.
    gas = constant(1.0, container=jaxgran.Walls(0.05, restitution=0.8))
    curve = theory_curve(gas, TAUS, corrections=without("sonine"))
    phi = 0.02
    pressure = 1 + 4 * phi * (1 - phi / 2) / (1 - phi) ** 3
    assert float(gas.mean_free_path) < float(constant(1.0).mean_free_path)
    rate = 4 / 0.048 * pressure * 0.36 * (0.01 / (2 * np.pi)) ** 0.5
    path = float(gas.mean_free_path) / 0.048 * pressure
    drop = 0.2 * np.sqrt(2 / np.pi) / (6 * 75 / 64 * np.sqrt(2 * np.pi) * path)
    cold = -drop / 2 + np.sqrt(1 + drop**2 / 4)
    rate *= 2 / 1.8 * (1 + 0.8633802 / 5 * 0.36 / (1 + path)) * cold
    expected = 0.01 / (1 + rate * curve.times / 2) ** 2
    np.testing.assert_allclose(curve.temperature, expected, rtol=1e-6)
    assert curve.displacement is None and curve.diffusion is None


def test_walls_take_more_from_fast_spheres():
    # DSMC of 800 000 spheres: T has an error of .1 %, a_2 of .003. Without walls a_2 is -.015.
    gas = constant(0.9, container=jaxgran.Walls(0.05, restitution=0.8))
    curve = theory_curve(gas, np.array([1.0, 3.0, 10.0]), corrections=without("correlations"))
    T = curve.temperature / gas.temperature
    np.testing.assert_allclose(T, [0.85653, 0.64930, 0.30791], rtol=2e-3)
    np.testing.assert_allclose(curve.sonine, [-0.0119, -0.0293, -0.0383], atol=0.01)


@pytest.mark.parametrize("dimension", [2, 3])
def test_elastic_walls_are_met_by_a_gas_everywhere_alike(dimension):
    free = hard_gas(1.0, 0.02, dimension)
    pressure = 1 + 2 ** (dimension - 1) * 0.02 * float(free.contact_value)

    def share(eps, width):
        """Impacts on walls over those of a gas that is everywhere alike, for one eps."""
        width *= float(free.mean_free_path)
        gas = hard_gas(1.0, 0.02, dimension, container=jaxgran.Walls(width + 1, restitution=eps))
        # d pairs of walls; each impact takes (1 - eps^2) T of the energy d T/2.
        alike = 4 * (1 - eps**2) * pressure / width / np.sqrt(2 * np.pi)
        maxwellian = jaxgran.KineticTheory(corrections=without("sonine"))
        T = jaxgran.cool(gas, [0.02 / alike], model=maxwellian).temperature[0]
        return 100 * (float(T) ** -0.5 - 1)  # T = (1 + rate t/2)^-2

    widths = 70, 7, 0.5  # in mean free paths
    eps = 0.9996, 0.9998, 0.9, 0.0
    near, nearer, weak, strong = np.array([[share(e, x) for x in widths] for e in eps])
    # At eps = 1, linearly; of the solver, and of (1 - eps)^2.
    np.testing.assert_allclose(2 * nearer - near, 1.0, rtol=5e-6)
    # The table of rates reaches as far as 2.5.
    assert min(weak[1:]) > 1.0 and max(strong) < 2.5
    # Across 70 mean free paths the layer is cold; across .5 it is that of balanced pressure.
    assert strong[0] < 1.0 and weak[2] == pytest.approx(2 / 1.9, rel=0.02)


@pytest.mark.parametrize("dimension", [2, 3])
def test_spheres_between_walls_meet_more_often(dimension):
    # Pairs at contact in a random direction, both centres between the walls.
    rng, sides = np.random.default_rng(0), np.array([0.012, 0.02, 0.03][:dimension])
    walls, diameter = jaxgran.Walls(sides, restitution=1.0), 2e-3
    widths = sides - diameter
    places = rng.uniform(size=(10**6, dimension)) * widths
    n = rng.normal(size=places.shape)
    partners = places + diameter * n / np.linalg.norm(n, axis=1, keepdims=True)
    inside = np.mean(np.all((partners > 0) & (partners < widths), axis=1))
    expected = inside * np.prod(sides / widths)
    found = float(walls.more_collisions(jnp.asarray(diameter), dimension))
    assert found == pytest.approx(expected, abs=3e-3)  # of 1e6 random numbers, 1 sigma is 5e-4


def test_a_viscoelastic_wall_is_softer_by_the_root_of_two():
    law = jaxgran.Viscoelastic(5e7, 0.22, 1e-6)
    softer = jaxgran.Viscoelastic(5e7 / 2**0.5, 0.22, 1e-6)
    shape = {"diameter": 2e-3, "mass": 1e-5, "speed": 0.1}
    wall, pair = law.on_wall(**shape), softer.reduced(**shape)
    assert float(wall.beta) == pytest.approx(float(pair.beta), rel=1e-12)
    assert float(wall.length) == pytest.approx(float(pair.length), rel=1e-12)


def test_a_box_that_does_not_hold_other_spheres_is_refused_in_a_choice():
    fits = gas_of(**ROUGH)
    with pytest.raises(ValueError, match="100 spheres .*0.04.* container"):
        jaxgran.choose_model(fits, [1.0], num_particles=100)


def test_rejected_steps_leave_no_values():
    # The first step, .01 mean free times, is far too long for D of spheres that drag stops sooner.
    gas = constant(1.0, drag=jaxgran.StokesDrag(1.0))
    taus, rate = np.array([1e-5, 1e-4, 1e-3]), 3e3
    gas = gas.replace(drag_rate=rate / float(gas.mean_free_time))
    curve = theory_curve(gas, taus, corrections=without("correlations"))
    left = np.exp(-rate * taus)
    expected = float(gas.temperature / gas.value("drag_rate")) * left * (1 - left)
    np.testing.assert_allclose(curve.diffusion, expected, rtol=2e-3)  # collisions: 1e-3


def test_spins_that_heat_the_gas_stay_within_the_table_of_rates():
    # T rises to 2 T_0 by the spins, far beyond a table that ends at T_0: beside the equations of
    # Huthmann & Zippelius without a table, integrated by another library.
    q, beta = 0.4, 0.5
    surface = jaxgran.Rough(beta, inertia=q, rotational_temperature=0.1)
    gas, taus = dataclasses.replace(glass_beads(0.02), surface=surface), np.array([0.3, 1.0, 3.0])
    names = "sonine", "softness", "correlations", "spin_cumulants"
    curve = theory_curve(gas, taus, corrections=without(*names))
    assert float(curve.temperature[2]) > 2 * float(gas.temperature)
    eta = q * (1 + beta) / (2 * (1 + q))

    @jax.jit
    def rates(t, temperatures):  # over T_0, per mean free time at t = 0
        T, T_rot = temperatures
        loss = impact_moments(gas.reduced_law, jnp.sqrt(T), 3)[0, 0] / (3 * jnp.sqrt(2 * jnp.pi))
        both = eta**2 * (T + T_rot / q)
        lost = jnp.stack([loss * T + 4 / 3 * (eta * T - both), 4 / 3 / q * (eta * T_rot - both)])
        return -jnp.sqrt(T) * lost

    found = solve_ivp(rates, (0, 3), [1, 10], t_eval=taus, rtol=1e-10, atol=1e-12).y
    expected = float(gas.temperature) * found
    np.testing.assert_allclose(curve.temperature, expected[0], rtol=1e-7)  # table 1e-9, solvers
    np.testing.assert_allclose(curve.rotational_temperature, expected[1], rtol=1e-7)


@pytest.mark.slow
def test_the_choice_of_a_model_says_how_near_walls_would_be():
    gas = glass_beads(packing_fraction=0.01)
    choice = jaxgran.choose_model(gas, [10 * float(gas.mean_free_time)], num_particles=200)
    long = float(gas.box_side(200) / gas.mean_free_path)
    assert any(f"is {long:.2g} mean free paths long: if it has walls" in r for r in choice.reasons)
