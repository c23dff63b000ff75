"""Whether a model explains a measured curve, in words."""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxgran.checks.validation import no_type_check
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.result import SIGNIFICANCE, Fit
from jaxgran.models.base import Omission

LARGEST_SCATTER = 0.3
"""Relative scatter of T about a model above which it does not explain a curve without errors."""


class Diagnosis(NamedTuple):
    """What a fit means.

    Attributes:
        explains: whether the search converged, the misfit is not significant, and the model leaves
            out nothing decisive of the scene.
        verdict: one plain sentence, and what to do if the model does not explain the curve.
        reasons: for the verdict, a sentence each.
        correlation: of neighbouring residuals; 0 for independent errors.
        correlation_factor: by which correlated errors increase the standard error, >= 1.
    """

    explains: bool
    verdict: str
    reasons: tuple[str, ...]
    correlation: float
    correlation_factor: float


@no_type_check
def diagnose(result: Fit, curve: CoolingCurve, num_particles: int | None = None) -> Diagnosis:
    """Say whether the model of a fit explains the measured curve, and if not, why.

    Args:
        result: of `jaxgran.fit`, of one curve (not batched).
        curve: the measured curve.
        num_particles: N of the measured gas, if known.
    """
    if not isinstance(result, Fit) or not isinstance(curve, CoolingCurve):
        raise ValueError(
            "diagnose takes the result of jaxgran.fit and the curve that was fitted, got "
            f"{type(result).__name__} and {type(curve).__name__}"
        )
    residuals = np.asarray(result.residuals)
    used = residuals != 0
    residuals, times = residuals[used], np.asarray(curve.times)[used]
    correlation = _neighbour_correlation(residuals)
    factor = np.sqrt((1 + correlation) / (1 - correlation)) if correlation > 0 else 1.0
    p_value, converged = float(result.p_value), bool(result.converged)
    # Without errors chi^2 says nothing, but no model explains what it misses by this much.
    scattered = np.isnan(p_value) and float(result.reduced_chi2) > LARGEST_SCATTER**2
    misfit = scattered or p_value < SIGNIFICANCE
    omissions = result.model.omissions(result.gas, num_particles)

    reasons = [
        _chance(result),
        *_about_residuals(residuals, times, correlation, p_value),
        *(omission.words for omission in omissions),
        *_about_search(result),
    ]
    verdict = _verdict(result.model.name, converged, misfit, omissions)
    explains = converged and not misfit and not any(o.decisive for o in omissions)
    return Diagnosis(explains, verdict, tuple(reasons), correlation, float(factor))


def _neighbour_correlation(residuals: Float[np.ndarray, "used"]) -> float:
    """Correlation of neighbouring residuals, outliers clipped."""
    if residuals.size < 4 or np.ptp(residuals) == 0:
        return 0.0
    clipped = np.clip(residuals, *(np.median(residuals) + np.array([-3, 3]) * residuals.std()))
    centred = clipped - clipped.mean()
    correlation = float(jnp.dot(centred[1:], centred[:-1]) / jnp.dot(centred, centred))
    return min(max(correlation, -0.95), 0.95)


def _chance(result: Fit) -> str:
    reduced, p_value = float(result.reduced_chi2), float(result.p_value)
    if np.isnan(p_value):
        scatter = 100 * np.sqrt(reduced)
        return (
            f"the curve carries no errors; the residuals scatter by {scatter:.2g} % of T, taken as "
            "the error"
        )
    chance = f"{100 * p_value:.2g}" if p_value < 0.99 else "over 99"
    return (
        f"reduced chi^2 is {reduced:.3g} for {int(result.degrees_of_freedom)} degrees of freedom "
        f"(probability by chance: {chance} %)"
    )


def _about_residuals(
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
    far = np.abs(residuals) > 5
    if not np.isnan(p_value) and 0 < far.sum() <= max(2, residuals.size // 20):
        at = ", ".join(f"t = {t:.3g} s" for t in times[far])
        yield f"far outliers at {at}: check their error bars"


def _about_search(result: Fit) -> Iterator[str]:
    """Convergence, noise of simulations and undetermined parameters."""
    if not bool(result.converged):
        yield "the search stopped early: allow more max_steps or free fewer parameters"
    if result.simulation_error is not None:
        share = np.asarray(result.simulation_error / result.standard_error)
        yield (
            f"{int(result.iterations)} simulations were run; their own noise is "
            f"{100 * float(np.max(share)):.0f} % of the error bar at most"
        )
    group = result.undetermined()
    if group:
        yield f"this curve does not determine {' and '.join(group)}"


def _verdict(name: str, converged: bool, misfit: bool, omissions: tuple[Omission, ...]) -> str:
    """The verdict on a model.

    Args:
        name: of the model.
        converged: whether the search did.
        misfit: whether it is significant.
        omissions: what the model leaves out of the scene, the most serious first.
    """
    if not converged:
        return "The search did not converge: do not trust its estimates."
    plural = name.endswith("s")
    name = name[:1].upper() + name[1:]
    decisive = any(omission.decisive for omission in omissions)
    if misfit:
        do, its = ("do", "their") if plural else ("does", "its")
        verdict = f"{name} {do} not explain this curve: do not trust {its} estimates."
    elif decisive:
        verdict = f"{name} cannot be trusted in this scene, though the curve fits."
    elif omissions:
        s = "" if plural else "s"
        return f"{name} fit{s} this curve, but the scene is at the edge of the model's validity."
    else:
        return f"{name} explain{'' if plural else 's'} this curve."
    return " ".join([verdict, *(omission.remedy for omission in omissions[:1])])
