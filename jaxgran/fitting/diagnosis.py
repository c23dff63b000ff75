"""Whether a model explains a measured curve, in words."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran.checks.validation import no_type_check
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.amplitudes import ASKED, Rival
from jaxgran.fitting.budget import slope_in_words
from jaxgran.fitting.reasons import about_chance, about_residuals, about_runs, about_search
from jaxgran.fitting.residuals import neighbour_correlation, runs_test
from jaxgran.fitting.result import SIGNIFICANCE, Fit
from jaxgran.fitting.rivals import FURTHER, free_elements, ranges, rivals
from jaxgran.models.base import Omission
from jaxgran.models.checks import walls_in_words

LARGEST_SCATTER = 0.3
"""Relative scatter of T about a model above which it does not explain a curve without errors."""

NOTHING = 0.01
"""Share of an estimate below which the low end of a range is next to nothing."""

STEADY = 3.0
"""Correlation of neighbouring residuals, in standard errors of it for independent ones, from which
on a curve without errors is not explained."""

RAREST_RUNS = 0.00135
"""The same of the runs of one sign: the chance of 3 standard errors."""


class Diagnosis(NamedTuple):
    """What a fit means.

    Attributes:
        explains: whether the search converged, the misfit is not significant, and the model leaves
            out nothing decisive of the scene.
        verdict: one plain sentence, and what to do if the model does not explain the curve.
        reasons: for the verdict, a sentence each.
        correlation: of neighbouring residuals; 0 for independent errors.
        runs_p_value: probability of so few changes of sign between neighbouring residuals, by the
            runs test of Wald & Wolfowitz.
        rivals: other laws of cooling compared with the fitted one, those that fit best first.
        ranges: the range of each free parameter, 95 %, SI, over all rivals that fit as well as the
            best: of a parameter that the rivals leave open this is much wider than its error.

    >>> jaxgran.diagnose(result, curve).verdict[:40]
    'Kinetic theory is compatible with this c'
    """

    explains: bool
    verdict: str
    reasons: tuple[str, ...]
    correlation: float
    runs_p_value: float
    rivals: tuple[Rival, ...]
    ranges: dict[str, tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]]


@no_type_check
def diagnose(result: Fit, curve: CoolingCurve, num_particles: int | None = None) -> Diagnosis:
    """Say whether the model of a fit explains the measured curve, and if not, why.

    Args:
        result: of `jaxgran.fit`, of one curve (not batched).
        curve: the measured curve.
        num_particles: N of the measured gas, if known.

    >>> jaxgran.diagnose(result, curve).explains
    True
    """
    if not isinstance(result, Fit) or not isinstance(curve, CoolingCurve):
        raise ValueError(
            "diagnose takes the result of jaxgran.fit and the curve that was fitted, got "
            f"{type(result).__name__} and {type(curve).__name__}"
        )
    residuals = np.asarray(result.residuals)
    used = residuals != 0
    residuals, times = residuals[used], np.asarray(curve.times)[used]
    correlation = float(neighbour_correlation(jnp.asarray(residuals)))
    p_value, converged = float(result.p_value), bool(result.converged)
    misfit = p_value < SIGNIFICANCE
    runs = runs_test(residuals)
    if result.scatter is not None:
        misfit = _is_misfit(result, residuals, correlation, runs[2], num_particles)
    omissions = result.model.omissions(result.gas, num_particles)
    found = rivals(result, curve) if converged and np.isfinite(result.chi2) else ()
    limits = ranges(result, found) if found else {}
    reasons = [
        about_chance(result),
        *_about_rivals(result, found, num_particles),
        *about_residuals(residuals, times, correlation, p_value),
        *about_runs(runs),
        *(omission.words for omission in omissions),
        *about_search(result),
        *slope_in_words(result),
    ]
    verdict = _verdict(result, misfit, omissions, found, limits)
    in_runs = runs[2] < SIGNIFICANCE and converged and not misfit
    verdict += " Its residuals come in runs of one sign." if in_runs else ""
    explains = converged and not misfit and not any(o.decisive for o in omissions)
    explains &= not any(rival.asked for rival in found) and not len(result.as_good())
    return Diagnosis(explains, verdict, tuple(reasons), correlation, runs[2], found, limits)


def _is_misfit(
    result: Fit,
    residuals: Float[np.ndarray, "used"],
    correlation: float,
    runs_p_value: float,
    num_particles: int | None,
) -> bool:
    """Whether a curve without errors is missed by too much, or too steadily for chance.

    Without errors chi^2 says nothing. Fluctuations of few particles are correlated in time, and of
    a size that N tells.
    """
    scatter = float(np.asarray(result.scatter))
    expected = np.sqrt(2 / (result.gas.dimension * num_particles)) if num_particles else 0.0
    steady = correlation > STEADY / np.sqrt(residuals.size) or runs_p_value < RAREST_RUNS
    return scatter > LARGEST_SCATTER or bool(steady and scatter > 2 * expected)


def _about_rivals(
    result: Fit, found: tuple[Rival, ...], num_particles: int | None
) -> Iterator[str]:
    """The rivals that the curve asks for or allows, and what the first parameter would then be."""
    yield _assumptions(result)
    if num_particles is not None and result.gas.container is None:
        yield f"the box of {num_particles} spheres {walls_in_words(result.gas, num_particles)}"
    free = free_elements(result)
    if free:
        yield (
            f"further losses are not looked for beside {', '.join(free)}, which would take them "
            "over"
        )
    elif result.gas.drive is not None:
        yield "further losses are not looked for in a driven gas"
    name = result.names[0]
    for rival in found:
        between = f"{name} is then {_between(rival.low[0], rival.high[0], result.estimate[0])}"
        if rival.asked:
            yield (
                f"{rival.name} added to the model fits better (chi^2 by {rival.improvement:.3g}, "
                f"1 % by chance would be {ASKED:.3g}): {between}"
            )
        elif not rival.told_apart:
            yield (
                f"{rival.name} cannot be excluded: {between}; errors of the curve and of the model "
                f"{rival.sharper:.2g} times as small would tell{_or_further(rival)}"
            )


def _between(low: float, high: float, estimate: Any) -> str:
    """A range in words: an upper bound where it goes down to next to nothing."""
    if 0 <= low < NOTHING * float(np.asarray(estimate)):
        return f"anything below {high:.3g}, an upper bound"
    return f"between {low:.3g} and {high:.3g}"


def _or_further(rival: Rival) -> str:
    if np.isnan(rival.decades):
        return ""
    if np.isinf(rival.decades):
        return f", but not {FURTHER[-1]:g} more decades of T"
    return f", and so would T followed through a factor of {10**rival.decades:.2g} more"


def _assumptions(result: Fit) -> str:
    elements = result.gas.elements
    spheres = ", rough spheres of constant beta_t" if "surface" in elements else ", smooth spheres"
    spheres = " spheres of constant friction" if "friction" in elements else spheres
    where = [] if "container" in elements else ["far from walls"]
    where += [] if "drag" in elements else ["in vacuum"]
    where.append("at homogeneous density")
    return f"this rests on equal{spheres}, {', '.join(where)}"


def _verdict(
    result: Fit,
    misfit: bool,
    omissions: tuple[Omission, ...],
    found: tuple[Rival, ...],
    limits: dict[str, Any],
) -> str:
    """The verdict on a model.

    Args:
        result: of a fit.
        misfit: whether it is significant.
        omissions: what the model leaves out of the scene, the most serious first.
        found: the rivals, those that fit best first.
        limits: the range of each parameter over them.
    """
    name = result.model.name
    if not bool(result.converged):
        return "The search did not converge: do not trust its estimates."
    if len(result.as_good()) and not misfit:
        return "Other parameters fit this curve as well: do not trust these estimates."
    plural = name.endswith("s")
    name = name[:1].upper() + name[1:]
    decisive = any(omission.decisive for omission in omissions)
    asked = [rival for rival in found if rival.asked]
    if misfit or asked:
        do, its = ("do", "their") if plural else ("does", "its")
        verdict = f"{name} {do} not explain this curve: do not trust {its} estimates."
        if asked:
            verdict += f" The curve asks for {asked[0].name}."
    elif decisive:
        verdict = f"{name} cannot be trusted in this scene, though the curve fits."
    elif omissions:
        s = "" if plural else "s"
        return f"{name} fit{s} this curve, but the scene is at the edge of the model's validity."
    else:
        verdict = f"{name} {'are' if plural else 'is'} compatible with this curve."
        open_to = [rival.name for rival in found if not rival.told_apart]
        if open_to:
            low, high = (x[0] for x in limits[result.names[0]])
            between = _between(low, high, result.estimate[0])
            verdict = f"{verdict[:-1]}, which does not exclude {open_to[0]}: "
            verdict += f"{result.names[0]} is {between}."
        return verdict
    return " ".join([verdict, *(omission.remedy for omission in omissions[:1])])
