"""Is the derivative of the cooling curve of a chaotic gas accurate, and for how long?

    python experiments/accuracy/gradient_health.py [--scenes dilute dense clustering]
        [--smoke] [--record] [--out DIR]

d ln T / d ln A of three gases after 1, 3, 10, 30 and 100 collisions per particle, by

- central finite differences (many replicas, the same initial states on both sides; the truncation
  error of the step is corrected by kinetic theory),
- forward mode without projection ("plain"),
- thermally projected forward and reverse mode,
- kinetic theory;

and the dependence of the projected derivative on the interval between projections. Standard errors
are over replicas. `derivatives_in_flows.py` examines two more gases with a flow, disks and hard
spheres. Prints tables, draws a
picture with the recorded scenes that are not computed, and writes a JSON file of each scene.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import figures, script_parser, write_picture, write_results
from experiments.support.scenes import beads
from jaxgran.plotting import COLOURS, INK

COLLISIONS = (1.0, 3.0, 10.0, 30.0, 100.0)
INTERVALS = (0.03, 0.1, 0.3, 1.0)
STEP = 0.3  # of ln A, to either side
# packing fraction, beta_T0, contact duration over mean free time, particles in a box, replicas
SCENES = {
    "dilute": (0.05, 0.1, 0.01, 500, 16),
    "dense": (0.25, 0.05, 0.05, 500, 16),
    "clustering": (0.3, 0.2, 0.05, 1000, 8),
}
# Sets of replicas for finite differences, which scatter more than tangents.
SETS = {"dilute": 1, "dense": 1, "clustering": 6}
FEW_REPLICAS = 4
EARLY, EARLY_REPLICAS = 2, 64  # the first times, where derivatives are small, have more replicas
PLAIN_HORIZON = 3  # times at which the plain derivative is computed; at the last it overflows
STEPS_PER_CONTACT = 25


def main() -> None:
    parser = script_parser(__doc__, "gradient_health")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = {name: figures(f"gradient_health_{name}") for name in SCENES}
    settings = {"step_of_ln_A": STEP, "steps_per_contact": STEPS_PER_CONTACT}
    for name in options.scenes:
        results[name] = examine(name, options.smoke)
        file = f"gradient_health_{name}"
        write_results(file, options, options.out / f"{file}.json", **results[name], **settings)
    write_picture(draw(results), "gradient_health", options)


def times_of(gas: jaxgran.Gas, collisions, size: int) -> np.ndarray:
    """Return the times at which a particle has made these numbers of collisions on average.

    By kinetic theory, or, if the box exceeds L_c, by a run of soft spheres: in clusters spheres
    collide more often than kinetic theory predicts.
    """

    def times(model, t):
        counts = np.asarray(jaxgran.cool(gas, t, model=model, progress=False).collisions)
        return np.exp(np.interp(np.log(collisions), np.log(np.maximum(counts, 1e-9)), np.log(t)))

    tau_c = float(gas.mean_free_time)
    found = times(jaxgran.KineticTheory(), tau_c * np.geomspace(0.1, 1e6, 400))
    if gas.box_side(size) < gas.critical_box:
        return found
    model = jaxgran.SoftSpheres(size, steps_per_contact=10)
    return times(model, np.geomspace(0.1 * tau_c, found[-1], 60))


def examine(name: str, smoke: bool) -> dict:
    """Compute all results of a scene."""
    begin, gas = time.perf_counter(), beads(*SCENES[name][:3])
    collisions = COLLISIONS[:2] if smoke else COLLISIONS
    (size, many), few, most = SCENES[name][3:], FEW_REPLICAS, EARLY_REPLICAS
    if smoke:
        size, many, few, most = 50, 2, 2, 4
    times = times_of(gas, collisions, size)
    constant = gas.value("dissipative_constant")

    def log_temperatures(log_scale, model, times=times, seed=0):
        changed = gas.replace(dissipative_constant=constant * jnp.exp(log_scale))
        key = jax.random.key(seed)
        curve = jaxgran.cool(changed, times, model=model, key=key, progress=not smoke)
        each = curve.temperature[None] if curve.replicas is None else curve.replicas.temperature
        return jnp.log(each), curve.collisions  # shape (replicas, times)

    def forward(model, times=times):
        begin = time.perf_counter()
        zero = jnp.zeros(())
        _, slope, counts = jax.jvp(
            lambda x: log_temperatures(x, model, times), (zero,), (jnp.ones(()),), has_aux=True
        )
        return np.asarray(slope), np.asarray(counts), time.perf_counter() - begin

    def spheres(replicas, **settings):
        return jaxgran.SoftSpheres(
            size,
            replicas=replicas,
            steps_per_contact=STEPS_PER_CONTACT,
            **settings,
        )

    theory = jaxgran.KineticTheory()
    exact = forward(theory)[0][0]
    ends = [np.asarray(log_temperatures(s * STEP, theory)[0][0]) for s in (1, -1)]
    truncation = (ends[0] - ends[1]) / (2 * STEP) - exact

    def differences(model, times, seed=0):
        ends = [np.asarray(log_temperatures(s * STEP, model, times, seed)[0]) for s in (1, -1)]
        return (ends[0] - ends[1]) / (2 * STEP) - truncation[: len(times)]

    def joined(early, late):
        pairs = zip(over_replicas(early), over_replicas(late), strict=True)
        return tuple(np.concatenate([a[:EARLY], b[EARLY:]]) for a, b in pairs)

    sets = 1 if smoke else SETS[name]
    late = np.concatenate([differences(spheres(many), times, seed) for seed in range(sets)])
    early = spheres(most), times[:EARLY]
    slopes, counts, seconds = forward(spheres(many))
    columns = {
        "kinetic theory": (exact, 0 * exact),
        "differences": joined(differences(*early), late),
        "projected": joined(forward(*early)[0], slopes),
    }
    # A plain derivative is computed under tracing, where arrays cannot be enlarged.
    plain = spheres(few, projection=None).sized_for(gas)
    columns["plain"] = over_replicas(forward(plain, times[:PLAIN_HORIZON])[0])
    by_interval = {}
    for interval in INTERVALS[:2] if smoke else INTERVALS:
        slopes = forward(spheres(few, projection=interval))[0]
        by_interval[interval] = over_replicas(slopes)
    # Reverse mode: the gradient of the mean ln T at the last time, compared with forward mode.
    model = spheres(few, projection=INTERVALS[1])
    last = jax.grad(lambda x: jnp.mean(log_temperatures(x, model)[0][:, -1]))(0.0)
    disagreement = abs(float(last) - by_interval[INTERVALS[1]][0][-1])

    bias = columns["projected"][0] / columns["differences"][0] - 1
    spread = np.hypot(columns["projected"][1], columns["differences"][1])
    spread /= np.abs(columns["differences"][0])
    print(f"\n{name}: phi, beta, t_c/tau_c = {SCENES[name][:3]}, N = {size}, {many} replicas")
    print_errors("collisions", {"": (counts, 0 * counts)})
    print_errors("d ln T/d ln A", columns)
    print_errors("over differences, %", {"projected": (100 * bias, 100 * spread)})
    print_errors("by interval, mean free times", by_interval)
    print(f"reverse minus forward, last point: {disagreement:.1e}; one tangent run {seconds:.0f} s")
    return {
        "collisions": counts.tolist(),
        "d_ln_T_d_ln_A": {n: [m.tolist(), e.tolist()] for n, (m, e) in columns.items()},
        "projected_over_differences": [bias.tolist(), spread.tolist()],
        "reverse_minus_forward": disagreement,
        "by_interval": {str(k): [m.tolist(), e.tolist()] for k, (m, e) in by_interval.items()},
        "num_particles": size,
        "replicas": many,
        "early_replicas": most,
        "late_differences": late.tolist(),  # of each replica
        "tangent_seconds": seconds,
        "seconds": time.perf_counter() - begin,
    }


def print_errors(title: str, rows: dict) -> None:
    for name, (mean, error) in rows.items():
        cells = (f"{m:+12.4g} ± {e:7.2g}" for m, e in zip(mean, error, strict=True))
        print(f"{title + ' ' + str(name):>45}{''.join(cells)}")


def over_replicas(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error over the first axis."""
    return values.mean(0), values.std(0, ddof=1) / len(values) ** 0.5


def draw(results: dict) -> Figure:
    """Draw the derivatives of two gases, their errors, and the effect of the interval."""
    figure = Figure(figsize=(10, 8), layout="constrained")
    (left, right), (errors, intervals) = figure.subplots(2, 2)
    for axes, name in zip((left, right), results, strict=False):
        draw_derivatives(axes, results[name])
        axes.set_title(f"{name} gas: d ln T / d ln A by four methods", fontsize=10, loc="left")
    left.set_ylabel("d ln T / d ln A")
    left.legend(frameon=False, fontsize=9, loc="lower left")
    for (name, result), colour, style in zip(
        results.items(),
        (INK, COLOURS["guide"], COLOURS["elastic"]),
        ("o-", "s--", "^:"),
        strict=False,
    ):
        bias, spread = (100 * np.asarray(x) for x in result["projected_over_differences"])
        n = np.asarray(result.get("collisions", COLLISIONS))[: len(bias)]
        look = {"color": colour, "ms": 5, "label": name}
        errors.errorbar(n, bias, spread, fmt=style, **look)
        if "by_interval" not in result:
            continue
        reference = np.asarray(result["d_ln_T_d_ln_A"]["differences"][0])
        at = min(3, len(reference) - 1)  # 30 collisions
        x = [float(k) for k in result["by_interval"]]
        y, e = (np.array([v[k][at] for v in result["by_interval"].values()]) for k in (0, 1))
        ratio = 100 * (y / reference[at] - 1)
        intervals.errorbar(x, ratio, 100 * np.abs(e / reference[at]), fmt=style, **look)
    for axes, title, label in (
        (errors, "Error of the projected derivative", "collisions per particle"),
        (
            intervals,
            "Error after 30 collisions, by interval",
            "mean free times between projections",
        ),
    ):
        axes.axhspan(-5, 5, color="0.92", zorder=0)
        axes.set(xscale="log", xlabel=label, ylabel="projected over differences − 1 (%)")
        axes.set_title(title, fontsize=10, loc="left")
        axes.legend(frameon=False, fontsize=9, loc="upper left")
    for axes in figure.axes:
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def draw_derivatives(axes, result: dict) -> None:
    """Draw the derivatives of one gas; write plain derivatives beyond the panel as text."""
    n = np.asarray(result["collisions"])
    styles = {
        "differences": ("o", INK, "finite differences"),
        "projected": ("^", COLOURS["soft spheres"], "projected"),
        "plain": ("x", COLOURS["hard spheres"], "plain forward mode"),
    }
    low, high = -2.2, 0.5
    for shift, (column, (marker, colour, label)) in enumerate(styles.items()):
        mean, error = (np.asarray(x) for x in result["d_ln_T_d_ln_A"][column])
        at = n[: len(mean)] * 1.08 ** (shift - 1)
        inside = (mean - error > low) & (mean + error < high)
        look = {"color": colour, "ms": 5.5, "mfc": "none" if marker == "o" else colour}
        axes.errorbar(at[inside], mean[inside], error[inside], fmt=marker, label=label, **look)
        outside = n[: len(mean)][~inside], mean[~inside], error[~inside]
        for x, m, e in zip(*outside, strict=True):
            axes.annotate(
                f"plain after {x:.0f}:\n{m:.1g} ± {e:.1g}",
                (x, high - 0.02),
                color=colour,
                fontsize=8,
                va="top",
                ha="left",
            )
    theory = np.asarray(result["d_ln_T_d_ln_A"]["kinetic theory"][0])
    colour = COLOURS["kinetic theory"]
    axes.plot(n, theory, "--", color=colour, lw=1.2, label="kinetic theory", zorder=0)
    axes.set(xscale="log", xlabel="collisions per particle", ylim=(low, high))


if __name__ == "__main__":
    main()
