"""Waves of the flow of a gas, and the tangents that a projection keeps.

A `Memory` lists the kept quantities. Its columns are changes of the velocities, shape (N, d) in
each box:

- v itself, which is the temperature;
- one column per wave, ``cos(k x) e`` and ``sin(k x) e``, with e perpendicular to k or in all
  directions; if the stress is kept, also these waves of ``M v`` with symmetric M (temperature and
  stress);
- one column for all waves of a band of lengths of k: their total flow
  ``u_b(x) = sum_k a_k exp(i k x)``, with a_k measured from the velocities. Twice its amount is the
  change of the logarithm of the energy of the band. With stress also ``S_b C``, the stress of its
  strain ``S_b`` with the velocities C relative to the flow.

The rest of the tangents is replaced by its least-squares fit with these columns. This conserves
``sum dv . u_b``, the change of the energy of each band, and ``sum dv . v``, that of the whole gas.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

RIDGE = 1e-9
"""Regularisation of the least squares, for dependent columns: S_b of few waves."""

Bands = tuple[tuple[int, ...], ...]
"""Bands of squared lengths n^2 of wave vectors ``2 pi n / side``."""


class Memory(NamedTuple):
    """Quantities that a projection keeps.

    Attributes:
        waves: n^2 of waves with one coefficient each.
        transverse: whether their velocities are perpendicular to k only.
        tensors: whether waves of temperature and stress are kept with them.
        flow: bands of transverse waves whose energy is kept.
        stress: bands whose stress is kept too.
        compression: bands of longitudinal waves whose energy is kept.
        heat: bands of waves of the temperature.
        density: bands of waves of the density, kept as displacements.
        displacement: displacements of `waves`: "forgotten", "fitted" or "carried" by the flow.
        viscous: whether waves include their stress, by Enskog's kinetic viscosity.
        touching: whether spheres in contact are projected too, which conserves the momentum of each
            wave.
        interval: interval between projections, in mean free times.
    """

    waves: tuple[int, ...] = ()
    transverse: bool = False
    tensors: bool = False
    flow: Bands = ()
    stress: Bands = ()
    compression: Bands = ()
    heat: Bands = ()
    density: Bands = ()
    displacement: str = "forgotten"
    viscous: bool = False
    touching: bool = False
    interval: float = 0.1


class Waves:
    """The waves of some n^2 in one box, and their amplitudes."""

    def __init__(self, position: Array, side: Array, squares: tuple[int, ...]):
        size, d = position.shape
        n = vectors(d, squares)
        self.k = jnp.asarray(2 * np.pi * n) / side
        self.square = jnp.sum(self.k**2, -1, keepdims=True)
        turn, reach = jnp.exp(2j * jnp.pi * position / side), int(np.abs(n).max())
        powers = jnp.stack([turn**m for m in range(-reach, reach + 1)])
        wave = jnp.ones((len(n), size), turn.dtype)
        for axis in range(d):
            wave *= powers[n[:, axis] + reach, :, axis]
        self.cos, self.sin = wave.real, wave.imag

    def amplitudes(self, values: Array) -> tuple[Array, Array]:
        """Return the amplitudes of cos and sin of values of each particle."""
        scale = 2 / self.cos.shape[1]
        return scale * self.cos @ values, scale * self.sin @ values

    def split(self, velocity: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Return the amplitudes of the flow perpendicular and parallel to k."""
        both = self.amplitudes(velocity)
        along = tuple(jnp.sum(a * self.k, -1, keepdims=True) * self.k / self.square for a in both)
        across = tuple(a - b for a, b in zip(both, along, strict=True))
        return (across[0], across[1]), (along[0], along[1])

    def field(self, amplitudes: tuple[Array, Array]) -> Array:
        """Return the sum of the waves at each particle."""
        return self.cos.T @ amplitudes[0] + self.sin.T @ amplitudes[1]

    def gradient(self, amplitudes: tuple[Array, Array]) -> Array:
        """Return the derivative of `field` in the position, on the last axis."""
        a, b = (x[..., None] * self._k_for(x) for x in amplitudes)
        return jnp.tensordot(self.cos.T, b, 1) - jnp.tensordot(self.sin.T, a, 1)

    def _k_for(self, x: Array) -> Array:
        return self.k if x.ndim == 1 else self.k[:, None, :]

    def each(self) -> Float[Array, "waves N"]:
        """Return each cos and each sin."""
        return jnp.concatenate([self.cos, self.sin])


def vectors(d: int, squares: tuple[int, ...]) -> np.ndarray:
    """Return wave vectors n of these squared lengths, one of each pair n and -n."""
    reach = int(max(squares) ** 0.5)
    half = [n for n in itertools.product(range(-reach, reach + 1), repeat=d) if n > (0,) * d]
    return np.array([n for n in half if sum(i * i for i in n) in squares])


def columns(
    memory: Memory, position: Array, velocity: Array, side: Array, relaxation: Array
) -> tuple[Float[Array, "columns N d"], Float[Array, "more N d"] | None]:
    """Return the kept changes of the velocities, v first, and of the positions, in one box.

    Args:
        memory: the kept quantities.
        position, velocity: state of the particles, in the rest frame of the box.
        side: side of the box.
        relaxation: relaxation time of the stress, ``eta_K / (rho T)``.
    """
    waves = {b: Waves(position, side, b) for b in sorted(_bands(memory))}
    flows = {b: waves[b].split(velocity) for b in waves}
    thermal = velocity - sum((waves[b].field(flows[b][0]) for b in memory.stress), start=0.0)
    found = [velocity]
    for b in memory.flow:
        field = waves[b].field(flows[b][0])
        if memory.viscous:
            field -= relaxation * _strained(waves[b], flows[b][0], thermal)
        found.append(field)
    found += [waves[b].field(flows[b][1]) for b in memory.compression]
    found += [_strained(waves[b], flows[b][0], thermal) for b in memory.stress]
    heat = jnp.sum(thermal**2, -1)
    found += [waves[b].field(waves[b].amplitudes(heat))[:, None] * thermal for b in memory.heat]
    more = []
    one = jnp.ones_like(heat)
    for b in memory.density:
        a, c = (x / waves[b].square[:, 0] for x in waves[b].amplitudes(one))
        more.append(waves[b].gradient((a, c)))
    kept = jnp.stack(found)
    if memory.waves:
        own = _each_wave(memory, Waves(position, side, memory.waves), velocity)
        kept = jnp.concatenate([kept, own])
        if memory.displacement == "fitted":
            more += [*own]
    return kept, jnp.stack(more) if more else None


def _bands(memory: Memory) -> set[tuple[int, ...]]:
    return {*memory.flow, *memory.stress, *memory.compression, *memory.heat, *memory.density}


def _strained(waves: Waves, amplitudes: tuple[Array, Array], thermal: Array) -> Array:
    """Return ``S C``, with the symmetric part S of the gradient of a flow."""
    gradient = waves.gradient(amplitudes)
    return jnp.einsum("nij,nj->ni", 0.5 * (gradient + jnp.swapaxes(gradient, 1, 2)), thermal)


def _each_wave(memory: Memory, waves: Waves, velocity: Array) -> Float[Array, "columns N d"]:
    """Return waves of the velocity, and of temperature and stress, one column each."""
    size, d = velocity.shape
    phase = waves.each()
    if memory.transverse:
        unit = np.array([_across(n) for n in vectors(d, memory.waves)])  # waves (d-1) d
        unit = jnp.asarray(np.concatenate([unit, unit]))
    else:
        unit = jnp.broadcast_to(jnp.eye(d), (len(phase), d, d))
    found = [jnp.einsum("kn,ked->kend", phase, unit).reshape(-1, size, d)]
    if memory.tensors:
        pairs = [(i, j) for i in range(d) for j in range(i, d)]
        tensors = np.zeros((len(pairs), d, d))
        for t, (i, j) in enumerate(pairs):
            tensors[t, i, j] = tensors[t, j, i] = 1.0
        strained = jnp.einsum("tij,nj->tni", tensors, velocity)
        found.append(jnp.einsum("kn,tni->ktni", phase, strained).reshape(-1, size, d))
        # Uniform stress; the trace is the temperature.
        shear = [t for t, (i, j) in enumerate(pairs) if i != j]
        normal = [t for t, (i, j) in enumerate(pairs) if i == j]
        found += [strained[np.array(shear)], strained[np.array(normal[1:])] - strained[normal[0]]]
    return jnp.concatenate(found)


def _across(n: np.ndarray) -> np.ndarray:
    """Return unit vectors perpendicular to a wave vector."""
    return np.linalg.svd(n[None].astype(float))[2][1:]


def fit(
    kept: Float[Array, "columns N d"], rest: Float[Array, "p N d"], weight: Float[Array, "N"]
) -> Float[Array, "p columns"]:
    """Fit the columns to a rest, by least squares over particles of weight 1."""
    scale = jnp.sqrt(jnp.mean(kept**2, axis=(1, 2)))
    scaled = kept / scale[:, None, None]
    weighed = scaled * weight[:, None]
    gram = jnp.einsum("and,bnd->ab", weighed, scaled)
    gram += RIDGE * kept.shape[1] * jnp.eye(len(kept))
    return jnp.linalg.solve(gram, jnp.einsum("and,pnd->ap", weighed, rest)).T / scale
