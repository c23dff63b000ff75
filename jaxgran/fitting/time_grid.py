"""The times at which a curve is computed, so that it can be compared with measured values."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxgran._utils.tracing import grid_size

MAX_LOG_STEP = 0.25
"""Longest step between two times at which a curve is computed, in ln(1 + t/tau_c): ln T falls by at
most .4 in a step."""


class TimeGrid(NamedTuple):
    """Times from 0 on, the nodes, which include the times of the data.

    Attributes:
        times: of the nodes, s, not decreasing.
        place: place of each time of the data among the nodes.
    """

    times: Float[np.ndarray, "nodes"]
    place: Int[np.ndarray, "times"]


def time_grid(times: Float[np.ndarray, "times"], mean_free_time: float) -> TimeGrid:
    """Return a grid with the given times, which need not be sorted.

    Neighbours are at most `MAX_LOG_STEP` apart in ``ln(1 + t/tau_c)``. The number of nodes is
    rounded up to a length for which programs are compiled (`grid_size`), by repeating the last one.

    Args:
        times: of the data, s, >= 0.
        mean_free_time: tau_c, s.
    """
    order = np.argsort(times, kind="stable")
    known = np.append(0.0, np.log1p(times[order] / mean_free_time))
    # As many nodes between two times as if the first one were 0: not fewer with another t0.
    since_first = np.log1p((times[order] - times[order[0]]) / mean_free_time)
    lengths = np.append(known[1], np.diff(since_first))
    parts = np.maximum(np.ceil(lengths / MAX_LOG_STEP).astype(int), 1)
    at = np.cumsum(parts)
    logs = np.interp(np.arange(at[-1] + 1), np.append(0, at), known)
    merged = np.expm1(logs) * mean_free_time
    merged[at] = times[order]
    place = np.empty(times.size, int)
    place[order] = at
    padding = grid_size(merged.size) - merged.size
    return TimeGrid(np.append(merged, np.full(padding, merged[-1])), place)


def shift_with_t0(
    grid: TimeGrid, mean_free_time: float, is_before: Bool[np.ndarray, "nodes"]
) -> Float[np.ndarray, "nodes"]:
    """Return the derivative of the times of a grid, distances from the start, in its time t0.

    Data before the start move away from it, those after it move nearer. The start itself stays, and
    nodes between are shifted in proportion to ``ln(1 + t/tau_c)``.

    Args:
        grid: distances of the data from the start, and nodes between.
        mean_free_time: tau_c, s, as in `time_grid`.
        is_before: whether a time of the data is before the start; at other nodes it has no effect.
    """
    times, place = grid
    logs = np.log1p(times / mean_free_time)
    data = np.sort(place)
    shifts = np.where(is_before[data], 1.0, -1.0) / (mean_free_time + times[data])
    shifts = np.interp(logs, np.append(0.0, logs[data]), np.append(0.0, shifts))
    return shifts * (mean_free_time + times)
