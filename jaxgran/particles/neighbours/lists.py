"""The list of pairs of particles in a periodic box, by any method."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from jaxgran.particles.neighbours.cells import cells
from jaxgran.particles.neighbours.jax_md_list import jax_md_pairs
from jaxgran.particles.neighbours.sweep import sweep

ENGINES = ("auto", "sweep", "cells", "jax-md")
"""Methods of building neighbour lists: `sweep` and `cells` in compiled code, or jax-md on the
device; "auto" is the fastest of them."""

MAX_LOOKAHEAD = 450
"""Expected look-ahead, in particles, up to which a sweep is as fast as cells: some
5000 spheres have it."""


class Pairs(NamedTuple):
    """Pairs of particles closer than a cutoff, each once.

    Attributes:
        i, j: indices into the particles of all replicas; rows beyond `count` are (0, 0).
        offset: multiple of the box side in each direction, such that ``x_i - x_j - offset`` is the
            shortest displacement of the pair. It remains valid while particles move without being
            wrapped.
        count: number of pairs. If it exceeds the capacity of the list, pairs are missing.
        lookahead: look-ahead, in particles, that a sweep or cells needed. If it exceeds their
            capacity, pairs are missing. 0 for jax-md.
    """

    i: Int[Array, "pairs"]
    j: Int[Array, "pairs"]
    offset: Float[Array, "pairs d"]
    count: Int[Array, ""]
    lookahead: Int[Array, ""]

    @property
    def in_use(self) -> Bool[Array, "pairs"]:
        """Whether each row holds a pair."""
        return jnp.arange(len(self.i), dtype=jnp.int32) < self.count


def wrap(side: ArrayLike, position: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Move positions by multiples of the side into [0, side)."""
    inside = jnp.mod(position, side)
    return jnp.where(inside >= side, 0.0, inside)  # rounding may give exactly `side`


def check_engine(name: str) -> None:
    """Raise ValueError for a name that is not one of `ENGINES`."""
    if name not in ENGINES:
        raise ValueError(
            f'neighbours must be one of {", ".join(ENGINES)}, got {name!r}. The default is "auto"'
        )


def compiled_engine(name: str, ahead: float) -> str:
    """Return the engine that builds neighbour lists in compiled code, "sweep" or "cells".

    It is `name`, or for "auto" and "jax-md" the fastest one, as measured on a CPU: a sweep up to a
    look-ahead of `MAX_LOOKAHEAD`, and cells beyond.

    Args:
        name: one of `ENGINES`.
        ahead: expected look-ahead of a sweep, in particles.
    """
    if name in ("sweep", "cells"):
        return name
    return "sweep" if ahead <= MAX_LOOKAHEAD else "cells"


def choose_engine(name: str, compiled: str, traced: bool) -> str:
    """Return the engine that builds neighbour lists in a run, one of `ENGINES` but not "auto".

    "auto" is jax-md on an accelerator, outside of compiled code.

    Args:
        name: one of `ENGINES`.
        compiled: the engine in compiled code.
        traced: whether the list is built in code that is being compiled or differentiated.
    """
    on_accelerator = jax.default_backend() != "cpu"
    if name == "jax-md" or (name == "auto" and on_accelerator and not traced):
        return "jax-md"
    return compiled


ListedPairs = tuple[Int[Array, "pairs"], Int[Array, "pairs"], Int[Array, ""], Int[Array, ""]]
"""Fields i, j, count and lookahead of `Pairs`."""


def search_pairs(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    replicas: int,
    capacity: tuple[int, int],
    engine: str,
) -> ListedPairs:
    """Find all pairs closer than a cutoff in each of several equal periodic boxes.

    The result has no derivatives. `with_offsets` adds the offsets in compiled code. A sweep and
    cells are compiled, also under `jax.jit` and `jax.vmap`. jax-md chooses the number of its cells
    from the values: `position`, `side` and `cutoff` must not be traced.

    Args:
        position: positions of all particles, replica after replica, in [0, side).
        side: side of the boxes.
        cutoff: distance in the same unit, > 0 and at most half a side; for a sweep less than that
            by at least a part in 10^6.
        replicas: number of boxes; particles of different boxes form no pairs.
        capacity: capacity of the list, in pairs, and of the look-ahead, in particles.
        engine: "sweep", "cells" or "jax-md". All return the same pairs, but may differ in pairs
            within rounding error of the cutoff.
    """
    position, side, cutoff = jax.lax.stop_gradient((position, side, cutoff))
    max_pairs, ahead = capacity
    if engine == "jax-md":
        i, j, count = jax_md_pairs(position, side, cutoff, replicas, max_pairs)
        return i, j, count, jnp.zeros((), jnp.int32)
    search = {"sweep": sweep, "cells": cells}[engine]
    return search(position, side, cutoff, replicas=replicas, capacity=max_pairs, ahead=ahead)


@jax.jit
def with_offsets(
    position: Float[Array, "particles d"], side: ArrayLike, listed: ListedPairs
) -> Pairs:
    """Add the offsets to the pairs that were found for these positions."""
    position, side = jax.lax.stop_gradient((position, jnp.asarray(side)))
    i, j, count, lookahead = listed
    offset = side * jnp.round((position[i] - position[j]) / side)
    return Pairs(i, j, offset, count, lookahead)
