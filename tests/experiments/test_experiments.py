"""The scripts a person runs, run as a person would."""

import json
import shlex

import pytest

from experiments.support.record import EXPERIMENTS
from tests.experiments.scripts import run


@pytest.mark.slow
def test_main_job_without_arguments(tmp_path):
    printed = run(EXPERIMENTS / "fit_cooling_curve.py", folder=tmp_path)
    summary = json.loads(printed.splitlines()[-1])
    assert "eps = 0.9" in printed and "mean free path 4.15 mm" in printed
    assert abs(summary["A"] / 3e-6 - 1) < 0.02
    assert abs(summary["A"] - 3e-6) < 2 * summary["A_std_err"]
    assert summary["converged"] and summary["verdict"] == "not determined"
    assert summary["model"] == "kinetic-theory"
    # Points of the same runs share their noise: where theory is right they scatter by half of it.
    assert 0.2 < summary["reduced_chi2"] < 1.5
    assert "Kinetic theory is consistent with this curve" in printed
    assert 1e-6 < summary["A_low"] < 2.7e-6 and 3e-6 < summary["A_high"] < 3.3e-6
    folder = tmp_path / "results" / "lammps_cooling_dilute-kinetic-theory"
    picture, record = sorted(folder.iterdir(), reverse=True)
    assert picture.suffix == ".png" and picture.stat().st_size > 20_000
    assert json.loads(record.read_text())["parameters"][0]["parameter"] == "A"


# --- small runs of the scripts that measure -----------------------------------------------------


def is_the_budgets(found):
    # 1200 samples: the mean within .1, the spread within 10 % at 3 standard errors.
    A = found["dissipative_constant"]
    assert abs(A["mean"] - A["fit"]) < 0.1 * A["std"]
    assert A["std"] == pytest.approx(A["fit_std"], rel=0.1)
    assert found["divergent"] == 0 and found["r_hat"] < 1.05


def holds_A(found):
    assert found["held"] == found["runs"] == 1
    assert found["made_by"]["command"] == "python experiments/fit/drop_tower.py --runs 1"


def is_right_where_walls_are_told(found):
    rows = {row["told"]: row for row in found["rows"] if row["name"].startswith("walls")}
    assert rows["all"]["held"] == rows["all"]["inside"] == 3
    assert rows["nothing"]["held"] == 0 and rows["nothing"]["A"] > 1.5


def expects_the_widths_of_runs(found):
    (scene,) = (scene for scene in found["scenes"] if scene["name"] == "smooth")
    present, best, _ = scene["rows"]
    assert best["expected"] < 0.5 * present["expected"]
    assert best["achieved"] < 0.5 * present["achieved"]


def is_the_same_twice(found):
    assert found["sweep"]["vmap_error"] < 1e-6 and found["sweep"]["scipy_error"] < 1e-6


def cools(found):
    (row,) = found["rows"]
    assert row["collisions_per_s"] > 0 and 0.5 < row["temperature_ratio"] < 1
    for lammps in row["lammps"].values():  # where it is installed
        assert lammps["temperature_ratio"] == pytest.approx(row["temperature_ratio"], rel=0.01)


def compares_both_curves(found):
    assert set(found["curves"]) == {"dilute", "dense"}


def is_of_second_order(found):
    for impact in found["impact"].values():
        assert 1.8 < impact["order"]["bias"] < 2.4  # second order; 2.17 and 2.09 at 25 and 50 steps
    assert found["ledger"]["rows"][1]["worst"] < 2e-4  # 5e-5 at 40 steps


def all_models_agree_early(found):
    for row in found["scenes"]["dense"]["rows"]:  # to the noise of 200 particles
        assert row["run_s"] > 0 and row["error"] < 0.01 + 4 * row["standard_error"]


def reads_one_rule_in_both_directions(found):
    assert len(found["rows"]) == 2  # soft spheres and stochastic simulation
    for row in found["rows"]:
        assert row["reverse_over_forward"] == pytest.approx(1.0, abs=1e-9)
        assert all(way["run_s"] > 0 for way in row["ways"].values())


def finds_A(found):
    for row in found["rows"]:
        assert len(row["guesses"]) == row["all_simulations"] > 0
        if row["search"] == "jaxgran.fit":  # 1000 spheres leave A open by some per cent
            assert abs(row["last_error"][0]) < 0.15


C1 = 1.153449
"""First coefficient of eps(v), the second being 3/5 of its square: Schwager & Poeschel, Phys. Rev.
E 57, 650 (1998)."""


def series_is_that_of_impacts(record):
    found = record["found"]
    assert found["recovered"]["unclipped"][:2] == pytest.approx([-C1, 0.6 * C1**2], abs=1e-5)
    assert found["recovered"]["clipped"][4] == pytest.approx(4 / 15, rel=0.02)
    assert found["orders"]["ramirez_four_terms"] < 3.1  # 4 if their third term were right


def dissipation_lengthens_the_memory(record):
    # With 8000 particles the relaxation time has an error of 3 %; at e = .7 it is 18 % longer.
    found = record["found"]
    elastic, constant = (found[name]["dsmc"]["relaxation"] for name in ("elastic", "constant"))
    assert constant / elastic == pytest.approx(2 / (1 + found["restitution"]), rel=0.12)


def claims_hold(found):
    verdicts = {row["name"]: row["verdict"] for row in found["rows"]}
    assert verdicts["39"] == "agree" and verdicts["41"] == "corrected"
    assert all(row["holds"] for row in found["rows"])


def error_bars_hold_the_surface(found):
    assert found["runs"] == 10 and min(found["held"].values()) >= 7


OF_IMPACTS, MEMORY = "--only paper_restitution --smoke", "--only paper_velocity_correlation --smoke"
SCRIPTS = {
    "fit/sample_posterior": ("--samples 300 --warmup 150", is_the_budgets, "png"),
    "fit/drop_tower": ("--runs 1", holds_A, "png"),
    "fit/wrong_physics": ("--runs 3 --rows 'walls, eps'", is_right_where_walls_are_told, ""),
    "fit/impacts": ("--only oblique --runs 2", error_bars_hold_the_surface, ""),
    "fit/plan": ("--runs 3 --rows smooth", expects_the_widths_of_runs, "png"),
    "fit/fit_head_to_head": ("--smoke --only fit_head_to_head", finds_A, ""),
    "speed/benchmark_theory": ("--smoke --only benchmark_kinetic_theory", is_the_same_twice, ""),
    "speed/benchmark_particles": ("--smoke --only particles", cools, ""),
    "speed/benchmark_derivatives": ("--smoke", reads_one_rule_in_both_directions, ""),
    "speed/speed_vs_error": ("--smoke", all_models_agree_early, "png"),
    "accuracy/compare_lammps": ("--smoke", compares_both_curves, "png"),
    "accuracy/soft_sphere_accuracy": ("--smoke", is_of_second_order, "png"),
    "paper/paper_cooling": (OF_IMPACTS, series_is_that_of_impacts, "png"),
    "paper/paper_diffusion": (MEMORY, dissipation_lengthens_the_memory, "png"),
    "paper/paper_claims": ("", claims_hold, ""),
}
"""Arguments, what must be found, and whether a picture is drawn."""


@pytest.mark.slow
@pytest.mark.minutes
@pytest.mark.parametrize("script", SCRIPTS)
def test_small_run_of_a_script(script, tmp_path):
    arguments, check, picture = SCRIPTS[script]
    run(EXPERIMENTS / f"{script}.py", *shlex.split(arguments), folder=tmp_path)
    written = {path.suffix[1:]: path for path in tmp_path.rglob("*.*")}
    assert not picture or written["png"].stat().st_size > 20_000
    record = json.loads(written["json"].read_text(encoding="utf-8"))
    assert record["made_by"]["packages"]
    check(record)


@pytest.mark.slow
@pytest.mark.minutes
def test_clustering_leaves_haffs_law(tmp_path):
    parts = "paper_clustering", "clustering_film"
    options = "--only", *parts, "--smoke", "--out", "here"
    run(EXPERIMENTS / "paper" / "paper_clustering.py", *options, folder=tmp_path)
    for name in (*parts, "paper_clustering_fields"):
        assert (tmp_path / "here" / f"{name}.png").stat().st_size > 20_000
    record, film = (json.loads((tmp_path / "here" / f"{x}.json").read_text()) for x in parts)
    assert film["across"][-1][0] > 2 * film["across"][0][0]  # flow and clusters grow
    (scene,) = record["scenes"].values()
    assert scene["viscoelastic"]["gamma_0"] == pytest.approx(scene["constant"]["gamma_0"])
    # At e = .6 even 500 disks depart from Haff's law: by 10 % in T after 4.3 +- 0.9 collisions.
    left = scene["constant"]["departures"]["T over theory's of N by 1.1"]
    assert 2 < left["N"][0] < 9 and 0.1 < left["T"][0] < 0.6
    assert scene["constant"]["last_flow"][0] > 0.1  # clusters flow
