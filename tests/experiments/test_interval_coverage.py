"""Intervals of fits to single runs of few particles, and to runs of a gas that clusters."""

import numpy as np
import pytest

from experiments.fit import interval_coverage


def test_measured_runs_cool():
    times, runs = interval_coverage.measured()
    assert runs.shape == (interval_coverage.MOST, interval_coverage.POINTS) == (20, 30)
    assert np.all(np.diff(times) > 0) and times[0] > 0
    # T_0 is .01 m^2/s^2; 30 collisions with beta_T0 = .2 leave a few per cent.
    assert np.all(runs[:, 0] < 0.01) and np.all(runs[:, -1] < 0.05 * 0.01)
    assert len({*runs[:, -1]}) == len(runs)  # each from a start of its own


def test_statistics_of_fits():
    found = interval_coverage.statistics(
        [{"ratio": ratio, "error": 0.1} for ratio in (0.9, 1.1, 1.19, 1.2)]
    )
    assert (found["runs"], found["held"]) == (4, 3)  # 1.96 standard errors hold all but the last
    assert found["expected_scatter"] == pytest.approx(0.1)
    assert found["bias"] == pytest.approx(np.mean(np.log([0.9, 1.1, 1.19, 1.2])))
