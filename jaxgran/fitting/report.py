"""The report of a fit as text: ranges, estimates, error budget, alternatives, reasons."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxgran.data.curve import above_noise
from jaxgran.data.drop_test import DropTest
from jaxgran.data.header_keys import GUESS
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.alternatives import Alternative
from jaxgran.fitting.goodness import SIGNIFICANCE
from jaxgran.fitting.result import CONDITIONAL, Fit, prefix_of
from jaxgran.fitting.rows import (
    CALIBRATION,
    FEW_PARTICLES,
    MEASUREMENT,
    MODEL,
    SAMPLING,
    SIMULATION,
    SLOPE,
)
from jaxgran.scene.parameters import symbol_of, unit_of

BUDGET_PARTS = {
    MEASUREMENT: "errors of the points",
    MODEL: "error of the model's cooling rate in this scene",
    FEW_PARTICLES: "random collisions of N particles",
    SAMPLING: "the mean over tracked grains in place of all",
    SLOPE: "error of derivatives through particles: large if the gas has a flow, or noisy",
    SIMULATION: "noise of the simulations of the fit",
    CALIBRATION: "error of the scale of T, common to all points",
    "other minima": "other values of the parameters that fit nearly as well",
}
"""Meaning of the parts of the error budget; other parts have the name of what is uncertain."""

OTHER_PART = "uncertainty of this input, as given or as known"
"""Meaning of a part of the error budget that is not in `BUDGET_PARTS`."""

SHAPES = {2: "square", 3: "cube"}
"""Shape of a box with equal sides, by its dimension."""


class ParameterRow(NamedTuple):
    """A free parameter in the report.

    Attributes:
        parameter: its symbol.
        unit: SI.
        estimate: nan if the data do not determine it.
        std_err: standard error of the estimate.
        error_budget: the parts of the standard error.
        low, high: 95 % range over all alternatives; nan if they were not compared.
        header: its value in the file; None if the file has none.
    """

    parameter: str
    unit: str
    estimate: float
    std_err: float
    error_budget: dict[str, float]
    low: float
    high: float
    header: float | None

    @property
    def largest_parts(self) -> list[tuple[str, float]]:
        """The parts of the error that are not 0, the largest first."""
        parts = sorted(self.error_budget.items(), key=lambda part: -part[1])
        return [(name, size) for name, size in parts if size > 0]


class Table(NamedTuple):
    """A table of texts.

    Attributes:
        head: of the columns.
        rows: a text for each column.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def report(result: Fit, *, explain: bool = False) -> str:
    """Return the report of a fit, as the command ``jaxgran fit`` prints it.

    Args:
        result: of `jaxgran.fit`.
        explain: show the error budget as a table that explains each part.
    """
    rows = parameter_rows(result)
    lines = [text for text in (result.headline, result.narrowing, result.verdict) if text]
    for label, measurement in result.measurements.items():
        lines.append("")
        if isinstance(measurement.data, DropTest):
            lines += _drop_test(label, measurement, measurement.data)
        else:
            lines += _curve(label, measurement)
            lines += _gas(measurement, result.scales[label])
    steps = "simulations" if SIMULATION in result.covariances else "steps of the search"
    lines.append(f"model    {result.model_name}, {result.iterations} {steps}")
    lines += ["", *_parameters(rows)]
    for row in rows:
        if not np.isnan(row.estimate):
            lines += _budget_table(row) if explain else [_budget(row)]
    alternatives = alternative_table(result)
    if alternatives.rows:
        lines += ["", *table(*alternatives)]
    if len(result.measurements) > 1:
        agreement = "The measurements do not contradict each other"
        if result.p_value < SIGNIFICANCE:
            agreement = "The measurements contradict each other, or the model"
        lines += ["", f"{agreement} (p = {result.p_value:.2g})."]
    lines += ["", *(f"  - {reason}" for reason in result.reasons)]
    return "\n".join(lines)


def parameter_rows(result: Fit) -> list[ParameterRow]:
    """Return estimate, errors, range and value in the file of each free parameter."""
    rows = []
    for i, name in enumerate(result.names):
        estimate, error = (float(np.squeeze(x)) for x in result.value(name))
        if name in result.undetermined:
            estimate = float("nan")
            error = float("nan")
        ends = result.ranges.get(name, (np.nan, np.nan))
        low, high = (float(np.squeeze(x)) for x in ends)
        row = ParameterRow(
            parameter=symbol_of(name),
            unit=unit_of(name),
            estimate=estimate,
            std_err=error,
            error_budget={part: float(x[i]) for part, x in result.error_budget.items()},
            low=low,
            high=high,
            header=_in_file(result, name),
        )
        rows.append(row)
    return rows


def _in_file(result: Fit, name: str) -> float | None:
    """Return the value of a parameter in the header of its file; None if it has none."""
    label, _, short = name.rpartition(": ")
    measurement = result.measurements.get(label) or next(iter(result.measurements.values()))
    text = dict(measurement.header).get(symbol_of(short), GUESS)
    return None if text == GUESS else float(text)


def alternative_table(result: Fit) -> Table:
    """Return the alternatives, with the values of the first parameter."""
    symbol = symbol_of(result.names[0])
    head = ("alternative explanation", "-2 ln L drop", symbol, "95 %", "distinguishable")
    rows = []
    for x in result.alternatives:
        limits = f"{x.low[0]:.3g} .. {x.high[0]:.3g}"
        if x.restitution is not None:
            limits = f"none: eps = {x.restitution:.3g}"
        answer = _is_distinguishable(x)
        rows.append((x.name, f"{x.improvement:.2g}", f"{x.estimate[0]:.3g}", limits, answer))
    return Table(head, rows)


def _is_distinguishable(x: Alternative) -> str:
    """Return whether the data exclude an alternative, in a cell of a table."""
    if x.preferred:
        return "preferred by the data"
    if x.distinguishable:
        return "yes"
    if x.restitution is not None:
        return "no"
    return f"no (needs {x.error_reduction_needed:.2g}x smaller errors)"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield rows of columns below their heads, the first one aligned to the left."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
        yield "  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip()


def _drop_test(label: str, measurement: Measurement, data: DropTest) -> Iterator[str]:
    v = np.asarray(data.speed)
    yield (f"drops    {prefix_of(label)}{v.size} impacts, v = {v.min():.3g} .. {v.max():.3g} m/s")
    if data.is_oblique:
        tilt = np.degrees(np.arctan2(np.asarray(data.tangential_speed), v))
        yield f"         oblique, {tilt.min():.2g} .. {tilt.max():.2g} degrees from the normal"
    header = dict(measurement.header)
    if "impacts_from" in header:
        yield f"         {header['impacts_from']}"
        yield "         they share grains with T(t), and hardly errors"


def _curve(label: str, measurement: Measurement) -> Iterator[str]:
    T = np.asarray(measurement.curve.temperature)
    times = np.asarray(measurement.curve.times)
    yield (f"curve    {prefix_of(label)}{T.size} points, t = {times[0]:.6g} .. {times[-1]:.6g} s,")
    coolest = T[above_noise(measurement.curve)][-1]
    yield f"         T falls to {coolest / T[0]:.3g} of its first value"
    header = dict(measurement.header)
    if "T_from" in header:
        yield f"         {header['T_from']}"


def _gas(measurement: Measurement, scales: dict[str, float]) -> Iterator[str]:
    """Yield lines on a fitted gas, given the numbers that describe it (`Fit.scales`)."""
    beta = f", beta_T0 = {scales['beta']:.3g}" if "beta" in scales else ""
    yield (
        f"gas      phi = {scales['phi']:.3g}, tau_c = {scales['tau_c']:.3g} s, "
        f"t_c/tau_c = {scales['contact_fraction']:.2g}{beta} (fitted)"
    )
    yield (
        f"impacts  eps = {scales['eps_first']:.3g} at the thermal speed of t = 0, "
        f"{scales['eps_last']:.3g} at the last one;"
    )
    path = f"         mean free path {1e3 * scales['mean_free_path']:.3g} mm"
    if measurement.num_particles is None:
        yield path
    else:
        shape = SHAPES[measurement.gas.dimension]
        yield f"{path}, in a box of {1e3 * scales['side']:.3g} mm if it is a {shape}"
    if beta:
        yield "         short contacts depend on A Y^(2/5) only: 10 % in Y is 4 % in A"


def _parameters(rows: list[ParameterRow]) -> Iterator[str]:
    """Yield the table of the ranges and the estimates."""
    cells = []
    for row in rows:
        name = f"{row.parameter:3} {row.unit}"
        span = "not computed" if np.isnan(row.low) else f"{row.low:.3g} .. {row.high:.3g}"
        cells.append((name, span, _estimate(row), _value_in_file(row)))
    yield from table(("", "95 % incl. alternatives", CONDITIONAL, "in file"), cells)


def _estimate(row: ParameterRow) -> str:
    """Return the estimate and its error in a cell of a table."""
    if np.isnan(row.estimate):
        return "not determined"
    is_rejected = row.estimate < row.low or row.estimate > row.high
    value = f"{row.estimate:.5g} +- {row.std_err:.2g}"
    return f"{value} (rejected)" if is_rejected else value


def _value_in_file(row: ParameterRow) -> str:
    """Return the value in the file in a cell of a table, with the difference of the estimate."""
    if not row.header:
        return ""
    if np.isnan(row.estimate):
        return f"{row.header:.5g}"
    return f"{row.header:.5g} ({100 * (row.estimate / row.header - 1):+.2f} %)"


def _is_time(row: ParameterRow) -> bool:
    """Tell whether a parameter is t0, which may be 0: then its error is given in ms."""
    return row.parameter.endswith("t0")


def _shares(row: ParameterRow) -> list[tuple[str, float]]:
    """Return the parts of an error in per cent of the estimate; for t0 in ms."""
    scale = 1e-3 if _is_time(row) else abs(row.estimate) / 100
    return [(name, size / scale) for name, size in row.largest_parts]


def _budget(row: ParameterRow) -> str:
    unit = "ms" if _is_time(row) else "%"
    parts = [f"{name} {share:.2g} {unit}" for name, share in _shares(row)]
    return f"error of {row.parameter}: {', '.join(parts)}"


def _budget_table(row: ParameterRow) -> Iterator[str]:
    """Yield the parts of an error, each with its meaning."""
    words = "ms" if _is_time(row) else "per cent"
    yield ""
    yield f"error of {row.parameter}, in {words}; the squares of the parts add up"
    for name, share in _shares(row):
        yield f"  {share:8.2g}  {name}: {BUDGET_PARTS.get(name, OTHER_PART)}"
