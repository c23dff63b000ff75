"""Do large runs of DSMC and hard spheres agree with theory and with published tables?

    python experiments/accuracy/particle_statistics.py [--only PART ...] [--record] [--smoke]
        [--out DIR]

Each part takes minutes, too long for a test, and writes a file of its own:

- dsmc_million: T of 12 million particles over that of kinetic theory;
- sonine: a_2 at constant restitution beside tables of stochastic simulation;
- sonine_coefficients: a_2, a_3 and D of DSMC in the cooling state of constant restitution, and how
  far those of kinetic theory are from them (the recorded ones are of an independent simulation in
  NumPy, `git show b50c940:experiments/accuracy/sonine_coefficients.py`);
- dsmc_order: the memory of the first velocity by steps of .1 and .05 less that by steps of .0125,
  with all pairs that may share a particle, half of them, or none;
- diffusion_published: D of elastic hard spheres;
- spins: T_rot/T and T of kinetic theory over those of DSMC for rough spheres;
- walls: ln T of hard spheres between walls less that of DSMC, which assumes a homogeneous gas.
"""

import dataclasses
from unittest import mock

import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.analysis import mean_and_error
from experiments.support.plots import INK, SOFT, THEORY, caption, panels
from experiments.support.record import Options, collected, run_parts
from experiments.support.scenes import cool, glass, hard_beads
from jaxgran import DSMC, HardSpheres
from jaxgran.particles.dsmc.collisions import Scheme
from jaxgran.particles.observables import third_sonine

CHAOS = jaxgran.KineticTheory(
    corrections=jaxgran.KineticTheory.all_corrections - {"softness", "correlations"}
)


def dsmc_million(options: Options):
    size, replicas = (1000, 2) if options.smoke else (10**6, 12)
    for beta, dimension in ((0.05, 3), (0.15, 3), (0.15, 2)):
        gas = glass(beta, dimension=dimension)
        times = np.array([10.0, 50.0, 100.0]) * float(gas.mean_free_time)
        curve = cool(gas, times, DSMC(size, replicas=replicas))
        off = curve.temperature / cool(gas, times, CHAOS).temperature - 1
        error = curve.temperature_error / curve.temperature
        yield {"beta": beta, "dimension": dimension, "off": off, "error": error}


TABLES = (
    (0.5, 3, 0.0476, 4e-4),
    (0.8, 3, -0.0145, 3e-4),
    (0.9, 3, -0.0152, 2e-4),
    (0.5, 2, 0.0733, 4e-4),
    (0.9, 2, -0.0301, 3e-4),
)
"""eps, dimension, a_2 and its error, by stochastic simulation."""


def sonine(options: Options):
    size, replicas = (1000, 2) if options.smoke else (100_000, 16)
    for eps, dimension, known, error in TABLES:
        gas = hard_beads(0.1, eps, dimension)
        times = in_collisions(gas, 10.0, 50.0)
        found = float(np.mean(cool(gas, times, DSMC(size, replicas=replicas)).sonine))
        row = {"eps": eps, "dimension": dimension, "found": found}
        yield row | {"known": known, "known_error": error}


def in_collisions(gas: jaxgran.Gas, first: float, last: float) -> np.ndarray:
    """Return times of so many collisions per particle by Haff's law, one for each."""
    half = max((1 - float(gas.value("coefficient")) ** 2) / gas.dimension / 2, 1e-9)
    return np.expm1(half * np.arange(first, last)) / half * float(gas.mean_free_time)


def sonine_coefficients(options: Options) -> dict:
    states = collected(coefficients_of_states(options.smoke))
    return {"states": states, "picture": draw_coefficients(states)}


def coefficients_of_states(smoke: bool):
    size, replicas = (20_000, 4) if smoke else (100_000, 16)
    for d in (3, 2):
        for eps in (0.5, 1.0) if smoke else (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0):
            gas = hard_beads(0.01, eps, d)
            times = in_collisions(gas, 20.0, 60.0)
            theory = cool(gas, times, CHAOS)
            model = DSMC(size, replicas=replicas)
            each = cool(gas, times, model, save=lambda x: third_sonine(x.velocity)).replicas
            # D n sigma^(d-1)/sqrt(2 T) of theory, which the displacements per collision scale.
            D = theory.diffusion[-1] / gas.path_length / jnp.sqrt(2 * theory.temperature[-1])
            expected = numbers(theory, theory.third_sonine)
            unit = np.array([1.0, 1.0, float(D) / expected[2]])
            value, error = mean_and_error(numbers(each, each.saved) * unit)
            row = {"simulated": value, "off": expected * unit - value, "error": error}
            yield {"dimension": d, "eps": eps} | row


def numbers(curve, a3) -> np.ndarray:
    """Return means over times of a_2, a_3 and of <dr^2> per collision, on the last axis."""
    spread = np.diff(curve.displacement) / np.diff(curve.collisions)
    return np.stack([np.mean(x, -1) for x in (curve.sonine, a3, spread)], -1)


def draw_coefficients(states: list[dict]):
    """Draw differences of theory in per cent."""
    figure, places = panels(2, size=(4.2, 3.6))
    shown = {"a₂ at constant ε": 0, "D at constant ε": 2}
    for axes, (title, k) in zip(places, shown.items(), strict=True):
        for d, style, colour in ((3, "o-", THEORY), (2, "s--", SOFT)):
            some = [s for s in states if s["dimension"] == d]
            some = [s for s in some if k or (abs(s["simulated"][0]) > 0.01 and s["eps"] < 1)]
            names = ("simulated", "off", "error")
            value, off, error = (np.array([s[n][k] for s in some]) for n in names)
            scale, look = 100 / np.abs(value), {"fmt": style, "ms": 4, "color": colour}
            x = [s["eps"] for s in some]
            axes.errorbar(x, off * scale, error * scale, label=f"{d}D", **look)
        axes.axhline(0, color=INK, lw=0.8)
        caption(axes, title, xlabel="ε", ylabel="theory − simulation (%)")
    return figure


def dsmc_order(options: Options):
    gas, of = hard_beads(0.1, 0.6), Scheme.build
    size, replicas = (1000, 2) if options.smoke else (400_000, 16)
    times = [float(gas.mean_free_time)]

    def memory(step, shared, seed):
        def scheme(*arguments):
            made = of(*arguments)
            second = round(shared * made.second)
            return made._replace(first=made.first + made.second - second, second=second)

        with mock.patch.object(Scheme, "build", scheme):
            each = cool(gas, times, DSMC(size, replicas=replicas, step=step), seed).replicas
        return mean_and_error(np.log(each.velocity_correlation[:, 0] / gas.temperature))

    fine, its_error = memory(0.0125, 1.0, 0)
    for shared in (1.0, 0.5, 0.0):
        for step in (0.1, 0.05):
            own, error = memory(step, shared, 1)
            off = {"off": float(own - fine), "error": float(np.hypot(error, its_error))}
            yield {"shared": shared, "step": step} | off


def diffusion_published(options: Options):
    """Erpenbeck & Wood, Phys. Rev. A 43 (1991) 4254, whose coefficients were not checked.

    A periodic box lowers D by 2.84 T / (6 pi eta L) to first order in 1/L (Yeh & Hummer, J. Phys.
    Chem. B 108 (2004) 15873).
    """
    size, replicas = (100, 2) if options.smoke else (4096, 16)
    for phi in (0.1, 0.2, 0.3):
        gas = hard_beads(phi, 1.0)
        times = gas.mean_free_time * jnp.linspace(60, 100, 5)
        curve = cool(gas, times, HardSpheres(size, replicas=replicas))
        slopes = np.polyfit(times, np.asarray(curve.replicas.displacement).T, 1)[0] / 6
        D, error = mean_and_error(slopes / (gas.diameter * jnp.sqrt(gas.temperature)))
        n, contact = 6 / np.pi * phi, float(gas.contact_value)
        met, y = 2 * np.pi / 3 * n * contact, n / 2**0.5
        first_sonine = 3 / (8 * n * np.pi**0.5 * contact)
        viscosity = 5 / (16 * np.pi**0.5) * 2 * np.pi / 3 * n * (1 / met + 0.8 + 0.7614 * met)
        box = 2.837 / (6 * np.pi * viscosity * float(gas.box_side(size) / gas.diameter))
        infinite = 1.01896 * first_sonine * (1 + 0.054034 * y + 6.3656 * y**2 - 10.9425 * y**3)
        yield {"phi": phi, "off": (D + box) / infinite - 1, "error": error / infinite}


ROUGH = (
    (None, 0.5, 0.7, 1.0),
    (None, 0.0, 0.7, 0.0),
    (0.05, 0.5, 0.9, 0.0),
    (0.05, 0.5, 0.9, 1.0),
    (0.1, 0.0, 0.9, 1.0),
    (0.2, 0.0, 0.8, 1.0),
    (0.2, 1.0, 0.7, 0.0),
    (1.0, 0.5, 0.8, 0.0),
)
"""mu, beta_t, eps, and T_rot/T at t = 0."""


def spins(options: Options):
    size, replicas = (1000, 2) if options.smoke else (50_000, 4)
    for dimension in (3, 2):
        for mu, beta, eps, ratio in ROUGH:
            gas = hard_beads(0.02, eps, dimension)
            T_rot = ratio * float(gas.temperature)
            surface = jaxgran.Rough(beta, rotational_temperature=T_rot, friction=mu)
            gas = dataclasses.replace(gas, surface=surface)
            times = np.array([1.0, 3.0, 10.0, 30.0, 100.0]) * float(gas.mean_free_time)
            simulated = cool(gas, times, DSMC(size, replicas=replicas))
            row = {"dimension": dimension, "mu": mu, "beta": beta, "eps": eps, "ratio": ratio}
            gaussian = {*CHAOS.corrections} - {"spin_cumulants"}
            for name, corrections in (("off", CHAOS.corrections), ("gaussian", gaussian)):
                theory = cool(gas, times, dataclasses.replace(CHAOS, corrections=corrections))
                T = theory.temperature / simulated.temperature
                row[f"T_{name}"] = T - 1
                ratios = theory.rotational_temperature / simulated.rotational_temperature / T
                row[name] = ratios - 1
            yield row


def walls(options: Options):
    for size, last in ((100, 0.006), (500, 0.04), (4000, 0.1)):
        phi = size * np.pi / 6 * (2e-3 / 0.05) ** 3
        container = jaxgran.Walls(0.05, restitution=0.8)
        gas = dataclasses.replace(glass(0.15, phi), container=container)
        theory = cool(gas, jnp.geomspace(1e-2, 1e3, 200))
        fallen = jnp.log(theory.temperature / gas.temperature)[::-1]
        times = jnp.interp(jnp.log(jnp.array([0.5, last])), fallen, theory.times[::-1])
        replicas = 2 if options.smoke else max(2, 3200 // size)
        hard = cool(gas, times, HardSpheres(size, replicas=replicas))
        dsmc = cool(gas, times, DSMC(1000 if options.smoke else 100_000))
        off = np.log(np.asarray(hard.temperature / dsmc.temperature))
        error = hard.temperature_error / hard.temperature
        yield {"num_particles": size, "off": off, "error": error}


if __name__ == "__main__":
    tables = dsmc_million, sonine, dsmc_order, diffusion_published, spins, walls
    run_parts(__doc__, *tables, sonine_coefficients)
