"""Is the range that a plan expects the range that experiments give?

    python experiments/fit/plan.py [--runs 50] [--rows smooth] [--record] [--out DIR]

Each scene is planned by `jaxgran.plan`: 30 times until T has fallen to 3 %, errors of T (and T_rot)
of 2 %, single runs. The same experiment, as it is, with the addition that the plan puts first, and
with the one that it puts second, is then simulated by hard spheres, with noise of the measurement,
and each run is fitted with the range over all alternatives. Finds for each

- expected: the width that the plan expects, (high - low)/A, for the true values;
- achieved: the median width of the runs, with its quartiles; 100 where a range has no upper end;
- held: runs whose range contains the true A.

The scenes: smooth spheres; walls, whose restitution is known to .03; rough spheres, whose beta_t is
known to .1; rough spheres that slide, whose friction is known to .05; drag, known to a tenth; and a
drop tower of 300 rough spheres between walls. With --rows scenes whose name contains a word are
computed again. Impacts of the added drop test are drawn from the law, with their error.
"""

import dataclasses
from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.fit.drop_tower import NUM_PARTICLES as NUM_IN_TOWER
from experiments.fit.drop_tower import scene as drop_tower
from experiments.fit.wrong_physics import (
    NUM_PARTICLES,
    NUM_POINTS,
    THEORY,
    WALLS,
    beads,
)
from experiments.support.analysis import fit_quietly, replicas_of
from experiments.support.plots import GUIDE, INK, caption, panels
from experiments.support.record import Options, collected, each_alone, figures, run_parts
from experiments.support.scenes import cool
from jaxgran.fitting.candidates import Planned, standard_candidates
from jaxgran.fitting.plan import OPEN_WIDTH

LAST, ERROR = 0.03, 0.02
NUM_ADDITIONS = 2


class Scene(NamedTuple):
    """A gas, and what is known of it: standard errors of its numbers, by name."""

    name: str
    gas: jaxgran.Gas
    known: dict[str, float]
    number: int = NUM_PARTICLES
    with_rotation: bool = False


DRAG = 0.015 * float(THEORY.cooling_rate(beads()))
SCENES = (
    Scene("smooth", beads(), {}),
    Scene("walls", beads(**WALLS), {"wall_coefficient": 0.03}),
    Scene("rough", beads(surface=jaxgran.Rough(-0.3)), {"tangential_restitution": 0.1}, 250, True),
    Scene("sliding", beads(surface=jaxgran.Rough(0.5, friction=0.2)), {"friction": 0.05}),
    Scene("drag", beads(drag=jaxgran.StokesDrag(DRAG)), {"drag_rate": DRAG / 10}),
    Scene("drop tower", drop_tower(), {"tangential_restitution": 0.1}, NUM_IN_TOWER, True),
)


def planned(scene: Scene) -> jaxgran.Measurement:
    """Return the experiment, with values of kinetic theory."""
    gas = scene.gas
    trial = np.geomspace(1e-2, 1e4, 400) * float(gas.mean_free_time)
    T = cool(gas, trial).temperature / gas.temperature
    end = float(jnp.interp(-np.log(LAST), -jnp.log(T), trial))
    curve = cool(gas, np.geomspace(end / 300, end, NUM_POINTS))
    fields = {"temperature_error": ERROR * curve.temperature, "displacement": None}
    if scene.with_rotation:
        fields["rotational_temperature_error"] = ERROR * curve.rotational_temperature
    else:
        fields["rotational_temperature"] = None
    return jaxgran.Measurement(
        gas,
        dataclasses.replace(curve, **fields),
        num_particles=scene.number,
        priors={name: (gas.value(name), error) for name, error in scene.known.items()},
        errors_measured=True,
    )


def compared(number: int, runs: int) -> dict:
    """Return the widths that a plan of a scene expects, and those of runs."""
    scene = SCENES[number]
    measurement = planned(scene)
    plan = jaxgran.plan(measurement)
    changes = {c.name: c.change for c in standard_candidates(plan.measurement)}
    rows = []
    for expected in (plan.present, *plan.additions[:NUM_ADDITIONS]):
        change = changes.get(expected.name)
        experiment = plan.measurement if change is None else change(plan.measurement)
        assert experiment is not None
        low, high = np.array([fitted(x) for x in simulated(experiment, runs)]).T
        widths = np.minimum(high - low, OPEN_WIDTH)
        quartiles = np.percentile(widths, [25, 50, 75])
        rows.append(
            {
                "addition": expected.name,
                "expected": expected.width,
                "truths": [expected.smallest, expected.median, expected.largest],
                "achieved": quartiles[1],
                "quartiles": quartiles[[0, 2]],
                "held": int(np.sum((low <= 1) & (high >= 1))),
            }
        )
    return {"name": scene.name, "runs": runs, "rows": rows}


def fitted(experiment: Planned) -> tuple[float, float]:
    """Return the range of A of a measured experiment, over the true value."""
    several = {"": experiment} if isinstance(experiment, jaxgran.Measurement) else experiment
    true_A = float(next(iter(several.values())).gas.value("dissipative_constant"))
    result = fit_quietly(experiment, free=("dissipative_constant",))
    ends = result.ranges.get("dissipative_constant", (0.0, np.inf))
    low, high = (float(np.squeeze(x)) / true_A for x in ends)
    return low, high


def simulated(experiment: Planned, runs: int) -> Iterator[Planned]:
    """Yield an experiment as it is measured in each run."""
    if isinstance(experiment, jaxgran.Measurement):
        yield from runs_of(experiment, runs, seed=0)
        return
    each = {label: runs_of(m, runs, seed) for seed, (label, m) in enumerate(experiment.items())}
    for run in range(runs):
        yield {label: found[run] for label, found in each.items()}


def runs_of(m: jaxgran.Measurement, runs: int, seed: int) -> list[jaxgran.Measurement]:
    """Return a measurement of each run, simulated with its noise."""
    rng = np.random.default_rng(seed)
    if isinstance(m.data, jaxgran.DropTest):
        error = np.asarray(m.data.error)
        exact = np.asarray(m.data.computed(m.gas))
        each = exact + error * rng.standard_normal((runs, error.size))
        drops = [dataclasses.replace(m.data, restitution=eps) for eps in each]
        return [dataclasses.replace(m, data=data) for data in drops]
    curve = cool(m.gas, m.curve.times, jaxgran.HardSpheres(m.num_particles, replicas=runs), seed)
    fields = {}
    for name in ("temperature", "rotational_temperature"):
        error = getattr(m.curve, f"{name}_error")
        if error is None:
            continue
        relative = np.asarray(error / getattr(m.curve, name))
        exact = replicas_of(curve, name)
        noisy = exact * (1 + relative * rng.standard_normal(exact.shape))
        fields |= {name: noisy, f"{name}_error": relative * noisy}
    curves = [
        jaxgran.CoolingCurve(m.curve.times, **{name: x[run] for name, x in fields.items()})
        for run in range(runs)
    ]
    return [dataclasses.replace(m, data=data) for data in curves]


def plan(options: Options) -> dict:
    """Compare the scenes, each in a process of its own."""
    known = figures("plan", {"scenes": []})["scenes"] if options.rows else []
    scenes = {found["name"]: found for found in known}
    asked = [k for k, scene in enumerate(SCENES) if options.rows in scene.name]
    for found in collected(each_alone(compared, [(k, options.runs) for k in asked])):
        scenes[found["name"]] = found
    found = [scenes[scene.name] for scene in SCENES if scene.name in scenes]
    ratios = [row["achieved"] / row["expected"] for scene in found for row in scene["rows"]]
    return {"scenes": found, "ratios": ratios, "picture": drawn(found)}


def drawn(found: list[dict]):
    """Draw expected and achieved widths."""
    rows = [(scene["name"], row) for scene in found for row in scene["rows"]]
    figure, (axes,) = panels(size=(8.0, 1.2 + 0.34 * len(rows)))
    for place, (_, row) in enumerate(rows):
        low, high = row["quartiles"]
        axes.plot([low, high], [place, place], "-", color=INK, lw=1.5)
        axes.plot([row["achieved"]], [place], "o", color=INK, ms=5)
        axes.plot([row["expected"]], [place], "|", color=GUIDE, ms=16, mew=2.5)
    axes.plot([], [], "o-", color=INK, label="hard spheres, median and quartiles")
    axes.plot([], [], "|", color=GUIDE, ms=12, mew=2.5, label="expected")
    axes.set_yticks(range(len(rows)), [f"{name}, {row['addition']}" for name, row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    title = f"single experiments, {found[0]['runs']} runs each"
    caption(axes, title, xscale="log", xlabel="width of the 95 % range over A")
    return figure


if __name__ == "__main__":
    run_parts(__doc__, plan, smoke=False, runs=50, rows="")
