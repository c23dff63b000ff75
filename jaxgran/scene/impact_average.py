"""Averages over the normal speeds of the impacts in a gas."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def _quadrature(num_nodes: int, top: float) -> tuple[np.ndarray, np.ndarray]:
    """Nodes g and weights for ``int_0^inf g exp(-g^2/2) f(g) dg``.

    Gauss-Legendre in sqrt(g), since laws of restitution are smooth in small powers of g. The
    integral beyond `top` is neglected.
    """
    x, w = np.polynomial.legendre.leggauss(num_nodes)
    root = (x + 1) / 2
    g = top * root**2
    return g, w * top * root * g * np.exp(-(g**2) / 2)


NODES, WEIGHTS = _quadrature(num_nodes=32, top=9.0)
"""Normal speeds g in units of sqrt(2 T), and their weights."""


def impact_average(function: Callable[[Array], Array], like: Float[Array, ""]) -> Float[Array, ""]:
    """``int_0^inf g exp(-g^2/2) f(g) dg``, the average over the normal speeds of impacts.

    Args:
        function: f, of an array of g.
        like: a number of the precision that is wanted.
    """
    nodes, weights = (jnp.asarray(x, like.dtype) for x in (NODES, WEIGHTS))
    return jnp.sum(weights * function(nodes))
