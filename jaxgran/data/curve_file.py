"""Files of cooling curves and drop tests.

A CSV file holds a measured curve, tracks of particles or a drop test, under header lines that
describe the gas; an npz file holds every array of a curve. `jaxgran.data.tables` reads the tables,
and `jaxgran.data.tracks` trajectories.
"""

import io
import json
import warnings
import zipfile
import zlib
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxgran._utils.validation import check_bool
from jaxgran.data import files, tracks
from jaxgran.data.curve import CoolingCurve, from_arrays
from jaxgran.data.curve_arrays import to_arrays
from jaxgran.data.curve_checks import check_values
from jaxgran.data.curve_questions import ask_about_columns, scene_of
from jaxgran.data.definitions import BY_COLUMN, TEMPERATURE_COLUMNS
from jaxgran.data.drop_test import DropTest
from jaxgran.data.drop_test_file import drop_test_columns, drop_test_of_table, is_drop_test
from jaxgran.data.header import checked_header, gas_or_none, missing_keys
from jaxgran.data.header_lines import header_entry, header_in_si, text_of_comment
from jaxgran.data.quantities import QUANTITIES
from jaxgran.data.questions import ask
from jaxgran.data.tables import Table, read_table
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

ARCHIVE_SUFFIX = ".npz"
"""Suffix of files that hold every array of a curve."""

CSV_SUFFIXES = (".csv", ".txt", ".dat", "")
"""Suffixes with which a curve is written as text."""

HEADER_ENTRY = "header"
"""Entry of an npz file that holds the header, as JSON; all others are arrays."""


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
        curve, header = _read_archive(path)
        header = header_in_si(header) | header_in_si(given)
        return Content(curve, header, list(ask_about_columns(curve, header, gas_or_none(header))))
    if tracks.is_trajectory(path):
        if units := UNIT_KEYS.keys() & given.keys():
            raise ValueError(
                f"{', '.join(units)}: the units of a trajectory stand in the file itself (units or "
                "ITEM: UNITS); write units behind the other values, as in {'diameter': '2 mm'}"
            )
        curve, header = tracks.curve_of_trajectory(path, header_in_si(given))
        return Content(curve, header, list(ask_about_columns(curve, header, gas_or_none(header))))
    table = read_table(path, WANTED, _columns_to_read, given, tracks.IDENTITIES)
    header = table.header
    columns = table.columns
    if is_drop_test(list(columns)):
        test, questions = drop_test_of_table(table)
        return Content(test, header, [*ask_about_speeds(columns), *questions])
    if "x" in columns:
        missing = missing_keys(header)
        gas = gas_or_none(header | {k: x for k, x in ANY_MATERIAL.items() if k in missing})
        curve, questions = tracks.curve_of_tracks(columns, header, table.lines, gas)
        if table.num_left_out:
            questions.append(ask("no track", number=table.num_left_out))
        questions += ask_about_columns(curve, header, gas_or_none(header))
        return Content(curve, header, questions)
    columns, rounding, column = _with_temperature(table, header)
    arrays = {FIELDS[name]: jnp.asarray(x) for name, x in columns.items()}
    check_values(arrays, place=lambda i: f"line {table.lines[i]}")
    curve = from_arrays(arrays)
    curve.check_measured()
    questions = list(ask_about_columns(curve, header, gas_or_none(header), rounding, column))
    return Content(curve, header, questions, rounding)


def _columns_to_read(names: list[str]) -> list[str]:
    """Return the columns; raise ValueError if one is unknown, missing or repeated."""
    if "x" in names or "id" in names:
        return tracks.track_columns(names)
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
        _, _, *measured = [q.column for q in QUANTITIES.values() if q.measured]  # without t and T
        raise ValueError(
            f"the columns are {', '.join(names)}; "
            + (f"missing: {', '.join(missing)}; " if missing else "")
            + (f"not known: {', '.join(unknown)}; " if unknown else "")
            + f"name them t,T and, where measured, {', '.join(measured)}, each once. In place "
            f"of T there may be {', '.join(TEMPERATURE_COLUMNS)}; tracks of particles have the "
            "columns id,t,x,y[,z]"
        )
    return names


def _with_temperature(
    table: Table, header: dict[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], str]:
    """Return columns with T = <v^2>/d in place of one of `TEMPERATURE_COLUMNS`.

    The velocities are taken for isotropic and Maxwellian. The header gets the entry T_from,
    and T_of if the column holds energies.

    Returns:
        The columns, the last digits of T and T_rot by field, and the column that gave T.

    Raises:
        ValueError: for a speed that is not positive, or an energy of particles of unknown mass.
    """
    columns = dict(table.columns)
    written = [name for name in ("T", "T_rot") if name in columns]
    rounding = {FIELDS[name]: table.last_digits(name) for name in written}
    name = next((name for name in TEMPERATURE_COLUMNS if name in columns), "T")
    if name == "T":
        return columns, rounding, name
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
    scene = scene_of(header)
    if "energy" in name and np.isnan(scene.mass):
        raise ValueError(
            f"a column {name} needs the mass of a particle: add diameter and density to the "
            "header, or give T = <v^2>/d itself"
        )
    if name == "total_energy" and np.isnan(scene.number):
        raise ValueError("a column of the energy of all particles needs N: add it to the header")
    factor = definition.factor(scene)
    columns["T"] = factor * values**power
    formula = name if power == 1 else f"{name}^{power}"
    header["T_from"] = f"T = {factor:.4g} {formula}: it is {definition.words}"
    if "energy" in name:
        header["T_of"] = "energy"
    slope = power * factor * values ** (power - 1)
    rounding["temperature"] = slope * table.last_digits(name)
    if error is not None:
        columns["T_err"] = slope * error
    return columns, rounding, name


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
        arrays: dict[str, Any] = {name: np.asarray(x) for name, x in to_arrays(curve).items()}
        arrays[HEADER_ENTRY] = np.array(json.dumps(header))
        files.write_atomically(path, lambda file: np.savez_compressed(file, **arrays))
        return
    curve.check_single()
    fields = {column: getattr(curve, field) for column, field in FIELDS.items()}
    present = {column: np.asarray(x) for column, x in fields.items() if x is not None}
    lines = []
    for key, value in header.items():
        line = f"# {key}: {value}"
        if len(line.splitlines()) > 1 or header_entry(text_of_comment(line)) != (
            key,
            value.strip(),
        ):
            raise ValueError(
                f"header key {key!r}: key and value must be one line of text each, the key without "
                f": and =, and the value must not end in #, a quote or a separator; got {value!r}"
            )
        lines.append(line)
    lines.append(",".join(present))
    lines += [",".join(f"{x:.17g}" for x in row) for row in zip(*present.values(), strict=True)]
    text = "\n".join(lines) + "\n"
    files.write_atomically(path, lambda f: f.write(text.encode()))


def _check_sizes(content: io.BytesIO) -> None:
    """Raise ValueError for an array larger than its entry of an npz file, or too much in all."""
    with zipfile.ZipFile(content) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > files.MAX_BYTES:
            raise ValueError(f"more than {files.MAX_BYTES:g} bytes unpacked")
        for entry in archive.infolist():
            with archive.open(entry) as file:
                version = np.lib.format.read_magic(file)
                read = np.lib.format.read_array_header_1_0
                read = read if version == (1, 0) else np.lib.format.read_array_header_2_0
                shape, _, dtype = read(file)
            if prod(shape) * dtype.itemsize > entry.file_size:
                raise ValueError(f"{entry.filename} is shorter than its header says")


def _read_archive(path: Path) -> tuple[CoolingCurve, dict[str, str]]:
    content = io.BytesIO(files.read_bytes(path))
    try:
        _check_sizes(content)
        content.seek(0)
        with np.load(content, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = checked_header(json.loads(str(arrays.pop(HEADER_ENTRY))))
        return from_arrays({name: jnp.asarray(x) for name, x in arrays.items()}), header
    except (
        OSError,
        EOFError,
        ValueError,
        KeyError,
        TypeError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise ValueError(
            f"not a file that this version of jaxgran.write_curve wrote ({error}); give such a "
            "file, or a CSV file"
        ) from None
