"""Does this version give the same numbers as another version?

    python experiments/accuracy/compare_versions.py CHECKOUT [--record] [--out DIR]

CHECKOUT is the folder of the other version (``git worktree add --detach FOLDER COMMIT``). Both
versions simulate the same ten scenes with all four models, with elements, derivatives and saved
observables, fit two curves, one by kinetic theory and one by DSMC, and fit two curves jointly. Each
version runs in a separate process. Every returned array is compared, of fits the estimate and the
fitted curve. Prints
one row for each case: the number of arrays, and "identical" if all bits agree, otherwise the
largest difference relative to the largest value of that array. The exit code is 1 if a case is not
identical.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.support.record import EXPERIMENTS, Options, of_version, run_parts
from jaxgran.data.example import EXAMPLE_FILES


def compare_versions(options: Options) -> Iterator[dict]:
    before, now = (
        of_version(folder, "numbers", EXAMPLE_FILES["dilute"])
        for folder in (options.CHECKOUT, EXPERIMENTS.parent)
    )
    for case in list(now)[1:]:  # the first step is the import
        one, other = (each[case] for each in (before, now))
        number, difference = f"{len(other)} arrays", float("inf")
        if len(one) == len(other):
            difference = max(map(relative_difference, one, other))
        print(f"{case:45} {number:12} {difference or 'identical'}")
        yield {"case": case, "difference": difference}


def relative_difference(one: list, other: list) -> float:
    """Return the largest difference over the largest value; 0 if all bits agree."""
    x, y = np.array(*one), np.array(*other)
    if x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes():
        return 0.0
    if x.shape != y.shape or x.dtype.kind not in "fiu":
        return float("inf")
    return float(np.nanmax(np.abs(x - y)) / np.nanmax(np.abs(x)))


if __name__ == "__main__":
    found = run_parts(__doc__, compare_versions, smoke=False, CHECKOUT=Path)
    sys.exit(any(row["difference"] for row in found["compare_versions"]["rows"]))
