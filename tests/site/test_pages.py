"""The site is built without a warning and fetches nothing, and the code of its pages runs."""

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import jinja2
import pytest

import jaxgran

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "pages"
TEXTS = {page.stem: page.read_text(encoding="utf-8") for page in sorted(PAGES.glob("*.md"))}
RECORDED = runpy.run_path(str(ROOT / "docs" / "recorded.py"))
PUBLIC = {*jaxgran.__all__, *(f"extend.{name}" for name in jaxgran.extend.__all__)}
PUBLIC -= {"extend", "observables"}
README = (ROOT / "README.md").read_text(encoding="utf-8")
RUN = """
import subprocess, sys
from pathlib import Path
from sybil import Sybil
from sybil.parsers.markdown import CodeBlockParser, PythonCodeBlockParser, SkipParser

def shell(example):
    subprocess.run(["bash", "-euc", example.parsed], check=True)

parsers = SkipParser(), PythonCodeBlockParser(), CodeBlockParser("bash", shell)
for example in Sybil(parsers).parse(Path(sys.argv[1])):
    example.evaluate()
"""
WRITTEN = {"plan": "plan.png", "derivatives": "sweep.png", "models": "film.gif", "index": "fit.png"}
PRINTED = {
    "plan": "ten drops + no rotation",
    "data": "Kinetic theory is consistent with this curve",
    "laws": "0.972",
    "models": "two replicas (2, 100, 3) True",
}
LONG = "devices", "plan", "scenes", "sharp_bits", "derivatives", "models", "laws"
"""Pages whose code runs for a minute or more."""
WITH_CODE = [
    pytest.param(name, marks=[pytest.mark.minutes] if name in LONG else [])
    for name, text in TEXTS.items()
    if "```python" in text
]
FETCHED = r"""<(?:script|link|img|iframe)\b[^>]*(?:src|href)=["']?(?:https?:)?//"""


@pytest.mark.slow
@pytest.mark.parametrize("name", WITH_CODE)
def test_the_code_of_a_page_runs_as_pasted(name, run, tmp_path):
    printed = run("-c", RUN, PAGES / f"{name}.md")
    assert PRINTED.get(name, "") in printed, printed
    if name in WRITTEN:
        assert (tmp_path / WRITTEN[name]).stat().st_size > 1000


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_fetches_nothing(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", "docs/mkdocs.yml", "-d"]
    variables = os.environ | {"RUN_TUTORIALS": "false"}  # they run in test_wheel.py
    done = subprocess.run(
        [*command, str(tmp_path)], cwd=ROOT, env=variables, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    pages = [*tmp_path.rglob("*.html")]
    assert len(pages) > 25
    for page in pages:
        assert not re.findall(FETCHED, page.read_text(encoding="utf-8")), page.name
    api = (tmp_path / "api.html").read_text(encoding="utf-8")
    for full in (
        *(f"jaxgran.{name}" for name in PUBLIC),
        *(f"jaxgran.particles.observables.{name}" for name in jaxgran.observables.__all__),
    ):
        assert f'id="{full}"' in api, f"{full} is not on the API page"


def test_every_public_name_is_on_the_api_page():
    shown = re.findall(r"^::: jaxgran\.(\w+|extend\.\w+)$", TEXTS["api"], re.MULTILINE)
    assert sorted(shown) == sorted(PUBLIC)


def test_the_numbers_of_the_readme_are_those_of_the_pages():
    environment = jinja2.Environment(trim_blocks=True, lstrip_blocks=True)
    environment.filters |= RECORDED["formats"]()
    page = environment.from_string(TEXTS["models"]).render(RECORDED["results"]())
    rows = [line for line in README.splitlines() if line.startswith("| `")]
    assert rows and all(row in page for row in rows)
