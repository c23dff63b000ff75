"""An unknown start of the clock."""

import dataclasses
import re

import jax
import numpy as np
import pytest

import jaxgran
from tests.fitting.curves import A, cooled_beads, fitted


def shifted(curve, late):
    """The curve on a clock that was started earlier than the gas."""
    return dataclasses.replace(curve, times=curve.times + late)


def test_t0_takes_up_a_late_clock():
    """A curve on two clocks has one A, and the values of t0 differ by the offset."""
    gas, curve = cooled_beads()
    late = 10.0 * float(curve.times[0])
    early, later = (fitted(gas, shifted(curve, x), free=(A, "t0")) for x in (0.0, late))
    assert early.converged and later.converged
    # Two searches, each to 1e-2 of a standard error.
    np.testing.assert_allclose(later.estimate[0], early.estimate[0], rtol=1e-4)
    error = float(later.value("t0")[1])
    (begun, delayed) = (x.start_time[""] for x in (early, later))
    assert delayed - begun == pytest.approx(late, abs=0.02 * error)
    # The gas itself began at 0; the curve is theory's own, so that the error is the measurement's.
    assert abs(begun) < 3 * float(early.error_budget["measurement"][1])
    assert early.undetermined == () and f"{late:.0e}"[0] in repr(later)
    # Without t0 the same curve is not explained.
    assert fitted(gas, shifted(curve, late), num_particles=10**7).p_value < 1e-6


def test_a_gas_begun_before_the_file_is_found():
    """Times counted from a point that lies after the start: t0 is negative."""
    gas, curve = cooled_beads(2, num_points=52)  # 40 are left, as in other tests
    first = float(curve.times[12])
    part = shifted(jax.tree.map(lambda x: x[12:], curve), -first)
    result = fitted(gas, part, free=(A, "t0"))
    t0, deviation = result.value("t0")
    assert abs(float(t0) + first) < 3 * float(deviation)


@pytest.mark.slow
def test_t0_and_the_first_temperature_are_not_found_together():
    gas, curve = cooled_beads()
    with pytest.warns(UserWarning, match="T0 and t0: .*forgets"):
        both = fitted(gas, curve, free=(A, "temperature", "t0"), quick=False)
    assert both.undetermined == ("temperature", "t0") and both.converged
    assert len(re.findall(r"(T\S*|t0) +not determined", repr(both))) == 2
    # The constant of the material does not depend on where the course begins.
    alone = fitted(gas, curve, free=(A, "temperature"))
    error = float(alone.error_budget["measurement"][0])
    assert float(both.estimate[0]) == pytest.approx(float(alone.estimate[0]), abs=error)
    assert "does not determine T0 and t0" not in both.verdict  # A is determined
    assert any("does not determine T0 and t0" in x for x in both.reasons)


def test_curves_of_one_material_have_their_own_clocks():
    gas, curve = cooled_beads()
    late = 20.0 * float(curve.times[0])
    data = {"prompt": shifted(curve, 0.0), "late": shifted(curve, late)}
    known = {"errors_measured": True, "num_particles": 10**7}
    data = {label: jaxgran.Measurement(gas, x, **known) for label, x in data.items()}
    found = jaxgran.fit(data, separate=("t0",), quick=True)
    delay = found.value("late: t0")[0] - found.value("prompt: t0")[0]
    assert float(delay) == pytest.approx(late, rel=0.01)
    assert found.p_value > 0.01 and found.converged
