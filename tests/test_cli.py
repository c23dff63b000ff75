"""The command line, run in this process."""

import dataclasses
import json
import os
import shlex
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgran
from jaxgran.cli.main import main
from jaxgran.cli.plan import read_experiment
from jaxgran.data.header import gas_of_header
from tests.beads import glass_beads

PNG = b"\x89PNG\r\n\x1a\n"
"""The first bytes of a PNG file."""

SCENE = "eta = 0.05\ndiameter = 2e-3\ndensity = 2500\nY = 5e7\nnu = 0.22\nT0 = 0.01\nA = 3e-6\n"


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "folder").mkdir()
    (tmp_path / "bad.toml").write_text("eta : 0.05\n")
    (tmp_path / "tables.toml").write_text(SCENE + "[walls]\nside = 0.1\n")
    (tmp_path / "no_A.toml").write_text(SCENE.replace("A = 3e-6", ""))
    return tmp_path


@pytest.fixture
def run(capsys):
    """A function that runs a command and returns its exit status, output and errors."""

    def run(*arguments):
        status = main([str(argument) for argument in arguments])
        return status, *capsys.readouterr()

    return run


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


def test_the_curve_of_a_run_of_particles_tells_their_number(scene):
    options = ["--model", "dsmc", "--particles", "6.4e1", "--replicas", "2", "--until", "0.1"]
    assert main(["cool", "scene.toml", *options]) == 0
    _, header = jaxgran.read_curve(scene / "cooling.csv")
    assert header["N"] == "64" and header["replicas"] == "2"


def test_choose_prints_reasons(scene, run):
    status, out, _ = run("choose", "scene.toml", "--until", 10)
    assert status == 0 and "Kinetic theory: the cheapest model" in out


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two curves (errors of 2 %) and a drop test of one material; a drop test of another one."""
    folder, rng = tmp_path_factory.mktemp("measured"), np.random.default_rng(1)
    for name, phi in {"thin": 0.02, "dense": 0.08}.items():
        header = dict(line.split(" = ") for line in SCENE.splitlines()) | {"eta": str(phi)}
        gas, _ = gas_of_header(header)
        del header["A"]
        curve = jaxgran.cool(gas, jnp.geomspace(0.1, 50.0, 40))
        noisy = curve.temperature * (1 + 0.02 * rng.normal(size=40))
        rows = jaxgran.CoolingCurve(curve.times, noisy, temperature_error=0.02 * noisy)
        jaxgran.write_curve(folder / f"{name}.csv", rows, header)
    speed = np.geomspace(0.01, 1.0, 20)
    for name, A in {"drops": 3e-6, "others": 6e-6}.items():
        eps = gas.replace(dissipative_constant=A).restitution(speed)
        eps = np.minimum(eps + 0.004 * rng.normal(size=20), 1.0)
        lines = [f"{v:.6g},{e:.6g},0.004" for v, e in zip(speed, eps, strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["v,eps,eps_err", *lines]) + "\n")
    header = "# diameter: 2 mm\n# density: 2500\n# Y: 50 MPa\n# nu: 0.22\n"
    (folder / "alone.csv").write_text(header + (folder / "drops.csv").read_text())
    return folder


@pytest.fixture
def measured(scene, files):
    shutil.copytree(files, scene, dirs_exist_ok=True)
    return scene


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


def test_several_measurements_are_fitted_jointly(measured, fit):
    out, answer = fit("thin.csv", "dense.csv", "--drop-test", "drops.csv")
    assert_finds_A(answer)
    assert answer["agree"] and "do not contradict" in out
    record = json.loads((measured / "fitted" / "thin-kinetic-theory.json").read_text())
    assert set(record["weight"]) == {"thin", "dense", "drops"}
    assert sum(part[0] for part in record["weight"].values()) == pytest.approx(1.0)
    assert answer["A_low"] < 3e-6 < answer["A_high"] and answer["thin: T0"] > 0
    assert (measured / "fitted" / "thin-kinetic-theory.png").read_bytes()[:8] == PNG


def test_a_contradicting_drop_test_is_reported(fit):
    # As many measurements as above, so that the program is compiled already.
    out, answer = fit("thin.csv", "dense.csv", "--drop-test", "others.csv")
    # N is not in the files: what speaks against A is that the curves need runs of 5 grains.
    assert not answer["agree"] and answer["p_value"] < 1e-3
    assert "thin: the curve scatters as" in out
    assert "contradict each other, or the model" in out


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
    assert "drops    20 impacts" in out and answer["verdict"] == "determined"


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
    assert status == 2 and "is it in steps or frames" in check and error == "error: no curve"


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


BAD_INPUT = {
    "melt": "melt",
    "fit": "no curve is given",
    "fit nowhere.csv": "no such file",
    "fit folder": "not a text file",
    "fit scene.toml --free Z": "Z",
    "cool": "SCENE",
    "cool nowhere.toml --until 1": "no such file",
    "cool scene.toml": "Give the last one, in s, as --until",
    "cool scene.toml --until -1": "--until must lie above",
    "cool scene.toml --until 1 --out nowhere/a.csv": "cannot write",
    "cool scene.toml --until 1 --out folder --overwrite": "cannot write",
    "cool scene.toml --until 1 --out a.png": "--out must not end in .png, got a.png",
    "fit nowhere.csv --particles 1.5": "a whole number below 2^63, got 1.5",
    "cool scene.toml --until 1 --key 1e30": "whole number below 2^63",
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
    "fit thin.csv --set 'T0=2 kg'": "--set: header line T0: 'kg' is not known",
    "fit thin.csv --set youngs=1": "give KEY=VALUE with KEY one of",
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


@pytest.mark.parametrize("variable, value", [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_a_terminal_without_colours_gets_no_escape_codes(capsys, monkeypatch, variable, value):
    monkeypatch.setenv(variable, value)
    assert main(["fit", "--help"]) == 0 and main(["melt"]) == 2
    out, err = capsys.readouterr()
    assert "\x1b" not in out + err


@pytest.fixture
def cache_of(monkeypatch):
    """A function that runs a command as in a new process; it returns the folder of its programs."""
    monkeypatch.delenv("JAXGRAN_NO_CACHE", raising=False)
    monkeypatch.setenv("XLA_FLAGS", "")
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)

    def cache_of(folder):
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
        assert main(["choose", "none.toml", "--until", "1"]) == 2
        return jax.config.values["jax_compilation_cache_dir"]

    yield cache_of
    jax.config.update("jax_compilation_cache_dir", before)


def test_the_compilation_cache_is_used_if_possible(tmp_path, monkeypatch, cache_of):
    (tmp_path / "file").write_text("")
    assert cache_of(tmp_path / "file") is None
    monkeypatch.setenv("JAXGRAN_NO_CACHE", "1")
    assert cache_of(tmp_path) is None
    monkeypatch.setenv("JAXGRAN_NO_CACHE", "0")
    programs = tmp_path / "jaxgran" / "compiled"
    assert cache_of(tmp_path) == str(programs)
    assert programs.stat().st_mode & 0o777 == 0o700
    assert cache_of(tmp_path / "others") == str(programs)  # one is set already


def test_a_cache_folder_that_others_can_write_is_not_used(tmp_path, cache_of):
    shared = tmp_path / "jaxgran" / "compiled"
    shared.mkdir(parents=True)
    shared.chmod(0o777)
    assert cache_of(tmp_path) is None


@pytest.mark.slow
def test_the_second_run_of_a_command_compiles_nothing(scene):
    """Run the command in separate processes, without a display; 30 s."""
    environment = {"XDG_CACHE_HOME": str(scene), "PATH": os.environ["PATH"], "HOME": str(scene)}
    environment |= {"PYTHONPATH": os.pathsep.join(sys.path)}
    cache = scene / "jaxgran" / "compiled"

    def run(*more):
        line = "import sys; from jaxgran.cli.main import main; sys.exit(main(sys.argv[1:]))"
        command = [sys.executable, "-c", line, "cool", "scene.toml", "--until", "1", "--overwrite"]
        done = subprocess.run(
            [*command, *more], env=environment, cwd=scene, capture_output=True, text=True
        )
        assert done.returncode == 0 and not done.stderr
        return {path.name for path in cache.glob("*-cache")}

    assert not run("--no-cache")
    first = run()
    assert first and run() == first


EXPERIMENT = """
[experiment]
times = {number = 10, first = 0.1, last = 10.0}
T_err = 0.02
N = 250
absent = ["walls", "drag"]
"""


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
        ("last = 10.0", "last = 0.05", "last must lie after first"),
        (", last = 10.0", "", "give times = [0.1, 0.3, 1.0] or times = {number"),
        ("times = {number = 10, first = 0.1, last = 10.0}", "", "[experiment] has no times"),
        ("N = 250", "N = 250\nT_eror = 1", "[experiment] T_eror is not known: give some of times"),
        ("N = 250", "N = 2.5", "N"),
        ("N = 250", "", "a plan needs N"),
        ("T_err = 0.02", "T_rot_err = 0.02", "T_rot_err needs rough grains: give beta_t"),
        ("[experiment]", "[flight]", "[flight] is not read"),
    ],
)
def test_what_makes_no_experiment_is_refused(scene, run, old, new, message):
    assert old in EXPERIMENT
    (scene / "flight.toml").write_text(SCENE + EXPERIMENT.replace(old, new))
    status, _, err = run("plan", "flight.toml")
    assert status == 2 and message in err, err


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


@pytest.mark.slow
@pytest.mark.minutes
def test_reports_are_single_pages(scene, run):
    (scene / "flight.toml").write_text(SCENE + EXPERIMENT)
    assert run("plan", "flight.toml", "--report")[0] == 0
    header = {"eta": 0.05, "diameter": 2e-3, "density": 2500, "Y": 5e7, "nu": 0.22, "T0": 0.01}
    measured = read_experiment(scene / "flight.toml")
    # A run of 250 grains, measured with errors of 2 %.
    model = jaxgran.DSMC(250)
    run_of_N = jaxgran.cool(measured.gas, measured.curve.times, model=model, key=jax.random.key(1))
    noise = 1 + 0.02 * np.random.default_rng(0).standard_normal(measured.curve.times.size)
    T = np.asarray(run_of_N.temperature) * noise
    curve = jaxgran.CoolingCurve(measured.curve.times, T, temperature_error=0.02 * T)
    jaxgran.write_curve("flown.csv", curve, header | {"N": 250, "absent": "walls"})
    options = "--report", "--imitate", 2, "--out", "."
    status, out, _ = run("fit", "flown.csv", *options)
    assert status == 0 and "of 2 imitations, its median width is" in out
    for name, words, pictures in (
        ("flight-plan.html", "Which range of A will this experiment give", 1),
        ("flown-kinetic-theory.html", "What to measure next", 2),
    ):
        page = (scene / name).read_text()
        assert words in page and page.count("data:image/png;base64,iVBOR") == pictures
        assert "<script" not in page and str(scene) not in page
