"""Waves of the density and of the flow."""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxgran.particles.observables.moments import centred

FLOW_SHELLS = 2
"""Lengths of wave vectors that count as flow: k = 2 pi / side, and sqrt(2) times that."""


def structure_factor(
    position: Float[Array | np.ndarray, "particles d"], side: ArrayLike, num_shells: int = 4
) -> tuple[Float[Array, "shells"], Float[Array, "shells"]]:
    """Static structure factor ``S(k) = |sum exp(i k x)|^2 / N`` at the smallest wave vectors.

    Args:
        position: of any periodic images of the particles.
        side: of the periodic box.
        num_shells: number of different lengths of the wave vector, from 2 pi / side upwards.

    Returns:
        The lengths k (1/length), and S averaged over the wave vectors of each length. A homogeneous
        gas has S below 1 at these wave vectors; clusters raise it.

    >>> k, S = observables.structure_factor(position, 1.0, num_shells=2)
    >>> [round(float(x), 3) for x in k]
    [6.283, 8.886]
    """
    waves, shells = _waves(position.shape[-1], num_shells)
    amplitude = _amplitudes(position, jnp.ones(len(position)), waves, side)
    return _lengths(waves, shells, side), _by_shell(jnp.abs(amplitude) ** 2, shells)


def flow_spectrum(
    position: Float[Array, "particles d"],
    velocity: Float[Array, "particles d"],
    side: ArrayLike,
    num_shells: int = 4,
) -> tuple[Float[Array, "shells"], Float[Array, "shells"], Float[Array, "shells"]]:
    """How much energy the flow has at the smallest wave vectors.

    With ``j(k) = sum (v - u) exp(i k x) / sqrt(N)`` split along k and across it, the spectra are
    ``|j_across|^2 / (d - 1)`` and ``|j_along|^2``, in the unit of T. Both are T where velocities
    are independent; vortices raise the first.

    Args:
        position, velocity: of one box; positions of any periodic images.
        side: of the periodic box.
        num_shells: number of different lengths of the wave vector, from 2 pi / side upwards.

    Returns:
        The lengths k, the transverse and the longitudinal spectrum.

    >>> k, across, along = observables.flow_spectrum(position, velocity, 1.0)
    >>> across.shape == along.shape == k.shape
    True
    """
    d = position.shape[-1]
    waves, shells = _waves(d, num_shells)
    v = centred(velocity)
    current = jax.vmap(lambda x: _amplitudes(position, x, waves, side), 1, 1)(v)
    unit = waves / np.sqrt(np.sum(waves**2, axis=1, keepdims=True))
    along = jnp.abs(jnp.sum(current * unit, axis=1)) ** 2
    across = (jnp.sum(jnp.abs(current) ** 2, axis=1) - along) / (d - 1)
    return _lengths(waves, shells, side), _by_shell(across, shells), _by_shell(along, shells)


def flow_share(
    position: Float[Array, "particles d"],
    velocity: Float[Array, "particles d"],
    side: ArrayLike,
    num_shells: int = FLOW_SHELLS,
) -> Float[Array, ""]:
    """Share of the kinetic energy in the flow: in its longest waves, above equipartition.

    ``(sum |j(k)|^2 - d T M) / (d N T / 2)`` with j of `flow_spectrum`, over M wave vectors, one of
    each pair k and -k. 0 on average where velocities are independent; its standard deviation is
    then ``2 sqrt(M / d) / N``.

    Args: as `flow_spectrum`.

    >>> share = observables.flow_share(position, velocity, 1.0)
    >>> bool(abs(share) < 0.02)
    True
    """
    num_particles, d = position.shape
    waves, _ = _waves(d, num_shells)
    v = centred(velocity)
    current = jax.vmap(lambda x: _amplitudes(position, x, waves, side), 1, 1)(v)
    # Where nothing moves there is no flow.
    energy = jnp.sum(v**2)
    moving = jnp.where(energy > 0, energy, 1.0)
    return 2 * jnp.sum(jnp.abs(current) ** 2) / moving - 2 * len(waves) / num_particles


def _waves(d: int, num_shells: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Wave vectors in units of 2 pi / side, one of each pair k and -k, and those of each length."""
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
    """``sum w exp(i k x) / sqrt(n)`` for each wave vector."""
    turns = jnp.asarray(position) / jnp.asarray(side)
    # A whole turn changes nothing, and a small phase is rounded less.
    phase = 2 * jnp.pi * ((turns - jnp.floor(turns)) @ waves.T.astype(turns.dtype))
    return weights @ jnp.exp(1j * phase) / math.sqrt(len(position))


def _lengths(waves: np.ndarray, shells: list[np.ndarray], side: ArrayLike) -> Array:
    square = np.array([np.sum(waves[shell[0]] ** 2) for shell in shells])
    return 2 * jnp.pi / jnp.asarray(side) * jnp.sqrt(square)


def _by_shell(values: Float[Array, "waves"], shells: list[np.ndarray]) -> Float[Array, "shells"]:
    return jnp.stack([jnp.mean(values[shell]) for shell in shells])
