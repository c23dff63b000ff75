"""Tracks of particles, and T(t) from them."""

import numpy as np
import pytest

import jaxgran
from tests.beads import glass_beads

HEADER = {"eta": "0.05", "diameter": "0.002", "density": "2500", "Y": "5e7", "nu": "0.22"}
HEADER |= {"T0": "0.01"}


def write(path, times, positions, header=HEADER):
    """A file of tracks, frame by frame, of positions (frames, particles, coordinates)."""
    lines = [f"# {key}: {value}" for key, value in header.items()]
    lines.append(",".join(["id", "t", *"xyz"[: positions.shape[2]]]))
    for t, frame in zip(times, positions, strict=True):
        lines += [
            ",".join(map(repr, [i + 1, float(t), *map(float, x)])) for i, x in enumerate(frame)
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


def free_flight(n, *, dimensions=3, drift=(0.3, -0.2, 0.5), seed=0):
    """Frames of particles that keep a Maxwellian velocity of variance .01 and share a drift."""
    rng = np.random.default_rng(seed)
    velocity = 0.1 * rng.standard_normal((n, 3))
    times = np.linspace(0.0, 0.01, 6)
    moved = (velocity + np.array(drift)) * times[:, None, None]
    return times, (rng.uniform(size=(n, 3)) + moved)[:, :, :dimensions], velocity


BARE = {"N": "200"}


@pytest.mark.parametrize("dimensions, unit", [(3, 1.0), (2, 1e3)])
def test_free_flight_gives_t_without_drift(tmp_path, dimensions, unit):
    times, positions, velocity = free_flight(200, dimensions=dimensions)
    units = {} if unit == 1 else {"length_unit": "mm", "time_unit": "ms"}
    path = write(tmp_path / "tracks.csv", unit * times, unit * positions, BARE | units)
    curve, header = jaxgran.read_curve(path)
    np.testing.assert_allclose(curve.times, (times[1:] + times[:-1]) / 2, rtol=1e-12)
    # Of all 200, whose momentum is 0: <v^2>/d is the variance with N below, not N - 1.
    expected = velocity[:, :dimensions].var(axis=0).mean()
    np.testing.assert_allclose(curve.temperature, expected, rtol=1e-9)  # of differences
    # Of a Gaussian sample: sqrt(2/(d n)) T, known within 10 % from 200 particles.
    error = expected * (2 / (dimensions * 200)) ** 0.5
    np.testing.assert_allclose(curve.temperature_error, error, rtol=0.15)
    assert "drift of 200 of 200 particles removed" in header["T_from"]
    assert ("two of three coordinates" in header["T_from"]) == (dimensions == 2)


def test_the_jackknife_leaves_one_particle_out(tmp_path):
    times, positions, velocity = free_flight(7)
    path = write(tmp_path / "tracks.csv", times, positions, {"N": "1000"})
    curve, _ = jaxgran.read_curve(path)
    others = [np.delete(velocity, i, axis=0).var(axis=0, ddof=1).mean() for i in range(7)]
    expected = np.sqrt(6 / 7 * np.sum((others - np.mean(others)) ** 2)) * 999 / 1000
    np.testing.assert_allclose(curve.temperature_error, expected, rtol=1e-9)


def test_errors_of_positions_are_removed(tmp_path):
    times, positions, velocity = free_flight(4000)
    error = 1e-4  # m; over .002 s this adds half of T
    noisy = positions + error * np.random.default_rng(1).standard_normal(positions.shape)
    path = write(tmp_path / "t.csv", times, noisy, {"N": "4000", "localisation_error": str(error)})
    with pytest.warns(UserWarning, match="localisation_error adds up to 3"):
        curve, header = jaxgran.read_curve(path)
    assert "localisation_error removed, at most 3" in header["T_from"]
    # 12000 components, of which a third is noise: sqrt(2/12000) (1 + 1/2) = 2 %, three of it.
    np.testing.assert_allclose(curve.temperature, velocity.var(axis=0).mean(), rtol=0.06)


def test_impacts_between_frames_are_corrected(tmp_path):
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
    path = write(tmp_path / "tracks.csv", times, np.array(positions), HEADER | {"N": str(n)})
    curve, header = jaxgran.read_curve(path)
    # Uncorrected T is 17 % too small; 9000 components: sqrt(2/9000) = 1.5 %, three of it.
    np.testing.assert_allclose(curve.temperature, 0.01, rtol=0.045)
    assert "corrected, at most 17 % of T" in header["T_from"]


CASES = [
    (lambda rows: rows + [rows[-1]], r"line 66: particle 10 at t = .* given again, after line 65"),
    (lambda rows: [r for r in rows if r.startswith("4,")], r"of 1 particle\(s\) in 6 frames"),
    (lambda rows: rows[:30], r"in 3 frames; at least 3 particles in 4 frames are needed"),
    (lambda rows: [*rows[:-1], "x" + rows[-1]], r"line 65: expected 5 finite numbers"),
    (lambda rows: [*rows[:-1], "1.5" + rows[-1][2:]], r"line 65: id is 1.5; number the particles"),
    ({"N": "5"}, "N = 5, but 10 particles are tracked"),
    ({"dimension": "2"}, "dimension 2 has no tracks with 3 coordinates"),
    ({"localisation_error": "-1"}, "localisation_error: must be >= 0"),
    ({"localisation_error": "1"}, "between frames 0 and 1 particles move no further than"),
]


@pytest.mark.parametrize("change, message", CASES)
def test_bad_tracks_are_refused(tmp_path, change, message):
    times, positions, _ = free_flight(10)
    if isinstance(change, dict):
        path = write(tmp_path / "tracks.csv", times, positions, change)
    else:
        keys = {"a": "1", "b": "2", "c": "3", "d": ""}
        path = write(tmp_path / "tracks.csv", times, positions, keys)
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines[:5], *change(lines[5:])]) + "\n")
    with pytest.raises(ValueError, match=message):
        jaxgran.read_curve(path)


def test_trackpy_names_and_further_columns(tmp_path):
    times, positions, _ = free_flight(10)
    first, _ = jaxgran.read_curve(write(tmp_path / "a.csv", times, positions, BARE))
    lines = [",y,x,z,mass,ecc,frame,particle"]
    for k, frame in reversed([*enumerate(positions)]):  # rows may stand in any order
        lines += [
            f"{i},{y!r},{x!r},{z!r},12.5,nan,{k},{i}" for i, (x, y, z) in enumerate(frame.tolist())
        ]
    path = tmp_path / "trackpy.csv"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="add '# frame_rate: ...', in frames per second"):
        jaxgran.read_curve(path)
    rate = repr(1 / float(times[1]))
    path.write_text(f"# N: 200\n# frame_rate: {rate}\n" + "\n".join(lines) + "\n")
    second, header = jaxgran.read_curve(path)
    np.testing.assert_allclose(second.temperature, first.temperature, rtol=1e-12)
    np.testing.assert_allclose(second.times, first.times, rtol=1e-12)
    assert "frame_rate" not in header
