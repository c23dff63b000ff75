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

import jax.numpy as jnp
import numpy as np
from scipy.integrate import cumulative_trapezoid, simpson

import jaxgran
from experiments.support import analysis, closed_forms
from experiments.support.analysis import ENSKOG, PACKING, gases_of
from experiments.support.plots import CONSTANT, DOTS, GUIDE, VISCOELASTIC, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import beads, cool, hard_beads
from jaxgran.theory.averages import collision_rate, impact_moments
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE

SPHERES = {"hard_spheres": jaxgran.HardSpheres, "soft_spheres": jaxgran.SoftSpheres}
MARKERS = {"dsmc": ("o", 3), "hard_spheres": ("s", 1), "soft_spheres": ("^", 1)}
"""Marker of each model in the picture, and step between drawn points."""

TIME = {"xlabel": "time t / τ$_c$(0)", "xscale": "log"}
CORRELATION: dict = {"packing_fraction": PACKING, "beta": 0.3, "seed": 0}
CORRELATION |= {"num_particles": 50_000, "replicas": 8, "lags": 61, "longest": 12.0}
CORRELATION |= {"restitutions": (1.0, 0.8, 0.6, 0.4, 0.2), "betas": (0.05, 0.15, 0.3, 0.6, 1.0)}
CORRELATION |= {"num_spheres": 2000, "boxes": 4, "age": 6.0, "sphere_lags": 25}
"""The longest lag is in tau_E(t'), the age, t' of hard and soft spheres, in tau_c(0)."""

FEW = {"num_particles": 2000, "replicas": 4, "restitutions": (1, 0.6), "betas": (0.3,), "boxes": 0}


def enskog_time(gas: jaxgran.Gas) -> float:
    """Return tau_E = (3/2) tau_c of the gas at its initial temperature."""
    return 1.5 * float(gas.mean_free_time)


def relaxation_rate(gas: jaxgran.Gas, theta, sonine=0.0, averages=impact_moments) -> np.ndarray:
    """Return nu_v over sqrt(T/T_0), in reduced units, at temperatures theta = T/T_0."""

    def one(theta, sonine):
        moments = averages(gas.reduced_law, jnp.sqrt(theta), gas.dimension)
        return jnp.polyval(moments[2, ::-1], sonine)

    return np.asarray(jnp.vectorize(one)(theta, sonine))


def decay_of_theory(gas: jaxgran.Gas, lags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return <v(0).v(t)>/(d T_0) = exp(-int nu_v dt) and the collisions per particle.

    The lags, in tau_E, must be dense enough for the trapezoidal rule.
    """
    times = lags * enskog_time(gas)
    curve = cool(gas, times, ENSKOG)
    theta = np.asarray(curve.temperature / gas.temperature)
    nu = relaxation_rate(gas, theta, curve.sonine) * np.sqrt(theta)
    passed = cumulative_trapezoid(nu * gas.impact_speed / gas.path_length, times, initial=0)
    return np.exp(-passed), np.asarray(curve.collisions)


def exact_relaxation(gas: jaxgran.Gas, theta=1.0, averages=impact_moments) -> np.ndarray:
    """Return tau_v/tau_E of the Maxwellian gas at temperatures theta = T/T_0, for any law."""
    rate = collision_rate(0.0, gas.dimension)
    return 2 / 3 * float(rate) / relaxation_rate(gas, theta, averages=averages)


def printed_relaxation(gas: jaxgran.Gas, theta=1.0) -> np.ndarray:
    """Return tau_v/tau_E by Eq. (31), or by the two terms of Eq. (32)."""
    if isinstance(gas.law, jaxgran.ConstantRestitution):
        return np.full(np.shape(theta), 2 / (1 + gas.law.coefficient))
    return exact_relaxation(gas, theta, closed_forms.paper_averages)


def stochastic(gas: jaxgran.Gas, config: dict) -> dict:
    """Compute the autocorrelation by DSMC from a Maxwellian start, its tau_v and its integral."""
    lags = np.linspace(0, config["longest"], config["lags"])
    model = jaxgran.DSMC(config["num_particles"], config["replicas"])
    return summary(cool(gas, lags * enskog_time(gas), model, config["seed"]), lags)


def summary(curve: jaxgran.CoolingCurve, lags: np.ndarray) -> dict:
    """Return means and standard errors over the replicas."""
    each = analysis.replicas_of(curve, "velocity_correlation")
    each = each / each[:, :1]
    collisions = analysis.replicas_of(curve, "collisions").mean(axis=0)
    early = (collisions > 0) & (collisions < 2.5)
    # Early -ln C = r N + s N^2: the relaxation time is 1/r collisions, and tau_E is 3/2 collisions.
    basis = np.stack([collisions[early], collisions[early] ** 2], axis=1)
    fits = np.linalg.lstsq(basis, -np.log(each[:, early]).T, rcond=None)[0][0]
    correlation, error = analysis.mean_and_error(each)
    found = {"lags": lags, "collisions": collisions, "correlation": correlation, "error": error}
    found |= analysis.with_error("relaxation", 2 / 3 / fits)
    return found | analysis.with_error("integral", simpson(each, x=lags, axis=1))


def in_boxes(gas: jaxgran.Gas, config: dict, ages: bool) -> dict[str, dict]:
    """Compute it by every sphere model that supports the gas, from t' on; none without boxes."""
    found, kinds = {}, SPHERES if isinstance(gas.law, jaxgran.Viscoelastic) else ["hard_spheres"]
    for kind in kinds if config["boxes"] else ():
        model = SPHERES[kind](config["num_spheres"], replicas=config["boxes"])
        age = config["age"] * float(gas.mean_free_time)
        grown = cool(gas, [age / 2, age] if ages else [age / 100], model, config["seed"])
        aged = gas.replace(temperature=float(grown.temperature[-1]))
        lags = np.linspace(0, config["longest"], config["sphere_lags"])
        curve = cool(aged, lags * enskog_time(aged), replace(model, start=grown.particles))
        # From 4 tau_E on the velocities at t' no longer matter, whatever the age.
        i = int(np.searchsorted(lags, 4.0))
        (slope,), (error,) = diffusion_of(curve, aged, slice(i, None, len(lags) - 1 - i))
        row = {"slope": slope, "slope_error": error}
        row["temperature"] = aged.temperature / gas.temperature
        found[kind] = summary(curve, lags) | row
    return found


def diffusion_of(
    curve: jaxgran.CoolingCurve, gas: jaxgran.Gas, which: slice = slice(None)
) -> tuple[np.ndarray, np.ndarray]:
    """Return d<dr^2>/(6 T tau_E dt) between times, where T tau_E dt ~ sqrt(T) dt ~ dN."""
    spread = analysis.replicas_of(curve, "displacement")[:, which]
    collisions = analysis.replicas_of(curve, "collisions")[:, which]
    unit = 9 * float(gas.temperature * gas.mean_free_time**2)
    return analysis.mean_and_error(np.diff(spread) / np.diff(collisions) / unit)


def paper_velocity_correlation(options: Options) -> dict:
    config = CORRELATION | (FEW if options.smoke else {})
    gases = gases_of(config["beta"])
    title = "Velocities decay nearly exponentially in collisions, but more slowly in time"
    figure, (decay, counted, times) = panels(3, title=title)
    found: dict = {"restitution": gases["constant"][0].coefficient}
    lags = np.linspace(0, config["longest"], 601)
    for name, (gas, color, label) in gases.items():
        expected, collisions = decay_of_theory(gas, lags)
        row: dict = {"dsmc": stochastic(gas, config)}
        row["paper_relaxation"] = printed_relaxation(gas)
        row["exact_relaxation"] = exact_relaxation(gas)
        row |= in_boxes(gas, config, ages=name != "elastic")
        decay.plot(lags, np.exp(-lags / row["paper_relaxation"]), "--", color=color, lw=0.9)
        for axes, x in ((decay, "lags"), (counted, "collisions")):
            along = lags if x == "lags" else collisions
            axes.plot(along, expected, color=color, label=label)
            for kind, (marker, every) in MARKERS.items():
                if kind not in row:
                    continue
                points = np.array([row[kind][key][::every] for key in (x, "correlation", "error")])
                points = points[:, points[1] > 4 * points[2]]
                look = {"fmt": marker, "mfc": "none" if kind in SPHERES else color}
                axes.errorbar(*points, ms=3.5, color=color, **look)
        found[name] = row
    shared = {"yscale": "log", "ylim": (2e-3, 1.2), "ylabel": "⟨v(t′)·v(t)⟩ / ⟨v(t′)²⟩"}
    shared |= {"xlim": (0, 9)}
    kinds = "● DSMC, □ hard, △ soft spheres, — theory"
    title = f"Over time: slower than exp(−(t−t′)/τ$_v$(t′)), dashed\n{kinds}"
    caption(decay, title, xlabel="(t − t′) / τ$_E$(t′)", **shared)
    title = f"Over collisions: nearly exponential\n{kinds}"
    caption(counted, title, xlabel="collisions per particle since t′", **shared)
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
        row = found[name] = {
            "lost": [lost_at_thermal_speed(gas) for gas in gases],
            "measured": [row["relaxation"] for row in rows],
            "error": [row["relaxation_error"] for row in rows],
            "exact": [exact_relaxation(gas) for gas in gases],
            "paper": [printed_relaxation(gas) for gas in gases],
        }
        look = {"color": color, "label": f"{name}: DSMC", **DOTS}
        axes.errorbar(row["lost"], row["measured"], row["error"], **look)
    x = np.linspace(0, 0.85, 60)
    axes.plot(x, 2 / (2 - x), color=CONSTANT, label="Eq. (31): 2 / (1 + ε)")
    line = [beads(PACKING, b) for b in np.linspace(1e-3, 1.15, 40)]
    x = [lost_at_thermal_speed(gas) for gas in line]
    exact, two = ([time(gas) for gas in line] for time in (exact_relaxation, printed_relaxation))
    axes.plot(x, exact, color=VISCOELASTIC, label="exact average of ε(v)")
    axes.plot(x, two, "--", color=VISCOELASTIC, lw=1, label="Eq. (32), two terms")
    labels = {"xlabel": "1 − ε at the thermal speed", "ylabel": "initial τ$_v$ / τ$_E$"}
    caption(axes, "The relaxation time, from the initial slope", **labels)
    return found


def paper_diffusion_coefficient(options: Options) -> dict:
    # The temperatures of the viscoelastic gas at t', over T_0; the last time in mean free times.
    config: dict = {"waits": (1.0, 0.1, 0.01, 0.001), "last": 3000.0, "points": 14}
    config |= {"waits": (1.0,), "last": 30.0, "points": 6} if options.smoke else {}
    config["correlation"] = CORRELATION | (FEW if options.smoke else {"seed": 1})
    gases = gases_of(CORRELATION["beta"])
    title = "Three methods give the same D, and it is not T τ$_v$: the gas cools during τ$_v$"
    figure, (fall, ratio, kinds) = panels(3, title=title)
    found: dict = {"restitution": gases["constant"][0].coefficient}
    for name, (gas, color, _) in gases.items():
        found[name] = routes(name, gas, color, config, fall, ratio)
    delta = float(gases["viscoelastic"][0].delta)
    tau = np.geomspace(0.3, config["last"], 200)
    u = 1 + COOLING_RATE[3] * delta * tau
    printed = u ** (-5 / 6) + (COOLING_CORRECTION + closed_forms.RELAXATION_CORRECTION) * delta / u
    fall.plot(tau, printed, "--", lw=1, color=VISCOELASTIC, label="Eq. (40), to order δ")
    title = f"{gases['viscoelastic'][2]}, and {gases['constant'][2]}"
    caption(fall, title, ylabel="D / D$_0$,  D$_0$ = T$_0$ τ$_E$(0)", yscale="log", **TIME)
    ratio.plot([], [], color=GUIDE, label="theory with memory")
    ratio.plot([], [], "--", lw=1, color=GUIDE, label="Eq. (34): D = T τ$_v$")
    for style, label in (("o", "DSMC, slope of ⟨Δr²⟩"), ("D", "DSMC, ∫⟨v(t′)·v(t)⟩dt")):
        ratio.plot([], [], style, mfc="none", color=GUIDE, label=label)
    labels = {"xlabel": "T(t′) / T$_0$", "ylabel": "D / (T τ$_E$)", "xscale": "log"}
    title = "D over T τ$_E$; the gas cools to the right"
    caption(ratio, title, xlim=(2, 1e-5), ylim=(0.96, 1.62), **labels)
    by_models(kinds, gases, found)
    return {"config": config, "found": found, "picture": figure}


def routes(name: str, gas: jaxgran.Gas, color: str, config: dict, fall, ratio) -> dict:
    """Draw and return D of one gas by all methods, in units of T tau_E."""
    start, tau_c, size = float(gas.temperature), float(gas.mean_free_time), config["correlation"]
    # D of elastic spheres is constant after a few collisions, and their collision rate is constant.
    last = config["last"] if name != "elastic" else min(config["last"], 30.0)
    tau, fine = np.geomspace(0.5, last, config["points"]), np.geomspace(0.02, last, 400)
    of = cool(gas, fine * tau_c, ENSKOG)
    model = jaxgran.DSMC(size["num_particles"], size["replicas"])
    curve = cool(gas, tau * tau_c, model, size["seed"] + 1)
    slopes, errors = diffusion_of(curve, gas)
    cooled = np.asarray(curve.temperature) / start
    middle = np.sqrt(cooled[1:] * cooled[:-1])
    curves = of.displacement, of.collisions
    steps = np.diff([analysis.interpolate_logs(tau, fine, y) for y in curves])
    waits = config["waits"] if name == "viscoelastic" else (1.0,)
    runs = [stochastic(gas.replace(temperature=start * wait), size) for wait in waits]
    row = {
        "temperature": middle,
        "by_slope": slopes,
        "by_slope_error": errors,
        # Per collision <dr^2> grows by 9 T_0 tau_c^2 at D = T tau_E.
        "by_slope_theory": np.divide(*steps) / (9 * start * tau_c**2),
        "waits": list(waits),
        "by_integral": [run["integral"] for run in runs],
        "by_integral_error": [run["integral_error"] for run in runs],
        "paper": printed_relaxation(gas, np.array(waits)),
        **in_boxes(gas, size, ages=name != "elastic"),
    }
    if name != "elastic":  # elastic spheres stay at T_0
        theta = np.asarray(of.temperature) / start
        D = np.asarray(of.diffusion) / (1.5 * start * tau_c)
        fall.plot(fine, D, color=color, label=name)
        pace = np.diff(curve.collisions) / np.diff(tau)
        at = np.sqrt(tau[1:] * tau[:-1])
        fall.errorbar(at[4:], (slopes * pace)[4:], (errors * pace)[4:], color=color, **DOTS)
        ratio.plot(theta, D / np.sqrt(theta), color=color, label=name)
        ratio.plot(theta, printed_relaxation(gas, theta), "--", color=color, lw=1)
        ratio.errorbar(middle, slopes, errors, color=color, **DOTS)
        hollow = {"fmt": "D", "ms": 6, "mfc": "none", "color": color}
        ratio.errorbar(waits, row["by_integral"], row["by_integral_error"], **hollow)
    return row


def by_models(axes, gases: dict, found: dict) -> None:
    """Draw D/(T tau_E) soon after the start by each particle model and method."""
    for shift, (name, (_, color, _)) in enumerate(gases.items()):
        row = found[name]
        for i, (way, marker, at) in enumerate((("slope", "o", -1), ("integral", "D", 0))):
            values, errors = (
                [row[f"by_{key}"][at], *(row.get(kind, {}).get(key, np.nan) for kind in SPHERES)]
                for key in (way, f"{way}_error")
            )
            if (name, way) == ("viscoelastic", "slope"):
                values[0] = np.nan  # its D/(T tau_E) decreases: no single value is initial
            style = {"fmt": marker, "ms": 4.5, "mfc": "none" if i else color, "color": color}
            y = np.array([0, 2, 4]) + i + 0.14 * (shift - 1)
            axes.errorbar(values, y, xerr=errors, label=name if i else None, **style)
    models, ways = ("DSMC", "hard spheres", "soft spheres"), ("⟨Δr²⟩", "∫⟨v·v⟩")
    axes.set_yticks(range(6), [f"{model}, {way}" for model in models for way in ways])
    axes.set_ylim(5.5, -0.5)
    title = "All models, T(t′) ≥ 0.4 T$_0$"
    caption(axes, title, xlabel="D / (T τ$_E$)", xlim=(0.95, 1.62))


def paper_diffusion(options: Options) -> dict:
    config: dict = {"num_particles": 20_000, "last": 1e6, "points": 22, "replicas": 8}
    config |= {"last_theory": 1e14, "deltas": (0.1, 0.03, 0.01)}  # deltas of the ranges of times
    if options.smoke:
        config |= {"num_particles": 1000, "replicas": 2, "last": 1e3, "points": 9}
        config |= {"last_theory": 1e10, "deltas": (0.1,)}
    config |= {"packing_fraction": PACKING, "beta": 0.15, "seed": 2}
    gases, tau = gases_of(config["beta"]), np.geomspace(0.1, config["last_theory"], 400)
    delta = float(gases["viscoelastic"][0].delta)
    title = "Viscoelastic grains spread as t$^{1/6}$ instead of log t, but only at very late times"
    figure, (in_time, exponent, in_collisions, forms) = panels(2, 2, title)
    found: dict = {"restitution": gases["constant"][0].coefficient, "delta": delta}
    for name, power in (("viscoelastic", 1 / 6), ("constant", None)):
        gas, color, label = gases[name]
        theory, dsmc, spread = analysis.compared(gas, "displacement", tau, config)
        spread.draw(in_time, exponent, color, label, power)
        collisions = np.asarray(theory.collisions)
        in_collisions.plot(collisions, spread.theory, color=color, label=label)
        in_collisions.errorbar(dsmc.collisions, spread.mean, spread.error, color=color, **DOTS)
        steps = (np.diff(spread.theory) / np.diff(collisions))[collisions[1:] > 20]
        found[name] = {
            "tau": spread.at,
            "displacement": spread.mean,
            "displacement_error": spread.error,
            "collisions": dsmc.collisions,
            "dsmc_from_theory": spread.miss,
            "exponent": spread.exponent,
            "exponent_error": spread.exponent_error,
            "linear_in_collisions_within": np.ptp(steps) / steps.mean(),
        }
        if name == "viscoelastic":
            near = np.abs(spread.local - 1 / 6) < 1 / 60
            found["exponent_within_10_per_cent_from"] = analysis.from_here(near, spread.where)
            rate = COOLING_RATE[3] * delta
            leading = 54 / rate * ((1 + rate * tau) ** (1 / 6) - 1)
            labels = "leading: u$^{1/6}$ − 1", "Eq. (40) integrated", "corrected, to order δ"
            of = labels, leading, closed_forms.paper_displacement, range(1, 15)
            found["closed_forms"] = analysis.draw_forms(forms, spread, delta, *of)
    # At small delta the solver's steps cover few collisions; longer times would take minutes.
    found["windows"] = [cooling_window(x, tau[tau < 1e12]) for x in config["deltas"]]
    length = "⟨Δr²⟩ / (T$_0$ τ$_c$(0)²)"
    title = "Over time: — theory, ● DSMC; a straight line is log t"
    caption(in_time, title, ylabel=length, xlim=(0.05, 2e10), ylim=(0, 9000), **TIME)
    labels = {"ylabel": "d ln⟨Δr²⟩ / d ln t", "yscale": "log", "ylim": (0.015, 2.2)}
    caption(exponent, "Local exponent; dotted: the paper's 1/6", **labels, **TIME)
    labels = {"xlabel": "collisions per particle  N", "ylabel": length}
    title = "Over collisions: both linear, nearly the same line"
    caption(in_collisions, title, xlim=(0, 600), ylim=(0, 7500), **labels)
    forms.axhline(0, color="0.7", lw=0.8)
    title = "Closed forms, viscoelastic: difference from theory"
    labels = {"ylabel": "formula / theory − 1", "xlim": (3, None), "ylim": (-0.25, 1.2)}
    caption(forms, title, **labels, **TIME)
    return {"config": config, "found": found, "picture": figure}


def cooling_window(delta: float, tau: np.ndarray) -> dict:
    """Return the paper's range of times for a given delta, and the accuracy of its laws there."""
    gas = beads(PACKING, 1.5 * 2**0.1 * delta)
    curve = cool(gas, tau * gas.mean_free_time, ENSKOG)
    theta = np.asarray(curve.temperature / gas.temperature)
    middle, local = analysis.slope(tau, np.asarray(curve.displacement))
    # tau_c |dT/dt| / T is the share of T lost in a collision, -d ln T/dN.
    lost = -np.diff(np.log(theta)) / np.diff(curve.collisions)
    relaxed = np.asarray(curve.diffusion / (1.5 * gas.temperature * gas.mean_free_time))
    off = np.abs(np.sqrt(theta) * printed_relaxation(gas, theta) / relaxed - 1)
    last = delta ** (-11 / 5)
    return {
        "delta": delta,
        "exponent_at_paper_to": analysis.interpolate(last, middle, local),
        "lost_per_collision_at_start": lost[0],
        "lost_per_collision_at_paper_to": analysis.interpolate(last, middle, lost),
        "t_tau_v_within_5_per_cent_from": analysis.from_here(off < 0.05, tau),
    }


if __name__ == "__main__":
    run_parts(__doc__, paper_velocity_correlation, paper_diffusion_coefficient, paper_diffusion)
