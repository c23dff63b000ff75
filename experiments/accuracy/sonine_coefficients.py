"""Do a_2, a_3, D and T of kinetic theory agree with direct simulation?

    python experiments/accuracy/sonine_coefficients.py [--record] [--smoke] [--out DIR]

A direct simulation in NumPy (`experiments.support.boltzmann`) shares no code with jaxgran. It
computes the homogeneous cooling state at constant eps, and the evolution of a viscoelastic gas from
a Maxwellian start, in two and three dimensions. Prints the simulated values with their standard
errors, and their differences from kinetic theory.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxgran
from experiments.support.boltzmann import BLOCK, Boltzmann
from experiments.support.record import script_parser, write_picture, write_results
from experiments.support.scenes import beads, hard_beads
from jaxgran.plotting import COLOURS, INK

EPSILONS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0)
RELAXING = 20.0
"""Collisions per sphere before the cooling state is recorded."""

EFOLDS = 6.0
"""Relaxation times of D in one window; the missing fraction exp(-6) of D is added."""

WINDOWS = 6
LEAST = {3: 90.0, 2: 360.0}
"""Least collisions per sphere in all windows, by dimension: D scatters more in 2D."""

SEEDS = {3: 8, 2: 32}
"""Number of runs of a viscoelastic gas."""

MARKS = (1.0, 2.0, 4.0, 8.0, 15.0, 30.0, 60.0)
"""Collisions per sphere at which a viscoelastic gas is recorded."""

BETA = 0.15
MODEL = jaxgran.KineticTheory(softness=False, correlations=False)
NAMES = ("T/T_0", "a_2", "a_3", "D")


def cooling_state(d: int, eps: float, blocks: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Measure a_2, a_3 and D n sigma^(d-1)/sqrt(2 T), with errors from the scatter of windows."""
    gas = Boltzmann(eps, d, blocks, seed)
    gas.run(RELAXING)
    # Per collision D relaxes at this rate in the first Sonine approximation.
    window = EFOLDS / ((1 + eps) ** 2 / (2 * d))
    found = []
    for _ in range(max(WINDOWS, round(LEAST[d] / window))):
        gas.forget()
        samples = []
        for _ in range(steps := round(window / 1.5)):
            gas.run(window / steps)
            samples.append(gas.moments[1:])
        a2, a3, _ = np.mean(samples, axis=0)
        found.append([a2, a3, samples[-1][-1] / -np.expm1(-EFOLDS)])
    return np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / len(found) ** 0.5


def theory_of_state(d: int, eps: float) -> np.ndarray:
    """Return a_2, a_3 and the reduced D of the cooling state by kinetic theory."""
    gas = hard_beads(0.01, eps, d)
    loss = max((1 - eps**2) / (2 * d), 1e-9)
    times = jnp.expm1(80 * loss) / loss * jnp.array([0.5, 1.0]) * gas.mean_free_time
    return in_units(gas, jaxgran.cool(gas, times, model=MODEL))[1:, -1]


def in_units(gas: jaxgran.Gas, curve: jaxgran.CoolingCurve) -> np.ndarray:
    """Return T/T_0, a_2, a_3 and D n sigma^(d-1)/sqrt(2 T), shape (4, times)."""
    assert curve.sonine is not None and curve.third_sonine is not None
    assert curve.diffusion is not None
    theta = curve.temperature / gas.temperature
    # The contact value, which shortens the path length, is divided out.
    reduced = curve.diffusion / gas.path_length / jnp.sqrt(2 * curve.temperature)
    return np.stack([theta, curve.sonine, curve.third_sonine, reduced])


def law_of(gas: jaxgran.Gas) -> Callable[[np.ndarray], np.ndarray]:
    """Return eps of a normal speed in units of sqrt(T_0), from a table over its fourth root."""
    per_unit = 40_000
    g = (np.arange(2 * per_unit) / per_unit) ** 4
    table = np.asarray(1 - gas.reduced_law.loss(jnp.asarray(g / 2**0.5)), np.float32)

    def restitution(speed: np.ndarray) -> np.ndarray:
        return table[(np.sqrt(np.sqrt(speed)) * per_unit + 0.5).astype(np.int32)]

    return restitution


def error_model(d: int, blocks: int, seeds: int) -> dict:
    """Simulate a viscoelastic gas from a Maxwellian start, and compute theory at the same times."""
    gas = beads(0.01, BETA, dimension=d)
    runs = []
    for seed in range(seeds):
        own, rows = Boltzmann(law_of(gas), d, blocks, 100 + seed), []
        for more in np.diff(MARKS, prepend=0.0):
            own.run(more)
            rows.append([own.time, *own.moments])
        runs.append(rows)
    found = np.array(runs)
    # At a given N the time is random: theory is computed at the times of each run.
    unit = float(gas.path_length / gas.impact_speed) * 2**0.5
    off = np.stack(
        [r[:, 1:].T - in_units(gas, jaxgran.cool(gas, r[:, 0] * unit, model=MODEL)) for r in found]
    )
    values = np.mean(found[..., 1:], axis=0).T
    return {
        "dimension": d,
        "beta": BETA,
        "collisions": list(MARKS),
        "spheres": seeds * blocks * BLOCK,
        "simulated": values.tolist(),
        "off": (-np.mean(off, axis=0)).tolist(),
        "error": (np.std(off, axis=0, ddof=1) / seeds**0.5).tolist(),
    }


def draw(states: list[dict], courses: list[dict]) -> Figure:
    """Draw differences of theory in per cent, for constant eps and for T of viscoelastic gases."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    shades = {3: COLOURS["kinetic theory"], 2: COLOURS["soft spheres"]}
    titles = ("a₂ at constant ε", "D at constant ε", f"T of a viscoelastic gas, β = {BETA:g}")
    for axes, k, title in zip(panels, (0, 2, None), titles, strict=True):
        for d, style in ((3, "o-"), (2, "s--")):
            if k is None:
                (own,) = (c for c in courses if c["dimension"] == d)
                x = own["collisions"]
                value, off, error = (np.array(own[n][0]) for n in ("simulated", "off", "error"))
            else:
                some = [s for s in states if s["dimension"] == d]
                some = [s for s in some if k or (abs(s["simulated"][0]) > 0.01 and s["eps"] < 1)]
                x = [s["eps"] for s in some]
                value, off, error = (
                    np.array([s[n][k] for s in some]) for n in ("simulated", "off", "error")
                )
            scale, look = 100 / np.abs(value), {"fmt": style, "ms": 4, "color": shades[d]}
            axes.errorbar(x, off * scale, error * scale, label=f"{d}D", **look)
        axes.set(xlabel="ε", title=title, ylabel="theory − simulation (%)")
    panels[2].set(xlabel="collisions per particle", xscale="log")
    for axes in panels:
        axes.axhline(0, color=INK, lw=0.8)
        axes.legend(frameon=False, loc="upper left" if axes is panels[2] else "upper right")
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def say(title: str, value: np.ndarray, off: np.ndarray, error: np.ndarray) -> None:
    """Print simulated values, and how far theory is from them."""
    rows = zip(NAMES[-len(value) :], value, error, off, strict=True)
    words = (f"{name} {v:.5f} +- {e:.5f}, theory {o:+.5f}" for name, v, e, o in rows)
    print(f"{title}: {'; '.join(words)}", flush=True)


def main() -> None:
    options = script_parser(__doc__, "sonine_coefficients").parse_args()
    jax.config.update("jax_enable_x64", True)
    blocks, epsilons = (32, (0.5, 1.0)) if options.smoke else (256, EPSILONS)
    states = []
    for d in (3, 2):
        for k, eps in enumerate(epsilons):
            value, error = cooling_state(d, eps, blocks, seed=k)
            off = theory_of_state(d, eps) - value
            states.append(
                {"dimension": d, "eps": eps, "simulated": value.tolist(), "off": off.tolist()}
                | {"error": error.tolist()}
            )
            say(f"d = {d}, eps = {eps:g}", value, off, error)
    courses = [error_model(d, blocks, 2 if options.smoke else SEEDS[d]) for d in (3, 2)]
    for course in courses:
        columns = (np.array(course[name]).T for name in ("simulated", "off", "error"))
        for n, *row in zip(course["collisions"], *columns, strict=True):
            say(f"d = {course['dimension']}, beta = {BETA:g}, {n:g} collisions", *row)
    write_picture(draw(states, courses), "sonine_coefficients", options)
    path = options.out / "sonine_coefficients.json"
    write_results("sonine_coefficients", options, path, states=states, courses=courses)


if __name__ == "__main__":
    main()
