"""Files of particles: frames are read from GSD, extended XYZ and LAMMPS files.

GSD files are read by `gsd`. Text files are read here: ASE 3.29, which reads them too,
changes the last digit of 10 % of the numbers of a dump and of 50 % of the numbers of a data file,
leaves out angular velocities, units and times, and accepts chemical elements alone as species.
"""

import re
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxgran._utils.extras import import_extra
from jaxgran._utils.validation import checked_int
from jaxgran.data.files import checked_path, name_in_errors, read_bytes
from jaxgran.data.header_values import MAX_COUNT
from jaxgran.data.particle_frame import SPIN, UNITS, VELOCITY, Frame, frame_of_columns
from jaxgran.data.particles import Particles

GSD = ".gsd"
XYZ = ".xyz"

TOLERANCE = 1e-12
"""Largest relative difference of the sides of a box that is read as a cube."""

GSD_DEFAULT = 1.0
"""Diameter and mass that `gsd` returns for files that give none."""

DATA_COLUMNS = {
    "atomic": ("id", "type", "x", "y", "z"),
    "sphere": ("id", "type", "diameter", "density", "x", "y", "z"),
}
"""Columns of the section Atoms of a LAMMPS data file, by its atom style."""

XYZ_VECTORS = {
    "pos": ("x", "y", "z"),
    "velo": VELOCITY,
    "vel": VELOCITY,
    "velocities": VELOCITY,
    "velocity": VELOCITY,
    "angular_velocity": SPIN,
}
"""Names of the columns of properties of an extended XYZ file."""

DUMP_ITEMS = ("UNITS", "TIMESTEP", "TIME", "NUMBER OF ATOMS", "BOX BOUNDS", "ATOMS")

SLANTED = "its box is slanted; only rectangular boxes are supported"
"""Message."""

FrameReader = Callable[[int | None], Frame]
"""A function that reads a frame, given its dimension or None."""


def read_particles(path: str | Path, *, frame: int = -1, dimension: int | None = None) -> Particles:
    """Read the particles of one frame, as a start for `HardSpheres` or `SoftSpheres`.

    Supported formats are GSD (``.gsd``, needs the extra `trajectories`), extended XYZ (``velo``,
    ``vel`` or ``velocities``), LAMMPS dumps (text; columns x y z or xu yu zu or xs ys zs, vx vy vz
    and optionally id and omegax omegay omegaz) and LAMMPS data files as its command ``write_data``
    writes them (atom styles sphere and atomic, with velocities). Text files may be compressed
    (``.gz``). Units that a file names are converted to SI, other numbers are read as SI. Particles
    are sorted by id, if the file has ids. The low corner of the box becomes 0, and particles are
    wrapped into a periodic box.

    Args:
        path: the file.
        frame: index of the frame, counted from 0, or from the end for negative ones; -1 is the
            last.
        dimension: 2 or 3; by default the dimension that the file gives, and 3 for files that give
            none. A LAMMPS dump of disks does not give it.

    Returns:
        `Particles` of one replica. ``box_side`` is one number for a cube or square, otherwise one
        for each side.

    Raises:
        ValueError: naming the file and what is wrong: no such file or frame, an incomplete frame, a
            box that is not rectangular or periodic in some directions only, missing velocities,
            unequal particles, units without a size in m, values that are no finite numbers.
        ModuleNotFoundError: for a .gsd file without `gsd`.

    >>> particles = jaxgran.cool(
    ...     gas, times[:1], model=jaxgran.HardSpheres(50), trajectory="run.xyz", progress=False
    ... ).particles
    >>> same = jaxgran.read_particles("run.xyz")
    >>> bool(jnp.all(same.velocity == particles.velocity))
    True
    """
    path = checked_path(path, "a LAMMPS dump or data file, extended XYZ, or GSD")
    if dimension not in (None, 2, 3):
        raise ValueError(f"dimension must be 2 or 3, or None, got {dimension!r}")
    frame = checked_int("frame", frame, -MAX_COUNT)
    with name_in_errors(path):
        frames = open_frames(path)
        if not -len(frames) <= frame < len(frames):
            raise ValueError(f"it has {len(frames)} frames, there is no frame {frame}")
        read = frames[frame](dimension)
    is_cube = np.ptp(read.sides) <= TOLERANCE * read.sides[0]
    return Particles(
        position=jnp.asarray(read.position[None]),
        velocity=jnp.asarray(read.velocity[None]),
        box_side=jnp.asarray(read.sides[0] if is_cube else read.sides),
        angular_velocity=None if read.spin is None else jnp.asarray(read.spin[None]),
    )


def open_frames(path: Path) -> list[FrameReader]:
    """Return a function for each frame of a file, which reads it."""
    if path.suffix == GSD:
        with import_gsd().open(str(path), "r") as file:
            return [partial(_read_gsd, path, k) for k in range(len(file))]
    text = read_bytes(path).decode("utf-8-sig")
    is_cut = not text.endswith("\n")
    frames: list[FrameReader]
    if text.lstrip().startswith("ITEM:"):
        frames = [partial(_read_dump, part) for part in _parts_of_dump(text)]
    elif re.match(r"\s*\d+(\s|$)", text):
        frames = [partial(_read_xyz, part) for part in _parts_of_xyz(text)]
    else:
        frames = [partial(_read_data, text)]
        is_cut = is_cut and "Atoms" in text
    return [*frames[:-1], _refuse_cut] if is_cut else frames


def import_gsd() -> Any:
    """Return the module `gsd.hoomd`, which the extra `trajectories` installs."""
    return import_extra("gsd.hoomd", "trajectories")


def _refuse_cut(dimension: int | None) -> Frame:
    """Refuse the last frame of a text file whose last line does not end."""
    raise ValueError(
        "it ends within a line, so that its last number may be cut off: end the last line if the "
        "file is complete, or read a frame before the last one"
    )


def _read_gsd(path: Path, k: int, dimension: int | None) -> Frame:
    """Return frame k of a GSD file."""
    with import_gsd().open(str(path), "r") as file:
        snapshot = file[k]
        # gsd returns the velocities of the first frame for a frame without, and 0 for the first. It
        # does not write those that equal the ones of the first frame: files of jaxgran have all.
        known = file.file.application.startswith("jaxgran") or file.file.chunk_exists(
            k, "particles/velocity"
        )
    particles = snapshot.particles
    box = snapshot.configuration
    sides, tilts = np.split(np.asarray(box.box, float), 2)
    if np.any(tilts != 0):
        raise ValueError(SLANTED)
    columns = {"type": particles.typeid}
    if np.any(particles.diameter != GSD_DEFAULT):
        columns["diameter"] = particles.diameter
    if np.any(particles.mass != GSD_DEFAULT):
        columns["mass"] = particles.mass
    columns |= _columns_of("xyz", particles.position)
    if known:
        columns |= _columns_of(VELOCITY, particles.velocity)
    spin = snapshot.log.get("particles/angular_velocity")
    if spin is not None:
        spin = np.reshape(spin, (int(particles.N), -1))
        in_plane = spin.shape[1] == 1
        columns |= _columns_of(SPIN[-1:] if in_plane else SPIN, spin)
    time = snapshot.log.get("time")
    time = None if time is None else float(time[0])
    dimension = dimension or int(box.dimensions)
    return frame_of_columns(columns, -sides / 2, sides, dimension, time=time, step=int(box.step))


def _columns_of(names: Sequence[str], vectors: np.ndarray) -> dict[str, np.ndarray]:
    """Return the components of vectors, shape (N, d), by name."""
    return dict(zip(names, np.asarray(vectors, float).T, strict=True))


def _parts_of_dump(text: str) -> list[dict[str, tuple[list[str], str]]]:
    """Return words and lines of each item of each frame of a LAMMPS dump, by name."""
    frames = []
    items = {}
    for section in re.split(r"^ITEM: ", text, flags=re.MULTILINE)[1:]:
        head, _, body = section.partition("\n")
        name = next((name for name in DUMP_ITEMS if head.startswith(name)), head)
        items[name] = head.removeprefix(name).split(), body
        if name == "ATOMS":
            frames.append(items)
            items = {"UNITS": items["UNITS"]} if "UNITS" in items else {}
    return frames + ([items] if items.keys() - {"UNITS"} else [])


def _read_dump(items: dict[str, tuple[list[str], str]], dimension: int | None) -> Frame:
    """Return the frame of some items of a LAMMPS dump."""
    if not {"BOX BOUNDS", "ATOMS", "NUMBER OF ATOMS"} <= items.keys():
        raise ValueError("the frame of the LAMMPS dump is incomplete")
    # Each axis has two letters, the boundaries at both ends; a slanted box has further words.
    flags, bounds = items["BOX BOUNDS"]
    if not all(re.fullmatch("[pfsm]{2}", flag) for flag in flags):
        raise ValueError(SLANTED)
    if any(set(flag) & set("sm") for flag in flags):
        raise ValueError("its box is fitted to the particles (boundary s or m): use p or f")
    low, high = np.array([line.split()[:2] for line in bounds.splitlines()[:3]], float).T
    names, body = items["ATOMS"]
    rows = [line.split() for line in body.splitlines() if line.strip()]
    words = {name: body.strip() for name, (_, body) in items.items()}
    return frame_of_columns(
        _table(rows, names, int(words["NUMBER OF ATOMS"])),
        low,
        high - low,
        dimension,
        units=words.get("UNITS", "si"),
        periodic=tuple("p" in flag for flag in flags) or (True,) * 3,
        time=float(words["TIME"]) if "TIME" in words else None,
        step=int(words["TIMESTEP"]) if "TIMESTEP" in words else None,
    )


def _parts_of_xyz(text: str) -> list[list[str]]:
    """Return the lines of each frame of an extended XYZ file."""
    lines = text.splitlines()
    frames = []
    at = 0
    while at < len(lines):
        if not lines[at].strip():
            at += 1
            continue
        if not lines[at].strip().isdigit():
            raise ValueError(f"line {at + 1} must be a number of particles, got {lines[at]!r}")
        end = at + 2 + int(lines[at])
        frames.append(lines[at:end])
        at = end
    return frames


def _read_xyz(lines: list[str], dimension: int | None) -> Frame:
    """Return the frame of some lines of an extended XYZ file."""
    head = lines[1] if len(lines) > 1 else ""
    info = dict(part.split("=", 1) for part in shlex.split(head) if "=" in part)
    info = {key.lower(): value for key, value in info.items()}
    missing = [name for name in ("Lattice", "Properties") if name.lower() not in info]
    if missing:
        raise ValueError(f"it has no {missing[0]} in the second line of a frame")
    unknown = [key for key in info if "unit" in key and key != "units"]
    if unknown:
        raise ValueError(f"it gives {unknown[0]}: write units={', units='.join(UNITS)} or SI")
    lattice = np.array(info["lattice"].split(), float).reshape(3, 3)
    if np.any(lattice != np.diag(np.diag(lattice))):
        raise ValueError(SLANTED)
    parts = info["properties"].split(":")
    names: list[str] = []
    for name, number in zip(parts[::3], map(int, parts[2::3]), strict=True):
        vector = XYZ_VECTORS.get(name.lower())
        if vector is not None:
            names += vector[-number:]  # in a plane the angular velocity has a z component only
        elif number == 1:
            names.append(name)
        else:
            names += [f"{name}_{k}" for k in range(number)]
    if dimension is None and "dimension" in info:
        dimension = int(info["dimension"])
    # One of T, F, true, False, 1 and 0 for each axis.
    flags = re.findall("[TtFf01]", info.get("pbc", "TTT"))
    return frame_of_columns(
        _table([line.split() for line in lines[2:]], names, int(lines[0])),
        np.array(info.get("origin", "0 0 0").split(), float),
        np.diag(lattice),
        dimension,
        units=info.get("units", "si"),
        periodic=tuple(flag in "Tt1" for flag in flags),
        time=float(info["time"]) if "time" in info else None,
    )


def _read_data(text: str, dimension: int | None) -> Frame:
    """Return the only frame of a LAMMPS data file."""
    # Lines such as "0.0 0.1 xlo xhi".
    bounds = [re.search(rf"^\s*(\S+)\s+(\S+)\s+{x}lo {x}hi", text, re.MULTILINE) for x in "xyz"]
    if not all(bounds):
        raise ValueError(
            "no file of particles: give a LAMMPS dump or data file, extended XYZ, or GSD (.gsd)"
        )
    if re.search(r"(xy xz yz|[abc]vec)\s*$", text, re.MULTILINE):  # of slanted boxes alone
        raise ValueError(SLANTED)
    low, high = np.array([[b[1], b[2]] for b in bounds if b], float).T
    style = re.search(r"^Atoms\s*#\s*(\w+)", text, re.MULTILINE)
    if style is None or style[1] not in DATA_COLUMNS:
        raise ValueError(f"its section Atoms must name its style, {' or '.join(DATA_COLUMNS)}")
    count = re.search(r"^\s*(\d+)\s+atoms\s*$", text, re.MULTILINE)
    atoms = _section(text, "Atoms", DATA_COLUMNS[style[1]], count)
    velocities = _section(text, "Velocities", ("id", *VELOCITY, *SPIN), count)
    if np.any(atoms["id"] != velocities["id"]):
        raise ValueError("its sections Atoms and Velocities have different ids")
    # The first line is a comment: "LAMMPS data file via write_data, ..., units = si".
    units = re.match(r".*units = (\w+)", text)
    units = units[1] if units else "si"
    return frame_of_columns(atoms | velocities, low, high - low, dimension, units=units)


def _section(
    text: str, name: str, columns: tuple[str, ...], count: re.Match[str] | None
) -> dict[str, np.ndarray]:
    """Return the columns of a section of a LAMMPS data file, sorted by id."""
    # The name, possibly with a comment; an empty line; lines that begin with a number.
    match = re.search(rf"^{name}\b.*\n\s*\n((?:[ \t]*[-+\d].*(?:\n|$))+)", text, re.MULTILINE)
    if match is None:
        raise ValueError(f"it has no section {name}")
    rows = [line.split("#")[0].split()[: len(columns)] for line in match[1].splitlines()]
    rows.sort(key=lambda row: int(row[0]))
    return _table(rows, columns[: len(rows[0])], int(count[1]) if count else len(rows))


def _table(rows: list[list[str]], names: Sequence[str], count: int) -> dict[str, np.ndarray]:
    """Return the columns of the rows of a frame, by name, as text."""
    if len(rows) != count or any(len(row) != len(names) for row in rows):
        raise ValueError(f"expected {count} rows of {len(names)} columns in a frame")
    columns = np.array(rows, object).reshape(count, len(names)).T
    return dict(zip(names, columns, strict=True))
