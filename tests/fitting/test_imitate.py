"""Imitations of a measurement: their noise, their counts, and what they refuse."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting import imitate as module
from jaxgran.fitting.drawn_errors import imitations
from jaxgran.fitting.measured_rows import with_errors_that_count
from jaxgran.fitting.twins import StrongestEffect, Truth
from tests.beads import glass_beads

TIMES = np.geomspace(0.1, 10.0, 10)
GAS = glass_beads()
RUNS = 300


def planned(**options) -> jaxgran.Measurement:
    T = jaxgran.cool(GAS, TIMES).temperature
    curve = jaxgran.CoolingCurve(TIMES, T, temperature_error=0.02 * T)
    return jaxgran.Measurement(GAS, **{"data": curve, "num_particles": 64} | options)


def counted(low, high, estimate, error, **fields) -> jaxgran.Imitation:
    ends = (np.asarray(x, float) for x in (low, high, estimate, error))
    grades = ("determined",) * len(low)
    first = ("as given", "dissipative_constant", 1.0, "DSMC")
    return jaxgran.Imitation(*first, fields.pop("asked", len(low)), *ends, grades, **fields)


def test_ranges_that_hold_the_truth_are_counted():
    low = [0.5, 1.1, np.nan, 0.9]
    high = [1.5, 1.3, np.nan, 1.1]
    found = counted(low, high, [1.1, 1.2, 3.0, 1.0], [0.1] * 4)
    assert (found.runs, found.held, found.held_alone) == (4, 2, 2)
    assert found.width == pytest.approx(0.2)
    assert found.headline.startswith("the range held the true A in 2 of 4 imitations")
    assert "after 1 of 9 runs" in repr(counted([0], [2], [1], [1], asked=9))


def imitated(measurement, errors_of_T=0.0, runs=2 * RUNS):
    """The imitations of a measurement, and their T over the exact one."""
    exact = jaxgran.cool(GAS, TIMES)
    T = jnp.broadcast_to(exact.temperature, (2 * RUNS, TIMES.size))
    replicas = jaxgran.CoolingCurve(TIMES, T)
    curve = dataclasses.replace(exact, replicas=replicas)
    result = FakeFit(exact, {"": errors_of_T})
    measurement = with_errors_that_count(measurement)
    each = imitations(measurement, result, curve, runs, np.random.default_rng(0))
    assert len(each) == runs
    return each, np.array([m.curve.temperature for m in each]) / np.asarray(T[0])


@pytest.mark.parametrize(
    ("options", "error"),
    [
        pytest.param({"errors_measured": True}, 0.02, id="as given"),
        pytest.param({"errors_measured": True, "replicas": 2}, 0.02, id="of a mean"),
        pytest.param({"replicas": 2}, 0.0, id="by the grains of the runs"),
        pytest.param({"num_particles": 1667}, 0.0, id="by the grains of one run"),
        pytest.param({"tracked": 32}, (2 / 3 / 32 * 0.5) ** 0.5, id="sampling"),
        pytest.param({"calibration_error": 0.05, "replicas": 2}, 0.05, id="scale of T"),
    ],
)
def test_imitations_have_the_errors_that_the_fit_counts(options, error):
    each, ratio = imitated(planned(**options), runs=2 * RUNS // options.get("replicas", 1))
    # Of 300 runs, whose errors may be common to all 10 times: 4 % of the width by chance, and .3 %
    # of the mean; without errors both are exact.
    assert np.std(ratio) == pytest.approx(error, rel=0.13, abs=1e-9)
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.01)
    if "errors_measured" in options:  # not more where the noise is low
        exact = jaxgran.cool(GAS, TIMES).temperature
        assert np.allclose(each[0].curve.temperature_error, 0.02 * exact)
    if error == 0:
        assert each[0].curve.temperature_error is None


def test_errors_that_the_fit_found_are_drawn_and_priors_are_about_the_truth():
    T = jaxgran.cool(GAS, TIMES).temperature
    priors = {"density": (2600.0, 125.0)}
    bare = planned(data=jaxgran.CoolingCurve(TIMES, T), priors=priors)
    each, ratio = imitated(bare, errors_of_T=0.03)
    assert np.std(ratio) == pytest.approx(0.03, rel=0.04)  # .9 % by chance, of 6000 values
    densities = np.array([m.priors["density"][0] for m in each])
    # Of 600 priors: .2 % of the mean by chance, 3 % of the width, which is 4.8 % of the density.
    assert np.mean(densities) == pytest.approx(2500.0, rel=0.01)
    assert np.std(densities) == pytest.approx(120.0, rel=0.1)


class FakeFit(jaxgran.Fit):
    """A fit of which the curve and its errors alone are known."""

    def __init__(self, curve, errors_of_T=()):
        object.__setattr__(self, "curve", curve)
        object.__setattr__(self, "errors_of_T", dict(errors_of_T))


@pytest.mark.parametrize(
    ("measurements", "message"),
    [
        ({"": planned(num_particles=None)}, "imitate needs N, the number of grains"),
        ({"": planned(num_particles=10**6)}, "5e.06 are allowed: ask for 5 runs or fewer"),
        ({"a": planned(), "b": planned()}, "imitate takes a fit of one curve"),
    ],
)
def test_what_cannot_be_imitated_is_refused(measurements, message):
    result = FakeFit(jaxgran.cool(GAS, TIMES))
    object.__setattr__(result, "measurements", measurements)
    with pytest.raises(ValueError, match=message):
        jaxgran.imitate(result, 100)


@pytest.mark.parametrize("model", [jaxgran.DSMC(10), jaxgran.KineticTheory()])
def test_a_model_of_another_number_of_particles_imitates_nothing(model):
    result = FakeFit(jaxgran.cool(GAS, TIMES))
    object.__setattr__(result, "measurements", {"": planned(num_particles=50)})
    with pytest.raises(ValueError, match="of the 50 grains .* num_particles=50"):
        jaxgran.imitate(result, 100, model=model)


@pytest.mark.slow
def test_interrupted_imitations_give_what_they_have(monkeypatch):
    measurement = planned(absent=("walls", "roughness", "drag"))
    result = jaxgran.fit(measurement)
    fits = []

    def interrupted(*arguments, **options):
        if len(fits) == 3:
            raise KeyboardInterrupt
        fits.append(jaxgran.fit(*arguments, **options))
        return fits[-1]

    monkeypatch.setattr(module, "fit", interrupted)
    found = jaxgran.imitate(result, 5, progress=False)
    # A fit that has begun when another one is interrupted is counted.
    assert 3 <= found.runs == len(fits) < found.asked == 5
    assert found.strongest is None
    assert found.width == pytest.approx(np.median((found.high - found.low) / found.value), rel=1e-2)
    assert "interrupted" in repr(found)


@pytest.mark.slow
def test_an_interruption_before_the_strongest_alternative_is_fitted_is_reported(monkeypatch):
    result = jaxgran.fit(planned(), quick=True)
    truth = Truth("with drag", effect="drag", elements={"drag": jaxgran.StokesDrag(0.01)})
    simulated = []

    def interrupted(*arguments, **options):
        if simulated:
            raise KeyboardInterrupt
        simulated.append(jaxgran.cool(*arguments, **options))
        return simulated[-1]

    monkeypatch.setattr(module, "strongest_effect", lambda result: StrongestEffect(truth, {}))
    monkeypatch.setattr(module, "cool", interrupted)
    monkeypatch.setattr(module, "fit", lambda measurement, **options: result)
    with pytest.warns(UserWarning, match='before an imitation "with drag" was fitted'):
        found = jaxgran.imitate(result, 2, progress=False)
    assert found.runs == found.asked == 2 and found.strongest is None
    monkeypatch.setattr(module, "cool", jaxgran.cool)
    monkeypatch.setattr(module, "_fits", lambda measured, *others: [result])  # one of two runs
    with pytest.warns(UserWarning, match='before an imitation "with drag" was fitted'):
        found = jaxgran.imitate(result, 2, progress=False)
    assert found.runs == 1 and found.strongest is None


@pytest.mark.slow
def test_the_strongest_alternative_is_imitated():
    rough = dataclasses.replace(GAS, surface=jaxgran.Rough(-0.8))
    T = jaxgran.cool(rough, TIMES).temperature
    curve = jaxgran.CoolingCurve(TIMES, T, temperature_error=0.01 * T)
    absent = ("walls", "drag")
    measurement = jaxgran.Measurement(GAS, curve, 200, absent=absent, errors_measured=True)
    found = jaxgran.imitate(jaxgran.fit(measurement), 4, model=jaxgran.DSMC(200), progress=False)
    other = found.strongest
    assert other is not None and other.truth == "with roughness"
    assert other.held > other.held_alone
