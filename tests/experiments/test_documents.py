"""The documents: their figures, their links and their length."""

import json
import re
from pathlib import Path

import pytest

import experiments.documents as documents
from experiments.support.record import figures
from experiments.support.tables import accuracy, gallery, speed

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "jaxgran" / "README.md", *ROOT.glob("experiments/*.md")]


EXPERIMENTS = ROOT / "experiments"
ENTRIES = [entry for entries in gallery.ENTRIES.values() for entry in entries]


def test_every_figure_is_that_of_its_json():
    for path, text in documents.documents().items():
        written = path.read_text(encoding="utf-8")
        assert written == text, f"{path.name} is stale: run python experiments/documents.py"


def test_a_changed_figure_is_found(monkeypatch):
    # The README's table and the gallery's findings come from the files, too.
    def changed(name):
        text = (EXPERIMENTS / "figures" / f"{name}.json").read_text(encoding="utf-8")
        return json.loads(text.replace('"run_s": ', '"run_s": 3'))

    monkeypatch.setattr(documents, "figures", changed)
    stale = {
        path.name
        for path, text in documents.documents().items()
        if path.read_text(encoding="utf-8") != text
    }
    assert {"README.md", "speed_vs_error.md"} <= stale


@pytest.mark.parametrize(
    "path", sorted(EXPERIMENTS.glob("figures/**/*.json")), ids=lambda p: p.stem
)
def test_figures_say_what_made_them(path):
    made = json.loads(path.read_text(encoding="utf-8"))["made_by"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d|before dates were recorded", made["date"])
    assert re.fullmatch(r"\d+\.\d+\.\d+", made["version"])
    assert made["precision"] in ("float64", "float32") and "CPU" in made["machine"]


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.script)
def test_entries_of_the_gallery_are_short(entry):
    finding = entry.finding(figures(entry.source) if entry.source else {})
    assert len(finding.split()) <= gallery.MAX_WORDS and finding.endswith(".")
    assert entry.question.endswith("?") and re.search(r"\d+ (s|min)", entry.time)
    assert (EXPERIMENTS / entry.script).exists()
    assert not entry.picture or (EXPERIMENTS / "pictures" / entry.picture).exists()
    assert not entry.table or (EXPERIMENTS / entry.table).exists()


def test_every_script_is_in_the_gallery():
    groups = ("fit", "accuracy", "speed", "paper")
    scripts = {
        str(p.relative_to(EXPERIMENTS)) for g in groups for p in EXPERIMENTS.glob(f"{g}/*.py")
    }
    assert scripts == {entry.script for entry in ENTRIES}


def test_every_picture_is_made_by_a_script():
    text = "".join(p.read_text(encoding="utf-8") for p in EXPERIMENTS.rglob("*.py"))
    for picture in EXPERIMENTS.glob("pictures/*.png"):
        name = picture.stem.removeprefix("fit_")
        assert f'"{picture.stem}"' in text or f'"{name}"' in text, (
            f"no script writes {picture.name}"
        )


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


def test_the_first_page_is_short():
    assert len((ROOT / "README.md").read_bytes()) <= 6144


@pytest.mark.parametrize("row", [*accuracy.ROWS, *speed.ROWS], ids=lambda row: row.what[:40])
def test_commands_of_the_tables_are_there(row):
    for file in re.findall(r"\S+\.(?:py|csv)", row.command):
        assert (ROOT / file).exists(), f"{row.what}: no {file}"


def _blocks(path):
    return re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.slow
def test_python_of_the_documents_runs():
    names = {}
    for block in _blocks(ROOT / "README.md") + _blocks(ROOT / "experiments" / "guide.md"):
        exec(block, names)
    assert names["sweep"].shape == (1000, 50) and names["slope"].shape == (50,)
    assert names["curve"].rotational_temperature.shape == (50,)
