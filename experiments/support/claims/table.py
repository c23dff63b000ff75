"""The table of claims: its rows, the results of other scripts, and a test gas."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import jax.numpy as jnp

import jaxgran
from experiments.support.scenes import beads
from jaxgran.theory.equations import COOLING_RATE

SMALL = 1e-4
"""delta at which first-order coefficients are measured."""


@dataclass
class Row:
    """One claim.

    Attributes:
        equation: its number in the paper, or "text".
        claim: the paper's statement.
        ours: the result of jaxgran.
        checked: the method of the check.
        verdict: "agree" or "corrected".
        holds: whether the numbers support the verdict.
        why: a reason or a limit.
        ratios: measured values over the paper's values: label, ratio, and its standard error or
            None.
    """

    equation: str
    claim: str
    ours: str
    checked: str
    verdict: str
    holds: bool = True
    why: str = ""
    ratios: list[tuple[str, float, float | None]] = field(default_factory=list)


@dataclass
class Table:
    """The rows of the table, made from the JSON files NAME.json in the folder `results`."""

    results: Path
    rows: list[Row] = field(default_factory=list)

    def add(self, equation, claim, ours, checked, verdict, holds=True, why="", ratios=()) -> None:
        """Add a row; ratios are (label, measured, printed), and optionally the measured error."""
        found = []
        for words, here, printed, *error in ratios:
            spread = abs(float(error[0] / printed)) if error else None
            found.append((words, float(here / printed), spread))
        self.rows.append(Row(equation, claim, ours, checked, verdict, bool(holds), why, found))

    def found(self, name: str) -> dict | None:
        """Return the entry "found" of the results of a script, or None if there are none."""
        whole = self.whole(name)
        return whole["found"] if whole else None

    def whole(self, name: str) -> dict | None:
        """Return all results of a script, or None if there are none."""
        path = self.results / f"{name}.json"
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    def markdown(self) -> str:
        lines = ["| Eq. | the paper | jaxgran | method | verdict | remark |", "|" + "---|" * 6]
        for r in self.rows:
            verdict = r.verdict if r.holds else "DOES NOT HOLD"
            cells = (r.equation, r.claim, r.ours, r.checked, verdict, r.why)
            # An unescaped "|" would end the cell.
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        return "\n".join(lines) + "\n"


def cooled(delta: float, u, **options) -> tuple[jaxgran.Gas, jaxgran.CoolingCurve]:
    """Return dilute viscoelastic beads of a given delta, cooled to times u = 1 + t/tau_0."""
    gas = beads(0.05, 1.5 * 2**0.1 * delta)
    tau = (jnp.asarray(u) - 1) / (COOLING_RATE[3] * delta)
    model = jaxgran.KineticTheory(
        softness=False, order=2, correlations=False, rtol=1e-11, **options
    )
    return gas, jaxgran.cool(gas, tau * gas.mean_free_time, model=model)
