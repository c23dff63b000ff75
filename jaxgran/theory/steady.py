"""Steady states of gases that white noise drives, and the states in which it leaves them.

Units as in `jaxgran.theory.averages`, where not of a gas.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced_scene import ReducedScene, reduced_scene
from jaxgran.theory import elements
from jaxgran.theory.averages import averages
from jaxgran.theory.moments import velocity

WIDEST = 60.0
"""Largest |ln T/T_0| of a steady state."""

_NEWTON_STEPS = 8
"""From a_2 = 0 to a steady a_2, at most .1, to rounding."""


class SteadyState(NamedTuple):
    """The steady state of a driven gas.

    Attributes:
        temperature: T, m^2/s^2.
        sonine: a_2.
        rotational_temperature: T_rot, m^2/s^2, of rough spheres; None of smooth ones.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> jaxgran.steady_state(driven)._fields
    ('temperature', 'sonine', 'rotational_temperature')
    """

    temperature: Float[Array, ""]
    sonine: Float[Array, ""]
    rotational_temperature: Float[Array, ""] | None


def steady_state(gas: Gas) -> SteadyState:
    """Where a driven gas comes to rest: ``dT/dt = da_2/dt = dT_rot/dt = 0`` of kinetic theory.

    The white noise then returns what impacts, walls and drag take. It does not depend on the first
    temperature of the gas. Differentiable in every float of the gas.

    Args:
        gas: with a `jaxgran.WhiteNoise` drive.

    Raises:
        ValueError: for a gas without a drive, or one that nothing keeps from heating on and on.

    Reference: van Noije & Ernst, Granular Matter 1, 57 (1998), for constant restitution, whose
    first order in a_2 this exceeds by terms of second order.

    >>> driven = dataclasses.replace(gas, drive=jaxgran.WhiteNoise(1e-3))
    >>> round(float(jaxgran.steady_state(driven).temperature), 5)
    0.00127
    """
    if gas.drive is None:
        raise ValueError("a gas without drive has no steady state: add drive=WhiteNoise(strength)")
    log_theta, sonine, ratio, residual = _solved(gas)
    if not isinstance(residual, Tracer) and not float(residual) < 1e-3:
        raise ValueError(
            "no temperature is found at which losses balance the drive: elastic spheres without "
            "drag, or a strength of 0, have none"
        )
    temperature = gas.temperature * jnp.exp(log_theta)
    rotational = None if gas.surface is None else ratio * temperature
    return SteadyState(temperature, sonine, rotational)


@eqx.filter_jit
def _solved(gas: Gas) -> tuple[Array, Array, Array, Array]:
    """ln T/T_0, a_2, T_rot/T, and by what share losses and drive differ."""
    scene, d = reduced_scene(gas), gas.dimension
    assert scene.drive is not None

    def balance(x: Array, scene: ReducedScene) -> Array:
        return _rates(x[0], x[1], scene, d)[:2] / jnp.exp(x[0] / 2)

    low = _balanced(scene, gas.temperature, d)
    first = jnp.stack([low, jnp.zeros_like(low)])
    tolerance = jnp.finfo(first.dtype).eps ** 0.75
    solver = optx.Newton(rtol=float(tolerance), atol=float(tolerance))
    x = optx.root_find(balance, solver, first, scene, throw=False, max_steps=32).value
    heating = scene.drive.strength / jnp.exp(1.5 * x[0])
    off = jnp.abs(balance(x, scene)[0]) / heating
    return x[0], x[1], _steady_ratio(jnp.exp(x[0] / 2), x[1], scene, d), off


def _balanced(scene: ReducedScene, like: Array, d: int) -> Float[Array, ""]:
    """ln T/T_0 at which Maxwellian losses balance a drive, within +- `WIDEST`.

    Without softness, whose first order has no meaning in a gas that is far too hot.
    """

    def halved(_, ends):
        middle = (ends[0] + ends[1]) / 2
        heats = _rates(middle, jnp.zeros_like(middle), scene, d, softness=False)[0] > 0
        return jnp.where(heats, middle, ends[0]), jnp.where(heats, ends[1], middle)

    widest = jnp.full((), WIDEST, like.dtype)
    low, high = jax.lax.fori_loop(0, 40, halved, (-widest, widest))
    return jax.lax.stop_gradient((low + high) / 2)


def hottest_speed(gas: Gas) -> Float[Array, ""]:
    """sqrt(T/T_0) of the steady state of a driven gas, 1 if it cools, or if nothing balances."""
    found = _balanced(reduced_scene(gas), gas.temperature, gas.dimension)
    return jnp.where((found > 0) & (found < 0.99 * WIDEST), jnp.exp(found / 2), 1.0)


def _rates(
    log_theta: Array, sonine: Array, scene: ReducedScene, d: int, softness: bool = True
) -> Array:
    """Rates of change of ln T and a_2, where T_rot/T is steady."""
    speed, none = jnp.exp(log_theta / 2), jnp.zeros_like(log_theta)
    state = [log_theta, sonine, none, none, none]
    if scene.surface is not None:
        state.append(_steady_ratio(speed, sonine, scene, d))
    rates = averages(scene.law, speed, d)
    return velocity(jnp.stack(state), rates, scene, d, softness=softness, maxwellian=False)


def _steady_ratio(speed: Array, sonine: Array, scene: ReducedScene, d: int) -> Array:
    """T_rot/T at which ``dT_rot/dt``, linear in it, is 0; 0 where surfaces are smooth."""
    if scene.surface is None:
        return jnp.zeros_like(speed)
    gain, both = (elements.changes(scene, speed, r, sonine, d).rotation for r in (0.0, 1.0))
    loss = gain - both
    return jnp.where(loss > 0, gain / jnp.where(loss > 0, loss, 1.0), 0.0)


def prepared_sonine(scene: ReducedScene, like: Array, d: int) -> Float[Array, ""]:
    """a_2 of a gas that white noise has driven at T_0, returning what impacts and walls take."""
    undriven = scene._replace(drive=None, drag=None)
    zero = jnp.zeros((), like.dtype)

    def peaking(sonine: Array) -> Array:
        rate = _rates(zero, sonine, undriven, d)
        return rate[1] + 2 * sonine * rate[0]

    sonine = zero
    for _ in range(_NEWTON_STEPS):
        value, slope = jax.jvp(peaking, (sonine,), (jnp.ones_like(zero),))
        sonine = sonine - value / slope
    return sonine
