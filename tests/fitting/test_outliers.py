"""Far values of a curve."""

import re
import warnings

import numpy as np
import pytest

import jaxgran
from jaxgran.fitting.outliers import Value, _predecessor
from jaxgran.fitting.setup import Request, build_problem
from tests.data.curve_files import GAS, TIMES, TRUE_A, T


@pytest.mark.parametrize("error", [None, pytest.param(0.01 * T, marks=pytest.mark.slow)])
def test_an_outlier_is_named_with_its_row_and_left_out_for_comparison(error):
    outlier = T * np.where(np.arange(40) == 12, 3.0, 1.0)
    curve = jaxgran.CoolingCurve(TIMES, outlier, temperature_error=error)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the verdict
        reasons = jaxgran.fit(jaxgran.Measurement(GAS, curve, num_particles=2000)).reasons
    found = re.search(
        r"outliers at t = .* s \(row 13\).*A is ([\d.e-]+) \+- ([\d.e-]+)", str(reasons)
    )
    value, uncertainty = map(float, found.groups())
    # The wave in T is .5 %; with the outlier A is 15 % too small.
    assert abs(value / TRUE_A - 1) < 0.01 and 0 < uncertainty < 0.02 * TRUE_A  # of 2000 grains


def test_a_value_that_is_not_used_is_no_outlier():
    times = np.append(0.0, TIMES)  # T at t = 0 is T_0 itself
    curve = jaxgran.CoolingCurve(times, np.append(float(GAS.temperature), T))
    measurement = jaxgran.Measurement(GAS, curve, num_particles=2000)
    names = ("dissipative_constant",)
    theory = jaxgran.KineticTheory()
    request = Request({"": measurement}, theory, names, (), {}, None, quick=True)
    problem, _, _ = build_problem(request)
    assert _predecessor(problem, Value("", 1, 0)) == []
    assert _predecessor(problem, Value("", 2, 0)) == [Value("", 1, 0)]
