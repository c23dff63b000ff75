"""How does a granular gas cool, with viscoelastic and with constant restitution?

    python experiments/paper/paper_cooling.py [--smoke] [--out DIR]

Two gases with the same initial cooling rate over seven decades of time: DSMC, kinetic theory, and
the paper's closed forms, Eqs. (10), (38) and (44), as printed and as corrected.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support import paper
from experiments.support.closed_forms import haff, paper_temperature
from experiments.support.scenes import beads, hard_beads
from jaxgran.theory.equations import COOLING_RATE

NAME = "paper_cooling"


@dataclass(frozen=True)
class Config:
    packing_fraction: float = 0.05
    beta: float = 0.15  # of an impact at the thermal speed, sqrt(2 T_0)
    num_particles: int = 20_000
    replicas: int = 8
    seed: int = 0
    last: float = 1e6  # mean free times simulated
    last_theory: float = 1e10
    points: int = 22


SMOKE = Config(num_particles=1000, replicas=2, last=1e3, points=9)


def main() -> None:
    options = paper.options(__doc__, NAME)
    config = SMOKE if options.smoke else Config()
    clock = paper.Clock()
    viscoelastic = beads(config.packing_fraction, config.beta)
    e = paper.alike(viscoelastic)
    gases = {"viscoelastic": viscoelastic, "constant": hard_beads(config.packing_fraction, e)}
    colors = {"viscoelastic": paper.VISCOELASTIC, "constant": paper.CONSTANT}
    slopes = {"viscoelastic": -5 / 3, "constant": -2.0}
    labels = {"viscoelastic": f"viscoelastic, δ = {float(viscoelastic.delta):.3f}"}
    labels["constant"] = f"constant ε = {e:.3f}"
    tau = np.geomspace(0.1, config.last_theory, 133)
    measured = np.geomspace(0.1, config.last, config.points)
    model = jaxgran.DSMC(config.num_particles, config.replicas)
    key = jax.random.key(config.seed)

    figure = paper.figure(
        "Viscoelastic spheres cool as t$^{-5/3}$, spheres of constant ε as t$^{-2}$:"
        " both of the paper's laws hold at late times",
        columns=3,
    )
    left, middle, right = figure.axes
    found = {}
    for name, gas in gases.items():
        theory = jaxgran.cool(
            gas,
            tau * gas.mean_free_time,
            model=jaxgran.KineticTheory(softness=False, correlations=False),
        )
        theta = np.asarray(theory.temperature / gas.temperature)
        dsmc = jaxgran.cool(gas, measured * gas.mean_free_time, model=model, key=key)
        each = paper.replicas_of(dsmc, "temperature") / float(gas.temperature)
        mean, error = paper.mean_and_error(each)
        at, exponents = paper.slope(measured, each)
        exponent, exponent_error = paper.mean_and_error(exponents)
        left.plot(tau, theta, color=colors[name], label=f"{labels[name]}: theory")
        left.errorbar(measured, mean, error, fmt="o", ms=3.5, color=colors[name], label="DSMC")
        where, local = paper.slope(tau, theta)
        middle.plot(where, local, color=colors[name], label=f"{name}: theory")
        middle.errorbar(at, exponent, exponent_error, fmt="o", ms=3.5, color=colors[name])
        middle.axhline(slopes[name], color=colors[name], ls=":", lw=1)
        of_theory = np.interp(np.log(measured), np.log(tau), np.log(theta))
        found[name] = {
            "largest_difference_of_theory": float(np.abs(np.exp(of_theory) / mean - 1).max()),
            "largest_standard_error": float((error / mean).max()),
            "exponent": {f"{t:.3g}": x for t, x in zip(at, exponent, strict=True)},
            "exponent_error": paper.listed(exponent_error),
            "exponent_of_theory": {f"{10.0**k:g}": _at(10.0**k, where, local) for k in range(10)},
            "collisions": float(np.asarray(dsmc.collisions)[-1]),
            "tau": paper.listed(measured),
            "temperature": paper.listed(mean),
            "temperature_error": paper.listed(error),
        }
        if name == "viscoelastic":
            late = np.abs(local - slopes[name]) < 0.01 * abs(slopes[name])
            found["exponent_within_1_per_cent_from"] = paper.from_here(late, where)
            found["closed_forms"] = formulas(right, tau, theta, float(gas.delta))
        else:
            expected = np.asarray(haff(tau, e))
            right.plot(tau, expected / theta - 1, color=colors[name], label="Haff, Eq. (44)")
            found["haff"] = paper.listed(expected[::12] / theta[::12] - 1)
    paper.caption(
        left,
        "Temperature",
        xlabel="time t / τ$_c$(0)",
        ylabel="T / T$_0$",
        xscale="log",
        yscale="log",
        ylim=(1e-16, 3),
    )
    paper.caption(
        middle,
        "Local exponent; dotted: the paper's −5/3 and −2",
        xlabel="time t / τ$_c$(0)",
        ylabel="d ln T / d ln t",
        xscale="log",
        ylim=(-2.1, 0.05),
    )
    right.axhline(0, color="0.7", lw=0.8)
    paper.caption(
        right,
        "Closed forms: difference from kinetic theory",
        xlabel="time t / τ$_c$(0)",
        ylabel="T$_{formula}$ / T − 1",
        xscale="log",
        ylim=(-0.42, 0.62),
    )
    for name in gases:
        row = found[name]
        print(
            f"{name}: theory within {100 * row['largest_difference_of_theory']:.2f} % of DSMC "
            f"(its error up to {100 * row['largest_standard_error']:.2f} %), last exponent "
            f"{list(row['exponent'].values())[-1]:.3f} +- {row['exponent_error'][-1]:.3f}"
        )
    paper.write(figure, options, NAME, config, clock, restitution=e, **found)


def _at(x: float, where: np.ndarray, values: np.ndarray) -> float:
    """Interpolate linearly in ln x."""
    return float(np.interp(np.log(x), np.log(where), values))


def formulas(axes, tau: np.ndarray, theta: np.ndarray, delta: float) -> dict:
    """Draw relative errors of the closed forms of T(t), and return them at some times."""
    u = 1 + COOLING_RATE[3] * delta * tau
    t = jnp.asarray(tau)
    forms = {
        "Eq. (10): u$^{-5/3}$": (u ** (-5 / 3), ":"),
        "Eq. (38) as printed, to order δ": (
            paper_temperature(t, delta, corrected=False),
            "--",
        ),
        "Eq. (38) corrected, to order δ$^2$": (paper_temperature(t, delta), "-"),
    }
    rows = {}
    for label, (values, style) in forms.items():
        miss = np.asarray(values) / theta - 1
        axes.plot(tau, miss, style, color=paper.VISCOELASTIC, label=label)
        key = label.split(":")[0].replace("$^2$", "^2")
        rows[key] = {f"{10.0**k:g}": _at(10.0**k, tau, miss) for k in range(-1, 11)}
    return rows


if __name__ == "__main__":
    main()
