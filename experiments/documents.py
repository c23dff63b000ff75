"""Write every figure of the documents: the tables of how wrong and how slow, the gallery, README.

    python experiments/documents.py [--pictures]

The figures come from `experiments/figures/*.json`, which the scripts write when they are run with
--record, and from nothing else. accuracy.md, speed.md, speed_vs_error.md, hard_cases.md,
wrong_physics.md, interval_coverage.md and paper_claims.md are written whole; README.md and
experiments/README.md between their marks `<!-- NAME -->` and `<!-- end of NAME -->`. A test
compares all of them with what this would write. With --pictures the pictures that
show nothing but figures (`support/dot_plots.py`) are drawn, too.
"""

import argparse
import re
from collections.abc import Iterable
from pathlib import Path

from experiments.accuracy import flow_memory, hard_cases
from experiments.fit import coverage_in_clusters, interval_coverage, wrong_physics
from experiments.paper import paper_claims
from experiments.speed import speed_vs_error
from experiments.support.claims import table as claims_table
from experiments.support.dot_plots import PLOTS, drawn
from experiments.support.record import EXPERIMENTS, FIGURES, PICTURES, figures
from experiments.support.tables import accuracy, gallery, speed
from experiments.support.tables.words import Row, between, of

ROOT = EXPERIMENTS.parent
BY = "Written by `python experiments/documents.py` from [figures](figures)"
MODELS = {
    "kinetic theory": ("`KineticTheory()`", "N/A", 1e3, "ms"),
    "DSMC": ("`DSMC(N)`", (10_000,), 1.0, "s, N = 10⁴"),
    "hard spheres": ("`HardSpheres(N)`", (2000, 3000), 1.0, "s"),
    "soft spheres": ("`SoftSpheres(N)`", (2000, 3000), 1.0, "s"),
}
"""Names, N, units of time and their words, of the models in the table of README.md."""
USES = {
    "kinetic theory": (
        "dilute gases in boxes below L_c; fits",
        "correlations, clusters, lasting contacts",
    ),
    "DSMC": ("any law, many decades of time", "positions: the same"),
    "hard spheres": ("clusters, short contacts", "lasting contacts"),
    "soft spheres": ("dense and soft gases", "β_t of impacts (it has friction)"),
}


def main() -> None:
    """Write all documents."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pictures", action="store_true", help="draw the pictures of figures, too")
    if parser.parse_args().pictures:
        for name, plot in PLOTS.items():
            drawn(plot(figures(name))).savefig(PICTURES / f"{name}.png", dpi=110)
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")


def documents() -> dict[Path, str]:
    """What each document should contain, by its path."""
    scenes = figures("speed_vs_error")["scenes"]
    memories = figures("flow_memory")
    whole = {
        "accuracy": "\n".join(
            [
                table("How wrong", accuracy.ROWS, accuracy.NOTE),
                accuracy.MEMORIES,
                flow_memory.table(memories),
                "",
                f"`python experiments/accuracy/flow_memory.py`. Made: {made([memories])}.",
                "",
                accuracy.MEMORIES_MEAN,
            ]
        ),
        "speed": table("How slow", speed.ROWS, speed.NOTE),
        "speed_vs_error": "\n\n".join(
            [
                "# Speed against error",
                f"{BY}`/speed_vs_error.json`.",
                *(
                    f"{speed_vs_error.table(name, scene)}\n\nMade: {scene['date']}."
                    for name, scene in scenes.items()
                ),
            ]
        )
        + "\n",
        "hard_cases": hard_cases.table(figures("hard_cases")["cases"]),
        "wrong_physics": wrong_physics.table(figures("wrong_physics")),
        "interval_coverage": "\n".join(
            [
                interval_coverage.table(figures("interval_coverage")),
                interval_coverage.IN_CLUSTERS,
                "",
                coverage_in_clusters.table(figures("coverage_in_clusters")),
                "",
            ]
        ),
        "paper_claims": claims(),
    }
    written = {EXPERIMENTS / f"{name}.md": text for name, text in whole.items()}
    parts = {"models": model_table(scenes), "dilute": printed("lammps_curves_dilute")}
    for path, blocks in (
        (ROOT / "README.md", parts),
        (EXPERIMENTS / "README.md", {"gallery": gallery_text()}),
    ):
        written[path] = filled(path.read_text(encoding="utf-8"), blocks)
    return written


def claims() -> str:
    """The table of the paper's claims."""
    rows = [claims_table.Row(**row) for row in figures("paper_claims")["rows"]]
    return paper_claims.HEAD + claims_table.Table(FIGURES, rows).markdown()


def filled(text: str, blocks: dict[str, str]) -> str:
    """The text with each block between its marks."""
    for name, block in blocks.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        if begin not in text or end not in text:
            raise ValueError(f"the marks {begin.strip()} and {end} are missing; put them back")
        head, _, rest = text.partition(begin)
        text = f"{head}{begin}{block}\n{end}{rest.partition(end)[2]}"
    return text


def table(title: str, rows: Iterable[Row], note: str) -> str:
    """A document with one table; the last column says when, and on what if not on two cores."""
    lines = [
        f"# {title}",
        "",
        f"{BY}. Version 0.1.0 on a two-core CPU in float64,",
        "unless the last column says otherwise; it has the day on which the command was run.",
        "",
        "| what | against | measured | command | made |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        found = [figures(source) for source in row.source.split()]
        cells = row.what, row.against, row.measured(*found), f"`{row.command}`", made(found)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", note])


def made(found: list[dict]) -> str:
    """The dates of some figures, and what is not usual of what made them."""
    usual = {"version": "0.1.0", "machine": "two-core CPU", "precision": "float64"}
    words = {
        ", ".join([f["made_by"]["date"], *(f["made_by"][k] for k in usual if differs(f, k, usual))])
        for f in found
    }
    return "; ".join(sorted(words))


def differs(found: dict, key: str, usual: dict) -> bool:
    return found["made_by"][key] != usual[key]


def model_table(scenes: dict) -> str:
    """README's table: which model when, how wrong, how fast."""
    lines = [
        "| model | for | leaves out | error of T | time, N = 2000 to 3000 |",
        "|---|---|---|---|---|",
    ]
    for name, (code, sizes, unit, words) in MODELS.items():
        rows = {scene: usual_rows(found["rows"], name, sizes) for scene, found in scenes.items()}
        errors = {scene: [100 * row["error"] for row in some] for scene, some in rows.items()}
        everywhere = [x for some in errors.values() for x in some]
        seconds = between((unit * row["run_s"] for some in rows.values() for row in some), "{:.2g}")
        if max(everywhere) > 10:
            dense = between(errors["dense"] + errors["clustering"], "{:.0f}")
            error = f"{between(errors['dilute'])} % where dilute, {dense} % where dense"
        else:
            error = f"{between(everywhere, '{:.0f}')} %"
        use, omitted = USES[name]
        lines.append(f"| {code} | {use} | {omitted} | {error} | {seconds} {words} |")
    return "\n".join([*lines, '| `"auto"` | the cheapest within a tolerance | | 2 % asked | |'])


def usual_rows(rows: list[dict], name: str, sizes) -> list[dict]:
    """Rows of a model of these sizes, with nothing else unusual."""
    mine = [row for row in of(rows, model=name) if speed_vs_error.is_usual(row)]
    if name == "kinetic theory":
        return mine
    return [row for row in mine if int(re.findall(r"\d+", row["knob"])[0]) in sizes]


def printed(name: str) -> str:
    """Lines that a fit printed."""
    return "\n".join(["```", *figures(name)["printed"], "```"])


def gallery_text() -> str:
    """A table of scripts for each group of questions."""
    lines = []
    for group, entries in gallery.ENTRIES.items():
        lines += ["", f"## {group}", "", "| | question | finding | time |", "|---|---|---|---|"]
        for entry in entries:
            found = figures(entry.source) if entry.source else {}
            finding = entry.finding(found)
            if entry.table:
                finding += f" ([table]({entry.table}))"
            shown = ""
            if entry.picture:
                path = f"pictures/{entry.picture}"
                shown = f'[<img src="{path}" width="180" alt="{entry.script}">]({path})'
            script = f"[`{entry.script}`]({entry.script})"
            lines.append(f"| {shown} | {entry.question}<br>{script} | {finding} | {entry.time} |")
    return "\n".join(lines[1:])


if __name__ == "__main__":
    main()
