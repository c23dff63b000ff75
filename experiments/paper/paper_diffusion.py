"""How far do the particles of a cooling gas move, and how long do they keep their velocities?

    python experiments/paper/paper_diffusion.py [--only paper_velocity_correlation
        paper_diffusion_coefficient paper_diffusion] [--smoke] [--record] [--out DIR]

paper_velocity_correlation: the autocorrelation <v(t').v(t)> of elastic spheres and of spheres of
constant and viscoelastic restitution, its decay, and its relaxation time tau_v compared with the
elastic Enskog time tau_E, Eqs. (24), (31), (32). DSMC starts from Maxwellian velocities at T(t').
Hard and soft spheres first cool until t' and continue from the state reached there; elastic
spheres, whose state does not change, start at once. Soft spheres support the viscoelastic law only.

paper_diffusion_coefficient: is D = T tau_v? D(t) by three methods: from the integral of the
autocorrelation from t' on, Eq. (9); from the slope of <dr^2>, Eq. (14); and by theory, Eqs. (34)
and (40) as printed and with memory, dD/dt = T - D/tau_v.

paper_diffusion: <dr^2> of two gases with the same initial cooling rate over time and over
collisions, by DSMC, kinetic theory and the closed forms, Eqs. (42), (45), (46), (47); its local
exponent; and the range of times in which the paper expects its laws to hold, Eq. (43), compared
with the range in which they do.
"""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import simpson

import jaxgran
from experiments.support import analysis, closed_forms
from experiments.support.plots import CONSTANT, ELASTIC, GUIDE, VISCOELASTIC, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import beads, cool, hard_beads, restitution_like
from jaxgran.theory.averages import Rates, collision_rate, impact_moments
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE

PACKING = 0.05
THEORY = jaxgran.KineticTheory(softness=False, correlations=False)
SPHERES = {"hard_spheres": jaxgran.HardSpheres, "soft_spheres": jaxgran.SoftSpheres}
MARKERS = {"dsmc": ("o", 3), "hard_spheres": ("s", 1), "soft_spheres": ("^", 1)}
"""Marker of each model in the picture, and step between drawn points."""

CORRELATION = {
    "packing_fraction": PACKING,
    "beta": 0.3,
    "num_particles": 50_000,
    "replicas": 8,
    "seed": 0,
    "lags": 61,
    "longest": 12.0,  # in tau_E(t')
    "restitutions": (1.0, 0.8, 0.6, 0.4, 0.2),
    "betas": (0.05, 0.15, 0.3, 0.6, 1.0),
    "num_spheres": 2000,  # in a box
    "boxes": 4,
    "age": 6.0,  # t' of hard and soft spheres, in tau_c(0)
    "sphere_lags": 25,
}
FEW = {"num_particles": 2000, "replicas": 4, "restitutions": (1.0, 0.6), "betas": (0.3,)}
FEW |= {"boxes": 0}


def gases_of(beta: float) -> tuple[dict, float]:
    """Return gases with their colour and label, and the constant restitution."""
    viscoelastic = beads(PACKING, beta)
    e = restitution_like(viscoelastic)
    return {
        "elastic": (hard_beads(PACKING, 1.0), ELASTIC, "elastic"),
        "constant": (hard_beads(PACKING, e), CONSTANT, f"constant ε = {e:.3f}"),
        "viscoelastic": (viscoelastic, VISCOELASTIC, f"viscoelastic, β = {beta}"),
    }, e


def enskog_time(gas: jaxgran.Gas) -> float:
    """Return tau_E = (3/2) tau_c of the gas at its initial temperature."""
    return 1.5 * float(gas.mean_free_time)


@partial(jax.jit, static_argnames="dimension")
def relaxation(law, theta, sonine, dimension: int):
    """Return nu_v and the collision rate, in reduced units, at temperatures theta = T/T_0."""

    def one(theta, sonine):
        rates = Rates.from_averages(impact_moments(law, jnp.sqrt(theta), dimension), sonine)
        return jnp.stack([rates.relaxation, collision_rate(sonine, dimension)])

    return (jax.vmap(one)(theta, sonine) * jnp.sqrt(theta)[:, None]).T


def decay_of_theory(gas: jaxgran.Gas, lags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return <v(0).v(t)>/(d T_0) = exp(-int nu_v dt) and the collisions per particle.

    The lags, in tau_E, must be dense enough for the trapezoidal rule.
    """
    times = lags * enskog_time(gas)
    curve = cool(gas, times, THEORY)
    theta = curve.temperature / gas.temperature
    nu = relaxation(gas.reduced_law, theta, curve.sonine, gas.dimension)[0]
    nu = np.asarray(nu * gas.impact_speed / gas.path_length)
    passed = np.concatenate([[0.0], np.cumsum((nu[1:] + nu[:-1]) / 2 * np.diff(times))])
    return np.exp(-passed), np.asarray(curve.collisions)


def stochastic(gas: jaxgran.Gas, config: dict) -> dict:
    """Compute the autocorrelation by DSMC from a Maxwellian start, its tau_v and its integral."""
    lags = np.linspace(0, config["longest"], config["lags"])
    model = jaxgran.DSMC(config["num_particles"], config["replicas"])
    return summary(cool(gas, lags * enskog_time(gas), model, config["seed"]), lags)


def summary(curve: jaxgran.CoolingCurve, lags: np.ndarray) -> dict:
    """Return means and standard errors over the replicas, as lists and numbers for JSON."""
    each = analysis.replicas_of(curve, "velocity_correlation")
    each = each / each[:, :1]
    collisions = analysis.replicas_of(curve, "collisions").mean(axis=0)
    early = (collisions > 0) & (collisions < 2.5)
    # Early -ln C = r N + s N^2: the relaxation time is 1/r collisions, and tau_E is 3/2 collisions.
    basis = np.stack([collisions[early], collisions[early] ** 2], axis=1)
    fits = np.linalg.lstsq(basis, -np.log(each[:, early]).T, rcond=None)[0][0]
    correlation, error = analysis.mean_and_error(each)
    found = {"lags": lags, "collisions": collisions, "correlation": correlation, "error": error}
    integrals = np.asarray(simpson(each, x=lags, axis=1))
    for name, values in (("relaxation", 2 / 3 / fits), ("integral", integrals)):
        found[name], found[f"{name}_error"] = map(float, analysis.mean_and_error(values))
    return found


def in_boxes(gas: jaxgran.Gas, config: dict, ages: bool) -> dict[str, dict]:
    """Compute it by every sphere model that supports the gas, from t' on; none without boxes."""
    found = {}
    for kind in SPHERES if isinstance(gas.law, jaxgran.Viscoelastic) else ["hard_spheres"]:
        if not config["boxes"]:
            continue
        model = SPHERES[kind](config["num_spheres"], replicas=config["boxes"])
        age = config["age"] * float(gas.mean_free_time)
        grown = cool(gas, [age / 2, age] if ages else [age / 100], model, config["seed"])
        aged = gas.replace(temperature=float(grown.temperature[-1]))
        lags = np.linspace(0, config["longest"], config["sphere_lags"])
        later = replace(model, start=grown.particles)
        curve = cool(aged, lags * enskog_time(aged), later)
        # From 4 tau_E on the velocities at t' no longer matter, whatever the age.
        i = int(np.searchsorted(lags, 4.0))
        (slope,), (error,) = diffusion_of(curve, aged, slice(i, None, len(lags) - 1 - i))
        cooled = float(aged.temperature / gas.temperature)
        row = {"slope": float(slope), "slope_error": float(error), "temperature": cooled}
        found[kind] = summary(curve, lags) | row
    return found


def diffusion_of(
    curve: jaxgran.CoolingCurve, gas: jaxgran.Gas, which: slice
) -> tuple[np.ndarray, np.ndarray]:
    """Return d<dr^2>/(6 T tau_E dt) between times, where T tau_E dt ~ sqrt(T) dt ~ dN."""
    spread = analysis.replicas_of(curve, "displacement")[:, which]
    collisions = analysis.replicas_of(curve, "collisions")[:, which]
    unit = 9 * float(gas.temperature * gas.mean_free_time**2)
    return analysis.mean_and_error(np.diff(spread) / np.diff(collisions) / unit)


def exact_relaxation(gas: jaxgran.Gas) -> float:
    """Return tau_v/tau_E of the Maxwellian gas at its initial temperature, for any law."""
    nu, rate = relaxation(gas.reduced_law, jnp.ones(1), jnp.zeros(1), gas.dimension)
    return float((2 / 3 * rate / nu)[0])


def printed_relaxation(gas: jaxgran.Gas) -> float:
    """Return tau_v/tau_E by Eq. (31), or by the two terms of Eq. (32)."""
    if isinstance(gas.law, jaxgran.ConstantRestitution):
        return float(2 / (1 + gas.law.coefficient))
    nu = closed_forms.paper_averages(gas.reduced_law, jnp.ones(()), gas.dimension)[2, 0]
    return float(2 / 3 * collision_rate(0.0, gas.dimension) / nu)


def paper_velocity_correlation(options: Options) -> dict:
    config = CORRELATION | (FEW if options.smoke else {})
    gases, e = gases_of(config["beta"])
    title = (
        "Dissipation lengthens the paths: velocities decay nearly exponentially in collisions,"
        " more slowly in time"
    )
    figure, (decay, counted, times) = panels(3, title=title)
    found: dict = {"restitution": e}
    lags = np.linspace(0, config["longest"], 601)
    for name, (gas, color, label) in gases.items():
        expected, collisions = decay_of_theory(gas, lags)
        row: dict = {"dsmc": stochastic(gas, config)}
        row["paper_relaxation"] = printed_relaxation(gas)
        row["exact_relaxation"] = exact_relaxation(gas)
        row |= in_boxes(gas, config, ages=name != "elastic")
        decay.plot(lags, expected, color=color, label=f"{label}: theory")
        decay.plot(lags, np.exp(-lags / row["paper_relaxation"]), "--", color=color, lw=0.9)
        counted.plot(collisions, expected, color=color, label=f"{label}: theory")
        for kind in [kind for kind in MARKERS if kind in row]:
            marker, every = MARKERS[kind]
            of = {k: v[::every] for k, v in row[kind].items() if np.ndim(v)}
            seen = of["correlation"] > 4 * of["error"]
            style = {"fmt": marker, "ms": 3.5, "color": color}
            style |= {"mfc": "none"} if kind in SPHERES else {}
            for axes, x in ((decay, of["lags"]), (counted, of["collisions"])):
                axes.errorbar(x[seen], of["correlation"][seen], of["error"][seen], **style)
        found[name] = row
    shared = {"yscale": "log", "ylim": (2e-3, 1.2), "ylabel": "⟨v(t′)·v(t)⟩ / ⟨v(t′)²⟩"}
    kinds = "● DSMC, □ hard, △ soft spheres, — theory"
    title = f"Over time: slower than exp(−(t−t′)/τ$_v$(t′)), dashed\n{kinds}"
    caption(decay, title, xlabel="(t − t′) / τ$_E$(t′)", xlim=(0, 9), **shared)
    title = f"Over collisions: nearly exponential\n{kinds}"
    caption(counted, title, xlabel="collisions per particle since t′", xlim=(0, 9), **shared)
    found["relaxation"] = relaxation_times(times, config)
    return {"config": config, "found": found, "picture": figure}


def lost_at_thermal_speed(gas: jaxgran.Gas) -> float:
    return 1 - float(gas.reduced_law.restitution(jnp.ones(())))


def relaxation_times(axes, config: dict) -> dict:
    """Draw tau_v/tau_E for several strengths of dissipation over 1 - eps at the thermal speed."""
    short, found = config | {"longest": 2.0, "lags": 11}, {}
    laws = {
        "constant": ([hard_beads(PACKING, e) for e in config["restitutions"]], CONSTANT),
        "viscoelastic": ([beads(PACKING, b) for b in config["betas"]], VISCOELASTIC),
    }
    for name, (gases, color) in laws.items():
        rows = [stochastic(gas, short) for gas in gases]
        found[name] = {
            "lost": [lost_at_thermal_speed(gas) for gas in gases],
            "measured": [row["relaxation"] for row in rows],
            "error": [row["relaxation_error"] for row in rows],
            "exact": [exact_relaxation(gas) for gas in gases],
            "paper": [printed_relaxation(gas) for gas in gases],
        }
        columns = (found[name][key] for key in ("lost", "measured", "error"))
        axes.errorbar(*columns, fmt="o", ms=4, color=color, label=f"{name}: DSMC")
    x = np.linspace(0, 0.85, 60)
    axes.plot(x, 2 / (2 - x), color=CONSTANT, label="Eq. (31): 2 / (1 + ε)")
    line = [beads(PACKING, b) for b in np.linspace(1e-3, 1.15, 40)]
    x = [lost_at_thermal_speed(gas) for gas in line]
    color = VISCOELASTIC
    axes.plot(x, [*map(exact_relaxation, line)], color=color, label="exact average of ε(v)")
    axes.plot(
        x, [*map(printed_relaxation, line)], "--", color=color, lw=1, label="Eq. (32), two terms"
    )
    labels = {"xlabel": "1 − ε at the thermal speed", "ylabel": "initial τ$_v$ / τ$_E$"}
    caption(axes, "The relaxation time, from the initial slope", **labels)
    return found


def paper_diffusion_coefficient(options: Options) -> dict:
    # The temperatures of the viscoelastic gas at t', over T_0; the last time in mean free times.
    config: dict = {"waits": (1.0, 0.1, 0.01, 0.001), "last": 3000.0, "points": 14}
    config |= {"waits": (1.0,), "last": 30.0, "points": 6} if options.smoke else {}
    config["correlation"] = CORRELATION | (FEW if options.smoke else {"seed": 1})
    gases, e = gases_of(CORRELATION["beta"])
    title = "Three methods give the same D, and it is not T τ$_v$: the gas cools during τ$_v$"
    figure, (fall, ratio, kinds) = panels(3, title=title)
    found: dict = {"restitution": e}
    for name, (gas, color, _) in gases.items():
        found[name] = routes(name, gas, color, config, fall, ratio)
    delta = float(gases["viscoelastic"][0].delta)
    tau = np.geomspace(0.3, config["last"], 200)
    u = 1 + COOLING_RATE[3] * delta * tau
    printed = u ** (-5 / 6) + (COOLING_CORRECTION + closed_forms.RELAXATION_CORRECTION) * delta / u
    fall.plot(tau, printed, "--", lw=1, color=VISCOELASTIC, label="Eq. (40), to order δ")
    title = f"viscoelastic (β = {CORRELATION['beta']}) and constant ε = {e:.3f}"
    labels = {"xlabel": "time t / τ$_c$(0)", "ylabel": "D / D$_0$,  D$_0$ = T$_0$ τ$_E$(0)"}
    caption(fall, title, xscale="log", yscale="log", **labels)
    ratio.plot([], [], color=GUIDE, label="theory with memory")
    ratio.plot([], [], "--", lw=1, color=GUIDE, label="Eq. (34): D = T τ$_v$")
    for style, label in (("o", "DSMC, slope of ⟨Δr²⟩"), ("D", "DSMC, ∫⟨v(t′)·v(t)⟩dt")):
        ratio.plot([], [], style, mfc="none", color=GUIDE, label=label)
    title = "D over T τ$_E$; the gas cools to the right"
    labels = {"xlabel": "T(t′) / T$_0$", "ylabel": "D / (T τ$_E$)"}
    caption(ratio, title, xscale="log", xlim=(2, 1e-5), ylim=(0.96, 1.62), **labels)
    by_models(kinds, gases, found)
    return {"config": config, "found": found, "picture": figure}


def routes(name: str, gas: jaxgran.Gas, color: str, config: dict, fall, ratio) -> dict:
    """Draw and return D of one gas by all methods, in units of T tau_E."""
    start, tau_c = float(gas.temperature), float(gas.mean_free_time)
    # D of elastic spheres is constant after a few collisions, and their collision rate is constant.
    last = config["last"] if name != "elastic" else min(config["last"], 30.0)
    tau, fine = np.geomspace(0.5, last, config["points"]), np.geomspace(0.02, last, 400)
    of = cool(gas, fine * tau_c, THEORY)
    size = config["correlation"]
    model = jaxgran.DSMC(size["num_particles"], size["replicas"])
    curve = cool(gas, tau * tau_c, model, size["seed"] + 1)
    slopes, errors = diffusion_of(curve, gas, slice(None))
    cooled = np.asarray(curve.temperature) / start
    middle = np.sqrt(cooled[1:] * cooled[:-1])

    def expected(quantity: str) -> np.ndarray:
        values = np.log(np.asarray(getattr(of, quantity)))
        return np.diff(np.exp(analysis.interpolate(tau, fine, values)))

    def printed(shares) -> list[float]:
        return [printed_relaxation(gas.replace(temperature=start * x)) for x in shares]

    waits = config["waits"] if name == "viscoelastic" else (1.0,)
    runs = [stochastic(gas.replace(temperature=start * wait), size) for wait in waits]
    unit = 9 * start * tau_c**2  # of <dr^2> per collision at D = T tau_E
    row = {
        "temperature": middle,
        "by_slope": slopes,
        "by_slope_error": errors,
        "by_slope_theory": expected("displacement") / expected("collisions") / unit,
        "waits": list(waits),
        "by_integral": [run["integral"] for run in runs],
        "by_integral_error": [run["integral_error"] for run in runs],
        "paper": printed(waits),
        **in_boxes(gas, size, ages=name != "elastic"),
    }
    if name != "elastic":  # elastic spheres stay at T_0
        theta = np.asarray(of.temperature) / start
        D = np.asarray(of.diffusion) / (1.5 * start * tau_c)
        fall.plot(fine, D, color=color, label=name)
        mean = slopes * np.diff(np.asarray(curve.collisions)) / np.diff(tau)
        at = np.sqrt(tau[1:] * tau[:-1])
        fall.errorbar(at[4:], mean[4:], (errors / slopes * mean)[4:], fmt="o", ms=4, color=color)
        ratio.plot(theta, D / np.sqrt(theta), color=color, label=name)
        ratio.plot(theta[::8], printed(theta[::8]), "--", color=color, lw=1)
        ratio.errorbar(middle, slopes, errors, fmt="o", ms=4, color=color)
        hollow = {"ms": 6, "mfc": "none", "color": color}
        ratio.errorbar(waits, row["by_integral"], row["by_integral_error"], fmt="D", **hollow)
    return row


def by_models(axes, gases: dict, found: dict) -> None:
    """Draw D/(T tau_E) soon after the start by each particle model and method."""
    labels = []
    for kind in ("dsmc", *SPHERES):
        for way, words, marker in (("slope", "⟨Δr²⟩", "o"), ("integral", "∫⟨v·v⟩", "D")):
            model = "DSMC" if kind == "dsmc" else kind.replace("_", " ")
            labels.append(f"{model}, {words}")
            for shift, (name, (_, color, _)) in enumerate(gases.items()):
                row, at = found[name], -1 if way == "slope" else 0
                if kind == "dsmc" and (way, name) == ("slope", "viscoelastic"):
                    continue  # its D/(T tau_E) decreases: no single value is initial
                if kind == "dsmc":
                    value, error = row[f"by_{way}"][at], row[f"by_{way}_error"][at]
                elif kind in row:
                    value, error = row[kind][way], row[kind][f"{way}_error"]
                else:
                    continue
                style = {"fmt": marker, "ms": 4.5, "mfc": color if marker == "o" else "none"}
                style |= {"color": color, "label": name if len(labels) == 2 else None}
                axes.errorbar(value, len(labels) - 1 + 0.14 * (shift - 1), xerr=error, **style)
    axes.set_yticks(range(len(labels)), labels)
    axes.invert_yaxis()
    title = "All models, T(t′) ≥ 0.4 T$_0$"
    caption(axes, title, xlabel="D / (T τ$_E$)", xlim=(0.95, 1.62))


def paper_diffusion(options: Options) -> dict:
    config: dict = {"num_particles": 20_000, "last": 1e6, "points": 22, "replicas": 8}
    config |= {"last_theory": 1e14, "deltas": (0.1, 0.03, 0.01)}  # deltas of the ranges of times
    if options.smoke:
        config |= {"num_particles": 1000, "replicas": 2, "last": 1e3, "points": 9}
        config |= {"last_theory": 1e10, "deltas": (0.1,)}
    config |= {"packing_fraction": PACKING, "beta": 0.15, "seed": 2}
    gases, e = gases_of(config["beta"])
    delta = float(gases["viscoelastic"][0].delta)
    title = (
        "Viscoelastic grains spread further: ⟨Δr²⟩ ~ t$^{1/6}$ instead of log t, but the exponent"
        " 1/6 is reached very late"
    )
    figure, (in_time, exponent, in_collisions, forms) = panels(2, 2, title)
    tau = np.geomspace(0.1, config["last_theory"], 400)
    found: dict = {"restitution": e, "delta": delta}
    for name in ("viscoelastic", "constant"):
        gas, color, label = gases[name]
        unit = float(gas.temperature * gas.mean_free_time**2)
        theory, dsmc, spread = analysis.compared(gas, "displacement", unit, tau, config, THEORY)
        label = f"viscoelastic, δ = {delta:.3f}" if name == "viscoelastic" else label
        spread.draw(in_time, exponent, color, f"{label}: theory", f"{name}: theory")
        shown = {"fmt": "o", "ms": 3.5, "color": color}
        in_collisions.plot(theory.collisions, spread.theory, color=color, label=f"{label}: theory")
        in_collisions.errorbar(dsmc.collisions, spread.mean, spread.error, **shown)
        steps = np.diff(spread.theory) / np.diff(np.asarray(theory.collisions))
        steps = steps[np.asarray(theory.collisions)[1:] > 20]
        found[name] = {
            "tau": spread.at,
            "displacement": spread.mean,
            "displacement_error": spread.error,
            "collisions": dsmc.collisions,
            "dsmc_from_theory": spread.miss,
            "exponent": spread.exponent,
            "exponent_error": spread.exponent_error,
            "exponent_of_theory": analysis.at_powers(0, 14, spread.where, spread.local),
            "linear_in_collisions_within": float(np.ptp(steps) / steps.mean()),
        }
        if name == "viscoelastic":
            near = np.abs(spread.local - 1 / 6) < 1 / 60
            found["exponent_within_10_per_cent_from"] = analysis.from_here(near, spread.where)
            rate, t = COOLING_RATE[3] * delta, jnp.asarray(tau)
            of = {
                "leading: u$^{1/6}$ − 1": (54 / rate * ((1 + rate * tau) ** (1 / 6) - 1), ":"),
                "Eq. (40) integrated": (
                    closed_forms.paper_displacement(t, delta, corrected=False),
                    "--",
                ),
                "corrected, to order δ": (closed_forms.paper_displacement(t, delta), "-"),
            }
            found["closed_forms"] = analysis.draw_forms(forms, spread, of, (1, 15))
    # At small delta the solver's steps cover few collisions; longer times would take minutes.
    found["windows"] = [cooling_window(x, tau[tau < 1e12]) for x in config["deltas"]]
    for axes in (in_time, exponent, in_collisions):
        axes.plot([], [], "o", ms=3.5, color=GUIDE, label="DSMC")
    length, logs = "⟨Δr²⟩ / (T$_0$ τ$_c$(0)²)", {"xlabel": "time t / τ$_c$(0)", "xscale": "log"}
    title = "Over time: a straight line is log t"
    caption(in_time, title, ylabel=length, xlim=(0.05, 2e10), ylim=(0, 9000), **logs)
    exponent.axhline(1 / 6, color=GUIDE, ls=":", lw=1.2)
    exponent.annotate("the paper's 1/6", (2e-1, 1 / 6), color=GUIDE, va="bottom", fontsize=8)
    labels = {"ylabel": "d ln⟨Δr²⟩ / d ln t", "yscale": "log", "ylim": (0.015, 2.2)}
    caption(exponent, "Local exponent; a logarithm has 0", **labels, **logs)
    labels = {"xlabel": "collisions per particle  N", "ylabel": length}
    title = "Over collisions: both linear, nearly the same line"
    caption(in_collisions, title, xlim=(0, 600), ylim=(0, 7500), **labels)
    forms.axhline(0, color="0.7", lw=0.8)
    title = "Closed forms, viscoelastic: difference from theory"
    labels = {"ylabel": "formula / theory − 1", "xlim": (3, None), "ylim": (-0.25, 1.2)}
    caption(forms, title, **labels, **logs)
    return {"config": config, "found": found, "picture": figure}


def cooling_window(delta: float, tau: np.ndarray) -> dict:
    """Return the paper's range of times for a given delta, and the accuracy of its laws there."""
    gas = beads(PACKING, 1.5 * 2**0.1 * delta)
    curve = cool(gas, tau * gas.mean_free_time, THEORY)
    theta = np.asarray(curve.temperature / gas.temperature)
    middle, local = analysis.slope(tau, np.asarray(curve.displacement))
    # tau_c |dT/dt| / T is the share of T lost in a collision, -d ln T/dN.
    lost = -np.diff(np.log(theta)) / np.diff(curve.collisions)
    relaxed = np.asarray(curve.diffusion / (1.5 * gas.temperature * gas.mean_free_time))
    averages = jax.vmap(lambda x: closed_forms.paper_averages(gas.reduced_law, x, 3)[2, 0])
    slowing = np.asarray(averages(jnp.sqrt(jnp.asarray(theta))))
    off = np.abs(np.sqrt(theta) * float(np.sqrt(32 * np.pi) / 3) / slowing / relaxed - 1)
    last = delta ** (-11 / 5)
    return {
        "delta": delta,
        "exponent_at_paper_to": float(analysis.interpolate(last, middle, local)),
        "lost_per_collision_at_start": float(lost[0]),
        "lost_per_collision_at_paper_to": float(analysis.interpolate(last, middle, lost)),
        "t_tau_v_within_5_per_cent_from": analysis.from_here(off < 0.05, tau),
    }


if __name__ == "__main__":
    run_parts(__doc__, paper_velocity_correlation, paper_diffusion_coefficient, paper_diffusion)
