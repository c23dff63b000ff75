"""The allowed range of a number or of times: how it is checked, and freed for a fit."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float


class Domain(NamedTuple):
    """An interval of the real line, open unless an end is said to belong to it.

    Attributes:
        low, high: the ends; may be infinite.
        low_allowed, high_allowed: whether the end itself is a legal value.
    """

    low: float = -np.inf
    high: float = np.inf
    low_allowed: bool = False
    high_allowed: bool = False

    def __str__(self) -> str:
        left = "[" if self.low_allowed else "("
        right = "]" if self.high_allowed else ")"
        return f"{left}{self.low:g}, {self.high:g}{right}"

    def check(self, name: str, value: ArrayLike, advice: str = "") -> None:
        """Raise ValueError if a value lies outside; values that are being traced pass unseen.

        Args:
            name: what the value is called where the caller gave it.
            value: any shape; every element is checked.
            advice: what to do about it.
        """
        if isinstance(value, Tracer):
            return
        try:
            numbers = np.asarray(value, dtype=float)
        except (TypeError, ValueError):
            raise ValueError(
                f"{name} must be a number in {self}, got {value!r}. {advice}"
            ) from None
        above = numbers >= self.low if self.low_allowed else numbers > self.low
        below = numbers <= self.high if self.high_allowed else numbers < self.high
        wrong = ~(above & below & np.isfinite(numbers))
        if np.any(wrong):
            raise ValueError(f"{name} must lie in {self}, got {numbers[wrong].flat[0]:g}. {advice}")

    def to_free(self, value: ArrayLike) -> Float[Array, "..."]:
        """Map the interior one-to-one onto the whole real line: log, logit, or nothing."""
        value = jnp.asarray(value)
        if np.isinf(self.low) and np.isinf(self.high):
            return value
        if np.isinf(self.high):
            return jnp.log(value - self.low)
        return jnp.log(value - self.low) - jnp.log(self.high - value)

    def from_free(self, free: ArrayLike) -> Float[Array, "..."]:
        """The inverse of `to_free`."""
        free = jnp.asarray(free)
        if np.isinf(self.low) and np.isinf(self.high):
            return free
        if np.isinf(self.high):
            return self.low + jnp.exp(free)
        return self.low + (self.high - self.low) * jax.nn.sigmoid(free)


POSITIVE = Domain(low=0.0)
NOT_NEGATIVE = Domain(low=0.0, low_allowed=True)
FRACTION = Domain(low=0.0, high=1.0, low_allowed=True, high_allowed=True)
ANY = Domain()


def checked_times(times: ArrayLike | Sequence[float]) -> Float[Array, "times"]:
    """Times as an array; ValueError unless they increase from t >= 0. Traced ones pass unseen."""
    if not isinstance(times, Tracer):
        numbers = np.asarray(times, dtype=float)
        if numbers.ndim != 1 or numbers.size == 0:
            raise ValueError(f"times must be a list of numbers, got shape {numbers.shape}")
        if not np.all(np.isfinite(numbers)) or numbers[0] < 0:
            raise ValueError(
                f"times must be finite and not negative, got {numbers.min():g} at the least; "
                "the gas starts at t = 0"
            )
        if np.any(np.diff(numbers) <= 0):
            i = int(np.argmax(np.diff(numbers) <= 0)) + 1
            raise ValueError(
                f"times must increase, got {numbers[i]:g} after {numbers[i - 1]:g}; sort them"
            )
    return jnp.asarray(times, dtype=jnp.result_type(float))
