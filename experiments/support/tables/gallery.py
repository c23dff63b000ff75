"""Entries of the gallery in README.md: one question, one finding, one picture, one time."""

from collections.abc import Callable
from typing import NamedTuple

from experiments.accuracy.flow_memory import within_bounds
from experiments.support.tables.accuracy import off_true
from experiments.support.tables.words import between, minus, of, percent, power

KINETIC = ("KineticTheory", "forward", "reverse")
"""Rows of kinetic theory in `benchmark_versions.py`."""

MOST_WORDS = 15
"""Of a finding."""


class Entry(NamedTuple):
    """A script of the gallery.

    Attributes:
        script: its path in experiments/.
        question: that it answers.
        source: the file in figures/, without its end; "" for none.
        finding: in 15 words or less, out of the contents of that file.
        picture: in pictures/, or "".
        time: on two cores.
        table: a document with the details, or "".
    """

    script: str
    question: str
    source: str
    finding: Callable[[dict], str]
    picture: str
    time: str
    table: str = ""


def dilute(f: dict) -> str:
    return f"Of the dilute curve A comes out {off_true()(f)} from the true one."


def wrong(f: dict) -> str:
    off = [row["A"] for row in f["rows"] if not row["name"].startswith("nothing")]
    return f"A is off by factors of {between(off)}; its range over rivals holds it."


def drop(f: dict) -> str:
    return f"Told of walls and roughness, its interval holds A in {f['held']} of {f['runs']} runs."


def devices(f: dict) -> str:
    ratios = between((row["ratio"] for row in f["rows"]), "{:.2f}")
    return f"Two replicas are {ratios} times as fast as on one core."


def million(f: dict) -> str:
    row = next(row for row in f["rows"] if "clusters" in row)
    case = row["clusters"]
    took = (case["melt_s"] + case["run_s"]) / 60
    return f"Hard disks: {took:.0f} minutes and {case['peak_GiB']:.1f} GiB on two cores."


def coverage(f: dict) -> str:
    return f"In {between((100 * row['coverage'] for row in f['rows']), '{:.0f}')} % of single runs."


def in_clusters(f: dict) -> str:
    return f"In {f['held']} of {f['runs']} LAMMPS runs, with derivatives by differences."


def posterior(f: dict) -> str:
    row = f["dissipative_constant"]
    return f"Yes: its width differs by {percent(row['std'] / row['fit_std'] - 1, 0)} %."


def heads(f: dict) -> str:
    rows = [row for row in of(f["rows"], scene="stochastic") if len(row["free"]) == 2]
    ours, simplex = (
        next(row["simulations"] for row in rows if row["search"].startswith(name))
        for name in ("jaxgran", "Nelder")
    )
    return f"A and T₀ take {ours} runs of DSMC with derivatives, {simplex} by Nelder–Mead."


def health(f: dict) -> str:
    bias, _ = f["projected_over_differences"]
    return f"To {max(abs(100 * x) for x in bias):.0f} % until 100 collisions; not in clusters."


def in_flows(f: dict) -> str:
    found = f["scenes"]["hard"]
    bias = [100 * x for x in found["bias"][0]]
    left = max(abs(100 * x) for x in found["bias_of_differences"][0])
    too_large = between(bias, "{:.0f}")
    return f"Projected ones are {too_large} % too large, differences within {left:.0f} %."


def memories(f: dict) -> str:
    rows = f["memories"]
    right = [name for name, row in rows.items() if within_bounds(row)]
    if right:
        return f"{right[0][0].upper()}{right[0][1:]}, within 10 % until 100 collisions."
    return f"None of {len(rows)} is shown to be right within 10 % at 100 collisions."


def lammps(f: dict) -> str:
    found = f["curves"]["dense"]["largest_temperature_difference"]
    return f"Within {100 * found:.1f} % in the dense gas, with nothing fitted."


def lammps_elements(f: dict) -> str:
    most = max(row["rms_velocity"][-1] for row in f["scenes"].values())
    return f"Velocities differ by at most {most:.0e} of √T₀ after a mean free time."


def soft(f: dict) -> str:
    order = f["impact"]["head-on"]["order"]["bias"]
    return f"ε of an impact errs with the step to the power {order:.1f}."


def theory(f: dict) -> str:
    return f"A thousand curves take {f['sweep']['vmap_run_s']:.2f} s."


def particles(f: dict) -> str:
    ratios = [row["lammps"]["1"]["ratio"] for row in f["rows"]]
    return f"{between(ratios, '{:.1f}')} times LAMMPS on one core."


def hard(f: dict) -> str:
    ratios = [row["lammps"]["ratio"] for row in f["rows"] if row["lammps"]]
    return f"{between(ratios, '{:.0f}')} times LAMMPS at short contacts."


def dsmc(f: dict) -> str:
    rates = [row["collisions_per_s"] / 1e6 for row in f["rows"]]
    return f"{between(rates, '{:.1f}')} million collisions a second."


def versions(f: dict) -> str:
    rows = [row["ratio"] for row in f["rows"] if not row["model"].startswith(KINETIC)]
    return f"Particle runs take {between(rows, '{:.2f}')} times as long."


def elements(f: dict) -> str:
    most = max(f["rows"], key=lambda row: row["ratio"])
    return f"At most {most['ratio']:.1f} times ({most['scene']}, {most['model']})."


def slopes(f: dict) -> str:
    ratios = [row["ways"]["reverse, A"]["ratio"] for row in f["rows"]]
    return f"Reverse mode takes {between(ratios, '{:.1f}')} runs, in constant memory."


def front(f: dict) -> str:
    rows = of(f["scenes"]["dilute"]["rows"], model="kinetic theory")
    error = between(100 * row["error"] for row in rows)
    return f"Dilute: kinetic theory, {error} % in milliseconds; dense: soft spheres."


def constant(f: dict) -> dict:
    return f["scenes"]["phi = 0.245, e = 0.9"]["constant"]["departures"]


def clustering(f: dict) -> str:
    n, error = constant(f)["T over theory's of N by 2"]["N"]
    return f"T doubles after {n:.1f} ± {error:.1f} collisions; viscoelastic gases need more."


def dissolves(f: dict) -> str:
    uneven = f["viscoelastic"]["unevenness"]
    return f"Yes: unevenness peaks at {max(uneven):.0f}, ends at {uneven[-1]:.1f} times elastic."


def film(f: dict) -> str:
    flow, density = (
        next(
            n
            for n, x in zip(f["collisions"], f[name], strict=True)
            if sum(x[:3]) > 30 * sum(f[name][0][:3])
        )
        for name in ("across", "S")
    )
    return f"The flow is 30 times itself after {flow:.0f} collisions, S(k) after {density:.0f}."


def compilation(f: dict) -> str:
    rows = f["rows"]
    soft, hard, dsmc = (rows[name]["first_s"] for name in ("SoftSpheres", "HardSpheres", "DSMC"))
    first, again = f["main_job"]["first_s"], f["main_job"]["again_s"]
    runs = f"Soft, hard spheres, DSMC {soft:.0f}, {hard:.0f}, {dsmc:.0f} s"
    return f"{runs}; fit {first:.0f} s, again {again:.1f} s."


def cooling(f: dict) -> str:
    last = list(f["found"]["viscoelastic"]["exponent"].values())[-1]
    other = list(f["found"]["constant"]["exponent"].values())[-1]
    return minus(f"T falls as t^{last:.3f} and t^{other:.3f} after 10⁶ τ_c.")


def velocities(f: dict) -> str:
    row = f["found"]["viscoelastic"]
    return (
        "Nearly exponentially in collisions, not in time; τ_v/τ_E is "
        f"{row['dsmc']['relaxation']:.3f}, printed {row['paper_relaxation']:.3f}."
    )


def coefficient(f: dict) -> str:
    row = f["found"]["constant"]
    return f"No: it is {row['by_slope'][-1]:.2f} T τ_E, printed {row['paper'][-1]:.2f}."


def spread(f: dict) -> str:
    row = f["found"]["viscoelastic"]
    return f"Towards t^(1/6): the exponent is {row['exponent'][-1]:.3f} after 10⁶ τ_c."


def exponents(f: dict) -> str:
    last = minus(f"{f['found']['ice']['exponent']:.2f}")
    return f"As t^(−2/(1+γ)); of ice the exponent is {last} at last."


def restitution(f: dict) -> str:
    limit = f["found"]["two_terms_good_to_one_per_cent"]["F = 0"]
    return f"Two terms hold to 1 % up to β = {limit:.2f}."


def claims(f: dict) -> str:
    agree = sum(row["verdict"] == "agree" for row in f["rows"])
    return f"{agree} of {len(f['rows'])} agree; the others are corrected."


def derived(f: dict) -> str:
    return (
        f"A fit to the equation of motion, right within {power(f['largest']['clipped']['error'])}."
    )


def states(f: dict) -> str:
    off = {
        k: max(
            100 * abs(row["off"][k] / row["simulated"][k])
            for row in f["states"]
            if abs(row["simulated"][k]) > least
        )
        for k, least in ((0, 0.01), (1, 0.003), (2, 0.0))
    }
    return f"Within {off[0]:.1f}, {off[1]:.0f} and {off[2]:.1f} %, for ε from 0 to 1."


def correlations(f: dict) -> str:
    rows = [row for row in f["rows"] if "h" in row]
    rates = [100 * (1 - row["rate"]) for row in rows]
    off = max(abs(100 * (row["theory"] - row["rate"])) for row in rows)
    return f"By {min(rates):.1f} to {max(rates):.0f} %; theory is at most {off:.1f} % off."


ENTRIES = {
    "Fits": (
        Entry(
            "fit/lammps_curves.py",
            "Which A explains a measured cooling curve?",
            "lammps_curves_dilute",
            dilute,
            "fit_dilute.png",
            "40 s; soft spheres 3 min each",
        ),
        Entry(
            "fit/wrong_physics.py",
            "What does a fit say of physics that it does not know?",
            "wrong_physics",
            wrong,
            "wrong_physics.png",
            "3 min",
            "wrong_physics.md",
        ),
        Entry(
            "fit/drop_tower.py",
            "What could a published drop-tower experiment say about A?",
            "drop_tower",
            drop,
            "drop_tower.png",
            "80 s",
        ),
        Entry(
            "fit/interval_coverage.py",
            "How often does a 95 % interval of A hold the truth?",
            "interval_coverage",
            coverage,
            "interval_coverage.png",
            "30 min",
            "interval_coverage.md",
        ),
        Entry(
            "fit/coverage_in_clusters.py",
            "And where the gas clusters?",
            "coverage_in_clusters",
            in_clusters,
            "coverage_in_clusters.png",
            "20 min",
            "interval_coverage.md",
        ),
        Entry(
            "fit/sample_posterior.py",
            "Is the error bar of a fit that of the posterior?",
            "sample_posterior",
            posterior,
            "sample_posterior.png",
            "1 to 3 min",
        ),
        Entry(
            "fit/fit_head_to_head.py",
            "How many simulations does a fit need, with and without derivatives?",
            "fit_head_to_head",
            heads,
            "fit_head_to_head.png",
            "8 min",
            "speed.md",
        ),
        Entry(
            "fit/own_model.py",
            "How do I add a model of my own?",
            "",
            lambda f: "A class with six members works in cool, choose_model, fit and diagnose.",
            "own_model.png",
            "15 s",
        ),
    ),
    "Accuracy": (
        Entry(
            "accuracy/compare_lammps.py",
            "Do soft spheres cool as in LAMMPS, without fitted parameters?",
            "compare_lammps",
            lammps,
            "compare_lammps.png",
            "2 min",
        ),
        Entry(
            "accuracy/compare_lammps_elements.py",
            "Do friction and walls move spheres as in LAMMPS, particle by particle?",
            "compare_lammps_elements",
            lammps_elements,
            "compare_lammps_elements.png",
            "5 min",
        ),
        Entry(
            "accuracy/gradient_health.py",
            "Is the derivative of a chaotic gas right, and until when?",
            "gradient_health_dilute",
            health,
            "gradient_health.png",
            "12 min; clustering 100 min",
            "accuracy.md",
        ),
        Entry(
            "accuracy/derivatives_in_flows.py",
            "Are derivatives right where a gas has a flow, or does the curve say?",
            "derivatives_in_flows",
            in_flows,
            "derivatives_in_flows.png",
            "5 min",
            "accuracy.md",
        ),
        Entry(
            "accuracy/flow_memory.py",
            "Which memory of its flow would make projected ones right?",
            "flow_memory",
            memories,
            "flow_memory.png",
            "60 min",
            "accuracy.md",
        ),
        Entry(
            "accuracy/soft_sphere_accuracy.py",
            "How large are the errors of soft spheres, and of which order?",
            "soft_sphere_accuracy",
            soft,
            "soft_sphere_accuracy.png",
            "2 min",
        ),
        Entry(
            "accuracy/hard_cases.py",
            "In which limits do simulations fail, and does jaxgran?",
            "hard_cases",
            lambda f: "24 limits: right answers within tolerances, or clear errors.",
            "hard_cases.png",
            "9 to 18 min",
            "hard_cases.md",
        ),
        Entry(
            "accuracy/derive_restitution.py",
            "Where do the coefficients of the fitted ε(β) come from?",
            "derive_restitution",
            derived,
            "derive_restitution.png",
            "10 s",
        ),
        Entry(
            "accuracy/derive_softness.py",
            "How much slower do two soft spheres cool, c(β)?",
            "",
            lambda f: "0.969 (d − 1) as β → 0, and less the more they dissipate.",
            "derive_softness.png",
            "10 s",
        ),
        Entry(
            "accuracy/sonine_coefficients.py",
            "Are a₂, a₃, D and T of kinetic theory those of direct simulation?",
            "sonine_coefficients",
            states,
            "sonine_coefficients.png",
            "20 min",
        ),
        Entry(
            "accuracy/measure_correlations.py",
            "By how much do correlated velocities slow the cooling?",
            "measure_correlations",
            correlations,
            "measure_correlations.png",
            "7 min; the whole grid 25 min",
        ),
        Entry(
            "accuracy/make_lammps_curves.py",
            "How does one make more cooling curves in LAMMPS?",
            "",
            lambda f: "Three are in data/; no constant of the theory was fitted to them.",
            "make_lammps_curves.png",
            "4 min each",
        ),
    ),
    "Speed": (
        Entry(
            "speed/speed_vs_error.py",
            "How fast and how accurate is each model?",
            "speed_vs_error",
            front,
            "speed_vs_error.png",
            "16 to 31 min",
            "speed_vs_error.md",
        ),
        Entry(
            "speed/benchmark_kinetic_theory.py",
            "How fast is kinetic theory?",
            "benchmark_kinetic_theory",
            theory,
            "benchmark_kinetic_theory.png",
            "40 s",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_replicas.py",
            "How much do two CPU devices help?",
            "benchmark_replicas",
            devices,
            "benchmark_replicas.png",
            "3 min",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_million.py",
            "What does a gas of a million cost, until it clusters?",
            "benchmark_million",
            million,
            "benchmark_million.png",
            "25 min",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_compilation.py",
            "How long does the first run of each particle model, or a fit, compile?",
            "benchmark_compilation",
            compilation,
            "benchmark_compilation.png",
            "1 min",
        ),
        Entry(
            "speed/benchmark_dsmc.py",
            "How fast is DSMC?",
            "benchmark_dsmc",
            dsmc,
            "benchmark_dsmc.png",
            "100 s",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_hard_spheres.py",
            "How fast are hard spheres, compared with LAMMPS?",
            "benchmark_hard_spheres",
            hard,
            "benchmark_hard_spheres.png",
            "6 min",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_particles.py",
            "How fast are soft spheres, compared with LAMMPS?",
            "benchmark_particles",
            particles,
            "benchmark_particles.png",
            "7 min",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_derivatives.py",
            "What does a derivative through particles cost?",
            "benchmark_derivatives",
            slopes,
            "benchmark_derivatives.png",
            "100 s",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_versions.py",
            "Does a gas without elements cost what it did before scenes had any?",
            "benchmark_versions",
            versions,
            "benchmark_versions.png",
            "6 min",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_elements.py",
            "What do rough spheres, walls and drag cost?",
            "benchmark_elements",
            elements,
            "benchmark_elements.png",
            "2 min",
            "speed.md",
        ),
    ),
    "The paper": (
        Entry(
            "paper/paper_claims.py",
            "Which claims of the paper hold, equation by equation?",
            "paper_claims",
            claims,
            "paper_claims.png",
            "15 s",
            "paper_claims.md",
        ),
        Entry(
            "paper/paper_restitution.py",
            "Is the paper's ε(v) right?",
            "paper_restitution",
            restitution,
            "paper_restitution.png",
            "15 s",
        ),
        Entry(
            "paper/paper_cooling.py",
            "How do spheres of viscoelastic and of constant ε cool?",
            "paper_cooling",
            cooling,
            "paper_cooling.png",
            "80 s",
        ),
        Entry(
            "paper/paper_velocity_correlation.py",
            "How does the velocity autocorrelation function decay?",
            "paper_velocity_correlation",
            velocities,
            "paper_velocity_correlation.png",
            "2 min",
        ),
        Entry(
            "paper/paper_diffusion_coefficient.py",
            "Is D = T τ_v?",
            "paper_diffusion_coefficient",
            coefficient,
            "paper_diffusion_coefficient.png",
            "2 min",
        ),
        Entry(
            "paper/paper_diffusion.py",
            "How does ⟨Δr²⟩ grow in a viscoelastic gas?",
            "paper_diffusion",
            spread,
            "paper_diffusion.png",
            "70 s",
        ),
        Entry(
            "paper/paper_exponents.py",
            "And if 1 − ε is a power v^γ, or ε as measured on ice?",
            "paper_exponents",
            exponents,
            "paper_exponents.png",
            "100 s",
        ),
        Entry(
            "paper/paper_clustering.py",
            "When does a gas depart from Haff's law?",
            "paper_clustering",
            clustering,
            "paper_clustering.png",
            "18 min",
        ),
        Entry(
            "paper/paper_clustering_dissolves.py",
            "Do clusters dissolve as ε approaches 1?",
            "paper_clustering_dissolves",
            dissolves,
            "paper_clustering_dissolves.png",
            "3 min",
        ),
        Entry(
            "paper/clustering_film.py",
            "What does a clustering gas look like, and what grows first?",
            "clustering_film",
            film,
            "clustering_film.png",
            "3 min",
        ),
    ),
}
