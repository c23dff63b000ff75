"""Observables of particles, for `cool(save=...)`: jittable and differentiable functions.

Positions and velocities of one box are arrays of shape (N, d), in any consistent units; boxes are
periodic squares or cubes. Below, ``u`` is the mean velocity of the box. There are moments of
velocities and displacements, density and flow in a grid of cells, distributions of velocities and
of distances, and Fourier modes of the density and of the flow.

>>> from jaxgran import observables
>>> position, velocity = jax.random.uniform(jax.random.key(0), (2, 1000, 3))
>>> k, S = jax.jit(observables.structure_factor)(position, 1.0)
>>> k.shape, S.shape
((4,), (4,))
"""

import itertools
import math
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

__all__ = [
    "cell_density",
    "cell_velocity",
    "flow_share",
    "flow_spectrum",
    "mean_square_displacement",
    "number_fluctuation",
    "pair_correlation",
    "sonine",
    "structure_factor",
    "temperature",
    "third_sonine",
    "velocity_correlation",
    "velocity_distribution",
]


@jax.jit
def temperature(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Return the temperature ``T = <v^2>/d`` for mass 1.

    Args:
        velocity: velocities relative to their mean.
    """
    return jnp.mean(velocity**2, axis=(-2, -1))


@jax.jit
def sonine(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Return the Sonine coefficient ``a_2 = d <v^4> / ((d + 2) <v^2>^2) - 1``.

    It is 0 for a Maxwellian gas. Its standard error is ``sqrt(8 / (d (d + 2) N))``.

    Args:
        velocity: velocities relative to their mean.
    """
    d = velocity.shape[-1]
    square = jnp.sum(velocity**2, axis=-1)
    return d / (d + 2) * jnp.mean(square**2, axis=-1) / jnp.mean(square, axis=-1) ** 2 - 1


@jax.jit
def third_sonine(velocity: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Return the Sonine coefficient ``a_3 = 1 + 3 a_2 - d^2 <v^6> / ((d + 2)(d + 4) <v^2>^3)``.

    It is 0 for a Maxwellian gas.

    Args:
        velocity: velocities relative to their mean.
    """
    d = velocity.shape[-1]
    square = jnp.sum(velocity**2, axis=-1)
    sixth = jnp.mean(square**3, axis=-1) / jnp.mean(square, axis=-1) ** 3
    return 1 + 3 * sonine(velocity) - d**2 / ((d + 2) * (d + 4)) * sixth


@jax.jit
def mean_square_displacement(displacement: Float[Array, "... particles d"]) -> Float[Array, "..."]:
    """Return the mean square displacement ``<dr^2>``.

    Args:
        displacement: displacements since t = 0, continued across the faces of the periodic box.
    """
    return jnp.mean(jnp.sum(displacement**2, axis=-1), axis=-1)


@jax.jit
def velocity_correlation(
    first: Float[Array, "... particles d"], velocity: Float[Array, "... particles d"]
) -> Float[Array, "..."]:
    """Return the velocity autocorrelation ``<v(0) . v(t)> / d``, which is T at t = 0."""
    return jnp.mean(first * velocity, axis=(-2, -1))


@jax.jit
def centred(velocity: Float[Array, "n d"]) -> Float[Array, "n d"]:
    """Return velocities relative to their mean."""
    return velocity - jnp.mean(velocity, axis=0, keepdims=True)


@partial(jax.jit, static_argnames="cells")
def cell_density(
    position: Float[Array, "particles d"], side: ArrayLike, cells: int
) -> Float[Array, "*grid"]:
    """Return the density over its mean in a grid of cells^d equal cells.

    Args:
        position: positions, in any periodic images.
        side: side of the periodic box.
        cells: number of cells along each side, >= 1.

    Returns:
        Array of shape (cells, ..., cells).

    >>> float(jnp.mean(observables.cell_density(position, 1.0, 4)))
    1.0
    """
    n, d = position.shape
    number = jnp.bincount(_cell_index(position, side, cells), length=cells**d)
    return (number * (cells**d / n)).reshape((cells,) * d)


@partial(jax.jit, static_argnames="cells")
def cell_velocity(
    position: Float[Array, "particles d"],
    velocity: Float[Array, "particles d"],
    side: ArrayLike,
    cells: int,
) -> Float[Array, "*grid d"]:
    """Return the flow: the mean of v - u in each cell of a grid.

    Args:
        position, velocity: particles of one box; positions in any periodic images.
        side: side of the periodic box.
        cells: number of cells along each side, >= 1.

    Returns:
        Array of shape (cells, ..., cells, d); nan in empty cells.

    >>> observables.cell_velocity(position, velocity, 1.0, 4).shape
    (4, 4, 4, 3)
    """
    d = position.shape[-1]
    cell = _cell_index(position, side, cells)
    v = centred(velocity)
    number = jnp.bincount(cell, length=cells**d)
    total = jax.ops.segment_sum(v, cell, num_segments=cells**d)
    return (total / number[:, None]).reshape((cells,) * d + (d,))  # 0/0 is nan


@partial(jax.jit, static_argnames="cells")
def number_fluctuation(
    position: Float[Array, "particles d"], side: ArrayLike, cells: int
) -> Float[Array, ""]:
    """Return the variance over the mean of the number of particles in the cells of a grid.

    The ratio is 1 for independent particles up to ``1/cells^d``, less in a fluid of hard spheres,
    and more where there are clusters as large as a cell.

    Args:
        position: positions, in any periodic images.
        side: side of the periodic box.
        cells: number of cells along each side, >= 1.

    >>> bool(abs(observables.number_fluctuation(position, 1.0, 5) - 1) < 0.5)
    True
    """
    n, d = position.shape
    return jnp.var(cell_density(position, side, cells)) * (n / cells**d)


def _cell_index(position: Float[Array, "particles d"], side: ArrayLike, cells: int) -> Array:
    if not (isinstance(cells, int) and cells >= 1):
        raise ValueError(f"cells must be a whole number >= 1, got {cells!r}")
    unit = position / jnp.asarray(side)
    cell = jnp.floor((unit - jnp.floor(unit)) * cells).astype(int)
    cell = jnp.minimum(cell, cells - 1)  # rounding may give `cells` itself
    powers = np.array([cells**k for k in reversed(range(position.shape[-1]))])
    return jnp.sum(cell * powers[None], axis=-1)


BATCH_SIZE = 64
"""Number of particles whose distances to all others are computed at once."""


def velocity_distribution(
    velocity: Float[Array, "particles d"], edges: ArrayLike | Sequence[float]
) -> Float[Array, "bins"]:
    """Return the distribution f(c) of velocities ``c = (v - u) / sqrt(2 T)``, averaged over angles.

    Its integral over all c is 1: a Maxwellian gas has ``pi^(-d/2) exp(-c^2)``.

    Args:
        velocity: velocities of one box.
        edges: edges of the bins in |c|, increasing, >= 0, shape (bins + 1,).

    >>> velocity = jax.random.normal(jax.random.key(0), (100_000, 3))
    >>> f = observables.velocity_distribution(velocity, [0.0, 0.1, 0.2])
    >>> bool(abs(f[1] * jnp.pi**1.5 - 0.977) < 0.1)
    True
    """
    return _speed_distribution(velocity, checked_edges(edges))


@jax.jit
def _speed_distribution(velocity: Float[Array, "n d"], edges: Float[Array, "e"]) -> Array:
    n, d = velocity.shape
    v = centred(velocity)
    c = jnp.sqrt(jnp.sum(v**2, axis=-1) / (2 * temperature(v)))
    return jnp.histogram(c, jnp.asarray(edges, c.dtype))[0] / (n * shell_volumes(edges, d))


def pair_correlation(
    position: Float[Array, "particles d"],
    side: ArrayLike,
    edges: ArrayLike | Sequence[float],
    centres: int | None = None,
) -> Float[Array, "bins"]:
    """Return the radial distribution function g(r), which is 1 for independent particles.

    ``g = pairs / (centres n V_shell)`` with the number density n. Its relative statistical error is
    about 1 / sqrt(number of pairs in the bin). The cost is N times `centres` distances.

    Args:
        position: positions, in any periodic images.
        side: side of the periodic box.
        edges: edges of the bins in r, increasing, >= 0, the last one <= side / 2, shape
            (bins + 1,).
        centres: number of particles, counted from the first, that are centres of shells; all by
            default.

    Raises:
        ValueError: if edges or the number of centres are out of range. Where the side is traced,
            bins beyond half of it are nan instead.

    >>> g = observables.pair_correlation(position, 1.0, [0.1, 0.2, 0.3])
    >>> bool(jnp.all(jnp.abs(g - 1) < 0.05))
    True
    """
    if position.ndim != 2:
        raise ValueError(
            f"position must have the shape (N, d) of one replica, got {position.shape}: take "
            "particles.position[0], or average over replicas by jax.vmap"
        )
    n = len(position)
    edges = checked_edges(edges)
    centres = n if centres is None else centres
    if not (isinstance(centres, int) and 1 <= centres <= n):
        raise ValueError(f"centres must be a whole number from 1 to {n}, got {centres!r}")
    if not any(isinstance(x, Tracer) for x in (side, edges)) and edges[-1] > side / 2:
        raise ValueError(
            f"the last edge of g(r) must be at most half a box side, {np.asarray(side) / 2:g}, got "
            f"{float(edges[-1]):g}. Use smaller distances, or more particles for a larger box."
        )
    return _pair_correlation(position, side, edges, centres)


@partial(jax.jit, static_argnames="centres")
def _pair_correlation(
    position: Float[Array, "n d"], side: Float[Array, ""], edges: Float[Array, "e"], centres: int
) -> Float[Array, "bins"]:
    n, d = position.shape

    def distances_from(i: Array) -> Float[Array, "bins"]:
        apart = position - position[i][None]
        apart = apart - side * jnp.round(apart / side)
        distance = jnp.sqrt(jnp.sum(apart**2, axis=-1))
        return jnp.histogram(distance.at[i].set(jnp.inf), jnp.asarray(edges, distance.dtype))[0]

    counts = jax.lax.map(distances_from, jnp.arange(centres), batch_size=min(BATCH_SIZE, centres))
    density = n / jnp.asarray(side) ** d
    g = jnp.sum(counts, axis=0) / (centres * density * shell_volumes(edges, d))
    # The tolerance allows for rounding of half a side.
    return jnp.where(edges[1:] <= side * (0.5 + 1e-6), g, jnp.nan)


def checked_edges(edges: ArrayLike | Sequence[float]) -> Array | np.ndarray:
    """Return edges as an array; raise ValueError if they are known and invalid."""
    if isinstance(edges, Tracer):
        return edges
    array = np.asarray(edges, float)
    if array.ndim != 1 or array.size < 2 or array[0] < 0 or not np.all(np.diff(array) > 0):
        raise ValueError(f"edges must be at least two increasing numbers >= 0, got {edges!r}")
    return array


def shell_volumes(edges: Float[Array | np.ndarray, "e"], d: int) -> Float[Array, "bins"]:
    """Return the volumes of the shells between spheres of these radii."""
    return math.pi ** (d / 2) / math.gamma(d / 2 + 1) * jnp.diff(jnp.asarray(edges) ** d)


NUM_FLOW_SHELLS = 2
"""Number of lengths of wave vectors that count as flow: k = 2 pi / side, and sqrt(2) times that."""


@partial(jax.jit, static_argnames="num_shells")
def structure_factor(
    position: Float[Array | np.ndarray, "particles d"], side: ArrayLike, num_shells: int = 4
) -> tuple[Float[Array, "shells"], Float[Array, "shells"]]:
    """Return the static structure factor ``S(k) = |sum exp(i k x)|^2 / N`` at small k.

    Args:
        position: positions, in any periodic images.
        side: side of the periodic box.
        num_shells: number of different lengths of the wave vector, from 2 pi / side upwards.

    Returns:
        The lengths k (1/length), and S averaged over the wave vectors of each length, both of shape
        (num_shells,). A homogeneous gas has S below 1 at these wave vectors; clusters raise it.

    >>> k, S = observables.structure_factor(position, 1.0, num_shells=2)
    >>> [round(float(x), 3) for x in k]
    [6.283, 8.886]
    """
    waves, shells = _waves(position.shape[-1], num_shells)
    amplitude = _amplitudes(position, jnp.ones(len(position)), waves, side)
    return _wave_numbers(waves, shells, side), _shell_means(jnp.abs(amplitude) ** 2, shells)


@partial(jax.jit, static_argnames="num_shells")
def flow_spectrum(
    position: Float[Array, "particles d"],
    velocity: Float[Array, "particles d"],
    side: ArrayLike,
    num_shells: int = 4,
) -> tuple[Float[Array, "shells"], Float[Array, "shells"], Float[Array, "shells"]]:
    """Return the energy spectra of the flow at the smallest wave vectors.

    The current ``j(k) = sum (v - u) exp(i k x) / sqrt(N)`` has a part across k and one along k.
    The transverse spectrum is ``|j_across|^2 / (d - 1)``, the longitudinal one ``|j_along|^2``,
    both in the unit of T. Both are T where velocities are independent; vortices raise the first.

    Args:
        position, velocity: particles of one box; positions in any periodic images.
        side: side of the periodic box.
        num_shells: number of different lengths of the wave vector, from 2 pi / side upwards.

    Returns:
        The lengths k (1/length), the transverse and the longitudinal spectrum, each of shape
        (num_shells,).

    >>> k, across, along = observables.flow_spectrum(position, velocity, 1.0)
    >>> across.shape == along.shape == k.shape
    True
    """
    d = position.shape[-1]
    waves, shells = _waves(d, num_shells)
    v = centred(velocity)
    current = jax.vmap(lambda x: _amplitudes(position, x, waves, side), 1, 1)(v)
    unit = waves / np.sqrt(np.sum(waves**2, axis=1, keepdims=True))
    amplitude = jnp.sum(current * unit, axis=1, keepdims=True)
    along = jnp.abs(amplitude[:, 0]) ** 2
    across = jnp.sum(jnp.abs(current - amplitude * unit) ** 2, axis=1) / (d - 1)
    k = _wave_numbers(waves, shells, side)
    return k, _shell_means(across, shells), _shell_means(along, shells)


@partial(jax.jit, static_argnames="num_shells")
def flow_share(
    position: Float[Array, "particles d"],
    velocity: Float[Array, "particles d"],
    side: ArrayLike,
    num_shells: int = NUM_FLOW_SHELLS,
) -> Float[Array, ""]:
    """Return the share of the kinetic energy in the longest waves of the flow, above equipartition.

    The share is ``(sum |j(k)|^2 - d T M) / (d N T / 2)`` with j of `flow_spectrum`, summed over M
    wave vectors, one of each pair k and -k. Where velocities are independent its mean is 0 and its
    standard deviation ``2 sqrt(M / d) / N``.

    Args:
        position, velocity, side, num_shells: see `flow_spectrum`.

    >>> share = observables.flow_share(position, velocity, 1.0)
    >>> bool(abs(share) < 0.02)
    True
    """
    num_particles, d = position.shape
    waves, _ = _waves(d, num_shells)
    v = centred(velocity)
    current = jax.vmap(lambda x: _amplitudes(position, x, waves, side), 1, 1)(v)
    energy = jnp.sum(v**2)
    divisor = jnp.where(energy > 0, energy, 1.0)  # particles at rest have no flow
    return 2 * jnp.sum(jnp.abs(current) ** 2) / divisor - 2 * len(waves) / num_particles


def _waves(d: int, num_shells: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return wave vectors k in units of 2 pi / side, without -k, and their indices by length."""
    if not (isinstance(num_shells, int) and num_shells >= 1):
        raise ValueError(f"num_shells must be a whole number >= 1, got {num_shells!r}")
    reach = range(-num_shells, num_shells + 1)
    half = [k for k in itertools.product(reach, repeat=d) if k > (0,) * d]
    square = np.sum(np.square(half), axis=1)
    lengths = np.unique(square)[:num_shells]
    waves = np.array(half)[np.isin(square, lengths)]
    square = np.sum(waves**2, axis=1)
    return waves.astype(float), [np.flatnonzero(square == length) for length in lengths]


def _amplitudes(
    position: Float[Array | np.ndarray, "n d"],
    weights: Float[Array, "n"],
    waves: np.ndarray,
    side: ArrayLike,
) -> Array:
    """Return ``sum w exp(i k x) / sqrt(n)`` for each wave vector."""
    unit = jnp.asarray(position) / jnp.asarray(side)
    # Whole periods do not change the result, and a small phase is rounded less.
    phase = 2 * jnp.pi * ((unit - jnp.floor(unit)) @ waves.T.astype(unit.dtype))
    factors = jnp.exp(jax.lax.complex(jnp.zeros_like(phase), phase))
    return weights.astype(factors.dtype) @ factors / math.sqrt(len(position))


def _wave_numbers(waves: np.ndarray, shells: list[np.ndarray], side: ArrayLike) -> Array:
    square = np.array([np.sum(waves[shell[0]] ** 2) for shell in shells])
    return 2 * jnp.pi / jnp.asarray(side) * jnp.sqrt(square)


def _shell_means(values: Float[Array, "waves"], shells: list[np.ndarray]) -> Float[Array, "shells"]:
    return jnp.stack([jnp.mean(values[shell]) for shell in shells])
