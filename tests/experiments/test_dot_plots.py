"""Pictures made from recorded figures alone."""

import numpy as np
import pytest

from experiments.support.dot_plots import PLOTS, Dot, DotPlot, drawn
from experiments.support.record import figures


@pytest.mark.parametrize("name", PLOTS)
def test_recorded_figures_can_be_drawn(name):
    plot = PLOTS[name](figures(name))
    axes = drawn(plot).axes[0]
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert labels == list(dict.fromkeys(dot.label for dot in plot.dots))
    # One marker for each dot, at its value.
    markers = [line for line in axes.lines if line.get_marker() in "os"]
    shown = [np.asarray(line.get_xdata())[0] for line in markers if np.size(line.get_xdata())]
    assert sorted(shown) == sorted(dot.value for dot in plot.dots)


def test_dots_of_one_label_share_a_line_and_bars_span_their_range():
    plot = DotPlot([Dot("a", 2.0, 1.0, 3.0), Dot("a", 4.0, hollow=True), Dot("b", 5.0)], "x")
    axes = drawn(plot).axes[0]
    markers = [line for line in axes.lines if line.get_marker() in "os"]
    assert [np.asarray(line.get_ydata())[0] for line in markers] == [0, 0, 1]
    (bar,) = [line for line in axes.lines if np.size(line.get_xdata()) == 2]
    assert list(np.asarray(bar.get_xdata())) == [1.0, 3.0]
