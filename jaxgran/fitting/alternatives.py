"""Alternative explanations of a measured curve, and the range of the parameters over them.

Each alternative adds one element to the scene, or one error to the measurement, of kinetic theory:
walls, drag, roughness, a noise floor, a wrong start of the clock. Its amplitude is varied from 0
until it explains almost the whole curve or the data exclude it, and the free parameters are fitted
again for each amplitude. chi^2 as a function of the amplitude shows whether the data prefer the
alternative, or exclude it; otherwise the parameters are only as certain as the amplitude.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.error_budget import curve_and_gas
from jaxgran.fitting.optimise import Problem, search
from jaxgran.fitting.parameters import START_TIME, domain_of
from jaxgran.fitting.residuals import FLOOR, DropTestRows, Measurement, chi2_scale
from jaxgran.fitting.result import SIGNIFICANCE, Fit
from jaxgran.models.error_model import ROUGHNESS_ERROR, SLIDING_ERROR
from jaxgran.models.kinetic_theory import KineticTheory

ALLOWED_CHI2 = 3.84
"""Increase of chi^2 over its minimum up to which an amplitude is allowed (5 % by chance), if the
errors are known; if they are estimated from the scatter, that of the F distribution."""

EXCLUDED_CHI2 = 4 * ALLOWED_CHI2
"""Increase of chi^2 beyond which larger amplitudes are not tried."""

DISTINGUISHABLE_SHARE = 0.1
"""Relative change of an estimate below which an allowed alternative is negligible."""

SHARES = (0.05, 0.15, 0.35, 0.6, 0.85, 0.97)
"""Amplitudes of walls, as shares of the initial cooling rate, and of a noise floor, as shares of
the last temperature."""

DRAG_SHARES = (0.001, 0.005, 0.02, 0.06, 0.2, 0.5, 0.9)
"""Amplitudes of drag, as shares of the initial cooling rate; its share grows as the gas cools."""

ROUGHNESS = (0.02, 0.08, 0.25, 0.6, 1.0, 1.4, 1.75, 1.9)
"""Values of 1 + beta_t of rough spheres."""

SLIDING = (0.3, 1.0, 2.5, 6.0, 15.0)
"""Values of 1/mu of rough spheres that slide."""

FRICTION = (0.02, 0.04, 0.06, 0.15, 0.4, 1.0)
"""Values of mu of smooth spheres that become rough and slide."""

STICKING_RESTITUTION = 0.44
"""beta_t of these, where they stick: that of glass (.44) and acetate (.43) beads, Foerster et al.,
Phys. Fluids 6, 1108 (1994)."""

DELAYS = (0.003, 0.02, 0.1, 0.3)
"""Errors of the start of the clock, over the initial cooling time, of both signs."""

NUM_REFINED = 2
"""Number of amplitudes tried between the last allowed one and the first excluded one, and around
each minimum."""

MIN_DROP = 0.25
"""Depth of a minimum among three amplitudes, and by their parabola below the least of them, over
`ALLOWED_CHI2`, below which none is tried."""

BARRIER = 5.0
"""Factor of `EXCLUDED_CHI2` for alternatives whose chi^2 may have a second minimum."""

MIN_SPACING = 0.05
"""Least distance of the latter from those tried, over the distance of these."""

WALL_RESTITUTION = 0.5
"""Restitution of the walls of an alternative; the side of the box is its amplitude."""

WALL_RATE_ERROR = 0.007
"""Relative error of theory's mean cooling rate until T has fallen to a fifth, if walls take all of
the energy (`jaxgran.models.error_model.WALL_ERROR`)."""

MIN_WALL_SIDE = 4.0
"""Smallest side of that box, in diameters."""

MAX_STEPS = 30
"""Maximum number of steps of a search."""

THEORY_TOLERANCE = 1e3
"""Factor of the tolerance of kinetic theory."""

SEARCH_TOLERANCE = 1e-4
"""Relative tolerance of a search where Gauss-Newton steps fail."""

LINEAR_STEP = 5.0
"""Length of a Gauss-Newton step, in standard errors, that is the last one: after it chi^2 is known
to .01 without another curve."""

MAX_CHANGE = 1.0
"""Largest change of an unconstrained parameter by a Gauss-Newton step: a factor e of A."""

SUPPORTED = {"surface", "container", "drag"}
"""Elements of a scene that alternatives add."""

DECLARABLE = {
    "walls": ("wall_side", "container_side, wall_restitution"),
    "roughness": ("tangential_restitution", "beta_t, T_rot"),
    "drag": ("drag_rate", "gamma"),
    "friction": ("friction", "friction"),
}
"""Parameter of each of the effects `jaxgran.data.curve_file.ABSENT`, and what describes it in a
file."""


class Kind(NamedTuple):
    """Kind of alternative.

    Attributes:
        name: in words.
        parameters: the floats, `START_TIME` or `FLOOR` that it adds, first its amplitude.
        amplitudes: values that are tried, in one or two increasing sequences from 0.
        values: values of parameters at an amplitude, given the label of the measurement.
        rate_error: relative error of kinetic theory's cooling rate by it, at an amplitude.
        one_minimum: False if amplitudes beyond excluded ones may be allowed.
    """

    name: str
    parameters: tuple[str, ...]
    amplitudes: tuple[tuple[float, ...], ...]
    values: Callable[[float, str], dict[str, float]]
    rate_error: Callable[[float], float] = lambda amplitude: 0.0
    one_minimum: bool = True


class Trial(NamedTuple):
    """Fit of the free parameters with one amplitude of an alternative."""

    amplitude: float
    chi2: float
    estimate: Float[np.ndarray, "p"]
    error: Float[np.ndarray, "p"]
    residuals: dict[str, Float[np.ndarray, "_"]]
    flat: Float[np.ndarray, "q"]


class Alternative(NamedTuple):
    """Alternative to a fitted law.

    Attributes:
        name: description of the added element or error.
        effect: its name in ``absent`` of `jaxgran.fit`; "" for an error of the measurement.
        amplitude: the best amplitude: the share of the initial cooling rate (walls, drag) or of
            the last T (floor), 1 + beta_t, or the delay of the clock over the cooling time.
        allowed: the smallest and the largest amplitude that the data allow.
        improvement: decrease of chi^2 from the fitted law to the best amplitude, over the scale of
            chi^2 (1 for independent errors of the given size).
        estimate: estimate of the free parameters at the best amplitude, SI.
        low, high: range of each free parameter over the allowed amplitudes, SI, 95 %.
        preferred: True if the data prefer this alternative to the fitted law; by chance they
            prefer any of the alternatives in 1 % of fits.
        distinguishable: True if the data distinguish the alternative from the fitted law: it
            changes the first parameter by less than 10 % beyond the error of the fitted law.
        error_reduction_needed: factor by which the errors must decrease to distinguish it; 1 if it
            is distinguishable.
    """

    name: str
    effect: str
    amplitude: float
    allowed: tuple[float, float]
    improvement: float
    estimate: Float[np.ndarray, "p"]
    low: Float[np.ndarray, "p"]
    high: Float[np.ndarray, "p"]
    preferred: bool
    distinguishable: bool
    error_reduction_needed: float


def compare_alternatives(
    result: Fit, absent: tuple[str, ...] = ()
) -> tuple[Alternative, tuple[Alternative, ...], float] | None:
    """Compare a fitted law with its alternatives, using T and, if it was fitted, T_rot.

    Args:
        result: a fit by `jaxgran.fit`.
        absent: effects that are known to be absent, see `jaxgran.data.curve_file.ABSENT`.

    Returns:
        The fitted law itself, and the alternatives to it, those that fit best first: none if the
        fitted gas is driven, or for drop tests alone; and the increase of chi^2 up to which they
        are allowed. None if the law cannot be computed.
    """
    gases = [curve_and_gas(result, label)[1] for label in result.comparisons]
    problem, first = _problem(result)
    kinds = _kinds(result, problem, absent) if all(gas.drive is None for gas in gases) else []
    bases = _minima(problem, result, first)
    if not bases:
        return None
    scale = _scale(bases[0], result)[0]
    trials = {kind: [_profile(problem, kind, base, scale) for base in bases] for kind in kinds}
    everything = [t for valleys in trials.values() for valley in valleys for t in valley]
    scale, degrees = _scale(min([*bases, *everything], key=lambda t: t.chi2), result)

    def quantile(chance: float) -> float:
        """Quantile of the F distribution of one degree of freedom and those of the scatter."""
        return float(scipy.special.stdtrit(degrees, 1 - chance / 2) ** 2)

    significant = quantile(SIGNIFICANCE / max(len(kinds), 1))
    allowed = min(quantile(0.05), EXCLUDED_CHI2)
    # Errors that the trials, which have no noise, do not include.
    parts = [result.error_budget.get(part, 0.0) for part in ("simulation", "few particles")]
    noise = np.hypot(*map(np.asarray, parts))
    positive = np.array(
        [domain_of(gases[0], n.rpartition(": ")[2]).low >= 0 for n in result._element_names]
    )

    def summarise(
        kind: Kind | None, valleys: list[list[Trial]], law: Alternative | None = None
    ) -> Alternative:
        rows = []
        for trials in valleys:  # interpolated between the amplitudes
            margins = [1.96 * np.hypot(scale**0.5 * trial.error, noise) for trial in trials]
            values = np.array(
                [
                    [t.chi2, t.amplitude, *(t.estimate - margin), *(t.estimate + margin)]
                    for t, margin in zip(trials, margins, strict=True)
                ]
            )
            fine = np.linspace(0, len(trials) - 1, 40 * (len(trials) - 1) + 1)
            known = np.arange(len(trials))
            rows.append(np.stack([np.interp(fine, known, column) for column in values.T], axis=1))
        best = min((trial for trials in valleys for trial in trials), key=lambda trial: trial.chi2)
        values = np.concatenate(rows)
        values = values[values[:, 0] <= best.chi2 + allowed * scale]
        low, high = np.min(values[:, 2:], axis=0), np.max(values[:, 2:], axis=0)
        low, high = low[: positive.size], high[positive.size :]
        low = np.where(positive, np.maximum(low, 0.0), low)
        improvement, wider = float((bases[0].chi2 - best.chi2) / scale), 0.0
        if law is not None:
            wider = max(law.low[0] - low[0], high[0] - law.high[0]) / abs(law.estimate[0])
        parameter = "" if kind is None else kind.parameters[0]
        return Alternative(
            name="" if kind is None else kind.name,
            effect=next((name for name, x in DECLARABLE.items() if x[0] == parameter), ""),
            amplitude=best.amplitude,
            allowed=(float(np.min(values[:, 1])), float(np.max(values[:, 1]))),
            improvement=improvement,
            estimate=best.estimate,
            low=low,
            high=high,
            preferred=improvement > significant,
            distinguishable=bool(wider < DISTINGUISHABLE_SHARE),
            error_reduction_needed=float(max(wider / DISTINGUISHABLE_SHARE, 1.0)),
        )

    law = summarise(None, [[base] for base in bases])
    alternatives = [summarise(kind, valleys, law) for kind, valleys in trials.items()]
    best_first = sorted(alternatives, key=lambda alternative: -alternative.improvement)
    return law, tuple(best_first), allowed


def ranges_over_alternatives(
    result: Fit, explanations: Sequence[Alternative], allowed_chi2: float
) -> dict[str, tuple[Float[np.ndarray, "size"], Float[np.ndarray, "size"]]]:
    """Return the 95 % range of each free parameter over all explanations that fit best.

    Args:
        result: a fit by `jaxgran.fit`.
        explanations: the fitted law and its alternatives.
        allowed_chi2: largest difference of their improvement from that of the best one.
    """
    best = max(explanation.improvement for explanation in explanations)
    as_good = [x for x in explanations if x.improvement >= best - allowed_chi2]
    low = np.min([x.low for x in as_good], axis=0)
    high = np.max([x.high for x in as_good], axis=0)
    names = np.array(result._element_names)
    return {name: (low[names == name], high[names == name]) for name in result.names}


def estimate_without(
    result: Fit, label: str, points: np.ndarray
) -> tuple[Float[np.ndarray, "p"], Float[np.ndarray, "p"]] | None:
    """Return estimates, and their errors, by kinetic theory without some points of a measurement.

    Args:
        result: a fit by `jaxgran.fit`.
        label: of the measurement.
        points: their indices.
    """
    problem, first = _problem(result)
    scale, measurements = 1.0, []
    for m in problem.measurements:
        if m.label == label and isinstance(m, Measurement):
            weights = {name: np.array(x) for name, x in m.weights.items()}
            for x in weights.values():
                x[points] = 0.0
            m = dataclasses.replace(m, weights=weights)
            scale = np.count_nonzero(weights["temperature"]) - len(result.names)
        measurements.append(m)
    problem = dataclasses.replace(problem, measurements=tuple(measurements))
    trial = _trial(problem, 0.0, first)
    if trial is None:
        return None
    without_errors = result.comparisons[label].scatter is not None
    return trial.estimate, trial.error * ((trial.chi2 / scale) ** 0.5 if without_errors else 1.0)


def _problem(result: Fit) -> tuple[Problem, np.ndarray]:
    """Return the problem of a fit with a free clock and kinetic theory, and its unknowns."""
    # A model that supports all alternatives is that of the trials, too.
    is_theory = not result.model.stochastic and set(result.model.elements) >= SUPPORTED
    model: Any = result.model if is_theory else KineticTheory()
    data = result.data if isinstance(result.data, dict) else {"": result.data}
    measurements, starts = [], {}
    for label, comparison in result.comparisons.items():
        curve, gas = curve_and_gas(result, label)
        measured = data[label] if label in data else next(iter(data.values()))
        starts[label] = float(comparison.start_time)
        if not isinstance(measured, CoolingCurve):
            measurements.append(DropTestRows(label, gas, measured))
            continue
        if "friction" in gas.elements:  # which kinetic theory does not support
            gas = dataclasses.replace(gas, surface=None)
        m = Measurement.of(
            label,
            gas,
            measured,
            model,
            comparison.num_particles if is_theory else None,
            1,
            use_displacement=False,
        )
        weights = {
            name: np.asarray(comparison.weights[name])
            for name in m.weights
            if name in comparison.weights
        }
        weights.setdefault("temperature", np.asarray(comparison.weights["temperature"]))
        # Weights of 0 stand for points that the model cannot compute, too.
        accuracy = np.full(weights["temperature"].shape, np.max(np.asarray(comparison.clock_error)))
        m = dataclasses.replace(
            m, weights=weights, clock_accuracy=accuracy, position=_mean_position(m)
        )
        m = dataclasses.replace(
            m, accuracies={k: x for k, x in m.accuracies.items() if k in weights}
        )
        if not is_theory:
            m = dataclasses.replace(m, offset=_offset(m, model, comparison, starts[label]))
        measurements.append(m)
    free = tuple(name for name in result.names if ": " not in name)
    separate = dict.fromkeys(name.rpartition(": ")[2] for name in result.names if ": " in name)
    problem = Problem.of(
        tuple(measurements), model, free, tuple(separate), result.priors, clock_is_free=True
    )
    values = {m.label: m.gas.floats | {START_TIME: starts[m.label]} for m in measurements}
    return dataclasses.replace(problem, tolerance=THEORY_TOLERANCE), problem.flat(values)


def _mean_position(m: Measurement) -> np.ndarray:
    """Return half of the mean of `Measurement.position` since t = 0.

    An error of the cooling rate with a trend in ln T delays the clock by its mean. The rates at the
    first and the last T differ in their errors by about as much as each of them is uncertain.
    """
    times = np.concatenate([[0.0], np.asarray(m.curve.times)])
    position = np.concatenate([[-1.0], np.asarray(m.position)])
    whole = np.cumsum(np.diff(times) * (position[1:] + position[:-1]) / 2)
    known = times[1:] > 0
    return np.where(known, whole / np.where(known, times[1:], 1.0), position[1:]) / 2


def _offset(m: Measurement, model: KineticTheory, comparison: Any, start: float) -> np.ndarray:
    """Return ln T of the fitted model, at its estimate, minus that of kinetic theory."""
    values = {START_TIME: np.asarray(start)} if start else {}
    rows, _ = m.evaluate(model, values)
    weights = np.asarray(comparison.weights["temperature"])
    used = weights > 0
    difference = rows[0].values - np.asarray(comparison.residuals["temperature"])
    return np.where(used, difference / np.where(used, weights, 1.0), 0.0)


def _minima(problem: Problem, result: Fit, first: np.ndarray) -> list[Trial]:
    """Return the minima of chi^2 that the data allow, the deepest one first."""
    p, ends = problem.num_free, np.asarray(result.minima.estimates, float)
    chi2, starts = np.asarray(result.minima.chi2), [first]
    near = EXCLUDED_CHI2 * max(float(result.reduced_chi2), 1.0)
    for estimate in ends[chi2 - np.min(chi2) < near]:
        if not np.allclose(estimate, result.estimate, rtol=DISTINGUISHABLE_SHARE):
            flat, begin = first.copy(), 0
            for u in problem.unknowns:
                if begin < p and np.isfinite([u.domain.low, u.domain.high]).any():
                    part = slice(begin, begin + u.size)
                    flat[part] = u.domain.to_free(estimate[part])
                begin += u.size
            starts.append(flat)
    trials = [_trial(problem, 0.0, start) for start in starts]
    found = sorted((t for t in trials if t is not None), key=lambda trial: trial.chi2)
    minima: list[Trial] = []
    for trial in found:
        known = any(np.allclose(trial.estimate, x.estimate, rtol=1e-2) for x in minima)
        if not known and trial.chi2 <= found[0].chi2 + ALLOWED_CHI2 * _scale(found[0], result)[0]:
            minima.append(trial)
    return minima


def _kinds(result: Fit, problem: Problem, absent: tuple[str, ...]) -> list[Kind]:
    """Return the kinds of alternatives to a fit."""
    scenes = [m.scene for m in problem.curves]
    rates = {m.label: _initial_rate(m, result) for m in problem.curves}
    lowest = {
        m.label: float(np.min(np.asarray(m.curve.temperature)[m.weights["temperature"] > 0]))
        for m in problem.curves
    }

    def walls(share: float, label: str) -> dict[str, float]:
        gas = next(m.scene for m in problem.curves if m.label == label)
        flux = 2 * np.sqrt(float(gas.temperature) / (2 * np.pi))
        side = 2 * (1 - WALL_RESTITUTION**2) * flux / max(share * rates[label], 1e-300)
        side = side + float(gas.diameter)
        side = max(side, MIN_WALL_SIDE * float(gas.diameter))
        return {"wall_side": side, "wall_coefficient": WALL_RESTITUTION}

    def drag(share: float, label: str) -> dict[str, float]:
        return {"drag_rate": share * rates[label] / 2}

    def delay(share: float, label: str) -> dict[str, float]:
        return {START_TIME: -share / rates[label]}

    beta_t, floor = "tangential_restitution", lambda x, label: {FLOOR: x * lowest[label]}
    possible = [
        Kind(
            "walls that dissipate energy",
            ("wall_side",),
            (SHARES,),
            walls,
            lambda share: WALL_RATE_ERROR * share,
        ),
        Kind("linear drag, as in air", ("drag_rate",), (DRAG_SHARES,), drag),
        Kind("a noise floor in T", (FLOOR,), (SHARES,), floor),
        Kind(
            "rough grains without initial rotation",
            (beta_t,),
            (ROUGHNESS,),
            lambda x, label: {beta_t: x - 1},
            lambda x: ROUGHNESS_ERROR * min(x, 1.0),
        ),
        Kind(
            "rough grains that slide",
            (beta_t, "friction"),
            (FRICTION,),
            lambda x, label: {beta_t: STICKING_RESTITUTION, "friction": x},
            lambda x: SLIDING_ERROR * x,
            one_minimum=False,
        ),
    ]
    if all(beta_t in gas.domains for gas in scenes):
        sliding = lambda x, label: {"friction": 1 / x}  # noqa: E731
        possible.append(Kind("grains that slide", ("friction",), (SLIDING,), sliding))
    known = {name.rpartition(": ")[2] for name in result.names}
    known |= {name for some in result.priors.values() for name in some}
    if not known & {START_TIME, "temperature"}:
        both = DELAYS, tuple(-x for x in DELAYS)
        possible.append(Kind("an error of the start time or of T_0", (START_TIME,), both, delay))
    known |= {DECLARABLE[name][0] for name in absent}
    known |= {name for gas in scenes for name in gas.domains}
    return [kind for kind in possible if known.isdisjoint(kind.parameters) and scenes]


def _initial_rate(m: Measurement, result: Fit) -> float:
    """Return the cooling rate at the start of a fitted curve, from the time in which T halves."""
    curve, gas = curve_and_gas(result, m.label)
    assert curve is not None
    T_0 = float(gas.temperature)
    times = np.asarray(curve.times) - float(result.comparisons[m.label].start_time)
    log_T = np.log(np.asarray(curve.temperature) / T_0)
    fallen = np.flatnonzero((log_T < -np.log(2)) & (times > 0))
    at = fallen[0] if fallen.size else -1
    cooled = np.expm1(-0.6 * min(log_T[at], -1e-6))  # 1 + t/tau = T^(-3/5)
    return float(5 / 3 * cooled / max(times[at], 1e-300))


def _trial(problem: Problem, amplitude: float, first: np.ndarray) -> Trial | None:
    """Fit the unknowns of a problem; None if it cannot be computed."""
    flat, step = _minimise(problem, first)
    rows, residuals, jacobian, _ = problem.evaluate(flat)
    if not (np.all(np.isfinite(residuals)) and np.all(np.isfinite(jacobian))):
        return None
    flat, p, change = flat + step, problem.num_free, jacobian @ step
    inverse = np.linalg.pinv(jacobian)
    error = np.linalg.norm(inverse, axis=1)[:p] * np.abs(problem.slopes(flat)[:p])
    changes = np.split(change, np.cumsum([row.values.size for row in rows])[:-1])
    by_label = {
        row.label or "": row.values + change
        for row, change in zip(rows, changes, strict=True)
        if row.measured and row.kind == "temperature"
    }
    chi2 = float(np.sum((residuals + change) ** 2))
    return Trial(amplitude, chi2, problem.estimates(flat), error, by_label, flat)


def _minimise(problem: Problem, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unknowns near the minimum, and a last step along which residuals are linear."""
    flat, chi2 = first, np.inf
    for _ in range(MAX_STEPS):
        _, residuals, jacobian, _ = problem.evaluate(flat)
        before, chi2 = chi2, np.sum(residuals**2)
        if not (chi2 < before and np.all(np.isfinite(jacobian))):
            break
        step = -np.linalg.pinv(jacobian) @ residuals
        largest = np.max(np.abs(step[: problem.num_free]))
        if np.linalg.norm(jacobian @ step) < LINEAR_STEP and largest < MAX_CHANGE:
            return flat, step
        flat = flat + step * min(1.0, MAX_CHANGE / max(largest, 1e-300))
    flat, *_ = search(problem, first, MAX_STEPS, tolerance=SEARCH_TOLERANCE)
    return flat, np.zeros_like(flat)


def _scale(trial: Trial, result: Fit) -> tuple[float, float]:
    """Return the scale of differences of chi^2, and the degrees of freedom of its estimate."""
    parts = [chi2_scale(x, len(result.names)) for x in trial.residuals.values()]
    scale, degrees = max(((float(x), float(n)) for x, n in parts), default=(1.0, np.inf))
    scatters = [comparison.scatter for comparison in result.comparisons.values()]
    return scale, np.inf if all(x is None for x in scatters) else degrees


def _profile(problem: Problem, kind: Kind, base: Trial, scale: float) -> list[Trial]:
    """Return fits with increasing amplitudes, from 0, of an alternative."""

    def fit_with(amplitude: float, first: np.ndarray) -> Trial | None:
        fixed = {m.label: kind.values(amplitude, m.label) for m in problem.curves}
        error = kind.rate_error(amplitude)
        measurements = tuple(
            dataclasses.replace(m, clock_accuracy=m.clock_accuracy + error)
            if isinstance(m, Measurement)
            else m
            for m in problem.measurements
        )
        changed = dataclasses.replace(problem, fixed=fixed, measurements=measurements)
        return _trial(changed, amplitude, first)

    trials, lowest = [base], base.chi2
    for sequence in kind.amplitudes:
        before, previous = base, None
        for amplitude in sequence:
            first = before.flat
            if previous is not None:
                slope = (before.flat - previous.flat) / (before.amplitude - previous.amplitude)
                step = np.clip(slope * (amplitude - before.amplitude), -1.0, 1.0)
                first = before.flat + step
            trial = fit_with(amplitude, first)
            if trial is None:
                break
            trials.append(trial)
            lowest = min(lowest, trial.chi2)
            if trial.chi2 > lowest + ALLOWED_CHI2 * scale:
                trials += _at_the_limit(fit_with, before, trial, lowest, ALLOWED_CHI2 * scale)
            previous, before = before, trial
            excluded = EXCLUDED_CHI2 * (1.0 if kind.one_minimum else BARRIER)
            if trial.chi2 > lowest + excluded * scale:
                break
    for _ in range(NUM_REFINED):
        trials.sort(key=lambda trial: trial.amplitude)
        threes = [trials[k - 1 : k + 2] for k in range(1, len(trials) - 1)]
        lowest_of_three = [x for x in threes if x[1].chi2 < min(x[0].chi2, x[2].chi2)]
        least_drop = MIN_DROP * ALLOWED_CHI2 * scale
        found = [_at_the_vertex(fit_with, three, least_drop) for three in lowest_of_three]
        trials += [trial for trial in found if trial is not None]
    return sorted(trials, key=lambda trial: trial.amplitude)


def _at_the_vertex(
    fit_with: Callable[[float, np.ndarray], Trial | None], three: list[Trial], least_drop: float
) -> Trial | None:
    """Return the fit at the vertex of the parabola through a minimum of chi^2, or on its side."""
    x, chi2 = (np.array([getattr(t, name) for t in three]) for name in ("amplitude", "chi2"))
    curvature, slope, _ = np.polyfit(x - x[1], chi2, 2)
    if max(np.min(np.delete(chi2, 1)) - chi2[1], slope**2 / (4 * curvature)) < least_drop:
        return None
    vertex = x[1] - slope / (2 * curvature)
    if not np.min(np.abs(vertex - x)) > MIN_SPACING * (x[2] - x[0]):
        vertex = (x[1] + (x[2] if vertex > x[1] else x[0])) / 2
    return fit_with(vertex, three[1].flat)


def _at_the_limit(
    fit_with: Callable[[float, np.ndarray], Trial | None],
    low: Trial,
    high: Trial,
    least: float,
    increase: float,
) -> list[Trial]:
    """Return fits near the amplitude at which chi^2, a parabola, exceeds its least value by this.

    The last one comes within a quarter of the increase, if `NUM_REFINED` are enough.
    """
    trials = []
    while low.chi2 <= least + increase < high.chi2 and len(trials) < NUM_REFINED:
        at_low, at_high = np.sqrt(low.chi2 - least), np.sqrt(high.chi2 - least)
        share = float(np.clip((np.sqrt(increase) - at_low) / (at_high - at_low), 0.05, 0.95))
        amplitude = low.amplitude + share * (high.amplitude - low.amplitude)
        trial = fit_with(amplitude, low.flat + share * (high.flat - low.flat))
        if trial is None:
            break
        trials.append(trial)
        least = min(least, trial.chi2)
        if abs(trial.chi2 - least - increase) < increase / 4:
            break
        low, high = (trial, high) if trial.chi2 <= least + increase else (low, trial)
    return trials
