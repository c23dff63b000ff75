"""Priors of a fit: known values, their residuals, and the parameters that vary because of them.

Priors are known numbers, arrays of NumPy.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxgran.data.measurement import DENSITY, START_TIME, Priors, prior_domain
from jaxgran.fitting.parameters import residuals_and_slopes
from jaxgran.scene.gas import Gas, law_fields

SHARED = ""
"""Label of the priors of parameters that all measurements share, and of a single measurement."""

SMOOTHNESS = "smoothness"
"""Name of the prior that a law of restitution brings."""


class KnownTime(NamedTuple):
    """A time that is known with an error.

    Attributes:
        value: s.
        error: its standard error, s; infinite if it is not known.
    """

    value: float
    error: float


def known_start_time(priors: dict[str, Priors], label: str) -> KnownTime:
    """Return t0 of a measurement by its priors; 0 with an infinite error without one."""
    both = {**priors.get(label, {}), **priors.get(SHARED, {})}
    value, error = both.get(START_TIME, (0.0, np.inf))
    return KnownTime(float(value), float(error))


def extra_parameters(priors: Priors, free: tuple[str, ...]) -> tuple[str, ...]:
    """Return the parameters that vary because of a prior and are not free parameters."""
    varied = ("mass" if name == DENSITY else name for name in priors if name != SMOOTHNESS)
    return tuple(dict.fromkeys(name for name in varied if name not in free))


class PriorRow(NamedTuple):
    """Residuals of a prior.

    Attributes:
        residuals: of unit variance, shape (n,).
        slopes: their derivatives in SI values, by the name of the parameter, shape (n, size).
    """

    residuals: Float[np.ndarray, "n"]
    slopes: dict[str, np.ndarray]


def prior_residuals(priors: Priors, gas: Gas, values: dict[str, Any]) -> dict[str, PriorRow]:
    """Return (value - known value) / standard error of each prior, with its derivatives.

    Differences are taken in the unconstrained scale.

    Args:
        priors: the known values.
        gas: the scene, for parameters that are not varied.
        values: SI values of the parameters that are varied, by name.
    """
    rows = {}
    for name, (given, error) in priors.items():
        if name == SMOOTHNESS:
            rows[name] = _row_of_law(gas, values)
        else:
            rows[name] = _row(name, np.asarray(given), np.asarray(error), gas, values)
    return rows


def _row_of_law(gas: Gas, values: dict[str, Any]) -> PriorRow:
    """Return the residuals of the prior that the law of a gas brings."""
    floats = {name: jnp.asarray(values[name]) for name in law_fields(gas.law) if name in values}
    residuals, slopes = residuals_and_slopes(_law_prior, gas, floats)
    return PriorRow(np.asarray(residuals), {name: np.asarray(x) for name, x in slopes.items()})


def _law_prior(gas: Gas) -> Array:
    return gas.law.prior_residuals()


def _row(
    name: str, given: np.ndarray, error: np.ndarray, gas: Gas, values: dict[str, Any]
) -> PriorRow:
    """Return the residual of a prior with a known value and its standard error."""

    def value_of(name: str) -> np.ndarray:
        return np.asarray(values[name] if name in values else gas.value(name))

    domain = prior_domain(gas, name)
    width = error / domain.slope(given)
    if name == DENSITY:
        mass = value_of("mass")
        diameter = value_of("diameter")
        value = 6 / np.pi * mass / diameter**3
        slopes = {"mass": 1 / (mass * width), "diameter": -3 / (diameter * width)}
    else:
        value = value_of(name)
        slopes = {name: 1 / (domain.slope(value) * width)}
    residuals = np.ravel((domain.to_free(value) - domain.to_free(given)) / width)
    matrices = {
        key: np.diag(np.broadcast_to(np.ravel(slope), residuals.shape))
        for key, slope in slopes.items()
        if key in values
    }
    return PriorRow(residuals, matrices)
