"""Rows of accuracy.md: errors of values, derivatives and fits."""

from collections.abc import Callable

import numpy as np

from experiments.support.scenes import beads
from experiments.support.tables.words import Row, each, minus, percent, power

NOTE = """\
Kinetic theory leaves out clustering and three-body contacts. It computes self-diffusion for
uncorrelated collisions. The relative error is −0.85 φ for dense spheres in boxes of some hundred
spheres, and larger in larger boxes. [speed_vs_error.md](speed_vs_error.md) compares the error of T
of every model with its run time.
"""

MEMORIES = """\
## Derivatives of a clustering gas: projections that also keep the flow

d ln T/d ln A of soft spheres, φ = .3, β = .2, t_c/τ_c = .05, in boxes of 1000 spheres (1.4 L_c).
The tangents are projected onto T and the quantities in the first column, every .1 mean free time
unless the row gives another interval. The number in a row is the largest n² of the waves,
k = 2π n / box side. "Waves" means one coefficient per wave; "energy" means one coefficient for all
transverse waves of a band of n² (1; 2; 3 and 4; 5 and 6; 8 and 9), which scales the flow of the gas
in that band; "stress" is the stress caused by this flow.
"""

MEMORIES_MEAN = """\
Keeping two bands of the flow removes the bias at 30 collisions, both with one coefficient per wave
and with one per band. At 100 collisions no projection is accurate within 10 %: the derivative is
too small or has the wrong sign, and stress, heat and density correct only part of this error.
Projecting spheres in contact as well, which conserves momentum, makes the derivative too small from
the start. Fitted and carried displacements are dominated by chaos. The projections of the package
therefore keep T only; for a clustering gas use `differences=`.
"""


def off_true(i: int = 0) -> Callable[[dict], str]:
    """Return the text of the relative error of an estimate, with its standard error."""

    def words(found: dict) -> str:
        row = found["parameters"][i]
        miss, error = row["estimate"] / row["true"] - 1, row["std_err"] / row["true"]
        return f"{percent(miss)} ± {100 * error:.1f} %"

    return words


def both(found: dict) -> str:
    return f"A {off_true()(found)}, T₀ {off_true(1)(found)}"


def projected(found: dict) -> str:
    bias, error = found["projected_over_differences"]
    pairs = (f"{percent(b)} ± {100 * e:.1f}" for b, e in zip(bias, error, strict=True))
    return " / ".join(pairs) + " %"


def in_flow(scene: str) -> Callable[[dict], str]:
    """Return the text of the errors of derivatives, at times where the error is below 50 %."""

    def words(found: dict) -> str:
        one = found["scenes"][scene]
        known = [i for i, error in enumerate(one["bias"][1]) if error < 0.5]
        estimated = " / ".join(percent(one["derivative_bias"][i]) for i in known)
        parts = [
            " / ".join(f"{percent(one[key][0][i])} ± {100 * one[key][1][i]:.1f}" for i in known)
            for key in ("bias", "bias_of_differences")
        ]
        return f"projected {parts[0]} %, estimated bias {estimated} %; by differences {parts[1]} %"

    return words


def plain(found: dict) -> str:
    mean, error = found["d_ln_T_d_ln_A"]["plain"]
    right = found["d_ln_T_d_ln_A"]["differences"][0]
    words = (
        minus(f"{m:.2g} ± {e:.1g} for {r:.2g}") for m, e, r in zip(mean, error, right, strict=False)
    )
    return f"{'; '.join(words)} at 1 / 3 / 10 collisions"


def trajectory(found: dict) -> str:
    rows = found["trajectory"]["rows"]
    steps = each((row["steps"] for row in rows), "{}")
    shares = each((power(row["lammps"]) for row in rows), "{}")
    return f"{shares} of the rms velocity at {steps} steps"


def impact(found: dict) -> str:
    rows = [row for row in found["impact"]["head-on"]["rows"] if row["steps"] in (25, 50, 100)]
    mean, scatter = ([power(abs(row[key])) for row in rows] for key in ("bias", "scatter"))
    order = found["impact"]["head-on"]["order"]["bias"]
    return f"mean {each(mean, '{}')} (order {order:.1f}), scatter {each(scatter, '{}')}"


def worst(key: str) -> Callable[[dict], str]:
    return lambda found: each((power(row["worst"]) for row in found[key]["rows"]), "{}")


def lammps(found: dict) -> str:
    curves = found["curves"]
    cells = (f"{100 * curves[name]['largest_temperature_difference']:.1f}" for name in curves)
    noise = (f"{100 * float(np.max(curves[name]['standard_error'])):.1f}" for name in curves)
    names, count = " / ".join(curves), found["replicas"]
    return f"{names}: {' / '.join(cells)} % at most ({count} replicas; standard error up to " + (
        f"{' / '.join(noise)} %)"
    )


def lammps_elements(found: dict) -> str:
    rows = found["scenes"]
    cells = (f"{name} {rows[name]['rms_velocity'][-1]:.0e}" for name in rows)
    return ", ".join(cells)


def drops(found: dict) -> str:
    low, high = min(found["A_over_true"]), max(found["A_over_true"])
    return (
        f"fitted over true A {low:.2f} to {high:.2f}; intervals contain the true A in "
        f"{found['held']} of {found['runs']} runs"
    )


def posterior(found: dict) -> str:
    row = found["dissipative_constant"]
    return (
        f"mean differs from the fit's by {percent(row['mean'] / row['fit'] - 1)} %, "
        f"its error bar by {percent(row['std'] / row['fit_std'] - 1, 0)} %; "
        f"{found['samples_per_second']:.0f} samples per second"
    )


def largest(*names: str) -> Callable[[dict], str]:
    """Return the text of the largest error of each named quantity over all rows of a test."""

    def words(found: dict) -> str:
        errors = {name: max(row[name] for row in found["rows"]) for name in names or ("error",)}
        symbols = {"error": "", "temperature": "T ", "displacement": "⟨Δr²⟩ "}
        return ", ".join(f"{symbols[name]}{power(error)}" for name, error in errors.items())

    return words


def off_in(row: dict, digits: int = 1) -> str:
    """Write the relative errors of a row in per cent: -0.1 ± 0.2 / +0.3 ± 0.2."""
    misses = zip(np.atleast_1d(row["off"]), np.atleast_1d(row["error"]), strict=True)
    pairs = (f"{percent(off, digits)} ± {100 * error:.{digits}f}" for off, error in misses)
    return " / ".join(pairs)


def offs(found: dict) -> str:
    return " / ".join(off_in(row) for row in found["rows"]) + " %"


def intervals(found: dict) -> str:
    (row,) = found["rows"]
    return "cover " + " and ".join(f"{100 * share:.1f}" for share in row["coverage"]) + " %"


def hard_derivatives(found: dict) -> str:
    *below, above = found["rows"]
    estimated = " / ".join(f"{100 * share:.0f}" for share in above["told"])
    return (
        f"{'; '.join(off_in(row) for row in below)} %; {off_in(above)} % in the box above L_c, "
        f"where a flow contains part of the energy; estimated bias {estimated} %"
    )


def dsmc_million(found: dict) -> str:
    def scene(row: dict) -> str:
        return f"{row['dimension']}D, β = {row['beta']:g}: {off_in(row, 3)} %"

    return "; ".join(map(scene, found["rows"]))


def sonine(found: dict) -> str:
    rows = found["rows"]
    known = (f"{row['known']:.4f}({1e4 * row['known_error']:.0f})" for row in rows)
    return minus(", ".join(f"{row['found']:.4f}" for row in rows) + " for " + ", ".join(known))


def dsmc_order(found: dict) -> str:
    def order(shared: float, errors: bool) -> str:
        rows = [row for row in found["rows"] if row["shared"] == shared]
        tails = (f" ± {row['error']:.4f}" if errors else "" for row in rows)
        return " / ".join(minus(f"{r['off']:+.4f}{t}") for r, t in zip(rows, tails, strict=True))

    return (
        f"{order(1.0, True)} (second order; first order without pairs that share a particle: "
        f"{order(0.0, False)})"
    )


def walls(found: dict) -> str:
    def at(i: int) -> str:
        pairs = ((row["off"][i], row["error"][i]) for row in found["rows"])
        return " / ".join(minus(f"{off:+.3f} ± {error:.3f}") for off, error in pairs)

    return f"{at(0)}, and {at(1)}"


FIT = "python experiments/fit/lammps_curves.py"
HEALTH = "python experiments/accuracy/gradient_health.py --scenes"
SOFT = "python experiments/accuracy/soft_sphere_accuracy.py"
FOUND = "pytest -n 0 -m figures --record"
AT = "at 1 / 3 / 10 / 30 / 100 collisions"
SLOPE = "d ln T/d ln A through soft spheres"
CLUSTERING = beads(0.3, 0.2, 0.05)
BOX = float(CLUSTERING.box_side(1000) / CLUSTERING.critical_box)
"""Side of the box of `gradient_health.py`'s clustering gas, in L_c."""

OTHERS = ("phi003", "phi003_large", "phi010", "phi025")
"""Names of the curves of `make_lammps_curves.py`."""

ROWS = (
    Row(
        "ε of one impact (ODE)",
        "high-precision values, β ≤ 5",
        "tests/impact",
        largest(),
        f"{FOUND} tests/scene/test_contact.py",
    ),
    Row(
        "fast ε(β), β ≤ 10⁴",
        "the ODE",
        "derive_restitution",
        lambda f: power(f["largest"]["clipped"]["error"]),
        "python experiments/accuracy/derive_restitution.py",
    ),
    Row(
        "T(t), a₂, ⟨Δr²⟩ to 1000 mean free times",
        "independent solution",
        "tests/kinetic_theory",
        largest("temperature", "displacement"),
        f"{FOUND} tests/models/test_kinetic_theory.py",
    ),
    Row(
        "Haff's law over 11 decades of time",
        "closed form",
        "tests/haff",
        largest(),
        f"{FOUND} tests/theory/test_closed_forms.py",
    ),
    Row(
        "d ln T/d ln A",
        "reference table",
        "tests/derivative",
        largest(),
        f"{FOUND} tests/models/test_kinetic_theory.py",
    ),
    Row(
        "95 % intervals of A and T₀",
        "500 noisy curves",
        "tests/intervals",
        intervals,
        f"{FOUND} tests/fitting/test_fit.py",
    ),
    Row(
        "A of the dilute LAMMPS curve",
        "true A",
        "lammps_curves_dilute",
        off_true(),
        f"{FIT} --cases dilute",
    ),
    Row(
        "A of other LAMMPS curves, to which the theory was never adjusted: φ = .03 with N = 1000 "
        "and with N = 4000, φ = .1, φ = .25",
        "true A",
        " ".join(f"lammps_curves_{name}" for name in OTHERS),
        lambda *found: "; ".join(off_true()(one) for one in found),
        f"{FIT} --cases {' '.join(OTHERS)}",
    ),
    Row(
        "A of the dense LAMMPS curve, which the diagnosis rejects; with T₀ free",
        "true A",
        "lammps_curves_dense lammps_curves_dense_T0",
        lambda one, two: f"{off_true()(one)}; {off_true()(two)}",
        f"{FIT} --cases dense dense_T0",
    ),
    Row(
        "A of the dense LAMMPS curve, through soft spheres (8 runs, 3 replicas)",
        "true A",
        "lammps_curves_dense_soft_spheres",
        off_true(),
        f"{FIT} --cases dense_soft_spheres",
    ),
    Row(
        "A and T₀ of the dense curve together, through soft spheres",
        "true values",
        "lammps_curves_dense_soft_spheres_T0",
        both,
        f"{FIT} --cases dense_soft_spheres_T0",
    ),
    Row(
        "A of the dilute LAMMPS curve, through soft spheres (8 runs, 2 replicas)",
        "true A",
        "lammps_curves_dilute_soft_spheres",
        off_true(),
        f"{FIT} --cases dilute_soft_spheres",
    ),
    Row(
        "error bar of A, φ and T₀ known within 4 and 1 %",
        "posterior by NUTS",
        "sample_posterior",
        posterior,
        "python experiments/fit/sample_posterior.py",
    ),
    Row(
        "A of a simulated drop-tower experiment, 300 rough spheres between walls",
        "true A",
        "drop_tower",
        drops,
        "python experiments/fit/drop_tower.py",
    ),
    Row(
        f"{SLOPE}, dilute, {AT}",
        "finite differences",
        "gradient_health_dilute",
        projected,
        f"{HEALTH} dilute",
    ),
    Row(
        f"{SLOPE}, dense (φ = .25, t_c/τ_c = .05), {AT}",
        "finite differences",
        "gradient_health_dense",
        projected,
        f"{HEALTH} dense",
    ),
    Row(
        f"{SLOPE}, clustering (φ = .3, β = .2, box {BOX:.2g} L_c), {AT}; biased after "
        "clusters form",
        "finite differences",
        "gradient_health_clustering",
        projected,
        f"{HEALTH} clustering",
    ),
    Row(
        "d ln T/d ln A through hard spheres after 10 and 30 τ_c, (φ, β) = (.02, .2), (.2, .1); "
        "(.2, .3) in a box of 1.1 L_c",
        "finite differences",
        "tests/hard_derivatives",
        hard_derivatives,
        f"{FOUND} tests/tangents/test_impact.py",
    ),
    *(
        Row(
            f"d ln T/d ln A through hard {kind} in a box of {box} L_c, at 3 / 10 / 30 / 100 "
            "collisions, projected, and by differences of 32 replicas",
            "finite differences of more runs",
            "derivatives_in_flows",
            in_flow(scene),
            f"python experiments/accuracy/derivatives_in_flows.py --scenes {scene}",
        )
        for scene, kind, box in (("hard", "spheres", "1.1"), ("disks", "disks", "2"))
    ),
    Row(
        "d ln T/d ln A through hard spheres, φ = .01, β = .15, at 1 / 5 / 10 / 50 / 100 τ_c",
        "reference table",
        "tests/hard_sensitivity",
        offs,
        f"{FOUND} tests/tangents/test_impact.py",
    ),
    Row(
        f"{SLOPE}, dilute, by plain forward mode",
        "finite differences",
        "gradient_health_dilute",
        plain,
        f"{HEALTH} dilute",
    ),
    Row(
        "soft spheres, velocities of 64 spheres after 2 τ_c",
        "LAMMPS trajectory",
        "soft_sphere_accuracy",
        trajectory,
        SOFT,
    ),
    Row(
        "ε of one impact in soft spheres, 25 / 50 / 100 steps",
        "the ODE",
        "soft_sphere_accuracy",
        impact,
        SOFT,
    ),
    Row(
        "error of the energy balance over the initial energy, 20 / 40 / 80 steps per contact",
        "0",
        "soft_sphere_accuracy",
        worst("ledger"),
        SOFT,
    ),
    Row(
        "change of the energy of an elastic gas in 100 τ_c, 20 / 40 / 80 steps per contact",
        "0",
        "soft_sphere_accuracy",
        worst("elastic"),
        SOFT,
    ),
    Row(
        "T(t) of the LAMMPS gases, without fitted parameters",
        "LAMMPS, 3 replicas",
        "compare_lammps",
        lammps,
        "python experiments/accuracy/compare_lammps.py",
    ),
    Row(
        "velocities with friction, with walls, after one mean free time, from the same start, rms",
        "LAMMPS (granular, wall/gran); difference over √T₀",
        "compare_lammps_elements",
        lammps_elements,
        "python experiments/accuracy/compare_lammps_elements.py",
    ),
    Row(
        "D of 4096 elastic hard spheres, φ = .1 / .2 / .3, corrected for box size (Yeh & Hummer)",
        "Erpenbeck & Wood 1991, infinite box",
        "tests/diffusion_published",
        offs,
        f"{FOUND} tests/models/test_hard_spheres.py",
    ),
    Row(
        "D of 500 elastic hard spheres, φ = .1 / .2 / .3, without that correction",
        "Speedy 1987",
        "tests/diffusion_500",
        offs,
        f"{FOUND} tests/models/test_hard_spheres.py",
    ),
    Row(
        "24 hard cases: limits of laws, densities, sizes, units, tolerances and fits, and faults "
        "during a run",
        "correct results, or a clear error or status",
        "hard_cases",
        lambda f: "[table](hard_cases.md)",
        "python experiments/accuracy/hard_cases.py --heavy",
    ),
    Row(
        "T of DSMC, N = 12·10⁶, at 10 / 50 / 100 τ_c",
        "kinetic theory",
        "tests/dsmc_million",
        dsmc_million,
        f"{FOUND} tests/models/test_dsmc.py",
    ),
    Row(
        "a₂ of DSMC at constant ε = .5, .8, .9 (3D), .5, .9 (2D), 1.6·10⁶ particles",
        "tables of stochastic simulation",
        "tests/sonine",
        sonine,
        f"{FOUND} tests/models/test_dsmc.py",
    ),
    Row(
        "ln of the velocity autocorrelation after 1 τ_c (ε = .6), DSMC steps of .1 / .05",
        "steps of .0125",
        "tests/dsmc_order",
        dsmc_order,
        f"{FOUND} tests/models/test_dsmc.py",
    ),
    Row(
        "ln T of hard spheres between walls (2 mm beads, 50 mm cube, ε_w = .8, β = .15), N = 100 / "
        "500 / 4000, at T/T₀ = .5, and at .006 / .04 / .1",
        "DSMC, which assumes a homogeneous gas",
        "tests/walls",
        walls,
        f"{FOUND} tests/models/test_hard_spheres_walls.py",
    ),
)
