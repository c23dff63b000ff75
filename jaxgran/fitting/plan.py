"""The plan of an experiment: the range of a parameter to expect, and which addition narrows it."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from jaxgran.data.curve import WITH_ERRORS, CoolingCurve
from jaxgran.data.measurement import Measurement
from jaxgran.fitting import report
from jaxgran.fitting.candidates import (
    Candidate,
    Change,
    Planned,
    combined,
    standard_candidates,
    with_curve,
)
from jaxgran.fitting.fit import HOW_TO_MEASURE, fit
from jaxgran.fitting.measured_rows import with_errors_that_count
from jaxgran.fitting.parameters import magnitude_of
from jaxgran.fitting.result import Fit
from jaxgran.fitting.setup import with_values_of
from jaxgran.fitting.threads import quiet_threads
from jaxgran.fitting.twins import AS_GIVEN, Truth, truths_of, twin
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameters import MATERIAL, PARAMETERS, SCENE, symbol_of, unit_of

NUM_BEST = 3
"""Number of additions that are compared for all truths, and in pairs."""

MIN_TIMES = 2
"""Smallest number of times after 0 of a planned curve."""

OPEN_WIDTH = 100.0
"""Width of a range, over the parameter, above which it has no upper end."""

DATA = "the measurement"
"""Name of what is planned in messages."""

AS_IT_IS = Candidate("as it is", price="", change=lambda measurement: measurement, kind="")
"""The experiment without an addition."""


class Expected(NamedTuple):
    """The 95 % range to expect of the first free parameter.

    Attributes:
        name: of the addition.
        price: what it takes, in words.
        low, high: ends of the range for the given values, SI.
        width: (high - low) over the true value, for the given values; at most 100, where the range
            has no upper end.
        median, smallest, largest: this width among the truths; all are `width` where the given
            values alone were compared.
        gain: width without the addition over that with it, the median over the truths.

    >>> planned = jaxgran.plan(measurement, candidates={"as it is": measurement})
    >>> planned.additions[0].name, round(planned.additions[0].gain, 2)
    ('as it is', 1.0)
    """

    name: str
    price: str
    low: float
    high: float
    width: float
    median: float
    smallest: float
    largest: float
    gain: float = 1.0


@dataclass(frozen=True, eq=False)
class Plan:
    """Ranges to expect of an experiment, as it is and with additions.

    Attributes:
        parameter: name of the first free parameter.
        truth: its value, SI, fitted to the given values.
        present: the range to expect of the experiment as it is.
        additions: those with an addition, the largest gain first: the best three, of different
            kinds, and then the others, which were compared for the given values alone.
        pair: that with the best two of the best three additions; None if no two go together.
        truths: gases over which medians are taken, in words.
        measurement: the experiment, with the values of kinetic theory.

    >>> planned = jaxgran.plan(measurement, candidates={"half": lambda m: m})
    >>> planned.parameter, f"{planned.truth:.2g}"
    ('dissipative_constant', '3e-06')
    """

    parameter: str
    truth: float
    present: Expected
    additions: tuple[Expected, ...]
    pair: Expected | None
    truths: tuple[str, ...]
    measurement: Measurement

    @property
    def headline(self) -> str:
        """The range to expect, and the best addition, in a sentence."""
        expected = _range_in_words(self.present, self.unit)
        text = f"{symbol_of(self.parameter)} is expected {expected} (95 %)"
        if self.additions and self.additions[0].gain > 1:
            best = self.additions[0]
            text += f"; with {best.name} {_range_in_words(best, self.unit)}"
        return text

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return unit_of(self.parameter)

    @property
    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """Head and rows of the table of the ranges, the best addition first."""
        rows = [self.present, *self.additions]
        if self.pair is not None:
            rows.append(self.pair)
        symbol = f"{symbol_of(self.parameter)} {self.unit}".strip()
        head = ("", symbol, "width", "of the truths", "gain", "price")
        cells = [
            (x.name, _ends(x), _percent(x.width), _spread(x), f"{x.gain:.2f}", x.price)
            for x in rows
        ]
        return head, cells

    @property
    def notes(self) -> tuple[str, ...]:
        """What the columns of the table mean."""
        return (
            "width: of the 95 % range, in per cent of the true value, for the given values; then "
            f"median (and ends) for {len(self.truths)} truths: {', '.join(self.truths)}.",
            "gain: the width as it is over that with the addition.",
        )

    def __repr__(self) -> str:
        """Table of the ranges."""
        head, rows = self.table
        length = max(len(price) for *_, price in rows)
        aligned = [(*numbers, price.ljust(length)) for *numbers, price in (head, *rows)]
        lines = report.table(aligned[0], aligned[1:])
        return "\n".join([f"{self.headline}.", "", *lines, "", *self.notes])


def plan(
    measurement: Measurement,
    *,
    candidates: dict[str, Planned | Change] | None = None,
    free: tuple[str, ...] | str | None = None,
) -> Plan:
    """Compute which range of A an experiment will give, and what would narrow it.

    A noise-free curve, T(t) by kinetic theory at the times of the measurement with its errors, is
    fitted as `jaxgran.fit` fits a measured one: the range over all alternatives is that to expect.
    ``experiments/fit/plan.py`` compares it with the median width of simulated experiments, which
    have noise. The same is done with each candidate, an addition to the experiment. The width of a
    range is ``(high - low)/|true value|``. A plan at a wrong truth misleads: for the experiment as
    it is and the best three candidates the width is found for up to five truths, too, in which A is
    smaller and larger, what has a prior departs from it, and the gas contains an effect that the
    fit does not know.

    Args:
        measurement: a curve with its errors, N and priors. With a curve by `jaxgran.cool`, which
            has a status, the plan starts at its gas, with a measured one at its fit. Times,
            relative errors (below 1), N, replicas, priors and declared absences stay.
        candidates: additions by name, in place of the standard ones: each is a measurement, several
            by label, or a function that takes the planned measurement and returns such. All but
            the measured values counts.
        free: free parameters, see `jaxgran.fit`. The plan gives the range of the first one.

    Returns:
        `Plan`. `print` shows a table, `jaxgran.plot_plan` a picture.

    Raises:
        ValueError: for a measurement without a curve, N, or two points, errors from 100 % on, and
            for a candidate that cannot be fitted, which is named.
        RuntimeError: if the fit of the given values fails.

    >>> def longer(m):
    ...     times = 3 * m.curve.times
    ...     return dataclasses.replace(m, data=dataclasses.replace(m.curve, times=times))
    >>> planned = jaxgran.plan(measurement, candidates={"three times as long": longer})
    >>> planned.additions[0].gain > 1.1
    True
    """
    _check(measurement)
    measurement = with_errors_that_count(measurement)
    listed = None if candidates is None else _candidates_of_user(candidates)
    is_planned = measurement.curve.status is not None
    with quiet_threads():
        base = twin(measurement) if is_planned else _at_its_fit(measurement, free)
        central = _fit(DATA, base, free=free)
    parameter = central.names[0]
    if parameter not in base.gas.domains:
        raise ValueError(f"a plan needs a parameter of the gas first in free, got {central.names}")
    truths = truths_of(base, central)
    ranges = {AS_GIVEN.name: _range_over_truth(central, parameter, base.gas)}
    present = _Experiment(AS_IT_IS, {"": base}, central.names, ranges)
    listed = standard_candidates(base) if listed is None else listed
    experiments = _with_additions(present, listed)
    best = _best_of_each_kind(experiments)
    _add_ranges([present, *best], truths)
    pairs = _with_additions(present, _pairs(best))
    # Those that were compared for all truths come first.
    experiments.sort(key=lambda x: (len(x.ranges) == 1, -x.gain_over(present)))
    return Plan(
        parameter=parameter,
        truth=_number(base.gas, parameter),
        present=present.expected(present),
        additions=tuple(x.expected(present) for x in experiments),
        pair=pairs[0].expected(present) if pairs else None,
        truths=tuple(truth.name for truth in truths),
        measurement=base,
    )


def _check(measurement: Any) -> None:
    """Raise ValueError unless a measurement makes an experiment."""
    if not isinstance(measurement, Measurement):
        raise ValueError(
            f"expected a jaxgran.Measurement, got a {type(measurement).__name__}. {HOW_TO_MEASURE}"
        )
    if not isinstance(measurement.data, CoolingCurve):
        raise ValueError("a plan begins with a cooling curve, got a drop test")
    if measurement.num_particles is None:
        raise ValueError("a plan needs N, the number of grains: give num_particles (key N)")
    times = np.asarray(measurement.curve.times)
    if np.sum(times > 0) < MIN_TIMES:
        raise ValueError(
            f"a plan needs {MIN_TIMES} or more times after t = 0, got {np.sum(times > 0)}"
        )
    error = measurement.curve.temperature_error
    if error is not None and np.all(np.asarray(error) >= np.asarray(measurement.curve.temperature)):
        raise ValueError(
            "the errors of T are 100 % or more of T at all times: a plan needs smaller ones, as "
            "0.02 T"
        )


def _candidates_of_user(given: Any) -> list[Candidate]:
    """Return the candidates of a user, or raise ValueError."""
    is_dictionary = isinstance(given, dict) and bool(given)
    if not is_dictionary or not all(
        callable(x) or isinstance(x, Measurement | dict) for x in given.values()
    ):
        raise ValueError(
            "candidates must be a dictionary of measurements or functions by name, as "
            f"{{'twice as long': longer}}, got {given!r:.60}"
        )
    return [_candidate_of_user(str(name), planned) for name, planned in given.items()]


def _candidate_of_user(name: str, planned: Any) -> Candidate:
    kind = f"yours: {name}"
    if isinstance(planned, Measurement | dict):
        return Candidate(name, "", lambda measurement: planned, kind, is_fixed=True)
    return Candidate(name, "", planned, kind)


def _at_its_fit(measurement: Measurement, free: Any) -> Measurement:
    """Return a measurement with the values of its fit.

    Its errors remain, relative to these; those that the fit found are added.
    """
    found = _fit(DATA, measurement, free=free, quick=True)
    fields = {}
    for quantity in WITH_ERRORS:
        measured = getattr(measurement.curve, quantity.field)
        fitted = getattr(found.curve, quantity.field)
        if measured is not None and fitted is not None:
            fields[quantity.field] = np.asarray(fitted)
    if found.errors_of_T:
        fields["temperature_error"] = found.errors_of_T[""] * fields["temperature"]
    base = replace(measurement, gas=found.gas, rounding={}, header=())
    return twin(with_curve(base, **fields))


class _Range(NamedTuple):
    """The 95 % range of a parameter over the magnitude of its true value."""

    low: float
    high: float

    @property
    def width(self) -> float:
        """Its width, `OPEN_WIDTH` at most."""
        return min(self.high - self.low, OPEN_WIDTH)


@dataclass
class _Experiment:
    """An experiment, and the ranges of its first free parameter for some truths.

    Attributes:
        candidate: the addition.
        measurements: by label.
        free: names of the free parameters.
        ranges: by name of the truth.
    """

    candidate: Candidate
    measurements: dict[str, Measurement]
    free: tuple[str, ...]
    ranges: dict[str, _Range] = field(default_factory=dict)

    def add_range(self, truth: Truth) -> None:
        """Compute the range for a truth, unless it is known, or the effect is known to be absent.

        Several curves share the parameters of the material; each has its own ones of the scene.
        """
        measurements = self.measurements
        is_absent = any(truth.effect in m.absent for m in measurements.values())
        if truth.name in self.ranges or is_absent:
            return
        curves = [m for m in measurements.values() if isinstance(m.data, CoolingCurve)]
        separate = ()
        if len(curves) > 1:
            separate = tuple(x for x in self.free if _belongs_to(x) == SCENE)
        shared = tuple(x for x in self.free if x not in separate)
        twins = {label: twin(m, truth) for label, m in measurements.items()}
        planned = twins[""] if [*twins] == [""] else twins
        name = f"candidate {self.candidate.name!r}"
        result = _fit(name, planned, free=shared, separate=separate)
        first = next(iter(measurements.values()))
        self.ranges[truth.name] = _range_over_truth(result, self.free[0], truth.gas(first.gas))

    def gain_over(self, present: "_Experiment") -> float:
        """Return the width without the addition over that with it, the median over truths."""
        gains = [
            present.ranges[truth].width / max(known.width, 1e-300)
            for truth, known in self.ranges.items()
        ]
        return float(np.median(gains))

    def expected(self, present: "_Experiment") -> Expected:
        """Return the range to expect, in SI units, beside the experiment as it is."""
        given = self.ranges[AS_GIVEN.name]
        widths = [known.width for known in self.ranges.values()]
        (base,) = present.measurements.values()
        magnitude = magnitude_of(_number(base.gas, self.free[0]))
        return Expected(
            name=self.candidate.name,
            price=self.candidate.price,
            low=given.low * magnitude,
            high=given.high * magnitude,
            width=given.width,
            median=float(np.median(widths)),
            smallest=min(widths),
            largest=max(widths),
            gain=self.gain_over(present),
        )


def _with_additions(present: _Experiment, candidates: Sequence[Candidate]) -> list[_Experiment]:
    """Return an experiment with each addition that applies, for the given values, the best first.

    A material has the same values in all of them.
    """
    (base,) = present.measurements.values()
    of_material = tuple(
        name for name in (*present.free, *base.priors) if _belongs_to(name) in (MATERIAL, None)
    )
    experiments = []
    for candidate in candidates:
        changed = candidate.change(base)
        if changed is None:
            continue
        measurements = {
            label: replace(m, gas=with_values_of(m.gas, base.gas, of_material))
            for label, m in _by_label(candidate, changed).items()
        }
        experiments.append(_Experiment(candidate, measurements, present.free))
    _add_ranges(experiments, [AS_GIVEN])
    return sorted(experiments, key=lambda x: -x.gain_over(present))


def _add_ranges(experiments: list[_Experiment], truths: list[Truth]) -> None:
    """Compute the range of each experiment for each truth."""
    with quiet_threads() as threads:
        tasks = [
            threads.submit(experiment.add_range, truth)
            for experiment in experiments
            for truth in truths
        ]
        for task in tasks:
            task.result()


def _by_label(candidate: Candidate, changed: Any) -> dict[str, Measurement]:
    """Return what a candidate gave by label, or raise ValueError."""
    if isinstance(changed, Measurement):
        return {"": changed}
    if not isinstance(changed, dict):
        raise ValueError(
            f"candidate {candidate.name!r} must give a jaxgran.Measurement, several by label "
            f"or None, got a {type(changed).__name__}"
        )
    return changed


def _best_of_each_kind(experiments: list[_Experiment]) -> list[_Experiment]:
    """Return the best experiments, with additions of different kinds."""
    best: dict[str, _Experiment] = {}
    for experiment in experiments:
        best.setdefault(experiment.candidate.kind, experiment)
    return list(best.values())[:NUM_BEST]


def _pairs(experiments: list[_Experiment]) -> list[Candidate]:
    """Return the combinations of two of their additions."""
    parts = [x.candidate for x in experiments if not x.candidate.is_fixed]
    return [
        Candidate(f"{a.name} + {b.name}", "both", partial(combined, a.change, b.change), "pair")
        for a, b in combinations(parts, 2)
    ]


def _belongs_to(name: str) -> str | None:
    """Return what a parameter is of, as `MATERIAL`; None for one that is not of a gas."""
    return PARAMETERS[name].belongs_to if name in PARAMETERS else None


def _fit(name: str, measurement: Planned, **options: Any) -> Fit:
    """Fit measurements; errors begin with their name."""
    try:
        return fit(measurement, **options)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None
    except RuntimeError as error:
        raise RuntimeError(f"{name}: {error}") from None


def _range_over_truth(result: Fit, name: str, truth: Gas) -> _Range:
    """Return the range of a parameter over its magnitude; 0 to inf if there is none.

    If each of several curves has the parameter for itself, the first curve counts.
    """
    for title, (low, high) in result.ranges.items():
        if title.rpartition(": ")[2] == name:
            magnitude = magnitude_of(_number(truth, name))
            return _Range(
                low=float(np.ravel(low)[0]) / magnitude,
                high=float(np.ravel(high)[0]) / magnitude,
            )
    return _Range(0.0, float("inf"))


def _number(gas: Gas, name: str) -> float:
    """Return the value of a parameter, of a vector its first element."""
    return float(np.ravel(gas.value(name))[0])


def _range_in_words(x: Expected, unit: str) -> str:
    """Say between which ends the parameter is expected."""
    if not x.width < OPEN_WIDTH:
        return f"above {x.low:.3g} {unit}".strip()
    return f"between {x.low:.3g} and {x.high:.3g} {unit}".strip()


def _ends(x: Expected) -> str:
    """Return the range in a cell of a table."""
    high = f"{x.high:.3g}" if x.width < OPEN_WIDTH else "no end"
    return f"{x.low:.3g} .. {high}"


def _spread(x: Expected) -> str:
    """Return the widths of the truths in a cell; "" where the given values alone were compared."""
    if x.smallest == x.largest:
        return ""
    return f"{_percent(x.median)} ({_percent(x.smallest)} to {_percent(x.largest)})"


def _percent(x: float) -> str:
    if not x < OPEN_WIDTH:
        return "open"
    return f"{100 * x:.2g}" if x < 1 else f"{100 * x:.0f}"
