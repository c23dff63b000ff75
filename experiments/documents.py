"""Write the generated documents: tables of accuracy and performance, the gallery, README.

    python experiments/documents.py [--pictures]

All figures come from `experiments/figures/*.json`, which the scripts write when they are run with
--record. accuracy.md, speed.md, speed_vs_error.md, hard_cases.md, wrong_physics.md,
interval_coverage.md and paper_claims.md are generated whole; README.md and experiments/README.md
only between the marks `<!-- NAME -->` and `<!-- end of NAME -->`. A test compares the documents
with the output of this script. With --pictures the pictures that show only recorded figures
(`support/dot_plots.py`) are drawn, too.
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
"""Code, N, factor and unit of the run time for each model in the table of README.md."""
USES = {
    "kinetic theory": (
        "dilute gases in boxes below L_c; fits",
        "correlations, clusters, lasting contacts",
    ),
    "DSMC": ("any law, many decades of time", "positions, so the same effects"),
    "hard spheres": ("clusters, short contacts", "lasting contacts"),
    "soft spheres": ("dense and soft gases", "impacts with β_t (friction instead)"),
}


def main() -> None:
    """Write all documents."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--pictures", action="store_true", help="draw pictures from the figures, too"
    )
    if parser.parse_args().pictures:
        for name, plot in PLOTS.items():
            drawn(plot(figures(name))).savefig(PICTURES / f"{name}.png", dpi=110)
    for path, text in documents().items():
        path.write_text(text, encoding="utf-8")


def documents() -> dict[Path, str]:
    """Return the text of each generated document, by its path."""
    scenes = figures("speed_vs_error")["scenes"]
    memories = figures("flow_memory")
    whole = {
        "accuracy": "\n".join(
            [
                table("Accuracy", accuracy.ROWS, accuracy.NOTE),
                accuracy.MEMORIES,
                flow_memory.table(memories),
                "",
                f"`python experiments/accuracy/flow_memory.py`. Date: {made([memories])}.",
                "",
                accuracy.MEMORIES_MEAN,
            ]
        ),
        "speed": table("Performance", speed.ROWS, speed.NOTE),
        "speed_vs_error": "\n\n".join(
            [
                "# Speed against error",
                f"{BY}`/speed_vs_error.json`.",
                *(
                    f"{speed_vs_error.table(name, scene)}\n\nDate: {scene['date']}."
                    for name, scene in scenes.items()
                ),
            ]
        )
        + "\n",
        "hard_cases": "# Hard cases\n\n" + hard_cases.table(figures("hard_cases")["cases"]),
        "wrong_physics": (
            "# Fits with incomplete physics\n\n" + wrong_physics.table(figures("wrong_physics"))
        ),
        "interval_coverage": "\n".join(
            [
                "# Coverage of 95 % intervals",
                "",
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
    """Return the table of the paper's claims."""
    rows = [claims_table.Row(**row) for row in figures("paper_claims")["rows"]]
    return paper_claims.HEAD + claims_table.Table(FIGURES, rows).markdown()


def filled(text: str, blocks: dict[str, str]) -> str:
    """Return the text with each block inserted between its marks."""
    for name, block in blocks.items():
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        if begin not in text or end not in text:
            raise ValueError(f"the marks {begin.strip()} and {end} are missing; put them back")
        head, _, rest = text.partition(begin)
        text = f"{head}{begin}{block}\n{end}{rest.partition(end)[2]}"
    return text


def table(title: str, rows: Iterable[Row], note: str) -> str:
    """Return a document with one table, whose last column is the date of each run."""
    lines = [
        f"# {title}",
        "",
        f"{BY}. Version 0.1.0 on a two-core CPU in float64,",
        "unless the last column says otherwise. The last column is the date of the run.",
        "",
        "| measurement | reference | result | command | date |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        found = [figures(source) for source in row.source.split()]
        cells = row.what, row.against, row.measured(*found), f"`{row.command}`", made(found)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", note])


def made(found: list[dict]) -> str:
    """Return the dates of some figures, with version, machine and precision if unusual."""
    usual = {"version": "0.1.0", "machine": "two-core CPU", "precision": "float64"}
    words = {
        ", ".join([f["made_by"]["date"], *(f["made_by"][k] for k in usual if differs(f, k, usual))])
        for f in found
    }
    return "; ".join(sorted(words))


def differs(found: dict, key: str, usual: dict) -> bool:
    return found["made_by"][key] != usual[key]


def model_table(scenes: dict) -> str:
    """Return the table of the models in README.md: use, limits, error of T and run time."""
    lines = [
        "| model | use for | leaves out | error of T | run time, N = 2000 to 3000 |",
        "|---|---|---|---|---|",
    ]
    for name, (code, sizes, unit, words) in MODELS.items():
        rows = {scene: usual_rows(found["rows"], name, sizes) for scene, found in scenes.items()}
        errors = {scene: [100 * row["error"] for row in some] for scene, some in rows.items()}
        everywhere = [x for some in errors.values() for x in some]
        seconds = between((unit * row["run_s"] for some in rows.values() for row in some), "{:.2g}")
        if max(everywhere) > 10:
            dense = between(errors["dense"] + errors["clustering"], "{:.0f}")
            error = f"{between(errors['dilute'])} % dilute, {dense} % dense"
        else:
            error = f"{between(everywhere, '{:.0f}')} %"
        use, omitted = USES[name]
        lines.append(f"| {code} | {use} | {omitted} | {error} | {seconds} {words} |")
    auto = '| `"auto"` | the fastest model within a tolerance | | 2 % by default | |'
    return "\n".join([*lines, auto])


def usual_rows(rows: list[dict], name: str, sizes) -> list[dict]:
    """Return the rows of a model with these sizes and otherwise default settings."""
    mine = [row for row in of(rows, model=name) if speed_vs_error.is_usual(row)]
    if name == "kinetic theory":
        return mine
    return [row for row in mine if int(re.findall(r"\d+", row["knob"])[0]) in sizes]


def printed(name: str) -> str:
    """Return the printed lines of a fit as a code block."""
    return "\n".join(["```", *figures(name)["printed"], "```"])


def gallery_text() -> str:
    """Return one table of scripts for each group of questions."""
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
