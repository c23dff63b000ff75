"""Objects in short words, for a terminal and for a notebook."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from jax.core import Tracer

Rows = Sequence[tuple[str, str]]
"""Names and what is said of them."""


def format_quantity(value: Any, unit: str = "") -> str:
    """A number with its unit; of an array the shape, of a traced value that it is one."""
    if isinstance(value, Tracer):
        return "traced"
    array = np.asarray(value)
    if array.ndim > 0:
        return f"values of shape {array.shape}"
    return f"{float(array):.4g} {unit}".rstrip()


def text_table(title: str, rows: Rows) -> str:
    """A title, and a line for each row."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:{width}}  {words}" for name, words in rows)])


def html_table(title: str, rows: Rows) -> str:
    """The same as a table."""
    lines = [f"<tr><th>{escape(name)}</th><td>{escape(words)}</td></tr>" for name, words in rows]
    return f"<table><caption>{escape(title)}</caption>{''.join(lines)}</table>"
