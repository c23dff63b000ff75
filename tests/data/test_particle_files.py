"""Particles in files of other programs, and trajectories that grow while a run goes on."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.data.particles import Sphere, Trajectory

gsd_hoomd = pytest.importorskip("gsd.hoomd")

SUFFIXES = pytest.mark.parametrize("suffix, digits", [("gsd", 1e-6), ("xyz", 0.0)])
SPHERE = Sphere(diameter=0.002, mass=1e-5)


def particles(dimension=3, n=20, replicas=1, seed=0, spins=None):
    rng = np.random.default_rng(seed)
    shape = (replicas, n, dimension)
    spin = None if spins is None else jnp.asarray(rng.normal(size=(replicas, n, spins)))
    return jaxgran.Particles(
        jnp.asarray(0.05 * rng.random(shape)), jnp.asarray(rng.normal(size=shape)), 0.05, spin
    )


@SUFFIXES
@pytest.mark.parametrize("dimension, spins", [(2, None), (3, None), (2, 1), (3, 3)])
def test_round_trip(tmp_path, suffix, digits, dimension, spins):
    path = tmp_path / f"run.{suffix}"
    written = [particles(dimension, seed=seed, spins=spins) for seed in range(3)]
    trajectory = Trajectory(path, 1, resumed=False)
    for k, frame in enumerate(written):
        trajectory.write(k, 0.1 * k, frame, SPHERE)
    for k, frame in ((0, written[0]), (1, written[1]), (-1, written[2])):
        read = jaxgran.read_particles(path, frame=k)
        # float32 has 6e-8 of the half side, and of the fastest velocity.
        np.testing.assert_allclose(read.position, frame.position, atol=0.05 * digits, rtol=0)
        np.testing.assert_allclose(read.velocity, frame.velocity, atol=4 * digits, rtol=0)
        assert read.box_side == pytest.approx(0.05, rel=max(digits, 1e-15))
        if spins is None:
            assert read.angular_velocity is None
        else:
            spin = frame.angular_velocity
            np.testing.assert_allclose(read.angular_velocity, spin, atol=4 * digits, rtol=0)


def test_gsd_is_read_by_gsd(tmp_path):
    path, frame = tmp_path / "run.gsd", particles()
    Trajectory(path, 1, resumed=False).write(0, 0.25, frame, SPHERE)
    with gsd_hoomd.open(str(path)) as file:
        (found,) = file
    assert found.configuration.dimensions == 3 and found.particles.N == 20
    np.testing.assert_allclose(found.configuration.box, [0.05] * 3 + [0] * 3, rtol=1e-7)
    np.testing.assert_allclose(found.particles.position, frame.position[0] - 0.025, atol=1e-8)
    np.testing.assert_allclose(found.particles.diameter, 0.002, rtol=1e-7)
    np.testing.assert_allclose(found.particles.mass, 1e-5, rtol=1e-7)
    assert found.log["time"] == [0.25]


@SUFFIXES
def test_a_trajectory_goes_on_where_it_ended(tmp_path, suffix, digits):
    path = tmp_path / f"run.{suffix}"
    first = Trajectory(path, 1, resumed=False)
    for k in range(3):
        first.write(k, 0.1 * k, particles(seed=k), SPHERE)
    with pytest.raises(ValueError, match="exists: name another file"):
        Trajectory(path, 1, resumed=False)
    # The checkpoint was written after the second frame: the third is there already.
    resumed = Trajectory(path, 1, resumed=True)
    for k in range(2, 5):
        resumed.write(k, 0.1 * k, particles(seed=k), SPHERE)
    for k in range(5):
        read = jaxgran.read_particles(path, frame=k)
        expected = particles(seed=k).velocity
        np.testing.assert_allclose(read.velocity, expected, atol=4 * digits, rtol=0)
    with pytest.raises(ValueError, match="5 frames, there is no frame 5"):
        jaxgran.read_particles(path, frame=5)
    with pytest.raises(ValueError, match="has 5 frames, but the checkpoint continues with frame 7"):
        Trajectory(path, 1, resumed=True).write(7, 0.0, particles(), SPHERE)


def test_half_a_frame_is_cut_off(tmp_path):
    path = tmp_path / "run.xyz"
    trajectory = Trajectory(path, 1, resumed=False)
    for k in range(2):
        trajectory.write(k, 0.1 * k, particles(seed=k), SPHERE)
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    with pytest.raises(ValueError, match="it ends within a line"):
        jaxgran.read_particles(path)
    read = jaxgran.read_particles(path, frame=-2)
    np.testing.assert_array_equal(read.velocity, particles().velocity)
    resumed = Trajectory(path, 1, resumed=True)
    resumed.write(1, 0.1, particles(seed=1), SPHERE)
    assert path.read_bytes() == whole


def test_a_run_writes_its_trajectory(beads, tmp_path, monkeypatch):
    gas, path = beads(0.15, dimension=2), tmp_path / "run.xyz"
    t = gas.mean_free_time * jnp.array([0.5, 1.0, 1.5])
    model = jaxgran.HardSpheres(30, replicas=2)
    options = {"model": model, "progress": False}
    run = {"trajectory": path, "checkpoint": tmp_path / "run.npz", "save": "particles"}
    curve = jaxgran.cool(gas, t, **options, **run)
    for k, frame in enumerate([0, 1, -1]):
        for r in range(2):
            read = jaxgran.read_particles(tmp_path / f"run.{r}.xyz", frame=frame)
            np.testing.assert_array_equal(read.position[0], curve.saved.position[k, r])
            np.testing.assert_array_equal(read.velocity[0], curve.saved.velocity[k, r])
    lines = (tmp_path / "run.0.xyz").read_text().splitlines()
    assert lines[0] == "30" and f"Time={float(t[0]):.17g}"[:20] in lines[1]
    each = [jaxgran.read_particles(tmp_path / f"run.{r}.xyz") for r in range(2)]
    start = each[0]._replace(
        position=jnp.concatenate([read.position for read in each]),
        velocity=jnp.concatenate([read.velocity for read in each]),
    )
    onward = dataclasses.replace(model, start=start)
    cooler = gas.replace(temperature=curve.temperature[-1])
    jaxgran.cool(cooler, t[:1], model=onward, progress=False)
    # It has ended: its checkpoint goes on with nothing, and its files stay.
    jaxgran.cool(gas, t, **options, **run)
    assert (tmp_path / "run.0.xyz").read_text().splitlines() == lines
    with pytest.raises(ValueError, match=r"run.0.xyz exists"):  # before the equilibration
        monkeypatch.setattr("jaxgran.particles.run._equilibrate", None)
        jaxgran.cool(gas, t, **options, trajectory=path)


@pytest.mark.parametrize(
    "model, trajectory, message",
    [
        (jaxgran.DSMC(10), "run.gsd", "DSMC has no positions"),
        (jaxgran.HardSpheres(10), "run.dcd", r"ends in .gsd or .xyz, got 'run.dcd'"),
        (jaxgran.HardSpheres(10), 3, "must be a path, got 3"),
    ],
)
def test_bad_trajectories_are_refused(beads, tmp_path, monkeypatch, model, trajectory, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        jaxgran.cool(beads(), [0.1], model=model, trajectory=trajectory, progress=False)


DUMP = """ITEM: TIMESTEP
0
ITEM: NUMBER OF ATOMS
2
ITEM: BOX BOUNDS pp pp pp
-1 3
0 4
0 4
ITEM: ATOMS id x y z vx vy vz
1 0 0 0 1 2 3
2 0 0 0 1 2 3
ITEM: TIMESTEP
100
ITEM: NUMBER OF ATOMS
2
ITEM: BOX BOUNDS pp pp pp
-1 3
0 4
0 4
ITEM: ATOMS id type xu yu zu vx vy vz omegax omegay omegaz
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


@pytest.mark.parametrize("text", [DUMP, DATA], ids=["dump", "data"])
def test_files_of_lammps(tmp_path, text):
    path = tmp_path / "state.lammps"
    path.write_text(text)
    read = jaxgran.read_particles(path)
    np.testing.assert_array_equal(read.position, [[[3.5, 1, 1], [1.5, 1, 3]]])
    np.testing.assert_array_equal(read.velocity, [[[1, 2, 3], [4, 5, 6]]])
    np.testing.assert_array_equal(read.angular_velocity, [[[0, 0, 1], [0, 0, 2]]])
    assert read.box_side == 4.0
    disks = jaxgran.read_particles(path, dimension=2)
    assert disks.position.shape == (1, 2, 2)
    np.testing.assert_array_equal(disks.angular_velocity, [[[1], [2]]])


@pytest.mark.parametrize(
    "text, change, message",
    [
        (DUMP, ("xu yu zu", "a b c"), "it has no columns xu yu zu or x y z or"),
        (DUMP, ("vx vy vz omegax", "fx fy fz omegax"), "it has no velocities in this frame"),
        (DUMP, ("BOUNDS pp", "BOUNDS xy xz yz pp"), "its box is slanted"),
        (DUMP, ("2.5 1 1 1", "nan 1 1 1"), "positions, velocities or sides are not finite"),
        (DUMP, ("2.5 1 1 1", "x 1 1 1"), "could not convert string"),
        (DATA, ("# sphere", ""), "must name its style, atomic or sphere"),
        (DATA, ("Velocities", "Bodies"), "it has no section Velocities"),
        (DATA, ("2 4 5 6 0 0 2", "3 4 5 6 0 0 2"), "have different ids"),
        (DATA, ("-1 3 xlo xhi", "3 -1 xlo xhi"), "which must be positive"),
        ("t,T\n1,2\n", ("", ""), "no file of particles: give a LAMMPS dump"),
    ],
)
def test_bad_files_are_refused(tmp_path, text, change, message):
    path = tmp_path / "state.lammps"
    path.write_text(text[::-1].replace(change[0][::-1], change[1][::-1], 1)[::-1])
    with pytest.raises(ValueError, match=f"state.lammps: .*{message}"):
        jaxgran.read_particles(path)


def test_files_that_are_not_there(tmp_path):
    for name in ("none.gsd", "none.xyz", "none.dump"):
        with pytest.raises(ValueError, match=f"{name}: no such file"):
            jaxgran.read_particles(tmp_path / name)
    (tmp_path / "text.gsd").write_text("no GSD")
    with pytest.raises(ValueError, match="text.gsd: "):
        jaxgran.read_particles(tmp_path / "text.gsd")
    with pytest.raises(ValueError, match="dimension must be 2 or 3"):
        jaxgran.read_particles(tmp_path / "text.gsd", dimension=4)
