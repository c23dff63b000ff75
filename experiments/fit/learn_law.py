"""What is the law of restitution of a material, without a formula? Learn eps(v) from T(t).

    python experiments/fit/learn_law.py [--smoke] [--record] [--out DIR]

`jaxgran.fit` fits a `RestitutionSpline` to each curve, through kinetic theory. The worlds:

- curves with an error of 1 %, made by direct simulation and by hard spheres, of viscoelastic beads,
  of ice (eps = .34 (v/(1 cm/s))^-.234; Bridges, Hatzes & Lin 1984) and of two laws with a yield
  speed: .95 below it or no loss at all, and falling as v^(-1/4) above;
- curves measured in LAMMPS, of beads with known A;
- a curve together with drop tests of single beads at speeds that the gas did not visit.

Counts how often the band contains the true law at nine speeds that the gas visited, reads off A,
and says whether the learnt law has the viscoelastic or the constant form (p > .01). The best
viscoelastic law is wrong about eps by `bias`, the spline by `error`.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.analysis import replicas_of
from experiments.support.plots import DSMC, GUIDE, INK, THEORY, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import cool, ice, of_lammps, temperature_only

ERROR = 0.01
NUM_KNOTS = 8
BEADS: dict = {"diameter": 2e-3, "mass": 1e-5, "packing_fraction": 0.03}
LAMMPS_CURVES = "dilute", "phi003", "phi003_large"


class Yielding(jaxgran.extend.RestitutionLaw):
    """``eps = .95 (1 + (v/v_y)^2)^(-1/8)`` with the yield speed v_y = .1 m/s."""

    def restitution(self, normal_speed):
        return 0.95 * (1 + (normal_speed / 0.1) ** 2) ** -0.125


class Plastic(jaxgran.extend.RestitutionLaw):
    """``eps = (v/v_y)^(-1/4)`` above the yield speed v_y = .1 m/s, and 1 below."""

    def restitution(self, normal_speed):
        return jnp.maximum(normal_speed / 0.1, 1.0) ** -0.25


TRUTHS: dict[str, tuple] = {  # and T_0, m^2/s^2
    "viscoelastic": (jaxgran.Viscoelastic(5e7, 0.22, 5e-6), 0.01),
    "ice": (ice(), 4e-4),
    "yield speed": (Yielding(), 0.04),
    "no loss below a yield speed": (Plastic(), 0.04),
}


def with_spline(gas: jaxgran.Gas, low: float, high: float) -> jaxgran.Gas:
    """Return the gas with an unknown law, whose knots span these speeds."""
    law = jaxgran.RestitutionSpline(np.geomspace(low, high, NUM_KNOTS))
    return dataclasses.replace(gas, law=law)


def learn(measurement: jaxgran.Measurement) -> jaxgran.Fit:
    """The whole recipe: knots over the visited speeds, and a fit of all numbers of the law."""
    speeds = jaxgran.RestitutionSpline.visited_speeds(measurement.curve.temperature)
    learner = with_spline(measurement.gas, *speeds)
    return jaxgran.fit(dataclasses.replace(measurement, gas=learner), free="law", quick=True)


def curves_of(gas, model, taus, seed):
    """A curve of each replica, with Gaussian errors."""
    times = jnp.asarray(taus) * gas.mean_free_time
    each = replicas_of(cool(gas, times, model, seed), "temperature")
    noise = np.random.default_rng(seed).normal(size=each.shape)
    for T in each * np.exp(ERROR * noise):
        yield jaxgran.CoolingCurve(times, T, temperature_error=ERROR * T)


def judge(gas: jaxgran.Gas, result: jaxgran.Fit, speeds=None) -> dict:
    """Compare a learnt law with the true one, read off A, and test two forms."""
    band = jaxgran.restitution_band(result, speeds)
    eps = np.asarray(gas.restitution(band.speeds))
    law = gas.law if isinstance(gas.law, jaxgran.Viscoelastic) else TRUTHS["viscoelastic"][0]
    beads = dataclasses.replace(gas, law=law).replace(dissipative_constant=1e-6)
    constant = dataclasses.replace(gas, law=jaxgran.ConstantRestitution(0.9))
    chi2, p, fitted = band.compare(beads, "dissipative_constant")
    return {
        "true_A": getattr(gas.law, "dissipative_constant", None),
        "held": (band.low <= eps) & (eps <= band.high),
        "A": float(fitted.value("dissipative_constant")),
        "p": {"viscoelastic": p, "constant": band.compare(constant, "coefficient")[1]},
        "error": float(np.max(np.abs(band.restitution - eps))),
        "bias": float(np.max(np.abs(np.asarray(fitted.restitution(band.speeds)) - eps))),
    }


def summary(rows: list[dict]) -> dict:
    """Return how often the band contains the true law, in how many runs, and its form."""
    names = "held", "A", "error", "bias"
    held, A, error, bias = (np.array([row[name] for row in rows]) for name in names)
    forms = {form: sum(row["p"][form] > 0.01 for row in rows) for form in rows[0]["p"]}
    return {
        "runs": len(rows),
        "true_A": rows[0]["true_A"],
        "held": float(held.mean()),  # at single speeds
        "held_at_all_speeds": int(held.all(1).sum()),
        "A": [float(A.mean()), float(A.std(ddof=1)) if len(A) > 1 else None],
        "forms": forms | {"neither": sum(max(row["p"].values()) <= 0.01 for row in rows)},
        "error": float(np.median(error)),
        "bias": float(np.median(bias)),
    }


def learn_law(options: Options) -> dict:
    size, replicas = (200, 2) if options.smoke else (1000, 20)
    models = [jaxgran.DSMC(size, replicas=replicas), jaxgran.HardSpheres(size, replicas=replicas)]
    taus, few = np.geomspace(0.3, 100.0, 40), 1 if options.smoke else None
    worlds, shown, beads = {}, {}, []
    for truth, (law, T) in TRUTHS.items():
        gas = jaxgran.Gas(law, **BEADS, temperature=T)
        for seed, model in enumerate(models[:few]):
            curves = list(curves_of(gas, model, taus, seed))
            known = [jaxgran.Measurement(gas, curve, num_particles=size) for curve in curves]
            fits = [learn(measurement) for measurement in known]
            worlds[f"{truth}, {model.name}"] = [judge(gas, fit) for fit in fits]
            shown.setdefault(truth, (gas, fits[0]))
        if truth == "viscoelastic":
            beads = [row for rows in worlds.values() for row in rows]
            worlds["viscoelastic, with drop tests"] = [with_drops(known[-1])]
    for name in LAMMPS_CURVES[:few]:
        measurement = of_lammps(name)
        # Without the start.
        after = jax.tree.map(lambda x: x[1:], temperature_only(measurement.curve))
        digits = {name: x[1:] for name, x in measurement.rounding.items()}
        learnt = learn(dataclasses.replace(measurement, data=after, rounding=digits))
        worlds[f"LAMMPS, {name}"] = [judge(measurement.gas, learnt)]
    found = {name: summary(rows) for name, rows in worlds.items()}
    return {"worlds": found, "beads": summary(beads), "picture": draw(shown)}


def with_drops(measurement: jaxgran.Measurement) -> dict:
    """Learn from a curve and from 20 drops of single beads at a twentieth of its lowest speed."""
    gas = measurement.gas
    low, high = jaxgran.RestitutionSpline.visited_speeds(measurement.curve.temperature)
    speeds = np.geomspace(low / 20, 3 * low / 20, 20)
    noise = 0.002 * np.random.default_rng(0).normal(size=speeds.size)
    drops = jaxgran.DropTest(speeds, gas.restitution(speeds) + noise, np.full(20, 0.002))
    learner = with_spline(gas, speeds[0], high)
    curve = dataclasses.replace(measurement, gas=learner)
    both = {"gas": curve, "drops": jaxgran.Measurement(learner, drops)}
    result = jaxgran.fit(both, free="law", quick=True)
    return judge(gas, result, speeds[[0, -1]])


def draw(results: dict[str, tuple[jaxgran.Gas, jaxgran.Fit]]):
    """Draw eps(v) with its band over the truth, and the speeds of impacts below."""
    num = len(results)
    figure, places = panels(num, 2, size=(4.5, 2.5), sharex="col", height_ratios=[3, 1])
    for i, (name, (gas, result)) in enumerate(results.items()):
        top, bottom = places[i], places[num + i]
        low, high = jaxgran.restitution_band(result).visited
        v = np.geomspace(low / 3, 2 * high, 120)
        band = jaxgran.restitution_band(result, v)
        top.fill_between(v, band.low, band.high, color=THEORY, alpha=0.25, label="95 % band")
        top.plot(v, band.restitution, color=THEORY, label="learnt from T(t)")
        top.plot(v, gas.restitution(v), "--", color=INK, label="true law")
        top.axvspan(low, high, color=GUIDE, alpha=0.12, label="visited speeds")
        caption(top, name, "none" if i else "lower left", xscale="log", ylabel="" if i else "ε(v)")
        # Impacts of a Maxwellian gas, per unit of ln v, over the whole curve.
        T, count = np.asarray(result.curve.temperature), np.asarray(result.curve.collisions)
        at = v[:, None] ** 2 / (2 * T[1:]) * np.exp(-(v[:, None] ** 2) / (4 * T[1:]))
        bottom.fill_between(v, at @ np.diff(count) / (count[-1] - count[0]), color=DSMC)
        caption(bottom, xlabel="normal speed of impacts (m/s)", ylabel="impacts", yticks=[])
    return figure


if __name__ == "__main__":
    run_parts(__doc__, learn_law)
