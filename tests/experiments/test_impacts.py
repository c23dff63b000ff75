"""Single impacts from tracks of spheres that were filmed."""

import dataclasses
import time

import numpy as np
import pytest

import jaxgran
from experiments.fit import impacts as study
from experiments.fit.wrong_physics import SIDE
from jaxgran.data.track_impacts import impacts_of_tracks
from tests.data.test_tracks import text_of

HEADER = {"eta": 0.03, "diameter": 2e-3, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}


A = 3e-6


@pytest.fixture(scope="module")
def filmed():
    """100 spheres filmed in 300 frames without a localisation error, in a periodic box."""
    return study.film(study.beads(), 300, seed=0, number=100)


def impacts_of(film, error, tmp_path, **header):
    noisy = study.with_errors(film, error, seed=1)
    text = text_of(film.times, noisy, box_side=film.side, **HEADER | header)
    (tmp_path / "tracks.csv").write_text(text)
    return jaxgran.read_impacts(tmp_path / "tracks.csv")


@pytest.mark.slow
def test_impacts_have_the_speeds_and_the_law_of_the_spheres(filmed, tmp_path):
    found = impacts_of(filmed, 4e-5, tmp_path, localisation_error=4e-5)
    truth = study.judged(filmed, found)
    assert truth["found"] >= 0.8 and truth["false"] <= 0.01
    assert abs(truth["bias"]) < 0.005
    residuals = np.asarray(found.spheres.residuals(filmed.gas))
    assert 0.7 < np.median(np.abs(residuals)) / 0.6745 < 1.3
    unknown = filmed.gas.replace(dissipative_constant=1e-6)
    result = jaxgran.fit(jaxgran.Measurement(unknown, found.spheres))
    assert abs(result.estimate[0] - A) < 3 * result.standard_error[0] < 0.15 * A
    assert result.p_value > 0.01


@pytest.mark.slow
def test_an_error_of_positions_that_is_not_given_is_found(filmed, tmp_path):
    found = impacts_of(filmed, 4e-5, tmp_path)
    assert found.localisation_error == pytest.approx(4e-5, rel=0.05)


@pytest.mark.slow
def test_the_scatter_of_eps_is_found_from_impact_to_impact(filmed, tmp_path):
    found = impacts_of(filmed, 1e-6, tmp_path, localisation_error=1e-6)
    rng = np.random.default_rng(0)
    test = found.spheres
    scattered = np.minimum(test.restitution + 0.03 * rng.standard_normal(len(test.speed)), 1.0)
    test = dataclasses.replace(test, restitution=scattered)
    result = jaxgran.fit(jaxgran.Measurement(filmed.gas, test))
    assert result.p_value > 0.01
    sharp = dataclasses.replace(test, scatters=False)
    assert jaxgran.fit(jaxgran.Measurement(filmed.gas, sharp)).p_value < 1e-6
    error = 0.03 / len(test.speed) ** 0.5 / 0.1  # of 1 - eps, relative
    assert result.standard_error[0] / A == pytest.approx(error, rel=0.5)


@pytest.mark.slow
def test_impacts_on_walls_are_found_where_there_are_walls(tmp_path):
    gas = study.beads(container=jaxgran.Walls(SIDE, restitution=0.8))
    film = study.film(gas, 300, seed=0)
    header = HEADER | {"container_side": SIDE, "wall_restitution": 0.9}
    noisy = study.with_errors(film, 4e-5, seed=1)
    (tmp_path / "tracks.csv").write_text(text_of(film.times, noisy, **header))
    found = jaxgran.read_impacts(tmp_path / "tracks.csv")
    tests = found.measurements
    assert {*tests} == {"impacts", "wall impacts"}
    walls = found.walls
    assert walls.onto == "wall" and len(walls.speed) > 50
    result = jaxgran.fit(tests["wall impacts"], free="wall_restitution")
    assert abs(result.estimate[0] - 0.8) < 3 * result.standard_error[0] < 0.03
    with pytest.raises(ValueError, match="walls parallel to the coordin"):
        jaxgran.read_impacts(
            tmp_path / "tracks.csv", {"container_side": 1.2 * SIDE, "N": 250, "eta": 0.0174}
        )


def test_many_rows_take_seconds(filmed):
    columns = study.columns_of(filmed, 4e-5, seed=1)
    begin = time.perf_counter()
    header = {"box_side": str(filmed.side), "localisation_error": "4e-5"}
    lines = list(range(columns["t"].size))
    impacts_of_tracks(columns, header, lines, filmed.gas)
    assert (time.perf_counter() - begin) / columns["t"].size < 5 / 1e5


@pytest.mark.minutes
def test_tracks_and_their_impacts_are_fitted_together():
    film = study.film(study.beads(surface=jaxgran.Rough(-0.3)), 250, seed=2, number=100)
    joint = study.joint_fit(film, 4e-5, seed=3)
    assert abs(joint.value("dissipative_constant")[0] / A - 1) < 0.15
