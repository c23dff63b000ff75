"""The command `jaxgran fit`: one measurement, or several of one material.

Reads files, fits them, prints a report, and writes a picture and a JSON file.
"""

import dataclasses
import json
import os
import platform
import tempfile
import time
import warnings
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxgran
from jaxgran import plotting
from jaxgran._utils.extras import import_extra
from jaxgran.cli.common import FitOptions, models_by_name
from jaxgran.cli.page import (
    Section,
    command_of,
    question_of,
    sections_of_fit,
    sections_of_plan,
    write_page,
)
from jaxgran.data.drop_test import DropTest
from jaxgran.data.files import name_in_errors
from jaxgran.data.header_keys import OPTIONAL_KEYS, PRIOR_KEYS
from jaxgran.data.header_lines import header_in_si
from jaxgran.data.measurement_header import absent_of_header
from jaxgran.data.units import UNIT_KEYS
from jaxgran.fitting.messages import NOT_DETERMINED, SIGNIFICANCE
from jaxgran.fitting.report import parameter_rows, report
from jaxgran.models.choose import default_models
from jaxgran.scene.parameters import BY_SYMBOL, SCENE

JOINT_MODEL = "kinetic-theory"
"""The only model of fits of drop tests and of several measurements: kinetic theory."""


def run_fit(paths: Sequence[Path], options: FitOptions, started: float) -> None:
    """Fit curves and drop tests of one material, print the result and write it.

    Args:
        paths: files of cooling curves.
        options: of the command.
        started: start of the job on the clock `time.perf_counter`.
    """
    files = (*paths, *options.drop_test)
    resolved = [path.resolve() for path in files]
    if repeated := [str(path) for path in resolved if resolved.count(path) > 1]:
        raise ValueError(f"{repeated[0]} is given twice. Give each measurement once.")
    is_single = len(files) == 1 and not options.impacts
    if not (is_single and paths) and options.model != JOINT_MODEL:
        raise ValueError(
            f"--model {options.model}: drop tests and several measurements are fitted with "
            f"{JOINT_MODEL}. Fit the curves one by one with other models."
        )
    if options.impacts and not paths:
        raise ValueError(
            "--impacts needs tracks of particles, and drop tests have none. Give a file of tracks, "
            "or leave out --impacts."
        )
    if options.report:
        import_extra("jinja2", "report")  # before the long part
    picture, record = output_files(files[0].stem, options)
    measurements = read_all(paths, options)
    request = parameters_of(options, measurements)
    model, chosen = choose_or_make_model(options, files[0], measurements, request)
    begin = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the report repeats them
        result = jaxgran.fit(
            measurements[""] if is_single else measurements,
            model=model,
            key=jax.random.key(options.key) if model.stochastic else None,
            quick=options.quick,
            **request,
        )
    fit_seconds = time.perf_counter() - begin
    summary = summary_of(result, model) | {
        "seconds": round(time.perf_counter() - started, 2),
        "fit_seconds": round(fit_seconds, 4),
    }
    picture.parent.mkdir(parents=True, exist_ok=True)
    if not is_single:
        fitted = {
            label: (m.curve, result.curve[label])
            for label, m in measurements.items()
            if result.curve[label] is not None
        }
        plotting.save_curves(fitted, result.headline, picture)
    elif paths:
        title = f"{files[0].stem.replace('_', ' ')}: {result.headline}"
        plotting.save_fit(result, title, picture)
    result.save(record, overwrite=options.overwrite, **summary, **details_of(result, chosen))
    print(report(result, explain=options.explain))
    for i, reason in enumerate(chosen):
        print(f"{'' if i else 'chosen':9}- {reason}")
    written = [record] if is_single and not paths else [picture, record]
    if options.report:
        page = record.with_suffix(".html")
        sections = sections_of_fit(result, picture if picture in written else None)
        if is_single and paths and result.grade == NOT_DETERMINED and not options.quick:
            sections[1:1] = what_to_measure_next(result)
        question = question_of(result.names[0], "fit")
        title = ", ".join(path.stem.replace("_", " ") for path in files)
        write_page(page, title, question, result.headline, sections, command_of("fit", files))
        written.append(page)
    if options.imitate:
        imitation = jaxgran.imitate(result, options.imitate, key=jax.random.key(options.key))
        print(f"\n{imitation}")
    print("\nwritten  " + "\n         ".join(map(str, written)) + "\n")
    print(json.dumps(summary, allow_nan=False))


def what_to_measure_next(result: jaxgran.Fit) -> list[Section]:
    """Return the part of a page with a plan that starts at a fit; none if N is not known."""
    measurement = result.measurements[""]
    if measurement.num_particles is None:
        return []
    planned = jaxgran.plan(measurement, free=result.names)
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "plan.png"
        plotting.save_plan(planned, planned.headline, picture)
        return sections_of_plan(planned, picture, "What to measure next")


def read_all(paths: Sequence[Path], options: FitOptions) -> dict[str, jaxgran.Measurement]:
    """Return the measurements of all files, by label; a single one has the label ""."""
    given = parse_settings(options.set)
    measurements: dict[str, jaxgran.Measurement] = {}
    drops = {"onto": "plate"} if options.onto_plate else {}
    if options.onto_plate and not options.drop_test:
        raise ValueError("--onto-plate belongs to --drop-test, which is not given.")
    is_single = len(paths) + len(options.drop_test) == 1 and not options.impacts
    for path in (*paths, *options.drop_test):
        label = path.stem if path.stem not in measurements else str(path)
        label = "" if is_single else label
        if path in paths:
            measurements[label] = jaxgran.read_measurement(path, given)
        else:
            gas = next(iter(measurements.values())).gas if paths else None  # of the first curve
            measurements[label] = jaxgran.read_measurement(path, given | drops, gas=gas)
        is_drop_test = isinstance(measurements[label].data, DropTest)
        if is_drop_test and path in paths:
            raise ValueError(f"{path} is a drop test. Give it as --drop-test {path}.")
        if not is_drop_test and path not in paths:
            raise ValueError(f"{path} is a cooling curve. Give it without --drop-test.")
        if options.impacts and path in paths:
            found = jaxgran.read_impacts(path, given).measurements
            measurements |= {f"{label} {name}": m for name, m in found.items()}
        if options.absent:
            measurements[label] = with_absent(measurements[label], options.absent)
    return measurements


def with_absent(measurement: jaxgran.Measurement, absent: Sequence[str]) -> jaxgran.Measurement:
    """Return a measurement with further effects that are known to be absent."""
    header = dict(measurement.header)
    header["absent"] = " ".join((*measurement.absent, *absent))
    return dataclasses.replace(
        measurement, absent=absent_of_header(header), header=tuple(header.items())
    )


def _constant_of(measurements: dict[str, jaxgran.Measurement]) -> str:
    """Return the symbol of the constant of the law that several measurements share."""
    gas = next(iter(measurements.values())).gas
    return "eps" if "coefficient" in gas.domains else "A"


def parameters_of(
    options: FitOptions, measurements: dict[str, jaxgran.Measurement]
) -> dict[str, Any]:
    """Return the arguments `free` and `separate` of the fit."""
    is_single = [*measurements] == [""]
    free = options.free or (() if is_single else (_constant_of(measurements), "T0"))
    of_curves = [m for m in measurements.values() if not isinstance(m.data, DropTest)]
    if free and not {"A", "eps"} & {*free}:
        for measurement in of_curves or measurements.values():
            if not {"A", "eps"} & dict(measurement.header).keys():
                raise ValueError(
                    f"--free {' '.join(free)} leaves A fixed, and the file does not give it. Add "
                    "--set A=VALUE (in s), or free A too."
                )
    if is_single:
        return {"free": free or None}
    of_scene = tuple(key for key in free if BY_SYMBOL[key].belongs_to == SCENE)
    shared = tuple(key for key in free if key not in of_scene)
    if not shared:
        raise ValueError(f"--free {' '.join(free)}: the curves share none of these. Add A.")
    return {"free": shared, "separate": of_scene}


def summary_of(result: jaxgran.Fit, model: Any) -> dict[str, Any]:
    """Return the line of JSON that the command prints."""
    entries = ("", "estimate"), ("_low", "low"), ("_high", "high"), ("_std_err", "std_err")
    rows = parameter_rows(result)
    summary: dict[str, Any] = {
        f"{row['parameter']}{end}": row[key] for row in rows for end, key in entries
    }
    (model_name,) = models_by_name([model])
    summary |= {
        "verdict": result.grade,
        "model": model_name,
        "reduced_chi2": round(result.reduced_chi2, 4),
        "p_value": result.p_value,
    }
    if len(result.measurements) > 1:
        summary["agree"] = result.p_value >= SIGNIFICANCE
    return as_json(summary | {"converged": result.converged})


def details_of(result: jaxgran.Fit, chosen: Sequence[str]) -> dict[str, Any]:
    """Return further entries of the JSON file, for people who read it."""
    headers = {label: dict(m.header) for label, m in result.measurements.items()}
    return as_json(
        {
            "headline": result.headline,
            "narrowing": result.narrowing,
            "diagnosis": {"verdict": result.verdict, "reasons": result.reasons},
            "alternatives": [alternative._asdict() for alternative in result.alternatives],
            "parameters": parameter_rows(result),
            "covariance": result.covariance,
            "weight": result.weights,
            "chosen": list(chosen),
            "header": headers.get("", headers),
            "versions": {name: version(name) for name in ("jaxgran", "jax", "diffrax")},
            "python": platform.python_version(),
            "device": jax.devices()[0].device_kind,
        }
    )


def choose_or_make_model(
    options: FitOptions,
    path: Path,
    measurements: dict[str, jaxgran.Measurement],
    request: dict[str, Any],
) -> tuple[jaxgran.extend.AbstractModel, tuple[str, ...]]:
    """Return the model, and the reasons for it if it was chosen automatically."""
    if options.model == JOINT_MODEL:
        return jaxgran.KineticTheory(), ()
    (measurement,) = measurements.values()
    num_particles = measurement.num_particles
    size = num_particles if options.particles is None else options.particles
    replicas = options.replicas
    if options.model != "auto":
        model = models_by_name(default_models(2 if size is None else size, replicas))[options.model]
        if model.stochastic and size is None:
            raise ValueError(f"{path} does not give N. Add --particles.")
        return model, ()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the final fit repeats them
        first = jaxgran.fit(measurement, quick=True, **request)
    choice = jaxgran.choose_model(
        first.gas,
        measurement.curve.times,
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
    """Return header entries from KEY=VALUE arguments."""
    known = (*BY_SYMBOL, *PRIOR_KEYS, *OPTIONAL_KEYS, *UNIT_KEYS)
    values = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals or key not in known:
            raise ValueError(f"--set {pair}: give KEY=VALUE with KEY one of {', '.join(known)}")
        if key in values:
            raise ValueError(f"--set gives {key} twice, {values[key]} and {value}: remove one")
        values[key] = value
    with name_in_errors(Path("--set")):
        header_in_si(values)
    return values


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
        folder = Path("results") / stem
        i = 2
        while folder.exists():
            folder = Path("results") / f"{stem}-{i}"
            i += 1
    existing = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ValueError(f"{existing} is not a writable folder. Name another one with --out.")
    files = folder / f"{stem}.png", folder / f"{stem}.json"
    pages = [folder / f"{stem}.html"] if options.report else []
    for file in (*files, *pages):
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
