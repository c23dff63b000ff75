import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.models.dsmc import DSMC
from jaxgran.particles.dsmc import collisions
from jaxgran.particles.dsmc.collisions import Scheme, draw_pairs
from tests.beads import hard_gas

# Hard spheres: kinetic theory without the correction for soft contacts.
THEORY = jaxgran.KineticTheory(softness=False, correlations=False)

# Scatter of one run times sqrt(N), over 60 replicas at beta = .05 and .15, d = 2 and 3.
T_SCATTER, SONINE_SCATTER, MSD_SCATTER = 0.55, 0.7, 1.0

SENSITIVITY = {1.0: -0.07813, 5.0: -0.3193, 10.0: -0.52054, 50.0: -1.05837, 100.0: -1.22284}
"""d ln T / d ln A, 3D, beta_T0 = .15, of kinetic theory."""


def constant(eps, dimension=3) -> jaxgran.Gas:
    return hard_gas(eps, 0.1, dimension, diameter=2.0, temperature=3.0)


@pytest.mark.parametrize(
    "beta, dimension", [(0.05, 3), pytest.param(0.15, 2, marks=pytest.mark.slow)]
)
def test_cools_and_spreads_as_kinetic_theory_says(beads, beta, dimension):
    gas, n = beads(beta, dimension), 10_000
    taus = np.concatenate([[1.0, 10.0], np.arange(20.0, 101.0, 2.0)])
    times = taus * float(gas.mean_free_time)
    theory, curve = (jaxgran.cool(gas, times, model=model) for model in (THEORY, DSMC(n)))
    tolerance = 0.002 + 3 * T_SCATTER / n**0.5
    assert np.all(np.abs(curve.temperature / theory.temperature - 1) < tolerance)
    # Collisions in the gas's own clock: as good as ln T.
    assert np.all(np.abs(curve.collisions / theory.collisions - 1)[1:] < tolerance)
    # D in the second Sonine order is within .5 %; another .5 % for the steps of early times.
    excess = np.asarray(curve.displacement / theory.displacement - 1)
    assert np.all(np.abs(excess) < 0.01 + 3 * MSD_SCATTER / n**0.5)
    # a_2 forgets in some 2.5 mean free times: the mean over 80 errs by 1/4 of one value.
    a2, expected = (np.mean(x.sonine[2:]) for x in (curve, theory))
    # Theory's is within 3 %.
    assert abs(a2 - expected) < 0.03 * abs(expected) + 3 * SONINE_SCATTER / n**0.5 / 4


@pytest.mark.slow
def test_sonine_coefficient_of_constant_restitution():
    # a_2 and its error of a table of stochastic simulation.
    eps, dimension, a2, error = 0.5, 3, 0.0476, 4e-4
    gas, n = constant(eps, dimension), 50_000
    cooling = (1 - eps**2) / dimension
    taus = np.arange(10.0, 50.0, 1.0)
    u = np.expm1(cooling * taus / 2) / (cooling / 2)  # t of tau collisions per particle
    curve = jaxgran.cool(gas, u * float(gas.mean_free_time), model=DSMC(n))
    scatter = 1.5 * SONINE_SCATTER / n**0.5  # the tail of eps = .5 makes the scatter larger
    assert abs(float(np.mean(curve.sonine)) - a2) < 2 * error + 3 * scatter / 3
    # Haff's law in collisions: d ln T / d tau = -(1 - eps^2)/d (1 + 3 a_2/16 + a_2/16).
    slope = np.polyfit(curve.collisions, np.log(curve.temperature), 1)[0]
    # The table's own moments give the factor; noise of ln T over 40 collision times.
    expected = -cooling * (1 + a2 / 4)
    assert slope == pytest.approx(expected, rel=0.002 + 3 * T_SCATTER / n**0.5 / (cooling * 40))


def test_elastic_gas_keeps_its_energy_and_its_maxwellian():
    gas, n = constant(1.0), 50_000
    times = np.array([1.0, 10.0, 20.0]) * float(gas.mean_free_time)
    curve = jaxgran.cool(gas, times, model=DSMC(n))
    np.testing.assert_allclose(curve.temperature, 3.0, rtol=1e-12)  # 1e6 rounded kicks
    assert np.all(np.abs(curve.sonine) < 3 * SONINE_SCATTER / n**0.5)
    theory = jaxgran.cool(gas, times, model=THEORY)
    # D of all Sonine orders is 1.002 of that of the second one.
    ratio = curve.displacement[-1] / theory.displacement[-1]
    assert ratio == pytest.approx(1.002, abs=3 * MSD_SCATTER / n**0.5)
    # C decays by 2/3 per collision; sqrt(1 / 3N) is its noise.
    expected = 3.0 * np.exp(-2 / 3)
    assert curve.velocity_correlation[0] == pytest.approx(expected, rel=0.01)  # first order: 1 %
    np.testing.assert_allclose(curve.collisions, [1, 10, 20], rtol=3 * 1.3 / n**0.5)


@pytest.mark.parametrize("n", [2, 64, 101])
def test_every_pair_is_about_equally_likely(n):
    scheme = Scheme.of(3, n, 0.1)

    def drawn(key):
        i, j, k = draw_pairs(jax.random.bits(key, (4,)), scheme)
        one = jnp.stack([i, j])
        return jnp.concatenate([one, jnp.stack([i[: scheme.second], k])], axis=1)

    draws = jax.vmap(drawn)(jax.random.split(jax.random.key(0), 4000))
    i, j = np.moveaxis(np.asarray(draws), 1, 0)
    for row_i, row_j in zip(i[:50], j[:50], strict=True):
        first = np.concatenate([row_i[: scheme.first], row_j])
        assert len(set(first)) == len(first)  # nobody twice, save the second pairs' first ones
    pairs = np.zeros((n, n))
    np.add.at(pairs, (np.minimum(i, j), np.maximum(i, j)), 1)
    counts = pairs[np.triu_indices(n, 1)]
    assert counts.sum() == i.size
    # Poisson counts: 6 standard deviations hold for the largest of thousands, and of few.
    mean = counts.mean()
    assert np.max(counts) < mean + 6 * mean**0.5 + 8 and np.min(counts) > mean - 6 * mean**0.5 - 1
    # What pairs scatter by beyond that: nothing for a prime N, else less than 20 %.
    beyond = (np.mean((counts - mean) ** 2) / mean - 1) / mean
    error = ((2 + 1 / mean) / counts.size) ** 0.5 / mean
    assert beyond < 5 * error + (0.0 if n == 101 else 0.2**2)
    # Each particle as often as any other.
    each = (pairs.sum(0) + pairs.sum(1)) / (2 * i.size / n)
    assert np.all(np.abs(each - 1) < 6 / (2 * i.size / n) ** 0.5)


@pytest.mark.slow
def test_the_step_is_second_order(monkeypatch):
    # Memory of the first velocity, 2/3 (1 + eps)/2 per collision, feels the step most.
    gas, n = constant(0.6), 200_000
    times = [1.0 * float(gas.mean_free_time)]

    def memory(step):
        curve = jaxgran.cool(gas, times, model=DSMC(n, step=step))
        return float(curve.velocity_correlation[0] / 3.0)

    fine, coarse = memory(0.025), memory(0.1)
    of = Scheme.of

    def disjoint(*arguments):
        scheme = of(*arguments)
        return scheme._replace(first=scheme.first + scheme.second, second=0)

    monkeypatch.setattr(Scheme, "of", staticmethod(disjoint))
    first_order = memory(0.1)
    # Measured over 3e6 particles: +.0009(6) at .1, -.0144(7) when pairs are only disjoint.
    noise = 1.6 / n**0.5  # of the ratio of two runs; 1.1 / sqrt(N) each was measured
    assert abs(np.log(coarse / fine)) < 2.5 * noise
    assert -0.0144 - 2.5 * noise < np.log(first_order / fine) < -0.0144 + 2.5 * noise


@pytest.mark.slow
def test_cools_by_six_decades():
    gas = constant(0.8)
    gamma = (1 - 0.8**2) / 6
    times = np.geomspace(1, (1e3 - 1) / gamma, 8) * float(gas.mean_free_time)
    model = DSMC(20_000)
    curve = jaxgran.cool(gas, times, model=model)
    theory = jaxgran.cool(gas, times, model=THEORY)
    assert theory.temperature[-1] < 1.2e-6 * gas.temperature
    # Late noise is that of the clock, which is that of T at half of its logarithm.
    assert np.all(np.abs(curve.temperature / theory.temperature - 1) < 0.02)


@pytest.mark.slow
def test_derivatives_are_those_of_kinetic_theory(beads):
    gas, taus = beads(0.15), jnp.asarray(list(SENSITIVITY))

    def logs(scales, model):
        """Logarithms of T, <dr^2> and the collision count, of a gas with scaled floats."""
        names = "dissipative_constant", "temperature", "packing_fraction"
        scaled = {n: gas.value(n) * jnp.exp(x) for n, x in zip(names, scales, strict=True)}
        curve = jaxgran.cool(gas.replace(**scaled), taus * gas.mean_free_time, model=model)
        return jnp.log(jnp.stack([curve.temperature, curve.displacement, curve.collisions]))

    ours, theory = (
        jax.jit(jax.jacfwd(lambda x, model=model: logs(x, model)))(jnp.zeros(3))
        for model in (DSMC(20_000), THEORY)
    )
    # 1 % at N = 4e4; the clock's part is theory's, to a_2's noise.
    np.testing.assert_allclose(ours[0, :, 0], list(SENSITIVITY.values()), rtol=0.03)
    np.testing.assert_allclose(ours[0], theory[0], rtol=0.03, atol=0.003)
    np.testing.assert_allclose(ours[2], theory[2], rtol=0.03, atol=0.003)
    # <dr.v> of 2e4 particles scatters by 3 %, and D is 2 % beyond the first Sonine order.
    np.testing.assert_allclose(ours[1], theory[1], rtol=0.06, atol=0.015)


@pytest.mark.slow
def test_says_when_impacts_are_too_fast(beads, monkeypatch):
    gas = beads(0.15)
    times = jnp.array([3.0]) * gas.mean_free_time
    monkeypatch.setattr(collisions, "CEILING", 2.0)  # many pairs are faster
    model = DSMC(1010, replicas=2)  # of a size that no program was compiled for before
    with pytest.raises(RuntimeError, match="many pairs are faster"):
        jaxgran.cool(gas, times, model=model)
    curve = jax.jit(lambda t: jaxgran.cool(gas, t, model=model))(times)
    assert np.isnan(curve.temperature[0])
    assert "many pairs are faster" in jaxgran.explain_status(curve.status)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"num_particles": 1}, "num_particles must be a whole number >= 2, an int, got 1"),
        ({"num_particles": 10, "replicas": 0}, "replicas must be a whole number >= 1"),
        ({"num_particles": 10, "step": 0.2}, r"step must lie in \(0, 0.1\], got 0.2"),
        ({"num_particles": 10, "step": "fine"}, "got 'fine'"),
    ],
)
def test_refuses_what_it_cannot_do(settings, message):
    with pytest.raises(ValueError, match=message):
        DSMC(**settings)


def test_keeps_no_checkpoint_in_compiled_code():
    def f(eps):
        curve = jaxgran.cool(constant(eps), [1.0], model=DSMC(100), checkpoint="run.npz")
        return curve.temperature[0]

    with pytest.raises(ValueError, match="DSMC cannot write a checkpoint.*Set checkpoint=None"):
        jax.jit(jax.grad(f))(0.6)


def test_each_of_a_few_particles_meets_the_others():
    # At rest as a whole, N particles have relative velocities of T N/(N-1) and N - 1 partners
    # each, of which sqrt(N/(N-1)) (N-1)/N remains: 1 - .5/N. Meeting N partners it would be
    # 1 + .5/N. 2000 gases of 20 make 40 000 collisions: a standard error of .5 %, less the 2.5 %.
    n, times = 20, np.array([1.0, 2.0])
    gas = constant(1.0)
    curve = jaxgran.cool(gas, times * float(gas.mean_free_time), model=DSMC(n, replicas=2000))
    rate = float(curve.collisions[-1]) / times[-1]
    assert abs(rate - (1 - 0.5 / n)) < 0.01
