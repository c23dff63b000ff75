"""Do soft spheres cool as in LAMMPS, with the same A and without fitted parameters?

    python experiments/accuracy/compare_lammps.py [--smoke] [--record] [--out DIR]

Simulates the gases of both LAMMPS curves. Finds the relative difference of T between soft spheres
and LAMMPS at all times, with its standard error from the replicas of both, and the difference
between kinetic theory and LAMMPS.
"""

import jax
import numpy as np

import jaxgran
from experiments.support.plots import INK, SOFT, THEORY, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import cool, of_lammps

SETTINGS = {"replicas": 4, "steps_per_contact": 40}


def compare_lammps(options: Options) -> dict:
    title = "Temperature of two gases, without fitted parameters"
    figure, places = panels(2, 2, title, (5, 3.2), sharex="col", height_ratios=[2, 1])
    columns = zip(("dilute", "dense"), places[:2], places[2:], strict=True)
    curves = {name: compare(name, options, *axes) for name, *axes in columns}
    return {"curves": curves, **SETTINGS, "picture": figure}


def compare(name: str, options: Options, top, bottom) -> dict:
    measurement = of_lammps(name)
    gas = measurement.gas
    size, points = (200, 12) if options.smoke else (measurement.num_particles, None)
    measured = jax.tree.map(lambda x: x[:points], measurement.curve)
    curve = cool(gas, measured.times, jaxgran.SoftSpheres(size, **SETTINGS))
    theory = cool(gas, measured.times)
    t, lammps = np.asarray(measured.times), np.asarray(measured.temperature)
    miss, theory_miss = (np.asarray(each.temperature) / lammps - 1 for each in (curve, theory))
    error = np.hypot(curve.temperature_error, measured.temperature_error) / lammps
    bars = measured.temperature_error[1:]
    top.errorbar(t[1:], lammps[1:], bars, fmt="o", ms=3.5, color=INK, label="LAMMPS")
    top.plot(t[1:], curve.temperature[1:], color=SOFT, label="soft spheres")
    top.plot(t[1:], theory.temperature[1:], "--", color=THEORY, label="kinetic theory")
    scene = f"{name} gas, φ = {float(gas.packing_fraction):.2g}"
    caption(top, scene, xscale="log", yscale="log", ylabel="temperature T (m²/s²)")
    bottom.axhline(0, color=INK, lw=1)
    bottom.errorbar(t[1:], 100 * miss[1:], 100 * error[1:], fmt="^", ms=3.5, color=SOFT)
    bottom.plot(t[1:], 100 * theory_miss[1:], "--", color=THEORY)
    limits = (-3, 3) if np.abs(theory_miss).max() < 0.03 else (-32, 6)
    caption(bottom, ylim=limits, xlabel="time t (s)", ylabel="T over LAMMPS' − 1 (%)")
    return {
        "largest_temperature_difference": np.abs(miss).max(),
        "largest_theory_difference": np.abs(theory_miss).max(),
        "temperature_difference": miss,
        "standard_error": error,
        "collisions": float(curve.collisions[-1]),
    }


if __name__ == "__main__":
    run_parts(__doc__, compare_lammps)
