"""Initial guesses of parameters from the measured curve."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.data.curve import CoolingCurve
from jaxgran.fitting.parameters import START
from jaxgran.scene.gas import Gas
from jaxgran.scene.restitution import ConstantRestitution, Viscoelastic
from jaxgran.theory import closed_forms


def guess_from_data(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Gas:
    """The gas with A (or e) and T_0, where they are free, guessed from the measured curve.

    ``T^(-3/5)`` (``T^(-1/2)`` for constant restitution) of a cooling gas is a straight line in
    time, whose value at t = 0 gives T_0 and whose slope over that value is 1/tau_0, proportional to
    A (to 1 - e^2). The line is fitted by linear least squares. Other parameters keep the values of
    the gas.

    Args:
        gas: the scene.
        curve: the measured curve.
        free: names of the free parameters.
    """
    guessed = _guessed(gas, curve, free)
    return gas.replace(**{name: guessed.value(name) for name in free if name != START})


@eqx.filter_jit
def _guessed(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Gas:
    """The same, of unchecked values."""
    power, line = _power_and_line(gas, curve)
    scale = curve.temperature[0]
    origin = (gas.temperature / scale) ** -power
    haff = isinstance(gas.law, ConstantRestitution)
    if "temperature" in free:
        origin, slope = _intercept_and_slope(curve, line)
        gas = gas.replace(temperature=scale * origin ** (-1 / power))
    elif START in free:
        _, slope = _intercept_and_slope(curve, line)
    else:
        weight = 1 / line
        slope = jnp.sum(weight**2 * (line - origin) * curve.times)
        slope = slope / jnp.sum((weight * curve.times) ** 2)
    rate = jnp.maximum(slope / origin, 1e-9 / curve.times[-1]) * gas.mean_free_time
    if haff and "coefficient" in free:
        loss = jnp.clip(2 * gas.dimension * rate, 1e-6, 0.99)
        gas = gas.replace(coefficient=jnp.sqrt(1 - loss))
    if isinstance(gas.law, Viscoelastic) and "dissipative_constant" in free:
        delta = rate / closed_forms.COOLING_RATE[gas.dimension]
        # To the next order in delta the cooling rate is that of delta (1 - q delta / 2): invert it.
        correction = 0.5 * closed_forms.COOLING_CORRECTION * delta
        delta = delta / (1 - jnp.minimum(correction, 0.7))
        gas = gas.replace(dissipative_constant=delta / (gas.alpha**0.4 * gas.temperature**0.1))
    return _elements_from_data(gas, curve, free)


def guess_of_start(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Array | float:
    """The time, s, at which that line gives the T_0 of a gas, where t0 is free and T_0 is known."""
    if START not in free or "temperature" in free:
        return 0.0
    power, line = _power_and_line(gas, curve)
    intercept, slope = _intercept_and_slope(curve, line)
    late = ((gas.temperature / curve.temperature[0]) ** -power - intercept) / slope
    duration = curve.times[-1]
    return jnp.clip(jnp.where(slope > 0, late, 0.0), -duration, 0.5 * duration)


def halving_time(curve: CoolingCurve) -> Float[Array, ""]:
    """The time until T has fallen to a half of its first value, or the last time before it has."""
    halved = (curve.temperature < 0.5 * curve.temperature[0]).at[-1].set(True)
    return curve.times[jnp.argmax(halved)]


def _power_and_line(gas: Gas, curve: CoolingCurve) -> tuple[float, Float[Array, "times"]]:
    """The power of T that is a straight line in time, and it, over its first value."""
    power = 1 / 2 if isinstance(gas.law, ConstantRestitution) else 3 / 5
    return power, (curve.temperature / curve.temperature[0]) ** -power


def _intercept_and_slope(curve: CoolingCurve, line: Float[Array, "times"]) -> tuple[Array, Array]:
    """Of a straight line, by least squares with equal relative errors."""
    weight = 1 / line
    design = jnp.stack([weight, weight * curve.times], axis=1)
    size = jnp.linalg.norm(design, axis=0)
    intercept, slope = jnp.linalg.lstsq(design / size[None], weight * line)[0] / size
    return jnp.maximum(intercept, 0.1 * line.min()), slope


def _elements_from_data(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Gas:
    """The gas with those free floats of its elements guessed that are at an end of their range.

    A fit in an unbounded scale cannot begin there. beta_t is taken for 0, T_rot at t = 0 for the
    first measured one, or a tenth of T_0, and a rate of drag for a tenth of the mean cooling rate.
    """
    measured = curve.rotational_temperature
    first = 0.1 * gas.temperature if measured is None else jnp.maximum(measured[0], measured[1])
    mean_rate = jnp.log(curve.temperature[0] / curve.temperature[-1]) / curve.times[-1]
    guesses = {
        "tangential_restitution": jnp.zeros(()),
        "rotational_temperature": jnp.maximum(first, 1e-6 * gas.temperature),
        "wall_coefficient": jnp.full((), 0.8),
        "wall_tangential_restitution": jnp.zeros(()),
        "drag_rate": 0.1 * jnp.maximum(mean_rate, 1e-9 / curve.times[-1]),
        "drag_rotational_rate": 0.1 * jnp.maximum(mean_rate, 1e-9 / curve.times[-1]),
    }
    for name in guesses.keys() & set(free):
        at_end = ~jnp.isfinite(gas.domains[name].to_free(gas.value(name)))
        gas = gas.replace(**{name: jnp.where(at_end, guesses[name], gas.value(name))})
    return gas
