"""What is the law of restitution of a material, without a formula? Learn eps(v) from T(t).

    python experiments/fit/learn_law.py [--smoke] [--record] [--out DIR]

Curves with an error of 1 % are made by direct simulation and by hard spheres with the viscoelastic
law. `jaxgran.fit` fits a `RestitutionSpline` to each,
through kinetic theory. Counts how often the band contains the true law at nine speeds that the gas
visited, reads off A, and compares the learnt law with a viscoelastic and a constant one.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.paper import Clock
from experiments.support.record import script_parser, write_picture, write_results

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
    made = jaxgran.cool(gas, times, model=model, key=jax.random.key(seed), progress=False)
    assert made.replicas is not None
    noise = np.random.default_rng(seed).normal(size=made.replicas.temperature.shape)
    for T, x in zip(np.asarray(made.replicas.temperature), noise, strict=True):
        T = jnp.asarray(T * np.exp(ERROR * x))
        yield jaxgran.CoolingCurve(times, T, temperature_error=ERROR * T)


def judge(gas: jaxgran.Gas, result: jaxgran.Fit) -> dict:
    """Compare a learnt law with the true one and with two formulas."""
    band = jaxgran.restitution_band(result)
    eps = np.asarray(gas.restitution(band.speeds))
    beads = dataclasses.replace(gas, law=jaxgran.Viscoelastic(5e7, 0.22, 1e-6))
    constant = dataclasses.replace(gas, law=jaxgran.ConstantRestitution(0.8))
    soft, p_soft, fitted = band.compare(beads, "dissipative_constant")
    hard, p_hard, same = band.compare(constant, "coefficient")
    return {
        "speeds": band.speeds.tolist(),
        "eps": band.restitution.tolist(),
        "band": [band.low.tolist(), band.high.tolist()],
        "true": eps.tolist(),
        "held": ((band.low <= eps) & (eps <= band.high)).tolist(),
        "A": float(fitted.value("dissipative_constant")),
        "coefficient": float(same.value("coefficient")),
        "viscoelastic": {"chi2": soft, "p": p_soft},
        "constant": {"chi2": hard, "p": p_hard},
        "fit": {"reduced_chi2": float(result.reduced_chi2), "p": float(result.p_value)},
    }


def summary(rows: list[dict]) -> dict:
    """How often the band contains the true law and laws of two forms, in how many runs."""
    held = np.array([row["held"] for row in rows])
    A = np.array([row["A"] for row in rows])
    return {
        "runs": len(rows),
        "held": float(held.mean()),  # at single speeds
        "held_at_all_speeds": int(held.all(1).sum()),
        "A": [float(A.mean()), float(A.std(ddof=1))],
        "viscoelastic": sum(row["viscoelastic"]["p"] > 0.05 for row in rows),
        "constant": sum(row["constant"]["p"] > 0.05 for row in rows),
        "chi2": {
            form: float(np.median([row[form]["chi2"] for row in rows]))
            for form in ("viscoelastic", "constant")
        },
    }


def main() -> None:
    options = script_parser(__doc__, "learn_law").parse_args()
    jax.config.update("jax_enable_x64", True)
    clock, size, replicas = Clock(), *((200, 2) if options.smoke else (1000, 10))
    taus = np.geomspace(0.3, 100.0, 40)
    beads = jaxgran.Gas(jaxgran.Viscoelastic(5e7, 0.22, 5e-6), **BEADS, temperature=0.01)
    scenes = {
        "DSMC": (beads, jaxgran.DSMC(size, replicas=replicas)),
        "hard spheres": (beads, jaxgran.HardSpheres(size, replicas=replicas)),
    }
    rows, shown = [], {}
    for seed, (name, (gas, model)) in enumerate(scenes.items()):
        if options.smoke and name == "hard spheres":
            continue
        for curve in curves_of(gas, model, taus, seed):
            result = learn(gas, curve, size)
            rows.append({"scene": name} | judge(gas, result))
            shown.setdefault(name, (gas, result))
        print(name, summary([row for row in rows if row["scene"] == name]), flush=True)
    true = float(beads.value("dissipative_constant"))
    found = {"beads": summary(rows), "rows": rows, "true_A": true}
    found["seconds"] = sum(clock.times.values())
    write_results("learn_law", options, options.out / "learn_law.json", **found)
    write_picture(draw(*shown["DSMC"]), "learn_law", options)


def draw(gas: jaxgran.Gas, result: jaxgran.Fit) -> Figure:
    """Draw eps(v) with its band over the truth, and the speeds of impacts below."""
    figure = Figure(figsize=(5.5, 5), layout="constrained")
    top, bottom = figure.subplots(2, sharex="col", height_ratios=[3, 1])
    low, high = jaxgran.restitution_band(result).visited
    v = np.geomspace(low / 3, 2 * high, 120)
    band = jaxgran.restitution_band(result, v)
    top.fill_between(v, band.low, band.high, color="#0072b2", alpha=0.25, label="95 % band")
    top.plot(v, band.restitution, color="#0072b2", label="learnt from T(t)")
    top.plot(v, gas.restitution(v), "--", color="#222222", label="true law")
    top.axvspan(low, high, color="#999999", alpha=0.12, label="visited speeds")
    top.set(xscale="log", ylabel="ε(v)", title="viscoelastic spheres")
    top.legend(frameon=False, fontsize=8, loc="lower left")
    # Impacts of a Maxwellian gas, per unit of ln v, over the whole curve.
    T, count = np.asarray(result.curve.temperature), np.asarray(result.curve.collisions)
    at = v[:, None] ** 2 / (2 * T[1:]) * np.exp(-(v[:, None] ** 2) / (4 * T[1:]))
    bottom.fill_between(v, at @ np.diff(count) / (count[-1] - count[0]), color="#009e73")
    bottom.set(xlabel="normal speed of impacts (m/s)", ylabel="impacts", yticks=[])
    return figure


if __name__ == "__main__":
    main()
