"""The list of pairs of particles in a periodic box, by any method, and the choice of the method."""

import jax
from jaxtyping import Array, ArrayLike, Float

from jaxgran.particles.neighbours.cells import pairs_by_cells
from jaxgran.particles.neighbours.jax_md_list import pairs_by_jax_md
from jaxgran.particles.neighbours.pairs import ListedPairs
from jaxgran.particles.neighbours.sweep import pairs_by_sweep

COMPILED_SEARCHES = {"sweep": pairs_by_sweep, "cells": pairs_by_cells}
"""Methods of building neighbour lists in compiled code, by name."""

ENGINES = ("auto", *COMPILED_SEARCHES, "jax-md")
"""Methods of building neighbour lists: in compiled code, or by jax-md on the device; "auto" is the
fastest of them."""

MAX_LOOKAHEAD = 450
"""Expected look-ahead, in particles, up to which a sweep is as fast as cells: some
5000 spheres have it."""


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
    if name in COMPILED_SEARCHES:
        return name
    return "sweep" if ahead <= MAX_LOOKAHEAD else "cells"


def choose_engine(name: str, compiled: str, *, traced: bool) -> str:
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


def search_pairs(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    cutoff: ArrayLike,
    *,
    replicas: int,
    capacity: int,
    ahead: int,
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
        capacity: largest number of pairs in the list.
        ahead: largest look-ahead of a sweep or cells, in particles.
        engine: "sweep", "cells" or "jax-md". All return the same pairs, but may differ in pairs
            within rounding error of the cutoff.

    Raises:
        ValueError: if the number of particles times `ahead` is too large for 32-bit indices.
        RuntimeError: if jax-md's own list overflows, see `jax_md_list.MAX_MULTIPLIER`.
    """
    position, side, cutoff = jax.lax.stop_gradient((position, side, cutoff))
    if engine == "jax-md":
        return pairs_by_jax_md(position, side, cutoff, replicas, capacity)
    search = COMPILED_SEARCHES[engine]
    return search(position, side, cutoff, replicas=replicas, capacity=capacity, ahead=ahead)
