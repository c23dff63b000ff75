"""Files of cooling curves and drop tests, and the gas that a header describes.

A CSV file holds a measured curve, or tracks of particles, under header lines that describe the gas;
an npz file holds every array of a curve. `jaxgran.data.tables` reads the tables. Values that are
unusual, most of them by their units, are asked about: each question names the value, what is usual,
and the factor that would make it usual; it is a warning, and the values are used as they are.
"""

import dataclasses
import io
import json
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator
from math import pi, sqrt
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import POSITIVE, UserNumber, check_bool, float_array
from jaxgran.data import files, tracks
from jaxgran.data.curve import QUANTITIES, CoolingCurve, from_arrays, to_arrays
from jaxgran.data.tables import UNIT_KEYS, UNITS, Table, header_entry, read_table, unit_in
from jaxgran.scene.elements import (
    VOLUME_TOLERANCE,
    Frictional,
    Rough,
    Walls,
    container_volume_ratio,
)
from jaxgran.scene.gas import ELEMENTS, Gas
from jaxgran.scene.geometry import sphere_mass
from jaxgran.scene.laws import Viscoelastic
from jaxgran.scene.parameters import BY_SYMBOL, REQUIRED, fields_of

WANTED = "t,T[,T_err][,msd][,msd_err]"
"""Columns of a file, for messages."""

CSV_FILE = f"a CSV file with the columns {WANTED}"

OPTIONAL_KEYS = ("N", "dimension", "replicas", "absent", "T_from", *tracks.TRACK_KEYS)
"""Further known header keys, neither of the gas nor of its elements."""

PROVENANCE_KEYS = ("units", "points", "end_tau", "melt_tau", "steps_per_contact", "source")
"""Keys that document the origin of a curve, and that no result depends on."""

PRIOR_KEYS = {f"{symbol}_err": p.name for symbol, p in BY_SYMBOL.items() if symbol != "A"}
"""Header keys of standard errors, and the names of their priors in `jaxgran.fit`."""

GUESS = "guess"
GUESSES = {
    "beta_t": 0.0,
    "friction": 0.3,
    "gamma": 0.0,
    "wall_restitution": 1.0,
    "wall_beta_t": 0.0,
}
"""Header keys whose value may be "guess", and the values from which a fit then starts."""

ABSENT = {
    "walls": ("container_side", "wall_restitution"),
    "roughness": ("beta_t",),
    "drag": ("gamma",),
    "friction": ("friction",),
}
"""Effects that the header key ``absent`` may name, and the keys that describe them."""

TEMPERATURE_COLUMNS: dict[str, tuple[int, Callable[..., np.ndarray], str]] = {
    "mean_speed": (
        2,
        lambda v, d, m: (pi / 8 if d == 3 else 2 / pi) * v**2,
        "(pi/8) <|v|>^2, in a plane (2/pi) <|v|>^2, for Maxwellian velocities",
    ),
    "vx2": (1, lambda x, d, m: x, "<v_x^2>, for isotropic velocities"),
    "v2_xy": (1, lambda x, d, m: x / 2, "<v_x^2 + v_y^2>/2, for isotropic velocities"),
    "energy": (1, lambda E, d, m: 2 * E / (d * m), "2 E/(d m), E in J per particle"),
}
"""Columns from which T = <v^2>/d is computed: their power in T, T of values, d and m, words."""

EXACT_DENSITY_ERROR = 1e-4
"""Relative error of the prior of a density without an error, where the diameter has one."""

ANY_MATERIAL = {"density": "1", "Y": "1", "nu": "0", "T0": "1"}
"""Header keys that the collision frequency over sqrt(T0) does not depend on."""

_MIXTURE = "grains of a mixture have a temperature for each kind, and one T is too few"
_STICKING = "grains that stick lose all of their speed below some speed, and grow"

UNSUPPORTED_KEYS = {
    "gravity": (0.0, "under gravity density and T change with height, but gases are homogeneous"),
    "polydispersity": (0.0, "grains of unequal masses have unequal temperatures"),
    "diameter_2": (None, _MIXTURE),
    "density_2": (None, _MIXTURE),
    "aspect_ratio": (1.0, "rods and ellipsoids collide at another rate and rotate"),
    "cohesion": (0.0, _STICKING),
    "surface_energy": (0.0, _STICKING),
    "charge": (0.0, "charged grains are deflected without touching, but grains fly freely"),
}
"""Keys of effects that no model has: the value that means "no effect" (or None), and the reason."""

USUAL_RANGES = {
    "diameter": (1e-7, 0.1),
    "density": (10.0, 2.5e4),
    "Y": (1e3, 1e13),
    "T0": (1e-12, 900.0),  # a thermal speed of 30 m/s
    "T_rot_0": (0.0, 900.0),
    "A": (0.0, 0.1),
    "container_side": (1e-6, 100.0),
    "gamma": (0.0, 1e4),
    "drive_strength": (0.0, 1e4),
    "t": (0.0, 1e7),
    "T": (0.0, 900.0),
    "msd": (0.0, 1e4),
    "T_rot": (0.0, 900.0),
}
"""Smallest and largest usual value of header keys and columns in granular gases."""

OTHER_UNITS = {
    "m": ("mm", "cm", "um"),
    "m^2": ("mm^2", "cm^2", "um^2"),
    "s": ("ms", "us", "min"),
    "1/s": ("1/ms", "1/min"),
    "m^2/s^2": ("mm^2/s^2", "cm^2/s^2"),
    "m^2/s^3": ("mm^2/s^3", "cm^2/s^3"),
    "kg/m^3": ("g/cm^3",),
    "Pa": ("GPa", "MPa", "kPa"),
}
"""Units in which values are often given, by SI unit."""

BOLTZMANN = 1.380649e-23

MAX_RATIO = 1.3
"""Ratio of T at t = 0 to T0, or of T0 to it, above which a question is asked."""

MAX_LATENESS = 0.3
"""Delay of the clock over the time in which T halves, above which a question is asked."""

USUAL_LOSS = (1e-3, 3.0)
"""Usual loss ``d (-dT/dt)/(nu_0 T)`` at first: 1 - eps^2 of smooth spheres in a box."""

MAX_ERROR_RATIO = 10.0
"""Ratio of T_err to the scatter of N particles, or its inverse, above which a question is asked."""


def read_curve(
    path: str | Path, header: dict[str, str] | None = None
) -> tuple[CoolingCurve, dict[str, str]]:
    """Read a measured cooling curve from a CSV file, or any curve from an npz file.

    The file has header lines ``# key: value``, a line with the names of the columns, and rows of
    numbers::

        # eta: 0.05
        t,T,T_err,msd
        0.0,1.0e-2,0,0
        7.8e-3,9.79e-3,8.0e-6,1.7e-6

    Args:
        path: the file. Its columns are t (s) and T (m^2/s^2) and, where measured, T_err (m^2/s^2),
            msd and msd_err (m^2), in any order. In place of T there may be mean_speed, vx2, v2_xy
            or energy (see `jaxgran.data.curve_file.TEMPERATURE_COLUMNS`), with errors under the
            same name and _err. Units may stand behind a name or a value, as in ``t (ms)`` and
            ``# diameter: 2 mm``; header keys length_unit, time_unit and speed_unit, which holds for
            T squared, give those of all other columns and of diameter, T0, A and the like; other
            numbers are in SI. Commas, semicolons, tabs or blanks separate the columns; between
            semicolons numbers may have decimal commas.
            Alternatively its columns are id,t,x,y and z, tracks of particles (see
            `jaxgran.data.tracks.curve_of_tracks`), or it is a trajectory with velocities (GSD,
            extended XYZ, LAMMPS dump). All other columns (a2, collisions, D, energies) and npz
            files that `write_curve` writes are read, too.
        header: entries, in SI, that replace those of the file or are added to them.

    Returns:
        The curve, and the header as a dictionary of strings, in SI. If T was computed from other
        columns, the entry T_from says how. Unusual values, and columns that contradict the header,
        cause warnings, which ask a question.

    Raises:
        ValueError: saying what is wrong, in which line, and what to do.

    >>> jaxgran.write_curve("mine.csv", curve, {"eta": "0.05"}, overwrite=True)
    >>> again, header = jaxgran.read_curve("mine.csv")
    >>> header, again.times.shape
    ({'eta': '0.05'}, (4,))
    """
    path, given = files.checked_path(path, CSV_FILE), {} if header is None else header
    _check_header(given)
    questions: list[str] = []
    with files.name_in_errors(path):
        if path.suffix == ARCHIVE_SUFFIX:
            return _read_archive(path)
        if tracks.is_trajectory(path):
            return tracks.curve_of_trajectory(path, given)
        table = read_table(path, WANTED, _columns_to_read)
        header = table.header | given
        if "x" in table.columns:
            gas = _gas_or_none(ANY_MATERIAL | header)
            curve, questions = tracks.curve_of_tracks(table.columns, header, table.lines, gas)
        else:
            columns = _with_temperature(table, header)
            fields = {quantity.column: quantity.field for quantity in QUANTITIES.values()}
            curve = from_arrays({fields[name]: jnp.asarray(x) for name, x in columns.items()})
            curve.check(lambda i: f"line {table.lines[i]}")
            questions = list(ask_about_columns(curve, header, _gas_or_none(header)))
    for question in questions:
        warnings.warn(f"{path}: {question}", stacklevel=2)
    return curve, header


def _columns_to_read(names: list[str]) -> list[str]:
    """Return the columns; raise ValueError if one is unknown, missing or repeated."""
    if "x" in names or "id" in names:
        return tracks.track_columns(names)
    if {"v", "eps"} <= {*names}:
        raise ValueError(
            f"the columns are {', '.join(names)}, those of a drop test: give it to read_drop_test, "
            "or to --drop-test"
        )
    temperatures = [name for name in ("T", *TEMPERATURE_COLUMNS) if name in names]
    known = {quantity.column for quantity in QUANTITIES.values()}
    known |= {end for name in temperatures for end in (name, f"{name}_err")}
    unknown = [name for name in names if name not in known]
    missing = ([] if "t" in names else ["t"]) + ([] if temperatures else ["T"])
    if len(temperatures) > 1:
        raise ValueError(f"{' and '.join(temperatures)} each give the temperature; keep one")
    if unknown or missing or len(set(names)) < len(names):
        measured = [q.column for q in QUANTITIES.values() if q.measured]
        raise ValueError(
            f"the columns are {', '.join(names)}; "
            + (f"missing: {', '.join(missing)}; " if missing else "")
            + (f"not known: {', '.join(unknown)}; " if unknown else "")
            + f"name them t,T and, where measured, {', '.join(measured[2:])}, each once. In place "
            f"of T there may be {', '.join(TEMPERATURE_COLUMNS)}; tracks of particles have the "
            "columns id,t,x,y[,z]"
        )
    return names


def _with_temperature(table: Table, header: dict[str, str]) -> dict[str, np.ndarray]:
    """Return columns with T = <v^2>/d in place of one of `TEMPERATURE_COLUMNS`.

    The velocities are taken for isotropic and Maxwellian. The entry T_from is added to the header.

    Raises:
        ValueError: for a value that is not positive, or an energy of particles of unknown mass.
    """
    columns, d, mass = dict(table.columns), files.header_count(header, "dimension") or 3, np.nan
    for name in TEMPERATURE_COLUMNS.keys() & columns.keys():
        values, error = columns.pop(name), columns.pop(f"{name}_err", None)
        if np.any(values <= 0):
            i = int(np.argmax(values <= 0))
            raise ValueError(
                f"line {table.lines[i]}: {name} is {values[i]:g}, it must be a positive number; "
                "correct or remove this row"
            )
        if name == "energy":
            if not {"diameter", "density"} <= header.keys():
                raise ValueError(
                    "a column energy needs the mass of a particle: add diameter and density to the "
                    "header, or give T = <v^2>/d itself"
                )
            size, density = (files.header_number(header, key) for key in ("diameter", "density"))
            mass = float(sphere_mass(size, density))
        power, temperature, words = TEMPERATURE_COLUMNS[name]
        columns["T"] = temperature(values, d, mass)
        header["T_from"] = f"T = {words}"
        if error is not None:
            columns["T_err"] = power * columns["T"] * error / values
    return columns


def read_gas(header: dict[str, str]) -> Gas:
    """Return the gas that the header of a curve describes, with A = 0, which a fit estimates.

    Args:
        header: eta (the packing fraction), diameter (m), density (of the material, kg/m^3), Y
            (Pa), nu, T0 (m^2/s^2) and, if it is not 3, dimension, as `read_curve` returns them;
            for rough spheres, walls, drag and a drive also the keys of
            `jaxgran.data.curve_file.read_elements`.

    Returns:
        A gas of viscoelastic spheres. Values that no granular gas has, and unknown keys, cause
        warnings.

    Raises:
        ValueError: for a missing key, a value that is no number or outside its range, and for
            elements that `read_elements` does not support.

    >>> header = {"eta": "0.05", "diameter": "2e-3", "density": "2500", "T0": "0.01"}
    >>> header |= {"Y": "5e7", "nu": "0.22"}
    >>> float(jaxgran.read_gas(header).packing_fraction)
    0.05
    """
    _check_header(header)
    gas = _make_gas(header)
    quantities = {*BY_SYMBOL, *PRIOR_KEYS}
    numbers = [key for key in header if key in quantities and header[key] != GUESS]
    for question in ask_about_header({key: files.header_number(header, key) for key in numbers}):
        warnings.warn(question, stacklevel=2)
    known = dict.fromkeys((*REQUIRED, *BY_SYMBOL, *OPTIONAL_KEYS, *UNIT_KEYS))
    others = {*known, *PRIOR_KEYS, *PROVENANCE_KEYS, *UNSUPPORTED_KEYS}
    # Comments that are no single word are not keys.
    unknown = [key for key in header if key.isidentifier() and key not in others]
    if unknown:
        warnings.warn(
            f"ignoring unknown header keys: {', '.join(unknown)}. Known keys are "
            f"{', '.join(known)}, and errors such as eta_err",
            stacklevel=2,
        )
    return gas


def _check_header(header: Any) -> None:
    kinds = str, int, float, np.number
    if not isinstance(header, dict) or not all(isinstance(x, kinds) for x in header.values()):
        raise ValueError(
            f"header must be a dictionary of texts, as read_curve returns it, got {header!r:.60}"
        )


def _gas_or_none(header: dict[str, str]) -> Gas | None:
    """Return the gas of a header, or None if the header does not describe one."""
    try:
        return _make_gas(header)
    except ValueError:  # `read_gas` says why
        return None


def _make_gas(header: dict[str, str]) -> Gas:
    d = files.header_count(header, "dimension") or 3
    if "eta" not in header and {"N", "container_side", "diameter"} <= header.keys():
        size, side = (files.header_number(header, key) for key in ("diameter", "container_side"))
        sphere = pi / 6 * size**3 if d == 3 else pi / 4 * size**2
        header = header | {"eta": repr(files.header_number(header, "N") * sphere / side**d)}
    missing = [key for key in REQUIRED if key not in header]
    if missing:
        raise ValueError(
            f"the header lacks {', '.join(missing)}; add lines such as '# {missing[0]}: VALUE' "
            f"(needed: {', '.join(REQUIRED)}; in SI units, or with a unit behind the value)"
        )
    values = {key: files.header_number(header, key) for key in REQUIRED}
    gas = Gas(
        Viscoelastic(values["Y"], values["nu"], 0.0),
        diameter=values["diameter"],
        mass=sphere_mass(values["diameter"], values["density"]),
        packing_fraction=values["eta"],
        temperature=values["T0"],
        dimension=d,
        **read_elements(header),
    )
    if gas.container is not None and "N" in header:
        number, eta = files.header_number(header, "N"), float(gas.packing_fraction)
        ratio = container_volume_ratio(gas, number)
        if abs(ratio - 1) > VOLUME_TOLERANCE:
            raise ValueError(
                f"N, eta and container_side contradict: {number:g} spheres in this container have "
                f"eta = {eta * ratio:.4g}, but the header gives {eta:.4g}; correct one of them"
            )
    return gas


def read_elements(header: dict[str, str]) -> dict[str, Any]:
    """Return the elements that a header describes, as keyword arguments of `jaxgran.Gas`.

    Args:
        header: for rough spheres beta_t and, if they are not 0.4 and 0, reduced_inertia,
            4 I/(m sigma^2), and T_rot_0, T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2, and, if they
            slide, Coulomb's coefficient friction; for lasting contacts with friction
            tangential_damping and friction (`jaxgran.Frictional`, numbers without a unit) in place
            of beta_t; for walls container_side, of a cube, m,
            wall_restitution and, for rough walls, wall_beta_t; for drag gamma, 1/s, of
            dv/dt = -gamma v; for a drive by white noise drive_strength, m^2/s^3, of
            dT/dt = drive_strength.

    Raises:
        ValueError: for a key that needs another one, a value outside its range, and for effects
            that no model has: gravity, mixtures, rods, ellipsoids, cohesion and charges.
    """
    for key, (neutral, reason) in UNSUPPORTED_KEYS.items():
        if key in header and (neutral is None or files.header_number(header, key) != neutral):
            advice = "" if neutral is None else f" or set it to {neutral:g}"
            raise ValueError(
                f"the header gives {key}: {reason}. No model of jaxgran supports it; fit a curve "
                f"of equal spheres without it, and leave {key} out{advice}"
            )
    lasting, rough = "tangential_damping" in header, "beta_t" in header
    if lasting and rough:
        raise ValueError(
            "the header gives both beta_t (instantaneous impacts) and tangential_damping (lasting "
            "contacts). Leave out beta_t for SoftSpheres(N), or tangential_damping for the other "
            "models"
        )
    unused = Rough if lasting or ("friction" in header and not rough) else Frictional
    elements = {}
    for name, kind in ((name, kind) for name, kinds in ELEMENTS.items() for kind in kinds):
        symbols = {field: p.symbol for field, p in fields_of(kind.__name__).items() if p.symbol}
        symbols |= {"restitution": "wall_restitution"} if kind is Walls else {}
        fields = {symbol: field for field, symbol in symbols.items()}
        given = [key for key in header if key in fields]
        if not given or kind is unused:
            continue
        required = (x.name for x in dataclasses.fields(kind) if x.default is dataclasses.MISSING)
        if missing := [symbols[x] for x in required if symbols[x] not in header]:
            fitted = f", or the line '# {missing[0]}: guess' to fit it (--free {missing[0]})"
            raise ValueError(
                f"the header gives {given[0]} without {missing[0]}; add {missing[0]}"
                + (fitted if missing[0] in GUESSES else "")
            )
        values = header | {key: GUESSES[key] for key in GUESSES if header.get(key) == GUESS}
        elements[name] = kind(**{fields[key]: files.header_number(values, key) for key in given})
    return elements


def read_priors(header: dict[str, str]) -> dict[str, tuple[float, float]]:
    """Read standard errors from a header, in the form of the argument ``priors`` of `jaxgran.fit`.

    Where the diameter has an error and the density has none, the mass follows the diameter.

    Args:
        header: with some of eta_err, diameter_err, density_err, Y_err, nu_err, T0_err, t0_err,
            beta_t_err and so on, the standard errors of the other keys, in their units. The value
            of t0, the time at which the gas began to cool, is 0 unless the header gives it.

    Raises:
        ValueError: for an error without its value, or one that is no positive number.

    >>> jaxgran.read_priors({"eta": "0.05", "eta_err": "0.002"})
    {'packing_fraction': (0.05, 0.002)}
    """
    _check_header(header)
    priors = {}
    if "t0" in header and "t0_err" not in header:
        raise ValueError(
            "the header gives t0 without t0_err; add its error, or subtract t0 from the times"
        )
    for key, name in PRIOR_KEYS.items():
        if key not in header:
            continue
        value_key = key.removesuffix("_err")
        if value_key not in header and value_key != "t0":
            raise ValueError(f"the header gives {key} without {value_key}; add the value itself")
        error = files.header_number(header, key)
        if error <= 0:
            raise ValueError(
                f"header line {key}: must be a positive number, got {header[key]!r}; leave it out "
                f"if {value_key} is known exactly"
            )
        priors[name] = files.header_number({"t0": "0"} | header, value_key), error
    if "diameter" in priors and "density" not in priors:
        if "density" not in header:
            raise ValueError("the header gives diameter_err without density; add the density")
        density = files.header_number(header, "density")
        priors["density"] = (density, EXACT_DENSITY_ERROR * density)
    return priors


def read_absent(header: dict[str, str]) -> tuple[str, ...]:
    """Read which effects a header declares absent, in the form of ``absent`` of `jaxgran.fit`.

    Args:
        header: with, for example, ``absent: walls, roughness``.

    Raises:
        ValueError: for an unknown effect, or one that the header describes by another key.

    >>> jaxgran.read_absent({"absent": "walls, drag"})
    ('walls', 'drag')
    """
    _check_header(header)
    names = tuple(filter(None, re.split(r"[\s,;]+", header.get("absent", ""))))
    for name in names:
        if name not in ABSENT:
            raise ValueError(
                f"header line absent: {name!r} is not known; give some of {', '.join(ABSENT)}"
            )
        if given := [key for key in ABSENT[name] if key in header]:
            raise ValueError(f"the header declares {name} absent and gives {given[0]}; remove one")
    return names


def write_curve(
    path: str | Path, curve: CoolingCurve, header: dict[str, str], *, overwrite: bool = False
) -> None:
    """Write a curve to a file that `read_curve` reads.

    A CSV file holds every known quantity at each time, T_err, msd, a2, collisions, energies and so
    on, with 17 digits, so that it is read back without loss, but neither single replicas nor
    particles. A file whose name ends in .npz holds everything, bit for bit.

    Args:
        path: the file; its suffix, .npz or another one, chooses the format.
        curve: of one system; none of its arrays may be traced.
        header: written as lines ``# key: value``, or unchanged to an .npz file.
        overwrite: whether an existing file may be replaced.

    Raises:
        ValueError: if the file exists and `overwrite` is False.
        OSError: naming the path, if it cannot be written; an existing file is then unchanged.

    >>> jaxgran.write_curve("all.npz", curve, {"note": "every array"}, overwrite=True)
    >>> jaxgran.read_curve("all.npz")[1]["note"]
    'every array'
    """
    path = files.checked_path(path, CSV_FILE)
    _check_header(header)
    check_bool(overwrite=overwrite)
    if not isinstance(curve, CoolingCurve):
        raise ValueError(f"curve must be a jaxgran.CoolingCurve, got {curve!r:.60}")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; choose another name or set overwrite=True")
    if path.suffix == ARCHIVE_SUFFIX:
        arrays: dict[str, Any] = {name: np.asarray(x) for name, x in to_arrays(curve).items()}
        arrays[HEADER_ENTRY] = np.array(json.dumps(header))
        return files.write_atomically(path, lambda file: np.savez_compressed(file, **arrays))
    fields = {q.column: getattr(curve, q.field) for q in QUANTITIES.values()}
    present = {name: np.asarray(v) for name, v in fields.items() if v is not None}
    lines = []
    for key, value in header.items():
        line = f"{key}: {value}"
        if len(line.splitlines()) > 1 or header_entry(line) != (key, str(value).strip()):
            raise ValueError(
                f"header key {key!r}: key and value must be one line of text each, and the key "
                "without : and ="
            )
        lines.append(f"# {line}")
    lines.append(",".join(present))
    lines += [",".join(f"{x:.17g}" for x in row) for row in zip(*present.values(), strict=True)]
    text = "\n".join(lines) + "\n"
    files.write_atomically(path, lambda f: f.write(text.encode()))


ARCHIVE_SUFFIX = ".npz"

HEADER_ENTRY = "header"
"""Entry of an npz file that holds the header, as JSON; all others are arrays."""


def _read_archive(path: Path) -> tuple[CoolingCurve, dict[str, str]]:
    content = io.BytesIO(path.read_bytes())
    try:
        with np.load(content, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop(HEADER_ENTRY)))
        return from_arrays({name: jnp.asarray(x) for name, x in arrays.items()}), header
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"not a file that this version of jaxgran.write_curve wrote ({error}); give such a "
            "file, or a CSV file"
        ) from None


DROP_TEST_COLUMNS = ("v", "eps", "eps_err")
MAX_SIGMAS = 5.0
"""Largest distance of a measured eps above 1, in standard errors, that is taken for chance."""


class DropTest(eqx.Module):
    """Coefficients of restitution of single impacts at some normal speeds.

    They depend on ``A Y^(2/5)``, as the cooling of a gas of hard spheres does, and on no other
    quantity of a cooling curve.

    Args:
        speed: normal relative speed before each impact, m/s, shape (n,), > 0.
        restitution: eps, shape (n,), > 0; above 1 only within its error.
        error: standard error of each eps, shape (n,), > 0.
        onto_plate: whether a sphere falls onto a thick plate of the same material, which makes
            ``alpha`` smaller by sqrt(2); if False, two equal spheres collide.

    Raises:
        ValueError: for a value out of its range, or lists of different lengths.

    >>> drops = jaxgran.DropTest(speed=[0.1, 0.3], restitution=[0.92, 0.90], error=[0.01, 0.01])
    >>> drops.speed.shape
    (2,)
    """

    speed: UserNumber = eqx.field(converter=float_array)
    restitution: UserNumber = eqx.field(converter=float_array)
    error: UserNumber = eqx.field(converter=float_array)
    onto_plate: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_bool(onto_plate=self.onto_plate)
        POSITIVE.check("speed", self.speed, "Give normal speeds in m/s.")
        advice = "Give the speed after over that before an impact."
        POSITIVE.check("restitution", self.restitution, advice)
        POSITIVE.check("error", self.error, "Give the standard error of each eps.")
        shapes = [np.shape(x) for x in (self.speed, self.restitution, self.error)]
        if len(shapes[0]) != 1 or len(set(shapes)) > 1 or shapes[0] == (0,):
            raise ValueError(
                "speed, restitution and error must be lists of equal length, with at least one "
                f"impact; got shapes {', '.join(map(str, shapes))}"
            )
        if any_traced((self.restitution, self.error)):
            return
        eps, error = np.asarray(self.restitution), np.asarray(self.error)
        above = eps > 1 + MAX_SIGMAS * error
        if np.any(above):
            i = int(np.argmax(above))
            raise ValueError(
                f"restitution must be at most 1 within its error, got {eps[i]:g} +- {error[i]:g}. "
                f"{advice}"
            )

    def residuals(self, gas: Gas) -> Float[Array, "n"]:
        """Return (measured - computed eps) over the error, for spheres of a gas."""
        reduced = gas.law.on_wall if self.onto_plate else gas.law.reduced
        law = reduced(diameter=gas.diameter, mass=gas.mass, speed=jnp.ones(()))
        computed = law.restitution(jnp.asarray(self.speed))
        return (jnp.asarray(self.restitution) - computed) / jnp.asarray(self.error)


def read_drop_test(path: str | Path, *, onto_plate: bool = False) -> DropTest:
    """Read a drop test from a CSV file with a line of names, v,eps,eps_err, and rows of numbers.

    Args:
        path: the file; v in m/s, or in units that it gives as curve files do (see `read_curve`).
        onto_plate: see `DropTest`.

    Raises:
        ValueError: saying what is wrong, in which line.

    >>> from pathlib import Path
    >>> rows = "v,eps,eps_err", "0.1,0.92,0.01", "0.3,0.90,0.01", "1.0,0.87,0.01"
    >>> size = Path("drops.csv").write_text(chr(10).join(rows))
    >>> jaxgran.read_drop_test("drops.csv").restitution.shape
    (3,)
    """
    return read_drops(path, onto_plate)[0]


def read_drops(path: str | Path, onto_plate: bool) -> tuple[DropTest, dict[str, str]]:
    """Return a drop test and the header of its file, in SI: see `read_drop_test`."""
    wanted = ",".join(DROP_TEST_COLUMNS)

    def columns_to_read(names: list[str]) -> list[str]:
        if sorted(names) != sorted(DROP_TEST_COLUMNS):
            raise ValueError(f"the columns are {', '.join(names)}; name them {wanted}")
        return names

    path = files.checked_path(path, f"a CSV file with the columns {wanted}")
    with files.name_in_errors(path):
        header, columns, _ = read_table(path, wanted, columns_to_read)
        return DropTest(columns["v"], columns["eps"], columns["eps_err"], onto_plate), header


def _is_usual(name: str, value: float) -> bool:
    low, high = USUAL_RANGES.get(name, (-np.inf, np.inf))
    return low <= value <= high


def ask_about_header(values: dict[str, float]) -> Iterator[str]:
    """Yield questions about unusual values of header keys, in SI."""
    for key, value in values.items():
        if not _is_usual(key, value):
            yield _unit_question(key, value, f"{key}: ")
        error = values.get(f"{key}_err", 0.0)
        if key in USUAL_RANGES and error > value > 0:
            yield (
                f"{key}_err is {error:.6g} {UNITS[key]}, more than {key}, {value:.6g}: a number "
                f"without a unit has that of {key}. Is it in {UNITS[key]}? Then write it behind"
            )


def _unit_question(name: str, value: float, line: str) -> str:
    low, high = USUAL_RANGES[name]
    base = UNITS[name]
    question = "check its unit"
    for unit in OTHER_UNITS[base]:
        in_si = unit_in(unit, base) * value
        if _is_usual(name, in_si):
            rewritten = f"{line}{in_si:.6g}, or {line}{value:g} {unit}"
            rewritten = rewritten if line else f"{name} ({unit}) as the name of the column"
            question = f"is it in {unit}? Then write {rewritten}"
            break
    return f"{name} is {value:.6g} {base}, and usual is {low:g} to {high:g}: {question}"


def ask_about_columns(
    curve: CoolingCurve, header: dict[str, str], gas: Gas | None
) -> Iterator[str]:
    """Yield questions about unusual values of columns, and columns that contradict the header.

    Args:
        curve: the columns, in SI.
        header: in SI.
        gas: of the header, if it describes one.
    """
    for quantity in QUANTITIES.values():
        values = getattr(curve, quantity.field)
        if quantity.measured and values is not None and not quantity.column.endswith("_err"):
            largest = float(np.max(np.asarray(values)))
            if largest > 0 and not _is_usual(quantity.column, largest):
                yield _unit_question(quantity.column, largest, "")
    if gas is None or gas.drive is not None:
        return
    if not all(_is_usual(key, float(header[key])) for key in REQUIRED if key in header):
        return  # `ask_about_header` asks first
    number = float(header["N"]) if "N" in header else None
    yield from _ask_about_start(curve, header, gas, number)
    if number is not None and curve.temperature_error is not None:
        replicas = float(header.get("replicas", 1))
        share = np.asarray(curve.temperature_error) / np.asarray(curve.temperature)
        expected = sqrt(2 / (gas.dimension * number * replicas))
        ratios = {"larger": share[1:].min() / expected, "smaller": expected / share.max()}
        for word, ratio in ratios.items():
            if ratio > MAX_ERROR_RATIO:
                yield (
                    f"T_err is at least {ratio:.2g} times {word} than the scatter of T of N = "
                    f"{number:g} particles in {replicas:g} run(s): are N, replicas and T_err those "
                    "of this curve, and is T_err a standard error of the mean?"
                )


def _ask_about_start(
    curve: CoolingCurve, header: dict[str, str], gas: Gas, number: float | None
) -> Iterator[str]:
    """Compare T at first with T0, the clock with T0, and the loss with the mean free time."""
    times = np.asarray(curve.times) - float(header.get("t0", 0.0))
    T, T0 = np.asarray(curve.temperature), float(gas.temperature)
    rows = slice(0, max(4, int(np.sum(0.4 * T[0] < T))))
    line = (T[rows] / T0) ** -0.6  # straight in time for viscoelastic spheres
    slope, origin = np.polyfit(times[rows] - times[0], line, 1, w=1 / line)
    if slope <= 0 or not np.isfinite(slope):
        return
    first = origin ** (-1 / 0.6)
    begin = times[0] + (1 - origin) / slope  # where the line reaches T0
    halving = (2**0.6 - 1) * max(origin, 0.1) / slope
    chance = 4 * sqrt(2 / (gas.dimension * number)) if number else 0.0
    known = 3 * float(header.get("T0_err", 0.0)) / T0
    at_zero = max(origin - slope * times[0], 1e-9) ** (-1 / 0.6)
    if first > MAX_RATIO + chance + known:
        yield _scale_question(first, gas, number)
    elif begin > MAX_LATENESS * halving and begin > 0.5 * times[0]:
        yield (
            f"T is T0 = {T0:g} m^2/s^2 at t = {begin:.6g} s and not at 0, by the first rows: does "
            "the clock of the file start earlier than the gas? Then subtract that time, or fit it: "
            "--free A t0. Or is T0 another one? Then --free A T0"
        )
    elif at_zero < 1 / (MAX_RATIO + chance + known):
        yield _scale_question(at_zero, gas, number)
    loss = gas.dimension * slope / (0.6 * origin) / float(_collision_frequency(gas))
    if T[-1] < 0.8 * T[0] and not USUAL_LOSS[0] <= loss <= USUAL_LOSS[1]:
        units = [unit for unit in OTHER_UNITS["s"] if 1e-3 < loss / unit_in(unit, "s") < 1]
        question = "are t, eta, diameter and T0 in the units that the file says?"
        if units:
            question = f"is t in {' or '.join(units)}? Then name the column t ({units[0]})"
        if loss < 1:
            question += "; is it in steps or frames? Then multiply it by their duration"
        yield (
            f"T falls to a half in {halving / float(gas.mean_free_time):.3g} mean free times of "
            f"the header's gas (eta, diameter, T0), and usual is .1 to 1e3: {question}"
        )


@eqx.filter_jit
def _collision_frequency(gas: Gas) -> Array:
    return gas.collision_frequency


def _scale_question(ratio: float, gas: Gas, number: float | None) -> str:
    """Return the question for T that begins at another value than T0."""
    d, mass, T0 = gas.dimension, float(gas.mass), float(gas.temperature)
    meanings = [
        (d, "<v^2>, not divided by the dimension"),
        (2, "<v_x^2 + v_y^2>? Then name the column v2_xy. Is it twice T"),
        (1 / T0, "T over T0"),
        (d / 2, "the energy over the mass"),
        (mass, "m <v^2>/d, in J"),
        (d * mass / 2, "the energy of a particle, in J? Then name the column energy. Is it that"),
        (d * mass / 2 * (number or np.nan), "the energy of all particles, in J"),
        (mass / BOLTZMANN, "in kelvin, m <v^2>/(d k_B)"),
        (1e4, "in cm^2/s^2"),
        (1e6, "in mm^2/s^2"),
    ]
    near = [(f, words) for f, words in meanings if abs(np.log(ratio / f)) < 0.12]
    question = "do both have the unit m^2/s^2, and are both <v^2>/d?"
    if near:
        factor, words = near[0]
        question = f"is the column {words}? Then multiply it by {1 / factor:.6g}"
    return (
        f"T is {ratio * T0:.4g} at first, {ratio:.3g} times the header's T0 = {T0:g} m^2/s^2: "
        f"{question}; or correct T0, or fit it: --free A T0"
    )
