"""Fits on the command line: of one and several curves, drop tests, clocks and priors."""

import dataclasses
import json

import pytest

import jaxgran
from tests.cli.scenes import PNG


def rewrite(name, change, out=None, **keys):
    """Write a changed copy of a curve, or the curve anew."""
    curve, header = jaxgran.read_curve(name)
    jaxgran.write_curve(out or name, change(curve), header | keys, overwrite=True)


def shifted(by):
    return lambda curve: dataclasses.replace(curve, times=by + curve.times)


@pytest.fixture
def fit(measured, run):
    """A function that fits; it returns the output, and the values of its last line."""

    def fit(*arguments):
        status, out, _ = run("fit", *arguments, "--out", "fitted")
        assert status == 0
        return out, json.loads(out.splitlines()[-1])

    return fit


def assert_finds_A(answer):
    assert abs(answer["A"] / 3e-6 - 1) < 3 * answer["A_std_err"] / 3e-6 < 0.1


@pytest.mark.slow
def test_several_measurements_are_fitted_jointly(measured, fit):
    out, answer = fit("thin.csv", "dense.csv", "--drop-test", "drops.csv")
    assert_finds_A(answer)
    assert answer["agree"] and "do not contradict" in out
    record = json.loads((measured / "fitted" / "thin-kinetic-theory.json").read_text())
    assert set(record["weight"]) == {"thin", "dense", "drops"}
    assert sum(part[0] for part in record["weight"].values()) == pytest.approx(1.0)
    assert answer["A_low"] < 3e-6 < answer["A_high"] and answer["thin: T0"] > 0
    assert (measured / "fitted" / "thin-kinetic-theory.png").read_bytes()[:8] == PNG


@pytest.mark.slow
def test_a_contradicting_drop_test_is_reported(fit):
    # As many measurements as above, so that the program is compiled already.
    out, answer = fit("thin.csv", "dense.csv", "--drop-test", "others.csv")
    # N is not in the files: what speaks against A is that the curves need runs of 5 grains.
    assert not answer["agree"] and answer["p_value"] < 1e-3
    assert "thin: the curve scatters as" in out
    assert "contradict each other, or the model" in out


@pytest.mark.slow
def test_errors_of_headers_are_priors_of_joint_fits(measured, fit):
    """What is of the material is known once, what is of a curve for each."""
    for name in ("thin.csv", "dense.csv"):
        text = (measured / name).read_text()
        (measured / name).write_text(f"# N: 100\n# Y_err: 5e6\n# eta_err: 0.002\n{text}")
    _, answer = fit("thin.csv", "dense.csv", "--quick")
    assert 0.04 < answer["A_std_err"] / answer["A"] < 0.1  # 10 % in Y is 4 % in A
    record = json.loads((measured / "fitted" / "thin-kinetic-theory.json").read_text())
    budget = record["parameters"][0]["error_budget"]
    assert budget["youngs_modulus"] / answer["A"] == pytest.approx(0.04, rel=0.1)
    assert budget["packing_fraction"] > 0 and budget["few particles"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("free", [("A",), ("A", "T0")])
def test_late_clocks_of_headers_are_priors_of_joint_fits(fit, free):
    for name in ("thin.csv", "dense.csv"):
        rewrite(name, shifted(5.0), t0="5", t0_err="0.01")
    _, answer = fit("thin.csv", "dense.csv", "--free", *free, "--quick")
    assert_finds_A(answer)
    assert answer["agree"]


@pytest.mark.slow
def test_curves_with_one_floor_of_noise_are_misfits_not_contradictions(fit):
    for name in ("thin.csv", "dense.csv"):
        rewrite(name, lambda x: dataclasses.replace(x, temperature=x.temperature + 2e-5))
    out, answer = fit("thin.csv", "dense.csv")
    assert answer["verdict"] == "not consistent" and not answer["agree"]
    assert "thin: chi^2 is" in out and "dense: chi^2 is" in out  # the misfit of each
    assert "a noise floor in T" in out
    assert answer["A_low"] < 3e-6 < answer["A_high"]


def test_a_drop_test_stands_alone(fit):
    out, answer = fit("--drop-test", "alone.csv")
    assert_finds_A(answer)
    assert ".png" not in out  # there is no curve to draw
    assert "drops    20 impacts" in out and answer["verdict"] == "determined"


@pytest.mark.slow
def test_a_late_clock_is_told_and_leaves_A_determined(measured, run):
    rewrite("thin.csv", shifted(1e4), "late.csv")
    status, out, err = run("fit", "late.csv", "--free", "A", "t0", "--quick")
    assert status == 0 and "warning: " in err and "--free A t0" in err
    assert "t = 10000.1 .. 10050 s" in out
    answer = json.loads(out.splitlines()[-1])
    assert_finds_A(answer)
    assert answer["t0"] == pytest.approx(1e4, abs=0.1)


def test_a_question_comes_before_the_error_that_it_explains(measured, run, monkeypatch):
    def fail(*args, **options):
        raise RuntimeError("no curve")

    rewrite("thin.csv", lambda x: dataclasses.replace(x, times=1e7 * x.times), "steps.csv")
    monkeypatch.setattr("jaxgran.fit", fail)  # which would take the largest number of steps
    status, _, err = run("fit", "steps.csv", "--quick")
    check, error = err.splitlines()[-2:]
    assert status == 2 and "is t counted in steps or frames" in check and error == "error: no curve"


@pytest.mark.slow
def test_a_single_curve_begins_with_the_range(measured, fit):
    text = (measured / "thin.csv").read_text()
    (measured / "thin.csv").write_text("# absent: walls\n" + text)
    out, answer = fit("thin.csv", "--absent", "roughness", "drag")
    assert out.startswith(f"A = {answer['A']:.3g} s, 95 % range {answer['A_low']:.3g} to ")
    assert list(answer)[:3] == ["A", "A_low", "A_high"] and answer["verdict"] == "determined"
    assert "assuming no other effect" in out and "absent: walls, roughness, drag" in out
    assert not any(word in out for word in ("walls that dissipate", "rough grains", "linear drag"))
    in_python = jaxgran.fit(
        jaxgran.read_measurement("thin.csv", {"absent": "walls roughness drag"})
    )
    ends = [float(end[0]) for end in in_python.ranges["dissipative_constant"]]
    assert ends == [answer["A_low"], answer["A_high"]]
    out, answer = fit("thin.csv", "--absent", "drag", "--quick", "--explain", "--overwrite")
    assert "alternatives were not compared" in out and answer["A_low"] is None
    assert "error of A, in per cent" in out and "the model's cooling rate in this scene" in out
