"""Profiles of -2 ln L: fits of all unknowns with increasing amplitudes of an alternative."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.fitting.information import inverse
from jaxgran.fitting.kinds import Kind
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import CurveRows
from jaxgran.fitting.search import MAX_STEP, Objective, minimise, newton_step

ALLOWED = 3.84
"""Increase of -2 ln L over the fitted law up to which its own parameters are allowed (5 % by
chance)."""

ALLOWED_OVER_ALL = 3.84
"""The same of all explanations over the best one."""

EXCLUDED = 4 * ALLOWED
"""Increase beyond which larger amplitudes are not tried."""

NUM_REFINED = 2
"""Number of amplitudes tried between the last allowed one and the first excluded one, and around
each minimum."""

MIN_DROP = 0.25
"""Depth of a minimum among three amplitudes, and by their parabola below the least of them, over
`ALLOWED`, below which none is tried."""

BARRIER = 5.0
"""Factor of `EXCLUDED` for alternatives whose -2 ln L may have a second minimum."""

MIN_SPACING = 0.05
"""Least distance of the latter from those tried, over the distance of these."""

MAX_STEPS = 20
"""Maximum number of steps of a search."""

TRIAL_STEP = 1.0
"""Length of a Newton step, in standard errors, that is the last one of a trial: it is taken without
another curve, and -2 ln L is then known to .1."""


class Trial(NamedTuple):
    """Fit of all unknowns with one amplitude of an alternative.

    Attributes:
        amplitude: of the alternative.
        value: -2 ln L.
        flat: the unknowns, in their unconstrained scale.
        error: standard errors of the free parameters in this scale.
    """

    amplitude: float
    value: float
    flat: Float[np.ndarray, "unknowns"]
    error: Float[np.ndarray, "p"]


def trial_of(
    problem: Problem, amplitude: float, first: np.ndarray, origin: np.ndarray
) -> Trial | None:
    """Fit the unknowns of a problem, in the region around an origin (`Objective`).

    Returns None if it cannot be computed.
    """
    end = minimise(problem, first, MAX_STEPS, TRIAL_STEP, origin)
    if not np.isfinite(end.value):
        return None
    found = problem.evaluate(end.flat)
    error = np.sqrt(np.diag(inverse(found.information))[: problem.num_free])
    step, length = newton_step(found)
    if length >= TRIAL_STEP:  # the search was cut short
        return Trial(amplitude, found.value, end.flat, error)
    # A longer step leaves the region in which -2 ln L is a parabola.
    share = min(1.0, MAX_STEP / max(float(np.max(np.abs(step))), MAX_STEP))
    fall = (2 * share - share**2) * length**2
    flat = Objective(problem, origin).nearest(end.flat + share * step)
    return Trial(amplitude, found.value - fall, flat, error)


def profile_of(problem: Problem, kind: Kind, base: Trial, origin: np.ndarray) -> list[Trial]:
    """Return fits with increasing amplitudes, from 0, of an alternative.

    Args:
        problem, kind: see `compare_alternatives`.
        base: the fit without the alternative.
        origin: of all searches: the fitted law. A search that began at the end of the one before
            would go on to values of A that change nothing.
    """

    def fit_with(amplitude: float, first: np.ndarray) -> Trial | None:
        added = kind.values_by_label(problem, amplitude)
        fixed = problem.fixed_with(added)
        changed = with_wider_rate_error(problem, kind.rate_error(amplitude))
        return trial_of(replace(changed, fixed=fixed), amplitude, first, origin)

    if not kind.keeps_A:
        trial = fit_with(kind.amplitudes[0][0], base.flat)
        return [base] if trial is None else [base, trial]
    trials = [base]
    lowest = base.value
    for sequence in kind.amplitudes:
        before = base
        previous = None
        for amplitude in sequence:
            first = before.flat
            if previous is not None:
                slope = (before.flat - previous.flat) / (before.amplitude - previous.amplitude)
                first = before.flat + np.clip(slope * (amplitude - before.amplitude), -1.0, 1.0)
            trial = fit_with(amplitude, first)
            if trial is None:
                break
            trials.append(trial)
            lowest = min(lowest, trial.value)
            if trial.value > lowest + ALLOWED_OVER_ALL:
                trials += _at_the_limit(fit_with, before, trial, lowest)
            previous = before
            before = trial
            excluded = EXCLUDED * (1.0 if kind.one_minimum else BARRIER)
            if trial.value > lowest + excluded:
                break
    for _ in range(NUM_REFINED):
        trials.sort(key=lambda trial: trial.amplitude)
        threes = [trials[k - 1 : k + 2] for k in range(1, len(trials) - 1)]
        lowest_of_three = [x for x in threes if x[1].value < min(x[0].value, x[2].value)]
        found = [_at_the_vertex(fit_with, three) for three in lowest_of_three]
        trials += [trial for trial in found if trial is not None]
    return sorted(trials, key=lambda trial: trial.amplitude)


def with_wider_rate_error(problem: Problem, error: float) -> Problem:
    """Return a problem with a larger error of the cooling rate of its model."""
    if error == 0:
        return problem

    def widened(m: Any) -> Any:
        if not isinstance(m, CurveRows):
            return m
        wider = m.rate_error._replace(error=m.rate_error.error + error)
        return replace(m, rate_error=wider)

    return replace(problem, measurements=tuple(widened(m) for m in problem.measurements))


def _at_the_vertex(
    fit_with: Callable[[float, np.ndarray], Trial | None], three: list[Trial]
) -> Trial | None:
    """Return the fit at the vertex of the parabola through a minimum of -2 ln L, or on its side."""
    x = np.array([trial.amplitude for trial in three])
    value = np.array([trial.value for trial in three])
    curvature, slope, _ = np.polyfit(x - x[1], value, 2)
    drop = max(np.min(np.delete(value, 1)) - value[1], slope**2 / (4 * curvature))
    if drop < MIN_DROP * ALLOWED:
        return None
    vertex = x[1] - slope / (2 * curvature)
    if np.min(np.abs(vertex - x)) <= MIN_SPACING * (x[2] - x[0]):
        vertex = (x[1] + (x[2] if vertex > x[1] else x[0])) / 2
    return fit_with(vertex, three[1].flat)


def _at_the_limit(
    fit_with: Callable[[float, np.ndarray], Trial | None],
    low: Trial,
    high: Trial,
    least: float,
) -> list[Trial]:
    """Return fits near the amplitude at which -2 ln L, a parabola, exceeds its least value by
    `ALLOWED_OVER_ALL`.

    The last one comes within a quarter of this increase, if `NUM_REFINED` are enough.
    """
    increase = ALLOWED_OVER_ALL
    trials = []
    while low.value <= least + increase < high.value and len(trials) < NUM_REFINED:
        at_low = np.sqrt(low.value - least)
        at_high = np.sqrt(high.value - least)
        share = float(np.clip((np.sqrt(increase) - at_low) / (at_high - at_low), 0.05, 0.95))
        amplitude = low.amplitude + share * (high.amplitude - low.amplitude)
        trial = fit_with(amplitude, low.flat + share * (high.flat - low.flat))
        if trial is None:
            break
        trials.append(trial)
        least = min(least, trial.value)
        if abs(trial.value - least - increase) < increase / 4:
            break
        low, high = (trial, high) if trial.value <= least + increase else (low, trial)
    return trials
