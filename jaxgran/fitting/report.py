"""The report of a fit as text: ranges, estimates, error budget, alternatives, reasons."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxgran.data.curve import above_noise
from jaxgran.data.drop_test import DropTest
from jaxgran.data.header_keys import GUESS
from jaxgran.data.measurement import Measurement
from jaxgran.fitting.alternatives import Alternative
from jaxgran.fitting.goodness import SIGNIFICANCE
from jaxgran.fitting.result import CONDITIONAL, Fit
from jaxgran.scene.parameters import symbol_of, unit_of

BUDGET_PARTS = {
    "measurement": "errors of the points",
    "model": "error of the model's cooling rate in this scene",
    "few particles": "random collisions of N particles",
    "sampling": "the mean over tracked grains in place of all",
    "slope": "error of derivatives through particles: large if the gas has a flow, or noisy",
    "simulation": "noise of the simulations of the fit",
    "calibration": "error of the scale of T, common to all points",
    "other minima": "other values of the parameters that fit nearly as well",
}
"""Meaning of the parts of the error budget; other parts have the name of what is uncertain."""

LINES = {
    "drops": "drops    {name}{number} impacts, v = {low:.3g} .. {high:.3g} m/s",
    "oblique": "         oblique, {low:.2g} .. {high:.2g} degrees from the normal",
    "source": "         {source}",
    "shared grains": "         they share grains with T(t), and hardly errors",
    "curve": "curve    {name}{number} points, t = {first:.6g} .. {last:.6g} s,",
    "T falls": "         T falls to {ratio:.3g} of its first value",
    "gas": "gas      phi = {phi:.3g}, tau_c = {tau_c:.3g} s, t_c/tau_c = {contact_fraction:.2g} "
    "(fitted)",
    "viscoelastic gas": "gas      phi = {phi:.3g}, tau_c = {tau_c:.3g} s, t_c/tau_c = "
    "{contact_fraction:.2g}, beta_T0 = {beta:.3g} (fitted)",
    "impacts": "impacts  eps = {eps_first:.3g} at the thermal speed of t = 0, {eps_last:.3g} at "
    "the last one;",
    "free path": "         mean free path {path:.3g} mm",
    "free path in box": "         mean free path {path:.3g} mm, in a box of {side:.3g} mm if it is "
    "a {shape}",
    "A and Y": "         short contacts depend on A Y^(2/5) only: 10 % in Y is 4 % in A",
    "model": "model    {model}, {number} steps of the search",
    "stochastic model": "model    {model}, {number} simulations",
    "agree": "The measurements do not contradict each other (p = {p:.2g}).",
    "contradict": "The measurements contradict each other, or the model (p = {p:.2g}).",
    "reason": "  - {reason}",
    "budget": "error of {symbol}: {parts}",
    "budget table": "error of {symbol}, in {words}; the squares of the parts add up",
    "budget row": "  {share:8.2g}  {name}: {meaning}",
    "other part": "uncertainty of this input, as given or as known",
}
"""Lines of the report by name, with places for values."""

SHAPES = {2: "square", 3: "cube"}
"""Shape of a box with equal sides, by its dimension."""


def _line(name: str, /, **values: Any) -> str:
    return LINES[name].format(**values)


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
    kind = "stochastic model" if "simulation" in result.covariances else "model"
    lines.append(_line(kind, model=result.model_name, number=result.iterations))
    lines += ["", *_parameters(rows)]
    for row in rows:
        if not np.isnan(row.estimate):
            lines += _budget_table(row) if explain else [_budget(row)]
    alternatives = alternative_table(result)
    if alternatives.rows:
        lines += ["", *table(*alternatives)]
    if len(result.measurements) > 1:
        agreement = "contradict" if result.p_value < SIGNIFICANCE else "agree"
        lines += ["", _line(agreement, p=result.p_value)]
    lines += ["", *(_line("reason", reason=reason) for reason in result.reasons)]
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
    yield _line("drops", name=_name(label), number=v.size, low=v.min(), high=v.max())
    if data.is_oblique:
        tilt = np.degrees(np.arctan2(np.asarray(data.tangential_speed), v))
        yield _line("oblique", low=tilt.min(), high=tilt.max())
    header = dict(measurement.header)
    if "impacts_from" in header:
        yield _line("source", source=header["impacts_from"])
        yield _line("shared grains")


def _name(label: str) -> str:
    return f"{label}: " if label else ""


def _curve(label: str, measurement: Measurement) -> Iterator[str]:
    T = np.asarray(measurement.curve.temperature)
    times = np.asarray(measurement.curve.times)
    yield _line("curve", name=_name(label), number=T.size, first=times[0], last=times[-1])
    coolest = T[above_noise(measurement.curve)][-1]
    yield _line("T falls", ratio=coolest / T[0])
    header = dict(measurement.header)
    if "T_from" in header:
        yield _line("source", source=header["T_from"])


def _gas(measurement: Measurement, scales: dict[str, float]) -> Iterator[str]:
    """Yield lines on a fitted gas, given the numbers that describe it (`Fit.scales`)."""
    is_viscoelastic = "beta" in scales
    yield _line("viscoelastic gas" if is_viscoelastic else "gas", **scales)
    yield _line("impacts", **scales)
    path = 1e3 * scales["mean_free_path"]
    if measurement.num_particles is None:
        yield _line("free path", path=path)
    else:
        shape = SHAPES[measurement.gas.dimension]
        yield _line("free path in box", path=path, side=1e3 * scales["side"], shape=shape)
    if is_viscoelastic:
        yield _line("A and Y")


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
    return _line("budget", symbol=row.parameter, parts=", ".join(parts))


def _budget_table(row: ParameterRow) -> Iterator[str]:
    """Yield the parts of an error, each with its meaning."""
    words = "ms" if _is_time(row) else "per cent"
    yield ""
    yield _line("budget table", symbol=row.parameter, words=words)
    for name, share in _shares(row):
        meaning = BUDGET_PARTS.get(name, LINES["other part"])
        yield _line("budget row", share=share, name=name, meaning=meaning)
