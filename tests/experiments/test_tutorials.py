"""The tutorials run as scripts and find what their text says."""

import re
from pathlib import Path

import pytest

from tests.experiments.scripts import run

FOLDER = Path(__file__).parents[2] / "experiments" / "tutorials"
SAID = {
    "1_fit_your_first_curve": r"A = (2\.9|3\.0)\d*e-06",
    "2_which_model": r"soft spheres +\d(\.\d)? %",
    "3_derivatives_through_chaos": r"e\+0\d times further apart",
    "4_grains_as_they_are": r"as rough spheres: A = (2|3)",
    "5_learn_a_law": r"A = (2\.9|3\.0)\d*e-06 s",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SAID)
def test_tutorial_runs(name, tmp_path):
    printed = run(FOLDER / f"{name}.py", folder=tmp_path, warning="error")
    assert re.search(SAID[name], printed), printed
