"""Parameters of a fit: their names, ranges and unconstrained scale, and gases with new ones."""

from collections.abc import Callable
from math import prod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from jaxgran._utils.validation import Domain
from jaxgran.data.measurement import START_TIME
from jaxgran.scene.gas import Gas
from jaxgran.scene.parameter_fields import law_fields

LAW = "law"
"""Name that stands for all parameters of the law of restitution."""


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
