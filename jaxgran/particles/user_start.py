"""Positions and velocities given by a user for a run of spheres to begin with."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxgran.checks.tracing import any_traced
from jaxgran.data.curve import Particles, UserParticles
from jaxgran.particles import neighbours
from jaxgran.scene.elements import Walls
from jaxgran.scene.gas import Gas

SAME_BOX = 1e-6
"""Relative difference up to which the box of a start counts as that of the gas."""


def check(start: UserParticles | None, gas: Gas, replicas: int, num_particles: int) -> None:
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
    other = is_of_other_box(start, gas, num_particles)
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


def is_of_other_box(start: Particles | None, gas: Gas, num_particles: int) -> Bool[Array, ""]:
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


def reduced(
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


def closest(
    position: Float[Array, "n d"],
    side: ArrayLike,
    replicas: int,
    capacity: tuple[int, int],
    by: str = "scipy",
) -> Float[Array, ""]:
    """The least distance between two spheres, in diameters; 1 if none is below.

    Args:
        position, side, replicas, by: as in `neighbours.find_pairs`.
        capacity: numbers of overlapping pairs, and of particles that a sweep looks ahead.
    """
    found = neighbours.search(position, side, 1.0, replicas, capacity, by)
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
