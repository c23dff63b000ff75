"""Short representations of objects."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.core import Tracer


def format_quantity(value: Any, unit: str = "") -> str:
    """Format a number with its unit; for an array give its shape, for a traced value "traced"."""
    if isinstance(value, Tracer):
        return "traced"
    array = np.asarray(value)
    if array.ndim > 0:
        return f"values of shape {array.shape}"
    return f"{float(array):.4g} {unit}".rstrip()


def text_table(title: str, rows: Sequence[tuple[str, str]]) -> str:
    """Format a title and rows, pairs of a name and its description, as one row a line."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:{width}}  {text}" for name, text in rows)])
