"""Alternative explanations of a measured curve, and the range of the parameters over them.

Each alternative adds one element to the scene, or one error to the measurement, of kinetic theory:
walls, drag, roughness, a noise floor, independent errors, a wrong start of the clock. Its amplitude
is varied from 0 until it explains almost the whole curve or the data exclude it, and all unknowns
are fitted again for each amplitude, with the scatter that N grains have in that scene. -2 ln L as a
function of the amplitude shows whether the data prefer the alternative, or exclude it; otherwise
the parameters are only as certain as the amplitude.

Where the data prefer an element, the same is done with a second effect beside it: the range then
allows for one effect more than the data show. Where they show independent errors of T, these stay
beside all other effects: otherwise no smooth effect could be as good.
"""

from collections.abc import Collection
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxgran.fitting.goodness import SIGNIFICANCE, goodness
from jaxgran.fitting.kinds import Kind, kinds_of
from jaxgran.fitting.parameters import SHARED, magnitude_of, with_values
from jaxgran.fitting.problem import Problem, build_unknown
from jaxgran.fitting.profiles import ALLOWED, ALLOWED_OVER_ALL, Trial, profile_of, trial_of
from jaxgran.fitting.rows import WHITE
from jaxgran.fitting.search import Minimum
from jaxgran.scene.laws import VARIANT_SPEED

PREFERENCE_LEVEL = 0.01
"""Probability by chance of any alternative being preferred."""

DISTINGUISHABLE_SHARE = 0.1
"""Relative change of an estimate below which an allowed alternative is negligible."""

AND = ", and "
"""Between the names of effects that are added together."""

THEORY_TOLERANCE = 1e3
"""Factor of the tolerance of kinetic theory: its default of 1e-8 in T is far below what data show,
and with 1e-5 each of many trials takes fewer steps in time."""

NUM_BETWEEN = 40
"""Number of steps of the interpolation from one tried amplitude to the next."""


class Alternative(NamedTuple):
    """Alternative to a fitted law.

    Attributes:
        name: description of the added element or error.
        effects: names in ``absent`` of `jaxgran.Measurement` of the elements that it adds; () for
            an error of the measurement. Each of these absences excludes the alternative.
        amplitude: the best amplitude: the share of the initial cooling rate (walls, drag) or of
            the lowest computed T (floor), 1 + beta_t, 1/mu or mu (sliding), the relative error,
            the standard deviation of eps, or the delay of the clock over the cooling time. Of
            several effects together it is the amplitude of the last one.
        allowed: the smallest and the largest amplitude that the data allow.
        improvement: decrease of -2 ln L from the fitted law to the best amplitude.
        estimate: estimate of the free parameters at the best amplitude, SI.
        low, high: range of each free parameter over the allowed amplitudes, SI, 95 %.
        preferred: True if the data prefer this alternative to the fitted law, or several effects
            together to those without the last one; by chance they prefer any of the alternatives in
            1 % of fits.
        distinguishable: True if the data exclude the alternative, or allow so little of it that it
            widens the range of the first parameter by less than 10 %.
        error_reduction_needed: factor by which the errors must decrease for that; 1 if it is
            distinguishable, or has no A.
        restitution: eps of an alternative in which it is constant, so that A has no meaning; None
            for all others. It is not part of the range.

    >>> best = result.alternatives[0]
    >>> best.improvement < 0.01 and not best.preferred  # the curve has no noise
    True
    """

    name: str
    effects: tuple[str, ...]
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

    @property
    def effect(self) -> str:
        """The first one of `effects`; "" if there is none."""
        return self.effects[0] if self.effects else ""

    @property
    def num_parts(self) -> int:
        """Number of elements and errors that it adds."""
        return len(self.name.split(AND))


class Explanations(NamedTuple):
    """A fitted law and its alternatives.

    Attributes:
        law: the fitted law itself.
        alternatives: to it, those that fit best first.
        significant: decrease of -2 ln L from which an explanation excludes others; infinite for a
            curve that is smoother than N grains allow, of which all explanations remain.
        not_computed: names of alternatives of which no amplitude could be computed.
    """

    law: Alternative
    alternatives: tuple[Alternative, ...]
    significant: float
    not_computed: tuple[str, ...] = ()

    def ranges(self, absent: Collection[str] = ()) -> tuple[np.ndarray, np.ndarray]:
        """Return the 95 % range of the free parameters over all explanations.

        One that fits significantly worse than the best one is excluded.

        Args:
            absent: effects whose alternatives are left out.
        """
        others = [
            x for x in self.alternatives if x.restitution is None and not {*absent} & {*x.effects}
        ]
        is_law_rejected = any(x.preferred for x in others)
        considered = [self.law, *others]
        best = max(x.improvement for x in considered)
        allowed = [x for x in considered if x.improvement >= best - self.significant]
        if not is_law_rejected:
            allowed.append(self.law)
        low = np.min([x.low for x in allowed], axis=0)
        high = np.max([x.high for x in allowed], axis=0)
        return low, high


def compare_alternatives(
    problem: Problem, minima: list[Minimum], further_errors: Float[np.ndarray, "p"]
) -> Explanations | None:
    """Compare a fitted law with its alternatives; a driven gas has none.

    Args:
        problem: of a model that supports all alternatives, at the minima of the fit.
        minima: minima of -2 ln L that the data allow.
        further_errors: standard errors of the free parameters that the problem does not contain, in
            their unconstrained scale.

    Returns:
        None if the law cannot be computed.
    """
    problem = replace(problem, tolerance=THEORY_TOLERANCE)
    bases = _fit_minima(problem, minima)
    if not bases:
        return None
    is_driven = any(m.scene.drive is not None for m in problem.curves)
    kinds = [] if is_driven else kinds_of(problem, bases[0].flat)
    significant = _significant_fall(problem, bases[0], len(kinds))
    stages = _fit_stages(problem, bases, kinds, significant)
    trials = [trial for stage in stages for trial in stage.trials_with_A()]
    best = min([*bases, *trials], key=lambda trial: trial.value)
    summary = _Summary(problem, bases[0], best, significant, further_errors)
    law = summary.summarise_law(bases)
    by_kinds: dict[tuple[Kind, ...], Alternative] = {}
    for stage in stages:
        # What a stage shows is one of the alternatives of the stage before.
        beside = by_kinds.get(stage.shown, law)
        for kind, profiles in stage.profiles.items():
            added = (*stage.shown, kind)
            by_kinds[added] = summary.summarise(added, profiles, beside)
    best_first = sorted(by_kinds.values(), key=lambda alternative: -alternative.improvement)
    not_computed = tuple(name for stage in stages for name in stage.not_computed)
    return Explanations(law, tuple(best_first), significant, not_computed)


def _fit_minima(problem: Problem, minima: list[Minimum]) -> list[Trial]:
    """Return the minima that the data allow as trials, the deepest one first."""
    trials = [trial_of(problem, 0.0, minimum.flat, minimum.flat) for minimum in minima]
    found = sorted((t for t in trials if t is not None), key=lambda trial: trial.value)
    size = problem.num_free
    different: list[Trial] = []
    for trial in found:
        known = any(np.allclose(trial.flat[:size], x.flat[:size], atol=1e-2) for x in different)
        if not known and trial.value <= found[0].value + ALLOWED:
            different.append(trial)
    return different


def _significant_fall(problem: Problem, base: Trial, num_kinds: int) -> float:
    """Return the decrease of -2 ln L from which an explanation excludes others."""
    found = problem.evaluate(base.flat)
    if goodness(problem, found).smooth_p_value < SIGNIFICANCE:
        return np.inf  # such a curve prefers whatever has less noise
    return float(scipy.stats.chi2.isf(PREFERENCE_LEVEL / max(num_kinds, 1), 1))


def _fit_stages(
    problem: Problem, bases: list[Trial], kinds: list[Kind], significant: float
) -> list["_Stage"]:
    """Return the alternatives to a law, then those beside each effect that they show."""
    origins = [base.flat for base in bases]
    stages = [_Stage.build(problem, bases, origins, (), kinds)]
    while (effect := stages[-1].find_next_effect(significant)) is not None:
        stage = _fit_beside(stages[-1], effect)
        if stage is None:
            break
        stages.append(stage)
    return stages


class _Stage(NamedTuple):
    """Alternatives beside effects that the data show, whose amplitudes are unknowns.

    Attributes:
        problem: with these effects.
        base: its fit.
        origin: of all searches: the fitted law, with the first guesses of the amplitudes.
        shown: the effects.
        profiles: of each further effect, from each minimum.
        not_computed: names of alternatives of which no amplitude could be computed.
    """

    problem: Problem
    base: Trial
    origin: np.ndarray
    shown: tuple[Kind, ...]
    profiles: dict[Kind, list[list[Trial]]]
    not_computed: tuple[str, ...]

    @classmethod
    def build(
        cls,
        problem: Problem,
        bases: list[Trial],
        origins: list[np.ndarray],
        shown: tuple[Kind, ...],
        kinds: list[Kind],
    ) -> "_Stage":
        """Fit with the amplitudes of all kinds of alternatives.

        Args:
            problem, shown: see the class.
            bases: fits without a further effect, the best one first.
            origins: of the searches from each of them.
            kinds: of further effects.
        """
        profiles: dict[Kind, list[list[Trial]]] = {}
        not_computed = []
        for kind in kinds:
            found = [
                profile_of(problem, kind, base, origin)
                for base, origin in zip(bases, origins, strict=True)
            ]
            # Each profile contains the fit without the alternative, too.
            if any(len(trials) > 1 for trials in found):
                profiles[kind] = found
            else:
                not_computed.append(_name_of((*shown, kind)))
        return cls(problem, bases[0], origins[0], shown, profiles, tuple(not_computed))

    def trials_with_A(self) -> list[Trial]:
        """Return all trials in which A has a meaning."""
        return [t for kind in self.profiles if kind.keeps_A for t in self.trials_of(kind)]

    def trials_of(self, kind: Kind) -> list[Trial]:
        """Return all trials of a kind of alternatives."""
        return [trial for trials in self.profiles[kind] for trial in trials]

    def best_of(self, kind: Kind) -> Trial:
        """Return the best fit with a kind of alternatives."""
        return min(self.trials_of(kind), key=lambda trial: trial.value)

    def find_next_effect(self, significant: float) -> Kind | None:
        """Return a further effect that the data show, None if there is none.

        It is independent errors of T, if these would exclude other effects, or the alternative that
        fits best if it is the first element of the scene to be shown.

        Args:
            significant: decrease of -2 ln L from which an element is shown.
        """
        known = [kind for kind in self.profiles if kind.keeps_A]
        if not known:
            return None
        for kind in known:
            if kind.parameters == (WHITE,) and self._gain(kind) > ALLOWED_OVER_ALL:
                return kind
        first = min(known, key=lambda kind: self.best_of(kind).value)
        shows_element = any(kind.effects for kind in self.shown)
        is_first_element = bool(first.effects) and not shows_element
        return first if is_first_element and self._gain(first) > significant else None

    def _gain(self, kind: Kind) -> float:
        return self.base.value - self.best_of(kind).value


def _fit_beside(stage: _Stage, effect: Kind) -> _Stage | None:
    """Return the alternatives beside one more effect; None if it cannot be fitted.

    Args:
        stage: in which the effect was found.
        effect: that is shown, whose amplitude becomes an unknown.
    """
    problem = stage.problem
    at_best = stage.best_of(effect)
    guesses = {}
    fixed = {}
    for label, values in effect.values_by_label(problem, at_best.amplitude).items():
        guesses[label] = values[effect.varied]
        fixed[label] = {name: x for name, x in values.items() if name != effect.varied}
    gases = {m.label: m.gas for m in problem.curves}
    labels = list(effect.curves)
    unknowns = []
    start = []
    # Drop tests have the law of impacts, too: all measurements share its parameter.
    for label in labels[:1] if effect.changes_law else labels:
        owner = SHARED if effect.changes_law else label
        unknown = build_unknown(effect.varied, owner, gases[label], problem.curves)
        unknowns.append(unknown)
        start.append(unknown.domain.to_free(guesses[label]) / unknown.unit)
    both = replace(
        effect.with_wider_rate_errors(problem, at_best.amplitude),
        unknowns=(*problem.unknowns, *unknowns),
        fixed=problem.extend_fixed(fixed),
    )
    origin = np.append(stage.origin, start)
    base = trial_of(both, 0.0, np.append(at_best.flat, start), origin)
    if base is None:
        return None
    return _Stage.build(both, [base], [origin], (*stage.shown, effect), kinds_of(both, base.flat))


def _name_of(effects: tuple[Kind, ...]) -> str:
    return AND.join(kind.name for kind in effects)


class _Allowed(NamedTuple):
    """Amplitudes that the data allow, and the ranges of the parameters over them.

    Attributes:
        amplitudes: the smallest and the largest one.
        low, high: range of each free parameter, SI.
    """

    amplitudes: tuple[float, float]
    low: Float[np.ndarray, "p"]
    high: Float[np.ndarray, "p"]


class _Summary(NamedTuple):
    """What the trials of each alternative are compared with.

    Attributes:
        problem: of the fit.
        base: the fitted law.
        best: the best of all trials in which A has a meaning.
        significant: decrease of -2 ln L from which an explanation excludes others.
        further_errors: see `compare_alternatives`.
    """

    problem: Problem
    base: Trial
    best: Trial
    significant: float
    further_errors: Float[np.ndarray, "p"]

    def summarise_law(self, bases: list[Trial]) -> Alternative:
        """Return the law itself, from all its minima."""
        allowed = self._find_allowed(
            [[base] for base in bases], self.base.value + ALLOWED, self.base
        )
        return Alternative(
            name="",
            effects=(),
            amplitude=self.base.amplitude,
            allowed=allowed.amplitudes,
            improvement=0.0,
            estimate=self.problem.to_estimates(self.base.flat),
            low=allowed.low,
            high=allowed.high,
            preferred=False,
            distinguishable=True,
            error_reduction_needed=1.0,
        )

    def summarise(
        self, added: tuple[Kind, ...], profiles: list[list[Trial]], beside: Alternative
    ) -> Alternative:
        """Return an alternative from its trials, interpolated between the amplitudes.

        Args:
            added: what the alternative adds; the amplitude of the last one is varied.
            profiles: the trials, from each minimum.
            beside: the same without the last effect.
        """
        varied = added[-1]
        # The first trial of a profile, without the alternative, is not a fit of another law.
        trials = [t for each in profiles for t in (each if varied.keeps_A else each[1:])]
        best = min(trials, key=lambda trial: trial.value)
        is_excluded = best.value > self.best.value + self.significant
        improvement = float(self.base.value - best.value)
        alternative = Alternative(
            name=_name_of(added),
            effects=tuple(dict.fromkeys(effect for kind in added for effect in kind.effects)),
            amplitude=best.amplitude,
            allowed=(best.amplitude, best.amplitude),
            improvement=improvement,
            estimate=self.problem.to_estimates(best.flat),
            low=beside.low,
            high=beside.high,
            preferred=bool(improvement - beside.improvement > self.significant),
            distinguishable=bool(is_excluded),
            error_reduction_needed=1.0,
        )
        if not varied.keeps_A:
            return alternative._replace(restitution=_constant_restitution(self.problem, best))
        limit = max(best.value + ALLOWED, self.best.value + ALLOWED_OVER_ALL)
        allowed = self._find_allowed(profiles, limit, best)
        alternative = alternative._replace(
            allowed=allowed.amplitudes, low=allowed.low, high=allowed.high
        )
        if is_excluded:
            return alternative
        beyond = max(beside.low[0] - allowed.low[0], allowed.high[0] - beside.high[0])
        widening = beyond / magnitude_of(float(beside.estimate[0]))
        return alternative._replace(
            distinguishable=bool(widening < DISTINGUISHABLE_SHARE),
            error_reduction_needed=float(max(widening / DISTINGUISHABLE_SHARE, 1.0)),
        )

    def _find_allowed(self, profiles: list[list[Trial]], limit: float, best: Trial) -> _Allowed:
        """Return what the data allow below a limit of -2 ln L, beside other unknowns of a trial."""
        size = self.problem.num_free
        columns = np.concatenate([self._interpolate(trials) for trials in profiles])
        inside = columns[columns[:, 0] <= limit]
        value, amplitude, middle, error = np.split(inside, [1, 2, 2 + size], axis=1)
        # At each amplitude -2 ln L is a parabola in the parameters. Where one of them matters so
        # little that its logarithm has a large error, it is a parabola in its value instead. The
        # factor exp(h) of such an error is therefore 1 + h + h^2/2, as it is for small h, up to
        # h = 2, and is continued by 1 + 2 h.
        half = np.sqrt(limit - value) * error
        of_positive = np.log1p(half + np.minimum(half**2 / 2, half))
        low = middle - half
        high = middle + np.where(self._is_logarithm, of_positive, half)
        return _Allowed(
            amplitudes=(float(np.min(amplitude)), float(np.max(amplitude))),
            low=self._to_si(np.min(low, axis=0), best),
            high=self._to_si(np.max(high, axis=0), best),
        )

    def _interpolate(self, trials: list[Trial]) -> Float[np.ndarray, "amplitudes columns"]:
        """Return columns of trials, and between them: -2 ln L, the amplitude, the free parameters
        in their unconstrained scale, and their errors."""
        size = self.problem.num_free
        rows = [
            [t.value, t.amplitude, *t.flat[:size], *np.hypot(t.error, self.further_errors)]
            for t in trials
        ]
        known = np.arange(len(trials))
        fine = np.linspace(0, len(trials) - 1, NUM_BETWEEN * (len(trials) - 1) + 1)
        return np.stack([np.interp(fine, known, column) for column in np.array(rows).T], axis=1)

    @property
    def _is_logarithm(self) -> np.ndarray:
        """Whether the unconstrained scale of each free parameter is a logarithm."""
        domains = [u.domain for u in self.problem.unknowns]
        is_positive = [np.isfinite(x.low) and not np.isfinite(x.high) for x in domains]
        return self.problem.repeat_per_element(is_positive)[: self.problem.num_free]

    def _to_si(self, free: np.ndarray, best: Trial) -> np.ndarray:
        with np.errstate(over="ignore"):
            return self.problem.to_estimates(np.append(free, best.flat[free.size :]))


def _constant_restitution(problem: Problem, trial: Trial) -> float:
    """Return eps of a trial in which it is constant."""
    m = problem.curves[0]
    values = problem.unflatten(trial.flat)[m.label]
    known = {name: x for name, x in values.items() if name in m.gas.domains}
    gas = with_values(m.gas, known | {"exponent": 0.0})
    return float(gas.restitution(VARIANT_SPEED))
