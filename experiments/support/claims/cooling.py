"""Rows of the table of claims: cooling laws, and the relaxation of the velocities."""

from math import gamma

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.claims.table import SMALL, Table, cooled
from experiments.support.closed_forms import (
    RELAXATION_CORRECTION,
    SONINE_COEFFICIENT,
    paper_temperature,
)
from experiments.support.scenes import beads
from jaxgran.scene.laws import C1
from jaxgran.theory.averages import collision_rate, impact_moments
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE, paper_averages


def cooling(table: Table) -> None:
    """Add the power law of T, the collision frequency, and the times at which they hold."""
    run = table.found("paper_cooling")
    gas, early = cooled(SMALL, [1.0001, 10.0])
    if run:
        row = run["viscoelastic"]
        last = list(row["exponent"].values())[-1]
        table.add(
            "10",
            "T = T₀ u^{−5/3}, u = 1 + t/τ₀",
            f"exponent {last:.3f} ± {row['exponent_error'][-1]:.3f} at 10⁶ τ_c, within 1 % of −5/3 "
            f"from {run['exponent_within_1_per_cent_from']:.1g} τ_c on; u^{{−5/3}} itself "
            f"{100 * run['closed_forms']['Eq. (10)']['100']:+.0f} % at 100 τ_c",
            "DSMC, theory (δ = 0.093)",
            "agree",
            abs(last + 5 / 3) < 0.05,
            "asymptotically",
            [("exponent of T(t), viscoelastic", last, -5 / 3, row["exponent_error"][-1])],
        )
    slope = jax.grad(
        lambda x: jnp.log(jaxgran.KineticTheory().cooling_rate(gas.replace(temperature=x)))
    )
    power = float(slope(gas.temperature) * gas.temperature)
    table.add(
        "11",
        "1/τ₀ ~ T₀^{3/5}",
        f"T₀^{{{power:.4f}}} at δ → 0",
        "theory",
        "agree",
        abs(power - 0.6) < 1e-3,
        ratios=[("exponent of 1/τ₀ in T₀", power, 0.6)],
    )
    spheres = table.found("paper_velocity_correlation")
    if spheres and "hard_spheres" in spheres["elastic"]:
        run = spheres["elastic"]["hard_spheres"]
        ratio = run["collisions"][-1] / (1.5 * run["lags"][-1])
        table.add(
            "12, 27",
            "1/τ_c = 4√π g₂ n σ² √T with g₂ = (2 − η)/(2(1 − η)³)",
            f"{ratio:.3f} of it (η = 0.05)",
            "hard spheres",
            "agree",
            abs(ratio - 1) < 0.02,
            ratios=[("1/τ_c at η = 0.05", ratio, 1.0)],
        )
    spread = table.found("paper_diffusion")
    if spread:
        row = spread["windows"][0]
        lost = row["lost_per_collision_at_paper_to"]
        table.add(
            "13, 43",
            "τ_c(t)/τ₀ grows: the theory holds for τ_c/δ ≪ t ≪ τ_c δ^{−11/5}",
            f"T loses {100 * lost:.1f} % a collision there, "
            f"{100 * row['lost_per_collision_at_start']:.1f} % at t = 0 and ever less later "
            f"(δ = {row['delta']:g}); D = T τ_v holds to 5 % from "
            f"{row['t_tau_v_within_5_per_cent_from']:.1e} τ_c on; the exponent of ⟨Δr²⟩ in the "
            f"paper's window is ≥ {row['exponent_at_paper_to']:.2f}",
            "theory",
            "corrected",
            lost < 0.1,
            "τ_c |dT/dt|/T ~ u^{−1/6} is what must be small; clusters, not this, end the theory",
        )
    series(table, gas)
    sonine(table, early)
    formulas(table)


def series(table: Table, gas: jaxgran.Gas) -> None:
    """Add the coefficients of Eqs. (32) and (36)."""
    q, s = COOLING_CORRECTION, SONINE_COEFFICIENT
    rates = jnp.asarray([impact_moments(gas.reduced_law, jnp.ones(()), 3)[i, 0] for i in (0, 2)])
    paper_rates = jnp.asarray(
        [paper_averages(gas.reduced_law, jnp.ones(()), 3)[i, 0] for i in (0, 2)]
    )
    elastic = 2 / 3 * float(collision_rate(0.0, 3))
    c = float((1 - rates[1] / elastic) / SMALL)
    first, second = RELAXATION_CORRECTION, 27 / 40 * gamma(2.2) * C1**2 * 4**0.2
    table.add(
        "32",
        f"1/τ_v = (1 − {first:.4f} δ θ^{{1/10}} + {second:.4f} δ² θ^{{1/5}})/τ_E",
        f"first coefficient {c:.4f} at δ = 10⁻⁴; two terms are {100 * _two_terms_off(0.1):.1g} % "
        f"off at δ = 0.1, {100 * _two_terms_off(0.3):.0f} % at 0.3",
        "exact average of ε(v)",
        "agree",
        abs(c / first - 1) < 1e-3,
        "of a Maxwellian gas",
        [("first coefficient of 1/τ_v", c, first)],
    )
    table.add(
        "36",
        "dT/dt = −b₁T^{8/5} + b₂T^{17/10}",
        f"right to {abs(float(paper_rates[0] / rates[0] - 1)):.0e} at δ = 10⁻⁴ if Maxwellian; with "
        f"a₂, b₂ grows by {100 * 0.24 * s / q:.1f} %",
        "exact average of ε(v)",
        "corrected",
        abs(float(paper_rates[0] / rates[0] - 1)) < 1e-5,
        "a₂ is of the order of b₂; contact that ends at F = 0 adds a term T^{7/4}",
    )


def sonine(table: Table, early: jaxgran.CoolingCurve) -> None:
    """Add the Sonine coefficient a_2, which the paper takes as zero."""
    s = SONINE_COEFFICIENT
    assert early.sonine is not None
    a_2 = float(early.sonine[1]) / SMALL / 10 ** (-1 / 6)
    table.add(
        "—",
        "velocities are Maxwellian",
        f"a₂ = −{s:.4f} δ θ^{{1/10}} (theory at δ = 10⁻⁴: {a_2:.4f})",
        "theory",
        "corrected",
        abs(a_2 / -s - 1) < 0.02,
        "an error of the order that the paper keeps",
    )


def formulas(table: Table) -> None:
    """Add the paper's closed forms of T(t)."""
    q, s = COOLING_CORRECTION, SONINE_COEFFICIENT
    first = float(paper_temperature(0.0, 0.093, corrected=False))
    run = table.found("paper_cooling")
    u = np.geomspace(1.01, 1e9, 50)
    gas, curve = cooled(0.093, u)
    tau = jnp.asarray(u - 1) / (COOLING_RATE[3] * 0.093)
    formula = paper_temperature(tau, 0.093)
    off = float(jnp.abs(formula * gas.temperature / curve.temperature - 1).max())
    table.add(
        "38",
        f"T/T₀ = u^{{−5/3}} + a₁ δ u^{{−11/6}} + …, a₁ = 2q = {2 * q:.4f}",
        f"printed T(0) = {first:.2f} T₀ (δ = 0.093); corrected within {100 * off:.1f} % to u = 10⁹",
        "theory",
        "corrected",
        off < 0.01,
        "the homogeneous solution −2qδu^{−8/3} is missing; a₂ and a₁ change with the Sonine a₂, "
        f"which makes a₁ {2 * (q + 0.24 * s):.3f}",
        [("T(0), δ = 0.093", 1.0, first), ("a₁", 2 * (q + 0.24 * s), 2 * q)],
    )
    rate = COOLING_RATE[3]
    table.add(
        "39",
        "τ_c(0)/(δτ₀) = 0.831928",
        f"{rate:.6f}",
        "closed form",
        "agree",
        abs(rate - 0.831928) < 1e-5,
        "the paper's digits are those of C₁ = 1.15344",
        [("τ_c(0)/(δτ₀)", rate, 0.831928)],
    )
    if run:
        row = run["constant"]
        last, haff = list(row["exponent"].values())[-1], max(map(abs, run["haff"]))
        table.add(
            "44",
            "T = T₀(1 + γ₀ t/τ_c)^{−2}",
            f"within {100 * haff:.2f} %; exponent {last:.3f} ± "
            f"{row['exponent_error'][-1]:.3f} at 10⁶ τ_c (ε = 0.83)",
            "DSMC, theory",
            "agree",
            abs(last + 2) < 0.01,
            "the difference is a₂",
            [("exponent of T(t), constant ε", last, -2.0, row["exponent_error"][-1])],
        )


def _two_terms_off(delta: float) -> float:
    """Return the relative error of the relaxation rate by the two terms of Eq. (32)."""
    law = beads(0.05, 1.5 * 2**0.1 * delta).reduced_law
    one = jnp.ones(())
    return float(abs(paper_averages(law, one, 3)[2, 0] / impact_moments(law, one, 3)[2, 0] - 1))
