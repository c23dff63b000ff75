"""The command `jaxgran fit`: one measurement, or several of one material.

Reads files, prints tables, and writes a picture and a JSON file.
"""

import json
import os
import platform
import time
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from jaxgran import plotting
from jaxgran.cli.common import FitOptions, models_by_name
from jaxgran.data.curve_file import GUESS, GUESSES, OPTIONAL_KEYS, PRIOR_KEYS, read_drops
from jaxgran.data.files import header_count, header_number, write_atomically
from jaxgran.data.tables import header_in_si
from jaxgran.fitting.fit import free_by_default
from jaxgran.fitting.residuals import unused_rotation
from jaxgran.fitting.result import CONDITIONAL, SIGNIFICANCE
from jaxgran.models.choose import default_models
from jaxgran.scene.parameters import BY_SYMBOL, MATERIAL, PARAMETERS, SCENE, symbol_of, unit_of

JOINT_MODEL = "kinetic-theory"
"""The only model of fits of drop tests and of several measurements: kinetic theory."""

ANY_GAS = {"eta": "0.1", "T0": "1"}
"""Header keys that single impacts do not depend on."""


def run_fit(paths: Sequence[Path], options: FitOptions, started: float) -> None:
    """Fit curves and drop tests of one material, print the result and write it.

    Args:
        paths: files of cooling curves.
        options: of the command.
        started: start of the job on the clock `time.perf_counter`.
    """
    files = (*paths, *options.drop_test)
    resolved, several = [path.resolve() for path in files], len(files) > 1
    if repeated := [str(path) for path in resolved if resolved.count(path) > 1]:
        raise ValueError(f"{repeated[0]} is given twice. Give each measurement once.")
    if (several or not paths) and options.model != JOINT_MODEL:
        raise ValueError(
            f"--model {options.model}: drop tests and several measurements are fitted with "
            f"{JOINT_MODEL}. Fit the curves one by one with other models."
        )
    picture, record = output_files(files[0].stem, options)
    free = options.free or (("A", "T0") if several else ())
    if free and all(BY_SYMBOL[key].belongs_to == SCENE for key in free) and several:
        raise ValueError(f"--free {' '.join(free)}: the curves share none of these. Add A.")
    gases, data, headers, priors = {}, {}, {}, {}
    for path in files:
        label = path.stem if path.stem not in data else str(path)
        if path in options.drop_test:
            data[label], header = read_drops(path, options.onto_plate)
            if paths:  # of spheres like those of the first curve
                gases[label] = next(iter(gases.values()))
                continue
            header = ANY_GAS | header
        else:
            data[label], header = jaxgran.read_curve(path)
        header |= parse_settings(options.set)
        if options.absent:
            header["absent"] = " ".join((header.get("absent", ""), *options.absent))
        gas = gas_of(header, free)
        free = free or tuple(map(symbol_of, free_by_default(gas, data[label])))
        if "A" not in free:
            if "A" not in header:
                raise ValueError(
                    f"--free {' '.join(free)} leaves A fixed, and the file does not give it. Add "
                    "--set A=VALUE (in s), or free A too."
                )
            gas = gas.replace(dissipative_constant=header_number(header, "A"))
        gases[label], headers[label] = gas, header
        if path in paths and "N" not in header and (unused := unused_rotation(gas, data[label])):
            warnings.warn(unused, stacklevel=2)
        for name, pair in jaxgran.read_priors(header).items():
            shared = name != "density" and PARAMETERS[name].belongs_to == MATERIAL
            priors.setdefault(f"{label}: {name}" if several and not shared else name, pair)
    declared = [jaxgran.read_absent(header) for header in headers.values()]
    arguments: dict[str, Any] = {
        "absent": tuple(x for x in declared[0] if all(x in others for others in declared)),
        "free": tuple(BY_SYMBOL[key].name for key in free),
        "num_particles": {label: header_count(header, "N") for label, header in headers.items()},
        "priors": priors,
        "replicas": {k: header_count(h, "replicas") or 1 for k, h in headers.items()},
    }
    label, model, reasons = next(iter(data)), jaxgran.KineticTheory(), ()
    if several:
        scene_names = [BY_SYMBOL[key].name for key in free if BY_SYMBOL[key].belongs_to == SCENE]
        arguments["separate"] = tuple(scene_names)
        arguments["free"] = tuple(x for x in arguments["free"] if x not in scene_names)
        measured = gases, data
    else:
        arguments |= {key: arguments[key][label] for key in ("num_particles", "replicas")}
        measured = gases[label], data[label]
        N = arguments["num_particles"]
        model, reasons = choose_or_make_model(options, files[0], *measured, arguments["free"], N)
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the diagnosis repeats them
        key = jax.random.key(options.key) if model.stochastic else None
        result = jaxgran.fit(*measured, model=model, key=key, **arguments)
        jax.block_until_ready(result.chi2)
    fit_seconds = time.perf_counter() - begin
    diagnosis = jaxgran.diagnose(result, quick=options.quick)
    rows = [_row(name, result, diagnosis, headers) for name in result.names]
    (model_name,) = models_by_name([model])
    entries = ("", "estimate"), ("_low", "low"), ("_high", "high"), ("_std_err", "std_err")
    agree = {"agree": float(result.p_value) > SIGNIFICANCE} if several else {}
    summary = as_json(
        {
            **{f"{row['parameter']}{end}": row[key] for row in rows for end, key in entries},
            "verdict": diagnosis.grade,
            "model": model_name,
            "reduced_chi2": round(float(result.reduced_chi2), 4),
            "p_value": float(result.p_value),
            **agree,
            "converged": bool(result.converged),
            "seconds": round(time.perf_counter() - started, 2),
            "fit_seconds": round(fit_seconds, 4),
        }
    )
    details = {
        "headline": diagnosis.headline,
        "narrowing": diagnosis.narrowing,
        "diagnosis": {"verdict": diagnosis.verdict, "reasons": diagnosis.reasons},
        "alternatives": [alternative._asdict() for alternative in diagnosis.alternatives],
        "parameters": rows,
        "covariance": result.covariance,
        "weight": result.weights(),
        "chosen": reasons,
        "header": headers if several else headers[label],
        "versions": {name: version(name) for name in ("jaxgran", "jax", "diffrax", "optimistix")},
        "python": platform.python_version(),
        "device": jax.devices()[0].device_kind,
    }
    picture.parent.mkdir(parents=True, exist_ok=True)
    title = f"{label.replace('_', ' ')}: {diagnosis.headline}"
    if several:
        fitted = {key: (data[key], curve) for key, curve in result.curve.items()}
        plotting.save_curves(fitted, diagnosis.headline, picture)
    elif paths:
        plotting.save_fit(result, data[label], title, picture)
    text = json.dumps(summary | as_json(details), indent=2, allow_nan=False) + "\n"
    write_atomically(record, lambda f: f.write(text.encode()))

    print("\n".join(filter(None, (diagnosis.headline, diagnosis.narrowing, diagnosis.verdict))))
    for label, header in headers.items():
        gas = result.gas[label] if several else result.gas
        print_scene(label, gas, data[label], header)
    steps = "simulations" if model.stochastic else "steps of least squares"
    print(f"model    {model_name}, {int(result.iterations)} {steps}")
    for i, reason in enumerate(reasons):
        print(f"{'' if i else 'chosen':9}- {reason}")
    print_parameters(rows)
    print_budget(rows, options.explain)
    print_alternatives(rows[0]["parameter"], diagnosis)
    if several:
        agreement = "do not contradict each other"
        if not agree["agree"]:
            agreement = "contradict each other, or the model"
        print(f"\nThe measurements {agreement} (p = {float(result.p_value):.2g}).")
    print("\n" + "\n".join(f"  - {reason}" for reason in diagnosis.reasons))
    print("\nwritten  " + "\n         ".join(map(str, (picture, record)[not paths :])) + "\n")
    print(json.dumps(summary, allow_nan=False))


def choose_or_make_model(options: FitOptions, path: Path, gas, curve, free, num_particles):
    """Return the model, and the reasons for it if it was chosen automatically."""
    size = num_particles if options.particles is None else options.particles
    replicas = options.replicas
    if options.model != "auto":
        model = models_by_name(default_models(2 if size is None else size, replicas))[options.model]
        if model.stochastic and size is None:
            raise ValueError(f"{path} does not give N. Add --particles.")
        return model, ()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the diagnosis of the final fit repeats them
        first = jaxgran.fit(gas, curve, free=free)
    choice = jaxgran.choose_model(
        first.gas,
        curve.times,
        options.tolerance,
        size if num_particles is None else num_particles,
        replicas=replicas,
    )
    if options.particles is None:
        return choice.model, choice.reasons
    # The choice is for the box of the file's N; the run has the number of particles given.
    (name,) = models_by_name([choice.model])
    return models_by_name(default_models(options.particles, replicas))[name], choice.reasons


def parse_settings(pairs: Sequence[str]) -> dict[str, str]:
    """Return header values from KEY=VALUE arguments."""
    known = (*BY_SYMBOL, *PRIOR_KEYS, *OPTIONAL_KEYS)
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in known:
            raise ValueError(f"--set {pair}: give KEY=VALUE with KEY one of {', '.join(known)}")
        values[key] = value
    try:
        return header_in_si(values)
    except ValueError as error:
        raise ValueError(f"--set: {error}") from None


def gas_of(header: dict[str, str], free: Sequence[str]) -> jaxgran.Gas:
    """Return the gas of a header, with an element to start from for each free parameter.

    Raises:
        ValueError: for a free parameter that the header does not describe, or a guess that is not
            fitted.
    """
    header = dict(header)
    if "beta_t" in free and {"reduced_inertia", "T_rot_0"} & header.keys():
        header.setdefault("beta_t", GUESS)
    if guessed := [key for key in GUESSES if header.get(key) == GUESS and key not in free]:
        raise ValueError(
            f"the file asks for a fit of {guessed[0]}: add --free A {guessed[0]}, or give its value"
        )
    gas = jaxgran.read_gas(header)
    for key in free:
        if BY_SYMBOL[key].name not in (*gas.domains, "t0"):
            start = f"`# {key}: {GUESS if key in GUESSES else 'VALUE'}` to the file"
            raise ValueError(
                f"--free {key}: the file gives no {key}. Add {start}, or --set "
                f"{key}={f'{GUESSES[key]:g}' if key in GUESSES else 'VALUE'}"
            )
    return gas


def output_files(name: str, options: FitOptions) -> tuple[Path, Path]:
    """Return the paths of the picture and the JSON file, by default in a new folder.

    Args:
        name: of the curve.
        options: of the command.

    Raises:
        ValueError: if the folder cannot be written to, or if a file exists and may not be replaced.
    """
    stem = f"{name}-{options.model}"
    folder = options.out
    if folder is None:
        folder, i = Path("results") / stem, 2
        while folder.exists():
            folder, i = Path("results") / f"{stem}-{i}", i + 1
    existing = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ValueError(f"{existing} is not a writable folder. Name another one with --out.")
    files = folder / f"{stem}.png", folder / f"{stem}.json"
    for file in files:
        if file.exists() and not options.overwrite:
            raise ValueError(f"{file} exists. Name another --out, or add --overwrite.")
    return files


def as_json(value: Any) -> Any:
    """Return dictionaries and lists as JSON takes them: lists for arrays, None for nan and inf."""
    if isinstance(value, dict):
        return {key: as_json(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        value = np.asarray(value).tolist()
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _row(name: str, result: Any, diagnosis: Any, headers: dict[str, dict[str, str]]) -> dict:
    """Return estimate, errors, range and value in the file of a free parameter."""
    label, _, short = name.rpartition(": ")
    header = headers[label] if label else next(iter(headers.values()))
    key, (estimate, error) = symbol_of(short), map(float, result.value(name))
    if name in result.undetermined():
        estimate = error = float("nan")
    low, high = (float(np.squeeze(x)) for x in diagnosis.ranges.get(name, (np.nan, np.nan)))
    i = result.names.index(name)
    return {
        "parameter": symbol_of(name),
        "unit": unit_of(name),
        "estimate": estimate,
        "std_err": error,
        "error_budget": {part: float(x[i]) for part, x in result.error_budget.items()},
        "low": low,
        "high": high,
        "header": None if header.get(key, GUESS) == GUESS else header_number(header, key),
    }


def print_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print columns below their heads, the first one aligned to the left."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    print()
    for row in (head, *rows):
        cells = [f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)]
        print("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())


def print_scene(label: str, gas: Any, curve: Any, header: dict[str, str]) -> None:
    """Print a curve, the gas that was fitted to it, and its impacts; or a drop test."""
    if isinstance(curve, jaxgran.DropTest):
        v = np.asarray(curve.speed)
        print(f"\ndrops    {label}: {v.size} impacts, v = {v.min():.3g} .. {v.max():.3g} m/s")
        return
    T, N, times = np.asarray(curve.temperature), header_count(header, "N"), curve.times
    print(f"\ncurve    {label}: {T.size} points, t = {times[0]:.6g} .. {times[-1]:.6g} s,")
    print(f"         T falls to {T[-1] / T[0]:.3g} of its first value")
    if "T_from" in header:
        print(f"         {header['T_from']}")
    scales = _scales(gas, T[-1], N or 1)
    phi, tau, contact, beta, first, last, path, side = map(float, scales)
    print(
        f"gas      phi = {phi:.3g}, tau_c = {tau:.3g} s, t_c/tau_c = {contact:.2g}, "
        f"beta_T0 = {beta:.3g} (fitted)"
    )
    print(f"impacts  eps = {first:.3g} at the thermal speed of t = 0, {last:.3g} at the last one;")
    print(f"         mean free path {1e3 * path:.3g} mm", end="")
    if N is not None:
        shape = "cube" if gas.dimension == 3 else "square"
        print(f", in a box of {1e3 * side:.3g} mm if it is a {shape}", end="")
    print("\n         short contacts depend on A Y^(2/5) only: 10 % in Y is 4 % in A")


@eqx.filter_jit
def _scales(gas: jaxgran.Gas, last: Any, N: int) -> tuple[Any, ...]:
    speeds = jnp.sqrt(2 * jnp.stack([gas.temperature, jnp.asarray(last)]))
    first, last = gas.restitution(speeds)
    now = gas.packing_fraction, gas.mean_free_time, gas.contact_fraction, gas.thermal_beta
    return *now, first, last, gas.mean_free_path, gas.box_side(N)


def print_parameters(rows: list[dict]) -> None:
    """Print the ranges and the estimates."""
    cells = []
    for row in rows:
        low, high, estimate = row["low"], row["high"], row["estimate"]
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
    print_table(("", "95 % incl. alternatives", CONDITIONAL, "in file"), cells)


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
        is_time = row["parameter"].endswith("t0")  # which may be 0
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


def print_alternatives(name: str, diagnosis: Any) -> None:
    """Print the alternatives: their improvement of chi^2 and the values of the first parameter."""
    cells = []
    for x in diagnosis.alternatives:
        needed = f"no (needs {x.error_reduction_needed:.2g}x smaller errors)"
        answer = "preferred by the data" if x.preferred else "yes" if x.distinguishable else needed
        limits = f"{x.low[0]:.3g} .. {x.high[0]:.3g}"
        cells.append((x.name, f"{x.improvement:.2g}", f"{x.estimate[0]:.3g}", limits, answer))
    if cells:
        head = "alternative explanation", "chi^2 drop", name, "95 %", "distinguishable"
        print_table(head, cells)
