"""The documents: their figures, pictures made of these, links and length."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import experiments.documents as documents
from experiments.support.dot_plots import PLOTS, Dot, drawn
from experiments.support.record import figures

ROOT = Path(__file__).parents[2]
EXPERIMENTS = ROOT / "experiments"
DOCUMENTS = [ROOT / "README.md", ROOT / "jaxgran" / "README.md", *EXPERIMENTS.glob("*.md")]
RECORDS = sorted(EXPERIMENTS.glob("figures/**/*.json"))
ENTRY = r"^\| (.*?) ?\| (.*)<br>\[`(.*)`\]\(.*\) \| (.*?)(?: \(\[table\].*)? \| (.*) \|$"
GALLERY = re.findall(ENTRY, (EXPERIMENTS / "README.md").read_text(encoding="utf-8"), re.MULTILINE)


def stale(found):
    written = documents.documents(found)
    return {path.name for path in written if path.read_text(encoding="utf-8") != written[path]}


def test_every_figure_is_that_of_its_json():
    assert not stale(documents.recorded()), "run python experiments/documents.py"


def test_a_changed_figure_is_found():
    text = json.dumps(documents.recorded()).replace('"run_s": ', '"run_s": 3')
    assert stale(json.loads(text)) == {"README.md", "speed.md", "speed_vs_error.md"}


def test_a_missing_figure_is_an_error():
    found = documents.recorded()
    del found["benchmark_dsmc"]["rows"][0]["collisions_per_s"]
    with pytest.raises(KeyError, match="collisions_per_s"):
        documents.documents(found)


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: path.stem)
def test_figures_say_what_made_them(path):
    made = json.loads(path.read_text(encoding="utf-8"))["made_by"]
    assert re.fullmatch(r"\d{4}-\d\d-\d\d|before dates were recorded", made["date"])
    assert re.fullmatch(r"\d+\.\d+\.\d+", made["version"])
    assert made["precision"] in ("float64", "float32") and "CPU" in made["machine"]


@pytest.mark.parametrize("entry", GALLERY, ids=lambda entry: entry[2])
def test_entries_of_the_gallery_are_short(entry):
    picture, question, script, finding, time = entry
    assert len(finding.split()) <= 15 and finding.endswith(".")
    assert question.endswith("?") and re.search(r"\d+ (s|min)", time)
    assert picture or script.endswith(("compare_versions.py", "particle_statistics.py"))


def markers(axes):
    """The markers of a plot that are drawn, without those of its legend."""
    found = [line for line in axes.lines if line.get_marker() in "os"]
    return [np.asarray(line.get_xydata())[0] for line in found if np.size(line.get_xdata())]


@pytest.mark.parametrize("name", PLOTS)
def test_recorded_figures_can_be_drawn(name):
    dots_of, draw = PLOTS[name]
    dots = list(dots_of(figures(name)))
    axes = draw(dots).axes[0]
    labels = [tick.get_text() for tick in axes.get_yticklabels()]
    assert labels == list(dict.fromkeys(dot.label for dot in dots))
    # One marker for each dot, at its value.
    assert sorted(x for x, _ in markers(axes)) == sorted(dot.value for dot in dots)


def test_dots_of_one_label_share_a_line_and_bars_span_their_range():
    dots = [Dot("a", 2.0, 1.0, 3.0), Dot("a", 4.0, hollow=True), Dot("b", 5.0)]
    axes = drawn(dots, "x").axes[0]
    assert [y for _, y in markers(axes)] == [0, 0, 1]
    (bar,) = [line for line in axes.lines if np.size(line.get_xdata()) == 2]
    assert list(np.asarray(bar.get_xdata())) == [1.0, 3.0]


def test_every_script_is_in_the_gallery():
    assert all((EXPERIMENTS / entry[2]).exists() for entry in GALLERY)
    shown = {EXPERIMENTS / entry[2] for entry in GALLERY}
    for group in ("fit", "accuracy", "speed", "paper"):
        assert {*EXPERIMENTS.glob(f"{group}/*.py")} <= shown


def test_every_picture_is_made_by_a_script():
    text = "".join(p.read_text(encoding="utf-8") for p in EXPERIMENTS.rglob("*.py"))
    drawn = {Path(name).name for name in documents.PLOTS} | {"flow_memory"}  # an older script
    for picture in EXPERIMENTS.glob("pictures/*.png"):
        name = picture.stem.removeprefix("fit_")
        quoted = any(f'"{each}"' in text for each in (picture.stem, name))
        written = picture.stem in drawn or quoted or f"def {name}(" in text
        assert written, f"no script writes {picture.name}"


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


@pytest.mark.parametrize("name", ["accuracy.md", "speed.md"])
def test_commands_of_the_tables_are_there(name):
    text = (EXPERIMENTS / name).read_text(encoding="utf-8")
    commands = " ".join(re.findall(r"`(python .*?|pytest .*?)`", text))
    for file in re.findall(r"\S+\.(?:py|csv)", commands):
        assert (ROOT / file).exists(), f"{name}: no {file}"


@pytest.mark.slow
def test_python_of_the_documents_runs():
    names, pages = {}, (ROOT / "README.md", EXPERIMENTS / "guide.md")
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        exec(block, names)
    assert names["sweep"].shape == (1000, 50) and names["slope"].shape == (50,)
    assert names["curve"].rotational_temperature.shape == (50,)
