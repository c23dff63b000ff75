"""Steady states of gases that white noise drives.

Units are the same as in `jaxgran.theory.averages`; functions of a `Gas` use SI units.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced import ReducedScene, reduced_scene
from jaxgran.theory.averages import (
    impact_moments,
)
from jaxgran.theory.density import Density
from jaxgran.theory.equations import Equations

MAX_IMBALANCE = 1e-3
"""Relative difference of losses and drive above which a state is not steady."""

MAX_LOG_TEMPERATURE = 60.0
"""Largest |ln T/T_0| of a steady state."""


class SteadyState(NamedTuple):
    """Steady state of a driven gas.

    Attributes:
        temperature: T, m^2/s^2.
        sonine: a_2.
        rotational_temperature: T_rot, m^2/s^2, of rough spheres; None for smooth spheres.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> jaxgran.steady_state(driven)._fields
    ('temperature', 'sonine', 'rotational_temperature')
    """

    temperature: Float[Array, ""]
    sonine: Float[Array, ""]
    rotational_temperature: Float[Array, ""] | None


def steady_state(gas: Gas) -> SteadyState:
    """Return the steady state of a driven gas by kinetic theory.

    ``dT/dt = da_2/dt = dT_rot/dt = 0``.

    In this state the white noise replaces the energy that impacts, walls and drag take. It does not
    depend on the initial temperature of the gas. Differentiable in every float of the gas.

    Args:
        gas: with a `jaxgran.WhiteNoise` drive.

    Returns:
        The state; nan under a transformation where no loss balances the drive.

    Raises:
        ValueError: for a gas without a drive, with lasting friction or unequal sizes, or in which
            no loss balances the drive.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution and to
    first order in a_2; this solution also has terms of second order.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> round(float(jaxgran.steady_state(driven).temperature), 5)
    0.00128
    """
    if gas.drive is None:
        raise ValueError("a gas without drive has no steady state: add drive=WhiteNoise(strength)")
    for name in ("friction", "diameter_sd"):
        if name in gas.elements:
            raise ValueError(
                f"the steady state of a gas with {name} is not known: leave {name} out"
            )
    log_theta, sonine, ratio, imbalance = _solve_steady(gas)
    is_steady = imbalance < MAX_IMBALANCE
    if not isinstance(is_steady, Tracer) and not is_steady:
        raise ValueError(
            "the losses balance the drive at no temperature. Give the gas a drive of strength > 0, "
            "and losses: a restitution below 1, or drag"
        )
    temperature = gas.temperature * jnp.exp(log_theta)
    rotational = None if gas.surface is None else ratio * temperature
    state = SteadyState(temperature, sonine, rotational)
    return jax.tree.map(lambda x: jnp.where(is_steady, x, jnp.nan), state)


@eqx.filter_jit
def _solve_steady(gas: Gas) -> tuple[Array, Array, Array, Array]:
    """ln T/T_0, a_2, T_rot/T, and the relative difference of losses and drive."""
    scene, density, d = reduced_scene(gas), Density.from_gas(gas), gas.dimension
    assert scene.drive is not None

    def balance(x: Array, scene: ReducedScene) -> Array:
        return _steady_rates(x, scene, density, d) / jnp.exp(x[0] / 2)

    start = _at_rest(_balance_log_temperature(scene, gas.temperature, d), scene)
    tolerance = jnp.finfo(start.dtype).eps ** 0.75
    solver = optx.Newton(rtol=float(tolerance), atol=float(tolerance))
    x = optx.root_find(balance, solver, start, scene, throw=False, max_steps=32).value
    heating = scene.drive / jnp.exp(1.5 * x[0])
    imbalance = jnp.abs(balance(x, scene)[0]) / heating
    ratio = jnp.zeros_like(x[0]) if scene.surface is None else x[3]
    return x[0], x[1], ratio, imbalance


def _balance_log_temperature(scene: ReducedScene, like: Array, d: int) -> Float[Array, ""]:
    """ln T/T_0 at which Maxwellian losses balance a drive, within +- `MAX_LOG_TEMPERATURE`.

    Spins are at rest: impacts of rough spheres then take most, and the temperature is too low.
    Softness is left out: its first order has no meaning in a gas that is far too hot.
    """

    def bisect(_, ends):
        middle = (ends[0] + ends[1]) / 2
        heats = _steady_rates(_at_rest(middle, scene), scene, Density(), d)[0] > 0
        return jnp.where(heats, middle, ends[0]), jnp.where(heats, ends[1], middle)

    bound = jnp.full((), MAX_LOG_TEMPERATURE, like.dtype)
    low, high = jax.lax.fori_loop(0, 40, bisect, (-bound, bound))
    return jax.lax.stop_gradient((low + high) / 2)


def max_thermal_speed(gas: Gas) -> Float[Array, ""]:
    """Return sqrt(T/T_0) of the steady state of a driven gas that heats up, and otherwise 1.

    It is 1 if the gas cools, and if no loss balances the drive. That of rough spheres is the one
    without spins, which is lower.
    """
    log_theta = _balance_log_temperature(reduced_scene(gas), gas.temperature, gas.dimension)
    return jnp.where(
        (log_theta > 0) & (log_theta < 0.99 * MAX_LOG_TEMPERATURE), jnp.exp(log_theta / 2), 1.0
    )


def _at_rest(log_theta: Array, scene: ReducedScene) -> Float[Array, "variables"]:
    """Variables of `_steady_rates` of a Maxwellian gas without spins."""
    return jnp.zeros(3 if scene.surface is None else 6, log_theta.dtype).at[0].set(log_theta)


def _steady_rates(
    x: Float[Array, "variables"], scene: ReducedScene, density: Density, d: int
) -> Float[Array, "variables"]:
    """Rates of change of ln T, a_2, a_3 and the spins where all correlations have built up."""
    zero = jnp.zeros_like(x[:1])
    moments = jnp.concatenate([x[:2], zero + jnp.inf, x[2:]])
    equations = Equations(d, 3, maxwellian=False, spreading=False)
    rates = impact_moments(scene.law, jnp.exp(x[0] / 2), d, 3, relaxation=False)
    change = equations.derivative(moments, rates, (scene, density))
    # Spins of smooth spheres, beta_t = -1, do not change: they are 0.
    return jnp.concatenate([change[:2], change[3:4], change[4:] - 1e-30 * x[3:]])
