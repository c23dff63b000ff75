"""Values that a JAX transformation traces, and operations on concrete arrays."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, DTypeLike


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
    return not isinstance(known_part(value), Tracer)


def known_part(value: Any) -> Any:
    """Return a value without the tangents that it carries."""
    while isinstance(value, Tracer) and hasattr(value, "primal"):
        value = value.primal
    return value


def in_compiled_code(*trees: Any) -> bool:
    """Tell whether any leaf is traced by `jax.jit`, and not only differentiated or batched."""

    def compiled(value):
        while isinstance(value, Tracer):
            if hasattr(value, "primal"):
                value = value.primal
            elif hasattr(value, "batch_dim"):
                value = value.val
            else:
                return True
        return False

    return any(compiled(leaf) for leaf in jax.tree.leaves(trees))


def pad_to(values: Any, size: int) -> Array:
    """Pad an array to `size` rows by repeating its last row."""
    added = [(0, size - len(values)), *[(0, 0)] * (np.ndim(values) - 1)]
    # By JAX a program would be compiled for each length.
    return as_jax_arrays(array_module(values).pad(values, added, mode="edge"))


def truncate_to(values: Array, size: int) -> Array:
    """Return the first `size` rows of an array."""
    return as_jax_arrays(array_module(values).asarray(values)[:size])  # see `pad_to`


def array_module(*trees: Any) -> Any:
    """Return `jax.numpy` if any leaf of these pytrees is traced, and otherwise NumPy.

    Code written with it works under transformations, and on the host compiles nothing.
    """
    return jnp if any_traced(*trees) else np


def as_jax_arrays(tree: Any) -> Any:
    """Return a pytree in which arrays and numbers of NumPy have become arrays of JAX."""
    numpy = np.ndarray, np.generic
    # jnp.asarray would compile a program for each length.
    return jax.tree.map(lambda x: concrete_array(x) if isinstance(x, numpy) else x, tree)


def grid_size(size: int) -> int:
    """Return the smallest of 32, 64, 128, ... that is >= `size`.

    Arrays are padded to it, so that few lengths are compiled.
    """
    return max(32, 1 << (size - 1).bit_length())


MAX_MAP_SHARE = 0.7
"""Share of the memory maps that Linux allows a process, beyond which programs are dropped."""


def near_map_limit() -> bool:
    """Return whether this process has nearly as many memory maps as Linux allows.

    XLA crashes at the limit, by default 65,530. A program of spheres has up to 900 maps.
    """
    try:
        allowed = int(Path("/proc/sys/vm/max_map_count").read_text())
        with open("/proc/self/maps", "rb") as file:
            used = sum(1 for _ in file)
    except OSError:  # not Linux
        return False
    return used > MAX_MAP_SHARE * allowed


def fast_compilation(backend: str) -> dict[str, Any]:
    """Return compiler options for programs that run for a short time.

    On a CPU a linearised curve compiles in 2.6 s instead of 7.4 s, and then takes 7 ms instead of
    4 ms (jaxlib 0.10.1). From 0.11 on XLA always uses its emitters of fusions.
    """
    if backend != "cpu":
        return {}
    emitters = {} if jax.__version_info__ >= (0, 11) else {"xla_cpu_use_fusion_emitters": False}
    return {"xla_backend_optimization_level": 1} | emitters


@cache
def fast_jit(function: Callable[..., Any], backend: str) -> Any:
    """Return a function, compiled once for all, with the options of `fast_compilation`."""
    options: dict[str, Any] = {"compiler_options": fast_compilation(backend)}
    return jax.jit(function, **options)


def nan_where(failed: Bool[Array, "..."], x: Array) -> Array:
    """Return a record with nan where a run failed, also in derivatives, but no nan in integers."""
    if not jnp.issubdtype(x.dtype, jnp.inexact):
        return x
    failed = failed.reshape(*failed.shape, *[1] * (x.ndim - failed.ndim))
    return x * jnp.where(failed, jnp.nan, 1.0).astype(x.dtype)
