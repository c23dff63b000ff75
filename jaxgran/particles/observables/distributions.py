"""Distributions of velocities and of distances, in bins."""

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from jaxgran.particles.observables.moments import centred, temperature

ROWS = 64
"""Particles whose distances to all others are computed at once."""


def velocity_distribution(
    velocity: Float[Array, "particles d"], edges: ArrayLike | Sequence[float]
) -> Float[Array, "bins"]:
    """The distribution f(c) of velocities ``c = (v - u) / sqrt(2 T)``, averaged over angles.

    Normalised so that its integral over all c is 1: a Maxwellian gas has
    ``pi^(-d/2) exp(-c^2)``.

    Args:
        velocity: of one box.
        edges: of the bins in |c|, increasing, >= 0, shape (bins + 1,).

    >>> velocity = jax.random.normal(jax.random.key(0), (100_000, 3))
    >>> f = observables.velocity_distribution(velocity, [0.0, 0.1, 0.2])
    >>> bool(abs(f[1] * jnp.pi**1.5 - 0.977) < 0.1)
    True
    """
    n, d = velocity.shape
    edges = checked_edges(edges)
    v = centred(velocity)
    c = jnp.sqrt(jnp.sum(v**2, axis=-1) / (2 * temperature(v)))
    return histogram(c, edges) / (n * shell_volumes(edges, d))


def pair_correlation(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    edges: ArrayLike | Sequence[float],
    centres: int | None = None,
) -> Float[Array, "bins"]:
    """Radial distribution function g(r): 1 for independent particles.

    ``g = pairs / (centres n V_shell)`` with the number density n. Its relative statistical error is
    about 1 / sqrt(number of pairs in the bin). All distances are computed: the time is that of
    N times `centres` of them.

    Args:
        position: of any periodic images.
        side: of the periodic box.
        edges: of the bins in r, increasing, >= 0, the last one <= side / 2, shape (bins + 1,).
        centres: how many of the particles, the first, are centres of shells; all by default.

    Raises:
        ValueError: for edges, or a number of centres, out of range. Where the side is traced, bins
            beyond half of it are nan.

    >>> g = observables.pair_correlation(position, 1.0, [0.1, 0.2, 0.3])
    >>> bool(jnp.all(jnp.abs(g - 1) < 0.05))
    True
    """
    n, d = position.shape
    edges = checked_edges(edges)
    centres = n if centres is None else centres
    if not (isinstance(centres, int) and 1 <= centres <= n):
        raise ValueError(f"centres must be a whole number from 1 to {n}, got {centres!r}")
    if not any(isinstance(x, Tracer) for x in (side, edges)) and edges[-1] > side / 2:
        raise ValueError(
            f"the last edge of g(r) is {float(edges[-1]):g}, at most half a box side "
            f"({np.asarray(side) / 2:g}) is allowed; use a larger box (more particles) or smaller "
            "distances"
        )

    def around(i: Array) -> Float[Array, "bins"]:
        apart = position - position[i][None]
        apart = apart - side * jnp.round(apart / side)
        distance = jnp.sqrt(jnp.sum(apart**2, axis=-1))
        return histogram(distance.at[i].set(jnp.inf), edges)

    counts = jax.lax.map(around, jnp.arange(centres), batch_size=min(ROWS, centres))
    density = n / jnp.asarray(side) ** d
    g = jnp.sum(counts, axis=0) / (centres * density * shell_volumes(edges, d))
    # Rounding of half a side is no reason for nan.
    return jnp.where(edges[1:] <= side * (0.5 + 1e-6), g, jnp.nan)


def checked_edges(edges: ArrayLike | Sequence[float]) -> Array | np.ndarray:
    """Edges of bins as an array; ValueError if they are known and not increasing from >= 0 on."""
    if isinstance(edges, Tracer):
        return edges
    array = np.asarray(edges, float)
    if array.ndim != 1 or array.size < 2 or array[0] < 0 or not np.all(np.diff(array) > 0):
        raise ValueError(
            f"edges of bins must be two or more increasing numbers >= 0, got {edges!r}"
        )
    return array


def histogram(
    values: Float[Array, "n"], edges: Float[Array | np.ndarray, "e"]
) -> Float[Array, "bins"]:
    """How many values lie in each bin, the last edge included."""
    bins, edges = edges.size - 1, jnp.asarray(edges, values.dtype)
    place = jnp.searchsorted(edges, values, side="right")
    place = jnp.where(values == edges[-1], bins, place)
    return jnp.bincount(place, length=bins + 2)[1:-1].astype(edges.dtype)


def shell_volumes(edges: Float[Array | np.ndarray, "e"], d: int) -> Float[Array, "bins"]:
    """Volumes of the shells between spheres of these radii."""
    return math.pi ** (d / 2) / math.gamma(d / 2 + 1) * jnp.diff(jnp.asarray(edges) ** d)
