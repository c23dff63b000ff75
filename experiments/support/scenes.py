"""Gases of several experiments, and their times."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import root_scalar

import jaxgran
from experiments.support.record import DATA
from jaxgran.data.example import EXAMPLE_FILES

LAMMPS_CURVES = EXAMPLE_FILES | {
    file.stem.removeprefix("lammps_cooling_"): file for file in DATA.glob("lammps_cooling_*.csv")
}
"""Files of curves simulated in LAMMPS, by the name of their scene."""


def beads(
    packing_fraction: float, beta: float, contact_fraction: float | None = None, dimension: int = 3
) -> jaxgran.Gas:
    """Return viscoelastic beads of 2 mm with T = 0.01 m^2/s^2.

    Args:
        packing_fraction: phi.
        beta: dissipation of an impact at the speed sqrt(2 T), `jaxgran.Gas.thermal_beta`.
        contact_fraction: contact duration over mean free time; fixes Y. None for Y = 1e7 Pa.
        dimension: 2 or 3.
    """
    gas = jaxgran.Gas(
        jaxgran.Viscoelastic(1e7, 0.22, 1e-6),
        diameter=2e-3,
        mass=jaxgran.sphere_mass(2e-3, 2500.0),
        packing_fraction=packing_fraction,
        temperature=0.01,
        dimension=dimension,
    )
    if contact_fraction is not None:
        stiffer = (float(gas.contact_fraction) / contact_fraction) ** 2.5
        gas = gas.replace(youngs_modulus=stiffer * gas.value("youngs_modulus"))
    return gas.replace(dissipative_constant=1e-6 * beta / float(gas.thermal_beta))


class Power(jaxgran.extend.RestitutionLaw):
    """``eps = (v/v_1)^-p``, and 1 below the speed v_1, m/s."""

    speed: float
    power: float

    def restitution(self, normal_speed):
        return jnp.maximum(normal_speed / self.speed, 1.0) ** -self.power


def ice() -> Power:
    """Return the law of ice as measured by Bridges, Hatzes & Lin, Nature 309, 333 (1984)."""
    return Power(0.01 * 0.34 ** (1 / 0.234), 0.234)


def hard_beads(packing_fraction: float, restitution: float, dimension: int = 3) -> jaxgran.Gas:
    """Return the beads of `beads`, with a constant coefficient of restitution."""
    gas = beads(packing_fraction, 0.1, dimension=dimension)
    return dataclasses.replace(gas, law=jaxgran.ConstantRestitution(restitution))


def glass(beta: float, packing_fraction: float = 0.05, dimension: int = 3) -> jaxgran.Gas:
    """Return beads of Y = 5e7 Pa."""
    gas = beads(packing_fraction, beta, dimension=dimension).replace(youngs_modulus=5e7)
    return gas.replace(dissipative_constant=gas.dissipative_constant * beta / gas.thermal_beta)


def viscoelastic_like(gas: jaxgran.Gas) -> jaxgran.Gas:
    """Return viscoelastic beads with the same initial cooling rate of a Maxwellian gas."""
    theory = jaxgran.KineticTheory()

    def alike(beta: float) -> jaxgran.Gas:
        return beads(float(gas.packing_fraction), beta, dimension=gas.dimension)

    def excess(beta: float) -> float:
        return float(theory.cooling_rate(alike(beta)) - theory.cooling_rate(gas))

    return alike(root_scalar(excess, bracket=(1e-3, 3.0)).root)


def restitution_like(gas: jaxgran.Gas) -> float:
    """Return the constant restitution with the initial cooling rate of this Maxwellian gas."""
    rate = jaxgran.KineticTheory().cooling_rate(gas) / gas.collision_frequency
    return float((1 - gas.dimension * rate) ** 0.5)


def of_lammps(name: str) -> jaxgran.Measurement:
    """Return a curve simulated in LAMMPS, with its gas, which has the true A."""
    return jaxgran.read_measurement(LAMMPS_CURVES[name])


def temperature_only(curve: jaxgran.CoolingCurve) -> jaxgran.CoolingCurve:
    """Return the curve without what was measured besides T."""
    error = curve.temperature_error
    return jaxgran.CoolingCurve(curve.times, curve.temperature, temperature_error=error)


def times_of(
    gas: jaxgran.Gas, collisions: Any, model: Any = None, last: float = 1e6, points: int = 400
) -> np.ndarray:
    """Return times at which a particle has made these numbers of collisions on average.

    Args:
        model: by default kinetic theory. In clusters spheres collide more often than it predicts.
        last: of the times of the model, in mean free times.
        points: number of these times.
    """
    trial = np.geomspace(1e-3 if model is None else 0.1, last, points) * float(gas.mean_free_time)
    counts = jaxgran.cool(gas, trial, model=model, progress=False).collisions
    x, y = np.append(0.0, np.asarray(counts)), np.append(0.0, trial)
    return np.interp(collisions, x, y)


def cool(gas: jaxgran.Gas, times, model=None, seed: int = 0, **options: Any) -> Any:
    """Return the curve of a gas, without a progress bar."""
    key = jax.random.key(seed)
    return jaxgran.cool(gas, times, model=model, key=key, progress=False, **options)
