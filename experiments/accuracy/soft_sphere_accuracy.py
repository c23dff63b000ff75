"""How large are the errors of soft spheres, and what is their order in the time step?

    python experiments/accuracy/soft_sphere_accuracy.py [--smoke] [--out DIR]

Four measurements without fitted parameters: the final velocities of 64 spheres compared with a
LAMMPS trajectory; eps of a single impact compared with its equation of motion, for many phases of
the time step at first touch; the energy balance of a cooling gas; the energy of an elastic gas.
Each table gives the order of the error: the slope of its logarithm over that of the time step.
Writes a picture and a JSON file.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

import jaxgran
from experiments.support.record import DATA as DATA_FOLDER
from experiments.support.record import script_parser, write_picture, write_results
from experiments.support.scenes import beads
from jaxgran.particles.capacity import Capacity
from jaxgran.plotting import COLOURS, INK

SOFT = COLOURS["soft spheres"]
TRAJECTORY = DATA_FOLDER / "lammps_trajectory_n64.npz"
TRAJECTORY_STEPS = (40, 100, 400, 1600)
FINEST = 6400  # steps of a reference run, which separates our error from that of LAMMPS
IMPACT_STEPS = (25, 50, 100, 200)  # each twice the one before
GAS_STEPS = (20, 40, 80)
BETA = 0.1  # of the head-on impact
ANGLES = {"head-on": 0.0, "at 45°": np.pi / 4}  # between relative velocity and line of centres
PHASES = 499  # odd, so that phases do not repeat in the finer runs
LEDGER = {"num_particles": 200, "beta": 0.3, "collision_times": 20, "replicas": 4}
ELASTIC = {"num_particles": 200, "beta": 0.0, "collision_times": 100, "replicas": 4}
CONTACT_FRACTION = 0.05  # of the mean free time, in both gases
PACKING = 0.2


def main() -> None:
    options = script_parser(__doc__, "soft_sphere_accuracy").parse_args()
    jax.config.update("jax_enable_x64", True)
    num, finest, phases, ledger, elastic = None, FINEST, PHASES, LEDGER, ELASTIC
    if options.smoke:
        small = {"num_particles": 64, "collision_times": 2, "replicas": 2}
        num, finest, phases, ledger, elastic = 2, 200, 51, LEDGER | small, ELASTIC | small
    begin = time.perf_counter()
    results = {
        "trajectory": follow_lammps(TRAJECTORY_STEPS[:num], finest),
        "impact": impacts(IMPACT_STEPS[:num], phases),
        "ledger": balance("energy balance of a cooling gas", GAS_STEPS[:num], **ledger),
        "elastic": balance("energy of an elastic gas", GAS_STEPS[:num], **elastic),
    }
    seconds = time.perf_counter() - begin
    write_picture(draw(results), "soft_sphere_accuracy", options, dpi=100)
    write_results(
        "soft_sphere_accuracy",
        options,
        options.out / "soft_sphere_accuracy.json",
        **results,
        phases=phases,
        ledger_scene=ledger,
        elastic_scene=elastic,
        contact_fraction=CONTACT_FRACTION,
        packing_fraction=PACKING,
        key=0,
        seconds=seconds,
    )
    print(f"{seconds:.0f} s; written to {options.out}")


def follow_lammps(steps_per_contact, finest: int) -> dict:
    data = dict(np.load(TRAJECTORY))
    side, diameter, size = float(data["box_side"]), float(data["diameter"]), 64
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(
            data["youngs_modulus"], data["poisson_ratio"], data["dissipative_constant"]
        ),
        diameter=diameter,
        mass=jaxgran.sphere_mass(diameter, data["density"]),
        packing_fraction=size * np.pi / 6 * (diameter / side) ** 3,
        temperature=np.mean(data["velocity"][0] ** 2),
    )
    first = (data["position"][:1], data["velocity"][:1], data["box_side"])
    start = jaxgran.Particles(*map(jnp.asarray, first))
    duration = data["t"][-1:] - data["t"][0]

    def last(steps):
        model = jaxgran.SoftSpheres(size, steps_per_contact=steps, start=start)
        end = jaxgran.cool(gas, duration, model=model).particles
        assert end is not None
        return np.asarray(end.velocity[0])

    def rms(velocity, reference):
        return float(np.sqrt(np.mean((velocity - reference) ** 2) / np.mean(reference**2)))

    lammps, own = data["velocity"][-1], last(finest)
    velocities = {steps: last(steps) for steps in steps_per_contact}
    rows = [
        {"steps": steps, "lammps": rms(v, lammps), "own": rms(v, own)}
        for steps, v in velocities.items()
    ]
    floor = rms(own, lammps)
    title = f"rms difference of velocities; {floor:.1e} from LAMMPS to {finest} steps"
    return {"finest": finest, "finest_to_lammps": floor, **table(title, rows)}


def impacts(steps_per_contact, phases: int) -> dict:
    """Measure errors of eps over the phases of a time step at first touch, one replica each."""
    # The spheres are so stiff that they do not rotate about each other during a contact.
    gas = beads(0.02, 0.0, 1e-8)
    side, sigma, contact = (float(x) for x in (gas.box_side(2), gas.diameter, gas.contact_duration))
    speed = float(jnp.sqrt(12 * gas.temperature))  # relative speed of a pair with temperature T
    gas = gas.replace(dissipative_constant=BETA / (1.5 * gas.alpha**0.4 * speed**0.2))
    normal_speeds = speed * np.cos(list(ANGLES.values()))
    betas = 1.5 * gas.value("dissipative_constant") * gas.alpha**0.4 * normal_speeds**0.2
    exact = jax.vmap(jaxgran.impact)(betas)
    durations = np.asarray(exact.duration * (gas.alpha**2 * normal_speeds) ** -0.2 / contact)
    # First touches are spread over one step of the coarsest run, so early that the contact ends
    # within the first mean contact duration: after it a new block begins, with another step.
    touch = contact * (0.02 + np.arange(phases) / phases / IMPACT_STEPS[0])
    assert touch[-1] / contact + max(durations) < 1
    results = {}
    for k, (name, angle) in enumerate(ANGLES.items()):
        normal = np.array([np.cos(angle), np.sin(angle), 0.0])
        relative = -sigma * normal - speed * touch[:, None] * np.array([1.0, 0.0, 0.0])
        position = np.stack([side / 2 + relative / 2, side / 2 - relative / 2], axis=1)
        velocity = np.zeros_like(position)
        velocity[:, 0, 0], velocity[:, 1, 0] = speed / 2, -speed / 2
        start = jaxgran.Particles(*map(jnp.asarray, (position, velocity, side)))
        rows = []
        for steps in steps_per_contact:
            model = jaxgran.SoftSpheres(2, replicas=phases, steps_per_contact=steps, start=start)
            plan = model.sized_for(gas).plan
            assert plan is not None
            capacity = Capacity(phases, 2, phases, phases, 2 * phases)  # all collide at once
            model = dataclasses.replace(model, plan=plan._replace(capacity=capacity))
            end = jaxgran.cool(gas, [2 * contact], model=model)
            assert end.particles is not None and end.replicas is not None
            assert np.all(np.asarray(end.replicas.collisions) == 1)
            after = np.asarray(end.particles.velocity[:, 0] - end.particles.velocity[:, 1])
            miss = -after @ normal / normal_speeds[k] - float(exact.restitution[k])
            row = {"steps": steps, "bias": float(np.mean(miss)), "scatter": float(np.std(miss))}
            rows.append(row | {"largest": float(np.abs(miss).max())})
        scene = {"beta": float(betas[k]), "mean_contacts": float(durations[k])}
        results[name] = {**scene, **table(f"error of eps, {name}, {scene}", rows)}
    return results


def balance(
    title: str,
    steps_per_contact,
    *,
    num_particles: int,
    beta: float,
    collision_times: float,
    replicas: int,
) -> dict:
    """Measure the error of the sum of kinetic, elastic and dissipated energy, a constant."""
    gas = beads(PACKING, 0.0, CONTACT_FRACTION)
    gas = gas.replace(dissipative_constant=beta / (1.5 * 2**0.1 * gas.alpha**0.4 * 0.01**0.1))
    times = np.linspace(0, collision_times, 41) * float(gas.mean_free_time)
    equilibrated = jaxgran.cool(
        gas, [0.0], model=jaxgran.SoftSpheres(num_particles, replicas=replicas)
    )
    rows, curve = [], equilibrated
    for steps in steps_per_contact:
        model = jaxgran.SoftSpheres(
            num_particles, replicas=replicas, steps_per_contact=steps, start=equilibrated.particles
        )
        curve = jaxgran.cool(gas, times, model=model)
        each = curve.replicas
        assert each is not None
        assert each.elastic_energy is not None and each.dissipated_energy is not None
        kinetic = 1.5 * gas.mass * each.temperature
        energy = np.asarray(kinetic + each.elastic_energy + each.dissipated_energy)
        miss = energy / energy[:, :1] - 1
        end = float(np.sqrt(np.mean(miss[:, -1] ** 2)))
        rows.append({"steps": steps, "worst": float(np.abs(miss).max()), "end": end})
    assert curve.collisions is not None
    ratio = float(curve.temperature[-1] / gas.temperature)
    collisions = float(curve.collisions[-1])
    title += f", {collisions:.0f} collisions per particle, T/T_0 = {ratio:.3f} at the end"
    return {"temperature_ratio": ratio, **table(title, rows)}


def table(title: str, rows: list[dict]) -> dict:
    """Print the rows, and under each column the order of the error in the time step."""
    names = [name for name in rows[0] if name != "steps"]
    steps = np.log([row["steps"] for row in rows])
    order = {
        name: -float(np.polyfit(steps, np.log([abs(row[name]) for row in rows]), 1)[0])
        for name in names
    }
    print(f"\n{title}\n{'steps':>8}" + "".join(f"{name:>12}" for name in names))
    for row in rows:
        print(f"{row['steps']:8d}" + "".join(f"{row[name]:12.2e}" for name in names))
    print(f"{'order':>8}" + "".join(f"{order[name]:12.2f}" for name in names))
    return {"rows": rows, "order": order}


def draw(results: dict) -> Figure:
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    (trajectory, impact), (ledger, elastic) = figure.subplots(2, 2)
    trajectory.set(title="64 spheres of LAMMPS after 2 τ$_c$", ylabel="velocity difference, rms")
    line(trajectory, results["trajectory"], "lammps", "o-", SOFT, "to LAMMPS")
    finest = results["trajectory"]["finest"]
    line(trajectory, results["trajectory"], "own", "s--", INK, f"to {finest} steps")
    impact.set(title="ε of one impact", ylabel="error of ε")
    for (name, result), colour in zip(results["impact"].items(), (SOFT, INK), strict=True):
        line(impact, result, "scatter", "o-", colour, f"scatter, {name}")
        line(impact, result, "bias", "s--", colour, f"|mean|, {name}")
    for axes, key, title in (
        (ledger, "ledger", "Energy balance of a cooling gas"),
        (elastic, "elastic", "Energy of an elastic gas"),
    ):
        axes.set(title=title, ylabel="error over the initial energy")
        line(axes, results[key], "worst", "o-", SOFT, "worst of all times")
        line(axes, results[key], "end", "s--", INK, "rms at the end")
    for axes in (trajectory, impact, ledger, elastic):
        axes.set(xscale="log", yscale="log", xlabel="steps per contact")
        ticks = axes.lines[0].get_xdata()
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.set_xticks([], minor=True)
        low, high = np.log10(axes.get_ylim())
        axes.set_ylim(10 ** np.floor(low), 10 ** np.ceil(high))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.legend(frameon=False, fontsize=8.5, loc="lower left")
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def line(axes: Axes, result: dict, name: str, style: str, colour: str, label: str) -> None:
    steps = [row["steps"] for row in result["rows"]]
    error = [abs(row[name]) for row in result["rows"]]
    label = f"{label} (order {result['order'][name]:.1f})"
    axes.plot(steps, error, style, color=colour, ms=5, lw=1.4, label=label)


if __name__ == "__main__":
    main()
