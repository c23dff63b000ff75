"""The floats of a module and of its parts, by name."""

from abc import abstractmethod
from functools import reduce
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxgran.checks.validation import Domain, UserNumber, number
from jaxgran.checks.words import as_html, as_text
from jaxgran.scene.gas_words import gas_rows, gas_title

S = TypeVar("S", bound="NamedFloats")


class Place(NamedTuple):
    """Where a float is: attributes, one within the other; and its allowed range."""

    path: tuple[str, ...]
    domain: Domain


class NamedFloats(eqx.Module):
    """A module whose floats, those of its parts included, can be read and replaced by name."""

    def __repr__(self) -> str:
        return as_text(gas_title(self), gas_rows(self))

    def _repr_html_(self) -> str:
        return as_html(gas_title(self), gas_rows(self))

    def __getattr__(self, name: str) -> Any:
        # Only for names that are no attributes: floats of parts are read as they are replaced.
        if not name.startswith("_") and "law" in vars(self) and name in self._places:
            return self.value(name)
        raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

    @property
    @abstractmethod
    def _places(self) -> dict[str, Place]:
        """Where each float is."""

    @property
    def domains(self) -> dict[str, Domain]:
        """Allowed range of every float, by name."""
        return {name: place.domain for name, place in self._places.items()}

    def value(self, name: str) -> Float[Array, "..."]:
        """The value of a float, by name.

        Raises:
            ValueError: for an unknown name.
        """
        places = self._places
        if name not in places:
            raise ValueError(f"no float {name!r} in this gas; it has {', '.join(places)}")
        return reduce(getattr, places[name].path, self)

    def replace(self: S, **values: UserNumber) -> S:
        """A copy with other values of some floats: ``gas.replace(dissipative_constant=1e-6)``.

        Args:
            values: by name.

        Raises:
            ValueError: for an unknown name or a value outside its range.
        """
        places = self._places
        for name, value in values.items():
            self.value(name)
            places[name].domain.check(name, value)

        def get(module):
            return [reduce(getattr, places[name].path, module) for name in values]

        return eqx.tree_at(get, self, [number(value) for value in values.values()])

    def _check_single(self, lists: tuple[str, ...]) -> None:
        """Raise ValueError for a batch; `lists` are the floats that hold more than one number."""
        if all(jnp.shape(leaf) == () for leaf in jax.tree.leaves(self)):
            return
        for name in self._places:
            shape = jnp.shape(self.value(name))
            if shape != () and name not in lists:
                raise ValueError(
                    f"{name} of the gas has shape {shape}, and one number is allowed: take many "
                    "gases with jax.vmap(lambda gas: jaxgran.cool(gas, times))(gases), or call "
                    "this for one gas at a time"
                )
