"""Files of particles: frames are read from GSD, extended XYZ and LAMMPS files, and trajectories are
written frame by frame during a run, as GSD or extended XYZ.

GSD files are read and written by `gsd`. Text files are read here: ASE 3.29, which reads them too,
changes the last digit of 10 % of the numbers of a dump and of 50 % of the numbers of a data file,
leaves out angular velocities, units and times, accepts chemical elements alone as species, and
writes XYZ with 8 decimals.
"""

import re
import shlex
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxgran._utils.validation import checked_int
from jaxgran.data.curve import Particles, import_extra
from jaxgran.data.files import MAX_COUNT, check_writable, checked_path, name_in_errors, read_bytes

GSD = ".gsd"
XYZ = ".xyz"

TOLERANCE = 1e-12
"""Largest relative difference of the sides of a box that is read as a cube."""

FLOAT32_TOLERANCE = 1e-6
"""Largest relative difference of equal sizes and masses, which GSD files store as float32."""

UNITS = {
    "si": (1.0, 1.0, 1.0),
    "cgs": (1e-2, 1.0, 1e-3),
    "micro": (1e-6, 1e-6, 1e-15),
    "nano": (1e-9, 1e-9, 1e-21),
    "metal": (1e-10, 1e-12, 1.66053906660e-27),
    "real": (1e-10, 1e-15, 1.66053906660e-27),
}
"""Units of length (m), time (s) and mass (kg), by their names in LAMMPS."""

GSD_DEFAULT = 1.0
"""Diameter, m, and mass, kg, of GSD files that give none."""

DATA_COLUMNS = {
    "atomic": ("id", "type", "x", "y", "z"),
    "sphere": ("id", "type", "diameter", "density", "x", "y", "z"),
}
"""Columns of the section Atoms of a LAMMPS data file, by its atom style."""

POSITIONS = (("xu", "yu", "zu"), ("x", "y", "z"), ("xs", "ys", "zs"), ("xsu", "ysu", "zsu"))
"""Accepted names of columns of positions, in order of preference; s stands for scaled ones."""
VELOCITY = ("vx", "vy", "vz")
SPIN = ("omegax", "omegay", "omegaz")

XYZ_VECTORS = {
    "pos": ("x", "y", "z"),
    "velo": VELOCITY,
    "vel": VELOCITY,
    "velocities": VELOCITY,
    "velocity": VELOCITY,
    "angular_velocity": SPIN,
}
"""Names of the columns of properties of an extended XYZ file."""

EQUAL = {
    **dict.fromkeys(("type", "element", "species", "Z", "q", "shapex", "shapey", "shapez")),
    **dict.fromkeys(("diameter", "radius"), (1, 0)),
    **dict.fromkeys(("mass", "masses"), (0, 1)),
    "density": (-3, 1),
}
"""Columns that must be equal for all particles, as gases of jaxgran consist of equal spheres, and
the powers of m and kg in the unit of numbers."""

DUMP_ITEMS = ("UNITS", "TIMESTEP", "TIME", "NUMBER OF ATOMS", "BOX BOUNDS", "ATOMS")

SLANTED = "its box is slanted; only rectangular boxes are supported"


class Frame(NamedTuple):
    """Particles of one frame of a file, in SI, in the d dimensions of their gas.

    Attributes:
        position: m, shape (N, d), relative to the low corner of the box.
        velocity: m/s, shape (N, d).
        sides: of the box, m, shape (d,).
        spin: angular velocity, 1/s, or None.
        equal: columns that are equal for all particles, by name.
        periodic: whether the box is periodic.
        time: s, or None if the file gives no time.
        step: number of the time step, or None.
    """

    position: np.ndarray
    velocity: np.ndarray
    sides: np.ndarray
    spin: np.ndarray | None
    equal: dict[str, np.ndarray]
    periodic: bool
    time: float | None
    step: int | None


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


def open_frames(path: Path) -> list[Callable[[int | None], Frame]]:
    """Return a function for each frame of a file, which reads it, given its dimension or None."""
    if path.suffix == GSD:
        with _import_gsd().open(str(path), "r") as file:
            return [partial(_read_gsd, path, k) for k in range(len(file))]
    text = read_bytes(path).decode("utf-8-sig")
    if text.lstrip().startswith("ITEM:"):
        read = _read_dump
        parts = _parts_of_dump(text)
    elif text.split(maxsplit=1)[:1] and text.split(maxsplit=1)[0].isdigit():
        read = _read_xyz
        parts = _parts_of_xyz(text)
    else:
        return [partial(_read_data, text)]
    frames: list[Any] = [partial(read, part) for part in parts]
    if not text.endswith("\n"):
        frames[-1:] = [_refuse_cut]
    return frames


def _refuse_cut(dimension: int | None) -> Frame:
    raise ValueError(
        "it ends within a line, so that its last number may be cut off: end the last line if the "
        "file is complete, or read a frame before the last one"
    )


def _frame(
    columns: dict[str, np.ndarray],
    low: np.ndarray,
    sides: np.ndarray,
    dimension: int | None,
    *,
    units: str = "si",
    periodic: tuple[bool, ...] = (True, True, True),
    time: float | None = None,
    step: int | None = None,
) -> Frame:
    """Return a frame in SI of columns of text or numbers, sorted by id.

    Raises:
        ValueError: for values, boxes and particles that `read_particles` does not support.
    """
    if units.lower() not in UNITS:
        raise ValueError(
            f"its units are {units!r}, without a size in m: convert it to SI. Known units are "
            f"{', '.join(UNITS)}"
        )
    length, second, kilogram = UNITS[units.lower()]
    if "id" in columns:
        ids = columns["id"].astype(int)
        if len(set(ids)) < len(ids):
            raise ValueError("it has an id twice; remove one of its particles")
        columns = {name: column[np.argsort(ids)] for name, column in columns.items()}

    def vector(names: tuple[str, ...]) -> np.ndarray | None:
        known = [columns[name].astype(float) for name in names if name in columns]
        return np.stack(known, axis=1) if len(known) == len(names) else None

    d = dimension or 3
    position = next((x for names in POSITIONS if (x := vector(names)) is not None), None)
    velocity = vector(VELOCITY)
    spin = vector(SPIN) if SPIN[0] in columns else vector(SPIN[-1:])
    if position is None:
        raise ValueError(f"it has no columns {' or '.join(map(' '.join, POSITIONS))}")
    if velocity is None:
        raise ValueError(
            "it has no velocities in this frame: write the columns vx vy vz (LAMMPS), velo (XYZ; "
            "not momenta), or particles/velocity into every frame (GSD; HOOMD needs "
            "dynamic=['property', 'momentum'] for it)"
        )
    if not columns.keys() & {"x", "xu"}:
        position = low + position * sides
    sides = length * sides[:d]
    low = length * low[:d]
    position = length * position[:, :d] - low
    velocity = length / second * velocity
    equal = {}
    different = []
    for name in EQUAL.keys() & columns.keys():
        powers = EQUAL[name]
        values = columns[name]
        if powers is None:
            is_equal = len(set(values)) <= 1
        else:
            values = length ** powers[0] * kilogram ** powers[1] * values.astype(float)
            is_equal = np.ptp(values) <= FLOAT32_TOLERANCE * np.max(np.abs(values))
        equal[name] = values
        different += [] if is_equal else [name]
    is_periodic = all(periodic[:d])
    moving = np.any(velocity, axis=0)
    finite = all(np.all(np.isfinite(x)) for x in (position, velocity, sides))
    outside = np.any((position < 0) | (position > sides)) and not is_periodic
    in_plane = d == 3 and any(moving) and not moving[2] and np.ptp(position[:, 2]) == 0
    faults = {
        f"its particles differ in {', '.join(different)}, but gases of jaxgran consist of equal "
        "spheres; give a file of one kind of particles": different,
        "some of its positions, velocities or sides are not finite numbers": not finite,
        f"its box has the sides {sides}, which must be positive": np.any(sides <= 0),
        "its box is periodic in some directions only; boxes of jaxgran are periodic, or have "
        "walls, on all sides": any(periodic[:d]) and not is_periodic,
        "some particles are outside of its box, which is not periodic": outside,
        "all its particles move in one plane: give dimension=2 for disks, or 3": in_plane
        and dimension is None,
    }
    if message := next((message for message, is_wrong in faults.items() if is_wrong), None):
        raise ValueError(message)
    if is_periodic:
        position = np.mod(position, sides)
        position = np.where(position < sides, position, 0.0)  # rounding may give a side
    if spin is not None:
        spin = (spin if d == 3 else spin[:, -1:]) / second
    time = None if time is None else second * time
    return Frame(position, velocity[:, :d], sides, spin, equal, is_periodic, time, step)


def _read_gsd(path: Path, k: int, dimension: int | None) -> Frame:
    with _import_gsd().open(str(path), "r") as file:
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
    spin, time = (snapshot.log.get(name) for name in ("particles/angular_velocity", "time"))
    columns = {"type": particles.typeid, "diameter": particles.diameter}
    if np.any(particles.mass != GSD_DEFAULT):  # otherwise it was not given
        columns["mass"] = particles.mass
    columns |= zip("xyz", np.asarray(particles.position, float).T, strict=True)
    if known:
        columns |= zip(VELOCITY, np.asarray(particles.velocity, float).T, strict=True)
    if spin is not None:
        spin = np.reshape(spin, (int(particles.N), -1)).T
        columns |= zip(SPIN[-len(spin) :], spin, strict=True)
    time = None if time is None else float(time[0])
    dimension = dimension or int(box.dimensions)
    return _frame(columns, -sides / 2, sides, dimension, time=time, step=int(box.step))


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
    if not {"BOX BOUNDS", "ATOMS", "NUMBER OF ATOMS"} <= items.keys():
        raise ValueError("the frame of the LAMMPS dump is incomplete")
    flags, bounds = items["BOX BOUNDS"]
    if not all(re.fullmatch("[pfsm]{2}", flag) for flag in flags):
        raise ValueError(SLANTED)
    if any(set(flag) & set("sm") for flag in flags):
        raise ValueError("its box is fitted to the particles (boundary s or m): use p or f")
    low, high = np.array([line.split()[:2] for line in bounds.splitlines()[:3]], float).T
    names, body = items["ATOMS"]
    rows = [line.split() for line in body.splitlines() if line.strip()]
    words = {name: body.strip() for name, (_, body) in items.items()}
    return _frame(
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
        name = name.lower() if name.lower() in XYZ_VECTORS else name
        several = XYZ_VECTORS.get(name, [f"{name}_{k}" for k in range(number)])
        # In a plane the angular velocity has a z component only.
        names += [name] if number == 1 and name not in XYZ_VECTORS else several[-number:]
    if dimension is None and "dimension" in info:
        dimension = int(info["dimension"])
    return _frame(
        _table([line.split() for line in lines[2:]], names, int(lines[0])),
        np.array(info.get("origin", "0 0 0").split(), float),
        np.diag(lattice),
        dimension,
        units=info.get("units", "si"),
        periodic=tuple(x in "Tt1" for x in re.findall("[TtFf01]", info.get("pbc", "TTT"))),
        time=float(info["time"]) if "time" in info else None,
    )


def _read_data(text: str, dimension: int | None) -> Frame:
    bounds = [re.search(rf"^\s*(\S+)\s+(\S+)\s+{x}lo {x}hi", text, re.MULTILINE) for x in "xyz"]
    if not all(bounds):
        raise ValueError(
            "no file of particles: give a LAMMPS dump or data file, extended XYZ, or GSD (.gsd)"
        )
    if re.search(r"^.*(xy xz yz|avec)", text, re.MULTILINE):
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
    units = re.search(r"^.*units = (\w+)", text)
    units = units[1] if units else "si"
    return _frame(atoms | velocities, low, high - low, dimension, units=units)


def _section(
    text: str, name: str, columns: tuple[str, ...], count: re.Match[str] | None
) -> dict[str, np.ndarray]:
    """Return the columns of a section of a LAMMPS data file, sorted by id."""
    match = re.search(rf"^{name}\b.*\n\s*\n((?:[ \t]*[-+\d].*(?:\n|$))+)", text, re.MULTILINE)
    if match is None:
        raise ValueError(f"it has no section {name}")
    rows = [line.split("#")[0].split()[: len(columns)] for line in match[1].splitlines()]
    rows.sort(key=lambda row: int(row[0]))
    return _table(rows, columns[: len(rows[0])], int(count[1]) if count else len(rows))


def _table(rows: list[list[str]], names: Sequence[str], count: int) -> dict[str, np.ndarray]:
    """Return the columns of the rows of a frame, by name, as text."""
    if len(rows) != count or any(len(row) != len(names) for row in rows):
        raise ValueError(
            f"a frame of {count} atoms has not as many complete rows of {len(names)} columns"
        )
    columns = np.array(rows, object).reshape(count, len(names)).T
    return dict(zip(names, columns, strict=True))


class Sphere(NamedTuple):
    """Properties of all particles of a trajectory.

    Attributes:
        diameter: m.
        mass: kg.
    """

    diameter: float
    mass: float


class Trajectory:
    """Files of the frames of a run, one for each replica, written during the run.

    All numbers are SI. Replica k of several writes ``name.k.gsd``. Only complete frames are
    appended: the files are readable whenever a run ends, and a resumed run continues after the
    last frame.

    Args:
        path: ends in .gsd (float32, for OVITO, freud, VMD and HOOMD; needs `gsd`) or in .xyz (text
            with all digits).
        replicas: number of replicas.
        resumed: whether the run continues from a checkpoint. If False, no file may exist.

    Raises:
        ValueError: for another suffix, or a file that exists.
        OSError: naming the file, if it cannot be written.
        ModuleNotFoundError: for a .gsd file without `gsd`.
    """

    def __init__(self, path: str | Path, replicas: int, resumed: bool):
        path = Path(path)
        if path.suffix not in FORMATS:
            raise ValueError(
                f"the name of a trajectory ends in {' or '.join(FORMATS)}, got {str(path)!r}"
            )
        self.append, count = FORMATS[path.suffix]
        names = [file_of_replica(path, k) for k in range(replicas)]
        self.paths = names if replicas > 1 else [path]
        for file in self.paths:
            check_writable(file)
            if file.exists() and not resumed:
                raise ValueError(f"{file} exists: name another file, or remove it")
        if path.suffix == GSD:
            _import_gsd()
        self.written = [count(file) if file.exists() else 0 for file in self.paths]

    def write(self, k: int, time: float, particles: Particles, sphere: Sphere) -> None:
        """Write frame k of all replicas, unless the files already contain it.

        Raises:
            ValueError: if frames before it are missing.
        """
        for r, path in enumerate(self.paths):
            if self.written[r] < k:
                raise ValueError(
                    f"{path} has {self.written[r]} frames, but the checkpoint continues with frame "
                    f"{k}: remove both to start a new run, or restore the trajectory"
                )
            if self.written[r] > k:
                continue
            sides = np.asarray(particles.box_side)
            arrays = particles._replace(box_side=None)  # type: ignore[arg-type]
            replica = jax.tree.map(lambda x, r=r: np.asarray(x[r]), arrays)
            self.append(path, k, time, replica._replace(box_side=sides), sphere)
            self.written[r] += 1


def _import_gsd() -> Any:
    return import_extra("gsd.hoomd", "trajectories")


def _append_gsd(path: Path, k: int, time: float, replica: Particles, sphere: Sphere) -> None:
    hoomd = _import_gsd()
    n, d = replica.position.shape
    sides = np.broadcast_to(replica.box_side, d)
    centred = np.zeros((2, n, 3))
    centred[0, :, :d] = replica.position - sides / 2  # a box of HOOMD is centred at 0
    centred[1, :, :d] = replica.velocity
    frame = hoomd.Frame()
    frame.configuration.step = k
    frame.configuration.dimensions = d
    frame.configuration.box = [*sides, *[0.0] * (6 - d)]
    frame.particles.N = n
    frame.particles.position, frame.particles.velocity = centred.astype(np.float32)
    frame.particles.diameter = np.full(n, sphere.diameter, np.float32)
    frame.particles.mass = np.full(n, sphere.mass, np.float32)
    frame.log["time"] = np.array([time])
    if replica.angular_velocity is not None:
        spins = np.asarray(replica.angular_velocity, np.float32)
        frame.log["particles/angular_velocity"] = spins
    # The application says that each frame has its own velocities: see `_read_gsd`.
    file = import_module("gsd.fl").open(
        name=str(path),
        mode="r+" if path.exists() else "x",
        application=f"jaxgran {version('jaxgran')}",
        schema="hoomd",
        schema_version=[1, 4],
    )
    with hoomd.HOOMDTrajectory(file) as frames:
        frames.append(frame)


def _count_frames_gsd(path: Path) -> int:
    with _import_gsd().open(str(path), "r") as file:
        return len(file)


def _append_xyz(path: Path, k: int, time: float, replica: Particles, sphere: Sphere) -> None:
    n, d = replica.position.shape
    sides = np.broadcast_to(replica.box_side, d)
    lattice = np.diag([*sides, *[sphere.diameter] * (3 - d)]).ravel()
    columns = [np.zeros((n, 3)), np.zeros((n, 3)), np.full((n, 1), sphere.diameter / 2)]
    columns[0][:, :d] = replica.position
    columns[1][:, :d] = replica.velocity
    names = "species:S:1:pos:R:3:velo:R:3:radius:R:1"
    if replica.angular_velocity is not None:
        columns.append(np.asarray(replica.angular_velocity))
        names += f":angular_velocity:R:{columns[-1].shape[1]}"
    head = (
        f'Lattice="{" ".join(f"{x:.17g}" for x in lattice)}" Properties={names} '
        f"Time={time:.17g} frame={k} dimension={d} mass={sphere.mass:.17g}"
    )
    rows = (" ".join(("A", *(f"{x:.17g}" for x in row))) for row in np.hstack(columns))
    with path.open("a", encoding="utf-8") as file:
        file.write("\n".join((str(n), head, *rows)) + "\n")


def _count_frames_xyz(path: Path) -> int:
    """Return the number of complete frames, and remove an incomplete last one from the file."""
    frames = 0
    end = 0
    with path.open("rb+") as file:
        while (first := file.readline()).strip():
            lines = [file.readline() for _ in range(int(first) + 1)]
            if not lines[-1].endswith(b"\n"):
                break
            frames += 1
            end = file.tell()
        file.truncate(end)
    return frames


FORMATS = {GSD: (_append_gsd, _count_frames_gsd), XYZ: (_append_xyz, _count_frames_xyz)}


def file_of_replica(path: str | Path, k: int) -> Path:
    """Return the file of replica k, if there are several replicas."""
    path = Path(path)
    return path.with_suffix(f".{k}{path.suffix}")
