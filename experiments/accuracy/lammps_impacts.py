"""Do the commands of `jaxgran.lammps_commands` give LAMMPS the contact law of a gas?

    python experiments/accuracy/lammps_impacts.py [--smoke] [--only lammps_impacts lammps_gases]
        [--runs 3] [--record] [--out DIR]

- lammps_impacts: two spheres, of equal or different sizes, meet head-on in LAMMPS at five speeds.
  Finds eps by the velocities before and after, and its difference from eps of the law for this
  pair: that of two equal spheres with the same effective radius and mass.
- lammps_gases: gases cool in LAMMPS until T is a tenth of T_0, in a periodic box and between walls
  of the same material. `jaxgran.fit` finds A of each run, with its standard error and its range.

Needs the extra `lammps`.
"""

import dataclasses
from collections.abc import Iterator

import numpy as np

import jaxgran
from experiments.accuracy.make_lammps_curves import simulate
from experiments.support.analysis import fit_quietly
from experiments.support.lammps_library import new_lammps
from experiments.support.record import Options, collected, run_parts
from experiments.support.scenes import beads, glass
from jaxgran.data.lammps import STEPS_OF_CONTACT

RATIOS = (1.0, 1.5, 2.0)
SPEEDS = (0.02, 0.05, 0.1, 0.3, 1.0)
GAP = 0.02
"""Distance of the surfaces before an impact, in diameters of the smaller sphere."""

NUMBER = 2000
"""Spheres in a gas."""

END = 38.0
"""Last time of a gas, in mean free times at t = 0: T is then a tenth of T_0 in a periodic box."""


def lammps_impacts(options: Options) -> dict:
    """Compare each pair at each speed."""
    ratios = RATIOS[:2] if options.smoke else RATIOS
    speeds = SPEEDS[1:3] if options.smoke else SPEEDS
    rows = list(collected(compared(ratio, v) for ratio in ratios for v in speeds))
    return {"rows": rows, "largest_difference": max(abs(row["difference"]) for row in rows)}


def compared(ratio: float, speed: float) -> dict:
    """Return eps of an impact in LAMMPS, and by the law."""
    gas = glass(0.1, 0.05)
    sizes = [float(gas.diameter), ratio * float(gas.diameter)]
    masses = [float(gas.mass), ratio**3 * float(gas.mass)]
    radius = sizes[0] * sizes[1] / (2 * sum(sizes))
    reduced = masses[0] * masses[1] / sum(masses)
    law = gas.law.reduced(diameter=4 * radius, mass=2 * reduced, speed=1.0)
    measured = impact(jaxgran.lammps_commands(gas, sizes), gas, sizes, speed)
    computed = float(law.restitution(np.asarray(speed)))
    return {"ratio": ratio, "speed": speed, "lammps": measured, "law": computed} | {
        "difference": measured - computed
    }


def impact(commands: str, gas: jaxgran.Gas, sizes: list[float], speed: float) -> float:
    """Return eps of a head-on impact of two spheres in LAMMPS."""
    lmp = new_lammps()
    side = 10 * sum(sizes)
    apart = sum(sizes) / 2 + GAP * sizes[0]
    lmp.commands_list(
        [
            "units si",
            "atom_style sphere",
            "boundary f f f",
            "newton off",
            f"region box block {-side} {side} {-side} {side} {-side} {side}",
            "create_box 2 box",
        ]
    )
    lmp.create_atoms(2, [1, 2], [1, 2], [0, 0, 0, apart, 0, 0], [speed, 0, 0, 0, 0, 0])
    for number, size in enumerate(sizes, 1):
        lmp.command(f"set type {number} diameter {size!r} density {float(gas.density)!r}")
    lmp.commands_list(commands.splitlines())
    step = float(lmp.extract_global("dt"))
    flight = 4 * GAP * sizes[0] / speed + 10 * float(gas.contact_duration)
    motion = [
        f"neighbor {0.5 * sizes[0]!r} bin",
        "comm_modify vel yes",
        "fix move all nve",
        "thermo 1000000000",
        f"run {int(flight / step)}",
    ]
    lmp.commands_list(motion)
    velocities = np.ctypeslib.as_array(lmp.gather_atoms("v", 1, 3)).reshape(2, 3)
    lmp.close()
    return float((velocities[1, 0] - velocities[0, 0]) / speed)


def lammps_gases(options: Options) -> Iterator[dict]:
    """Fit A to each run of each gas."""
    number, end = (200, 5.0) if options.smoke else (NUMBER, END)
    gas = beads(packing_fraction=0.05, beta=0.2, contact_fraction=0.01)
    walls = jaxgran.Walls(gas.box_side(number), restitution=gas.law)
    gases = {"periodic box": gas, "walls": dataclasses.replace(gas, container=walls)}
    for name, one in gases.items():
        times, runs = simulate(one, number, options.runs, end, STEPS_OF_CONTACT)
        for T in runs:
            curve = jaxgran.CoolingCurve(times, T)
            yield {"gas": name} | fitted(jaxgran.Measurement(one, curve, num_particles=number))


def fitted(measurement: jaxgran.Measurement) -> dict:
    """Return A of a run by a fit, its standard error and its range, over the true A."""
    result = fit_quietly(measurement)
    true = float(measurement.gas.value("dissipative_constant"))
    T = np.asarray(measurement.curve.temperature)
    low, high = (float(end[0]) for end in result.ranges["dissipative_constant"])
    return {
        "fallen_to": float(T[-1] / T[0]),
        "true": true,
        "estimate": float(result.estimate[0]),
        "std_err": float(result.standard_error[0]),
        "range": [low, high],
        "held": low <= true <= high,
        "reduced_chi2": float(result.reduced_chi2),
        "p_value": float(result.p_value),
        "verdict": result.verdict,
    }


if __name__ == "__main__":
    run_parts(__doc__, lammps_impacts, lammps_gases, runs=3)
