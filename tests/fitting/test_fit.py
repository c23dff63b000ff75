import dataclasses

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.guesses import guess_from_data
from jaxgran.fitting.report import report
from tests.beads import glass_beads
from tests.fitting.curves import (
    BOTH,
    A,
    cooled_beads,
    deviation,
    fitted,
    in_range,
    rough_beads,
    synthetic,
)


def test_exact_data_give_exact_parameters():
    gas, curve = cooled_beads(relative_error=1e-9)
    result = fitted(gas, curve, free=BOTH, num_particles=10**9)
    assert result.converged and result.chi2 < 0.1
    # What is left of A is a fraction of theory's own error, whose size depends on A.
    assert deviation(result, gas) < 0.3 and result.standard_error[0] < 6e-3 * result.estimate[0]
    np.testing.assert_allclose(result.estimate[1], gas.temperature, rtol=1e-5)


def test_guess_uses_the_data_not_the_gas():
    gas, curve = cooled_beads(2)
    gases = [gas.replace(dissipative_constant=a) for a in (0.0, 1e-9, 1e-2)]
    (value,) = {float(guess_from_data(x, curve, (A,)).value(A)) for x in gases}
    assert 0.7 < value / gas.value(A) < 1.4


@pytest.mark.minutes
@pytest.mark.slow
@pytest.mark.figures
def test_intervals_cover_the_truth(record):
    # 300 noisy curves: a 95 % interval must cover in 92.5 to 97.5 % (2 standard errors).
    gas = glass_beads(0.15)
    truth = np.array([gas.value(name) for name in BOTH])

    # The points have errors of 1e-2: a tolerance of 1e-6 takes a third of the steps of the default.
    model = jaxgran.KineticTheory(rtol=1e-6)
    inside, reduced = [], []
    for key in jax.random.split(jax.random.key(0), 300):
        curve = synthetic(gas, key, model=model)
        result = fitted(gas, curve, free=BOTH, model=model, num_particles=10**7)
        assert result.converged
        # The curves are theory's own: its cooling rate has no error here.
        error = result.error_budget["measurement"]
        inside.append(np.abs(result.estimate - truth) < 1.959964 * error)
        reduced.append(result.reduced_chi2)
    coverage = np.mean(inside, axis=0)
    assert np.all((coverage >= 0.925) & (coverage <= 0.975)), coverage
    np.testing.assert_allclose(np.mean(reduced), 1.0, atol=0.05)  # 38 d.o.f., 300 curves: 0.013
    record("intervals", coverage=coverage.tolist())


@pytest.mark.slow
def test_without_errors_and_N_the_scatter_tells_both():
    # Independent errors are not the scatter of a run: they are preferred as an explanation.
    gas, curve = cooled_beads(5)
    bare = jaxgran.Measurement(gas, jaxgran.CoolingCurve(curve.times, curve.temperature))
    result = jaxgran.fit(bare)
    assert result.names == BOTH
    white = next(a for a in result.alternatives if a.name == "independent errors of T")
    assert white.preferred and white.amplitude == pytest.approx(0.01, rel=0.3)
    # Neither choice moves A by more than its error.
    assert deviation(result, gas) < 3 and in_range(result, gas.value(A))


@pytest.mark.slow
def test_displacement_adds_information():
    gas, curve = cooled_beads(6, relative_error=0.2, quantities=("temperature", "displacement"))
    both = fitted(gas, curve, num_particles=10**6)
    bare = dataclasses.replace(curve, displacement=None, displacement_error=None)
    alone = fitted(gas, bare, num_particles=10**6)
    assert "displacement" in both.residuals[""] and "displacement" not in alone.residuals[""]
    assert both.error_budget["measurement"][0] < 0.98 * alone.error_budget["measurement"][0]
    assert deviation(both, gas) < 3


def test_a_fit_is_shown_and_saved(tmp_path):
    gas, curve = cooled_beads()
    shown = fitted(gas, curve, free=BOTH, quick=False, num_particles=10**6)
    title, *rows = repr(shown).splitlines()
    assert title == shown.headline and "95 %" in title
    assert any(row.startswith("  assuming no other effect") for row in rows)
    shown.save(tmp_path / "fit.json")
    with pytest.raises(ValueError, match="fit.json exists"):
        shown.save(tmp_path / "fit.json")
    loaded = jaxgran.Fit.load(tmp_path / "fit.json")
    assert repr(loaded) == repr(shown) and report(loaded) == report(shown)
    np.testing.assert_array_equal(loaded.curve.temperature, shown.curve.temperature)
    of_particles = dataclasses.replace(shown, model=jaxgran.DSMC(100))
    of_particles.save(tmp_path / "fit.json", overwrite=True)
    assert jaxgran.Fit.load(tmp_path / "fit.json").model is None
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="other.json: not a fit"):
        jaxgran.Fit.load(tmp_path / "other.json")


def test_a_rotation_that_is_not_used_is_said():
    gas = rough_beads().replace(rotational_temperature=0.01)
    known, smooth = synthetic(gas, relative_error=0.02), dataclasses.replace(gas, surface=None)
    with pytest.warns(UserWarning, match="no surface"):
        result = fitted(smooth, known)
    assert "rotational_temperature" not in result.residuals[""]
    # Without errors the scatter of N spheres gives the weights.
    bare = dataclasses.replace(known, temperature_error=None, rotational_temperature_error=None)
    result = fitted(gas, bare, num_particles=250)
    assert "rotational_temperature" in result.residuals[""]


def test_errors_that_are_the_scatter_of_N_grains_are_left_out():
    gas = glass_beads(0.15)
    curve = synthetic(gas, relative_error=(2 / 750) ** 0.5)
    bare = jaxgran.CoolingCurve(curve.times, curve.temperature)
    results = [
        jaxgran.fit(jaxgran.Measurement(gas, x, num_particles=250, **known), free=BOTH, quick=True)
        for x, known in ((curve, {}), (bare, {}), (curve, {"errors_measured": True}))
    ]
    np.testing.assert_array_equal(results[0].estimate, results[1].estimate)
    assert any(
        "T_err equals the fluctuation of independent samples" in x for x in results[0].reasons
    )
    assert results[2].standard_error[0] > results[0].standard_error[0]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:this curve does not determine")
def test_a_search_through_gases_too_soft_for_the_theory_ends():
    gas, curve = cooled_beads()
    late = dataclasses.replace(curve, times=curve.times + 60.0)  # T_0 at t = 0 is huge
    result = fitted(gas, late, free=BOTH)
    assert np.all(np.isfinite(result.estimate)) and result.grade == "not consistent"
    # There no step is made, which would be repeated 200000 times.
    status = jax.jit(lambda T: jaxgran.cool(gas.replace(temperature=T), late.times).status)(1e6)
    assert "does not support this gas" in jaxgran.explain_status(int(status))
