"""By how much do correlated velocities slow the cooling of hard spheres?

    python experiments/accuracy/measure_correlations.py [--full] [--record] [--smoke] [--out DIR]

Hard spheres of constant restitution start from an elastic fluid and cool in boxes shorter than L_c.
Their cooling rate over Enskog's, with a_2 and a_3 of kinetic theory, is measured in each box from
T^(-1/2), which grows at a constant rate in Enskog's theory, and compared with
`jaxgran.theory.density` and `jaxgran.models.error_model`. For elastic spheres the collision rate
over Enskog's is measured; its difference from 1 is a property of equilibrium and is divided out.
The rates are corrected for finite N: without total momentum spheres collide faster, few spheres
share the energy, and T^(-1/2) is not linear in it. The corrections are ``1/(2N) - 3/(4dN) +
3 (1 - eps^2)/(dN)`` of the cooling rate and ``-1/(2N) + 1/(4dN)`` of the collision rate. They leave
out the contact value of finite N, which is common to both.

Without --full: eps = .7, .9, 1 and errors of some .2 %; with --full also eps = .8 and .95, in boxes
of the same length in L_c as those of eps = .7, and errors of some .15 %. (A box shorter than L_c/2
lacks waves that the theory of a large box counts.)
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import curve_fit

import jaxgran
from experiments.support.analysis import mean_and_error, replicas_of
from experiments.support.plots import DSMC, ELASTIC, HARD, INK, THEORY, caption, panels
from experiments.support.record import Options, run_parts
from experiments.support.scenes import cool, hard_beads, times_of
from jaxgran.models.error_model import flow_share
from jaxgran.theory.density import correlation_build_up, correlation_slowdown

MARKS = np.array([0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0])
"""Collisions per particle at which T is recorded."""

PLATEAU = 5
"""Index of the first mark at which correlations have reached their plateau."""

SIZES = {
    3: {0.05: (1000,), 0.1: (400,), 0.2: (140, 1200), 0.3: (110,)},
    2: {0.05: (200,), 0.1: (100, 420), 0.2: (50,), 0.3: (36,)},
}
"""N by dimension and phi: boxes of .6 to .8 L_c at eps = .7, and two of .9 L_c at eps = .9."""


TOGETHER = 6000
"""Number of spheres that are simulated at the same time."""


class Point(NamedTuple):
    """A gas in boxes of N spheres."""

    dimension: int
    packing_fraction: float
    restitution: float
    num_particles: int

    @property
    def gas(self) -> jaxgran.Gas:
        return hard_beads(self.packing_fraction, self.restitution, self.dimension)


@cache
def enskog(point: Point) -> jaxgran.CoolingCurve:
    """Return the curve without correlations, at the times of `MARKS`."""
    corrections = jaxgran.KineticTheory.all_corrections - {"correlations"}
    model = jaxgran.KineticTheory(corrections=corrections)
    return cool(point.gas, times_of(point.gas, MARKS[1:], model, 4e3, 600), model)


def slowing(point: Point, temperature) -> np.ndarray:
    """Return the growth of T^(-1/2) up to each mark from the one before, on the last axis."""
    return np.diff(np.asarray(temperature) ** -0.5, prepend=float(point.gas.temperature) ** -0.5)


def simulated(point: Point, impacts: float, seed: int) -> np.ndarray:
    """Return the rate over Enskog's between marks, corrected for finite N, (boxes, marks)."""
    n, d, theory = point.num_particles, point.dimension, enskog(point)
    replicas = max(TOGETHER // n, 2)
    model = jaxgran.HardSpheres(n, replicas=replicas)
    found = []
    for batch in range(max(1, round(impacts / (replicas * n * MARKS[-1] / 2)))):
        key = jax.random.fold_in(jax.random.key(seed), batch)
        curve = jaxgran.cool(point.gas, theory.times, model=model, key=key, progress=False)
        if point.restitution == 1:
            counts = replicas_of(curve, "collisions")
            found.append(np.diff(counts, axis=1, prepend=0) / np.diff(MARKS))
        else:
            growth = slowing(point, replicas_of(curve, "temperature"))
            found.append(growth / slowing(point, theory.temperature))
    loss = 1 - point.restitution**2
    few = (1 / 2 - 3 / (4 * d) + 3 * loss / d if loss else -1 / 2 + 1 / (4 * d)) / n
    return np.concatenate(found) / (1 + few)


def weighted(values: np.ndarray, first: int, point: Point) -> np.ndarray:
    """Return the mean over the marks from the first on, weighted by the change of ln T."""
    # By T^(-1/2) the last values would dominate. T of elastic spheres is constant.
    log_t = np.log(np.append(point.gas.temperature, enskog(point).temperature))
    weights = np.diff(MARKS if point.restitution == 1 else log_t)[first:]
    return values[..., first:] @ (weights / weights.sum())


def measured(point: Point, impacts: float, seed: int) -> dict:
    """Measure the rates of one gas over Enskog's, on the plateau and as they build up."""
    each = simulated(point, impacts, seed)
    late = weighted(each, 0 if point.restitution == 1 else PLATEAU, point)
    (rate, error), (course, course_error) = mean_and_error(late), mean_and_error(each)
    row = {"rate": float(rate), "error": float(error), "boxes": len(each)}
    return point._asdict() | row | {"course": course, "course_error": course_error}


def strength(phi: float, eps: float, d: int) -> float:
    """Return h in ``1 - h (1 - eps^2)``, the rate over Enskog's by theory."""
    loss = 1 - eps**2
    return float(correlation_slowdown(jnp.asarray(phi), jnp.asarray(loss), d)) / loss


def compared(row: dict, elastic: dict) -> dict:
    """Return the rates over those of elastic spheres, and the rates of theory.

    The flow lowers the cooling rate, and a lower rate slows the growth of its waves: L_c increases
    by the root of the rate over Enskog's. The rate is computed by iteration.
    """
    point = Point(*(row[name] for name in Point._fields))
    gas, theory = point.gas, enskog(point)
    log_t = np.append(0.0, np.log(np.asarray(theory.temperature / gas.temperature)))
    loss = 1 - point.restitution**2
    h = strength(point.packing_fraction, point.restitution, point.dimension)
    built = np.asarray(correlation_build_up(jnp.asarray(MARKS[1:] + MARKS[:-1]) / 2))

    def flow_at(rate: np.ndarray) -> np.ndarray:
        longer = np.append(rate[0], (rate[1:] + rate[:-1]) / 2)
        lc = float(gas.critical_box) / np.append(longer, rate[-1]) ** 0.5
        share, _ = flow_share(gas, log_t, lc, point.num_particles)
        return 1.5 * (share[1:] + share[:-1]) / 2  # the rate goes as T^(3/2) of the heat

    expected = 1 - h * loss * built
    for _ in range(30):
        expected = (expected + 1 - h * loss * built - flow_at(expected)) / 2
    flow = 1 - h * loss * built - expected
    rate, error = row["rate"] / elastic["rate"], float(np.hypot(row["error"], elastic["error"]))
    share, grown, theory_rate = (
        float(weighted(x, PLATEAU, point)) for x in (flow, built, expected)
    )
    return row | {
        "rate": rate,
        "error": error,
        "flow": share,
        "theory": theory_rate,
        "h": (1 - share - rate) / (loss * grown),
        "h_error": error / (loss * grown),
        "course": row["course"] / elastic["rate"],
        "course_flow": flow,
    }


def build_up(rows: list[dict]) -> tuple[float, float]:
    """Fit a common N_0 of ``1 - exp(-N/N_0)``, net of the flow; return it with its error."""
    middle = (MARKS[1:] + MARKS[:-1]) / 2
    slower = np.array([1 - row["course_flow"] - row["course"] for row in rows])
    errors = np.array([row["course_error"] for row in rows])

    def courses(_, n_0, *plateaus):
        return np.outer(plateaus, -np.expm1(-middle / n_0)).ravel()

    data = {"ydata": slower.ravel(), "sigma": errors.ravel(), "absolute_sigma": True}
    best, covariance = curve_fit(courses, None, p0=(5.0, *slower[:, -1]), **data)
    return float(best[0]), float(covariance[0, 0] ** 0.5)


def draw(rows: list[dict]):
    """Draw h against phi, and the rate against the number of collisions."""
    figure, places = panels(2, size=(5, 4), sharey=True)
    for axes, d in zip(places, (3, 2), strict=True):
        own = [r for r in rows if r["dimension"] == d and "h" in r]
        for k, eps in enumerate(sorted({r["restitution"] for r in own})):
            some = [r for r in own if r["restitution"] == eps]
            x = [r["packing_fraction"] * (1 + 0.04 * (k - 1)) for r in some]
            y, e = ([r[name] for r in some] for name in ("h", "h_error"))
            look = {"fmt": "osv^D"[k], "ms": 5, "color": (HARD, ELASTIC, DSMC)[k % 3]}
            axes.errorbar(x, y, e, label=f"ε = {eps:g}", **look)
        phi = np.linspace(1e-3, 0.32, 60)
        for eps, line in ((0.9, "-"), (0.7, "--")):
            h = [strength(p, eps, d) for p in phi]
            axes.plot(phi, h, line, color=THEORY, label=f"kinetic theory, ε = {eps:g}")
        axes.axhline(0, color=INK, lw=0.8)
        title, label = ("spheres", "h, loss of rate over 1 − ε²") if d == 3 else ("disks", "")
        caption(axes, title, "upper left", xlabel="packing fraction φ", ylabel=label)
    return figure


def measure_correlations(options: Options) -> dict:
    impacts = 2e4 if options.smoke else 1.6e6 if options.full else 7e5
    gases = [(d, phi, sizes) for d in SIZES for phi, sizes in SIZES[d].items()]
    rows, elastic = [], {}
    for d, phi, sizes in gases[2:3] if options.smoke else gases:
        series = [(n, (0.7, 0.9) if k == 0 else (0.9,)) for k, n in enumerate(sizes)]
        if options.full:
            # Boxes of the length in L_c that those of eps = .7 have.
            shares = {eps: (0.51 / (1 - eps**2)) ** (d / 2) for eps in (0.8, 0.95)}
            series += [(round(sizes[0] * share), (eps,)) for eps, share in shares.items()]
        for n, epsilons in series:
            for eps in (1.0, *epsilons):
                row = measured(Point(d, phi, eps, n), impacts, seed=len(rows))
                elastic = row if eps == 1 else elastic
                rows.append(row if eps == 1 else compared(row, elastic))
                print(rows[-1], flush=True)
    n_0 = build_up([row for row in rows if "h" in row])
    return {"rows": rows, "marks": MARKS, "build_up": n_0, "picture": draw(rows)}


if __name__ == "__main__":
    run_parts(__doc__, measure_correlations, full=False)
