"""Positions and velocities given by a user for a run of spheres to begin with.

Initial conditions of particle runs: positions without overlap and Maxwellian velocities.

Positions without overlap from random points, compiled: what `initial` does on the host.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, concrete
from jaxgran.data.curve import Particles, UserParticles
from jaxgran.particles import neighbours
from jaxgran.particles.neighbours import Pairs, tree_search
from jaxgran.scene.elements import Walls
from jaxgran.scene.gas import Gas

PACKING_LIMIT = {2: 0.65, 3: 0.48}
"""Largest packing fraction of a random start, which is a fluid; hard disks and spheres freeze at
slightly larger ones."""

GAP = 1e-3
"""Smallest distance between the surfaces to which a pair is pushed apart."""

MAX_PUSHES = 20_000
"""Pushes of all pairs after which to give up."""


def maxwellian_velocities(
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
    return normalise_velocities(v.reshape(-1, dimension), replicas)


def normalise_velocities(
    velocity: Float[Array, "particles d"], replicas: int
) -> Float[Array, "particles d"]:
    """Velocities shifted and scaled to zero momentum and unit temperature in every replica."""
    v = velocity.reshape(replicas, -1, velocity.shape[-1])
    v = v - jnp.mean(v, axis=1, keepdims=True)
    v = v / jnp.sqrt(jnp.mean(v**2, axis=(1, 2), keepdims=True))
    return v.reshape(velocity.shape)


def host_positions(
    key: PRNGKeyArray,
    side: ArrayLike,
    replicas: int,
    num_particles: int,
    dimension: int,
    room: Float[Array, "d"] | None = None,
) -> Float[Array, "particles d"]:
    """Random positions of unit spheres without overlap in periodic boxes, computed on the host.

    `jaxgran.particles.setup` does the same in compiled code, with other random gaps.

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
    max_pushes: int = MAX_PUSHES

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
                i, j = _close_pairs(_wrap_all(x, side), side, cutoff)
                built = x.copy()
            apart = x[i] - x[j]
            apart -= side * np.round(apart / side)
            distance = np.sqrt(np.sum(apart**2, axis=1))
            close = distance < 1 + self.gap / 2
            if not close.any():
                return _wrap_all(x, side)
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


def _wrap_all(x: Float[np.ndarray, "n d"], side: float) -> Float[np.ndarray, "n d"]:
    inside = np.mod(x, side)
    return np.where(inside >= side, 0.0, inside)


def _close_pairs(
    inside: Float[np.ndarray, "n d"], side: float, cutoff: float
) -> tuple[Int[np.ndarray, "pairs"], Int[np.ndarray, "pairs"]]:
    """The pairs closer than a cutoff."""
    capacity = 16 * len(inside)
    while True:
        i, j, count = tree_search(inside, side, cutoff, 1, capacity)
        if count <= capacity:
            return i[:count], j[:count]
        capacity = int(1.5 * count)


COINCIDENT = 1e-9
"""Distance from which points at the same place part."""


class _Relaxation(NamedTuple):
    """Spheres that are pushed apart: positions, pushes made, whether some overlapped before the
    last of them, and the status."""

    position: Float[Array, "n d"]
    pushes: Int[Array, ""]
    overlap: Bool[Array, ""]
    fault: Int[Array, ""]


class _Boxes(NamedTuple):
    """What does not change: see the arguments of `positions`; and the largest random gap."""

    key: PRNGKeyArray
    side: ArrayLike
    replicas: int
    skin: ArrayLike
    capacity: tuple[int, int]
    room: Float[Array, "1 d"] | None
    at_random: Float[Array, ""]

    def until_stale(self, now: _Relaxation) -> _Relaxation:
        """A new neighbour list, and pushes until it is stale or none is needed."""
        built, cutoff = neighbours.wrap(self.side, now.position), 1 + jnp.asarray(self.skin)
        found = neighbours.search_pairs(
            built, self.side, cutoff, self.replicas, self.capacity, "sweep"
        )
        pairs = neighbours.with_offsets(built, self.side, found)
        full = (pairs.count > self.capacity[0]) | (pairs.lookahead > self.capacity[1])

        def goes_on(carry: tuple[_Relaxation, Array]) -> Array:
            now, stale = carry
            return now.overlap & ~stale & (now.pushes < MAX_PUSHES)

        def push(carry: tuple[_Relaxation, Array]) -> tuple[_Relaxation, Array]:
            now, _ = carry
            x, overlap = self.pushed(now.position, pairs, now.pushes)
            moved = jnp.sqrt(jnp.max(jnp.sum((x - built) ** 2, axis=1)))
            now = now._replace(position=x, pushes=now.pushes + 1, overlap=overlap)
            return now, 2 * moved > self.skin - 2 * GAP

        now, _ = jax.lax.while_loop(goes_on, push, (now._replace(position=built), full))
        late = now.overlap & (now.pushes >= MAX_PUSHES)
        fault = status.flag(status.LIST_FULL, full) | status.flag(status.NO_ROOM, late)
        return now._replace(fault=now.fault | fault)

    def pushed(self, x: Array, pairs: Pairs, k: Array) -> tuple[Array, Array]:
        """The positions after push k of all overlapping pairs, and whether there are any."""
        apart = x[pairs.i] - x[pairs.j] - pairs.offset
        square = jnp.sum(apart * apart, axis=1)
        distance = jnp.sqrt(jnp.where(square > 0, square, COINCIDENT**2))
        # Coincident points part along the first axis.
        first_axis = jnp.zeros_like(apart).at[:, 0].set(COINCIDENT)
        apart = jnp.where((square > 0)[:, None], apart, first_axis)
        real = jnp.arange(self.capacity[0]) < pairs.count
        close = real & (distance < 1 + GAP / 2)
        more = jax.random.uniform(jax.random.fold_in(self.key, k), distance.shape, x.dtype)
        target = 1 + GAP + self.at_random * more
        push = jnp.where(close, 0.5 * (target - distance) / distance, 0.0)[:, None] * apart
        x = x.at[pairs.i].add(push).at[pairs.j].add(-push)
        return x if self.room is None else jnp.clip(x, 0.0, self.room), jnp.any(close)


def relaxed_positions(
    key: PRNGKeyArray,
    side: ArrayLike,
    size: tuple[int, int, int],
    skin: ArrayLike,
    capacity: tuple[int, int],
    room: Float[Array, "d"] | None = None,
    fault: ArrayLike = status.OK,
) -> tuple[Float[Array, "particles d"], Int[Array, ""]]:
    """As `jaxgran.particles.setup.host_positions`, with random gaps of its own.

    Args:
        key: of the random numbers.
        side: of the boxes in diameters.
        size: replicas, particles in each, dimension.
        skin: of the neighbour list.
        capacity: of the list, in pairs, and of its look-ahead, in particles.
        room: as there.
        fault: the status before; unless it is ok nothing is pushed.

    Returns:
        Positions, replica after replica, and the status: the list is full, or there is no room.
    """
    replicas, num_particles, dimension = size
    volume = jnp.asarray(side) ** dimension if room is None else jnp.prod(room + 1)
    within = None if room is None else room[None]
    at_random = largest_gap(num_particles, dimension, volume)
    boxes = _Boxes(key, side, replicas, skin, capacity, within, at_random)
    points = uniform_points(key, replicas * num_particles, dimension)
    points = points * (jnp.asarray(side) if within is None else within)
    zero = jnp.zeros((), jnp.int32)
    first = _Relaxation(points, zero, jnp.ones((), bool), jnp.asarray(fault, jnp.int32))

    def unfinished(now: _Relaxation) -> Array:
        return now.overlap & (now.fault == status.OK)

    last = jax.lax.while_loop(unfinished, boxes.until_stale, first)
    return neighbours.wrap(side, last.position), last.fault


SAME_BOX = 1e-6
"""Relative difference up to which the box of a start counts as that of the gas."""


def check_start(start: UserParticles | None, gas: Gas, replicas: int, num_particles: int) -> None:
    """Raise ValueError for a start of another shape, or, if its numbers are known, another box."""
    if start is None:
        return
    if not isinstance(start, Particles):
        raise ValueError(
            "start must be a jaxgran.Particles(position, velocity, box_side), such as "
            f"curve.particles, got {type(start).__name__}"
        )
    shape = (replicas, num_particles, gas.dimension)
    for name, values in zip(start._fields[:2], start[:2], strict=True):
        if np.shape(values) != shape:
            raise ValueError(f"start.{name} has shape {np.shape(values)}, not {shape}")
    other = has_other_box(start, gas, num_particles)
    if not isinstance(other, Tracer) and bool(other):
        side = box_side(gas, num_particles)
        given, own = (
            np.array2string(np.asarray(s / gas.diameter), precision=7)
            for s in (start.box_side, side)
        )
        raise ValueError(
            f"start.box_side is {given} diameters, that of the gas {own}: change packing_fraction "
            "or the start"
        )


def check_inside(start: Particles | None, walls: Walls, least: ArrayLike, dimension: int) -> None:
    """Raise ValueError for a start with a sphere that does not stand between the walls.

    Args:
        start: as given by the user.
        walls: at 0 and at each side.
        least: distance of centres from them, m.
        dimension: d.
    """
    if start is None or any_traced(start.position, walls.side, least):
        return
    least = float(np.asarray(least))
    sides, place = np.broadcast_to(walls.side, (dimension,)), np.asarray(start.position)
    outside = np.any((place < least) | (place > sides - least), axis=-1)
    if np.any(outside):
        replica, i = np.argwhere(outside)[0]
        where = "outside of the walls"
        if np.all((place[replica, i] >= 0) & (place[replica, i] <= sides)):
            where = f"less than its radius, {least:.6g} m, from a wall"
        raise ValueError(
            f"sphere {i} of replica {replica} of the start is at {place[replica, i]} m, {where}: "
            f"they are at 0 and {sides} m; move it inside"
        )


def has_other_box(start: Particles | None, gas: Gas, num_particles: int) -> Bool[Array, ""]:
    """Whether there is a start and its box is not that of the gas."""
    if start is None:
        return jnp.array(False)
    ratio = jax.lax.stop_gradient(start.box_side / box_side(gas, num_particles))
    return ~jnp.all(jnp.abs(ratio - 1) < SAME_BOX + 10 * jnp.finfo(ratio.dtype).eps)


def box_side(gas: Gas, num_particles: int) -> Float[Array, "..."]:
    """Side of the periodic box of a gas, or of its container, which may have d sides."""
    return gas.box_side(num_particles) if gas.container is None else gas.container.side


def with_constant_temperature(start: Particles | None, gas: Gas) -> Gas:
    """The gas as derivatives see it: with a start, T_0 is a unit of speed and nothing else."""
    if start is None:
        return gas
    return gas.replace(temperature=jax.lax.stop_gradient(gas.temperature))


def reduced_start(
    start: Particles | None, gas: Gas, *, differentiable: bool = False
) -> tuple[Float[Array, "n d"], Float[Array, "n d"]] | None:
    """Positions and velocities in units of the gas, replica after replica; None without a start.

    Args:
        start: as given by the user.
        gas: the scene.
        differentiable: whether derivatives see the diameter as the unit of length; else the start
            is the same, in diameters, for a gas of any diameter.
    """
    if start is None:
        return None
    length = gas.diameter if differentiable else jax.lax.stop_gradient(gas.diameter)
    position = start.position / length
    velocity = start.velocity / jnp.sqrt(gas.temperature)
    return position.reshape(-1, gas.dimension), velocity.reshape(-1, gas.dimension)


def min_distance(
    position: Float[Array, "n d"],
    side: ArrayLike,
    replicas: int,
    capacity: tuple[int, int],
    by: str = "scipy",
) -> Float[Array, ""]:
    """The least distance between two spheres, in diameters; 1 if none is below.

    Args:
        position, side, replicas, by: as in `neighbours.search_pairs`.
        capacity: numbers of overlapping pairs, and of particles that a sweep looks ahead.
    """
    found = neighbours.search_pairs(position, side, 1.0, replicas, capacity, by)
    pairs = neighbours.with_offsets(position, side, found)
    apart = position[pairs.i] - position[pairs.j] - pairs.offset
    real = jnp.arange(capacity[0]) < pairs.count
    square = jnp.where(real, jnp.sum(apart * apart, -1), 1.0)
    return jnp.sqrt(jnp.min(square, initial=1.0))


def overlap_by_rounding(
    position: Float[Array, "n d"], side: ArrayLike, least: float
) -> Float[Array, ""]:
    """Overlap that rounding of positions can give two spheres in contact; at least `least`."""
    return jnp.maximum(least, 10 * side * jnp.finfo(position.dtype).eps)
