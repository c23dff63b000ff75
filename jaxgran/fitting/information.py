"""Fisher information of measurements on the unknowns of a fit, and the causes of their errors."""

from collections import defaultdict
from collections.abc import Callable, Collection
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from jaxgran.fitting.comparison import Residuals
from jaxgran.fitting.evaluation import Evaluation
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import FEW_PARTICLES, MEASUREMENT, MODEL, SAMPLING, SCATTER, SIMULATION
from jaxgran.fitting.search import Minimum, Solution
from jaxgran.scene.laws import RestitutionLaw
from jaxgran.scene.parameter_fields import law_fields

DEGENERATE = 9.0
"""Difference of -2 ln L up to which two minima are equally good: three standard errors."""

UNDETERMINED_ERROR = 1.0
"""Standard error in the unconstrained scale, a factor e, above which nothing is known."""

SOURCE_STEP = 0.02
"""Relative change of a variance by which its part of an error is found."""

MIN_EIGENVALUE = 1e-12
"""Smallest information on a combination of parameters, so that its error stays finite."""

MIN_SHARE = 0.05
"""Share of a parameter in an undetermined combination, over the largest share, from which the
parameter is itself undetermined."""


def inverse(information: np.ndarray) -> np.ndarray:
    """Return the covariance of parameters of some information; very large where there is none."""
    values, axes = np.linalg.eigh(information)
    return axes / np.maximum(values, MIN_EIGENVALUE) @ axes.T


def resolved_inverse(
    information: Float[np.ndarray, "p p"], resolution: float
) -> Float[np.ndarray, "p p"]:
    """Return the covariance of parameters in the combinations that data determine, 0 in others.

    With each parameter scaled to a sensitivity of 1, these are the combinations whose sensitivity
    is above a share of the largest one.

    Args:
        information: on the parameters.
        resolution: the share.
    """
    size = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scale = np.outer(size, size)
    return np.linalg.pinv(information / scale, rcond=resolution**2, hermitian=True) / scale


def information_by_source(solution: Solution) -> dict[str, np.ndarray]:
    """Return the information on all unknowns, as the variance of the estimate's score by source.

    A variance that grows by a share a lowers the information by a times its part.
    """
    problem = solution.problem
    found = solution.evaluate()
    parts: defaultdict[str, np.ndarray] = defaultdict(lambda: np.zeros_like(found.information))
    for source in _sources_of_curves(problem):
        with_variance = partial(_information_of_curves, problem, solution.best.flat, source)
        parts[source] += decrease_with_variance(with_variance)
    for row in found.rows:
        # What the scatter itself tells is as uncertain as few grains make it.
        parts[FEW_PARTICLES] += 0.5 * row.log_slopes.T @ row.log_slopes
        if row.name != "curve":
            parts[_source_of(row)] += row.slopes.T @ row.slopes
    return {name: part for name, part in parts.items() if np.any(part)}


def _sources_of_curves(problem: Problem) -> list[str]:
    """Return the causes of the scatter of the measured curves about theory."""
    if not problem.curves:
        return []
    sources = [MEASUREMENT, FEW_PARTICLES, MODEL]
    if any(m.grains.sample > 0 for m in problem.curves):
        sources.append(SAMPLING)
    if any(np.any(np.asarray(m.simulation) > 0) for m in problem.curves):
        sources.append(SIMULATION)
    return sources


def _information_of_curves(
    problem: Problem, flat: np.ndarray, source: str, factor: float
) -> np.ndarray:
    """Return the information from values of T and T_rot, with a factor of a source's variance."""
    found = problem.evaluate(flat, **{source: factor})
    parts = [row.slopes.T @ row.slopes for row in found.rows if row.name == "curve"]
    return sum(parts, np.zeros_like(found.information))


def _source_of(row: Residuals) -> str:
    """Return the cause of the error of residuals other than those of T and T_rot."""
    if not row.is_prior:
        return MEASUREMENT
    return FEW_PARTICLES if row.name == SCATTER else row.name


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


def covariance_of_minima(solution: Solution, covariance: np.ndarray) -> np.ndarray:
    """Return the covariance of the estimates by minima that are nearly as deep, SI.

    Args:
        solution: of a fit.
        covariance: of all unknowns, in their unconstrained scale.
    """
    problem, best, minima = solution
    error = _errors_of_free(problem, covariance)
    kept = [best]
    for m in sorted(minima, key=lambda minimum: minimum.value):
        if min(_distance(m, other, error) for other in kept) > 1:
            kept.append(m)
    estimate = problem.to_estimates(best.flat)
    distance = np.stack([problem.to_estimates(m.flat) - estimate for m in kept])
    weights = np.exp([(best.value - m.value) / 2 for m in kept])
    return np.einsum("k,ki,kj->ij", weights / np.sum(weights), distance, distance)


def equally_good_minima(solution: Solution, covariance: np.ndarray) -> np.ndarray:
    """Return the estimates at other minima that are as good, three standard errors or more apart.

    Args:
        solution, covariance: see `covariance_of_minima`.
    """
    problem, best, minima = solution
    error = _errors_of_free(problem, covariance)
    estimates: list[np.ndarray] = []
    for m in minima:
        is_deep = m.value < best.value + DEGENERATE
        is_apart = _distance(m, best, error) > DEGENERATE**0.5
        estimate = problem.to_estimates(m.flat)
        is_known = any(np.allclose(estimate, other, rtol=1e-3) for other in estimates)
        if is_deep and is_apart and not is_known:
            estimates.append(estimate)
    return np.array(estimates).reshape(-1, problem.num_free)


def _errors_of_free(problem: Problem, covariance: np.ndarray) -> np.ndarray:
    """Return the standard errors of the free parameters, in their unconstrained scale."""
    return np.sqrt(np.diag(covariance))[: problem.num_free]


def _distance(a: Minimum, b: Minimum, error: np.ndarray) -> float:
    """Return the largest distance of a free parameter between two minima, in standard errors."""
    return float(np.max(np.abs(a.flat - b.flat)[: error.size] / error))


def weights_of_measurements(problem: Problem, found: Evaluation) -> dict[str, np.ndarray]:
    """Return the fraction of the information on each estimate from each measurement.

    The information of a measurement is that on a parameter while all others are known.
    """
    p = problem.num_free
    parts = {m.label: np.zeros(p) for m in problem.measurements}
    for row in found.rows:
        if not row.is_prior:
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
    p = problem.num_free
    measured = [row.slopes[:, :p] for row in found.rows if not row.is_prior]
    priors = [row.slopes[:, :p] for row in found.rows if row.is_prior]
    sensitivity = np.concatenate(measured + priors)
    _, singular, axes = np.linalg.svd(sensitivity, full_matrices=False)
    is_weak = _take_part(axes[singular <= UNDETERMINED_ERROR])
    size = np.maximum(np.linalg.norm(sensitivity, axis=0), np.finfo(float).tiny)
    _, singular, axes = np.linalg.svd(sensitivity / size, full_matrices=False)
    is_weak |= _take_part(axes[singular <= problem.model.derivative_accuracy * singular[0]])
    titles = problem.repeat_per_element([u.title for u in problem.unknowns])[:p]
    left_out = _exempt_parameters(problem.measurements[0].scene.law)
    return tuple(dict.fromkeys(str(x) for x in titles[is_weak] if x not in left_out))


def _take_part(combinations: Float[np.ndarray, "k p"]) -> Bool[np.ndarray, "p"]:
    """Tell which parameters take part in any of some combinations of them."""
    share = np.abs(combinations)
    return np.any(share > MIN_SHARE * share.max(axis=1, initial=0.0, keepdims=True), axis=0)


def _exempt_parameters(law: RestitutionLaw) -> Collection[str]:
    """Return the parameters of a law that need not be determined one by one."""
    if law.prior_residuals().size:
        return law_fields(law).keys()
    return law_fields(law).keys() - law.domains.keys()
