import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxgran
from jaxgran.fitting.parameters import guess_from_data
from tests.beads import glass_beads
from tests.fitting.curves import BOTH, A, cooled_beads, deviation, rough_beads, synthetic


def test_exact_data_give_exact_parameters():
    gas, curve = cooled_beads(relative_error=1e-9)
    result = jaxgran.fit(gas, curve, free=BOTH)
    truth = [gas.value(A), gas.temperature]
    np.testing.assert_allclose(result.estimate, truth, rtol=1e-7)  # errors of 1e-9, solver of 1e-9
    assert bool(result.converged)


@pytest.mark.slow
def test_quasi_newton_ends_where_least_squares_do():
    gas, curve = cooled_beads(1)
    one = jaxgran.fit(gas, curve, free=BOTH)
    other = jaxgran.fit(gas, curve, free=BOTH, solver=optx.BFGS(rtol=1e-10, atol=1e-10))
    assert bool(one.converged) and bool(other.converged)
    # Both stop far inside the statistical error of 3e-3.
    np.testing.assert_allclose(one.estimate, other.estimate, rtol=1e-6)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-4)


def test_guess_uses_the_data_not_the_gas():
    gas, curve = cooled_beads(2)
    gases = [gas.replace(dissipative_constant=a) for a in (0.0, 1e-9, 1e-2)]
    (value,) = {float(guess_from_data(x, curve, (A,)).value(A)) for x in gases}
    assert 0.7 < value / gas.value(A) < 1.4


@pytest.mark.slow
@pytest.mark.figures
def test_intervals_cover_the_truth(record):
    # 500 noisy curves: a 95 % interval must cover in 93 to 97 % (2 standard errors of 500 trials).
    gas = glass_beads(0.15)
    truth = jnp.stack([gas.value(name) for name in BOTH])

    # The points have errors of 1e-2: a tolerance of 1e-6 takes a third of the steps of the default.
    model = jaxgran.KineticTheory(rtol=1e-6)

    def covered(key):
        result = jaxgran.fit(gas, synthetic(gas, key, model=model), free=BOTH, model=model)
        # The curves are theory's own: its clock has no error here.
        error = result.error_budget["measurement"]
        inside = jnp.abs(result.estimate - truth) < 1.959964 * error
        return inside, result.reduced_chi2, result.converged

    inside, reduced, converged = jax.vmap(covered)(jax.random.split(jax.random.key(0), 500))
    coverage = jnp.mean(inside, axis=0)
    assert jnp.all(converged)
    assert jnp.all((coverage >= 0.93) & (coverage <= 0.97)), coverage
    np.testing.assert_allclose(jnp.mean(reduced), 1.0, atol=0.04)  # 38 d.o.f., 500 curves: 0.01
    record("intervals", coverage=coverage.tolist())


@pytest.mark.slow
def test_errors_from_the_scatter():
    # Without error bars, and with bars that are too small, the scatter itself must tell the error,
    # to the 11 % that 40 points allow.
    gas, curve = cooled_beads(5)
    bare = dataclasses.replace(curve, temperature_error=None)
    boast = dataclasses.replace(curve, temperature_error=curve.temperature_error / 5)
    honest, without, boasted = (jaxgran.fit(gas, x, free=(A,)) for x in (curve, bare, boast))
    for result in (without, boasted):
        np.testing.assert_allclose(result.estimate, honest.estimate, rtol=1e-3)
        found, expected = (fit.error_budget["measurement"] for fit in (result, honest))
        np.testing.assert_allclose(found, expected, rtol=0.3)
    assert jnp.isnan(without.p_value) and boasted.p_value < 0.01
    assert "no errors" in jaxgran.diagnose(without, bare).reasons[0]
    assert jaxgran.diagnose(boasted, boast).grade == "not consistent"
    assert jaxgran.fit(gas, bare).names == BOTH


@pytest.mark.slow
def test_displacement_adds_information():
    gas, curve = cooled_beads(6, relative_error=0.2, quantities=("temperature", "displacement"))
    both = jaxgran.fit(gas, curve)
    bare = dataclasses.replace(curve, displacement=None, displacement_error=None)
    alone = jaxgran.fit(gas, bare)
    assert "displacement" in both.comparison.residuals
    assert "displacement" not in alone.comparison.residuals
    assert both.error_budget["measurement"][0] < 0.98 * alone.error_budget["measurement"][0]
    assert deviation(both, gas) < 3


def test_a_fit_is_shown_by_its_estimates():
    gas, curve = cooled_beads()
    shown = jaxgran.fit(gas, curve, free=BOTH)
    title, *rows = repr(shown).splitlines()
    assert title == jaxgran.diagnose(shown).headline and "95 %" in title
    assert any(row.startswith("  if nothing else is there") for row in rows)
    assert "converged" in repr(shown)


def test_T_rot_of_few_spheres_that_were_hit_fluctuates_more():
    gas = dataclasses.replace(glass_beads(0.15), surface=jaxgran.Rough(-0.3))
    times = jnp.geomspace(0.3, 3.0, 40) * gas.mean_free_time
    # The scatter of T_rot over 100 runs of DSMC(250), relative, at five of the times.
    scatter = [0.1883, 0.1667, 0.1128, 0.0846, 0.0726]
    theory = jaxgran.cool(gas, times)
    T_rot = theory.rotational_temperature
    bare = jaxgran.CoolingCurve(times, theory.temperature, rotational_temperature=T_rot)
    weights = jaxgran.fit(gas, bare, num_particles=250).comparison.weights
    found = 1 / weights["rotational_temperature"][jnp.array([0, 9, 19, 29, 39])]
    np.testing.assert_allclose(found, scatter, rtol=0.2)  # of 100 runs: 7 %
    assert found[0] > 3 * (2 / 750) ** 0.5  # the error of spins that all have


def test_a_rotation_that_is_not_used_is_said():
    gas = rough_beads().replace(rotational_temperature=0.01)
    known, smooth = synthetic(gas, relative_error=0.02), dataclasses.replace(gas, surface=None)
    bare = dataclasses.replace(known, temperature_error=None, rotational_temperature_error=None)
    for scene, words in ((smooth, "no surface"), (gas, "its weights need T_err and T_rot_err")):
        # Said before a long search.
        with pytest.warns(UserWarning, match=words), pytest.raises(ValueError):
            jaxgran.fit(scene, bare, solver="none")
    # With N the errors that lack are those of its fluctuations; those that are given stay.
    for curve, error in ((bare, (2 / 750) ** 0.5), (known, 0.02)):
        found = jaxgran.fit(gas, curve, num_particles=250).comparison.weights
        np.testing.assert_allclose(1 / found["temperature"], error)
        np.testing.assert_allclose(1 / found["rotational_temperature"], error)


def test_a_search_through_gases_too_soft_for_the_theory_ends():
    gas, curve = cooled_beads()
    late = dataclasses.replace(curve, times=curve.times + 60.0)  # T_0 at t = 0 is huge
    with pytest.warns(UserWarning):
        result = jaxgran.fit(gas, late, free=BOTH)
    assert np.all(np.isfinite(result.estimate))
    # There no step is made, which would be repeated 200000 times.
    status = jax.jit(lambda T: jaxgran.cool(gas.replace(temperature=T), late.times).status)(1e6)
    assert "does not support this gas" in jaxgran.explain_status(int(status))
