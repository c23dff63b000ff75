"""Rows of speed.md: run times, memory and compilation."""

from collections.abc import Callable

from experiments.support.tables import million
from experiments.support.tables.words import Row, between, each, of, thousands

NOTE = """\
## Speed against error

[speed_vs_error.md](speed_vs_error.md) gives the largest error of T over a whole curve and the run
time without compilation, for every model and several values of its settings
([picture](pictures/speed_vs_error.png)). The reference of the dilute and the dense gas is the
LAMMPS curve, without fitted parameters; the reference of the clustering gas (φ = .2, β = .5,
t_c/τ_c = .02, to 60 τ_c) is 12 × 12 000 soft spheres with 80 steps per contact. Models have four
replicas of N particles. The largest error of 30 to 60 noisy points is about two standard errors
even for an exact model; fewer particles mean a smaller box. The noise that `choose_model` estimates
is shot noise and the noise of the few waves of a growing flow; it agrees with the scatter of runs
of three gases in two boxes each
(`pytest -m "slow or not slow" tests/models/test_selection.py -k noise`).

For a dilute gas in a box below L_c use kinetic theory: no model is better by more than a fraction
of its own noise and 1 %. If contacts last long or overlap, or the box is longer than L_c, use soft
spheres with 10 to 20 steps per contact, and spend run time on particles rather than on steps. Hard
spheres of the same N take a seventh to two fifths of that time, and are accurate if contacts are
short. float32 has no visible loss of accuracy here.
"""

SOFT = "python experiments/speed/benchmark_particles.py"
HARD = "python experiments/speed/benchmark_hard_spheres.py"
THEORY = "python experiments/speed/benchmark_kinetic_theory.py"
SLOPES = "python experiments/speed/benchmark_derivatives.py"
HEADS = "python experiments/fit/fit_head_to_head.py"


def against_lammps(fraction: float, ranks: str) -> Callable[[dict], str]:
    def words(found: dict) -> str:
        rows = of(found["rows"], contact_fraction=fraction)
        ratios = each((row["lammps"][ranks]["ratio"] for row in rows), "{:.1f}×")
        rates = each((thousands(row["collisions_per_s"]) for row in rows), "{}")
        return f"{ratios} as fast ({rates} collisions/s)" if ranks == "1" else ratios

    return words


def hard(found: dict) -> str:
    rows = of(found["rows"], dimension=3)
    ratios = each((row["lammps"]["ratio"] for row in rows), "{:.1f}×")
    rates = each((thousands(row["collisions_per_s"]) for row in rows), "{}")
    set_up = each((1e3 * row["set_up_s"] for row in rows), "{:.0f}")
    return (
        f"{ratios} as fast ({rates} collisions/s; measured alternately; set-up, {set_up} ms, left "
        "out on both sides)"
    )


def disks(found: dict) -> str:
    rows = of(found["rows"], dimension=2)
    return f"{each((thousands(row['collisions_per_s']) for row in rows), '{}')} collisions/s"


def slopes(found: dict) -> str:
    rows = [row for row in found["rows"] if row["title"].startswith("Soft")]
    forward, reverse = (
        "; ".join(f"{row['ways'][way]['ratio']:.1f}×" for row in rows)
        for way in ("forward, A", "reverse, A")
    )
    return f"forward {forward}, reverse {reverse}"


def slopes_of_dsmc(found: dict) -> str:
    (row,) = [row for row in found["rows"] if row["title"].startswith("DSMC")]
    forward, reverse = (row["ways"][way]["ratio"] for way in ("forward, A", "reverse, A"))
    return f"forward {forward:.1f}×, reverse {reverse:.1f}×"


def memory(found: dict) -> str:
    rows = found["memory"]["rows"]
    return f"{each((row['peak_MiB'] - row['before_MiB'] for row in rows), '{:.0f}')} MiB"


def elements(model: str) -> Callable[[dict], str]:
    def words(found: dict) -> str:
        rows = [r for r in found["rows"] if r["model"] == model and r["scene"] != "smooth"]
        return ", ".join(
            f"{row['scene']} {row['ratio']:.2f}×"
            + (
                ""
                if row["ratio_of_contacts"] == row["ratio"]
                else f" ({row['ratio_of_contacts']:.2f}×)"
            )
            for row in rows
        )

    return words


def versions(found: dict) -> str:
    rows = [row for row in found["rows"] if row["model"] in ("DSMC", "HardSpheres", "SoftSpheres")]
    return " / ".join(f"{row['ratio']:.2f} ± {row['error']:.2f}" for row in rows)


def dsmc(found: dict) -> str:
    rates = (row["collisions_per_s"] / 1e6 for row in found["rows"])
    return f"{each(rates)} million collisions/s"


def replicas(found: dict) -> str:
    return ", ".join(f"{row['model']} {row['ratio']:.2f}×" for row in found["rows"])


def sweep(found: dict) -> str:
    row = found["sweep"]
    return f"{row['ratio_scipy_over_vmap']:.0f}× faster ({row['vmap_run_s']:.2f} s)"


def one_slope(found: dict) -> str:
    row = found["derivative"]
    ratios = between((row["ratio_forward"], row["ratio_reverse"]), "{:.1f}")
    batches = row["ratio_forward_in_batches_of_100"]
    return f"{ratios}×, {batches:.1f}× in batches of 100 (a solve takes {row['solve_ms']:.1f} ms)"


def cold(found: dict) -> str:
    row = found["cold"]
    return f"{row['import_s']:.1f} s; {row['main_job_s']:.0f} s"


def heads(scene: str) -> Callable[[dict], str]:
    def words(found: dict) -> str:
        parts = []
        for count, name in ((1, "A"), (2, "A and T₀")):
            rows = [row for row in of(found["rows"], scene=scene) if len(row["free"]) == count]
            runs = (f"{row['simulations'] or 'never'} by {row['search']}" for row in rows)
            parts.append(f"{name}: {', '.join(runs)}")
        return "; ".join(parts)

    return words


SIZES = "N = 1000 / 4096 / 32768"
ROWS = (
    Row(
        f"soft spheres, φ = .1, t_c/τ_c = .01, {SIZES}",
        "LAMMPS, one core, same run",
        "benchmark_particles",
        against_lammps(0.01, "1"),
        SOFT,
    ),
    Row(
        f"soft spheres, φ = .1, t_c/τ_c = .003, {SIZES}",
        "LAMMPS, one core",
        "benchmark_particles",
        against_lammps(0.003, "1"),
        SOFT,
    ),
    Row(
        f"soft spheres, φ = .1, t_c/τ_c = .01; .003, {SIZES}",
        "LAMMPS, two cores",
        "benchmark_particles",
        lambda f: f"{against_lammps(0.01, '2')(f)}; {against_lammps(0.003, '2')(f)}",
        SOFT,
    ),
    Row(
        "soft spheres, 8 gases of N = 1000 with different A, vmap",
        "one after another",
        "benchmark_particles",
        lambda f: (
            f"{f['sweep']['ratio']:.2f} of the time (the equilibration, 10 of 12 τ_c, is common)"
        ),
        SOFT,
    ),
    Row(
        "hard spheres, φ = .1, N = 1000 / 4096 / 16384 / 50000",
        "LAMMPS, one core, t_c/τ_c = .01, same run",
        "benchmark_hard_spheres",
        hard,
        HARD,
    ),
    Row(
        "hard disks, φ = .2, N = 1000 / 4096 / 16384 / 50000",
        "",
        "benchmark_hard_spheres",
        disks,
        HARD,
    ),
    Row(
        "50 000 hard disks, φ = .2, ε = .9, 100 collisions per disk, until they cluster",
        "",
        "benchmark_hard_spheres_until",
        lambda f: f"{f['run_s']:.0f} s with compilation",
        f"{HARD} --until 100",
    ),
    *million.ROWS,
    Row(
        "1000 curves of 5 decades, vmap",
        "SciPy LSODA loop, same accuracy",
        "benchmark_kinetic_theory",
        sweep,
        THEORY,
    ),
    Row(
        "one derivative of kinetic theory, forward or reverse",
        "one solve",
        "benchmark_kinetic_theory",
        one_slope,
        THEORY,
    ),
    Row(
        "a derivative in A through soft spheres, N = 4096, t_c/τ_c = .01; .1",
        "the plain run",
        "benchmark_derivatives",
        slopes,
        SLOPES,
    ),
    Row(
        "a derivative in A through DSMC, N = 10⁵",
        "the plain run",
        "benchmark_derivatives",
        slopes_of_dsmc,
        SLOPES,
    ),
    Row(
        "peak memory that reverse mode adds, 1 / 10 / 100 / 1000 blocks",
        "one stored state per block: .2 / 2 / 19 / 188 MiB",
        "benchmark_derivatives",
        memory,
        SLOPES,
    ),
    Row(
        "DSMC, N = 10⁴ / 10⁵ / 10⁶",
        "",
        "benchmark_dsmc",
        dsmc,
        "python experiments/speed/benchmark_dsmc.py",
    ),
    Row(
        "two replicas of N = 4096 on two CPU devices, collisions per second",
        "both on one core",
        "benchmark_replicas",
        replicas,
        "python experiments/speed/benchmark_replicas.py",
    ),
    Row(
        "rough spheres, walls: hard spheres, N = 4096",
        "smooth gas, time per collision (time per contact, walls included)",
        "benchmark_elements",
        elements("hard spheres"),
        "python experiments/speed/benchmark_elements.py",
    ),
    Row(
        "walls, drag, friction: soft spheres, N = 2000",
        "smooth gas, time per collision (time per contact, walls included)",
        "benchmark_elements_soft",
        elements("soft spheres"),
        "python experiments/speed/benchmark_elements.py --soft",
    ),
    Row(
        "a smooth periodic gas: DSMC N = 10⁵, hard spheres N = 4096, soft spheres N = 2000",
        "the version before scenes had elements, run alternately",
        "benchmark_versions",
        versions,
        "python experiments/speed/benchmark_versions.py CHECKOUT",
    ),
    Row(
        "rough spheres, walls, drag: DSMC, N = 10⁵",
        "smooth gas, time per collision (time per contact, walls included)",
        "benchmark_elements",
        elements("DSMC"),
        "python experiments/speed/benchmark_elements.py",
    ),
    Row(
        "rough spheres, walls, drag: kinetic theory",
        "smooth gas, time per run",
        "benchmark_elements",
        elements("kinetic theory"),
        "python experiments/speed/benchmark_elements.py",
    ),
    Row(
        "runs until A is known to 2 %, DSMC of the dense gas",
        "searches without derivatives",
        "fit_head_to_head",
        heads("stochastic"),
        HEADS,
    ),
    Row(
        "runs until A is known to 2 %, soft spheres, dense LAMMPS curve",
        "searches without derivatives",
        "fit_head_to_head",
        heads("soft-spheres"),
        HEADS,
    ),
    Row(
        "`import jaxgran`; the whole fit of the README, without cached programs",
        "",
        "benchmark_kinetic_theory",
        cold,
        THEORY,
    ),
)
