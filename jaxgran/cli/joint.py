"""The joint fit of several measured curves and drop tests of one material, from files."""

import dataclasses
import json
import time
from pathlib import Path

import numpy as np

import jaxgran
from jaxgran import plotting
from jaxgran.cli.fit import PARAMETERS, FitOptions, with_given_constant
from jaxgran.cli.models import MODELS, named
from jaxgran.cli.output import environment, finite_or_null, outputs, settings
from jaxgran.data.drop_test import DropTest
from jaxgran.data.files import write_whole
from jaxgran.data.header import header_count
from jaxgran.fitting.few_replicas import smooth_errors
from jaxgran.fitting.joint import JointFit
from jaxgran.models.selection import default_models

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
    (model,) = (named(default_models(2))[name] for name in MODELS[:1])
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
    write_whole(record, lambda f: f.write(text.encode()))
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
