"""What a fit concludes: the range in one line, a grade with a verdict, and the reasons for it."""

from collections.abc import Sequence
from dataclasses import replace

from jaxgran.fitting.alternatives import Explanations
from jaxgran.fitting.headline import headline, narrowing
from jaxgran.fitting.reasons import (
    describe_comparison,
    describe_convergence,
    describe_fit,
    describe_search,
    describe_surroundings,
)
from jaxgran.fitting.result import Fit
from jaxgran.fitting.setup import Request
from jaxgran.fitting.verdict import limitations_of, misfit_of, verdict


def with_conclusions(
    request: Request,
    result: Fit,
    explanations: Explanations | None,
    notes: Sequence[str],
    measurement_share: float,
) -> Fit:
    """Return a fit with its first line, grade, verdict and reasons.

    Args:
        request: of the user.
        result: a fit whose numbers are complete.
        explanations: the fitted law and its alternatives; None if they were not compared.
        notes: further reasons.
        measurement_share: share of the errors of the measurement in the variances of T, see
            `jaxgran.fitting.goodness.measurement_share`.
    """
    limitations = limitations_of(request.model, result)
    misfit = misfit_of(result, measurement_share)
    not_computed = () if explanations is None else explanations.not_computed
    grade, sentence = verdict(result, misfit, limitations, not_computed)
    reasons = (
        *describe_fit(result, misfit, request.model),
        *describe_comparison(request, result, explanations),
        *notes,
        *describe_surroundings(result),
        *(limitation.words for limitation in limitations),
        *describe_convergence(result),
        *describe_search(result),
    )
    return replace(
        result,
        grade=grade,
        headline=headline(result),
        narrowing=narrowing(result, explanations),
        verdict=sentence,
        reasons=reasons,
    )
