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
from jaxgran.data.curve_file import GUESS, DropTest
from jaxgran.data.files import header_count, header_number, write_atomically
from jaxgran.fitting.fit import JointFit, free_by_default
from jaxgran.fitting.residuals import smooth_errors, unused_rotation
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
    needs = f"needs {alternative.error_reduction_needed:.2g}x smaller errors"
    if np.isfinite(alternative.decades):
        needs += f" or a {10**alternative.decades:.0f}x longer decay"
    return f"no ({needs})"


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
    measurements, first_gas = {}, None
    for path in curves:
        curve, header = jaxgran.read_curve(path)
        header |= parse_settings(options.set)
        gas = with_given_constant(gas_of(header, free), header, free)
        first_gas = gas if first_gas is None else first_gas
        curve, _ = smooth_errors(curve, header_count(header, "replicas") or 1)
        measurements[_label(path, measurements)] = gas, curve
    for path in options.drop_test:  # of spheres like those of the first curve
        test = jaxgran.read_drop_test(path, onto_plate=options.onto_plate)
        measurements[_label(path, measurements)] = first_gas, test
    model = models_by_name(default_models(2))[JOINT_MODEL]
    result = jaxgran.fit_jointly(measurements, shared=shared, separate=separate, model=model)
    summary = {
        **{key: result.estimate.get(BY_SYMBOL[key].name) for key in free},
        **{f"{key}_std_err": result.standard_error.get(BY_SYMBOL[key].name) for key in free},
    }
    summary = {key: float(x) for key, x in summary.items() if x is not None}
    summary |= {
        "model": options.model,
        "agree": bool(result.agree),
        "p_value": float(result.p_value),
        "converged": bool(result.converged),
        "seconds": round(time.perf_counter() - started, 2),
    }
    summary = finite_or_null(summary)
    details = {
        "weight": result.weight,
        "chi2": result.chi2,
        "decrease": result.decrease,
        "separate": result.separate,
        **environment(),
    }
    text = json.dumps(finite_or_null(summary | details), indent=2, allow_nan=False) + "\n"
    record.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(record, lambda f: f.write(text.encode()))
    agreement = "do not contradict" if result.agree else "contradict"
    title = f"{', '.join(measurements)}: the measurements {agreement} each other"
    plotting.save_curves(_fitted_curves(result, measurements, model), title, picture)
    print_joint_fit(result, measurements, {BY_SYMBOL[key].name: key for key in free})
    print(f"\nwritten  {picture}\n         {record}\n")
    print(json.dumps(summary, allow_nan=False))


def _label(path: Path, taken: dict) -> str:
    """Return the stem of a file, or its whole path if the stem is taken."""
    return path.stem if path.stem not in taken else str(path)


def _fitted_curves(result: JointFit, measurements: dict, model) -> dict:
    """Return each measured curve and the fitted one, by label."""
    curves = {}
    for label, (gas, measured) in measurements.items():
        if isinstance(measured, DropTest):
            continue
        separate = {name: value for name, (value, _) in result.separate.get(label, {}).items()}
        values = result.estimate | separate
        start = float(values.pop("t0", 0.0))
        fitted = gas.replace(**{name: x for name, x in values.items() if name in gas.domains})
        times = np.asarray(measured.times)
        times = times[times >= start]
        computed = jaxgran.cool(fitted, times - start, model=model)
        curves[label] = measured, dataclasses.replace(computed, times=times)
    return curves


def print_joint_fit(result: JointFit, measurements: dict, keys: dict[str, str]) -> None:
    """Print shared values, the weight of each measurement, and whether the measurements agree."""
    print(f"{'':10}{'estimate':>13} {'+-':>10}")
    for name, estimate in result.estimate.items():
        key = keys[name]
        error = float(result.standard_error[name])
        print(f"{key:3} {PARAMETERS[name].unit:5} {float(estimate):13.5g} {error:10.2g}")
    width = max(map(len, measurements))
    shared = list(result.estimate)
    print(
        f"\n{'':{width}}  points    chi^2  decrease  weight in {', '.join(keys[x] for x in shared)}"
    )
    for label, (_, data) in measurements.items():
        points = np.size(data.restitution if isinstance(data, DropTest) else data.times)
        weights = ", ".join(f"{result.weight[label][name]:.2f}" for name in shared)
        print(f"{label:{width}}  {points:6d}  {result.chi2[label]:7.1f}", end="")
        print(f"  {result.decrease[label]:8.1f}  {weights}")
        for name, (value, error) in result.separate.get(label, {}).items():
            unit = PARAMETERS[name].unit
            print(f"{'':{width}}  {keys[name]} = {value:.5g} +- {error:.2g} {unit}")
    agreement = "do not contradict" if result.agree else "contradict"
    print(f"\nThe measurements {agreement} each other (p = {result.p_value:.2g}).")
