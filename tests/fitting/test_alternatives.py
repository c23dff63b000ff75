"""Curves of gases with an element that the fit is not told of, and the ranges over alternatives."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.fitting import alternatives
from jaxgran.fitting.optimise import Problem, search
from tests.beads import glass_beads

A = "dissipative_constant"
ELEMENTS = {
    "walls": {"container": jaxgran.Walls(0.1, restitution=0.8)},
    "drag": {"drag": jaxgran.StokesDrag(0.02)},
    "roughness": {"surface": jaxgran.Rough(-0.9)},
    "friction": {"surface": jaxgran.Rough(0.44, friction=0.05)},
}
NAMES = {
    "walls": "walls that dissipate energy",
    "drag": "linear drag, as in air",
    "roughness": "rough grains without initial rotation",
    "friction": "rough grains that slide",
}


def measured(gas, key=None, end=300.0, error=0.003):
    times = jnp.geomspace(0.2, end, 48) * gas.mean_free_time
    T = jaxgran.cool(gas, times).temperature
    noise = 0.0 if key is None else error * jax.random.normal(key, T.shape)
    T = T * (1 + noise)
    return jaxgran.CoolingCurve(times=times, temperature=T, temperature_error=error * T)


@pytest.mark.parametrize("element", ELEMENTS)
def test_the_range_holds_A_where_an_element_is_not_told(element):
    gas = glass_beads(0.1)
    truth = float(gas.value(A))
    curve = measured(dataclasses.replace(gas, **ELEMENTS[element]), jax.random.key(0))
    result = jaxgran.fit(gas, curve)
    assert abs(float(result.estimate[0]) - truth) > 3 * float(result.standard_error[0])
    diagnosis = jaxgran.diagnose(result)
    low, high = (float(x[0]) for x in diagnosis.ranges[A])
    assert low < truth < high
    found = next(a for a in diagnosis.alternatives if a.name == NAMES[element])
    assert found.low[0] < truth < found.high[0]
    best = diagnosis.alternatives[0].improvement
    assert found.improvement > best - 3.84 and found.preferred
    assert diagnosis.grade != "determined"
    # Declared absent, the element is no longer an alternative.
    told = jaxgran.diagnose(jaxgran.fit(gas, curve, absent=(element,)))
    assert NAMES[element] not in {a.name for a in told.alternatives}
    assert f"known to be absent: {element}" in told.reasons


def test_no_alternative_is_preferred_where_all_is_told():
    gas = glass_beads(0.1)
    for seed in range(5):
        diagnosis = jaxgran.diagnose(jaxgran.fit(gas, measured(gas, jax.random.key(seed))))
        low, high = (float(x[0]) for x in diagnosis.ranges[A])
        assert diagnosis.grade != "not consistent" and low < float(gas.value(A)) < high
        assert not any(a.preferred for a in diagnosis.alternatives)
        drag = next(a for a in diagnosis.alternatives if "drag" in a.name)
        assert drag.distinguishable and drag.allowed[1] < 0.02


def test_more_exact_data_narrow_the_range():
    gas, widths = glass_beads(0.1), []
    for error in (0.02, 0.002):
        result = jaxgran.fit(gas, measured(gas, error=error))
        low, high = jaxgran.diagnose(result).ranges[A]
        widths.append(float(high[0] - low[0]))
    assert widths[1] < 0.6 * widths[0]


def test_unknown_absent_elements_are_refused():
    gas = glass_beads(0.1)
    result = jaxgran.fit(gas, measured(gas))
    with pytest.raises(ValueError, match="absent must be a tuple of walls, roughness, drag"):
        jaxgran.diagnose(result, absent=("gravity",))


def test_the_last_step_of_a_trial_needs_no_further_curve(monkeypatch):
    gas = glass_beads(0.1)
    result = jaxgran.fit(gas, measured(gas, jax.random.key(0)), free=(A, "temperature"))
    problem, starts = alternatives._problem(result)
    first = alternatives._first(problem, result, starts)
    flat, *_ = search(problem, first, 100)  # to its own tolerance, 1e-8
    _, residuals, jacobian, _ = problem.evaluate(flat)
    inverse = np.linalg.pinv(jacobian)
    covariance = inverse @ inverse.T
    error = np.sqrt(np.diag(covariance))
    curves, evaluate = [], Problem._evaluate
    monkeypatch.setattr(Problem, "_evaluate", lambda *x: curves.append(1) or evaluate(*x))
    # A is 2 standard errors off, and the others are where they fit best with it.
    trial = alternatives._trial(problem, 0.0, flat + 2.0 * covariance[0] / error[0])
    assert len(curves) == 1
    # What the linear step leaves is of second order in these 2 standard errors.
    assert trial.chi2 == pytest.approx(float(residuals @ residuals), abs=0.02)
    np.testing.assert_allclose(trial.flat[:2], flat[:2], atol=0.05 * np.min(error[:2]))
