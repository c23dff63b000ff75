"""The documents: their figures, links and length."""

import json
import re

import pytest

import experiments.documents as documents
from experiments.support.record import EXPERIMENTS

ROOT = EXPERIMENTS.parent
DOCUMENTS = [ROOT / "README.md", ROOT / "jaxgran" / "README.md", *EXPERIMENTS.glob("*.md")]
RECORDS = sorted(EXPERIMENTS.glob("figures/**/*.json"))
ENTRY = r"^\| (.*?) ?\| (.*)<br>\[`(.*)`\]\(.*\) \| (.*?)(?: \(\[table\].*)? \| (.*) \|$"
GALLERY = re.findall(ENTRY, (EXPERIMENTS / "README.md").read_text(encoding="utf-8"), re.MULTILINE)


def test_every_figure_is_that_of_its_json():
    written = documents.documents(documents.recorded())
    stale = {path.name for path in written if path.read_text(encoding="utf-8") != written[path]}
    assert not stale, "run python experiments/documents.py"


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_figures_say_what_made_them(path):
    made = json.loads(path.read_text(encoding="utf-8"))["made_by"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d|before dates were recorded", made["date"])
    assert re.fullmatch(r"\d+\.\d+\.\d+", made["version"])
    assert made["precision"] in ("float64", "float32") and "CPU" in made["machine"]


def test_every_script_is_in_the_gallery():
    assert all((EXPERIMENTS / entry[2]).exists() for entry in GALLERY)
    shown = {EXPERIMENTS / entry[2] for entry in GALLERY}
    for group in ("fit", "accuracy", "speed", "paper"):
        assert {*EXPERIMENTS.glob(f"{group}/*.py")} <= shown


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
