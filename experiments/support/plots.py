"""Panels of pictures, and what they have in common."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxgran.plotting import COLOURS

INK, GUIDE, ELASTIC = (COLOURS[name] for name in ("measured", "guide", "elastic"))
CONSTANT, VISCOELASTIC = (COLOURS[name] for name in ("constant restitution", "viscoelastic"))
THEORY, DSMC, HARD, SOFT = (
    COLOURS[name] for name in ("kinetic theory", "DSMC", "hard spheres", "soft spheres")
)

DOTS = {"fmt": "o", "ms": 3.5}
"""Points with error bars."""


def panels(
    columns: int = 1, rows: int = 1, title: str = "", size=(4.6, 4.0), **shared: Any
) -> tuple[Figure, list[Axes]]:
    """Return a figure with a title, and its panels, row by row.

    Args:
        size: width and height of a panel, inches.
        shared: further settings of `Figure.subplots`.
    """
    height = rows * size[1] + (0.4 if title else 0.0)
    figure = Figure(figsize=(columns * size[0], height), layout="constrained")
    figure.suptitle(title, color=INK)
    figure.subplots(rows, columns, **shared)
    return figure, figure.axes


def caption(axes: Axes, title: str = "", legend: Any = "best", **settings: Any) -> None:
    """Give a panel its title, labels and, unless its place is "none", a legend."""
    axes.set(**settings)
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.grid(color="0.92", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if legend != "none" and axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, framealpha=0.85, edgecolor="none", loc=legend)
