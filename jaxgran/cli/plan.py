"""The command `jaxgran plan`: the range to expect of an experiment, and what would narrow it."""

import dataclasses
import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxgran
from jaxgran import plotting
from jaxgran._utils.extras import import_extra
from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.cli.fit import as_json, parse_settings
from jaxgran.cli.page import command_of, question_of, sections_of_plan, write_page
from jaxgran.data.files import check_writable, name_in_errors, write_atomically
from jaxgran.data.header import gas_of_header
from jaxgran.data.measurement_header import arguments_of_header
from jaxgran.data.scene_file import errors_of, read_scene_file, times_of
from jaxgran.fitting.twins import twin


def run_plan(
    path: Path,
    *,
    free: Sequence[str],
    given: Sequence[str],
    out: Path | None,
    overwrite: bool,
    page: bool,
) -> None:
    """Plan an experiment, print the table and write a picture and a JSON file.

    Args:
        path: of a scene with an experiment, or of a measured curve.
        free: symbols of the free parameters; () for the default.
        given: KEY=VALUE of the header of a measured curve.
        out: the picture.
        overwrite: whether existing files may be replaced.
        page: whether a web page is written, too.
    """
    if page:
        import_extra("jinja2", "report")  # before the long part
    picture = Path(f"{path.stem}-plan.png") if out is None else out
    record = picture.with_suffix(".json")
    if picture == record:
        raise ValueError(f"--out {out} is the name of the JSON file. Give the picture another one.")
    written = [picture, record, *([picture.with_suffix(".html")] if page else [])]
    for file in written:
        if file.exists() and not overwrite:
            raise ValueError(f"{file} exists. Name another --out, or add --overwrite.")
        check_writable(file)
    if path.suffix == ".toml":
        if given:
            raise ValueError("--set replaces values of a CSV file. Write them into the TOML file.")
        with name_in_errors(path):
            measurement = read_experiment(path)
    else:
        measurement = jaxgran.read_measurement(path, parse_settings(given))
    planned = jaxgran.plan(measurement, free=tuple(free) or None)
    print(planned)
    plotting.save_plan(planned, f"{path.stem.replace('_', ' ')}: {planned.headline}", picture)
    text = json.dumps(as_json(details_of(planned)), indent=1, allow_nan=False) + "\n"
    write_atomically(record, lambda file: file.write(text.encode()))
    if page:
        sections = sections_of_plan(planned, picture)
        question = question_of(planned.parameter, "plan")
        title = path.stem.replace("_", " ")
        command = command_of("plan", [path])
        write_page(written[-1], title, question, planned.headline, sections, command)
    print("\nwritten  " + "\n         ".join(map(str, written)))


def read_experiment(path: Path) -> jaxgran.Measurement:
    """Return a planned measurement, with values of kinetic theory.

    Args:
        path: of a TOML file of a scene with a table [experiment].
    """
    header, experiment = read_scene_file(path)
    gas, questions = gas_of_header(header)
    for question in questions:
        warnings.warn(f"{path}: {question}", stacklevel=2)
    if not {"A", "eps"} & header.keys():
        raise ValueError("a plan needs a guess of A, in s, or of eps: add one")
    errors = errors_of(experiment)
    if "rotational_temperature" in errors and gas.surface is None:
        raise ValueError("T_rot_err needs rough grains: give beta_t, or leave out T_rot_err")
    if "displacement" in errors and gas.container is not None:
        raise ValueError("msd_err: <dr^2> is not computed between walls. Leave out msd_err")
    times = times_of(experiment)
    ones = np.ones_like(times)
    planned: dict[str, Any] = {"times": times, "temperature": ones}
    for name, error in errors.items():
        planned[name] = ones
        planned[f"{name}_error"] = error * ones
    planned["status"] = np.zeros((), int)
    curve = jaxgran.CoolingCurve(**as_jax_arrays(planned))
    arguments = arguments_of_header(header)
    arguments["errors_measured"] |= "temperature" in errors
    return twin(jaxgran.Measurement(gas, curve, **arguments))


def details_of(planned: jaxgran.Plan) -> dict[str, Any]:
    """Return the content of the JSON file."""
    fields = {f.name: getattr(planned, f.name) for f in dataclasses.fields(planned)}
    del fields["measurement"]
    rows = [row._asdict() for row in planned.additions]
    pair = None if planned.pair is None else planned.pair._asdict()
    more = {"present": planned.present._asdict(), "additions": rows, "pair": pair}
    return {"headline": planned.headline} | fields | more
