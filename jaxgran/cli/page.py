"""Reports as web pages: one file with its pictures, made by one template without scripts."""

import base64
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from jaxgran._utils.extras import import_extra
from jaxgran.data.files import write_atomically
from jaxgran.fitting.plan import Plan
from jaxgran.fitting.report import (
    BUDGET_PARTS,
    ParameterRow,
    alternative_table,
    parameter_rows,
)
from jaxgran.fitting.result import Fit
from jaxgran.scene.parameters import symbol_of

TEMPLATE = Path(__file__).with_name("page.html")
"""The page, in the language of jinja2."""

QUESTIONS = {
    "fit": "Which {symbol} explains these measurements?",
    "plan": "Which range of {symbol} will this experiment give, and what would narrow it?",
}
"""The question that the page of a command answers."""


@dataclass(frozen=True)
class Section:
    """A part of a page.

    Attributes:
        title: its heading.
        sentences: paragraphs.
        head, rows: of a table.
        picture: a PNG file in base64; "" without one.
    """

    title: str
    sentences: Sequence[str] = ()
    head: Sequence[str] = ()
    rows: Sequence[Sequence[str]] = ()
    picture: str = ""


def write_page(
    path: Path,
    *,
    title: str,
    question: str,
    answer: str,
    sections: Sequence[Section],
    command: str,
) -> None:
    """Write a page.

    Args:
        path: of the HTML file.
        title, question, answer: what stands first.
        sections: the parts below.
        command: that made it.

    Raises:
        ModuleNotFoundError: without jinja2.
    """
    jinja2 = import_extra("jinja2", "report")
    environment = jinja2.Environment(
        autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    made_by = f"{command}\njaxgran {version('jaxgran')}, Python {platform.python_version()}"
    text = environment.from_string(TEMPLATE.read_text("utf-8")).render(
        title=title, question=question, answer=answer, sections=sections, made_by=made_by
    )
    write_atomically(path, lambda file: file.write(text.encode()))


def sections_of_fit(result: Fit, picture: Path | None) -> list[Section]:
    """Return the parts of the page of a fit: the answer, alternatives, errors and input."""
    shown = "" if picture is None else _encoded(picture)
    sentences = [text for text in (result.verdict, result.narrowing) if text]
    sections = [Section("The curve and its fit", sentences, picture=shown)]
    alternatives = alternative_table(result)
    if alternatives.rows:
        title = "Other explanations"
        sections.append(Section(title, head=alternatives.head, rows=alternatives.rows))
    sections += map(_section_of_budget, parameter_rows(result))
    sections.append(Section("Reasons", result.reasons))
    for label, m in result.measurements.items():
        title = "The input as it was read"
        title = f"{title}: {label}" if label else title
        sections.append(Section(title, head=("key", "value, SI"), rows=m.header))
    return sections


def _section_of_budget(row: ParameterRow) -> Section:
    """Return the parts of the error of a parameter, the largest first."""
    cells = [
        (name, f"{size:.2g}", BUDGET_PARTS.get(name, "uncertainty of this input"))
        for name, size in row.largest_parts
    ]
    title = f"What the error of {row.parameter} consists of"
    size_in_unit = f"size, {row.unit}" if row.unit else "size"
    return Section(title, head=("part", size_in_unit, "meaning"), rows=cells)


def sections_of_plan(planned: Plan, picture: Path, title: str = "What to measure") -> list[Section]:
    """Return the parts of a page on what to measure."""
    head, rows = planned.table
    section = Section(
        title, sentences=planned.notes, head=head, rows=rows, picture=_encoded(picture)
    )
    return [section]


def question_of(command: str, parameter: str) -> str:
    """Return the question that the page of a command answers, in a sentence."""
    return QUESTIONS[command].format(symbol=symbol_of(parameter))


def command_of(name: str, files: Sequence[Path]) -> str:
    """Return the command of a page, with the names of its files alone."""
    return " ".join(["jaxgran", name, *(file.name for file in files)])


def _encoded(picture: Path) -> str:
    return base64.b64encode(picture.read_bytes()).decode()
