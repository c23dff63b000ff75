"""Spheres of unequal sizes: sampled impacts, limits, bad input."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran._utils.tracing import fast_jit
from jaxgran.fitting.kalman import Nodes, filtered
from jaxgran.fitting.rows import Noise
from jaxgran.scene.reduced import reduced_scene
from jaxgran.theory import sizes
from jaxgran.theory.density import Density
from jaxgran.theory.equations import Equations
from tests.beads import glass_beads, hard_gas, without

THEORY = jaxgran.KineticTheory(corrections=without("softness", "correlations"))


def of_sizes(gas, spread):
    return replace(gas, diameter_sd=spread * gas.diameter)


def taus(gas, *values):
    """Times in mean free times."""
    return np.array(values) * float(gas.mean_free_time)


@pytest.mark.slow
def test_corrections_of_impacts_leave_the_drag_as_it_is():
    gas = of_sizes(glass_beads(0.3, packing_fraction=0.2), 0.15)
    dragged = replace(gas, drag=jaxgran.StokesDrag(0.1 / gas.mean_free_time))
    equations = Equations(3, 2, maxwellian=False, spreading=False, sizes=True)
    rates = []
    for density in (Density(), Density.from_gas(gas)):
        for scene in (reduced_scene(gas), reduced_scene(dragged)):
            both = scene, density
            state = equations.initial(both, jnp.zeros(1))
            state = state.at[equations.names.index("collisions")].set(20.0)
            state = state.at[equations.names.index("size_ratio")].set(0.3)
            at_state = equations.table(both, jnp.asarray(1.0))(state[0])
            rates.append(float(equations.derivative(state, at_state, both)[0]))
    of_drag = rates[1] - rates[0]
    assert abs(rates[2] / rates[0] - 1) > 0.01  # impacts are corrected
    assert rates[3] - rates[2] == pytest.approx(of_drag, rel=1e-10)


# --- impacts ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("eps", [1.0, 0.7])
def test_changes_are_those_of_sampled_impacts(dimension, eps):
    spread, q, n = 0.15, 0.6, 400_000
    gas = of_sizes(hard_gas(eps, dimension=dimension), spread)
    reduced = reduced_scene(gas).sizes
    T = np.asarray(sizes.partial_temperatures(jnp.asarray(q)))
    masses = np.asarray(reduced.masses)
    rng = np.random.default_rng(0)
    changes, squares = np.zeros(2), np.zeros((2, 2))
    errors, square_errors = np.zeros(2), np.zeros((2, 2))
    for pair, frequency in zip(sizes.PAIRS, np.asarray(reduced.frequency), strict=True):
        i, j = pair
        w = T[i] + T[j]
        u = np.sqrt(w * 2 * rng.exponential(1, n))
        centre = T[i] / w * u + np.sqrt(T[i] * T[j] / w) * rng.normal(size=n)
        other = centre - u
        share = masses[j] / (masses[i] + masses[j])
        of_i = (centre - share * (1 + eps) * u) ** 2 - centre**2
        of_j = (other + (1 - share) * (1 + eps) * u) ** 2 - other**2
        sums = np.zeros((2, n))
        sums[i] += of_i
        sums[j] += of_j
        rate = frequency * np.sqrt(w / 2) * float(sizes.collision_rate(0.0, dimension))
        products = sums[:, None] * sums[None]
        changes += rate * sums.mean(1)
        errors += (rate * sums.std(1)) ** 2 / n
        squares += rate * products.mean(2)
        square_errors += (rate * products.std(2)) ** 2 / n
    one = jnp.ones(())
    found = sizes.pair_rates(reduced, one, jnp.asarray(q), 0.0, dimension)
    assert np.all(np.abs(found.changes - changes) < 4 * np.sqrt(errors))
    assert np.all(np.abs(found.squares - squares) < 4 * np.sqrt(square_errors))


@pytest.mark.parametrize("make", [glass_beads, lambda: glass_beads(dimension=2)])
def test_rates_without_a_spread_are_those_of_equal_spheres(make):
    gas = make()
    scene = reduced_scene(of_sizes(gas, 0.0))
    speed, a2, d = jnp.asarray(0.8), jnp.asarray(-0.02), gas.dimension
    found = sizes.pair_rates(scene.sizes, speed, jnp.zeros(()), a2, d)
    of_T, of_ratio = sizes.variable_changes(jnp.zeros(()), d) @ found.changes
    expected = sizes.equal_rates(scene.law, speed, a2, d)
    assert float(of_T) == pytest.approx(float(expected), rel=1e-12)
    assert abs(float(of_ratio)) < 1e-12


# --- curves -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_no_spread_is_equal_spheres():
    gas = glass_beads()
    times = taus(gas, 0.3, 3, 30, 300)
    equal, other = (jaxgran.cool(x, times, model=THEORY) for x in (gas, of_sizes(gas, 0.0)))
    np.testing.assert_allclose(other.temperature, equal.temperature, rtol=1e-7)
    np.testing.assert_allclose(other.collisions, equal.collisions, rtol=1e-7)
    np.testing.assert_allclose(other.size_ratio, 1, rtol=1e-12)
    assert equal.size_ratio is None and other.diffusion is None and other.displacement is None
    equal, other = (np.asarray(THEORY.covariance(x, times, 250)) for x in (gas, of_sizes(gas, 0.0)))
    np.testing.assert_allclose(other, equal, rtol=1e-5)


@pytest.mark.slow
def test_elastic_spheres_reach_equipartition_at_constant_energy():
    spread = 0.15
    gas = of_sizes(hard_gas(1.0, 0.01), spread)
    times = taus(gas, 0.1, 1, 10, 100)
    curve = jaxgran.cool(gas, times, model=THEORY)
    masses = np.array([1 - spread, 1 + spread]) ** 3
    assert float(curve.size_ratio[-1]) == pytest.approx(masses[1] / masses[0], rel=1e-6)
    ratio = sizes.energy_ratio(spread, jnp.log(curve.size_ratio))
    np.testing.assert_allclose(ratio * curve.temperature, gas.temperature, rtol=1e-7)
    # The energy is exactly constant, but for the first exchange: it is T_0 at q = 0 on average.
    found = np.asarray(THEORY.covariance(gas, times, 250, energy=True))
    start = 8 / 3 / 250 * float(sizes.energy_slope(jnp.asarray(spread), jnp.zeros(()))) ** 2
    np.testing.assert_allclose(found, start, rtol=2e-2)


def test_rates_are_even_in_the_spread():
    gas = glass_beads()
    times = taus(gas, 3, 30)
    T = [
        np.log(jaxgran.cool(of_sizes(gas, s), times, model=THEORY).temperature)
        for s in (0.0, 0.02, 0.04)
    ]
    np.testing.assert_allclose((T[2] - T[0]) / (T[1] - T[0]), 4, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("make", [glass_beads, lambda: glass_beads(dimension=2)])
def test_derivatives_in_the_spread_agree(make):
    gas = of_sizes(make(), 0.1)
    times = taus(gas, 0.5, 3, 30)

    def log_T(diameter_sd):
        curve = jaxgran.cool(gas.replace(diameter_sd=diameter_sd), times, model=THEORY)
        return jnp.log(curve.temperature)

    forward = jax.jacfwd(log_T)(gas.diameter_sd)
    step = 1e-3 * gas.diameter_sd
    difference = (log_T(gas.diameter_sd + step) - log_T(gas.diameter_sd - step)) / (2 * step)
    np.testing.assert_allclose(forward, difference, rtol=1e-4)
    np.testing.assert_allclose(jax.jacrev(log_T)(gas.diameter_sd), forward, rtol=1e-6)


def test_drag_alone_slows_small_spheres_more():
    spread, rate = 0.1, 2.0
    gas = of_sizes(hard_gas(1.0, 1e-9), spread)
    gas = replace(gas, drag=jaxgran.StokesDrag(rate))
    times = np.array([0.1, 0.3])
    curve = jaxgran.cool(gas, times, model=THEORY)
    parts = [np.exp(-2 * rate * times / (1 + sign * spread) ** 2) for sign in (-1, 1)]
    np.testing.assert_allclose(curve.temperature / gas.temperature, np.mean(parts, 0), rtol=1e-5)
    np.testing.assert_allclose(curve.size_ratio, parts[0] / parts[1], rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("energy", [False, True])
def test_the_filter_is_the_covariance(energy):
    gas = of_sizes(glass_beads(), 0.15)
    times = taus(gas, *np.concatenate([[0.0], np.geomspace(0.05, 50, 60)]))
    curve = jaxgran.cool(gas, times, model=THEORY)
    q = jnp.log(curve.size_ratio)
    slope = sizes.energy_slope(gas.diameter_sd / gas.diameter, q) if energy else jnp.zeros_like(q)

    def one(x):
        return jnp.asarray(x)[:, None]

    log_T = jnp.log(curve.temperature)
    nodes = Nodes(
        one(log_T), 0 * one(log_T), curve.sonine, one(curve.collisions), one(q), one(slope)
    )
    residual = np.random.default_rng(0).normal(size=times.size) * 0.01
    residuals = np.zeros((times.size, 2, 1, 1))
    residuals[:, 0, 0, 0] = residual
    variances = np.full((times.size, 2, 1), 1e-4)
    used = np.stack([np.arange(times.size) > 0, np.zeros(times.size)], axis=1).astype(float)
    zero = jnp.zeros(())
    noise = Noise(jnp.full(1, 1 / 250), zero, jnp.zeros(times.size), zero, zero)
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], gas)
    found, spread = fast_jit(filtered, jax.default_backend())(
        batch,
        nodes,
        jnp.asarray(residuals),
        jnp.asarray(variances),
        one(q) * 0 + 1,
        jnp.asarray(used),
        noise,
    )
    chi2 = np.sum(np.asarray(found[1:, 0, 0, 0]) ** 2 / np.asarray(spread[1:, 0, 0]))
    model = jaxgran.KineticTheory()
    C = np.asarray(model.covariance(gas, times, 250, energy=energy))[1:, 1:]
    C = C + 1e-4 * np.eye(times.size - 1)
    expected = residual[1:] @ np.linalg.solve(C, residual[1:])
    # Both interpolate J and Q, between these nodes and between 97 times.
    assert chi2 == pytest.approx(expected, rel=5e-3)
    log_det = np.sum(np.log(np.asarray(spread[1:, 0, 0])))
    assert log_det == pytest.approx(np.linalg.slogdet(C)[1], abs=0.02 * times.size**0.5)


# --- the scene ----------------------------------------------------------------------------------


def test_packing_fraction_is_the_volume_of_the_spheres():
    gas = glass_beads()
    spheres = of_sizes(gas, 0.15)
    assert float(gas.number_density / spheres.number_density) == pytest.approx(1 + 3 * 0.15**2)
    disks = glass_beads(dimension=2)
    ratio = disks.number_density / of_sizes(disks, 0.15).number_density
    assert float(ratio) == pytest.approx(1 + 0.15**2)


@pytest.mark.parametrize(
    "elements",
    [
        {"surface": jaxgran.Rough(0.2)},
        {"container": jaxgran.Walls(0.05, restitution=0.8)},
        {"drive": jaxgran.WhiteNoise(0.05)},
    ],
)
def test_elements_without_a_theory_are_refused(elements):
    gas = replace(of_sizes(glass_beads(), 0.1), **elements)
    with pytest.raises(ValueError, match=f"diameter_sd together with {[*elements][0]}.*Set"):
        jaxgran.cool(gas, taus(gas, 1.0))


@pytest.mark.parametrize("model", [jaxgran.DSMC, jaxgran.HardSpheres, jaxgran.SoftSpheres])
def test_models_of_equal_spheres_refuse(model):
    gas = of_sizes(glass_beads(), 0.1)
    with pytest.raises(ValueError, match=r"equal spheres.*diameter_sd.*Use KineticTheory"):
        jaxgran.cool(gas, taus(gas, 1.0), model=model(64))


def test_a_wide_spread_is_refused():
    gas = glass_beads()
    with pytest.raises(ValueError, match=r"diameter_sd is 0\.21 of the diameter, at most 0\.2"):
        of_sizes(gas, 0.21)
    wide = of_sizes(gas, 0.1).replace(diameter_sd=0.25 * gas.diameter)
    with pytest.raises(ValueError, match="at most 0.2"):
        jaxgran.cool(wide, taus(gas, 1.0))
    with pytest.raises(ValueError, match="diameter_sd must lie in"):
        of_sizes(gas, -0.1)
