"""Files of particles: particles are read from GSD, extended XYZ and LAMMPS files, and trajectories
are written frame by frame during a run, as GSD or extended XYZ.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxgran.data.curve import Particles
from jaxgran.data.files import check_writable

GSD = ".gsd"
XYZ = ".xyz"

SIDE_TOLERANCE = 1e-12
"""Largest relative difference of the sides of a box that is read as a cube."""

DATA_COLUMNS = {"atomic": 5, "sphere": 7}
"""Columns up to z by atom style of LAMMPS data files: id, type, (diameter, density,) x, y, z."""


class _Frame(NamedTuple):
    """Content of one frame: the box, given by its low corner and sides, and rows of coordinates."""

    position: np.ndarray
    velocity: np.ndarray
    low: np.ndarray
    sides: np.ndarray
    spin: np.ndarray | None
    dimension: int = 3


def read_particles(path: str | Path, *, frame: int = -1, dimension: int | None = None) -> Particles:
    """Read the particles of one frame, as a start for `HardSpheres` or `SoftSpheres`.

    Supported formats are GSD (``.gsd``, needs the extra `trajectories`), extended XYZ (``.xyz``,
    with ``velo`` or ``vel``), LAMMPS dumps (text; columns id, x y z or xu yu zu or xs ys zs, vx vy
    vz and optionally omegax omegay omegaz) and LAMMPS data files as its command ``write_data``
    writes them (atom styles sphere and atomic, with velocities). Numbers are read as SI, LAMMPS's
    ``units si``. Particles are sorted by id and wrapped into the box, whose low corner becomes 0.

    Args:
        path: the file.
        frame: index of the frame, counted from 0, or from the end for negative ones; -1 is the
            last.
        dimension: 2 or 3; by default the dimension that the file gives, and 3 for LAMMPS files,
            which give none.

    Returns:
        `Particles` of one replica. ``box_side`` is one number for a cube or square, otherwise one
        for each side.

    Raises:
        ValueError: naming the file and what is wrong: no such file or frame, a box that is not
            rectangular, missing velocities or columns, values that are no finite numbers.
        ModuleNotFoundError: for a .gsd file without `gsd`.

    >>> particles = jaxgran.cool(
    ...     gas, times[:1], model=jaxgran.HardSpheres(50), trajectory="run.xyz", progress=False
    ... ).particles
    >>> same = jaxgran.read_particles("run.xyz")
    >>> bool(jnp.all(same.velocity == particles.velocity))
    True
    """
    path = Path(path)
    if dimension not in (None, 2, 3):
        raise ValueError(f"dimension must be 2 or 3, or None, got {dimension!r}")
    try:
        if path.suffix == GSD:
            content = _read_gsd(path, frame)
        else:
            text = path.read_text(encoding="utf-8")
            read = _read_xyz if path.suffix == XYZ else _read_lammps
            content = read(text, frame)
        return _to_particles(content, content.dimension if dimension is None else dimension)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except (ValueError, OSError, RuntimeError, IndexError, KeyError) as error:
        words = f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: {words}") from None


def _to_particles(content: _Frame, d: int) -> Particles:
    """Return one replica of d dimensions, with positions in [0, side)."""
    position, velocity = content.position[:, :d], content.velocity[:, :d]
    sides, spin = content.sides[:d], content.spin
    for name, values in (("positions", position), ("velocities", velocity), ("sides", sides)):
        if not np.all(np.isfinite(values)):
            raise ValueError(f"some of its {name} are not finite numbers")
    if not np.all(sides > 0):
        raise ValueError(f"its box has the sides {sides}, which must be positive")
    inside = np.mod(position - content.low[:d], sides)
    inside = np.where(inside < sides, inside, 0.0)  # rounding may give a side
    is_cube = np.ptp(sides) <= SIDE_TOLERANCE * sides[0]
    if spin is not None and d == 2:
        spin = spin[:, -1:]
    return Particles(
        position=jnp.asarray(inside[None]),
        velocity=jnp.asarray(velocity[None]),
        box_side=jnp.asarray(sides[0] if is_cube else sides),
        angular_velocity=None if spin is None else jnp.asarray(spin[None]),
    )


def _frame_index(frames: int, frame: int) -> int:
    if not -frames <= frame < frames:
        raise ValueError(f"it has {frames} frames, there is no frame {frame}")
    return frame % frames


def _read_gsd(path: Path, frame: int) -> _Frame:
    if not path.exists():
        raise FileNotFoundError
    with _import_gsd().open(str(path), "r") as file:
        snapshot = file[_frame_index(len(file), frame)]
    d, box = int(snapshot.configuration.dimensions), np.asarray(snapshot.configuration.box, float)
    if np.any(box[3:] != 0):
        raise ValueError("its box is slanted; only rectangular boxes are supported")
    sides = box[:3]
    spin = snapshot.log.get("particles/angular_velocity")
    spin = None if spin is None else np.reshape(spin, (int(snapshot.particles.N), -1))
    position = np.asarray(snapshot.particles.position, float)
    velocity = np.asarray(snapshot.particles.velocity, float)
    return _Frame(position, velocity, -sides / 2, sides, spin, d)


def _read_xyz(text: str, frame: int) -> _Frame:
    lines, starts, at = text.split("\n")[:-1], [], 0  # drops an incomplete last line
    while at < len(lines) and lines[at].strip():
        starts.append(at)
        at += int(lines[at]) + 2
    if at > len(lines):
        starts.pop()
    at = starts[_frame_index(len(starts), frame)]
    count, head = int(lines[at]), lines[at + 1]
    match = re.search(r'Lattice="([^"]*)"', head)
    if match is None:
        raise KeyError("Lattice")
    lattice = np.array(match[1].split(), float).reshape(3, 3)
    if np.any(lattice != np.diag(np.diag(lattice))):
        raise ValueError("its box is slanted; only rectangular boxes are supported")
    columns = _xyz_columns(head)
    rows = [line.split() for line in lines[at + 2 : at + 2 + count]]

    def values(name: str) -> np.ndarray:
        return np.array([row[columns[name]] for row in rows], float)

    velocity = next((name for name in ("velo", "vel", "velocities") if name in columns), "velo")
    spin = values("angular_velocity") if "angular_velocity" in columns else None
    d = int((re.search(r"\bdimension=(\d)", head) or [0, 3])[1])
    return _Frame(values("pos"), values(velocity), np.zeros(3), np.diag(lattice), spin, d)


def _xyz_columns(head: str) -> dict[str, slice]:
    """Return the slice of each property in the columns of an extended XYZ file."""
    match = re.search(r"Properties=(\S+)", head)
    if match is None:
        raise KeyError("Properties")
    parts, columns, at = match[1].split(":"), {}, 0
    for name, number in zip(parts[::3], parts[2::3], strict=True):
        columns[name] = slice(at, at + int(number))
        at += int(number)
    return columns


def _read_lammps(text: str, frame: int) -> _Frame:
    return _read_dump(text, frame) if text.startswith("ITEM:") else _read_data(text)


def _read_dump(text: str, frame: int) -> _Frame:
    frames = re.split(r"^ITEM: TIMESTEP\n", text, flags=re.MULTILINE)[1:]
    text = frames[_frame_index(len(frames), frame)]
    bounds = re.search(r"ITEM: BOX BOUNDS(.*)\n((?:.*\n){3})", text)
    atoms = re.search(r"ITEM: ATOMS (.*)\n", text)
    count = re.search(r"ITEM: NUMBER OF ATOMS\n(\d+)", text)
    if bounds is None or atoms is None or count is None:
        raise ValueError("the frame of the LAMMPS dump is incomplete")
    if "xy" in bounds[1] or "abc" in bounds[1]:
        raise ValueError("its box is slanted; only rectangular boxes are supported")
    low, high = np.array([line.split()[:2] for line in bounds[2].splitlines()], float).T
    names = atoms[1].split()
    table = np.array([line.split() for line in text[atoms.end() :].splitlines()], dtype=object)
    if table.shape != (int(count[1]), len(names)):
        raise ValueError(f"a frame of {count[1]} atoms has not as many complete rows")
    order = np.argsort(table[:, names.index("id")].astype(int)) if "id" in names else slice(None)

    def values(*wanted: str) -> np.ndarray:
        missing = [name for name in wanted if name not in names]
        if missing:
            raise KeyError(f"column {' '.join(missing)}")
        return table[order][:, [names.index(name) for name in wanted]].astype(float)

    if "xs" in names:
        position = low + values("xs", "ys", "zs") * (high - low)
    else:
        position = values("xu", "yu", "zu") if "xu" in names else values("x", "y", "z")
    spin = values("omegax", "omegay", "omegaz") if "omegax" in names else None
    return _Frame(position, values("vx", "vy", "vz"), low, high - low, spin)


def _read_data(text: str) -> _Frame:
    bounds = [re.search(rf"^\s*(\S+)\s+(\S+)\s+{x}lo {x}hi", text, re.MULTILINE) for x in "xyz"]
    if not all(bounds):
        raise ValueError(
            "neither a LAMMPS dump nor a LAMMPS data file. Give one of these, or .gsd or .xyz"
        )
    if re.search(r"^.*xy xz yz", text, re.MULTILINE):
        raise ValueError("its box is slanted; only rectangular boxes are supported")
    low, high = np.array([[b[1], b[2]] for b in bounds if b], float).T
    style = re.search(r"^Atoms\s*#\s*(\w+)", text, re.MULTILINE)
    if style is None or style[1] not in DATA_COLUMNS:
        raise ValueError(f"its section Atoms must name its style, {' or '.join(DATA_COLUMNS)}")
    atoms, velocities = _section(text, "Atoms"), _section(text, "Velocities")
    if set(atoms) != set(velocities):
        raise ValueError("its sections Atoms and Velocities have different ids")
    ids = sorted(atoms)
    end = DATA_COLUMNS[style[1]] - 1
    position = np.array([atoms[i][end - 3 : end] for i in ids])
    velocity = np.array([velocities[i] for i in ids])
    spin = velocity[:, 3:6] if velocity.shape[1] > 3 else None
    return _Frame(position, velocity[:, :3], low, high - low, spin)


def _section(text: str, name: str) -> dict[int, list[float]]:
    """Return the rows of numbers of a section of a LAMMPS data file, by id."""
    match = re.search(rf"^{name}\b.*\n\s*\n((?:[ \t]*[-+\d].*(?:\n|$))+)", text, re.MULTILINE)
    if match is None:
        raise KeyError(f"section {name}")
    rows = [line.split("#")[0].split() for line in match[1].splitlines()]
    return {int(row[0]): [float(x) for x in row[1:]] for row in rows}


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
    try:
        return import_module("gsd.hoomd")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'files of type .gsd need gsd: pip install "jaxgran[trajectories]", or use .xyz',
            name=error.name,
        ) from None


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
    with hoomd.open(str(path), "r+" if path.exists() else "x") as file:
        file.append(frame)


def _count_frames_gsd(path: Path) -> int:
    with _import_gsd().open(str(path), "r") as file:
        return len(file)


def _append_xyz(path: Path, k: int, time: float, replica: Particles, sphere: Sphere) -> None:
    n, d = replica.position.shape
    sides = np.broadcast_to(replica.box_side, d)
    lattice = np.diag([*sides, *[sphere.diameter] * (3 - d)]).ravel()
    columns = [np.zeros((n, 3)), np.zeros((n, 3)), np.full((n, 1), sphere.diameter / 2)]
    columns[0][:, :d], columns[1][:, :d] = replica.position, replica.velocity
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
    frames, end = 0, 0
    with path.open("rb+") as file:
        while (first := file.readline()).strip():
            lines = [file.readline() for _ in range(int(first) + 1)]
            if not lines[-1].endswith(b"\n"):
                break
            frames, end = frames + 1, file.tell()
        file.truncate(end)
    return frames


FORMATS = {GSD: (_append_gsd, _count_frames_gsd), XYZ: (_append_xyz, _count_frames_xyz)}


def file_of_replica(path: str | Path, k: int) -> Path:
    """Return the file of replica k, if there are several replicas."""
    path = Path(path)
    return path.with_suffix(f".{k}{path.suffix}")
