"""Do soft spheres with friction and between walls move as in LAMMPS, particle by particle?

    python experiments/accuracy/compare_lammps_elements.py [--particles 500] [--record] [--store]
        [--out DIR]

LAMMPS (`pair_style granular` with viscous tangential forces and Coulomb's limit, `fix wall/gran`
for walls, which have friction too) and jaxgran simulate the same initial state for one mean free
time. Finds the differences of the velocities at several times, and of T and T_rot. LAMMPS computes
the slip with sigma/2 instead of the distance to the contact. The difference is of the order of the
overlap, so a stiffer gas with friction agrees better. LAMMPS is the extra `lammps`. ``--store``
writes a short trajectory of 64 spheres for the tests.
"""

import dataclasses

import numpy as np

import jaxgran
from experiments.support.lammps_library import granular_box
from experiments.support.plots import caption, panels
from experiments.support.record import DATA, Options, run_parts
from experiments.support.scenes import beads, cool

FRICTION = {"tangential_damping": 0.6, "friction": 0.3}
OF_WALLS = {"tangential_damping": 0.8, "friction": 0.4}
TIMES = np.array([0.1, 0.25, 0.5, 0.75, 1.0])  # mean free times
STEPS = 400  # per contact, of both codes

SCENES = {  # contact duration in mean free times, friction, walls
    "smooth": (0.05, False, False),
    "friction": (0.05, True, False),
    "friction, ten times as stiff": (0.02, True, False),
    "walls": (0.05, False, True),
    "walls and friction": (0.05, True, True),
    "walls and friction, ten times as stiff": (0.02, True, True),
}


def scene(name: str, num: int) -> jaxgran.Gas:
    duration, frictional, contained = SCENES[name]
    gas = beads(packing_fraction=0.15, beta=0.3, contact_fraction=duration)
    surface = jaxgran.Frictional(**FRICTION) if frictional else None
    of_walls = OF_WALLS if frictional else {}
    walls = jaxgran.Walls(gas.box_side(num), restitution=gas.law, **of_walls) if contained else None
    return dataclasses.replace(gas, surface=surface, container=walls)


def compare_lammps_elements(options: Options) -> dict:
    if options.store:
        store()
        raise SystemExit
    rows = {name: compare(name, options.particles) for name in SCENES}
    figure, (axes,) = panels(size=(7, 5.4))
    for (name, row), mark in zip(rows.items(), "osD^vP", strict=True):
        axes.plot(TIMES, row["rms_velocity"], f"{mark}-", ms=4, label=name)
    labels = {"xlabel": "t, mean free times", "ylabel": "difference of velocities, rms, over √T₀"}
    caption(axes, "Soft spheres and LAMMPS from the same start", yscale="log", **labels)
    settings = {"particles": options.particles, "steps_per_contact": STEPS}
    settings |= {"friction": FRICTION, "friction_of_walls": OF_WALLS}
    return {"scenes": rows, "times": TIMES, **settings, "picture": figure}


def compare(name: str, num: int) -> dict:
    gas = scene(name, num)
    start, times = initial(gas, num), TIMES * float(gas.mean_free_time)
    lammps = trajectory(gas, start, times, STEPS)
    model = jaxgran.SoftSpheres(num, steps_per_contact=STEPS, start=start)
    curve = cool(gas, times, model, save="particles")
    ours, speed, sigma = curve.saved, float(gas.temperature) ** 0.5, float(gas.diameter)
    velocity = ours.velocity[:, 0] - lammps["velocity"]

    def rms(x) -> np.ndarray:
        return np.sqrt(np.mean(x**2, axis=(1, 2)))

    found = {
        "rms_velocity": rms(velocity) / speed,
        "temperature": float(curve.temperature[-1] / np.mean(lammps["velocity"][-1] ** 2) - 1),
    }
    if gas.surface is not None:
        T_rot = 0.4 * sigma**2 / 4 * np.mean(lammps["omega"][-1] ** 2)
        spin = ours.angular_velocity[:, 0] - lammps["omega"]
        found["rms_spin"] = rms(spin) * sigma / 2 / speed
        found["rotational_temperature"] = float(curve.rotational_temperature[-1] / T_rot - 1)
    print(name, found, flush=True)
    return found


def initial(gas: jaxgran.Gas, num: int) -> jaxgran.Particles:
    """Return an initial state of a gas, without rotation."""
    walls = gas.container and jaxgran.Walls(gas.container.side, restitution=gas.law)
    smooth = dataclasses.replace(gas, surface=None, container=walls)
    return cool(smooth, [0.0], jaxgran.SoftSpheres(num)).particles


def trajectory(gas: jaxgran.Gas, start, times: np.ndarray, steps: int) -> dict[str, np.ndarray]:
    """Return positions, velocities and angular velocities in LAMMPS at the given times."""
    lmp = granular_box(gas, start, 0.3, "nve/sphere")
    names = {"position": "x", "velocity": "v", "omega": "omega"}
    found: dict[str, list] = {name: [] for name in names}
    for duration in np.diff(times, prepend=0.0):
        count = int(np.ceil(duration * steps / float(gas.contact_duration)))
        lmp.commands_list([f"timestep {float(duration) / count!r}", f"run {count}"])
        for name, key in names.items():
            found[name].append(np.reshape(lmp.gather_atoms(key, 1, 3), (-1, 3)))
    lmp.close()
    return {name: np.array(rows) for name, rows in found.items()}


def store() -> None:
    """Write a trajectory of 64 spheres with friction between walls, for the tests."""
    gas = scene("walls and friction", 64)
    start, times = initial(gas, 64), np.array([0.25, 0.5]) * float(gas.mean_free_time)
    first = {"first_position": start.position, "first_velocity": start.velocity}
    content = {"t": times} | first | trajectory(gas, start, times, 1000)
    content |= {name: gas.value(name) for name in gas.domains}
    np.savez_compressed(DATA / "lammps_elements_n64.npz", **content)


if __name__ == "__main__":
    run_parts(__doc__, compare_lammps_elements, smoke=False, particles=500, store=False)
