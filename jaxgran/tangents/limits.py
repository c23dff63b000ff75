"""The limits of a rule of differentiation: what it refuses, and what it does not know."""

from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

T = TypeVar("T")


def first_order_only(inputs: T) -> T:
    """The inputs of a rule, which can then not be differentiated itself.

    A rule is made of the tangents of one run; differentiated plainly it would return the chaotic
    derivatives of these.

    Raises:
        ValueError: if a derivative in these inputs is taken.
    """
    # Known numbers stay known, for runs that are driven from the host.
    numbers, others = eqx.partition(inputs, _may_change)
    return eqx.combine(_held(numbers), others)


def _may_change(leaf: Any) -> bool:
    return isinstance(leaf, Tracer) and eqx.is_inexact_array(leaf)


@jax.custom_jvp
def _held(numbers: Any) -> Any:
    return numbers


@partial(_held.defjvp, symbolic_zeros=True)
def _held_jvp(at, along):
    (numbers,), (tangents,) = at, along
    if not all(isinstance(tangent, SymbolicZero) for tangent in jax.tree.leaves(tangents)):
        raise ValueError(
            "a second derivative through a particle model was asked for, which has first "
            "derivatives only: take the difference of two first derivatives (jax.grad, jax.jvp or "
            "jax.jacfwd at two values of the parameter, with the same key), or use "
            "KineticTheory, which has second derivatives"
        )
    return numbers, jax.tree.map(jnp.zeros_like, numbers)


def unknown(shape: tuple[int, ...], *changes: Float[Array, "..."]) -> Float[Array, "..."]:
    """The tangent of a result whose derivative is not known: nan, or 0 if nothing changes.

    In reverse mode the changes are nan where the result has a cotangent, and 0 where it has none,
    so that results that a function does not use do not spoil its gradient.

    Args:
        shape: of the result.
        changes: tangents of all that it depends on.
    """
    dtype = jnp.result_type(*changes)
    total = sum((jnp.sum(_indeterminate(x)) for x in changes), start=jnp.zeros((), dtype))
    return _indeterminate(jnp.broadcast_to(total, shape))


def unknown_tangent(result: Array, *changes: Float[Array, "..."]) -> Any:
    """`unknown` for a result of any type: integers have no tangent."""
    if jnp.issubdtype(result.dtype, jnp.inexact):
        return unknown(result.shape, *changes).astype(result.dtype)
    return np.zeros(result.shape, jax.dtypes.float0)


def _indeterminate(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """The solution y of ``0 y = x``, and in reverse mode likewise: nan where x is not 0."""

    def solution(_: Any, x: Array) -> Array:
        return jnp.where(x == 0, jnp.zeros_like(x), jnp.nan)

    return jax.lax.custom_linear_solve(lambda y: 0 * y, x, solution, solution)
