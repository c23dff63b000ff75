"""Numbers that describe a gas at some temperatures, computed by one program for a kind of gas."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.tracing import grid_size, pad_to
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import NODES
from jaxgran.scene.laws import Viscoelastic
from jaxgran.theory.averages import mean_inelasticity
from jaxgran.theory.density import softness_factor

MAX_CHECKED_SPEED = 3.7
"""Normal speed, over sqrt(2 T), that a thousandth of the impacts of a gas exceed."""

MIN_LENGTH = 128
"""Smallest number of temperatures of a program, so that most calls share one."""


class Scales(NamedTuple):
    """Numbers of a Maxwellian gas at one temperature, or arrays of NumPy for some temperatures.

    Attributes:
        mean_free_time, mean_free_path: s, m.
        volume: of the gas per sphere, 1/n, m^d.
        contact_fraction: contact duration over mean free time.
        overlap: mean largest overlap, in diameters.
        softness: c X_T/sigma, by which soft contacts slow the cooling.
        critical_box: L_c, m.
        cooling_rate: -d ln T/dt by impacts, 1/s; < 0 if the law heats the gas.
        lowest_restitution: eps at its lowest, at speeds to `MAX_CHECKED_SPEED`.
        restitution: eps of an impact at the speed sqrt(2 T).
        beta: dissipation parameter of viscoelastic spheres at that speed; nan for others.
    """

    mean_free_time: Any
    mean_free_path: Any
    volume: Any
    contact_fraction: Any
    overlap: Any
    softness: Any
    critical_box: Any
    cooling_rate: Any
    lowest_restitution: Any
    restitution: Any
    beta: Any

    def box_side(self, num_particles: int, dimension: int) -> float:
        """Side of the cube (of the square if d = 2) of N spheres, m; of scales at one T."""
        return float((num_particles * self.volume) ** (1 / dimension))


def scales_at(gas: Gas, temperature: ArrayLike | None = None) -> Scales:
    """Return the scales of a gas of known numbers at some temperatures.

    Args:
        gas: the scene.
        temperature: T, m^2/s^2, shape () or (temperatures,); T_0 by default.

    Returns:
        The scales, of the shape of the temperature.
    """
    temperature = gas.temperature if temperature is None else temperature
    T = np.atleast_1d(temperature)
    with jax.ensure_compile_time_eval():  # a known gas may be checked while jax.jit traces
        padded = pad_to(T, max(grid_size(T.size), MIN_LENGTH))
        found = _scales(gas, padded)
    used = slice(T.size) if np.ndim(temperature) else 0
    return jax.tree.map(lambda x: np.asarray(x)[used], found)


@eqx.filter_jit
def first_cooling_rate(gas: Gas) -> Float[Array, ""]:
    """Return ``-d ln T/dt`` by impacts, 1/s, of a Maxwellian gas at T_0."""
    return _cooling(gas)[0]


def _cooling(gas: Gas) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return ``-d ln T/dt`` by impacts, 1/s, of a Maxwellian gas at T_0, and eps at its lowest."""
    law = gas.reduced_law
    one = jnp.ones_like(gas.temperature)
    speeds = jnp.asarray(NODES[NODES < MAX_CHECKED_SPEED], one.dtype)
    rate = gas.collision_frequency * mean_inelasticity(law, one) / gas.dimension
    return rate, jnp.min(law.restitution(speeds))


@eqx.filter_jit
def _scales(gas: Gas, temperature: Float[Array, "temperatures"]) -> Scales:
    def at(temperature):
        now = gas.replace(temperature=temperature)
        law = now.reduced_law
        one = jnp.ones_like(temperature)
        rate, lowest = _cooling(now)
        beta = now.thermal_beta if isinstance(gas.law, Viscoelastic) else jnp.nan * one
        return Scales(
            now.mean_free_time,
            now.mean_free_path,
            1 / now.number_density,
            now.contact_fraction,
            now.mean_overlap,
            1 - softness_factor(law, one, now.dimension),
            now.critical_box,
            rate,
            lowest,
            law.restitution(one),
            beta,
        )

    return jax.vmap(at)(temperature)
