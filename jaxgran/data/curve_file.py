"""Files of cooling curves and drop tests.

A CSV file holds a measured curve, tracks of particles or a drop test, under header lines that
describe the gas; an npz file holds every array of a curve, and a trajectory the velocities of
particles.
"""

import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxgran._utils.validation import check_bool
from jaxgran.data import files
from jaxgran.data.curve import CoolingCurve, from_arrays
from jaxgran.data.curve_archive import ARCHIVE_SUFFIX, read_archive, write_archive
from jaxgran.data.curve_checks import check_values
from jaxgran.data.curve_questions import ask_about_columns
from jaxgran.data.definitions import BY_COLUMN, TEMPERATURE_COLUMNS, facts_of
from jaxgran.data.drop_test import DropTest
from jaxgran.data.drop_test_file import drop_test_columns, drop_test_of_table, is_drop_test
from jaxgran.data.header import checked_header, gas_or_none, missing_keys
from jaxgran.data.header_lines import header_entry, header_in_si, text_of_comment
from jaxgran.data.quantities import QUANTITIES
from jaxgran.data.tables import Table, read_table
from jaxgran.data.track_positions import IDENTITIES, track_columns
from jaxgran.data.tracks import curve_of_tracks
from jaxgran.data.trajectory_curve import curve_of_trajectory, is_trajectory
from jaxgran.data.units import UNIT_KEYS
from jaxgran.data.usual_values import ask_about_speeds

WANTED = "t,T[,T_err][,msd][,msd_err]"
"""Columns of a file, for messages."""

CSV_FILE = f"a CSV file with the columns {WANTED}"
"""What is read, for messages."""

ANY_MATERIAL = {"density": "1", "Y": "1", "nu": "0", "T0": "1"}
"""Header keys that the collision frequency over sqrt(T0) does not depend on."""

FIELDS = {quantity.column: name for name, quantity in QUANTITIES.items()}
"""Fields of a curve by column."""

CSV_SUFFIXES = (".csv", ".txt", ".dat", "")
"""Suffixes with which a curve is written as text."""


def read_curve(
    path: str | Path, header: dict[str, Any] | None = None
) -> tuple[CoolingCurve, dict[str, str]]:
    """Read a curve with every quantity that a file holds, as `write_curve` writes it.

    `jaxgran.read_measurement` reads a measured curve together with its gas.

    Args:
        path: the file, of any format that `jaxgran.read_measurement` reads but drop tests.
        header: see `jaxgran.read_measurement`.

    Returns:
        The curve, and the header as a dictionary of strings, in SI. If T was computed from other
        columns, the entry T_from says how.

    Raises:
        ValueError: saying what is wrong, in which line, and what to do.

    >>> jaxgran.write_curve("mine.csv", curve, {"eta": "0.05"}, overwrite=True)
    >>> again, header = jaxgran.read_curve("mine.csv")
    >>> header, again.times.shape
    ({'eta': '0.05'}, (4,))
    """
    path = files.checked_path(path, CSV_FILE)
    given = {} if header is None else checked_header(header)
    with files.name_in_errors(path):
        content = read_data(path, given)
        if isinstance(content.data, DropTest):
            raise ValueError("the file is a drop test: read it by jaxgran.read_measurement")
    for question in content.questions:
        warnings.warn(f"{path}: {question}", stacklevel=2)
    return content.data, content.header


class Content(NamedTuple):
    """Content of a file.

    Attributes:
        data: the curve, or the drop test.
        header: in SI.
        questions: about both.
        rounding: last digits of fields of the curve as they were written, SI, by field.
    """

    data: CoolingCurve | DropTest
    header: dict[str, str]
    questions: list[str]
    rounding: dict[str, np.ndarray] = {}


def read_data(path: Path, given: dict[str, str]) -> Content:
    """Read a file of any format.

    Args:
        path: the file.
        given: further entries of its header.
    """
    if path.suffix == ARCHIVE_SUFFIX:
        curve, header = read_archive(path)
        return _content_of_curve(curve, header_in_si(header) | header_in_si(given))
    if is_trajectory(path):
        if units := UNIT_KEYS.keys() & given.keys():
            raise ValueError(
                f"{', '.join(units)}: the units of a trajectory stand in the file itself (units or "
                "ITEM: UNITS); write units behind the other values, as in {'diameter': '2 mm'}"
            )
        return _content_of_curve(*curve_of_trajectory(path, header_in_si(given)))
    table = read_table(path, WANTED, _columns_to_read, given, IDENTITIES)
    if is_drop_test(list(table.columns)):
        test, questions = drop_test_of_table(table)
        return Content(test, table.header, [*ask_about_speeds(table.columns), *questions])
    if "x" in table.columns:
        return _content_of_tracks(table)
    return _content_of_table(table)


def _content_of_curve(curve: CoolingCurve, header: dict[str, str]) -> Content:
    questions = ask_about_columns(curve, header, gas_or_none(header))
    return Content(curve, header, list(questions))


def _content_of_tracks(table: Table) -> Content:
    missing = missing_keys(table.header)
    any_material = {key: x for key, x in ANY_MATERIAL.items() if key in missing}
    gas = gas_or_none(table.header | any_material)
    tracked = curve_of_tracks(table.columns, table.header, table.lines, gas)
    content = _content_of_curve(tracked.curve, tracked.header)
    questions = list(tracked.questions)
    if table.num_left_out:
        questions.append(f"{table.num_left_out} positions that belong to no track are left out")
    return content._replace(questions=questions + content.questions)


def _content_of_table(table: Table) -> Content:
    """Return the curve of a table of T, or of a quantity from which T follows."""
    read = _read_temperature(table)
    columns = {FIELDS[name]: jnp.asarray(x) for name, x in read.columns.items()}
    check_values(columns, place=lambda i: f"line {table.lines[i]}")
    curve = from_arrays(columns)
    curve.check_measured()
    gas = gas_or_none(read.header)
    questions = ask_about_columns(curve, read.header, gas, read.rounding, read.column)
    return Content(curve, read.header, list(questions), read.rounding)


def _columns_to_read(names: list[str]) -> list[str]:
    """Return the columns; raise ValueError if one is unknown, missing or repeated."""
    if "x" in names or "id" in names:
        return track_columns(names)
    if is_drop_test(names):
        return drop_test_columns(names)
    temperatures = [name for name in ("T", *TEMPERATURE_COLUMNS) if name in names]
    errors = {f"{name}_err" for name in temperatures}
    known = {*FIELDS, *temperatures, *errors}
    if "total_energy" in names:  # tables of energies have columns of other energies, too
        names = [name for name in names if name in known]
    unknown = [name for name in names if name not in known]
    missing = ([] if "t" in names else ["t"]) + ([] if temperatures else ["T"])
    if len(temperatures) > 1:
        raise ValueError(f"{' and '.join(temperatures)} each give the temperature; keep one")
    if len(given := sorted((errors | {"T_err"}) & {*names})) > 1:
        raise ValueError(f"{' and '.join(given)} each give the error of T; keep one")
    if unknown or missing or len(set(names)) < len(names):
        columns = [quantity.column for quantity in QUANTITIES.values() if quantity.measured]
        measured = [name for name in columns if name not in ("t", "T")]
        raise ValueError(
            f"the columns are {', '.join(names)}; "
            + (f"missing: {', '.join(missing)}; " if missing else "")
            + (f"not known: {', '.join(unknown)}; " if unknown else "")
            + f"name them t,T and, where measured, {', '.join(measured)}, each once. In place "
            f"of T there may be {', '.join(TEMPERATURE_COLUMNS)}; tracks of particles have the "
            "columns id,t,x,y[,z]"
        )
    return names


class _Temperature(NamedTuple):
    """Columns of a curve with T = <v^2>/d.

    Attributes:
        columns: by name, in SI.
        header: of the file; if T was computed T_from says how, and T_of whether from energies.
        rounding: last digits of T and T_rot as they were written, SI, by field.
        column: from which T was read.
    """

    columns: dict[str, np.ndarray]
    header: dict[str, str]
    rounding: dict[str, np.ndarray]
    column: str


def _read_temperature(table: Table) -> _Temperature:
    """Return the columns of a table, with T in place of one of `TEMPERATURE_COLUMNS`.

    The velocities are taken for isotropic and Maxwellian.

    Raises:
        ValueError: for a speed that is not positive, or an energy of particles of unknown mass.
    """
    columns = dict(table.columns)
    header = dict(table.header)
    written = [name for name in ("T", "T_rot") if name in columns]
    rounding = {FIELDS[name]: table.last_digits(name) for name in written}
    name = next((name for name in TEMPERATURE_COLUMNS if name in columns), "T")
    if name == "T":
        return _Temperature(columns, header, rounding, name)
    values = columns.pop(name)
    error = columns.pop(f"{name}_err", None)
    definition = BY_COLUMN[name]
    power = definition.power
    if power > 1 and np.any(values <= 0):
        i = int(np.argmax(values <= 0))
        raise ValueError(
            f"line {table.lines[i]}: {name} is {values[i]:g}, it must be a positive number; "
            "correct or remove this row"
        )
    facts = facts_of(header)
    if "energy" in name and np.isnan(facts.mass):
        raise ValueError(
            f"a column {name} needs the mass of a particle: add diameter and density to the "
            "header, or give T = <v^2>/d itself"
        )
    if name == "total_energy" and np.isnan(facts.number):
        raise ValueError("a column of the energy of all particles needs N: add it to the header")
    factor = definition.factor(facts)
    columns["T"] = factor * values**power
    formula = name if power == 1 else f"{name}^{power}"
    header["T_from"] = f"T = {factor:.4g} {formula}: it is {definition.words}"
    if "energy" in name:
        header["T_of"] = "energy"
    slope = power * factor * values ** (power - 1)
    rounding["temperature"] = slope * table.last_digits(name)
    if error is not None:
        columns["T_err"] = slope * error
    return _Temperature(columns, header, rounding, name)


def write_curve(
    path: str | Path, curve: CoolingCurve, header: dict[str, Any], *, overwrite: bool = False
) -> None:
    """Write a curve to a file that `read_curve` reads.

    A CSV file holds every known quantity at each time, T_err, msd, a2, collisions, energies and so
    on, with 17 digits, so that it is read back without loss; it has three times or more. It holds
    neither single replicas nor particles, nor what a function `save` of `jaxgran.cool` returned. A
    file whose name ends in .npz holds everything, bit for bit.

    Args:
        path: the file; its suffix, .npz or one of .csv, .txt, .dat and none, chooses the format.
        curve: none of its arrays may be traced. A CSV file holds one system.
        header: its numbers are converted to SI, in which the columns are.
        overwrite: whether an existing file may be replaced.

    Raises:
        ValueError: for another suffix, several curves in a CSV file, an entry that is not one line,
            a unit that is not one of the key, and if the file exists and `overwrite` is False.
        OSError: naming the path, if it cannot be written; an existing file is then unchanged.

    >>> jaxgran.write_curve("all.npz", curve, {"note": "every array"}, overwrite=True)
    >>> jaxgran.read_curve("all.npz")[1]["note"]
    'every array'
    """
    path = files.checked_path(path, CSV_FILE)
    header = header_in_si(checked_header(header))
    check_bool(overwrite=overwrite)
    if not isinstance(curve, CoolingCurve):
        raise ValueError(f"curve must be a jaxgran.CoolingCurve, got {curve!r:.60}")
    if path.suffix not in (ARCHIVE_SUFFIX, *CSV_SUFFIXES):
        raise ValueError(
            f"{path}: a curve is written as .npz or as text, {', '.join(CSV_SUFFIXES[:-1])}; "
            "choose one of these endings"
        )
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; choose another name or set overwrite=True")
    if path.suffix == ARCHIVE_SUFFIX:
        write_archive(path, curve, header)
        return
    curve.check_single()
    text = "\n".join([*_header_lines(header), *_table_lines(curve)]) + "\n"
    files.write_atomically(path, lambda f: f.write(text.encode()))


def _header_lines(header: dict[str, str]) -> Iterator[str]:
    """Yield the lines of a header; raise ValueError for one that would be read otherwise."""
    for key, value in header.items():
        line = f"# {key}: {value}"
        is_one = len(line.splitlines()) == 1
        if not is_one or header_entry(text_of_comment(line)) != (key, value.strip()):
            raise ValueError(
                f"header key {key!r}: key and value must be one line of text each, the key without "
                f": and =, and the value must not end in #, a quote or a separator; got {value!r}"
            )
        yield line


def _table_lines(curve: CoolingCurve) -> Iterator[str]:
    """Yield the line of names and the rows of the known quantities of a curve."""
    fields = {column: getattr(curve, field) for column, field in FIELDS.items()}
    present = {column: np.asarray(x) for column, x in fields.items() if x is not None}
    yield ",".join(present)
    for row in zip(*present.values(), strict=True):
        yield ",".join(f"{x:.17g}" for x in row)
