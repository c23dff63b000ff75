"""Tracks that cannot show impacts."""

import pytest

import jaxgran

HEADER = {"eta": 0.03, "diameter": 2e-3, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}
PLAIN = "\n".join(
    f"{i},{k / 500},{0.01 * i + 1e-4 * k},0.01,0.02" for k in range(20) for i in (1, 2)
)


@pytest.mark.parametrize(
    "text, header, message",
    [
        (f"id,t,x,y,z\n{PLAIN}\n", {}, "2 coordinates .*dimension 3"),
        ("t,T\n1,2\n", {}, "tracks of particles have id,t,x,y"),
        (f"id,t,x,y,z\n{PLAIN}\n", {"aspect_ratio": 10}, "rods and ellipsoids"),
        (f"id,t,x,y,z\n{PLAIN}\n", {"dimension": 2}, "no impact with 3 frames"),
        ("id,t,x,y\n1,0,0,0\n1,1,0,0\n", {"dimension": 2}, "2 frames; .* 3 before"),
    ],
)
def test_tracks_that_cannot_show_impacts_are_refused(tmp_path, text, header, message):
    (tmp_path / "tracks.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        jaxgran.read_impacts(tmp_path / "tracks.csv", HEADER | header)
