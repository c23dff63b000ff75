import re
import subprocess
import sys
from pathlib import Path

import jaxgran

ROOT = Path(__file__).parent.parent
FLOORS = [
    ["domain", "status", "checkpoint", "rows"],
    ["sweep_and_prune"],
    ["neighbours"],
    ["contact", "simulation", "observables", "initial"],
    ["restitution", "encounters"],
    ["gas", "tangents"],
    ["kinetics", "closed_forms", "curve", "collisions", "flow", "room"],
    ["estimate", "given"],
    ["boxes"],
    ["blocks", "impacts", "search", "start"],
    ["events"],
    ["models.kinetic_theory", "models.dsmc", "models.hard_spheres", "models.soft_spheres"],
    ["choice"],
    ["cooling"],
    ["fitting"],
    ["diagnosis", "plotting"],
]


def test_import_is_light():
    # jax_md alone takes seconds; x64 is the caller's choice.
    code = (
        "import sys, jaxgran, jax; "
        "assert 'jax_md' not in sys.modules and 'matplotlib' not in sys.modules; "
        "assert not jax.config.jax_enable_x64"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_is_there_and_explained():
    for name in jaxgran.__all__:
        assert getattr(jaxgran, name).__doc__


def test_every_module_has_a_floor():
    files = (ROOT / "jaxgran").rglob("*.py")
    modules = {".".join(f.relative_to(ROOT / "jaxgran").with_suffix("").parts) for f in files}
    listed = [name for names in FLOORS for name in names]
    assert modules == {*listed, "__init__", "models.__init__"} and len(set(listed)) == len(listed)


def test_imports_go_one_way():
    floor = {name: i for i, names in enumerate(FLOORS) for name in names}
    for name, level in floor.items():
        text = (ROOT / "jaxgran" / (name.replace(".", "/") + ".py")).read_text()
        modules = re.findall(r"^from jaxgran\.([\w.]+) import", text, re.M)
        for names in re.findall(r"^from jaxgran import ([\w, ]+)", text, re.M):
            modules += names.split(", ")
        for module in modules:
            assert floor[module] < level, f"{name} imports {module}"
