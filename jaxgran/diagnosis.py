"""Whether a fit is to be believed, in words."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxgran.choice import words
from jaxgran.curve import CoolingCurve
from jaxgran.estimate import SIGNIFICANCE, Fit
from jaxgran.gas import Gas

CONTACT_LIMIT = 0.03
"""Contact duration over mean free time above which impacts stop being instant and binary."""

OVERLAP_LIMIT = 0.01
"""Mean overlap, in diameters, above which the first-order softness correction runs out."""

PACKING_LIMIT = {2: 0.4, 3: 0.25}
"""Packing fraction above which successive collisions are correlated."""


class Diagnosis(NamedTuple):
    """Attributes:
    explains: whether the model explains the curve: no significant misfit, no regime left out.
    verdict: one plain sentence.
    reasons: what it rests on, a sentence each.
    correlation: of neighbouring residuals; 0 for independent errors.
    correlation_factor: by which correlated errors make the standard error larger, >= 1.
    """

    explains: bool
    verdict: str
    reasons: tuple[str, ...]
    correlation: float
    correlation_factor: float


def regime(
    gas: Gas, num_particles: int | None = None, model: str = "KineticTheory"
) -> tuple[list[str], list[str]]:
    """What a model leaves out of this scene, in words: of the contacts, of the space.

    Args:
        gas: the scene.
        num_particles: N, if known: tells the box.
        model: the name of the model. Hard spheres leave out contacts only, soft spheres nothing.
    """
    contacts, space = [], []
    if model == "SoftSpheres":
        return contacts, space
    duration, overlap = float(gas.contact_fraction), float(gas.mean_overlap)
    if duration > CONTACT_LIMIT:
        contacts.append(
            f"contacts last {duration:.2g} of the mean free time, so spheres meet three at a time"
        )
    if overlap > OVERLAP_LIMIT:
        beyond = "which impacts of no duration leave out"
        if model == "KineticTheory":
            beyond = "beyond the first-order softness correction"
        contacts.append(f"spheres overlap by {100 * overlap:.2g} % of a diameter, {beyond}")
    if model == "HardSpheres":
        return contacts, space
    limit = PACKING_LIMIT[gas.dimension]
    if float(gas.packing_fraction) > limit:
        space.append(
            f"the packing fraction {float(gas.packing_fraction):.2g} is above {limit:g}, where "
            "collisions remember each other"
        )
    if num_particles is not None:
        box, critical = float(gas.box_side(num_particles)), float(gas.critical_box)
        if box > critical:
            space.append(
                f"the box, {box / float(gas.diameter):.3g} diameters, is above "
                f"L_c = {critical / float(gas.diameter):.3g}: the gas does not stay homogeneous"
            )
    return contacts, space


def diagnose(result: Fit, curve: CoolingCurve, num_particles: int | None = None) -> Diagnosis:
    """Say whether the model of a fit explains the measured curve, and if not, why.

    Args:
        result: of `jaxgran.fit`, of one curve (not batched).
        curve: the measured curve.
        num_particles: N of the measured gas, if known.
    """
    residuals = np.asarray(result.residuals)
    used = residuals != 0
    residuals, times = residuals[used], np.asarray(curve.times)[used]
    correlation = _neighbour_correlation(residuals)
    factor = np.sqrt((1 + correlation) / (1 - correlation)) if correlation > 0 else 1.0
    reduced, p_value = float(result.reduced_chi2), float(result.p_value)
    contacts, space = regime(result.gas, num_particles, result.model)
    has_errors = not np.isnan(p_value)
    misfit = has_errors and p_value < SIGNIFICANCE

    reasons = []
    if has_errors:
        chance = f"{100 * p_value:.2g}" if p_value < 0.99 else "over 99"
        reasons.append(
            f"reduced chi^2 is {reduced:.3g} for {int(result.degrees_of_freedom)} degrees of "
            f"freedom (chance alone: {chance} %)"
        )
    else:
        scatter = 100 * np.sqrt(reduced)
        reasons.append(
            f"the curve carries no errors; the residuals scatter by {scatter:.2g} % of T, taken "
            "as the error"
        )
    if correlation > 2 / np.sqrt(residuals.size):
        reasons.append(_trend(residuals, correlation, misfit))
    far = np.abs(residuals) > 5
    if has_errors and 0 < far.sum() <= max(2, residuals.size // 20):
        at = ", ".join(f"t = {t:.3g} s" for t in times[far])
        reasons.append(f"far outliers at {at}: look at their error bars")
    reasons += contacts + space
    if not bool(result.converged):
        reasons.append("the search stopped early: more max_steps or fewer free parameters")
    if result.simulation_error is not None:
        share = np.asarray(result.simulation_error / result.standard_error)
        reasons.append(
            f"{int(result.iterations)} simulations were run; their own noise is "
            f"{100 * float(np.max(share)):.0f} % of the error bar at most"
        )
    group = result.undetermined()
    if group:
        reasons.append(f"this curve does not determine {' and '.join(group)}")

    explains = not misfit and not contacts and bool(result.converged)
    name = words(result.model)
    s = "" if name.endswith("spheres") else "s"
    if not bool(result.converged):
        verdict = "The search did not converge: do not trust its estimates."
    elif explains and not space:
        verdict = f"{name} explain{s} this curve."
    elif explains:
        verdict = f"{name} fit{s} this curve, but the scene is at the edge of what it holds for."
    else:
        do, its = ("does", "its") if s else ("do", "their")
        verdict = f"{name} {do} not explain this curve: do not trust {its} estimates."
        if not misfit and contacts:
            verdict = f"{name} cannot be trusted in this scene, though the curve fits."
        if contacts:
            verdict += " This scene needs soft spheres, which resolve every contact in time."
        elif space:
            verdict += " This scene needs particles with positions."
    return Diagnosis(explains, verdict, tuple(reasons), correlation, float(factor))


def _neighbour_correlation(residuals: np.ndarray) -> float:
    if residuals.size < 4 or np.ptp(residuals) == 0:
        return 0.0
    clipped = np.clip(residuals, *(np.median(residuals) + np.array([-3, 3]) * residuals.std()))
    centred = clipped - clipped.mean()
    correlation = float(jnp.dot(centred[1:], centred[:-1]) / jnp.dot(centred, centred))
    return min(max(correlation, -0.95), 0.95)


def _trend(residuals: np.ndarray, correlation: float, misfit: bool) -> str:
    early, middle, late = (float(part.mean()) for part in np.array_split(residuals, 3))
    text = f"neighbouring residuals go together (correlation {correlation:.2f})"
    if not misfit:
        return text + ", as points of the same runs do: the error is widened for it"
    return text + (
        f" and drift: the measured gas is hotter (+) or colder (-) than the model by {early:+.1f}, "
        f"{middle:+.1f}, {late:+.1f} sigma on average early, midway and late"
    )
