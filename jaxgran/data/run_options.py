"""Options of the run of a model, as a model's `simulate` gets them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jaxtyping import PRNGKeyArray


class Run(NamedTuple):
    """Options of one run, which `jaxgran.cool` makes from its arguments.

    Attributes:
        key: key of the random numbers; None stands for `jax.random.key(0)`. Deterministic models
            ignore it.
        progress: whether to show a progress bar on a terminal.
        checkpoint: file to which the run is saved and from which it is resumed, or None.
        save: function of the particles of each replica, or "particles". Its value at each time
            becomes `CoolingCurve.saved`. None saves nothing.
        trajectory: file to which the particles are written at each time, or None.
        starts: equilibrated random starts of earlier runs, which runs of spheres read and extend: a
            run that finds its gas there takes the positions and draws new velocities. None
            equilibrates each run.

    >>> jaxgran.extend.Run(progress=False).checkpoint is None
    True
    """

    key: PRNGKeyArray | None = None
    progress: bool = False
    checkpoint: str | Path | None = None
    save: Callable[..., Any] | str | None = None
    trajectory: str | Path | None = None
    starts: dict[str, Any] | None = None
