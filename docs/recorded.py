"""Numbers of the pages, from the recorded results, when the site is built (mkdocs-macros).

A script that is run with --record writes its results to `experiments/recorded/NAME.json`. In a page
whose head says `render_macros: true`, `{{ NAME.field | each(".1f") }}` stands for a number of this
file, so that every number of a page comes from one field; results of tests are in `tests.NAME`.
"""

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jinja2

MACROS = Path(__file__).parent / "macros"
RECORDED = Path(__file__).parents[1] / "experiments" / "recorded"
USUAL = {"machine": "two-core CPU", "precision": "float64"}
RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def define_env(env: Any) -> None:
    """Give the recorded results and the formats of numbers to the pages."""
    env.filters.update(formats())
    env.variables.update(results())


def on_pre_page_macros(env: Any) -> None:
    """Find `macros/`; let lines of statements leave no blank lines, which would end a table."""
    env.env.loader = jinja2.FileSystemLoader(MACROS)
    env.env.trim_blocks = True
    env.env.lstrip_blocks = True


def formats() -> dict[str, Any]:
    """Return the filters of the pages by name."""
    functions = each, errors, made, measured, of, pick, power, span
    return {function.__name__: function for function in functions}


def results() -> dict[str, Any]:
    """Return all recorded results, by the name of their file; those of tests in "tests"."""
    of_tests = {path.stem: read(path) for path in RECORDED.glob("tests/*.json")}
    return {path.stem: read(path) for path in RECORDED.glob("*.json")} | {"tests": of_tests}


def read(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8"))


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
    """Return version and date of some results, with machine and precision if unusual."""
    by = [results["made_by"] for results in found]
    words = {
        ", ".join([b["version"], b["date"], *(b[k] for k in USUAL if b[k] != USUAL[k])]) for b in by
    }
    return "; ".join(sorted(words))
