"""What is the result of a fit of A if the curve contains physics that the fit is not told of?

    python experiments/fit/wrong_physics.py [--runs 100] [--rows walls] [--record] [--out DIR]

Each curve is T(t) of one run of 250 hard spheres (2 mm beads, phi = .03, A = 3e-6 s), until T has
fallen to 3 %, at 30 times, without errors; the fit knows N. What the gas contains and what the fit
is told differ between the rows: `told` names it, A and T_0 are free, and beta_t where it says so,
with T_rot measured. Finds for each row

- A: fitted over true A, median;
- scatter: the standard deviation of ln A over the runs; off: the root mean square of ln(A/true A),
  which contains what all runs have in common, too; expected: these by the error bar;
- held: runs whose error bar "assuming no other effect" (95 %) contains the true A;
- inside: runs whose range over all explanations contains it;
- grades: how many runs are determined, not determined, not consistent.

- width: the median of ln(high/low) of this range;
- low_of: the median low end with each single alternative, over true A; the lowest one sets that of
  the range, and is the profile of its likelihood.

In the row "fast grains lost" spheres beyond 2.2 sqrt(2 T) are not seen. In the rows of sizes
diameters are distributed evenly within 10 % of their mean, or half of the spheres are 1.2 or 1.4
times as large as the others; masses are proportional to the cubes of diameters, and T is the mean
square velocity over 3. In the rows of scatter eps of each impact is a normal random number, clipped
to 0 to 1, whose mean is the law. Both are simulated by `unlike_spheres`. Contacts of hard spheres
have no duration, so kinetic theory is used without "softness".
"""

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.analysis import fit_quietly
from experiments.support.record import Options, collected, each_alone, figures, run_parts
from experiments.support.scenes import cool, glass

TRUE_A, NUM_PARTICLES, PHI = 3e-6, 250, 0.03
NUM_POINTS, LAST = 30, 0.03
NORMAL = 1.96
SEEN = 2.2
"""Largest speed that is seen, in sqrt(2 T)."""

THEORY = jaxgran.KineticTheory(corrections=jaxgran.KineticTheory.all_corrections - {"softness"})


def beads(**elements) -> jaxgran.Gas:
    gas = glass(0.1, PHI).replace(dissipative_constant=TRUE_A)
    return dataclasses.replace(gas, **elements)


SIDE = float(beads().box_side(NUM_PARTICLES))
WALLS = {"container": jaxgran.Walls(SIDE, restitution=0.9)}
ROUGH, GUESS = {"surface": jaxgran.Rough(-0.3)}, {"surface": jaxgran.Rough(0.0)}
BETA_WALLS = jaxgran.Walls(SIDE, restitution=0.9, tangential_restitution=-0.3)
ROUGH_WALLS = ROUGH | {"container": BETA_WALLS}
SLIDING = {"surface": jaxgran.Rough(0.5, friction=0.2)}
DRAG = {"drag": jaxgran.StokesDrag(0.015 * float(THEORY.cooling_rate(beads())))}


def seen(particles):
    """Return T of the spheres whose speed is below `SEEN`."""
    square = jnp.sum(particles.velocity**2, axis=-1)
    near = square < SEEN**2 * 2 * jnp.mean(square) / 3
    return jnp.sum(jnp.where(near, square, 0.0)) / (3 * jnp.sum(near))


class Row(NamedTuple):
    """What a gas contains, and what its fit is told.

    Attributes:
        name: of the gas.
        gas: elements of the gas.
        told: "all", "nothing", or in words.
        fitted: elements of the gas of the fit.
        free: free parameters besides A and T_0; with beta_t, T_rot is measured.
        floor: noise floor over T_0.
        save: what is measured instead of T; see `jaxgran.cool`.
        sizes: diameters over their mean, shape (N,); None if all are equal.
        scatter: standard deviation of eps from impact to impact.
    """

    name: str
    gas: dict
    told: str
    fitted: dict
    free: tuple[str, ...] = ()
    floor: float = 0.0
    save: Callable | None = None
    sizes: np.ndarray | None = None
    scatter: float = 0.0


def two_sizes(ratio: float) -> np.ndarray:
    """Return diameters over their mean, half of them larger by a ratio."""
    return np.repeat([2.0, 2.0 * ratio], NUM_PARTICLES // 2) / (1 + ratio)


BETA = ("tangential_restitution",)
ROWS = (
    Row("smooth, periodic", {}, "all", {}),
    Row("walls, eps_w = .9", WALLS, "all", WALLS),
    Row("walls, eps_w = .9", WALLS, "nothing", {}),
    Row("rough, beta_t = -.3", ROUGH, "all", ROUGH),
    Row("rough, beta_t = -.3", ROUGH, "nothing", {}),
    Row("rough between rough walls", ROUGH_WALLS, "beta_t free", ROUGH_WALLS | GUESS, BETA),
    Row("sliding, mu = .2, beta_0 = .5", SLIDING, "all", SLIDING),
    Row("sliding, mu = .2, beta_0 = .5", SLIDING, "beta_t = .5", {"surface": jaxgran.Rough(0.5)}),
    Row("sliding, mu = .2, beta_0 = .5", SLIDING, "beta_t free", GUESS, BETA),
    Row("sliding, mu = .2, beta_0 = .5", SLIDING, "nothing", {}),
    Row("drag, 3 % of the first losses", DRAG, "nothing", {}),
    Row("a noise floor of 1 % of T_0", {}, "nothing", {}, floor=0.01),
    Row("fast grains lost", {}, "nothing", {}, save=seen),
    Row("sizes, +-10 %", {}, "nothing", {}, sizes=np.linspace(0.9, 1.1, NUM_PARTICLES)),
    Row("sizes, 1 : 1.2", {}, "nothing", {}, sizes=two_sizes(1.2)),
    Row("sizes, 1 : 1.4", {}, "nothing", {}, sizes=two_sizes(1.4)),
    Row("eps scatters by .05", {}, "nothing", {}, scatter=0.05),
    Row("eps scatters by .1", {}, "nothing", {}, scatter=0.1),
)


def wrong_physics(options: Options) -> dict:
    """Compute each row in a process of its own, as many at a time as there are cores."""
    known = figures("wrong_physics")["rows"] if options.rows else []
    rows = {(row["name"], row["told"]): row for row in known}
    asked = [k for k, row in enumerate(ROWS) if options.rows in row.name]
    for found in collected(each_alone(statistics, [(k, options.runs) for k in asked])):
        rows[found["name"], found["told"]] = found
    return {"rows": [rows[row.name, row.told] for row in ROWS if (row.name, row.told) in rows]}


def measured(row: Row, runs: int) -> tuple:
    """Return times until T has fallen to its last share, and T and T_rot of each run."""
    gas = beads(**row.gas)
    trial = jnp.geomspace(1e-2, 1e4, 400) * gas.mean_free_time
    T = cool(gas, trial, THEORY).temperature / gas.temperature
    end = float(jnp.interp(-np.log(LAST), -jnp.log(T), trial))
    times = np.geomspace(end / 300, end, NUM_POINTS)
    if row.sizes is not None or row.scatter:
        sizes = np.ones(NUM_PARTICLES) if row.sizes is None else row.sizes
        return times, unlike_spheres(gas, sizes, row.scatter, times, runs), None
    model = jaxgran.HardSpheres(NUM_PARTICLES, replicas=runs)
    each = cool(gas, times, model, save=row.save).replicas
    return times, each.saved if row.save else each.temperature, each.rotational_temperature


def unlike_spheres(
    gas: jaxgran.Gas, relative_sizes: np.ndarray, scatter: float, times, runs: int
) -> jax.Array:
    """Return T in each run of spheres whose sizes differ and whose eps scatters.

    A serial event-driven code. The number of spheres in the volume is that of the gas.
    """
    largest = float(np.max(relative_sizes))
    apart = gas.replace(diameter=gas.diameter * largest, packing_fraction=PHI * largest**3)
    start = cool(apart, [0.0], jaxgran.HardSpheres(NUM_PARTICLES, replicas=runs)).particles
    side = start.box_side
    sizes = jnp.asarray(relative_sizes)
    diameter = (sizes[:, None] + sizes) / 2 * gas.diameter
    mass = sizes**3
    images = side * jnp.stack(jnp.meshgrid(*[jnp.arange(-1.0, 2.0)] * 3), -1).reshape(-1, 3)

    def impacts(now, x, v, i):
        """Return the times at which sphere i meets each other one."""
        r, w = x[i] - x, (v[i] - v)[:, None]
        r = (r - side * jnp.round(r / side))[:, None] + images
        b, c, w2 = (r * w).sum(-1), (r**2).sum(-1) - diameter[i, :, None] ** 2, (w**2).sum(-1)
        square = b**2 - w2 * c
        after = jnp.maximum(c, 0.0) / (jnp.sqrt(jnp.maximum(square, 0.0)) - b)
        after = jnp.where((b < 0) & (square > 0), after, jnp.inf).min(axis=-1)
        return now + after.at[i].set(jnp.inf)

    def impact(carry):
        now, x, v, table, key = carry
        key, of_impact = jax.random.split(key)
        i, j = jnp.unravel_index(jnp.argmin(table), table.shape)
        x, now = x + v * (table[i, j] - now), table[i, j]
        normal = x[i] - x[j]
        normal -= side * jnp.round(normal / side)
        normal /= jnp.linalg.norm(normal)
        speed, share = (v[j] - v[i]) @ normal, mass[j] / (mass[i] + mass[j])
        # eps is a function of (A k^(2/5))^5 v with k = sqrt(reduced radius)/(reduced mass).
        radius = 2 * sizes[i] * sizes[j] / (sizes[i] + sizes[j])
        equal = speed * radius / (2 * share * mass[i]) ** 2
        eps = gas.restitution(equal) + scatter * jax.random.normal(of_impact)
        kick = (1 + jnp.clip(eps, 0.0, 1.0)) * speed * normal
        v = v.at[i].add(share * kick).at[j].add((share - 1) * kick)
        for k in (i, j):
            of_k = impacts(now, x, v, k)
            table = table.at[k].set(of_k).at[:, k].set(of_k)
        return now, x, v, table, key

    def until(carry, end):
        now, x, v, table, key = jax.lax.while_loop(lambda c: c[3].min() < end, impact, carry)
        x = x + v * (end - now)
        return (end, x, v, table, key), jnp.mean(v**2)

    @jax.jit
    def run(x, v, key):
        v = v - mass @ v / mass.sum()
        v = v * jnp.sqrt(gas.temperature / jnp.mean(v**2))
        first = jax.vmap(lambda i: impacts(0.0, x, v, i))(jnp.arange(NUM_PARTICLES))
        start = jnp.zeros(()), x, v, first, key
        return jax.lax.scan(until, start, jnp.asarray(times))[1]

    keys = jax.random.split(jax.random.key(0), runs)
    starts = zip(start.position, start.velocity, keys, strict=True)
    return jnp.stack([run(*one) for one in starts])


def statistics(number: int, runs: int) -> dict:
    """Simulate a row, fit each run, and return statistics."""
    row = ROWS[number]
    times, each, rotation = measured(row, runs)
    gas, found, lows = beads(**row.fitted), [], defaultdict(list)
    free = "dissipative_constant", "temperature", *row.free
    for run, T in enumerate(np.asarray(each) + row.floor * float(gas.temperature)):
        T_rot = rotation[run] if row.free else None
        one = jaxgran.CoolingCurve(times, T, rotational_temperature=T_rot)
        measurement = jaxgran.Measurement(gas, one, num_particles=NUM_PARTICLES)
        result = fit_quietly(measurement, model=THEORY, free=free)
        ends = result.ranges.get("dissipative_constant", (np.nan, np.nan))
        numbers = *result.value("dissipative_constant"), *ends
        found.append((*(float(np.squeeze(x)) / TRUE_A for x in numbers), result.grade))
        for alternative in result.alternatives:
            if alternative.num_parts == 1 and alternative.restitution is None:
                lows[alternative.name].append(float(alternative.low[0]) / TRUE_A)
    *numbers, grades = zip(*found, strict=True)
    A, error, low, high = np.array(numbers)
    known = np.isfinite(low)
    inside = (low <= 1) & (high >= 1)
    return {"name": row.name, "told": row.told, "runs": runs} | {
        "A": float(np.median(A)),
        "scatter": float(np.std(np.log(A), ddof=1)) if runs > 1 else None,
        "off": float(np.sqrt(np.mean(np.log(A) ** 2))),
        "expected": float(np.median(error / A)),
        "held": int(np.sum(np.abs(A - 1) < NORMAL * error)),
        "inside": int(np.sum(inside)),
        "computed": int(np.sum(known)),
        "inside_or_flagged": int(np.sum(inside | (np.array(grades) == "not consistent"))),
        "range": [float(np.median(x[known])) if known.any() else None for x in (low, high)],
        "width": float(np.median(np.log(high / low)[known])) if known.any() else None,
        "low_of": {name: float(np.median(ends)) for name, ends in sorted(lows.items())},
        "grades": dict(Counter(grades)),
    }


if __name__ == "__main__":
    run_parts(__doc__, wrong_physics, smoke=False, runs=100, rows="")
