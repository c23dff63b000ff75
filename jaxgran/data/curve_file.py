"""Files of measured cooling curves: CSV with a header that describes the gas."""

from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxgran.data.curve import COLUMNS, FURTHER, MIN_POINTS, CoolingCurve
from jaxgran.data.curve_archive import SUFFIX, read_archive, write_archive
from jaxgran.data.files import write_whole
from jaxgran.data.header import header_count, header_number
from jaxgran.data.quantities import STAND_INS, in_si, warn_of_units
from jaxgran.data.scene_keys import check_volume, read_elements, warn_of_unknown_keys
from jaxgran.data.table import read_table
from jaxgran.data.tracks import check_track_names, curve_of_tracks
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import sphere_mass
from jaxgran.scene.restitution import Viscoelastic

GAS_KEYS = ("eta", "diameter", "density", "Y", "nu", "T0")
"""Keys of the header that `read_gas` needs."""

PRIOR_KEYS = {
    "eta_err": "packing_fraction",
    "diameter_err": "diameter",
    "density_err": "density",
    "Y_err": "youngs_modulus",
    "nu_err": "poisson_ratio",
    "T0_err": "temperature",
    "t0_err": "t0",
}
"""Keys of the header with standard errors, and the names that `jaxgran.fit` gives them."""

EXACT = 1e-4
"""Relative error of a density that is given without one, where the diameter has one."""


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
            or energy (see `jaxgran.data.quantities.STAND_INS`), with errors under the same name and
            _err. Header keys length_unit (m, cm, mm, um) and time_unit (s, ms, us, min) are those
            of the columns and of diameter, T0 and A; density and Y stay in SI. Or its columns are
            id,t,x,y and z, tracks of particles (see `jaxgran.data.tracks.curve_of_tracks`). What
            `write_curve` writes besides (a2, collisions, D, energies, whole npz files) is read too.

    Returns:
        The curve, and the header as a dictionary of strings, in SI; its entry T_from says how T was
        computed, where it was.

    Raises:
        ValueError: saying what is wrong, in which line, and what to do.

    >>> jaxgran.write_curve("mine.csv", curve, {"eta": "0.05"}, overwrite=True)
    >>> again, header = jaxgran.read_curve("mine.csv")
    >>> header, again.times.shape
    ({'eta': '0.05'}, (4,))
    """
    path = Path(path)
    if path.suffix == SUFFIX:
        return read_archive(path)
    table = read_table(path, "t,T[,T_err][,msd][,msd_err]", partial(_check_names, path))
    if "id" in table.columns:
        return curve_of_tracks(path, table)
    columns, header, lines = table.columns, table.header, table.lines
    if len(lines) < MIN_POINTS:
        raise ValueError(
            f"{path}: {len(lines)} rows of numbers, at least {MIN_POINTS} are needed; "
            "measure the cooling at more times"
        )
    try:
        columns, header = in_si(columns, header)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    known = COLUMNS | FURTHER
    fields: dict[str, Any] = {known[name]: jnp.asarray(x) for name, x in columns.items()}
    curve = CoolingCurve(**fields)
    curve.check(lambda i: f"{path}, line {lines[i]}")
    return curve, header


def _check_names(path: Path, i: int, names: list[str]) -> None:
    """ValueError if a name of a column in line i is unknown, missing or repeated."""
    if "id" in names:
        check_track_names(path, i, names)
        return
    stand_ins = [name for name in ("T", *STAND_INS) if name in names]
    known = {*COLUMNS, *FURTHER, *(f"{name}{end}" for name in STAND_INS for end in ("", "_err"))}
    unknown = [name for name in names if name not in known]
    unknown += [f"{name}_err" for name in STAND_INS if f"{name}_err" in names and name not in names]
    missing = ([] if "t" in names else ["t"]) + ([] if stand_ins else ["T"])
    if len(stand_ins) > 1:
        raise ValueError(
            f"{path}, line {i}: {' and '.join(stand_ins)} each give the temperature; keep one"
        )
    if unknown or missing or len(set(names)) < len(names):
        raise ValueError(
            f"{path}, line {i}: the columns are {', '.join(names)}; "
            + (f"missing: {', '.join(missing)}; " if missing else "")
            + (f"not known: {', '.join(unknown)}; " if unknown else "")
            + f"name them t,T and, where measured, {', '.join(list(COLUMNS)[2:])}, each once; in "
            f"place of T there may be {', '.join(STAND_INS)}; tracks of particles are id,t,x,y[,z]"
        )


def read_gas(header: dict[str, str]) -> Gas:
    """The gas that the header of a curve describes, with A = 0, since A is what a fit estimates.

    Args:
        header: eta (the packing fraction), diameter (m), density (of the material, kg/m^3), Y
            (Pa), nu, T0 (m^2/s^2) and, if it is not 3, dimension, as `read_curve` returns them; and
            of rough spheres, walls and drag what `jaxgran.data.scene_keys.read_elements` takes.

    Returns:
        A gas of viscoelastic spheres. Values that no granular gas has, and keys that are not known,
        are warned of.

    Raises:
        ValueError: for a missing key, a value that is no number or outside its range, and for what
            `read_elements` refuses.

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
    check_volume(header, gas)
    warn_of_units(gas)
    warn_of_unknown_keys(header, (*GAS_KEYS, "t0", *PRIOR_KEYS))
    return gas


def read_priors(header: dict[str, str]) -> dict[str, tuple[float, float]]:
    """What the header says of the errors of its values, as `jaxgran.fit` takes ``priors``.

    Where the diameter has an error and the density has none, the mass follows the diameter.

    Args:
        header: with some of eta_err, diameter_err (m), density_err (kg/m^3), Y_err (Pa), nu_err,
            T0_err (m^2/s^2) and t0_err (s), the standard errors of the values beside them; that of
            t0, the time at which the gas began to cool, is 0 unless it is given.

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
                f"where {value_key} is known exactly"
            )
        value = header_number({"t0": "0"} | header, value_key)
        priors[name] = (value, error)
    if "diameter" in priors and "density" not in priors:
        if "density" not in header:
            raise ValueError("the header gives diameter_err without density; add the density")
        density = header_number(header, "density")
        priors["density"] = (density, EXACT * density)
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
        curve: of one system; None of its arrays may be traced.
        header: written as lines ``# key: value``, or as it is in an .npz file.
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
        raise ValueError(f"{path} exists; choose another name or say overwrite=True")
    if path.suffix == SUFFIX:
        return write_archive(path, curve, header)
    fields = {name: getattr(curve, field) for name, field in (COLUMNS | FURTHER).items()}
    present = {name: np.asarray(v) for name, v in fields.items() if v is not None}
    lines = [f"# {key}: {value}" for key, value in header.items()]
    lines.append(",".join(present))
    lines += [",".join(f"{x:.17g}" for x in row) for row in zip(*present.values(), strict=True)]
    text = "\n".join(lines) + "\n"
    write_whole(path, lambda f: f.write(text.encode()))
