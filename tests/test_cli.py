"""The command line, in this process."""

import jax
import pytest

import jaxgran
from jaxgran.cli.app import FREE, main

SCENE = "eta = 0.05\ndiameter = 2e-3\ndensity = 2500\nY = 5e7\nnu = 0.22\nT0 = 0.01\nA = 3e-6\n"


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "folder").mkdir()
    (tmp_path / "units.toml").write_text(SCENE + 'time_unit = "ms"\n')
    (tmp_path / "bad.toml").write_text("eta : 0.05\n")
    (tmp_path / "no_A.toml").write_text(SCENE.replace("A = 3e-6", ""))
    return tmp_path


def test_cool_writes_the_curve_of_the_package(scene, capsys):
    assert main(["cool", "scene.toml", "--until", "10"]) == 0
    curve, header = jaxgran.read_curve(scene / "cooling.csv")
    gas = jaxgran.read_gas(header).replace(dissipative_constant=3e-6)
    expected = jaxgran.cool(gas, curve.times)
    assert jax.numpy.allclose(curve.temperature, expected.temperature, rtol=1e-12)  # 17 digits
    assert "written  cooling.csv" in capsys.readouterr().out
    assert main(["cool", "scene.toml", "--until", "10"]) == 2
    assert "exists; name another --out" in capsys.readouterr().err


def test_choose_says_why(scene, capsys):
    assert main(["choose", "scene.toml", "--until", "10"]) == 0
    assert "Kinetic theory: the cheapest model" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["melt"], "melt"),
        (["fit"], "no curve is given"),
        (["fit", "nowhere.csv"], "no such file"),
        (["fit", "folder"], "not a text file"),
        (["fit", "scene.toml", "--free", "Z"], "Z"),
        (["fit", "scene.toml", "--replicas", "many"], "many"),
        (["cool"], "SCENE"),
        (["cool", "nowhere.toml", "--until", "1"], "no such file"),
        (["cool", "scene.toml"], "give the last one, in s, as --until"),
        (["cool", "scene.toml", "--until", "-1"], "--until must lie above"),
        (["cool", "scene.toml", "--until", "1", "--out", "nowhere/a.csv"], "cannot write"),
        (["cool", "scene.toml", "--until", "1", "--out", "folder", "--overwrite"], "cannot write"),
        (["cool", "units.toml", "--until", "1"], "a TOML scene is in SI"),
        (["cool", "bad.toml", "--until", "1"], "not TOML"),
        (["choose", "no_A.toml", "--until", "1"], "does not give A"),
    ],
)
def test_bad_input_is_answered_with_one_line(scene, capsys, arguments, words):
    assert main(arguments) == 2
    said, told = capsys.readouterr()
    assert told.startswith("error: ") and words in told and len(told.splitlines()) == 1
    assert not said and not (scene / "results").exists()


@pytest.mark.parametrize("command", [[], ["fit"], ["cool"], ["choose"]])
def test_help_is_there(capsys, command):
    assert main([*command, "--help"]) == 0
    assert "Usage: jaxgran" in capsys.readouterr().out


def test_every_parameter_of_a_fit_has_its_name():
    from jaxgran.cli.fit import PARAMETERS

    assert set(PARAMETERS) == set(FREE.__args__)
