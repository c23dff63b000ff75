"""Plans on the command line."""

import json

import numpy as np
import pytest

from jaxgran.cli.plan import read_experiment
from tests.cli.scenes import EXPERIMENT, PNG, SCENE


def test_an_experiment_is_read_from_a_scene(scene):
    (scene / "flight.toml").write_text(SCENE + "eta_err = 0.002\n" + EXPERIMENT)
    measurement = read_experiment(scene / "flight.toml")
    assert measurement.num_particles == 250 and measurement.absent == ("walls", "drag")
    assert np.allclose(measurement.curve.times, np.geomspace(0.1, 10.0, 10))
    relative = measurement.curve.temperature_error / measurement.curve.temperature
    assert np.allclose(relative, 0.02) and measurement.errors_measured
    assert [*measurement.priors] == ["packing_fraction"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("T_err = 0.02", "T_err = 3.0", "T_err must lie in (0, 1), got 3. It is relative"),
        ("T_err = 0.02", "T_err = 0.0", "T_err must lie in (0, 1), got 0"),
        ("number = 10", "number = 1", "number of times must be"),
        ("number = 10", "number = 10000000000000", "at most 100000, got 10000000000000"),
        ("last = 10.0", "last = 0.05", "last must lie after first"),
        (", last = 10.0", "", "give times = [0.1, 0.3, 1.0] or times = {number"),
        ("times = {number = 10, first = 0.1, last = 10.0}", "", "[experiment] has no times"),
        ("N = 250", "N = 250\nT_eror = 1", "[experiment] T_eror is not known: give some of times"),
        ("N = 250", "N = 2.5", "N"),
        ("N = 250", "", "a plan needs N"),
        ("T_err = 0.02", "T_rot_err = 0.02", "T_rot_err needs rough grains: give beta_t"),
        ("[experiment]", "[flight]", "[flight] is not read"),
        (EXPERIMENT, "", "a plan needs a table [experiment] with times = [0.1, 0.3, 1.0] or"),
    ],
)
def test_what_makes_no_experiment_is_refused(scene, run, old, new, message):
    assert old in EXPERIMENT
    (scene / "flight.toml").write_text(SCENE + EXPERIMENT.replace(old, new))
    status, _, err = run("plan", "flight.toml")
    assert status == 2 and message in err, err


@pytest.mark.minutes
@pytest.mark.slow
def test_plan_prints_a_table_and_writes_it(scene, run):
    (scene / "flight.toml").write_text(SCENE + EXPERIMENT)
    status, out, _ = run("plan", "flight.toml", "--out", "plan.png")
    assert status == 0 and "no roughness: declared" in out
    assert (scene / "plan.png").read_bytes()[:8] == PNG
    record = json.loads((scene / "plan.json").read_text())
    assert record["truth"] == 3e-6 and record["additions"][0]["gain"] > 1
    status, _, err = run("plan", "flight.toml", "--out", "plan.png")
    assert status == 2 and "exists. Name another --out" in err
    status, _, err = run("plan", "flight.toml", "--out", "plan.html", "--report")
    assert status == 2 and "must not end in .json or .html" in err
