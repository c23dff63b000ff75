"""Do the commands of `jaxgran.lammps_commands` give impacts in LAMMPS the eps of the law?

    python experiments/accuracy/lammps_impacts.py [--smoke] [--record] [--out DIR]

Two spheres, of equal or different sizes, meet head-on in LAMMPS at five speeds. Finds eps by the
velocities before and after, and its difference from eps of the law for this pair: that of two equal
spheres with the same effective radius and mass. Needs the extra `lammps`.
"""

import numpy as np

import jaxgran
from experiments.support.lammps_library import new_lammps
from experiments.support.record import Options, collected, run_parts
from experiments.support.scenes import glass

RATIOS = (1.0, 1.5, 2.0)
SPEEDS = (0.02, 0.05, 0.1, 0.3, 1.0)
GAP = 0.02
"""Distance of the surfaces before an impact, in diameters of the smaller sphere."""


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


if __name__ == "__main__":
    run_parts(__doc__, lammps_impacts)
