"""The recorded results, and the documents beside the code: what made them, and links."""

import json
import re

import pytest

from experiments.support.record import EXPERIMENTS

ROOT = EXPERIMENTS.parent
DOCUMENTS = [ROOT / "README.md", ROOT / "jaxgran" / "README.md", EXPERIMENTS / "README.md"]
RECORDS = sorted(EXPERIMENTS.glob("recorded/**/*.json"))
GALLERY = (ROOT / "docs" / "pages" / "gallery.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_results_say_what_made_them(path):
    made = json.loads(path.read_text(encoding="utf-8"))["made_by"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d|before dates were recorded", made["date"])
    assert re.fullmatch(r"\d+\.\d+\.\d+", made["version"])
    assert made["precision"] in ("float64", "float32") and "CPU" in made["machine"]


def test_every_script_is_in_the_gallery():
    shown = set(re.findall(r"\b\w+/\w+\.py\b", GALLERY))
    for group in ("fit", "accuracy", "speed", "paper"):
        assert {f"{group}/{script.name}" for script in EXPERIMENTS.glob(f"{group}/*.py")} <= shown


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    text = path.read_text(encoding="utf-8")
    for target, _, anchor in re.findall(r"\]\(([^)#:\s]*)(#([^)\s]*))?\)", text):
        other = path if target == "" else path.parent / target
        assert other.exists(), f"{path.name} links to {target}, which is not there"
        if anchor:
            heads = re.findall(r"^#+ (.*)$", other.read_text(encoding="utf-8"), re.MULTILINE)
            names = [re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads]
            assert anchor in names, f"{path.name}: {other.name} has no heading {anchor}"


def test_the_table_of_faults_names_tests_that_exist():
    text = (ROOT / "tests" / "faults.md").read_text()
    named = re.findall(r"([\w/]+\.py)(?:::(\w+)(?:\[(.*?)\])?)?", text.partition("|---")[2])
    assert len(named) > 40
    for file, function, case in named:
        code = (ROOT / "tests" / file).read_text()
        assert not function or f"def {function}(" in code, function
        assert not case or f'"{case}"' in code, case
