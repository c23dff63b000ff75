"""Tracks that cannot show impacts, lines through flights, and errors of the speeds of impacts."""

import dataclasses

import numpy as np
import pytest

import jaxgran
from jaxgran.data.flights import fit_lines
from jaxgran.data.motion import Motion, error_by_second_differences
from jaxgran.data.track_impacts import impacts_of_tracks
from tests.beads import glass_beads

HEADER = {"eta": 0.03, "diameter": 2e-3, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}
PLAIN = "\n".join(
    f"{i},{k / 500},{0.01 * i + 1e-4 * k},0.01,0.02" for k in range(20) for i in (1, 2)
)

ONCE = "\n".join(f"{k},{k / 500},0.01,0.01,0.02" for k in range(20))


@pytest.mark.parametrize(
    "text, header, message",
    [
        (f"id,t,x,y,z\n{PLAIN}\n", {}, "2 coordinates .*dimension 3"),
        ("t,T\n1,2\n", {}, "tracks of particles have id,t,x,y"),
        (f"id,t,x,y,z\n{PLAIN}\n", {"aspect_ratio": 10}, "rods and ellipsoids"),
        (f"id,t,x,y,z\n{PLAIN}\n", {"dimension": 2}, "no impact with 3 frames"),
        ("id,t,x,y\n1,0,0,0\n1,1,0,0\n", {"dimension": 2}, "2 frames; .* 3 before"),
        (
            f"id,t,x,y,z\n{PLAIN}\n",
            {"dimension": 2, "localisation_error": 0},
            "> 0 m, got 0. Leave it out",
        ),
        (
            f"id,t,x,y,z\n{ONCE}\n",
            {"dimension": 2, "localisation_error": 1e-6},
            "in two frames.* same id",
        ),
    ],
)
def test_tracks_that_cannot_show_impacts_are_refused(tmp_path, text, header, message):
    (tmp_path / "tracks.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        jaxgran.read_impacts(tmp_path / "tracks.csv", HEADER | header)


def test_lines_through_short_flights_of_long_tracks_keep_their_digits():
    # Sums over all of these rows reach 1e9 s^2, and a flight has 2e-4 s^2. Squares of times 40 s
    # after the first frame, which are summed, leave an error of 1e-8.
    particles, frames, length = 50, 20_000, 8
    t = np.tile(np.arange(frames) / 500, particles)
    ids = np.repeat(np.arange(particles), frames)
    path = 0.05 * np.sin(40 * t + ids)
    columns = {"id": ids, "t": t, "x": path, "y": 0.5 * path, "z": 0.1 * path}
    motion = Motion.from_columns(columns, {}, lines=list(range(t.size)))
    begin = np.array([7, 399_000, t.size - length])
    found = fit_lines(motion, begin, begin + length)
    for k, first in enumerate(begin):
        rows = slice(first, first + length)
        slope = np.polyfit(t[rows] - t[first], path[rows], 1)[0]
        assert found.velocity[k, 0] == pytest.approx(slope, rel=1e-7)
        assert found.square[k] == pytest.approx(np.sum((t[rows] - t[rows].mean()) ** 2), rel=1e-7)


def test_gaps_between_frames_do_not_count_as_errors():
    # Six straight lines of 90 frames; five of them lack every fourth frame.
    error = 1e-5
    frame = np.arange(90)
    seen = [frame] + 5 * [frame[frame % 4 > 0]]
    ids = np.repeat(np.arange(6), [x.size for x in seen])
    t = np.concatenate(seen) / 500
    x = 0.3 * t + error * np.random.default_rng(0).standard_normal(t.size)
    columns = {"id": ids, "t": t, "x": x, "y": 0.01 * ids + 0.2 * t, "z": 0.1 * t}
    motion = Motion.from_columns(columns, {}, lines=list(range(ids.size)))
    # y and z have no error: the median of all three is below that of x.
    assert error_by_second_differences(motion) < error


def test_frames_at_uneven_times_do_not_count_as_errors():
    error = 1e-5
    t = np.tile((np.arange(90) + np.arange(90) // 2) / 500, 6)  # frames at 0, 1, 3, 4, 6, 7, ...
    ids = np.repeat(np.arange(6), 90)
    noise = error * np.random.default_rng(0).standard_normal((3, t.size))
    paths = {name: 0.3 * t + noise[k] for k, name in enumerate("xyz")}
    motion = Motion.from_columns({"id": ids, "t": t} | paths, {}, lines=list(range(ids.size)))
    assert error_by_second_differences(motion) == pytest.approx(error, rel=0.06)


def test_impacts_on_walls_are_found_wherever_they_lie_between_frames():
    # 15 x 15 spheres move along x between two walls, and are reflected with eps = .9.
    gas = glass_beads()
    side = 0.062
    room = side - float(gas.diameter)
    frames = np.arange(400)
    ids, times, paths = [], [], []
    expected = 0
    rng = np.random.default_rng(0)
    places = np.linspace(0, room, 15)
    for number, (y, z) in enumerate(np.array(np.meshgrid(places, places)).reshape(2, -1).T):
        x = np.empty(frames.size)
        speed = 0.5
        begin, since = room * rng.random(), 0.0
        sign = 1.0
        t = frames / 500
        while True:
            until = since + ((room - begin) if sign > 0 else begin) / speed
            inside = (t >= since) & (t < until)
            x[inside] = begin + sign * speed * (t[inside] - since)
            if until > t[-1]:
                break
            is_inner = 0 < y < room and 0 < z < room
            expected += is_inner and 5 / 500 < until < t[-1] - 5 / 500
            begin = room if sign > 0 else 0.0
            since, sign, speed = until, -sign, 0.9 * speed
        ids.append(np.full(frames.size, number))
        times.append(t)
        paths.append(np.stack([x, np.full_like(x, y), np.full_like(x, z)]))
    names = dict(zip("xyz", np.concatenate(paths, axis=1), strict=True))
    columns = {"id": np.concatenate(ids), "t": np.concatenate(times)} | names
    between = dataclasses.replace(gas, container=jaxgran.Walls(side, restitution=0.9))
    lines = list(range(columns["t"].size))
    found = impacts_of_tracks(columns, {"localisation_error": "1e-7"}, lines, between)
    assert found.walls is not None and found.walls.num_values >= 0.99 * expected > 500
    np.testing.assert_allclose(found.walls.restitution, 0.9, atol=0.002)


def test_errors_of_speeds_are_the_scatter_of_equal_impacts():
    # 2000 pairs, far from each other, make one oblique impact with eps = .8 in the plane x,y.
    pairs, frames, error = 2000, 24, 2e-5
    gas = glass_beads()
    diameter = float(gas.diameter)
    times = np.arange(frames) / 500
    time = times[frames // 2] + 3e-4
    g = np.array([-0.3, 0.1, 0.0])
    normal = np.array([0.8, 0.6, 0.0])
    speed = -g @ normal
    change = 1.8 * speed * normal / 2
    passed = (times - time)[:, None]
    later = np.maximum(passed, 0)
    first = diameter * normal + passed * g + later * change
    second = -later * change
    apart = 0.1 * np.arange(pairs)[:, None] * np.array([0.0, 0.0, 1.0])
    position = np.stack([apart + first[:, None], apart + second[:, None]], axis=2)
    rng = np.random.default_rng(0)
    position = position.reshape(-1, 3) + error * rng.standard_normal((2 * frames * pairs, 3))
    columns = dict(zip("xyz", position.T, strict=True))
    columns["id"] = np.tile(np.arange(2.0 * pairs), frames)
    columns["t"] = np.repeat(times, 2 * pairs)
    header = {"localisation_error": str(error)}
    found = impacts_of_tracks(columns, header, list(range(len(position))), gas).spheres
    assert len(found.speed) > 0.95 * pairs
    before = np.asarray(found.speed)
    after = before * np.asarray(found.restitution)
    error_before = np.asarray(found.speed_error)
    error_after = np.asarray(found.error) * before
    correlation = np.corrcoef(before, after)[0, 1]
    assert np.mean(before) == pytest.approx(speed, rel=2e-3)
    assert np.mean(after) == pytest.approx(0.8 * speed, rel=2e-3)
    assert np.std(before) == pytest.approx(np.mean(error_before), rel=0.06)
    assert np.std(after) == pytest.approx(np.mean(error_after), rel=0.06)
    assert correlation == pytest.approx(np.mean(np.asarray(found.correlation)), abs=0.06)
    assert abs(correlation) > 0.2
