"""The free parameters of a fit as one array in a scale without bounds."""

from jax import Array
from jax import numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from jaxgran.scene.gas import Gas


class Parameters:
    """Map between a gas and the array of its free parameters in their unbounded scale.

    The scale of a positive parameter is its logarithm (see `jaxgran.checks.validation.Domain`).
    """

    def __init__(self, gas: Gas, names: tuple[str, ...]):
        self._gas, self._names = gas, names
        self._domains = [gas.domains[name] for name in names]
        self._unravel = ravel_pytree(self._to_free(gas))[1]

    def _to_free(self, gas: Gas) -> list[Array]:
        pairs = zip(self._names, self._domains, strict=True)
        return [domain.to_free(gas.value(name)) for name, domain in pairs]

    def flat(self, gas: Gas) -> Float[Array, "p"]:
        """The free parameters of a gas, in the unbounded scale."""
        return ravel_pytree(self._to_free(gas))[0]

    def values(self, flat: Float[Array, "p"]) -> dict[str, Array]:
        """Their SI values by name."""
        pairs = zip(self._names, self._domains, self._unravel(flat), strict=True)
        return {name: domain.from_free(free) for name, domain, free in pairs}

    def gas(self, flat: Float[Array, "p"]) -> Gas:
        """The gas with these values."""
        return self._gas.replace(**self.values(flat))

    def estimates(self, flat: Float[Array, "p"]) -> Float[Array, "p"]:
        """SI values in one array."""
        return jnp.concatenate([jnp.ravel(value) for value in self.values(flat).values()])
