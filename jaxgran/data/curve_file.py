"""Files of cooling curves, tracks and drop tests.

A CSV file holds a measured curve, or tracks of particles, under header lines that describe the gas;
an npz file holds every array of a curve. The module also converts units, computes T from related
columns and reads the gas, the elements of a scene and priors from a header.
"""

import json
import warnings
import zipfile
from functools import partial
from math import pi
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran._utils.validation import (
    POSITIVE,
    Domain,
    UserBool,
    UserNumber,
    check_bool,
    float_array,
)
from jaxgran.data.curve import COLUMNS, COMPUTED_COLUMNS, MIN_POINTS, CoolingCurve, Particles
from jaxgran.data.files import (
    Table,
    header_count,
    header_number,
    number_row,
    read_table,
    read_text,
    write_atomically,
)
from jaxgran.scene.elements import (
    VOLUME_TOLERANCE,
    Frictional,
    Rough,
    StokesDrag,
    Walls,
    WhiteNoise,
    container_volume_ratio,
)
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_mass
from jaxgran.scene.laws import ConstantRestitution, Viscoelastic

GAS_KEYS = ("eta", "diameter", "density", "Y", "nu", "T0")
"""Header keys that `read_gas` requires."""

PRIOR_KEYS = {
    "eta_err": "packing_fraction",
    "diameter_err": "diameter",
    "density_err": "density",
    "Y_err": "youngs_modulus",
    "nu_err": "poisson_ratio",
    "T0_err": "temperature",
    "t0_err": "t0",
}
"""Header keys of standard errors, and the names of their priors in `jaxgran.fit`."""

EXACT_DENSITY_ERROR = 1e-4
"""Relative error of the prior of a density without an error, where the diameter has one."""


def read_curve(path: str | Path) -> tuple[CoolingCurve, dict[str, str]]:
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
            same name and _err. Header keys length_unit (m, cm, mm, um) and time_unit (s, ms, us,
            min) give the units of the columns and of diameter, T0 and A; density and Y stay in SI.
            Alternatively its columns are id,t,x,y and z, tracks of particles (see
            `jaxgran.data.curve_file.curve_of_tracks`). All other columns (a2, collisions, D,
            energies) and npz files that `write_curve` writes are read, too.

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
    path = Path(path)
    if path.suffix == ARCHIVE_SUFFIX:
        return _read_archive(path)
    table = read_table(path, "t,T[,T_err][,msd][,msd_err]", partial(_check_column_names, path))
    if "id" in table.columns:
        return curve_of_tracks(path, table)
    columns, header, lines = table.columns, table.header, table.lines
    if len(lines) < MIN_POINTS:
        raise ValueError(
            f"{path}: {len(lines)} rows of numbers, at least {MIN_POINTS} are needed; "
            "measure the cooling at more times"
        )
    try:
        columns, header = _convert_to_si(columns, header)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    known = COLUMNS | COMPUTED_COLUMNS
    fields: dict[str, Any] = {known[name]: jnp.asarray(x) for name, x in columns.items()}
    curve = CoolingCurve(**fields)
    curve.check(lambda i: f"{path}, line {lines[i]}")
    return curve, header


def _check_column_names(path: Path, i: int, names: list[str]) -> None:
    """Raise ValueError if a column name in line i is unknown, missing or repeated."""
    if "id" in names:
        _check_track_names(path, i, names)
        return
    temperatures = [name for name in ("T", *TEMPERATURE_COLUMNS) if name in names]
    known = {
        *COLUMNS,
        *COMPUTED_COLUMNS,
        *(f"{name}{end}" for name in TEMPERATURE_COLUMNS for end in ("", "_err")),
    }
    unknown = [name for name in names if name not in known]
    unknown += [
        f"{name}_err"
        for name in TEMPERATURE_COLUMNS
        if f"{name}_err" in names and name not in names
    ]
    missing = ([] if "t" in names else ["t"]) + ([] if temperatures else ["T"])
    if len(temperatures) > 1:
        raise ValueError(
            f"{path}, line {i}: {' and '.join(temperatures)} each give the temperature; keep one"
        )
    if unknown or missing or len(set(names)) < len(names):
        raise ValueError(
            f"{path}, line {i}: the columns are {', '.join(names)}; "
            + (f"missing: {', '.join(missing)}; " if missing else "")
            + (f"not known: {', '.join(unknown)}; " if unknown else "")
            + f"name them t,T and, where measured, {', '.join(list(COLUMNS)[2:])}, each once. In "
            f"place of T there may be {', '.join(TEMPERATURE_COLUMNS)}; tracks of particles have "
            "the columns id,t,x,y[,z]"
        )


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
    missing = [key for key in GAS_KEYS if key not in header]
    if missing:
        raise ValueError(
            f"the header lacks {', '.join(missing)}; add lines such as '# {missing[0]}: VALUE' "
            f"(needed: {', '.join(GAS_KEYS)}; in SI units)"
        )
    values = {key: header_number(header, key) for key in GAS_KEYS}
    law = Viscoelastic(values["Y"], values["nu"], 0.0)
    gas = Gas(
        law,
        diameter=values["diameter"],
        mass=sphere_mass(values["diameter"], values["density"]),
        packing_fraction=values["eta"],
        temperature=values["T0"],
        dimension=header_count(header, "dimension") or 3,
        **read_elements(header),
    )
    _check_container_volume(header, gas)
    _warn_of_unusual_values(gas)
    _warn_of_unknown_keys(header)
    return gas


def read_priors(header: dict[str, str]) -> dict[str, tuple[float, float]]:
    """Read standard errors from a header, in the form of the argument ``priors`` of `jaxgran.fit`.

    Where the diameter has an error and the density has none, the mass follows the diameter.

    Args:
        header: with some of eta_err, diameter_err (m), density_err (kg/m^3), Y_err (Pa), nu_err,
            T0_err (m^2/s^2) and t0_err (s), the standard errors of eta, diameter and so on. The
            value of t0, the time at which the gas began to cool, is 0 unless the header gives it.

    Raises:
        ValueError: for an error without its value, or one that is no positive number.

    >>> jaxgran.read_priors({"eta": "0.05", "eta_err": "0.002"})
    {'packing_fraction': (0.05, 0.002)}
    """
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
        error = header_number(header, key)
        if error <= 0:
            raise ValueError(
                f"header line {key}: must be a positive number, got {header[key]!r}; leave it out "
                f"if {value_key} is known exactly"
            )
        value = header_number({"t0": "0"} | header, value_key)
        priors[name] = (value, error)
    if "diameter" in priors and "density" not in priors:
        if "density" not in header:
            raise ValueError("the header gives diameter_err without density; add the density")
        density = header_number(header, "density")
        priors["density"] = (density, EXACT_DENSITY_ERROR * density)
    return priors


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
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; choose another name or set overwrite=True")
    if path.suffix == ARCHIVE_SUFFIX:
        return _write_archive(path, curve, header)
    fields = {name: getattr(curve, field) for name, field in (COLUMNS | COMPUTED_COLUMNS).items()}
    present = {name: np.asarray(v) for name, v in fields.items() if v is not None}
    lines = [f"# {key}: {value}" for key, value in header.items()]
    lines.append(",".join(present))
    lines += [",".join(f"{x:.17g}" for x in row) for row in zip(*present.values(), strict=True)]
    text = "\n".join(lines) + "\n"
    write_atomically(path, lambda f: f.write(text.encode()))


LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
"""Values of the header key ``length_unit``, in m."""

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0}
"""Values of the header key ``time_unit``, in s."""

UNIT_POWERS = {
    "t": (0, 1),
    "T": (2, -2),
    "msd": (2, 0),
    "D": (2, -1),
    "velocity_correlation": (2, -2),
    "x": (1, 0),
    "y": (1, 0),
    "z": (1, 0),
    "localisation_error": (1, 0),
    "T_rot": (2, -2),
    "mean_speed": (1, -1),
    "vx2": (2, -2),
    "v2_xy": (2, -2),
    "diameter": (1, 0),
    "diameter_err": (1, 0),
    "T0": (2, -2),
    "T0_err": (2, -2),
    "t0": (0, 1),
    "t0_err": (0, 1),
    "T_rot_0": (2, -2),
    "container_side": (1, 0),
    "gamma": (0, -1),
    "A": (0, 1),
}
"""Powers of length and time in columns, with their errors, and header values; all others are SI."""

TEMPERATURE_COLUMNS = {
    "mean_speed": "mean speed <|v|>",
    "vx2": "mean square <v_x^2> of one component of the velocity",
    "v2_xy": "mean square <v_x^2 + v_y^2> of two components, which a camera records",
    "energy": "translational energy of a particle (m/2) <v^2>, in J",
}
"""Columns from which T = <v^2>/d is computed, and their meaning."""

USUAL_RANGES = {
    "diameter": (1e-7, 0.1, "m"),
    "temperature": (0.0, 900.0, "m^2/s^2, a thermal speed of 30 m/s"),
    "youngs_modulus": (1e3, 1e13, "Pa"),
}
"""Smallest and largest usual value in a granular gas, and the unit; others cause a warning."""


def _warn_of_unusual_values(gas: Gas) -> None:
    """Warn of values that no granular gas has, which are mostly errors of units."""
    for name, (low, high, unit) in USUAL_RANGES.items():
        value = float(gas.value(name))
        if not low <= value <= high:
            warnings.warn(
                f"{name} is {value:.3g}, outside {low:g} to {high:g} {unit}: check its unit; "
                "a file may give its units as length_unit and time_unit",
                stacklevel=3,
            )


def _convert_to_si(
    columns: dict[str, np.ndarray], header: dict[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return columns and header in SI, with T in place of one of `TEMPERATURE_COLUMNS`.

    The returned header has no units; its entry T_from says how T was computed.

    Raises:
        ValueError: for an unknown unit, or an energy of particles of unknown mass.
    """
    units = (
        _header_unit(header, "length_unit", LENGTH_UNITS),
        _header_unit(header, "time_unit", TIME_UNITS),
    )
    unit_keys = ("length_unit", "time_unit")
    header = {key: value for key, value in header.items() if key not in unit_keys}
    for key in UNIT_POWERS.keys() & header.keys():
        factor = _unit_factor(units, key)
        if factor != 1 and (value := _number_or_none(header[key])) is not None:
            header[key] = repr(factor * value)
    columns = {name: _unit_factor(units, name) * column for name, column in columns.items()}
    for name in TEMPERATURE_COLUMNS.keys() & columns.keys():
        values = columns.pop(name)
        error = columns.pop(f"{name}_err", None)
        columns["T"], power, header["T_from"] = _temperature_from_column(name, values, header)
        if error is not None:
            share = np.divide(error, values, out=np.zeros_like(error), where=values != 0)
            columns["T_err"] = power * columns["T"] * share
    return columns, header


def _unit_factor(units: tuple[float, float], name: str) -> float:
    length, time = UNIT_POWERS.get(name.removesuffix("_err"), (0, 0))
    return units[0] ** length * units[1] ** time


def _header_unit(header: dict[str, str], key: str, units: dict[str, float]) -> float:
    name = header.get(key, next(iter(units)))
    if name not in units:
        raise ValueError(f"header line {key}: {name!r} is not known; use {', '.join(units)}")
    return units[name]


def _number_or_none(text: str) -> float | None:
    """Return the number in a text, or None; the code that uses the value reports the error."""
    try:
        return float(text)
    except ValueError:
        return None


def _temperature_from_column(
    name: str, values: np.ndarray, header: dict[str, str]
) -> tuple[np.ndarray, float, str]:
    """Compute T = <v^2>/d from a related column, for isotropic Maxwellian velocities.

    Args:
        name: name of the column, one of `TEMPERATURE_COLUMNS`.
        values: in SI.
        header: with dimension (default 3) and, for an energy, diameter and density.

    Returns:
        T, m^2/s^2; the power of the column in it; and the equation, in words.

    Raises:
        ValueError: for an energy of particles of unknown mass.
    """
    three = _number_or_none(header.get("dimension", "3")) == 3
    if name == "mean_speed":
        factor, words = (pi / 8, "pi/8") if three else (2 / pi, "2/pi")
        return factor * values**2, 2.0, f"T = ({words}) mean_speed^2, for Maxwellian velocities"
    if name == "vx2":
        return values, 1.0, "T = vx2, for isotropic velocities"
    if name == "v2_xy":
        return values / 2, 1.0, "T = v2_xy / 2, for isotropic velocities"
    diameter, density = (_number_or_none(header.get(key, "")) for key in ("diameter", "density"))
    if diameter is None or density is None:
        raise ValueError(
            "a column energy needs the mass of a particle: add diameter and density to the header, "
            "or give T = <v^2>/d itself"
        )
    mass = float(sphere_mass(diameter, density))
    d = 3 if three else 2
    return 2 * values / (d * mass), 1.0, f"T = 2 energy / ({d} m), for energies in J per particle"


ROUGH_KEYS = ("beta_t", "reduced_inertia", "T_rot_0")
FRICTION_KEYS = ("tangential_damping", "friction")
WALL_KEYS = ("container_side", "wall_restitution", "wall_beta_t")
DRAG_KEYS = ("gamma",)
DRIVE_KEYS = ("drive_strength",)
ELEMENT_KEYS = (*ROUGH_KEYS, *FRICTION_KEYS, *WALL_KEYS, *DRAG_KEYS, *DRIVE_KEYS)
"""Header keys of the elements of a scene."""

UNSUPPORTED_KEYS = {
    "gravity": (
        0.0,
        "under gravity density and T change with height, but gases in jaxgran are homogeneous",
    ),
    "polydispersity": (
        0.0,
        "grains of unequal masses have unequal temperatures, and one T is too few",
    ),
    "diameter_2": (
        None,
        "grains of a mixture have a temperature for each kind, and one T is too few",
    ),
    "density_2": (
        None,
        "grains of a mixture have a temperature for each kind, and one T is too few",
    ),
    "aspect_ratio": (
        1.0,
        "rods and ellipsoids collide at a rate that depends on their orientation, and smooth "
        "impacts make them rotate, but grains in jaxgran are spheres",
    ),
    "cohesion": (0.0, "grains that stick lose all of their speed below some speed, and grow"),
    "surface_energy": (0.0, "grains that stick lose all of their speed below some speed, and grow"),
    "charge": (
        0.0,
        "charged grains are deflected without touching, but grains in jaxgran fly freely",
    ),
}
"""Keys of effects that no model has: the value that means "no effect" (or None), and the reason."""

OTHER_KEYS = (
    "N",
    "A",
    "dimension",
    "replicas",
    "T_from",
    "length_unit",
    "time_unit",
    "localisation_error",
)
"""Further known keys, neither of the gas nor of its elements."""

PROVENANCE_KEYS = ("units", "points", "end_tau", "melt_tau", "steps_per_contact", "source")
"""Keys that document the origin of a curve, and that no result depends on."""


def read_elements(header: dict[str, str]) -> dict[str, Any]:
    """Return the elements that a header describes, as keyword arguments of `jaxgran.Gas`.

    Args:
        header: for rough spheres beta_t and, if they are not 0.4 and 0, reduced_inertia,
            4 I/(m sigma^2), and T_rot_0, T_rot = I <w^2>/(d_rot m) at t = 0, m^2/s^2; for lasting
            contacts with friction tangential_damping and friction (`jaxgran.Frictional`, numbers
            without a unit) in place of beta_t; for walls container_side, of a cube, m,
            wall_restitution and, for rough walls, wall_beta_t; for drag gamma, 1/s, of
            dv/dt = -gamma v; for a drive by white noise drive_strength, m^2/s^3, of
            dT/dt = drive_strength.

    Raises:
        ValueError: for a key that needs another one, a value outside its range, and for effects
            that no model has: gravity, mixtures, rods, ellipsoids, cohesion and charges.
    """
    _check_supported(header)
    values = {key: header_number(header, key) for key in header if key in ELEMENT_KEYS}
    elements: dict[str, Any] = {}
    surface = _read_surface(values)
    if surface is not None:
        elements["surface"] = surface
    if _has_element(values, WALL_KEYS, required=("container_side", "wall_restitution")):
        elements["container"] = Walls(
            values["container_side"],
            restitution=values["wall_restitution"],
            tangential_restitution=values.get("wall_beta_t"),
        )
    if "gamma" in values:
        elements["drag"] = StokesDrag(values["gamma"])
    if "drive_strength" in values:
        elements["drive"] = WhiteNoise(values["drive_strength"])
    return elements


def _check_supported(header: dict[str, str]) -> None:
    for key, (neutral, reason) in UNSUPPORTED_KEYS.items():
        if key in header and (neutral is None or header_number(header, key) != neutral):
            advice = "" if neutral is None else f" or set it to {neutral:g}"
            raise ValueError(
                f"the header gives {key}: {reason}. No model of jaxgran supports it; fit a curve "
                f"of equal spheres without it, and leave {key} out{advice}"
            )


def _read_surface(values: dict[str, float]) -> Rough | Frictional | None:
    inertia, rotation = values.get("reduced_inertia", 0.4), values.get("T_rot_0", 0.0)
    if _has_element(values, FRICTION_KEYS, required=FRICTION_KEYS):
        if "beta_t" in values:
            raise ValueError(
                "the header gives both beta_t (instantaneous impacts) and friction (lasting "
                "contacts). Leave out beta_t for SoftSpheres(N), or friction and "
                "tangential_damping for the other models"
            )
        damping, friction = (values[key] for key in FRICTION_KEYS)
        return Frictional(damping, friction, inertia=inertia, rotational_temperature=rotation)
    if _has_element(values, ROUGH_KEYS, required=("beta_t",)):
        return Rough(values["beta_t"], inertia=inertia, rotational_temperature=rotation)
    return None


def _has_element(
    values: dict[str, float], keys: tuple[str, ...], required: tuple[str, ...]
) -> bool:
    given = [key for key in keys if key in values]
    missing = [key for key in required if key not in values]
    if given and missing:
        raise ValueError(f"the header gives {given[0]} without {missing[0]}; add {missing[0]}")
    return bool(given)


def _check_container_volume(header: dict[str, str], gas: Gas) -> None:
    """Raise ValueError if N, eta, diameter and container_side of a header contradict."""
    if gas.container is None or "N" not in header:
        return
    number = header_number(header, "N")
    ratio = container_volume_ratio(gas, number)
    if abs(ratio - 1) > VOLUME_TOLERANCE:
        raise ValueError(
            f"N, eta and container_side contradict: {number:g} spheres in this container have eta "
            f"= {float(gas.packing_fraction) * ratio:.4g}, but the header gives "
            f"{float(gas.packing_fraction):.4g}; correct one of them"
        )


def _warn_of_unknown_keys(header: dict[str, str]) -> None:
    """Warn of unknown header keys. Comments that are no single word are not keys."""
    known = (*GAS_KEYS, "t0", *PRIOR_KEYS)
    known = (*known, *ELEMENT_KEYS, *OTHER_KEYS, *PROVENANCE_KEYS, *UNSUPPORTED_KEYS)
    unknown = [key for key in header if key.isidentifier() and key not in known]
    if unknown:
        warnings.warn(
            f"ignoring unknown header keys: {', '.join(unknown)}. Known keys are "
            f"{', '.join(known)}",
            stacklevel=3,
        )


COORDINATES = ("x", "y", "z")

MIN_TRACKS = 3
"""Particles needed for a scatter after the drift is removed and one particle is left out."""

MAX_CORRECTION = 0.3
"""Largest share of T that impacts may take, or localisation may add, without a warning."""

NUM_ITERATIONS = 50
"""Iterations for T from the displacements, each of which reduces the error by 2 or more."""


class Tracks(NamedTuple):
    """Positions of the same particles in every frame.

    Attributes:
        times: of the frames, s, increasing.
        positions: m, shape (frames, particles, coordinates).
    """

    times: Float[np.ndarray, "frames"]
    positions: Float[np.ndarray, "frames particles coordinates"]


def _check_track_names(path: Path, i: int, names: list[str]) -> None:
    """Raise ValueError unless the columns in line i are id, t, x, y and possibly z."""
    allowed = [["id", "t", *COORDINATES[:d]] for d in (2, 3)]
    if sorted(names) not in [sorted(columns) for columns in allowed]:
        raise ValueError(
            f"{path}, line {i}: the columns are {', '.join(names)}; tracks of particles have "
            f"{' or '.join(','.join(columns) for columns in allowed)}, each once"
        )


def curve_of_tracks(path: Path, table: Table) -> tuple[CoolingCurve, dict[str, str]]:
    """Return T(t) of particles whose positions are known in frames.

    Velocities are differences over neighbouring frames, ``u = (x(t_2) - x(t_1))/(t_2 - t_1)``, and
    belong to the middle of the two times, to second order in the share by which T falls meanwhile.
    The drift, the mean velocity of all tracked particles between the two frames, is removed:
    ``T = sum (u - <u>)^2 / (d (n - 1))`` for n particles and d coordinates. In a gas of N particles
    (header key N) without walls, whose true momentum is 0, T is multiplied by ``(N - 1)/N``.
    Two coordinates of a three-dimensional gas represent all three.

    Two biases of u^2 are removed if the header gives the necessary values. The standard error of
    one coordinate of a position, ``localisation_error``, adds ``2 error^2/(t_2 - t_1)^2`` to T; the
    jackknife error, which it widens, is not corrected. Impacts between frames bend the
    paths: with the velocity autocorrelation ``exp(-nu_v t)`` T is too small by the factor
    ``2 (exp(-x) - 1 + x)/x^2 = 1 - x/3 + ...``, ``x = nu_v (t_2 - t_1)``; nu_v is Enskog's value
    for elastic spheres, ``(2/d)`` of their collision frequency, from eta, diameter and T.

    T_err is the jackknife error over particles, which leaves out one at a time. It is the error of
    T of the gas from which these particles are a sample. Errors of neighbouring times are
    correlated, as the particles are the same.

    Args:
        path: of the file, for messages.
        table: its columns id, t, x, y and z; rows in any order in which the times of each particle
            increase. Positions are unwrapped: they continue when a particle leaves a periodic box.

    Returns:
        The curve, and the header, whose entry T_from says how T was computed.

    Raises:
        ValueError: for fewer than 3 particles or 4 frames, for times that do not increase, a
            particle twice in a frame, or one that is missing in a frame: naming the line.
    """
    try:
        columns, header = _convert_to_si(table.columns, table.header)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    tracks = _tracks(path, columns, table.lines)
    duration = np.diff(tracks.times)
    velocity = np.diff(tracks.positions, axis=0) / duration[:, None, None]
    factor, notes = _momentum_correction(path, tracks, header)
    T, error = _temperature_and_error(velocity)
    T, error = factor * T, factor * error
    T, words = _correct_localisation(path, T, duration, header)
    notes += words
    T_true, words = _correct_impacts(path, T, duration, header)
    notes += words
    curve = CoolingCurve(
        times=jnp.asarray((tracks.times[1:] + tracks.times[:-1]) / 2),
        temperature=jnp.asarray(T_true),
        temperature_error=jnp.asarray(error * T_true / T),
    )
    header["T_from"] = f"T = <(u - <u>)^2>/d, u over neighbouring frames; {'; '.join(notes)}"
    curve.check(f"{path}: T between frames {{0}} and the next".format)
    return curve, header


def _tracks(path: Path, columns: dict[str, np.ndarray], lines: list[int]) -> Tracks:
    t, names = columns["t"], [name for name in COORDINATES if name in columns]
    whole = columns["id"] == np.round(columns["id"])
    if not np.all(whole):
        i = int(np.argmin(whole))
        raise ValueError(
            f"{path}, line {lines[i]}: id is {columns['id'][i]:g}; number the particles"
        )
    ids, particle = np.unique(columns["id"].astype(int), return_inverse=True)
    times, frame = np.unique(t, return_inverse=True)
    if len(ids) < MIN_TRACKS:
        raise ValueError(
            f"{path}, line {lines[-1] if lines else 1}: the file ends after tracks of {len(ids)} "
            f"particle(s); at least {MIN_TRACKS} are needed to remove the drift and estimate errors"
        )
    if len(times) <= MIN_POINTS:
        raise ValueError(
            f"{path}, line {lines[-1]}: the file ends after tracks of {len(times)} frames; at "
            f"least {MIN_POINTS + 1} are needed: record for longer"
        )
    row = _row_indices(path, particle, frame, (ids, times), lines)
    _check_order(path, particle, t, ids, lines)
    positions = np.stack([columns[name] for name in names], axis=1)
    return Tracks(times, positions[row])


def _row_indices(
    path: Path,
    particle: np.ndarray,
    frame: np.ndarray,
    values: tuple[np.ndarray, np.ndarray],
    lines: list[int],
) -> np.ndarray:
    """Return the only row of each particle in each frame, shape (frames, particles)."""
    ids, times = values
    row = np.full((len(times), len(ids)), len(lines))
    np.minimum.at(row, (frame, particle), np.arange(len(lines)))  # the first of several
    repeated = row[frame, particle] != np.arange(len(lines))
    if np.any(repeated):
        i = int(np.argmax(repeated))
        raise ValueError(
            f"{path}, line {lines[i]}: particle {ids[particle[i]]} at t = {times[frame[i]]:g} s is "
            f"given again, after line {lines[row[frame[i], particle[i]]]}; remove one"
        )
    missing = row == len(lines)
    if np.any(missing):
        k, j = (int(index[0]) for index in np.nonzero(missing))
        near = row[k - 1, j] if k else row[:, j].min()
        raise ValueError(
            f"{path}, line {lines[near]}: particle {ids[j]} has a position in this line, but none "
            f"in the frame at t = {times[k]:g} s. Remove its track, or use only the frames that "
            "all particles share"
        )
    return row


def _check_order(
    path: Path, particle: np.ndarray, t: np.ndarray, ids: np.ndarray, lines: list[int]
) -> None:
    """Raise ValueError unless the times of each particle increase down the file."""
    order = np.argsort(particle, kind="stable")
    backward = (np.diff(t[order]) < 0) & (np.diff(particle[order]) == 0)
    if np.any(backward):
        i = int(order[1:][backward].min())
        raise ValueError(
            f"{path}, line {lines[i]}: t is {t[i]:g} s, earlier than in the previous row of "
            f"particle {ids[particle[i]]}; sort the rows of each particle by time"
        )


def _temperature_and_error(
    velocity: Float[np.ndarray, "times n d"],
) -> tuple[Float[np.ndarray, "times"], Float[np.ndarray, "times"]]:
    """Return the variance of a velocity component, drift removed, and its jackknife error."""
    _, n, d = velocity.shape
    centred = velocity - velocity.mean(axis=1, keepdims=True)
    square = np.sum(centred**2, axis=2)
    # Without particle i the others have the mean -u_i/(n - 1), in the frame of all.
    left = square.sum(axis=1, keepdims=True) - square * n / (n - 1)
    each = left / (d * (n - 2))
    error = np.sqrt((n - 1) * np.var(each, axis=1))
    return square.sum(axis=1) / (d * (n - 1)), error


def _momentum_correction(
    path: Path, tracks: Tracks, header: dict[str, str]
) -> tuple[float, list[str]]:
    """Return (N - 1)/N, or 1 if N is unknown or walls change the momentum; and notes on both."""
    n, d = tracks.positions.shape[1:]
    dimension = header_count(header, "dimension") or 3
    if d > dimension:
        raise ValueError(
            f"{path}: a gas of dimension {dimension} has no tracks with {d} coordinates; correct "
            "the header or leave out z"
        )
    projected = ["two of three coordinates, for isotropic velocities"] if d < dimension else []
    N = header_count(header, "N")
    if N is None:
        return 1.0, [f"drift of {n} particles removed", *projected]
    if n > N:
        raise ValueError(
            f"{path}: the header gives N = {N}, but {n} particles are tracked; correct N"
        )
    free = "container_side" not in header
    return (N - 1) / N if free else 1.0, [f"drift of {n} of {N} particles removed", *projected]


def _correct_localisation(
    path: Path, T: Float[np.ndarray, "times"], duration: np.ndarray, header: dict[str, str]
) -> tuple[Float[np.ndarray, "times"], list[str]]:
    """Return T without the scatter of measured positions, and a note."""
    if "localisation_error" not in header:
        return T, ["errors of positions not known (localisation_error)"]
    error = header_number(header, "localisation_error")
    if error < 0:
        raise ValueError(f"{path}: header line localisation_error: must be >= 0, got {error:g}")
    added = 2 * (error / duration) ** 2
    if np.any(added >= T):
        k = int(np.argmax(added >= T))
        raise ValueError(
            f"{path}: between frames {k} and {k + 1} particles move no further than "
            f"localisation_error = {error:g} m; leave out this and later frames, or use frames "
            "further apart"
        )
    share = float(np.max(added / T))
    _warn_of_correction(path, "localisation_error adds", share, "to", "leave out the last frames")
    return T - added, [f"localisation_error removed, at most {100 * share:.2g} % of T"]


def _correct_impacts(
    path: Path, T: Float[np.ndarray, "times"], duration: np.ndarray, header: dict[str, str]
) -> tuple[Float[np.ndarray, "times"], list[str]]:
    """Return T corrected for impacts between frames, and a note."""
    if not {"eta", "diameter"} <= header.keys():
        return T, ["impacts between frames not corrected (eta and diameter are not given)"]
    gas = Gas(
        ConstantRestitution(1.0),
        diameter=header_number(header, "diameter"),
        mass=1.0,
        packing_fraction=header_number(header, "eta"),
        temperature=1.0,
        dimension=header_count(header, "dimension") or 3,
        **read_elements(header),
    )
    rate = 2 / gas.dimension * float(gas.collision_frequency) * duration
    true = T
    for _ in range(NUM_ITERATIONS):
        true = T / _displacement_factor(rate * np.sqrt(true))
    share = float(np.max(1 - T / true))
    _warn_of_correction(
        path, "impacts between frames take", share, "from", "use frames closer together"
    )
    return true, [f"impacts between frames corrected, at most {100 * share:.2g} % of T"]


def _displacement_factor(x: Float[np.ndarray, "times"]) -> Float[np.ndarray, "times"]:
    """Return ``2 (exp(-x) - 1 + x)/x^2``, T from displacements over x relaxation times, over T."""
    small = x < 1e-3
    safe = np.where(small, 1.0, x)
    return np.where(small, 1 - x / 3, 2 * (np.expm1(-safe) + safe) / safe**2)


def _warn_of_correction(path: Path, cause: str, share: float, direction: str, advice: str) -> None:
    if share > MAX_CORRECTION:
        warnings.warn(
            f"{path}: {cause} up to {100 * share:.2g} % {direction} T, too much for an accurate "
            f"correction: {advice}",
            stacklevel=6,
        )


ARCHIVE_SUFFIX = ".npz"

HEADER_ENTRY = "header"
"""Entry of an npz file that holds the header, as JSON; all others are arrays."""

DICT_PREFIX = "key:"
"""Prefix of a key of a dictionary in the name of an entry."""


def _write_archive(path: Path, curve: CoolingCurve, header: dict[str, str]) -> None:
    """Write all arrays of a curve, without loss, to an npz file.

    Names of entries are those of the fields, as ``replicas.temperature`` and
    ``particles.position``, and for saved arrays those of the places in the tree, as
    ``saved.key:g.0``. Lists are read back as tuples.
    """
    arrays: dict[str, Any] = {HEADER_ENTRY: np.array(json.dumps(header)), **_flatten(curve)}
    write_atomically(path, lambda file: np.savez_compressed(file, **arrays))


def _read_archive(path: Path) -> tuple[CoolingCurve, dict[str, str]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays.pop(HEADER_ENTRY)))
        return _unflatten_curve(arrays), header
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path}: not a file that jaxgran.write_curve wrote ({error}); give such a file, or a "
            "CSV file"
        ) from None


def _flatten(tree: Any, prefix: str = "") -> dict[str, np.ndarray]:
    """Return the arrays of a curve, its particles and saved values by name, without None.

    Raises:
        ValueError: for a saved value that is no array, dictionary, tuple, list or `Particles`.
    """
    if tree is None:
        return {}
    children = _named_children(tree)
    if children is not None:
        nested = (_flatten(child, f"{prefix}.{name}") for name, child in children.items())
        return {name: array for arrays in nested for name, array in arrays.items()}
    if not isinstance(tree, jax.Array | np.ndarray | np.generic | float | int):
        raise ValueError(
            f"{prefix[1:]} is of type {type(tree).__name__}: let `save` return arrays in "
            "dictionaries, tuples or lists"
        )
    return {prefix[1:]: np.asarray(tree)}


def _named_children(tree: Any) -> dict[str, Any] | None:
    """Return the children of a container, by names that encode its type, or None for a leaf."""
    if isinstance(tree, CoolingCurve):
        return dict(vars(tree))
    if isinstance(tree, Particles):
        return tree._asdict()
    if isinstance(tree, dict):
        return {f"{DICT_PREFIX}{name}": value for name, value in tree.items()}
    if isinstance(tree, list) or (isinstance(tree, tuple) and not hasattr(tree, "_fields")):
        return {str(k): value for k, value in enumerate(tree)}
    return None


def _unflatten_curve(arrays: dict[str, np.ndarray]) -> CoolingCurve:
    builders = {
        "replicas": _unflatten_curve,
        "particles": _unflatten,
        "saved": _unflatten,
        "saved_error": _unflatten,
    }
    return CoolingCurve(
        **{
            name: builders.get(name, _unflatten)(inner)
            for name, inner in _group_by_first_name(arrays).items()
        }
    )


def _unflatten(arrays: dict[str, np.ndarray]) -> Any:
    """Return an array, or a dictionary, a tuple or `Particles` of arrays."""
    if "" in arrays:
        return jnp.asarray(arrays[""])
    children = {name: _unflatten(inner) for name, inner in _group_by_first_name(arrays).items()}
    if all(name.startswith(DICT_PREFIX) for name in children):
        return {name.removeprefix(DICT_PREFIX): child for name, child in children.items()}
    if all(name.isdigit() for name in children):
        return tuple(children[str(k)] for k in range(len(children)))
    return Particles(**children)


def _group_by_first_name(arrays: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Return arrays by the first part of their names, and then by the rest."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, array in arrays.items():
        first, _, rest = name.partition(".")
        groups.setdefault(first, {})[rest] = array
    return groups


DROP_TEST_COLUMNS = ("v", "eps", "eps_err")
RESTITUTION = Domain(0.0, 1.0, high_allowed=True)


class DropTest(eqx.Module):
    """Coefficients of restitution of single impacts at some normal speeds.

    They depend on ``A Y^(2/5)``, as the cooling of a gas of hard spheres does, and on no other
    quantity of a cooling curve.

    Args:
        speed: normal relative speed before each impact, m/s, shape (n,), > 0.
        restitution: eps, shape (n,), in (0, 1].
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
    onto_plate: UserBool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_bool("onto_plate", self.onto_plate)
        POSITIVE.check("speed", self.speed, "Give normal speeds in m/s.")
        RESTITUTION.check(
            "restitution", self.restitution, "Give the speed after over that before an impact."
        )
        POSITIVE.check("error", self.error, "Give the standard error of each eps.")
        shapes = [np.shape(x) for x in (self.speed, self.restitution, self.error)]
        if len(shapes[0]) != 1 or len(set(shapes)) > 1 or shapes[0] == (0,):
            raise ValueError(
                "speed, restitution and error must be lists of equal length, with at least one "
                f"impact; got shapes {', '.join(map(str, shapes))}"
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
        path: the file; v in m/s. Lines that begin with # are ignored.
        onto_plate: see `DropTest`.

    Raises:
        ValueError: saying what is wrong, in which line.

    >>> from pathlib import Path
    >>> rows = "v,eps,eps_err", "0.1,0.92,0.01", "0.3,0.90,0.01", "1.0,0.87,0.01"
    >>> size = Path("drops.csv").write_text(chr(10).join(rows))
    >>> jaxgran.read_drop_test("drops.csv").restitution.shape
    (3,)
    """
    path, wanted = Path(path), ",".join(DROP_TEST_COLUMNS)
    rows: list[list[float]] = []
    names: list[str] = []
    for i, line in enumerate(read_text(path, wanted).splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        if names:
            rows.append(number_row(path, i, line, names))
            continue
        names = [name.strip() for name in line.split(",")]
        if sorted(names) != sorted(DROP_TEST_COLUMNS):
            raise ValueError(
                f"{path}, line {i}: the columns are {', '.join(names)}; name them {wanted}"
            )
    if not rows:
        raise ValueError(f"{path}: no rows of numbers under {wanted}; add one row for each impact")
    columns = dict(zip(names, np.array(rows).T, strict=True))
    try:
        return DropTest(columns["v"], columns["eps"], columns["eps_err"], onto_plate)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
