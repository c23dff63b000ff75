"""The scripts a person runs, run as a person would."""

import argparse
import json
import subprocess
import sys
from pathlib import Path

import pytest

import experiments.fit_cooling_curve as fit_cooling_curve
import jaxgran
from jaxgran.cli.common import MODELS, choose_or_make_model

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
DENSE = EXPERIMENTS / "data" / "lammps_cooling_dense.csv"


def run(script, *arguments, cwd):
    command = [sys.executable, str(EXPERIMENTS / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)


@pytest.mark.slow
def test_main_job_without_arguments(tmp_path):
    done = run("fit_cooling_curve.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout.splitlines()[-1])
    assert "eps = 0.9" in done.stdout and "mean free path 4.15 mm" in done.stdout
    assert abs(summary["A"] / 3e-6 - 1) < 0.02
    assert abs(summary["A"] - 3e-6) < 2 * summary["A_std_err"]
    assert (
        summary["converged"]
        and summary["verdict"] == "not determined"
        and summary["model"] == "kinetic-theory"
    )
    # Points of the same runs share their noise: where theory is right they scatter by half of it.
    assert 0.2 < summary["reduced_chi2"] < 1.5
    assert "Kinetic theory is consistent with this curve" in done.stdout
    assert 1e-6 < summary["A_low"] < 2.7e-6 and 3e-6 < summary["A_high"] < 3.3e-6
    folder = tmp_path / "results" / "lammps_cooling_dilute-kinetic-theory"
    picture, record = sorted(folder.iterdir(), reverse=True)
    assert picture.suffix == ".png" and picture.stat().st_size > 20_000
    assert json.loads(record.read_text())["parameters"][0]["parameter"] == "A"


@pytest.mark.slow
def test_the_posterior_is_that_of_the_budget(tmp_path):
    done = run("fit/sample_posterior.py", "--samples", "300", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    line = next(line for line in done.stdout.splitlines() if line.startswith("{"))
    summary = json.loads(line)
    found = summary["dissipative_constant"]
    # 1200 samples: the mean within .1, the spread within 10 % at 3 standard errors.
    assert abs(found["mean"] - found["fit"]) < 0.1 * found["std"]
    assert found["std"] == pytest.approx(found["fit_std"], rel=0.1)
    assert summary["divergent"] == 0 and summary["r_hat"] < 1.05
    assert (tmp_path / "here" / "sample_posterior.png").stat().st_size > 20_000


@pytest.mark.slow
def test_main_job_says_what_it_cannot_explain(tmp_path):
    done = run("fit_cooling_curve.py", DENSE, "--free", "A", "T0", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "This scene needs soft spheres" in done.stdout
    assert json.loads(done.stdout.splitlines()[-1])["verdict"] == "not consistent"
    # Nothing is written over unless asked.
    before = {path: path.read_bytes() for path in (tmp_path / "here").iterdir()}
    again = run("fit_cooling_curve.py", DENSE, "--out", "here", cwd=tmp_path)
    assert again.returncode == 2
    assert "exists. Name another --out, or add --overwrite" in again.stderr
    assert {path: path.read_bytes() for path in (tmp_path / "here").iterdir()} == before


@pytest.mark.parametrize(
    "name, model",
    [
        ("kinetic-theory", jaxgran.KineticTheory()),
        ("dsmc", jaxgran.DSMC(100, replicas=3)),
        ("hard-spheres", jaxgran.HardSpheres(100, replicas=3)),
        ("soft-spheres", jaxgran.SoftSpheres(100, replicas=3)),
    ],
)
def test_models_are_found_by_their_names(name, model):
    assert name in MODELS
    options = argparse.Namespace(model=name, particles=100, replicas=3, curve="curve.csv")
    assert choose_or_make_model(options, None, None, (), None) == (model, ())
    options.particles = None
    if model.stochastic:
        with pytest.raises(ValueError, match="curve.csv does not give N. Add --particles"):
            choose_or_make_model(options, None, None, (), None)


def main_job(monkeypatch, capsys, folder, *arguments):
    """The main job in this process: its exit code, and what it prints."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["fit_cooling_curve.py", *map(str, arguments)])
    return fit_cooling_curve.main(), *capsys.readouterr()


HEADER = "# eta: 0.05\n# diameter: 0.002\n# density: 2500\n# Y: 5e7\n# nu: 0.22\n# T0: 0.01\n"
ROWS = "t,T,T_err\n1,6e-3,1e-4\n2,5e-3,1e-4\n3,4e-3,1e-4\n4,3e-3,1e-4\n"


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--set", "Y=-1"], "youngs_modulus must lie in"),
        (["--set", "youngs=1"], "give KEY=VALUE with KEY one of"),
        (["--set", "N=many"], "header line N"),
        (["--set", "N=1e30"], "header line N"),
        (["--key", 10**30], "too large"),
        (["--set", "Y=0.05"], "in Pa"),
        (["--free", "T0"], "leaves A fixed"),
        (["--model", "hard-spheres", "--particles", 0], "num_particles must be a whole number"),
        (["--out", "taken"], "is not a writable folder"),
    ],
)
def test_main_job_ends_with_one_line(arguments, words, tmp_path, monkeypatch, capsys):
    (tmp_path / "bare.csv").write_text(HEADER + ROWS)
    (tmp_path / "taken").write_text("")
    code, _, told = main_job(monkeypatch, capsys, tmp_path, "bare.csv", *arguments)
    assert code == 2 and told.startswith("error: ") and words in told
    assert len(told.splitlines()) == 1 and not (tmp_path / "results").exists()


@pytest.mark.slow
def test_drop_tower_runs(tmp_path):
    done = run("fit/drop_tower.py", "--runs", 1, "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "eps = 0.90: beta_t = -0.73 or 0.16" in done.stdout
    assert "'held': 1, 'runs': 1" in done.stdout
    assert (tmp_path / "here" / "drop_tower.png").stat().st_size > 20_000


@pytest.mark.slow
def test_wrong_physics_runs(tmp_path):
    options = "--runs", 3, "--rows", "walls, eps", "--out", "figures.json"
    done = run("fit/wrong_physics.py", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "figures.json").read_text())["rows"]
    rows = {row["told"]: row for row in rows if row["name"].startswith("walls")}
    assert rows["all"]["held"] == rows["all"]["inside"] == 3
    assert rows["nothing"]["held"] == 0 and rows["nothing"]["A"] > 1.5


@pytest.mark.slow
def test_own_model_runs(tmp_path):
    done = run("fit/own_model.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # A loss that grows as spins warm up is hardly told from a larger constant one.
    verdict = "Haff law is consistent with this curve, which does not determine coefficient: "
    assert verdict in done.stdout


@pytest.mark.slow
def test_benchmark_runs(tmp_path):
    done = run("speed/benchmark_theory.py", "--smoke", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout.splitlines()[-1])
    assert row["vmap_error"] < 1e-6 and row["scipy_error"] < 1e-6  # the same physics, twice


def rows_of(script, part, folder):
    """Return the rows that a small run of a part of a benchmark records."""
    done = run(f"speed/{script}.py", "--only", part, "--smoke", "--out", "here", cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads((folder / "here" / f"benchmark_{part}.json").read_text())["rows"]


@pytest.mark.slow
def test_particle_benchmark_runs(tmp_path):
    (row,) = rows_of("benchmark_particles", "particles", tmp_path)
    assert row["collisions_per_s"] > 0 and 0.5 < row["temperature_ratio"] < 1
    for lammps in row["lammps"].values():  # where it is installed
        assert lammps["temperature_ratio"] == pytest.approx(row["temperature_ratio"], rel=0.01)


@pytest.mark.slow
def test_comparison_with_lammps_runs(tmp_path):
    done = run("accuracy/compare_lammps.py", "--smoke", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "here" / "compare_lammps.png").stat().st_size > 20_000
    record = json.loads((tmp_path / "here" / "compare_lammps.json").read_text())
    assert set(record["curves"]) == {"dilute", "dense"}


@pytest.mark.slow
def test_soft_sphere_accuracy_runs(tmp_path):
    done = run("accuracy/soft_sphere_accuracy.py", "--smoke", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "here" / "soft_sphere_accuracy.png").stat().st_size > 20_000
    record = json.loads((tmp_path / "here" / "soft_sphere_accuracy.json").read_text())
    for impact in record["impact"].values():
        assert 1.8 < impact["order"]["bias"] < 2.4  # second order; 2.17 and 2.09 at 25 and 50 steps
    assert record["ledger"]["rows"][1]["worst"] < 2e-4  # 5e-5 at 40 steps
    assert record["trajectory"]["finest_to_lammps"] < 1e-3  # 3e-4 at 200 steps


@pytest.mark.slow
def test_speed_against_error_runs(tmp_path):
    done = run("speed/speed_vs_error.py", "--smoke", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "here" / "speed_vs_error_smoke.png").stat().st_size > 20_000
    rows = json.loads((tmp_path / "here" / "speed_vs_error_smoke.json").read_text())["scenes"][
        "dense"
    ]
    for row in rows["rows"]:  # at early times all models agree to the noise of 200 particles
        assert row["run_s"] > 0 and row["error"] < 0.01 + 4 * row["standard_error"]


@pytest.mark.slow
def test_benchmark_of_derivatives_runs(tmp_path):
    done = run("speed/benchmark_derivatives.py", "--smoke", "--out", "figures.json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "figures.json").read_text())["rows"]
    assert len(rows) == 2  # soft spheres and stochastic simulation
    for row in rows:  # the same linear rule, read in both directions
        assert row["reverse_over_forward"] == pytest.approx(1.0, abs=1e-9)
        assert all(way["run_s"] > 0 for way in row["ways"].values())


@pytest.mark.slow
def test_fits_head_to_head_run(tmp_path):
    done = run("fit/fit_head_to_head.py", "--smoke", "--out", "here", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "here" / "fit_head_to_head.json").read_text())["rows"]
    for row in rows:
        assert len(row["guesses"]) == row["all_simulations"] > 0
        if row["search"] == "jaxgran.fit":  # 1000 spheres leave A open by some per cent
            assert abs(row["last_error"][0]) < 0.15
