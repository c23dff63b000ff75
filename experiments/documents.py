"""Write accuracy.md and speed.md, the tables of how wrong and how slow, from figures.json.

A figure of these tables is changed in figures.json, after its command has been run, and nowhere
else; a test compares the tables with what this script would write.
"""

import argparse
import json
from pathlib import Path

HERE = Path(__file__).parent

ACCURACY = """\
Kinetic theory leaves out correlations, clustering and three-body contacts. Its self-diffusion is
the first Sonine approximation, 1.7 % (3D) or 2.4 % (2D) low for dilute elastic spheres, and 0.85 φ
lower for dense ones in boxes of some hundred spheres, more in larger ones. Errors of T of every
model against its run time: [speed_vs_error.md](speed_vs_error.md).
"""

SPEED = """\
## Speed against error

[speed_vs_error.md](speed_vs_error.md) has the largest error of T over a whole curve, and the run
time without compilation, of every model as its knob is turned
([picture](pictures/speed_vs_error.png)). The dilute and the dense gas are LAMMPS' own curves,
nothing fitted; the clustering gas (φ = .2, β = .5, t_c/τ_c = .02, to 60 τ_c) is held against
12 × 12 000 soft spheres of 80 steps a contact. Models have four replicas of N particles. The
largest of 30 to 60 noisy points is itself two of its standard errors where nothing is wrong; boxes
of fewer particles are smaller boxes. The noise that `choose_model` estimates is that of shots and
of the few waves of a growing flow, as runs of three gases in two boxes each scatter
(`pytest -m "slow or not slow" tests/models/test_selection.py -k noise`).

For a dilute gas in a box below L_c take kinetic theory: no model beats its 1.5 % by more than a
fraction of its own noise and 1 %. Where contacts last or overlap, or the box is longer than L_c,
take soft spheres with 10 to 20 steps a contact and spend the time on particles rather than on
steps. Hard spheres of the same N take a seventh to two fifths of that time, and err by 2 to 3 %
from N = 3000 on where contacts are short (the clustering gas), in the dense gas by 4 to 9 %.
float32 costs no accuracy that shows here.
"""

HEADS = {"accuracy": ("How wrong", ACCURACY), "speed": ("How slow", SPEED)}
"""Title and note of each document."""


def document(name: str, figures: dict) -> str:
    """The text of one document.

    Args:
        name: "accuracy" or "speed".
        figures: contents of figures.json; a row may have its own version, machine or precision.
    """
    title, note = HEADS[name]
    default = figures["made_by"]
    lines = [
        f"# {title}",
        "",
        f"Unless a row says otherwise: {default['machine']}, {default['precision']}, "
        f"version {default['version']}. Written by",
        "`python experiments/documents.py` from [figures.json](figures.json).",
        "",
        "| what | against | measured | command |",
        "|---|---|---|---|",
    ]
    for row in figures[name]:
        own = [str(row[key]) for key in default if key in row]
        measured = row["measured"] + (f" ({', '.join(own)})" if own else "")
        lines.append(f"| {row['what']} | {row['against']} | {measured} | `{row['command']}` |")
    return "\n".join([*lines, "", note])


def main() -> None:
    """Write both documents."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    figures = json.loads((HERE / "figures.json").read_text(encoding="utf-8"))
    for name in HEADS:
        (HERE / f"{name}.md").write_text(document(name, figures), encoding="utf-8")


if __name__ == "__main__":
    main()
