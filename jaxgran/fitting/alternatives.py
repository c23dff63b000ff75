"""Alternative explanations of a measured curve, and the range of the parameters over them.

Each alternative adds one element to the scene, or one error to the measurement, of kinetic theory:
walls, drag, roughness, a noise floor, independent errors, a wrong start of the clock. Its amplitude
is varied from 0 until it explains almost the whole curve or the data exclude it, and all unknowns
are fitted again for each amplitude, with the scatter that N grains have in that scene. -2 ln L as a
function of the amplitude shows whether the data prefer the alternative, or exclude it; otherwise
the parameters are only as certain as the amplitude.

Where the data prefer an element, the same is done with a second effect beside it: the range then
allows for one effect more than the data show.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.comparison import FLOOR, WHITE
from jaxgran.fitting.goodness import SIGNIFICANCE, goodness
from jaxgran.fitting.information import inverse
from jaxgran.fitting.parameters import Unknown, as_floats, domain_of, with_parameters
from jaxgran.fitting.problem import Problem
from jaxgran.fitting.rows import CurveRows
from jaxgran.fitting.search import MAX_STEP, Minimum, farthest, minimise, newton_step
from jaxgran.models.error_model import ROUGHNESS_ERROR, SLIDING_ERROR
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import VARIANT_SPEED, VISCOELASTIC_EXPONENT

ALLOWED = 3.84
"""Increase of -2 ln L over that of the law up to which its own parameters are allowed (5 % by
chance)."""

ALLOWED_OVER_ALL = 3.84
"""The same of all explanations over the best one."""

EXCLUDED = 4 * ALLOWED
"""Increase beyond which larger amplitudes are not tried."""

PREFERENCE_LEVEL = 0.01
"""Probability by chance of any alternative being preferred."""

DISTINGUISHABLE_SHARE = 0.1
"""Relative change of an estimate below which an allowed alternative is negligible."""

SHARES = (0.05, 0.15, 0.35, 0.6, 0.85, 0.97)
"""Amplitudes of walls, as shares of the initial cooling rate, and of a noise floor, as shares of
the lowest computed temperature."""

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

SPREADS = (0.02, 0.05, 0.1, 0.15)
"""Standard deviations of eps from impact to impact."""

WHITE_ERRORS = (0.002, 0.006, 0.02, 0.06)
"""Relative standard deviations of independent errors of T."""

NUM_REFINED = 2
"""Number of amplitudes tried between the last allowed one and the first excluded one, and around
each minimum."""

MIN_DROP = 0.25
"""Depth of a minimum among three amplitudes, and by their parabola below the least of them, over
`ALLOWED`, below which none is tried."""

BARRIER = 5.0
"""Factor of `EXCLUDED` for alternatives whose -2 ln L may have a second minimum."""

MIN_SPACING = 0.05
"""Least distance of the latter from those tried, over the distance of these."""

WALL_RESTITUTION = 0.5
"""Restitution of the walls of an alternative; the side of the box is its amplitude."""

WALL_RATE_ERROR = 0.007
"""Relative error of theory's mean cooling rate until T has fallen to a fifth, if walls take all of
the energy (`jaxgran.models.error_model.WALL_ERROR`)."""

MIN_WALL_SIDE = 4.0
"""Smallest side of that box, in diameters."""

MAX_STEPS = 20
"""Maximum number of steps of a search."""

THEORY_TOLERANCE = 1e3
"""Factor of the tolerance of kinetic theory."""

TRIAL_STEP = 1.0
"""Length of a Newton step, in standard errors, that is the last one of a trial: it is taken without
another curve, and -2 ln L is then known to .1."""

DECLARABLE = {
    "walls": ("wall_side", "container_side, wall_restitution"),
    "roughness": ("tangential_restitution", "beta_t, T_rot"),
    "drag": ("drag_rate", "gamma"),
    "friction": ("friction", "friction"),
}
"""Parameter of each of the effects `jaxgran.data.header.ABSENT`, and what describes it in a
file."""


SCENE_PARAMETERS = tuple(parameter for parameter, _ in DECLARABLE.values())
"""The parameters of elements of a scene, beside which second effects are tried."""

WALLS_ADDED = "walls that dissipate energy"
DRAG_ADDED = "linear drag, as in air"
ROUGHNESS_ADDED = "rough grains without initial rotation"
"""Names of alternatives that add one element to the scene."""


class Kind(NamedTuple):
    """Kind of alternative.

    Attributes:
        name: in words.
        parameters: the parameters that it adds; the first one identifies the effect.
        amplitudes: values that are tried, in one or two increasing sequences from 0.
        values: values of parameters at an amplitude, given the label of the measurement.
        rate_error: relative error of kinetic theory's cooling rate by it, at an amplitude.
        one_minimum: False if amplitudes beyond excluded ones may be allowed.
        changes_law: whether it is in the law of impacts, which drop tests obey, too.
        keeps_A: False if A has no meaning in it: it is not part of the range.
    """

    name: str
    parameters: tuple[str, ...]
    amplitudes: tuple[tuple[float, ...], ...]
    values: Callable[[float, str], dict[str, float]]
    rate_error: Callable[[float], float] = lambda amplitude: 0.0
    one_minimum: bool = True
    changes_law: bool = False
    keeps_A: bool = True


class Trial(NamedTuple):
    """Fit of all unknowns with one amplitude of an alternative.

    Attributes:
        amplitude: of the alternative.
        value: -2 ln L.
        flat: the unknowns, in their unconstrained scale.
        error: standard errors of the free parameters in this scale.
    """

    amplitude: float
    value: float
    flat: Float[np.ndarray, "unknowns"]
    error: Float[np.ndarray, "p"]


class Alternative(NamedTuple):
    """Alternative to a fitted law.

    Attributes:
        name: description of the added element or error.
        effect: its name in ``absent`` of `jaxgran.Measurement`; "" for an error of the measurement.
            Of two effects together it is the first one.
        amplitude: the best amplitude: the share of the initial cooling rate (walls, drag) or of
            the lowest computed T (floor), 1 + beta_t, 1/mu or mu (sliding), the relative error,
            the standard deviation of eps, or the delay of the clock over the cooling time. Of two
            effects together it is the amplitude of the second one.
        allowed: the smallest and the largest amplitude that the data allow.
        improvement: decrease of -2 ln L from the fitted law to the best amplitude.
        estimate: estimate of the free parameters at the best amplitude, SI.
        low, high: range of each free parameter over the allowed amplitudes, SI, 95 %.
        preferred: True if the data prefer this alternative to the fitted law, or two effects
            together to the first of them; by chance they prefer any of the alternatives in 1 % of
            fits.
        distinguishable: True if the data allow so little of the alternative that it widens the
            range of the first parameter by less than 10 %.
        error_reduction_needed: factor by which the errors must decrease for that; 1 if it is
            distinguishable.
        restitution: eps of an alternative in which it is constant, so that A has no meaning; None
            for all others. It is not part of the range.

    >>> best = result.alternatives[0]
    >>> best.improvement < 0.01 and not best.preferred  # the curve has no noise
    True
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
    restitution: float | None = None


class Explanations(NamedTuple):
    """A fitted law and its alternatives.

    Attributes:
        law: the fitted law itself.
        alternatives: to it, those that fit best first.
    """

    law: Alternative
    alternatives: tuple[Alternative, ...]

    def ranges(self, without: Sequence[Alternative] = ()) -> tuple[np.ndarray, np.ndarray]:
        """Return the 95 % range of the free parameters over all explanations that fit best.

        Args:
            without: explanations that are left out.
        """
        considered = [
            x for x in (self.law, *self.alternatives) if x not in without and x.restitution is None
        ]
        best = max(x.improvement for x in considered)
        allowed = [
            x
            for x in considered
            if x.improvement >= best - ALLOWED_OVER_ALL or (x is self.law and not self.is_rejected)
        ]
        low = np.min([x.low for x in allowed], axis=0)
        high = np.max([x.high for x in allowed], axis=0)
        return low, high

    @property
    def is_rejected(self) -> bool:
        """Whether the data prefer an alternative in which A has a meaning to the fitted law."""
        return any(x.preferred and x.restitution is None for x in self.alternatives)


def compare_alternatives(
    problem: Problem,
    minima: list[Minimum],
    noise: Float[np.ndarray, "p"],
    absent: tuple[str, ...],
    is_driven: bool,
) -> Explanations | None:
    """Compare a fitted law with its alternatives.

    Args:
        problem: of a model that supports all alternatives, at the minima of the fit.
        minima: minima of -2 ln L that the data allow.
        noise: standard errors of the free parameters, in their unconstrained scale, that the
            problem does not contain.
        absent: effects that are known to be absent, see `jaxgran.data.header.ABSENT`.
        is_driven: whether the gas is driven, which has no alternatives.

    Returns:
        None if the law cannot be computed.
    """
    problem = replace(problem, tolerance=THEORY_TOLERANCE)
    bases = _minima(problem, minima)
    if not bases:
        return None
    kinds = [] if is_driven else _kinds(problem, bases[0].flat, absent)
    significant = float(scipy.stats.chi2.isf(PREFERENCE_LEVEL / max(len(kinds), 1), 1))
    found = problem.evaluate(bases[0].flat)
    if goodness(problem, found)["smooth_p_value"] < SIGNIFICANCE / 2:
        # Such a curve prefers whatever has less noise.
        significant = np.inf
    profiles = {
        kind: [_profile(problem, kind, base, base.flat) for base in bases] for kind in kinds
    }
    first = _preferred_element(profiles, bases[0].value - significant)
    pairs = {} if first is None else _pairs(problem, first, profiles[first], bases[0], absent)
    all_profiles = profiles | pairs
    trials = [t for kind in all_profiles if kind.keeps_A for t in _trials(all_profiles[kind])]
    best = min([*bases, *trials], key=lambda trial: trial.value)
    summary = _Summary(problem, bases[0], best, significant, noise)
    law = summary.build(None, [[base] for base in bases])
    singles = {kind: summary.build(kind, found, law) for kind, found in profiles.items()}
    alternatives = [*singles.values()]
    if first is not None:
        alternatives += [summary.build(pair, x, singles[first]) for pair, x in pairs.items()]
    best_first = sorted(alternatives, key=lambda alternative: -alternative.improvement)
    return Explanations(law, tuple(best_first))


def _trials(profiles: list[list[Trial]]) -> list[Trial]:
    return [trial for profile in profiles for trial in profile]


def _preferred_element(profiles: dict[Kind, list[list[Trial]]], limit: float) -> Kind | None:
    """Return the alternative of least -2 ln L, if it adds an element and is below a limit."""
    known = [kind for kind in profiles if kind.keeps_A]
    if not known:
        return None

    def least(kind: Kind) -> float:
        return min(trial.value for trial in _trials(profiles[kind]))

    first = min(known, key=least)
    is_element = first.parameters[0] in SCENE_PARAMETERS
    return first if is_element and least(first) < limit else None


def _pairs(
    problem: Problem,
    first: Kind,
    profiles: list[list[Trial]],
    law: Trial,
    absent: tuple[str, ...],
) -> dict[Kind, list[list[Trial]]]:
    """Return profiles of second effects beside an element, whose amplitude is an unknown.

    Args:
        problem, absent: see `compare_alternatives`.
        first: the element.
        profiles: of the element alone.
        law: the fit without it.
    """
    at_best = min(_trials(profiles), key=lambda trial: trial.value)
    problem, base, origin = _with_free_amplitude(problem, first, at_best, law)
    if base is None:
        return {}
    found = {}
    for second in _kinds(problem, base.flat, absent):
        if second.keeps_A:
            pair = second._replace(
                name=f"{first.name}, and {second.name}",
                parameters=(*first.parameters, *second.parameters),
            )
            found[pair] = [_profile(problem, second, base, origin)]
    return found


def _with_free_amplitude(
    problem: Problem, kind: Kind, at_best: Trial, law: Trial
) -> tuple[Problem, Trial | None, np.ndarray]:
    """Return the problem with an element whose amplitude is an unknown, its fit, and its origin."""
    name = kind.parameters[0]
    # A law of impacts is that of drop tests, too; other elements belong to each curve.
    owners = problem.measurements if kind.changes_law else problem.curves
    values = {m.label: dict(kind.values(at_best.amplitude, m.label)) for m in owners}
    first = {m.label: values[m.label].pop(name) for m in owners}
    domain = domain_of(problem.curves[0].gas, name)
    labels = [None] if kind.changes_law else [m.label for m in problem.curves]
    unknowns = [Unknown(name, label, (), domain) for label in labels]
    start = [domain.to_free(x) for x in first.values()][: len(labels)]
    changed = _with_rate_error(problem, kind.rate_error(at_best.amplitude))
    both = replace(changed, unknowns=(*problem.unknowns, *unknowns), fixed=values)
    origin = np.append(law.flat, start)
    return both, _trial(both, 0.0, np.append(at_best.flat, start), origin), origin


def _with_rate_error(problem: Problem, error: float) -> Problem:
    """Return a problem with a larger error of the cooling rate of its model."""

    def widened(m: Any) -> Any:
        if not isinstance(m, CurveRows):
            return m
        times, known = m.rate_error
        return replace(m, rate_error=(times, known + error))

    return replace(problem, measurements=tuple(widened(m) for m in problem.measurements))


class _Summary(NamedTuple):
    """What the trials of each alternative are compared with: see `compare_alternatives`."""

    problem: Problem
    base: Trial
    best: Trial
    significant: float
    noise: Float[np.ndarray, "p"]

    def build(
        self, kind: Kind | None, profiles: list[list[Trial]], beside: Alternative | None = None
    ) -> Alternative:
        """Return an alternative from its trials, interpolated between the amplitudes.

        Args:
            kind: of the alternative; None for the law itself.
            profiles: the trials, from each minimum.
            beside: what it is added to: the law, or an element; None for the law itself.
        """
        size = self.problem.num_free
        rows = []
        for trials in profiles:
            values = np.array(
                [
                    [t.value, t.amplitude, *t.flat[:size], *np.hypot(t.error, self.noise)]
                    for t in trials
                ]
            )
            fine = np.linspace(0, len(trials) - 1, 40 * (len(trials) - 1) + 1)
            known = np.arange(len(trials))
            rows.append(np.stack([np.interp(fine, known, column) for column in values.T], axis=1))
        # The law without an alternative is not a trial of one that has no amplitudes in between.
        ends = [trials if kind is None or kind.keeps_A else trials[1:] for trials in profiles]
        best = min((t for trials in ends for t in trials), key=lambda t: t.value, default=self.base)
        values = np.concatenate(rows)
        limit = best.value + ALLOWED
        if kind is not None:
            limit = max(limit, self.best.value + ALLOWED_OVER_ALL)
        inside = values[values[:, 0] <= limit]
        # At each amplitude -2 ln L is a parabola in the parameters. Where one of them matters so
        # little that its logarithm has a large error, it is a parabola in its value instead: the
        # factor exp(h), for small h, becomes 1 + 2 h, which is more than 1 + h.
        half = np.sqrt(limit - inside[:, :1]) * inside[:, 2 + size :]
        of_positive = np.log1p(half + np.minimum(half**2 / 2, half))
        upwards = np.where(self._is_logarithm, of_positive, half)
        middle = inside[:, 2 : 2 + size]
        low = self._in_si(np.min(middle - half, axis=0), best)
        high = self._in_si(np.max(middle + upwards, axis=0), best)
        estimate = self.problem.estimates(best.flat)
        wider = 0.0
        if beside is not None:
            beyond = max(beside.low[0] - low[0], high[0] - beside.high[0])
            wider = beyond / abs(beside.estimate[0])
        parameter = "" if kind is None else kind.parameters[0]
        improvement = self.base.value - best.value
        gained = improvement if beside is None else improvement - beside.improvement
        restitution = None
        if kind is not None and beside is not None and not kind.keeps_A:
            wider = 0.0
            low = beside.low
            high = beside.high
            restitution = constant_restitution(self.problem, best)
        return Alternative(
            name="" if kind is None else kind.name,
            effect=next((name for name, x in DECLARABLE.items() if x[0] == parameter), ""),
            amplitude=best.amplitude,
            allowed=(float(np.min(inside[:, 1])), float(np.max(inside[:, 1]))),
            improvement=float(improvement),
            estimate=estimate,
            low=low,
            high=high,
            preferred=bool(gained > self.significant),
            distinguishable=bool(wider < DISTINGUISHABLE_SHARE),
            error_reduction_needed=float(max(wider / DISTINGUISHABLE_SHARE, 1.0)),
            restitution=restitution,
        )

    @property
    def _is_logarithm(self) -> np.ndarray:
        """Whether the unconstrained scale of a free parameter is a logarithm."""
        size = self.problem.num_free
        unknowns = self.problem.unknowns
        domains = [u.domain for u in unknowns]
        is_positive = [np.isfinite(x.low) and not np.isfinite(x.high) for x in domains]
        return np.repeat(is_positive, [u.size for u in unknowns])[:size]

    def _in_si(self, free: np.ndarray, best: Trial) -> np.ndarray:
        with np.errstate(over="ignore"):
            return self.problem.estimates(np.append(free, best.flat[free.size :]))


def _minima(problem: Problem, minima: list[Minimum]) -> list[Trial]:
    """Return the minima that the data allow as trials, the deepest one first."""
    trials = [_trial(problem, 0.0, minimum.flat, minimum.flat) for minimum in minima]
    found = sorted((t for t in trials if t is not None), key=lambda trial: trial.value)
    different: list[Trial] = []
    for trial in found:
        size = problem.num_free
        known = any(np.allclose(trial.flat[:size], x.flat[:size], atol=1e-2) for x in different)
        if not known and trial.value <= found[0].value + ALLOWED:
            different.append(trial)
    return different


def _kinds(problem: Problem, flat: np.ndarray, absent: tuple[str, ...]) -> list[Kind]:
    """Return the kinds of alternatives to a fit."""
    if not problem.curves:
        return []
    scenes = {m.label: m.scene for m in problem.curves}
    values = problem.values(flat)
    curves = problem.evaluate(flat).curves
    rates = {m.label: _initial_rate(m, values[m.label], curves[m.label]) for m in problem.curves}
    lowest = {
        m.label: float(np.min(curves[m.label]["temperature"][m.used[:, 0] > 0]))
        for m in problem.curves
    }

    def walls(share: float, label: str) -> dict[str, float]:
        side = side_of_walls(scenes[label], share * rates[label])
        return {"wall_side": side, "wall_coefficient": WALL_RESTITUTION}

    beta_t = "tangential_restitution"
    possible = [
        Kind(
            WALLS_ADDED,
            ("wall_side",),
            (SHARES,),
            walls,
            lambda share: WALL_RATE_ERROR * share,
        ),
        Kind(
            DRAG_ADDED,
            ("drag_rate",),
            (DRAG_SHARES,),
            lambda share, label: {"drag_rate": share * rates[label] / 2},
        ),
        Kind(
            "a noise floor in T", (FLOOR,), (SHARES,), lambda x, label: {FLOOR: x * lowest[label]}
        ),
        Kind("independent errors of T", (WHITE,), (WHITE_ERRORS,), lambda x, label: {WHITE: x}),
        Kind(
            ROUGHNESS_ADDED,
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
    if all(beta_t in gas.domains for gas in scenes.values()):
        sliding = Kind(
            "grains that slide",
            ("friction",),
            (SLIDING,),
            lambda x, label: {"friction": 1 / x},
            changes_law=True,
        )
        possible.append(sliding)
    known = {u.name for u in problem.unknowns}
    if all("exponent" in m.gas.domains for m in problem.curves):
        spread = Kind(
            "eps that scatters from impact to impact",
            ("spread",),
            (SPREADS,),
            lambda x, label: {"spread": x},
            changes_law=True,
        )
        constant = Kind(
            "a constant coefficient of restitution",
            ("exponent",),
            ((1.0,),),
            lambda x, label: {"exponent": VISCOELASTIC_EXPONENT * (1 - x)},
            changes_law=True,
            keeps_A=False,
        )
        possible.append(spread)
        if "dissipative_constant" in known:
            possible.append(constant)
    if not known & {START_TIME, "temperature"}:
        delay = Kind(
            "an error of the start time or of T_0",
            (START_TIME,),
            (DELAYS, tuple(-x for x in DELAYS)),
            lambda share, label: {START_TIME: -share / rates[label]},
        )
        possible.append(delay)
    if all(np.any(m.errors[:, 0] > 0) for m in problem.curves):
        known.add(WHITE)
    known |= {DECLARABLE[name][0] for name in absent}
    known |= {name for gas in scenes.values() for name in gas.domains}
    supported = {FLOOR, WHITE, START_TIME}.union(*(m.gas.domains for m in problem.curves))
    for m in problem.curves:  # spheres of unequal sizes have neither walls nor roughness
        supported &= {FLOOR, WHITE, START_TIME, *m.gas.domains}
    return [
        kind
        for kind in possible
        if known.isdisjoint(kind.parameters) and supported.issuperset(kind.parameters)
    ]


def side_of_walls(gas: Gas, rate: float) -> float:
    """Return the side of a box whose walls, of restitution `WALL_RESTITUTION`, cool a gas.

    Args:
        gas: the gas.
        rate: cooling rate by the walls at the start, 1/s.
    """
    flux = 2 * np.sqrt(float(gas.temperature) / (2 * np.pi))
    side = 2 * (1 - WALL_RESTITUTION**2) * flux / max(rate, 1e-300) + float(gas.diameter)
    return max(side, MIN_WALL_SIDE * float(gas.diameter))


def _initial_rate(m: CurveRows, values: dict[str, Any], curve: dict[str, Any]) -> float:
    """Return the cooling rate at the start of a fitted curve, from the time in which T halves."""
    T_0 = float(values.get("temperature", m.scene.temperature))
    times = np.asarray(m.curve.times) - float(values.get(START_TIME, 0.0))
    log_T = np.log(curve["temperature"] / T_0)
    fallen = np.flatnonzero((log_T < -np.log(2)) & (times > 0))
    at = fallen[0] if fallen.size else -1
    cooled = np.expm1(-0.6 * min(log_T[at], -1e-6))  # 1 + t/tau = T^(-3/5)
    return float(5 / 3 * cooled / max(times[at], 1e-300))


def constant_restitution(problem: Problem, trial: Trial) -> float:
    """Return eps of a trial in which it is constant."""
    m = problem.curves[0]
    values = problem.values(trial.flat)[m.label]
    known = {name: x for name, x in values.items() if name in m.gas.domains}
    gas = with_parameters(m.gas, as_floats(known | {"exponent": 0.0}))
    return float(gas.restitution(VARIANT_SPEED))


def _trial(
    problem: Problem, amplitude: float, first: np.ndarray, origin: np.ndarray
) -> Trial | None:
    """Fit the unknowns of a problem, not farther than `farthest` from an origin.

    Returns None if it cannot be computed.
    """
    end = minimise(problem, first, MAX_STEPS, TRIAL_STEP, origin)
    if not np.isfinite(end.value):
        return None
    found = problem.evaluate(end.flat)
    error = np.sqrt(np.diag(inverse(found.information))[: problem.num_free])
    step, length = newton_step(found)
    if length >= TRIAL_STEP:  # the search was cut short
        return Trial(amplitude, found.value, end.flat, error)
    # A longer step leaves the region in which -2 ln L is a parabola.
    share = min(1.0, MAX_STEP / max(float(np.max(np.abs(step))), MAX_STEP))
    fall = (2 * share - share**2) * length**2
    limits = farthest(problem)
    flat = origin + np.clip(end.flat + share * step - origin, -limits, limits)
    return Trial(amplitude, found.value - fall, flat, error)


def _profile(problem: Problem, kind: Kind, base: Trial, origin: np.ndarray) -> list[Trial]:
    """Return fits with increasing amplitudes, from 0, of an alternative.

    Args:
        problem, kind: see `compare_alternatives`.
        base: the fit without the alternative.
        origin: of all searches: the fitted law. A search that began at the end of the one before
            would go on to values of A that change nothing.
    """

    def fit_with(amplitude: float, first: np.ndarray) -> Trial | None:
        fixed = {
            m.label: problem.fixed.get(m.label, {}) | kind.values(amplitude, m.label)
            for m in problem.measurements
            if kind.changes_law or isinstance(m, CurveRows)
        }
        changed = _with_rate_error(problem, kind.rate_error(amplitude))
        return _trial(replace(changed, fixed=fixed), amplitude, first, origin)

    if not kind.keeps_A:
        trial = fit_with(kind.amplitudes[0][0], base.flat)
        return [base] if trial is None else [base, trial]
    trials = [base]
    lowest = base.value
    for sequence in kind.amplitudes:
        before = base
        previous = None
        for amplitude in sequence:
            first = before.flat
            if previous is not None:
                slope = (before.flat - previous.flat) / (before.amplitude - previous.amplitude)
                first = before.flat + np.clip(slope * (amplitude - before.amplitude), -1.0, 1.0)
            trial = fit_with(amplitude, first)
            if trial is None:
                break
            trials.append(trial)
            lowest = min(lowest, trial.value)
            if trial.value > lowest + ALLOWED_OVER_ALL:
                trials += _at_the_limit(fit_with, before, trial, lowest)
            previous = before
            before = trial
            excluded = EXCLUDED * (1.0 if kind.one_minimum else BARRIER)
            if trial.value > lowest + excluded:
                break
    for _ in range(NUM_REFINED):
        trials.sort(key=lambda trial: trial.amplitude)
        threes = [trials[k - 1 : k + 2] for k in range(1, len(trials) - 1)]
        lowest_of_three = [x for x in threes if x[1].value < min(x[0].value, x[2].value)]
        found = [_at_the_vertex(fit_with, three) for three in lowest_of_three]
        trials += [trial for trial in found if trial is not None]
    return sorted(trials, key=lambda trial: trial.amplitude)


def _at_the_vertex(
    fit_with: Callable[[float, np.ndarray], Trial | None], three: list[Trial]
) -> Trial | None:
    """Return the fit at the vertex of the parabola through a minimum of -2 ln L, or on its side."""
    x = np.array([trial.amplitude for trial in three])
    value = np.array([trial.value for trial in three])
    curvature, slope, _ = np.polyfit(x - x[1], value, 2)
    drop = max(np.min(np.delete(value, 1)) - value[1], slope**2 / (4 * curvature))
    if drop < MIN_DROP * ALLOWED:
        return None
    vertex = x[1] - slope / (2 * curvature)
    if np.min(np.abs(vertex - x)) <= MIN_SPACING * (x[2] - x[0]):
        vertex = (x[1] + (x[2] if vertex > x[1] else x[0])) / 2
    return fit_with(vertex, three[1].flat)


def _at_the_limit(
    fit_with: Callable[[float, np.ndarray], Trial | None],
    low: Trial,
    high: Trial,
    least: float,
) -> list[Trial]:
    """Return fits near the amplitude at which -2 ln L, a parabola, exceeds its least value by
    `ALLOWED_OVER_ALL`.

    The last one comes within a quarter of this increase, if `NUM_REFINED` are enough.
    """
    increase = ALLOWED_OVER_ALL
    trials = []
    while low.value <= least + increase < high.value and len(trials) < NUM_REFINED:
        at_low = np.sqrt(low.value - least)
        at_high = np.sqrt(high.value - least)
        share = float(np.clip((np.sqrt(increase) - at_low) / (at_high - at_low), 0.05, 0.95))
        amplitude = low.amplitude + share * (high.amplitude - low.amplitude)
        trial = fit_with(amplitude, low.flat + share * (high.flat - low.flat))
        if trial is None:
            break
        trials.append(trial)
        least = min(least, trial.value)
        if abs(trial.value - least - increase) < increase / 4:
            break
        low, high = (trial, high) if trial.value <= least + increase else (low, trial)
    return trials
