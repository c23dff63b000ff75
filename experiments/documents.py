"""Write the documents from their templates and the recorded figures.

    python experiments/documents.py [--pictures]

A script that is run with --record writes its results to `experiments/figures/NAME.json`. A template
in `experiments/templates/` is Markdown (with Jinja2) in which `{{ NAME.field | each(".1f") }}`
stands for a figure of this file, so that every number of a document comes from one field. A
template NAME.md makes `experiments/NAME.md`, or the block between the marks `<!-- NAME -->` and
`<!-- end of NAME -->` of README.md or experiments/README.md. A test compares the documents with
the output of this script. With --pictures the pictures that show only recorded figures
(`support/dot_plots.py`) are drawn, too.
"""

import argparse
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jinja2

from experiments.support.dot_plots import PLOTS
from experiments.support.record import EXPERIMENTS, FIGURES, PICTURES, figures

ROOT = EXPERIMENTS.parent
TEMPLATES = EXPERIMENTS / "templates"
FRONT = ROOT / "README.md"
BLOCKS = {"models": FRONT, "gallery": EXPERIMENTS / "README.md"}
USUAL = {"version": "0.1.0", "machine": "two-core CPU", "precision": "float64"}
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def main() -> None:
    """Write all documents."""
    as_written = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=as_written)
    parser.add_argument("--pictures", action="store_true", help="draw pictures of the figures, too")
    if parser.parse_args().pictures:
        for name, (dots, draw) in PLOTS.items():
            draw(dots(figures(name))).savefig(PICTURES / f"{Path(name).name}.png", dpi=110)
    for path, text in documents(recorded()).items():
        path.write_text(text, encoding="utf-8")


def recorded() -> dict[str, Any]:
    """Return all recorded figures, by the name of their file; those of tests in "tests"."""
    of_tests = {path.stem: figures(f"tests/{path.stem}") for path in FIGURES.glob("tests/*.json")}
    return {path.stem: figures(path.stem) for path in FIGURES.glob("*.json")} | {"tests": of_tests}


def documents(found: dict[str, Any]) -> dict[Path, str]:
    """Return the text of each generated document, by its path."""
    blanks = {"trim_blocks": True, "lstrip_blocks": True, "keep_trailing_newline": True}
    loader = jinja2.FileSystemLoader(TEMPLATES)
    environment = jinja2.Environment(loader=loader, undefined=jinja2.StrictUndefined, **blanks)
    filters = each, errors, made, measured, of, pick, power, span
    environment.filters |= {f.__name__: f for f in filters}
    written: dict[Path, str] = {}
    for template in sorted(TEMPLATES.glob("*.md")):
        name, text = template.stem, environment.get_template(template.name).render(found)
        path = BLOCKS.get(name, EXPERIMENTS / template.name)
        if name in BLOCKS:
            text = filled(written.get(path) or path.read_text(encoding="utf-8"), name, text)
        written[path] = text
    return written


def filled(text: str, name: str, block: str) -> str:
    """Return the text with a block inserted between its marks."""
    begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    if begin not in text or end not in text:
        raise ValueError(f"the marks {begin.strip()} and {end} are missing; put them back")
    head, _, rest = text.partition(begin)
    return f"{head}{begin}{block}{end}{rest.partition(end)[2]}"


def listed(values: Any) -> list:
    return [values] if isinstance(values, int | float) else list(values)


def minus(text: str) -> str:
    return text.replace("-", "−")


def each(values: Any, style: str, scale: float = 1, sep: str = " / ", unit: str = "") -> str:
    """Format numbers, or one number, one after another: 1.0 / −2.0."""
    return sep.join(minus(format(scale * value, style)) + unit for value in listed(values))


def span(values: Iterable[float], style: str, scale: float = 1) -> str:
    """Format the range of numbers, or one number if both ends read alike."""
    values = list(values)
    low, high = (each(end, style, scale) for end in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def power(values: Any, sep: str = " / ") -> str:
    """Format numbers with one digit and a power of ten: 7·10⁻⁶."""
    parts = (f"{value:.0e}".split("e") for value in listed(values))
    return sep.join(f"{minus(digit)}·10{str(int(n)).translate(RAISED)}" for digit, n in parts)


def errors(both: tuple[Any, Any], digits: int = 1) -> str:
    """Format relative errors and their standard errors in per cent: −0.1 ± 0.2 / +0.3 ± 0.2."""
    pairs = zip(*map(listed, both), strict=True)
    return " / ".join(
        minus(f"{100 * off:+.{digits}f} ± {100 * error:.{digits}f}") for off, error in pairs
    )


def measured(both: tuple[float, float]) -> str:
    """Format a value and its standard error, this one with two digits: 3.080 ± 0.075."""
    digits = max(0, 1 - math.floor(math.log10(both[1])))
    return each(both, f".{digits}f", sep=" ± ")


def pick(rows: Iterable[Any], *keys: Any) -> list:
    """Return one field of each row; several keys lead to a field within a field."""
    rows = list(rows)
    for key in keys:
        rows = [row[key] for row in rows]
    return rows


def of(rows: Iterable[dict], **wanted: Any) -> list[dict]:
    """Return the rows with these values; a list allows several."""
    allowed = {key: value if isinstance(value, list) else [value] for key, value in wanted.items()}
    return [row for row in rows if all(row[key] in values for key, values in allowed.items())]


def made(*found: dict) -> str:
    """Return the dates of some figures, with version, machine and precision if unusual."""
    by = [figures["made_by"] for figures in found]
    words = {", ".join([b["date"], *(b[k] for k in USUAL if b[k] != USUAL[k])]) for b in by}
    return "; ".join(sorted(words))


if __name__ == "__main__":
    main()
