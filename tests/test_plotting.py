"""Pictures of curves and fits."""

from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot

import jaxgran
from tests.beads import SI, glass_beads, hard_gas
from tests.own_model import HaffLaw


def test_a_curve_is_drawn_in_given_axes():
    error = [0.0, 0.5, 0.25, 0.25]
    curve = jaxgran.CoolingCurve([0, 1, 2, 5], [4, 2.5, 1.75, 0.75], temperature_error=error)
    figure, axes = pyplot.subplots()
    assert jaxgran.plot_curve(curve, axes, label="mine") is axes
    drawn: Any = axes.containers[0].get_children()[0]
    np.testing.assert_array_equal(drawn.get_xdata(), curve.times[1:])  # 0 has no logarithm
    np.testing.assert_array_equal(drawn.get_ydata(), curve.temperature[1:])
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert axes.get_legend_handles_labels()[1] == ["mine"]
    assert jaxgran.plot_curve(curve) is pyplot.gca()
    pyplot.close("all")


def test_a_fit_is_drawn_with_its_residuals():
    gas = hard_gas(0.9, 0.02, **SI)
    times = np.geomspace(1.0, 100.0, 20) * float(gas.mean_free_time)
    T = jaxgran.cool(gas, times, model=HaffLaw()).temperature
    noisy = T * (1 + 0.01 * np.random.default_rng(0).normal(size=20))
    curve = jaxgran.CoolingCurve(times, noisy, temperature_error=0.01 * T)
    result = jaxgran.fit(jaxgran.Measurement(gas, curve), model=HaffLaw(), quick=True)
    top, bottom = jaxgran.plot_fit(result)
    points: Any = top.containers[0].get_children()[0]
    np.testing.assert_array_equal(points.get_ydata(), noisy)
    np.testing.assert_array_equal(top.lines[1].get_ydata(), result.curve.temperature)
    drawn: Any = bottom.lines[-1]
    np.testing.assert_array_equal(drawn.get_ydata(), result.residuals[""]["temperature"])
    pyplot.close("all")
    with pytest.raises(ValueError, match=r"axes must be two, .* got shape \(3,\)"):
        jaxgran.plot_fit(result, np.zeros(3))


def test_a_fit_of_several_measurements_is_not_drawn():
    each = {"first": [0.92, 0.9], "second": [0.91, 0.9]}
    several = jaxgran.fit(
        {
            name: jaxgran.Measurement(
                glass_beads(), jaxgran.DropTest([0.1, 0.3], eps, [0.01, 0.01])
            )
            for name, eps in each.items()
        },
        quick=True,
    )
    with pytest.raises(ValueError, match="got one of first, second. Draw each"):
        jaxgran.plot_fit(several)
    pyplot.close("all")


def test_plot_functions_are_imported_on_first_use():
    assert set(dir(jaxgran)) == {*jaxgran.__all__, "plot_curve", "plot_fit", "plot_plan"}
    with pytest.raises(AttributeError, match="no attribute 'plot_nothing'"):
        _ = jaxgran.plot_nothing
