"""Which A explains the six cooling curves simulated in LAMMPS?

    python experiments/fit/lammps_curves.py [--only dilute dense ...] [--record] [--out DIR]

Runs `jaxgran fit` on the curves of `data/`: kinetic theory on all, and soft spheres in the cases
that name them (minutes). Prints the relative error of each A, and the parts of its error bar. With
--record the figures and pictures of the documents are replaced, including the pictures `fit_*.png`.
"""

import contextlib
import io
import json
from functools import partial

from experiments.support.record import PICTURES, Options, run_parts
from experiments.support.scenes import LAMMPS_CURVES
from jaxgran.cli.main import main as command

NAMES = ("dilute", "dense", "phi003", "phi003_large", "phi010", "phi025")
CURVES = {name: str(LAMMPS_CURVES[name]) for name in NAMES}
SOFT, T_0 = ["--model", "soft-spheres"], ["--free", "A", "T0"]
CASES = {name: [curve] for name, curve in CURVES.items()} | {
    "dense_T0": [CURVES["dense"], *T_0],
    "dense_soft_spheres": [CURVES["dense"], *SOFT],
    "dense_soft_spheres_T0": [CURVES["dense"], *SOFT, *T_0],
    "dilute_soft_spheres": [CURVES["dilute"], *SOFT, "--replicas", "2"],
}
QUICK = (*NAMES, "dense_T0")
SHOWN = ("dilute", "dense_soft_spheres")
"""Cases whose picture is in the documents."""


def fit_case(case: str, options: Options) -> dict:
    """Fit a curve; return estimates, true values, the verdict, and lines of the printed table."""
    folder, said = options.out / case, io.StringIO()
    with contextlib.redirect_stdout(said):
        code = command(["fit", *CASES[case], "--out", str(folder), "--overwrite"])
    print(said.getvalue())
    if code:
        raise SystemExit(code)
    (record,), (picture,) = folder.glob("*.json"), folder.glob("*.png")
    if options.record and case in SHOWN:
        (PICTURES / f"fit_{case}.png").write_bytes(picture.read_bytes())
    found, lines = json.loads(record.read_text(encoding="utf-8")), said.getvalue().splitlines()
    rows = found["parameters"]
    first = next(i for i, line in enumerate(lines) if line.split()[:1] == ["95"])
    budget = next(line for line in lines if line.startswith(f"error of {rows[0]['parameter']}"))
    return {
        "parameters": [row | {"true": row["header"]} for row in rows],
        "verdict": found["verdict"],
        "reduced_chi2": found["reduced_chi2"],
        "printed": [lines[0], "", *lines[first : first + 1 + len(rows)], budget],
    }


if __name__ == "__main__":
    parts = {case: partial(fit_case, case) for case in CASES}
    run_parts(__doc__, named=parts, prefix="lammps_curves_", smoke=False, default=QUICK)
