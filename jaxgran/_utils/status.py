"""Status of a run: one bit for each fault, since compiled runs raise no exceptions."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Int


class Fault(NamedTuple):
    """A fault that a run can report: one bit of its status.

    Attributes:
        bit: a power of two.
        meaning: what happened, as a clause.
        advice: what the user can do if the run cannot recover by itself.
    """

    bit: int
    meaning: str
    advice: str


OK = 0
_ALLOW_MORE_PAIRS = (
    "inside jax.jit allow more pairs by sized_for(gas, spare=4); otherwise lower the packing "
    "fraction, since the gas may have clustered into one dense region"
)
LIST_FULL = Fault(1, "the neighbour list is full", _ALLOW_MORE_PAIRS)
CONTACTS_FULL = Fault(2, "the list of pairs that may touch is full", _ALLOW_MORE_PAIRS)
SKIN_EXCEEDED = Fault(
    4,
    "a sphere moved farther than the skin of its neighbour list within one block of steps",
    "increase steps_per_contact, or start with smaller velocities",
)
STEP_TOO_LARGE = Fault(
    8,
    "the total energy has grown: the time step is too large",
    "increase steps_per_contact",
)
NOT_FINITE = Fault(
    16,
    "a result is not a finite number",
    "check for values of the gas that are so small or large that their powers are 0 or infinite, "
    "and a given start for coincident spheres",
)
STALLED = Fault(
    32,
    "the simulated time no longer advances",
    "the gas may have collapsed into lasting contacts; end the run earlier",
)
TOO_FAST = Fault(
    64,
    "many pairs are faster than the largest relative speed for which collisions are sampled",
    "the velocity distribution has a tail of fast particles; check whether the law of restitution "
    "gains energy at some speed",
)
MAX_STEPS_REACHED = Fault(
    128,
    "the solver reached its largest number of steps before the last time",
    "for a nearly elastic gas over many decades of time use KineticTheory(solver=diffrax.Kvaerno5"
    "()); otherwise increase max_steps, or end earlier",
)
OVERLAPPING = Fault(
    256,
    "two spheres of the initial state overlap, or a sphere and a wall",
    "move them apart, or leave start out for a random initial state",
)
BOX_MISMATCH = Fault(
    512,
    "the box of start does not match the gas",
    "change packing_fraction, or give a start in a box of the right size",
)
BOX_TOO_SMALL = Fault(
    1024,
    "the box is too short to distinguish a sphere from its periodic image",
    "use more particles or a lower packing_fraction",
)
ENERGY_DRIFT = Fault(
    2048,
    "the energy balance of the whole run is off by more than 5 %, by small errors of many steps",
    "increase steps_per_contact, or use float64 instead of float32",
)
OUT_OF_RANGE = Fault(
    4096,
    "a parameter of the gas lies outside its range, or the times do not increase from 0 or later",
    "see gas.domains for the ranges, and sort the times",
)
UNSUPPORTED = Fault(
    8192,
    "the model does not support this gas",
    "call jaxgran.cool for this gas alone to see the reason",
)
OVERLAPS_REMAIN = Fault(
    16384,
    "randomly placed spheres still overlap after many steps that push them apart",
    "lower the packing fraction, or give your own start",
)
FAULTS = tuple(x for x in [*globals().values()] if isinstance(x, Fault))


def flag(fault: Fault, when: ArrayLike) -> Int[Array, "..."]:
    """Return the bit of a fault if `when` is true, otherwise 0; combine statuses with `|`.

    Args:
        fault: the fault to report.
        when: booleans, any shape.
    """
    return jnp.where(jnp.asarray(when), fault.bit, OK).astype(jnp.int32)


def has(status: ArrayLike, fault: Fault) -> Bool[Array, "..."]:
    """Tell for each run whether its status contains a fault; `status` has any shape."""
    return (jnp.asarray(status) & fault.bit) != 0


def explain(status: ArrayLike | None) -> str:
    """Describe the faults of a status, each with advice; "ok" for 0 and for None.

    Args:
        status: of one curve or, as `jax.vmap` returns it, of several: `CoolingCurve.status`.

    Raises:
        ValueError: for a number that is not a status.

    >>> jaxgran.explain_status(0)
    'ok'
    """
    bits = np.asarray(OK if status is None else status)
    if bits.dtype.kind not in "iu" or np.any(bits < 0) or np.any(bits >= 2 * FAULTS[-1].bit):
        raise ValueError(
            "status must come from a curve: whole numbers from 0 to "
            f"{2 * FAULTS[-1].bit - 1}, got {status!r:.60}"
        )
    counts = [(fault, np.count_nonzero(bits & fault.bit)) for fault in FAULTS]
    of_all = "" if bits.ndim == 0 else f" of {bits.size} curves"
    words = [
        (f"{count}{of_all}: " if of_all else "") + f"{fault.meaning}: {fault.advice}"
        for fault, count in counts
        if count
    ]
    return "; ".join(words) or "ok"
