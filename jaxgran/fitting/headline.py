"""The first line of a fit: the first parameter with its range, and what would narrow this range."""

import numpy as np

from jaxgran.fitting.alternatives import DISTINGUISHABLE_SHARE, Explanations
from jaxgran.fitting.kinds import DECLARABLE
from jaxgran.fitting.parameters import magnitude_of
from jaxgran.fitting.result import CONDITIONAL, Fit
from jaxgran.scene.parameters import symbol_of, unit_of

NARROWING_LOSS = 5.0
"""Increase of -2 ln L beyond which explanations without some effects do not explain the data."""

NEGLIGIBLE_SHARE = 0.01
"""Share of an estimate below which the low end of a range counts as 0."""

MAX_RATIO = 3.0
"""Ratio of the ends of a range above which a positive parameter counts as not determined."""

UNBOUNDED = 1e3
"""Ratio of the high end of a range to the estimate, above which the range counts as open."""


def headline(result: Fit) -> str:
    """Return the first parameter with its range, and whether it has a meaning."""
    line = _first_parameter(result)
    preferred = [x for x in result.alternatives if x.preferred and x.restitution is None]
    best = max((x.improvement for x in preferred), default=0.0)
    for alternative in result.alternatives:
        eps = alternative.restitution
        if eps is not None and alternative.improvement >= best:
            how_well = "better" if alternative.preferred else "equally well"
            return (
                f"{line}. Impacts of constant restitution, eps = {eps:.3g}, explain the data "
                f"{how_well}; A would then have no meaning"
            )
    return line


def _first_parameter(result: Fit) -> str:
    """Return the first parameter with its range; without it if that lies outside of the range."""
    name = result.names[0]
    symbol = symbol_of(name)
    unit = unit_after_number(name)
    estimate, error = (float(np.ravel(x)[0]) for x in result.value(name))
    if name not in result.ranges:
        return f"{symbol} = {estimate:.4g} +- {error:.2g}{unit} {CONDITIONAL}"
    low, high = first_range(result)
    if not low <= estimate <= high or _is_wide(low, high, estimate):
        return f"{describe_range(result, low, high)} (95 %)"
    return f"{symbol} = {estimate:.3g}{unit}, 95 % range {low:.3g} to {high:.3g}{unit}"


def unit_after_number(name: str) -> str:
    """Return the unit of a parameter, with a blank before it; "" if it has none."""
    return f" {unit_of(name)}".rstrip()


def first_range(result: Fit) -> tuple[float, float]:
    """Return the low and the high end of the range of the first parameter."""
    low, high = result.ranges[result.names[0]]
    return float(low[0]), float(high[0])


def _is_wide(low: float, high: float, estimate: float) -> bool:
    """Tell whether the range of a positive parameter is too wide for an estimate to be given."""
    return low >= 0 and (low < NEGLIGIBLE_SHARE * magnitude_of(estimate) or high > MAX_RATIO * low)


def describe_range(result: Fit, low: float, high: float) -> str:
    """Return in which range the first parameter lies."""
    name = result.names[0]
    symbol = symbol_of(name)
    unit = unit_after_number(name)
    estimate = magnitude_of(float(result.estimate[0]))
    is_open = not np.isfinite(high) or (low >= 0 and high >= UNBOUNDED * max(estimate, low))
    if 0 <= low < NEGLIGIBLE_SHARE * estimate:
        if is_open:
            return f"{symbol} has no bounds"
        return f"{symbol} is below {high:.3g}{unit}"
    if is_open:
        return f"{symbol} is above {low:.3g}{unit}"
    return f"{symbol} is between {low:.3g} and {high:.3g}{unit}"


def narrowing(result: Fit, explanations: Explanations | None) -> str:
    """Return which effects, known to be absent, would narrow the range; "" if none would."""
    if explanations is None:
        return ""
    wide = [x for x in explanations.alternatives if x.effect and not x.distinguishable]
    effects = sorted({x.effect for x in wide})
    every = [explanations.law, *explanations.alternatives]
    best = max(x.improvement for x in every)
    best_of_others = max(x.improvement for x in every if not {*effects} & {*x.effects})
    if not wide or best_of_others < best - NARROWING_LOSS:
        return ""
    low, high = (float(end[0]) for end in explanations.ranges(absent=effects))
    lowest, highest = (float(end[0]) for end in explanations.ranges())
    gain = max(low - lowest, highest - high)
    if not gain > DISTINGUISHABLE_SHARE * magnitude_of(float(result.estimate[0])):
        return ""
    keys = ", ".join(DECLARABLE[effect].keys for effect in effects)
    return (
        f"with no {' and no '.join(effects)}, {describe_range(result, low, high)}. If this absence "
        f"is known, declare `absent: {', '.join(effects)}`; if the effect is present, describe it "
        f"by {keys}"
    )
