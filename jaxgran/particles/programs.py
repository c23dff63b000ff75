"""Compiled programs of the host driver, which are kept."""

from collections import OrderedDict
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jaxgran.checks.tracing import any_traced
from jaxgran.particles.dynamics import AbstractDynamics, stretches
from jaxgran.particles.interruption import outside_of_transformations
from jaxgran.particles.state import State

STRETCHES = 8
"""Neighbour lists used in one call of compiled code; progress is shown between calls."""

MOST_PROGRAMS = 32
"""Compiled programs that are kept; beyond that the one unused for longest is released."""

_PROGRAMS: OrderedDict[Any, jax.stages.Compiled] = OrderedDict()
"""Programs of `stretches` by what they were compiled for. Unlike those that `jax.jit` keeps they
are bounded in number, and shared by plain runs and those inside a rule of differentiation."""


def some_stretches(
    dynamics: AbstractDynamics, state: State, end: np.ndarray, engine: str
) -> tuple[State, Array, Array]:
    """`STRETCHES` stretches, compiled for the types and the static fields of these arguments."""
    leaves, structure = jax.tree.flatten((dynamics, state, end))

    def some(leaves: list[Array]) -> tuple[State, Array, Array]:
        dynamics, state, end = structure.unflatten(leaves)
        return stretches(dynamics, state, end, engine, least=1, most=STRETCHES)

    if any_traced(leaves):  # constants within a transformation of something else
        return jax.jit(some)(leaves)
    types = tuple((x.shape, x.dtype, getattr(x, "sharding", None)) for x in leaves)
    key = engine, STRETCHES, structure, types
    if (program := _PROGRAMS.pop(key, None)) is None:  # in one step: there are threads
        program = outside_of_transformations(lambda: jax.jit(some).lower(leaves).compile())
    _PROGRAMS[key] = program
    if len(_PROGRAMS) > MOST_PROGRAMS:
        _PROGRAMS.popitem(last=False)
    return program(leaves)
