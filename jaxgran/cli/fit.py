"""The fit of a measured curve, from a file to a table, a picture and a JSON file."""

import json
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxgran
from jaxgran import plotting
from jaxgran.cli.models import model_of, named
from jaxgran.cli.output import environment, finite_or_null, outputs, plain, settings
from jaxgran.cli.report import (
    print_budget,
    print_doubts,
    print_impacts,
    print_model,
    print_rivals,
    print_rows,
    print_scene,
    print_verdict,
)
from jaxgran.data.files import write_whole
from jaxgran.data.header import header_count, header_number
from jaxgran.fitting.checks import unused_rotation
from jaxgran.fitting.fit import free_by_default

PARAMETERS = {
    "A": ("dissipative_constant", "s"),
    "T0": ("temperature", "m^2/s^2"),
    "t0": ("t0", "s"),
    "Y": ("youngs_modulus", "Pa"),
    "nu": ("poisson_ratio", ""),
    "eta": ("packing_fraction", ""),
    "diameter": ("diameter", "m"),
    "beta_t": ("tangential_restitution", ""),
    "reduced_inertia": ("inertia", ""),
    "T_rot_0": ("rotational_temperature", "m^2/s^2"),
    "container_side": ("wall_side", "m"),
    "wall_restitution": ("wall_coefficient", ""),
    "wall_beta_t": ("wall_tangential_restitution", ""),
    "tangential_damping": ("tangential_damping", ""),
    "friction": ("friction", ""),
    "gamma": ("drag_rate", "1/s"),
    "drive_strength": ("drive_strength", "m^2/s^3"),
}


LARGEST_KEY = 2**63
"""Of whole numbers that make a key of random numbers."""


@dataclass
class FitOptions:
    """What the command `fit` is told; see its help."""

    curve: Path
    model: str
    tolerance: float
    particles: int | None
    replicas: int
    key: int
    free: list[str]
    set: list[str]
    out: Path | None
    overwrite: bool
    explain: bool = False


def names_of(floats: tuple[str, ...]) -> list[str]:
    """Arguments of --free for floats of a gas."""
    return [key for key, (name, _) in PARAMETERS.items() if name in floats]


def run_fit(options: FitOptions, started: float) -> None:
    """Fit, print, draw and write; `started` is when the clock of the whole job began."""
    with warnings.catch_warnings(record=True) as doubts:  # of units and of tracks
        warnings.simplefilter("always", UserWarning)
        curve, header = jaxgran.read_curve(options.curve)
        header |= settings(options.set)
        gas, priors = jaxgran.read_gas(header), jaxgran.read_priors(header)
    options.free = options.free or names_of(free_by_default(gas, curve))
    gas = with_given_constant(gas, header, options.free)
    n = header_count(header, "N")
    replicas = header_count(header, "replicas") or 1
    picture, record = outputs(options)
    free = tuple(PARAMETERS[key][0] for key in options.free)
    model, reasons = model_of(options, gas, curve, free, n)
    (model_name,) = named([model])
    imported = time.perf_counter() - started
    asked = {"free": free, "priors": priors, "num_particles": n, "replicas": replicas}
    result, first_seconds, fit_seconds = timed_fit(options, gas, curve, model, asked)
    diagnosis = jaxgran.diagnose(result, curve, n)
    rows = rows_of(options, result, diagnosis, header)
    print_scene(options, gas, curve, header, result)
    print_doubts(doubts, unused_rotation(gas, curve))
    print_impacts(result.gas, float(curve.temperature[-1]), n)
    print_model(model_name, result, reasons)
    print_rows(rows)
    print_budget(rows, options.explain)
    print_rivals(rows[0]["parameter"], diagnosis)
    print_verdict(diagnosis)
    picture.parent.mkdir(parents=True, exist_ok=True)
    plotting.save_fit(result, curve, title_of(options, rows, diagnosis), picture)
    summary = {
        **{row["parameter"]: row["estimate"] for row in rows},
        **{f"{row['parameter']}_std_err": row["std_err"] for row in rows},
        "model": model_name,
        "reduced_chi2": round(float(result.reduced_chi2), 4),
        "converged": bool(result.converged),
        **{f"{row['parameter']}_low": row["low"] for row in rows},
        **{f"{row['parameter']}_high": row["high"] for row in rows},
        "explains": diagnosis.explains,
        "seconds": round(time.perf_counter() - started, 2),
        "compile_seconds": round(first_seconds - fit_seconds, 2),
        "fit_seconds": round(fit_seconds, 4),
    }
    details = {
        "curve": options.curve.name,
        "chosen": reasons,
        "header": header,
        "parameters": rows,
        "covariance": np.asarray(result.covariance).tolist(),
        "diagnosis": {"verdict": diagnosis.verdict, "reasons": diagnosis.reasons},
        "rivals": [plain(rival) for rival in diagnosis.rivals],
        "import_seconds": round(imported, 2),
        **environment(),
    }
    summary = finite_or_null(summary)
    text = json.dumps(finite_or_null(summary | details), indent=2, allow_nan=False) + "\n"
    write_whole(record, lambda f: f.write(text.encode()))
    print(f"\nwritten  {picture}\n         {record}\n")
    print(json.dumps(summary, allow_nan=False))


def title_of(options: FitOptions, rows: list[dict], diagnosis) -> str:
    """The title of the picture: the first parameter and the verdict."""
    head = rows[0]
    answer = "not determined"
    if not np.isnan(head["estimate"]):
        answer = with_error(head["estimate"], head["std_err"], head["unit"])
    name = options.curve.stem.replace("_", " ")
    return f"{name}: {head['parameter']} = {answer}\n{diagnosis.verdict}"


def with_error(value: float, error: float, unit: str) -> str:
    """A value and its standard error as a person writes them: (2.959 ± 0.051)·10⁻⁶ s."""
    power = int(np.floor(np.log10(abs(value)))) if value else 0
    if not np.isfinite(error) or error <= 0 or -2 < power < 4:
        return f"{value:.4g} ± {error:.2g} {unit}".strip()
    digits = max(power - int(np.floor(np.log10(error))) + 1, 0)
    raised = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    value, error = value / 10.0**power, error / 10.0**power
    return f"({value:.{digits}f} ± {error:.{digits}f})·10{raised} {unit}".strip()


def with_given_constant(gas, header, free: list[str]):
    """The gas with the header's A, where A is not fitted."""
    if "A" in header:
        given = gas.replace(dissipative_constant=header_number(header, "A"))
        return gas if "A" in free else given
    if "A" in free:
        return gas
    raise ValueError(
        f"--free {' '.join(free)} leaves A fixed, and the file does not give it: add --set A=VALUE "
        "(in s), or free A too"
    )


def timed_fit(options: FitOptions, gas, curve, model, asked: dict[str, Any]):
    """The fit, seconds of the first and of the last time that it was made."""
    if abs(options.key) >= LARGEST_KEY:
        raise ValueError(f"--key {options.key} is too large: give a whole number below 2^63")
    key = jax.random.key(options.key) if model.stochastic else None

    def fit():
        begin = time.perf_counter()
        result = jaxgran.fit(gas, curve, model=model, key=key, **asked)
        jax.block_until_ready(result.chi2)
        return result, time.perf_counter() - begin

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # said again, in words, by the diagnosis
        result, first_seconds = fit()
        fit_seconds = first_seconds
        if not model.stochastic:  # the second time without compilation
            result, fit_seconds = fit()
    return result, first_seconds, fit_seconds


def rows_of(options: FitOptions, result, diagnosis, header) -> list[dict]:
    """Estimates and errors, a row for each parameter; nan where the curve determines none."""
    rows, unknown = [], result.undetermined()
    for key in options.free:
        name, unit = PARAMETERS[key]
        estimate, error = (float(x) for x in result.value(name))
        between = limits(diagnosis, name)
        if name in unknown:
            estimate, error, *between = 4 * [float("nan")]
        i = result.names.index(name)
        rows.append(
            {
                "parameter": key,
                "unit": unit,
                "estimate": estimate,
                "std_err": error,
                "error_budget": {part: float(x[i]) for part, x in result.error_budget.items()},
                **dict(zip(("low", "high"), between, strict=True)),
                "header": header_number(header, key) if key in header else None,
            }
        )
    return rows


def limits(diagnosis, name: str) -> list[float]:
    """The range of a parameter over all rivals that fit as well, 95 %; nan if there is none."""
    return [float(np.squeeze(x)) for x in diagnosis.ranges.get(name, (np.nan, np.nan))]
