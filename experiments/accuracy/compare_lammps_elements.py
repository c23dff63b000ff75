"""Do soft spheres with friction and between walls move as in LAMMPS, particle by particle?

    python experiments/accuracy/compare_lammps_elements.py [--particles 500] [--store] [--out DIR]

LAMMPS (`pair_style granular` with viscous tangential forces and Coulomb's limit, `fix wall/gran`
for walls, which have friction too) and jaxgran simulate the same initial state for one mean free
time. Prints the differences of the velocities at several times, and of T and T_rot. LAMMPS computes
the slip with sigma/2 instead of the distance to the contact. The difference is of the order of the
overlap, so a stiffer gas with friction agrees better. LAMMPS is the extra `lammps`. ``--store``
writes a short trajectory of 64 spheres for the tests. Writes a picture and a JSON file.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.lammps_library import granular_box, hertzian
from experiments.support.record import DATA, script_parser, write_picture, write_results
from experiments.support.scenes import beads

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


def main() -> None:
    parser = script_parser(__doc__, "compare_lammps_elements", smoke=False)
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--store", action="store_true", help="write the data of the tests")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.store:
        store(DATA / "lammps_elements_n64.npz")
        return
    rows = {name: compare(name, options.particles) for name in SCENES}
    picture(rows, options)
    write_results(
        "compare_lammps_elements",
        options,
        options.out / "compare_lammps_elements.json",
        scenes=rows,
        times=TIMES.tolist(),
        particles=options.particles,
        steps_per_contact=STEPS,
        friction=FRICTION,
        friction_of_walls=OF_WALLS,
    )
    print(f"written to {options.out}")


def scene(name: str, num: int) -> jaxgran.Gas:
    duration, frictional, contained = SCENES[name]
    gas = beads(packing_fraction=0.15, beta=0.3, contact_fraction=duration)
    elements: dict[str, Any] = {}
    if frictional:
        elements["surface"] = jaxgran.Frictional(**FRICTION)
    if contained:
        friction_material = OF_WALLS if frictional else {}
        walls = jaxgran.Walls(gas.box_side(num), restitution=gas.law, **friction_material)
        elements["container"] = walls
    return dataclasses.replace(gas, **elements)


def compare(name: str, num: int) -> dict:
    gas = scene(name, num)
    start = drawn(gas, num)
    times = TIMES * float(gas.mean_free_time)
    lammps = trajectory(gas, start, times, STEPS)
    ours = [followed(gas, start, times[:i], num) for i in range(1, len(times) + 1)]
    speed, sigma = float(gas.temperature) ** 0.5, float(gas.diameter)
    side = float(start.box_side)
    velocity = np.array([each.velocity[0] for each, _ in ours]) - lammps["velocity"]
    apart = np.array([each.position[0] for each, _ in ours]) - lammps["position"]
    if gas.container is None:
        apart -= side * np.round(apart / side)
    found = {
        "rms_velocity": (np.sqrt(np.mean(velocity**2, axis=(1, 2))) / speed).tolist(),
        "largest_velocity": (np.abs(velocity).max(axis=(1, 2)) / speed).tolist(),
        "largest_position": (np.abs(apart).max(axis=(1, 2)) / sigma).tolist(),
        "temperature": float(relative(ours[-1][1].temperature[-1], lammps["velocity"][-1], 1.0)),
        "collisions": float(ours[-1][1].collisions[-1]),
        "mean_overlap": float(gas.mean_overlap),
    }
    if gas.surface is not None:
        spin = np.array([each.angular_velocity[0] for each, _ in ours]) - lammps["omega"]
        found["rms_spin"] = (np.sqrt(np.mean(spin**2, axis=(1, 2))) * sigma / 2 / speed).tolist()
        T_rot = ours[-1][1].rotational_temperature[-1]
        found["rotational_temperature"] = float(
            relative(T_rot, lammps["omega"][-1], 0.4 * sigma**2 / 4)
        )
    print(f"{name}: {found['collisions']:.2f} collisions per particle")
    for key, value in found.items():
        words = " ".join(f"{v:.1e}" for v in value) if isinstance(value, list) else f"{value:.2e}"
        print(f"    {key:>24} {words}")
    return found


def drawn(gas: jaxgran.Gas, num: int) -> jaxgran.Particles:
    """Return an initial state of a gas, without rotation."""
    walls = gas.container and jaxgran.Walls(gas.container.side, restitution=gas.law)
    smooth = dataclasses.replace(gas, surface=None, container=walls)
    start = jaxgran.cool(smooth, [0.0], model=jaxgran.SoftSpheres(num)).particles
    assert start is not None
    return start


def relative(T, velocity: np.ndarray, factor: float) -> float:
    """Return the relative difference of a temperature from that of given velocities."""
    return T / (factor * np.mean(velocity**2)) - 1


def followed(gas: jaxgran.Gas, start: jaxgran.Particles, times, num: int) -> tuple[Any, Any]:
    """Return the particles at the last time, and the curve."""
    model = jaxgran.SoftSpheres(num, steps_per_contact=STEPS, start=start)
    curve = jaxgran.cool(gas, times, model=model, progress=False)
    return curve.particles, curve


def trajectory(gas: jaxgran.Gas, start, times: np.ndarray, steps: int) -> dict[str, np.ndarray]:
    """Return positions, velocities and angular velocities in LAMMPS at the given times."""
    walls, n, side = gas.container, start.position.shape[1], float(start.box_side)
    law = hertzian(gas, gas.law, tangential(gas, FRICTION))
    lmp = granular_box(gas, start.position[0], start.velocity[0], side, law, 0.3, "nve/sphere")
    if walls is not None:
        law = hertzian(gas, walls.restitution, tangential(gas, OF_WALLS), wall=True)
        for axis in "xyz":
            lmp.command(f"fix {axis} all wall/gran granular {law} {axis}plane 0 {side!r}")
    found: dict[str, list] = {"position": [], "velocity": [], "omega": []}
    last = 0.0
    for time in times:
        count = int(np.ceil((time - last) * steps / float(gas.contact_duration)))
        lmp.command(f"timestep {float(time - last) / count!r}")
        lmp.command(f"run {count}")
        for name, key in (("position", "x"), ("velocity", "v"), ("omega", "omega")):
            rows, ids = lmp.numpy.extract_atom(key), lmp.numpy.extract_atom("id")
            assert rows is not None and ids is not None
            found[name].append(np.array(rows[:n], float)[np.argsort(ids[:n])])
        last = time
    lmp.close()
    return {name: np.array(rows) for name, rows in found.items()}


def tangential(gas: jaxgran.Gas, values: dict[str, float]) -> str:
    return "0 0" if gas.surface is None else " ".join(str(value) for value in values.values())


def picture(rows: dict[str, dict], options: argparse.Namespace) -> None:
    figure = Figure(figsize=(7, 5.4), layout="constrained")
    axes = figure.subplots()
    for (name, row), mark in zip(rows.items(), "osD^vP", strict=True):
        axes.plot(TIMES, row["rms_velocity"], f"{mark}-", ms=4, label=name)
    axes.set(
        yscale="log",
        xlabel="t, mean free times",
        ylabel="difference of velocities, rms, over √T₀",
        title="Soft spheres and LAMMPS from the same start",
    )
    figure.legend(frameon=False, loc="outside lower center", ncols=2, fontsize=9)
    write_picture(figure, "compare_lammps_elements", options)


def store(file: Path) -> None:
    """Write a trajectory of 64 spheres with friction between walls, for the tests."""
    gas = scene("walls and friction", 64)
    start = drawn(gas, 64)
    assert isinstance(gas.law, jaxgran.Viscoelastic)
    times = np.array([0.25, 0.5]) * float(gas.mean_free_time)
    lammps = trajectory(gas, start, times, 1000)
    first = {"first_position": start.position, "first_velocity": start.velocity}
    floats = {name: gas.value(name) for name in gas.domains}
    content: dict[str, Any] = {"t": times} | first | lammps | floats
    np.savez_compressed(file, **content)
    print(f"written to {file}: {', '.join(content)}")


if __name__ == "__main__":
    main()
