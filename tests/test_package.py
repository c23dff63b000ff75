import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "jaxgran"
FILES = sorted(PACKAGE.rglob("*.py"))


def test_import_is_light():
    # jax_md alone takes seconds; x64 is the caller's choice.
    code = (
        "import sys, jaxgran, jax; "
        "assert 'jax_md' not in sys.modules and 'matplotlib' not in sys.modules; "
        "assert not jax.config.jax_enable_x64"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_no_model_is_known_by_its_class_outside_models():
    names = "KineticTheory|DSMC|HardSpheres|SoftSpheres"
    for file in FILES:
        if file.is_relative_to(PACKAGE / "models"):
            continue
        text = file.read_text()
        assert not re.search(rf"isinstance\([^)]*\b({names})\b", text), file
        assert not re.search(rf"[\[=] ?[\"']({names})[\"']", text), file
