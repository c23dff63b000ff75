"""Are projected derivatives of a clustering gas accurate if the projection also keeps its flow?

    python experiments/accuracy/flow_memory.py [--memories NAME ...] [--keys 0 1] [--smoke]
        [--record] [--out DIR]

d ln T/d ln A of soft spheres (phi = .3, beta_T0 = .2, t_c/tau_c = .05, 1000 spheres, 1.4 L_c)
after 10, 30, 60 and 100 collisions per particle. The tangents are projected, every .1 mean free
time unless the name gives another interval, onto the temperature and

- waves of the flow, one coefficient each (least squares on ``cos(k x) e`` and ``sin(k x) e``), with
  or without waves of temperature and stress, and of displacements;
- or the energy of the flow in bands of wave lengths, one coefficient per band, with or without the
  stress caused by this flow, longitudinal waves, waves of heat and of density.

The quantities kept in addition to the temperature are called a memory. The reference is differences
of many runs (gradient_health.py --scenes clustering). Waves are named by n^2, with
k = 2 pi n / side. Each memory is measured in two boxes per key, in a separate process; --record
keeps the recorded boxes of other memories and keys. Standard errors are over boxes.
"""

import argparse
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.apart import alone
from experiments.support.flow_projection import projecting
from experiments.support.flow_waves import Memory
from experiments.support.record import add_recording, figures, write_picture, write_results
from experiments.support.scenes import beads
from jaxgran.plotting import COLOURS, INK

COLLISIONS = (10.0, 30.0, 60.0, 100.0)
REFERENCE = {10.0: (-0.604, 0.005), 30.0: (-0.979, 0.008), 100.0: (-0.811, 0.022)}
"""Differences of many runs, and their standard errors."""

PHI, BETA, CONTACT, SIZE, REPLICAS, STEPS = 0.3, 0.2, 0.05, 1000, 2, 15
END, POINTS = 2400.0, 45  # mean free times

ONE, TWO = ((1,),), ((1,), (2,))
FIVE = ((1,), (2,), (3, 4), (5, 6), (8, 9))
MEMORIES = {
    "T": Memory(),
    "waves, 1": Memory(waves=(1,)),
    "waves, 2": Memory(waves=(1, 2)),
    "transverse waves, 2": Memory(waves=(1, 2), transverse=True),
    "waves of flow, heat, stress, 1": Memory(waves=(1,), tensors=True),
    "waves of flow, heat, stress, 2": Memory(waves=(1, 2), tensors=True),
    "waves and fitted displacements, 1": Memory(waves=(1,), displacement="fitted"),
    "waves and carried displacements, 1": Memory(waves=(1,), displacement="carried"),
    "waves, 2, momentum conserved": Memory(waves=(1, 2), touching=True),
    "energy, 1": Memory(flow=ONE),
    "energy, 2": Memory(flow=TWO),
    "energy, 2, Enskog's stress": Memory(flow=TWO, viscous=True),
    "energy and stress, 1": Memory(flow=ONE, stress=ONE),
    "energy and stress, 2": Memory(flow=TWO, stress=TWO),
    "energy and stress, 2, momentum conserved": Memory(flow=TWO, stress=TWO, touching=True),
    "energy and stress, 2, every .3": Memory(flow=TWO, stress=TWO, interval=0.3),
    "energy and stress, 9": Memory(flow=FIVE, stress=FIVE),
    "energy and stress, 9, every .3": Memory(flow=FIVE, stress=FIVE, interval=0.3),
    "energy, stress, heat, density, 2": Memory(
        flow=TWO, stress=TWO, compression=TWO, heat=(*TWO, (4,)), density=(*TWO, (4,))
    ),
}
"""Memories by name; the number in a name is the largest n^2."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--memories", nargs="+", choices=MEMORIES, default=list(MEMORIES))
    parser.add_argument("--keys", nargs="+", type=int, default=[0, 1], help="of random numbers")
    parser.add_argument("--measure", choices=MEMORIES, help=argparse.SUPPRESS)
    parser.add_argument("--smoke", action="store_true", help="few particles, early times only")
    parser.add_argument("--out", type=Path, default=Path("results") / "flow_memory")
    add_recording(parser)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.measure:
        print(json.dumps(measured(options.measure, options.keys[0], options.smoke)))
        return
    rows = recorded() if options.record else {}
    print(f"{'':>42}" + "".join(f"{n:>17.0f}" for n in COLLISIONS), "collisions")
    for name in options.memories:
        boxes = rows[name]["boxes"] if name in rows else {}
        for key in options.keys:
            smoke = ["--smoke"] if options.smoke else []
            own = ["--measure", name, "--keys", str(key), *smoke]
            boxes[str(key)] = alone(__file__, *own)["boxes"]
        rows[name] = {"boxes": boxes} | over_boxes([x for k in sorted(boxes) for x in boxes[k]])
        print(line(name, rows[name]), flush=True)
        kept = {name: rows[name] for name in MEMORIES if name in rows}
        reference = [[n, *REFERENCE[n]] for n in REFERENCE]
        file = options.out / "flow_memory.json"
        write_results("flow_memory", options, file, reference=reference, memories=kept)
    write_picture(draw(rows), "flow_memory", options)


def recorded() -> dict:
    """Return the recorded results."""
    try:
        return figures("flow_memory")["memories"]
    except FileNotFoundError:
        return {}


def measured(name: str, key: int, smoke: bool) -> dict:
    """Measure the derivative in each box with a memory, at the `COLLISIONS` that are reached."""
    gas, memory = beads(PHI, BETA, CONTACT), MEMORIES[name]
    size, end, points = (100, 20.0, 8) if smoke else (SIZE, END, POINTS)
    times = float(gas.mean_free_time) * np.geomspace(0.3, end, points)
    model = jaxgran.SoftSpheres(
        size, replicas=REPLICAS, steps_per_contact=STEPS, projection=memory.interval
    )

    def log_temperatures(log_scale):
        constant = gas.value("dissipative_constant") * jnp.exp(log_scale)
        changed, own = gas.replace(dissipative_constant=constant), jax.random.key(key)
        curve = jaxgran.cool(changed, times, model=model, key=own, progress=False)
        assert curve.replicas is not None
        return jnp.log(curve.replicas.temperature), curve.collisions

    with projecting(memory):
        _, slopes, counts = jax.jvp(log_temperatures, (0.0,), (1.0,), has_aux=True)
    found = [n for n in COLLISIONS if n <= counts[-1]]
    at = [np.interp(np.log(found), np.log(counts), slope).tolist() for slope in slopes]
    return {"boxes": at}


def over_boxes(boxes: list[list[float]]) -> dict:
    """Return mean and standard error over boxes, at the collisions that all of them reached."""
    reached = min(map(len, boxes))
    each = np.array([box[:reached] for box in boxes])
    error = each.std(0, ddof=1) / len(each) ** 0.5
    return {
        "collisions": list(COLLISIONS[:reached]),
        "d_ln_T_d_ln_A": [each.mean(0).tolist(), error.tolist()],
        "num_boxes": len(each),
    }


def over_reference(row: dict) -> dict[float, tuple[float, float]]:
    """Return the relative difference from the derivative by differences, and its standard error."""
    found = {}
    for n, mean, error in zip(row["collisions"], *row["d_ln_T_d_ln_A"], strict=True):
        if n in REFERENCE:
            true, spread = REFERENCE[n]
            found[n] = mean / true - 1, abs(np.hypot(error, spread * mean / true) / true)
    return found


def within_bounds(row: dict) -> bool:
    """Return whether the derivative is accurate to 5 (+- 3) % at 30 and 10 (+- 4) % at 100."""
    off, bounds = over_reference(row), {30.0: (0.05, 0.03), 100.0: (0.1, 0.04)}
    return all(
        n in off and abs(off[n][0]) < most and off[n][1] < error
        for n, (most, error) in bounds.items()
    )


def line(name: str, row: dict) -> str:
    """Format the derivatives of a memory."""
    columns = zip(*row["d_ln_T_d_ln_A"], strict=True)
    words = "".join(f"{m:+9.3f} ± {e:5.3f}" for m, e in columns)
    return f"{name:>42}{words}   ({row['num_boxes']} boxes)"


def draw(rows: dict) -> Figure:
    """Draw the derivatives of some memories and those by differences."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    n = np.array(list(REFERENCE))
    mean, error = np.array(list(REFERENCE.values())).T
    axes.errorbar(n, mean, error, fmt="o", color=INK, mfc="none", ms=8, label="differences of runs")
    shown = {
        "T": ("^", COLOURS["soft spheres"], "T only (the package)"),
        "waves, 2": ("v", COLOURS["guide"], "and waves of the flow, n² ≤ 2"),
        "energy and stress, 2": ("s", COLOURS["hard spheres"], "and energy, stress of two bands"),
        "energy and stress, 9": (
            "D",
            COLOURS["kinetic theory"],
            "and energy, stress of five bands",
        ),
    }
    for shift, (name, (marker, colour, label)) in enumerate(shown.items()):
        if name not in rows:
            continue
        at = np.array(rows[name]["collisions"]) * 1.05 ** (shift - 1.5)
        look = {"fmt": f"{marker}-", "color": colour, "lw": 0.8, "ms": 5, "label": label}
        axes.errorbar(at, *rows[name]["d_ln_T_d_ln_A"], **look)
    axes.set(xscale="log", xlabel="collisions per particle", ylabel="d ln T / d ln A")
    axes.set_xticks(COLLISIONS, [f"{x:.0f}" for x in COLLISIONS])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=9, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


if __name__ == "__main__":
    main()
