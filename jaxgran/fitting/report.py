"""The report of a fit as text: ranges, estimates, error budget, alternatives, reasons."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from jaxgran.data.curve import above_noise
from jaxgran.data.drop_test import DropTest
from jaxgran.data.header_keys import GUESS
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


def report(result: Fit, *, explain: bool = False) -> str:
    """Return the report of a fit, as the command ``jaxgran fit`` prints it.

    Args:
        result: of `jaxgran.fit`.
        explain: show the error budget as a table that explains each part.
    """
    rows = parameter_rows(result)
    lines = [text for text in (result.headline, result.narrowing, result.verdict) if text]
    for label in result.measurements:
        lines += _scene(result, label)
    kind = "simulations" if "simulation" in result.covariances else "steps of the search"
    lines.append(f"model    {result.model_name}, {result.iterations} {kind}")
    lines += ["", *_parameters(rows)]
    lines += _budget(rows, explain)
    lines += _alternatives(result)
    if len(result.measurements) > 1:
        agreement = "do not contradict each other"
        if result.p_value < SIGNIFICANCE:
            agreement = "contradict each other, or the model"
        lines += ["", f"The measurements {agreement} (p = {result.p_value:.2g})."]
    lines += ["", *(f"  - {reason}" for reason in result.reasons)]
    return "\n".join(lines)


def parameter_rows(result: Fit) -> list[dict[str, Any]]:
    """Return estimate, errors, range and value in the file of each free parameter."""
    rows = []
    for name in result.names:
        estimate, error = (float(np.squeeze(x)) for x in result.value(name))
        if name in result.undetermined:
            estimate = error = float("nan")
        ends = result.ranges.get(name, (np.nan, np.nan))
        low, high = (float(np.squeeze(x)) for x in ends)
        i = result.names.index(name)
        rows.append(
            {
                "parameter": symbol_of(name),
                "unit": unit_of(name),
                "estimate": estimate,
                "std_err": error,
                "error_budget": {part: float(x[i]) for part, x in result.error_budget.items()},
                "low": low,
                "high": high,
                "header": _in_file(result, name),
            }
        )
    return rows


def _in_file(result: Fit, name: str) -> float | None:
    """Return the value of a parameter in the header of its file; None if it has none."""
    label, _, short = name.rpartition(": ")
    measurement = result.measurements.get(label) or next(iter(result.measurements.values()))
    text = dict(measurement.header).get(symbol_of(short), GUESS)
    return None if text == GUESS else float(text)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield rows of columns below their heads, the first one aligned to the left."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    for row in (head, *rows):
        cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
        yield "  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip()


def _scene(result: Fit, label: str) -> Iterator[str]:
    """Yield lines on a curve, the gas that was fitted to it, and its impacts; or a drop test."""
    measurement = result.measurements[label]
    name = f"{label}: " if label else ""
    yield ""
    if isinstance(measurement.data, DropTest):
        v = np.asarray(measurement.data.speed)
        yield f"drops    {name}{v.size} impacts, v = {v.min():.3g} .. {v.max():.3g} m/s"
        if measurement.data.is_oblique:
            tilt = np.degrees(np.arctan2(np.asarray(measurement.data.tangential_speed), v))
            yield f"         oblique, {tilt.min():.2g} .. {tilt.max():.2g} degrees from the normal"
        origin = dict(measurement.header).get("impacts_from")
        if origin is not None:
            yield f"         {origin}"
            yield "         they share grains with T(t), and hardly errors"
        return
    T = np.asarray(measurement.data.temperature)
    last = T[above_noise(measurement.data)][-1]
    times = np.asarray(measurement.data.times)
    yield f"curve    {name}{T.size} points, t = {times[0]:.6g} .. {times[-1]:.6g} s,"
    yield f"         T falls to {last / T[0]:.3g} of its first value"
    header = dict(measurement.header)
    if "T_from" in header:
        yield f"         {header['T_from']}"
    scales = result.scales[label]
    beta = f", beta_T0 = {scales['beta']:.3g}" if "beta" in scales else ""
    yield (
        f"gas      phi = {scales['phi']:.3g}, tau_c = {scales['tau_c']:.3g} s, "
        f"t_c/tau_c = {scales['contact_fraction']:.2g}{beta} (fitted)"
    )
    yield (
        f"impacts  eps = {scales['eps_first']:.3g} at the thermal speed of t = 0, "
        f"{scales['eps_last']:.3g} at the last one;"
    )
    box = ""
    if measurement.num_particles is not None:
        shape = "cube" if measurement.gas.dimension == 3 else "square"
        box = f", in a box of {1e3 * scales['side']:.3g} mm if it is a {shape}"
    yield f"         mean free path {1e3 * scales['mean_free_path']:.3g} mm{box}"
    if beta:
        yield "         short contacts depend on A Y^(2/5) only: 10 % in Y is 4 % in A"


def _parameters(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the table of the ranges and the estimates."""
    cells = []
    for row in rows:
        low = row["low"]
        high = row["high"]
        estimate = row["estimate"]
        value = f"{estimate:.5g} +- {row['std_err']:.2g}"
        value += " (rejected)" if estimate < low or estimate > high else ""
        difference = f"{row['header']:.5g}" if row["header"] else ""
        if difference and not np.isnan(estimate):
            difference += f" ({100 * (estimate / row['header'] - 1):+.2f} %)"
        cells.append(
            (
                f"{row['parameter']:3} {row['unit']}",
                "not computed" if np.isnan(low) else f"{low:.3g} .. {high:.3g}",
                "not determined" if np.isnan(estimate) else value,
                difference,
            )
        )
    yield from table(("", "95 % incl. alternatives", CONDITIONAL, "in file"), cells)


def _budget(rows: list[dict[str, Any]], explain: bool) -> Iterator[str]:
    """Yield the parts of each error, the largest first, in per cent of the estimate (t0: in ms)."""
    for row in rows:
        if np.isnan(row["estimate"]):
            continue
        parts = sorted(row["error_budget"].items(), key=lambda part: -part[1])
        is_time = row["parameter"].endswith("t0")  # which may be 0
        scale, unit = (1e-3, "ms") if is_time else (abs(row["estimate"]) / 100, "%")
        shares = [(name, x / scale) for name, x in parts if x > 0]
        if not explain:
            line = ", ".join(f"{name} {share:.2g} {unit}" for name, share in shares)
            yield f"error of {row['parameter']}: {line}"
            continue
        words = "ms" if is_time else "per cent"
        yield ""
        yield f"error of {row['parameter']}, in {words}; the squares of the parts add up"
        for name, share in shares:
            meaning = BUDGET_PARTS.get(name, "uncertainty of this input, as given or as known")
            yield f"  {share:8.2g}  {name}: {meaning}"


def alternative_rows(result: Fit) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the head and the rows of the table of the alternatives."""
    cells = []
    for x in result.alternatives:
        needed = f"no (needs {x.error_reduction_needed:.2g}x smaller errors)"
        answer = "preferred by the data" if x.preferred else "yes" if x.distinguishable else needed
        limits = f"{x.low[0]:.3g} .. {x.high[0]:.3g}"
        if x.restitution is not None:
            limits = f"none: eps = {x.restitution:.3g}"
        cells.append((x.name, f"{x.improvement:.2g}", f"{x.estimate[0]:.3g}", limits, answer))
    symbol = symbol_of(result.names[0])
    return ("alternative explanation", "-2 ln L drop", symbol, "95 %", "distinguishable"), cells


def _alternatives(result: Fit) -> Iterator[str]:
    """Yield the table of the alternatives, with the values of the first parameter."""
    head, cells = alternative_rows(result)
    if cells:
        yield ""
        yield from table(head, cells)
