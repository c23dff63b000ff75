"""Fits through particle models, and Gauss-Newton through noise on a stand-in."""

import dataclasses
from collections.abc import Callable
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting import simulated_fit
from jaxgran.fitting.simulations import Simulation
from tests.beads import glass_beads, soft_beads
from tests.fitting.curves import BOTH, A, deviation, in_range, rough_beads, synthetic
from tests.fitting.curves import fitted as fit_measured


@pytest.mark.minutes
@pytest.mark.slow
def test_T_rot_is_fitted_beside_T():
    gas = rough_beads()
    model, names = jaxgran.DSMC(5000, replicas=2), (A, "tangential_restitution")
    curve = synthetic(gas, jax.random.key(0), 30, 0.02, 30.0, model)
    guess = gas.replace(tangential_restitution=-0.3)
    result = fit_measured(guess, curve, free=names, model=model, num_particles=10_000)
    assert result.converged and "rotational_temperature" in result.residuals[""]
    assert all(deviation(result, gas, name) < 3 for name in names)
    # Both are known to some per cent; from T alone they are not distinguishable.
    assert float(result.standard_error[0] / result.estimate[0]) < 0.1
    assert float(result.standard_error[1]) < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_a_good_fit_through_particles_is_consistent(seed, monkeypatch):
    # Simulations of fewer grains than were measured, whose noise is most of the differences.
    gas = glass_beads(0.15)
    times = np.geomspace(1.0, 60.0, 40) * float(gas.mean_free_time)
    measured = jaxgran.DSMC(1000, replicas=4)
    curve = jaxgran.cool(gas, times, model=measured, key=jax.random.key(seed), progress=False)
    curve = jaxgran.CoolingCurve(curve.times, curve.temperature)
    measurement = jaxgran.Measurement(gas, curve, num_particles=1000, replicas=4)
    model = jaxgran.DSMC(250, replicas=2)
    key = jax.random.key(10 + seed)
    compared = []
    compare = simulated_fit.compare_alternatives

    def compare_and_keep(problem, *args):
        compared.extend(problem.curves)
        return compare(problem, *args)

    monkeypatch.setattr(simulated_fit, "compare_alternatives", compare_and_keep)
    result = jaxgran.fit(measurement, free=(A,), model=model, key=key, progress=False)
    # Of the measured grains, and of 500 in each of at most 20 simulations.
    assert compared[0].grains.inverse_number >= 1 / 4000 + 1 / (20 * 500)
    assert result.converged and result.p_value > 0.01 and result.smooth_p_value > 0.01
    assert result.grade != "not consistent"
    assert not any(alternative.preferred for alternative in result.alternatives)
    assert in_range(result, gas.value(A))


@pytest.mark.slow
def test_an_exact_first_temperature_hides_no_other_parameter():
    # Next to its sensitivity A counted as not determined: it stayed at its guess, without an error.
    gas = glass_beads(0.15)
    times = np.append(0.0, np.geomspace(1.0, 60.0, 20)) * float(gas.mean_free_time)
    curve = jaxgran.cool(gas, times)
    curve = jaxgran.CoolingCurve(curve.times, curve.temperature)
    measurement = jaxgran.Measurement(gas, curve, num_particles=1000)
    model = jaxgran.DSMC(1000, replicas=4)
    both, alone = (
        jaxgran.fit(measurement, free=free, model=model, quick=True, progress=False)
        for free in (BOTH, (A,))
    )
    assert float(both.estimate[1]) == pytest.approx(float(gas.temperature), rel=1e-4)
    assert float(both.standard_error[0]) == pytest.approx(float(alone.standard_error[0]), rel=0.3)
    assert deviation(both, gas) < 3


@pytest.mark.minutes
@pytest.mark.slow
def test_fit_through_soft_spheres_finds_what_made_the_curve():
    gas = soft_beads(0.1, 0.3, packing_fraction=0.2)
    model = jaxgran.SoftSpheres(200, replicas=3, steps_per_contact=20)
    curve = synthetic(gas, None, 12, 0.025, 6.0, model)
    result = fit_measured(gas, curve, model=model, max_steps=5, num_particles=600)
    error = result.value(A)[1]
    # The measured curve is a run of 600 spheres itself, whose noise its 2.5 % stand for.
    assert deviation(result, gas) < 3
    assert float(error) < 0.15 * gas.value(A) and result.converged


@pytest.mark.slow
def test_errors_of_priors_and_of_the_scale_are_in_the_error_bar_and_the_range():
    gas = glass_beads()
    curve = synthetic(gas, jax.random.key(0), 20, 0.005, 30.0)
    known = {"num_particles": 10_000, "absent": ("walls", "roughness", "drag", "friction")}
    model = jaxgran.DSMC(2000, replicas=2)

    def widths(**further):
        measurement = jaxgran.Measurement(gas, curve, errors_measured=True, **known, **further)
        result = jaxgran.fit(measurement, free=(A,), model=model, progress=False)
        low, high = (float(x[0]) for x in result.ranges[A])
        return np.array([float(result.standard_error[0]), high - low]) / gas.value(A)

    plain = widths()  # 1.5 % and 6 %
    # A is known as the density is, to 20 % and more; T known to 30 % gives A to some per cent.
    assert np.all(widths(priors={"packing_fraction": (0.05, 0.01)}) > 0.2 + plain)
    assert np.all(widths(calibration_error=0.3) > 1.3 * plain)


# --- a stand-in whose parameters are known

GAS = glass_beads()
TRUTH = (0.3, -0.2)
"""Logarithms of A and of T_0, over those of `GAS`."""
ERROR = 0.005


def logs(gas):
    return jnp.stack([jnp.log(gas.value(name) / GAS.value(name)) for name in BOTH])


def at(flat, gas):
    return gas.replace(**{n: gas.value(n) * np.exp(x) for n, x in zip(BOTH, flat, strict=True)})


def power_law(log_rate, log_T, taus):
    return log_T - 5 / 3 * jnp.log1p(taus * jnp.exp(log_rate))


def of_sum(log_rate, log_T, taus):
    """The same, of A times T_0, or nearly so: far below the resolution of the model."""
    return power_law(log_rate + (1 + 1e-6) * log_T, 0.0 * log_T, taus)


class StandIn(jaxgran.KineticTheory):
    """T by a formula, with noise that stays along a run, and slopes wrong by a factor."""

    formula: Callable = power_law
    bias: float = 1.0
    noise: float = 0.01
    replicas: int = 4
    stochastic: ClassVar[bool] = True
    derivative_accuracy: ClassVar[float] = 0.01

    def simulate(self, gas, times, run):
        flat, taus = logs(gas), times / GAS.mean_free_time
        # The value of the formula, with a part of its slope.
        flat = self.bias * flat + jax.lax.stop_gradient((1 - self.bias) * flat)
        log_T = {"temperature": self.formula(*flat, taus)}
        if gas.surface is not None:  # T_rot depends on T_0 alone
            log_T["rotational_temperature"] = power_law(flat[1], 0.0, taus)
        runs = {}
        for k, (name, value) in enumerate(log_T.items()):
            shape = self.replicas, times.size
            steps = jax.random.normal(jax.random.fold_in(run.key, k), shape)
            drift = self.noise / times.size**0.5 * jnp.cumsum(steps, axis=1)
            runs[name] = GAS.temperature * jnp.exp(value[None] + drift)
        return jaxgran.CoolingCurve.of_replicas(times, runs)


def fitted(model, truth=TRUTH, first=(0.0, 0.0), gas=GAS, **settings):
    exact = dataclasses.replace(model, noise=0.0) if isinstance(model, StandIn) else None
    curve = synthetic(at(truth, gas), None, 40, ERROR, 1000.0, exact)
    options = {"free": BOTH, "start": at(first, gas), "num_particles": 10**9} | settings
    return fit_measured(gas, curve, model=model, progress=False, **options)


@pytest.mark.slow
@pytest.mark.parametrize("bias", [0.8, 1.0, 1.2])
def test_a_biased_slope_does_not_move_the_answer(bias):
    quiet = fitted(StandIn(bias=bias, noise=1e-6), first=(-0.6, 0.3))
    # What is left is what a biased step leaves of the last step, 20 % of less than a tenth.
    np.testing.assert_allclose(logs(quiet.gas), TRUTH, atol=0.02)
    assert quiet.converged and quiet.iterations <= 8


class Captured(Exception):
    pass


@pytest.fixture
def begun(monkeypatch):
    """What a fit begins its search with: the simulations, and where it starts."""

    def begin(*args, **settings):
        captured = []

        def capture(sims, first, max_simulations):
            captured.append((sims, first))
            raise Captured

        monkeypatch.setattr(simulated_fit, "by_gauss_newton", capture)
        with pytest.raises(Captured):
            fitted(*args, **settings)
        return captured[0]

    return begin


@pytest.mark.minutes
def test_noise_of_slopes_does_not_move_the_answer(begun):
    """Runs whose noise grows with A: the noise of a slope is that of the values, times 3."""
    sims, flat = begun(StandIn(noise=1e-6), first=TRUTH)
    exact, _ = sims.run(flat, 0)
    rng = np.random.default_rng(0)
    half = exact.values.size // 2  # T_rot is not compared

    def noisy():
        steps = 0.1 * rng.standard_normal((4, half)) / half**0.5
        each = np.pad(np.cumsum(steps, axis=1), ((0, 0), (0, half)))
        mean = each.mean(axis=0)
        slope = exact.slope + np.stack([3.0 * mean, 0.0 * mean], axis=1)
        variance = np.full(2 * half, each.var() / 3)
        return exact._replace(
            values=exact.values + mean, slope=slope, deviation=each - mean, variance=variance
        )

    off = np.array([sims.average([noisy(), noisy()]).flat - flat for _ in range(400)])
    error = off.std(axis=0) / len(off) ** 0.5
    assert np.all(np.abs(off.mean(axis=0)) < 3 * error)


@pytest.mark.minutes
@pytest.mark.slow
def test_simulations_scatter_as_theory_expects(begun):
    sims, flat = begun(jaxgran.DSMC(100, replicas=4), (0.0, 0.0), num_particles=10_000)
    moved, expected = [], []
    for stream in range(80):
        simulation, _ = sims.run(flat, stream)
        average = sims.average([simulation])
        noise = sims.expected_noise(average.comparison, simulation.slope, average.information, 4)
        moved.append(average.flat)
        expected.append(np.diag(noise))
    ratio = np.var(moved, axis=0, ddof=1) / np.mean(expected, axis=0)
    # The variance of 80 values is known to 16 %.
    np.testing.assert_allclose(ratio, 1.0, atol=3 * 0.16)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [jaxgran.DSMC, jaxgran.SoftSpheres])
def test_contacts_scatter_what_was_measured_and_soft_spheres(begun, kind):
    sims, flat = begun(kind(100, replicas=2), num_particles=300)
    of_two_replicas = Simulation(flat, flat, flat[None], np.zeros((2, 1)), flat)
    grains = sims.with_noise([of_two_replicas]).grains
    assert grains.inverse_number == pytest.approx(1 / 300 + 1 / 200)
    by_contacts = grains.inverse_number * grains.contacts
    expected = grains.inverse_number if kind is jaxgran.SoftSpheres else 1 / 300
    assert by_contacts == pytest.approx(expected)


class OneRun(StandIn):
    """A model whose curves do not tell their noise."""

    def simulate(self, gas, times, run):
        return dataclasses.replace(super().simulate(gas, times, run), replicas=None)


def test_curves_without_replicas_are_refused():
    with pytest.raises(ValueError, match="OneRun .*two replicas"):
        fitted(OneRun())


@pytest.mark.slow
def test_more_runs_make_it_quieter():
    model = StandIn(noise=0.06, replicas=16)
    found, once = (fitted(model, first=(0.25, -0.2), max_steps=steps) for steps in (8, 1))
    assert found.iterations > 2  # the noise of one run is more than half the error bar
    noise = found.error_budget["simulation"] / once.error_budget["simulation"]
    assert np.all(noise < 0.8)  # 8 runs: .35


@pytest.mark.slow
def test_what_the_curve_does_not_tell_stays_where_it_was():
    with pytest.warns(UserWarning, match="A and T0"):
        found = fitted(StandIn(formula=of_sum), (0.3, 0.0), first=(0.1, 0.1))
    flat = logs(found.gas)
    assert float(flat[0] - flat[1]) == pytest.approx(0.0, abs=1e-6)
    assert float(flat.sum()) == pytest.approx(0.3, abs=0.02)


def test_two_quantities_tell_what_one_does_not():
    # T depends on the product of A and T_0, T_rot on T_0 alone.
    gas = dataclasses.replace(GAS, surface=jaxgran.Rough(0.0))
    found = fitted(StandIn(formula=of_sum), gas=gas)
    np.testing.assert_allclose(logs(found.gas), TRUTH, atol=0.03)
    assert np.all(found.error_budget["simulation"] > 0)
