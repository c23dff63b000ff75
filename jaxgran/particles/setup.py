"""Initial conditions of particle runs.

A random start has Maxwellian velocities and positions without overlap, which are computed on the
host or in compiled code. A start given by a user is checked and reduced to the units of the run.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, array_module, concrete_array
from jaxgran.data.curve import Particles
from jaxgran.particles import neighbours
from jaxgran.particles.snapshot import box_side
from jaxgran.scene.elements import Walls
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import PACKING_LIMIT

GAP = 1e-3
"""Smallest distance, in diameters, between the surfaces to which a pair is pushed apart."""

MAX_PUSHES = 20_000
"""Largest number of pushes of all overlapping pairs."""

COINCIDENT = 1e-9
"""Distance, in diameters, that is assumed between points at the same place."""

ALLOWED_OVERLAP = 1e-9
"""Overlap in diameters that is allowed in a given start of hard spheres."""

SAME_BOX = 1e-6
"""Relative difference up to which the box of a start counts as that of the gas."""


def maxwellian_velocities(
    key: PRNGKeyArray, replicas: int, num_particles: int, dimension: int
) -> Float[Array, "particles d"]:
    """Draw Maxwellian velocities with zero momentum and exactly ``<v^2>/d = 1`` in each replica.

    Raises:
        ValueError: for fewer than two particles.
    """
    if num_particles < 2:
        raise ValueError(
            f"num_particles must be at least 2, got {num_particles}. A single particle without "
            "momentum is at rest"
        )
    v = jax.random.normal(key, (replicas, num_particles, dimension), jnp.result_type(float))
    return normalise_velocities(v.reshape(-1, dimension), replicas)


@partial(jax.jit, static_argnums=1)
def normalise_velocities(
    velocity: Float[Array, "particles d"], replicas: int
) -> Float[Array, "particles d"]:
    """Shift and scale velocities to zero momentum and unit temperature in every replica."""
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
    region: Float[Array, "d"] | None = None,
) -> Float[Array, "particles d"]:
    """Place unit spheres at random positions without overlap in periodic boxes, on the host.

    The spheres are first placed at uniform random points. Then all overlapping pairs are pushed
    apart, both spheres by the same distance, and again until no overlap is left. For a dilute gas
    the result is close to equilibrium; a dense gas should be equilibrated afterwards.
    `relaxed_positions` does the same in compiled code, with other random gaps.

    Args:
        key: key of the random numbers, which determines the result.
        side: side of the boxes in diameters.
        replicas: number of boxes, filled independently.
        num_particles: number of spheres in each box.
        dimension: 2 or 3.
        region: sides of the region, which begins at 0, of the positions, each at least a diameter
            less than the side of the box; None for the whole box.

    Returns:
        Positions in [0, side), or in [0, region], replica after replica.

    Raises:
        RuntimeError: if overlaps are left after many pushes because the packing is too dense.
    """
    uniform = np.asarray(uniform_points(key, replicas * num_particles, dimension))
    length, sides = float(np.asarray(side)), None if region is None else np.asarray(region, float)
    boxes = uniform.reshape(replicas, -1, dimension).astype(float)
    boxes = boxes * (length if sides is None else sides)
    x = np.concatenate([_push_apart(x, length, sides) for x in boxes]).astype(uniform.dtype)
    return concrete_array(np.where(x >= uniform.dtype.type(length), uniform.dtype.type(0), x))


def uniform_points(key: PRNGKeyArray, number: int, dimension: int) -> Float[Array, "particles d"]:
    """Draw uniform random points in [0, 1)."""
    return jax.random.uniform(key, (number, dimension), jnp.result_type(float))


def _push_apart(
    x: Float[np.ndarray, "n d"], side: float, region: Float[np.ndarray, "d"] | None
) -> Float[np.ndarray, "n d"]:
    cutoff, built, random = min(1.4, side / 2), None, np.random.default_rng(len(x))
    volume = side ** x.shape[1] if region is None else float(np.prod(region + 1))
    max_extra_gap = float(largest_extra_gap(len(x), x.shape[1], volume))
    i = j = np.empty(0, int)
    for _ in range(MAX_PUSHES):
        moved = np.inf if built is None else np.sqrt(np.max(np.sum((x - built) ** 2, axis=1)))
        if 2 * moved > cutoff - 1 - 2 * GAP:
            # x stays unwrapped, so that the distance moved since then can be computed.
            i, j = neighbours.close_pairs(neighbours.wrap(side, x), side, cutoff).T
            built = x.copy()
        separation = x[i] - x[j]
        separation -= side * np.round(separation / side)
        distance = np.sqrt(np.sum(separation**2, axis=1))
        close = distance < 1 + GAP / 2
        if not close.any():
            return neighbours.wrap(side, x)
        separation, distance = separation[close], distance[close]
        # Coincident points are separated along the first axis.
        separation[distance == 0, 0] = distance[distance == 0] = COINCIDENT
        target = 1 + GAP + max_extra_gap * random.random(len(distance))
        push = (0.5 * (target - distance) / distance)[:, None] * separation
        for axis in range(x.shape[1]):
            x[:, axis] += np.bincount(i[close], push[:, axis], len(x))
            x[:, axis] -= np.bincount(j[close], push[:, axis], len(x))
        if region is not None:
            x = np.clip(x, 0.0, region)
    raise RuntimeError(
        f"{len(x)} spheres at this packing still overlap after {MAX_PUSHES} pushes. Lower "
        "the packing fraction"
    )


def largest_extra_gap(n: int, d: int, volume: ArrayLike) -> Any:
    """Return the largest random gap that is added to `GAP`.

    With equal gaps all pairs that were pushed would touch again at the same moment.
    """
    xp = array_module(volume)
    packing_fraction = n / xp.asarray(volume) * {2: np.pi / 4, 3: np.pi / 6}[d]
    return 0.1 * xp.maximum(0.0, 1 - 1.5 * packing_fraction / PACKING_LIMIT[d])


def relaxed_positions(
    key: PRNGKeyArray,
    side: ArrayLike,
    size: tuple[int, int, int],
    skin: ArrayLike,
    capacity: tuple[int, int],
    region: Float[Array, "d"] | None = None,
    fault: ArrayLike = status.OK,
) -> tuple[Float[Array, "particles d"], Int[Array, ""]]:
    """Place unit spheres as `host_positions` does, in compiled code.

    Args:
        key: key of the random numbers.
        side: side of the boxes in diameters.
        size: replicas, particles in each, dimension.
        skin: skin of the neighbour list.
        capacity: capacity of the list, in pairs, and of its look-ahead, in particles.
        region: see `host_positions`.
        fault: status before; unless it is ok no sphere is pushed.

    Returns:
        Positions, replica after replica, and the status: `LIST_FULL` or `OVERLAPS_REMAIN` after a
        failure.
    """
    replicas, num_particles, dimension = size
    volume = jnp.asarray(side) ** dimension if region is None else jnp.prod(region + 1)
    max_extra_gap = largest_extra_gap(num_particles, dimension, volume)
    cutoff = 1 + jnp.asarray(skin)
    points = uniform_points(key, replicas * num_particles, dimension)
    points = points * (jnp.asarray(side) if region is None else region[None])

    def push_until_stale(carry: tuple[Array, Array, Array, Array]) -> tuple:
        """Build a neighbour list, and push until it is stale or no overlap is left."""
        x, num_pushes, overlap, fault = carry
        built = neighbours.wrap(side, x)
        listed = neighbours.search_pairs(built, side, cutoff, replicas, capacity, "sweep")
        pairs = neighbours.with_offsets(built, side, listed)
        full = (pairs.count > capacity[0]) | (pairs.lookahead > capacity[1])

        def unfinished(carry: tuple) -> Array:
            _, num_pushes, overlap, stale = carry
            return overlap & ~stale & (num_pushes < MAX_PUSHES)

        def push_all(carry: tuple) -> tuple:
            x, num_pushes, _, _ = carry
            separation = x[pairs.i] - x[pairs.j] - pairs.offset
            square = jnp.sum(separation * separation, axis=1)
            distance = jnp.sqrt(jnp.where(square > 0, square, COINCIDENT**2))
            # Coincident points are separated along the first axis.
            first_axis = jnp.zeros_like(separation).at[:, 0].set(COINCIDENT)
            separation = jnp.where((square > 0)[:, None], separation, first_axis)
            in_use = jnp.arange(capacity[0]) < pairs.count
            close = in_use & (distance < 1 + GAP / 2)
            key_of_push = jax.random.fold_in(key, num_pushes)
            random = jax.random.uniform(key_of_push, distance.shape, x.dtype)
            target = 1 + GAP + max_extra_gap * random
            size = jnp.where(close, 0.5 * (target - distance) / distance, 0.0)
            push = size[:, None] * separation
            x = x.at[pairs.i].add(push).at[pairs.j].add(-push)
            x = x if region is None else jnp.clip(x, 0.0, region[None])
            moved = jnp.sqrt(jnp.max(jnp.sum((x - built) ** 2, axis=1)))
            return x, num_pushes + 1, jnp.any(close), 2 * moved > skin - 2 * GAP

        first = built, num_pushes, overlap, full
        x, num_pushes, overlap, _ = jax.lax.while_loop(unfinished, push_all, first)
        failed = overlap & (num_pushes >= MAX_PUSHES)
        fault |= status.flag(status.LIST_FULL, full) | status.flag(status.OVERLAPS_REMAIN, failed)
        return x, num_pushes, overlap, fault

    def unfinished(carry: tuple) -> Array:
        _, _, overlap, fault = carry
        return overlap & (fault == status.OK)

    first = points, jnp.zeros((), jnp.int32), jnp.ones((), bool), jnp.asarray(fault, jnp.int32)
    x, _, _, fault = jax.lax.while_loop(unfinished, push_until_stale, first)
    return neighbours.wrap(side, x), fault


def check_start(start: Particles | None, gas: Gas, replicas: int, num_particles: int) -> None:
    """Raise ValueError if a start has another shape or, with known numbers, another box."""
    if start is None:
        return
    if not isinstance(start, Particles):
        raise ValueError(
            f"start must be a jaxgran.Particles, got {type(start).__name__}. Take curve.particles "
            "of another run, or Particles(position, velocity, box_side)"
        )
    shape = (replicas, num_particles, gas.dimension)
    for name, values in zip(start._fields[:2], start[:2], strict=True):
        if np.shape(values) != shape:
            raise ValueError(f"start.{name} has shape {np.shape(values)}, not {shape}")
    other = has_other_box(start, gas, num_particles)
    if not isinstance(other, Tracer) and bool(other):
        side = box_side(gas, num_particles)
        given, expected = (
            np.array2string(np.asarray(s / gas.diameter), precision=7)
            for s in (start.box_side, side)
        )
        raise ValueError(
            f"start.box_side is {given} diameters, that of the gas {expected}. Change "
            "packing_fraction or the start"
        )


def check_inside(start: Particles, walls: Walls, min_wall_distance: ArrayLike) -> None:
    """Raise ValueError if the centre of a sphere is too close to a wall, at 0 or at a side."""
    if any_traced(start.position, walls.side, min_wall_distance):
        return
    least, position = float(np.asarray(min_wall_distance)), np.asarray(start.position)
    sides = np.broadcast_to(walls.side, position.shape[-1:])
    outside = np.any((position < least) | (position > sides - least), axis=-1)
    if np.any(outside):
        replica, i = np.argwhere(outside)[0]
        where = "outside of the walls"
        if np.all((position[replica, i] >= 0) & (position[replica, i] <= sides)):
            where = f"less than its radius, {least:.6g} m, from a wall"
        raise ValueError(
            f"sphere {i} of replica {replica} of the start is at {position[replica, i]} m, "
            f"{where}. The walls are at 0 and {sides} m: move it inside"
        )


def has_other_box(start: Particles | None, gas: Gas, num_particles: int) -> Bool[Array, ""]:
    """Return whether the start has another box than the gas; False without a start."""
    if start is None:
        return jnp.array(False)
    ratio = jax.lax.stop_gradient(start.box_side / box_side(gas, num_particles))
    return ~jnp.all(jnp.abs(ratio - 1) < SAME_BOX + 10 * jnp.finfo(ratio.dtype).eps)


def reduced_start(
    start: Particles | None, gas: Gas, *, differentiable: bool = False
) -> tuple[Float[Array, "n d"], Float[Array, "n d"]] | None:
    """Return positions and velocities of a start in units of the gas; None without a start.

    Args:
        start: particles given by the user.
        gas: the gas.
        differentiable: whether the unit of length, the diameter, is differentiated. Otherwise
            derivatives keep the start, in diameters, constant.
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
    engine: str = "scipy",
) -> Float[Array, ""]:
    """Return the least distance between two spheres in diameters, and 1 without overlap.

    Args:
        position, side, replicas, engine: see `neighbours.search_pairs`.
        capacity: capacity in overlapping pairs, and in particles that a sweep looks ahead.
    """
    listed = neighbours.search_pairs(position, side, 1.0, replicas, capacity, engine)
    pairs = neighbours.with_offsets(position, side, listed)
    separation = position[pairs.i] - position[pairs.j] - pairs.offset
    in_use = jnp.arange(capacity[0]) < pairs.count
    square = jnp.where(in_use, jnp.sum(separation * separation, -1), 1.0)
    return jnp.sqrt(jnp.min(square, initial=1.0))


def allowed_overlap(position: Float[Array, "n d"], side: ArrayLike) -> Float[Array, ""]:
    """Return the overlap up to which spheres of a start count as hard, at least that of spheres in
    contact by rounding of positions."""
    return jnp.maximum(ALLOWED_OVERLAP, 10 * side * jnp.finfo(position.dtype).eps)
