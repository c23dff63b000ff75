"""TOML files of scenes."""

import numpy as np
import pytest

from jaxgran.data.scene_file import read_scene_file
from tests.cli.scenes import EXPERIMENT, SCENE


def test_lists_are_sides_of_a_container_and_absent_effects(tmp_path):
    (tmp_path / "box.toml").write_text("container_side = [0.1, 0.2, 0.3]\n" + SCENE + EXPERIMENT)
    header, experiment = read_scene_file(tmp_path / "box.toml")
    assert header["container_side"] == "0.1 x 0.2 x 0.3" and header["absent"] == "walls, drag"
    np.testing.assert_allclose(experiment.times, np.geomspace(0.1, 10.0, 10))
    assert experiment.errors == {"temperature": 0.02}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("T_err", "T_er", r"\[experiment\] T_er is not known"),
        ("T_err = 0.02", "T_err = true", "T_err must be a number"),
        ("N = 250", "N = true", "N must be one number or text, got True"),
        ("eta = 0.05", "eta = [0.05, 0.06]", r"eta must be one number or text, got \[0.05, 0.06\]"),
        ("eta = 0.05", "eta = true", "eta must be one number or text, got True"),
        ("eta = 0.05", "container_side = [[0.1]]", "container_side must be one number"),
        ("eta = 0.05", "eta = 2026-01-01", "eta must be one number"),
        ("eta = 0.05", "N = 5", r"N stands before \[experiment\] and in it"),
    ],
)
def test_what_makes_no_scene_is_refused(tmp_path, old, new, message):
    text = SCENE + EXPERIMENT
    assert old in text
    (tmp_path / "flight.toml").write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message):
        read_scene_file(tmp_path / "flight.toml")
