"""What soft spheres have besides the state and the progress of all kinds of spheres."""

from typing import NamedTuple

from jaxtyping import Array, Bool, Float, Int


class SoftState(NamedTuple):
    """What soft spheres have besides `State`.

    Attributes:
        elastic: energy in contacts.
        refine: factor by which steps are shorter than asked.
        good: number of blocks since the step was last changed.
        drift: sum of the relative energy errors of all blocks.
        spin: of spheres with friction; else None.
    """

    elastic: Float[Array, "replicas"]
    refine: Float[Array, ""]
    good: Int[Array, ""]
    drift: Float[Array, "replicas"]
    spin: Float[Array, "n spins"] | None = None


class SoftProgress(NamedTuple):
    """What soft spheres have besides `Progress`.

    Attributes:
        extra: particles found to take part only when a block had been stepped.
        widen: factor by which the next block looks farther.
        num_blocks: made with this neighbour list.
    """

    extra: Bool[Array, "n"]
    widen: Float[Array, ""]
    num_blocks: Int[Array, ""]
