"""Spheres in boxes: the state and the motion that soft and hard spheres share.

Units: the diameter, the mass and the initial temperature are 1. One array holds the particles of
all replicas, replica after replica (n = replicas * N rows).

A segment of a run is what can be computed with one neighbour list. It consists of blocks of time
steps (soft spheres) or windows of impacts (hard spheres).
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran._utils import status
from jaxgran.particles import observables
from jaxgran.particles.capacity import Capacity, skin_for_pairs
from jaxgran.particles.dynamics import AbstractDynamics, advance_time, time_left
from jaxgran.particles.neighbours.lists import search_pairs
from jaxgran.particles.neighbours.pairs import ListedPairs, Pairs, with_offsets
from jaxgran.particles.start import (
    Placement,
    PlacementState,
    maxwellian_velocities,
    normalised_velocities,
)
from jaxgran.scene.elements import NUM_SPIN_COMPONENTS
from jaxgran.scene.geometry import MIN_BOX, wrap
from jaxgran.scene.reduced import SphereScene

S = TypeVar("S", bound="AbstractSphereDynamics")

EQUILIBRATION_COLLISIONS = 10.0
"""Duration of the equilibration, in mean free times."""

MAX_EQUILIBRATION = 2e4
"""Longest equilibration, in diameters over the thermal speed. It takes effect below a packing
fraction of 6e-5. There random positions are distributed as in a gas, apart from a share of this
size, and flights through many boxes would take minutes."""

SETTLING_COLLISIONS = 2.0
"""Mean free times of equilibration after which the capacity of the run is sufficient."""

SEGMENTS_PER_CALL = 8
"""Largest number of segments in one call of `AbstractSphereDynamics.advance`."""

MAX_STALLED = 1000
"""Largest number of blocks or segments in a row that do not advance the time."""

FATAL = (
    status.LIST_FULL.bit
    | status.CONTACTS_FULL.bit
    | status.NOT_FINITE.bit
    | status.STALLED.bit
    | status.ENERGY_DRIFT.bit
    | status.OVERLAPPING.bit
)
"""Faults from which `AbstractSphereDynamics.recover` does not recover."""

MIN_FLIGHT = 1e-15
"""Flight of the fastest sphere, in diameters, below which the time counts as not advanced."""


class SphereState(NamedTuple):
    """Spheres of all replicas at one time.

    Attributes:
        time: time t.
        time_rest: rounding error of `time`, to be added to it. With it even the shortest steps in
            single precision are summed correctly.
        position: positions, which are wrapped into the box when a neighbour list is built.
        velocity: velocities, in the frame in which each replica is at rest at t = 0, or in the
            frame of walls and drag.
        image: number of box sides that wrapping has subtracted from each position.
        origin: positions at t = 0.
        first_velocity: velocities at t = 0.
        drift: velocity of that frame in the frame of the start.
        dissipated: energy lost since t = 0.
        collisions: number of collisions that began since t = 0; each pair counts once.
        skin: skin of the neighbour list.
        fresh: True until the first segment, which counts the energy in contacts.
        stalled: number of segments in a row that did not advance the time.
        status: faults of the last segment.
        needed: rows that each array of `Capacity` needed in the last segment.
        internal: further fields of soft or of hard spheres.
        tangents: derivatives of the state; None without them.
    """

    time: Float[Array, ""]
    time_rest: Float[Array, ""]
    position: Float[Array, "n d"]
    velocity: Float[Array, "n d"]
    image: Int[Array, "n d"]
    origin: Float[Array, "n d"]
    first_velocity: Float[Array, "n d"]
    drift: Float[Array, "replicas d"]
    dissipated: Float[Array, "replicas"]
    collisions: Int[Array, "replicas"]
    skin: Float[Array, ""]
    fresh: Bool[Array, ""]
    stalled: Int[Array, ""]
    status: Int[Array, ""]
    needed: Int[Array, "kinds"]
    internal: Any
    tangents: Any = None


class Segment(NamedTuple):
    """What is known within one segment.

    Attributes:
        state: state after the last block (window) that succeeded, with the status of the last one
            and the largest number of rows needed.
        stale: whether a new neighbour list is needed.
        retry: what soft or hard spheres change when they repeat a block: a factor on the bound of
            speeds (hard), `SoftRetry` (soft).
    """

    state: SphereState
    stale: Bool[Array, ""]
    retry: Any


class AbstractSphereDynamics(AbstractDynamics):
    """Spheres in boxes, which move in segments.

    Attributes:
        scene: numbers of the gas, in units of its diameter, mass and initial temperature.
        shape: number of boxes, of spheres in each, and dimension d.
        capacity: lengths of the arrays.
        equilibration_capacity: the same in the first mean free times of the equilibration.
        listed_by_skin: pairs per particle that the skin adds to the first neighbour list.
        engine: search for pairs, one of `neighbours.lists.ENGINES` but not "auto".
        compiled_engine: the same in compiled code, as in the random placement.
    """

    scene: AbstractVar[SphereScene]
    capacity: AbstractVar[Capacity]
    equilibration_capacity: AbstractVar[Capacity]
    listed_by_skin: AbstractVar[float]
    engine: AbstractVar[str]
    compiled_engine: AbstractVar[str]

    @abstractmethod
    def elastic(self: S) -> S:
        """Return the dynamics of smooth spheres without dissipation."""

    @abstractmethod
    def initial_internal(self, velocity: Float[Array, "n d"], key: PRNGKeyArray) -> Any:
        """Return `SphereState.internal` at t = 0."""

    @abstractmethod
    def initial_tangents(self, state: SphereState, directions: Any) -> Any:
        """Return `SphereState.tangents` at t = 0 along directions in the material."""

    @abstractmethod
    def prepare(self, state: SphereState, end: ArrayLike) -> tuple[SphereState, Array, Array]:
        """Prepare a new neighbour list.

        Returns:
            The state with wrapped positions, the positions for which the list is built, and the
            time until which it is used, at most `end`.
        """

    @abstractmethod
    def run_blocks(
        self, state: SphereState, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Segment:
        """Move the spheres to an end, or until the neighbour list is stale or a block fails."""

    @abstractmethod
    def recover(self, now: Segment, before: SphereState) -> SphereState:
        """Change settings of the state to avoid a failure, if possible.

        Args:
            now: at the end of a segment.
            before: state at its beginning.

        Returns:
            The state, whose status has the faults that cannot be avoided.
        """

    @abstractmethod
    def true_velocities(self, state: SphereState) -> tuple[Array, Array | None]:
        """Return true velocities and spins from stored ones; None without spins."""

    @property
    def replicas(self) -> int:
        """Number of boxes."""
        return self.shape[0]

    @property
    def calls_host(self) -> bool:
        """True if pairs are found by jax-md, which takes known numbers only."""
        return self.engine == "jax-md"

    @property
    def region(self) -> Float[Array, "d"] | None:
        """Sides of the region, which begins at 1/2, of the centres; None for the whole box."""
        return None if self.scene.container is None else self.scene.container - 1

    @property
    def first_skin(self) -> Float[Array, ""]:
        """Skin of the first neighbour list."""
        _, num_particles, dimension = self.shape
        return skin_for_pairs(self.listed_by_skin, num_particles, self.scene.filled_side, dimension)

    def random_start(self, key: Any, each: Callable, reach: Callable) -> Any:
        """Return the positions and velocities of a fluid, after elastic motion, and the status."""
        placed = reach([(self.placement(), 0.0)], each(_begin_placement, self, key))
        elastic = self.elastic()
        crowded = elastic.with_capacity(self.equilibration_capacity)
        state = each(_begin_equilibration, crowded, (placed, key))
        frequency = self.scene.collision_frequency
        end = jnp.minimum(EQUILIBRATION_COLLISIONS / frequency, MAX_EQUILIBRATION)
        settled = jnp.minimum(SETTLING_COLLISIONS / frequency, end)
        state = reach([(crowded, settled), (elastic, end)], state)
        return each(_at_rest, self, state)

    @property
    def equilibrium(self) -> Any:
        """Elastic spheres of no law, with what equilibrates them."""
        return self.elastic().described()

    def with_new_velocities(self, start: Any, key: PRNGKeyArray) -> Any:
        """Return a start at the same places: in equilibrium velocities do not depend on them."""
        position, _ = start
        return position, _first_velocities(key, self.shape)

    def placement(self) -> Placement:
        """Return the random placement of the spheres."""
        return Placement(
            side=self.scene.side,
            region=self.region,
            skin=self.first_skin,
            shape=self.shape,
            capacity=self.equilibration_capacity,
            engine=self.compiled_engine,
        )

    def initial(self, start: Any, key: Any, directions: Any) -> SphereState:
        """Return the state at t = 0 with given positions and velocities, and its tangents."""
        position, velocity = start
        dtype = position.dtype
        inside = wrap(position, self.scene.side)
        drift = jnp.zeros((self.replicas, position.shape[1]), dtype)
        if self.scene.galilean_invariant:
            drift = jnp.mean(by_replica(velocity, self.replicas), axis=1)
            velocity = velocity - self.by_sphere(drift)
        state = SphereState(
            time=jnp.zeros((), dtype),
            time_rest=jnp.zeros((), dtype),
            position=inside,
            velocity=velocity,
            image=jnp.zeros(position.shape, jnp.int32),
            origin=inside,
            first_velocity=velocity,
            drift=drift,
            dissipated=jnp.zeros(self.replicas, dtype),
            collisions=jnp.zeros(self.replicas, jnp.result_type(int)),
            skin=jnp.asarray(self.first_skin, dtype),
            fresh=jnp.ones((), bool),
            stalled=jnp.zeros((), jnp.int32),
            # In a smaller box a neighbour list is stale at once, and the run would not end.
            status=status.flag(status.BOX_TOO_SMALL, self.scene.side < MIN_BOX),
            needed=jnp.zeros(len(self.capacity), jnp.int32),
            internal=self.initial_internal(velocity, key),
        )
        if directions is None:
            return state
        return state._replace(tangents=self.initial_tangents(state, directions))

    def by_sphere(self, values: Float[Array, "replicas d"]) -> Float[Array, "n d"]:
        """Return values of replicas, repeated for each of their spheres."""
        return jnp.repeat(values, self.shape[1], axis=0)

    def unfinished(self, state: SphereState, until: ArrayLike) -> Bool[Array, ""]:
        return (state.status == status.OK) & (state.fresh | (state.time < until))

    def advance(self, state: SphereState, until: ArrayLike) -> SphereState:
        """Run segments until a time, at most `SEGMENTS_PER_CALL`; one if the host finds pairs."""
        if self.calls_host:
            return self.run_segment(state, until) if self.unfinished(state, until) else state

        def unfinished(carry: tuple) -> Array:
            num_segments, state = carry
            return (num_segments < SEGMENTS_PER_CALL) & self.unfinished(state, until)

        def run_one(carry: tuple) -> tuple:
            num_segments, state = carry
            return num_segments + 1, self.run_segment(state, until)

        carry = jnp.zeros((), jnp.int32), state
        return jax.lax.while_loop(unfinished, run_one, carry)[1]

    def run_segment(self, state: SphereState, until: ArrayLike) -> SphereState:
        """Build a neighbour list, run blocks until it is stale, and recover from a failure.

        If the status of the result is not ok, recovery was not possible: an array is too short, a
        number is not finite, or a step cannot become shorter. The state is then the given one.
        """
        prepared, listed, end = self.prepare(state, until)
        found = search_pairs(
            listed,
            self.scene.side,
            1 + prepared.skin,
            replicas=self.replicas,
            capacity=self.capacity.pairs,
            ahead=self.capacity.lookahead,
            engine=self.engine,
        )
        return self._run_until_stale(state, prepared, listed, found, end)

    @jax.jit
    def _run_until_stale(
        self,
        given: SphereState,
        prepared: SphereState,
        listed: Float[Array, "n d"],
        found: ListedPairs,
        end: ArrayLike,
    ) -> SphereState:
        """Run the blocks of a segment; the given state returns after a failure."""
        pairs = with_offsets(listed, self.scene.side, found)
        needed = jnp.zeros_like(given.needed).at[:2].set(jnp.stack([pairs.count, pairs.lookahead]))
        prepared = prepared._replace(status=self.capacity.exceeded_by(needed), needed=needed)
        state = self.recover(self.run_blocks(prepared, listed, pairs, end), prepared)
        fault = state.status
        needed = state.needed
        advanced = elapsed(given, state) > min_duration(given)
        stalled = jnp.where(advanced, 0, given.stalled + 1)
        state = state._replace(fresh=jnp.zeros((), bool))
        # The whole segment is repeated with longer arrays: a list made within it has another order.
        state = jax.tree.map(partial(jnp.where, fault == status.OK), state, given)
        fault |= status.flag(status.STALLED, stalled >= MAX_STALLED)
        return state._replace(stalled=stalled, status=fault, needed=needed)

    def to_lab_frame(self, state: SphereState) -> tuple[Array, Array, Array | None]:
        drift = self.by_sphere(state.drift)
        position = wrap(state.position + drift * state.time, self.scene.side)
        velocity, spin = self.true_velocities(state)
        return position, velocity + drift, spin

    def invalid_block(self, new: SphereState, needed: Int[Array, "kinds"]) -> Int[Array, ""]:
        """Return the status of a block that lacks pairs or particles, or is not finite."""
        list_status = self.capacity.exceeded_by(needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        not_finite = jnp.where(finite, status.OK, status.NOT_FINITE.bit)
        return jnp.where(list_status > 0, list_status, not_finite)


def _begin_placement(dynamics: AbstractSphereDynamics, key: PRNGKeyArray) -> PlacementState:
    return dynamics.placement().initial(jax.random.split(key)[0])


def _begin_equilibration(
    dynamics: AbstractSphereDynamics, placed_and_key: tuple[PlacementState, PRNGKeyArray]
) -> SphereState:
    """Return the state at the places of a placement, with Maxwellian velocities."""
    placed, key = placed_and_key
    position = placed.position if dynamics.region is None else placed.position + 0.5
    velocity = _first_velocities(key, dynamics.shape)
    state = dynamics.initial((position, velocity), key, None)
    return state._replace(status=state.status | placed.status)


def _first_velocities(key: PRNGKeyArray, shape: tuple[int, int, int]) -> Float[Array, "n d"]:
    return maxwellian_velocities(jax.random.split(key)[1], shape)


def _at_rest(
    dynamics: AbstractSphereDynamics, state: SphereState
) -> tuple[tuple[Array, Array], Int[Array, ""]]:
    """Return the positions and velocities of a state, at rest and with T = 1, and its status."""
    velocity = normalised_velocities(state.velocity, dynamics.replicas)
    return (state.position, velocity), state.status


def repeat_until(end: ArrayLike, block: Callable[[Segment], Segment], first: Segment) -> Segment:
    """Run blocks until the end is reached, the neighbour list is stale or a block fails.

    A run of `MAX_STALLED` blocks that do not advance the time is a failure, too.
    """
    shortest = min_duration(first.state)

    def unfinished(carry: tuple) -> Array:
        now, _ = carry
        return (now.state.time < end) & ~now.stale & (now.state.status == status.OK)

    def run_block(carry: tuple) -> tuple:
        old, num_stalled = carry
        new = block(old)
        advanced = elapsed(old.state, new.state) > shortest
        num_stalled = jnp.where(advanced, 0, num_stalled + 1)
        fault = new.state.status | status.flag(status.STALLED, num_stalled >= MAX_STALLED)
        return new._replace(state=new.state._replace(status=fault)), num_stalled

    return jax.lax.while_loop(unfinished, run_block, (first, jnp.zeros((), jnp.int32)))[0]


def elapsed(old: SphereState, new: SphereState) -> Float[Array, ""]:
    """Return the time between two states."""
    return (new.time - old.time) + (new.time_rest - old.time_rest)


def min_duration(state: SphereState) -> Float[Array, ""]:
    """Return the time in which the fastest sphere flies `MIN_FLIGHT`; 0 for spheres at rest."""
    speed = fastest(state.velocity, 1)[0]
    return jnp.where(speed > 0, MIN_FLIGHT / jnp.where(speed > 0, speed, 1.0), 0.0)


def next_block(
    state: SphereState, longest: Float[Array, ""], end: ArrayLike
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Return the duration of the next of equal blocks until an end, and whether it is the last."""
    duration = time_left(state, end)
    # Rounding errors of a whole number of blocks do not make one more.
    num_left = jnp.maximum(jnp.ceil(duration / longest * (1 - 1e-9)), 1.0)
    return duration / num_left, num_left <= 1


def advance_to_end(
    state: SphereState, duration: ArrayLike, end: ArrayLike, is_last: ArrayLike
) -> SphereState:
    """Advance the time of a state by a block, the last one of which leads exactly to the end."""
    later = advance_time(state, duration)
    return later._replace(
        time=jnp.where(is_last, end, later.time),
        time_rest=jnp.where(is_last, 0.0, later.time_rest),
    )


def by_replica(values: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas N d"]:
    """Return values of all spheres with an axis of replicas."""
    return values.reshape(replicas, -1, values.shape[-1])


def centred(values: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas N d"]:
    """Return values minus their mean over each replica."""
    values = by_replica(values, replicas)
    return values - jnp.mean(values, axis=1, keepdims=True)


def peculiar_velocity(
    scene: SphereScene, velocity: Float[Array, "n d"], replicas: int
) -> Float[Array, "replicas N d"]:
    """Return velocities in the frame of each centre of mass, or in the frame of the walls."""
    if scene.container is None:
        return centred(velocity, replicas)
    return by_replica(velocity, replicas)


def temperature(velocity: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas"]:
    """Return T of each replica."""
    return observables.temperature(centred(velocity, replicas))


def kinetic_energy(velocity: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas"]:
    """Return the kinetic energy of each replica in the frame of the velocities."""
    return 0.5 * jnp.sum(velocity.reshape(replicas, -1) ** 2, axis=-1)


def fastest(velocity: Float[Array, "n d"], replicas: int) -> Float[Array, "replicas"]:
    """Return the speed of the fastest sphere of each replica."""
    return jnp.sqrt(jnp.max(jnp.sum(velocity * velocity, -1).reshape(replicas, -1), axis=-1))


def common_values(
    state: SphereState, scene: SphereScene, replicas: int
) -> tuple[dict[str, Array], Float[Array, "replicas N d"]]:
    """Return the records that soft and hard spheres share, and peculiar velocities.

    Walls bound displacements, and there are no periodic waves between them: these records are left
    out.
    """
    velocity = peculiar_velocity(scene, state.velocity, replicas)
    first = peculiar_velocity(scene, state.first_velocity, replicas)
    num_particles = velocity.shape[1]
    values = {
        "temperature": observables.temperature(velocity),
        "sonine": observables.sonine(velocity),
        "velocity_correlation": observables.velocity_correlation(first, velocity),
        "dissipated_energy": state.dissipated / num_particles,
        "collisions": 2 / num_particles * state.collisions.astype(jnp.result_type(float)),
    }
    if scene.container is None:
        boxes = state.image.astype(state.position.dtype)
        travelled = centred(state.position - state.origin + scene.side * boxes, replicas)
        flow_share = jax.vmap(partial(observables.flow_share, side=scene.side))
        values["displacement"] = observables.mean_square_displacement(travelled)
        values["flow_share"] = flow_share(state.position.reshape(velocity.shape), velocity)
    return values, velocity


def with_dissipated_energy(slopes: dict[str, Array], dimension: int) -> dict[str, Array]:
    """Return derivatives with the derivative of the dissipated energy, by the energy balance."""
    inside = 0.5 * dimension * slopes["temperature"] + slopes.get("elastic_energy", 0.0)
    if "rotational_temperature" in slopes:
        components = NUM_SPIN_COMPONENTS[dimension]
        inside = inside + 0.5 * components * slopes["rotational_temperature"]
    return slopes | {"dissipated_energy": -inside}
