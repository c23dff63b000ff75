"""The fit of a measured curve, from a file to a table, a picture and a JSON file.

What the commands print.

The joint fit of several measured curves and drop tests of one material, from files.
"""

import dataclasses
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
from jaxgran.cli.common import (
    MODELS,
    alternative_as_json,
    choose_or_make_model,
    environment,
    finite_or_null,
    models_by_name,
    outputs,
    settings,
)
from jaxgran.data.curve_file import DropTest
from jaxgran.data.files import header_count, header_number, write_atomically
from jaxgran.fitting.fit import JointFit, free_by_default
from jaxgran.fitting.residuals import smooth_errors, unused_rotation
from jaxgran.models.choose import default_models


def print_scene(options: Any, gas, curve, header, result) -> None:
    """The curve and the gas that was fitted to it."""
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


def print_warnings(warned, unused: str | None) -> None:
    """Warnings of the input, and what of it was not used."""
    for doubt in [*(warning.message for warning in warned), *([unused] if unused else [])]:
        print(f"check    {doubt}")


def print_impacts(gas, last_T: float, num_particles: int | None) -> None:
    """What the fitted A means: eps at the rms impact speeds of the first and of the last T."""
    first, last = (float(gas.restitution(np.sqrt(2 * T))) for T in (gas.temperature, last_T))
    print(f"impacts  eps = {first:.3g} at the thermal speed of t = 0, {last:.3g} at the last one;")
    print(f"         mean free path {1e3 * float(gas.mean_free_path):.3g} mm", end="")
    if num_particles is not None:
        box = 1e3 * float(gas.box_side(num_particles))
        shape = "cube" if gas.dimension == 3 else "square"
        print(f", in a box of {box:.3g} mm if it is a {shape}", end="")
    print()
    if isinstance(gas.law, jaxgran.Viscoelastic):
        print("         A and Y enter as A Y^(2/5) where contacts are short: 10 % in Y is 4 % in A")


def print_model(name: str, result, reasons) -> None:
    """The model, its steps and why it was chosen."""
    steps = "simulations" if result.model.stochastic else "steps of least squares"
    print(f"model    {name}, {int(result.iterations)} {steps}")
    if reasons:
        print("chosen", "\n".join(f"         - {reason}" for reason in reasons).lstrip())


def print_rows(rows: list[dict]) -> None:
    """The table of estimates."""
    print(f"\n{'':10}{'estimate':>13} {'+-':>10} {'95 %, with alternatives':>24}  header's")
    for row in rows:
        print(f"{row['parameter']:4}{row['unit']:6}", end="")
        if np.isnan(row["estimate"]):
            print(f"{'not determined':>13}")
            continue
        between = f"{row['low']:.3g} .. {row['high']:.3g}"
        between = "not looked for" if np.isnan(row["low"]) else between
        print(f"{row['estimate']:13.5g} {row['std_err']:10.2g} {between:>24}", end="")
        if row["header"]:
            print(f"  {row['header']:.5g} ({100 * (row['estimate'] / row['header'] - 1):+.2f} %)")
        else:
            print()


PARTS = {
    "measurement": "errors of the points, with the correlation of neighbours",
    "model": "the model's clock in this scene",
    "few particles": "chance of the collisions of N particles",
    "slope": "derivatives through particles: too large where the gas has a flow, or noisy",
    "simulation": "noise of the simulations that the fit made",
}
"""What a part of the error budget is; the others are named after what is uncertain."""


def print_budget(rows: list[dict], explain: bool) -> None:
    """The parts of each error, in per cent of the estimate, the largest first; of t0 in ms."""
    for row in rows:
        if np.isnan(row["estimate"]):
            continue
        parts = sorted(row["error_budget"].items(), key=lambda part: -part[1])
        is_time = row["parameter"] == "t0"  # which may be 0
        over, unit = (1e-3, "ms") if is_time else (abs(row["estimate"]) / 100, "%")
        shares = [(name, x / over) for name, x in parts if x > 0]
        if not explain:
            line = ", ".join(f"{name} {share:.2g} {unit}" for name, share in shares)
            print(f"error of {row['parameter']}: {line}")
            continue
        words = "ms" if is_time else "per cent"
        print(f"\nerror of {row['parameter']}, in {words}; the squares of the parts add up")
        for name, share in shares:
            print(f"  {share:8.2g}  {name}: {PARTS.get(name, 'its error as given, or as known')}")


def print_alternatives(name: str, diagnosis) -> None:
    """The laws that were compared, how much better they fit, and what the first parameter is."""
    if not diagnosis.alternatives:
        return
    width = max(len(rival.name) for rival in diagnosis.alternatives)
    print(f"\n{'with, besides':{width}}  chi^2 less {name:>9} {'95 %':>20}  told apart")
    for rival in diagnosis.alternatives:
        between = f"{rival.low[0]:.3g} .. {rival.high[0]:.3g}"
        told = (
            "yes"
            if rival.distinguishable
            else f"no: errors {rival.error_reduction_needed:.2g} x smaller would"
        )
        if not rival.distinguishable and np.isfinite(rival.decades):
            told += f", or T followed to 1/{10**rival.decades:.2g} of its last"
        told = "the curve asks for it" if rival.preferred else told
        print(f"{rival.name:{width}}  {rival.improvement:10.2g}", end="")
        print(f" {rival.estimate[0]:9.3g} {between:>20}  {told}")


def print_verdict(diagnosis) -> None:
    """What the fit is worth, and why."""
    print(f"\n{diagnosis.verdict}")
    for reason in diagnosis.reasons:
        print(f"  - {reason}")


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


MAX_KEY = 2**63
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
    model, reasons = choose_or_make_model(options, gas, curve, free, n)
    (model_name,) = models_by_name([model])
    imported = time.perf_counter() - started
    asked = {"free": free, "priors": priors, "num_particles": n, "replicas": replicas}
    result, first_seconds, fit_seconds = timed_fit(options, gas, curve, model, asked)
    diagnosis = jaxgran.diagnose(result, curve, n)
    rows = rows_of(options, result, diagnosis, header)
    print_scene(options, gas, curve, header, result)
    print_warnings(doubts, unused_rotation(gas, curve))
    print_impacts(result.gas, float(curve.temperature[-1]), n)
    print_model(model_name, result, reasons)
    print_rows(rows)
    print_budget(rows, options.explain)
    print_alternatives(rows[0]["parameter"], diagnosis)
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
        "rivals": [alternative_as_json(rival) for rival in diagnosis.alternatives],
        "import_seconds": round(imported, 2),
        **environment(),
    }
    summary = finite_or_null(summary)
    text = json.dumps(finite_or_null(summary | details), indent=2, allow_nan=False) + "\n"
    write_atomically(record, lambda f: f.write(text.encode()))
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
    if abs(options.key) >= MAX_KEY:
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


OF_ONE_SCENE = {"temperature", "packing_fraction", "diameter", "rotational_temperature"} | {
    "wall_side",
    "drag_rate",
    "drive_strength",
    "t0",
}
"""Floats that each curve has for itself; the others are of the material, and shared."""


def run_joint(
    curves: list[Path], drops: list[Path], onto_plate: bool, options: FitOptions, started: float
) -> None:
    """Fit, print and write; `started` is when the clock of the whole job began."""
    if options.model not in MODELS[:1]:
        raise ValueError(
            f"--model {options.model}: several measurements are fitted with {MODELS[0]}; fit the "
            "curves one by one with other models"
        )
    picture, record = outputs(options)
    free = options.free or ["A", "T0"]
    names = [PARAMETERS[key][0] for key in free]
    shared = tuple(name for name in names if name not in OF_ONE_SCENE)
    separate = tuple(name for name in names if name in OF_ONE_SCENE)
    if not shared:
        raise ValueError(f"--free {' '.join(free)}: curves share none of these; free A")
    files = [path.resolve() for path in (*curves, *drops)]
    if twice := [str(path) for path in files if files.count(path) > 1]:
        raise ValueError(f"{twice[0]} is given twice; a measurement counts once")
    measurements, gas = {}, None
    for path in curves:
        curve, header = jaxgran.read_curve(path)
        header |= settings(options.set)
        own = with_given_constant(jaxgran.read_gas(header), header, free)
        gas = own if gas is None else gas
        curve, _ = smooth_errors(curve, header_count(header, "replicas") or 1)
        measurements[_label(path, measurements)] = own, curve
    for path in drops:  # of spheres like those of the first curve
        test = jaxgran.read_drop_test(path, onto_plate=onto_plate)
        measurements[_label(path, measurements)] = gas, test
    (model,) = (models_by_name(default_models(2))[name] for name in MODELS[:1])
    found = jaxgran.fit_jointly(measurements, shared=shared, separate=separate, model=model)
    _print(found, measurements, {PARAMETERS[key][0]: key for key in free})
    summary = {
        **{key: found.estimate.get(PARAMETERS[key][0]) for key in free},
        **{f"{key}_std_err": found.standard_error.get(PARAMETERS[key][0]) for key in free},
    }
    summary = {key: float(x) for key, x in summary.items() if x is not None}
    summary |= {"model": options.model, "agree": bool(found.agree), "p_value": float(found.p_value)}
    summary |= {"converged": bool(found.converged)}
    summary |= {"seconds": round(time.perf_counter() - started, 2)}
    summary = finite_or_null(summary)
    details = {
        "weight": found.weight,
        "chi2": found.chi2,
        "decrease": found.decrease,
        "separate": found.separate,
        **environment(),
    }
    text = json.dumps(finite_or_null(summary | details), indent=2, allow_nan=False) + "\n"
    record.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(record, lambda f: f.write(text.encode()))
    says = "do not contradict" if found.agree else "contradict"
    title = f"{', '.join(measurements)}: the measurements {says} each other"
    plotting.save_curves(_fitted(found, measurements, model), title, picture)
    print(f"\nwritten  {picture}\n         {record}\n")
    print(json.dumps(summary, allow_nan=False))


def _fitted(found: JointFit, measurements: dict, model) -> dict:
    """The measured curves by label, each with the one computed for it."""
    curves = {}
    for label, (gas, measured) in measurements.items():
        if isinstance(measured, DropTest):
            continue
        own = {name: value for name, (value, _) in found.separate.get(label, {}).items()}
        values = found.estimate | own
        start = float(values.pop("t0", 0.0))
        fitted = gas.replace(**{name: x for name, x in values.items() if name in gas.domains})
        later = np.asarray(measured.times)
        later = later[later >= start]
        computed = jaxgran.cool(fitted, later - start, model=model)
        curves[label] = measured, dataclasses.replace(computed, times=later)
    return curves


def _label(path: Path, taken: dict) -> str:
    """The name of a measurement: its file's, and its folder's where that is taken."""
    return path.stem if path.stem not in taken else str(path)


def _print(found: JointFit, measurements: dict, keys: dict[str, str]) -> None:
    """Shared values, what each measurement weighs, and whether they agree."""
    print(f"{'':10}{'estimate':>13} {'+-':>10}")
    for name, estimate in found.estimate.items():
        key = keys[name]
        error = float(found.standard_error[name])
        print(f"{key:4}{PARAMETERS[key][1]:6}{float(estimate):13.5g} {error:10.2g}")
    width = max(map(len, measurements))
    shared = list(found.estimate)
    print(
        f"\n{'':{width}}  points    chi^2  decrease  weight in {', '.join(keys[x] for x in shared)}"
    )
    for label, (_, data) in measurements.items():
        points = np.size(data.restitution if isinstance(data, DropTest) else data.times)
        weights = ", ".join(f"{found.weight[label][name]:.2f}" for name in shared)
        print(f"{label:{width}}  {points:6d}  {found.chi2[label]:7.1f}", end="")
        print(f"  {found.decrease[label]:8.1f}  {weights}")
        for name, (value, error) in found.separate.get(label, {}).items():
            unit = PARAMETERS[keys[name]][1]
            print(f"{'':{width}}  {keys[name]} = {value:.5g} +- {error:.2g} {unit}")
    says = "do not contradict" if found.agree else "contradict"
    print(f"\nThe measurements {says} each other (p = {found.p_value:.2g}).")
