"""The recipes run as they are printed, each in a folder of its own."""

import re
import subprocess
import sys

import pytest

from experiments.support.record import EXPERIMENTS
from tests.experiments.scripts import run

TEXT = (EXPERIMENTS / "recipes.md").read_text(encoding="utf-8")
RECIPES = dict(re.findall(r"^## (.*?)\n.*?```python\n(.*?)```", TEXT, re.DOTALL | re.MULTILINE))
WRITTEN = {
    "Before you measure: what would narrow the range of A": "plan.png",
    "A sweep and its heat map": "sweep.png",
    "Snapshots, observables and a film": "film.gif",
    "Saving and loading everything": "run.npz",
}
SAID = {
    "Before you measure: what would narrow the range of A": "ten drops + no rotation",
    "Your own data: speeds in ms and mm": "Kinetic theory is consistent with this curve",
    "Your own law of restitution": "0.972",
    "Saving and loading everything": "two replicas (2, 100, 3) True",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_recipe_runs(name, tmp_path):
    script = tmp_path / "recipe.py"
    script.write_text(RECIPES[name], encoding="utf-8")
    if "num_cpu_devices" in RECIPES[name]:  # which must be set before JAX computes
        command = [sys.executable, "-W", "error", "recipe.py"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        printed = done.stdout
    else:
        printed = run(script, folder=tmp_path, warning="error")
    assert SAID.get(name, "") in printed, printed
    if name in WRITTEN:
        assert (tmp_path / WRITTEN[name]).stat().st_size > 1000
