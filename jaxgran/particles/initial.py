"""Initial conditions of particle runs: positions without overlap and Maxwellian velocities."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from jaxgran.checks.tracing import concrete
from jaxgran.particles.neighbours import tree_search

PACKING_LIMIT = {2: 0.65, 3: 0.48}
"""Largest packing fraction of a random start, which is a fluid; hard disks and spheres freeze at
slightly larger ones."""

GAP = 1e-3
"""Smallest distance between the surfaces to which a pair is pushed apart."""

MOST_PUSHES = 20_000
"""Pushes of all pairs after which to give up."""


def velocities(
    key: PRNGKeyArray, replicas: int, num_particles: int, dimension: int
) -> Float[Array, "particles d"]:
    """Maxwellian velocities of unit temperature, replica after replica.

    Each replica has zero momentum and exactly ``<v^2>/d = 1``.

    Raises:
        ValueError: for fewer than two particles, which could only be at rest at zero momentum.
    """
    if num_particles < 2:
        raise ValueError(
            f"num_particles must be at least 2, got {num_particles}; a single particle without "
            "momentum is at rest"
        )
    v = jax.random.normal(key, (replicas, num_particles, dimension), jnp.result_type(float))
    return settle(v.reshape(-1, dimension), replicas)


def settle(velocity: Float[Array, "particles d"], replicas: int) -> Float[Array, "particles d"]:
    """Velocities shifted and scaled to zero momentum and unit temperature in every replica."""
    v = velocity.reshape(replicas, -1, velocity.shape[-1])
    v = v - jnp.mean(v, axis=1, keepdims=True)
    v = v / jnp.sqrt(jnp.mean(v**2, axis=(1, 2), keepdims=True))
    return v.reshape(velocity.shape)


def positions(
    key: PRNGKeyArray,
    side: ArrayLike,
    replicas: int,
    num_particles: int,
    dimension: int,
    room: Float[Array, "d"] | None = None,
) -> Float[Array, "particles d"]:
    """Random positions of unit spheres without overlap in periodic boxes, computed on the host.

    `jaxgran.particles.relaxation` does the same in compiled code, with other random gaps.

    The spheres are first placed at uniform random points. Then all overlapping pairs are pushed
    apart, both spheres by the same distance, and again until no overlap is left. For a dilute gas
    the result is close to equilibrium; a dense gas should be melted afterwards.

    Args:
        key: of the random numbers, which determines the result.
        side: of the boxes in diameters.
        replicas: number of boxes, filled independently.
        num_particles: in each.
        dimension: 2 or 3.
        room: lengths from 0 on along each axis within which positions must be, each at least a
            diameter less than the side; None is the whole box.

    Returns:
        Positions in [0, side), or in [0, room], replica after replica.

    Raises:
        RuntimeError: if overlaps are left after many pushes, which means that the packing is too
            dense.
    """
    uniform = uniform_points(key, replicas * num_particles, dimension)
    within = () if room is None else (room,)
    return concrete(_OverlapRemoval(replicas)(uniform, side, *within))


def uniform_points(key: PRNGKeyArray, number: int, dimension: int) -> Float[Array, "particles d"]:
    """Uniform random points in [0, 1)."""
    return jax.random.uniform(key, (number, dimension), jnp.result_type(float))


class _OverlapRemoval(NamedTuple):
    """Positions without overlap from random points in [0, 1), on the host.

    Attributes:
        replicas: number of boxes.
        gap, max_pushes: as `GAP` and `MOST_PUSHES`.
    """

    replicas: int
    gap: float = GAP
    max_pushes: int = MOST_PUSHES

    def __call__(self, uniform, side, room=None):
        uniform, side = np.asarray(uniform), float(side)
        room = None if room is None else np.asarray(room, float)
        boxes = uniform.reshape(self.replicas, -1, uniform.shape[-1]).astype(float)
        boxes = boxes * (side if room is None else room)
        x = np.concatenate([self._box(x, side, room) for x in boxes]).astype(uniform.dtype)
        return np.where(x >= uniform.dtype.type(side), uniform.dtype.type(0), x)

    def _box(
        self, x: Float[np.ndarray, "n d"], side: float, room: Float[np.ndarray, "d"] | None
    ) -> Float[np.ndarray, "n d"]:
        cutoff, built, random = min(1.4, side / 2), None, np.random.default_rng(len(x))
        volume = side ** x.shape[1] if room is None else float(np.prod(room + 1))
        at_random = float(largest_gap(len(x), x.shape[1], volume))
        i = j = np.empty(0, int)
        for _ in range(self.max_pushes):
            moved = np.inf if built is None else np.sqrt(np.max(np.sum((x - built) ** 2, axis=1)))
            if 2 * moved > cutoff - 1 - 2 * self.gap:
                # x stays unwrapped, or it could not be told how far particles have moved since.
                i, j = _listed(_wrapped(x, side), side, cutoff)
                built = x.copy()
            apart = x[i] - x[j]
            apart -= side * np.round(apart / side)
            distance = np.sqrt(np.sum(apart**2, axis=1))
            close = distance < 1 + self.gap / 2
            if not close.any():
                return _wrapped(x, side)
            apart, distance = apart[close], distance[close]
            # Coincident points part along the first axis.
            apart[distance == 0, 0] = distance[distance == 0] = 1e-9
            target = 1 + self.gap + at_random * random.random(len(distance))
            push = (0.5 * (target - distance) / distance)[:, None] * apart
            for axis in range(x.shape[1]):
                x[:, axis] += np.bincount(i[close], push[:, axis], len(x))
                x[:, axis] -= np.bincount(j[close], push[:, axis], len(x))
            if room is not None:
                x = np.clip(x, 0.0, room)
        raise RuntimeError(
            f"{len(x)} spheres at this packing still overlap after {self.max_pushes} pushes; lower "
            "the packing fraction"
        )


def largest_gap(n: int, d: int, volume: ArrayLike) -> Float[Array, ""]:
    """Largest gap that is added at random between pushed pairs.

    With equal gaps all these pairs would touch again at the same moment.
    """
    filled = n / jnp.asarray(volume) * {2: np.pi / 4, 3: np.pi / 6}[d]
    return 0.1 * jnp.maximum(0.0, 1 - 1.5 * filled / PACKING_LIMIT[d])


def _wrapped(x: Float[np.ndarray, "n d"], side: float) -> Float[np.ndarray, "n d"]:
    inside = np.mod(x, side)
    return np.where(inside >= side, 0.0, inside)


def _listed(
    inside: Float[np.ndarray, "n d"], side: float, cutoff: float
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """The pairs closer than a cutoff."""
    capacity = 16 * len(inside)
    while True:
        i, j, count = tree_search(inside, side, cutoff, 1, capacity)
        if count <= capacity:
            return i[:count], j[:count]
        capacity = int(1.5 * count)
