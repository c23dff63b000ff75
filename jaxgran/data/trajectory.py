"""Trajectories: frames of a run, written to GSD or extended XYZ files while it runs.

`jaxgran.read_particles` reads them.
"""

from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxgran.data.files import check_writable
from jaxgran.data.particle_file import GSD, XYZ, import_gsd
from jaxgran.data.particles import Particles


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
            import_gsd()
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


def _append_gsd(path: Path, k: int, time: float, replica: Particles, sphere: Sphere) -> None:
    hoomd = import_gsd()
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
    with import_gsd().open(str(path), "r") as file:
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
