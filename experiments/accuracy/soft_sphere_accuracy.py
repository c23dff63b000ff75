"""How large are the errors of soft spheres, and what is their order in the time step?

    python experiments/accuracy/soft_sphere_accuracy.py [--smoke] [--record] [--out DIR]

Four measurements without fitted parameters: the final velocities of 64 spheres compared with a
LAMMPS trajectory; eps of a single impact compared with its equation of motion, for many phases of
the time step at first touch; the energy balance of a cooling gas; the energy of an elastic gas.
Each has the order of the error: the slope of its logarithm over that of the time step.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import NullFormatter

import jaxgran
from experiments.support.plots import INK, SOFT, caption, panels
from experiments.support.record import DATA, Options, run_parts
from experiments.support.scenes import beads, cool
from jaxgran.particles.capacity import Capacity

TRAJECTORY_STEPS = (40, 100, 400, 1600)
FINEST = 6400  # steps of a reference run, which separates our error from that of LAMMPS
IMPACT_STEPS = (25, 50, 100, 200)  # each twice the one before
GAS_STEPS = (20, 40, 80)
BETA = 0.1  # of the head-on impact
ANGLES = {"head-on": 0.0, "at 45°": np.pi / 4}  # between relative velocity and line of centres
PHASES = 499  # odd, so that phases do not repeat in the finer runs
LEDGER = {"num_particles": 200, "beta": 0.3, "collision_times": 20, "replicas": 4}
ELASTIC = LEDGER | {"beta": 0.0, "collision_times": 100}
CONTACT_FRACTION = 0.05  # of the mean free time, in both gases
PACKING = 0.2


def soft_sphere_accuracy(options: Options) -> dict:
    num, phases, ledger, elastic = None, PHASES, LEDGER, ELASTIC
    if options.smoke:
        small = {"num_particles": 64, "collision_times": 2, "replicas": 2}
        num, phases, ledger, elastic = 2, 51, LEDGER | small, ELASTIC | small
    found = {} if options.smoke else {"trajectory": follow_lammps(TRAJECTORY_STEPS, FINEST)}
    found |= {
        "impact": impacts(IMPACT_STEPS[:num], phases),
        "ledger": balance(GAS_STEPS[:num], **ledger),
        "elastic": balance(GAS_STEPS[:num], **elastic),
    }
    scenes = {"phases": phases, "ledger_scene": ledger, "elastic_scene": elastic}
    scenes |= {"contact_fraction": CONTACT_FRACTION, "packing_fraction": PACKING}
    return found | scenes | {"picture": draw(found)}


def follow_lammps(steps_per_contact, finest: int) -> dict:
    data = dict(np.load(DATA / "lammps_trajectory_n64.npz"))
    diameter, size = float(data["diameter"]), 64
    names = ("youngs_modulus", "poisson_ratio", "dissipative_constant", "diameter")
    gas = beads(0.1, 0.1).replace(
        **{name: data[name] for name in names},
        mass=jaxgran.sphere_mass(diameter, data["density"]),
        packing_fraction=size * np.pi / 6 * (diameter / float(data["box_side"])) ** 3,
        temperature=np.mean(data["velocity"][0] ** 2),
    )
    first = (data["position"][:1], data["velocity"][:1], data["box_side"])
    start = jaxgran.Particles(*map(jnp.asarray, first))
    duration = data["t"][-1:] - data["t"][0]

    def last(steps):
        model = jaxgran.SoftSpheres(size, steps_per_contact=steps, start=start)
        return np.asarray(cool(gas, duration, model).particles.velocity[0])

    def rms(velocity, reference):
        return float(np.sqrt(np.mean((velocity - reference) ** 2) / np.mean(reference**2)))

    lammps, own = data["velocity"][-1], last(finest)
    rows = []
    for steps in steps_per_contact:
        velocity = last(steps)
        rows.append({"steps": steps, "lammps": rms(velocity, lammps), "own": rms(velocity, own)})
    return {"finest": finest, "finest_to_lammps": rms(own, lammps), **with_order(rows)}


def impacts(steps_per_contact, phases: int) -> dict:
    """Measure errors of eps over the phases of a time step at first touch, one replica each."""
    # The spheres are so stiff that they do not rotate about each other during a contact.
    gas = beads(0.02, BETA / 6**0.1, 1e-8)
    side, sigma, contact = (float(x) for x in (gas.box_side(2), gas.diameter, gas.contact_duration))
    speed = float(jnp.sqrt(12 * gas.temperature))  # relative speed of a pair with temperature T
    cosines = np.cos(list(ANGLES.values()))
    normal_speeds, betas = speed * cosines, BETA * cosines**0.2
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
            sizes = model.sized_for(gas)._sizes
            capacity = Capacity(phases, 2, phases, phases, 2 * phases)  # all collide at once
            model = dataclasses.replace(model, _sizes=sizes._replace(capacity=capacity))
            end = cool(gas, [2 * contact], model)
            assert np.all(np.asarray(end.replicas.collisions) == 1)
            after = np.asarray(end.particles.velocity[:, 0] - end.particles.velocity[:, 1])
            miss = -after @ normal / normal_speeds[k] - float(exact.restitution[k])
            rows.append({"steps": steps, "bias": float(miss.mean()), "scatter": float(miss.std())})
        scene = {"beta": float(betas[k]), "mean_contacts": float(durations[k])}
        results[name] = {**scene, **with_order(rows)}
    return results


def balance(steps_per_contact, num_particles: int, beta: float, collision_times, replicas: int):
    """Measure the error of the sum of kinetic, elastic and dissipated energy, a constant."""
    gas = beads(PACKING, beta, CONTACT_FRACTION)
    times = np.linspace(0, collision_times, 41) * float(gas.mean_free_time)
    first = jaxgran.SoftSpheres(num_particles, replicas=replicas)
    first = dataclasses.replace(first, start=cool(gas, [0.0], first).particles)
    rows = []
    for steps in steps_per_contact:
        each = cool(gas, times, dataclasses.replace(first, steps_per_contact=steps)).replicas
        kinetic = 1.5 * gas.mass * each.temperature
        energy = np.asarray(kinetic + each.elastic_energy + each.dissipated_energy)
        miss = energy / energy[:, :1] - 1
        end = float(np.sqrt(np.mean(miss[:, -1] ** 2)))
        rows.append({"steps": steps, "worst": float(np.abs(miss).max()), "end": end})
    return with_order(rows)


def with_order(rows: list[dict]) -> dict:
    """Return the rows, and the order of the error of each column in the time step."""
    steps, order = np.log([row["steps"] for row in rows]), {}
    for name in list(rows[0])[1:]:
        errors = np.log([abs(row[name]) for row in rows])
        order[name] = -float(np.polyfit(steps, errors, 1)[0])
    return {"rows": rows, "order": order}


def draw(found: dict):
    figure, (trajectory, impact, ledger, elastic) = panels(2, 2, size=(4.5, 3.5))
    if "trajectory" in found:
        line(trajectory, found["trajectory"], "lammps", "o-", SOFT, "to LAMMPS")
        line(trajectory, found["trajectory"], "own", "s--", INK, f"to {FINEST} steps")
    for (name, result), colour in zip(found["impact"].items(), (SOFT, INK), strict=True):
        line(impact, result, "scatter", "o-", colour, f"scatter, {name}")
        line(impact, result, "bias", "s--", colour, f"|mean|, {name}")
    for axes, name in ((ledger, "ledger"), (elastic, "elastic")):
        line(axes, found[name], "worst", "o-", SOFT, "worst of all times")
        line(axes, found[name], "end", "s--", INK, "rms at the end")
    words = {
        "64 spheres of LAMMPS after 2 τ$_c$": "velocity difference, rms",
        "ε of one impact": "error of ε",
        "Energy balance of a cooling gas": "error over the initial energy",
        "Energy of an elastic gas": "error over the initial energy",
    }
    for axes, (title, label) in zip(figure.axes, words.items(), strict=True):
        labels = {"xlabel": "steps per contact", "ylabel": label}
        if not axes.lines:
            continue  # a small run follows no trajectory
        caption(axes, title, "lower left", xscale="log", yscale="log", **labels)
        ticks = np.asarray(axes.lines[0].get_xdata())
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.set_xticks([], minor=True)
        low, high = np.log10(axes.get_ylim())
        axes.set_ylim(10 ** np.floor(low), 10 ** np.ceil(high))
        axes.yaxis.set_minor_formatter(NullFormatter())
    return figure


def line(axes, result: dict, name: str, style: str, colour: str, label: str) -> None:
    steps = [row["steps"] for row in result["rows"]]
    error = [abs(row[name]) for row in result["rows"]]
    label = f"{label} (order {result['order'][name]:.1f})"
    axes.plot(steps, error, style, color=colour, ms=5, lw=1.4, label=label)


if __name__ == "__main__":
    run_parts(__doc__, soft_sphere_accuracy)
