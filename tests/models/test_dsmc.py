import dataclasses
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.models.dsmc import DSMC
from jaxgran.particles.dsmc import collisions, run
from jaxgran.particles.dsmc.collisions import Scheme, draw_pairs
from jaxgran.particles.dsmc.run import initial_dsmc_state
from jaxgran.scene.reduced import ReducedScene
from tests.beads import glass_beads

# Hard spheres: kinetic theory without the correction for soft contacts.
THEORY = jaxgran.KineticTheory(softness=False, correlations=False)

# Scatter of one run times sqrt(N), over 60 replicas at beta = .05 and .15, d = 2 and 3.
T_SCATTER, SONINE_SCATTER, MSD_SCATTER = 0.55, 0.7, 1.0

SENSITIVITY = {1.0: -0.07813, 5.0: -0.3193, 10.0: -0.52054, 50.0: -1.05837, 100.0: -1.22284}
"""d ln T / d ln A, 3D, beta_T0 = .15, of kinetic theory."""


def constant(eps, dimension=3) -> jaxgran.Gas:
    return jaxgran.Gas(
        jaxgran.ConstantRestitution(eps),
        diameter=2.0,
        mass=1.0,
        packing_fraction=0.1,
        temperature=3.0,
        dimension=dimension,
    )


TAUS = np.concatenate([[1.0, 10.0], np.arange(20.0, 101.0, 2.0)])


def theory_and_dsmc(gas, n, **settings):
    times = TAUS * float(gas.mean_free_time)
    return tuple(jaxgran.cool(gas, times, model=m) for m in (THEORY, DSMC(n, **settings)))


def compare_all_but_temperature(theory, curve, n, tolerance):
    # D in the second Sonine order is within .5 %; another .5 % for the steps of early times.
    excess = np.asarray(curve.displacement / theory.displacement - 1)
    assert np.all(np.abs(excess) < 0.01 + 3 * MSD_SCATTER / n**0.5)
    # a_2 forgets in some 2.5 mean free times: the mean over 80 errs by 1/4 of one value.
    late = TAUS >= 20
    a2, expected = np.mean(curve.sonine[late]), np.mean(theory.sonine[late])
    # Theory's is within 3 %.
    assert abs(a2 - expected) < 0.03 * abs(expected) + 3 * SONINE_SCATTER / n**0.5 / 4
    # Collisions in the gas's own clock: as good as ln T.
    assert np.all(np.abs(curve.collisions / theory.collisions - 1)[1:] < tolerance)


SCENES = [(0.05, 3), (0.15, 3), (0.15, 2)]
OFTEN = [SCENES[0], *(pytest.param(*scene, marks=pytest.mark.slow) for scene in SCENES[1:])]


@pytest.mark.parametrize("beta, dimension", OFTEN)
def test_cools_and_spreads_as_kinetic_theory_says(beads, beta, dimension):
    n = 20_000
    theory, curve = theory_and_dsmc(beads(beta, dimension), n)
    tolerance = 0.002 + 3 * T_SCATTER / n**0.5
    assert np.all(np.abs(curve.temperature / theory.temperature - 1) < tolerance)
    compare_all_but_temperature(theory, curve, n, tolerance)


@pytest.fixture(scope="module", params=SCENES, ids=str)
def million(request):
    return request.param, theory_and_dsmc(glass_beads(*request.param), 10**6, replicas=12)


@pytest.mark.slow
@pytest.mark.figures
def test_a_million_particles_cool_as_kinetic_theory_says(million, record):
    (beta, dimension), (theory, curve) = million
    off = np.asarray(curve.temperature / theory.temperature - 1)
    error = np.asarray(curve.temperature_error / curve.temperature)
    for tau in (10.0, 50.0, 100.0):
        at = tau == TAUS
        print(f"\nbeta {beta}, {dimension}D, {tau:g} mean free times: T over theory", end=" ")
        print(f"{100 * off[at].item():+.3f} +- {100 * error[at].item():.3f} %", end="")
    print(f"; at most {100 * np.abs(off).max():.3f} %")
    # .03 % are asked of the theory; besides, three times the scatter of 12 million.
    assert np.all(np.abs(off) < 3e-4 + 3 * T_SCATTER / (12e6) ** 0.5)
    some = np.isin(TAUS, (10.0, 50.0, 100.0))
    numbers = {"off": off[some].tolist(), "error": error[some].tolist()}
    record("dsmc_million", beta=beta, dimension=dimension, **numbers)


@pytest.mark.slow
def test_a_million_particles_spread_as_kinetic_theory_says(million):
    compare_all_but_temperature(*million[1], 10**6, 0.002)


# Tables of stochastic simulation, with their errors.
@pytest.mark.parametrize(
    "eps, dimension, a2, error",
    [
        (0.5, 3, 0.0476, 4e-4),
        pytest.param(0.8, 3, -0.0145, 3e-4, marks=pytest.mark.slow),
        pytest.param(0.9, 3, -0.0152, 2e-4, marks=pytest.mark.slow),
        (0.5, 2, 0.0733, 4e-4),
        pytest.param(0.9, 2, -0.0301, 3e-4, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    "replicas", [1, pytest.param(16, marks=[pytest.mark.slow, pytest.mark.figures])]
)
def test_sonine_coefficient_of_constant_restitution(eps, dimension, a2, error, replicas, record):
    gas, size = constant(eps, dimension), 50_000 if replicas == 1 else 100_000
    n = size * replicas
    cooling = (1 - eps**2) / dimension
    taus = np.arange(10.0, 50.0, 1.0)
    u = np.expm1(cooling * taus / 2) / (cooling / 2)  # t of tau collisions per particle
    curve = jaxgran.cool(gas, u * float(gas.mean_free_time), model=DSMC(size, replicas=replicas))
    scatter = 1.5 * SONINE_SCATTER / n**0.5  # the tail of eps = .5 makes the scatter larger
    found = float(np.mean(curve.sonine))
    print(f"\neps {eps}, {dimension}D, {n} particles: a_2 = {found:.5f}, {a2} +- {error} known")
    assert abs(found - a2) < 2 * error + 3 * scatter / 3
    # Haff's law in collisions: d ln T / d tau = -(1 - eps^2)/d (1 + 3 a_2/16 + a_2/16).
    slope = np.polyfit(curve.collisions, np.log(curve.temperature), 1)[0]
    # The table's own moments give the factor; noise of ln T over 40 collision times.
    expected = -cooling * (1 + a2 / 4)
    assert slope == pytest.approx(expected, rel=0.002 + 3 * T_SCATTER / n**0.5 / (cooling * 40))
    if replicas > 1:
        record("sonine", eps=eps, dimension=dimension, found=found, known=a2, known_error=error)


def test_elastic_gas_keeps_its_energy_and_its_maxwellian():
    gas, n = constant(1.0), 100_000
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


def state_after(gas, scheme, steps, replicas=1, key=0):
    key = jax.random.key_data(jax.random.key(key))
    state = initial_dsmc_state(key, replicas, scheme, 0)
    step = jax.jit(collisions.step, static_argnums=(4, 5))
    share = jnp.ones(replicas)
    for _ in range(steps):
        state = step(state, key, share, ReducedScene(gas.reduced_law), scheme, False)
    return state


@pytest.mark.parametrize("dimension", [2, 3])
def test_momentum_energy_and_speeds(dimension):
    gas = constant(0.7, dimension)
    state = state_after(gas, Scheme.of(dimension, 1001, 0.1), 100, replicas=2)
    velocity = np.asarray(state.particles[..., :dimension])
    assert np.all(np.abs(velocity.mean(axis=1)) < 1e-14)  # round-off of 1e4 kicks
    theta = 2 * np.mean(velocity**2, axis=(1, 2))
    assert np.all(theta < 0.5) and theta[0] != theta[1]
    np.testing.assert_allclose(state.temperature, theta, rtol=1e-12)  # of summed losses


@pytest.mark.parametrize("n", [2, 3, 64, 101, 1000])
def test_every_pair_is_about_equally_likely(n):
    scheme = Scheme.of(3, n, 0.1)

    def drawn(key):
        i, j, k = draw_pairs(jax.random.bits(key, (4,)), scheme)
        one = jnp.stack([i, j])
        return jnp.concatenate([one, jnp.stack([i[: scheme.second], k])], axis=1)

    draws = 4000 if n < 1000 else 20_000
    i, j = np.moveaxis(
        np.asarray(jax.vmap(drawn)(jax.random.split(jax.random.key(0), draws))), 1, 0
    )
    for row_i, row_j in zip(i[:50], j[:50], strict=True):
        first = np.concatenate([row_i[: scheme.first], row_j])
        assert len(set(first)) == len(first)  # nobody twice, save the second pairs' first ones
    pairs = np.zeros((n, n))
    np.add.at(pairs, (np.minimum(i, j), np.maximum(i, j)), 1)
    counts = pairs[np.triu_indices(n, 1)]
    assert counts.sum() == i.size
    # Poisson counts: 5 standard deviations hold for the largest of half a million, and of few.
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
@pytest.mark.figures
def test_the_order_of_the_step(monkeypatch, record):
    # The same memory, of 6.4 million particles at each step: pairs that may share a particle make
    # a step second order; with half of them, or none, it would be first order.
    gas, n, replicas = constant(0.6), 400_000, 16
    times = [1.0 * float(gas.mean_free_time)]
    of = Scheme.of

    def memory(step, shared, seed):
        def scheme(*arguments):
            made = of(*arguments)
            second = round(shared * made.second)
            return made._replace(first=made.first + made.second - second, second=second)

        monkeypatch.setattr(Scheme, "of", staticmethod(scheme))
        model = DSMC(n, replicas=replicas, step=step)
        curve = jaxgran.cool(gas, times, model=model, key=jax.random.key(seed))
        each = np.asarray(curve.replicas.velocity_correlation)
        return np.log(each[:, 0] / 3.0)

    fine = memory(0.0125, 1.0, 0)
    miss = {}
    for shared in (1.0, 0.5, 0.0):
        for step in (0.1, 0.05):
            own = memory(step, shared, 1)
            error = np.hypot(*(np.std(x, ddof=1) / replicas**0.5 for x in (own, fine)))
            off = np.mean(own) - np.mean(fine)
            miss[shared, step] = off, error
            print(f"\nshared {shared}, step {step}: off by {off:+.5f} +- {error:.5f}")
    for step in (0.1, 0.05):
        off, error = miss[1.0, step]
        assert abs(off) < 0.1 * step**2 + 3 * error  # .001 at .1
    for shared, slope in ((0.5, -0.07), (0.0, -0.144)):
        for step in (0.1, 0.05):
            off, error = miss[shared, step]
            # The second order of a step of .1 adds up to a fifth.
            assert off == pytest.approx(slope * step, abs=0.2 * abs(slope) * step + 3 * error)
    for (shared, step), (off, error) in miss.items():
        numbers = {"off": float(off), "error": float(error)}
        record("dsmc_order", shared=shared, step=step, **numbers)


@pytest.mark.slow
def test_other_times_change_nothing(beads):
    gas = beads(0.15)
    tau = float(gas.mean_free_time)
    few = jaxgran.cool(gas, [2 * tau], model=DSMC(1000, replicas=2))
    many = jaxgran.cool(gas, np.linspace(0, 2, 201) * tau, model=DSMC(1000, replicas=2))
    assert many.temperature[0] == pytest.approx(float(gas.temperature), rel=1e-14)
    assert many.temperature[-1] == few.temperature[0]
    assert np.all(np.diff(many.temperature) <= 1e-14 * gas.temperature)
    # Ballistic at first, also inside the first step.
    t = many.times[1]
    assert many.displacement[1] == pytest.approx(float(3 * gas.temperature * t**2), rel=0.02)


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


def test_replicas_are_runs_of_their_own(beads):
    gas = beads(0.15)
    times = np.array([1.0, 5.0]) * float(gas.mean_free_time)
    two = jaxgran.cool(gas, times, model=DSMC(1000, replicas=2), key=jax.random.key(0))
    assert two.replicas.temperature.shape == (2, 2)
    assert two.replicas.temperature[0, 1] != two.replicas.temperature[1, 1]
    other = jaxgran.cool(gas, times, model=DSMC(1000, replicas=2), key=jax.random.key(1))
    assert np.all(other.temperature != two.temperature)
    values = two.replicas.temperature[:, 1]
    expected = abs(values[0] - values[1]) / 2  # standard error of the mean of two
    assert two.temperature_error[1] == pytest.approx(float(expected), rel=1e-9)
    assert np.all(two.displacement_error > 0)


def test_resumes_bit_for_bit(beads, tmp_path, monkeypatch):
    gas = beads(0.15)
    times = np.array([0.3, 2.0, 4.0]) * float(gas.mean_free_time)
    file = tmp_path / "run.npz"
    whole = jaxgran.cool(gas, times, model=DSMC(1000, replicas=2))
    monkeypatch.setattr("jaxgran.particles.run.CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(run, "CHUNK", 1)
    compiled_advance, left = collisions.compiled_advance, [4]

    def dies(*args, **kwargs):
        left[0] -= 1
        if left[0] < 0:
            raise MemoryError("killed")
        return compiled_advance(False)(*args, **kwargs)

    monkeypatch.setattr(collisions, "compiled_advance", lambda donate: dies)
    with pytest.raises(MemoryError):
        jaxgran.cool(gas, times, model=DSMC(1000, replicas=2), checkpoint=file)
    assert file.exists()
    monkeypatch.setattr(collisions, "compiled_advance", compiled_advance)
    resumed = jaxgran.cool(gas, times, model=DSMC(1000, replicas=2), checkpoint=file)
    for name in ("temperature", "sonine", "displacement", "collisions", "velocity_correlation"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name))
    with pytest.raises(ValueError, match="another run"):
        jaxgran.cool(gas, 2 * times, model=DSMC(1000, replicas=2), checkpoint=file)


def test_jit_and_vmap_give_the_same_numbers(beads):
    gas = beads(0.15)
    times = np.array([0.5, 3.0]) * float(gas.mean_free_time)
    constants = gas.value("dissipative_constant") * jnp.array([0.2, 1.0])
    keys = jax.random.split(jax.random.key(5), 2)

    def run(a, key):
        changed = gas.replace(dissipative_constant=a)
        curve = jaxgran.cool(changed, times, model=DSMC(1000, replicas=2), key=key)
        return curve.temperature, curve.displacement, curve.status

    swept = jax.jit(jax.vmap(run))(constants, keys)
    assert np.all(swept[2] == 0)
    for i in range(2):
        alone = run(constants[i], keys[i])
        # Collisions without positions do not magnify round-off.
        np.testing.assert_allclose(swept[0][i], alone[0], rtol=1e-9)
        np.testing.assert_allclose(swept[1][i], alone[1], rtol=1e-9)


NAMES = "dissipative_constant", "temperature", "packing_fraction"


def logs(scale, gas, taus, model):
    """Logarithms of T, <dr^2> and the collision count, of a gas with scaled floats."""
    scaled = {name: gas.value(name) * jnp.exp(x) for name, x in zip(NAMES, scale, strict=True)}
    times = jnp.asarray(taus) * gas.mean_free_time
    curve = jaxgran.cool(gas.replace(**scaled), times, model=model)
    return jnp.log(jnp.stack([curve.temperature, curve.displacement, curve.collisions]))


@pytest.mark.slow
def test_derivatives_are_those_of_kinetic_theory(beads):
    gas, zero = beads(0.15), jnp.zeros(3)
    ours, theory = (
        jax.jit(jax.jacfwd(lambda x, m=model: logs(x, gas, list(SENSITIVITY), m)))(zero)
        for model in (DSMC(20_000), THEORY)
    )
    # 1 % at N = 4e4; the clock's part is theory's, to a_2's noise.
    np.testing.assert_allclose(ours[0, :, 0], list(SENSITIVITY.values()), rtol=0.03)
    np.testing.assert_allclose(ours[0], theory[0], rtol=0.03, atol=0.003)
    np.testing.assert_allclose(ours[2], theory[2], rtol=0.03, atol=0.003)
    # <dr.v> of 2e4 particles scatters by 3 %, and D is 2 % beyond the first Sonine order.
    np.testing.assert_allclose(ours[1], theory[1], rtol=0.06, atol=0.015)


def test_derivatives_are_those_of_the_runs(beads):
    gas, zero, taus, n = beads(0.15), jnp.zeros(3), [1.0, 5.0], 20_000
    at = partial(logs, gas=gas, taus=taus, model=DSMC(n))
    forward = jax.jit(jax.jacfwd(at))(zero)
    reverse = jax.jit(jax.jacrev(at))(zero)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12, atol=1e-12)  # one linear rule
    # The same random numbers on both sides; runs drift apart, which leaves sqrt(2) T_SCATTER.
    h = 0.3  # d^3 ln T / d (ln A)^3 is below one: h^2/6
    plain = jax.jit(at)
    up, down = (plain(jnp.array([x, 0.0, 0.0])) for x in (h, -h))
    difference = (up - down) / (2 * h)
    noise = 2.5 * 2**0.5 / n**0.5 / (2 * h)
    np.testing.assert_allclose(
        forward[0, :, 0], difference[0], rtol=0.02, atol=noise * T_SCATTER + h**2 / 60
    )
    np.testing.assert_allclose(forward[1, :, 0], difference[1], rtol=0.02, atol=noise * MSD_SCATTER)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["constant", "series"])
def test_derivatives_of_other_laws(law):
    gas = constant(0.9)
    if law == "series":
        series = jaxgran.RestitutionSeries([-0.1, 0.02], [0.2, 0.4])
        gas = dataclasses.replace(gas, law=series)
    times = jnp.array([0.0, 1.0, 10.0]) * gas.mean_free_time

    def log_temperature(gas, times, model):
        return jnp.log(jaxgran.cool(gas, times, model=model).temperature)

    def along(model):
        ones = jax.tree.map(jnp.ones_like, (gas, times))
        return jax.jit(
            lambda g, t: jax.jvp(lambda *x: log_temperature(*x, model), (g, t), ones)[1]
        )(gas, times)

    ours, theory = along(DSMC(20_000)), along(THEORY)
    assert np.all(np.isfinite(ours))
    np.testing.assert_allclose(ours, theory, rtol=0.03, atol=0.015)  # terms of order one cancel


@pytest.mark.slow
def test_gradient_of_error_bars_does_not_spoil_that_of_values(beads):
    gas = beads(0.15)

    def last(a, t):
        curve = jaxgran.cool(gas.replace(dissipative_constant=a), t, model=DSMC(1000, replicas=2))
        return curve.temperature[-1] / gas.temperature

    t = jnp.array([0.0, 1.0]) * gas.mean_free_time
    slopes = jax.grad(last, argnums=(0, 1))(gas.value("dissipative_constant"), t)
    assert slopes[0] < 0 and slopes[1][0] == 0 and slopes[1][1] < 0


@pytest.mark.slow
def test_single_precision(beads):
    gas = beads(0.15)
    times = np.array([1.0, 10.0]) * float(gas.mean_free_time)
    fine = jaxgran.cool(gas, times, model=DSMC(5000))
    with jax.enable_x64(False):
        single = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), gas)
        coarse = jaxgran.cool(single, times, model=DSMC(5000))
        assert coarse.temperature.dtype == jnp.float32
    # Other velocities: normal numbers differ between precisions.
    np.testing.assert_allclose(
        coarse.temperature, fine.temperature, rtol=4 * 2**0.5 * T_SCATTER / 5000**0.5
    )
    np.testing.assert_allclose(coarse.displacement, fine.displacement, rtol=6 / 5000**0.5)


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
        ({"num_particles": 10.0}, "num_particles"),
        ({"num_particles": 10, "replicas": 0}, "replicas must be a whole number >= 1"),
        ({"num_particles": 10, "step": 0.0}, r"step must lie in \(0, 0.1\]"),
        ({"num_particles": 10, "step": 0.2}, "got 0.2"),
        ({"num_particles": 10, "step": "fine"}, "got 'fine'"),
    ],
)
def test_refuses_what_it_cannot_do(settings, message):
    with pytest.raises(ValueError, match=message):
        DSMC(**settings)


class Step(jaxgran.RestitutionLaw, jaxgran.ReducedLaw):
    """A law of one's own, with no floats in it."""

    domains: ClassVar = {}

    def reduced(self, *, diameter, mass, speed):
        return self

    def restitution(self, v):
        return jnp.full_like(v, 0.6)


@pytest.mark.slow
def test_a_law_without_floats_has_derivatives():
    gas = constant(0.6)
    times = jnp.array([1.0, 3.0]) * gas.mean_free_time
    for model in (DSMC(1000), THEORY):

        def f(temperature, law, model=model):
            changed = dataclasses.replace(gas.replace(temperature=temperature), law=law)
            return jaxgran.cool(changed, times, model=model).temperature

        ours, known = (jax.jvp(partial(f, law=law), (3.0,), (1.0,)) for law in (Step(), gas.law))
        np.testing.assert_allclose(ours, known, rtol=1e-9)


def test_keeps_no_checkpoint_in_compiled_code():
    def f(eps):
        curve = jaxgran.cool(constant(eps), [1.0], model=DSMC(100), checkpoint="run.npz")
        return curve.temperature[0]

    with pytest.raises(ValueError, match="DSMC cannot write a checkpoint.*Set checkpoint=None"):
        jax.grad(f)(0.6)


def test_refuses_a_law_that_heats():
    gas = dataclasses.replace(constant(0.9), law=jaxgran.RestitutionSeries([0.1], [0.2]))
    with pytest.raises(ValueError, match="heat up"):
        jaxgran.cool(gas, [1.0], model=DSMC(100))


@pytest.mark.slow
@pytest.mark.parametrize("n", [2, 3, 5])
def test_few_particles(n):
    gas = constant(0.9)
    curve = jaxgran.cool(gas, [3 * float(gas.mean_free_time)], model=DSMC(n, replicas=20))
    assert np.all(np.isfinite(curve.temperature)) and curve.temperature[0] < gas.temperature


def test_each_of_a_few_particles_meets_the_others():
    # At rest as a whole, N particles have relative velocities of T N/(N-1) and N - 1 partners
    # each, of which sqrt(N/(N-1)) (N-1)/N remains: 1 - .5/N. Meeting N partners it would be
    # 1 + .5/N. 2000 gases of 20 make 40 000 collisions: a standard error of .5 %, less the 2.5 %.
    n, times = 20, np.array([1.0, 2.0])
    gas = constant(1.0)
    curve = jaxgran.cool(gas, times * float(gas.mean_free_time), model=DSMC(n, replicas=2000))
    rate = float(curve.collisions[-1]) / times[-1]
    assert abs(rate - (1 - 0.5 / n)) < 0.01
