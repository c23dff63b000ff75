"""Whether numbers are known, or are being traced by a JAX transformation."""

from typing import Any

import jax
from jax.core import Tracer


def any_traced(*trees: Any) -> bool:
    """Whether some number among the leaves of these pytrees is being traced."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(trees))
