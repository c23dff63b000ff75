"""Are derivatives accurate in a gas with a flow, is their bias estimated, and do differences help?

    python experiments/accuracy/derivatives_in_flows.py [--scenes hard disks] [--smoke] [--record]
        [--out DIR]

d ln T / d ln A of gases in boxes longer than L_c, after 3, 10, 30 and 100 collisions per particle:

- reference: central differences of runs over many sets of replicas with separate keys; kinetic
  theory corrects the truncation error of the step;
- projected derivatives, and the estimate of their bias (`CoolingCurve.derivative_bias`);
- derivatives by differences of one set (``differences=0.3``), with another key.

Standard errors are over replicas. Relative biases mean little at times when ln T hardly depends on
A. Also prints the run time of derivatives, forward and reverse, over that of a run without them.
"""

import time
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.record import script_parser, write_picture, write_results
from experiments.support.scenes import beads
from jaxgran.plotting import COLOURS, INK

COLLISIONS = (3.0, 10.0, 30.0, 100.0)
STEP = 0.3  # of ln A, to either side
# packing fraction, beta_T0, dimension, particles in a box, replicas, sets of the reference
SCENES = {"hard": (0.2, 0.3, 3, 500, 32, 6), "disks": (0.25, 0.3, 2, 300, 32, 12)}
WORDS = {"hard": "hard spheres", "disks": "hard disks"}
POINTS = 40  # times from which the flow is known


def main() -> None:
    parser = script_parser(__doc__, "derivatives_in_flows")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = {name: examine(name, options.smoke) for name in options.scenes}
    write_picture(draw(results), "derivatives_in_flows", options)
    file = options.out / "derivatives_in_flows.json"
    write_results("derivatives_in_flows", options, file, step_of_ln_A=STEP, scenes=results)


def times_of(gas: jaxgran.Gas, model: jaxgran.HardSpheres, last: float) -> np.ndarray:
    """Return times until a particle has made the last number of collisions, measured by a run."""
    times = float(gas.mean_free_time) * np.geomspace(0.3, 60 * last, POINTS)
    counts = jaxgran.cool(gas, times, model=model, progress=False).collisions
    assert counts is not None
    end = np.exp(np.interp(np.log(last), np.log(counts), np.log(times)))
    return np.geomspace(times[0], end, POINTS)


def examine(name: str, smoke: bool) -> dict:
    """Compute all results of a scene."""
    phi, beta, dimension, size, replicas, sets = SCENES[name]
    gas = beads(phi, beta, 0.01, dimension)
    collisions = COLLISIONS[:2] if smoke else COLLISIONS
    if smoke:
        size, replicas, sets = 60, 2, 1
    model = jaxgran.HardSpheres(size, replicas=replicas)
    times = times_of(gas, replace(model, replicas=2), collisions[-1])
    constant = gas.value("dissipative_constant")

    def log_temperatures(log_scale, model, seed=0):
        changed = gas.replace(dissipative_constant=constant * jnp.exp(log_scale))
        key = jax.random.key(seed)
        curve = jaxgran.cool(changed, times, model=model, key=key, progress=False)
        assert curve.replicas is not None
        return jnp.log(curve.replicas.temperature), curve

    def forward(model, seed=0):
        f = partial(log_temperatures, model=model, seed=seed)
        _, slopes, curve = jax.jvp(f, (0.0,), (1.0,), has_aux=True)
        return np.asarray(slopes), curve

    def theory(log_scale):
        changed = gas.replace(dissipative_constant=constant * jnp.exp(log_scale))
        return jnp.log(jaxgran.cool(changed, times).temperature)

    truncation = (theory(STEP) - theory(-STEP)) / (2 * STEP) - jax.jvp(theory, (0.0,), (1.0,))[1]
    each = []
    for seed in range(1, sets + 1):
        ends = [np.asarray(log_temperatures(s * STEP, model, seed)[0]) for s in (1, -1)]
        each.append((ends[0] - ends[1]) / (2 * STEP) - np.asarray(truncation))
    projected, curve = forward(model)
    by_differences, _ = forward(replace(model, differences=STEP))
    counts = np.asarray(curve.collisions)
    at = [int(np.argmin(np.abs(counts - n))) for n in collisions]
    columns = {
        "reference": over_replicas(np.concatenate(each)[:, at]),
        "projected": over_replicas(projected[:, at]),
        "differences": over_replicas(by_differences[:, at]),
    }
    found = {
        "box_over_critical": float(gas.box_side(size) / gas.critical_box),
        "num_particles": size,
        "replicas": replicas,
        "sets": sets,
        "collisions": counts[at].tolist(),
        "d_ln_T_d_ln_A": {k: [m.tolist(), e.tolist()] for k, (m, e) in columns.items()},
        "flow_share": np.asarray(curve.flow_share)[at].tolist(),
        "bias": [x.tolist() for x in bias(columns, "projected")],
        "bias_of_differences": [x.tolist() for x in bias(columns, "differences")],
        "derivative_bias": np.asarray(curve.derivative_bias)[at].tolist(),
        "costs": costs(lambda s, model: log_temperatures(s, model)[0], model),
    }
    print_scene(name, found)
    return found


def over_replicas(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard error over the first axis."""
    return values.mean(0), values.std(0, ddof=1) / len(values) ** 0.5


def bias(columns: dict, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative difference of a derivative from the reference, and its standard error."""
    (mean, error), (true, spread) = columns[name], columns["reference"]
    return mean / true - 1, np.hypot(error, spread * mean / true) / np.abs(true)


def costs(f, model: jaxgran.HardSpheres) -> dict[str, float]:
    """Return the run time of derivatives over that of a run, from the second of two calls each."""

    def took(call):
        call()
        begin = time.perf_counter()
        jax.block_until_ready(call())
        return time.perf_counter() - begin

    run, found = took(lambda: f(0.0, model)), {}
    for kind, own in (("projected", model), ("differences", replace(model, differences=STEP))):
        found[f"{kind}, forward"] = took(
            lambda own=own: jax.jvp(lambda s: f(s, own), (0.0,), (1.0,))[1]
        )
        found[f"{kind}, reverse"] = took(
            lambda own=own: jax.grad(lambda s: jnp.sum(f(s, own)[:, -1]))(0.0)
        )
    return {kind: seconds / run for kind, seconds in found.items()} | {"run_s": run}


def print_scene(name: str, found: dict) -> None:
    """Print the table of a scene."""
    sizes = f"N = {found['num_particles']} ({found['box_over_critical']:.2f} L_c)"
    print(f"\n{name}: phi, beta = {SCENES[name][:2]}, {sizes}, {found['replicas']} replicas")
    titles = ("reference", "projected", "differences=0.3", "projected over", "estimated bias")
    print(f"{'collisions':>11}" + "".join(f"{title:>20}" for title in titles))
    for i, n in enumerate(found["collisions"]):
        print(f"{n:11.1f}", end="")
        for mean, error in found["d_ln_T_d_ln_A"].values():
            print(f"{mean[i]:+12.4f} ± {error[i]:5.4f}", end="")
        (b, e), estimated = (x[i] for x in found["bias"]), found["derivative_bias"][i]
        print(f"{100 * b:+11.1f} ± {100 * e:4.1f} %{100 * estimated:+18.1f} %")
    words = ", ".join(f"{kind} {x:.2f}" for kind, x in found["costs"].items() if kind != "run_s")
    print(f"cost in runs of {found['costs']['run_s']:.1f} s: {words}")


def draw(results: dict) -> Figure:
    """Draw the derivatives of each gas by three methods, and the band of the estimated bias."""
    figure = Figure(figsize=(5 * len(results), 4), layout="constrained")
    looks = {
        "reference": ("o", INK, "differences of many runs"),
        "projected": ("^", COLOURS["soft spheres"], "projected"),
        "differences": ("s", COLOURS["hard spheres"], "by differences"),
    }
    for axes, (name, found) in zip(
        np.ravel(figure.subplots(1, len(results), squeeze=False)), results.items(), strict=True
    ):
        n = np.array(found["collisions"])
        for shift, (kind, (marker, colour, label)) in enumerate(looks.items()):
            mean, error = found["d_ln_T_d_ln_A"][kind]
            fill = "none" if kind == "reference" else colour
            look = {"fmt": marker, "color": colour, "mfc": fill, "ms": 6, "label": label}
            axes.errorbar(n * 1.08 ** (shift - 1), mean, error, **look)
        slope = np.array(found["d_ln_T_d_ln_A"]["projected"][0])
        freed = slope / (1 + np.array(found["derivative_bias"]))
        label = "projected, minus its estimated bias"
        axes.plot(n, freed, "--", color=COLOURS["soft spheres"], lw=1.2, label=label, zorder=0)
        axes.set(xscale="log", xlabel="collisions per particle", ylabel="d ln T / d ln A")
        title = f"{WORDS[name]} in a box of {found['box_over_critical']:.1f} $L_c$"
        axes.set_title(title, fontsize=10, loc="left")
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].legend(frameon=False, fontsize=9, loc="upper right")
    return figure


if __name__ == "__main__":
    main()
