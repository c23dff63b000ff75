"""Trajectories, written frame by frame while a run goes on: GSD and extended XYZ."""

from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import jax
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
