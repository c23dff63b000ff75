"""Which claims of the paper are confirmed? Numbers and verdicts for a table of every claim.

    python experiments/paper/paper_claims.py [--record] [--out DIR]

Computes constants and formulas in seconds, and reads what the other scripts paper_*.py recorded in
`experiments/figures`. A verdict is "agree" or "corrected"; it does not hold if the numbers
contradict it. The table, `templates/paper_claims.md`, quotes these numbers and those figures.
"""

from math import gamma, pi

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support import closed_forms
from experiments.support.record import figures, run_parts
from experiments.support.scenes import beads, hard_beads, of_lammps
from jaxgran.scene.contact import impact
from jaxgran.scene.laws import C1, C2
from jaxgran.theory.averages import TERMS, collision_rate, impact_moments
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE

SMALL = 1e-4
"""delta at which first-order coefficients are measured."""

QUOTED = ((70, 0.9, 0.0031), (23, 0.6, 0.0027))
"""The paper's N_c (collisions per particle at the onset), coefficient of restitution, T_c/T_0."""

BY_NUMBER, BY_TIME = "T over theory's of N by 2", "T over theory's of t by 2"
RATE = COOLING_RATE[3]
AGREE, CORRECTED = "agree", "corrected"


def paper_claims(_) -> dict:
    found = {
        name: found.get("found", found)
        for name in ("restitution", "cooling", "velocity_correlation", "diffusion")
        + ("diffusion_coefficient", "exponents", "clustering", "clustering_dissolves")
        for found in [figures(f"paper_{name}")]
    }
    numbers = expansions() | laws() | curves(found) | clusters(found["clustering"])
    rows = claims(found, numbers)
    print([row["name"] for row in rows if not row["holds"]], "do not hold")
    return {"numbers": numbers, "rows": rows}


def check(name: str, verdict: str, value, expected, tolerance, *compared: tuple) -> dict:
    """Return a verdict, which holds if a value is within a tolerance of the expected one.

    `compared` are labels, measured and printed values, and errors of the measured ones, of which
    the ratios are drawn.
    """
    ratios = []
    for words, here, printed, *error in compared:
        spread = abs(float(error[0] / printed)) if error else None
        ratios.append((words, float(here / printed), spread))
    equation, holds = "text" if name.startswith("text") else name, abs(value - expected) < tolerance
    row = {"name": name, "equation": equation, "verdict": verdict}
    return row | {"holds": bool(holds), "ratios": ratios}


def cooled(delta: float, u) -> tuple[jaxgran.Gas, jaxgran.CoolingCurve]:
    """Return dilute viscoelastic beads of a given delta, cooled to times u = 1 + t/tau_0."""
    gas = beads(0.05, 1.5 * 2**0.1 * delta)
    model = jaxgran.KineticTheory(softness=False, order=2, correlations=False, rtol=1e-11)
    tau = (jnp.asarray(u) - 1) / (RATE * delta)
    return gas, jaxgran.cool(gas, tau * gas.mean_free_time, model=model)


def averages(delta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates of cooling and of relaxation, exact and by the paper's two terms."""
    law, one = beads(0.05, 1.5 * 2**0.1 * delta).reduced_law, jnp.ones(())
    both = (f(law, one, 3) for f in (impact_moments, closed_forms.paper_averages))
    exact, paper = (np.asarray(moments)[np.array([0, 2]), 0] for moments in both)
    return exact, paper


def expansions() -> dict[str, float]:
    """Return the coefficients of the expansions in delta, of the paper and by theory."""
    q, c = COOLING_CORRECTION, closed_forms.RELAXATION_CORRECTION
    s = closed_forms.SONINE_COEFFICIENT
    (cooling, relaxation), (paper_cooling, _) = averages(SMALL)
    gas, curve = cooled(SMALL, [1.0001, 10.0, 1e4, 1e6])
    u, late = np.array([1e4, 1e6]), slice(2, None)
    d_0 = 1.5 * float(gas.temperature * gas.mean_free_time)
    a_3 = (np.asarray(curve.diffusion)[late] / d_0 - u ** (-5 / 6)) * u / SMALL
    exact = np.asarray(curve.displacement)[late] / float(gas.temperature * gas.mean_free_time**2)
    formula = np.asarray(closed_forms.paper_displacement((u - 1) / (RATE * SMALL), SMALL))
    rate = jax.grad(
        lambda x: jnp.log(jaxgran.KineticTheory().cooling_rate(gas.replace(temperature=x)))
    )
    printed = 8 / 3 * pi**0.5 * gas.diameter**2 * gas.contact_value * gas.number_density
    return {
        "hertz": float(impact(0.0).duration),
        "C1": C1,
        "C2": C2,
        "rate_power": float(rate(gas.temperature) * gas.temperature),
        "relaxation_first": c,
        "relaxation_second": 27 / 40 * gamma(2.2) * C1**2 * 4**0.2,
        "relaxation_of_theory": float(1 - 1.5 * relaxation / collision_rate(0.0, 3)) / SMALL,
        "relaxation_off_at_.1": float(abs(np.divide(*averages(0.1))[1] - 1)),
        "relaxation_off_at_.3": float(abs(np.divide(*averages(0.3))[1] - 1)),
        "cooling_off": float(abs(paper_cooling / cooling - 1)),
        "cooling_growth": 0.24 * s / q,
        "a1_paper": 2 * q,
        "a1": 2 * (q + 0.24 * s),
        "a2": s,
        "a2_of_theory": float(curve.sonine[1]) / SMALL / 10 ** (-1 / 6),
        "a3_paper": q + c,
        "a3": q + 0.24 * s + 2 * c + 3 / 16 * s,
        "a3_of_theory": float(a_3[0]),
        "rate": RATE,
        "D0": float(printed * gas.temperature**0.5 * 1.5 * gas.mean_free_time),
        "displacement_off": float(np.abs(formula / exact - 1).max()),
    }


def laws() -> dict:
    """Return the accuracy of closed forms at delta = .093, and of theory for a LAMMPS curve."""
    u = np.geomspace(1.01, 1e9, 50)
    gas, curve = cooled(0.093, u)
    formula = closed_forms.paper_temperature((u - 1) / (RATE * 0.093), 0.093) * gas.temperature
    gas, late = cooled(0.093, [1e2, 1e6, 1e12])
    theta = np.asarray(late.temperature / gas.temperature)
    leading = 54 / (RATE * 0.093) * (theta**-0.1 - 1)
    leading *= float(gas.temperature * gas.mean_free_time**2)
    collisions = np.asarray(late.collisions)
    gas, measured, _ = of_lammps("dilute")
    theory = jaxgran.cool(gas, measured.times)
    far = theory.displacement[1:] / measured.displacement[1:] - 1
    return {
        "first_temperature": float(closed_forms.paper_temperature(0.0, 0.093, corrected=False)),
        "temperature_off": float(jnp.abs(formula / curve.temperature - 1).max()),
        "leading": (leading / np.asarray(late.displacement)).tolist(),
        "power_of_N": float(np.log(theta[2] / theta[1]) / np.log(collisions[2] / collisions[1])),
        "lammps_delta": float(gas.delta),
        "lammps_T": float(jnp.abs(theory.temperature[1:] / measured.temperature[1:] - 1).max()),
        "lammps_displacement": float(jnp.abs(far).max()),
    }


def relaxation_of_cooling_state(eps: float) -> float:
    """Return 1/tau_v of the cooling state over that of a Maxwellian gas at this T, less 1."""
    gas, model = hard_beads(0.01, eps), jaxgran.KineticTheory(correlations=False)
    curve = jaxgran.cool(gas, jnp.array([1e3, 1e4]) * gas.mean_free_time, model=model)
    a2, a3 = np.asarray(curve.sonine)[-1], np.asarray(curve.third_sonine)[-1]
    moments = np.asarray(impact_moments(gas.reduced_law, jnp.ones(()), 3, order=3))[3]
    powers = zip(*TERMS[3], strict=True)
    terms = (c * a2**i * a3**j for c, (i, j) in zip(moments, powers, strict=True))
    return float(sum(terms) / moments[0] - 1)


def curves(found: dict) -> dict:
    """Return what follows from the recorded simulations of cooling and diffusion."""
    run, routes = found["velocity_correlation"], found["diffusion_coefficient"]["constant"]
    dsmc, e = run["constant"]["dsmc"], run["restitution"]
    i = int(np.argmin(np.abs(np.array(dsmc["lags"]) - 4.0)))
    lowest = 1 - run["relaxation"]["constant"]["lost"][-1]
    spheres, constant = run["elastic"]["hard_spheres"], found["diffusion"]["constant"]
    x, y = np.log(constant["tau"]), np.array(constant["displacement"])
    first, last = np.diff(y[-7::3]) / np.diff(x[-7::3])  # of the last two decades
    slopes = np.array(routes["by_slope"]) / np.array(routes["by_slope_theory"])
    return {
        "frequency": spheres["collisions"][-1] / (1.5 * spheres["lags"][-1]),
        "correlation": [dsmc["correlation"][i], dsmc["error"][i]],
        "correlation_printed": float(np.exp(-4 / run["constant"]["paper_relaxation"])),
        "correlation_exponential": float(np.exp(-(1 + e) / 3 * dsmc["collisions"][i])),
        "lowest_eps": lowest,
        "relaxation_of_cooling_state": relaxation_of_cooling_state(lowest),
        "slopes_off": float(np.abs(slopes - 1).max()),
        "haff_off": max(map(abs, found["cooling"]["haff"])),
        "logarithm_off": float(abs(last / first - 1)),
    }


def clusters(found: dict) -> dict:
    """Return the departures from Haff's law, and their distance from the paper's numbers."""
    scenes = list(found["scenes"].values())
    left = [scene["constant"]["departures"] for scene in scenes]
    by_number, by_time = ([one[name] for one in left] for name in (BY_NUMBER, BY_TIME))
    cooler = [scene["constant"]["T_at_the_papers_N"] for scene in scenes]
    spread = [t["N"][0] - n["N"][0] for n, t in zip(by_number, by_time, strict=True)]
    # N at which T has the quoted value, by the slope of ln T between the two departures.
    shifts = [
        float(np.log(T[0] / quoted) / (np.log(n["T"][0] / t["T"][0]) / width))
        for T, n, t, width, (_, _, quoted) in zip(
            cooler, by_number, by_time, spread, QUOTED, strict=True
        )
    ]
    later = [scene["viscoelastic_over_constant"][BY_NUMBER] for scene in scenes]
    return {
        "N_by_time": [one["N"] for one in by_time],
        "N_by_number": [one["N"] for one in by_number],
        "N_early": [one["T over theory's of t by 1.1"]["N"][0] for one in left],
        "T_at_N": cooler,
        "haff_at_N": [float(np.exp(-(1 - e**2) / 2 * n)) for n, e, _ in QUOTED],
        "T_off": [quoted / T[0] - 1 for T, (_, _, quoted) in zip(cooler, QUOTED, strict=True)],
        "shifts": shifts,
        "spread": spread,
        "clocks": [
            found["first_scene_over_second"][name]
            for name in (BY_TIME, BY_NUMBER, "unevenness over elastic by 2")
        ],
        "later": later,
    }


def claims(found: dict, n: dict) -> list[dict]:
    """Return the verdict of each claim, with what it is compared with."""
    run, spread, routes = found["cooling"], found["diffusion"], found["diffusion_coefficient"]
    visco, even = run["viscoelastic"], run["constant"]
    last, last_even = (list(one["exponent"].values())[-1] for one in (visco, even))
    elastic, constant, eps = routes["elastic"], routes["constant"], routes["restitution"]
    slow = found["velocity_correlation"]["relaxation"]["constant"]
    tau_v, tau_v_paper, tau_v_error = (slow[key][-1] for key in ("measured", "paper", "error"))
    D, D_error, D_theory = (constant[f"by_slope{key}"][-1] for key in ("", "_error", "_theory"))
    error = np.hypot(elastic["by_slope_error"][-1], elastic["by_integral_error"][0])
    bend = [spread[name]["linear_in_collisions_within"] for name in ("constant", "viscoelastic")]
    powers = [
        (f"exponent of T(t), {name}", one["last_exponent_of_theory"], one["paper_exponent"])
        for name, one in found["exponents"].items()
        if name.startswith("γ")
    ]
    uneven = found["clustering_dissolves"]["viscoelastic"]["unevenness"]
    far, far_error = (spread["viscoelastic"][key][-1] for key in ("exponent", "exponent_error"))
    decay, decay_error = n["correlation"]
    onset = list(zip(n["N_by_time"], n["T_at_N"], n["haff_at_N"], QUOTED, strict=True))
    no_haff = all(abs(T[0] / haff - 1) > 1 for _, T, haff, _ in onset)
    shifts = [shift / width for shift, width in zip(n["shifts"], n["spread"], strict=True)]
    universal = all(0.5 < r["T"][0] < 2 < r["N"][0] for r in n["clocks"][:2])
    delayed = min(one["N"][0] - 3 * one["N"][1] for one in n["later"])
    third, lost = found["restitution"]["recovered"]["clipped"][4], spread["windows"][0]
    theory = n["relaxation_of_theory"]
    compared = {
        "5": [("C₁", C1, 1.15344)],
        "6": [("C₂", C2, 0.79826)],
        "10": [("exponent of T(t), viscoelastic", last, -5 / 3, visco["exponent_error"][-1])],
        "11": [("exponent of 1/τ₀ in T₀", n["rate_power"], 0.6)],
        "12, 27": [("1/τ_c at η = 0.05", n["frequency"], 1)],
        "22, 24": [
            (f"⟨v(0)·v(4τ_E)⟩, ε = {eps:.2f}", decay, n["correlation_printed"], decay_error)
        ],
        "31": [(f"τ_v, ε = {n['lowest_eps']:.1f}", tau_v, tau_v_paper, tau_v_error)],
        "32": [("first coefficient of 1/τ_v", theory, n["relaxation_first"])],
        "33, 34": [(f"D/(T τ_E), ε = {eps:.2f}", D, constant["paper"][-1], D_error)],
        "38": [("T(0), δ = 0.093", 1, n["first_temperature"]), ("a₁", n["a1"], n["a1_paper"])],
        "39": [("τ_c(0)/(δτ₀)", RATE, 0.831928)],
        "40": [("a₃", n["a3"], n["a3_paper"])],
        "42": [("exponent of ⟨Δr²⟩(t)", far, 1 / 6, far_error)],
        "44": [("exponent of T(t), constant ε", last_even, -2, even["exponent_error"][-1])],
        "text, clocks of the gas": [("exponent of T(N)", n["power_of_N"], -10)],
        "text, γ": powers,
        "text, N_c": [(f"N_c, ε = {q[1]:g}", N[0], q[0], N[1]) for N, _, _, q in onset],
        "text, T_c": [(f"T/T₀ at N_c, ε = {q[1]:g}", T[0], q[2], T[1]) for _, T, _, q in onset],
    }
    checks = {
        "1": (AGREE, third, 4 / 15, 2e-3),
        "2–4": (AGREE, n["hertz"], 3.21806546, 1e-7),
        "5": (AGREE, C1, 1.15344, 1e-5),
        "6": (AGREE, C2, 0.79826, 1e-5),
        "7–9": (AGREE, elastic["by_slope"][-1], elastic["by_integral"][0], 3 * error),
        "10": (AGREE, last, -5 / 3, 0.05),
        "10, 42": (AGREE, max(n["lammps_T"] / 0.02, n["lammps_displacement"] / 0.08), 0, 1),
        "11": (AGREE, n["rate_power"], 0.6, 1e-3),
        "12, 27": (AGREE, n["frequency"], 1, 0.02),
        "13, 43": (CORRECTED, lost["lost_per_collision_at_paper_to"], 0, 0.1),
        "14": (AGREE, n["slopes_off"], 0, 0.03),
        "22, 24": (CORRECTED, decay / n["correlation_exponential"], 1, 0.05),
        "31": (AGREE, tau_v / tau_v_paper, 1, 0.02),
        "32": (AGREE, theory / n["relaxation_first"], 1, 1e-3),
        "33, 34": (CORRECTED, D / D_theory, 1, 0.01),
        "36": (CORRECTED, n["cooling_off"], 0, 1e-5),
        "38": (CORRECTED, n["temperature_off"], 0, 0.01),
        "39": (AGREE, RATE, 0.831928, 1e-5),
        "40": (CORRECTED, n["a3_of_theory"] / n["a3"], 1, 0.01),
        "41": (CORRECTED, n["D0"], 1, 1e-9),
        "42": (CORRECTED, n["displacement_off"], 0, 1e-4),
        "44": (AGREE, last_even, -2, 0.01),
        "45": (AGREE, n["logarithm_off"], 0, 0.03),
        "46": (AGREE, max(bend[0] / 0.01, bend[1] / 0.3), 0, 1),
        "47": (AGREE, n["leading"][-1], 1, 0.1),
        "—": (CORRECTED, n["a2_of_theory"] / -n["a2"], 1, 0.02),
        "text, clocks of the gas": (AGREE, n["power_of_N"], -10, 3),
        "text, γ": (AGREE, max(abs(x - y) for _, x, y in powers), 0, 0.03),
        "text, N_c": (AGREE, max(abs(N[0] / q[0] - 1) for N, _, _, q in onset), 0, 0.05),
        "text, T_c": (AGREE, max(map(abs, shifts)), 0, 1 if no_haff else 0),
        "text, clock": (AGREE, universal, True, 0.5),
        "text, retarded": (AGREE, delayed > 1, True, 0.5),
        "text, dissolution": (AGREE, uneven[-1] / max(uneven), 0, 0.3),
    }
    return [check(name, *row, *compared.get(name, [])) for name, row in checks.items()]


if __name__ == "__main__":
    run_parts(__doc__, paper_claims, smoke=False)
