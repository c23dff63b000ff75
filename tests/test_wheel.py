"""The wheel alone, in a fresh environment and an empty folder, runs what a newcomer runs."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

from jaxgran.data.example import EXAMPLE_FILES

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TUTORIALS = {
    "1_fit_your_first_curve": r"A = (2\.9|3\.0)\d*e-06",
    "2_which_model": r"soft spheres +\d(\.\d)? %",
    "3_derivatives_through_chaos": r"e\+0\d times further apart",
    "4_grains_as_they_are": r"as rough spheres: A = (2|3)",
    "5_learn_a_law": r"A = (2\.9|3\.0)\d*e-06 s",
}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, made as an installer makes it."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def fresh(wheel, tmp_path_factory):
    """The programs of an environment with the wheel and what it depends on.

    The dependencies are those of this environment. Its folder is a line of a .pth file, so that
    an editable installation of jaxgran in it is not found.
    """
    folder = tmp_path_factory.mktemp("environment")
    venv.create(folder)
    paths = {"base": str(folder), "platbase": str(folder)}
    installed = sysconfig.get_path("purelib", vars=paths)
    scripts = Path(sysconfig.get_path("scripts", vars=paths))
    pip = [sys.executable, "-m", "pip", "--python", str(scripts / "python"), "install", "--no-deps"]
    subprocess.run([*pip, "--no-index", str(wheel)], check=True, capture_output=True)
    dependencies = sysconfig.get_path("purelib"), sysconfig.get_path("platlib")
    (Path(installed) / "dependencies.pth").write_text("\n".join(dependencies), encoding="utf-8")
    return scripts


@pytest.fixture
def run(fresh, tmp_path):
    """A function that runs a program of the fresh environment in an empty folder."""
    bare = {key: x for key, x in os.environ.items() if not key.startswith(("PYTHON", "XLA"))}

    def run(*arguments, program="python"):
        command = [str(fresh / program), *map(str, arguments)]
        done = subprocess.run(command, cwd=tmp_path, env=bare, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_the_package_of_the_wheel_is_found_and_stands_alone(run, fresh):
    code = (
        "import jaxgran, importlib.util as u; print(jaxgran.__file__, u.find_spec('experiments'))"
    )
    file, experiments = run("-c", code).split()
    assert Path(file).is_relative_to(fresh.parent) and experiments == "None"


def test_the_wheel_holds_the_package_alone(wheel):
    with zipfile.ZipFile(wheel) as content:
        names = set(content.namelist())
    assert {name.partition("/")[0] for name in names if "dist-info" not in name} == {"jaxgran"}
    assert {"jaxgran/py.typed", "jaxgran/data/lammps_cooling_dilute.csv"} <= names


def test_the_python_of_the_readme_runs_in_an_empty_folder(run):
    (block,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    (printed,) = re.findall(r"```python\n.*?```\s*```\n(.*?)```", README, re.DOTALL)
    found = run("-W", "error", "-c", block)
    words = re.compile(r"[\d.]+(e-?\d+)?")  # numbers differ in their last digits
    assert words.sub("0", found).split() == words.sub("0", printed).split(), found


def test_the_command_fits_a_file_in_an_empty_folder(run, tmp_path):
    shutil.copy(EXAMPLE_FILES["dilute"], tmp_path / "curve.csv")
    printed = run("fit", "curve.csv", "--free", "A", "T0", "--quick", program="jaxgran")
    assert "A   s" in printed


@pytest.mark.parametrize("name", TUTORIALS)
def test_tutorial_runs(name, run):
    printed = run("-W", "error", ROOT / "experiments" / "tutorials" / f"{name}.py")
    assert re.search(TUTORIALS[name], printed), printed
