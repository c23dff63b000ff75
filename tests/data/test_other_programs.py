"""Files of other programs, as they were reported: read right, or refused in words."""

import gzip
import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import jaxgran
from jaxgran.data.particle_frame import frame_of_columns

gsd_hoomd = pytest.importorskip("gsd.hoomd")

N, SIDE, FRAMES = 30, 0.03, 4
RNG = np.random.default_rng(0)
POSITION = SIDE * RNG.random((FRAMES, N, 3))
VELOCITY = RNG.normal(size=(FRAMES, N, 3)) * 0.1 / np.arange(1, FRAMES + 1)[:, None, None]


def rows(*columns, frame=-1):
    """Rows of text: whole numbers and words before the positions and velocities of a frame."""
    numbers = np.concatenate([POSITION[frame], VELOCITY[frame]], axis=1)
    return "".join(
        " ".join([*map(str, words), *(f"{x:.17g}" for x in row)]) + "\n"
        for *words, row in zip(*columns, numbers, strict=True)
    )


IDS, ONES = range(1, N + 1), [1] * N
BOUNDS = f"0 {SIDE}\n" * 3


def dump(
    *, bounds=BOUNDS, flags="pp pp pp", names="id type x y z vx vy vz", columns=(IDS, ONES), head=""
):
    """A LAMMPS dump of all frames; {k} in its head is the index of a frame."""
    return "".join(
        f"{head.format(k=k)}ITEM: TIMESTEP\n{1000 * k}\nITEM: NUMBER OF ATOMS\n{N}\n"
        f"ITEM: BOX BOUNDS {flags}\n{bounds}ITEM: ATOMS {names}\n"
        f"{rows(*columns, frame=k)}"
        for k in range(FRAMES)
    )


def xyz(*, head="", properties="species:S:1:pos:R:3:velo:R:3", between="", species=("Gl",) * N):
    """An extended XYZ file of all frames; {k} in its head is the index of a frame."""
    lattice = f'Lattice="{SIDE} 0 0 0 {SIDE} 0 0 0 {SIDE}"'
    return between.join(
        f"{N}\n{lattice} Properties={properties} {head.format(k=k)}\n{rows(species, frame=k)}"
        for k in range(FRAMES)
    )


def gsd(*, velocities=range(FRAMES), types=0, diameter=1.0):
    """Write a GSD file whose frames have velocities in some frames only."""

    def write(path):
        with gsd_hoomd.open(str(path), "x") as file:
            for k in range(FRAMES):
                frame = gsd_hoomd.Frame()
                frame.configuration.box = [SIDE] * 3 + [0] * 3
                frame.configuration.step = 1000 * k
                frame.particles.N = N
                frame.particles.types = ["A", "B"]
                frame.particles.typeid = np.arange(N) * types % 2
                frame.particles.diameter = diameter * np.ones(N)
                frame.particles.position = POSITION[k] - SIDE / 2
                if k in velocities:
                    frame.particles.velocity = VELOCITY[k]
                file.append(frame)

    return write


FRAME = """ITEM: TIMESTEP
0
ITEM: NUMBER OF ATOMS
2
ITEM: BOX BOUNDS pp pp pp
-1 3
0 4
0 4
ITEM: ATOMS id """

DUMP = f"""{FRAME}x y z vx vy vz
1 0 0 0 1 2 3
2 0 0 0 1 2 3
{FRAME.replace("0", "100", 1)}type xu yu zu vx vy vz omegax omegay omegaz
2 1 0.5 1 -1 4 5 6 0 0 2
1 1 2.5 1 1 1 2 3 0 0 1
"""

DATA = """LAMMPS data file via write_data, version 2 Aug 2023

2 atoms
1 atom types

-1 3 xlo xhi
0 4 ylo yhi
0 4 zlo zhi

Atoms # sphere

2 1 0.002 2500 0.5 1 3 0 0 -1
1 1 0.002 2500 2.5 1 1 0 0 0

Velocities

1 1 2 3 0 0 1
2 4 5 6 0 0 2
"""


TWO = [1, 2] * (N // 2)
PARTICLES = {
    # 6: velocities of this very frame
    "velocities in the first frame only": ("a.gsd", gsd(velocities=(0,)), "no velocities in this"),
    "no velocities": ("a.gsd", gsd(velocities=()), r"no velocities.*dynamic=\['property'"),
    "velocities in every frame": ("a.gsd", gsd(), None),
    # 7: units and times
    "units si": ("a.dump", dump().replace("ITEM", "ITEM: UNITS\nsi\nITEM", 1), None),
    "units lj": ("a.dump", dump().replace("ITEM", "ITEM: UNITS\nlj\nITEM", 1), "'lj', without a"),
    "time of each frame": ("a.dump", dump(head="ITEM: TIME\n0.5\n"), None),
    "another unit of XYZ": ("a.xyz", xyz(head="length_unit=mm"), "gives length_unit: write units="),
    # 8: equal spheres
    "two types": ("a.dump", dump(columns=(IDS, TWO)), "differ in type"),
    "two radii": ("a.dump", dump(columns=(IDS, TWO)).replace("type", "radius"), "differ in radius"),
    "two masses": ("a.xyz", xyz(species=TWO).replace("species:S", "mass:R"), "differ in mass"),
    "equal sizes in float32": ("a.gsd", gsd(diameter=0.1), None),
    # 9: extended XYZ of others
    "walls": ("a.xyz", xyz(head='pbc="F F F"'), None),
    "walls in words": ("a.xyz", xyz(head='pbc="false false True"'), "in some directions only"),
    "walls elsewhere": ("a.xyz", xyz(head='pbc="F F F" Origin="1 0 0"'), "are outside of its box"),
    "ASE's momenta": ("a.xyz", xyz(properties="species:S:1:pos:R:3:momenta:R:3"), "not momenta"),
    "velocity in capitals": (
        "a.xyz",
        xyz(properties="species:S:1:pos:R:3:Velocity:R:3"),
        None,
    ),
    "another suffix": ("a.extxyz", xyz(), None),
    "quoted properties": ("a.xyz", xyz(properties='"species:S:1:pos:R:3:velo:R:3"'), None),
    "compressed XYZ": ("a.xyz.gz", xyz(), None),
    "no box": ("a.xyz", xyz().replace("Lattice", "Box"), "it has no Lattice"),
    # 10: whole frames
    "blank line between frames": ("a.xyz", xyz(between="\n"), None),
    "no end of the last line": ("a.xyz", xyz()[:-1], "ends within a line"),
    "cut within the last number": ("a.dump", dump()[:-3], "ends within a line"),
    "cut within the rows": (
        "a.dump",
        dump().rsplit("\n", 3)[0] + "\n",
        "expected 30 rows of 8",
    ),
    "cut within the head": ("a.dump", dump() + "ITEM: TIMESTEP\n7\n", "is incomplete"),
    "text after a frame": ("a.xyz", xyz() + "end\n", "must be a number of particles, got 'end'"),
    # 23 and siblings
    "an id twice": ("a.dump", dump(columns=([1, 1, *IDS[2:]], ONES)), "has an id twice"),
    "a box around the particles": ("a.dump", dump(flags="ss ss ss"), "boundary s or m"),
    "walls of a dump": ("a.dump", dump(flags="ff ff ff"), None),
    "a curve": ("a.csv", "t,T\n1,2\n", "no file of particles: give a LAMMPS dump"),
    "no GSD": ("a.gsd", "no GSD", ""),
    **{name: (name, lambda path: None, "no such file") for name in ("no.gsd", "no.xyz", "no.dump")},
}
ATOMIC = DATA.replace("# sphere", "# atomic").replace(" 0.002 2500", "")
ATOMIC = ATOMIC.replace("3 0 0 1\n2 4 5 6 0 0 2", "3\n2 4 5 6")  # no spins
CHANGES = [
    (DUMP, "xu yu zu", "a b c", "it has no columns xu yu zu or x y z or"),
    (DUMP, "vx vy vz", "fx fy fz", "it has no velocities in this frame"),
    (DUMP, "BOUNDS", "BOUNDS xy xz yz", "its box is slanted"),
    (DUMP, "2.5 1 1 1", "nan 1 1 1", "positions, velocities or sides are not finite"),
    (DUMP, "2.5 1 1 1", "x 1 1 1", "could not convert string"),
    (ATOMIC, "version 2 Aug 2023", "units = lj", "'lj', without a size"),
    (DATA, "# sphere", "", "must name its style, atomic or sphere"),
    (DATA, "Velocities", "Bodies", "it has no section Velocities"),
    (DATA, "2 4 5 6 0 0 2", "3 4 5 6 0 0 2", "have different ids"),
    (DATA, "-1 3 xlo xhi", "3 -1 xlo xhi", "which must be positive"),
    (DATA, "6 0 0 2\n", "6 0 0 2", "ends within a line"),
]
for text, old, new, words in CHANGES:
    PARTICLES[words] = ("state.lammps", new.join(text.rsplit(old, 1)), words)


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


@pytest.mark.parametrize("text", [DUMP, DATA], ids=["dump", "data"])
def test_files_of_lammps(tmp_path, text):
    path = write(tmp_path / "state.lammps", text)
    read = jaxgran.read_particles(path)
    np.testing.assert_array_equal(read.position, [[[3.5, 1, 1], [1.5, 1, 3]]])
    np.testing.assert_array_equal(read.velocity, [[[1, 2, 3], [4, 5, 6]]])
    np.testing.assert_array_equal(read.angular_velocity, [[[0, 0, 1], [0, 0, 2]]])
    assert read.box_side == 4.0
    disks = jaxgran.read_particles(path, dimension=2)
    assert disks.position.shape == (1, 2, 2)
    np.testing.assert_array_equal(disks.angular_velocity, [[[1], [2]]])


@pytest.mark.parametrize(
    "units, length, speed", [("cgs", 1e-2, 1e-2), ("micro", 1e-6, 1.0), ("metal", 1e-10, 100.0)]
)
def test_units_of_lammps(tmp_path, units, length, speed):
    text = dump().replace("ITEM", f"ITEM: UNITS\n{units}\nITEM", 1)
    read = jaxgran.read_particles(write(tmp_path / "a.dump", text))
    np.testing.assert_allclose(read.position[0], length * POSITION[-1], rtol=1e-14)
    np.testing.assert_allclose(read.velocity[0], speed * VELOCITY[-1], rtol=1e-14)


def test_densities_of_lammps_in_metal_units_are_in_grams_per_cubic_centimetre():
    names = ("x", "y", "z", "vx", "vy", "vz")
    columns = dict(zip(names, np.hstack([POSITION[0], VELOCITY[0]]).T, strict=True))
    columns["density"] = np.full(N, 2.5)
    box = {"low": np.zeros(3), "sides": np.full(3, SIDE), "periodic": (True,) * 3}
    frame = frame_of_columns(columns, **box, dimension=3, units="metal", time=None, step=None)
    np.testing.assert_allclose(frame.equal["density"], 2500, rtol=1e-14)


def test_scaled_positions_are_scaled_whatever_other_columns_there_are(tmp_path):
    text = dump(names="id x xs ys zs vx vy vz", columns=(IDS, [7.0] * N))
    read = jaxgran.read_particles(write(tmp_path / "a.dump", text), dimension=3)
    np.testing.assert_allclose(read.position[0] / SIDE, POSITION[-1] % 1.0, rtol=1e-12)


def test_disks_in_space_are_asked_about(tmp_path):
    flat = dump(names="id z vz x y a vx vy b", columns=(IDS, [0] * N, [0] * N))
    path = write(tmp_path / "a.dump", flat)
    with pytest.raises(ValueError, match="plane: give dimension=2"):
        jaxgran.read_particles(path)
    assert jaxgran.read_particles(path, dimension=2).velocity.shape == (1, N, 2)


def tracks(*, wrong=0.0, gaps=0.0, noise=0.0, wrapped=False, swaps=(), d=3):
    """Columns of 400 particles in free flight whose speeds fall, their T, and the side of the box.

    The thermal displacement between the first two of 15 frames is .15 of the mean distance.

    Args:
        wrong: share of the identities that are exchanged with a neighbour before each frame.
        gaps: share of the positions that are missing.
        noise: standard error of a position, in units of the displacement.
        wrapped: whether positions are wrapped into the box.
        swaps: frames before which two particles anywhere exchange their identities.
        d: dimension.
    """
    n, frames, step = 400, 15, 0.15
    rng = np.random.default_rng(1)
    side = 0.003 * (n * np.pi / 6 / 0.04) ** (1 / d)
    velocity = rng.normal(size=(n, d))
    velocity -= velocity.mean(axis=0)
    dt = step * side / n ** (1 / d) / 0.1
    clock = np.cumsum(0.1 / (1 + 0.05 * np.arange(-0.5, frames)))[:frames] * dt
    position = side * rng.random((n, d)) + velocity * clock[:, None, None]
    T = np.mean(velocity**2) * (np.diff(clock) / dt) ** 2
    position += noise * step * side / n ** (1 / d) * rng.normal(size=position.shape)
    ids, rows = np.arange(n), []
    for k, frame in enumerate(position):
        distance = np.linalg.norm(frame[:, None] - frame, axis=2) + 10 * side * np.eye(n)
        for i in rng.choice(n, round(wrong * n / 2), replace=False) if k else ():
            j = np.argmin(distance[i])
            ids[i], ids[j] = ids[j], ids[i]
        if k in swaps:
            ids[[0, n // 2]] = ids[[n // 2, 0]]
        frame = frame % side if wrapped else frame
        there = np.flatnonzero(rng.random(n) >= gaps)
        rows.append([ids[there], np.full(there.size, k * dt), *frame[there].T])
    return np.concatenate(rows, axis=1), T, side


OUT = "displacements left out because of wrong identities"
RATE = "velocities change .* times as fast as impacts"
FREE = {"N": 400}
GAS = FREE | {"eta": 0.04, "diameter": 0.003}
TRACKS = {
    "clean": ({}, FREE, []),
    "clean, of a gas whose impacts the tracks do not show": ({}, GAS, [RATE]),
    "gaps, tracks that begin and end": ({"gaps": 0.2}, FREE, []),
    "5 % wrong links": ({"wrong": 0.05}, FREE, [OUT]),
    "5 % wrong links and gaps": ({"wrong": 0.05, "gaps": 0.1}, FREE, [OUT]),
    "two swapped identities": ({"swaps": (7,)}, FREE, [OUT]),
    "wrapped, side given": ({"wrapped": True}, FREE | {"box_side": None}, []),
    "unknown error of positions": ({"noise": 0.2}, FREE, ["localisation_error not given"]),
    "known error of positions": ({"noise": 0.2}, FREE | {"localisation_error": 0.2}, []),
}


FLAT = "clean", "two swapped identities", "unknown error of positions"


@pytest.mark.parametrize("name, d", [(x, d) for x in TRACKS for d in (2, 3) if d == 3 or x in FLAT])
def test_tracks(read, name, d):
    faults, header, words = TRACKS[name]
    columns, T, side = tracks(**faults, d=d)
    header = header | {"dimension": d}
    if "box_side" in header:
        header["box_side"] = side
    if "localisation_error" in header:
        header["localisation_error"] *= 0.15 * side / 400 ** (1 / d)
    head = "".join(f"# {key}: {value}\n" for key, value in header.items())
    names = "id,t,x,y,z"[: 4 + 2 * d]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        curve, found = read(f"{head}{names}\n", *columns)
    assert len(told) == len(words)
    for word, warning in zip(words, told, strict=True):
        assert re.search(word, str(warning.message))
    assert (OUT in found["T_from"]) >= (OUT in words)
    # Of the same particles: of chance is left that of the third which gaps take, 2.5 % (3 % in a
    # plane), thrice and more.
    np.testing.assert_allclose(curve.temperature, T, rtol=0.08 if d == 3 else 0.11)
    assert np.mean(np.asarray(curve.temperature) / T) == pytest.approx(1.0, abs=0.03)


def test_wrapped_tracks_are_refused(read):
    columns, _, side = tracks(wrapped=True, swaps=(7,))
    with pytest.raises(ValueError, match="the box.*'# box_side: ...'") as error:
        read("id,t,x,y,z\n", *columns)
    suggested = float(re.search(r"side, ([\d.]+) m", str(error.value))[1])
    assert suggested == pytest.approx(side, rel=0.02)


STEP = {"timestep": "1e-3"}
TRAJECTORIES = {
    "times in a dump": ("a.dump", dump(head="ITEM: TIME\n{k}\n"), {}, None),
    "steps in a dump": ("a.lammpstrj.gz", dump(), STEP, None),
    "steps without their length": ("a.dump", dump(), {}, r"frame 0: it has no time.*timestep"),
    "XYZ without times": ("a.xyz", xyz(), {"frame_rate": "1"}, None),
    "GSD": ("a.gsd", gsd(), STEP, None),
    "GSD, no velocities": ("a.gsd", gsd(velocities=(0, 1, 3)), STEP, "frame 2: .*no velocities"),
    "another N": ("a.dump", dump(), STEP | {"N": "31"}, "N is 30, but 31 in the header"),
    "another size": ("a.gsd", gsd(diameter=2.0), STEP | {"diameter": "3"}, "diameter is 2, but 3"),
    "a size of 1 m": (
        "a.dump",
        dump(names="id diameter x y z vx vy vz"),
        STEP | {"diameter": "3"},
        "diameter is 1, but 3",
    ),
}


@pytest.mark.parametrize("name, content, header, words", TRAJECTORIES.values(), ids=TRAJECTORIES)
def test_trajectories(tmp_path, name, content, header, words):
    path = write(tmp_path / name, content)
    if words is not None:
        with pytest.raises(ValueError, match=f"{name}: .*{words}"):
            jaxgran.read_curve(path, header=header)
        return
    curve, found = jaxgran.read_curve(path, header=header)
    still = VELOCITY - VELOCITY.mean(axis=1, keepdims=True)
    T = np.mean(still**2, axis=(1, 2))
    np.testing.assert_allclose(curve.temperature, T, rtol=1e-6)
    np.testing.assert_allclose(curve.times, range(FRAMES))
    # Of 90 Gaussian numbers, sqrt(2/90) of T, known within 18 %: three of it.
    np.testing.assert_allclose(curve.temperature_error, (2 / (3 * N)) ** 0.5 * T, rtol=0.54)
    assert found["N"] == str(N) and not found.keys() & header.keys()
    assert float(found["T0"]) == pytest.approx(T[0], rel=1e-6)


def test_spins_and_sizes_of_a_trajectory(tmp_path):
    spin = RNG.normal(size=(N, 3))
    columns = [IDS, [1e-3] * N, [2e-6] * N, *spin.T.tolist()]
    text = dump(names="id radius mass omegax omegay omegaz x y z vx vy vz", columns=columns)
    path = write(tmp_path / "a.dump", text)
    curve, header = jaxgran.read_curve(path, header=STEP)
    # T_rot = I <w^2>/(3 m) with I = 2/5 m r^2.
    expected = 0.4 * 1e-6 * np.mean(spin**2)
    np.testing.assert_allclose(curve.rotational_temperature, expected, rtol=1e-12)
    numbers = {key: float(header[key]) for key in ("diameter", "density", "eta")}
    volume = np.pi / 6 * 0.002**3
    expected = {"diameter": 0.002, "density": 2e-6 / volume, "eta": N * volume / SIDE**3}
    assert numbers == pytest.approx(expected)


@pytest.mark.parametrize(
    "clock, scale, words",
    [
        ("10{k}", 1.0, "T is T0 .* at t = .* not at t = 0.*--free A t0"),
        ("{k}", 1 / 9, "times the header's T0"),
    ],
)
def test_trajectories_are_questioned(tmp_path, clock, scale, words):
    path = write(tmp_path / "a.dump", dump(head=f"ITEM: TIME\n{clock}\n"))
    still = VELOCITY[0] - VELOCITY[0].mean(axis=0)
    known = {"diameter": 1e-3, "density": 2500, "Y": 1e7, "nu": 0.3, "eta": 0.001}
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        jaxgran.read_curve(path, header=known | {"T0": scale * np.mean(still**2)})
    assert re.search(words, " ".join(str(warning.message) for warning in told))


@pytest.mark.parametrize("d", [2, 3])
def test_tracks_as_trackmate_exports_them(read, d):
    columns, T, _ = tracks(d=3)
    ids, t, x, y, z = columns[:5]
    z = z * (d == 3)
    spots = np.arange(len(ids))
    names = "LABEL,ID,TRACK_ID,POSITION_X,POSITION_Y,POSITION_Z,POSITION_T,FRAME"
    words = "Label,Spot ID,Track ID,X,Y,Z,T,Frame"
    head = f"{names}\n{words}\n{words}\n,,,(mm),(mm),(mm),(ms),\n"
    arrays = spots, spots, ids, 1e3 * x, 1e3 * y, 1e3 * z, 1e3 * t, 0 * t
    curve, found = read(head, *arrays)
    np.testing.assert_allclose(np.mean(curve.temperature / T), 1.0, atol=0.1)
    assert ("two of three coordinates" in found["T_from"]) == (d == 2)


@pytest.mark.parametrize("nothing", ["", "None", "nan"])
def test_positions_without_a_track_are_left_out(tmp_path, nothing):
    columns, T, _ = tracks(d=3)
    ids, t, x, y, z = columns[:5]
    rows = [",".join(map(repr, map(float, row))) for row in zip(ids, t, x, y, z, strict=True)]
    rows += [f"{nothing},{float(t[k])!r},0.001,0.002,0.003" for k in range(0, len(ids), 9)]
    head = "TRACK_ID,POSITION_T,POSITION_X,POSITION_Y,POSITION_Z"
    path = write(tmp_path / "spots.csv", "\n".join([head, *rows]) + "\n")
    number = len(rows) - len(ids)
    with pytest.warns(UserWarning, match=f"{number} positions .*no track"):
        curve = jaxgran.read_curve(path)[0]
    np.testing.assert_allclose(np.mean(curve.temperature / T), 1.0, atol=0.1)
