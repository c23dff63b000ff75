"""What is the law of restitution of a material, without a formula? Learn eps(v) from T(t).

    python experiments/fit/learn_law.py [--smoke] [--record] [--out DIR]

Curves with an error of 1 % are made by direct simulation and by hard spheres with the viscoelastic
law. `jaxgran.fit` fits a `RestitutionSpline` to each,
through kinetic theory. Counts how often the band contains the true law at nine speeds that the gas
visited, and reads off A.
"""

import argparse
import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.analysis import replicas_of
from experiments.support.plots import DSMC, GUIDE, INK, THEORY, caption, panels
from experiments.support.record import run_parts
from experiments.support.scenes import cool

ERROR = 0.01
NUM_KNOTS = 8
BEADS: dict[str, Any] = {"diameter": 2e-3, "mass": 1e-5, "packing_fraction": 0.03}


def learn(gas: jaxgran.Gas, curve: jaxgran.CoolingCurve, num_particles: int) -> jaxgran.Fit:
    """The whole recipe: knots over the visited speeds, and a fit of all numbers of the law."""
    speeds = jaxgran.RestitutionSpline.visited_speeds(curve.temperature)
    law = jaxgran.RestitutionSpline(np.geomspace(*speeds, NUM_KNOTS))
    learner = dataclasses.replace(gas, law=law)
    return jaxgran.fit(learner, curve, free="law", num_particles=num_particles)


def curves_of(gas, model, taus, seed):
    """A curve of each replica, with Gaussian errors."""
    times = jnp.asarray(taus) * gas.mean_free_time
    each = replicas_of(cool(gas, times, model, seed), "temperature")
    noise = np.random.default_rng(seed).normal(size=each.shape)
    for T in each * np.exp(ERROR * noise):
        yield jaxgran.CoolingCurve(times, jnp.asarray(T), temperature_error=jnp.asarray(ERROR * T))


def judge(gas: jaxgran.Gas, result: jaxgran.Fit) -> dict:
    """Compare a learnt law with the true one, and read off A."""
    band = jaxgran.restitution_band(result)
    eps = np.asarray(gas.restitution(band.speeds))
    beads = dataclasses.replace(gas, law=jaxgran.Viscoelastic(5e7, 0.22, 1e-6))
    fitted = band.compare(beads, "dissipative_constant")[2]
    return {
        "speeds": band.speeds,
        "eps": band.restitution,
        "band": [band.low, band.high],
        "true": eps,
        "held": (band.low <= eps) & (eps <= band.high),
        "A": float(fitted.value("dissipative_constant")),
    }


def summary(rows: list[dict]) -> dict:
    """Return how often the band contains the true law, in how many runs."""
    held = np.array([row["held"] for row in rows])
    A = np.array([row["A"] for row in rows])
    return {
        "runs": len(rows),
        "held": float(held.mean()),  # at single speeds
        "held_at_all_speeds": int(held.all(1).sum()),
        "A": [float(A.mean()), float(A.std(ddof=1))],
    }


def learn_law(options: argparse.Namespace) -> dict:
    size, replicas = (200, 2) if options.smoke else (1000, 10)
    taus = np.geomspace(0.3, 100.0, 40)
    beads = jaxgran.Gas(jaxgran.Viscoelastic(5e7, 0.22, 5e-6), **BEADS, temperature=0.01)
    scenes = {
        "DSMC": jaxgran.DSMC(size, replicas=replicas),
        "hard spheres": jaxgran.HardSpheres(size, replicas=replicas),
    }
    rows, results = [], []
    for seed, (name, model) in enumerate(list(scenes.items())[: 1 if options.smoke else 2]):
        for curve in curves_of(beads, model, taus, seed):
            results.append(learn(beads, curve, size))
            rows.append({"scene": name} | judge(beads, results[-1]))
        print(name, summary([row for row in rows if row["scene"] == name]), flush=True)
    true = float(beads.value("dissipative_constant"))
    picture = draw(beads, results[0])
    return {"beads": summary(rows), "rows": rows, "true_A": true, "picture": picture}


def draw(gas: jaxgran.Gas, result: jaxgran.Fit) -> Figure:
    """Draw eps(v) with its band over the truth, and the speeds of impacts below."""
    figure = panels(1, 2, size=(5.5, 2.5), sharex="col", height_ratios=[3, 1])
    top, bottom = figure.axes
    low, high = jaxgran.restitution_band(result).visited
    v = np.geomspace(low / 3, 2 * high, 120)
    band = jaxgran.restitution_band(result, v)
    top.fill_between(v, band.low, band.high, color=THEORY, alpha=0.25, label="95 % band")
    top.plot(v, band.restitution, color=THEORY, label="learnt from T(t)")
    top.plot(v, gas.restitution(v), "--", color=INK, label="true law")
    top.axvspan(low, high, color=GUIDE, alpha=0.12, label="visited speeds")
    caption(top, "viscoelastic spheres", "lower left", xscale="log", ylabel="ε(v)")
    # Impacts of a Maxwellian gas, per unit of ln v, over the whole curve.
    T, count = np.asarray(result.curve.temperature), np.asarray(result.curve.collisions)
    at = v[:, None] ** 2 / (2 * T[1:]) * np.exp(-(v[:, None] ** 2) / (4 * T[1:]))
    bottom.fill_between(v, at @ np.diff(count) / (count[-1] - count[0]), color=DSMC)
    caption(bottom, xlabel="normal speed of impacts (m/s)", ylabel="impacts", yticks=[])
    return figure


if __name__ == "__main__":
    run_parts(__doc__, {"learn_law": learn_law})
