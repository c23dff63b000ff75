"""Observables: functions of the positions and velocities of particles, in any consistent units."""

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.particles.neighbours import displacement, find_pairs


def temperature(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Temperature ``T = <v^2>/d`` for mass 1, of velocities relative to their mean."""
    return jnp.mean(velocity**2, axis=(-2, -1))


def sonine(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Sonine coefficient ``a_2 = d <v^4> / ((d + 2) <v^2>^2) - 1``; 0 for a Maxwellian gas."""
    d = velocity.shape[-1]
    square = jnp.sum(velocity**2, axis=-1)
    return d / (d + 2) * jnp.mean(square**2, axis=-1) / jnp.mean(square, axis=-1) ** 2 - 1


def mean_square_displacement(
    displacement: Float[Array, "... particles d"],
) -> Float[Array, "..."]:
    """``<dr^2>`` of displacements since t = 0, followed across the faces of the box."""
    return jnp.mean(jnp.sum(displacement**2, axis=-1), axis=-1)


def velocity_correlation(
    first: Float[Array, "... particles d"], velocity: Float[Array, "... particles d"]
) -> Float[Array, "..."]:
    """Velocity autocorrelation ``<v(0) . v(t)> / d``, which is T at t = 0."""
    return jnp.mean(first * velocity, axis=(-2, -1))


def pair_correlation(
    position: Float[Array, "particles d"], side: float, edges: ArrayLike | Sequence[float]
) -> Float[np.ndarray, "bins"]:
    """Radial distribution function g(r), 1 for independent particles.

    Args:
        position: in [0, side).
        side: of the periodic box.
        edges: of the bins in r, increasing, the last one <= side / 2.

    Returns:
        g in each bin; its relative statistical error is 1 / sqrt(number of pairs in the bin).

    Raises:
        ValueError: if the last edge is larger than half the side.
    """
    edges = np.asarray(edges, dtype=float)
    if edges[-1] > side / 2:
        raise ValueError(
            f"the last edge of g(r) is {edges[-1]:g}, at most half a box side ({side / 2:g}) is "
            "allowed; use a larger box (more particles) or smaller distances"
        )
    n, d = position.shape
    density = n / side**d
    ball = np.pi * edges**2 if d == 2 else 4 / 3 * np.pi * edges**3
    expected = n / 2 * density * np.diff(ball)
    capacity = max(1024, int(2 * n * density * ball[-1]))
    pairs = find_pairs(position, side, float(edges[-1]), capacity=capacity)
    while int(pairs.count) > capacity:
        capacity = int(pairs.count)
        pairs = find_pairs(position, side, float(edges[-1]), capacity=capacity)
    i, j = (np.asarray(index)[: int(pairs.count)] for index in (pairs.i, pairs.j))
    distance = np.linalg.norm(np.asarray(displacement(side, position[i], position[j])), axis=-1)
    return np.histogram(distance, edges)[0] / expected


def structure_factor(
    position: Float[Array | np.ndarray, "particles d"], side: ArrayLike, num_shells: int = 4
) -> tuple[Float[np.ndarray, "shells"], Float[np.ndarray, "shells"]]:
    """Static structure factor ``S(k) = |sum exp(i k x)|^2 / N`` at the smallest wave vectors.

    Args:
        position: of any periodic images of the particles.
        side: of the periodic box.
        num_shells: number of different lengths of the wave vector, from 2 pi / side upwards.

    Returns:
        The lengths k (1/length), and S averaged over the wave vectors of each length. A homogeneous
        gas has S below 1 at these wave vectors; clusters raise it.
    """
    d = position.shape[-1]
    reach = range(-num_shells, num_shells + 1)
    waves = np.array([k for k in itertools.product(reach, repeat=d) if any(k)])
    square = np.sum(waves**2, axis=1)
    lengths = np.unique(square)[:num_shells]
    values = []
    for length in lengths:
        phase = 2 * np.pi / side * (np.asarray(position) @ waves[square == length].T)
        total = np.exp(1j * phase).sum(axis=0)
        values.append(np.mean(np.abs(total) ** 2) / len(position))
    return 2 * np.pi / np.asarray(side) * np.sqrt(lengths), np.array(values)
