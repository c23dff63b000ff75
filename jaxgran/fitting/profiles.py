"""Profiles of -2 ln L: fits of all unknowns with increasing amplitudes of an alternative."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxgran.fitting.information import inverse
from jaxgran.fitting.kinds import Kind
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.search import Objective, minimise, newton_step

ALLOWED = 3.84
"""Increase of -2 ln L over the minimum of one explanation up to which its parameters are allowed:
the value that chi^2 of one degree of freedom exceeds in 5 % of cases (chi2.isf(0.05, 1))."""

ALLOWED_OVER_ALL = 3.84
"""The same over the minimum of all explanations, up to which an amplitude is allowed. It has a name
of its own because another level of it would change which explanations are left, and not the range
of the parameters in each of them."""

EXCLUDED = 4 * ALLOWED
"""Increase beyond which larger amplitudes are not tried."""

NUM_REFINED = 2
"""Number of amplitudes tried between the last allowed one and the first excluded one, and around
each minimum."""

MIN_DROP = 0.25
"""A minimum between three amplitudes is refined only if it is deeper than this, in units of
`ALLOWED`."""

BARRIER = 5.0
"""Factor of `EXCLUDED` for alternatives whose -2 ln L may have a second minimum."""

MIN_SPACING = 0.05
"""Smallest distance of a refined amplitude from a tried one, over the distance of the outer two of
three amplitudes."""

MAX_STEPS = 20
"""Maximum number of steps of a search."""

TRIAL_STEP = 1.0
"""A search ends where the next Newton step is shorter than this, in standard errors. The trial
takes this step without another evaluation, which gives -2 ln L to 0.1."""

MAX_CHANGE = 1.0
"""Largest change of an unconstrained parameter in that step, and from the fit with one amplitude to
the first guess with the next one: a factor e of a positive parameter. Beyond it -2 ln L is not a
parabola, and the unknowns are not linear in the amplitude."""


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
    share = MAX_CHANGE / max(float(np.max(np.abs(step))), MAX_CHANGE)
    flat = Objective(problem, origin).nearest(end.flat + share * step)
    # The parabola has its minimum at the end of the whole step, `length**2` below its value here.
    left = end.flat + step - flat
    fall = length**2 - float(left @ found.information @ left)
    return Trial(amplitude, found.value - fall, flat, error)


def profile_of(problem: Problem, kind: Kind, base: Trial, origin: np.ndarray) -> list[Trial]:
    """Return fits with increasing amplitudes of an alternative, the fit without it among them.

    Amplitudes that cannot be computed are left out.

    Args:
        problem, kind: see `compare_alternatives`.
        base: the fit without the alternative.
        origin: of all searches: the fitted law. A search that began at the end of the one before
            would go on to values of A that change nothing.
    """
    profile = _Profile(problem, kind, base, origin)
    trials = [base]
    for amplitudes in kind.amplitudes:
        trials += profile.fit_sequence(amplitudes, min(trial.value for trial in trials))
    if kind.keeps_A:
        for _ in range(NUM_REFINED):
            trials += profile.refine(sorted(trials, key=_amplitude))
    return sorted(trials, key=_amplitude)


def _amplitude(trial: Trial) -> float:
    return trial.amplitude


@dataclass(frozen=True)
class _Profile:
    """Fits with the amplitudes of an alternative.

    Attributes:
        problem, kind, base, origin: see `profile_of`.
    """

    problem: Problem
    kind: Kind
    base: Trial
    origin: Float[np.ndarray, "unknowns"]

    def fit(self, amplitude: float, first: np.ndarray) -> Trial | None:
        """Fit all unknowns with an amplitude, from a first guess; None if this fails."""
        added = self.kind.values_by_label(self.problem, amplitude)
        wider = self.kind.with_wider_rate_errors(self.problem, amplitude)
        fixed = self.problem.extend_fixed(added)
        return trial_of(replace(wider, fixed=fixed), amplitude, first, self.origin)

    def fit_sequence(self, amplitudes: Iterable[float], lowest: float) -> list[Trial]:
        """Fit with amplitudes further and further from 0, up to one that is excluded.

        Args:
            amplitudes: in this order.
            lowest: -2 ln L of the best fit before.
        """
        excluded = EXCLUDED * (1.0 if self.kind.one_minimum else BARRIER)
        trials = []
        previous = None
        before = self.base
        for amplitude in amplitudes:
            trial = self.fit(amplitude, _extrapolated(previous, before, amplitude))
            if trial is None:
                continue
            trials.append(trial)
            lowest = min(lowest, trial.value)
            if self.kind.keeps_A and trial.value > lowest + ALLOWED_OVER_ALL:
                trials += self._fit_near_limit(before, trial, lowest)
            if trial.value > lowest + excluded:
                break
            previous = before
            before = trial
        return trials

    def refine(self, trials: list[Trial]) -> list[Trial]:
        """Fit near each minimum of -2 ln L among trials of increasing amplitudes."""
        found = [
            self._fit_near_minimum(trials[k - 1 : k + 2])
            for k in range(1, len(trials) - 1)
            if trials[k].value < min(trials[k - 1].value, trials[k + 1].value)
        ]
        return [trial for trial in found if trial is not None]

    def _fit_near_minimum(self, three: list[Trial]) -> Trial | None:
        """Fit with the amplitude at the vertex of a parabola through three trials.

        If the vertex is too near to a tried amplitude, one beside it takes its place.
        """
        x = np.array([trial.amplitude for trial in three])
        value = np.array([trial.value for trial in three])
        curvature, slope, _ = np.polyfit(x - x[1], value, 2)
        drop = max(np.min(np.delete(value, 1)) - value[1], slope**2 / (4 * curvature))
        if drop < MIN_DROP * ALLOWED:
            return None
        vertex = x[1] - slope / (2 * curvature)
        if np.min(np.abs(vertex - x)) <= MIN_SPACING * (x[2] - x[0]):
            vertex = (x[1] + (x[2] if vertex > x[1] else x[0])) / 2
        return self.fit(vertex, three[1].flat)

    def _fit_near_limit(self, inside: Trial, outside: Trial, lowest: float) -> list[Trial]:
        """Fit with amplitudes at which -2 ln L, a parabola, exceeds its lowest value by
        `ALLOWED_OVER_ALL`.

        The last one comes within a quarter of this increase, if `NUM_REFINED` are enough.
        """
        increase = ALLOWED_OVER_ALL
        trials = []
        while inside.value <= lowest + increase < outside.value and len(trials) < NUM_REFINED:
            root_inside = np.sqrt(inside.value - lowest)
            root_outside = np.sqrt(outside.value - lowest)
            share = (np.sqrt(increase) - root_inside) / (root_outside - root_inside)
            share = float(np.clip(share, 0.05, 0.95))
            amplitude = inside.amplitude + share * (outside.amplitude - inside.amplitude)
            trial = self.fit(amplitude, inside.flat + share * (outside.flat - inside.flat))
            if trial is None:
                break
            trials.append(trial)
            lowest = min(lowest, trial.value)
            if abs(trial.value - lowest - increase) < increase / 4:
                break
            if trial.value <= lowest + increase:
                inside = trial
            else:
                outside = trial
        return trials


def _extrapolated(previous: Trial | None, before: Trial, amplitude: float) -> np.ndarray:
    """Return a first guess of the unknowns, on the line through the last two trials."""
    if previous is None:
        return before.flat
    slope = (before.flat - previous.flat) / (before.amplitude - previous.amplitude)
    change = slope * (amplitude - before.amplitude)
    return before.flat + np.clip(change, -MAX_CHANGE, MAX_CHANGE)
