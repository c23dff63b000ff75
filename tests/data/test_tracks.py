"""Tracks of particles, and T(t) from them."""

import gzip

import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads


def text_of(times, positions, **header):
    """A file of tracks, frame by frame, of positions (frames, particles, coordinates)."""
    frames, n, d = positions.shape
    ids = np.tile(np.arange(n) + 1, frames)
    rows = np.column_stack([ids, np.repeat(times, n), positions.reshape(-1, d)])
    lines = [f"# {key}: {value}" for key, value in header.items()]
    lines += ["id,t,x,y,z"[: 4 + 2 * d], *(",".join(f"{x:.17g}" for x in row) for row in rows)]
    return "\n".join(lines) + "\n"


def free_flight(n, *, dimensions=3, drift=(0.3, -0.2, 0.5), seed=0):
    """Frames of particles that keep a Maxwellian velocity of variance .01 and share a drift."""
    rng = np.random.default_rng(seed)
    velocity = 0.1 * rng.standard_normal((n, 3))
    times = np.linspace(0.0, 0.01, 6)
    moved = (velocity + np.array(drift)) * times[:, None, None]
    return times, (rng.uniform(size=(n, 3)) + moved)[:, :, :dimensions], velocity


@pytest.mark.parametrize("dimensions, unit", [(3, 1.0), (2, 1e3)])
def test_free_flight_gives_t_without_drift(read, dimensions, unit):
    times, positions, velocity = free_flight(200, dimensions=dimensions)
    units = {} if unit == 1 else {"length_unit": "mm", "time_unit": "ms"}
    curve, header = read(text_of(unit * times, unit * positions, N=200, **units))
    np.testing.assert_allclose(curve.times, (times[1:] + times[:-1]) / 2, rtol=1e-12)
    # Of all 200, whose momentum is 0: <v^2>/d is the variance with N below, not N - 1.
    expected = velocity[:, :dimensions].var(axis=0).mean()
    np.testing.assert_allclose(curve.temperature, expected, rtol=1e-9)  # of differences
    # Of a Gaussian sample: sqrt(2/(d n)) T, known within 10 % from 200 particles.
    error = expected * (2 / (dimensions * 200)) ** 0.5
    np.testing.assert_allclose(curve.temperature_error, error, rtol=0.15)
    assert "drift of 200 of 200 particles removed" in header["T_from"]
    assert ("two of three coordinates" in header["T_from"]) == (dimensions == 2)


def test_the_jackknife_leaves_one_particle_out(read):
    times, positions, velocity = free_flight(7)
    curve, _ = read(text_of(times, positions, N=1000))
    others = [np.delete(velocity, i, axis=0).var(axis=0, ddof=1).mean() for i in range(7)]
    expected = np.sqrt(6 / 7 * np.sum((others - np.mean(others)) ** 2)) * 999 / 1000
    np.testing.assert_allclose(curve.temperature_error, expected, rtol=1e-9)


def test_errors_of_positions_are_removed(read):
    times, positions, velocity = free_flight(4000)
    error = 1e-4  # m; over .002 s this adds half of T
    noisy = positions + error * np.random.default_rng(1).standard_normal(positions.shape)
    with pytest.warns(UserWarning, match="localisation_error adds up to 3"):
        curve, header = read(text_of(times, noisy, N=4000, localisation_error=error))
    assert "localisation_error removed, at most 3" in header["T_from"]
    # 12000 components, of which a third is noise: sqrt(2/12000) (1 + 1/2) = 2 %, three of it.
    np.testing.assert_allclose(curve.temperature, velocity.var(axis=0).mean(), rtol=0.06)


def test_impacts_between_frames_are_corrected(read):
    """Velocities that lose their memory at Enskog's rate (an Ornstein-Uhlenbeck process)."""
    gas = glass_beads(0.0)
    rate = 2 / 3 * float(gas.collision_frequency)
    n, fine, frames = 3000, 40, 6
    dt = 0.6 / rate / fine  # frames .6 relaxation times apart, each in 40 steps
    rng, keep = np.random.default_rng(0), np.exp(-rate * dt)
    v, x, positions = 0.1 * rng.standard_normal((n, 3)), np.zeros((n, 3)), []
    for step in range(fine * frames + 1):
        if step % fine == 0:
            positions.append(x)
        new = keep * v + 0.1 * np.sqrt(1 - keep**2) * rng.standard_normal((n, 3))
        x, v = x + dt * (v + new) / 2, new
    times = np.arange(frames + 1) * fine * dt
    keys = {"eta": 0.05, "diameter": 0.002, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}
    curve, header = read(text_of(times, np.array(positions), N=n, **keys))
    # Uncorrected T is 17 % too small; 9000 components: sqrt(2/9000) = 1.5 %, three of it.
    np.testing.assert_allclose(curve.temperature, 0.01, rtol=0.045)
    assert "corrected, at most 17 % of T" in header["T_from"]
    # The rate of impacts depends on the diameter and on eta, not on the law.
    keys = {"eta": 0.05, "diameter": 0.002, "eps": 0.9}
    same, of_eps = read(text_of(times, np.array(positions), N=n, **keys))
    np.testing.assert_array_equal(same.temperature, curve.temperature)
    assert of_eps["T_from"] == header["T_from"]


def test_two_columns_of_one_name_are_refused(read):
    with pytest.raises(ValueError, match="2 columns are x: keep one"):
        read("id,t,x (px),y (px),x (mm),y (mm)\n1,0,1,1,.1,.1\n")


CASES = [
    (lambda rows: rows + [rows[-1]], r"line 66: particle 10 at t = .* given again, after line 65"),
    (lambda rows: [r for r in rows if r.startswith("4,")], r"of 1 particle\(s\) in 6 frames"),
    (lambda rows: rows[:30], r"in 3 frames; at least 3 particles in 4 frames are needed"),
    (lambda rows: [*rows[:-1], "x" + rows[-1]], r"line 65: expected 5 finite numbers"),
    (lambda rows: [*rows[:-1], "1.5" + rows[-1][2:]], r"line 65: id is 1.5; number the particles"),
    ({"box_side": "-1"}, "box_side: must be a positive number, got '-1'"),
    ({"N": "5"}, "N = 5, but 10 particles are tracked"),
    ({"dimension": "2"}, "dimension 2 has no tracks with 3 coordinates"),
    ({"localisation_error": "-1"}, "localisation_error: must be >= 0"),
    ({"localisation_error": "1"}, "between frames 0 and 1 particles move no further than"),
]


@pytest.mark.parametrize("change, message", CASES)
def test_bad_tracks_are_refused(read, change, message):
    times, positions, _ = free_flight(10)
    if isinstance(change, dict):
        text = text_of(times, positions, **change)
    else:
        lines = text_of(times, positions, a=1, b=2, c=3, d="").splitlines()
        text = "\n".join([*lines[:5], *change(lines[5:])]) + "\n"
    with pytest.raises(ValueError, match=message):
        read(text)


def test_trackpy_names_and_further_columns(read):
    times, positions, _ = free_flight(10)
    first, _ = read(text_of(times, positions, N=200))
    frame, i = (index.ravel() for index in np.indices((6, 10)))
    x, y, z = positions.reshape(-1, 3).T
    columns = i, y, x, z, np.full(60, 12.5), np.full(60, np.nan), frame, i
    columns = [column[::-1] for column in columns]  # rows may stand in any order
    names, rate = ",y,x,z,mass,ecc,frame,particle\n", float(1 / times[1])
    with pytest.raises(ValueError, match="add '# frame_rate: ...'"):
        read(names, *columns)
    second, header = read(f"# N: 200\n# frame_rate: {rate}\n{names}", *columns)
    np.testing.assert_allclose(second.temperature, first.temperature, rtol=1e-12)
    np.testing.assert_allclose(second.times, first.times, rtol=1e-12)
    assert "frame_rate" not in header


def test_few_particles_of_a_compressed_file_are_all_kept(tmp_path):
    """The scatter of five displacements says too little on the longest of them."""
    times = 0.01 * np.arange(30)
    position = np.random.default_rng(0).normal(size=(5, 3)) * times[:, None, None]
    path = tmp_path / "t.csv.gz"
    path.write_bytes(gzip.compress(text_of(times, position).encode()))
    assert "wrong identities" not in jaxgran.read_curve(path)[1]["T_from"]
