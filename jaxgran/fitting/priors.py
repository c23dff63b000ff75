"""What is known of a gas besides its cooling curve."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.checks.tracing import any_traced
from jaxgran.checks.validation import POSITIVE, Domain
from jaxgran.fitting.parameters import START, domain_of
from jaxgran.scene.gas import Gas

DENSITY = "density"
"""The one name that is not a float of a gas: the mass over the volume of a sphere."""


class Priors(eqx.Module):
    """Known values of floats of a gas, each with a standard error.

    Each is Gaussian in the float's unbounded scale (the logarithm of a positive one).

    Attributes:
        names: of the floats, or "density", which then lets the mass vary, or "t0", the time at
            which the gas began to cool.
        given: their values, SI.
        errors: and standard errors, SI.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    given: tuple[Float[Array, "..."], ...]
    errors: tuple[Float[Array, "..."], ...]

    @classmethod
    def of(cls, gas: Gas, priors: Any) -> "Priors":
        """The priors that a user gave.

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

    def with_one(self, name: str, value: ArrayLike, error: ArrayLike) -> "Priors":
        """These and one more."""
        more = (jnp.asarray(value),), (jnp.asarray(error),)
        return Priors((*self.names, name), self.given + more[0], self.errors + more[1])

    def also_free(self, free: tuple[str, ...]) -> tuple[str, ...]:
        """Floats that vary because of a prior, besides those that are free anyway."""
        varied = ("mass" if name == DENSITY else name for name in self.names)
        return tuple(dict.fromkeys(name for name in varied if name not in free))

    def residuals(self, gas: Gas, start: Array | float = 0.0) -> Float[Array, "priors"]:
        """(value - given one) / standard error of each, in the unbounded scale.

        Args:
            gas: with its values.
            start: the time at which it began to cool, s.
        """
        parts = []
        for name, given, error in zip(self.names, self.given, self.errors, strict=True):
            value = jnp.asarray(start) if name == START else _value(gas, name)
            domain = _domain(gas, name)
            scale, width = jax.jvp(domain.to_free, (given,), (error,))
            parts.append(jnp.ravel((domain.to_free(value) - scale) / width))
        return jnp.concatenate([jnp.zeros(0, gas.temperature.dtype), *parts])


NO_PRIORS = Priors((), (), ())


def _value(gas: Gas, name: str) -> Float[Array, "..."]:
    return gas.density if name == DENSITY else gas.value(name)


def _domain(gas: Gas, name: str) -> Domain:
    return POSITIVE if name == DENSITY else domain_of(gas, name)


def _check_prior(gas: Gas, name: str, pair: object) -> None:
    if name not in (DENSITY, START) and name not in gas.domains:
        raise ValueError(
            f"priors: no float {name!r} in this gas; it has {', '.join(gas.domains)}, and {DENSITY}"
            f" and {START}"
        )
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ValueError(
            f"priors: {name} needs (value, standard error), as (0.05, 0.002), got {pair!r:.60}"
        )
    if any_traced(pair):
        return
    value, error = pair
    _domain(gas, name).check(f"priors: {name}", value, "Give the known value, in SI units.")
    POSITIVE.check(f"priors: standard error of {name}", error, "Leave out what is known exactly.")
    if not np.all(np.isfinite(np.asarray(_domain(gas, name).to_free(value)))):
        raise ValueError(
            f"priors: {name} = {value} lies on the end of its range {_domain(gas, name)}, where no "
            "error has a meaning; give a value inside"
        )
