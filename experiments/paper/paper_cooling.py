"""How does a granular gas cool, and is the paper's eps(v) right?

    python experiments/paper/paper_cooling.py [--only paper_restitution paper_cooling
        paper_exponents] [--smoke] [--record] [--out DIR]

paper_restitution: the series of eps, Eqs. (1), (5), (6). Integrates the equation of motion of
single impacts for both conditions at which contact can end (xi = 0 and F = 0), fits the
coefficients of the series to them, and measures the errors of the truncated series.

paper_cooling: two gases with the same initial cooling rate, viscoelastic and of constant
restitution, over seven decades of time: DSMC, kinetic theory, and the paper's closed forms, Eqs.
(10), (38) and (44), as printed and as corrected.

paper_exponents: the paper's closing remark considers eps = 1 - c v^gamma with exponents other than
1/5. Then dT/dt ~ -T^((3 + gamma)/2), T ~ t^(-2/(1 + gamma)) and <dr^2> ~ t^(gamma/(1 + gamma)). Ice
as measured by Bridges, Hatzes & Lin (Nature 309, 333, 1984), eps = min(1, 0.34 v^-0.234) with v in
cm/s, is not such a power law: the exponent of its T(t) changes with time.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import NullFormatter
from numpy.polynomial.chebyshev import chebpts1
from numpy.polynomial.polynomial import polyfit
from scipy.integrate import cumulative_trapezoid

import jaxgran
from experiments.support import analysis
from experiments.support.analysis import PACKING, interpolate_logs, slope
from experiments.support.closed_forms import haff, paper_temperature
from experiments.support.plots import DOTS, ELASTIC, GUIDE, INK, VISCOELASTIC, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import beads, ice
from jaxgran.scene.contact import impact
from jaxgran.scene.laws import C1, C2, UNCLIPPED_SERIES, viscoelastic_restitution
from jaxgran.theory.equations import COOLING_RATE

RAMIREZ = (0.48358, 0.28528)
"""Third and fourth coefficients of Ramirez et al., PRE 60, 4465 (1999), as often quoted."""

TIME, RATE = {"xlabel": "time t / τ$_c$(0)", "xscale": "log"}, "d ln T / d ln t"
SHADES = ("#084594", "#2171b5", "#6baed6", "#bdc9e1")
"""Colours from the smallest gamma to the largest, from dark to light."""


def paper_restitution(options: Options) -> dict:
    config = {"rtol": 1e-13, "num_impacts": 60, "lowest": 1e-3, "highest": 2.0, "fit_top": 0.3}
    config |= {"num_impacts": 16, "fit_degree": 12} if options.smoke else {"fit_degree": 16}
    betas = np.geomspace(config["lowest"], config["highest"], config["num_impacts"])
    clipped, unclipped = (restitutions(betas, end, config["rtol"]) for end in (True, False))
    two, five = series(betas, (-C1, C2)), series(betas, UNCLIPPED_SERIES)
    errors = {
        "two_terms_unclipped": two - unclipped,
        "two_terms_clipped": two - clipped,
        "ramirez_four_terms": series(betas, (-C1, C2, -RAMIREZ[0], RAMIREZ[1])) - unclipped,
        "four_terms": series(betas, UNCLIPPED_SERIES[:4]) - unclipped,
        "fast_law": np.asarray(viscoelastic_restitution(jnp.asarray(betas))) - clipped,
    }
    errors = {name: np.abs(error) for name, error in errors.items()}
    title = "The paper's two terms of ε hold to 1 % up to β = 0.25, for both ends of contact"
    axis = {"xlabel": "dissipation  β = (3/2) A α$^{2/5}$ v$^{1/5}$", "xscale": "log"}
    figure, (left, right) = panels(2, title=title, subplot_kw=axis)
    for eps, style, color, label in (
        (clipped, "-", INK, "equation of motion, ends at F = 0"),
        (unclipped, "--", ELASTIC, "equation of motion, ends at ξ = 0 (paper)"),
        (two, "-", VISCOELASTIC, "paper, Eq. (1): two terms"),
        (five, ":", INK, "five terms"),
    ):
        left.plot(betas, eps, style, color=color, label=label)
    caption(left, "One impact", ylabel="restitution  ε", ylim=(-0.02, 1.02))
    looks = (
        ("two terms, from ε that ends at ξ = 0", VISCOELASTIC, "-"),
        ("two terms, from ε that ends at F = 0", VISCOELASTIC, ":"),
        ("four terms of Ramírez et al. 1999", ELASTIC, "-"),
        ("four terms, corrected", GUIDE, "-."),
        ("the package's fast law, from F = 0", INK, "-"),
    )
    for error, (label, color, style) in zip(errors.values(), looks, strict=True):
        seen = error > 1e-13
        right.plot(betas[seen], error[seen], style, color=color, label=label)
    labels = {"ylabel": "error of ε", "yscale": "log", "ylim": (1e-13, 30)}
    caption(right, "Difference from the equation of motion", **labels)
    relative = {"F = 0": np.abs(two / clipped - 1), "xi = 0": np.abs(two / unclipped - 1)}
    measured = "two_terms_unclipped", "two_terms_clipped", "ramirez_four_terms"
    found = {
        "recovered": recovered(config),
        "orders": {name: np.mean(slope(betas[:10], errors[name][:10])[1]) for name in measured},
        "two_terms_good_to_one_per_cent": {
            name: interpolate_logs(0.01, miss, betas) for name, miss in relative.items()
        },
    }
    return {"config": config, "found": found, "picture": figure}


def restitutions(betas: np.ndarray, clipped: bool, rtol: float) -> np.ndarray:
    solve = jax.jit(lambda b: impact(b, clipped=clipped, rtol=rtol).restitution)
    return np.array([float(solve(b)) for b in betas])


def series(betas: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    return 1 + betas[:, None] ** np.arange(1, len(coefficients) + 1) @ np.array(coefficients)


def recovered(config: dict) -> dict[str, list[float]]:
    """Fit coefficients of beta^(1/2), beta, ... (clipped) or beta, beta^2, ... to impacts."""
    # A least-squares fit on Chebyshev nodes, twice as many as coefficients.
    degree, found = config["fit_degree"], {}
    nodes = config["fit_top"] * (1 + chebpts1(2 * degree)) / 2
    for name, power in (("clipped", 2), ("unclipped", 1)):
        x = nodes * config["fit_top"] ** (1 / power - 1)
        lost = restitutions(x**power, name == "clipped", config["rtol"]) - 1
        found[name] = polyfit(x, lost, range(1, degree + 1))[1:7]
    return found


def paper_cooling(options: Options) -> dict:
    config = {"num_particles": 20_000, "replicas": 8, "last": 1e6, "points": 22}
    if options.smoke:
        config |= {"num_particles": 1000, "replicas": 2, "last": 1e3, "points": 9}
    config |= {"packing_fraction": PACKING, "beta": 0.15, "seed": 0, "last_theory": 1e10}
    gases, tau = analysis.gases_of(config["beta"]), np.geomspace(0.1, config["last_theory"], 133)
    e = gases["constant"][0].coefficient
    title = "Late viscoelastic gases cool as t$^{-5/3}$, those of constant ε as t$^{-2}$"
    figure, (left, middle, right) = panels(3, title=title, subplot_kw=TIME)
    found: dict = {"restitution": e}
    for name, power in (("viscoelastic", -5 / 3), ("constant", -2.0)):
        gas, color, label = gases[name]
        T = analysis.compared(gas, "temperature", tau, config)[2]
        T.draw(left, middle, color, label, power)
        found[name] = {
            "largest_difference_of_theory": np.abs(1 / (1 + T.miss) - 1).max(),
            "exponent": {f"{t:.3g}": x for t, x in zip(T.middle, T.exponent, strict=True)},
            "exponent_error": T.exponent_error,
        }
        if name == "viscoelastic":
            late = np.abs(T.local - power) < 0.01 * abs(power)
            found["exponent_within_1_per_cent_from"] = analysis.from_here(late, T.where)
            delta = float(gas.delta)
            labels = "Eq. (10): u$^{-5/3}$", "Eq. (38) as printed, to order δ"
            labels += ("Eq. (38) corrected, to order δ$^2$",)
            leading = (1 + COOLING_RATE[3] * delta * tau) ** power
            of = labels, leading, paper_temperature, range(-1, 11)
            found["closed_forms"] = analysis.draw_forms(right, T, delta, *of)
        else:
            expected = np.asarray(haff(tau, e)) / T.theory - 1
            right.plot(tau, expected, color=color, label="Haff, Eq. (44)")
            found["haff"] = expected[::12]
    title = "Temperature: — theory, ● DSMC"
    caption(left, title, ylabel="T / T$_0$", yscale="log", ylim=(1e-16, 3))
    caption(middle, "Local exponent; dotted: −5/3 and −2", ylabel=RATE, ylim=(-2.1, 0.05))
    title = "Closed forms: difference from kinetic theory"
    caption(right, title, ylabel="T$_{formula}$ / T − 1", ylim=(-0.42, 0.62))
    return {"config": config, "found": found, "picture": figure}


def maxwellian(gas: jaxgran.Gas, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return T/T_0 of a Maxwellian gas of any law, and gamma = d ln <1 - eps^2> / d ln sqrt(T).

    ``d ln T/d tau = -<1 - eps^2> sqrt(T/T_0)/3`` with the mean weighted by ``g^3 exp(-g^2/2)``,
    computed as a sum over a fine grid, since `jaxgran.KineticTheory` requires a smooth law, unlike
    that of ice.
    """
    theta = np.geomspace(1.0, 1e-7, 1500)
    g = (np.arange(4000) + 0.5) / 400
    weight = g**3 * np.exp(-(g**2) / 2)
    eps = np.asarray(gas.reduced_law.restitution(jnp.asarray(g * np.sqrt(theta)[:, None])))
    lost = np.maximum((1 - eps**2) @ weight / weight.sum(), 1e-300)
    # The times at which T has these values.
    passed = cumulative_trapezoid(3 / (lost * np.sqrt(theta)), -np.log(theta), initial=0)
    at = np.exp(np.interp(tau, passed, np.log(theta)))
    gamma = 2 * np.gradient(np.log(lost), np.log(theta))
    return at, np.interp(-np.log(at), -np.log(theta), gamma)


def paper_exponents(options: Options) -> dict:
    config = {"gammas": (0.0, 0.2, 0.5, 1.0), "num_particles": 5000, "last": 1e5, "points": 19}
    config |= {"loss": 0.15, "ice_speed": 0.01, "packing_fraction": PACKING, "replicas": 8}
    if options.smoke:
        config |= {"gammas": (0, 1), "num_particles": 1000, "replicas": 2, "last": 100, "points": 7}
    config |= {"seed": 3, "last_theory": 1e8}
    title = "1 − ε ~ v$^γ$ cools as t$^{−2/(1+γ)}$; ice has no fixed exponent and becomes elastic"
    figure, (left, middle, right) = panels(3, title=title, subplot_kw={"xscale": "log"})
    tau = np.geomspace(0.1, config["last_theory"], 181)
    scene, gases = beads(PACKING, 0.1), {}
    for gamma, color in zip(config["gammas"], SHADES, strict=False):
        coefficient = -config["loss"] / float(scene.impact_speed) ** gamma
        law = jaxgran.RestitutionSeries([coefficient], [gamma])
        gases[f"γ = {gamma:g}"] = replace(scene, law=law), color, -2 / (1 + gamma)
    size = {"diameter": 0.02, "mass": jaxgran.sphere_mass(0.02, 900.0)}
    frozen = replace(scene, law=ice(), temperature=config["ice_speed"] ** 2 / 2, **size)
    found: dict = {}
    for name, (gas, color, power) in {**gases, "ice": (frozen, INK, None)}.items():
        theory = jaxgran.KineticTheory()
        of, _, T = analysis.compared(gas, "temperature", tau, config, theory)
        if power is None:
            theta, steepness = maxwellian(gas, tau)
            T = analysis.Compared(tau, theta, T.at, T.each)
            speed, aged, old = 100 * config["ice_speed"], T.middle > 100, tau[1:] > 100
            at = speed * np.sqrt(theta[1:][old])
            right.plot(at, T.local[old], color=INK, label="theory, Maxwellian")
            seen = speed * np.sqrt(np.sqrt(T.mean[1:] * T.mean[:-1]))[aged]
            errors = T.exponent_error[aged]
            right.errorbar(seen, T.exponent[aged], errors, color=INK, label="DSMC", **DOTS)
            label = "−2/(1 + γ), γ = d ln⟨1 − ε²⟩ / d ln T$^{1/2}$"
            right.plot(at, -2 / (1 + steepness[1:][old]), ":", color=GUIDE, label=label)
        T.draw(left, None if power is None else middle, color, name, power)
        last = T.at[-2:]
        found[name] = {
            "paper_exponent": power,
            "exponent": T.exponent[-1],
            "exponent_error": T.exponent_error[-1],
            "exponent_of_theory": slope(last, np.interp(last, tau, T.theory))[1][0],
            "last_exponent_of_theory": T.local[-1],
            "last_displacement_exponent": slope(tau, of.displacement)[1][-1],
        }
    caption(left, "Temperature: — theory, ● DSMC", ylabel="T / T$_0$", yscale="log", **TIME)
    caption(middle, "Local exponents; dotted: −2/(1 + γ)", ylabel=RATE, **TIME)
    title = f"Ice: elastic below {100 * float(ice().speed):.3f} cm/s; time runs to the left"
    caption(right, title, xlabel="thermal speed (2T)$^{1/2}$, cm/s", ylabel=RATE, ylim=(-2.1, 0.05))
    right.xaxis.set_minor_formatter(NullFormatter())
    return {"config": config, "found": found, "picture": figure}


if __name__ == "__main__":
    run_parts(__doc__, paper_restitution, paper_cooling, paper_exponents)
