"""Entries of the gallery in README.md: question, finding, picture and run time of each script."""

from collections.abc import Callable
from typing import NamedTuple

from experiments.accuracy.flow_memory import within_bounds
from experiments.support.tables.accuracy import off_true
from experiments.support.tables.words import between, minus, of, percent, power

KINETIC = ("KineticTheory", "forward", "reverse")
"""Beginnings of the names of kinetic-theory rows in `benchmark_versions.py`."""

MAX_WORDS = 15
"""Largest number of words of a finding."""


class Entry(NamedTuple):
    """A script of the gallery.

    Attributes:
        script: path in experiments/.
        question: the question that the script answers.
        source: name of the file in figures/ without extension; "" for none.
        finding: returns the answer, at most 15 words, from the contents of that file.
        picture: name in pictures/, or "".
        time: run time on two cores.
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
    return f"Dilute curve: the fitted A differs from the true by {off_true()(f)}."


def wrong(f: dict) -> str:
    ratios = [row["A"] for row in f["rows"] if not row["name"].startswith("nothing")]
    return f"A is {between(ratios)} times the true; the alternatives' range usually contains it."


def drop(f: dict) -> str:
    return f"With walls and roughness, the interval contains A in {f['held']} of {f['runs']} runs."


def devices(f: dict) -> str:
    ratios = between((row["ratio"] for row in f["rows"]), "{:.2f}")
    return f"Two replicas run {ratios} times as fast as on one core."


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
    return f"A and T₀ take {ours} DSMC runs with derivatives, {simplex} with Nelder–Mead."


def health(f: dict) -> str:
    bias, _ = f["projected_over_differences"]
    largest = max(abs(100 * x) for x in bias)
    return f"Within {largest:.0f} % up to 100 collisions, but not in clusters."


def in_flows(f: dict) -> str:
    found = f["scenes"]["hard"]
    bias = [100 * x for x in found["bias"][0]]
    left = max(abs(100 * x) for x in found["bias_of_differences"][0])
    too_large = between(bias, "{:.0f}")
    return f"Projected ones are {too_large} % too large, differences are within {left:.0f} %."


def memories(f: dict) -> str:
    rows = f["memories"]
    right = [name for name, row in rows.items() if within_bounds(row)]
    if right:
        return f"{right[0][0].upper()}{right[0][1:]}, within 10 % up to 100 collisions."
    return f"None of {len(rows)} is shown to be accurate within 10 % at 100 collisions."


def lammps(f: dict) -> str:
    found = f["curves"]["dense"]["largest_temperature_difference"]
    return f"T agrees within {100 * found:.1f} % in the dense gas."


def lammps_elements(f: dict) -> str:
    most = max(row["rms_velocity"][-1] for row in f["scenes"].values())
    return f"Velocities differ by at most {most:.0e} √T₀ after one mean free time."


def soft(f: dict) -> str:
    order = f["impact"]["head-on"]["order"]["bias"]
    return f"The error of ε in an impact has order {order:.1f}."


def theory(f: dict) -> str:
    return f"A thousand curves take {f['sweep']['vmap_run_s']:.2f} s."


def particles(f: dict) -> str:
    ratios = [row["lammps"]["1"]["ratio"] for row in f["rows"]]
    return f"{between(ratios, '{:.1f}')} times as fast as LAMMPS on one core."


def hard(f: dict) -> str:
    ratios = [row["lammps"]["ratio"] for row in f["rows"] if row["lammps"]]
    return f"{between(ratios, '{:.0f}')} times as fast as LAMMPS, for short contacts."


def dsmc(f: dict) -> str:
    rates = [row["collisions_per_s"] / 1e6 for row in f["rows"]]
    return f"{between(rates, '{:.1f}')} million collisions per second."


def versions(f: dict) -> str:
    rows = [row["ratio"] for row in f["rows"] if not row["model"].startswith(KINETIC)]
    return f"Particle runs take {between(rows, '{:.2f}')} times as long."


def elements(f: dict) -> str:
    most = max(f["rows"], key=lambda row: row["ratio"])
    return f"At most {most['ratio']:.1f} times a smooth gas ({most['scene']}, {most['model']})."


def slopes(f: dict) -> str:
    ratios = [row["ways"]["reverse, A"]["ratio"] for row in f["rows"]]
    return f"Reverse mode takes {between(ratios, '{:.1f}')} times a run, in constant memory."


def front(f: dict) -> str:
    rows = of(f["scenes"]["dilute"]["rows"], model="kinetic theory")
    error = between(100 * row["error"] for row in rows)
    return f"Dilute: kinetic theory, {error} % in milliseconds; dense: soft spheres."


def constant(f: dict) -> dict:
    return f["scenes"]["phi = 0.245, e = 0.9"]["constant"]["departures"]


def clustering(f: dict) -> str:
    n, error = constant(f)["T over theory's of N by 2"]["N"]
    return f"T is twice Haff's after {n:.1f} ± {error:.1f} collisions, later in viscoelastic gases."


def dissolves(f: dict) -> str:
    uneven = f["viscoelastic"]["unevenness"]
    peak, last = max(uneven), uneven[-1]
    return f"Yes: density fluctuations peak at {peak:.0f} and end at {last:.1f} times elastic."


def film(f: dict) -> str:
    flow, density = (
        next(
            n
            for n, x in zip(f["collisions"], f[name], strict=True)
            if sum(x[:3]) > 30 * sum(f[name][0][:3])
        )
        for name in ("across", "S")
    )
    return f"The flow grows 30-fold in {flow:.0f} collisions, S(k) in {density:.0f}."


def compilation(f: dict) -> str:
    rows = f["rows"]
    soft, hard, dsmc = (rows[name]["first_s"] for name in ("SoftSpheres", "HardSpheres", "DSMC"))
    first, again = f["main_job"]["first_s"], f["main_job"]["again_s"]
    runs = f"Soft spheres {soft:.0f}, hard spheres {hard:.0f}, DSMC {dsmc:.0f} s"
    return f"{runs}; fit {first:.0f} s, again {again:.1f} s."


def cooling(f: dict) -> str:
    last = list(f["found"]["viscoelastic"]["exponent"].values())[-1]
    other = list(f["found"]["constant"]["exponent"].values())[-1]
    return minus(f"T falls as t^{last:.3f} and t^{other:.3f} after 10⁶ τ_c.")


def velocities(f: dict) -> str:
    row = f["found"]["viscoelastic"]
    return (
        "Nearly exponentially in collisions, not in time; τ_v/τ_E is "
        f"{row['dsmc']['relaxation']:.3f}, in the paper {row['paper_relaxation']:.3f}."
    )


def coefficient(f: dict) -> str:
    row = f["found"]["constant"]
    return f"No: D is {row['by_slope'][-1]:.2f} T τ_E, in the paper {row['paper'][-1]:.2f} T τ_E."


def spread(f: dict) -> str:
    row = f["found"]["viscoelastic"]
    return f"Towards t^(1/6): the exponent is {row['exponent'][-1]:.3f} after 10⁶ τ_c."


def exponents(f: dict) -> str:
    last = minus(f"{f['found']['ice']['exponent']:.2f}")
    return f"T falls as t^(−2/(1+γ)); for ice the last exponent is {last}."


def restitution(f: dict) -> str:
    limit = f["found"]["two_terms_good_to_one_per_cent"]["F = 0"]
    return f"Two terms of the series are accurate within 1 % up to β = {limit:.2f}."


def claims(f: dict) -> str:
    agree = sum(row["verdict"] == "agree" for row in f["rows"])
    return f"{agree} of {len(f['rows'])} agree; the others are corrected."


def derived(f: dict) -> str:
    return (
        f"A fit to the equation of motion, accurate within "
        f"{power(f['largest']['clipped']['error'])}."
    )


def same_numbers(f: dict) -> str:
    same = [row["difference"] == 0 for row in f["rows"]]
    return f"Identical to version 0.1.0, bit for bit, in {sum(same)} of {len(same)} cases."


def states(f: dict) -> str:
    off = {
        k: max(
            100 * abs(row["off"][k] / row["simulated"][k])
            for row in f["states"]
            if abs(row["simulated"][k]) > least
        )
        for k, least in ((0, 0.01), (1, 0.003), (2, 0.0))
    }
    return f"a₂, a₃, D agree within {off[0]:.1f}, {off[1]:.0f}, {off[2]:.1f} %, for ε from 0 to 1."


def correlations(f: dict) -> str:
    rows = [row for row in f["rows"] if "h" in row]
    rates = [100 * (1 - row["rate"]) for row in rows]
    off = max(abs(100 * (row["theory"] - row["rate"])) for row in rows)
    return f"By {min(rates):.1f} to {max(rates):.0f} %; the error of theory is at most {off:.1f} %."


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
            "What is the result of a fit whose model leaves out some physics?",
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
            "How often does a 95 % interval contain the true A?",
            "interval_coverage",
            coverage,
            "interval_coverage.png",
            "30 min",
            "interval_coverage.md",
        ),
        Entry(
            "fit/coverage_in_clusters.py",
            "How often does it contain the true A in a clustering gas?",
            "coverage_in_clusters",
            in_clusters,
            "coverage_in_clusters.png",
            "20 min",
            "interval_coverage.md",
        ),
        Entry(
            "fit/sample_posterior.py",
            "Does the error bar of a fit agree with the posterior?",
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
            "How do I add my own model?",
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
            "Is the derivative of a chaotic gas accurate, and for how long?",
            "gradient_health_dilute",
            health,
            "gradient_health.png",
            "12 min; clustering 100 min",
            "accuracy.md",
        ),
        Entry(
            "accuracy/derivatives_in_flows.py",
            "Are derivatives accurate in a gas with a flow, and is their bias estimated?",
            "derivatives_in_flows",
            in_flows,
            "derivatives_in_flows.png",
            "5 min",
            "accuracy.md",
        ),
        Entry(
            "accuracy/flow_memory.py",
            "Are projected derivatives accurate if the projection also keeps the flow?",
            "flow_memory",
            memories,
            "flow_memory.png",
            "60 min",
            "accuracy.md",
        ),
        Entry(
            "accuracy/soft_sphere_accuracy.py",
            "How large are the errors of soft spheres, and what is their order in the step?",
            "soft_sphere_accuracy",
            soft,
            "soft_sphere_accuracy.png",
            "2 min",
        ),
        Entry(
            "accuracy/hard_cases.py",
            "How does jaxgran behave in limits in which simulations often fail?",
            "hard_cases",
            lambda f: "24 limits: correct results within tolerances, or clear errors.",
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
            "How much do soft contacts slow the cooling, c(β)?",
            "",
            lambda f: "c = 0.969 (d − 1) as β → 0, and less for larger β.",
            "derive_softness.png",
            "10 s",
        ),
        Entry(
            "accuracy/sonine_coefficients.py",
            "Do a₂, a₃, D and T of kinetic theory agree with direct simulation?",
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
            "accuracy/compare_versions.py",
            "Does this version give the same numbers as another version?",
            "compare_versions",
            same_numbers,
            "",
            "8 min",
        ),
        Entry(
            "accuracy/make_lammps_curves.py",
            "How can I make more cooling curves with LAMMPS?",
            "",
            lambda f: "Four are in data/; no constant of the theory was fitted to them.",
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
            "What does a gas of a million particles cost, until it clusters?",
            "benchmark_million",
            million,
            "benchmark_million.png",
            "25 min",
            "speed.md",
        ),
        Entry(
            "speed/benchmark_compilation.py",
            "How long does the first run of each particle model, or a fit, take?",
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
            "Did support for walls, roughness and drag slow down gases without them?",
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
            "Which claims of the paper are confirmed, equation by equation?",
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
            "How do gases of viscoelastic and of constant ε cool?",
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
            "How does T fall if 1 − ε is a power v^γ, or for ε of ice?",
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
