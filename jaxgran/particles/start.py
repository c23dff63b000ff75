"""Initial conditions of particle runs.

A random start has Maxwellian velocities and random positions without overlap (`Placement`). A start
given by a user is checked and reduced to the units of the run.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced
from jaxgran.data.particles import Particles
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import AbstractProcess
from jaxgran.particles.neighbours.lists import search_pairs
from jaxgran.particles.neighbours.pairs import with_offsets
from jaxgran.particles.snapshot import box_side
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.gas import Gas
from jaxgran.scene.geometry import PACKING_LIMIT, sphere_surface, wrap
from jaxgran.scene.walls import Walls

GAP = 1e-3
"""Smallest distance, in diameters, between the surfaces to which a pair is pushed apart."""

LARGEST_EXTRA_GAP = 0.1
"""Largest random gap in addition, in a dilute gas. With equal gaps all pairs that were pushed would
touch again at the same moment."""

GOLDEN_RATIO = 0.618
"""Change of the random numbers of the gaps from push to push."""

MAX_PUSHES = 20_000
"""Largest number of pushes of all overlapping pairs."""

COINCIDENT = 1e-9
"""Distance, in diameters, that is assumed between points at the same place."""

SAME_BOX = 1e-6
"""Relative difference up to which a start is taken to have the box of the gas."""


def maxwellian_velocities(
    key: PRNGKeyArray, shape: tuple[int, int, int]
) -> Float[Array, "particles d"]:
    """Draw Maxwellian velocities with zero momentum and exactly ``<v^2>/d = 1`` in each replica.

    Args:
        key: of the random numbers.
        shape: number of replicas, of particles in each, and dimension d.
    """
    v = jax.random.normal(key, shape, jnp.result_type(float))
    return normalised_velocities(v.reshape(-1, shape[2]), shape[0])


def normalised_velocities(
    velocity: Float[Array, "particles d"], replicas: int
) -> Float[Array, "particles d"]:
    """Shift and scale velocities to zero momentum and unit temperature in every replica."""
    v = velocity.reshape(replicas, -1, velocity.shape[-1])
    v = v - jnp.mean(v, axis=1, keepdims=True)
    v = v / jnp.sqrt(jnp.mean(v**2, axis=(1, 2), keepdims=True))
    return v.reshape(velocity.shape)


def maxwellian_spins(
    key: PRNGKeyArray, shape: tuple[int, int, int], mean_square: Float[Array, ""]
) -> Float[Array, "replicas N spins"]:
    """Draw Maxwellian spins with a given mean square of each component in each replica."""
    spins = jax.random.normal(key, shape, mean_square.dtype)
    size = jnp.sqrt(mean_square / jnp.mean(spins**2, axis=(1, 2), keepdims=True))
    return size * spins


def initial_spins(
    key: PRNGKeyArray, shape: tuple[int, int, int], mean_square: Float[Array, ""]
) -> Float[Array, "particles spins"]:
    """Draw the spins of all spheres at t = 0, see `maxwellian_spins`.

    Args:
        key: of the random numbers of the run.
        shape: number of replicas, of particles in each, and dimension d.
        mean_square: of each component.
    """
    replicas, num_particles, dimension = shape
    components = NUM_SPIN_COMPONENTS[dimension]
    key = jax.random.fold_in(key, 2)  # positions and velocities have other keys
    spins = maxwellian_spins(key, (replicas, num_particles, components), mean_square)
    return spins.reshape(-1, components)


class PlacementState(NamedTuple):
    """Spheres that are pushed apart.

    Attributes:
        time, status, needed: see `AbstractProcess`; the time is 0 to the end.
        position: in the box, replica after replica.
        share: a random number of each sphere, in [0, 1), for its gaps.
        num_pushes: number of pushes.
        overlap: whether any pair overlapped at the last push.
    """

    time: Float[Array, ""]
    status: Int[Array, ""]
    needed: Int[Array, "kinds"]
    position: Float[Array, "particles d"]
    share: Float[Array, "particles"]
    num_pushes: Int[Array, ""]
    overlap: Bool[Array, ""]


class Placement(AbstractProcess):
    """Random places of unit spheres without overlap, in periodic boxes.

    The spheres begin at uniform random points. Then all overlapping pairs are pushed apart, both
    spheres by the same distance, and again until no overlap is left. For a dilute gas the result is
    close to equilibrium; a dense gas should be equilibrated afterwards. The pushes do not depend on
    the order in which pairs are found.

    Attributes:
        side: of the boxes in diameters.
        region: sides of the region, which begins at 0, of the positions, each at least a diameter
            less than the side of the box; None for the whole box.
        skin: of the neighbour list.
        shape: number of boxes, of spheres in each, and dimension.
        capacity: of the neighbour list.
        engine: see `neighbours.lists.search_pairs`; one that works in compiled code.
    """

    side: Float[Array, ""]
    region: Float[Array, "d"] | None
    skin: Float[Array, ""]
    shape: tuple[int, int, int] = eqx.field(static=True)
    capacity: Capacity = eqx.field(static=True)
    engine: str = eqx.field(static=True)

    @property
    def calls_host(self) -> bool:
        """False: the engine works in compiled code."""
        return False

    def initial(self, key: PRNGKeyArray) -> PlacementState:
        """Return spheres at uniform random points."""
        replicas, num_particles, dimension = self.shape
        size = replicas * num_particles, dimension + 1
        uniform = jax.random.uniform(key, size, jnp.result_type(float))
        sides = jnp.broadcast_to(self.side, (dimension,)) if self.region is None else self.region
        return PlacementState(
            time=jnp.zeros((), uniform.dtype),
            status=jnp.zeros((), jnp.int32),
            needed=jnp.zeros(len(self.capacity), jnp.int32),
            position=uniform[:, :dimension] * sides[None],
            share=uniform[:, dimension],
            num_pushes=jnp.zeros((), jnp.int32),
            overlap=jnp.ones((), bool),
        )

    def unfinished(self, state: PlacementState, until: ArrayLike) -> Bool[Array, ""]:
        return state.overlap & (state.status == status.OK)

    def advance(self, state: PlacementState, until: ArrayLike) -> PlacementState:
        """Build a neighbour list, and push until it is stale or no overlap is left."""
        side = self.side
        replicas, num_particles, dimension = self.shape
        built = wrap(state.position, side)
        listed = search_pairs(
            built,
            side,
            1 + self.skin,
            replicas=replicas,
            capacity=self.capacity.pairs,
            ahead=self.capacity.lookahead,
            engine=self.engine,
        )
        pairs = with_offsets(built, side, listed)
        needed = jnp.zeros_like(state.needed).at[:2].set(jnp.stack([pairs.count, pairs.lookahead]))
        full = self.capacity.exceeded_by(needed)
        volume = side**dimension if self.region is None else jnp.prod(self.region + 1)
        per_sphere = sphere_surface(dimension) / dimension / 2**dimension
        packing_fraction = num_particles * per_sphere / volume
        crowding = 1.5 * packing_fraction / PACKING_LIMIT[dimension]
        extra_gap = LARGEST_EXTRA_GAP * jnp.maximum(0.0, 1 - crowding)

        def is_fresh(carry: tuple) -> Array:
            state, stale = carry
            return state.overlap & ~stale & (state.num_pushes < MAX_PUSHES)

        def push_all(carry: tuple) -> tuple:
            state, _ = carry
            x = state.position
            separation = x[pairs.i] - x[pairs.j] - pairs.offset
            square = jnp.sum(separation * separation, axis=1)
            distance = jnp.sqrt(jnp.where(square > 0, square, COINCIDENT**2))
            # Coincident points are separated along the first axis.
            first_axis = jnp.zeros_like(separation).at[:, 0].set(COINCIDENT)
            separation = jnp.where((square > 0)[:, None], separation, first_axis)
            close = pairs.in_use & (distance < 1 + GAP / 2)
            shift = GOLDEN_RATIO * state.num_pushes.astype(x.dtype)
            share = state.share[pairs.i] + state.share[pairs.j] + shift
            target = 1 + GAP + extra_gap * (share - jnp.floor(share))
            size = jnp.where(close, 0.5 * (target - distance) / distance, 0.0)
            push = size[:, None] * separation
            x = x.at[pairs.i].add(push).at[pairs.j].add(-push)
            x = x if self.region is None else jnp.clip(x, 0.0, self.region[None])
            moved = jnp.sqrt(jnp.max(jnp.sum((x - built) ** 2, axis=1)))
            pushed = state._replace(
                position=x, num_pushes=state.num_pushes + 1, overlap=jnp.any(close)
            )
            return pushed, 2 * moved > self.skin - 2 * GAP

        first = state._replace(position=built), full != status.OK
        state, _ = jax.lax.while_loop(is_fresh, push_all, first)
        failed = state.overlap & (state.num_pushes >= MAX_PUSHES)
        fault = full | status.flag(status.OVERLAPS_REMAIN, failed)
        return state._replace(position=wrap(state.position, side), needed=needed, status=fault)


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
            f"start.box_side is {given} diameters, but the box of the gas has {expected}. Change "
            "packing_fraction or the start"
        )


def check_inside(start: Particles, walls: Walls, min_wall_distance: ArrayLike) -> None:
    """Raise ValueError if the centre of a sphere is too close to a wall, at 0 or at a side."""
    if any_traced(start.position, walls.side, min_wall_distance):
        return
    least = float(np.asarray(min_wall_distance))
    position = np.asarray(start.position)
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
