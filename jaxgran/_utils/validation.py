"""Validation of user input, and the map from an interval to an unconstrained parameter."""

import datetime
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

UserNumber = ArrayLike | Sequence[float]
"""A number of a user, or a list or an array of numbers."""


class Domain(NamedTuple):
    """Interval of the allowed values of a number; each end is excluded by default.

    Attributes:
        low, high: the ends; may be infinite.
        low_allowed, high_allowed: whether the end itself is allowed.

    >>> positive = jaxgran.extend.Domain(low=0.0)
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
            advice: a sentence that ends the error message and tells the user what to do.

        Raises:
            ValueError: if the value is not a number, or an element is not finite or lies outside.
        """
        if isinstance(value, Tracer):
            return
        try:
            numbers = _floats(value)
        except (TypeError, ValueError):
            raise ValueError(
                f"{name} must be a number in {self}, got {value!r}. {advice}"
            ) from None
        wrong = ~self.contains(numbers)
        if np.any(wrong):
            raise ValueError(f"{name} must lie in {self}, got {numbers[wrong].flat[0]:g}. {advice}")

    def contains(self, value: ArrayLike) -> Any:
        """Tell for each element of a value whether it is finite and lies in the interval.

        The value may be traced. The result is an array of JAX if the value is, otherwise of NumPy.
        """
        x: Any = value if isinstance(value, jax.Array) else np.asarray(value)
        above = x >= self.low if self.low_allowed else x > self.low
        below = x <= self.high if self.high_allowed else x < self.high
        return above & below & (abs(x) < np.inf)

    def to_free(self, value: Any) -> Any:
        """Map the interior of the interval one-to-one onto the whole real line.

        The map is the identity if both ends are infinite, ``ln(x - low)`` if only the upper end is,
        otherwise the logit ``ln(x - low) - ln(high - x)``. Values may be arrays of JAX or of NumPy.
        """
        xp = jnp if isinstance(value, jax.Array) else np
        if np.isinf(self.low) and np.isinf(self.high):
            return value
        with np.errstate(divide="ignore"):
            if np.isinf(self.high):
                return xp.log(value - self.low)
            return xp.log(value - self.low) - xp.log(self.high - value)

    def from_free(self, free: Any) -> Any:
        """Inverse of `to_free`."""
        xp = jnp if isinstance(free, jax.Array) else np
        if np.isinf(self.low) and np.isinf(self.high):
            return free
        with np.errstate(over="ignore"):
            if np.isinf(self.high):
                return self.low + xp.exp(free)
        return self.low + (self.high - self.low) * (1 + xp.tanh(free / 2)) / 2

    def slope(self, value: Any) -> Any:
        """Derivative of a value in its unconstrained parameter."""
        if np.isinf(self.low) and np.isinf(self.high):
            return value * 0 + 1.0
        if np.isinf(self.high):
            return value - self.low
        return (value - self.low) * (self.high - value) / (self.high - self.low)


POSITIVE = Domain(low=0.0)
NON_NEGATIVE = Domain(low=0.0, low_allowed=True)
FRACTION = Domain(low=0.0, high=1.0, low_allowed=True, high_allowed=True)
ANY = Domain()


def float_array(value: UserNumber, name: str = "", unit: str = "") -> Float[Array, "..."]:
    """Convert a number or a list of numbers to a JAX array of the default float type.

    The array is strongly typed, so that two Python floats do not cause two compilations.

    Args:
        value: any shape.
        name: of the value, for messages.
        unit: of the value, SI, to which quantities with units are converted.

    Raises:
        ValueError: if the value cannot be converted.
    """
    value = in_si(value, unit)
    if np.ma.is_masked(value):
        of = f" of {name}" if name else ""
        raise ValueError(f"some values{of} are masked. Leave these points out of all quantities.")
    try:
        leaves = jax.tree.leaves(value)
        if any(isinstance(leaf, jax.Array) for leaf in leaves):
            if not all(_is_real(leaf) for leaf in leaves):
                raise TypeError
            return jnp.asarray(value, dtype=jnp.result_type(float))
        return jnp.asarray(_floats(value), dtype=jnp.result_type(float))
    except (TypeError, ValueError):
        what = f"{name} must be" if name else "expected"
        raise ValueError(f"{what} a number or an array of numbers, got {value!r:.60}") from None


def number_named(name: str, unit: str = "") -> Callable[[UserNumber], Array]:
    """Return a converter of `equinox.field` to a float array; `name` is that in messages."""
    return partial(float_array, name=name, unit=unit)


def _floats(value: Any) -> np.ndarray:
    """Convert to NumPy floats; raise TypeError or ValueError for strings, booleans and the like."""
    array = np.asarray(in_si(value))
    if not _is_real(array):
        raise TypeError
    return array.astype(float)


def _is_real(array: Any) -> bool:
    """Return whether an array or a number holds real numbers, and not booleans."""
    dtype = jnp.result_type(array)
    return jnp.issubdtype(dtype, jnp.integer) or jnp.issubdtype(dtype, jnp.floating)


def in_si(value: Any, unit: str = "") -> Any:
    """Return the numbers of a quantity with a unit in SI; other values unchanged.

    Args:
        value: of any type. Known are quantities of pint, astropy and unyt, and time differences.
        unit: SI unit, which quantities are converted to; if "", they are converted to base units.

    Raises:
        ValueError: for dates, and for a quantity that cannot have this unit.
    """
    if type(value) in (list, tuple):
        return [in_si(part, unit) for part in value]
    value = getattr(value, "data", value) if hasattr(value, "dims") else value  # of xarray
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    if kind == "M" or isinstance(value, datetime.date):
        raise ValueError(
            "got dates, and times are in seconds since the gas began to cool. Subtract the first "
            "one: dates - dates[0]"
        )
    if isinstance(value, datetime.timedelta):
        return value.total_seconds()
    if kind == "m":
        return np.asarray(value) / np.timedelta64(1, "s")
    to_base = next((x for x in ("to_base_units", "decompose", "in_mks") if hasattr(value, x)), None)
    if to_base is None or not hasattr(value, "to"):
        return value
    try:
        converted = value.to(unit.replace("^", "**")) if unit else getattr(value, to_base)()
    except Exception as error:  # each library raises errors of its own
        raise ValueError(f"expected a quantity in {unit or 'SI units'}: {error}") from None
    return converted.magnitude if hasattr(converted, "magnitude") else converted.value


def python_int(value: Any) -> Any:
    """Convert a NumPy integer to a Python int, which compares and prints the same everywhere."""
    return int(value) if isinstance(value, np.integer) else value


def checked_int(name: str, value: Any, minimum: int, advice: str = "") -> int:
    """Return an integer of Python or NumPy as an int, after a check of its type and size.

    Args:
        name: name of the value in the error message.
        value: the value that the user gave.
        minimum: the smallest allowed value.
        advice: a sentence that ends the error message.

    Raises:
        ValueError: if the value is not an integer, or is less than the minimum.
    """
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < minimum:
        raise ValueError(
            f"{name} must be a whole number >= {minimum}, an int, got {value!r}. {advice}".rstrip()
        )
    return int(value)


def checked_float(name: str, value: Any, domain: Domain, advice: str = "") -> float:
    """Return a number that is fixed at compilation as a float, after a check of type and range.

    Args:
        name: name of the value in the error message.
        value: the value that the user gave.
        domain: the allowed interval.
        advice: a sentence that ends the error message.

    Raises:
        ValueError: if the value is not a single number, or lies outside the interval.
    """
    if not isinstance(value, float | int | np.number) or isinstance(value, bool):
        raise ValueError(f"{name} must be a number in {domain}, got {value!r}. {advice}".rstrip())
    domain.check(name, value, advice)
    return float(value)


def check_bool(**values: Any) -> None:
    """Raise ValueError unless the values, by name, are True or False."""
    for name, value in values.items():
        if not isinstance(value, bool | np.bool_):
            raise ValueError(f"{name} must be True or False, got {value!r}")


def list_to_array(value: Any, unit: str = "") -> Any:
    """Convert a list or an array of any library to a JAX array; return others unchanged."""
    value = in_si(value, unit)
    is_foreign = hasattr(value, "__array__") and not isinstance(value, jax.Array)
    return float_array(value) if isinstance(value, list | tuple) or is_foreign else value


def checked_times(times: UserNumber) -> Float[Array, "times"]:
    """Convert output times to a JAX array, after a check that they increase from t >= 0.

    Traced times are not checked.

    Args:
        times: t, s, shape (times,).

    Raises:
        ValueError: if there are no times, or if they are not finite, negative or not increasing.
    """
    if isinstance(times, Tracer):
        return times.astype(jnp.result_type(float))
    try:
        numbers = _floats(in_si(times, "s")).astype(jnp.result_type(float))
    except (TypeError, ValueError):
        raise ValueError(f"times must be a list of numbers, got {times!r}") from None
    if numbers.ndim != 1 or numbers.size == 0:
        raise ValueError(f"times must be a list of numbers, got shape {numbers.shape}")
    wrong = ~np.isfinite(numbers) | (numbers < 0)
    if np.any(wrong):
        raise ValueError(
            f"times must be finite and not negative, got {numbers[wrong][0]:g}. "
            "The gas starts at t = 0."
        )
    not_later = np.flatnonzero(np.diff(numbers) <= 0)
    if not_later.size:
        before, after = numbers[not_later[0] :][:2]
        raise ValueError(
            f"times must increase, got {after:g} after {before:g} in {numbers.dtype}. Sort them "
            'and remove repeated times, or call jax.config.update("jax_enable_x64", True) first.'
        )
    # Without a dtype JAX would compile a program for each length.
    return jnp.asarray(numbers, dtype=numbers.dtype)
