"""Validation of numbers given by a user, and the map between a range and the whole real line."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

F = TypeVar("F", bound=Callable)

if TYPE_CHECKING:
    UserNumber = ArrayLike | Sequence[float]
    UserCount = int
    UserFloat = float
    UserTruth = bool

    def no_type_check(function: F) -> F:
        """Mark a public function that checks its arguments itself, with clearer errors."""
        return function
else:
    # A run-time type checker lets everything pass, so that a wrong type is reported in words.
    from typing import no_type_check  # noqa: F401

    UserNumber = UserCount = UserFloat = UserTruth = Any


class Domain(NamedTuple):
    """The interval of allowed values of a number; open, unless an end is said to be included.

    Attributes:
        low, high: the ends; may be infinite.
        low_allowed, high_allowed: whether the end itself is an allowed value.

    >>> positive = jaxgran.Domain(low=0.0)
    >>> str(positive), bool(positive.contains(-1.0))
    ('(0, inf)', False)
    """

    low: float = -np.inf
    high: float = np.inf
    low_allowed: bool = False
    high_allowed: bool = False

    def __str__(self) -> str:
        left = "[" if self.low_allowed else "("
        right = "]" if self.high_allowed else ")"
        return f"{left}{self.low:g}, {self.high:g}{right}"

    def check(self, name: str, value: UserNumber, advice: str = "") -> None:
        """Check that every element of a value is finite and lies in the interval.

        Traced values are not checked.

        Args:
            name: name of the value in the error message.
            value: any shape.
            advice: a sentence that tells the user what to do; ends the error message.

        Raises:
            ValueError: if the value is no number, or an element is not finite or lies outside.
        """
        if isinstance(value, Tracer):
            return
        try:
            numbers = _floats(value)
        except (TypeError, ValueError):
            raise ValueError(
                f"{name} must be a number in {self}, got {value!r}. {advice}"
            ) from None
        above = numbers >= self.low if self.low_allowed else numbers > self.low
        below = numbers <= self.high if self.high_allowed else numbers < self.high
        wrong = ~(above & below & np.isfinite(numbers))
        if np.any(wrong):
            raise ValueError(f"{name} must lie in {self}, got {numbers[wrong].flat[0]:g}. {advice}")

    def contains(self, value: ArrayLike) -> Bool[Array, "..."]:
        """Whether each element of a value, which may be traced, is finite and in the interval."""
        value = jnp.asarray(value)
        above = value >= self.low if self.low_allowed else value > self.low
        below = value <= self.high if self.high_allowed else value < self.high
        return above & below & jnp.isfinite(value)

    def to_free(self, value: ArrayLike) -> Float[Array, "..."]:
        """Map the interior of the interval one-to-one onto the whole real line.

        The identity if both ends are infinite, ``ln(x - low)`` if only the upper one is, else the
        logit ``ln(x - low) - ln(high - x)``.
        """
        value = jnp.asarray(value)
        if np.isinf(self.low) and np.isinf(self.high):
            return value
        if np.isinf(self.high):
            return jnp.log(value - self.low)
        return jnp.log(value - self.low) - jnp.log(self.high - value)

    def from_free(self, free: ArrayLike) -> Float[Array, "..."]:
        """Inverse of `to_free`."""
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


def number(value: UserNumber) -> Float[Array, "..."]:
    """Convert a number, or a list of numbers, to a JAX array of the default float type.

    The array is strongly typed, so that two Python floats do not cause two compilations.

    Raises:
        ValueError: if the value cannot be converted.
    """
    try:
        if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(value)):
            return jnp.asarray(value, dtype=jnp.result_type(float))
        return jnp.asarray(_floats(value), dtype=jnp.result_type(float))
    except (TypeError, ValueError):
        raise ValueError(f"expected a number or an array of numbers, got {value!r}") from None


def check_normal(name: str, value: Array) -> None:
    """Raise ValueError for a number that single precision cannot hold, where that is used."""
    if not isinstance(value, Tracer) and value.dtype != jnp.float64:
        small = np.asarray(value)
        if np.any((small != 0) & (np.abs(small) < np.finfo(small.dtype).tiny)):
            raise ValueError(
                f"{name} is too small for {small.dtype}, got {small.min():g}: "
                'jax.config.update("jax_enable_x64", True) first'
            )


def _floats(value: Any) -> np.ndarray:
    """Numbers as NumPy floats; TypeError or ValueError for texts, truth values and the like."""
    array = np.asarray(value)
    if array.dtype.kind not in "iuf" and not jnp.issubdtype(array.dtype, jnp.floating):
        raise TypeError
    return array.astype(float)


def python_number(value: Any) -> Any:
    """A whole number of NumPy as one of Python, which compares and prints the same everywhere."""
    return int(value) if isinstance(value, np.integer) else value


def whole_number(name: str, value: Any, least: int, advice: str = "") -> int:
    """A whole number given by a user, of Python or NumPy.

    Args:
        name: of the value in the error message.
        value: what was given.
        least: the smallest allowed.
        advice: ends the error message.

    Raises:
        ValueError: for anything else or less.
    """
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least:
        raise ValueError(
            f"{name} must be a whole number >= {least}, an int, got {value!r}. {advice}".rstrip()
        )
    return int(value)


def plain_number(name: str, value: Any, domain: Domain, advice: str = "") -> float:
    """A number given by a user that is fixed when a program is compiled.

    Args:
        name: of the value in the error message.
        value: what was given.
        domain: the allowed interval.
        advice: ends the error message.

    Raises:
        ValueError: for anything that is no single number, or outside of the interval.
    """
    if not isinstance(value, float | int | np.number) or isinstance(value, bool):
        raise ValueError(f"{name} must be a number in {domain}, got {value!r}. {advice}".rstrip())
    domain.check(name, value, advice)
    return float(value)


def check_bool(name: str, value: Any) -> None:
    """Raise ValueError for anything but True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")


def array_if_listed(value: Any) -> Any:
    """A list, tuple or NumPy array of numbers as a JAX array; anything else as it is."""
    return number(value) if isinstance(value, list | tuple | np.ndarray) else value


def checked_times(times: UserNumber) -> Float[Array, "times"]:
    """Convert output times to a JAX array, after checking that they increase from t >= 0.

    Traced times are not checked.

    Args:
        times: t, s, shape (times,).

    Raises:
        ValueError: if there is no time, or times are not finite, negative or not increasing.
    """
    if not isinstance(times, Tracer):
        try:
            numbers = _floats(times)
        except (TypeError, ValueError):
            raise ValueError(f"times must be a list of numbers, got {times!r}") from None
        if numbers.ndim != 1 or numbers.size == 0:
            raise ValueError(f"times must be a list of numbers, got shape {numbers.shape}")
        wrong = ~np.isfinite(numbers) | (numbers < 0)
        if np.any(wrong):
            raise ValueError(
                f"times must be finite and not negative, got {numbers[wrong][0]:g}; "
                "the gas starts at t = 0"
            )
        if np.any(np.diff(numbers) <= 0):
            i = int(np.argmax(np.diff(numbers) <= 0)) + 1
            raise ValueError(
                f"times must increase, got {numbers[i]:g} after {numbers[i - 1]:g}; sort them and "
                "remove repeated ones"
            )
    times = jnp.asarray(times, dtype=jnp.result_type(float))
    if not isinstance(times, Tracer) and np.any(np.diff(np.asarray(times)) <= 0):
        raise ValueError(
            f"times are closer together than {times.dtype} can tell apart: give fewer of them, or "
            'jax.config.update("jax_enable_x64", True) first'
        )
    return times
