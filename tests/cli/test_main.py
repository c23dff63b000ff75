"""The commands: what they write and say, and bad input."""

import shlex

import jax
import numpy as np
import pytest

import jaxgran
from jaxgran.cli.main import main
from tests.beads import glass_beads
from tests.cli.scenes import PNG, SCENE


def test_cool_writes_the_curve_of_the_package(scene, run):
    status, out, _ = run("cool", "scene.toml", "--until", 10)
    assert status == 0 and "written  cooling.csv\n         cooling.png" in out
    measurement = jaxgran.read_measurement(scene / "cooling.csv")
    curve = measurement.curve
    expected = jaxgran.cool(measurement.gas, curve.times)
    assert jax.numpy.allclose(curve.temperature, expected.temperature, rtol=1e-12)  # 17 digits
    assert (scene / "cooling.png").read_bytes()[:8] == PNG
    status, _, err = run("cool", "scene.toml", "--until", 10)
    assert status == 2 and "exists. Name another --out" in err
    status, out, _ = run("cool", "scene.toml", "--until", 10, "--particles", 1, "--out", "one.csv")
    assert status == 0 and "written  one.csv" in out  # theory has no particles


@pytest.mark.slow
def test_the_curve_of_a_run_of_particles_tells_their_number(scene):
    options = ["--model", "dsmc", "--particles", "6.4e1", "--replicas", "2", "--until", "0.1"]
    assert main(["cool", "scene.toml", *options]) == 0
    _, header = jaxgran.read_curve(scene / "cooling.csv")
    assert header["N"] == "64" and header["replicas"] == "2"


@pytest.mark.slow
def test_a_computed_curve_begins_with_the_gas_and_keeps_no_key_of_a_measurement(scene):
    head = SCENE.replace(" = ", ": ").replace("\n", "\n# ")
    keys = "t0: 5\n# t0_err: 1\n# tracked: 100\n# T_scale_err: 0.01"
    (scene / "late.csv").write_text(f"# {head}{keys}\nt,T\n5.1,0.0095\n6,0.006\n8,0.003\n")
    assert main(["cool", "late.csv", "--model", "dsmc", "--particles", "64"]) == 0
    curve, header = jaxgran.read_curve(scene / "cooling.csv")
    np.testing.assert_allclose(curve.times, [0.1, 1.0, 3.0], rtol=1e-12)
    assert {"t0", "tracked", "T_scale_err"}.isdisjoint(header)


@pytest.mark.slow
def test_the_number_of_a_container_is_that_of_its_density(scene):
    box = "container_side = 0.02\nwall_restitution = 0.9\n"
    (scene / "box.toml").write_text(SCENE + box)
    assert main(["cool", "box.toml", "--model", "dsmc", "--until", "0.1"]) == 0
    _, header = jaxgran.read_curve(scene / "cooling.csv")
    expected = jaxgran.read_measurement(scene / "cooling.csv").gas.number_density * 0.02**3
    assert int(header["N"]) == pytest.approx(float(expected), abs=0.5)


def test_choose_prints_reasons(scene, run):
    status, out, _ = run("choose", "scene.toml", "--until", 10)
    assert status == 0 and "Kinetic theory: the fastest model" in out


BAD_INPUT = {
    "melt": "melt",
    "fit": "no curve is given",
    "fit nowhere.csv": "no such file",
    "fit folder": "not a text file",
    "fit scene.toml --free Z": "Z",
    "fit thin.csv --absent wall": "--absent",
    "cool": "SCENE",
    "cool nowhere.toml --until 1": "no such file",
    "cool scene.toml": "Give the last one, in s, as --until",
    "cool scene.toml --until -1": "--until must lie above",
    "cool scene.toml --until 1 --out nowhere/a.csv": "cannot write",
    "cool scene.toml --until 1 --out folder --overwrite": "cannot write",
    "cool scene.toml --until 1 --out a.json": "--out must end in .csv or .npz, got a.json",
    "cool guess.toml --until 1": "beta_t is a guess. Give its value",
    "fit thin.csv --onto-plate": "--onto-plate belongs to --drop-test",
    "cool scene.toml --until 1 --out a.png": "--out must not end in .png, got a.png",
    "fit nowhere.csv --particles 1.5": "a whole number between -2^63 and 2^63, got 1.5",
    "cool scene.toml --until 1 --key 1e30": "whole number between -2^63",
    "fit nowhere.csv --tolerance nan": "--tolerance must lie in (0, inf), got nan",
    "cool bad.toml --until 1": "not TOML",
    "cool tables.toml --until 1": "[walls] is not read: write all keys without tables",
    "choose no_A.toml --until 1": "does not give A",
    "fit thin.csv thin.csv": "given twice",
    "fit thin.csv dense.csv --model dsmc": "fitted with kinetic-theory",
    "fit thin.csv dense.csv --free T0 --set A=3e-6": "share none of these",
    "fit thin.csv --drop-test dense.csv": "is a cooling curve. Give it without --drop-test",
    "fit drops.csv": "the gas of a curve, by gas=... or by jaxgran fit CURVE.csv --drop-test",
    "fit thin.csv alone.csv": "is a drop test. Give it as --drop-test alone.csv",
    "fit --drop-test drops.csv": "of this drop test lacks diameter, density, Y, nu",
    "fit thin.csv --free A beta_t": "Give the header line `# beta_t: guess`",
    "fit thin.csv --set beta_t=guess": "the value of beta_t is a guess: free it, too",
    "fit thin.csv --set 'T0=2 kg'": "header line T0: 'kg' is not known",
    "fit thin.csv dense.csv --imitate 5": "--imitate takes a fit of one curve",
    "fit thin.csv --imitate 1": "--imitate 1: give 2 or more runs",
    "fit thin.csv --set youngs=1": "give KEY=VALUE with KEY one of",
    "fit thin.csv --set A=1e-6 A=2e-6": "--set gives A twice, 1e-6 and 2e-6",
    "fit thin.csv --set N=many": "header line N",
    "fit thin.csv --set Y=0.05": "in Pa",
    "fit thin.csv --free T0": "leaves A fixed",
    "fit thin.csv --model dsmc --particles 0": "num_particles must be a whole",
    "fit thin.csv --out scene.toml": "is not a writable folder",
}


@pytest.mark.parametrize("arguments", BAD_INPUT)
def test_bad_input_is_answered_with_one_line(measured, run, arguments):
    status, out, err = run(*shlex.split(arguments))
    *checks, error = err.splitlines()
    assert status == 2 and error.startswith("error: ") and BAD_INPUT[arguments] in error
    assert len(checks) == ("Y=0.05" in arguments)  # an unusual value is asked about
    assert not out and not (measured / "results").exists()


@pytest.mark.parametrize("fault, code", [(KeyboardInterrupt, 130), (BrokenPipeError, 0)])
def test_interrupts_and_closed_pipes_end_quietly(scene, monkeypatch, capfd, fault, code):
    def stop(*args, **options):
        raise fault

    monkeypatch.setattr("jaxgran.choose_model", stop)
    monkeypatch.setattr("os.dup2", lambda *files: None)  # the output goes on after the test
    assert main(["choose", "scene.toml", "--until", "1"]) == code
    assert capfd.readouterr().err == ("interrupted\n" if code else "")


@pytest.mark.parametrize("command", [[], ["fit"], ["cool"], ["choose"]])
def test_every_command_has_help(run, command):
    status, out, _ = run(*command, "--help")
    assert status == 0 and "Usage: jaxgran" in out


@pytest.mark.parametrize("variable, value", [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_a_terminal_without_colours_gets_no_escape_codes(capsys, monkeypatch, variable, value):
    monkeypatch.setenv(variable, value)
    assert main(["fit", "--help"]) == 0 and main(["melt"]) == 2
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err


def test_models_are_found_by_their_names(measured, run, monkeypatch):
    fitted = []

    def fit(*measured, model, **options):
        fitted.append(model)
        raise RuntimeError("no fit")

    monkeypatch.setattr("jaxgran.fit", fit)
    candidates = jaxgran.choose_model(glass_beads(), [1.0]).candidates
    names = [c.model.name.lower().replace(" ", "-") for c in candidates]
    for name, candidate in zip(names, candidates, strict=True):
        run("fit", "thin.csv", "--model", name, "--particles", 100)
        kind, model = type(candidate.model), fitted.pop()
        assert model == (kind(100, replicas=3) if kind.stochastic else kind())
        *_, error = run("fit", "thin.csv", "--model", name)
        assert ("thin.csv does not give N. Add --particles." in error) == kind.stochastic
    names = ", ".join(f'"{name}"' for name in names)
    assert f"Choose from: {names}." in run("cool", "scene.toml", "--model", "best")[2]
    assert f'Choose from: {names}, "auto".' in run("fit", "thin.csv", "--model", "best")[2]


@pytest.mark.parametrize("command", ["fit thin.csv", "cool scene.toml --until 1"])
def test_a_folder_without_permission_is_reported(measured, run, monkeypatch, command):
    monkeypatch.setattr("os.access", lambda *args: False)  # the tests may run as root
    status, out, err = run(*command.split())
    assert status == 2 and len(err.splitlines()) == 1 and "writ" in err and not out
