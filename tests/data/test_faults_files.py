"""Files of other programs, as they were reported: read right, or refused in words."""

import gzip
from pathlib import Path

import numpy as np
import pytest

import jaxgran

gsd_hoomd = pytest.importorskip("gsd.hoomd")

N, SIDE = 30, 0.03
RNG = np.random.default_rng(0)
POSITION = SIDE * RNG.random((2, N, 3))
VELOCITY = RNG.normal(size=(2, N, 3)) * [[[0.1]], [[0.07]]]


def rows(*columns, frame=-1):
    """Rows of text: whole numbers and words before the positions and velocities of a frame."""
    numbers = np.concatenate([POSITION[frame], VELOCITY[frame]], axis=1)
    return [
        " ".join([*map(str, words), *(f"{x:.17g}" for x in row)])
        for *words, row in zip(*columns, numbers, strict=True)
    ]


IDS, ONES = range(1, N + 1), [1] * N
BOUNDS = f"0 {SIDE}\n" * 3


def dump(
    *, bounds=BOUNDS, flags="pp pp pp", names="id type x y z vx vy vz", columns=(IDS, ONES), head=""
):
    """A LAMMPS dump of both frames."""
    return "".join(
        f"{head}ITEM: TIMESTEP\n{1000 * k}\nITEM: NUMBER OF ATOMS\n{N}\n"
        f"ITEM: BOX BOUNDS {flags}\n{bounds}ITEM: ATOMS {names}\n"
        + "\n".join(rows(*columns, frame=k))
        + "\n"
        for k in range(2)
    )


def xyz(*, head="", properties="species:S:1:pos:R:3:velo:R:3", between="", species=("Gl",) * N):
    """An extended XYZ file of both frames."""
    lattice = f'Lattice="{SIDE} 0 0 0 {SIDE} 0 0 0 {SIDE}"'
    return between.join(
        f"{N}\n{lattice} Properties={properties} {head}\n"
        + "\n".join(rows(species, frame=k))
        + "\n"
        for k in range(2)
    )


def gsd(*, velocities=(0, 1), types=0, diameter=1.0):
    """Write a GSD file whose frames have velocities in some frames only."""

    def write(path):
        with gsd_hoomd.open(str(path), "x") as file:
            for k in range(2):
                frame = gsd_hoomd.Frame()
                frame.configuration.box = [SIDE] * 3 + [0] * 3
                frame.particles.N = N
                frame.particles.types = ["A", "B"]
                frame.particles.typeid = np.arange(N) * types % 2
                frame.particles.diameter = diameter * np.ones(N)
                frame.particles.position = POSITION[k] - SIDE / 2
                if k in velocities:
                    frame.particles.velocity = VELOCITY[k]
                file.append(frame)

    return write


PARTICLES = {
    # 6: velocities of this very frame
    "velocities in the first frame only": ("a.gsd", gsd(velocities=(0,)), "no velocities in this"),
    "no velocities": ("a.gsd", gsd(velocities=()), r"no velocities.*dynamic=\['property'"),
    "velocities in every frame": ("a.gsd", gsd(), None),
    # 7: units and times
    "units si": ("a.dump", dump().replace("ITEM", "ITEM: UNITS\nsi\nITEM", 1), None),
    "units lj": ("a.dump", dump().replace("ITEM", "ITEM: UNITS\nlj\nITEM", 1), "'lj', without a"),
    "time of each frame": ("a.dump", dump(head="ITEM: TIME\n0.5\n"), None),
    "units of a data file": (
        "a.data",
        "LAMMPS data file via write_data, units = lj\n\n1 atoms\n"
        "0 1 xlo xhi\n0 1 ylo yhi\n0 1 zlo zhi\n\nAtoms # atomic\n\n1 1 0 0 0\n\n"
        "Velocities\n\n1 1 1 1\n",
        "'lj', without a size",
    ),
    "units of extended XYZ": ("a.xyz", xyz(head="units=lj"), "'lj', without a size"),
    "another unit of XYZ": ("a.xyz", xyz(head="length_unit=mm"), "gives length_unit: write units="),
    # 8: equal spheres
    "two types": ("a.dump", dump(columns=(IDS, [1, 2] * (N // 2))), "differ in type"),
    "two radii": (
        "a.dump",
        dump(names="id radius x y z vx vy vz", columns=(IDS, [1e-3, 2e-3] * (N // 2))),
        "differ in radius",
    ),
    "two masses": (
        "a.xyz",
        xyz(properties="mass:R:1:pos:R:3:velo:R:3", species=[1.0, 1.5] * (N // 2)),
        "differ in mass",
    ),
    "two species": ("a.xyz", xyz(species=["A", "B"] * (N // 2)), "differ in species"),
    "two types of GSD": ("a.gsd", gsd(types=1), "differ in type"),
    "equal sizes in float32": ("a.gsd", gsd(diameter=0.1), None),
    # 9: extended XYZ of others
    "walls": ("a.xyz", xyz(head='pbc="F F F"'), None),
    "walls elsewhere": ("a.xyz", xyz(head='pbc="F F F" Origin="1 0 0"'), "are outside of its box"),
    "walls on two sides": ("a.xyz", xyz(head='pbc="T T F"'), "periodic in some directions only"),
    "ASE's momenta": (
        "a.xyz",
        xyz(properties="species:S:1:pos:R:3:momenta:R:3"),
        "not momenta",
    ),
    "another suffix": ("a.extxyz", xyz(), None),
    "quoted properties": ("a.xyz", xyz(properties='"species:S:1:pos:R:3:velo:R:3"'), None),
    "compressed XYZ": ("a.xyz.gz", xyz(), None),
    "compressed dump": ("a.dump.gz", dump(), None),
    "no box": ("a.xyz", xyz().replace("Lattice", "Box"), "it has no Lattice"),
    # 10: whole frames
    "blank line between frames": ("a.xyz", xyz(between="\n"), None),
    "no end of the last line": ("a.xyz", xyz()[:-1], "ends within a line"),
    "cut within the last number": ("a.dump", dump()[:-3], "ends within a line"),
    "cut within the rows": ("a.dump", dump().rsplit("\n", 3)[0] + "\n", "not as many complete"),
    "cut within the head": ("a.dump", dump() + "ITEM: TIMESTEP\n7\n", "is incomplete"),
    "text after a frame": ("a.xyz", xyz() + "end\n", "must be a number of particles, got 'end'"),
    # 23 and siblings
    "an id twice": ("a.dump", dump(columns=([1, 1, *IDS[2:]], ONES)), "has an id twice"),
    "a box around the particles": ("a.dump", dump(flags="ss ss ss"), "boundary s or m"),
    "walls of a dump": ("a.dump", dump(flags="ff ff ff"), None),
}


def write(path, content):
    if callable(content):
        content(path)
    elif path.suffix == ".gz":
        path.write_bytes(gzip.compress(content.encode()))
    else:
        path.write_text(content)
    return path


@pytest.mark.parametrize("name, content, words", PARTICLES.values(), ids=PARTICLES)
def test_particles(tmp_path, name, content, words):
    path = write(tmp_path / name, content)
    if words is not None:
        with pytest.raises(ValueError, match=f"{name}: .*{words}"):
            jaxgran.read_particles(path)
        return
    read = jaxgran.read_particles(path)
    digits = 1e-6 if Path(name).suffix == ".gsd" else 1e-15  # float32, or all
    np.testing.assert_allclose(read.position[0], POSITION[-1], atol=digits * SIDE)
    np.testing.assert_allclose(read.velocity[0], VELOCITY[-1], rtol=digits)
    assert read.box_side == pytest.approx(SIDE, rel=digits)


@pytest.mark.parametrize(
    "units, length, speed", [("cgs", 1e-2, 1e-2), ("micro", 1e-6, 1.0), ("metal", 1e-10, 100.0)]
)
def test_units_of_lammps(tmp_path, units, length, speed):
    text = dump().replace("ITEM", f"ITEM: UNITS\n{units}\nITEM", 1)
    read = jaxgran.read_particles(write(tmp_path / "a.dump", text))
    np.testing.assert_allclose(read.position[0], length * POSITION[-1], rtol=1e-14)
    np.testing.assert_allclose(read.velocity[0], speed * VELOCITY[-1], rtol=1e-14)


def test_disks_in_space_are_asked_about(tmp_path):
    lines = [
        " ".join([*words[:4], "0", *words[5:7], "0"]) if len(words) == 8 else line
        for line in dump().splitlines()
        if (words := line.split())
    ]
    path = write(tmp_path / "a.dump", "\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="move in one plane: give dimension=2"):
        jaxgran.read_particles(path)
    assert jaxgran.read_particles(path, dimension=2).velocity.shape == (1, N, 2)
