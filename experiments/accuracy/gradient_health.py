"""Is the derivative of the cooling curve of a chaotic gas accurate, and for how long?

    python experiments/accuracy/gradient_health.py [--only gradient_health_dilute ...]
        [--smoke] [--record] [--out DIR]

d ln T / d ln A by central finite differences of runs (the same initial states on both sides;
kinetic theory corrects the truncation error of the step), compared with derivatives. Standard
errors are over replicas. Relative errors mean little at times when ln T hardly depends on A.

gradient_health_dilute, _dense, _clustering: soft spheres after 1, 3, 10, 30 and 100 collisions per
particle, by forward mode without projection ("plain"), thermally projected, and by kinetic theory;
and the dependence of the projected derivative on the interval between projections.

hard_derivatives: hard spheres after 10 and 30 mean free times, below L_c and in a box of 1.1 L_c.

dsmc_derivatives: DSMC after 10 and 50 collisions per particle, where it has no flow.

derivatives_in_flows: hard spheres and disks in boxes longer than L_c, after 3, 10, 30 and 100
collisions: finite differences of many sets of replicas with separate keys, projected derivatives
and the estimate of their bias (`CoolingCurve.derivative_bias`), and derivatives by differences of
one set (``differences=0.3``), with another key.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.analysis import mean_and_error, over
from experiments.support.plots import ELASTIC, GUIDE, HARD, INK, SOFT, THEORY, caption, panels
from experiments.support.record import Options, figures, run_parts
from experiments.support.scenes import beads, cool, glass, times_of

COLLISIONS = (1.0, 3.0, 10.0, 30.0, 100.0)
INTERVALS = (0.03, 0.1, 0.3, 1.0)
STEP = 0.3  # of ln A, to either side
STEPS_PER_CONTACT = 25
# packing fraction, beta_T0, contact duration over mean free time, particles in a box, replicas,
# sets of replicas for finite differences, which scatter more than tangents
SOFT_SPHERES = {
    "dilute": (0.05, 0.1, 0.01, 500, 16, 1),
    "dense": (0.25, 0.05, 0.05, 500, 16, 1),
    "clustering": (0.3, 0.2, 0.05, 1000, 8, 6),
}
EARLY = 2  # the first times, where derivatives are small, have more replicas
PLAIN_HORIZON = 3  # times at which the plain derivative is computed; at the last it overflows
# packing fraction, beta_T0, dimension, particles in a box, replicas, sets of the reference
FLOWS = {"hard": (0.2, 0.3, 3, 500, 32, 6), "disks": (0.25, 0.3, 2, 300, 32, 12)}
WORDS = {"hard": "hard spheres", "disks": "hard disks"}

# Marker, colour and label of the methods in the pictures.
LOOKS = {
    "differences": ("o", INK, "finite differences"),
    "projected": ("^", SOFT, "projected"),
    "plain": ("x", HARD, "plain forward mode"),
}
LOOKS_IN_FLOWS = {
    "reference": ("o", INK, "differences of many runs"),
    "projected": ("^", SOFT, "projected"),
    "differences": ("s", HARD, "by differences"),
}
LABELS = {"xlabel": "collisions per particle", "ylabel": "d ln T / d ln A", "xscale": "log"}
SHOWN = -2.2, 0.5  # range of the derivatives in the picture


class Slopes:
    """d ln T / d ln A of a gas at some times, of each replica, shape (replicas, times)."""

    def __init__(self, gas: jaxgran.Gas, times: np.ndarray):
        self.gas, self.times, self.truncation = gas, times, np.zeros(len(times))
        self.theory = self.forward(jaxgran.KineticTheory())[0][0]
        self.truncation = self.differences(jaxgran.KineticTheory())[0] - self.theory

    def log_temperatures(self, shift, model, seed=0):
        A = self.gas.value("dissipative_constant") * jnp.exp(shift)
        curve = cool(self.gas.replace(dissipative_constant=A), self.times, model, seed)
        each = curve.temperature[None] if curve.replicas is None else curve.replicas.temperature
        return jnp.log(each), curve

    def forward(self, model) -> tuple[np.ndarray, jaxgran.CoolingCurve]:
        """Return the derivatives in forward mode, and the curve."""
        of = partial(self.log_temperatures, model=model)
        _, slopes, curve = jax.jvp(of, (0.0,), (1.0,), has_aux=True)
        return np.asarray(slopes), curve

    def differences(self, model, seeds=(0,)) -> np.ndarray:
        """Return finite differences, corrected by kinetic theory."""
        slopes = []
        for seed in seeds:
            right, left = (self.log_temperatures(x * STEP, model, seed)[0] for x in (1, -1))
            slopes.append((right - left) / (2 * STEP))
        return np.concatenate(slopes) - self.truncation

    def projected_over_differences(self, model) -> tuple[dict, jaxgran.CoolingCurve]:
        """Return how far projected derivatives are off, its error, and the curve."""
        projected, curve = self.forward(model)
        off, error = over(mean_and_error(projected), mean_and_error(self.differences(model)))
        return {"off": off, "error": error}, curve


def soft_spheres(name: str, options: Options) -> dict:
    (phi, beta, contact, size, many, sets), few, most = SOFT_SPHERES[name], 4, 64
    collisions, intervals = COLLISIONS, INTERVALS
    if options.smoke:
        collisions, intervals = COLLISIONS[:2], INTERVALS[:2]
        size, many, sets, few, most = 50, 2, 1, 2, 4
    gas = beads(phi, beta, contact)
    times = times_of(gas, collisions)
    if gas.box_side(size) > gas.critical_box:
        rough = jaxgran.SoftSpheres(size, steps_per_contact=10)
        times = times_of(gas, collisions, rough, times[-1] / float(gas.mean_free_time), 60)
    model = jaxgran.SoftSpheres(size, replicas=many, steps_per_contact=STEPS_PER_CONTACT)
    slopes, early, first = (Slopes(gas, times[:n]) for n in (None, EARLY, PLAIN_HORIZON))
    early_model = replace(model, replicas=most)
    projected, curve = slopes.forward(model)

    def joined(first, rest):
        return np.hstack([mean_and_error(first), np.array(mean_and_error(rest))[:, EARLY:]])

    # A plain derivative is computed under tracing, where arrays cannot be enlarged.
    plain = replace(model, replicas=few, projection=None).sized_for(gas)
    late = slopes.differences(model, range(sets))
    columns = {
        "kinetic theory": [slopes.theory, 0 * slopes.theory],
        "differences": joined(early.differences(early_model), late),
        "projected": joined(early.forward(early_model)[0], projected),
        "plain": mean_and_error(first.forward(plain)[0]),
    }
    models = {str(x): replace(model, replicas=few, projection=x) for x in intervals}
    found = {
        "collisions": curve.collisions,
        "d_ln_T_d_ln_A": columns,
        "projected_over_differences": over(columns["projected"], columns["differences"]),
        "by_interval": {x: mean_and_error(slopes.forward(own)[0]) for x, own in models.items()},
        "num_particles": size,
        "replicas": many,
        "early_replicas": most,
        "step_of_ln_A": STEP,
        "steps_per_contact": STEPS_PER_CONTACT,
    }
    results = {each: figures(f"gradient_health_{each}") for each in SOFT_SPHERES} | {name: found}
    return found | {"picture": {"gradient_health": draw(results)}}


def hard_derivatives(options: Options) -> Iterator[dict]:
    for phi, beta, replicas in ((0.02, 0.2, 32), (0.2, 0.1, 32), (0.2, 0.3, 96)):
        gas = glass(beta, phi)
        slopes = Slopes(gas, np.array([10.0, 30.0]) * float(gas.mean_free_time))
        model = jaxgran.HardSpheres(*((50, 2) if options.smoke else (500, replicas)))
        found, curve = slopes.projected_over_differences(model)
        yield {"phi": phi, "beta": beta, "told": curve.derivative_bias} | found


def dsmc_derivatives(options: Options) -> Iterator[dict]:
    collisions = (10.0, 50.0)
    for phi, beta in ((0.08, 0.1), (0.08, 0.3), (0.08, 1.0)):
        gas = glass(beta, phi)
        slopes = Slopes(gas, times_of(gas, collisions))
        model = jaxgran.DSMC(*((200, 2) if options.smoke else (20_000, 32)))
        found, _ = slopes.projected_over_differences(model)
        yield {"phi": phi, "beta": beta, "collisions": collisions} | found


def derivatives_in_flows(options: Options) -> dict:
    scenes = {name: in_flow(name, options.smoke) for name in FLOWS}
    return {"step_of_ln_A": STEP, "scenes": scenes, "picture": draw_flows(scenes)}


def in_flow(name: str, smoke: bool) -> dict:
    (phi, beta, dimension, size, replicas, sets), collisions = FLOWS[name], COLLISIONS[1:]
    if smoke:
        collisions, size, replicas, sets = COLLISIONS[1:3], 60, 2, 1
    gas, model = beads(phi, beta, 0.01, dimension), jaxgran.HardSpheres(size, replicas=replicas)
    few = replace(model, replicas=2)
    end = times_of(gas, collisions[-1], few, 60 * collisions[-1], 40)
    # The bias follows from the flow at all times.
    slopes = Slopes(gas, np.geomspace(0.3 * float(gas.mean_free_time), end, 40))
    projected, curve = slopes.forward(model)
    counts = np.asarray(curve.collisions)
    at = [int(np.argmin(np.abs(counts - n))) for n in collisions]
    each = {
        "reference": slopes.differences(model, range(1, sets + 1)),
        "projected": projected,
        "differences": slopes.forward(replace(model, differences=STEP))[0],
    }
    columns = {kind: mean_and_error(values[:, at]) for kind, values in each.items()}
    return {
        "box_over_critical": float(gas.box_side(size) / gas.critical_box),
        "num_particles": size,
        "replicas": replicas,
        "sets": sets,
        "collisions": counts[at],
        "d_ln_T_d_ln_A": columns,
        "bias": over(columns["projected"], columns["reference"]),
        "bias_of_differences": over(columns["differences"], columns["reference"]),
        "derivative_bias": np.asarray(curve.derivative_bias)[at],
    }


def draw_flows(scenes: dict):
    """Draw the derivatives of each gas by three methods, and without the estimated bias."""
    figure, places = panels(len(scenes), size=(5, 4))
    for axes, (name, found) in zip(places, scenes.items(), strict=True):
        draw_derivatives(axes, found, LOOKS_IN_FLOWS)
        freed = np.array(found["d_ln_T_d_ln_A"]["projected"][0])
        freed = freed / (1 + np.array(found["derivative_bias"]))
        label = "projected, minus its estimated bias"
        axes.plot(found["collisions"], freed, "--", color=SOFT, lw=1.2, label=label, zorder=0)
        title = f"{WORDS[name]} in a box of {found['box_over_critical']:.1f} $L_c$"
        caption(axes, title, "upper right", **LABELS)
    return figure


def draw(results: dict):
    """Draw the derivatives of two gases, their errors, and the effect of the interval."""
    figure, (left, right, errors, intervals) = panels(2, 2, size=(5, 4))
    for axes, (name, found) in zip((left, right), results.items(), strict=False):
        draw_derivatives(axes, found, LOOKS, *SHOWN)
        theory = found["d_ln_T_d_ln_A"]["kinetic theory"][0]
        look = {"color": THEORY, "lw": 1.2, "label": "kinetic theory", "zorder": 0}
        axes.plot(found["collisions"], theory, "--", **look)
        title = f"{name} gas: d ln T / d ln A by four methods"
        caption(axes, title, "lower left", ylim=SHOWN, **LABELS)
    looks = ((INK, "o-"), (GUIDE, "s--"), (ELASTIC, "^:"))
    for (name, result), (colour, style) in zip(results.items(), looks, strict=False):
        bias, spread = (100 * np.asarray(x) for x in result["projected_over_differences"])
        look: dict = {"fmt": style, "color": colour, "ms": 5, "label": name}
        errors.errorbar(np.asarray(result["collisions"])[: len(bias)], bias, spread, **look)
        if "by_interval" not in result:
            continue
        reference = np.asarray(result["d_ln_T_d_ln_A"]["differences"][0])
        at = min(3, len(reference) - 1)  # 30 collisions
        y, e = 100 * np.array(list(result["by_interval"].values()))[:, :, at].T / reference[at]
        x = [float(interval) for interval in result["by_interval"]]
        intervals.errorbar(x, y - 100, np.abs(e), **look)
    labels = {"xscale": "log", "ylabel": "projected over differences − 1 (%)"}
    for axes in (errors, intervals):
        axes.axhspan(-5, 5, color="0.92", zorder=0)
    title = "Error of the projected derivative"
    caption(errors, title, "upper left", xlabel="collisions per particle", **labels)
    title = "Error after 30 collisions, by interval"
    caption(intervals, title, "upper left", xlabel="mean free times between projections", **labels)
    return figure


def draw_derivatives(axes, found: dict, looks: dict, low=-np.inf, high=np.inf) -> None:
    """Draw the derivatives of one gas by each method; write those beyond the panel as text."""
    for shift, (column, (marker, colour, label)) in enumerate(looks.items()):
        mean, error = (np.asarray(x) for x in found["d_ln_T_d_ln_A"][column])
        n = np.asarray(found["collisions"])[: len(mean)]
        inside = (mean - error > low) & (mean + error < high)
        look = {"color": colour, "ms": 6, "mfc": "none" if marker == "o" else colour}
        at = n[inside] * 1.08 ** (shift - 1)
        axes.errorbar(at, mean[inside], error[inside], fmt=marker, label=label, **look)
        for x, m, e in zip(n[~inside], mean[~inside], error[~inside], strict=True):
            words = f"{column} after {x:.0f}:\n{m:.1g} ± {e:.1g}"
            axes.annotate(words, (x, high - 0.02), color=colour, fontsize=8, va="top")


if __name__ == "__main__":
    soft = {f"gradient_health_{name}": partial(soft_spheres, name) for name in SOFT_SPHERES}
    run_parts(__doc__, hard_derivatives, dsmc_derivatives, derivatives_in_flows, named=soft)
