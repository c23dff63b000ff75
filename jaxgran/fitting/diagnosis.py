"""Whether a model explains a measured curve, in words.

The likelihood of a measured curve, for samplers.

Clauses of a diagnosis about chi^2, residuals and the search.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.validation import POSITIVE, no_type_check
from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.alternatives import (
    FURTHER,
    PREFERRED_CHI2,
    Alternative,
    compare_alternatives,
    free_element_parameters,
    ranges_over_alternatives,
)
from jaxgran.fitting.error_budget import describe_slope_bias
from jaxgran.fitting.residuals import (
    Comparison,
    check_curve,
    check_deterministic,
    neighbour_correlation,
    runs_test,
    smooth_errors,
)
from jaxgran.fitting.result import SIGNIFICANCE, Fit, describe_minima
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.models.checks import describe_walls
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas


@no_type_check
def log_likelihood(
    gas: Gas,
    curve: CoolingCurve,
    *,
    model: AbstractModel | None = None,
    clock: ArrayLike = 1.0,
    num_particles: int | None = None,
    replicas: int = 1,
) -> Float[Array, ""]:
    """Logarithm of the likelihood of a measured curve, but for a constant.

    ``-chi^2/2`` of the residuals that `jaxgran.fit` minimises, with a common factor of all <dr^2>
    integrated out. Where T has no errors, ``-(n/2) ln sum (ln T_measured - ln T_model)^2``: their
    common relative size is integrated out with the prior 1/size.

    A pure function, for `jax.jit`, `jax.vmap` and `jax.grad`; `experiments/fit/sample_posterior.py`
    samples it. Priors are the caller's to add.

    Args:
        gas: the scene, of one or of traced numbers.
        curve: the measurement.
        model: a deterministic model, by default `jaxgran.KineticTheory()`.
        clock: factor by which the times of the model are multiplied, > 0, or one for each time.
            With the prior 1 +- ``fit(...).clock_error`` it stands for the error of the model, which
            is no part of the likelihood.
        num_particles, replicas: of the measurement, as in `jaxgran.fit`.

    Returns:
        The logarithm; -inf where the model cannot compute the curve.

    Raises:
        ValueError: for a curve that cannot be one, a scene that the model cannot take, or a
            stochastic model, of which each call has other noise.

    >>> other = gas.replace(dissipative_constant=4e-6)
    >>> bool(jaxgran.log_likelihood(gas, curve) > jaxgran.log_likelihood(other, curve))
    True
    """
    model = KineticTheory() if model is None else model
    _check(gas, curve, model, clock)
    curve, _ = smooth_errors(curve, replicas)
    N = None if num_particles is None else jnp.asarray(float(num_particles))
    comparison = Comparison.of(gas, curve, model, (), N, float(replicas))
    flat = jnp.zeros(comparison.num_nuisance, gas.temperature.dtype)
    times_factor = jnp.broadcast_to(jnp.asarray(clock), curve.times.shape)
    residuals = comparison.evaluate(flat, times_factor)[0]
    known = jnp.sum(residuals**2)
    if flat.size:
        # Linear in the factors of T_rot and <dr^2>, whose best values are subtracted.
        slope = jax.jacfwd(lambda x: comparison.evaluate(x, times_factor)[0])(flat)
        against = slope.T @ residuals
        known = known - against @ jnp.linalg.solve(slope.T @ slope, against)
    if curve.temperature_error is None:
        value = -0.5 * curve.times.size * jnp.log(known)
    else:
        value = -0.5 * known
    return jnp.where(jnp.isnan(value), -jnp.inf, value)


@no_type_check
def _check(gas: Gas, curve: CoolingCurve, model: AbstractModel, clock: ArrayLike) -> None:
    check_curve(gas, curve)
    POSITIVE.check("clock", clock, "1 leaves the model's times as they are.")
    check_deterministic(model, "a likelihood")
    model.check_scene(gas)


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
    if others := describe_minima(result.names, result.degenerate_solutions()):
        yield others


MAX_SCATTER = 0.3
"""Relative scatter of T about a model above which it does not explain a curve without errors."""

NEGLIGIBLE = 0.01
"""Share of an estimate below which the low end of a range is next to nothing."""

STEADY = 3.0
"""Correlation of neighbouring residuals, in standard errors of it for independent ones, from which
on a curve without errors is not explained."""

MIN_RUNS_P_VALUE = 0.00135
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
    alternatives: tuple[Alternative, ...]
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
    limitations = result.model.limitations(result.gas, num_particles)
    found = compare_alternatives(result, curve) if converged and np.isfinite(result.chi2) else ()
    limits = ranges_over_alternatives(result, found) if found else {}
    reasons = [
        about_chance(result),
        *_about_alternatives(result, found, num_particles),
        *about_residuals(residuals, times, correlation, p_value),
        *about_runs(runs),
        *(omission.words for omission in limitations),
        *about_search(result),
        *describe_slope_bias(result),
    ]
    verdict = _verdict(result, misfit, limitations, found, limits)
    in_runs = runs[2] < SIGNIFICANCE and converged and not misfit
    verdict += " Its residuals come in runs of one sign." if in_runs else ""
    explains = converged and not misfit and not any(o.decisive for o in limitations)
    explains &= not any(rival.preferred for rival in found) and not len(
        result.degenerate_solutions()
    )
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
    steady = correlation > STEADY / np.sqrt(residuals.size) or runs_p_value < MIN_RUNS_P_VALUE
    return scatter > MAX_SCATTER or bool(steady and scatter > 2 * expected)


def _about_alternatives(
    result: Fit, found: tuple[Alternative, ...], num_particles: int | None
) -> Iterator[str]:
    """The rivals that the curve asks for or allows, and what the first parameter would then be."""
    yield _assumptions(result)
    if num_particles is not None and result.gas.container is None:
        yield f"the box of {num_particles} spheres {describe_walls(result.gas, num_particles)}"
    free = free_element_parameters(result)
    if free:
        yield (
            f"further losses are not looked for beside {', '.join(free)}, which would take them "
            "over"
        )
    elif result.gas.drive is not None:
        yield "further losses are not looked for in a driven gas"
    name = result.names[0]
    for rival in found:
        between = (
            f"{name} is then {_describe_range(rival.low[0], rival.high[0], result.estimate[0])}"
        )
        if rival.preferred:
            yield (
                f"{rival.name} added to the model fits better (chi^2 by {rival.improvement:.3g}, "
                f"1 % by chance would be {PREFERRED_CHI2:.3g}): {between}"
            )
        elif not rival.distinguishable:
            yield (
                f"{rival.name} cannot be excluded: {between}; errors of the curve and of the model "
                f"{rival.error_reduction_needed:.2g} times as small would tell{_describe_longer_decay(rival)}"
            )


def _describe_range(low: float, high: float, estimate: Any) -> str:
    """A range in words: an upper bound where it goes down to next to nothing."""
    if 0 <= low < NEGLIGIBLE * float(np.asarray(estimate)):
        return f"anything below {high:.3g}, an upper bound"
    return f"between {low:.3g} and {high:.3g}"


def _describe_longer_decay(rival: Alternative) -> str:
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
    limitations: tuple[Limitation, ...],
    found: tuple[Alternative, ...],
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
    if len(result.degenerate_solutions()) and not misfit:
        return "Other parameters fit this curve as well: do not trust these estimates."
    plural = name.endswith("s")
    name = name[:1].upper() + name[1:]
    decisive = any(omission.decisive for omission in limitations)
    preferred = [rival for rival in found if rival.preferred]
    if misfit or preferred:
        do, its = ("do", "their") if plural else ("does", "its")
        verdict = f"{name} {do} not explain this curve: do not trust {its} estimates."
        if preferred:
            verdict += f" The curve asks for {preferred[0].name}."
    elif decisive:
        verdict = f"{name} cannot be trusted in this scene, though the curve fits."
    elif limitations:
        s = "" if plural else "s"
        return f"{name} fit{s} this curve, but the scene is at the edge of the model's validity."
    else:
        verdict = f"{name} {'are' if plural else 'is'} compatible with this curve."
        open_to = [rival.name for rival in found if not rival.distinguishable]
        if open_to:
            low, high = (x[0] for x in limits[result.names[0]])
            between = _describe_range(low, high, result.estimate[0])
            verdict = f"{verdict[:-1]}, which does not exclude {open_to[0]}: "
            verdict += f"{result.names[0]} is {between}."
        return verdict
    return " ".join([verdict, *(omission.remedy for omission in limitations[:1])])
