"""Trajectories that grow while a run goes on."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.data.trajectory import Sphere, Trajectory
from tests.beads import glass_beads

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


def write_frames(path, numbers, *, resumed=False, **options):
    trajectory = Trajectory(path, 1, resumed=resumed)
    for k in numbers:
        trajectory.write(k, 0.1 * k, particles(seed=k, **options), SPHERE)


@SUFFIXES
@pytest.mark.parametrize("dimension, spins", [(2, None), (3, None), (2, 1), (3, 3)])
def test_round_trip(tmp_path, suffix, digits, dimension, spins):
    path, options = tmp_path / f"run.{suffix}", {"dimension": dimension, "spins": spins}
    write_frames(path, range(3), **options)
    for k, seed in ((0, 0), (1, 1), (-1, 2)):
        read, frame = jaxgran.read_particles(path, frame=k), particles(seed=seed, **options)
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
    write_frames(path, range(3))
    with pytest.raises(ValueError, match="exists: name another file"):
        Trajectory(path, 1, resumed=False)
    # The checkpoint was written after the second frame: the third is there already.
    write_frames(path, range(2, 5), resumed=True)
    for k in range(5):
        read = jaxgran.read_particles(path, frame=k)
        expected = particles(seed=k).velocity
        np.testing.assert_allclose(read.velocity, expected, atol=4 * digits, rtol=0)
    with pytest.raises(ValueError, match="5 frames, .* frame 5"):
        jaxgran.read_particles(path, frame=5)
    with pytest.raises(ValueError, match="5 frames, .* frame 7"):
        write_frames(path, [7], resumed=True)


def test_half_a_frame_is_cut_off(tmp_path):
    path = tmp_path / "run.xyz"
    write_frames(path, range(2))
    whole = path.read_bytes()
    path.write_bytes(whole[:-30])
    with pytest.raises(ValueError, match="ends within a line"):
        jaxgran.read_particles(path)
    read = jaxgran.read_particles(path, frame=-2)
    np.testing.assert_array_equal(read.velocity, particles().velocity)
    write_frames(path, [1], resumed=True)
    assert path.read_bytes() == whole


@pytest.mark.slow
def test_a_run_writes_its_trajectory(tmp_path, monkeypatch):
    gas, path = glass_beads(0.15, dimension=2), tmp_path / "run.xyz"
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
        monkeypatch.setattr("tqdm.tqdm.update", lambda *args: pytest.fail("it began to run"))
        jaxgran.cool(gas, t, **options, trajectory=path)
