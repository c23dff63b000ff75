"""The table of claims: its rows, the figures of other scripts, and one gas of a given delta."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import jax.numpy as jnp
from scenes import beads

import jaxgran
from jaxgran import closed_forms

SMALL = 1e-4
"""delta at which first-order coefficients are taken."""


@dataclass
class Row:
    equation: str
    claim: str
    ours: str
    checked: str
    verdict: str
    holds: bool = True
    why: str = ""


@dataclass
class Table:
    results: Path
    rows: list[Row] = field(default_factory=list)

    def add(self, equation, claim, ours, checked, verdict, holds=True, why="") -> None:
        self.rows.append(Row(equation, claim, ours, checked, verdict, bool(holds), why))

    def found(self, name: str) -> dict | None:
        whole = self.whole(name, f"{name}.json")
        return whole["found"] if whole else None

    def whole(self, folder: str, file: str) -> dict | None:
        path = self.results / folder / file
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    def markdown(self) -> str:
        lines = ["| Eq. | the paper | here | checked by | verdict | why |", "|" + "---|" * 6]
        for r in self.rows:
            verdict = r.verdict if r.holds else "DOES NOT HOLD"
            cells = (r.equation, r.claim, r.ours, r.checked, verdict, r.why)
            # A bar would end the cell.
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        return "\n".join(lines) + "\n"


def cooled(delta: float, u, **options) -> tuple[jaxgran.Gas, jaxgran.CoolingCurve]:
    """Dilute viscoelastic beads of a delta, at given u = 1 + t/tau_0."""
    gas = beads(0.05, 1.5 * 2**0.1 * delta)
    tau = (jnp.asarray(u) - 1) / (closed_forms.COOLING_RATE[3] * delta)
    model = jaxgran.KineticTheory(softness=False, rtol=1e-11, **options)
    return gas, jaxgran.cool(gas, tau * gas.mean_free_time, model=model)
