"""How does <dr^2> grow with time, collisions and 1/T, and when do the paper's laws hold?

    python experiments/paper/paper_diffusion.py [--smoke] [--out DIR]

Compares <dr^2> of two gases with the same initial cooling rate, one viscoelastic and one of
constant restitution, by DSMC, kinetic theory and the closed forms (paper, Eqs. (42), (45), (46),
(47)); computes its local exponent; and compares the range of times in which the paper expects its
laws to hold, Eq. (43), with the range in which they do.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support import paper
from experiments.support.closed_forms import paper_displacement
from experiments.support.scenes import beads, hard_beads
from jaxgran.theory.equations import COOLING_RATE, paper_averages

NAME = "paper_diffusion"


@dataclass(frozen=True)
class Config:
    packing_fraction: float = 0.05
    beta: float = 0.15  # of an impact at the thermal speed
    num_particles: int = 20_000
    replicas: int = 8
    seed: int = 2
    last: float = 1e6  # mean free times simulated
    points: int = 22
    last_theory: float = 1e14
    deltas: tuple[float, ...] = (0.1, 0.03, 0.01)  # for which the range of times is tabulated


SMOKE = Config(num_particles=1000, replicas=2, last=1e3, points=9, last_theory=1e10, deltas=(0.1,))


def main() -> None:
    options = paper.options(__doc__, NAME)
    config = SMOKE if options.smoke else Config()
    clock = paper.Clock()
    viscoelastic = beads(config.packing_fraction, config.beta)
    e, delta = paper.alike(viscoelastic), float(viscoelastic.delta)
    gases = {"viscoelastic": viscoelastic, "constant": hard_beads(config.packing_fraction, e)}
    colors = {"viscoelastic": paper.VISCOELASTIC, "constant": paper.CONSTANT}
    labels = {"viscoelastic": f"viscoelastic, δ = {delta:.3f}", "constant": f"constant ε = {e:.3f}"}
    figure = paper.figure(
        "Viscoelastic grains spread further: ⟨Δr²⟩ ~ t$^{1/6}$ instead of log t, but the exponent"
        " 1/6 is reached very late",
        columns=2,
        rows=2,
    )
    in_time, exponent, in_collisions, forms = figure.axes
    tau = np.geomspace(0.1, config.last_theory, 400)
    measured = np.geomspace(0.1, config.last, config.points)
    key = jax.random.key(config.seed)
    model = jaxgran.DSMC(config.num_particles, config.replicas)
    found = {}
    for name, gas in gases.items():
        unit = float(gas.temperature * gas.mean_free_time**2)
        theory = jaxgran.KineticTheory(softness=False, correlations=False)
        of = jaxgran.cool(gas, tau * gas.mean_free_time, model=theory)
        dsmc = jaxgran.cool(gas, measured * gas.mean_free_time, model=model, key=key)
        spread, collisions, theta = columns(of, float(gas.temperature), unit)
        each = paper.replicas_of(dsmc, "displacement") / unit
        mean, error = paper.mean_and_error(each)
        shown = {"fmt": "o", "ms": 3.5, "color": colors[name]}
        _, dsmc_collisions, dsmc_theta = columns(dsmc, float(gas.temperature), unit)
        far = tau <= 1e10
        for axes, x, at in (
            (in_time, tau, measured),
            (in_collisions, collisions, dsmc_collisions),
        ):
            axes.plot(x[far], spread[far], color=colors[name], label=f"{labels[name]}: theory")
            axes.errorbar(at, mean, error, **shown)
        where, local = paper.slope(tau, spread)
        at, exponents = paper.slope(measured, each)
        local_mean, local_error = paper.mean_and_error(exponents)
        exponent.plot(where, local, color=colors[name], label=f"{name}: theory")
        exponent.errorbar(at, local_mean, local_error, **shown)
        steps = np.diff(spread) / np.diff(collisions)
        late = collisions[1:] > 20
        miss = mean / np.exp(np.interp(np.log(measured), np.log(tau), np.log(spread))) - 1
        found[name] = {
            "tau": paper.listed(measured),
            "displacement": paper.listed(mean),
            "displacement_error": paper.listed(error),
            "collisions": paper.listed(dsmc_collisions),
            "temperature": paper.listed(dsmc_theta),
            "dsmc_from_theory": paper.listed(miss),
            "exponent": paper.listed(local_mean),
            "exponent_error": paper.listed(local_error),
            "exponent_of_theory": {f"{10.0**k:g}": _at(10.0**k, where, local) for k in range(14)},
            "per_collision_in_1_5_ell2": paper.listed(steps[late][:: max(late.sum() // 6, 1)] / 9),
            "linear_in_collisions_within": float(np.ptp(steps[late]) / steps[late].mean()),
        }
        if name == "viscoelastic":
            near = np.abs(local - 1 / 6) < 1 / 60
            found["exponent_within_10_per_cent_from"] = paper.from_here(near, where)
            found["closed_forms"] = formulas(forms, tau, spread, delta)
    # At small delta the solver's steps cover few collisions; longer times would take minutes.
    short = tau[tau < 1e12]
    found["windows"] = [cooling_window(x, short) for x in config.deltas]
    dress(figure.axes)
    for name in gases:
        row = found[name]
        print(
            f"{name}: DSMC from theory {100 * np.array(row['dsmc_from_theory'][1:]).min():+.2f} to "
            f"{100 * np.array(row['dsmc_from_theory'][1:]).max():+.2f} %; last exponent "
            f"{row['exponent'][-1]:.4f} +- {row['exponent_error'][-1]:.4f}; <dr^2> per collision "
            f"constant within {100 * row['linear_in_collisions_within']:.1f} % beyond 20 collisions"
        )
    for row in found["windows"]:
        print(row)
    paper.write(figure, options, NAME, config, clock, restitution=e, delta=delta, **found)


def columns(curve: jaxgran.CoolingCurve, temperature: float, unit: float) -> list[np.ndarray]:
    """Return <dr^2> in T_0 tau_c(0)^2, collisions, T/T_0."""
    assert curve.displacement is not None and curve.collisions is not None
    parts = (curve.displacement / unit, curve.collisions, curve.temperature / temperature)
    return [np.asarray(part) for part in parts]


def _at(x: float, where: np.ndarray, values: np.ndarray) -> float:
    """Interpolate linearly in ln x."""
    return float(np.interp(np.log(x), np.log(where), values))


def formulas(axes, tau: np.ndarray, spread: np.ndarray, delta: float) -> dict:
    """Draw relative errors of the closed forms of <dr^2>(t), and return them at some times."""
    rate = COOLING_RATE[3] * delta
    u, t = 1 + rate * tau, jnp.asarray(tau)
    of = {
        "leading: u$^{1/6}$ − 1": (54 / rate * (u ** (1 / 6) - 1), ":"),
        "Eq. (40) integrated": (paper_displacement(t, delta, corrected=False), "--"),
        "corrected, to order δ": (paper_displacement(t, delta), "-"),
    }
    rows = {}
    shown = tau > 3
    for label, (values, style) in of.items():
        miss = np.asarray(values) / spread - 1
        axes.plot(tau[shown], miss[shown], style, color=paper.VISCOELASTIC, label=label)
        rows[label.split(":")[0]] = {f"{10.0**k:g}": _at(10.0**k, tau, miss) for k in range(1, 15)}
    return rows


def cooling_window(delta: float, tau: np.ndarray) -> dict:
    """Return the paper's range of times for a given delta, and the accuracy of its laws there."""
    gas = beads(0.05, 1.5 * 2**0.1 * delta)
    curve = jaxgran.cool(
        gas,
        tau * gas.mean_free_time,
        model=jaxgran.KineticTheory(softness=False, correlations=False),
    )
    unit = float(gas.temperature * gas.mean_free_time**2)
    spread, collisions, theta = columns(curve, float(gas.temperature), unit)
    middle, local = paper.slope(tau, spread)
    # tau_c |dT/dt| / T is the share of T lost in a collision, -d ln T/dN.
    lost = -np.diff(np.log(theta)) / np.diff(collisions)
    relaxed = np.asarray(curve.diffusion) / (1.5 * unit / float(gas.mean_free_time))
    averages = jax.vmap(lambda x: paper_averages(gas.reduced_law, x, 3)[2, 0])
    slowing = np.asarray(averages(jnp.sqrt(jnp.asarray(theta))))
    t_tau_v = np.sqrt(theta) * float(np.sqrt(32 * np.pi) / 3) / slowing
    first, last = 1 / delta, delta ** (-11 / 5)
    return {
        "delta": delta,
        "paper_from": first,
        "paper_to": last,
        "exponent_at_paper_to": _at(last, middle, local),
        "lost_per_collision_at_start": float(lost[0]),
        "lost_per_collision_at_paper_to": _at(last, middle, lost),
        "exponent_within_10_per_cent_from": paper.from_here(np.abs(6 * local - 1) < 0.1, middle),
        "t_tau_v_within_5_per_cent_from": paper.from_here(
            np.abs(t_tau_v / relaxed - 1) < 0.05, tau
        ),
        "t_tau_v_within_1_per_cent_from": paper.from_here(
            np.abs(t_tau_v / relaxed - 1) < 0.01, tau
        ),
    }


def dress(panels) -> None:
    """Give the panels their titles and labels."""
    in_time, exponent, in_collisions, forms = panels
    for axes in (in_time, exponent, in_collisions):
        axes.plot([], [], "o", ms=3.5, color=paper.GUIDE, label="DSMC")
    spread, time = "⟨Δr²⟩ / (T$_0$ τ$_c$(0)²)", "time t / τ$_c$(0)"
    title = "Over time: a straight line is log t"
    paper.caption(in_time, title, xlabel=time, ylabel=spread, xscale="log", ylim=(0, 9000))
    exponent.axhline(1 / 6, color=paper.GUIDE, ls=":", lw=1.2)
    exponent.annotate("the paper's 1/6", (2e-1, 1 / 6), color=paper.GUIDE, va="bottom", fontsize=8)
    title = "Local exponent; a logarithm has 0"
    labels = {"xlabel": time, "ylabel": "d ln⟨Δr²⟩ / d ln t"}
    paper.caption(exponent, title, xscale="log", yscale="log", ylim=(0.015, 2.2), **labels)
    title = "Over collisions: both linear, nearly the same line"
    labels = {"xlabel": "collisions per particle  N", "ylabel": spread}
    paper.caption(in_collisions, title, xlim=(0, 600), ylim=(0, 7500), **labels)
    forms.axhline(0, color="0.7", lw=0.8)
    title = "Closed forms of the viscoelastic ⟨Δr²⟩: difference from theory"
    paper.caption(forms, title, xlabel=time, ylabel="formula / theory − 1", xscale="log")


if __name__ == "__main__":
    main()
