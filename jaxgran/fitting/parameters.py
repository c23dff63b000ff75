"""Parameters of a fit: names, ranges and unconstrained scale, gases with new values, and priors.

Priors are known numbers, arrays of NumPy.
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
from jaxgran.data.measurement import DENSITY, START_TIME, Priors, prior_domain
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameter_fields import law_fields

LAW = "law"
"""Name that stands for all parameters of the law of restitution."""

SHARED = ""
"""Label of what all measurements share: unknowns, priors and residuals. It is the label of a single
measurement, too."""

SMOOTHNESS = "smoothness"
"""Name of the prior that a law of restitution brings."""


class Unknown(NamedTuple):
    """A parameter that a search varies.

    Attributes:
        name: of a parameter of the gas, `START_TIME`, or of a nuisance parameter.
        label: of the measurement that it belongs to, or `SHARED`.
        shape: of its value.
        domain: its range, which gives its unconstrained scale.
        unit: of the unconstrained scale of a parameter with an infinite range.
    """

    name: str
    label: str
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
        return self.name if self.label == SHARED else f"{self.label}: {self.name}"

    def applies_to(self, label: str) -> bool:
        """Tell whether it is an unknown of the measurement with a label."""
        return self.label in (SHARED, label)


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
    return gas.with_arrays(values)


def as_floats(values: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return known values as NumPy arrays of the default float type, by name."""
    dtype = jnp.result_type(float)
    return {name: np.asarray(x, dtype) for name, x in values.items()}


def with_values(gas: Gas, values: dict[str, Any]) -> Gas:
    """Return a gas with known values of parameters, by name; ranges are not checked."""
    return with_parameters(gas, as_floats(values))


def magnitude_of(value: float) -> float:
    """Return what changes and ranges of a parameter are compared with; 1 for 0, as of beta_t."""
    return abs(value) or 1.0


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
