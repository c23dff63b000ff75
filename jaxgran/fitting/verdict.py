"""The verdict of a fit: its grade, and the sentence that says it."""

from typing import NamedTuple

import numpy as np
import scipy  # which imports scipy.stats at its first use

from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.alternatives import Alternative
from jaxgran.fitting.goodness import SIGNIFICANCE
from jaxgran.fitting.headline import MAX_RATIO, describe_range, first_range, unit_after_number
from jaxgran.fitting.result import DETERMINED, NOT_CONSISTENT, NOT_DETERMINED, Fit, by_label
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.scene.parameters import symbol_of

RISING_SIGNIFICANCE = 0.05
"""Level at which T is found to rise: of four rising values the probability by chance is 0.04."""

DECISIVE_WEIGHT = 0.8
"""Weight in a parameter above which impacts, or curves, are said to determine it."""

MAX_MEASUREMENT_SHARE = 0.5
"""Share of the errors of the measurement in the variances of T from which too little scatter is
blamed on these errors, and not on the grains."""


class Misfit(NamedTuple):
    """How the data differ from what the model, N grains and the errors allow.

    Attributes:
        scatters_more: whether they scatter more about the model.
        scatters_less: whether the curve scatters less.
        is_smooth: whether that is a misfit of the grains, and not of errors that are too large.
        rising: the first and the last T of curves without errors that rise.
    """

    scatters_more: bool
    scatters_less: bool
    is_smooth: bool
    rising: list[tuple[float, float]]

    @property
    def is_significant(self) -> bool:
        """Whether the model is not consistent with the data."""
        return self.scatters_more or self.is_smooth or bool(self.rising)


def misfit_of(result: Fit, measurement_share: float) -> Misfit:
    """Return the misfit of a fit.

    Args:
        result: of the fit.
        measurement_share: share of the errors of the measurement in the variances of T, see
            `jaxgran.fitting.goodness.measurement_share`.
    """
    scatters_less = result.smooth_p_value < SIGNIFICANCE
    return Misfit(
        scatters_more=result.p_value < SIGNIFICANCE,
        scatters_less=scatters_less,
        is_smooth=scatters_less and measurement_share < MAX_MEASUREMENT_SHARE,
        rising=_rising(result),
    )


def _rising(result: Fit) -> list[tuple[float, float]]:
    """Return `Misfit.rising`; scatter would be found to explain such curves."""
    found = []
    curves = by_label(result.curve)
    for label, m in result.measurements.items():
        if isinstance(m.data, DropTest) or m.gas.drive is not None:
            continue
        computed = curves[label].temperature
        if computed[-1] >= computed[0]:  # as where rotation heats it
            continue
        T = np.asarray(m.data.temperature)
        trend = scipy.stats.kendalltau(np.arange(T.size), T, alternative="greater")
        if m.data.temperature_error is None and trend.pvalue < RISING_SIGNIFICANCE:
            found.append((float(T[0]), float(T[-1])))
    return found


def limitations_of(model: AbstractModel, result: Fit) -> list[Limitation]:
    """Return the limitations of a model in the fitted gases, the decisive ones first."""
    gases = by_label(result.gas)
    by_words: dict[str, Limitation] = {}
    for label, m in result.measurements.items():
        if isinstance(m.data, DropTest):
            continue
        for limitation in model.limitations(gases[label], m.num_particles):
            by_words.setdefault(limitation.words, limitation)
    return sorted(by_words.values(), key=lambda limitation: not limitation.decisive)


def verdict(
    result: Fit,
    misfit: Misfit,
    limitations: list[Limitation],
    not_computed: tuple[str, ...] = (),
) -> tuple[str, str]:
    """Return the grade of a fit, and the sentence that says it.

    Args:
        result: the numbers of the fit.
        misfit: see `misfit_of`.
        limitations: see `limitations_of`.
        not_computed: names of alternatives that could not be computed, so that nothing excludes
            them.
    """
    if not result.converged:
        return NOT_CONSISTENT, "The search did not converge: do not trust its estimates."
    name = result.model_name
    model = name[:1].upper() + name[1:]
    model_is = f"{model} {'are' if name.endswith('s') else 'is'}"
    data, _ = data_and_verb(result)
    symbol = symbol_of(result.names[0])
    remedy = limitations[0].remedy if limitations else ""
    edge = "The model is not tested for all of this scene: see the reasons." if limitations else ""
    preferred = [alternative for alternative in result.alternatives if alternative.preferred]
    if misfit.is_significant or preferred:
        words = f"{model_is} not consistent with {data}: do not trust the estimates."
        best = _preferred(result, preferred[0]) if preferred else ""
        return NOT_CONSISTENT, _joined(words, best, remedy)
    if any(limitation.decisive for limitation in limitations):
        words = f"{model} cannot be trusted in this scene, although the fit to {data} is good."
        return NOT_CONSISTENT, _joined(words, remedy)
    doubt = _doubt(result, not_computed)
    if doubt is not None:
        words = f"{model_is} consistent with {data}, but {symbol} is not determined: {doubt}."
        return NOT_DETERMINED, _joined(words, edge)
    if not result.ranges:
        words = (
            f"{model_is} consistent with {data}. Alternatives were not compared: the range of "
            f"{symbol} that they allow is not known."
        )
        return NOT_DETERMINED, _joined(words, edge)
    span = describe_range(result, *first_range(result))
    words = f"{model_is} consistent with {data}, {_who_determines(result)} {symbol}: {span}."
    return DETERMINED, _joined(words, edge)


def _joined(*sentences: str) -> str:
    """Return sentences, some of which may be empty, with blanks between them."""
    return " ".join(filter(None, sentences))


def data_and_verb(result: Fit) -> tuple[str, str]:
    """Return what was fitted, with the form of "do" that agrees with it."""
    are_drops = [isinstance(m.data, DropTest) for m in result.measurements.values()]
    if are_drops == [False]:
        return "this curve", "does"
    return "these impacts" if all(are_drops) else "these measurements", "do"


def _preferred(result: Fit, best: Alternative) -> str:
    """Return the alternative that the data prefer."""
    if best.restitution is not None:
        return f"The data prefer a model with {best.name}."
    name = result.names[0]
    value = f"{symbol_of(name)} = {best.estimate[0]:.3g}{unit_after_number(name)}"
    return f"The data prefer a model with {best.name}, in which {value}."


def _doubt(result: Fit, not_computed: tuple[str, ...]) -> str | None:
    """Return why the first parameter is not determined; None if nothing is known against it."""
    if len(result.other_minima):
        data, _ = data_and_verb(result)
        return f"other values of the parameters fit {data} nearly as well"
    if result.names[0] in result.undetermined:
        return why_undetermined(result.undetermined)
    if not result.ranges:
        return None
    low, high = first_range(result)
    span = describe_range(result, low, high)
    # One without A narrows nothing: the first line says that A would have no meaning.
    possible = [x for x in result.alternatives if x.restitution is None and not x.distinguishable]
    if possible:
        simplest = min(possible, key=lambda alternative: alternative.num_parts)
        return f"{simplest.name} cannot be excluded; over all explanations {span}"
    if not_computed:
        return (
            f"{not_computed[0]} could not be computed, and may widen the range; without it {span}"
        )
    return span if low >= 0 and high > MAX_RATIO * low else None


def why_undetermined(group: tuple[str, ...]) -> str:
    """Return why data do not determine parameters."""
    how = "depend only on a combination of" if len(group) > 1 else "hardly depend on"
    words = f"the computed values {how} {symbols_of(group)}"
    if any(name.rpartition(": ")[2] == START_TIME for name in group):
        return f"{words} (a cooling gas forgets its initial temperature)"
    if {"dissipative_constant", "youngs_modulus"} <= {*group}:
        return f"{words} (in a gas of hard spheres A and Y enter only as A Y^(2/5))"
    return words


def symbols_of(group: tuple[str, ...]) -> str:
    """Return the symbols of some parameters as a list."""
    *first, last = map(symbol_of, group)
    return f"{', '.join(first)} and {last}" if first else last


def _who_determines(result: Fit) -> str:
    """Return which measurements determine the first parameter, by their weights."""
    drops = [x for x, m in result.measurements.items() if isinstance(m.data, DropTest)]
    num_curves = len(result.measurements) - len(drops)
    if num_curves == 0:
        return "which determine"
    if len(result.measurements) == 1:
        return "which determines"
    share = sum(float(result.weights[label][0]) for label in drops)
    if share > DECISIVE_WEIGHT:
        return "and the impacts determine"
    if drops and share < 1 - DECISIVE_WEIGHT:
        return "and the curves determine" if num_curves > 1 else "and the curve determines"
    return "which together determine"
