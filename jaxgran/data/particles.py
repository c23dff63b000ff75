"""Particles from files: GSD, extended XYZ, and LAMMPS's dump and data files.

Trajectories, written frame by frame while a run goes on: GSD and extended XYZ.
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


class Sphere(NamedTuple):
    """What all particles of a trajectory have in common.

    Attributes:
        diameter: m.
        mass: kg.
    """

    diameter: float
    mass: float


class Trajectory:
    """Files of the frames of a run, one for each replica, written while it goes on.

    All numbers are SI. Replica k of several writes ``name.k.gsd``. A frame is appended whole: what
    a run left behind is readable whenever it ends, and a resumed run goes on after its last frame.

    Args:
        path: ends in .gsd (float32, of OVITO, freud, VMD and HOOMD; needs `gsd`) or in .xyz (text
            with all digits).
        replicas: number of boxes.
        resumed: whether the run goes on from a checkpoint; else no file may exist.

    Raises:
        ValueError: for another suffix, or a file that exists.
        OSError: naming the file, if it cannot be written.
        ModuleNotFoundError: for a .gsd file without `gsd`.
    """

    def __init__(self, path: str | Path, replicas: int, resumed: bool):
        path = Path(path)
        if path.suffix not in FORMATS:
            raise ValueError(f"a trajectory ends in {' or '.join(FORMATS)}, got {str(path)!r}")
        self.append, count = FORMATS[path.suffix]
        several = replicas > 1
        names = [file_of_replica(path, k) for k in range(replicas)]
        self.paths = names if several else [path]
        for file in self.paths:
            check_writable(file)
            if file.exists() and not resumed:
                raise ValueError(f"{file} exists: name another file, or remove it")
        if path.suffix == GSD:
            needed_gsd()
        self.written = [count(file) if file.exists() else 0 for file in self.paths]

    def write(self, k: int, time: float, particles: Particles, sphere: Sphere) -> None:
        """Write frame k of all replicas, unless it is there.

        Raises:
            ValueError: if frames before it are missing.
        """
        for r, path in enumerate(self.paths):
            if self.written[r] < k:
                raise ValueError(
                    f"{path} has {self.written[r]} frames, and the checkpoint goes on with frame "
                    f"{k}: remove both to begin anew, or restore the trajectory"
                )
            if self.written[r] > k:
                continue
            sides, each = particles.box_side, particles._replace(box_side=None)  # type: ignore[arg-type]
            one = jax.tree.map(lambda x, r=r: np.asarray(x[r]), each)
            self.append(path, k, time, one._replace(box_side=np.asarray(sides)), sphere)
            self.written[r] += 1


def needed_gsd() -> Any:
    """The module `gsd.hoomd`."""
    try:
        return import_module("gsd.hoomd")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            'files of type .gsd need gsd: pip install "jaxgran[trajectories]", or use .xyz',
            name=error.name,
        ) from None


def _append_gsd(path: Path, k: int, time: float, of_one: Particles, sphere: Sphere) -> None:
    hoomd = needed_gsd()
    n, d = of_one.position.shape
    sides = np.broadcast_to(of_one.box_side, d)
    centred = np.zeros((2, n, 3))
    centred[0, :, :d] = of_one.position - sides / 2  # a box of HOOMD is centred at 0
    centred[1, :, :d] = of_one.velocity
    frame = hoomd.Frame()
    frame.configuration.step = k
    frame.configuration.dimensions = d
    frame.configuration.box = [*sides, *[0.0] * (6 - d)]
    frame.particles.N = n
    frame.particles.position, frame.particles.velocity = centred.astype(np.float32)
    frame.particles.diameter = np.full(n, sphere.diameter, np.float32)
    frame.particles.mass = np.full(n, sphere.mass, np.float32)
    frame.log["time"] = np.array([time])
    if of_one.angular_velocity is not None:
        spins = np.asarray(of_one.angular_velocity, np.float32)
        frame.log["particles/angular_velocity"] = spins
    with hoomd.open(str(path), "r+" if path.exists() else "x") as file:
        file.append(frame)


def _frames_of_gsd(path: Path) -> int:
    with needed_gsd().open(str(path), "r") as file:
        return len(file)


def _append_xyz(path: Path, k: int, time: float, of_one: Particles, sphere: Sphere) -> None:
    n, d = of_one.position.shape
    sides = np.broadcast_to(of_one.box_side, d)
    lattice = np.diag([*sides, *[sphere.diameter] * (3 - d)]).ravel()
    columns = [np.zeros((n, 3)), np.zeros((n, 3)), np.full((n, 1), sphere.diameter / 2)]
    columns[0][:, :d], columns[1][:, :d] = of_one.position, of_one.velocity
    names = "species:S:1:pos:R:3:velo:R:3:radius:R:1"
    if of_one.angular_velocity is not None:
        columns.append(np.asarray(of_one.angular_velocity))
        names += f":angular_velocity:R:{columns[-1].shape[1]}"
    head = (
        f'Lattice="{" ".join(f"{x:.17g}" for x in lattice)}" Properties={names} '
        f"Time={time:.17g} frame={k} dimension={d} mass={sphere.mass:.17g}"
    )
    rows = (" ".join(("A", *(f"{x:.17g}" for x in row))) for row in np.hstack(columns))
    with path.open("a", encoding="utf-8") as file:
        file.write("\n".join((str(n), head, *rows)) + "\n")


def _frames_of_xyz(path: Path) -> int:
    """How many whole frames there are; a last one that is not whole is cut off."""
    frames, whole = 0, 0
    with path.open("rb+") as file:
        while (first := file.readline()).strip():
            lines = [file.readline() for _ in range(int(first) + 1)]
            if not lines[-1].endswith(b"\n"):
                break
            frames, whole = frames + 1, file.tell()
        file.truncate(whole)
    return frames


FORMATS = {GSD: (_append_gsd, _frames_of_gsd), XYZ: (_append_xyz, _frames_of_xyz)}


def file_of_replica(path: str | Path, k: int) -> Path:
    """The file of replica k of several."""
    path = Path(path)
    return path.with_suffix(f".{k}{path.suffix}")


SAME_SIDES = 1e-12
"""Relative difference up to which the sides of a box count as those of a cube."""

DATA_COLUMNS = {"atomic": 5, "sphere": 7}
"""Columns up to z of atom styles of LAMMPS's data files: id, type, (diameter, density,) x, y, z."""


class _Found(NamedTuple):
    """What a file holds: the box from its low corner on, and rows of three coordinates."""

    position: np.ndarray
    velocity: np.ndarray
    low: np.ndarray
    sides: np.ndarray
    spin: np.ndarray | None
    dimension: int = 3


def read_particles(path: str | Path, *, frame: int = -1, dimension: int | None = None) -> Particles:
    """Read the particles of one frame, as a start for `HardSpheres` or `SoftSpheres`.

    Of GSD (``.gsd``, needs the extra `trajectories`), extended XYZ (``.xyz``, with ``velo`` or
    ``vel``), a LAMMPS dump (text; columns id, x y z or xu yu zu or xs ys zs, vx vy vz and, if
    there, omegax omegay omegaz) or a LAMMPS data file as `write_data` writes it (atom styles
    sphere and atomic, with velocities). Numbers are taken for SI, LAMMPS's ``units si``. Particles
    are put in the order of their ids, and into the box, whose low corner becomes 0.

    Args:
        path: the file.
        frame: which one, from 0 on, or from the end, -1 the last.
        dimension: 2 or 3; by default what the file says, and 3 of LAMMPS's, which do not.

    Returns:
        `Particles` of one replica; ``box_side`` is one number for a cube or square, else one for
        each side.

    Raises:
        ValueError: naming the file and what is wrong: no such file or frame, a slanted box,
            velocities or columns that are missing, numbers that are none.
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
            found = _read_gsd(path, frame)
        else:
            text = path.read_text(encoding="utf-8")
            read = _read_xyz if path.suffix == XYZ else _read_lammps
            found = read(text, frame)
        return _in_box(*found[:5], found.dimension if dimension is None else dimension)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; check the path") from None
    except (ValueError, OSError, RuntimeError, IndexError, KeyError) as error:
        words = f"it has no {error.args[0]}" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path}: {words}") from None


def _in_box(
    position: np.ndarray,
    velocity: np.ndarray,
    low: np.ndarray,
    sides: np.ndarray,
    spin: np.ndarray | None,
    d: int,
) -> Particles:
    """One replica of d dimensions in [0, side)."""
    position, velocity, sides = position[:, :d], velocity[:, :d], sides[:d]
    for name, values in (("positions", position), ("velocities", velocity), ("sides", sides)):
        if not np.all(np.isfinite(values)):
            raise ValueError(f"some of its {name} are not finite numbers")
    if not np.all(sides > 0):
        raise ValueError(f"its box has the sides {sides}, which must be positive")
    inside = np.mod(position - low[:d], sides)
    inside = np.where(inside < sides, inside, 0.0)  # where rounding gave a side
    cube = np.ptp(sides) <= SAME_SIDES * sides[0]
    if spin is not None and d == 2:
        spin = spin[:, -1:]
    return Particles(
        position=jnp.asarray(inside[None]),
        velocity=jnp.asarray(velocity[None]),
        box_side=jnp.asarray(sides[0] if cube else sides),
        angular_velocity=None if spin is None else jnp.asarray(spin[None]),
    )


def _chosen_frame(frames: int, frame: int) -> int:
    if not -frames <= frame < frames:
        raise ValueError(f"it has {frames} frames, there is no frame {frame}")
    return frame % frames


def _read_gsd(path: Path, frame: int) -> _Found:
    if not path.exists():
        raise FileNotFoundError
    with needed_gsd().open(str(path), "r") as file:
        found = file[_chosen_frame(len(file), frame)]
    d, box = int(found.configuration.dimensions), np.asarray(found.configuration.box, float)
    if np.any(box[3:] != 0):
        raise ValueError("its box is slanted; only right-angled ones are known")
    sides = box[:3]
    spin = found.log.get("particles/angular_velocity")
    spin = None if spin is None else np.reshape(spin, (int(found.particles.N), -1))
    position = np.asarray(found.particles.position, float)
    velocity = np.asarray(found.particles.velocity, float)
    return _Found(position, velocity, -sides / 2, sides, spin, d)


def _read_xyz(text: str, frame: int) -> _Found:
    lines, starts, at = text.split("\n")[:-1], [], 0  # without what was not written to its end
    while at < len(lines) and lines[at].strip():
        starts.append(at)
        at += int(lines[at]) + 2
    if at > len(lines):
        starts.pop()
    at = starts[_chosen_frame(len(starts), frame)]
    count, head = int(lines[at]), lines[at + 1]
    found = re.search(r'Lattice="([^"]*)"', head)
    if found is None:
        raise KeyError("Lattice")
    lattice = np.array(found[1].split(), float).reshape(3, 3)
    if np.any(lattice != np.diag(np.diag(lattice))):
        raise ValueError("its box is slanted; only right-angled ones are known")
    columns = _xyz_columns(head)
    rows = [line.split() for line in lines[at + 2 : at + 2 + count]]

    def values(name: str) -> np.ndarray:
        return np.array([row[columns[name]] for row in rows], float)

    velocity = next((name for name in ("velo", "vel", "velocities") if name in columns), "velo")
    spin = values("angular_velocity") if "angular_velocity" in columns else None
    d = int((re.search(r"\bdimension=(\d)", head) or [0, 3])[1])
    return _Found(values("pos"), values(velocity), np.zeros(3), np.diag(lattice), spin, d)


def _xyz_columns(head: str) -> dict[str, slice]:
    """Places of the columns of an extended XYZ file by name."""
    found = re.search(r"Properties=(\S+)", head)
    if found is None:
        raise KeyError("Properties")
    parts, columns, at = found[1].split(":"), {}, 0
    for name, number in zip(parts[::3], parts[2::3], strict=True):
        columns[name] = slice(at, at + int(number))
        at += int(number)
    return columns


def _read_lammps(text: str, frame: int) -> _Found:
    return _read_dump(text, frame) if text.startswith("ITEM:") else _read_data(text)


def _read_dump(text: str, frame: int) -> _Found:
    frames = re.split(r"^ITEM: TIMESTEP\n", text, flags=re.MULTILINE)[1:]
    one = frames[_chosen_frame(len(frames), frame)]
    bounds = re.search(r"ITEM: BOX BOUNDS(.*)\n((?:.*\n){3})", one)
    atoms = re.search(r"ITEM: ATOMS (.*)\n", one)
    count = re.search(r"ITEM: NUMBER OF ATOMS\n(\d+)", one)
    if bounds is None or atoms is None or count is None:
        raise ValueError("not a whole frame of a LAMMPS dump")
    if "xy" in bounds[1] or "abc" in bounds[1]:
        raise ValueError("its box is slanted; only right-angled ones are known")
    low, high = np.array([line.split()[:2] for line in bounds[2].splitlines()], float).T
    names = atoms[1].split()
    table = np.array([line.split() for line in one[atoms.end() :].splitlines()], dtype=object)
    if table.shape != (int(count[1]), len(names)):
        raise ValueError(f"a frame of {count[1]} atoms has not as many whole rows")
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
    return _Found(position, values("vx", "vy", "vz"), low, high - low, spin)


def _read_data(text: str) -> _Found:
    bounds = [re.search(rf"^\s*(\S+)\s+(\S+)\s+{x}lo {x}hi", text, re.MULTILINE) for x in "xyz"]
    if not all(bounds):
        raise ValueError("neither a LAMMPS dump nor a data file, nor does it end in .gsd or .xyz")
    if re.search(r"^.*xy xz yz", text, re.MULTILINE):
        raise ValueError("its box is slanted; only right-angled ones are known")
    low, high = np.array([[b[1], b[2]] for b in bounds if b], float).T
    style = re.search(r"^Atoms\s*#\s*(\w+)", text, re.MULTILINE)
    if style is None or style[1] not in DATA_COLUMNS:
        raise ValueError(f"its section Atoms must name its style, {' or '.join(DATA_COLUMNS)}")
    atoms, velocities = _section(text, "Atoms"), _section(text, "Velocities")
    if set(atoms) != set(velocities):
        raise ValueError("its sections Atoms and Velocities have other ids")
    ids = sorted(atoms)
    end = DATA_COLUMNS[style[1]] - 1
    position = np.array([atoms[i][end - 3 : end] for i in ids])
    found = np.array([velocities[i] for i in ids])
    spin = found[:, 3:6] if found.shape[1] > 3 else None
    return _Found(position, found[:, :3], low, high - low, spin)


def _section(text: str, name: str) -> dict[int, list[float]]:
    """Rows of numbers of a section of a data file by id."""
    found = re.search(rf"^{name}\b.*\n\s*\n((?:[ \t]*[-+\d].*(?:\n|$))+)", text, re.MULTILINE)
    if found is None:
        raise KeyError(f"section {name}")
    rows = [line.split("#")[0].split() for line in found[1].splitlines()]
    return {int(row[0]): [float(x) for x in row[1:]] for row in rows}
