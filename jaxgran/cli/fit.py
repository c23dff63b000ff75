"""The command `jaxgran fit`: fits of one measured curve, and joint fits of several measurements.

Reads files, prints tables, and writes a picture and a JSON file.
"""

import dataclasses
import json
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxgran
from jaxgran import plotting
from jaxgran.cli.common import (
    MODELS,
    FitOptions,
    alternative_as_json,
    choose_or_make_model,
    environment,
    finite_or_null,
    gas_of,
    models_by_name,
    output_files,
    parse_settings,
)
from jaxgran.data.curve_file import GUESS
from jaxgran.data.files import header_count, header_number, write_atomically
from jaxgran.fitting.fit import free_by_default
from jaxgran.fitting.residuals import unused_rotation
from jaxgran.fitting.result import SIGNIFICANCE
from jaxgran.models.choose import default_models
from jaxgran.scene.parameters import BY_SYMBOL, PARAMETERS, SCENE

MAX_KEY = 2**63
"""Upper bound of the seeds of `jax.random.key`."""

JOINT_MODEL = MODELS[0]
"""The only model of joint fits: kinetic theory."""


def run_fit(options: FitOptions, started: float) -> None:
    """Fit one curve, print the result and write it.

    Args:
        options: of the command.
        started: start of the job on the clock `time.perf_counter`.
    """
    with warnings.catch_warnings(record=True) as input_warnings:  # about units and tracks
        warnings.simplefilter("always", UserWarning)
        curve, header = jaxgran.read_curve(options.curve)
        header |= parse_settings(options.set)
        gas, priors = gas_of(header, options.free), jaxgran.read_priors(header)
    free_symbols = options.free or free_keys(free_by_default(gas, curve))
    options = dataclasses.replace(options, free=tuple(free_symbols))
    gas = with_given_constant(gas, header, options.free)
    n = header_count(header, "N")
    replicas = header_count(header, "replicas") or 1
    picture, record = output_files(options)
    free = tuple(BY_SYMBOL[key].name for key in options.free)
    model, reasons = choose_or_make_model(options, gas, curve, free, n)
    (model_name,) = models_by_name([model])
    imported = time.perf_counter() - started
    arguments = {"free": free, "priors": priors, "num_particles": n, "replicas": replicas}
    result, first_seconds, fit_seconds = timed_fit(options, gas, curve, model, arguments)
    diagnosis = jaxgran.diagnose(result, curve, n)
    rows = parameter_rows(options, result, diagnosis, header)
    picture.parent.mkdir(parents=True, exist_ok=True)
    plotting.save_fit(result, curve, picture_title(options, rows, diagnosis), picture)
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
        "alternatives": [alternative_as_json(x) for x in diagnosis.alternatives],
        "import_seconds": round(imported, 2),
        **environment(),
    }
    summary = finite_or_null(summary)
    text = json.dumps(finite_or_null(summary | details), indent=2, allow_nan=False) + "\n"
    write_atomically(record, lambda f: f.write(text.encode()))
    print_scene(options, gas, curve, header, result)
    print_warnings(input_warnings, unused_rotation(gas, curve))
    print_impacts(result.gas, float(curve.temperature[-1]), n)
    print_model(model_name, result, reasons)
    print_rows(rows)
    print_budget(rows, options.explain)
    print_alternatives(rows[0]["parameter"], diagnosis)
    print_verdict(diagnosis)
    print(f"\nwritten  {picture}\n         {record}\n")
    print(json.dumps(summary, allow_nan=False))


def free_keys(floats: tuple[str, ...]) -> list[str]:
    """Return the arguments of --free for floats of a gas."""
    return [PARAMETERS[name].symbol for name in floats]


def with_given_constant(gas, header, free: Sequence[str]):
    """Return the gas with the header's A, if A is not free."""
    if "A" in header:
        given = gas.replace(dissipative_constant=header_number(header, "A"))
        return gas if "A" in free else given
    if "A" in free:
        return gas
    raise ValueError(
        f"--free {' '.join(free)} leaves A fixed, and the file does not give it. Add --set A=VALUE "
        "(in s), or free A too."
    )


def timed_fit(options: FitOptions, gas, curve, model, arguments: dict[str, Any]):
    """Return the fit, the seconds of its first run, and those of a run without compilation."""
    if abs(options.key) >= MAX_KEY:
        raise ValueError(f"--key {options.key} is too large. Give a whole number below 2^63.")
    key = jax.random.key(options.key) if model.stochastic else None

    def fit():
        begin = time.perf_counter()
        result = jaxgran.fit(gas, curve, model=model, key=key, **arguments)
        jax.block_until_ready(result.chi2)
        return result, time.perf_counter() - begin

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the diagnosis repeats them
        result, first_seconds = fit()
        fit_seconds = first_seconds
        if not model.stochastic:
            result, fit_seconds = fit()
    return result, first_seconds, fit_seconds


def parameter_rows(options: FitOptions, result, diagnosis, header) -> list[dict]:
    """Return estimate and errors of each free parameter; nan if the curve does not determine it."""
    rows, undetermined = [], result.undetermined()
    for key in options.free:
        name, unit = BY_SYMBOL[key].name, BY_SYMBOL[key].unit
        estimate, error = (float(x) for x in result.value(name))
        limits = range_over_alternatives(diagnosis, name)
        if name in undetermined:
            estimate, error, *limits = 4 * [float("nan")]
        i = result.names.index(name)
        rows.append(
            {
                "parameter": key,
                "unit": unit,
                "estimate": estimate,
                "std_err": error,
                "error_budget": {part: float(x[i]) for part, x in result.error_budget.items()},
                **dict(zip(("low", "high"), limits, strict=True)),
                "header": None if header.get(key, GUESS) == GUESS else header_number(header, key),
            }
        )
    return rows


def range_over_alternatives(diagnosis, name: str) -> list[float]:
    """Return the 95 % range of a parameter over all alternatives that fit as well as the best.

    Both limits are nan if there is none.
    """
    return [float(np.squeeze(x)) for x in diagnosis.ranges.get(name, (np.nan, np.nan))]


def picture_title(options: FitOptions, rows: list[dict], diagnosis) -> str:
    """Return the title of the picture: the first parameter and the verdict."""
    first = rows[0]
    answer = "not determined"
    if not np.isnan(first["estimate"]):
        answer = format_with_error(first["estimate"], first["std_err"], first["unit"])
    name = options.curve.stem.replace("_", " ")
    return f"{name}: {first['parameter']} = {answer}\n{diagnosis.verdict}"


def format_with_error(value: float, error: float, unit: str) -> str:
    """Format a value and its standard error, such as (2.959 ± 0.051)·10⁻⁶ s."""
    power = int(np.floor(np.log10(abs(value)))) if value else 0
    if not np.isfinite(error) or error <= 0 or -2 < power < 4:
        return f"{value:.4g} ± {error:.2g} {unit}".strip()
    digits = max(power - int(np.floor(np.log10(error))) + 1, 0)
    raised = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    value, error = value / 10.0**power, error / 10.0**power
    return f"({value:.{digits}f} ± {error:.{digits}f})·10{raised} {unit}".strip()


def print_scene(options: Any, gas, curve, header, result) -> None:
    """Print the curve and the gas that was fitted to it."""
    T = np.asarray(curve.temperature)
    print(f"curve    {options.curve.name}: {T.size} points, t = 0 .. {curve.times[-1]:.3g} s,")
    print(f"         T falls to {T[-1] / T[0]:.3g} of its first value")
    if "T_from" in header:
        print(f"         {header['T_from']}")
    print(
        f"gas      phi = {float(gas.packing_fraction):.3g}, tau_c = "
        f"{float(gas.mean_free_time):.3g} s, t_c/tau_c = {float(gas.contact_fraction):.2g}, "
        f"beta_T0 = {float(result.gas.thermal_beta):.3g} (fitted)"
    )


def print_warnings(input_warnings, unused: str | None) -> None:
    """Print warnings about the input, and which part of it was not used."""
    for text in [*(warning.message for warning in input_warnings), *([unused] if unused else [])]:
        print(f"check    {text}")


def print_impacts(gas, last_T: float, num_particles: int | None) -> None:
    """Print eps at the rms impact speeds of the first and of the last T, and the mean free path."""
    first, last = (float(gas.restitution(np.sqrt(2 * T))) for T in (gas.temperature, last_T))
    print(f"impacts  eps = {first:.3g} at the thermal speed of t = 0, {last:.3g} at the last one;")
    print(f"         mean free path {1e3 * float(gas.mean_free_path):.3g} mm", end="")
    if num_particles is not None:
        box = 1e3 * float(gas.box_side(num_particles))
        shape = "cube" if gas.dimension == 3 else "square"
        print(f", in a box of {box:.3g} mm if it is a {shape}", end="")
    print()
    if isinstance(gas.law, jaxgran.Viscoelastic):
        print("         short contacts depend on A Y^(2/5) only: 10 % in Y is 4 % in A")


def print_model(name: str, result, reasons) -> None:
    """Print the model, its number of steps, and why it was chosen."""
    steps = "simulations" if result.model.stochastic else "steps of least squares"
    print(f"model    {name}, {int(result.iterations)} {steps}")
    if reasons:
        print("chosen", "\n".join(f"         - {reason}" for reason in reasons).lstrip())


def print_rows(rows: list[dict]) -> None:
    """Print the table of estimates."""
    print(f"\n{'':10}{'estimate':>13} {'+-':>10} {'95 % incl. alternatives':>24}  in file")
    for row in rows:
        print(f"{row['parameter']:3} {row['unit']:5} ", end="")
        if np.isnan(row["estimate"]):
            print(f"{'not determined':>13}")
            continue
        limits = f"{row['low']:.3g} .. {row['high']:.3g}"
        limits = "not computed" if np.isnan(row["low"]) else limits
        print(f"{row['estimate']:13.5g} {row['std_err']:10.2g} {limits:>24}", end="")
        if row["header"]:
            print(f"  {row['header']:.5g} ({100 * (row['estimate'] / row['header'] - 1):+.2f} %)")
        else:
            print()


BUDGET_PARTS = {
    "measurement": "errors of the points, with the correlation of neighbouring points",
    "model": "error of the model's clock in this scene",
    "few particles": "random collisions of N particles",
    "slope": "error of derivatives through particles: large if the gas has a flow, or noisy",
    "simulation": "noise of the simulations of the fit",
}
"""Meaning of the parts of the error budget; other parts have the name of what is uncertain."""


def print_budget(rows: list[dict], explain: bool) -> None:
    """Print the parts of each error, the largest first, in per cent of the estimate (t0: in ms)."""
    for row in rows:
        if np.isnan(row["estimate"]):
            continue
        parts = sorted(row["error_budget"].items(), key=lambda part: -part[1])
        is_time = row["parameter"] == "t0"  # which may be 0
        scale, unit = (1e-3, "ms") if is_time else (abs(row["estimate"]) / 100, "%")
        shares = [(name, x / scale) for name, x in parts if x > 0]
        if not explain:
            line = ", ".join(f"{name} {share:.2g} {unit}" for name, share in shares)
            print(f"error of {row['parameter']}: {line}")
            continue
        words = "ms" if is_time else "per cent"
        print(f"\nerror of {row['parameter']}, in {words}; the squares of the parts add up")
        for name, share in shares:
            meaning = BUDGET_PARTS.get(name, "uncertainty of this input, as given or as known")
            print(f"  {share:8.2g}  {name}: {meaning}")


def print_alternatives(name: str, diagnosis) -> None:
    """Print the alternatives: their improvement of chi^2 and the values of the first parameter."""
    if not diagnosis.alternatives:
        return
    head = "alternative explanation"
    width = max(len(head), *(len(alternative.name) for alternative in diagnosis.alternatives))
    print(f"\n{head:{width}}  chi^2 drop {name:>9} {'95 %':>20}  distinguishable")
    for alternative in diagnosis.alternatives:
        limits = f"{alternative.low[0]:.3g} .. {alternative.high[0]:.3g}"
        print(f"{alternative.name:{width}}  {alternative.improvement:10.2g}", end="")
        print(f" {alternative.estimate[0]:9.3g} {limits:>20}  {_distinguishable(alternative)}")


def _distinguishable(alternative) -> str:
    if alternative.preferred:
        return "preferred by the data"
    if alternative.distinguishable:
        return "yes"
    return f"no (needs {alternative.error_reduction_needed:.2g}x smaller errors)"


def print_verdict(diagnosis) -> None:
    """Print the verdict and its reasons."""
    print(f"\n{diagnosis.verdict}")
    for reason in diagnosis.reasons:
        print(f"  - {reason}")


def run_joint_fit(curves: list[Path], options: FitOptions, started: float) -> None:
    """Fit curves and drop tests of one material jointly, print the result and write it.

    Args:
        curves: files of cooling curves.
        options: of the command.
        started: start of the job on the clock `time.perf_counter`.
    """
    if options.model != JOINT_MODEL:
        raise ValueError(
            f"--model {options.model}: several measurements are fitted with {JOINT_MODEL}. Fit the "
            "curves one by one with other models."
        )
    picture, record = output_files(options)
    free = options.free or ("A", "T0")
    parameters = [BY_SYMBOL[key] for key in free]
    shared = tuple(p.name for p in parameters if p.belongs_to != SCENE)
    separate = tuple(p.name for p in parameters if p.belongs_to == SCENE)
    if not shared:
        raise ValueError(f"--free {' '.join(free)}: the curves share none of these. Add A.")
    files = [path.resolve() for path in (*curves, *options.drop_test)]
    if repeated := [str(path) for path in files if files.count(path) > 1]:
        raise ValueError(f"{repeated[0]} is given twice. Give each measurement once.")
    data, gases, numbers, runs = {}, {}, {}, {}
    for path in curves:
        curve, header = jaxgran.read_curve(path)
        header |= parse_settings(options.set)
        label = _label(path, data)
        gases[label] = with_given_constant(gas_of(header, free), header, free)
        numbers[label], runs[label] = header_count(header, "N"), header_count(header, "replicas")
        data[label] = curve
    for path in options.drop_test:  # of spheres like those of the first curve
        label = _label(path, data)
        data[label] = jaxgran.read_drop_test(path, onto_plate=options.onto_plate)
        gases[label] = next(iter(gases.values()))
    result = jaxgran.fit(
        gases,
        data,
        free=shared,
        separate=separate,
        model=models_by_name(default_models(2))[JOINT_MODEL],
        num_particles=numbers,
        replicas={label: n or 1 for label, n in runs.items()},
    )
    diagnosis = jaxgran.diagnose(result)
    rows = joint_rows(result, diagnosis)
    print_joint_fit(result, rows)
    print_alternatives(rows[0]["parameter"], diagnosis)
    print_verdict(diagnosis)
    agree = float(result.p_value) > SIGNIFICANCE
    summary = {
        **{row["parameter"]: row["estimate"] for row in rows},
        **{f"{row['parameter']}_std_err": row["std_err"] for row in rows},
        **{f"{row['parameter']}_low": row["low"] for row in rows},
        **{f"{row['parameter']}_high": row["high"] for row in rows},
        "model": options.model,
        "agree": agree,
        "p_value": float(result.p_value),
        "converged": bool(result.converged),
        "explains": diagnosis.explains,
        "seconds": round(time.perf_counter() - started, 2),
    }
    summary = finite_or_null(summary)
    details = {
        "weight": {label: x.tolist() for label, x in result.weights().items()},
        "chi2": {label: _chi2(c) for label, c in result.comparisons.items()},
        "parameters": rows,
        "diagnosis": {"verdict": diagnosis.verdict, "reasons": diagnosis.reasons},
        "alternatives": [alternative_as_json(x) for x in diagnosis.alternatives],
        **environment(),
    }
    text = json.dumps(finite_or_null(summary | details), indent=2, allow_nan=False) + "\n"
    record.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(record, lambda f: f.write(text.encode()))
    fitted = result.curve if isinstance(result.curve, dict) else {}
    plotted = {label: (data[label], curve) for label, curve in fitted.items()}
    plotting.save_curves(plotted, diagnosis.verdict, picture)
    print(f"\nwritten  {picture}\n         {record}\n")
    print(json.dumps(summary, allow_nan=False))


def _chi2(comparison) -> float:
    return sum(float(np.sum(np.asarray(x) ** 2)) for x in comparison.residuals.values())


def joint_rows(result, diagnosis) -> list[dict]:
    """Return estimate, error and range of each parameter of several measurements."""
    rows = []
    for name in result.names:
        label, _, short = name.rpartition(": ")
        key, unit = PARAMETERS[short].symbol, PARAMETERS[short].unit
        low, high = range_over_alternatives(diagnosis, name)
        rows.append(
            {
                "parameter": f"{label}: {key}" if label else key,
                "unit": unit,
                "estimate": float(result.value(name)[0]),
                "std_err": float(result.value(name)[1]),
                "low": low,
                "high": high,
            }
        )
    return rows


def _label(path: Path, taken: dict) -> str:
    """Return the stem of a file, or its whole path if the stem is taken."""
    return path.stem if path.stem not in taken else str(path)


def print_joint_fit(result, rows: list[dict]) -> None:
    """Print the estimates, and the misfit and the weight of each measurement."""
    width = max(10, *(len(f"{row['parameter']} {row['unit']}") + 1 for row in rows))
    print(f"{'':{width}}{'estimate':>13} {'+-':>10} {'95 % incl. alternatives':>24}")
    for row in rows:
        limits = f"{row['low']:.3g} .. {row['high']:.3g}"
        limits = "not computed" if np.isnan(row["low"]) else limits
        print(f"{row['parameter'] + ' ' + row['unit']:{width}}{row['estimate']:13.5g} ", end="")
        print(f"{row['std_err']:10.2g} {limits:>24}")
    width = max(map(len, result.comparisons))
    print(f"\n{'':{width}}  points    chi^2  weight in {rows[0]['parameter']}")
    for label, weight in result.weights().items():
        comparison = result.comparisons[label]
        points = sum(int(np.sum(np.asarray(x) != 0)) for x in comparison.residuals.values())
        print(f"{label:{width}}  {points:6d}  {_chi2(comparison):7.1f}  {weight[0]:.2f}")
    agreement = "do not contradict" if float(result.p_value) > SIGNIFICANCE else "contradict"
    print(f"\nThe measurements {agreement} each other (p = {float(result.p_value):.2g}).")
