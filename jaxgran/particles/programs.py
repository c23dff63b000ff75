"""Compiled programs of the host driver, which are kept."""

import sys
from collections import OrderedDict
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jaxgran.checks.tracing import any_traced
from jaxgran.particles import cores
from jaxgran.particles.dynamics import AbstractDynamics, stretches
from jaxgran.particles.interruption import outside_of_transformations
from jaxgran.particles.state import State

STRETCHES = 8
"""Neighbour lists used in one call of compiled code; progress is shown between calls."""

COMPILING = "compiling ..."


@contextmanager
def compiling(progress: bool) -> Iterator[None]:
    """Say "compiling ..." on a terminal as long as the block lasts; the progress bar follows."""
    shown = progress and sys.stderr.isatty()
    if shown:
        print(f"\r{COMPILING}", end="", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        if shown:
            print(f"\r{' ' * len(COMPILING)}\r", end="", file=sys.stderr, flush=True)


_MET: set[Hashable] = set()


def first_time(program: Hashable) -> bool:
    """Whether this process is told of a program for the first time, and so has it to compile."""
    new = program not in _MET
    _MET.add(program)
    return new


MOST_PROGRAMS = 32
"""Compiled programs that are kept; beyond that the one unused for longest is released."""

_PROGRAMS: OrderedDict[Any, jax.stages.Compiled] = OrderedDict()
"""Programs of `stretches` by what they were compiled for. Unlike those that `jax.jit` keeps they
are bounded in number, and shared by plain runs and those inside a rule of differentiation."""


def some_stretches(
    dynamics: AbstractDynamics,
    state: State,
    end: np.ndarray,
    engine: str,
    progress: bool = False,
    donate: bool = False,
) -> tuple[State, Array, Array]:
    """`STRETCHES` stretches, compiled for the types and the static fields of these arguments.

    With `donate` the new state is written over the given one, which must be `owned` and is deleted.
    """
    kept, rest = jax.tree.flatten((dynamics, end))
    moving, of_state = jax.tree.flatten(state)

    def some(moving: list[Array], kept: list[Array]) -> tuple[State, Array, Array]:
        dynamics, end = rest.unflatten(kept)
        state = of_state.unflatten(moving)
        return stretches(dynamics, state, end, engine, least=1, most=STRETCHES)

    leaves = moving, kept
    if any_traced(leaves):  # constants within a transformation of something else
        return jax.jit(some)(*leaves)
    types = tuple((x.shape, x.dtype, getattr(x, "sharding", None)) for x in (*moving, *kept))
    key = engine, STRETCHES, rest, of_state, types, donate
    if (program := _PROGRAMS.pop(key, None)) is None:  # in one step: there are threads
        jitted = jax.jit(some, donate_argnums=0 if donate else ())
        with compiling(progress):
            options = cores.options()
            program = outside_of_transformations(lambda: jitted.lower(*leaves).compile(options))
    _PROGRAMS[key] = program
    if len(_PROGRAMS) > MOST_PROGRAMS:
        _PROGRAMS.popitem(last=False)
    return program(*leaves)
