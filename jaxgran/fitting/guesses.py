"""First guesses of the parameters of a fit, from the measured data.

Guesses are known numbers, arrays of NumPy.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.data.curve import CoolingCurve, above_noise
from jaxgran.data.drop_test import PLATE, WALL, DropTest
from jaxgran.data.measurement import START_TIME
from jaxgran.fitting.parameters import KnownTime, with_values
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import C1, ConstantRestitution, RestitutionSpline, Viscoelastic
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE

NUM_GUESSES = 24
"""Number of values of beta_t, and of mu, that are compared with oblique impacts."""


def guess_from_data(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Gas:
    """Return the gas with its free parameters guessed from the measured curve.

    ``T^(-3/5)`` (``T^(-1/2)`` for constant restitution) of a cooling gas is a straight line in
    time. Its value at t = 0 gives T_0; its slope over that value is 1/tau_0, proportional to A (to
    1 - e^2); the drops of a `RestitutionSpline` are scaled to it. The line is fitted by least
    squares. Floats of elements are guessed where they are at an end of their range; all others keep
    the values of the gas.

    Args:
        gas: the scene.
        curve: the measured curve.
        free: names of the free parameters.
    """
    times, T = _above_noise(curve)
    power = power_of_line(gas)
    line = (T / T[0]) ** -power
    origin = (np.asarray(gas.temperature) / T[0]) ** -power
    values: dict[str, Any] = {}
    if "temperature" in free:
        origin, slope = _intercept_and_slope(times, line)
        values["temperature"] = T[0] * origin ** (-1 / power)
    elif START_TIME in free:
        _, slope = _intercept_and_slope(times - times[0], line)
    else:
        weight = 1 / line
        slope = np.sum(weight**2 * (line - origin) * times) / np.sum((weight * times) ** 2)
    rate = np.maximum(slope / origin, 1e-9 / times[-1])
    values |= _guess_law(with_values(gas, values), rate, free)
    values |= _guess_elements(gas, curve, free)
    return with_values(gas, values)


def _guess_law(gas: Gas, rate: Any, free: tuple[str, ...]) -> dict[str, Any]:
    """Return the parameters of a law with which a gas cools as a line of `guess_from_data`.

    Args:
        gas: the scene.
        rate: 1/tau_0, the slope of the line over its value at t = 0, 1/s.
        free: names of the free parameters.
    """
    scales = jax.tree.map(np.asarray, _law_scales(gas))
    per_collision = rate * scales.mean_free_time
    # A collision takes the share (1 - eps^2)/d of T.
    inelasticity = gas.dimension * per_collision / power_of_line(gas)
    inelasticity = np.clip(inelasticity, 1e-6, 0.99)
    if isinstance(gas.law, ConstantRestitution) and "coefficient" in free:
        return {"coefficient": np.sqrt(1 - inelasticity)}
    if isinstance(gas.law, RestitutionSpline) and "drops" in free:
        drops = np.asarray(gas.law.drops)
        drops = np.maximum(drops, 1e-3 * np.max(drops))  # fits vary their logarithms
        return {"drops": drops * (-np.log1p(-inelasticity) / 2 / scales.drop)}
    if isinstance(gas.law, Viscoelastic) and "dissipative_constant" in free:
        delta = per_collision / COOLING_RATE[gas.dimension]
        # At T_0 the cooling rate goes as delta (1 - q delta), and later with smaller delta: half of
        # the correction stands for the mean. It is inverted.
        correction = 0.5 * COOLING_CORRECTION * delta
        delta = delta / (1 - np.minimum(correction, 0.7))
        T_0 = np.asarray(gas.temperature)
        return {"dissipative_constant": delta / (scales.alpha**0.4 * T_0**0.1)}
    return {}


class _LawScales(NamedTuple):
    """What turns a cooling rate into parameters of a law.

    Attributes:
        mean_free_time: s.
        alpha: of viscoelastic spheres; 1 for other laws.
        drop: -ln eps of a spline at the root mean square of normal speeds, ``2 sqrt(T)``; 1 for
            other laws.
    """

    mean_free_time: Float[Array, ""]
    alpha: Float[Array, ""]
    drop: Float[Array, ""]


@eqx.filter_jit
def _law_scales(gas: Gas) -> _LawScales:
    alpha = jnp.ones_like(gas.mass)
    drop = alpha
    if isinstance(gas.law, Viscoelastic):
        alpha = gas.alpha
    if isinstance(gas.law, RestitutionSpline):
        drop = -jnp.log1p(-gas.law.loss(2 * jnp.sqrt(gas.temperature)))
    return _LawScales(gas.mean_free_time, alpha, drop)


def _guess_elements(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> dict[str, Any]:
    """Guess free parameters of the elements that are at an end of their range.

    A fit in an unconstrained scale cannot start there. The guess is 0 for beta_t, .8 for the
    restitution of walls, and a tenth of the mean cooling rate for a drag rate. For T_rot at t = 0
    it is the larger one of the first two measured values, or a tenth of T_0.
    """
    measured = curve.rotational_temperature
    times, T = _above_noise(curve)
    T_0 = np.asarray(gas.temperature)
    T_rot = 0.1 * T_0
    if measured is not None:
        T_rot = np.max(np.asarray(measured)[:2])
    drag = 0.1 * np.maximum(np.log(T[0] / T[-1]) / times[-1], 1e-9 / times[-1])
    guesses = {
        "tangential_restitution": np.zeros(()),
        "rotational_temperature": np.maximum(T_rot, 1e-6 * T_0),
        "wall_coefficient": np.full((), 0.8),
        "wall_tangential_restitution": np.zeros(()),
        "drag_rate": drag,
        "drag_rotational_rate": drag,
    }
    values = {}
    for name in guesses.keys() & set(free):
        value = np.asarray(gas.value(name))
        at_end = ~np.isfinite(gas.domains[name].to_free(value))
        values[name] = np.where(at_end, guesses[name], value)
    return values


def guess_start_time(
    gas: Gas, curve: CoolingCurve, free: tuple[str, ...], known: KnownTime
) -> float:
    """Return the time, s, at which the line of `guess_from_data` gives the T_0 of a gas.

    It is the known one if t0 is not free, or if T_0 is free, too. It stays within 3 errors of it.
    """
    if START_TIME not in free or "temperature" in free:
        return known.value
    times, T = _above_noise(curve)
    since = times - times[0]
    power = power_of_line(gas)
    intercept, slope = _intercept_and_slope(since, (T / T[0]) ** -power)
    guess = ((np.asarray(gas.temperature) / T[0]) ** -power - intercept) / slope
    guess = times[0] + np.clip(np.where(slope > 0, guess, 0.0), -since[-1], 0.5 * since[-1])
    return float(np.clip(guess, known.value - 3 * known.error, known.value + 3 * known.error))


def guess_from_drops(gas: Gas, test: DropTest, free: tuple[str, ...]) -> dict[str, Any]:
    """Return guesses of free parameters on which the impacts of a drop test depend, by name.

    A follows from ``eps = exp(-C1 beta)`` of the median impact, and a constant restitution is the
    median one. Oblique impacts give beta_t and mu (`_guess_tangential`).
    """
    values: dict[str, Any] = {}
    eps = np.clip(np.median(np.asarray(test.restitution)), 1e-3, 0.999)
    if test.onto == WALL:
        values["wall_coefficient"] = eps
    else:
        values["coefficient"] = eps
        if isinstance(gas.law, Viscoelastic):
            law = gas.law.of_wall() if test.onto == PLATE else gas.law
            alpha = law.alpha(diameter=gas.diameter, mass=gas.mass)
            speed = np.median(np.asarray(test.speed))
            A = -np.log(eps) / (1.5 * C1 * alpha**0.4 * speed**0.2)
            values["dissipative_constant"] = A
    if test.is_oblique:
        beta_t, friction = _guess_tangential(gas, test)
        prefix = "wall_" if test.onto == WALL else ""
        values[f"{prefix}tangential_restitution"] = beta_t
        values["friction"] = friction
    return {name: x for name, x in values.items() if name in free and name in gas.domains}


def _guess_tangential(gas: Gas, test: DropTest) -> tuple[float, float]:
    """Return beta_t and mu of oblique impacts.

    Each impact gives the beta_t with which it would stick, and the mu with which it would slide.
    The pair of these that fits all impacts best is the guess.
    """
    q = float(gas.value("inertia"))
    change = 1 - np.asarray(test.tangential_restitution)
    if test.of_centres:
        change = change * (1 + q) / q
    steepness = np.asarray(test.speed) / np.asarray(test.tangential_speed)
    of_unit_friction = (1 + 1 / q) * (1 + np.asarray(test.restitution)) * steepness
    shares = np.linspace(0, 1, NUM_GUESSES)
    sticking = np.clip(np.quantile(change, shares), 0.02, 1.98)
    friction = np.clip(np.quantile(change / of_unit_friction, shares), 0.01, 10.0)
    sliding = friction[:, None] * of_unit_friction
    computed = np.minimum(sticking[:, None, None], sliding)
    misfit = np.sum(((change - computed) / np.asarray(test.tangential_error)) ** 2, axis=-1)
    i, j = np.unravel_index(np.argmin(misfit), misfit.shape)
    return float(sticking[i] - 1), float(friction[j])


def halving_time(curve: CoolingCurve) -> float:
    """Return the time from the first point to that below half of its T, or to the last one."""
    times, T = _above_noise(curve)
    halved = np.concatenate([T[:-1] < 0.5 * T[0], np.ones(1, bool)])
    return float(times[np.argmax(halved)] - times[0])


def _above_noise(curve: CoolingCurve) -> tuple[np.ndarray, np.ndarray]:
    """Return the times and T of the rows from which parameters can be guessed."""
    rows = above_noise(curve)
    return np.asarray(curve.times)[rows], np.asarray(curve.temperature)[rows]


def power_of_line(gas: Gas) -> float:
    """Return p for which T^(-p) of a cooling gas is a straight line in time."""
    return 1 / 2 if isinstance(gas.law, ConstantRestitution) else 3 / 5


def _intercept_and_slope(times: np.ndarray, line: np.ndarray) -> tuple[Any, Any]:
    """Fit a straight line with equal relative errors, whose intercept is positive."""
    slope, intercept = np.polyfit(times, line, 1, w=1 / line)
    return np.maximum(intercept, 0.1 * line.min()), slope
