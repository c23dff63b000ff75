"""What a measurement tells about the unknowns of a fit, and by which cause they err."""

from collections.abc import Callable

import numpy as np

from jaxgran.fitting.problem import Evaluation, Problem
from jaxgran.fitting.rows import SCATTER
from jaxgran.fitting.search import Minimum
from jaxgran.scene.parameter_fields import law_fields

DEGENERATE = 9.0
"""Difference of -2 ln L up to which two minima are equally good: three standard errors."""

UNDETERMINED_ERROR = 1.0
"""Standard error in the unconstrained scale, a factor e, above which nothing is known."""

SOURCE_STEP = 0.02
"""Relative change of a variance by which its part of an error is found."""

MIN_EIGENVALUE = 1e-12
"""Least information on a combination of parameters: their error is then infinite to all ends."""

FEW_PARTICLES = "few particles"
"""Part of an error by the randomness of collisions of N grains."""

SAMPLING = "sampling"
"""Part of an error by T of some tracked grains in place of all."""


def inverse(information: np.ndarray) -> np.ndarray:
    """Return the covariance of parameters of some information; very large where there is none."""
    values, axes = np.linalg.eigh(information)
    return axes / np.maximum(values, MIN_EIGENVALUE) @ axes.T


def information_by_source(
    problem: Problem, flat: np.ndarray, found: Evaluation
) -> dict[str, np.ndarray]:
    """Return the information on all unknowns, as the variance of the estimate's score by source.

    A variance that grows by a share a lowers the information by a times its part.
    """
    parts: dict[str, np.ndarray] = {}

    def add(name: str, part: np.ndarray) -> None:
        parts[name] = parts.get(name, 0.0) + part

    def linear(evaluation: Evaluation) -> np.ndarray:
        return sum(
            (row.slopes.T @ row.slopes for row in evaluation.rows if row.name == "curve"),
            np.zeros_like(found.information),
        )

    sources = ["measurement", FEW_PARTICLES, "model"]
    if any(m.grains.sample > 0 for m in problem.curves):
        sources.append(SAMPLING)
    if any(np.any(np.asarray(m.simulation) > 0) for m in problem.curves):
        sources.append("simulation")
    for name in sources if problem.curves else []:
        add(
            name, decrease_with_variance(lambda x, n=name: linear(problem.evaluate(flat, **{n: x})))
        )
    for row in found.rows:
        # What the scatter itself tells is as uncertain as few grains make it.
        add(FEW_PARTICLES, 0.5 * row.log_slopes.T @ row.log_slopes)
        if row.name == "curve":
            continue
        name = row.name if row.is_prior else "measurement"
        add(FEW_PARTICLES if name == SCATTER else name, row.slopes.T @ row.slopes)
    return {name: part for name, part in parts.items() if np.any(part)}


def decrease_with_variance(information: Callable[[float], np.ndarray]) -> np.ndarray:
    """Return how much an information decreases with the logarithm of a variance.

    Args:
        information: as a function of a factor of this variance.
    """
    less = information(1 - SOURCE_STEP)
    more = information(1 + SOURCE_STEP)
    return positive((less - more) / (2 * SOURCE_STEP))


def positive(matrix: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix without the negative eigenvalues of round-off."""
    values, axes = np.linalg.eigh(matrix)
    return axes * np.maximum(values, 0.0) @ axes.T


def covariance_of_minima(
    problem: Problem, end: Minimum, minima: list[Minimum], covariance: np.ndarray
) -> np.ndarray:
    """Return the covariance of the estimates by minima that are nearly as deep, SI."""
    p = problem.num_free
    error = np.sqrt(np.diag(covariance))[:p]
    kept = [end]
    for m in sorted(minima, key=lambda minimum: minimum.value):
        nearest = min(np.max(np.abs(m.flat - x.flat)[:p] / error) for x in kept)
        if nearest > 1:
            kept.append(m)
    distance = np.stack([problem.estimates(m.flat) - problem.estimates(end.flat) for m in kept])
    weights = np.exp([(end.value - m.value) / 2 for m in kept])
    return np.einsum("k,ki,kj->ij", weights / np.sum(weights), distance, distance)


def equally_good_minima(
    problem: Problem, end: Minimum, minima: list[Minimum], covariance: np.ndarray
) -> np.ndarray:
    """Return the estimates at other minima that are as good, and apart by three standard errors."""
    p = problem.num_free
    error = np.sqrt(np.diag(covariance))[:p]
    solutions: list[np.ndarray] = []
    for m in minima:
        apart = np.max(np.abs(m.flat - end.flat)[:p] / error) > DEGENERATE**0.5
        estimate = problem.estimates(m.flat)
        known = any(np.allclose(estimate, other, rtol=1e-3) for other in solutions)
        if m.value < end.value + DEGENERATE and apart and not known:
            solutions.append(estimate)
    return np.array(solutions).reshape(-1, p)


def weights_of_measurements(problem: Problem, found: Evaluation) -> dict[str, np.ndarray]:
    """Return the fraction of the information on each estimate from each measurement.

    The information of a measurement is that on a parameter while all others are known.
    """
    p = problem.num_free
    parts = {m.label: np.zeros(p) for m in problem.measurements}
    for row in found.rows:
        if not row.is_prior and row.label is not None:
            parts[row.label] = parts[row.label] + np.diag(row.information)[:p]
    whole = np.maximum(np.sum(list(parts.values()), axis=0), np.finfo(float).tiny)
    return {label: part / whole for label, part in parts.items()}


def undetermined(problem: Problem, found: Evaluation) -> tuple[str, ...]:
    """Return the parameters that the data do not determine, or only in a combination.

    These are the parameters in those singular vectors of the sensitivity whose standard error
    exceeds 1 (a factor e), or, with each parameter scaled to a sensitivity of 1, whose singular
    value is below ``model.derivative_accuracy`` times the largest. Parameters of a law with a
    smoothness prior, and arrays in parts of a law, such as a neural network, are not among them.
    """
    gas = problem.measurements[0].scene
    without_meaning = law_fields(gas.law).keys() - gas.law.domains.keys()
    left_out = law_fields(gas.law) if gas.law.prior_residuals().size else without_meaning
    p = problem.num_free
    measured = [row.slopes[:, :p] for row in found.rows if not row.is_prior]
    priors = [row.slopes[:, :p] for row in found.rows if row.is_prior]
    sensitivity = np.concatenate(measured + priors)
    size = np.maximum(np.linalg.norm(sensitivity, axis=0), np.finfo(float).tiny)
    is_weak = np.zeros(p, bool)
    accuracy = problem.model.derivative_accuracy
    for scale, limit in ((np.ones(p), UNDETERMINED_ERROR), (size, accuracy)):
        _, singular, rotation = np.linalg.svd(sensitivity / scale, full_matrices=False)
        least = limit * (singular[0] if scale is size else 1.0)
        share = np.abs(rotation[singular <= least])
        is_weak |= np.any(share > 0.05 * share.max(axis=1, initial=0.0, keepdims=True), axis=0)
    titles_of_elements = np.repeat(
        [u.title for u in problem.unknowns], [u.size for u in problem.unknowns]
    )[:p]
    weak = [str(name) for name, is_so in zip(titles_of_elements, is_weak, strict=True) if is_so]
    return tuple(dict.fromkeys(name for name in weak if name not in left_out))
