"""The free parameters of a fit as one array in a scale without bounds."""

from jax import Array
from jax import numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, Float

from jaxgran.checks.validation import Domain
from jaxgran.scene.gas import Gas

START = "t0"
"""The one free parameter that is no float of a gas: the time, on the clock of the measurement, at
which the gas had its temperature T_0 and began to cool."""

ANY_TIME = Domain()


def domain_of(gas: Gas, name: str) -> Domain:
    """The allowed values of a parameter.

    Raises:
        ValueError: for a name that is none, with those that are.
    """
    if name == START:
        return ANY_TIME
    gas.value(name)
    return gas.domains[name]


def size_of(gas: Gas, name: str) -> int:
    """How many numbers a parameter is."""
    return 1 if name == START else gas.value(name).size


class Parameters:
    """Map between a gas and the array of its free parameters in their unbounded scale.

    The scale of a positive parameter is its logarithm (see `jaxgran.checks.validation.Domain`),
    that of `START` is linear, in units of a time.
    """

    def __init__(self, gas: Gas, names: tuple[str, ...], time_scale: ArrayLike = 1.0):
        self._gas, self.names, self._time_scale = gas, names, time_scale
        self._domains = [domain_of(gas, name) for name in names]
        self._unravel = ravel_pytree(self._to_free(gas, 0.0))[1]

    def _to_free(self, gas: Gas, start: ArrayLike) -> list[Array]:
        pairs = zip(self.names, self._domains, strict=True)
        late = jnp.asarray(start / self._time_scale, gas.temperature.dtype)
        return [late if n == START else domain.to_free(gas.value(n)) for n, domain in pairs]

    def flat(self, gas: Gas, start: ArrayLike = 0.0) -> Float[Array, "p"]:
        """The free parameters of a gas that began at some time, in the unbounded scale."""
        return ravel_pytree(self._to_free(gas, start))[0]

    def values(self, flat: Float[Array, "p"]) -> dict[str, Array]:
        """Their SI values by name."""
        pairs = zip(self.names, self._domains, self._unravel(flat), strict=True)
        return {
            name: free * self._time_scale if name == START else domain.from_free(free)
            for name, domain, free in pairs
        }

    def gas(self, flat: Float[Array, "p"]) -> Gas:
        """The gas with these values."""
        values = self.values(flat)
        values.pop(START, None)
        return self._gas.replace(**values)

    def start(self, flat: Float[Array, "p"]) -> Array | float:
        """The time at which the gas began to cool, s; 0 if it is not free."""
        return self.values(flat).get(START, 0.0)

    def estimates(self, flat: Float[Array, "p"]) -> Float[Array, "p"]:
        """SI values in one array."""
        return jnp.concatenate([jnp.ravel(value) for value in self.values(flat).values()])
