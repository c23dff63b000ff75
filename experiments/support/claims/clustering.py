"""Rows of the table of claims: the onset and the dissolution of clusters."""

import numpy as np

from experiments.support.claims.table import Table

QUOTED = ((70, 0.9, 0.0031), (23, 0.6, 0.0027))
"""The paper's N_c (collisions per particle at the onset), coefficient of restitution, T_c/T_0."""
BY_NUMBER, BY_TIME = "T over theory's of N by 2", "T over theory's of t by 2"
BY_DENSITY = "unevenness over elastic by 2"


def clustering(table: Table) -> None:
    haff = [np.exp(-(1 - e**2) / 2 * n) for n, e, _ in QUOTED]
    run = table.whole("paper_clustering")
    if run:
        onset(table, run, haff)
    gas = table.whole("paper_clustering_dissolves")
    if gas:
        dissolution(table, gas["viscoelastic"])


def onset(table: Table, run: dict, haff: list) -> None:
    """Add the departure from Haff's law, and the comparison of clocks."""
    scenes = [scene["constant"] for scene in run["scenes"].values()]
    cooler = [scene["T_at_the_papers_N"] for scene in scenes]
    found = {name: [scene["departures"][name] for scene in scenes] for name in (BY_NUMBER, BY_TIME)}
    early = [scene["departures"]["T over theory's of t by 1.1"]["N"][0] for scene in scenes]
    off = [100 * (q / T[0] - 1) for T, (_, _, q) in zip(cooler, QUOTED, strict=True)]
    clocks = run["first_scene_over_second"]

    def numbers(name: str) -> str:
        return " and ".join(_of(left["N"]) for left in found[name])

    table.add(
        "text",
        "clusters at N_c = 70 (φ = .245, ε = .9) and 23 (φ = .05, ε = .6)",
        f"T is twice Haff's of the same time at N = {numbers(BY_TIME)}, twice Haff's of the same N "
        f"at {numbers(BY_NUMBER)}",
        "hard disks, 20 000, 3 seeds",
        "agree",
        all(
            abs(left["N"][0] / n - 1) < 0.05
            for left, (n, _, _) in zip(found[BY_TIME], QUOTED, strict=True)
        ),
        "N_c is a matter of definition: 10 % above Haff's law of the same time comes at "
        f"{early[0]:.0f} and {early[1]:.0f}",
        [
            (f"N_c, ε = {e:g}", left["N"][0], n, left["N"][1])
            for left, (n, e, _) in zip(found[BY_TIME], QUOTED, strict=True)
        ],
    )
    # N at which T has the quoted value, by the slope of ln T between the two departures.
    shifts = []
    for T, number, time, (_, _, quoted) in zip(cooler, *found.values(), QUOTED, strict=True):
        slope = np.log(number["T"][0] / time["T"][0]) / (time["N"][0] - number["N"][0])
        shifts.append(float(np.log(T[0] / quoted) / slope))
    spread = [time["N"][0] - number["N"][0] for number, time in zip(*found.values(), strict=True)]
    table.add(
        "text",
        "1/𝒯_c = .0031 and .0027 there",
        f"T/T₀ = {_of(cooler[0])} and {_of(cooler[1])} at N = 70 and 23; Haff's law says "
        f"{haff[0]:.4f} and {haff[1]:.4f}",
        "hard disks, 20 000, 3 seeds",
        "agree",
        all(abs(shift) < width for shift, width in zip(shifts, spread, strict=True))
        and all(abs(T[0] / law - 1) > 1 for T, law in zip(cooler, haff, strict=True)),
        f"{off[0]:+.0f} % and {off[1]:+.0f} % off, as much as {shifts[0]:+.1f} of 70 and "
        f"{shifts[1]:+.1f} of 23 collisions: within the definition of N_c, whose two here differ "
        f"by {spread[0]:.0f} and {spread[1]:.0f}; they are no values of Haff's law",
        [
            (f"T/T₀ at N_c, ε = {e:g}", T[0], quoted, T[1])
            for T, (_, e, quoted) in zip(cooler, QUOTED, strict=True)
        ],
    )
    ratio = clocks[BY_TIME], clocks[BY_NUMBER], clocks[BY_DENSITY]
    table.add(
        "text",
        "𝒯 is a more universal clock of clustering than N",
        f"first gas over second: N {_of(ratio[0]['N'])}, T {_of(ratio[0]['T'])} at T = 2 Haff(t); "
        f"N {_of(ratio[1]['N'])}, T {_of(ratio[1]['T'])} at 2 Haff(N); by density N "
        f"{_of(ratio[2]['N'])}, T {_of(ratio[2]['T'])}",
        "hard disks, 20 000, 3 seeds",
        "agree",
        all(0.5 < r["T"][0] < 2 < r["N"][0] for r in ratio[:2]),
        "by energy; by density neither clock is universal",
    )
    later = [scene["viscoelastic_over_constant"][BY_NUMBER] for scene in run["scenes"].values()]
    table.add(
        "text",
        "clusters are retarded in a viscoelastic gas",
        f"same first dissipation: T = 2 Haff(N) later in N by {_of(later[0]['N'])} and "
        f"{_of(later[1]['N'])}, in time by {_of(later[0]['tau'])} and {_of(later[1]['tau'])}",
        "hard disks, 20 000, 3 seeds",
        "agree",
        all(x["N"][0] - 3 * x["N"][1] > 1 for x in later),
        f"in every clock; T there is {_of(later[0]['T'])} and {_of(later[1]['T'])} of the other's",
    )


def dissolution(table: Table, gas: dict) -> None:
    """Add the dissolution of clusters as the coefficient of restitution approaches 1."""
    uneven, flow, N = (np.asarray(gas[key]) for key in ("unevenness", "flow", "collisions"))
    peak = int(np.argmax(uneven))
    table.add(
        "text",
        "the viscoelastic gas becomes homogeneous again as ε → 1",
        f"density fluctuations {uneven[peak]:.1f} times the elastic fluid's at N = {N[peak]:.0f}, "
        f"{uneven[-1]:.2f} ± {gas['unevenness_error'][-1]:.2f} at N = {N[-1]:.0f}; the flow still "
        f"holds {flow[-1]:.2f} ± {gas['flow_error'][-1]:.2f} of the energy",
        "hard disks, 2000, φ = .05, 6 seeds",
        "agree",
        uneven[-1] < 0.3 * uneven[peak],
        "seen in a box of some L_c; larger ones take longer, as the number of disks",
    )


def _of(mean_and_error: list[float]) -> str:
    """Write "mean ± error", the error with two significant digits or rounded to units."""
    mean, error = mean_and_error
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{mean:.{digits}f} ± {error:.{digits}f}"
