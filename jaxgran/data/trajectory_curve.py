"""T(t) of trajectories: files that give the velocities of all particles in frames."""

from collections.abc import Mapping
from math import pi
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxgran.data.curve import CoolingCurve, from_arrays
from jaxgran.data.curve_checks import check_values
from jaxgran.data.header_values import header_count, header_number, positive_number
from jaxgran.data.particle_file import open_frames
from jaxgran.data.particle_frame import Frame
from jaxgran.scene.geometry import sphere_mass

TRAJECTORIES = (".gsd", ".xyz", ".extxyz", ".dump", ".lammpstrj")
"""Suffixes of files that give the velocities of all particles."""

HEADER_TOLERANCE = 0.01
"""Largest relative difference of a number in a header from the trajectory."""


def is_trajectory(path: Path) -> bool:
    """Return whether a file contains velocities of particles, by its name or its first word."""
    if Path(str(path).removesuffix(".gz")).suffix in TRAJECTORIES:
        return True
    try:
        # Not of a pipe, which can be read only once.
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(5) == b"ITEM:"
    except OSError:
        return False


def curve_of_trajectory(
    path: Path, header: Mapping[str, str]
) -> tuple[CoolingCurve, dict[str, str]]:
    """Return T(t) of the frames of a file of particles.

    ``T = sum (v - <v>)^2 / (d N)`` in periodic boxes, and ``<v^2>/d`` between walls, which are at
    rest. With angular velocities w and a diameter ``T_rot = q sigma^2 <w^2>/(4 d_rot)``, where q is
    the header key reduced_inertia, by default 0.4. The standard errors are for N independent
    particles.

    Args:
        path: of a GSD, extended XYZ or LAMMPS file: see `jaxgran.read_particles`.
        header: in SI; with timestep, s, for files that count time steps, or frame_rate, 1/s, for
            files without times, and reduced_inertia and diameter for T_rot, unless the file gives
            the diameter.

    Returns:
        The curve, and the header with N, the dimension of disks and, as far as the file gives them,
        diameter, density and eta.

    Raises:
        ValueError: for a file or frame that `jaxgran.read_particles` refuses, and for frames
            without times.
    """
    header = dict(header)
    rows: list[dict[str, float]] = []
    for k, read in enumerate(open_frames(path)):
        try:
            frame = read(header_count(header, "dimension"))
            _add_to_header(header, frame)
            rows.append({"times": _time(k, frame, header), **_quantities(frame, header)})
        except ValueError as error:
            raise ValueError(f"frame {k}: {error}") from None
    if not rows:
        raise ValueError("it has no frames")
    fields = {name: jnp.asarray([row[name] for row in rows if name in row]) for name in rows[0]}
    check_values(fields, place="frame {}".format)
    curve = from_arrays(fields)
    if curve.times[0] == 0:
        header.setdefault("T0", repr(rows[0]["temperature"]))
    header["T_from"] = "T = <v^2>/d of the particles of each frame, in the frame at rest"
    return curve, {key: x for key, x in header.items() if key not in ("timestep", "frame_rate")}


def _add_to_header(header: dict[str, str], frame: Frame) -> None:
    """Add what a frame says of the gas; raise ValueError if the header contradicts it."""
    N, d = frame.position.shape
    equal = frame.equal
    from_file: dict[str, float] = {"N": N, "dimension": d}
    if "diameter" in equal or "radius" in equal:
        sigma = float(equal["diameter"][0] if "diameter" in equal else 2 * equal["radius"][0])
        from_file["diameter"] = sigma
        if "density" in equal:
            from_file["density"] = float(equal["density"][0])
        elif "mass" in equal:
            from_file["density"] = float(equal["mass"][0] / sphere_mass(sigma, 1.0))
        if frame.periodic:
            volume = float(np.prod(frame.sides))
            from_file["eta"] = N * (pi / 6 if d == 3 else pi / 4) * sigma**d / volume
    for key, value in from_file.items():
        tolerance = 0.0 if key in ("N", "dimension") else HEADER_TOLERANCE
        if abs(header_number(header, key) - value if key in header else 0.0) > tolerance * value:
            raise ValueError(f"{key} is {value:g}, but {header[key]} in the header or before")
        header.setdefault(key, repr(value))


def _time(k: int, frame: Frame, header: dict[str, str]) -> float:
    """Return the time of frame k, s."""
    if frame.time is not None:
        return frame.time
    if frame.step is not None and "timestep" in header:
        return frame.step * positive_number(header, "timestep")
    if "frame_rate" in header:
        return k / positive_number(header, "frame_rate")
    raise ValueError(
        "it has no time: write times into the file (LAMMPS: dump_modify ... time yes; XYZ: "
        "Time=...), or give header={'timestep': ...}, in s, or {'frame_rate': ...}, in 1/s"
    )


def _quantities(frame: Frame, header: dict[str, str]) -> dict[str, float]:
    """Return T and T_rot of a frame, and their errors, by the names of the fields of a curve."""
    velocity = frame.velocity
    if frame.periodic and "container_side" not in header:
        velocity = velocity - velocity.mean(axis=0)
    energies = {"temperature": np.mean(velocity**2, axis=1)}
    if frame.spin is not None and "diameter" in header:
        inertia = header_number({"reduced_inertia": "0.4"} | header, "reduced_inertia")
        square = inertia * header_number(header, "diameter") ** 2 / 4
        energies["rotational_temperature"] = square * np.mean(frame.spin**2, axis=1)
    values = {name: float(np.mean(each)) for name, each in energies.items()}
    scatter = {name: float(np.std(each, ddof=1)) for name, each in energies.items()}
    return values | {f"{name}_error": x / len(velocity) ** 0.5 for name, x in scatter.items()}
