"""Rows of speed.md of a gas of a million particles."""

from collections.abc import Callable

from experiments.support.tables.words import Row, each

COMMAND = "python experiments/speed/benchmark_million.py"
KINDS = {"hard-spheres": "HardSpheres", "soft-spheres": "SoftSpheres", "dsmc": "DSMC"}
BUSY = 0.5
"""Load of a machine from which on a timing is one beside other work."""


def of_each(words: Callable[[dict], str], *needed: str) -> Callable[[dict], str]:
    """Words of each model of `benchmark_million` for which the needed figures are known."""

    def measured(found: dict) -> str:
        rows = [row for row in found["rows"] if all(key in row for key in needed)]
        said = [f"{KINDS[row['model']]} {words(row)}" for row in rows]
        beside = any(row["load"] > BUSY for row in rows)
        return "; ".join(said) + (" (timed beside other work)" if beside else "")

    return measured


def of_a_collision(row: dict) -> str:
    case = row["two cores"]
    peak = case["peak_GiB"]
    return f"{1e6 * case['s_per_collision']:.3g} µs a collision, {peak:.1f} GiB at the peak"


def into_clusters(row: dict) -> str:
    case = row["clusters"]
    minutes = case["run_s"] / 60 * case["clusters_at"] / case["collisions"][-1]
    return (
        f"{case['clusters_at']:.1f} collisions each, {minutes:.1f} min after a melt of "
        f"{case['melt_s'] / 60:.1f} min, {case['peak_GiB']:.1f} GiB"
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
        "the same from a fluid to clusters: numbers in cells vary twice as much as in a fluid",
        "",
        "benchmark_million",
        of_each(into_clusters, "clusters"),
        COMMAND,
    ),
    Row(
        "the same, strong scaling: two cores",
        "one core",
        "benchmark_million",
        of_each(lambda row: f"{row['strong']:.2f}×", "strong"),
        COMMAND,
    ),
    Row(
        "the same, weak scaling: collisions a second of N on two cores; of two replicas of N/2 on "
        "two CPU devices",
        "N/2 on one core",
        "benchmark_million",
        of_each(lambda row: f"{row['weak']:.2f}×; {row['replicas']:.2f}×", "weak", "replicas"),
        COMMAND,
    ),
    Row(
        "memory of one disk with all arrays of a run, and on paper the largest N of one device",
        "16 / 80 / 141 GB",
        "benchmark_million",
        of_each(on_paper, "largest"),
        COMMAND,
    ),
)
