"""How fast tracked particles forget their velocities, from correlations of their displacements.

Impacts between two frames bend the paths, so that particles get less far than in free flight. The
velocity autocorrelation is taken to be ``exp(-nu_v t)``.
"""

from typing import NamedTuple

import numpy as np
import scipy  # which imports scipy.optimize at its first use
from jaxtyping import Float, Int

from jaxgran.data.displacements import MIN_TRACKS, Step

NUM_ITERATIONS = 50
"""Iterations of `free_flight_squares`, each of which reduces the error by 2 or more."""

MIN_FREE_SHARE = 1e-3
"""Least share of a mean square displacement that a fit leaves after errors of the positions."""

TOUCHING = 1e-6
"""Gap of two intervals, over the duration of the first, below which they share a frame."""

MIN_SIGMAS = 5.0
"""Least significance of what the displacements show, the errors of which are correlated."""

ENSKOG_ERROR = 0.2
"""Relative standard error of Enskog's rate for a granular gas."""


class Memory(NamedTuple):
    """What the correlations of displacements show.

    Attributes:
        rate: nu_v/sqrt(T), 1/m; 0 if it is not significant.
        localisation_error: standard error of one coordinate, m; None if it was given, or is not
            significant.
        rate_ratio: rate over Enskog's; None if one of them is not known.
    """

    rate: float
    localisation_error: float | None = None
    rate_ratio: float | None = None


def fit_memory(
    steps: list[Step],
    T: Float[np.ndarray, "steps"],
    enskog: float | None,
    localisation_error: float | None,
) -> Memory:
    """Return how fast the velocities are forgotten.

    Displacements in the intervals k and l have the mean squares s_k and s_l in free flight, last
    x_k and x_l relaxation times, and have errors e of the positions:

        <dx_k^2> = s_k f(x_k) + 2 e^2,
        <dx_k dx_l> = sqrt(s_k s_l) g(x_k) g(x_l) exp(-nu_v gap) - e^2 (if they touch),

    with `displacement_factor` f, ``g(x) = (1 - exp(-x))/x``, and the time between them as gap.

    Args:
        steps: displacements of at least `MIN_TRACKS` particles each.
        T: mean square of a velocity component by the displacements, m^2/s^2.
        enskog: nu_v/sqrt(T) of elastic spheres by Enskog's theory, 1/m, with the relative error
            `ENSKOG_ERROR`; None if the gas is not known.
        localisation_error: e, m; None if it is to be estimated.
    """
    pairs = _measured_correlations(steps)
    if not (np.all(T > 0) and len(pairs.correlation)):
        return Memory(enskog or 0.0)
    duration = np.array([step.duration for step in steps])
    squares = T * duration**2
    unit = float(np.median(squares))
    # Lengths in the fit are in sqrt(unit), so that its parameters are of the order of 1.
    expected_rate = None if enskog is None else enskog * unit**0.5
    given_error_square = (localisation_error or 0.0) ** 2 / unit

    def residuals(parameters: np.ndarray) -> np.ndarray:
        rate = parameters[0]
        error_square = parameters[1] if len(parameters) > 1 else given_error_square
        model = _model_correlations(pairs, squares, duration, unit, rate, error_square)
        misfit = pairs.weight * (pairs.correlation - model)
        if expected_rate is None:
            return misfit
        return np.append(misfit, (rate / expected_rate - 1) / ENSKOG_ERROR)

    def fit(start: list[float], high: list[float]) -> tuple[np.ndarray, np.ndarray]:
        found = scipy.optimize.least_squares(residuals, start, bounds=([0.0] * len(start), high))
        return found.x, np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))

    first_rate = expected_rate or 0.1
    max_rate = max(20.0, 2 * first_rate)  # far above what displacements can show
    found, error = fit([first_rate], [max_rate])
    estimated = None
    if localisation_error is None:
        # 2 e^2 is at most the whole of a mean square displacement.
        both, errors = fit([first_rate, 0.05], [max_rate, 0.49])
        if both[1] > MIN_SIGMAS * errors[1]:
            found = both
            error = errors
            estimated = float(np.sqrt(both[1] * unit))
    if expected_rate is None and found[0] < MIN_SIGMAS * error[0]:
        return Memory(0.0, estimated)
    ratio = None if expected_rate is None else found[0] / expected_rate
    return Memory(found[0] / unit**0.5, estimated, ratio)


class _Correlations(NamedTuple):
    """Correlations of the displacements in two intervals.

    Attributes:
        first: index of the first interval.
        second: index of the second one.
        gap: time from the end of the first to the start of the second, s.
        correlation: of the displacements of the particles in both.
        weight: inverse of its error.
    """

    first: Int[np.ndarray, "pairs"]
    second: Int[np.ndarray, "pairs"]
    gap: Float[np.ndarray, "pairs"]
    correlation: Float[np.ndarray, "pairs"]
    weight: Float[np.ndarray, "pairs"]


def _measured_correlations(steps: list[Step]) -> _Correlations:
    """Return the correlations of neighbouring steps, and of those with one step between."""
    rows = []
    for lag in (1, 2):
        for k, (one, two) in enumerate(zip(steps, steps[lag:], strict=False)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            if len(i) < MIN_TRACKS:
                continue
            a = _centred(one.displacement[i])
            b = _centred(two.displacement[j])
            gap = two.time - one.time - (two.duration + one.duration) / 2
            correlation = np.sum(a * b) / np.sqrt(np.sum(a**2) * np.sum(b**2))
            rows.append((k, k + lag, max(gap, 0.0), correlation, np.sqrt(a.size)))
    first, second, gap, correlation, weight = np.array(rows).reshape(-1, 5).T
    return _Correlations(first.astype(int), second.astype(int), gap, correlation, weight)


def _centred(displacement: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return displacement - displacement.mean(axis=0)


def _model_correlations(
    pairs: _Correlations,
    squares: Float[np.ndarray, "steps"],
    duration: Float[np.ndarray, "steps"],
    unit: float,
    rate: float,
    error_square: float,
) -> Float[np.ndarray, "pairs"]:
    """Return the correlations of `fit_memory` at a rate and an error of the positions.

    Args:
        pairs: the intervals.
        squares: mean square of one component of the displacements in each interval, m^2.
        duration: of each interval, s.
        unit: square of the unit of length of the fit, m^2.
        rate: nu_v/sqrt(T) times the unit of length.
        error_square: e^2 over the unit.
    """
    i = pairs.first
    j = pairs.second
    without_error = np.maximum(squares / unit - 2 * error_square, MIN_FREE_SHARE)
    relaxations = rate * np.sqrt(free_flight_squares(without_error, rate))
    free_flight = np.sqrt(without_error / displacement_factor(relaxations))
    moved = free_flight * scipy.special.exprel(-relaxations)
    nu_v_square = relaxations[i] / duration[i] * relaxations[j] / duration[j]
    decay = np.exp(-pairs.gap * np.sqrt(nu_v_square))
    touch = pairs.gap < TOUCHING * duration[i]
    covariance = moved[i] * moved[j] * decay - error_square * touch
    return unit * covariance / np.sqrt(squares[i] * squares[j])


def free_flight_squares(
    squares: Float[np.ndarray, "steps"], rate: float | Float[np.ndarray, "steps"]
) -> Float[np.ndarray, "steps"]:
    """Return the mean squares s that displacements would have without impacts between the frames.

    They solve ``squares = s f(rate sqrt(s))`` with `displacement_factor` f.

    Args:
        squares: mean square of one component of the displacements, in any unit.
        rate: relaxation times in a displacement of unit length in free flight.
    """
    free = squares
    for _ in range(NUM_ITERATIONS):
        free = squares / displacement_factor(rate * np.sqrt(free))
    return free


def displacement_factor(x: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    """Return ``2 (exp(-x) - 1 + x)/x^2``, T from displacements over x relaxation times, over T."""
    small = x < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 - x / 3, 2 * (np.expm1(-safe) + safe) / safe**2)
