"""Clauses of a diagnosis about chi^2, residuals and the search."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jaxgran.fitting.minima import minima_in_words
from jaxgran.fitting.result import SIGNIFICANCE, Fit


def about_chance(result: Fit) -> str:
    reduced, p_value = float(result.reduced_chi2), float(result.p_value)
    if result.scatter is not None:
        scatter = 100 * float(np.asarray(result.scatter))
        return (
            f"the curve carries no errors; the residuals scatter by {scatter:.2g} % of T, taken as "
            "the error"
        )
    chance = f"{100 * p_value:.2g}" if p_value < 0.99 else "over 99"
    return (
        f"reduced chi^2 is {reduced:.3g} for {int(result.degrees_of_freedom)} degrees of freedom "
        f"(probability by chance: {chance} %)"
    )


def about_residuals(
    residuals: Float[np.ndarray, "used"],
    times: Float[np.ndarray, "used"],
    correlation: float,
    p_value: float,
) -> Iterator[str]:
    """Correlation and outliers.

    Args:
        residuals: over their errors, where they have a weight.
        times: t, s, of the residuals.
        correlation: of neighbouring residuals.
        p_value: of the fit, nan if the errors are unknown.
    """
    if correlation > 2 / np.sqrt(residuals.size):
        text = f"neighbouring residuals are correlated (coefficient {correlation:.2f})"
        if p_value < SIGNIFICANCE:
            early, middle, late = (float(p.mean()) for p in np.array_split(residuals, 3))
            yield (
                f"{text} and drift: the measured gas is hotter (+) or colder (-) than the model by "
                f"{early:+.1f}, {middle:+.1f}, {late:+.1f} standard errors on average in the first,"
                " second and last third"
            )
        else:
            yield f"{text}, as points of the same runs are: the error is increased for it"
    if p_value > 1 - SIGNIFICANCE:
        share = float(np.sqrt(np.mean(residuals**2)))
        yield (
            f"residuals scatter by {share:.2g} of the errors of T, less than chance allows: these "
            "errors are too large, or the points share theirs"
        )
    far = np.abs(residuals) > 5
    if not np.isnan(p_value) and 0 < far.sum() <= max(2, residuals.size // 20):
        at = ", ".join(f"t = {t:.3g} s" for t in times[far])
        yield f"far outliers at {at}: check their error bars"


def about_runs(runs: tuple[int, float, float]) -> Iterator[str]:
    number, expected, chance = runs
    if chance < SIGNIFICANCE:
        yield (
            f"residuals change their sign seldom: {number} runs of one sign, where independent "
            f"ones have {expected:.3g} (probability by chance: {100 * chance:.2g} %)"
        )


def about_search(result: Fit) -> Iterator[str]:
    """Convergence, noise of simulations and undetermined parameters."""
    if not bool(result.converged):
        yield "the search stopped early: allow more max_steps or free fewer parameters"
    noise = result.error_budget.get("simulation")
    if noise is not None:
        share = np.asarray(noise / result.standard_error)
        yield (
            f"{int(result.iterations)} simulations were run; their own noise is "
            f"{100 * float(np.max(share)):.0f} % of the error bar at most"
        )
    group = result.undetermined()
    if group:
        yield f"this curve does not determine {' and '.join(group)}"
    if others := minima_in_words(result.names, result.as_good()):
        yield others
