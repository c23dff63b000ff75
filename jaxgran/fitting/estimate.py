"""The estimate of a fit, its errors by cause, and its result."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array

from jaxgran._utils import status
from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement import START_TIME, Measurement, Priors
from jaxgran.fitting.alternatives import Explanations, compare_alternatives
from jaxgran.fitting.messages import SIGNIFICANCE, say, with_words
from jaxgran.fitting.outliers import without_outliers
from jaxgran.fitting.parameters import (
    as_floats,
    guess_from_data,
    guess_from_drops,
    guess_start_time,
    known_start_time,
    with_floats,
)
from jaxgran.fitting.prediction import Residuals
from jaxgran.fitting.problem import Evaluation, Problem
from jaxgran.fitting.result import Fit
from jaxgran.fitting.rows import SCATTER, CurveRows, DropRows, curve_rows, with_rate_error
from jaxgran.fitting.search import Descent, Minimum, best_of_starts, minimise
from jaxgran.models.base import AbstractModel
from jaxgran.models.checks import describe_walls
from jaxgran.scene.gas import Gas, law_fields
from jaxgran.scene.parameters import symbol_of

DEGENERATE = 9.0
"""Difference of -2 ln L up to which two minima are equally good: three standard errors."""

UNDETERMINED_ERROR = 1.0
"""Standard error in the unconstrained scale, a factor e, from which on nothing is known."""

SOURCE_STEP = 0.02
"""Relative change of a variance by which its part of an error is found."""

MIN_EIGENVALUE = 1e-12
"""Least information on a combination of parameters: their error is then infinite to all ends."""

FEW_PARTICLES = "few particles"
"""Part of an error by the randomness of collisions of N grains."""


@dataclass(frozen=True)
class Request:
    """What a user asks of a fit, after all checks.

    Attributes:
        measurements: by label.
        model: the model.
        names: of the shared free parameters.
        separate: of those that each curve has separately.
        priors: of shared parameters and of those of each measurement.
        start: a further guess; None without one.
        absent: effects that are known to be absent in all curves.
        quick: whether alternatives are left out.
    """

    measurements: dict[str, Measurement]
    model: AbstractModel
    names: tuple[str, ...]
    separate: tuple[str, ...]
    priors: dict[str, Priors]
    start: Gas | None
    absent: tuple[str, ...]
    quick: bool


def fit_without_noise(request: Request, max_steps: int, descent: Descent | None = None) -> Fit:
    """Fit a model without noise, starting at the best of some guesses."""
    problem, first, notes = problem_of(request)
    problem.check_points()
    if descent is None:
        problem, best, minima = _found_by_two_searches(problem, first, max_steps)
    else:  # it keeps the errors of the cooling rate that it began with
        best, minima = best_of_starts(problem, first, max_steps, descent)
    check_computed(problem, best)
    explanations = None
    if best.converged and not request.quick:
        is_driven = any(m.scene.drive is not None for m in problem.curves)
        noise = np.zeros(problem.num_free)
        explanations = compare_alternatives(problem, minima, noise, request.absent, is_driven)
    trace = None if descent is None else descent.trace
    result = assembled(request, problem, best, minima, explanations, trace)
    share = measurement_share(problem, problem.evaluate(best.flat))
    if result.p_value < SIGNIFICANCE / 2 and not request.quick:
        notes += _of_outliers(problem, first, max_steps)
    return with_all_words(request, result, explanations, notes, share)


def _of_outliers(problem: Problem, first: np.ndarray, max_steps: int) -> Iterator[str]:
    """Yield a clause on far outliers, and the first parameter of a fit without them."""
    rest, end, left_out = without_outliers(problem, first, max_steps)
    found = rest.evaluate(end.flat)
    if not left_out or goodness(rest, found)["p_value"] < SIGNIFICANCE / 2:
        return
    times = {m.label: np.asarray(m.curve.times) for m in problem.curves}
    places = [
        f"{x.label}: " * bool(x.label) + f"t = {times[x.label][x.time]:.3g} s (row {x.time + 1})"
        for x in sorted(left_out)
    ]
    error = np.sqrt(inverse(found.information)[0, 0]) * rest.slopes(end.flat)[0]
    without = say(
        "without outliers",
        symbol=symbol_of(problem.unknowns[0].name),
        value=rest.estimates(end.flat)[0],
        error=error,
    )
    yield say("outliers", places=", ".join(places)) + without


def _found_by_two_searches(
    problem: Problem, first: np.ndarray, max_steps: int
) -> tuple[Problem, Minimum, list[Minimum]]:
    """Return the deepest minimum, and those that are nearly as deep, with the problem there.

    The first search has the scatter that N gives. The second one finds it, too, with the errors of
    the model's cooling rate in the gas that the first one found.
    """
    held, is_left = problem.holding(SCATTER)
    begun, minima = best_of_starts(held, first[is_left], max_steps)
    check_computed(held, begun)

    def whole(flat: np.ndarray) -> np.ndarray:
        full = first.copy()
        full[is_left] = flat
        return full

    problem = problem_with_rate_errors(problem, whole(begun.flat))
    near = [whole(m.flat) for m in minima if m.value < begun.value + DEGENERATE]
    minima = [minimise(problem, flat, max_steps) for flat in near]
    end = min(minima, key=lambda minimum: minimum.value)
    steps = begun.steps + sum(m.steps for m in minima)
    best = end._replace(steps=steps)
    return problem, best, minima


def problem_of(request: Request) -> tuple[Problem, np.ndarray, list[str]]:
    """Return the problem of a fit, a first guess of its unknowns, and notes on the data."""
    model = request.model
    free = (*request.names, *request.separate)
    prior_names = {name for some in request.priors.values() for name in some}
    fits_t0 = START_TIME in (*free, *prior_names)
    measurements: list[CurveRows | DropRows] = []
    guesses: dict[str, Gas] = {}
    notes: list[str] = []
    for label, m in request.measurements.items():
        if isinstance(m.data, DropTest):
            measurements.append(DropRows(label, m))
            guesses[label] = guess_from_drops(m.gas, m.data, free)
            continue
        model.check_scene(m.gas if request.start is None else request.start)
        rows, more = curve_rows(label, m, model, fits_T_0="temperature" in free, fits_t0=fits_t0)
        notes += [f"{label}: {note}" if label else note for note in more]
        clocks = (START_TIME,) if START_TIME in prior_names else ()
        since = m.curve
        if "temperature" in free:
            known = known_start_time(request.priors, label)[0]
            since = replace(since, times=np.asarray(since.times) - np.asarray(known))
        guesses[label] = guess_from_data(rows.gas, since, (*free, *clocks))
        measurements.append(rows)
    problem = Problem.build(
        tuple(measurements), model, request.names, request.separate, request.priors
    )
    for m in measurements:  # drop tests begin at the shared values of the first curve
        if isinstance(m, DropRows) and problem.curves:
            shared = guesses[problem.curves[0].label]
            guesses[m.label] = with_values_of(m.gas, shared, request.names)
    first = problem.flat(_values_of_guesses(problem, guesses))
    problem = problem_with_rate_errors(problem, first)
    if request.start is not None:
        complete = {
            label: with_values_of(guess, request.start, free) for label, guess in guesses.items()
        }
        other = problem.flat(_values_of_guesses(problem, complete))
        starts = [(problem.evaluate(flat).value, flat) for flat in (first, other)]
        first = min(starts, key=lambda pair: (np.isnan(pair[0]), pair[0]))[1]
    return problem, first, notes


def problem_with_rate_errors(problem: Problem, flat: np.ndarray) -> Problem:
    """Return a problem with the errors of its model's cooling rate at some unknowns."""
    values = problem.values(flat)

    def with_error(m: CurveRows | DropRows) -> CurveRows | DropRows:
        if isinstance(m, DropRows):
            return m
        own = {n: x for n, x in values[m.label].items() if n in m.scene.domains}
        return with_rate_error(m, problem.model, with_floats(m.scene, as_floats(own)))

    return replace(problem, measurements=tuple(map(with_error, problem.measurements)))


def with_values_of(gas: Gas, other: Gas, names: tuple[str, ...]) -> Gas:
    """Return a gas with the values that another one has for some parameters."""
    known = {n: other.value(n) for n in names if n in other.domains and n in gas.domains}
    return gas.replace(**known)


def _values_of_guesses(problem: Problem, guesses: dict[str, Gas]) -> dict[str, dict[str, Any]]:
    """Return the values of gases and a guess of t0, by label and name."""
    values: dict[str, dict[str, Any]] = {label: gas.floats for label, gas in guesses.items()}
    for m in problem.curves:
        names = tuple(u.name for u in problem.unknowns if u.label in (None, m.label))
        known = known_start_time(problem.priors, m.label)
        values[m.label][START_TIME] = guess_start_time(guesses[m.label], m.curve, names, known)
    return values


def check_computed(problem: Problem, end: Minimum) -> None:
    """Raise RuntimeError if one of the curves was not computed where a search ended."""
    for curve in problem.evaluate(end.flat).curves.values():
        fault = int(curve.get("status", status.OK))
        if fault != status.OK:
            names = [u.title for u in problem.unknowns]
            values = zip(names, problem.estimates(end.flat), strict=False)
            at = ", ".join(f"{name} = {value:.3g}" for name, value in values)
            raise RuntimeError(
                f"{type(problem.model).__name__} could not compute the curve at {at}, where the "
                f"search ended: {status.explain(fault)}"
            )
    if not np.isfinite(end.value):
        raise RuntimeError(
            "the likelihood is not a number where the search begins, at "
            f"{problem.estimates(end.flat)}: give start, a gas nearer to the measured one"
        )


def inverse(information: np.ndarray) -> np.ndarray:
    """Return the covariance of parameters of some information; very large where there is none."""
    values, axes = np.linalg.eigh(information)
    return axes / np.maximum(values, MIN_EIGENVALUE) @ axes.T


def assembled(
    request: Request,
    problem: Problem,
    end: Minimum,
    minima: list[Minimum],
    explanations: Explanations | None,
    trace: Any = None,
) -> Fit:
    """Return the result of a fit without words.

    Args:
        request: of the user.
        problem: at its minimum.
        end: the deepest minimum.
        minima: all minima.
        explanations: the fitted law and its alternatives; None if they were not compared.
        trace: course of a descent.
    """
    found = problem.evaluate(end.flat)
    p = problem.num_free
    scale = problem.slopes(end.flat)
    covariance = inverse(found.information)
    parts = _information_by_source(problem, end.flat, found)
    to_si = scale[:, None] * covariance
    covariances = {name: (to_si @ part @ to_si.T)[:p, :p] for name, part in parts.items()}
    spread = _of_other_minima(problem, end, minima, covariance)
    if np.any(spread > 0):
        covariances["other minima"] = spread
    values = problem.values(end.flat)
    gases = {}
    curves: dict[str, CoolingCurve | None] = {}
    for m in problem.measurements:
        floats = {n: x for n, x in values[m.label].items() if n in m.scene.domains}
        gases[m.label] = with_floats(m.scene, as_jax_arrays(as_floats(floats)))
        curves[m.label] = None
        if isinstance(m, CurveRows):
            curves[m.label] = _as_curve(m, found.curves[m.label])
    names = titles(problem)
    is_single = [*gases] == [""]
    errors = np.sqrt(np.diag(covariance))
    elements = problem.elements(end.flat)
    scatter = {
        e.label or "": (float(np.exp(end.flat[e.place])), float(errors[e.place]))
        for e in elements
        if e.name == SCATTER
    }
    return Fit(
        names=names,
        model=problem.model,
        model_name=problem.model.name,
        measurements=request.measurements,
        gas=gases[""] if is_single else gases,
        curve=curves[""] if is_single else curves,
        estimate=problem.estimates(end.flat),
        covariances=covariances,
        ranges=ranges_of(problem, explanations),
        alternatives=() if explanations is None else explanations.alternatives,
        **goodness(problem, found),
        log_likelihood=-0.5 * found.value,
        residuals=_residuals(problem, found),
        scatter=scatter,
        scales={m.label: described(gases[m.label], m) for m in problem.curves},
        start_time={m.label: float(values[m.label].get(START_TIME, 0.0)) for m in problem.curves},
        weights=_weights(problem, found),
        undetermined=undetermined(problem, found),
        other_minima=_other_minima(problem, end, minima, covariance),
        converged=end.converged,
        iterations=end.steps,
        trace=trace,
    )


def titles(problem: Problem) -> tuple[str, ...]:
    """Return the names of the free parameters."""
    ends = np.cumsum([u.size for u in problem.unknowns])
    free = zip(problem.unknowns, ends, strict=True)
    return tuple(u.title for u, end in free if end <= problem.num_free)


def ranges_of(
    problem: Problem, explanations: Explanations | None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the range of each free parameter over all explanations; {} without them."""
    if explanations is None:
        return {}
    low, high = explanations.ranges()
    sizes = [u.size for u in problem.unknowns if u.title in titles(problem)]
    ends = np.cumsum(sizes)
    places = zip(titles(problem), ends, sizes, strict=False)
    return {name: (low[end - n : end], high[end - n : end]) for name, end, n in places}


def _information_by_source(
    problem: Problem, flat: np.ndarray, found: Evaluation
) -> dict[str, np.ndarray]:
    """Return the information on all unknowns, as the variance of the estimate's score by source.

    A variance that grows by a share a lowers the information by a times its part.
    """
    parts: dict[str, np.ndarray] = {}

    def add(name: str, part: np.ndarray) -> None:
        parts[name] = parts.get(name, 0.0) + part

    def linear(evaluation: Evaluation) -> np.ndarray:
        return sum(
            (row.slopes.T @ row.slopes for row in evaluation.rows if row.name == "curve"),
            np.zeros_like(found.information),
        )

    sources = ["measurement", FEW_PARTICLES, "model"]
    if any(np.any(np.asarray(m.simulation) > 0) for m in problem.curves):
        sources.append("simulation")
    for name in sources if problem.curves else []:
        less = linear(problem.evaluate(flat, **{name: 1 - SOURCE_STEP}))
        more = linear(problem.evaluate(flat, **{name: 1 + SOURCE_STEP}))
        add(name, _positive((less - more) / (2 * SOURCE_STEP)))
    for row in found.rows:
        # What the scatter itself tells is as uncertain as few grains make it.
        add(FEW_PARTICLES, 0.5 * row.log_slopes.T @ row.log_slopes)
        if row.name == "curve":
            continue
        name = row.name if row.is_prior else "measurement"
        add(FEW_PARTICLES if name == SCATTER else name, row.slopes.T @ row.slopes)
    return {name: part for name, part in parts.items() if np.any(part)}


def _positive(matrix: np.ndarray) -> np.ndarray:
    """Return a symmetric matrix without the negative eigenvalues of round-off."""
    values, axes = np.linalg.eigh(matrix)
    return axes * np.maximum(values, 0.0) @ axes.T


def _of_other_minima(
    problem: Problem, end: Minimum, minima: list[Minimum], covariance: np.ndarray
) -> np.ndarray:
    """Return the covariance of the estimates by minima that are nearly as deep, SI."""
    p = problem.num_free
    error = np.sqrt(np.diag(covariance))[:p]
    kept = [end]
    for m in sorted(minima, key=lambda minimum: minimum.value):
        nearest = min(np.max(np.abs(m.flat - x.flat)[:p] / error) for x in kept)
        if nearest > 1:
            kept.append(m)
    distance = np.stack([problem.estimates(m.flat) - problem.estimates(end.flat) for m in kept])
    weights = np.exp([(end.value - m.value) / 2 for m in kept])
    return np.einsum("k,ki,kj->ij", weights / np.sum(weights), distance, distance)


def _other_minima(
    problem: Problem, end: Minimum, minima: list[Minimum], covariance: np.ndarray
) -> np.ndarray:
    """Return the estimates at other minima that are as good, and apart by three standard errors."""
    p = problem.num_free
    error = np.sqrt(np.diag(covariance))[:p]
    solutions: list[np.ndarray] = []
    for m in minima:
        apart = np.max(np.abs(m.flat - end.flat)[:p] / error) > DEGENERATE**0.5
        estimate = problem.estimates(m.flat)
        known = any(np.allclose(estimate, other, rtol=1e-3) for other in solutions)
        if m.value < end.value + DEGENERATE and apart and not known:
            solutions.append(estimate)
    return np.array(solutions).reshape(-1, p)


def goodness(problem: Problem, found: Evaluation) -> dict[str, Any]:
    """Return chi^2, its degrees of freedom, and its probabilities by chance.

    T and T_rot, <dr^2> and each drop test are tested separately, so that many points of one do not
    hide a misfit of the other: the p-value is that of the worst, corrected for the choice. Where N
    is not known, its scatter explains any curve: then it is tested that N is not too small.
    """
    chi2 = sum(float(np.sum(row.values**2)) for row in found.rows)
    counts = {id(row): _count(problem, row) for row in found.rows}
    size = found.gradient.size
    degrees = max(sum(counts.values()) - size, 1)
    measured = [row for row in found.rows if not row.is_prior]
    upper, lower = [], []
    for row in measured:
        own = problem.num_free if len(measured) == 1 else 0
        number = max(counts[id(row)] - own, 1)
        square = float(np.sum(row.values**2))
        upper.append(float(scipy.stats.chi2.sf(square, number)))
        if row.name == "curve":
            lower.append(float(scipy.stats.chi2.cdf(square, number)))

    unknown = [m.label for m in problem.curves if m.measurement.num_particles is None]
    for row in found.rows:
        if row.name == SCATTER and row.label in unknown:
            upper.append(float(scipy.stats.norm.sf(row.values[0])))

    def of_worst(values: list[float]) -> float:
        if not values:
            return 1.0
        return float(-np.expm1(len(values) * np.log1p(-min(min(values), 1 - 1e-12))))

    return {
        "chi2": chi2,
        "degrees_of_freedom": degrees,
        "p_value": of_worst(upper),
        "smooth_p_value": of_worst(lower),
    }


def _count(problem: Problem, row: Residuals) -> int:
    """Return the number of residuals that count."""
    for m in problem.curves:
        if m.label == row.label and row.name == "curve":
            return int(np.sum(m.used))
        if m.label == row.label and row.name == "displacement" and m.displacement is not None:
            return int(np.sum(m.displacement.errors > 0))
    return row.values.size


def _residuals(problem: Problem, found: Evaluation) -> dict[str, dict[str, np.ndarray]]:
    residuals: dict[str, dict[str, np.ndarray]] = {m.label: {} for m in problem.measurements}
    by_label = {m.label: m for m in problem.curves}
    for row in found.rows:
        if row.is_prior or row.label is None:
            continue
        if row.name != "curve":
            residuals[row.label][row.name] = row.values
            continue
        of_T, of_rotation = np.split(row.values, 2)
        residuals[row.label]["temperature"] = of_T
        if by_label[row.label].uses_rotation:
            residuals[row.label]["rotational_temperature"] = of_rotation
    return residuals


def _weights(problem: Problem, found: Evaluation) -> dict[str, np.ndarray]:
    """Return the fraction of the information on each estimate from each measurement.

    The information of a measurement is that on a parameter while all others are known.
    """
    p = problem.num_free
    parts = {m.label: np.zeros(p) for m in problem.measurements}
    for row in found.rows:
        if not row.is_prior and row.label is not None:
            parts[row.label] = parts[row.label] + np.diag(row.information)[:p]
    whole = np.maximum(np.sum(list(parts.values()), axis=0), np.finfo(float).tiny)
    return {label: part / whole for label, part in parts.items()}


def undetermined(problem: Problem, found: Evaluation) -> tuple[str, ...]:
    """Return the parameters that the data do not determine, or only in a combination.

    These are the parameters in those singular vectors of the sensitivity whose standard error
    exceeds 1 (a factor e), or, with each parameter scaled to a sensitivity of 1, whose singular
    value is below ``model.derivative_accuracy`` times the largest. Parameters of a law with a
    smoothness prior, and arrays in parts of a law, such as a neural network, are not among them.
    """
    gas = problem.measurements[0].scene
    without_meaning = law_fields(gas.law).keys() - gas.law.domains.keys()
    left_out = law_fields(gas.law) if gas.law.prior_residuals().size else without_meaning
    p = problem.num_free
    measured = [row.slopes[:, :p] for row in found.rows if not row.is_prior]
    priors = [row.slopes[:, :p] for row in found.rows if row.is_prior]
    sensitivity = np.concatenate(measured + priors)
    size = np.maximum(np.linalg.norm(sensitivity, axis=0), np.finfo(float).tiny)
    is_weak = np.zeros(p, bool)
    accuracy = problem.model.derivative_accuracy
    for scale, limit in ((np.ones(p), UNDETERMINED_ERROR), (size, accuracy)):
        _, singular, rotation = np.linalg.svd(sensitivity / scale, full_matrices=False)
        least = limit * (singular[0] if scale is size else 1.0)
        share = np.abs(rotation[singular <= least])
        is_weak |= np.any(share > 0.05 * share.max(axis=1, initial=0.0, keepdims=True), axis=0)
    titles_of_elements = np.repeat(
        [u.title for u in problem.unknowns], [u.size for u in problem.unknowns]
    )[:p]
    weak = [str(name) for name, is_so in zip(titles_of_elements, is_weak, strict=True) if is_so]
    return tuple(dict.fromkeys(name for name in weak if name not in left_out))


def _as_curve(m: CurveRows, computed: dict[str, Any]) -> CoolingCurve:
    """Return a computed curve without the quantities that the scene does not have."""
    absent = () if m.scene.surface is not None else ("rotational_temperature",)
    if m.scene.container is not None:
        absent += ("displacement", "diffusion")
    fields = {name: x for name, x in computed.items() if name not in absent}
    return CoolingCurve(times=m.curve.times, **as_jax_arrays(fields))


def described(gas: Gas, m: CurveRows) -> dict[str, float]:
    """Return numbers that describe a fitted gas: see `Fit.scales`."""
    N = m.measurement.num_particles
    # An array: a number of Python would be a constant of a program of its own.
    numbers = _scales(gas, jnp.asarray(m.values[-1, 0]))
    described = {name: float(x) for name, x in numbers.items()}
    volume = described.pop("volume")
    side = float("nan") if N is None else (N * volume) ** (1 / gas.dimension)
    return described | {"side": side}


@eqx.filter_jit
def _scales(gas: Gas, last: Array) -> dict[str, Array]:
    speeds = jnp.sqrt(2 * jnp.stack([gas.temperature, last]))
    first, at_last = gas.restitution(speeds)
    scales = {
        "phi": gas.packing_fraction,
        "tau_c": gas.mean_free_time,
        "contact_fraction": gas.contact_fraction,
        "eps_first": first,
        "eps_last": at_last,
        "mean_free_path": gas.mean_free_path,
        "volume": 1 / gas.number_density,
    }
    if hasattr(gas.law, "dissipative_constant"):
        scales["beta"] = gas.thermal_beta
    return scales


def with_all_words(
    request: Request,
    result: Fit,
    explanations: Explanations | None,
    notes: Iterable[str],
    share: float,
) -> Fit:
    """Return a result with its first line, verdict and reasons; see `measurement_share`."""
    limitations = []
    notes = list(notes)
    gases = result.gas if isinstance(result.gas, dict) else {"": result.gas}
    for label, m in request.measurements.items():
        if isinstance(m.data, DropTest):
            continue
        gas = gases[label]
        N = m.num_particles
        for limitation in request.model.limitations(gas, N):
            if limitation.words not in {known.words for known in limitations}:
                limitations.append(limitation)
        if N is not None and gas.container is None and "walls" not in request.absent:
            prefix = f"{label}: " if label else ""
            notes.append(f"{prefix}the box of {N} spheres {describe_walls(gas, N)}")
    return with_words(
        result,
        explanations,
        tuple(limitations),
        notes,
        request.absent,
        quick=request.quick,
        measurement_share=share,
    )


def measurement_share(problem: Problem, found: Evaluation) -> float:
    """Return the share of the errors of the measurement in the variances of T."""
    shares = []
    for m in problem.curves:
        row = next(r for r in found.rows if r.label == m.label and r.name == "curve")
        variance = np.exp(np.split(row.log_variance, 2)[0])
        relative = (m.errors[:, 0] / found.curves[m.label]["temperature"]) ** 2
        shares.append(np.mean((relative / variance)[m.used[:, 0] > 0]))
    return float(max(shares, default=0.0))
