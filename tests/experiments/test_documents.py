"""The documents: their figures, their links and their length."""

import json
import re
from pathlib import Path

import pytest

import experiments.documents as documents

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", ROOT / "jaxgran" / "README.md", *ROOT.glob("experiments/*.md")]


@pytest.mark.parametrize("name", documents.HEADS)
def test_tables_are_what_the_figures_say(name):
    figures = json.loads((ROOT / "experiments" / "figures.json").read_text(encoding="utf-8"))
    written = (ROOT / "experiments" / f"{name}.md").read_text(encoding="utf-8")
    assert written == documents.document(name, figures), "run python experiments/documents.py"


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


@pytest.mark.parametrize("name", documents.HEADS)
def test_commands_of_the_tables_are_there(name):
    figures = json.loads((ROOT / "experiments" / "figures.json").read_text(encoding="utf-8"))
    for row in figures[name]:
        for file in re.findall(r"\S+\.(?:py|csv)", row["command"]):
            assert (ROOT / file).exists(), f"{row['what']}: no {file}"


def _blocks(path):
    return re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.slow
def test_python_of_the_documents_runs():
    names = {}
    for block in _blocks(ROOT / "README.md") + _blocks(ROOT / "experiments" / "guide.md"):
        exec(block, names)
    assert names["sweep"].shape == (1000, 50) and names["slope"].shape == (50,)
    assert names["curve"].rotational_temperature.shape == (50,)
