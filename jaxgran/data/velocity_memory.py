"""How fast tracked particles forget their velocities, from correlations of their displacements."""

from typing import NamedTuple

import numpy as np
import scipy  # which imports scipy.optimize at its first use
from jaxtyping import Float, Int

from jaxgran.data.displacements import MIN_TRACKS, Step

NUM_ITERATIONS = 50
"""Iterations for T from the displacements, each of which reduces the error by 2 or more."""

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

    With the velocity autocorrelation ``exp(-nu_v t)`` and an error e of the positions

        <dx_k^2> = T f_k + 2 e^2,    <dx_k dx_l> = T h_k h_l exp(-nu_v gap) - e^2 (if they touch),

    where f and h are integrals over the intervals and gap is the time between these.

    Args:
        steps: displacements of at least `MIN_TRACKS` particles each.
        T: mean square of a velocity component by the displacements, m^2/s^2.
        enskog: nu_v/sqrt(T) of elastic spheres by Enskog's theory, 1/m, with the relative error
            `ENSKOG_ERROR`; None if the gas is not known.
        localisation_error: e, m; None if it is to be estimated.
    """
    pairs = _correlations(steps)
    if not (np.all(T > 0) and len(pairs.correlation)):
        return Memory(enskog or 0.0)
    time = np.array([step.time for step in steps])
    duration = np.array([step.duration for step in steps])
    i = pairs.first
    j = pairs.second
    D = T * duration**2
    unit = float(np.median(D))
    gap = np.maximum(time[j] - time[i] - (duration[j] + duration[i]) / 2, 0.0)
    touch = gap < 1e-6 * duration[i]
    prior = None if enskog is None else enskog * unit**0.5
    known_square = (localisation_error or 0.0) ** 2 / unit

    def residuals(parameters: np.ndarray) -> np.ndarray:
        rate = parameters[0]
        square = parameters[1] if len(parameters) > 1 else known_square
        moved = np.maximum(D / unit - 2 * square, 1e-3)
        x = rate * np.sqrt(moved)
        for _ in range(NUM_ITERATIONS):
            x = rate * np.sqrt(moved / displacement_factor(x))
        h = np.sqrt(moved / displacement_factor(x)) * scipy.special.exprel(-x)
        decay = np.exp(-gap * np.sqrt(x[i] / duration[i] * x[j] / duration[j]))
        model = unit * (h[i] * h[j] * decay - square * touch) / np.sqrt(D[i] * D[j])
        known = [] if prior is None else [(rate / prior - 1) / ENSKOG_ERROR]
        return np.concatenate([pairs.weight * (pairs.correlation - model), known])

    def fit(start: list[float], high: list[float]) -> tuple[np.ndarray, np.ndarray]:
        found = scipy.optimize.least_squares(residuals, start, bounds=([0.0] * len(start), high))
        return found.x, np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))

    first = prior or 0.1
    highest = max(20.0, 2 * first)
    found, error = fit([first], [highest])
    estimated = None
    if localisation_error is None:
        both, errors = fit([first, 0.05], [highest, 0.49])
        if both[1] > MIN_SIGMAS * errors[1]:
            found = both
            error = errors
            estimated = float(np.sqrt(both[1] * unit))
    if prior is None and found[0] < MIN_SIGMAS * error[0]:
        return Memory(0.0, estimated)
    ratio = None if prior is None else found[0] / prior
    return Memory(found[0] / unit**0.5, estimated, ratio)


class _Correlations(NamedTuple):
    """Correlations of the displacements in two steps.

    Attributes:
        first: index of the first step.
        second: index of the second one.
        correlation: of the displacements of the particles in both.
        weight: inverse of its error.
    """

    first: Int[np.ndarray, "pairs"]
    second: Int[np.ndarray, "pairs"]
    correlation: Float[np.ndarray, "pairs"]
    weight: Float[np.ndarray, "pairs"]


def _correlations(steps: list[Step]) -> _Correlations:
    """Return the correlations of neighbouring steps, and of those with one step between."""
    rows = []
    for lag in (1, 2):
        for k, (one, two) in enumerate(zip(steps, steps[lag:], strict=False)):
            _, i, j = np.intersect1d(one.ids, two.ids, assume_unique=True, return_indices=True)
            if len(i) < MIN_TRACKS:
                continue
            a, b = (x - x.mean(axis=0) for x in (one.displacement[i], two.displacement[j]))
            correlation = np.sum(a * b) / np.sqrt(np.sum(a**2) * np.sum(b**2))
            rows.append((k, k + lag, correlation, np.sqrt(a.size)))
    first, second, correlation, weight = np.array(rows).reshape(-1, 4).T
    return _Correlations(first.astype(int), second.astype(int), correlation, weight)


def displacement_factor(x: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    """Return ``2 (exp(-x) - 1 + x)/x^2``, T from displacements over x relaxation times, over T."""
    small = x < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 - x / 3, 2 * (np.expm1(-safe) + safe) / safe**2)
