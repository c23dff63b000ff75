"""What a fit concludes: the range in one line, a grade with a verdict, and the reasons for it.

The rules here choose messages and their values; `jaxgran.fitting.messages` has the words.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy  # which imports scipy.stats at its first use

from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.alternatives import DISTINGUISHABLE_SHARE, Alternative, Explanations
from jaxgran.fitting.goodness import SIGNIFICANCE
from jaxgran.fitting.kinds import DECLARABLE
from jaxgran.fitting.measured_rows import UNKNOWN_NUMBER
from jaxgran.fitting.messages import DATA, SPHERES, Message, listed
from jaxgran.fitting.result import (
    CONDITIONAL,
    DETERMINED,
    NOT_CONSISTENT,
    NOT_DETERMINED,
    Fit,
    by_label,
)
from jaxgran.fitting.setup import Request
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.models.limitations import describe_walls
from jaxgran.scene.parameters import symbol_of, unit_of

RISING_SIGNIFICANCE = 0.05
"""Level at which T is found to rise: of four rising values the probability by chance is 0.04."""

NARROWING_LOSS = 5.0
"""Increase of -2 ln L beyond which explanations without some effects do not explain the data."""

NEGLIGIBLE_SHARE = 0.01
"""Share of an estimate below which the low end of a range counts as 0."""

MAX_RATIO = 3.0
"""Ratio of the ends of a range above which a positive parameter counts as not determined."""

UNBOUNDED = 1e3
"""Ratio of the high end of a range to the estimate, above which the range counts as open."""

DECISIVE_WEIGHT = 0.8
"""Weight in a parameter above which impacts, or curves, are said to determine it."""

MAX_MEASUREMENT_SHARE = 0.5
"""Share of the errors of the measurement in the variances of T from which too little scatter is
blamed on these errors, and not on the grains."""

MAX_ERROR_OF_N = 1.0
"""Standard error of ln N from which N by the scatter of a curve is not reported."""

NEARLY_CERTAIN = 0.99
"""Probability by chance from which it is not reported in digits."""

MIN_REDUCTION = 1.1
"""Smallest factor by which errors are said to have to shrink: less would be rounded to 1."""

MIN_PARTICLES = 50
"""Least number of particles of a model whose noise is known."""

GRADES = {
    "not converged": NOT_CONSISTENT,
    "not consistent": NOT_CONSISTENT,
    "not trusted": NOT_CONSISTENT,
    "not determined": NOT_DETERMINED,
    "not compared": NOT_DETERMINED,
    "determined": DETERMINED,
}
"""Grade of a fit by the name of its verdict."""


class _Misfit(NamedTuple):
    """How the data differ from what the model, N grains and the errors allow.

    Attributes:
        scatters_more: whether they scatter more about the model.
        scatters_less: whether the curve scatters less.
        is_smooth: whether that is a misfit of the grains, and not of errors that are too large.
        rising: messages on curves that rise.
    """

    scatters_more: bool
    scatters_less: bool
    is_smooth: bool
    rising: list[Message]

    @property
    def is_significant(self) -> bool:
        """Whether the model is not consistent with the data."""
        return self.scatters_more or self.is_smooth or bool(self.rising)


def with_conclusions(
    request: Request,
    result: Fit,
    explanations: Explanations | None,
    notes: Sequence[str | Message],
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
    limitations = _limitations(request.model, result)
    misfit = _misfit(result, measurement_share)
    verdict = _verdict(result, misfit, limitations)
    reasons = [
        _chi2(result),
        *misfit.rising,
        *_reasons_of_misfit(result, misfit),
        *_scatter(result),
        *_errors_of_T(result),
        *_parts_of_measurements(result),
        _assumptions(request.model, result),
        *_absent_effects(result),
        *_limits_of_comparison(request, result),
        *_not_computed(explanations),
        *_alternatives(result),
        *notes,
        *_surroundings(result),
        *(limitation.words for limitation in limitations),
        *_convergence(result),
        *describe_search(result),
    ]
    narrowing = None if explanations is None else _narrowing(result, explanations)
    return replace(
        result,
        grade=GRADES[verdict.name],
        headline=str(_headline(result)),
        narrowing="" if narrowing is None else str(narrowing),
        verdict=str(verdict),
        reasons=tuple(map(str, reasons)),
    )


# --- the first line


def _headline(result: Fit) -> Message:
    """Return the first parameter with its range, and whether it has a meaning."""
    headline = _first_parameter(result)
    preferred = [x for x in result.alternatives if x.preferred and x.restitution is None]
    best = max((x.improvement for x in preferred), default=0.0)
    for alternative in result.alternatives:
        if alternative.restitution is not None and alternative.improvement >= best:
            how_well = Message("better" if alternative.preferred else "as well")
            eps = alternative.restitution
            return Message("constant", headline=headline, eps=eps, how_well=how_well)
    return headline


def _first_parameter(result: Fit) -> Message:
    """Return the first parameter with its range; without it if that lies outside of the range."""
    name = result.names[0]
    estimate, error = (float(np.ravel(x)[0]) for x in result.value(name))
    values = _symbol_and_unit(result)
    values |= {"estimate": estimate, "error": error, "conditional": CONDITIONAL}
    if name not in result.ranges:
        return Message("estimate alone", **values)
    low, high = _ends(result)
    if not low <= estimate <= high or _is_wide(low, high, estimate):
        return Message("range alone", range=_range(result, low, high))
    return Message("estimate and range", low=low, high=high, **values)


def _symbol_and_unit(result: Fit) -> dict[str, Any]:
    name = result.names[0]
    return {"symbol": symbol_of(name), "unit": unit_of(name)}


def _ends(result: Fit) -> tuple[float, float]:
    """Return the low and the high end of the range of the first parameter."""
    low, high = result.ranges[result.names[0]]
    return float(low[0]), float(high[0])


def _is_wide(low: float, high: float, estimate: float) -> bool:
    """Tell whether the range of a positive parameter is too wide for an estimate to be given."""
    return low >= 0 and (low < NEGLIGIBLE_SHARE * abs(estimate) or high > MAX_RATIO * low)


def _range(result: Fit, low: float, high: float) -> Message:
    """Return in which range the first parameter lies."""
    estimate = abs(float(result.estimate[0]))
    values = _symbol_and_unit(result)
    values |= {"low": low, "high": high}
    is_open = not high < UNBOUNDED * max(estimate, low)
    if 0 <= low < NEGLIGIBLE_SHARE * estimate:
        return Message("unknown" if is_open else "below", **values)
    return Message("above" if is_open else "between", **values)


def _narrowing(result: Fit, explanations: Explanations) -> Message | None:
    """Return which effects, known to be absent, would narrow the range; None if none would."""
    wide = [x for x in explanations.alternatives if x.effect and not x.distinguishable]
    effects = sorted({x.effect for x in wide})
    every = [explanations.law, *explanations.alternatives]
    best = max(x.improvement for x in every)
    best_of_others = max(x.improvement for x in every if not {*effects} & {*x.effects})
    if not wide or best_of_others < best - NARROWING_LOSS:
        return None
    low, high = (float(end[0]) for end in explanations.ranges(absent=effects))
    lowest, highest = (float(end[0]) for end in explanations.ranges())
    gain = max(low - lowest, highest - high)
    if not gain > DISTINGUISHABLE_SHARE * abs(result.estimate[0]):
        return None
    return Message(
        "narrowing",
        effects=listed("neither", effects),
        range=_range(result, low, high),
        names=listed("names", effects),
        given=listed("names", (DECLARABLE[effect].keys for effect in effects)),
    )


# --- the verdict


def _misfit(result: Fit, measurement_share: float) -> _Misfit:
    scatters_less = result.smooth_p_value < SIGNIFICANCE
    return _Misfit(
        scatters_more=result.p_value < SIGNIFICANCE,
        scatters_less=scatters_less,
        is_smooth=scatters_less and measurement_share < MAX_MEASUREMENT_SHARE,
        rising=list(_rising(result)),
    )


def _rising(result: Fit) -> Iterator[Message]:
    """Yield curves without errors that rise; scatter would be found to explain them."""
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
            yield Message("rising", first=T[0], last=T[-1])


def _limitations(model: AbstractModel, result: Fit) -> list[Limitation]:
    """Return the limitations of a model in the fitted gases, the decisive ones first."""
    gases = by_label(result.gas)
    by_words: dict[str, Limitation] = {}
    for label, m in result.measurements.items():
        if isinstance(m.data, DropTest):
            continue
        for limitation in model.limitations(gases[label], m.num_particles):
            by_words.setdefault(limitation.words, limitation)
    return sorted(by_words.values(), key=lambda limitation: not limitation.decisive)


def _verdict(result: Fit, misfit: _Misfit, limitations: list[Limitation]) -> Message:
    """Return the verdict; `GRADES` has its grade."""
    values = _subject(result) | _data(result)
    preferred = [alternative for alternative in result.alternatives if alternative.preferred]
    remedy = limitations[0].remedy if limitations else ""
    edge = Message("edge") if limitations else ""
    if not result.converged:
        return Message("not converged")
    if misfit.is_significant or preferred:
        best = _preferred(result, preferred[0]) if preferred else ""
        return Message("not consistent", preferred=best, remedy=remedy, **values)
    if any(limitation.decisive for limitation in limitations):
        return Message("not trusted", remedy=remedy, **values)
    doubt = _doubt(result)
    if doubt is not None:
        return Message("not determined", why=doubt, edge=edge, **values)
    if not result.ranges:
        return Message("not compared", edge=edge, **values)
    return Message(
        "determined",
        who_determines=_who_determines(result),
        range=_range(result, *_ends(result)),
        edge=edge,
        **values,
    )


def _subject(result: Fit) -> dict[str, Any]:
    """Return the model, as a sentence begins with it, and the symbol of the first parameter."""
    name = result.model_name
    model = name[:1].upper() + name[1:]
    model_is = Message("models are" if name.endswith("s") else "model is", Model=model)
    return {"Model": model, "model_is": model_is, "symbol": symbol_of(result.names[0])}


def _data(result: Fit) -> dict[str, str]:
    """Return the words for what was fitted."""
    are_drops = [isinstance(m.data, DropTest) for m in result.measurements.values()]
    if are_drops == [False]:
        return DATA["curve"]
    return DATA["impacts" if all(are_drops) else "measurements"]


def _preferred(result: Fit, best: Alternative) -> Message:
    """Return the alternative that the data prefer."""
    if best.restitution is not None:
        return Message("law preferred", name=best.name)
    value = Message("value", estimate=float(best.estimate[0]), **_symbol_and_unit(result))
    return Message("preferred", name=best.name, value=value)


def _doubt(result: Fit) -> Message | None:
    """Return why the first parameter is not determined; None if nothing is known against it."""
    if len(result.other_minima):
        return Message("other minima", **_data(result))
    if result.names[0] in result.undetermined:
        return _why_undetermined(result.undetermined)
    if not result.ranges:
        return None
    low, high = _ends(result)
    span = _range(result, low, high)
    # One without A narrows nothing: the first line says that A would have no meaning.
    possible = [x for x in result.alternatives if x.restitution is None and not x.distinguishable]
    if possible:
        simplest = min(possible, key=lambda alternative: alternative.num_parts)
        return Message("possible", name=simplest.name, range=span)
    return span if low >= 0 and high > MAX_RATIO * low else None


def _why_undetermined(group: tuple[str, ...]) -> Message:
    """Return why data do not determine parameters."""
    hint = ""
    if any(name.endswith("t0") for name in group):
        hint = Message("forgets")
    elif {"dissipative_constant", "youngs_modulus"} <= {*group}:
        hint = Message("A and Y")
    kind = "combination" if len(group) > 1 else "weak"
    return Message(kind, names=_symbols(group), hint=hint)


def _symbols(group: tuple[str, ...]) -> str:
    return listed("both", map(symbol_of, group))


def _who_determines(result: Fit) -> Message:
    """Return which measurements determine the first parameter, by their weights."""
    drops = [x for x, m in result.measurements.items() if isinstance(m.data, DropTest)]
    num_curves = len(result.measurements) - len(drops)
    if num_curves == 0:
        return Message("drops alone")
    if len(result.measurements) == 1:
        return Message("one curve")
    share = sum(float(result.weights[label][0]) for label in drops)
    if share > DECISIVE_WEIGHT:
        return Message("mainly drops")
    if drops and share < 1 - DECISIVE_WEIGHT:
        return Message("mainly the curves" if num_curves > 1 else "mainly the curve")
    return Message("all together")


# --- the reasons


def _chi2(result: Fit) -> Message:
    has_digits = result.p_value < NEARLY_CERTAIN
    chance = Message("chance" if has_digits else "nearly certain", percent=100 * result.p_value)
    degrees = int(result.degrees_of_freedom)
    return Message("chi2", reduced=result.reduced_chi2, degrees=degrees, chance=chance)


def _reasons_of_misfit(result: Fit, misfit: _Misfit) -> Iterator[Message]:
    """Yield what scatter that is too large or too small may come from."""
    known = [m.num_particles for m in result.measurements.values() if m.num_particles is not None]
    if misfit.scatters_more:
        as_few = ""
        if len(known) == len(result.measurements) == 1:
            as_few = Message("as few", number=_two_digits(known[0] / result.reduced_chi2))
        yield Message("scatters more", as_few=as_few)
    if misfit.scatters_less:
        yield Message("scatters less" if misfit.is_smooth else "errors too large")


def _two_digits(x: float) -> float:
    """Return a number rounded to two digits, which is then written without an exponent."""
    return float(f"{x:.2g}")


def _scatter(result: Fit) -> Iterator[Message]:
    """Yield N by the scatter of each curve for which it is not known."""
    for label, (ratio, error) in result.scatter.items():
        if result.measurements[label].num_particles is None and error < MAX_ERROR_OF_N:
            number = UNKNOWN_NUMBER / ratio
            of_number = _two_digits(number * error)
            yield Message("scatter", of=label, number=_two_digits(number), error=of_number)


def _errors_of_T(result: Fit) -> Iterator[Message]:
    """Yield the errors of T that a fit found in curves without errors."""
    for label, error in result.errors_of_T.items():
        is_given = result.measurements[label].curve.temperature_error is not None
        advice = Message("errors are given" if is_given else "no errors are given")
        yield Message("errors of T", of=label, percent=100 * error, advice=advice)


def _parts_of_measurements(result: Fit) -> Iterator[Message]:
    """Yield the misfit and the weight of each of several measurements."""
    if len(result.measurements) < 2:
        return
    for label, residuals in result.residuals.items():
        values = np.concatenate(list(residuals.values()))
        yield Message(
            "of each",
            label=label,
            chi2=float(np.sum(values**2)),
            number=int(np.sum(values != 0)),
            symbol=symbol_of(result.names[0]),
            weight=result.weights[label][0],
        )


def _assumptions(model: AbstractModel, result: Fit) -> Message:
    """Return what a model assumes of the measured gases."""
    measurements = result.measurements
    spheres = {label: _element_of_spheres(m) for label, m in measurements.items()}
    assumed = []
    for element in dict.fromkeys(spheres.values()):
        labels = [label for label, x in spheres.items() if x == element]
        assumed += _in_curves(result, SPHERES[element], labels)
    without_walls = [label for label, m in measurements.items() if m.gas.container is None]
    assumed += _in_curves(result, Message("far from walls"), without_walls)
    without_drag = [label for label, m in measurements.items() if m.gas.drag is None]
    assumed += _in_curves(result, Message("in vacuum"), without_drag)
    if not model.has_positions:
        assumed.append(Message("homogeneous"))
    return Message("assumptions", all=listed("names", assumed))


def _element_of_spheres(m: Measurement) -> str:
    """Return the first element of `SPHERES` that a gas has; "" for equal, smooth spheres."""
    return next((element for element in SPHERES if element in m.gas.elements), "")


def _absent_effects(result: Fit) -> Iterator[Message]:
    """Yield the effects that are known to be absent, with the curves if not in all of them."""
    measurements = result.measurements
    absent = []
    for effect in dict.fromkeys(x for m in measurements.values() for x in m.absent):
        labels = [label for label, m in measurements.items() if effect in m.absent]
        absent += _in_curves(result, effect, labels)
    if absent:
        yield Message("absent", names=listed("names", absent))


def _in_curves(
    result: Fit, what: str | Message, labels: Collection[str]
) -> Iterator[str | Message]:
    """Yield what holds for all curves, or for those that are then named; nothing for none.

    In a fit of drop tests alone these take the place of curves.

    Args:
        result: of the fit.
        what: the statement.
        labels: of the measurements for which it holds.
    """
    every = result.measurements
    curves = [x for x, m in every.items() if not isinstance(m.data, DropTest)] or [*every]
    among = [label for label in curves if label in labels]
    if among == curves:
        yield what
    elif among:
        yield Message("in some", what=what, labels=listed("names", among))


def _limits_of_comparison(request: Request, result: Fit) -> Iterator[Message]:
    """Yield why alternatives were not compared, or not by the model."""
    if request.quick:
        yield Message("quick")
    if any(m.gas.drive is not None for m in request.measurements.values()):
        yield Message("driven")
    if request.model.stochastic and result.alternatives:
        yield Message("of particles")


def _not_computed(explanations: Explanations | None) -> Iterator[Message]:
    """Yield the alternatives of which no amplitude could be computed."""
    if explanations is not None and explanations.not_computed:
        yield Message("not computed", names=listed("names", explanations.not_computed))


def _alternatives(result: Fit) -> Iterator[Message]:
    """Yield the alternatives that are preferred or possible, with the first parameter there."""
    estimate = float(result.estimate[0])
    for alternative in result.alternatives:
        low = float(alternative.low[0])
        high = float(alternative.high[0])
        is_law = alternative.restitution is not None
        values: dict[str, Any] = {
            "name": alternative.name,
            "eps": alternative.restitution,
            "improvement": alternative.improvement,
            "range": _range(result, low, high),
            "factor": _two_digits(max(alternative.error_reduction_needed, MIN_REDUCTION)),
        }
        if alternative.preferred:
            yield Message("law is preferred" if is_law else "is preferred", **values)
            if not low <= estimate <= high:
                yield Message("outside", estimate=estimate)
        elif not alternative.distinguishable:
            yield Message("law is possible" if is_law else "is possible", **values)


def _surroundings(result: Fit) -> Iterator[Message]:
    """Yield for each curve what its walls, or the box of its grains, may mean."""
    gases = by_label(result.gas)
    for label, m in result.measurements.items():
        if isinstance(m.data, DropTest):
            continue
        gas = gases[label]
        N = m.num_particles
        if gas.container is not None:
            yield Message("gravity")
        elif N is not None and "walls" not in m.absent:
            yield Message("box", of=label, number=N, walls=describe_walls(gas, N))


def _convergence(result: Fit) -> Iterator[Message]:
    """Yield whether the search did not converge, and the noise of simulations."""
    if not result.converged:
        yield Message("max_steps")
    noise = result.error_budget.get("simulation")
    if noise is not None:
        share = 100 * float(np.max(noise / result.standard_error))
        yield Message("simulations", number=result.iterations, share=share)


def describe_search(result: Fit) -> Iterator[Message]:
    """Yield few particles, undetermined parameters and equally good minima.

    `jaxgran.fit` also gives them as warnings.
    """
    number = getattr(result.model, "num_particles", None)
    if number is not None and number < MIN_PARTICLES:
        yield Message("few particles", number=number, least=MIN_PARTICLES)
    if group := result.undetermined:
        why = _why_undetermined(group)
        yield Message("undetermined", names=_symbols(group), why=why, **_data(result))
    if len(result.other_minima):
        symbols = [symbol_of(name) for name in result.names]
        places = []
        for minimum in result.other_minima:
            pairs = zip(symbols, minimum, strict=False)
            values = [Message("value", symbol=symbol, estimate=x, unit="") for symbol, x in pairs]
            places.append(listed("names", values))
        yield Message("another minimum", places=listed("places", places), **_data(result))
