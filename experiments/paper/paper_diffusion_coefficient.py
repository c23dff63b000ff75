"""Is D = T tau_v, and does D decrease with time as in the paper?

    python experiments/paper/paper_diffusion_coefficient.py [--smoke] [--out DIR]

D(t) of a cooling gas is computed by three methods: from the integral of the velocity
autocorrelation from t' on, Eq. (9); from the slope of <dr^2>, Eq. (14); and by theory, Eqs. (34)
and (40) as printed and with memory, dD/dt = T - D/tau_v. The simulations are DSMC, and hard and
soft spheres at one time t'.
"""

from dataclasses import dataclass, field, replace

import jax
import numpy as np

import jaxgran
from experiments.paper.paper_velocity_correlation import (
    SPHERES,
    diffusion,
    in_boxes,
    printed_relaxation,
    stochastic,
)
from experiments.paper.paper_velocity_correlation import Config as Correlation
from experiments.support import paper
from experiments.support.closed_forms import RELAXATION_CORRECTION
from experiments.support.scenes import beads, hard_beads
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE

NAME = "paper_diffusion_coefficient"


@dataclass(frozen=True)
class Config:
    correlation: Correlation = field(default_factory=lambda: Correlation(seed=1))
    waits: tuple[float, ...] = (1.0, 0.1, 0.01, 0.001)  # T(t')/T_0 of the viscoelastic gas
    last: float = 3000.0  # the last time, in mean free times
    points: int = 14


SMOKE = Config(
    replace(Correlation(), num_particles=2000, replicas=4, boxes=0),
    waits=(1.0,),
    last=30.0,
    points=6,
)


def main() -> None:
    options = paper.options(__doc__, NAME)
    config = SMOKE if options.smoke else Config()
    clock = paper.Clock()
    phi = config.correlation.packing_fraction
    viscoelastic = beads(phi, config.correlation.beta)
    e = paper.alike(viscoelastic)
    gases = {
        "elastic": (hard_beads(phi, 1.0), paper.ELASTIC),
        "constant": (hard_beads(phi, e), paper.CONSTANT),
        "viscoelastic": (viscoelastic, paper.VISCOELASTIC),
    }
    figure = paper.figure(
        "Three methods give the same D, and it is not T τ$_v$: the gas cools during τ$_v$",
        columns=3,
    )
    fall, ratio, kinds = figure.axes
    found = {
        name: routes(name, gas, color, config, fall, ratio) for name, (gas, color) in gases.items()
    }
    tau = np.geomspace(0.3, config.last, 200)
    delta = float(viscoelastic.delta)
    u = 1 + COOLING_RATE[3] * delta * tau
    a_3 = COOLING_CORRECTION + RELAXATION_CORRECTION
    printed = u ** (-5 / 6) + a_3 * delta / u
    fall.plot(tau, printed, "--", lw=1, color=paper.VISCOELASTIC, label="Eq. (40), to order δ")
    paper.caption(
        fall,
        f"viscoelastic (β = {config.correlation.beta}) and constant ε = {e:.3f}",
        xlabel="time t / τ$_c$(0)",
        ylabel="D / D$_0$,  D$_0$ = T$_0$ τ$_E$(0)",
        xscale="log",
        yscale="log",
    )
    ratio.plot([], [], color=paper.GUIDE, label="theory with memory")
    ratio.plot([], [], "--", lw=1, color=paper.GUIDE, label="Eq. (34): D = T τ$_v$")
    for style, label in (("o", "DSMC, slope of ⟨Δr²⟩"), ("D", "DSMC, ∫⟨v(t′)·v(t)⟩dt")):
        ratio.plot([], [], style, mfc="none", color=paper.GUIDE, label=label)
    paper.caption(
        ratio,
        "D over T τ$_E$; the gas cools to the right",
        xlabel="T(t′) / T$_0$",
        ylabel="D / (T τ$_E$)",
        xscale="log",
        xlim=(2, 1e-5),
        ylim=(0.96, 1.62),
    )
    by_models(kinds, gases, found)
    for name, row in found.items():
        print(
            f"{name}: D/(T tau_E) by the slope {row['by_slope'][-1]:.3f} +- "
            f"{row['by_slope_error'][-1]:.3f} (theory {row['by_slope_theory'][-1]:.3f}), by the "
            f"integral {row['by_integral'][-1]:.3f} +- {row['by_integral_error'][-1]:.3f}, T tau_v "
            f"{row['paper'][-1]:.3f}"
        )
        for kind in [kind for kind in SPHERES if kind in row]:
            of = row[kind]
            print(
                f"    {kind}, T/T_0 = {of['temperature']:.3f}: by the slope {of['slope']:.3f}"
                f" +- {of['slope_error']:.3f}, by the integral {of['integral']:.3f} +- "
                f"{of['integral_error']:.3f}"
            )
    paper.write(figure, options, NAME, config, clock, restitution=e, **found)


def routes(name: str, gas: jaxgran.Gas, color: str, config: Config, fall, ratio) -> dict:
    """Draw and return D of one gas by all methods, in units of T tau_E."""
    start, tau_c = float(gas.temperature), float(gas.mean_free_time)
    unit = 9 * start * tau_c**2  # of <dr^2> per collision at D = T tau_E
    # D of elastic spheres is constant after a few collisions, and their collision rate is constant.
    last = config.last if name != "elastic" else min(config.last, 30.0)
    tau = np.geomspace(0.5, last, config.points)
    fine = np.geomspace(0.02, last, 400)
    of = jaxgran.cool(
        gas, fine * tau_c, model=jaxgran.KineticTheory(softness=False, correlations=False)
    )
    theta = np.asarray(of.temperature) / start
    size = config.correlation
    model, key = jaxgran.DSMC(size.num_particles, size.replicas), jax.random.key(size.seed + 1)
    curve = jaxgran.cool(gas, tau * tau_c, model=model, key=key)
    slopes, errors = diffusion(curve, gas, slice(None))
    cooled = np.asarray(curve.temperature) / start
    middle = np.sqrt(cooled[1:] * cooled[:-1])

    def expected(quantity: str) -> np.ndarray:
        values = np.log(np.asarray(getattr(of, quantity)))
        return np.diff(np.exp(np.interp(np.log(tau), np.log(fine), values)))

    waits = config.waits if name == "viscoelastic" else (1.0,)
    runs = [stochastic(gas.replace(temperature=start * wait), size) for wait in waits]
    printed = [float(printed_relaxation(gas.replace(temperature=start * x))) for x in theta[::8]]
    boxes = in_boxes(gas, size, ages=name != "elastic")
    row = {
        "temperature": paper.listed(middle),
        "by_slope": paper.listed(slopes),
        "by_slope_error": paper.listed(errors),
        "by_slope_theory": paper.listed(expected("displacement") / expected("collisions") / unit),
        "waits": list(waits),
        "by_integral": [run["integral"] for run in runs],
        "by_integral_error": [run["integral_error"] for run in runs],
        "paper": [float(printed_relaxation(gas.replace(temperature=start * w))) for w in waits],
        **boxes,
    }
    d_0 = 1.5 * start * tau_c
    if name != "elastic":
        fall.plot(fine, np.asarray(of.diffusion) / d_0, color=color, label=name)
        mean = slopes * np.diff(np.asarray(curve.collisions)) / np.diff(tau)
        at = np.sqrt(tau[1:] * tau[:-1])
        fall.errorbar(at[4:], mean[4:], (errors / slopes * mean)[4:], fmt="o", ms=4, color=color)
    if name != "elastic":  # elastic spheres stay at T_0
        d_of_theory = np.asarray(of.diffusion) / d_0 / np.sqrt(theta)
        ratio.plot(theta, d_of_theory, color=color, label=name)
        ratio.plot(theta[::8], printed, "--", color=color, lw=1)
        ratio.errorbar(middle, slopes, errors, fmt="o", ms=4, color=color)
        hollow = {"ms": 6, "mfc": "none", "color": color}
        ratio.errorbar(waits, row["by_integral"], row["by_integral_error"], fmt="D", **hollow)
    return row


def by_models(axes, gases: dict, found: dict) -> None:
    """Draw D/(T tau_E) soon after the start by each particle model and method."""
    lines = [("DSMC", "dsmc")] + [(name.replace("_", " "), name) for name in SPHERES]
    ways = (("slope", "⟨Δr²⟩", "o"), ("integral", "∫⟨v·v⟩", "D"))
    labels = [f"{words}, {way}" for words, _ in lines for _, way, _ in ways]
    for shift, (name, (_, color)) in enumerate(gases.items()):
        row = found[name]
        for i, (_, kind) in enumerate(lines):
            for j, (way, _, marker) in enumerate(ways):
                if kind == "dsmc":
                    at = -1 if way == "slope" and name != "viscoelastic" else 0
                    if way == "slope" and name == "viscoelastic":
                        continue  # its D/(T tau_E) decreases: no single value is initial
                    value, error = row[f"by_{way}"][at], row[f"by_{way}_error"][at]
                elif kind in row:
                    value, error = row[kind][way], row[kind][f"{way}_error"]
                else:
                    continue
                axes.errorbar(
                    value,
                    2 * i + j + 0.14 * (shift - 1),
                    xerr=error,
                    fmt=marker,
                    ms=4.5,
                    mfc=color if marker == "o" else "none",
                    color=color,
                    label=name if (i, j) == (0, 1) else None,
                )
    axes.set_yticks(range(len(labels)), labels)
    axes.invert_yaxis()
    title = "All models, T(t′) ≥ 0.4 T$_0$"
    paper.caption(axes, title, xlabel="D / (T τ$_E$)", xlim=(0.95, 1.62))


if __name__ == "__main__":
    main()
