"""Numbers that are known, and those that are being traced by a JAX transformation."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, DTypeLike


def any_traced(*trees: Any) -> bool:
    """Whether some number among the leaves of these pytrees is being traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def concrete(value: Any, dtype: DTypeLike | None = None) -> Array:
    """Numbers known to Python or NumPy as a JAX array.

    Unlike `jax.numpy.asarray` it returns a concrete array also inside a rule of differentiation,
    within `jax.ensure_compile_time_eval`.
    """
    return jax.device_put(np.asarray(value, dtype))


def is_known(value: Any) -> bool:
    """Whether the value of a number is known, though a derivative in it may be taken."""
    while isinstance(value, Tracer) and hasattr(value, "primal"):
        value = value.primal
    return not isinstance(value, Tracer)


def pad_to(values: Array, size: int) -> Array:
    """An array with its last value repeated until there are `size`."""
    more = size - len(values)
    if isinstance(values, Tracer):
        return jnp.concatenate([values, jnp.broadcast_to(values[-1:], (more, *values.shape[1:]))])
    # By NumPy: JAX would compile a program for each length.
    return concrete(np.concatenate([values, np.repeat(np.asarray(values)[-1:], more, axis=0)]))


def truncate_to(values: Array, size: int) -> Array:
    """The first `size` values of an array."""
    if isinstance(values, Tracer):
        return values[:size]
    return concrete(np.asarray(values)[:size])  # as above
