"""What a fit says: the range in one line, a verdict, and the reasons for it.

`MESSAGES` holds all sentences; the functions below choose and fill them.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import scipy  # which imports scipy.stats at its first use

from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.alternatives import AND, DISTINGUISHABLE_SHARE, Alternative, Explanations
from jaxgran.fitting.goodness import SIGNIFICANCE
from jaxgran.fitting.kinds import DECLARABLE
from jaxgran.fitting.measured_rows import UNKNOWN_NUMBER
from jaxgran.fitting.result import CONDITIONAL, Fit
from jaxgran.models.base import Limitation
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

MIN_PARTICLES = 50
"""Least number of particles of a model whose noise is known."""

DETERMINED = "determined"
NOT_DETERMINED = "not determined"
NOT_CONSISTENT = "not consistent"
"""Grades of `Fit.grade`."""

MESSAGES = {
    # the first line
    "estimate alone": "{symbol} = {estimate:.4g} +- {error:.2g} {unit} {conditional}",
    "estimate and range": "{symbol} = {estimate:.3g} {unit}, 95 % range {low:.3g} to {high:.3g} "
    "{unit}",
    "range alone": "{range} (95 %)",
    "between": "{symbol} is between {low:.3g} and {high:.3g} {unit}",
    "below": "{symbol} is below {high:.3g} {unit}",
    "above": "{symbol} is above {low:.3g} {unit}",
    "unknown": "{symbol} is not determined",
    "constant": "{headline}. A constant coefficient of restitution, {eps:.3g}, explains the data "
    "{as_well}: then A has no meaning",
    "narrowing": "without {effects}, {range}: if this is known, declare `absent: {names}`, or give "
    "{given}",
    # the verdict
    "not converged": "The search did not converge: do not trust its estimates.",
    "not consistent": "{Model} {be} not consistent with {data}: do not trust the estimates."
    "{preferred} {remedy}",
    "preferred": "The data prefer a model with {name}",
    "preferred value": "The data prefer a model with {name}, in which {symbol} = {estimate:.3g} "
    "{unit}",
    "not trusted": "{Model} cannot be trusted in this scene, though {data} {fit}. {remedy}",
    "determined": "{Model} {be} consistent with {data}, {determine} {symbol}: {range}.{edge}",
    "not determined": "{Model} {be} consistent with {data}, which {do} not determine {symbol}: "
    "{why}.{edge}",
    "edge": " The scene is at the edge of the model's validity.",
    "other minima": "other parameters fit {data} as well",
    "not compared": "{Model} {be} consistent with {data}. Alternatives were not compared: the "
    "range of {symbol} that they allow is not known.{edge}",
    "possible": "{name} cannot be excluded, and {range}",
    # reasons
    "chi2": "reduced chi^2 is {reduced:.3g} for {degrees} degrees of freedom (probability by "
    "chance: {chance} %)",
    "scatters more": "the data scatter more about the model than their errors and N equal spheres "
    "allow: another effect, a mixture of sizes, eps that scatters, fewer grains than given, or "
    "noise of the measurement",
    "as few": " (some {number:g} grains would scatter as much)",
    "scatters less": "the curve scatters less than N equal spheres do: grains that walls cool, "
    "more grains than given, or a curve that was smoothed",
    "rising": "T rises from {first:.3g} to {last:.3g} m^2/s^2, and nothing drives this gas: "
    "check the order of the rows and the noise of the measurement, or give drive_strength",
    "gravity": "gravity is taken as absent: in one simulated box with walls of restitution 0.8, "
    "0.01 g made A 9 % too small",
    "errors too large": "the residuals are smaller than the errors of T allow by chance: these "
    "errors are too large, or they are common to the points",
    "scatter of eps": "eps of the impacts scatters by {scatter:.2g} beyond its errors",
    "scatter": "the curve scatters as {number:g} +- {error:g} grains do",
    "of each": "{label}: chi^2 is {chi2:.3g} for {number} points; its weight in {symbol} is "
    "{weight:.2f}",
    "assumptions": "the model assumes {all}",
    "absent": "known to be absent: {names}",
    "quick": "alternatives were not compared, as requested",
    "driven": "alternatives were not compared: the gas is driven",
    "of particles": "the range over alternatives comes from kinetic theory, shifted to the fitted "
    "curve",
    "is preferred": "{name} added to the model decreases -2 ln L by {improvement:.3g}, which "
    "happens by chance in less than 1 % of fits: with it {range}",
    "law is preferred": "{name}, {eps:.3g}, in place of the fitted law decreases -2 ln L by "
    "{improvement:.3g}, which happens by chance in less than 1 % of fits: A has no meaning then",
    "law is possible": "{name}, {eps:.3g}, in place of the fitted law cannot be excluded: A has no "
    "meaning then; to exclude it, the errors must be {factor:g} times smaller",
    "outside": "the estimate {estimate:.3g} lies outside of this range, because it assumes that "
    "the preferred alternative is absent",
    "is possible": "{name} cannot be excluded: with it {range}; to exclude it, the errors must be "
    "{factor:g} times smaller",
    "outliers": "far outliers at {places}: check them and their error bars",
    "without outliers": "; without them {symbol} is {value:.3g} +- {error:.2g}",
    "errors of T": "T scatters by {percent:.2g} % more than its grains can: taken for independent "
    "errors of T, beside which all else is fitted. {advice}",
    "distant": "nearly every T differs from the fitted one by more than a factor of {ratio:g}: "
    "alternatives were not compared; check the units, the scale of T and T0",
    "max_steps": "the search did not converge: free fewer parameters, or in Python increase "
    "max_steps",
    "simulations": "{number} simulations were run; their noise is at most {share:.0f} % of the "
    "standard error",
    "few particles": "{number} particles are too few for their noise to be known, and cool faster "
    "than a gas: give the model {least} or more",
    "undetermined": "{data} {do} not determine {names}: {why}; free fewer parameters",
    "weak": "it hardly depends on {names}",
    "combination": "it depends only on a combination of {names}",
    "forgets": " (a cooling gas forgets its initial temperature)",
    "A and Y": " (in a gas of hard spheres A and Y enter only as A Y^(2/5))",
    "another minimum": "-2 ln L has another, equally good minimum at {places}: {data} {do} not "
    "distinguish them",
    "slopes": "the derivatives through particles err by an estimated {share:.2g} %, which the "
    "standard error includes: more replicas reduce it, and where the gas has a flow "
    "differences=0.3 in Python",
}
"""Sentences by name, with places for values."""


def say(name: str, /, **values: Any) -> str:
    """Return a sentence with its values, without blanks that empty values leave."""
    return MESSAGES[name].format(**values).replace("  ", " ").strip()


def two_digits(x: float) -> float:
    """Return a number rounded to two digits, which is then written without an exponent."""
    return float(f"{x:.2g}")


def with_words(
    result: Fit,
    explanations: Explanations | None,
    limitations: tuple[Limitation, ...],
    notes: list[str],
    *,
    quick: bool,
    measurement_share: float,
) -> Fit:
    """Return a fit with its first line, verdict and reasons.

    Args:
        result: a fit whose numbers are complete.
        explanations: the fitted law and its alternatives; None if they were not compared.
        limitations: of the model in the scenes.
        notes: further reasons.
        quick: whether the user did not want the alternatives.
        measurement_share: share of the errors of the measurement in the variances of T.
    """
    limitations = tuple(sorted(limitations, key=lambda limitation: not limitation.decisive))
    scatters_more = result.p_value < SIGNIFICANCE
    scatters_less = result.smooth_p_value < SIGNIFICANCE
    rising = list(_rising(result))
    is_smooth = scatters_less and measurement_share < 0.5
    is_misfit = scatters_more or is_smooth or bool(rising)
    grade, verdict = _verdict(result, is_misfit, limitations)
    reasons = [
        _chi2(result),
        *rising,
        *_misfit(result, scatters_more, scatters_less, is_misfit),
        *_scatter(result),
        *_errors_of_T(result),
        *_of_each(result),
        *_alternatives(result, quick=quick),
        *notes,
        *(limitation.words for limitation in limitations),
        *_convergence(result),
        *describe_search(result),
    ]
    return replace(
        result,
        grade=grade,
        headline=_headline(result),
        narrowing="" if explanations is None else _narrowing(result, explanations),
        verdict=verdict,
        reasons=tuple(reasons),
    )


def _rising(result: Fit) -> Iterator[str]:
    """Yield a clause on curves without errors that rise; scatter would be found to explain them."""
    for label, m in result.measurements.items():
        if isinstance(m.data, DropTest) or m.gas.drive is not None:
            continue
        curve = result.curve[label] if isinstance(result.curve, dict) else result.curve
        T = np.asarray(m.data.temperature)
        if curve.temperature[-1] >= curve.temperature[0]:  # as where rotation heats it
            continue
        trend = scipy.stats.kendalltau(np.arange(T.size), T, alternative="greater")
        if m.data.temperature_error is None and trend.pvalue < RISING_SIGNIFICANCE:
            yield say("rising", first=T[0], last=T[-1])


def _unit_of(result: Fit) -> dict[str, str]:
    name = result.names[0]
    return {"symbol": symbol_of(name), "unit": unit_of(name)}


def _range(result: Fit, low: float, high: float) -> str:
    """Say in which range the first parameter lies."""
    estimate = abs(float(result.estimate[0]))
    ends = {"low": low, "high": high} | _unit_of(result)
    is_open = not high < UNBOUNDED * max(estimate, low)
    if 0 <= low < NEGLIGIBLE_SHARE * estimate:
        return say("unknown" if is_open else "below", **ends)
    return say("above" if is_open else "between", **ends)


def _headline(result: Fit) -> str:
    """Return the first parameter with its range, and whether it has a meaning."""
    headline = _first_parameter(result)
    preferred = [x for x in result.alternatives if x.preferred and x.restitution is None]
    best = max((x.improvement for x in preferred), default=0.0)
    for alternative in result.alternatives:
        if alternative.restitution is not None and alternative.improvement >= best:
            as_well = "better" if alternative.preferred else "as well"
            return say("constant", headline=headline, eps=alternative.restitution, as_well=as_well)
    return headline


def _first_parameter(result: Fit) -> str:
    """Return the first parameter with its range; without it if that lies outside of the range."""
    name = result.names[0]
    estimate, error = (float(np.ravel(x)[0]) for x in result.value(name))
    values = {"estimate": estimate, "error": error, "conditional": CONDITIONAL} | _unit_of(result)
    if name not in result.ranges:
        return say("estimate alone", **values)
    low, high = (float(x[0]) for x in result.ranges[name])
    is_wide = low < NEGLIGIBLE_SHARE * abs(estimate) or high > MAX_RATIO * low
    if not low <= estimate <= high or (low >= 0 and is_wide):
        return say("range alone", range=_range(result, low, high))
    return say("estimate and range", low=low, high=high, **values)


def _narrowing(result: Fit, explanations: Explanations) -> str:
    """Return which effects, known to be absent, would narrow the range of the first parameter."""
    wide = [x for x in explanations.alternatives if x.effect and not x.distinguishable]
    effects = sorted({x.effect for x in wide})
    excluded = [x for x in explanations.alternatives if x.effect in effects]
    others = [x for x in (explanations.law, *explanations.alternatives) if x not in excluded]
    best = max(x.improvement for x in (explanations.law, *explanations.alternatives))
    if not wide or max(x.improvement for x in others) < best - NARROWING_LOSS:
        return ""
    low, high = explanations.ranges(without=excluded)
    widest_low, widest_high = explanations.ranges()
    gain = max(low[0] - widest_low[0], widest_high[0] - high[0])
    if not gain > DISTINGUISHABLE_SHARE * abs(result.estimate[0]):
        return ""
    return say(
        "narrowing",
        effects=" and no ".join(effects),
        range=_range(result, float(low[0]), float(high[0])),
        names=", ".join(effects),
        given=", ".join(DECLARABLE[effect][1] for effect in effects),
    )


def _verdict(result: Fit, is_misfit: bool, limitations: tuple[Limitation, ...]) -> tuple[str, str]:
    """Return the grade of a fit, and the verdict in words."""
    name = result.model_name
    words = {
        "Model": name[:1].upper() + name[1:],
        "be": "are" if name.endswith("s") else "is",
        "remedy": " ".join(limitation.remedy for limitation in limitations[:1]),
        "edge": say_edge(limitations),
        "symbol": symbol_of(result.names[0]),
        "determine": _who_determines(result),
    } | _data_of(result)
    preferred = [alternative for alternative in result.alternatives if alternative.preferred]
    if not result.converged:
        return NOT_CONSISTENT, say("not converged")
    if is_misfit or preferred:
        best = _preferred(result, preferred[0]) if preferred else ""
        return NOT_CONSISTENT, say("not consistent", preferred=best, **words)
    if any(limitation.decisive for limitation in limitations):
        return NOT_CONSISTENT, say("not trusted", **words)
    possible = [a.name for a in result.alternatives if not a.distinguishable]
    group = result.undetermined
    if len(result.other_minima):
        why = say("other minima", **words)
    elif result.names[0] in group:
        why = _why_undetermined(group)
    elif not result.ranges:
        return NOT_DETERMINED, say("not compared", **words)
    else:
        low, high = (float(x[0]) for x in result.ranges[result.names[0]])
        span = _range(result, low, high)
        if not possible and not (low >= 0 and high > MAX_RATIO * low):
            return DETERMINED, say("determined", range=span, **words)
        simplest = min(possible, key=lambda name: name.count(AND), default=None)
        why = span if simplest is None else say("possible", name=simplest, range=span)
    return NOT_DETERMINED, say("not determined", why=why, **words)


def _data_of(result: Fit) -> dict[str, str]:
    """Return words for what was fitted, with the verbs that agree with it."""
    are_drops = [isinstance(m.data, DropTest) for m in result.measurements.values()]
    if are_drops == [False]:
        return {"data": "this curve", "do": "does", "fit": "fits"}
    data = "these impacts" if all(are_drops) else "these measurements"
    return {"data": data, "do": "do", "fit": "fit"}


def _who_determines(result: Fit) -> str:
    """Say which measurements determine the first parameter, by their weights."""
    drops = [x for x, m in result.measurements.items() if isinstance(m.data, DropTest)]
    curves = [x for x in result.measurements if x not in drops]
    if not curves:
        return "which determine"
    if len(result.measurements) == 1:
        return "which determines"
    share = sum(float(result.weights[label][0]) for label in drops)
    if share > DECISIVE_WEIGHT:
        return "and the impacts determine"
    if drops and share < 1 - DECISIVE_WEIGHT:
        return "and the curves determine" if len(curves) > 1 else "and the curve determines"
    return "which together determine"


def _preferred(result: Fit, best: Alternative) -> str:
    """Return a sentence on the best alternative, with a blank before it."""
    kind = "preferred" if best.restitution is not None else "preferred value"
    words = say(kind, name=best.name, estimate=float(best.estimate[0]), **_unit_of(result))
    return f" {words}."


def say_edge(limitations: tuple[Limitation, ...]) -> str:
    """Return a sentence on limitations that are not decisive, with a blank before it."""
    return MESSAGES["edge"] if limitations else ""


def _chi2(result: Fit) -> str:
    chance = f"{100 * result.p_value:.2g}" if result.p_value < 0.99 else "over 99"
    degrees = int(result.degrees_of_freedom)
    return say("chi2", reduced=result.reduced_chi2, degrees=degrees, chance=chance)


def _misfit(
    result: Fit, scatters_more: bool, scatters_less: bool, is_misfit: bool
) -> Iterator[str]:
    known = [m.num_particles for m in result.measurements.values() if m.num_particles is not None]
    if scatters_more:
        as_few = ""
        if len(known) == len(result.measurements) == 1:
            as_few = MESSAGES["as few"].format(number=two_digits(known[0] / result.reduced_chi2))
        yield MESSAGES["scatters more"] + as_few
    if scatters_less:
        yield say("scatters less" if is_misfit else "errors too large")


def _scatter(result: Fit) -> Iterator[str]:
    """Yield N by the scatter of each curve for which it is not known."""
    for label, (ratio, error) in result.scatter.items():
        if result.measurements[label].num_particles is None and error < 1.0:
            number = UNKNOWN_NUMBER / ratio
            prefix = f"{label}: " if label else ""
            error = number * error
            yield prefix + say("scatter", number=two_digits(number), error=two_digits(error))


def _errors_of_T(result: Fit) -> Iterator[str]:
    """Yield a clause on the errors of T that a fit found in curves without errors."""
    for label, error in result.errors_of_T.items():
        is_given = result.measurements[label].curve.temperature_error is not None
        advice = "If T_err are errors of the measurement, say so: `errors: measured`"
        advice = advice if is_given else "Give T_err if they are known"
        prefix = f"{label}: " if label else ""
        yield prefix + say("errors of T", percent=100 * error, advice=advice)


def _of_each(result: Fit) -> Iterator[str]:
    """Yield the misfit and the weight of each of several measurements."""
    if len(result.measurements) < 2:
        return
    for label, residuals in result.residuals.items():
        values = np.concatenate(list(residuals.values()))
        yield say(
            "of each",
            label=label,
            chi2=float(np.sum(values**2)),
            number=int(np.sum(values != 0)),
            symbol=symbol_of(result.names[0]),
            weight=result.weights[label][0],
        )


def _alternatives(result: Fit, *, quick: bool) -> Iterator[str]:
    """Yield clauses about preferred or possible alternatives, with the first parameter there."""
    yield _assumptions(result)
    if absent := _absent_effects(result):
        yield say("absent", names=", ".join(absent))
    if quick:
        yield say("quick")
    if any(m.gas.drive is not None for m in result.measurements.values()):
        yield say("driven")
    if result.model is not None and result.model.stochastic and result.alternatives:
        yield say("of particles")
    estimate = float(result.estimate[0])
    for alternative in result.alternatives:
        low = float(alternative.low[0])
        high = float(alternative.high[0])
        kind = "law " if alternative.restitution is not None else ""
        words = {
            "name": alternative.name,
            "eps": alternative.restitution,
            "improvement": alternative.improvement,
            "range": _range(result, low, high),
            "factor": two_digits(alternative.error_reduction_needed),
        }
        if alternative.preferred:
            yield say(f"{kind}is preferred", **words)
            if not low <= estimate <= high:
                yield say("outside", estimate=estimate)
        elif not alternative.distinguishable:
            yield say(f"{kind}is possible", **words)


def _in_curves(result: Fit, words: str, holds: Callable[[Measurement], bool]) -> Iterator[str]:
    """Yield words that hold for all curves, or for those that they then name; nothing for none.

    In a fit of drop tests alone these take the place of curves.
    """
    of_curves = {k: m for k, m in result.measurements.items() if not isinstance(m.data, DropTest)}
    curves = of_curves or result.measurements
    labels = [label for label, m in curves.items() if holds(m)]
    if labels:
        yield words if len(labels) == len(curves) else f"{words} ({', '.join(labels)})"


def _absent_effects(result: Fit) -> list[str]:
    """Return the effects that are known to be absent, with the curves if not in all of them."""
    effects = dict.fromkeys(x for m in result.measurements.values() for x in m.absent)
    return [
        text
        for effect in effects
        for text in _in_curves(result, effect, lambda m, effect=effect: effect in m.absent)
    ]


SPHERES = {
    "diameter_sd": "smooth spheres of one material, whose sizes differ as given",
    "friction": "equal spheres of constant friction",
    "surface": "equal, rough spheres of constant beta_t",
}
"""What a model assumes of spheres with an element, the first one that they have."""


def _assumptions(result: Fit) -> str:
    def spheres(m: Measurement) -> str:
        own = (words for element, words in SPHERES.items() if element in m.gas.elements)
        return next(own, "equal, smooth spheres")

    kinds = dict.fromkeys(map(spheres, result.measurements.values()))
    assumed = [
        text
        for kind in kinds
        for text in _in_curves(result, kind, lambda m, k=kind: spheres(m) == k)
    ]
    assumed += _in_curves(result, "far from walls", lambda m: m.gas.container is None)
    assumed += _in_curves(result, "in vacuum", lambda m: m.gas.drag is None)
    if not getattr(result.model, "has_positions", False):
        assumed.append("at homogeneous density")
    return say("assumptions", all=", ".join(assumed))


def _convergence(result: Fit) -> Iterator[str]:
    """Yield clauses about convergence and the noise of simulations."""
    if not result.converged:
        yield say("max_steps")
    noise = result.error_budget.get("simulation")
    if noise is not None:
        share = 100 * float(np.max(noise / result.standard_error))
        yield say("simulations", number=result.iterations, share=share)


def _names_of(group: tuple[str, ...]) -> str:
    return " and ".join(map(symbol_of, group))


def _why_undetermined(group: tuple[str, ...]) -> str:
    """Say why data do not determine parameters."""
    why = say("combination" if len(group) > 1 else "weak", names=_names_of(group))
    if any(name.endswith("t0") for name in group):
        return why + MESSAGES["forgets"]
    if {"dissipative_constant", "youngs_modulus"} <= {*group}:
        return why + MESSAGES["A and Y"]
    return why


def describe_search(result: Fit) -> Iterator[str]:
    """Yield clauses on few particles, undetermined parameters and equally good minima."""
    number = getattr(result.model, "num_particles", MIN_PARTICLES)
    if number < MIN_PARTICLES:
        yield say("few particles", number=number, least=MIN_PARTICLES)
    if group := result.undetermined:
        why = _why_undetermined(group)
        yield say("undetermined", names=_names_of(group), why=why, **_data_of(result))
    if len(result.other_minima):
        symbols = [symbol_of(name) for name in result.names]
        sets = [zip(symbols, other, strict=False) for other in result.other_minima]
        places = [", ".join(f"{name} = {x:.3g}" for name, x in each) for each in sets]
        yield say("another minimum", places=" and at ".join(places), **_data_of(result))
