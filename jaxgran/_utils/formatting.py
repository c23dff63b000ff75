"""Short representations of objects, for a terminal and for a notebook."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from jax.core import Tracer

TableRows = Sequence[tuple[str, str]]
"""Pairs of a name and its description."""


def format_quantity(value: Any, unit: str = "") -> str:
    """Format a number with its unit; for an array give its shape, for a traced value "traced"."""
    if isinstance(value, Tracer):
        return "traced"
    array = np.asarray(value)
    if array.ndim > 0:
        return f"values of shape {array.shape}"
    return f"{float(array):.4g} {unit}".rstrip()


def text_table(title: str, rows: TableRows) -> str:
    """Format a title and rows as plain text, one row a line."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:{width}}  {text}" for name, text in rows)])


def html_table(title: str, rows: TableRows) -> str:
    """Format a title and rows as an HTML table."""
    lines = [f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in rows]
    return f"<table><caption>{escape(title)}</caption>{''.join(lines)}</table>"
