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
from collections.abc import Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax

import jaxgran
from jaxgran import plotting
from jaxgran._utils.extras import import_extra
from jaxgran.cli.options import KINETIC_THEORY, FitOptions, models_by_name, parse_settings
from jaxgran.cli.output import as_json, check_new, list_written, title_of
from jaxgran.cli.page import (
    Section,
    command_of,
    question_of,
    sections_of_fit,
    sections_of_plan,
    write_page,
)
from jaxgran.cli.scene import has_dissipation
from jaxgran.data.drop_test import DropTest
from jaxgran.data.measurement_header import absent_of_header
from jaxgran.fitting.goodness import SIGNIFICANCE
from jaxgran.fitting.imitate import MIN_RUNS
from jaxgran.fitting.report import parameter_rows, report
from jaxgran.fitting.result import NOT_DETERMINED
from jaxgran.models.choose import default_models
from jaxgran.scene.parameters import BY_SYMBOL, SCENE


class Outputs(NamedTuple):
    """Files that the command writes.

    Attributes:
        picture: PNG file.
        record: JSON file.
        page: HTML file.
    """

    picture: Path
    record: Path
    page: Path


class FreeParameters(NamedTuple):
    """Arguments of `jaxgran.fit`.

    Attributes:
        free: symbols of the free parameters that all measurements share; None for the default.
        separate: symbols of those that each curve has separately.
    """

    free: tuple[str, ...] | None
    separate: tuple[str, ...] = ()


class ChosenModel(NamedTuple):
    """The model of a fit.

    Attributes:
        model: the model.
        reasons: for it, if it was chosen automatically.
    """

    model: jaxgran.extend.AbstractModel
    reasons: tuple[str, ...] = ()


def run_fit(paths: Sequence[Path], options: FitOptions, started: float) -> None:
    """Fit curves and drop tests of one material, print the result and write it.

    Args:
        paths: files of cooling curves.
        options: of the command.
        started: start of the job on the clock `time.perf_counter`.
    """
    _check_request(paths, options)
    if options.report:
        import_extra("jinja2", "report")  # before the long part
    files = (*paths, *options.drop_test)
    outputs = output_files(files[0].stem, options)
    measurements = read_all(paths, options)
    parameters = parameters_of(options, measurements)
    chosen = choose_or_make_model(options, files[0], measurements, parameters)
    begin = time.perf_counter()
    result = _fit_without_warnings(
        measurements,
        parameters,
        model=chosen.model,
        key=jax.random.key(options.key) if chosen.model.stochastic else None,
        quick=options.quick,
    )
    fit_seconds = time.perf_counter() - begin
    summary = summary_of(result, chosen.model) | {
        "seconds": round(time.perf_counter() - started, 2),
        "fit_seconds": round(fit_seconds, 4),
    }
    outputs.record.parent.mkdir(parents=True, exist_ok=True)
    picture = outputs.picture if paths else None  # drop tests have no curve
    if picture is not None:
        save_picture(result, title_of(files[0]), picture)
    details = details_of(result, chosen.reasons)
    result.save(outputs.record, overwrite=options.overwrite, **summary, **details)
    print(report(result, explain=options.explain))
    for number, reason in enumerate(chosen.reasons):
        head = "chosen" if number == 0 else ""
        print(f"{head:9}- {reason}")
    written = [outputs.record] if picture is None else [picture, outputs.record]
    if options.report:
        plan = [] if options.quick or picture is None else what_to_measure_next(result)
        save_page(result, files, outputs.page, picture, plan)
        written.append(outputs.page)
    if options.imitate:
        imitation = jaxgran.imitate(result, options.imitate, key=jax.random.key(options.key))
        print(f"\n{imitation}")
    print(f"\n{list_written(written)}\n")
    print(json.dumps(summary, allow_nan=False))


def _check_request(paths: Sequence[Path], options: FitOptions) -> None:
    """Raise ValueError unless the files and the options belong together."""
    resolved = [path.resolve() for path in (*paths, *options.drop_test)]
    if repeated := [str(path) for path in resolved if resolved.count(path) > 1]:
        raise ValueError(f"{repeated[0]} is given twice. Give each measurement once.")
    is_single_curve = bool(paths) and is_single(labels_of(paths, options))
    if not is_single_curve and options.model != KINETIC_THEORY:
        raise ValueError(
            f"--model {options.model}: drop tests and several measurements are fitted with "
            f"{KINETIC_THEORY}. Fit the curves one by one with other models."
        )
    if options.imitate and not is_single_curve:
        raise ValueError(
            "--imitate takes a fit of one curve. Imitate the curves one by one, or leave it out."
        )
    if options.imitate and options.imitate < MIN_RUNS:
        raise ValueError(
            f"--imitate {options.imitate}: give {MIN_RUNS} or more runs, or leave it out."
        )
    if options.impacts and not paths:
        raise ValueError(
            "--impacts needs tracks of particles, and drop tests have none. Give a file of tracks, "
            "or leave out --impacts."
        )


def labels_of(paths: Sequence[Path], options: FitOptions) -> list[str]:
    """Return the labels of the files of curves, then of the drop tests.

    A label is the name of the file, or its path if a file before it has the same name. A single
    measurement has the label "".
    """
    files = [*paths, *options.drop_test]
    if len(files) == 1 and not options.impacts:
        return [""]
    labels: list[str] = []
    for path in files:
        labels.append(str(path) if path.stem in labels else path.stem)
    return labels


def is_single(labels: Iterable[str]) -> bool:
    """Tell whether labels stand for a single measurement."""
    return [*labels] == [""]


def output_files(name: str, options: FitOptions) -> Outputs:
    """Return the files to write, by default in a new folder.

    Args:
        name: of the curve.
        options: of the command.

    Raises:
        ValueError: if the folder cannot be written to, or if a file exists and may not be replaced.
    """
    stem = f"{name}-{options.model}"
    folder = _new_folder(stem) if options.out is None else options.out
    existing = next(part for part in (folder, *folder.absolute().parents) if part.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise ValueError(f"{existing} is not a writable folder. Name another one with --out.")
    outputs = Outputs(folder / f"{stem}.png", folder / f"{stem}.json", folder / f"{stem}.html")
    check_new(outputs.picture, options.overwrite)
    check_new(outputs.record, options.overwrite)
    if options.report:
        check_new(outputs.page, options.overwrite)
    return outputs


def _new_folder(stem: str) -> Path:
    """Return a folder in results that does not exist: its name ends in -2, -3, ... if needed."""
    folder = Path("results") / stem
    number = 2
    while folder.exists():
        folder = Path("results") / f"{stem}-{number}"
        number += 1
    return folder


def read_all(paths: Sequence[Path], options: FitOptions) -> dict[str, jaxgran.Measurement]:
    """Return the measurements of all files, by label; a single one has the label ""."""
    given = parse_settings(options.set)
    if options.onto_plate and not options.drop_test:
        raise ValueError("--onto-plate belongs to --drop-test, which is not given.")
    labels = labels_of(paths, options)
    measurements: dict[str, jaxgran.Measurement] = {}
    for path, label in zip(paths, labels, strict=False):
        measurement = jaxgran.read_measurement(path, given)
        if isinstance(measurement.data, DropTest):
            raise ValueError(f"{path} is a drop test. Give it as --drop-test {path}.")
        measurements[label] = with_absent(measurement, options.absent)
        if options.impacts:
            found = jaxgran.read_impacts(path, given).measurements
            measurements |= {f"{label} {name}": m for name, m in found.items()}
    of_drops = given | {"onto": "plate"} if options.onto_plate else given
    gas = next(iter(measurements.values())).gas if paths else None  # of the first curve
    for path, label in zip(options.drop_test, labels[len(paths) :], strict=True):
        measurement = jaxgran.read_measurement(path, of_drops, gas=gas)
        if not isinstance(measurement.data, DropTest):
            raise ValueError(f"{path} is a cooling curve. Give it without --drop-test.")
        measurements[label] = with_absent(measurement, options.absent)
    return measurements


def with_absent(measurement: jaxgran.Measurement, absent: Sequence[str]) -> jaxgran.Measurement:
    """Return a measurement with further effects that are known to be absent."""
    if not absent:
        return measurement
    header = dict(measurement.header)
    header["absent"] = " ".join((*measurement.absent, *absent))
    return dataclasses.replace(
        measurement, absent=absent_of_header(header), header=tuple(header.items())
    )


def parameters_of(
    options: FitOptions, measurements: dict[str, jaxgran.Measurement]
) -> FreeParameters:
    """Return the free parameters of the fit."""
    free = options.free
    if not free and not is_single(measurements):
        free = (_constant_of(measurements), "T0")
    _check_constant(free, measurements)
    if is_single(measurements):
        return FreeParameters(free or None)
    of_scene = tuple(key for key in free if BY_SYMBOL[key].belongs_to == SCENE)
    shared = tuple(key for key in free if key not in of_scene)
    if not shared:
        raise ValueError(f"--free {' '.join(free)}: the curves share none of these. Add A.")
    return FreeParameters(shared, of_scene)


def _constant_of(measurements: dict[str, jaxgran.Measurement]) -> str:
    """Return the symbol of the constant of the law that several measurements share."""
    gas = next(iter(measurements.values())).gas
    return "eps" if "coefficient" in gas.domains else "A"


def _check_constant(free: Sequence[str], measurements: dict[str, jaxgran.Measurement]) -> None:
    """Raise ValueError if neither the fit nor a file gives A or eps."""
    if not free or not {"A", "eps"}.isdisjoint(free):
        return
    of_curves = [m for m in measurements.values() if not isinstance(m.data, DropTest)]
    for measurement in of_curves or measurements.values():
        if not has_dissipation(dict(measurement.header)):
            raise ValueError(
                f"--free {' '.join(free)} leaves A fixed, and the file does not give it. Add "
                "--set A=VALUE (in s), or free A too."
            )


def choose_or_make_model(
    options: FitOptions,
    path: Path,
    measurements: dict[str, jaxgran.Measurement],
    parameters: FreeParameters,
) -> ChosenModel:
    """Return the model that the options name, or that is chosen for a first fit.

    Args:
        options: of the command.
        path: of the curve, for a message.
        measurements: one curve, unless the model is `KINETIC_THEORY`.
        parameters: of the fit.
    """
    if options.model == KINETIC_THEORY:
        return ChosenModel(jaxgran.KineticTheory())
    (measurement,) = measurements.values()
    given = measurement.num_particles
    size = given if options.particles is None else options.particles
    if options.model != "auto":
        by_name = models_by_name(default_models(2 if size is None else size, options.replicas))
        model = by_name[options.model]
        if model.stochastic and size is None:
            raise ValueError(f"{path} does not give N. Add --particles.")
        return ChosenModel(model)
    first = _fit_without_warnings(measurements, parameters, quick=True)
    choice = jaxgran.choose_model(
        first.gas,
        measurement.curve.times,
        options.tolerance,
        size if given is None else given,
        replicas=options.replicas,
    )
    if options.particles is None:
        return ChosenModel(choice.model, choice.reasons)
    # The choice is for the box of the file's N; the run has the number of particles given.
    (name,) = models_by_name([choice.model])
    by_name = models_by_name(default_models(options.particles, options.replicas))
    return ChosenModel(by_name[name], choice.reasons)


def _fit_without_warnings(
    measurements: dict[str, jaxgran.Measurement], parameters: FreeParameters, **options: Any
) -> jaxgran.Fit:
    """Fit without warnings, which the report repeats."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jaxgran.fit(
            measurements[""] if is_single(measurements) else measurements,
            free=parameters.free,
            separate=parameters.separate,
            **options,
        )


def save_picture(result: jaxgran.Fit, name: str, picture: Path) -> None:
    """Write the picture of a fit of one curve, or of several measurements.

    Args:
        result: of the fit.
        name: of a single curve.
        picture: the file.
    """
    if is_single(result.measurements):
        plotting.save_fit(result, f"{name}: {result.headline}", picture)
        return
    curves = {
        label: (m.curve, result.curve[label])
        for label, m in result.measurements.items()
        if result.curve[label] is not None
    }
    plotting.save_curves(curves, result.headline, picture)


def summary_of(result: jaxgran.Fit, model: jaxgran.extend.AbstractModel) -> dict[str, Any]:
    """Return the line of JSON that the command prints."""
    summary: dict[str, Any] = {}
    for row in parameter_rows(result):
        summary[row.parameter] = row.estimate
        summary[f"{row.parameter}_low"] = row.low
        summary[f"{row.parameter}_high"] = row.high
        summary[f"{row.parameter}_std_err"] = row.std_err
    (model_name,) = models_by_name([model])
    summary["verdict"] = result.grade
    summary["model"] = model_name
    summary["reduced_chi2"] = round(result.reduced_chi2, 4)
    summary["p_value"] = result.p_value
    if len(result.measurements) > 1:
        summary["agree"] = result.p_value >= SIGNIFICANCE
    summary["converged"] = result.converged
    return as_json(summary)


def details_of(result: jaxgran.Fit, chosen: Sequence[str]) -> dict[str, Any]:
    """Return further entries of the JSON file, for people who read it."""
    headers = {label: dict(m.header) for label, m in result.measurements.items()}
    return as_json(
        {
            "headline": result.headline,
            "narrowing": result.narrowing,
            "diagnosis": {"verdict": result.verdict, "reasons": result.reasons},
            "alternatives": [alternative._asdict() for alternative in result.alternatives],
            "parameters": [row._asdict() for row in parameter_rows(result)],
            "covariance": result.covariance,
            "weight": result.weights,
            "chosen": list(chosen),
            "header": headers.get("", headers),
            "versions": {name: version(name) for name in ("jaxgran", "jax", "diffrax")},
            "python": platform.python_version(),
            "device": jax.devices()[0].device_kind,
        }
    )


def save_page(
    result: jaxgran.Fit,
    files: Sequence[Path],
    page: Path,
    picture: Path | None,
    plan: Sequence[Section],
) -> None:
    """Write the web page of a fit.

    Args:
        result: of the fit.
        files: of its measurements.
        page: the file.
        picture: of the fit; None without one.
        plan: part with a plan, which stands after the first part.
    """
    first, *others = sections_of_fit(result, picture)
    write_page(
        page,
        title=", ".join(map(title_of, files)),
        question=question_of("fit", result.names[0]),
        answer=result.headline,
        sections=[first, *plan, *others],
        command=command_of("fit", files),
    )


def what_to_measure_next(result: jaxgran.Fit) -> list[Section]:
    """Return the part of a page with a plan that starts at a fit of one curve.

    There is none if the curve determines the parameter, or if N is not known.
    """
    if not is_single(result.measurements) or result.grade != NOT_DETERMINED:
        return []
    measurement = result.measurements[""]
    if measurement.num_particles is None:
        return []
    planned = jaxgran.plan(measurement, free=result.names)
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "plan.png"
        plotting.save_plan(planned, planned.headline, picture)
        return sections_of_plan(planned, picture, "What to measure next")
