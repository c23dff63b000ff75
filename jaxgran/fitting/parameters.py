"""Parameters of a fit: their unconstrained scale, initial guesses from the data, and priors."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import POSITIVE, Domain
from jaxgran.data.curve import CoolingCurve
from jaxgran.scene.gas import Gas
from jaxgran.scene.laws import ConstantRestitution, Viscoelastic
from jaxgran.theory.equations import COOLING_CORRECTION, COOLING_RATE

START_TIME = "t0"
"""Name of the time, on the clock of the measurement, at which the gas had its temperature T_0 and
began to cool: the only free parameter that is not a float of a gas."""

DENSITY = "density"
"""Name of a prior that is not of a float of a gas: the mass over the volume of a sphere."""

ANY_TIME = Domain()


def domain_of(gas: Gas, name: str) -> Domain:
    """Return the allowed values of a parameter.

    Raises:
        ValueError: for an unknown name; the message lists the known ones.
    """
    if name == START_TIME:
        return ANY_TIME
    gas.value(name)
    return gas.domains[name]


def size_of(gas: Gas, name: str) -> int:
    """Return the number of elements of a parameter."""
    return 1 if name == START_TIME else gas.value(name).size


class Parameters:
    """Map between a gas and the array of its free parameters in their unconstrained scale.

    The scale of a positive parameter is its logarithm (see `jaxgran._utils.validation.Domain`);
    that of `START_TIME` is linear, in units of `time_scale`.
    """

    def __init__(self, gas: Gas, names: tuple[str, ...], time_scale: ArrayLike = 1.0):
        self._gas, self.names, self._time_scale = gas, names, time_scale
        self._domains = [domain_of(gas, name) for name in names]
        self._unravel = ravel_pytree(self._to_free(gas, 0.0))[1]

    def _to_free(self, gas: Gas, start: ArrayLike) -> list[Array]:
        pairs = zip(self.names, self._domains, strict=True)
        t0 = jnp.asarray(start / self._time_scale, gas.temperature.dtype)
        return [t0 if n == START_TIME else domain.to_free(gas.value(n)) for n, domain in pairs]

    def flat(self, gas: Gas, start: ArrayLike = 0.0) -> Float[Array, "p"]:
        """Return the free parameters, unconstrained, of a gas that began to cool at `start`."""
        return ravel_pytree(self._to_free(gas, start))[0]

    def values(self, flat: Float[Array, "p"]) -> dict[str, Array]:
        """Return SI values by name."""
        pairs = zip(self.names, self._domains, self._unravel(flat), strict=True)
        return {
            name: free * self._time_scale if name == START_TIME else domain.from_free(free)
            for name, domain, free in pairs
        }

    def gas(self, flat: Float[Array, "p"]) -> Gas:
        """Return the gas with these values."""
        values = self.values(flat)
        values.pop(START_TIME, None)
        return self._gas.replace(**values)

    def start(self, flat: Float[Array, "p"]) -> Array | float:
        """Return the time at which the gas began to cool, s; 0 if it is not free."""
        return self.values(flat).get(START_TIME, 0.0)

    def estimates(self, flat: Float[Array, "p"]) -> Float[Array, "p"]:
        """Return SI values in one array."""
        return jnp.concatenate([jnp.ravel(value) for value in self.values(flat).values()])


def guess_from_data(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Gas:
    """Return the gas with its free parameters guessed from the measured curve.

    ``T^(-3/5)`` (``T^(-1/2)`` for constant restitution) of a cooling gas is a straight line in
    time. Its value at t = 0 gives T_0; its slope over that value is 1/tau_0, proportional to A (to
    1 - e^2). The line is fitted by linear least squares. Floats of elements are guessed where they
    are at an end of their range; all others keep the values of the gas.

    Args:
        gas: the scene.
        curve: the measured curve.
        free: names of the free parameters.
    """
    guessed = _guess(gas, curve, free)
    return gas.replace(**{name: guessed.value(name) for name in free if name != START_TIME})


@eqx.filter_jit
def _guess(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Gas:
    """Compiled part of `guess_from_data`."""
    power, line = _power_and_line(gas, curve)
    scale = curve.temperature[0]
    origin = (gas.temperature / scale) ** -power
    haff = isinstance(gas.law, ConstantRestitution)
    if "temperature" in free:
        origin, slope = _intercept_and_slope(curve, line)
        gas = gas.replace(temperature=scale * origin ** (-1 / power))
    elif START_TIME in free:
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
        delta = rate / COOLING_RATE[gas.dimension]
        # To the next order in delta the cooling rate is that of delta (1 - q delta / 2): invert it.
        correction = 0.5 * COOLING_CORRECTION * delta
        delta = delta / (1 - jnp.minimum(correction, 0.7))
        gas = gas.replace(dissipative_constant=delta / (gas.alpha**0.4 * gas.temperature**0.1))
    return _guess_elements(gas, curve, free)


def guess_start_time(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Array | float:
    """Return the time, s, at which the line of `guess_from_data` gives the T_0 of a gas.

    It is 0 if t0 is not free, or if T_0 is free too.
    """
    if START_TIME not in free or "temperature" in free:
        return 0.0
    power, line = _power_and_line(gas, curve)
    intercept, slope = _intercept_and_slope(curve, line)
    t0 = ((gas.temperature / curve.temperature[0]) ** -power - intercept) / slope
    duration = curve.times[-1]
    return jnp.clip(jnp.where(slope > 0, t0, 0.0), -duration, 0.5 * duration)


def halving_time(curve: CoolingCurve) -> Float[Array, ""]:
    """Return the first time at which T is below half of its first value, or the last time."""
    halved = (curve.temperature < 0.5 * curve.temperature[0]).at[-1].set(True)
    return curve.times[jnp.argmax(halved)]


def _power_and_line(gas: Gas, curve: CoolingCurve) -> tuple[float, Float[Array, "times"]]:
    """Return the negative power of T that is a straight line in time, and that line, 1 at first."""
    power = 1 / 2 if isinstance(gas.law, ConstantRestitution) else 3 / 5
    return power, (curve.temperature / curve.temperature[0]) ** -power


def _intercept_and_slope(curve: CoolingCurve, line: Float[Array, "times"]) -> tuple[Array, Array]:
    """Fit a straight line by least squares with equal relative errors."""
    weight = 1 / line
    design = jnp.stack([weight, weight * curve.times], axis=1)
    size = jnp.linalg.norm(design, axis=0)
    intercept, slope = jnp.linalg.lstsq(design / size[None], weight * line)[0] / size
    return jnp.maximum(intercept, 0.1 * line.min()), slope


def _guess_elements(gas: Gas, curve: CoolingCurve, free: tuple[str, ...]) -> Gas:
    """Guess free floats of the elements that are at an end of their range.

    A fit in an unconstrained scale cannot start there. The guess of beta_t is 0, that of T_rot at
    t = 0 the first measured one or a tenth of T_0, and that of a drag rate a tenth of the mean
    cooling rate.
    """
    measured = curve.rotational_temperature
    T_rot = 0.1 * gas.temperature if measured is None else jnp.maximum(measured[0], measured[1])
    mean_rate = jnp.log(curve.temperature[0] / curve.temperature[-1]) / curve.times[-1]
    guesses = {
        "tangential_restitution": jnp.zeros(()),
        "rotational_temperature": jnp.maximum(T_rot, 1e-6 * gas.temperature),
        "wall_coefficient": jnp.full((), 0.8),
        "wall_tangential_restitution": jnp.zeros(()),
        "drag_rate": 0.1 * jnp.maximum(mean_rate, 1e-9 / curve.times[-1]),
        "drag_rotational_rate": 0.1 * jnp.maximum(mean_rate, 1e-9 / curve.times[-1]),
    }
    for name in guesses.keys() & set(free):
        at_end = ~jnp.isfinite(gas.domains[name].to_free(gas.value(name)))
        gas = gas.replace(**{name: jnp.where(at_end, guesses[name], gas.value(name))})
    return gas


class Priors(eqx.Module):
    """Known values of floats of a gas, each with a standard error.

    Each prior is Gaussian in the unconstrained scale (the logarithm of a positive float).

    Attributes:
        names: names of the floats, or "density", which lets the mass vary, or "t0", the time at
            which the gas began to cool.
        given: known values, SI.
        errors: standard errors, SI.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    given: tuple[Float[Array, "..."], ...]
    errors: tuple[Float[Array, "..."], ...]

    @classmethod
    def of(cls, gas: Gas, priors: Any) -> "Priors":
        """Check and convert the priors that a user gave.

        Raises:
            ValueError: for an unknown name, a value outside its range or an error that is not
                positive.
        """
        if priors is None:
            return NO_PRIORS
        if not isinstance(priors, dict):
            raise ValueError(
                f"priors must be a dictionary of names, as {{'packing_fraction': (0.05, 0.002)}}, "
                f"got {priors!r:.60}"
            )
        for name, pair in priors.items():
            _check_prior(gas, name, pair)
        pairs = [tuple(map(jnp.asarray, pair)) for pair in priors.values()]
        values, errors = zip(*pairs, strict=True) if pairs else ((), ())
        return cls(tuple(priors), tuple(values), tuple(errors))

    def add(self, name: str, value: ArrayLike, error: ArrayLike) -> "Priors":
        """Return these priors and one more."""
        return Priors(
            (*self.names, name),
            (*self.given, jnp.asarray(value)),
            (*self.errors, jnp.asarray(error)),
        )

    def extra_parameters(self, free: tuple[str, ...]) -> tuple[str, ...]:
        """Return the floats that vary because of a prior and are not free parameters."""
        varied = ("mass" if name == DENSITY else name for name in self.names)
        return tuple(dict.fromkeys(name for name in varied if name not in free))

    def residuals(self, gas: Gas, start: Array | float = 0.0) -> Float[Array, "priors"]:
        """Return (value - known value) / standard error of each prior, in the unconstrained scale.

        Args:
            gas: the gas with the values.
            start: the time at which it began to cool, s.
        """
        parts = []
        for name, given, error in zip(self.names, self.given, self.errors, strict=True):
            value = jnp.asarray(start) if name == START_TIME else _prior_value(gas, name)
            domain = _prior_domain(gas, name)
            scale, width = jax.jvp(domain.to_free, (given,), (error,))
            parts.append(jnp.ravel((domain.to_free(value) - scale) / width))
        return jnp.concatenate([jnp.zeros(0, gas.temperature.dtype), *parts])


NO_PRIORS = Priors((), (), ())


def _prior_value(gas: Gas, name: str) -> Float[Array, "..."]:
    return gas.density if name == DENSITY else gas.value(name)


def _prior_domain(gas: Gas, name: str) -> Domain:
    return POSITIVE if name == DENSITY else domain_of(gas, name)


def _check_prior(gas: Gas, name: str, pair: object) -> None:
    if name not in (DENSITY, START_TIME) and name not in gas.domains:
        raise ValueError(
            f"priors: no float {name!r} in this gas; it has {', '.join(gas.domains)}, and {DENSITY}"
            f" and {START_TIME}"
        )
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ValueError(
            f"priors: {name} needs (value, standard error), as (0.05, 0.002), got {pair!r:.60}"
        )
    if any_traced(pair):
        return
    value, error = pair
    _prior_domain(gas, name).check(f"priors: {name}", value, "Give the known value, in SI units.")
    POSITIVE.check(
        f"priors: standard error of {name}", error, "Leave out values that are known exactly."
    )
    if not np.all(np.isfinite(np.asarray(_prior_domain(gas, name).to_free(value)))):
        raise ValueError(
            f"priors: {name} = {value} lies on the end of its range {_prior_domain(gas, name)}: "
            "give a value inside the range"
        )
