"""Do soft spheres cool as in LAMMPS, with the same A and without fitted parameters?

    python experiments/accuracy/compare_lammps.py [--replicas 4] [--smoke] [--out DIR]

Simulates the gases of both LAMMPS curves. Prints the relative difference of T between soft spheres
and LAMMPS at some times, with its standard error from the replicas of both, and the difference
between kinetic theory and LAMMPS. Writes a picture and a JSON file.
"""

import argparse
import time

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import DATA, script_parser, write_picture, write_results
from jaxgran.data.files import header_number
from jaxgran.plotting import COLOURS, INK

SCENES = ("dilute", "dense")
STEPS_PER_CONTACT = 40


def main() -> None:
    parser = script_parser(__doc__, "compare_lammps")
    parser.add_argument("--replicas", type=int, default=4)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    figure = Figure(figsize=(10, 6.4), layout="constrained")
    axes = figure.subplots(2, 2, sharex="col", height_ratios=[2, 1])
    curves = {}
    for column, name in zip(axes.T, SCENES, strict=True):
        curves[name] = compare(name, options, column)
    figure.suptitle("Temperature of two gases, without fitted parameters")
    write_picture(figure, "compare_lammps", options)
    write_results(
        "compare_lammps",
        options,
        options.out / "compare_lammps.json",
        curves=curves,
        replicas=options.replicas,
        steps_per_contact=STEPS_PER_CONTACT,
        key=0,
    )
    print(f"written to {options.out}")


def compare(name: str, options: argparse.Namespace, axes) -> dict:
    measured, header = jaxgran.read_curve(DATA / f"lammps_cooling_{name}.csv")
    gas = jaxgran.read_gas(header)
    gas = gas.replace(dissipative_constant=header_number(header, "A"))
    size, points = (200, 12) if options.smoke else (int(header["N"]), None)
    measured = jax.tree.map(lambda x: x[:points], measured)
    model = jaxgran.SoftSpheres(
        size, replicas=options.replicas, steps_per_contact=STEPS_PER_CONTACT
    )
    begin = time.perf_counter()
    curve = jaxgran.cool(gas, measured.times, model=model)
    jax.block_until_ready(curve.temperature)
    seconds = time.perf_counter() - begin
    theory = jaxgran.cool(gas, measured.times)
    assert curve.temperature_error is not None and measured.temperature_error is not None
    assert curve.displacement is not None and measured.displacement is not None
    assert curve.collisions is not None
    t = np.asarray(measured.times)
    lammps = np.asarray(measured.temperature)
    miss = np.asarray(curve.temperature) / lammps - 1
    error = np.hypot(curve.temperature_error, measured.temperature_error) / lammps
    theory_miss = np.asarray(theory.temperature) / lammps - 1
    print(f"{name}: N = {size}, {options.replicas} replicas, {seconds:.0f} s")
    print(f"{'t, s':>10} {'T/T_0':>10} {'soft spheres':>13} {'+-':>7} {'kinetic theory':>15}")
    for i in np.linspace(1, t.size - 1, 9).astype(int):
        print(
            f"{t[i]:10.4g} {lammps[i] / lammps[0]:10.4g} {100 * miss[i]:+12.2f}% "
            f"{100 * error[i]:6.2f}% {100 * theory_miss[i]:+14.2f}%"
        )
    displacement = np.asarray(curve.displacement[1:] / measured.displacement[1:]) - 1
    print(
        f"largest difference of T {100 * np.abs(miss).max():.2f} %, of <dr^2> "
        f"{100 * np.abs(displacement).max():.2f} %; {float(curve.collisions[-1]):.1f} collisions "
        "per particle\n"
    )
    top, bottom = axes
    soft, by_theory = COLOURS["soft spheres"], COLOURS["kinetic theory"]
    bars = measured.temperature_error[1:]
    top.errorbar(t[1:], lammps[1:], bars, fmt="o", ms=3.5, color=INK, label="LAMMPS")
    top.plot(t[1:], curve.temperature[1:], color=soft, label="soft spheres")
    top.plot(t[1:], theory.temperature[1:], "--", color=by_theory, label="kinetic theory")
    scene = f"{name} gas, φ = {float(gas.packing_fraction):.2g}"
    top.set(xscale="log", yscale="log", ylabel="temperature T (m²/s²)", title=scene)
    top.legend(frameon=False, loc="lower left")
    bottom.axhline(0, color=INK, lw=1)
    bottom.errorbar(t[1:], 100 * miss[1:], 100 * error[1:], fmt="^", ms=3.5, color=soft)
    bottom.plot(t[1:], 100 * theory_miss[1:], "--", color=by_theory)
    bottom.set(xlabel="time t (s)", ylabel="T over LAMMPS' − 1 (%)")
    bottom.set_ylim((-3, 3) if np.abs(theory_miss).max() < 0.03 else (-32, 6))
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
    return {
        "largest_temperature_difference": float(np.abs(miss).max()),
        "largest_displacement_difference": float(np.abs(displacement).max()),
        "largest_theory_difference": float(np.abs(theory_miss).max()),
        "temperature_difference": miss.tolist(),
        "standard_error": error.tolist(),
        "seconds": seconds,
    }


if __name__ == "__main__":
    main()
