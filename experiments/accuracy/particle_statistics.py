"""Do large runs of DSMC and hard spheres agree with theory and with published tables?

    python experiments/accuracy/particle_statistics.py [--only PART ...] [--record] [--smoke]
        [--out DIR]

Each part takes minutes, too long for a test, and writes a file of its own:

- dsmc_million: T of 12 million particles over that of kinetic theory;
- sonine: a_2 at constant restitution beside tables of stochastic simulation;
- dsmc_order: the memory of the first velocity by steps of .1 and .05 less that by steps of .0125,
  with all pairs that may share a particle, half of them, or none;
- diffusion_published, diffusion_500: D of elastic hard spheres;
- hard_sensitivity: d ln T / d ln A of hard spheres beside a reference table;
- hard_derivatives: the same over finite differences, below L_c and in a box of 1.1 L_c;
- walls: ln T of hard spheres between walls less that of DSMC, which assumes a homogeneous gas.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxgran
from experiments.support.record import script_parser, write_results
from experiments.support.scenes import beads, hard_beads
from jaxgran import DSMC, HardSpheres
from jaxgran.particles.dsmc.collisions import Scheme


def glass(beta: float, packing_fraction: float = 0.05, dimension: int = 3) -> jaxgran.Gas:
    """Return beads of Y = 5e7 Pa."""
    gas = beads(packing_fraction, beta, dimension=dimension).replace(youngs_modulus=5e7)
    return gas.replace(dissipative_constant=gas.dissipative_constant * beta / gas.thermal_beta)


def cool(gas, times, model, key=0) -> Any:
    return jaxgran.cool(gas, times, model=model, key=jax.random.key(key), progress=False)


def of_replicas(values) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean over replicas and its standard error."""
    values = np.asarray(values)
    return values.mean(axis=0), values.std(axis=0, ddof=1) / len(values) ** 0.5


def dsmc_million(smoke: bool):
    size, replicas = (1000, 2) if smoke else (10**6, 12)
    theory = jaxgran.KineticTheory(softness=False, correlations=False)
    for beta, dimension in ((0.05, 3), (0.15, 3), (0.15, 2)):
        gas = glass(beta, dimension=dimension)
        times = np.array([10.0, 50.0, 100.0]) * float(gas.mean_free_time)
        curve = cool(gas, times, DSMC(size, replicas=replicas))
        off = np.asarray(curve.temperature / cool(gas, times, theory).temperature - 1)
        error = np.asarray(curve.temperature_error / curve.temperature)
        yield {"beta": beta, "dimension": dimension, "off": off.tolist(), "error": error.tolist()}


TABLES = (
    (0.5, 3, 0.0476, 4e-4),
    (0.8, 3, -0.0145, 3e-4),
    (0.9, 3, -0.0152, 2e-4),
    (0.5, 2, 0.0733, 4e-4),
    (0.9, 2, -0.0301, 3e-4),
)
"""eps, dimension, a_2 and its error, by stochastic simulation."""


def sonine(smoke: bool):
    size, replicas = (1000, 2) if smoke else (100_000, 16)
    for eps, dimension, known, error in TABLES:
        gas = hard_beads(0.1, eps, dimension)
        half = (1 - eps**2) / dimension / 2
        # Times of 10 to 50 collisions per particle by Haff's law.
        times = np.expm1(half * np.arange(10.0, 50.0)) / half * float(gas.mean_free_time)
        found = float(np.mean(cool(gas, times, DSMC(size, replicas=replicas)).sonine))
        row = {"eps": eps, "dimension": dimension, "found": found}
        yield row | {"known": known, "known_error": error}


def dsmc_order(smoke: bool):
    gas, of = hard_beads(0.1, 0.6), Scheme.of
    size, replicas = (1000, 2) if smoke else (400_000, 16)
    times = [float(gas.mean_free_time)]

    def memory(step, shared, seed):
        def scheme(*arguments):
            made = of(*arguments)
            second = round(shared * made.second)
            return made._replace(first=made.first + made.second - second, second=second)

        setattr(Scheme, "of", staticmethod(scheme))  # noqa: B010
        each = cool(gas, times, DSMC(size, replicas=replicas, step=step), seed).replicas
        setattr(Scheme, "of", staticmethod(of))  # noqa: B010
        return np.log(each.velocity_correlation[:, 0] / gas.temperature)

    fine, its_error = of_replicas(memory(0.0125, 1.0, 0))
    for shared in (1.0, 0.5, 0.0):
        for step in (0.1, 0.05):
            own, error = of_replicas(memory(step, shared, 1))
            off = {"off": float(own - fine), "error": float(np.hypot(error, its_error))}
            yield {"shared": shared, "step": step} | off


def diffusion(packing_fraction, size, replicas, begin):
    """Return the gas, with D of its elastic spheres and its standard error, over sigma sqrt(T)."""
    gas = hard_beads(packing_fraction, 1.0)
    times = gas.mean_free_time * jnp.linspace(begin, begin + 40, 5)
    curve = cool(gas, times, HardSpheres(size, replicas=replicas))
    slopes = np.polyfit(times, np.asarray(curve.replicas.displacement).T, 1)[0] / 6
    D, error = of_replicas(slopes / (gas.diameter * jnp.sqrt(gas.temperature)))
    return gas, D, error


def diffusion_published(smoke: bool):
    """Erpenbeck & Wood, Phys. Rev. A 43 (1991) 4254, whose coefficients were not checked.

    A periodic box lowers D by 2.84 T / (6 pi eta L) to first order in 1/L (Yeh & Hummer, J. Phys.
    Chem. B 108 (2004) 15873).
    """
    size, replicas = (100, 2) if smoke else (4096, 16)
    for phi in (0.1, 0.2, 0.3):
        gas, D, error = diffusion(phi, size, replicas, 60)
        n, contact = 6 / np.pi * phi, float(gas.contact_value)
        met, y = 2 * np.pi / 3 * n * contact, n / 2**0.5
        first_sonine = 3 / (8 * n * np.pi**0.5 * contact)
        viscosity = 5 / (16 * np.pi**0.5) * 2 * np.pi / 3 * n * (1 / met + 0.8 + 0.7614 * met)
        box = 2.837 / (6 * np.pi * viscosity * float(gas.box_side(size) / gas.diameter))
        infinite = 1.01896 * first_sonine * (1 + 0.054034 * y + 6.3656 * y**2 - 10.9425 * y**3)
        off = {"off": float((D + box) / infinite - 1), "error": float(error / infinite)}
        yield {"phi": phi} | off


def diffusion_500(smoke: bool):
    """Speedy, Mol. Phys. 62 (1987) 509, which boxes of 500 meet as they are."""
    for phi in (0.1, 0.2, 0.3):
        _, D, error = diffusion(phi, *((100, 2) if smoke else (500, 64)), 20)
        n = 6 / np.pi * phi
        speedy = 3 / (8 * n * np.pi**0.5) * (1 - n / 1.09) * (1 + n**2 * (0.4 - 0.83 * n**2))
        yield {"phi": phi, "off": float(D / speedy - 1), "error": float(error / speedy)}


def log_temperature(gas, times, model):
    """Return ln T of each replica as a function of a shift of ln A."""

    def of(shift):
        changed = gas.replace(dissipative_constant=gas.dissipative_constant * jnp.exp(shift))
        return jnp.log(cool(changed, times, model).replicas.temperature)

    return of


SENSITIVITY = {1.0: -0.07813, 5.0: -0.3193, 10.0: -0.52054, 50.0: -1.05837, 100.0: -1.22284}
"""d ln T / d ln A after so many mean free times, beta = .15, of kinetic theory."""


def hard_sensitivity(smoke: bool):
    gas, size = glass(0.15, 0.01), 100 if smoke else 1000
    times = np.array(list(SENSITIVITY)) * float(gas.mean_free_time)
    of = log_temperature(gas, times, HardSpheres(size, replicas=2 if smoke else 8))
    mean, error = of_replicas(jax.jvp(of, (0.0,), (1.0,))[1])
    off = mean / np.array(list(SENSITIVITY.values())) - 1
    yield {"off": off.tolist(), "error": (error / np.abs(mean)).tolist()}


def hard_derivatives(smoke: bool):
    for phi, beta, replicas in ((0.02, 0.2, 32), (0.2, 0.1, 32), (0.2, 0.3, 96)):
        gas = glass(beta, phi)
        times = np.array([1.0, 3.0, 10.0, 15.0, 20.0, 30.0]) * float(gas.mean_free_time)
        model, h = HardSpheres(*((50, 2) if smoke else (500, replicas))), 0.3
        of = log_temperature(gas, times, model)
        difference, spread = of_replicas((of(h) - of(-h)) / (2 * h))
        mean, error = of_replicas(jax.jvp(of, (0.0,), (1.0,))[1])
        told = np.asarray(cool(gas, times, model).derivative_bias)
        off, error = mean / difference - 1, np.hypot(spread, error) / np.abs(difference)
        numbers = {"off": off, "error": error, "told": told}
        row = {name: values[[2, 5]].tolist() for name, values in numbers.items()}
        yield {"phi": phi, "beta": beta} | row


def walls(smoke: bool):
    for size, last in ((100, 0.006), (500, 0.04), (4000, 0.1)):
        phi = size * np.pi / 6 * (2e-3 / 0.05) ** 3
        container = jaxgran.Walls(0.05, restitution=0.8)
        gas = dataclasses.replace(glass(0.15, phi), container=container)
        theory = cool(gas, jnp.geomspace(1e-2, 1e3, 200), jaxgran.KineticTheory())
        fallen = jnp.log(theory.temperature / gas.temperature)[::-1]
        times = jnp.interp(jnp.log(jnp.array([0.5, last])), fallen, theory.times[::-1])
        hard = cool(gas, times, HardSpheres(size, replicas=2 if smoke else max(2, 3200 // size)))
        dsmc = cool(gas, times, DSMC(1000 if smoke else 100_000))
        off = np.log(np.asarray(hard.temperature / dsmc.temperature))
        error = np.asarray(hard.temperature_error / hard.temperature)
        yield {"num_particles": size, "off": off.tolist(), "error": error.tolist()}


PARTS = (
    dsmc_million,
    sonine,
    dsmc_order,
    diffusion_published,
    diffusion_500,
    hard_sensitivity,
    hard_derivatives,
    walls,
)


def main() -> None:
    parser = script_parser(__doc__, "particle_statistics")
    names = [part.__name__ for part in PARTS]
    parser.add_argument("--only", nargs="+", choices=names, default=names)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for part in PARTS:
        if (name := part.__name__) in options.only:
            rows = []
            for row in part(options.smoke):
                print(name, row, flush=True)
                rows.append(row)
            write_results(name, options, options.out / f"{name}.json", rows=rows)


if __name__ == "__main__":
    main()
