"""How does a gas cool if 1 - eps is any power of the impact speed, or eps as measured on ice?

    python experiments/paper/paper_exponents.py [--smoke] [--out DIR]

The paper's closing remark considers eps = 1 - c v^gamma with exponents other than 1/5. Then
dT/dt ~ -T^((3 + gamma)/2), T ~ t^(-2/(1 + gamma)) and <dr^2> ~ t^(gamma/(1 + gamma)). Ice as
measured by Bridges, Hatzes & Lin (Nature 309, 333, 1984), eps = min(1, 0.34 v^-0.234) with v in
cm/s, is not such a power law: the exponent of its T(t) changes with time. Uses theory and DSMC.
"""

from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.ticker import NullFormatter

import jaxgran
from experiments.support import paper
from experiments.support.scenes import beads
from jaxgran._utils.validation import POSITIVE, Domain, float_array

SHADES = ("#084594", "#2171b5", "#6baed6", "#bdc9e1")
"""Colours from the smallest gamma to the largest, from dark to light."""
NAME = "paper_exponents"


@dataclass(frozen=True)
class Config:
    gammas: tuple[float, ...] = (0.0, 0.2, 0.5, 1.0)
    loss: float = 0.15  # 1 - epsilon at the thermal speed, sqrt(2 T_0)
    ice_speed: float = 0.01  # sqrt(2 T_0) of the ice, m/s
    packing_fraction: float = 0.05
    num_particles: int = 5000
    replicas: int = 8
    seed: int = 3
    last: float = 1e5  # mean free times simulated
    last_theory: float = 1e8
    points: int = 19


SMOKE = Config(gammas=(0.0, 1.0), num_particles=1000, replicas=2, last=100.0, points=7)


class Ice(jaxgran.RestitutionLaw, jaxgran.ReducedLaw):
    """``eps = min(1, (v/v_1)^(-p))``: elastic below v_1, decreasing with the speed above."""

    threshold: Float[Array, ""] = eqx.field(
        converter=float_array, default=0.01 * 0.34 ** (1 / 0.234)
    )
    exponent: Float[Array, ""] = eqx.field(converter=float_array, default=0.234)

    domains: ClassVar[dict[str, Domain]] = {"threshold": POSITIVE, "exponent": POSITIVE}

    def reduced(self, *, diameter, mass, speed) -> "Ice":
        return Ice(self.threshold / speed, self.exponent)

    def restitution(self, normal_speed):
        return jnp.minimum(1.0, (normal_speed / self.threshold) ** -self.exponent)


def maxwellian(gas: jaxgran.Gas, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return T/T_0 of a Maxwellian gas of any law, and gamma = d ln <1 - eps^2> / d ln sqrt(T).

    ``d ln T/d tau = -<1 - eps^2> sqrt(T/T_0)/3`` with the mean weighted by ``g^3 exp(-g^2/2)``,
    computed as a sum over a fine grid, since `jaxgran.KineticTheory` requires a smooth law, unlike
    that of ice.
    """
    theta = np.geomspace(1.0, 1e-7, 1500)
    g = (np.arange(4000) + 0.5) / 400
    weight = g**3 * np.exp(-(g**2) / 2)
    eps = np.asarray(gas.reduced_law.restitution(jnp.asarray(g * np.sqrt(theta)[:, None])))
    lost = np.maximum((1 - eps**2) @ weight / weight.sum(), 1e-300)
    pace = 3 / (lost * np.sqrt(theta))
    passed = np.cumsum((pace[1:] + pace[:-1]) / 2 * -np.diff(np.log(theta)))
    at = np.exp(np.interp(tau, np.concatenate([[0.0], passed]), np.log(theta)))
    gamma = 2 * np.gradient(np.log(lost), np.log(theta))
    return at, np.interp(-np.log(at), -np.log(theta), gamma)


def gas_of(gamma: float, config: Config) -> jaxgran.Gas:
    """Return beads with 1 - eps = loss (v/sqrt(2 T_0))^gamma."""
    scene = beads(config.packing_fraction, 0.1)
    coefficient = -config.loss / float(scene.impact_speed) ** gamma
    return eqx.tree_at(
        lambda gas: gas.law, scene, jaxgran.RestitutionSeries([coefficient], [gamma])
    )


def main() -> None:
    options = paper.options(__doc__, NAME)
    config = SMOKE if options.smoke else Config()
    clock = paper.Clock()
    figure = paper.figure(
        "1 − ε ~ v$^γ$ cools as t$^{−2/(1+γ)}$; ice has no fixed exponent and becomes elastic",
        columns=3,
    )
    cooling, exponents, ice = figure.axes
    colors = dict(zip(config.gammas, SHADES, strict=False))
    tau = np.geomspace(0.1, config.last_theory, 181)
    measured = np.geomspace(0.1, config.last, config.points)
    key = jax.random.key(config.seed)
    model = jaxgran.DSMC(config.num_particles, config.replicas)
    frozen = jaxgran.Gas(
        Ice(),
        diameter=0.02,
        mass=jaxgran.sphere_mass(0.02, 900.0),
        packing_fraction=config.packing_fraction,
        temperature=config.ice_speed**2 / 2,
    )
    gases: dict[str, tuple[jaxgran.Gas, str, float | None]] = {
        f"γ = {gamma:g}": (gas_of(gamma, config), colors[gamma], gamma) for gamma in config.gammas
    }
    gases["ice"] = (frozen, paper.INK, None)
    found = {}
    for name, (gas, color, gamma) in gases.items():
        start = float(gas.temperature)
        of = jaxgran.cool(gas, tau * gas.mean_free_time)
        dsmc = jaxgran.cool(gas, measured * gas.mean_free_time, model=model, key=key)
        theta, spread = np.asarray(of.temperature) / start, np.asarray(of.displacement)
        each = paper.replicas_of(dsmc, "temperature") / start
        mean, error = paper.mean_and_error(each)
        at, local = paper.slope(measured, each)
        local_mean, local_error = paper.mean_and_error(local)
        where, expected = paper.slope(tau, theta)
        dots = {"fmt": "o", "ms": 3.5, "color": color}
        if gamma is None:
            usual = theta
            theta, steepness = maxwellian(gas, tau)
            where, expected = paper.slope(tau, theta)
            speed = 100 * config.ice_speed * np.sqrt(theta)
            seen = 100 * config.ice_speed * np.sqrt(np.sqrt(mean[1:] * mean[:-1]))
            aged, old = at > 100, tau > 100  # past the initial transient
            ice.plot(speed[1:][old[1:]], expected[old[1:]], color=color, label="theory, Maxwellian")
            ice.errorbar(seen[aged], local_mean[aged], local_error[aged], label="DSMC", **dots)
            label = "−2/(1 + γ), γ = d ln⟨1 − ε²⟩ / d ln T$^{1/2}$"
            ice.plot(speed[old], -2 / (1 + steepness[old]), ":", color=paper.GUIDE, label=label)
            off = np.abs(usual / theta - 1) < 0.03
            found["ice_by_kinetic_theory_fails_from"] = (
                float(tau[~off][0]) if (~off).any() else None
            )
        else:
            exponents.plot(
                where, expected, color=color, label=f"{name}: −2/(1 + γ) = {-2 / (1 + gamma):.3g}"
            )
            exponents.errorbar(at, local_mean, local_error, **dots)
            exponents.axhline(-2 / (1 + gamma), color=color, ls=":", lw=1)
        cooling.plot(tau, theta, color=color, label=name)
        cooling.errorbar(measured, mean, error, **dots)
        miss = mean / np.exp(np.interp(np.log(measured), np.log(tau), np.log(theta))) - 1
        found[name] = {
            "paper_exponent": None if gamma is None else -2 / (1 + gamma),
            "paper_displacement_exponent": None if gamma is None else gamma / (1 + gamma),
            "exponent": float(local_mean[-1]),
            "exponent_error": float(local_error[-1]),
            "exponent_of_theory": float(
                np.diff(np.log(np.interp(measured[-2:], tau, theta)))[0]
                / np.diff(np.log(measured[-2:]))[0]
            ),
            "last_exponent_of_theory": float(expected[-1]),
            "last_displacement_exponent": float(paper.slope(tau, spread)[1][-1]),
            "dsmc_from_theory": paper.listed(miss),
            "standard_error": paper.listed(error / mean),
            "tau": paper.listed(measured),
            "temperature": paper.listed(mean),
            "last_temperature": float(theta[-1]),
        }
        row = found[name]
        early, late = row["exponent_of_theory"], row["last_exponent_of_theory"]
        print(
            f"{name}: exponent {row['exponent']:.3f} +- {row['exponent_error']:.3f} at "
            f"{at[-1]:.2g} tau_c (theory {early:.3f}, {late:.3f} at {where[-1]:.1g}; paper "
            f"{row['paper_exponent']}); of <dr^2> {row['last_displacement_exponent']:.3f}; "
            f"DSMC from theory {100 * miss.min():+.2f} to {100 * miss.max():+.2f} %"
        )
    found["ice"]["threshold_cm_per_s"] = 100 * float(Ice().threshold)
    paper.caption(
        cooling,
        "Temperature: — theory, ● DSMC",
        xlabel="time t / τ$_c$(0)",
        ylabel="T / T$_0$",
        xscale="log",
        yscale="log",
    )
    labels = {"xlabel": "time t / τ$_c$(0)", "ylabel": "d ln T / d ln t"}
    paper.caption(exponents, "Local exponents; dotted: −2/(1 + γ)", xscale="log", **labels)
    labels = {"xlabel": "thermal speed (2T)$^{1/2}$, cm/s", "ylabel": "d ln T / d ln t"}
    title = (
        f"Ice: elastic below {found['ice']['threshold_cm_per_s']:.3f} cm/s; time runs to the left"
    )
    paper.caption(ice, title, xscale="log", ylim=(-2.1, 0.05), **labels)
    ice.xaxis.set_minor_formatter(NullFormatter())
    paper.write(figure, options, NAME, config, clock, **found)


if __name__ == "__main__":
    main()
