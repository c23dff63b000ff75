"""The options of one run, as opposed to the description of a model."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jaxtyping import PRNGKeyArray


class Run(NamedTuple):
    """The options of one run. `jaxgran.cool` makes it from its arguments.

    Attributes:
        key: of the random numbers; None is `jax.random.key(0)`. Deterministic models ignore it.
        progress: show a progress bar on a terminal.
        checkpoint: file to which the run is saved and from which it is resumed; None for none.
        save: a function of the particles of each replica, or "particles", whose value at each time
            is `CoolingCurve.saved`; None for nothing.
        trajectory: file to which the particles are written at each time; None for none.

    >>> jaxgran.Run(progress=False).checkpoint is None
    True
    """

    key: PRNGKeyArray | None = None
    progress: bool = False
    checkpoint: str | Path | None = None
    save: Callable[..., Any] | str | None = None
    trajectory: str | Path | None = None


DEFAULTS = Run()
"""A silent run with the default random numbers, not saved."""
