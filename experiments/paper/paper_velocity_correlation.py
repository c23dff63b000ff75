"""How fast does the velocity autocorrelation function of a cooling gas decay?

    python experiments/paper/paper_velocity_correlation.py [--smoke] [--out DIR]

Measures the velocity autocorrelation <v(t').v(t)> of elastic spheres and of spheres of constant and
viscoelastic restitution, by DSMC and by hard and soft spheres: its decay, and its relaxation time
tau_v, compared with the elastic Enskog time tau_E (paper, Eqs. (24), (31), (32)).

DSMC starts from Maxwellian velocities at T(t'). Hard and soft spheres first cool until t' and
continue from the state reached there; elastic spheres, whose state does not change, start at once.
Soft spheres support the viscoelastic law only.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import simpson

import jaxgran
from experiments.support import paper
from experiments.support.scenes import beads, hard_beads
from jaxgran.theory.averages import Rates, collision_rate, impact_moments
from jaxgran.theory.equations import paper_averages

NAME = "paper_velocity_correlation"
SPHERES = {"hard_spheres": jaxgran.HardSpheres, "soft_spheres": jaxgran.SoftSpheres}
MARKERS = {"dsmc": ("o", 3), "hard_spheres": ("s", 1), "soft_spheres": ("^", 1)}
"""Marker of each model in the picture, and step between drawn points."""


@dataclass(frozen=True)
class Config:
    packing_fraction: float = 0.05
    beta: float = 0.3
    num_particles: int = 50_000
    replicas: int = 8
    seed: int = 0
    lags: int = 61
    longest: float = 12.0  # in tau_E(t')
    restitutions: tuple[float, ...] = (1.0, 0.8, 0.6, 0.4, 0.2)
    betas: tuple[float, ...] = (0.05, 0.15, 0.3, 0.6, 1.0)
    num_spheres: int = 2000  # in a box
    boxes: int = 4
    age: float = 6.0  # t' of hard and soft spheres, in tau_c(0)
    sphere_lags: int = 25


SMOKE = replace(
    Config(),
    num_particles=2000,
    replicas=4,
    restitutions=(1.0, 0.6),
    betas=(0.3,),
    boxes=0,
)


def enskog_time(gas: jaxgran.Gas) -> float:
    """Return tau_E = (3/2) tau_c of the gas at its initial temperature."""
    return 1.5 * float(gas.mean_free_time)


@partial(jax.jit, static_argnames="dimension")
def relaxation(law, theta, sonine, dimension: int):
    """Return nu_v and the collision rate, in reduced units, at temperatures theta = T/T_0."""

    def one(theta, sonine):
        rates = Rates.from_averages(impact_moments(law, jnp.sqrt(theta), dimension), sonine)
        return jnp.stack([rates.relaxation, collision_rate(sonine, dimension)])

    return (jax.vmap(one)(theta, sonine) * jnp.sqrt(theta)[:, None]).T


def theory(gas: jaxgran.Gas, lags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return <v(0).v(t)>/(d T_0) = exp(-int nu_v dt) and the collisions per particle.

    The lags, in tau_E, must be dense enough for the trapezoidal rule.
    """
    times = lags * enskog_time(gas)
    curve = jaxgran.cool(
        gas, times, model=jaxgran.KineticTheory(softness=False, correlations=False)
    )
    theta = curve.temperature / gas.temperature
    nu = relaxation(gas.reduced_law, theta, curve.sonine, gas.dimension)[0]
    nu = np.asarray(nu * gas.impact_speed / gas.path_length)
    passed = np.concatenate([[0.0], np.cumsum((nu[1:] + nu[:-1]) / 2 * np.diff(times))])
    return np.exp(-passed), np.asarray(curve.collisions)


def stochastic(gas: jaxgran.Gas, config: Config) -> dict:
    """Compute the autocorrelation by DSMC from a Maxwellian start, its tau_v and its integral."""
    lags = np.linspace(0, config.longest, config.lags)
    model = jaxgran.DSMC(config.num_particles, config.replicas)
    key = jax.random.key(config.seed)
    curve = jaxgran.cool(gas, lags * enskog_time(gas), model=model, key=key)
    return summary(curve, lags, float(gas.temperature))


def summary(curve: jaxgran.CoolingCurve, lags: np.ndarray, temperature: float) -> dict:
    """Return means and standard errors over the replicas, as lists and numbers for JSON."""
    each = paper.replicas_of(curve, "velocity_correlation")
    each = each / each[:, :1]
    collisions = paper.replicas_of(curve, "collisions").mean(axis=0)
    early = (collisions > 0) & (collisions < 2.5)
    # Early -ln C = r N + s N^2: the relaxation time is 1/r collisions, and tau_E is 3/2 collisions.
    basis = np.stack([collisions[early], collisions[early] ** 2], axis=1)
    fits = np.linalg.lstsq(basis, -np.log(each[:, early]).T, rcond=None)[0][0]
    times = {
        "relaxation": 2 / 3 / fits,
        "integral": simpson(each, x=lags, axis=1),
    }
    correlation, error = paper.mean_and_error(each)
    row = {"lags": lags, "collisions": collisions, "correlation": correlation, "error": error}
    row = {name: paper.listed(values) for name, values in row.items()}
    for name, values in times.items():
        mean, its_error = paper.mean_and_error(values)
        row |= {name: float(mean), f"{name}_error": float(its_error)}
    return row


def in_boxes(gas: jaxgran.Gas, config: Config, ages: bool) -> dict[str, dict]:
    """Compute it by every sphere model that supports the gas; empty if `config.boxes` is 0."""
    kinds = SPHERES if isinstance(gas.law, jaxgran.Viscoelastic) else ["hard_spheres"]
    return {
        kind: spheres(SPHERES[kind](config.num_spheres, replicas=config.boxes), gas, config, ages)
        for kind in kinds
        if config.boxes
    }


def spheres(model, gas: jaxgran.Gas, config: Config, ages: bool) -> dict:
    """Compute it in boxes of spheres, from t' on, and D from the slope of <dr^2> there."""
    age, key = config.age * float(gas.mean_free_time), jax.random.key(config.seed)
    grown = jaxgran.cool(gas, [age / 2, age] if ages else [age / 100], model=model, key=key)
    temperature = float(grown.temperature[-1])
    later = replace(model, start=grown.particles)
    aged = gas.replace(temperature=temperature)
    lags = np.linspace(0, config.longest, config.sphere_lags)
    curve = jaxgran.cool(aged, lags * enskog_time(aged), model=later)
    row = summary(curve, lags, temperature)
    # From 4 tau_E on the velocities at t' no longer matter, whatever the age.
    i = int(np.searchsorted(lags, 4.0))
    (slope,), (error,) = diffusion(curve, aged, slice(i, None, len(lags) - 1 - i))
    row |= {"slope": float(slope), "slope_error": float(error)}
    return row | {"temperature": temperature / float(gas.temperature)}


def diffusion(
    curve: jaxgran.CoolingCurve, gas: jaxgran.Gas, which: slice
) -> tuple[np.ndarray, np.ndarray]:
    """Return d<dr^2>/(6 T tau_E dt) between times, where T tau_E dt ~ sqrt(T) dt ~ dN."""
    spread = paper.replicas_of(curve, "displacement")[:, which]
    collisions = paper.replicas_of(curve, "collisions")[:, which]
    unit = 9 * float(gas.temperature * gas.mean_free_time**2)
    return paper.mean_and_error(np.diff(spread) / np.diff(collisions) / unit)


def main() -> None:
    options = paper.options(__doc__, NAME)
    config = SMOKE if options.smoke else Config()
    clock = paper.Clock()
    phi = config.packing_fraction
    viscoelastic = beads(phi, config.beta)
    e = paper.alike(viscoelastic)
    gases = {
        "elastic": (hard_beads(phi, 1.0), paper.ELASTIC, "elastic"),
        "constant": (hard_beads(phi, e), paper.CONSTANT, f"constant ε = {e:.3f}"),
        "viscoelastic": (viscoelastic, paper.VISCOELASTIC, f"viscoelastic, β = {config.beta}"),
    }
    figure = paper.figure(
        "Dissipation lengthens the paths: velocities decay nearly exponentially in collisions,"
        " more slowly in time",
        columns=3,
    )
    decay, counted, times = figure.axes
    found, lags = {}, np.linspace(0, config.longest, 601)
    for name, (gas, color, label) in gases.items():
        expected, collisions = theory(gas, lags)
        row: dict[str, Any] = {"dsmc": stochastic(gas, config)}
        row["paper_relaxation"] = float(printed_relaxation(gas))
        row["exact_relaxation"] = float(exact_relaxation(gas))
        row |= in_boxes(gas, config, ages=name != "elastic")
        decay.plot(lags, expected, color=color, label=f"{label}: theory")
        decay.plot(lags, np.exp(-lags / row["paper_relaxation"]), "--", color=color, lw=0.9)
        counted.plot(collisions, expected, color=color, label=f"{label}: theory")
        for kind in [kind for kind in MARKERS if kind in row]:
            marker, every = MARKERS[kind]
            of = {k: np.array(v)[::every] for k, v in row[kind].items() if isinstance(v, list)}
            seen = of["correlation"] > 4 * of["error"]
            style = {"fmt": marker, "ms": 3.5, "color": color}
            style |= {"mfc": "none"} if kind in SPHERES else {}
            for axes, x in ((decay, of["lags"]), (counted, of["collisions"])):
                axes.errorbar(x[seen], of["correlation"][seen], of["error"][seen], **style)
        found[name] = row
    shared = {"yscale": "log", "ylim": (2e-3, 1.2), "ylabel": "⟨v(t′)·v(t)⟩ / ⟨v(t′)²⟩"}
    kinds = "● DSMC, □ hard, △ soft spheres, — theory"
    title = f"Over time: slower than exp(−(t−t′)/τ$_v$(t′)), dashed\n{kinds}"
    paper.caption(decay, title, xlabel="(t − t′) / τ$_E$(t′)", xlim=(0, 9), **shared)
    title = f"Over collisions: nearly exponential\n{kinds}"
    paper.caption(counted, title, xlabel="collisions per particle since t′", xlim=(0, 9), **shared)
    found["relaxation"] = relaxation_times(times, config)
    for name in gases:
        row = found[name]
        measured = [
            f"{row[kind]['relaxation']:.3f} +- {row[kind]['relaxation_error']:.3f} ({kind})"
            for kind in MARKERS
            if kind in row
        ]
        printed = row["paper_relaxation"]
        print(f"{name}: tau_v/tau_E {', '.join(measured)}, paper {printed:.3f}")
    paper.write(figure, options, NAME, config, clock, restitution=e, **found)


def exact_relaxation(gas: jaxgran.Gas) -> jax.Array:
    """Return tau_v/tau_E of the Maxwellian gas at its initial temperature, for any law."""
    nu, rate = relaxation(gas.reduced_law, jnp.ones(1), jnp.zeros(1), gas.dimension)
    return (2 / 3 * rate / nu)[0]


def printed_relaxation(gas: jaxgran.Gas) -> jax.Array:
    """Return tau_v/tau_E by Eq. (31), or by the two terms of Eq. (32)."""
    if isinstance(gas.law, jaxgran.ConstantRestitution):
        return 2 / (1 + gas.law.coefficient)
    one = jnp.ones(())
    nu = paper_averages(gas.reduced_law, one, gas.dimension)[2, 0]
    return 2 / 3 * collision_rate(0.0, gas.dimension) / nu


def relaxation_times(axes, config: Config) -> dict:
    """Draw tau_v/tau_E for several strengths of dissipation over 1 - eps at the thermal speed."""
    short = replace(config, longest=2.0, lags=11)
    phi, found = config.packing_fraction, {}
    laws = {
        "constant": ([hard_beads(phi, e) for e in config.restitutions], paper.CONSTANT),
        "viscoelastic": ([beads(phi, b) for b in config.betas], paper.VISCOELASTIC),
    }
    for name, (gases, color) in laws.items():
        lost = [1 - float(gas.reduced_law.restitution(jnp.ones(()))) for gas in gases]
        rows = [stochastic(gas, short) for gas in gases]
        values = [row["relaxation"] for row in rows]
        errors = [row["relaxation_error"] for row in rows]
        axes.errorbar(lost, values, errors, fmt="o", ms=4, color=color, label=f"{name}: DSMC")
        found[name] = {
            "lost": lost,
            "measured": values,
            "error": errors,
            "exact": paper.listed(exact_relaxation(gas) for gas in gases),
            "paper": paper.listed(printed_relaxation(gas) for gas in gases),
        }
    x = np.linspace(0, 0.85, 60)
    axes.plot(x, 2 / (2 - x), color=paper.CONSTANT, label="Eq. (31): 2 / (1 + ε)")
    line = [beads(phi, b) for b in np.linspace(1e-3, 1.15, 40)]
    x = [1 - float(gas.reduced_law.restitution(jnp.ones(()))) for gas in line]
    exact = [float(exact_relaxation(gas)) for gas in line]
    two = [float(printed_relaxation(gas)) for gas in line]
    axes.plot(x, exact, color=paper.VISCOELASTIC, label="exact average of ε(v)")
    axes.plot(x, two, "--", color=paper.VISCOELASTIC, lw=1, label="Eq. (32), two terms")
    labels = {"xlabel": "1 − ε at the thermal speed", "ylabel": "initial τ$_v$ / τ$_E$"}
    paper.caption(axes, "The relaxation time, from the initial slope", **labels)
    return found


if __name__ == "__main__":
    main()
