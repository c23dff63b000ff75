"""What can go wrong in compiled code, as data, with the advice that goes with it."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int


class Fault(NamedTuple):
    """One bit of a status.

    Attributes:
        bit: a power of two.
        meaning: what happened.
        advice: what to do if the run could not repair it by itself.
    """

    bit: int
    meaning: str
    advice: str


OK = 0
LIST_FULL = Fault(
    1,
    "the neighbour list is full",
    "inside jax.jit give more room by sized_for(gas, spare=4); else lower the packing fraction, "
    "the gas may have clustered into one dense clump",
)
CONTACTS_FULL = Fault(
    2,
    "more spheres are about to touch than there is room for",
    "as for a full neighbour list",
)
SKIN_OUTRUN = Fault(
    4,
    "a sphere crossed the skin of its neighbour list within one block of steps",
    "use more steps per contact, or a smaller starting velocity",
)
STEP_TOO_LARGE = Fault(
    8,
    "energy appeared from nowhere: the time step is too large",
    "raise steps_per_contact",
)
NOT_FINITE = Fault(
    16,
    "a position or velocity is not a finite number",
    "look for coincident spheres or values out of range in the starting state",
)
STALLED = Fault(
    32,
    "the run makes no progress",
    "the gas may have collapsed into lasting contacts; end the run earlier",
)
TOO_FAST = Fault(
    64,
    "many pairs meet faster than the ceiling of the collision rate",
    "the velocities have grown a tail of fast particles; look whether the law of restitution "
    "heats impacts at some speed",
)
STEPS_SPENT = Fault(
    128,
    "the solver reached its largest number of steps before the last time",
    "for a nearly elastic gas over many decades of time use KineticTheory(solver=diffrax.Kvaerno5"
    "()); else raise max_steps, or end earlier",
)
OVERLAPPING = Fault(
    256,
    "two spheres of the start overlap, which hard spheres must not",
    "move them apart, or leave start out for a random one",
)
OTHER_BOX = Fault(
    512,
    "the start's box is not that of the gas",
    "change packing_fraction or the start",
)
BOX_TOO_SMALL = Fault(
    1024,
    "the box is too short to tell a sphere from its image",
    "use more particles or a lower packing_fraction",
)
FAULTS = (
    LIST_FULL,
    CONTACTS_FULL,
    SKIN_OUTRUN,
    STEP_TOO_LARGE,
    NOT_FINITE,
    STALLED,
    TOO_FAST,
    STEPS_SPENT,
    OVERLAPPING,
    OTHER_BOX,
    BOX_TOO_SMALL,
)


def flag(fault: Fault, when: ArrayLike) -> Int[Array, "..."]:
    """The fault's bit where `when` holds, else 0; combine several with `|`."""
    return jnp.where(jnp.asarray(when), fault.bit, OK).astype(jnp.int32)


def has(status: ArrayLike, fault: Fault) -> Bool[Array, "..."]:
    """Whether a status carries a fault."""
    return (jnp.asarray(status) & fault.bit) != 0


def explain(status: int) -> str:
    """A status in words, with what to do; "ok" for 0."""
    faults = [fault for fault in FAULTS if int(status) & fault.bit]
    return "; ".join(f"{f.meaning}: {f.advice}" for f in faults) or "ok"
