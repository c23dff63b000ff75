"""The wheel alone, in a fresh environment and an empty folder, runs what a newcomer runs."""

import re
import shutil
import zipfile
from pathlib import Path

import pytest

from jaxgran.data.example import EXAMPLE_FILES

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TUTORIALS = {
    "1_fit_your_first_curve": r"A = (2\.9|3\.0)\d*e-06",
    "2_which_model": r"soft spheres +\d(\.\d)? %",
    "3_derivatives_through_chaos": r"e\+0\d times further apart",
    "4_grains_as_they_are": r"as rough spheres: A = (2|3)",
    "5_learn_a_law": r"A = (2\.9|3\.0)\d*e-06 s",
    "6_plan_an_experiment": r"the range held the true A in \d+ of 10 imitations",
}
LONG = [pytest.param(name, marks=pytest.mark.minutes) for name in [*TUTORIALS][1:]]

pytestmark = pytest.mark.slow


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


@pytest.mark.parametrize("name", ["1_fit_your_first_curve", *LONG])
def test_tutorial_runs(name, run):
    printed = run("-W", "error", ROOT / "docs" / "pages" / "tutorials" / f"{name}.py")
    assert re.search(TUTORIALS[name], printed), printed


def test_the_description_links_to_nothing_that_is_not_in_the_wheel(wheel):
    with zipfile.ZipFile(wheel) as content:
        (name,) = (name for name in content.namelist() if name.endswith("METADATA"))
        description = content.read(name).decode()
    targets = re.findall(r"\]\(([^)]*)\)", description)
    assert targets and all(target.startswith("https://") for target in targets)
