"""What hard spheres have besides the state and progress of all spheres."""

from typing import NamedTuple

from jaxtyping import Array, Float, Int, UInt32


class HardState(NamedTuple):
    """What hard spheres have besides `State`.

    Attributes:
        age: time since the last impact.
        regularised: impacts made elastic because they followed the last one too soon.
        window: length of the next window.
        spin: of rough spheres, what drag keeps of it; else None.
        turned: gain of the energy of these spins since t = 0; else None.
        key: of the random numbers of a drive, and of how many kicks; else None.
    """

    age: Float[Array, "n"]
    regularised: Int[Array, "replicas"]
    window: Float[Array, ""]
    spin: Float[Array, "n spins"] | None = None
    turned: Float[Array, "replicas"] | None = None
    key: UInt32[Array, "3"] | None = None


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
