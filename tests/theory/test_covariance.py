"""The covariance of one run: closed forms, limits, derivatives, bad input."""

from dataclasses import replace
from math import gamma

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.models.linearise import with_neutral_elements
from jaxgran.scene.reduced import reduced_scene
from jaxgran.theory import covariance
from jaxgran.theory.averages import loss_moments
from jaxgran.theory.density import Density
from jaxgran.theory.elements import element_rates
from jaxgran.theory.moments import Spins
from tests.beads import glass_beads, hard_gas, without

THEORY = jaxgran.KineticTheory(corrections=without("softness", "correlations"))
ROUGH = jaxgran.Rough(0.2, rotational_temperature=6e-3)
SLIDING = replace(ROUGH, friction=jnp.asarray(0.2))
WALLS = jaxgran.Walls([0.05, 0.06, 0.08], restitution=0.8, tangential_restitution=0.2)
DRAG = jaxgran.StokesDrag(1.0, rotational_rate=2.0)
GASES = {
    "smooth": glass_beads(),
    "disks": glass_beads(dimension=2),
    "constant": hard_gas(0.8),
    "series": replace(glass_beads(), law=jaxgran.RestitutionSeries([-0.3, 0.1], [0.2, 0.4])),
    "rough": replace(glass_beads(), surface=ROUGH),
    "from rest": replace(glass_beads(), surface=jaxgran.Rough(0.2, friction=0.2)),
    "walls": replace(glass_beads(), container=jaxgran.Walls(0.05, restitution=0.8)),
    "driven": replace(glass_beads(), drive=jaxgran.WhiteNoise(0.05)),
    "all": replace(glass_beads(), surface=SLIDING, container=WALLS, drag=DRAG),
}
LONG = {"rough": pytest.mark.slow, "from rest": pytest.mark.slow, "all": pytest.mark.minutes}


def taus(gas, *values):
    """Times in mean free times."""
    return np.array(values) * float(gas.mean_free_time)


# --- closed forms -------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [0.0, 0.2, 0.5])
def test_spread_of_losses_of_a_power_law(power):
    class Loss(jaxgran.extend.RestitutionLaw):
        power: float

        def restitution(self, normal_speed):
            return jnp.sqrt(1 - 1e-3 * normal_speed**self.power)

    law = replace(hard_gas(), law=Loss(power)).reduced_law
    mean, square = loss_moments(law, jnp.ones(()))
    # <v^n> is in proportion to Gamma(1 + n/2) 2^(n/2); 1e-3 of the mean by the quadrature.
    expected = gamma(3 + power) / gamma(2 + power / 2) ** 2
    assert float(square / mean**2) == pytest.approx(expected, rel=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smooth", "disks", "constant", "series"])
def test_smooth_spheres_have_one_quadrature(name):
    gas = GASES[name]
    times = taus(gas, 0.3, 1, 3, 10, 30, 100, 300)
    fine = np.concatenate(
        [np.linspace(0, times[0], 50)[:-1], np.geomspace(times[0], times[-1], 999)]
    )
    curve, along = jax.jvp(
        lambda T: jaxgran.cool(gas.replace(temperature=T), fine, model=THEORY),
        (gas.temperature,),
        (gas.temperature,),
    )
    phi = along.temperature / curve.temperature
    zeta = -np.gradient(np.log(curve.temperature), fine, edge_order=2)
    omega = np.gradient(curve.collisions, fine, edge_order=2)
    speed = np.sqrt(curve.temperature / gas.temperature)
    mean, square = jax.vmap(lambda v, a: loss_moments(gas.reduced_law, v, a))(speed, curve.sonine)
    rate = 2 * np.asarray(square / mean**2) * zeta**2 / (omega * np.asarray(phi) ** 2)
    integral = np.concatenate([[0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(fine))])
    at = np.searchsorted(fine, times * (1 - 1e-12))
    earlier = np.minimum.outer(np.arange(7), np.arange(7))
    expected = np.outer(phi[at], phi[at]) * integral[at][earlier]
    # The memory of a_2, which Phi has: 1 %.
    np.testing.assert_allclose(THEORY.covariance(gas, times, 1), expected, rtol=0.015)


@pytest.mark.parametrize("name", ["smooth", "rough", "all"])
def test_mean_rates_are_those_of_the_equations(name):
    gas = GASES[name]
    scene, d, a2 = reduced_scene(gas), gas.dimension, jnp.asarray(0.0)
    speed = jnp.asarray(0.7)
    spins = Spins(jnp.asarray(0.4), None, None)
    mean = covariance.Mean(2 * jnp.log(speed), a2, jnp.zeros(()), spins)
    kinds = [covariance.collisions(scene, Density(), speed, mean, d)]
    if scene.walls is not None:
        kinds.append(covariance.wall_impacts(scene.walls, scene.surface, speed, d))
    A = 2 * spins.rotation / (1.0 if scene.surface is None else scene.surface.inertia)
    S = jnp.asarray(2.0)
    each = [covariance.energy_moments(x, scene.surface, S, A, d)[0] for x in kinds]
    gains = jnp.sum(jnp.stack(each), axis=0)
    spins = Spins.gaussian(spins.rotation)
    without_drag = scene._replace(drag=None)
    elements = element_rates(without_drag, speed, spins, a2, d, gaussian_spins=True)
    loss = kinds[0].rate * loss_moments(scene.law, speed)[0] / d
    # Averages by 8 nodes instead of 32.
    assert float(-2 / d * gains[0]) == pytest.approx(float(loss + elements.cooling), rel=2e-3)
    if scene.surface is not None:
        turned = float(2 / 3 * gains[1])
        assert turned == pytest.approx(float(elements.spins.rotation), rel=2e-3, abs=1e-4)


@pytest.mark.slow
def test_a_driven_gas_forgets_and_reaches_the_variance_of_its_steady_state():
    gas = GASES["driven"]
    state = jaxgran.steady_state(gas)
    steady = gas.replace(temperature=state.temperature)
    zeta = float(gas.value("drive_strength") / state.temperature)
    # ln T relaxes at (1 + p) zeta; the last interval has 1000 such times, all of them 1e4.
    times = np.array([1.0, 2.0, 3.0, 1e3, 2e3, 1e4]) / zeta
    found = np.asarray(jaxgran.KineticTheory().covariance(gas, times, 250))
    model = jaxgran.KineticTheory()
    rate, slope = jax.jvp(
        lambda x: model.cooling_rate(steady.replace(temperature=state.temperature * jnp.exp(x))),
        (jnp.zeros(()),),
        (jnp.ones(()),),
    )
    p = float(slope / rate)
    mean, square = loss_moments(steady.reduced_law, jnp.ones(()), state.sonine)
    omega = float(steady.collision_frequency)
    noise = 2 * float(square / mean**2) * zeta**2 / omega + 4 * zeta / 3
    expected = noise / (2 * (1 + p) * zeta) / 250
    # 1 %: a_2, softness and correlations in the losses.
    np.testing.assert_allclose(np.diag(found)[-3:], expected, rtol=0.01)
    assert abs(found[-1, -2]) < 1e-12 * expected
    # Over one relaxation it has lost e times.
    decay = np.log(found[1, 1] / found[2, 1]) / (1 + p)
    assert decay == pytest.approx(1.0, rel=0.1)  # T is 10 % from steady at first


@pytest.mark.slow
def test_walls_take_regularly():
    # Elastic spheres between walls that take little: the variance of what they take in a time t
    # over the Poissonian one, as the constants say (and with the tail of the oscillator, 1/t).
    gas = replace(hard_gas(1.0, 0.01), container=jaxgran.Walls(20.0, restitution=1 - 1e-4))
    times = 19.0 * np.array([0.1, 0.2, 0.4, 1.6])
    curve = jaxgran.cool(gas, times, model=THEORY)
    found = np.diag(np.asarray(THEORY.covariance(gas, times, 1)))
    lost = -np.log(np.asarray(curve.temperature))
    # A loss has the mean square 2 <x>^2, as v_n^2 is exponential.
    impacts = lost / (2 / 3 * (1 - (1 - 1e-4) ** 2))
    np.testing.assert_allclose(found / (2 * lost**2 / impacts), [0.83, 0.63, 0.36, 0.2], atol=0.01)


# --- limits -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [pytest.param(name, marks=LONG.get(name, ())) for name in GASES])
def test_is_positive_symmetric_and_zero_at_the_start(name):
    gas = GASES[name]
    times = taus(gas, 0.0, 1e-3, 0.1, 0.2, 1, 2, 5, 10, 11, 12, 100, 1e3)
    rotation = gas.surface is not None
    found = np.asarray(jaxgran.KineticTheory().covariance(gas, times, 250, rotation=rotation))
    assert found.shape == (24, 24) if rotation else (12, 12)
    np.testing.assert_array_equal(found, found.T)
    assert np.all(found[0] == 0)
    scale = np.sqrt(np.maximum(np.diag(found), 1e-300))
    spread = np.linalg.eigvalsh(found / np.outer(scale, scale))
    assert spread[0] > -1e-12 * spread[-1]  # rounding
    if rotation:  # T alone is the same
        alone = jaxgran.KineticTheory().covariance(gas, times, 250)
        np.testing.assert_allclose(found[:12, :12], alone, rtol=1e-10)


@pytest.mark.parametrize("name", ["smooth", "constant"])  # with drag T has no float so late
def test_holds_over_many_decades(name):
    gas = GASES[name]
    found = np.asarray(jaxgran.KineticTheory().covariance(gas, taus(gas, 1e6, 1e8), 250))
    assert np.all(np.isfinite(found)) and np.all(np.diag(found) > 0)
    if name == "constant":  # d ln T/dt = -2/t and r = 2 at last: the variance tends to a constant
        # ln T = -2 ln t has the noise of the clock: C' = -C zeta/... ; Haff: Var = 2 zeta/(omega N)
        expected = 2 * 2 * (1 - 0.8**2) / 3 / 250
        assert found[1, 1] == pytest.approx(expected, rel=0.03)  # a_2: r and p


def test_elastic_spheres_do_not_scatter():
    gas = hard_gas(1.0)
    assert np.all(np.asarray(THEORY.covariance(gas, taus(gas, 1, 10), 250)) == 0)


def test_does_not_depend_on_units():
    one, other = hard_gas(0.8), hard_gas(0.8, diameter=3e-3, mass=2e-6, temperature=0.05)
    found = [THEORY.covariance(gas, taus(gas, 1, 10, 100), 1) for gas in (one, other)]
    np.testing.assert_allclose(*found, rtol=1e-9)


@pytest.mark.slow
def test_the_variance_goes_as_one_over_n():
    gas = GASES["all"]
    one, many = (THEORY.covariance(gas, taus(gas, 1, 10), n) for n in (1, 250))
    np.testing.assert_allclose(one / 250, many, rtol=1e-14)


@pytest.mark.slow
def test_few_times_give_what_many_give():
    gas = GASES["all"]
    few, many = taus(gas, 2.0, 50.0), taus(gas, *np.sort(np.r_[np.geomspace(0.01, 49, 300), 2, 50]))
    at = np.searchsorted(many, few * (1 - 1e-12))
    found = THEORY.covariance(gas, few, 1, rotation=True)
    rows = np.concatenate([at, at + many.size])
    dense = np.asarray(THEORY.covariance(gas, many, 1, rotation=True))[np.ix_(rows, rows)]
    # J and Q are interpolated linearly between 97 times.
    np.testing.assert_allclose(found, dense, rtol=3e-3)


@pytest.mark.slow
def test_elements_without_effect_change_nothing():
    gas, model = GASES["smooth"], THEORY.simplified_for(GASES["smooth"])
    times = taus(gas, 1, 10, 100)
    plain, all_of_them = (
        model.covariance(x, times, 250) for x in (gas, with_neutral_elements(gas, model))
    )
    np.testing.assert_allclose(plain, all_of_them, rtol=1e-9)


# --- as a part of compiled programs -------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smooth", pytest.param("all", marks=pytest.mark.minutes)])
def test_derivatives_agree(name):
    gas = GASES[name]
    names = {"dissipative_constant": 1e-4, "packing_fraction": 1e-4}
    if name == "all":
        names |= {"tangential_restitution": 1e-4, "friction": 1e-4, "wall_coefficient": 1e-5}
    times, rotation = taus(gas, 0, 0.5, 2, 10, 50), gas.surface is not None

    @jax.jit
    def values(x):
        changed = gas.replace(**dict(zip(names, x, strict=True)))
        return THEORY.covariance(changed, times, 1, rotation=rotation)

    x = jnp.stack([gas.value(name) for name in names])
    forward = jax.jit(jax.jacfwd(values))(x)
    assert np.all(np.isfinite(forward))
    weights = jax.random.normal(jax.random.key(0), forward.shape[:-1])
    reverse = jax.jit(jax.grad(lambda x: jnp.sum(weights * values(x))))(x)
    np.testing.assert_allclose(reverse, jnp.einsum("ij,ijk->k", weights, forward), rtol=1e-8)
    for k, share in enumerate(names.values()):
        step = share * x[k]
        change = (values(x.at[k].add(step)) - values(x.at[k].add(-step))) / (2 * step)
        # Steps of 1e-4 have errors of 1e-8; the solver's tolerance is 1e-10 over the step.
        scale = np.max(np.abs(forward[..., k]))
        np.testing.assert_allclose(change, forward[..., k], atol=1e-4 * scale)


@pytest.mark.slow
def test_a_batch_is_computed_in_one_program():
    gas = GASES["smooth"]
    A = gas.dissipative_constant * jnp.array([0.9, 1.0, 1.1])
    times = taus(gas, 1, 10)
    batch = jax.jit(
        jax.vmap(lambda A: THEORY.covariance(gas.replace(dissipative_constant=A), times, 250))
    )(A)
    for found, a in zip(batch, A, strict=True):
        alone = THEORY.covariance(gas.replace(dissipative_constant=a), times, 250)
        np.testing.assert_allclose(found, alone, rtol=1e-6)


@pytest.mark.slow
def test_single_precision():
    gas, double = GASES["rough"], GASES["rough"]
    times = taus(gas, 1, 10, 100)
    expected = THEORY.covariance(double, times, 250, rotation=True)
    with jax.enable_x64(False):
        single = jax.tree.map(lambda x: jnp.asarray(np.asarray(x, np.float32)), gas)
        found = THEORY.covariance(single, times.astype(np.float32), 250, rotation=True)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=3e-3)  # rounded differences over their step


# --- bad input ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values, message",
    [
        ({"num_particles": 0}, "num_particles"),
        ({"times": [2.0, 1.0]}, "must increase"),
        ({"times": [-1.0]}, "not negative"),
        ({"rotation": True}, "rough|Rough"),
    ],
)
def test_bad_input_is_refused(values, message):
    options = {"times": [1.0], "num_particles": 250, "rotation": False} | values
    with pytest.raises(ValueError, match=message):
        THEORY.covariance(GASES["smooth"], **options)
