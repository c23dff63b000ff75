"""Status of a run in compiled code, where nothing can be raised: one bit for each fault."""

from typing import NamedTuple, SupportsInt

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Int


class Fault(NamedTuple):
    """A fault that a run can report: one bit of its status.

    Attributes:
        bit: a power of two.
        meaning: what happened, as a clause.
        advice: what the user can do if the run could not repair it by itself.
    """

    bit: int
    meaning: str
    advice: str


OK = 0
_ALLOW_MORE_PAIRS = (
    "inside jax.jit allow more pairs by sized_for(gas, spare=4); else lower the packing fraction: "
    "the gas may have clustered into one dense region"
)
LIST_FULL = Fault(1, "the neighbour list is full", _ALLOW_MORE_PAIRS)
CONTACTS_FULL = Fault(2, "the list of pairs that may touch is full", _ALLOW_MORE_PAIRS)
SKIN_OUTRUN = Fault(
    4,
    "a sphere moved farther than the skin of its neighbour list within one block of steps",
    "raise steps_per_contact, or start with smaller velocities",
)
STEP_TOO_LARGE = Fault(
    8,
    "the total energy has grown: the time step is too large",
    "raise steps_per_contact",
)
NOT_FINITE = Fault(
    16,
    "a position or velocity is not a finite number",
    "check the initial state for coincident spheres and for values outside their range",
)
STALLED = Fault(
    32,
    "the simulated time no longer advances",
    "the gas may have collapsed into lasting contacts; end the run earlier",
)
TOO_FAST = Fault(
    64,
    "many pairs meet faster than the largest relative speed for which collisions are sampled",
    "the velocity distribution has grown a tail of fast particles; check whether the law of "
    "restitution gains energy at some speed",
)
STEPS_SPENT = Fault(
    128,
    "the solver reached its largest number of steps before the last time",
    "for a nearly elastic gas over many decades of time use KineticTheory(solver=diffrax.Kvaerno5"
    "()); else raise max_steps, or end earlier",
)
OVERLAPPING = Fault(
    256,
    "two spheres of the initial state overlap, or a sphere and a wall, which hard spheres must not",
    "move them apart, or leave out start for a random initial state",
)
OTHER_BOX = Fault(
    512,
    "the start's box is not that of the gas",
    "change packing_fraction, or give a start in a box of the right size",
)
BOX_TOO_SMALL = Fault(
    1024,
    "the box is too short to tell a sphere from its periodic image",
    "use more particles or a lower packing_fraction",
)
ENERGY_DRIFT = Fault(
    2048,
    "the energy balance of the whole run is off by more than 5 %, by small errors of many steps",
    "raise steps_per_contact, or in single precision use float64",
)
OUT_OF_RANGE = Fault(
    4096,
    "a float of the gas lies outside its range, or the times do not increase from 0 or later",
    "look at gas.domains, and sort the times",
)
UNSUPPORTED = Fault(
    8192,
    "the model does not take this gas",
    "call jaxgran.cool for it alone, which says why",
)
NO_ROOM = Fault(
    16384,
    "spheres at random places still overlap after many pushes apart",
    "lower the packing fraction, or give your own start",
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
    ENERGY_DRIFT,
    OUT_OF_RANGE,
    UNSUPPORTED,
    NO_ROOM,
)


def flag(fault: Fault, when: ArrayLike) -> Int[Array, "..."]:
    """The bit of a fault where `when` is true, else 0; combine several statuses with `|`.

    Args:
        fault: what to report.
        when: booleans, any shape.
    """
    return jnp.where(jnp.asarray(when), fault.bit, OK).astype(jnp.int32)


def has(status: ArrayLike, fault: Fault) -> Bool[Array, "..."]:
    """Whether the status of each run, any shape, contains a fault."""
    return (jnp.asarray(status) & fault.bit) != 0


def explain(status: SupportsInt) -> str:
    """The faults of one status in words, each with what to do about it; "ok" for 0.

    Args:
        status: a whole number, such as `jaxgran.CoolingCurve.status`.

    >>> jaxgran.explain_status(0)
    'ok'
    """
    faults = [fault for fault in FAULTS if int(status) & fault.bit]
    return "; ".join(f"{f.meaning}: {f.advice}" for f in faults) or "ok"
