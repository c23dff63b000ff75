"""Rows of speed.md of a gas of a million particles."""

from collections.abc import Callable

from experiments.support.tables.words import Row, each

COMMAND = "python experiments/speed/benchmark_million.py"
KINDS = {"hard-spheres": "HardSpheres", "soft-spheres": "SoftSpheres", "dsmc": "DSMC"}
BUSY = 0.5
"""Load of the machine above which a timing is marked as disturbed by other jobs."""


def of_each(words: Callable[[dict], str], *needed: str) -> Callable[[dict], str]:
    """Return the text of each model of `benchmark_million` that has the needed figures."""

    def measured(found: dict) -> str:
        rows = [row for row in found["rows"] if all(key in row for key in needed)]
        parts = [f"{KINDS[row['model']]} {words(row)}" for row in rows]
        disturbed = any(row["load"] > BUSY for row in rows)
        return "; ".join(parts) + (" (timed while other jobs ran)" if disturbed else "")

    return measured


def of_a_collision(row: dict) -> str:
    case = row["two cores"]
    peak = case["peak_GiB"]
    return f"{1e6 * case['s_per_collision']:.3g} µs per collision, peak memory {peak:.1f} GiB"


def into_clusters(row: dict) -> str:
    case = row["clusters"]
    minutes = case["run_s"] / 60 * case["clusters_at"] / case["collisions"][-1]
    return (
        f"{case['clusters_at']:.1f} collisions per disk, {minutes:.1f} min after an equilibration "
        f"of {case['melt_s'] / 60:.1f} min, {case['peak_GiB']:.1f} GiB"
    )


def on_paper(row: dict) -> str:
    millions = each((n / 1e6 for n in row["largest"].values()), "{:.0f}")
    return f"{row['bytes_per_particle']:.0f} bytes, {millions} million"


ROWS = (
    Row(
        "10⁶ disks in one box, φ = .05",
        "",
        "benchmark_million",
        of_each(of_a_collision, "two cores"),
        COMMAND,
    ),
    Row(
        "this gas until it clusters: numbers in cells vary twice as much as in a fluid",
        "",
        "benchmark_million",
        of_each(into_clusters, "clusters"),
        COMMAND,
    ),
    Row(
        "this gas, strong scaling: two cores",
        "one core",
        "benchmark_million",
        of_each(lambda row: f"{row['strong']:.2f}×", "strong"),
        COMMAND,
    ),
    Row(
        "this gas, weak scaling, collisions per second: N on two cores; two replicas of N/2 on two "
        "CPU devices",
        "N/2 on one core",
        "benchmark_million",
        of_each(lambda row: f"{row['weak']:.2f}×; {row['replicas']:.2f}×", "weak", "replicas"),
        COMMAND,
    ),
    Row(
        "memory per disk with all arrays of a run, and the estimated largest N on one device",
        "16 / 80 / 141 GB",
        "benchmark_million",
        of_each(on_paper, "largest"),
        COMMAND,
    ),
)
