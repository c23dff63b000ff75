"""Which claims of the paper are confirmed? A table of every numbered claim with measurements.

    python experiments/paper/paper_claims.py [--results results] [--out DIR]

Constants and formulas are computed here, in seconds. Results of particle simulations are read from
the JSON files of the other paper_*.py scripts in the results folder. Run these scripts first: a row
without its file is left out. A verdict is replaced by "DOES NOT HOLD" if the numbers contradict it.
"""

import argparse
from dataclasses import asdict
from pathlib import Path

import jax
import jax.numpy as jnp

import jaxgran
from experiments.support import paper
from experiments.support.claims.clustering import clustering
from experiments.support.claims.cooling import cooling
from experiments.support.claims.diffusion import diffusion, equilibrium, memory
from experiments.support.claims.table import Row, Table
from experiments.support.record import DATA, FIGURES, add_recording, write_results
from jaxgran.data.files import header_number
from jaxgran.scene.contact import impact
from jaxgran.scene.laws import C1, C2

HEAD = """# The paper's claims

Brilliantov & Pöschel, *Self-diffusion in granular gases*; equation numbers are those of the
preprint. Written by `paper_claims.py` from the results of the scripts `paper_*.py`. Definitions and
formal steps are not listed (15–21, 23, 25, 26, 28–30, 35, 37). θ = T/T₀, u = 1 + t/τ₀, 𝒯 = T₀/T.

"""


def restitution(table: Table) -> None:
    """Add the series of eps, its coefficients and the impact of Hertzian spheres."""
    shot = table.found("paper_restitution")
    if shot:
        reach = shot["two_terms_good_to_one_per_cent"]
        table.add(
            "1",
            "ε = 1 − C₁β + C₂β² ∓ …",
            f"within 1 % to β = {min(reach.values()):.2f}; next terms −0.52288 β³ (contact ends at "
            f"ξ = 0) or {shot['recovered']['clipped'][4]:.4f} β^{{5/2}} (at F = 0; 4/15)",
            "single impacts (ODE)",
            "agree",
            abs(shot["recovered"]["clipped"][4] - 4 / 15) < 2e-3,
            "to the order printed",
        )
    hertz = float(impact(0.0).duration)
    alpha = "Hertz impact lasts 3.218 (α²v)^{−1/5}"
    table.add(
        "2–4",
        "α, R_eff, m_eff",
        f"{alpha}: {hertz:.8f}",
        "ODE",
        "agree",
        abs(hertz - 3.21806546) < 1e-7,
    )
    for equation, name, value, printed in (("5", "C₁", C1, 1.15344), ("6", "C₂", C2, 0.79826)):
        table.add(
            equation,
            f"{name} = {printed}",
            f"{value:.9f}",
            "closed form, ODE",
            "agree",
            abs(value - printed) < 1e-5,
            ratios=[(name, value, printed)],
        )


def remarks(table: Table) -> None:
    """Add other laws of restitution, and a measured curve."""
    run = table.found("paper_exponents")
    if run:
        seen = [run[k] for k in run if k.startswith("γ")]
        table.add(
            "text",
            "other exponents γ of ε(v)",
            "T ~ t^{−2/(1+γ)}: "
            + "; ".join(
                f"{r['last_exponent_of_theory']:.3f} for {r['paper_exponent']:.3f}" for r in seen
            )
            + f"; ice: {run['ice']['exponent']:.3f} ± {run['ice']['exponent_error']:.3f} at 10⁵ τ_c"
            ", on to 0",
            "theory, DSMC",
            "agree",
            all(abs(r["last_exponent_of_theory"] - r["paper_exponent"]) < 0.03 for r in seen),
            "ice has no single γ: elastic below 0.01 cm/s",
            [
                (
                    f"exponent of T(t), {name}",
                    run[name]["last_exponent_of_theory"],
                    run[name]["paper_exponent"],
                )
                for name in run
                if name.startswith("γ")
            ],
        )
    curve, header = jaxgran.read_curve(DATA / "lammps_cooling_dilute.csv")
    gas = jaxgran.read_gas(header)
    gas = gas.replace(dissipative_constant=header_number(header, "A"))
    theory = jaxgran.cool(gas, curve.times)
    assert curve.displacement is not None and theory.displacement is not None
    hot = float(jnp.abs(theory.temperature[1:] / curve.temperature[1:] - 1).max())
    far = float(jnp.abs(theory.displacement[1:] / curve.displacement[1:] - 1).max())
    table.add(
        "10, 42",
        "T(t) and ⟨Δr²⟩(t) of viscoelastic spheres",
        f"kinetic theory from the true A: T within {100 * hot:.1f} %, ⟨Δr²⟩ within "
        f"{100 * far:.1f} %",
        "LAMMPS data, φ = .05, δ = " + f"{float(gas.delta):.3f}",
        "agree",
        hot < 0.02 and far < 0.08,
        "with the corrections above; ⟨Δr²⟩ is larger by 1.7 % of higher Sonine orders, the rest "
        "correlations at this density",
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=FIGURES)
    parser.add_argument("--out", type=Path, default=Path("results") / "paper_claims")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    clock = paper.Clock()
    table = Table(options.results)
    for part in (restitution, equilibrium, cooling, memory, diffusion, remarks, clustering):
        part(table)
    table.rows.sort(key=_place)
    path = options.out / "paper_claims.json"
    rows = [asdict(row) for row in table.rows]
    write_results("paper_claims", options, path, rows=rows, **clock.times)
    (options.out / "paper_claims.md").write_text(HEAD + table.markdown(), encoding="utf-8")
    print(table.markdown())


def _place(row: Row) -> float:
    """Return the position of a row, by its first equation; "text" comes last."""
    first = row.equation.split(",")[0].split("–")[0]
    return float(first) if first.isdigit() else 99.0 if first else 35.5


if __name__ == "__main__":
    main()
