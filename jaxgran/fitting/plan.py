"""The plan of an experiment: the range of a parameter to expect, and which addition narrows it."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from jaxgran.data.curve import CoolingCurve
from jaxgran.data.measurement import Measurement
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
from jaxgran.fitting.report import table
from jaxgran.fitting.result import Fit
from jaxgran.fitting.setup import with_values_of
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
        text = f"{symbol_of(self.parameter)} is expected {_range(self.present, self.unit)} (95 %)"
        best = self.additions[:1]
        if best and best[0].gain > 1:
            text += f"; with {best[0].name} {_range(best[0], self.unit)}"
        return text

    @property
    def unit(self) -> str:
        """Unit of the parameter."""
        return unit_of(self.parameter)

    @property
    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """Head and rows of the table of the ranges, the best addition first."""
        rows = [self.present, *self.additions, *([] if self.pair is None else [self.pair])]
        symbol = f"{symbol_of(self.parameter)} {self.unit}".strip()
        cells = [
            (x.name, _ends(x), _percent(x.width), _spread(x), f"{x.gain:.2f}", x.price)
            for x in rows
        ]
        return ("", symbol, "width", "of the truths", "gain", "price"), cells

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
        head, cells = self.table
        long = max(len(row[-1]) for row in cells)
        aligned = [(*row[:-1], row[-1].ljust(long)) for row in (head, *cells)]
        rows = table(aligned[0], aligned[1:])
        return "\n".join([f"{self.headline}.", "", *rows, "", *self.notes])


def plan(
    measurement: Measurement,
    *,
    candidates: dict[str, Planned | Change] | None = None,
    free: tuple[str, ...] | str | None = None,
) -> Plan:
    """Compute which range of A an experiment will give, and what would narrow it.

    A noise-free curve, T(t) by kinetic theory at the times of the measurement with its errors, is
    fitted as `jaxgran.fit` fits a measured one: the range over all alternatives is that to expect.
    The median width of simulated experiments, which have noise, is .9 to 1.3 times the expected one
    (``experiments/fit/plan.py``).
    The same is done with each candidate, an addition to the experiment. The width of a range is
    ``(high - low)/(true value)``. A plan at a wrong truth misleads: for the experiment as it is and
    the best three candidates the width is found for up to five truths, too, in which A is smaller
    and larger, what has a prior departs from it, and the gas contains an effect that the fit does
    not know.

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
    listed = None if candidates is None else _of_user(candidates)
    is_planned = measurement.curve.status is not None
    base = twin(measurement) if is_planned else _at_its_fit(measurement, free)
    central = _fit(DATA, {"": base}, free)
    names = central.names
    if names[0] not in base.gas.domains:
        raise ValueError(f"a plan needs a parameter of the gas first in free, got {names}")
    truths = truths_of(base, central)
    present = _Row(Candidate("as it is", "", _unchanged, ""), {"": base}, names)
    present.ends[AS_GIVEN.name] = _relative(central, names[0], AS_GIVEN, base.gas)
    listed = standard_candidates(base) if listed is None else listed
    rows = _compared(listed, base, present)
    best = _best(rows)
    for row in (present, *best):
        for truth in truths[1:]:
            row.add(truth)
    pairs = _compared(_pairs(best), base, present)
    rows.sort(key=lambda row: (len(row.ends) == 1, -row.gain(present)))
    return Plan(
        parameter=names[0],
        truth=float(np.ravel(base.gas.value(names[0]))[0]),
        present=present.expected(present),
        additions=tuple(row.expected(present) for row in rows),
        pair=pairs[0].expected(present) if pairs else None,
        truths=tuple(truth.name for truth in truths),
        measurement=base,
    )


@dataclass
class _Row:
    """An experiment, and its ranges for some truths.

    Attributes:
        candidate: the addition.
        measurements: the experiment, by label.
        names: of the free parameters.
        ends: low and high ends of the range of the first one over its true value, by truth.
    """

    candidate: Candidate
    measurements: dict[str, Measurement]
    names: tuple[str, ...]
    ends: dict[str, tuple[float, float]] = field(default_factory=dict)

    def add(self, truth: Truth) -> None:
        """Compute the range for a truth, unless its effect is known to be absent."""
        if any(truth.effect in m.absent for m in self.measurements.values()):
            return
        twins = {label: twin(m, truth) for label, m in self.measurements.items()}
        result = _fit(f"candidate {self.candidate.name!r}", twins, self.names)
        gas = next(iter(self.measurements.values())).gas
        self.ends[truth.name] = _relative(result, self.names[0], truth, gas)

    def width(self, truth: str) -> float:
        """Return the width of the range for a truth, over the true value; `OPEN_WIDTH` at most."""
        low, high = self.ends[truth]
        return min(high - low, OPEN_WIDTH)

    def gain(self, present: "_Row") -> float:
        """Return the width without the addition over that with it, the median over truths."""
        pairs = [(present.width(truth), self.width(truth)) for truth in self.ends]
        return float(np.median([a / max(b, 1e-300) for a, b in pairs]))

    def expected(self, present: "_Row") -> Expected:
        """Return the range to expect."""
        low, high = self.ends[AS_GIVEN.name]
        widths = [self.width(truth) for truth in self.ends]
        gas = next(iter(present.measurements.values())).gas
        scale = float(np.ravel(gas.value(self.names[0]))[0])
        return Expected(
            name=self.candidate.name,
            price=self.candidate.price,
            low=low * scale,
            high=high * scale,
            width=self.width(AS_GIVEN.name),
            median=float(np.median(widths)),
            smallest=min(widths),
            largest=max(widths),
            gain=self.gain(present),
        )


def _compared(candidates: Sequence[Candidate], base: Measurement, present: _Row) -> list[_Row]:
    """Return the additions that apply, for the given values, the best one first."""
    rows = []
    for candidate in candidates:
        changed = candidate.change(base)
        if changed is None:
            continue
        changed = {"": changed} if isinstance(changed, Measurement) else changed
        if not isinstance(changed, dict):
            raise ValueError(
                f"candidate {candidate.name!r} must give a jaxgran.Measurement, several by label "
                f"or None, got a {type(changed).__name__}"
            )
        row = _Row(candidate, _of_this_material(changed, base, present.names), present.names)
        row.add(AS_GIVEN)
        rows.append(row)
    return sorted(rows, key=lambda row: -row.gain(present))


def _best(rows: list[_Row]) -> list[_Row]:
    """Return the best additions of different kinds."""
    best: dict[str, _Row] = {}
    for row in rows:
        best.setdefault(row.candidate.kind, row)
    return list(best.values())[:NUM_BEST]


def _pairs(rows: list[_Row]) -> list[Candidate]:
    """Return the combinations of two of some additions that are functions."""
    parts = [row.candidate for row in rows if not _is_fixed(row.candidate)]
    return [
        Candidate(f"{a.name} + {b.name}", "both", partial(combined, a.change, b.change), "pair")
        for a, b in combinations(parts, 2)
    ]


def _is_fixed(candidate: Candidate) -> bool:
    """Whether an addition is a measurement, and no function of one."""
    return getattr(candidate.change, "func", None) is _instead


def _of_user(candidates: Any) -> list[Candidate]:
    """Return the candidates of a user, or raise ValueError."""
    is_dictionary = isinstance(candidates, dict) and bool(candidates)
    if not is_dictionary or not all(
        callable(x) or isinstance(x, Measurement | dict) for x in candidates.values()
    ):
        raise ValueError(
            "candidates must be a dictionary of measurements or functions by name, as "
            f"{{'twice as long': longer}}, got {candidates!r:.60}"
        )
    found = []
    for name, planned in candidates.items():
        is_fixed = isinstance(planned, Measurement | dict)
        change = partial(_instead, planned) if is_fixed else planned
        found.append(Candidate(str(name), "", change, f"yours: {name}"))
    return found


def _instead(planned: Planned, measurement: Measurement) -> Planned:
    return planned


def _unchanged(measurement: Measurement) -> Measurement:
    return measurement


def _of_this_material(
    measurements: dict[str, Measurement], base: Measurement, names: tuple[str, ...]
) -> dict[str, Measurement]:
    """Return measurements with the values that their material has in the present experiment."""
    varied = (*names, *base.priors)
    of_material = tuple(
        x for x in varied if x not in PARAMETERS or PARAMETERS[x].belongs_to == MATERIAL
    )
    return {
        label: replace(m, gas=with_values_of(m.gas, base.gas, of_material))
        for label, m in measurements.items()
    }


def _fit(name: str, measurements: dict[str, Measurement], free: Any, quick: bool = False) -> Fit:
    """Fit measurements without warnings; errors begin with their name.

    Several curves share the parameters of the material; each has its own parameters of the scene.
    """
    curves = [m for m in measurements.values() if isinstance(m.data, CoolingCurve)]
    separate = ()
    if len(curves) > 1:
        separate = tuple(x for x in free if x in PARAMETERS and PARAMETERS[x].belongs_to == SCENE)
        free = tuple(x for x in free if x not in separate)
    given = measurements[""] if [*measurements] == [""] else measurements
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            return fit(given, free=free, separate=separate, quick=quick)
    except (ValueError, RuntimeError) as error:
        raise type(error)(f"{name}: {error}") from None


def _relative(result: Fit, name: str, truth: Truth, gas: Gas) -> tuple[float, float]:
    """Return the range of a parameter over its true value; 0 to inf if there is none.

    If each of several curves has the parameter for itself, that of the first curve counts.
    """
    titles = [title for title in result.ranges if title.rpartition(": ")[2] == name]
    if not titles:
        return 0.0, float("inf")
    low, high = (float(np.ravel(x)[0]) for x in result.ranges[titles[0]])
    true = float(np.ravel(truth.gas(gas).value(name))[0])
    return low / true, high / true


def _at_its_fit(measurement: Measurement, free: Any) -> Measurement:
    """Return a measurement with the values of its fit.

    Its errors remain, relative to these; those that the fit found are added.
    """
    found = _fit(DATA, {"": measurement}, free, quick=True)
    fields = {}
    for name in ("temperature", "rotational_temperature", "displacement"):
        fitted = getattr(found.curve, name)
        if getattr(measurement.curve, name) is not None and fitted is not None:
            fields[name] = np.asarray(fitted)
    if found.errors_of_T:
        fields["temperature_error"] = found.errors_of_T[""] * fields["temperature"]
    base = replace(measurement, gas=found.gas, rounding={}, header=())
    return twin(with_curve(base, **fields))


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


def _range(x: Expected, unit: str) -> str:
    """Say between which ends the parameter is expected."""
    if not x.width < OPEN_WIDTH:
        return f"above {x.low:.3g} {unit}".strip()
    return f"between {x.low:.3g} and {x.high:.3g} {unit}".strip()
