"""Parameters of a fit: their unconstrained scale, initial guesses from the data, and priors.

Guesses and priors are known numbers, arrays of NumPy.
"""

from collections.abc import Callable
from math import prod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.validation import Domain
from jaxgran.data.curve import CoolingCurve, above_noise
from jaxgran.data.drop_test import PLATE, WALL, DropTest
from jaxgran.data.measurement import DENSITY, START_TIME, Priors, prior_domain
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import C1, ConstantRestitution, RestitutionSpline, Viscoelastic
from jaxgran.scene.parameter_fields import law_fields
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE

LAW = "law"
"""Name that stands for all parameters of the law of restitution."""

SHARED = ""
"""Label of the priors of parameters that all measurements share, and of a single measurement."""

NUM_GUESSES = 24
"""Number of values of beta_t, and of mu, that are compared with oblique impacts."""

SMOOTHNESS = "smoothness"
"""Name of the prior that a law of restitution brings."""


def domain_of(gas: Gas, name: str) -> Domain:
    """Return the allowed values of a parameter.

    Raises:
        ValueError: for an unknown name; the message lists the known ones.
    """
    if name == START_TIME:
        return Domain()
    gas.value(name)  # raises for an unknown name
    return gas.domains[name]


def with_names_of_law(names: tuple[str, ...], gas: Gas) -> tuple[str, ...]:
    """Return names of free parameters, with all parameters of the law in place of `LAW`."""
    if LAW not in names:
        return names
    own = tuple(law_fields(gas.law))
    if not own:
        raise ValueError(
            f'free="law", but the law {type(gas.law).__name__} has no parameters. Declare its '
            "numbers as fields of the type float, its arrays as jax.Array"
        )
    parts = [own if name == LAW else (name,) for name in names]
    return tuple(dict.fromkeys(name for part in parts for name in part))


def with_parameters(gas: Gas, values: dict[str, Any]) -> Gas:
    """Return a gas with new parameters, of any type of array; ranges are not checked."""
    if not values:
        return gas
    fields = gas._parameter_fields
    leaves, structure = jax.tree.flatten(gas)
    positions = structure.unflatten(range(len(leaves)))
    for name, value in values.items():
        leaves[fields[name].get(positions)] = value
    changed = structure.unflatten(leaves)
    # Its parameters have the same places: to find them again takes as long as all else here.
    vars(changed)["_parameter_fields"] = fields
    return changed


def as_floats(values: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return known values as NumPy arrays of the default float type, by name."""
    dtype = jnp.result_type(float)
    return {name: np.asarray(x, dtype) for name, x in values.items()}


class Unknown(NamedTuple):
    """A parameter that a search varies.

    Attributes:
        name: of a parameter of the gas, `START_TIME`, or of a nuisance parameter.
        label: of the measurement that it belongs to; None if all share it.
        shape: of its value.
        domain: its range, which gives its unconstrained scale.
        unit: of the unconstrained scale of a parameter with an infinite range.
    """

    name: str
    label: str | None
    shape: tuple[int, ...]
    domain: Domain
    unit: ArrayLike = 1.0

    @property
    def size(self) -> int:
        """Number of elements."""
        return prod(self.shape)

    @property
    def title(self) -> str:
        """Name in a `Fit`, which begins with a label for a parameter of one measurement."""
        return self.name if not self.label else f"{self.label}: {self.name}"


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
    values |= _guess_law(with_parameters(gas, as_floats(values)), rate, free)
    values |= _guess_elements(gas, curve, free)
    return with_parameters(gas, as_floats(values))


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


def _guess_law(gas: Gas, rate: Any, free: tuple[str, ...]) -> dict[str, Any]:
    """Return the parameters of a law with which a gas cools as a line of `guess_from_data`.

    Args:
        gas: the scene.
        rate: 1/tau_0, the slope of the line over its value at t = 0, 1/s.
        free: names of the free parameters.
    """
    mean_free_time, alpha, drop_now = map(np.asarray, _law_scales(gas))
    per_collision = rate * mean_free_time
    # A collision takes the share (1 - eps^2)/d of T.
    inelasticity = gas.dimension * per_collision / power_of_line(gas)
    inelasticity = np.clip(inelasticity, 1e-6, 0.99)
    if isinstance(gas.law, ConstantRestitution) and "coefficient" in free:
        return {"coefficient": np.sqrt(1 - inelasticity)}
    if isinstance(gas.law, RestitutionSpline) and "drops" in free:
        drops = np.asarray(gas.law.drops)
        drops = np.maximum(drops, 1e-3 * np.max(drops))  # fits vary their logarithms
        return {"drops": drops * (-np.log1p(-inelasticity) / 2 / drop_now)}
    if isinstance(gas.law, Viscoelastic) and "dissipative_constant" in free:
        delta = per_collision / COOLING_RATE[gas.dimension]
        # At T_0 the cooling rate goes as delta (1 - q delta), and later with smaller delta: half of
        # the correction stands for the mean. It is inverted.
        correction = 0.5 * COOLING_CORRECTION * delta
        delta = delta / (1 - np.minimum(correction, 0.7))
        T_0 = np.asarray(gas.temperature)
        return {"dissipative_constant": delta / (alpha**0.4 * T_0**0.1)}
    return {}


@eqx.filter_jit
def _law_scales(gas: Gas) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Mean free time, alpha of viscoelastic spheres, and -ln eps of a spline at a typical impact.

    The typical impact has the root mean square of normal speeds, ``2 sqrt(T)``.
    """
    alpha = drop = jnp.ones_like(gas.mass)
    if isinstance(gas.law, Viscoelastic):
        alpha = gas.alpha
    if isinstance(gas.law, RestitutionSpline):
        drop = -jnp.log1p(-gas.law.loss(2 * jnp.sqrt(gas.temperature)))
    return gas.mean_free_time, alpha, drop


def known_start_time(priors: dict[str, Priors], label: str) -> tuple[float, float]:
    """Return t0 of a measurement and its error, s, by its priors; (0, inf) without a prior."""
    both = {**priors.get(label, {}), **priors.get(SHARED, {})}
    value, error = both.get(START_TIME, (0.0, np.inf))
    return float(value), float(error)


def guess_start_time(
    gas: Gas, curve: CoolingCurve, free: tuple[str, ...], known: tuple[float, float]
) -> float:
    """Return the time, s, at which the line of `guess_from_data` gives the T_0 of a gas.

    It is the known one if t0 is not free, or if T_0 is free, too. It stays within 3 errors of it.
    """
    t0, error = known
    if START_TIME not in free or "temperature" in free:
        return t0
    times, T = _above_noise(curve)
    since = times - times[0]
    power = power_of_line(gas)
    intercept, slope = _intercept_and_slope(since, (T / T[0]) ** -power)
    guess = ((np.asarray(gas.temperature) / T[0]) ** -power - intercept) / slope
    guess = times[0] + np.clip(np.where(slope > 0, guess, 0.0), -since[-1], 0.5 * since[-1])
    return float(np.clip(guess, t0 - 3 * error, t0 + 3 * error))


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


def extra_parameters(priors: Priors, free: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parameters that vary because of a prior and are not free parameters."""
    varied = ("mass" if name == DENSITY else name for name in priors if name != SMOOTHNESS)
    return tuple(dict.fromkeys(name for name in varied if name not in free))


def prior_residuals(
    priors: Priors, gas: Gas, values: dict[str, Any]
) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Return (value - known value) / standard error of each prior, and its derivatives.

    Differences are taken in the unconstrained scale. Derivatives are in SI values, by the name of
    the parameter, of shape (n, size) for n residuals.

    Args:
        priors: the known values.
        gas: the scene, for parameters that are not varied.
        values: SI values of the parameters that are varied, by name.
    """
    rows = {}

    def value_of(name: str) -> np.ndarray:
        return np.asarray(values[name] if name in values else gas.value(name))

    for name, (given, error) in priors.items():
        if name == SMOOTHNESS:
            floats = {n: jnp.asarray(values[n]) for n in law_fields(gas.law) if n in values}
            row = residuals_and_slopes(_law_prior, gas, floats)
            rows[name] = jax.tree.map(np.asarray, row)
            continue
        domain = prior_domain(gas, name)
        given = np.asarray(given)
        error = np.asarray(error)
        width = error / domain.slope(given)
        if name == DENSITY:
            mass = value_of("mass")
            diameter = value_of("diameter")
            value = 6 / np.pi * mass / diameter**3
            slopes = {"mass": 1 / (mass * width), "diameter": -3 / (diameter * width)}
        else:
            value = value_of(name)
            slopes = {name: 1 / (domain.slope(value) * width)}
        row = np.ravel((domain.to_free(value) - domain.to_free(given)) / width)
        matrices = {
            key: np.diag(np.broadcast_to(np.ravel(slope), row.shape))
            for key, slope in slopes.items()
            if key in values
        }
        rows[name] = row, matrices
    return rows


def _law_prior(gas: Gas) -> Array:
    return gas.law.prior_residuals()


@eqx.filter_jit
def residuals_and_slopes(
    residuals_of: Callable[[Gas], Array], gas: Gas, parameters: dict[str, Array]
) -> tuple[Array, dict[str, Array]]:
    """Return residuals of a gas, and their derivatives, shape (n, size), by name of parameter."""

    def residuals(parameters: dict[str, Array]) -> tuple[Array, Array]:
        values = residuals_of(with_parameters(gas, parameters))
        return values, values

    slopes, values = jax.jacfwd(residuals, has_aux=True)(parameters)
    return values, {name: slope.reshape(values.size, -1) for name, slope in slopes.items()}
