"""The tutorials run as scripts and find what their text says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "experiments" / "tutorials"


@pytest.mark.parametrize(
    "name, said",
    [
        pytest.param("1_fit_your_first_curve", r"A = (2\.9|3\.0)\d*e-06", marks=pytest.mark.slow),
        pytest.param("2_which_model", r"soft spheres +\d(\.\d)? %", marks=pytest.mark.slow),
        pytest.param(
            "3_derivatives_through_chaos", r"e\+0\d times further apart", marks=pytest.mark.slow
        ),
        pytest.param(
            "4_grains_as_they_are", r"as rough spheres: A = (2|3)", marks=pytest.mark.slow
        ),
        ("5_learn_a_law", r"A = (2\.9|3\.0)\d*e-06 s"),
    ],
)
def test_tutorial_runs(name, said, tmp_path):
    command = [sys.executable, "-W", "error::UserWarning", FOLDER / f"{name}.py"]
    environment = os.environ | {"MPLBACKEND": "agg"}
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=tmp_path, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.search(said, done.stdout), done.stdout
