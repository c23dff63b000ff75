"""What hard spheres have besides the state and progress of all spheres."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int


class HardState(NamedTuple):
    """What hard spheres have besides `State`.

    Attributes:
        age: time since the last impact.
        regularised: impacts made elastic because they followed the last one too soon.
        window: length of the next window.
        spin: of rough spheres; else None.
    """

    age: Float[Array, "n"]
    regularised: Int[Array, "replicas"]
    window: Float[Array, ""]
    spin: Float[Array, "n spins"] | None = None


class HardProgress(NamedTuple):
    """What hard spheres have besides `Progress`.

    Attributes:
        widen: factor by which the bound on speeds is raised.
        num_windows, num_failed, num_rounds: made with this neighbour list.
    """

    widen: Float[Array, ""]
    num_windows: Int[Array, ""]
    num_failed: Int[Array, ""]
    num_rounds: Int[Array, ""]
