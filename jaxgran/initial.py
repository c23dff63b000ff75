"""Where a particle simulation starts: positions without overlap, Maxwellian velocities."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxgran.neighbours import vesin_search

PACKING_LIMIT = {2: 0.65, 3: 0.48}
"""Packing fraction up to which the start is a fluid: hard disks and spheres freeze soon above."""


def velocities(
    key: PRNGKeyArray, replicas: int, num_particles: int, dimension: int
) -> Float[Array, "particles d"]:
    """Maxwellian velocities of unit temperature, replica after replica.

    Each replica has zero momentum and exactly ``<v^2>/d = 1``.

    Raises:
        ValueError: for fewer than two particles, which zero momentum would leave at rest.
    """
    if num_particles < 2:
        raise ValueError(f"num_particles must be at least 2, got {num_particles}")
    v = jax.random.normal(key, (replicas, num_particles, dimension), jnp.result_type(float))
    return settle(v.reshape(-1, dimension), replicas)


def settle(velocity: Float[Array, "particles d"], replicas: int) -> Float[Array, "particles d"]:
    """Velocities shifted and scaled to zero momentum and unit temperature in every replica."""
    v = velocity.reshape(replicas, -1, velocity.shape[-1])
    v = v - jnp.mean(v, axis=1, keepdims=True)
    v = v / jnp.sqrt(jnp.mean(v**2, axis=(1, 2), keepdims=True))
    return v.reshape(velocity.shape)


def positions(
    key: PRNGKeyArray, side: ArrayLike, replicas: int, num_particles: int, dimension: int
) -> Float[Array, "particles d"]:
    """Random positions of unit spheres without overlap in periodic boxes, on the host.

    Uniform points, whose overlaps are then pushed apart by half each, over and over, until none is
    left. Dilute that is nearly an equilibrium gas; a dense one should be melted afterwards.

    Args:
        key: fixes the result.
        side: of the boxes in diameters.
        replicas: number of boxes, filled independently.
        num_particles: in each.
        dimension: 2 or 3.

    Returns:
        Positions in [0, side), replica after replica.

    Raises:
        RuntimeError: if overlaps are left after many pushes: the packing is too dense.
    """
    shape = (replicas * num_particles, dimension)
    uniform = jax.random.uniform(key, shape, jnp.result_type(float))
    host = _Untangle(replicas)
    if not any(isinstance(x, Tracer) for x in (uniform, side)):
        return jnp.asarray(host(uniform, side))
    out = jax.ShapeDtypeStruct(shape, uniform.dtype)
    return jax.pure_callback(host, out, uniform, side, vmap_method="sequential")


class _Untangle(NamedTuple):
    replicas: int
    gap: float = 1e-3
    max_pushes: int = 20_000

    def __call__(self, uniform, side):
        uniform, side = np.asarray(uniform), float(side)
        boxes = uniform.reshape(self.replicas, -1, uniform.shape[-1]).astype(float) * side
        x = np.concatenate([self._box(x, side) for x in boxes]).astype(uniform.dtype)
        return np.where(x >= uniform.dtype.type(side), uniform.dtype.type(0), x)

    def _box(self, x: np.ndarray, side: float) -> np.ndarray:
        n, d = x.shape
        cutoff, built, room = min(1.4, side / 2), None, 16 * n
        # Pushed pairs end at random gaps, or all would meet again at the same moment.
        filled = n / side**d * {2: np.pi / 4, 3: np.pi / 6}[d]
        largest_gap = 0.1 * max(0.0, 1 - 1.5 * filled / PACKING_LIMIT[d])
        random = np.random.default_rng(n)
        i = j = np.empty(0, int)
        for _ in range(self.max_pushes):
            moved = np.inf if built is None else np.sqrt(np.max(np.sum((x - built) ** 2, axis=1)))
            if 2 * moved > cutoff - 1 - 2 * self.gap:
                # Not wrapped until the end, so that steps since the list was built can be told.
                inside = np.mod(x, side)
                i, j, count = vesin_search(
                    np.where(inside >= side, 0, inside), side, cutoff, 1, room
                )
                if count > room:
                    room = int(1.5 * count)
                    continue
                i, j, built = i[:count], j[:count], x.copy()
            apart = x[i] - x[j]
            apart -= side * np.round(apart / side)
            distance = np.sqrt(np.sum(apart**2, axis=1))
            close = distance < 1 + self.gap / 2
            if not close.any():
                inside = np.mod(x, side)
                return np.where(inside >= side, 0.0, inside)
            apart, distance = apart[close], distance[close]
            # Coincident points part along the first axis.
            apart[distance == 0, 0] = distance[distance == 0] = 1e-9
            target = 1 + self.gap + largest_gap * random.random(len(distance))
            push = (0.5 * (target - distance) / distance)[:, None] * apart
            for axis in range(d):
                x[:, axis] += np.bincount(i[close], push[:, axis], n)
                x[:, axis] -= np.bincount(j[close], push[:, axis], n)
        raise RuntimeError(
            f"{n} spheres at this packing still overlap after {self.max_pushes} pushes; lower the "
            "packing fraction"
        )
