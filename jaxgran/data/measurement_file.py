"""Files of measurements: a measured curve or drop test, with the gas that the header describes."""

import warnings
from pathlib import Path
from typing import Any

from jaxgran.data import files
from jaxgran.data.curve_file import CSV_FILE, Content, read_data
from jaxgran.data.drop_test import DropTest
from jaxgran.data.header import (
    ask_about_another_gas,
    checked_header,
    gas_of_header,
    missing_keys,
)
from jaxgran.data.measurement import Measurement
from jaxgran.data.measurement_header import arguments_of_header
from jaxgran.scene.gas import Gas

UNUSED_BY_IMPACTS = {"eta": "0.1", "T0": "0.01"}
"""Header entries that single impacts do not depend on, for drop tests without them."""


def read_measurement(
    path: str | Path, header: dict[str, Any] | None = None, *, gas: Gas | None = None
) -> Measurement:
    """Read a measured cooling curve or a drop test, with the gas that the header describes.

    A CSV file has header lines ``# key: value``, a line with the names of the columns, and rows of
    numbers::

        # eta: 0.05
        # diameter: 2 mm
        t,T,T_err,msd
        0.0,1.0e-2,0,0
        7.8e-3,9.79e-3,8.0e-6,1.7e-6

    A curve has the columns t (s) and T (m^2/s^2) and, where measured, T_err (m^2/s^2), T_rot,
    T_rot_err, msd and msd_err (m^2), in any order. In place of T there may be mean_speed, vx2,
    v2_xy or energy (`jaxgran.data.curve_file.TEMPERATURE_COLUMNS`), with errors under the same name
    and _err. A drop test has the columns v (m/s), eps and eps_err; oblique impacts have v_n,v_t (or
    v,angle), eps, eps_err, eps_t and eps_t_err, or velocities and spins
    (`jaxgran.data.drop_test_file.drop_test_of_table`). Tracks of particles have the columns
    id,t,x,y and, where measured, z (`jaxgran.data.tracks.curve_of_tracks`).

    Units may stand after a name or a value, as in ``t (ms)`` and ``# diameter: 2 mm``. The header
    keys length_unit, time_unit and speed_unit, which holds for T squared, give units of all other
    columns and of diameter, T0, A and the like; other numbers are in SI. Commas, semicolons, tabs
    or blanks separate the columns; between semicolons numbers may have decimal commas.

    The keys of a header are those of the gas (`jaxgran.data.header.gas_of_header`), of errors
    (`jaxgran.data.measurement_header.priors_of_header`), of drop tests, onto ("sphere", "plate" or
    "wall"), eps_scatters ("yes") and spin_before ("0"), and of tracks. N, replicas, absent,
    tracked, T0_of ("run" or "ensemble"), T_scale_err and errors ("measured") stand for the
    arguments of `Measurement`; T_scale is a factor that T already contains, with its error behind
    it.

    Args:
        path: the file: a CSV file, a trajectory with velocities (GSD, extended XYZ, LAMMPS dump),
            or an npz file that `write_curve` writes.
        header: further entries of the header, before anything is read; they replace entries with
            the same key.
        gas: the gas in place of the header's, such as the gas of a curve for a drop test.

    Returns:
        `Measurement`. Unusual values, and columns that contradict the header, cause warnings,
        which ask a question.

    Raises:
        ValueError: naming the file, what is wrong, in which line, and what to do.

    >>> known = {"eta": 0.05, "diameter": "2 mm", "density": 2387, "Y": 5e7, "nu": 0.22, "T0": 0.01}
    >>> jaxgran.write_curve("mine.csv", curve, known, overwrite=True)
    >>> measurement = jaxgran.read_measurement("mine.csv", {"N": 250})
    >>> measurement.curve.times.shape, measurement.num_particles
    ((4,), 250)
    """
    path = files.checked_path(path, CSV_FILE)
    entries = {} if header is None else checked_header(header)
    with files.name_in_errors(path):
        content = read_data(path, entries)
        gas, questions = _gas_of(content, gas)
        arguments = arguments_of_header(content.header)
        measurement = Measurement(gas, content.data, rounding=content.rounding, **arguments)
    for question in (*content.questions, *questions):
        warnings.warn(f"{path}: {question}", stacklevel=2)
    return measurement


def _gas_of(content: Content, gas: Gas | None) -> tuple[Gas, list[str]]:
    """Return a given gas, or else the gas of the header, and questions about it."""
    if gas is not None:
        return gas, ask_about_another_gas(content.header, gas)
    if isinstance(content.data, DropTest):
        return _gas_of_drop_test(content.header)
    return gas_of_header(content.header)


def _gas_of_drop_test(header: dict[str, str]) -> tuple[Gas, list[str]]:
    """Return the gas of a drop test, and questions about it."""
    unused = dict(UNUSED_BY_IMPACTS)
    if {"N", "container_side"} <= header.keys():
        del unused["eta"]  # which these two give
    if missing := missing_keys(UNUSED_BY_IMPACTS | header):
        raise ValueError(
            f"the header of this drop test lacks {', '.join(missing)}: add them, or give the gas "
            "of a curve, by gas=... or by jaxgran fit CURVE.csv --drop-test"
        )
    return gas_of_header(unused | header)
