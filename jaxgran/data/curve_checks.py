"""Checks of the values of a cooling curve, whose errors name the first wrong point."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from jaxgran.data.quantities import QUANTITIES, WITH_ERRORS, Quantity


def check_values(
    fields: dict[str, Any], status: Any = None, place: Callable[[int], str] = "point {}".format
) -> None:
    """Check the lengths of the fields of a curve, and the values of a measured one.

    Args:
        fields: by name; times are known.
        status: of a computed curve, the values of which are not checked.
        place: returns the name of a point, given its index, for error messages.

    Raises:
        ValueError: naming the first wrong point, and saying what to do.
    """
    times = np.asarray(fields["times"])
    known = {name: fields[name] for name in QUANTITIES if fields.get(name) is not None}
    for name, values in known.items():
        if np.shape(values)[-1:] != times.shape[-1:]:
            raise ValueError(
                f"{name} has shape {np.shape(values)}, but times have shape {times.shape}; give "
                "one value for each time"
            )
    if status is not None or times.ndim != 1:
        return
    for name, values in known.items():
        if QUANTITIES[name].measured and is_known(values) and np.ndim(values) == 1:
            error = known.get(f"{name}_error")
            error = np.asarray(error) if is_known(error) else np.zeros(1)
            _check_signs(QUANTITIES[name], np.asarray(values), error, times, place)
    not_later = np.flatnonzero(np.diff(times) <= 0)
    if not_later.size:
        i = int(not_later[0]) + 1
        raise ValueError(
            f"{place(i)}: t is {times[i]:g} after {times[i - 1]:g}; times must increase: sort "
            "the rows by time and remove repeated ones"
        )


def _check_signs(
    quantity: Quantity,
    values: np.ndarray,
    error: np.ndarray,
    times: np.ndarray,
    place: Callable[[int], str],
) -> None:
    column = quantity.column
    zero_allowed = np.zeros(values.shape, bool)
    zero_allowed[:1] = column != "T" and (column == "t" or times[0] == 0)
    allowed = (values > 0) | (error > 0) | (zero_allowed & (values == 0))
    wrong = ~(np.isfinite(values) & allowed)
    if not np.any(wrong):
        return
    i = int(np.argmax(wrong))
    zero = " (zero is allowed only in a first row at t = 0)" if column != "T" else ""
    advice = "correct or remove this row"
    if quantity in WITH_ERRORS and values[i] <= 0:
        advice += (
            f"; if noise was subtracted, give {quantity.error.column}: {column} may then be "
            "negative, and rows that are left out make A wrong"
        )
    raise ValueError(
        f"{place(i)}: {column} is {values[i]:g}, it must be a positive number{zero}; {advice}"
    )


def is_known(values: Any) -> bool:
    """Return whether values are numbers, and neither traced nor None nor a placeholder."""
    is_array = isinstance(values, jax.Array | np.ndarray)
    return is_array and not isinstance(values, Tracer)
