"""Tracks that cannot show impacts, and lines through short flights of long tracks."""

import numpy as np
import pytest

import jaxgran
from jaxgran.data.flights import fit_lines
from jaxgran.data.motion import Motion

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
