"""Particles from files: GSD, extended XYZ, and LAMMPS's dump and data files."""

import re
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxgran.data.curve import Particles
from jaxgran.data.trajectory import GSD, XYZ, needed_gsd

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


def _chosen(frames: int, frame: int) -> int:
    if not -frames <= frame < frames:
        raise ValueError(f"it has {frames} frames, there is no frame {frame}")
    return frame % frames


def _read_gsd(path: Path, frame: int) -> _Found:
    if not path.exists():
        raise FileNotFoundError
    with needed_gsd().open(str(path), "r") as file:
        found = file[_chosen(len(file), frame)]
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
    at = starts[_chosen(len(starts), frame)]
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
    one = frames[_chosen(len(frames), frame)]
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
