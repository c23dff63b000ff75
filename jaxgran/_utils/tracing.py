"""Values that a JAX transformation traces, and operations on concrete arrays."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, DTypeLike


def any_traced(*trees: Any) -> bool:
    """Tell whether any leaf of these pytrees is traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))


def concrete_array(value: Any, dtype: DTypeLike | None = None) -> Array:
    """Convert numbers of Python or NumPy to a concrete JAX array.

    Unlike `jax.numpy.asarray` it returns a concrete array also inside a differentiation rule,
    within `jax.ensure_compile_time_eval`.
    """
    return jax.device_put(np.asarray(value, dtype))


def is_known(value: Any) -> bool:
    """Tell whether the value of a number is known, even if it carries a tangent."""
    while isinstance(value, Tracer) and hasattr(value, "primal"):
        value = value.primal
    return not isinstance(value, Tracer)


def pad_to(values: Array, size: int) -> Array:
    """Pad an array to `size` rows by repeating its last row."""
    missing = size - len(values)
    if isinstance(values, Tracer):
        last = jnp.broadcast_to(values[-1:], (missing, *values.shape[1:]))
        return jnp.concatenate([values, last])
    # NumPy, because JAX would compile a program for each length.
    return concrete_array(
        np.concatenate([values, np.repeat(np.asarray(values)[-1:], missing, axis=0)])
    )


def truncate_to(values: Array, size: int) -> Array:
    """Return the first `size` rows of an array."""
    if isinstance(values, Tracer):
        return values[:size]
    return concrete_array(np.asarray(values)[:size])  # NumPy: see `pad_to`
