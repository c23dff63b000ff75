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
from jaxgran.theory.moments import Density, Moments, velocity

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
    0.00128
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
    scene, density, d = reduced_scene(gas), Density.of(gas), gas.dimension
    assert scene.drive is not None

    def balance(x: Array, scene: ReducedScene) -> Array:
        return _rates(x, scene, density, d) / jnp.exp(x[0] / 2)

    low = _balanced(scene, gas.temperature, d)
    first = jnp.stack([low, jnp.zeros_like(low), jnp.zeros_like(low)])
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
        maxwellian = jnp.stack([middle, jnp.zeros_like(middle)])
        heats = _rates(maxwellian, scene, Density(), d, softness=False)[0] > 0
        return jnp.where(heats, middle, ends[0]), jnp.where(heats, ends[1], middle)

    widest = jnp.full((), WIDEST, like.dtype)
    low, high = jax.lax.fori_loop(0, 40, halved, (-widest, widest))
    return jax.lax.stop_gradient((low + high) / 2)


def hottest_speed(gas: Gas) -> Float[Array, ""]:
    """sqrt(T/T_0) of the steady state of a driven gas, 1 if it cools, or if nothing balances."""
    found = _balanced(reduced_scene(gas), gas.temperature, gas.dimension)
    return jnp.where((found > 0) & (found < 0.99 * WIDEST), jnp.exp(found / 2), 1.0)


def _rates(
    x: Float[Array, "variables"],
    scene: ReducedScene,
    density: Density,
    d: int,
    softness: bool = True,
) -> Float[Array, "variables"]:
    """Rates of change of ln T, a_2 and, if it is among them, a_3, where T_rot/T is steady.

    So many collisions have been that all correlations have built up.
    """
    order = len(x)
    speed, zero = jnp.exp(x[0] / 2), jnp.zeros_like(x[0])
    rotation = None if scene.surface is None else _steady_ratio(speed, x[1], scene, d)
    named: dict[str, Array] = dict(
        zip(("log_temperature", "sonine", "third_sonine"), x, strict=False)
    )
    if order > 2:
        named["diffusion_shape"] = zero
    lasting = jnp.full_like(x[0], jnp.inf)
    at = Moments(**named, diffusion=zero, displacement=zero, collisions=lasting, rotation=rotation)
    state = jnp.stack([value for value in at if value is not None])
    rates = averages(scene.law, speed, d, order)
    options = {"order": order, "softness": softness, "maxwellian": False}
    change = Moments.of(velocity(state, rates, scene, density, d, **options), order)
    return jnp.stack([getattr(change, name) for name in list(named)[:order]])


def _steady_ratio(speed: Array, sonine: Array, scene: ReducedScene, d: int) -> Array:
    """T_rot/T at which ``dT_rot/dt``, linear in it, is 0; 0 where surfaces are smooth."""
    if scene.surface is None:
        return jnp.zeros_like(speed)
    gain, both = (elements.changes(scene, speed, r, sonine, d).rotation for r in (0.0, 1.0))
    loss = gain - both
    return jnp.where(loss > 0, gain / jnp.where(loss > 0, loss, 1.0), 0.0)


def scene_at_start(gas: Gas) -> ReducedScene:
    """The scene of a gas, with T_rot/T of a steady state where white noise has driven it at T_0.

    There is ``dT_rot/dt = 0`` by impacts, on walls too; drag begins at t = 0.
    """
    scene = reduced_scene(gas)
    if scene.prepared is None or scene.surface is None:
        return scene
    undriven, like = scene._replace(drive=None, drag=None), jnp.ones_like(gas.temperature)
    ratio = _steady_ratio(like, jnp.zeros_like(like), undriven, gas.dimension)
    return scene._replace(surface=scene.surface._replace(ratio=ratio))


def prepared(
    first: Float[Array, "moments"], scene: ReducedScene, density: Density, d: int, order: int
) -> Float[Array, "moments"]:
    """The moments at the start with a_2 (and a_3) of a gas that white noise has driven at T_0.

    The noise has returned what impacts and walls took.
    """
    undriven = scene._replace(drive=None, drag=None)

    def peaking(sonine: Array) -> Array:
        rate = _rates(jnp.concatenate([jnp.zeros_like(sonine[:1]), sonine]), undriven, density, d)
        return rate[1:] + rate[0] * jnp.arange(2.0, order + 1, dtype=sonine.dtype) * sonine

    sonine = jnp.zeros(order - 1, first.dtype)
    for _ in range(_NEWTON_STEPS):
        sonine = sonine - jnp.linalg.solve(jax.jacfwd(peaking)(sonine), peaking(sonine))
    at = Moments.of(first, order)._replace(sonine=sonine[0])
    if order > 2:
        at = at._replace(third_sonine=sonine[1])
    return jnp.stack([value for value in at if value is not None])
