"""Diagnosis of a fit in words, and the likelihood of a measured curve."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.formatting import text_table
from jaxgran._utils.validation import POSITIVE, check_bool
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.curve_file import ABSENT, DropTest
from jaxgran.fitting.alternatives import (
    DECLARABLE,
    Alternative,
    compare_alternatives,
    estimate_without,
    ranges_over_alternatives,
)
from jaxgran.fitting.error_budget import curve_and_gas, describe_derivative_bias
from jaxgran.fitting.parameters import START_TIME
from jaxgran.fitting.residuals import Measurement, check_curve, neighbour_correlation
from jaxgran.fitting.result import CONDITIONAL, SIGNIFICANCE, Fit
from jaxgran.models.base import AbstractModel, Limitation
from jaxgran.models.checks import checked_model, describe_walls
from jaxgran.models.kinetic_theory import KineticTheory
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import symbol_of, unit_of

MAX_SCATTER = 0.3
"""Relative scatter of T about a model above which it does not explain a curve without errors."""

SYSTEMATIC_CORRELATION = 3.0
"""Correlation of neighbouring residuals, in standard errors for independent ones, above which a
model does not explain a curve without errors."""

MAX_SIGMAS = 5.0
"""Residual of an outlier, over that of most points and over its error."""

MIN_OUTLIER = 0.004
"""Least error of T, relative, that is assumed for the points of a curve without errors."""

MIN_PARTICLES = 50
"""Particles of a model from which on the noise of its curves is known."""

MIN_JUDGED = 10
"""Points needed to tell an outlier from the scatter of the others."""

UNKNOWN_SCATTER = 0.025
"""Relative scatter of T, correlated in time, that some hundred particles have where N is unknown:
without errors and N no misfit smaller than twice of it can be told from chance."""

NEGLIGIBLE_SHARE = 0.01
"""Share of an estimate below which the low end of a range counts as 0."""


DETERMINED, NOT_DETERMINED, NOT_CONSISTENT = "determined", "not determined", "not consistent"
"""Grades of `Diagnosis.grade`."""

MAX_RATIO = 3.0
"""Ratio of the ends of a range from which on a positive parameter is not determined."""


class Diagnosis(NamedTuple):
    """Interpretation of a fit.

    Attributes:
        headline: the first free parameter with its 95 % range over all explanations that the data
            and the scene do not exclude.
        narrowing: which knowledge would narrow this range, and to which one; "" if none would.
        grade: "determined" if the model is consistent with the curve, and no alternative that the
            data allow changes the first parameter by more than 10 % beyond its error; "not
            determined" if the model is consistent alone; "not consistent" if the search did not
            converge, the misfit is significant, the data prefer an alternative, or the model has a
            decisive limitation in the scene.
        verdict: a sentence that says this, and what to do if the model is not consistent.
        reasons: reasons for the verdict, one sentence each.
        correlation: correlation of neighbouring residuals of T, the largest of all measurements; 0
            for independent errors.
        alternatives: other explanations of the curve, those that fit best first.
        ranges: 95 % range of each free parameter, SI, over all explanations that fit as well as the
            best one. It is much wider than the error of a parameter that depends on the
            alternative.

    >>> jaxgran.diagnose(result, curve).headline[:24]
    'A = 3e-06 s, 95 % range '
    """

    headline: str
    narrowing: str
    grade: str
    verdict: str
    reasons: tuple[str, ...]
    correlation: float
    alternatives: tuple[Alternative, ...]
    ranges: dict[str, tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]]

    def __repr__(self) -> str:
        rows = [("", text) for text in (self.narrowing, self.verdict) if text]
        return text_table(self.headline, [*rows, *(("-", reason) for reason in self.reasons)])


def diagnose(
    result: Fit,
    data: CoolingCurve | DropTest | dict | None = None,
    num_particles: int | None = None,
    *,
    absent: tuple[str, ...] = (),
    quick: bool = False,
) -> Diagnosis:
    """Decide whether the model of a fit explains the measurements, and give the reasons.

    Args:
        result: the result of `jaxgran.fit` (not batched).
        data: not needed: the result holds the measurement.
        num_particles: N of the measured gas, by default that given to `jaxgran.fit`.
        absent: further effects that are known to be absent, see `jaxgran.fit`.
        quick: leave the search of alternatives out, which takes most of the time; then there are no
            ranges.

    Raises:
        ValueError: if `result` is not a `Fit`, or for an unknown name in `absent`.

    >>> jaxgran.diagnose(result).grade
    'not determined'
    """
    if not isinstance(result, Fit) or not isinstance(data, CoolingCurve | DropTest | dict | None):
        raise ValueError(
            "diagnose needs the result of jaxgran.fit and the fitted curve, got "
            f"{type(result).__name__} and {type(data).__name__}"
        )
    check_bool(quick=quick)
    absent = tuple(dict.fromkeys((*result.absent, *checked_absent(absent))))
    p_value, converged = float(result.p_value), bool(result.converged)
    misfit, notes, limitations, correlations = p_value < SIGNIFICANCE, [], [], []
    for label, comparison in result.comparisons.items():
        curve, gas = curve_and_gas(result, label)
        if curve is None:
            continue
        N = comparison.num_particles if num_particles is None else num_particles
        residuals = np.asarray(comparison.residuals["temperature"])
        used = residuals != 0
        correlation = float(neighbour_correlation(residuals[used]))
        correlations.append(correlation)
        if comparison.scatter is not None:
            scatter, expected = float(np.asarray(comparison.scatter)), _expected_scatter(gas, N)
            misfit = misfit or _is_misfit(scatter, expected, correlation, residuals[used].size)
        for limitation in result.model.limitations(gas, N):
            if limitation.words not in {known.words for known in limitations}:
                limitations.append(limitation)
        prefix = f"{label}: " if label else ""
        if N is not None and gas.container is None and "walls" not in absent:
            notes.append(f"{prefix}the box of {N} spheres {describe_walls(gas, N)}")
        expected = _expected_scatter(gas, N, comparison.replicas)
        if comparison.errors_of_particles:
            notes.append(
                f"{prefix}the curve gives no errors of T_rot: those of {N} particles are used, "
                f"{100 * expected:.2g} % of T"
            )
        errors = 1 / np.asarray(comparison.weights["temperature"])[used]
        described = _describe_residuals(
            residuals[used], correlation, p_value, float(np.median(errors)), expected
        )
        outliers = [] if quick else _describe_outliers(result, label)
        notes += [prefix + note for note in (*described, *outliers)]
    limitations = tuple(sorted(limitations, key=lambda limitation: not limitation.decisive))
    explanations, alternatives, ranges = None, (), {}
    if converged and np.isfinite(result.chi2) and not quick:
        explanations = compare_alternatives(result, absent)
    if explanations is not None:
        law, alternatives, allowed_chi2 = explanations
        ranges = ranges_over_alternatives(result, (law, *alternatives), allowed_chi2)
    reasons = [
        _describe_chi2(result),
        *_describe_measurements(result),
        *_describe_alternatives(result, alternatives, absent, quick),
        *notes,
        *(limitation.words for limitation in limitations),
        *_describe_convergence(result),
        *describe_search(result),
        *describe_derivative_bias(result),
    ]
    grade, verdict = _verdict(result, misfit, limitations, alternatives, ranges)
    return Diagnosis(
        _headline(result, ranges),
        "" if explanations is None else _narrowing(result, *explanations),
        grade,
        verdict,
        tuple(reasons),
        max(correlations, default=0.0),
        alternatives,
        ranges,
    )


def checked_absent(absent: Any) -> tuple[str, ...]:
    """Return the names of effects that a user declares absent, or raise ValueError."""
    if isinstance(absent, str) or not set(absent) <= set(ABSENT):
        raise ValueError(f"absent must be a tuple of {', '.join(ABSENT)}, got {absent!r}")
    return tuple(absent)


def _headline(result: Fit, ranges: dict[str, Any]) -> str:
    """Return the first parameter with its range; without it if that lies outside of the range."""
    name = result.names[0]
    symbol, unit = symbol_of(name), unit_of(name)
    estimate, error = (float(np.ravel(x)[0]) for x in result.value(name))
    if name not in ranges:
        return f"{symbol} = {estimate:.4g} +- {error:.2g} {unit}".rstrip() + f" {CONDITIONAL}"
    low, high = (float(x[0]) for x in ranges[name])
    is_wide = low < NEGLIGIBLE_SHARE * abs(estimate) or high > MAX_RATIO * low
    if not low <= estimate <= high or (low >= 0 and is_wide):
        return f"{_range_of_first(result, *ranges[name])} (95 %)"
    span = f"{low:.3g} to {high:.3g} {unit}".rstrip()
    return f"{symbol} = {estimate:.3g} {unit}".rstrip() + f", 95 % range {span}"


def _range_of_first(result: Fit, low: np.ndarray, high: np.ndarray) -> str:
    """Say in which range the first parameter lies; vectors begin with the ends of this range."""
    name, estimate = result.names[0], abs(float(np.asarray(result.estimate)[0]))
    ends = f"between {low[0]:.3g} and {high[0]:.3g}"
    if 0 <= low[0] < NEGLIGIBLE_SHARE * estimate:
        ends = f"below {high[0]:.3g}"
    return f"{symbol_of(name)} is {ends} {unit_of(name)}".rstrip()


def _narrowing(
    result: Fit, law: Alternative, alternatives: tuple[Alternative, ...], allowed_chi2: float
) -> str:
    """Return which effects, known to be absent, would narrow the range of the first parameter."""
    wide = [x for x in alternatives if x.effect and not x.distinguishable]
    others = [law, *(x for x in alternatives if x not in wide)]
    best = max(x.improvement for x in (law, *alternatives))
    if not wide or max(x.improvement for x in others) < best - allowed_chi2:
        return ""
    effects = sorted({x.effect for x in wide})
    narrower = ranges_over_alternatives(result, others, allowed_chi2)
    value = _range_of_first(result, *narrower[result.names[0]])
    given = ", ".join(DECLARABLE[effect][1] for effect in effects)
    return (
        f"if there is no {' and no '.join(effects)}, {value}: declare "
        f"`absent: {', '.join(effects)}`, or give {given}"
    )


def _is_misfit(scatter: float, expected: float, correlation: float, number: int) -> bool:
    """Return True if the misfit of a curve without errors is too large or systematic.

    Without errors chi^2 is no measure of the misfit. Fluctuations of few particles are correlated
    in time too, but N gives their size.

    Args:
        scatter: relative scatter of T about the model.
        expected: that of N particles, 0 if N is unknown.
        correlation: of neighbouring residuals.
        number: of residuals.
    """
    is_systematic = correlation > SYSTEMATIC_CORRELATION / number**0.5
    return scatter > MAX_SCATTER or is_systematic and scatter > 2 * (expected or UNKNOWN_SCATTER)


def _expected_scatter(gas: Gas, num_particles: int | None, replicas: int = 1) -> float:
    """Return the relative fluctuation of T of N particles, 0 if N is unknown."""
    total = gas.dimension * (num_particles or 0) * replicas
    return (2 / total) ** 0.5 if total else 0.0


def _describe_measurements(result: Fit) -> Iterator[str]:
    """Yield the misfit and the weight of each of several measurements."""
    if len(result.comparisons) < 2:
        return
    weights = result.weights()
    for label, comparison in result.comparisons.items():
        chi2 = sum(float(np.sum(np.asarray(x) ** 2)) for x in comparison.residuals.values())
        number = sum(int(np.sum(np.asarray(x) != 0)) for x in comparison.residuals.values())
        yield (
            f"{label}: chi^2 is {chi2:.3g} for {number} points; its weight in "
            f"{symbol_of(result.names[0])} is "
            f"{weights[label][0]:.2f}"
        )


def _verdict(
    result: Fit,
    misfit: bool,
    limitations: tuple[Limitation, ...],
    alternatives: tuple[Alternative, ...],
    ranges: dict[str, Any],
) -> tuple[str, str]:
    """Return the grade of a fit, and the verdict in words.

    Args:
        result: the fit.
        misfit: True if the misfit is significant.
        limitations: limitations of the model in the scene, the most serious first.
        alternatives: alternatives to the model, those that fit best first.
        ranges: range of each parameter over the alternatives.
    """
    name, remedy = result.model.name, " ".join(limitation.remedy for limitation in limitations[:1])
    be = "are" if name.endswith("s") else "is"
    name, symbol = name[:1].upper() + name[1:], symbol_of(result.names[0])
    preferred = [alternative for alternative in alternatives if alternative.preferred]
    decisive = any(limitation.decisive for limitation in limitations)
    if not bool(result.converged):
        return NOT_CONSISTENT, "The search did not converge: do not trust its estimates."
    if misfit or preferred:
        verdict = f"{name} {be} not consistent with this curve: do not trust the estimates."
        if preferred:
            verdict += f" The data prefer a model with {preferred[0].name}."
        return NOT_CONSISTENT, f"{verdict} {remedy}".rstrip()
    if decisive:
        verdict = f"{name} cannot be trusted in this scene, though the curve fits."
        return NOT_CONSISTENT, f"{verdict} {remedy}"
    consistent = f"{name} {be} consistent with this curve"
    edge = " The scene is at the edge of the model's validity." if limitations else ""
    possible = [a.name for a in alternatives if not a.distinguishable]
    group = result.undetermined()
    if len(result.degenerate_solutions()):
        why = "other parameters fit this curve as well"
    elif result.names[0] in group:
        why = f"this curve does not determine {' and '.join(map(symbol_of, group))}"
    elif not ranges:
        why = "alternatives were not compared"
    else:
        low, high = ranges[result.names[0]]
        value = _range_of_first(result, low, high)
        if not possible and not (low[0] >= 0 and high[0] > MAX_RATIO * low[0]):
            return DETERMINED, f"{consistent}, which determines {symbol}: {value}.{edge}"
        why = f"{possible[0]} cannot be excluded, and " if possible else ""
        why += value
    return NOT_DETERMINED, f"{consistent}, which does not determine {symbol}: {why}.{edge}"


def _describe_chi2(result: Fit) -> str:
    reduced, p_value = float(result.reduced_chi2), float(result.p_value)
    scatter = next(iter(result.comparisons.values())).scatter
    if scatter is not None:
        scatter = 100 * float(np.asarray(scatter))
        return (
            f"the curve has no errors; the scatter of the residuals, {scatter:.2g} % of T, is used "
            "as the error"
        )
    chance = f"{100 * p_value:.2g}" if p_value < 0.99 else "over 99"
    return (
        f"reduced chi^2 is {reduced:.3g} for {int(result.degrees_of_freedom)} degrees of freedom "
        f"(probability by chance: {chance} %)"
    )


def _describe_alternatives(
    result: Fit, alternatives: tuple[Alternative, ...], absent: tuple[str, ...], quick: bool
) -> Iterator[str]:
    """Yield clauses about preferred or possible alternatives, with the first parameter there."""
    yield _describe_assumptions(result)
    if absent:
        yield f"known to be absent: {', '.join(absent)}"
    if quick:
        yield "alternatives were not compared, as requested"
    if any(curve_and_gas(result, k)[1].drive is not None for k in result.comparisons):
        yield "additional loss terms were not tested: the gas is driven"
    if result.model.stochastic and alternatives:
        yield "the range over alternatives is that of kinetic theory, shifted to the fitted curve"
    estimate = float(np.asarray(result.estimate)[0])
    for alternative in alternatives:
        value = f"then {_range_of_first(result, alternative.low, alternative.high)}"
        if alternative.preferred:
            yield (
                f"{alternative.name} added to the model decreases chi^2 by "
                f"{alternative.improvement:.3g}, which happens by chance in less than 1 % of fits: "
                f"{value}"
            )
            if not alternative.low[0] <= estimate <= alternative.high[0]:
                yield (
                    f"the estimate {estimate:.3g} lies outside of this range, because it is that "
                    "without the preferred alternative"
                )
        elif not alternative.distinguishable:
            yield (
                f"{alternative.name} cannot be excluded: {value}; to exclude it, the errors of the "
                f"curve and of the model must be {alternative.error_reduction_needed:.2g} times "
                "smaller"
            )


def _describe_assumptions(result: Fit) -> str:
    elements = {e for k in result.comparisons for e in curve_and_gas(result, k)[1].elements}
    spheres = ", rough spheres of constant beta_t" if "surface" in elements else ", smooth spheres"
    spheres = " spheres of constant friction" if "friction" in elements else spheres
    where = [] if "container" in elements else ["far from walls"]
    where += [] if "drag" in elements else ["in vacuum"]
    where.append("at homogeneous density")
    return f"the model assumes equal{spheres}, {', '.join(where)}"


def _describe_residuals(
    residuals: Float[np.ndarray, "used"],
    correlation: float,
    p_value: float,
    error: float,
    expected: float,
) -> Iterator[str]:
    """Yield clauses about correlation and the size of the errors.

    Args:
        residuals: weighted residuals that are not 0.
        correlation: correlation of neighbouring residuals.
        p_value: p-value of the fit, nan if the errors are unknown.
        error: median relative error of T.
        expected: that of the fluctuations of N particles, 0 if N is unknown.
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
            yield f"{text}, as for points of the same runs: the error is increased accordingly"
    if p_value > 1 - SIGNIFICANCE:
        share = float(np.sqrt(np.mean(residuals**2)))
        yield (
            f"the residuals are only {share:.2g} of the errors of T, less than expected by chance: "
            "these errors are too large, or they are common to the points"
        )
        if 0 < 2 * expected < error:
            yield (
                f"T_err is {100 * error:.2g} % of T, but N particles fluctuate by only "
                f"{100 * expected:.2g} %: give T_err = {expected:.2g} T, or leave it out, so that "
                "the scatter is used; the ranges are too wide otherwise"
            )


def _describe_outliers(result: Fit, label: str) -> Iterator[str]:
    """Yield a clause on points far from all others, and the first parameter without them."""
    comparison = result.comparisons[label]
    residuals = np.abs(np.asarray(comparison.residuals["temperature"]))
    typical = float(np.median(residuals[residuals > 0])) / 0.6745  # Gaussian: the standard error
    limit = max(1.0, typical)
    if comparison.scatter is not None:  # the unit is the scatter, to which outliers contribute
        limit = max(typical, MIN_OUTLIER / float(np.asarray(comparison.scatter)))
    far, number = np.flatnonzero(residuals > MAX_SIGMAS * limit), int(np.sum(residuals > 0))
    if number < MIN_JUDGED or not 0 < far.size <= max(2, number // 20):
        return
    curve, _ = curve_and_gas(result, label)
    assert curve is not None
    times = np.asarray(curve.times)
    at = ", ".join(f"t = {times[k]:.3g} s (row {k + 1})" for k in far)
    words = f"far outliers at {at}: check them and their error bars"
    if (others := estimate_without(result, label, far)) is not None:
        value, error = (float(x[0]) for x in others)
        words += f"; without them {symbol_of(result.names[0])} is {value:.3g} +- {error:.2g}"
    yield words


def _describe_convergence(result: Fit) -> Iterator[str]:
    """Yield clauses about convergence and the noise of simulations."""
    if not bool(result.converged):
        yield "the search did not converge: increase max_steps or free fewer parameters"
    noise = result.error_budget.get("simulation")
    if noise is not None:
        share = np.asarray(noise / result.standard_error)
        yield (
            f"{int(result.iterations)} simulations were run; their noise is at most "
            f"{100 * float(np.max(share)):.0f} % of the standard error"
        )


def describe_search(result: Fit) -> Iterator[str]:
    """Yield clauses on few particles, undetermined parameters and equally good minima."""
    number = getattr(result.model, "num_particles", MIN_PARTICLES)
    if number < MIN_PARTICLES:
        yield (
            f"{number} particles are too few for their noise to be known, and cool faster than a "
            f"gas: give the model {MIN_PARTICLES} or more"
        )
    if group := result.undetermined():
        names, why = " and ".join(map(symbol_of, group)), "it hardly depends on this parameter"
        if len(group) > 1:
            why = "it depends only on a combination of them"
        if any(name.endswith(START_TIME) for name in group):
            why += " (a cooling gas forgets its initial temperature)"
        elif {"dissipative_constant", "youngs_modulus"} <= {*group}:
            why += " (in a gas of hard spheres A and Y enter only as A Y^(2/5))"
        yield f"this curve does not determine {names}: {why}; free fewer parameters"
    if len(others := result.degenerate_solutions()):
        sets = (zip(map(symbol_of, result.names), other, strict=False) for other in others)
        at = " and at ".join(", ".join(f"{name} = {x:.3g}" for name, x in each) for each in sets)
        yield (
            f"chi^2 has another, equally good minimum at {at}: this curve does not distinguish them"
        )


def log_likelihood(
    gas: Gas,
    curve: CoolingCurve,
    *,
    model: AbstractModel | None = None,
    clock: ArrayLike = 1.0,
    num_particles: int | None = None,
    replicas: int = 1,
) -> Float[Array, ""]:
    """Logarithm of the likelihood of a measured curve, up to a constant.

    ``-chi^2/2`` of the residuals that `jaxgran.fit` minimises, with a common factor of all <dr^2>
    and one of all T_rot integrated out. If T has no errors, it is
    ``-(n/2) ln sum (ln T_measured - ln T_model)^2``: the common relative size of the errors is
    integrated out with the prior 1/size.

    This is a pure function, for `jax.jit`, `jax.vmap` and `jax.grad`, without priors;
    `experiments/fit/sample_posterior.py` adds priors and samples it.

    Args:
        gas: the scene; its values may be traced.
        curve: the measurement.
        model: a deterministic model, by default `jaxgran.KineticTheory()`.
        clock: factor of the times of the model, > 0, or one for each time. With the prior
            1 +- ``fit(...).clock_error`` it represents the error of the model, which the likelihood
            does not include.
        num_particles, replicas: N and number of runs of the measurement, as in `jaxgran.fit`.

    Returns:
        The logarithm; -inf if the model cannot compute the curve.

    Raises:
        ValueError: for an invalid curve, a scene that the model does not support, or a stochastic
            model, whose noise differs between calls.

    >>> other = gas.replace(dissipative_constant=4e-6)
    >>> bool(jaxgran.log_likelihood(gas, curve) > jaxgran.log_likelihood(other, curve))
    True
    """
    model = KineticTheory() if model is None else model
    check_curve(gas, curve)
    POSITIVE.check("clock", clock, "1 leaves the times of the model unchanged.")
    if checked_model(model).stochastic:
        raise ValueError(
            f"a likelihood needs a model without noise, got {type(model).__name__}, which is "
            "stochastic. Use jaxgran.KineticTheory()"
        )
    model.check_scene(gas)
    m = Measurement.of("", gas, curve, model, num_particles, replicas, use_displacement=True)
    m = replace(m, faster=m.faster * jnp.asarray(clock))
    rows, _ = m.evaluate(model, dict.fromkeys(m.nuisances, jnp.zeros(())), linear=False)
    residuals = jnp.concatenate([jnp.asarray(row.values) for row in rows])
    chi2 = jnp.sum(residuals**2)
    if m.nuisances:
        # The residuals are linear in the factors of T_rot and <dr^2>: subtract the best fit.
        nothing = [jnp.zeros((row.values.shape[0], 1)) for row in rows]
        columns = [
            [row.slopes.get(name, zero) for row, zero in zip(rows, nothing, strict=True)]
            for name in m.nuisances
        ]
        slope = jnp.concatenate([jnp.concatenate(column) for column in columns], axis=1)
        projection = slope.T @ residuals
        chi2 = chi2 - projection @ jnp.linalg.solve(slope.T @ slope, projection)
    if curve.temperature_error is None:
        value = -0.5 * curve.times.size * jnp.log(chi2)
    else:
        value = -0.5 * chi2
    return jnp.where(jnp.isnan(value), -jnp.inf, value)
