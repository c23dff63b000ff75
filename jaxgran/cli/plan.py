"""The command `jaxgran plan`: the range to expect of an experiment, and what would narrow it."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import jaxgran
from jaxgran import plotting
from jaxgran._utils.extras import import_extra
from jaxgran._utils.tracing import as_jax_arrays
from jaxgran.cli.options import parse_settings
from jaxgran.cli.output import as_json, check_new, list_written, title_of
from jaxgran.cli.page import command_of, question_of, sections_of_plan, write_page
from jaxgran.cli.scene import has_dissipation, read_toml
from jaxgran.data.files import check_writable, name_in_errors, write_atomically
from jaxgran.data.measurement_header import arguments_of_header
from jaxgran.data.scene_file import EXPERIMENT, HOW_TO_GIVE_TIMES
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
    html = picture.with_suffix(".html")
    if picture in (record, html):
        raise ValueError(
            f"--out {out} must not end in .json or .html, the endings of the other files. Give the "
            "picture another name, as plan.png."
        )
    written = [picture, record, html] if page else [picture, record]
    for file in written:
        check_new(file, overwrite)
        check_writable(file)
    planned = jaxgran.plan(_read(path, given), free=tuple(free) or None)
    print(planned)
    plotting.save_plan(planned, f"{title_of(path)}: {planned.headline}", picture)
    text = json.dumps(as_json(details_of(planned)), indent=1, allow_nan=False) + "\n"
    write_atomically(record, lambda file: file.write(text.encode()))
    if page:
        write_page(
            html,
            title=title_of(path),
            question=question_of("plan", planned.parameter),
            answer=planned.headline,
            sections=sections_of_plan(planned, picture),
            command=command_of("plan", [path]),
        )
    print(f"\n{list_written(written)}")


def _read(path: Path, given: Sequence[str]) -> jaxgran.Measurement:
    """Return the planned measurement of a scene, or the measured one of a curve."""
    if path.suffix != ".toml":
        return jaxgran.read_measurement(path, parse_settings(given))
    if given:
        raise ValueError("--set replaces values of a CSV file. Write them into the TOML file.")
    with name_in_errors(path):
        return read_experiment(path)


def read_experiment(path: Path) -> jaxgran.Measurement:
    """Return a planned measurement, with values of kinetic theory.

    Args:
        path: of a TOML file of a scene with a table [experiment].
    """
    file = read_toml(path)
    if not has_dissipation(file.header):
        raise ValueError("a plan needs a guess of A, in s, or of eps: add one")
    if file.experiment is None:
        raise ValueError(f"a plan needs a table [{EXPERIMENT}] with {HOW_TO_GIVE_TIMES}")
    times, errors = file.experiment
    if "rotational_temperature" in errors and file.gas.surface is None:
        raise ValueError("T_rot_err needs rough grains: give beta_t, or leave out T_rot_err")
    if "displacement" in errors and file.gas.container is not None:
        raise ValueError("msd_err: <dr^2> is not computed between walls. Leave out msd_err")
    ones = np.ones_like(times)
    planned: dict[str, Any] = {"times": times, "temperature": ones}
    for name, error in errors.items():
        planned[name] = ones
        planned[f"{name}_error"] = error * ones
    planned["status"] = np.zeros((), int)
    curve = jaxgran.CoolingCurve(**as_jax_arrays(planned))
    arguments = arguments_of_header(file.header)
    arguments["errors_measured"] |= "temperature" in errors
    return twin(jaxgran.Measurement(file.gas, curve, **arguments))


def details_of(planned: jaxgran.Plan) -> dict[str, Any]:
    """Return the content of the JSON file."""
    fields = {f.name: getattr(planned, f.name) for f in dataclasses.fields(planned)}
    del fields["measurement"]
    fields["present"] = planned.present._asdict()
    fields["additions"] = [row._asdict() for row in planned.additions]
    fields["pair"] = None if planned.pair is None else planned.pair._asdict()
    return {"headline": planned.headline} | fields
