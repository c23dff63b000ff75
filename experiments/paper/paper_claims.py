"""Which claims of the paper are confirmed? Numbers and verdicts for a table of every claim.

    python experiments/paper/paper_claims.py [--record] [--out DIR]

Computes constants and formulas in seconds, and reads what the other scripts paper_*.py recorded in
`experiments/recorded`. A verdict is "agree" or "corrected"; it does not hold if the numbers
contradict it. The table, `docs/pages/validation/paper_claims.md`, quotes these numbers and
those figures.
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
SCRIPTS = ("restitution", "cooling", "velocity_correlation", "diffusion", "diffusion_coefficient")
SCRIPTS += ("exponents", "clustering", "clustering_dissolves")


def paper_claims(_) -> dict:
    recorded = {name: figures(f"paper_{name}") for name in SCRIPTS}
    found = {name: x.get("found", x) for name, x in recorded.items()}
    numbers = expansions() | laws() | curves(found) | clusters(found["clustering"])
    rows = claims(found, numbers)
    print([row["name"] for row in rows if not row["holds"]], "do not hold")
    return {"numbers": numbers, "rows": rows}


def check(name: str, verdict: str, value, expected, tolerance, *compared: tuple) -> dict:
    """Return a verdict, which holds if a value is within a tolerance of the expected one.

    `compared` are labels, measured and printed values, and errors of the measured ones, of which
    the ratios are drawn. A label, alone or with an error, compares the value with the expected one.
    """
    ratios = []
    for words, *numbers in compared:
        here, printed, *error = numbers if len(numbers) > 1 else (value, expected, *numbers)
        spread = abs(float(error[0] / printed)) if error else None
        ratios.append((words, float(here / printed), spread))
    equation, holds = "text" if name.startswith("text") else name, abs(value - expected) < tolerance
    row = {"name": name, "equation": equation, "verdict": verdict}
    return row | {"holds": bool(holds), "ratios": ratios}


def miss(values, expected) -> float:
    """Return the largest relative difference."""
    return float(np.max(np.abs(np.divide(values, expected) - 1)))


def beads_of(delta: float) -> jaxgran.Gas:
    return beads(0.05, 1.5 * 2**0.1 * delta)


def cooled(delta: float, u) -> tuple[jaxgran.Gas, jaxgran.CoolingCurve]:
    """Return dilute viscoelastic beads of a given delta, cooled to times u = 1 + t/tau_0."""
    gas, tau = beads_of(delta), (jnp.asarray(u) - 1) / (RATE * delta)
    model = jaxgran.KineticTheory(
        corrections=jaxgran.KineticTheory.all_corrections - {"softness", "correlations"},
        order=2,
        rtol=1e-11,
    )
    return gas, jaxgran.cool(gas, tau * gas.mean_free_time, model=model)


def averages(delta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates of cooling and of relaxation, each exact and by the paper's two terms."""
    law, one = beads_of(delta).reduced_law, jnp.ones(())
    both = np.array([f(law, one, 3) for f in (impact_moments, closed_forms.paper_averages)])
    return both[:, 0, 0], both[:, 2, 0]


def expansions() -> dict[str, float]:
    """Return the coefficients of the expansions in delta, of the paper and by theory."""
    q, c = COOLING_CORRECTION, closed_forms.RELAXATION_CORRECTION
    s = closed_forms.SONINE_COEFFICIENT
    cooling, (relaxation, _) = averages(SMALL)
    gas, curve = cooled(SMALL, [1.0001, 10.0, 1e4, 1e6])
    u, late = np.array([1e4, 1e6]), slice(2, None)
    unit = float(gas.temperature * gas.mean_free_time)
    a_3 = (curve.diffusion[late] / (1.5 * unit) - u ** (-5 / 6)) * u / SMALL
    formula = closed_forms.paper_displacement((u - 1) / (RATE * SMALL), SMALL)
    exact = curve.displacement[late] / (unit * gas.mean_free_time)
    theory = jaxgran.KineticTheory()
    slope = jax.grad(lambda T: jnp.log(theory.cooling_rate(gas.replace(temperature=T))))
    printed = 8 / 3 * pi**0.5 * gas.diameter**2 * gas.contact_value * gas.number_density
    return {
        "hertz": float(impact(0.0).duration),
        "C1": C1,
        "C2": C2,
        "rate_power": float(slope(gas.temperature) * gas.temperature),
        "relaxation_first": c,
        "relaxation_second": 27 / 40 * gamma(2.2) * C1**2 * 4**0.2,
        "relaxation_of_theory": float(1 - 1.5 * relaxation / collision_rate(0.0, 3)) / SMALL,
        "relaxation_off_at_.1": miss(*averages(0.1)[1]),
        "relaxation_off_at_.3": miss(*averages(0.3)[1]),
        "cooling_off": miss(*cooling[::-1]),
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
        "displacement_off": miss(formula, exact),
    }


def laws() -> dict:
    """Return the accuracy of closed forms at delta = .093, and of theory for a LAMMPS curve."""
    u = np.geomspace(1.01, 1e9, 50)
    gas, curve = cooled(0.093, u)
    formula = closed_forms.paper_temperature((u - 1) / (RATE * 0.093), 0.093) * gas.temperature
    gas, late = cooled(0.093, [1e2, 1e6, 1e12])
    theta = np.asarray(late.temperature / gas.temperature)
    leading = 54 / (RATE * 0.093) * (theta**-0.1 - 1) * gas.temperature * gas.mean_free_time**2
    power = np.log(theta[2] / theta[1]) / np.log(late.collisions[2] / late.collisions[1])
    lammps = of_lammps("dilute")
    measured = lammps.curve
    theory = jaxgran.cool(lammps.gas, measured.times)
    return {
        "first_temperature": float(closed_forms.paper_temperature(0.0, 0.093, corrected=False)),
        "temperature_off": miss(formula, curve.temperature),
        "leading": (leading / np.asarray(late.displacement)).tolist(),
        "power_of_N": float(power),
        "lammps_delta": float(lammps.gas.delta),
        "lammps_T": miss(theory.temperature[1:], measured.temperature[1:]),
        "lammps_displacement": miss(theory.displacement[1:], measured.displacement[1:]),
    }


def relaxation_of_cooling_state(eps: float) -> float:
    """Return 1/tau_v of the cooling state over that of a Maxwellian gas at this T, less 1."""
    gas = hard_beads(0.01, eps)
    corrections = jaxgran.KineticTheory.all_corrections - {"correlations"}
    model = jaxgran.KineticTheory(corrections=corrections)
    curve = jaxgran.cool(gas, jnp.array([1e3, 1e4]) * gas.mean_free_time, model=model)
    moments = impact_moments(gas.reduced_law, jnp.ones(()), 3, order=3)[3]
    i, j = np.array(TERMS[3])
    terms = moments * curve.sonine[-1] ** i * curve.third_sonine[-1] ** j
    return float(terms.sum() / moments[0] - 1)


def curves(found: dict) -> dict:
    """Return what follows from the recorded simulations of cooling and diffusion."""
    run, routes = found["velocity_correlation"], found["diffusion_coefficient"]["constant"]
    dsmc, e = run["constant"]["dsmc"], run["restitution"]
    i = int(np.argmin(np.abs(np.array(dsmc["lags"]) - 4.0)))
    lowest = 1 - run["relaxation"]["constant"]["lost"][-1]
    spheres, constant = run["elastic"]["hard_spheres"], found["diffusion"]["constant"]
    x, y = np.log(constant["tau"]), constant["displacement"]
    first, last = np.diff(y[-7::3]) / np.diff(x[-7::3])  # of the last two decades
    return {
        "frequency": spheres["collisions"][-1] / (1.5 * spheres["lags"][-1]),
        "correlation": [dsmc["correlation"][i], dsmc["error"][i]],
        "correlation_printed": float(np.exp(-4 / run["constant"]["paper_relaxation"])),
        "correlation_exponential": float(np.exp(-(1 + e) / 3 * dsmc["collisions"][i])),
        "lowest_eps": lowest,
        "relaxation_of_cooling_state": relaxation_of_cooling_state(lowest),
        "slopes_off": miss(routes["by_slope"], routes["by_slope_theory"]),
        "haff_off": max(map(abs, found["cooling"]["haff"])),
        "logarithm_off": miss(last, first),
    }


def clusters(found: dict) -> dict:
    """Return the departures from Haff's law, and their distance from the paper's numbers."""
    rows = []
    for scene, (paper_N, e, paper_T) in zip(found["scenes"].values(), QUOTED, strict=True):
        left, T = scene["constant"]["departures"], scene["constant"]["T_at_the_papers_N"]
        by_number, by_time = left[BY_NUMBER], left[BY_TIME]
        spread = by_time["N"][0] - by_number["N"][0]
        slope = np.log(by_number["T"][0] / by_time["T"][0]) / spread
        row = {
            "N_by_time": by_time["N"],
            "N_by_number": by_number["N"],
            "N_early": left["T over theory's of t by 1.1"]["N"][0],
            "T_at_N": T,
            "haff_at_N": float(np.exp(-(1 - e**2) / 2 * paper_N)),
            "T_off": paper_T / T[0] - 1,
            # N at which T has the quoted value, by the slope of ln T between the two departures.
            "shifts": float(np.log(T[0] / paper_T) / slope),
            "spread": spread,
            "later": scene["viscoelastic_over_constant"][BY_NUMBER],
        }
        rows.append(row)
    clocks = (BY_TIME, BY_NUMBER, "unevenness over elastic by 2")
    return {name: [row[name] for row in rows] for name in rows[0]} | {
        "clocks": [found["first_scene_over_second"][name] for name in clocks]
    }


def claims(found: dict, n: dict) -> list[dict]:
    """Return the verdict of each claim, with what it is compared with."""
    spread, routes = found["diffusion"], found["diffusion_coefficient"]
    cooling, laws = found["cooling"], ("viscoelastic", "constant")
    visco, even = (list(cooling[law]["exponent"].values())[-1] for law in laws)
    visco_error, even_error = (cooling[law]["exponent_error"][-1] for law in laws)
    bend = [spread[law]["linear_in_collisions_within"] for law in laws]
    elastic, constant, eps = routes["elastic"], routes["constant"], routes["restitution"]
    error = np.hypot(elastic["by_slope_error"][-1], elastic["by_integral_error"][0])
    D, D_error, D_theory = (constant[f"by_slope{key}"][-1] for key in ("", "_error", "_theory"))
    slow = found["velocity_correlation"]["relaxation"]["constant"]
    tau_v, tau_v_error = (slow[key][-1] / slow["paper"][-1] for key in ("measured", "error"))
    decay, decay_error = n["correlation"]
    far, far_error = (spread["viscoelastic"][key][-1] for key in ("exponent", "exponent_error"))
    powers = [
        (f"exponent of T(t), {name}", one["last_exponent_of_theory"], one["paper_exponent"])
        for name, one in found["exponents"].items()
        if name.startswith("γ")
    ]
    onset = list(zip(QUOTED, n["N_by_time"], n["T_at_N"], n["haff_at_N"], strict=True))
    N_c = [(f"N_c, ε = {e:g}", N, q, error) for (q, e, _), (N, error), *_ in onset]
    T_c = [(f"T/T₀ at N_c, ε = {e:g}", T, q, error) for (_, e, q), _, (T, error), _ in onset]
    no_haff = all(abs(T / haff - 1) > 1 for *_, (T, _), haff in onset)
    shift = np.max(np.abs(np.divide(n["shifts"], n["spread"])))
    universal = all(0.5 < r["T"][0] < 2 < r["N"][0] for r in n["clocks"][:2])
    delayed = all(one["N"][0] - 3 * one["N"][1] > 1 for one in n["later"])
    uneven = found["clustering_dissolves"]["viscoelastic"]["unevenness"]
    third, lost = found["restitution"]["recovered"]["clipped"][4], spread["windows"][0]
    # Labels of values that are compared with printed ones, these values, and errors.
    decays = f"⟨v(0)·v(4τ_E)⟩, ε = {eps:.2f}", decay, n["correlation_printed"], decay_error
    diffuses = f"D/(T τ_E), ε = {eps:.2f}", D, constant["paper"][-1], D_error
    power_of_t = "exponent of ⟨Δr²⟩(t)", far, 1 / 6, far_error
    T_0, a_1 = ("T(0), δ = 0.093", 1, n["first_temperature"]), ("a₁", n["a1"], n["a1_paper"])
    a_3, a_3_of_theory = ("a₃", n["a3"], n["a3_paper"]), n["a3_of_theory"] / n["a3"]
    relaxation = n["relaxation_of_theory"] / n["relaxation_first"]
    by_lammps = max(n["lammps_T"] / 0.02, n["lammps_displacement"] / 0.08)
    return [
        check("1", AGREE, third, 4 / 15, 2e-3),
        check("2–4", AGREE, n["hertz"], 3.21806546, 1e-7),
        check("5", AGREE, C1, 1.15344, 1e-5, ("C₁",)),
        check("6", AGREE, C2, 0.79826, 1e-5, ("C₂",)),
        check("7–9", AGREE, elastic["by_slope"][-1], elastic["by_integral"][0], 3 * error),
        check("10", AGREE, visco, -5 / 3, 0.05, ("exponent of T(t), viscoelastic", visco_error)),
        check("10, 42", AGREE, by_lammps, 0, 1),
        check("11", AGREE, n["rate_power"], 0.6, 1e-3, ("exponent of 1/τ₀ in T₀",)),
        check("12, 27", AGREE, n["frequency"], 1, 0.02, ("1/τ_c at η = 0.05",)),
        check("13, 43", CORRECTED, lost["lost_per_collision_at_paper_to"], 0, 0.1),
        check("14", AGREE, n["slopes_off"], 0, 0.03),
        check("22, 24", CORRECTED, decay / n["correlation_exponential"], 1, 0.05, decays),
        check("31", AGREE, tau_v, 1, 0.02, (f"τ_v, ε = {n['lowest_eps']:.1f}", tau_v_error)),
        check("32", AGREE, relaxation, 1, 1e-3, ("first coefficient of 1/τ_v",)),
        check("33, 34", CORRECTED, D / D_theory, 1, 0.01, diffuses),
        check("36", CORRECTED, n["cooling_off"], 0, 1e-5),
        check("38", CORRECTED, n["temperature_off"], 0, 0.01, T_0, a_1),
        check("39", AGREE, RATE, 0.831928, 1e-5, ("τ_c(0)/(δτ₀)",)),
        check("40", CORRECTED, a_3_of_theory, 1, 0.01, a_3),
        check("41", CORRECTED, n["D0"], 1, 1e-9),
        check("42", CORRECTED, n["displacement_off"], 0, 1e-4, power_of_t),
        check("44", AGREE, even, -2, 0.01, ("exponent of T(t), constant ε", even_error)),
        check("45", AGREE, n["logarithm_off"], 0, 0.03),
        check("46", AGREE, max(bend[0] / 0.3, bend[1] / 0.01), 0, 1),
        check("47", AGREE, n["leading"][-1], 1, 0.1),
        check("—", CORRECTED, n["a2_of_theory"] / -n["a2"], 1, 0.02),
        check("text, clocks of the gas", AGREE, n["power_of_N"], -10, 3, ("exponent of T(N)",)),
        check("text, γ", AGREE, max(abs(x - y) for _, x, y in powers), 0, 0.03, *powers),
        check("text, N_c", AGREE, max(abs(N / q - 1) for _, N, q, _ in N_c), 0, 0.05, *N_c),
        check("text, T_c", AGREE, shift, 0, 1 if no_haff else 0, *T_c),
        check("text, clock", AGREE, universal, True, 0.5),
        check("text, retarded", AGREE, delayed, True, 0.5),
        check("text, dissolution", AGREE, uneven[-1] / max(uneven), 0, 0.3),
    ]


if __name__ == "__main__":
    run_parts(__doc__, paper_claims, smoke=False)
