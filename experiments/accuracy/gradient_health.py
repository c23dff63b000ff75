"""Is the derivative of the cooling curve of a chaotic gas right, and until when?

    python experiments/accuracy/gradient_health.py [--scenes dilute dense clustering]
        [--late-differences] [--smoke] [--out DIR]

d ln T / d ln A of three gases after 1, 3, 10, 30 and 100 collisions per particle, by

- central finite differences (many replicas, the same initial states on both sides; the truncation
  error of the step is corrected by kinetic theory),
- forward mode without projection ("plain"),
- thermally projected forward and reverse mode,
- kinetic theory;

and how the projected derivative depends on the interval between projections. Standard errors are
over replicas. Prints tables, draws a picture and writes a JSON file. Scenes of an older JSON file
that are not asked for are kept in both. With --late-differences all results of a scene are kept
except the finite differences at the late times, which are computed again.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt  # noqa: E402
import numpy as np  # noqa: E402
from tqdm import tqdm  # noqa: E402

import jaxgran  # noqa: E402
from experiments.support.record import save  # noqa: E402
from experiments.support.scenes import beads  # noqa: E402

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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--late-differences", action="store_true", help="compute only these again")
    parser.add_argument("--smoke", action="store_true", help="few particles, early times only")
    parser.add_argument("--out", type=Path, default=Path("results") / "gradient_health")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    file, results = options.out / "gradient_health.json", {}
    if file.exists():  # scenes that are not asked for are kept
        results = json.loads(file.read_text())["scenes"]
    if options.late_differences and (missing := set(options.scenes) - set(results)):
        parser.error(
            f"--late-differences needs earlier results, and {file} has none of "
            f"{', '.join(sorted(missing))}: run these scenes without it first"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    for name in tqdm(options.scenes, disable=options.smoke):
        before = results.get(name) if options.late_differences else None
        results[name] = examine(name, options.smoke, before)
        settings = {"step_of_ln_A": STEP, "steps_per_contact": STEPS_PER_CONTACT}
        save(file, scenes=results, **settings, key="0; differences of set k of late replicas: k")
    draw({name: results[name] for name in SCENES if name in results}, file.with_suffix(".png"))
    print(f"written to {options.out}")


def times_of(gas: jaxgran.Gas, collisions, size: int) -> np.ndarray:
    """Times at which a particle has made so many collisions on average.

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


def examine(name: str, smoke: bool, before: dict | None) -> dict:
    """All results of a scene; given earlier ones, only the late differences are computed again."""
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
    if before is None:
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
    else:
        counts, seconds = np.asarray(before["collisions"]), before["tangent_seconds"]
        columns = arrays(before["d_ln_T_d_ln_A"])
        for kept, new in zip(columns["differences"], over_replicas(late), strict=True):
            kept[EARLY:] = new[EARLY:]
        by_interval = {float(k): v for k, v in arrays(before["by_interval"]).items()}
        disagreement = before["reverse_minus_forward"]

    print(f"\n{name}: phi, beta, t_c/tau_c = {SCENES[name][:3]}, N = {size}, ", end="")
    print(f"{many} replicas ({most} at the first {EARLY} times, {len(late)} for late differences)")
    print(f"box {float(gas.box_side(size) / gas.diameter):.3g} diameters, ", end="")
    print(f"L_c {float(gas.critical_box / gas.diameter):.3g}")
    print(f"{'collisions':>11}" + "".join(f"{column:>24}" for column in columns))
    for i in range(len(times)):
        print(f"{counts[i]:11.1f}", end="")
        print("".join(f"{m[i]:+14.4g} ± {e[i]:7.2g}" for m, e in columns.values() if i < len(m)))
    bias = columns["projected"][0] / columns["differences"][0] - 1
    spread = np.hypot(columns["projected"][1], columns["differences"][1])
    spread /= np.abs(columns["differences"][0])
    print("projected over differences: ", end="")
    print(", ".join(f"{100 * b:+.1f} ± {100 * e:.1f} %" for b, e in zip(bias, spread, strict=True)))
    print(f"reverse minus forward, last point: {disagreement:.1e}; one tangent run {seconds:.0f} s")
    print("interval between projections, in mean free times:")
    for interval, (mean, error) in by_interval.items():
        print(f"{interval:11.2g}", end="")
        print("".join(f"{m:+14.4g} ± {e:7.2g}" for m, e in zip(mean, error, strict=True)))
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


def arrays(columns: dict) -> dict[str, tuple[np.ndarray, ...]]:
    """Means and standard errors from a JSON file."""
    return {name: tuple(map(np.asarray, values)) for name, values in columns.items()}


def over_replicas(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error over the first axis."""
    return values.mean(0), values.std(0, ddof=1) / len(values) ** 0.5


def draw(results: dict, path: Path) -> None:
    figure, axes = plt.subplots(2, len(results), figsize=(4.2 * len(results), 7), squeeze=False)
    styles = {
        "differences": ("o", "finite differences"),
        "plain": ("x", "plain forward mode"),
        "projected": ("s", "projected"),
        "kinetic theory": ("", "kinetic theory"),
    }
    for (name, result), (top, bottom) in zip(results.items(), axes.T, strict=True):
        n = np.asarray(result["collisions"])
        for shift, (column, (marker, label)) in enumerate(styles.items()):
            mean, error = (np.asarray(x) for x in result["d_ln_T_d_ln_A"][column])
            if column == "kinetic theory":
                top.plot(n, mean, "k--", lw=1, label=label)
                continue
            at = n[: len(mean)] * 1.06 ** (shift - 1)
            top.errorbar(at, mean, error, fmt=marker, ms=5, label=label)
        top.set(xscale="log", title=name, xlabel="collisions per particle", ylim=(-2.2, 0.7))
        reference = np.asarray(result["d_ln_T_d_ln_A"]["differences"][0])
        for i, goal in enumerate(COLLISIONS[: len(n)]):
            x = [float(k) for k in result["by_interval"]]
            y, e = zip(*((m[i], s[i]) for m, s in result["by_interval"].values()), strict=True)
            ratio = np.asarray(y) / reference[i] - 1
            bottom.errorbar(
                np.asarray(x) * 1.03**i,
                100 * ratio,
                100 * np.abs(np.asarray(e) / reference[i]),
                fmt="o-",
                ms=3,
                label=f"{goal:.0f}",
            )
        bottom.axhspan(-5, 5, color="0.9", zorder=0)
        bottom.set(xscale="log", xlabel="mean free times between projections")
        low, high = bottom.get_ylim()
        bottom.set_ylim(min(low, -30), max(high, 70))
    axes[0, 0].set_ylabel("d ln T / d ln A")
    axes[0, 0].legend(fontsize=8)
    axes[1, 0].set_ylabel("projected over differences, %")
    axes[1, 0].legend(title="collisions", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
