"""Gases of disks simulated beyond Haff's law, and the measures of their clusters."""

import dataclasses
import time
from collections.abc import Callable, Collection, Iterable

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import root_scalar

import jaxgran
from experiments.support.scenes import beads
from jaxgran.plotting import COLOURS as COLOURS_OF

LAWS = ("constant", "viscoelastic")
COLOURS = (COLOURS_OF["constant restitution"], COLOURS_OF["viscoelastic"])
"""Colours of the laws."""

PER_CELL = 20
"""Mean number of disks in the cells over which density and flow are measured.

Such a cell is smaller than a cluster."""

SPARE = 4.0
"""Capacity for pairs over that of a homogeneous gas, since clusters have more pairs."""

FACTORS = (1.05, 1.1, 1.2, 2.0)
"""Ratios of T to that of kinetic theory at which a gas counts as departed from it."""

UNEVEN = (1.5, 2.0)
"""Ratios of the unevenness to that of the elastic fluid at which a gas counts as departed."""

SLOPE_OVER = 6
"""Number of intervals between stored points over which a slope of ln T is fitted."""


def viscoelastic_like(gas: jaxgran.Gas) -> jaxgran.Gas:
    """Return viscoelastic disks with the same initial cooling rate of a Maxwellian gas."""
    theory = jaxgran.KineticTheory()

    def alike(beta: float) -> jaxgran.Gas:
        return beads(float(gas.packing_fraction), beta, dimension=gas.dimension)

    def excess(beta: float) -> float:
        return float(theory.cooling_rate(alike(beta)) - theory.cooling_rate(gas))

    return alike(root_scalar(excess, bracket=(1e-3, 3.0)).root)


def dissipation(gas: jaxgran.Gas) -> float:
    """Return gamma_0, half of the initial decrease of ln T per collision per particle."""
    return float(jaxgran.KineticTheory().cooling_rate(gas) / gas.collision_frequency) / 2


def follow(
    gas: jaxgran.Gas,
    seed: int,
    num_particles: int,
    until: float,
    keep: Collection[float] = (),
    progress: Callable[[float], None] = lambda collisions: None,
) -> dict:
    """Cool hard disks until each has made `until` collisions, in a sequence of short runs.

    Each run starts from the final particles of the one before and lasts about one collision per
    particle, or 3 % of those made so far. Its duration follows from the temperature reached.

    Args:
        gas: the disks.
        seed: random seed of the initial state, an equilibrated elastic gas.
        num_particles: number of disks.
        until: collisions per particle.
        keep: collisions per particle at which positions are stored.
        progress: called with the collisions per particle after every run.

    Returns:
        At the end of every run the collisions per particle, t (s), T, the unevenness, the share of
        the energy that is flow, and the regularised collisions per particle; positions in box sides
        at `keep`; wall seconds of the initial state and of the run.
    """
    began = time.perf_counter()
    # All runs have the same capacity, large enough for clusters, so that they compile once.
    sized = jaxgran.HardSpheres(num_particles).sized_for(gas, spare=SPARE)
    key = jax.random.key(seed)
    now = jaxgran.cool(gas, [0.0], model=sized, key=key, progress=False).particles
    assert now is not None
    started = time.perf_counter()
    rows, positions = [[0.0, 0.0, float(gas.temperature), *clusters(now), 0.0]], {}
    pace = 1.0  # mean time between collisions over the mean free time of a homogeneous gas
    while rows[-1][0] < until:
        collisions, t, temperature, *_, regularised = rows[-1]
        here = gas.replace(temperature=temperature)
        ahead = [x - collisions for x in (*keep, until) if x > collisions]
        planned = min(max(1.0, 0.03 * collisions), min(ahead) + 0.05)
        duration = planned * pace * float(here.mean_free_time)
        model = dataclasses.replace(sized, start=now)
        curve = jaxgran.cool(here, [duration], model=model, progress=False)
        assert curve.collisions is not None and curve.regularised is not None
        now, done = curve.particles, float(curve.collisions[-1])
        assert now is not None
        pace *= float(np.clip(planned / done, 0.5, 2.0))
        rows.append(
            [
                collisions + done,
                t + duration,
                float(curve.temperature[-1]),
                *clusters(now),
                regularised + float(curve.regularised[-1]),
            ]
        )
        for mark in keep:
            if collisions < mark <= rows[-1][0] + 0.02:
                positions[mark] = np.asarray(now.position[0] / now.box_side)
        progress(rows[-1][0])
    names = "collisions", "t", "temperature", "unevenness", "flow", "regularised"
    run = dict(zip(names, np.array(rows).T, strict=True))
    seconds = {"start_s": started - began, "run_s": time.perf_counter() - started}
    return run | seconds | {"positions": positions}


def clusters(particles: jaxgran.Particles) -> tuple[float, float]:
    """Return the unevenness of the density, and the share of the kinetic energy in the flow.

    Both are measured on square cells with `PER_CELL` disks on average. The unevenness is the
    variance of the number of disks in a cell over its mean: 1 for independent points, less for a
    fluid. The flow is the energy of the mean velocities of the cells over all kinetic energy, less
    the value expected of independent velocities.
    """
    place = np.asarray(particles.position[0] / particles.box_side) % 1.0
    velocity = np.asarray(particles.velocity[0])
    cells = max(2, round((len(place) / PER_CELL) ** 0.5))
    index = (cells * place).astype(int) % cells @ [cells, 1]
    number = np.bincount(index, minlength=cells**2)
    momentum = np.array([np.bincount(index, v, minlength=cells**2) for v in velocity.T])
    flow = np.sum(momentum**2 / np.maximum(number, 1)) / np.sum(velocity**2)
    chance = np.count_nonzero(number) / len(place)
    return float(np.var(number) / np.mean(number)), float((flow - chance) / (1 - chance))


def homogeneous(gas: jaxgran.Gas, run: dict) -> tuple[np.ndarray, np.ndarray]:
    """Return ln T of kinetic theory at the collisions per particle of a run, and at its times."""
    tau = np.concatenate([[0.0], np.geomspace(1e-2, 1e13, 800)])
    theory = jaxgran.cool(gas, jnp.asarray(tau) * gas.mean_free_time)
    assert theory.collisions is not None
    log_t = np.log(np.asarray(theory.temperature))
    at_times = np.interp(np.log1p(run["t"] / float(gas.mean_free_time)), np.log1p(tau), log_t)
    return np.interp(run["collisions"], np.asarray(theory.collisions), log_t), at_times


def crossing(x: np.ndarray, y: np.ndarray, level: float) -> float:
    """Return the first x at which y reaches a level, by linear interpolation; nan if never."""
    above = np.flatnonzero(y >= level)
    if not above.size or above[0] == 0:
        return float("nan")
    i = above[0]
    return float(x[i - 1] + (level - y[i - 1]) / (y[i] - y[i - 1]) * (x[i] - x[i - 1]))


def slope(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return dy/dx at each point, from a line fitted to it and its neighbours."""
    half = SLOPE_OVER // 2
    ends = [(max(i - half, 0), min(i + half, len(x) - 1) + 1) for i in range(len(x))]
    return np.array([np.polyfit(x[a:b], y[a:b], 1)[0] for a, b in ends])


def departures(run: dict, elastic: float) -> dict[str, dict[str, float]]:
    """Return N, T/T_0 and nu_0 t of the departure from kinetic theory, by each definition."""
    x = run["collisions"]
    at = {f"T over theory's of N by {c:g}": crossing(x, run["excess"], np.log(c)) for c in FACTORS}
    for c in FACTORS:
        at[f"T over theory's of t by {c:g}"] = crossing(x, run["excess_in_time"], np.log(c))
    share = run["slope"] / run["theory_slope"]
    at["ln T falls half as fast"] = crossing(x, -share, -0.5)
    for c in UNEVEN:
        at[f"unevenness over elastic by {c:g}"] = crossing(x, run["unevenness"], c * elastic)

    def there(collisions, name):
        if not np.isfinite(collisions):
            return float("nan")
        return float(np.exp(np.interp(collisions, x[1:], np.log(run[name][1:]))))

    return {
        name: {"N": n, "T": 1 / there(n, "clock"), "tau": there(n, "tau")} for name, n in at.items()
    }


def mean_error(values: Iterable[float]) -> list[float]:
    """Return mean and standard error; nan if one value is nan."""
    every = np.asarray(list(values))
    return [float(every.mean()), float(every.std(ddof=1) / len(every) ** 0.5)]
