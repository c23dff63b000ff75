"""Dynamics of soft or hard spheres: the interface, and the loops over neighbour lists.

A segment of a run is what can be computed with one neighbour list. It consists of blocks of time
steps (soft spheres) or windows of impacts (hard spheres).
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from jaxgran._utils import status
from jaxgran.gradients.rule import Records
from jaxgran.particles import neighbours
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.neighbours import ListedPairs, Pairs
from jaxgran.particles.state import State
from jaxgran.scene.gas import SphereScene

MAX_STALLED = 1000
"""Largest number of blocks or segments in a row that do not advance the time."""

FATAL = (
    status.LIST_FULL.bit
    | status.CONTACTS_FULL.bit
    | status.NOT_FINITE.bit
    | status.STALLED.bit
    | status.ENERGY_DRIFT.bit
)
"""Faults from which `AbstractDynamics.recover` does not recover."""

MIN_FLIGHT = 1e-15
"""Flight of the fastest sphere, in diameters, below which the time counts as not advanced."""


class Progress(NamedTuple):
    """Progress of a run within one segment.

    Attributes:
        state: state after the last block (window) that succeeded.
        stale: whether a new neighbour list is needed.
        status: status of the last block.
        needed: largest number of rows needed in each array of `Capacity`.
        internal: further fields of soft or of hard spheres.
    """

    state: State
    stale: Bool[Array, ""]
    status: Int[Array, ""]
    needed: Int[Array, "kinds"]
    internal: Any


class AbstractDynamics(eqx.Module):
    """Dynamics of one kind of spheres. The lengths of arrays are static, and the scene is data.

    Attributes:
        scene: numbers of the gas, in units of its diameter, mass and initial temperature.
        replicas: number of boxes.
        capacity: lengths of the arrays.
    """

    scene: AbstractVar[SphereScene]
    replicas: AbstractVar[int]
    capacity: AbstractVar[Capacity]

    @abstractmethod
    def initial_internal(self, num_rows: int, dtype: Any) -> Any:
        """Return `State.internal` at t = 0."""

    @abstractmethod
    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, Array]:
        """Return the state for a new neighbour list, the positions to list, and its last time."""

    @abstractmethod
    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        """Move the spheres to an end, or until the neighbour list is stale or a block fails."""

    @abstractmethod
    def recover(self, now: Progress, before: State) -> tuple[State, Int[Array, ""]]:
        """Change settings of the state to avoid a failure, if possible.

        Args:
            now: progress at the end of a segment.
            before: state at its beginning.

        Returns:
            The state, and the status with the faults that cannot be avoided.
        """

    @abstractmethod
    def observe(self, state: State) -> Records:
        """Return the records of a state."""

    @abstractmethod
    def elastic(self) -> "AbstractDynamics":
        """Return the dynamics without dissipation."""

    @abstractmethod
    def with_tangents(self, state: State, directions: Any) -> State:
        """Add tangents along directions in the material to a state independent of the material."""

    @abstractmethod
    def sample_spins(self, state: State, key: PRNGKeyArray) -> State:
        """Draw the random fields of a state at t = 0: the spins, and the key of a drive."""

    @abstractmethod
    def to_lab_frame(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        """Return true velocities and spins, None without spins, from stored velocities."""

    @property
    def region(self) -> Float[Array, "d"] | None:
        """Sides of the region, which begins at 1/2, of the centres; None for the whole box."""
        return None if self.scene.container is None else self.scene.container - 1

    def invalid_block(self, new: State, needed: Int[Array, "kinds"]) -> Int[Array, ""]:
        """Return the status of a block that lacks pairs or particles, or is not finite."""
        list_status = self.capacity.exceeded_by(needed)
        finite = jnp.isfinite(jnp.sum(new.velocity)) & jnp.isfinite(jnp.sum(new.position))
        not_finite = jnp.where(finite, status.OK, status.NOT_FINITE.bit)
        return jnp.where(list_status > 0, list_status, not_finite)

    def check_start(self, state: State) -> Int[Array, ""]:
        """Return the status of positions given by a user."""
        return jnp.zeros((), jnp.int32)

    def begin(self, position: Array, velocity: Array, skin: ArrayLike) -> State:
        """Return the state at t = 0 with given positions and velocities."""
        dtype, inside = position.dtype, neighbours.wrap(self.scene.side, position)
        return State(
            time=jnp.zeros((), dtype),
            time_rest=jnp.zeros((), dtype),
            position=inside,
            velocity=velocity,
            image=jnp.zeros(position.shape, jnp.int32),
            origin=inside,
            first_velocity=velocity,
            dissipated=jnp.zeros(self.replicas, dtype),
            collisions=jnp.zeros(self.replicas, jnp.result_type(int)),
            skin=jnp.asarray(skin, dtype),
            internal=self.initial_internal(len(position), dtype),
        )

    def with_capacity(self, capacity: Capacity) -> "AbstractDynamics":
        """Return the same dynamics with other lengths of arrays."""
        return dataclasses.replace(self, capacity=capacity)

    def run_segment(self, state: State, end: ArrayLike, engine: str) -> Progress:
        """Build a neighbour list, run blocks until it is stale, and recover from a failure.

        The state is the last good one. If the status is not ok, `recover` was not possible: an
        array is too short, a number is not finite, or a step cannot become shorter.

        Args:
            state: state at the beginning.
            end: time at which to stop.
            engine: one of `neighbours.ENGINES`, but not "auto".
        """
        before, listed, until = self.prepare(state, end)
        cutoff, sizes = 1 + before.skin, self.capacity[:2]
        result = neighbours.search_pairs(
            listed, self.scene.side, cutoff, self.replicas, sizes, engine
        )
        return _run_until_stale(self, before, listed, result, until)


@jax.jit
def _run_until_stale(
    dynamics: AbstractDynamics, before: State, listed: Array, result: ListedPairs, until: ArrayLike
) -> Progress:
    pairs = neighbours.with_offsets(listed, dynamics.scene.side, result)
    now = dynamics.advance(before, listed, pairs, until)
    state, fault = dynamics.recover(now, before)
    return now._replace(state=state, status=fault)


def initial_progress(state: State, pairs: Pairs, capacity: Capacity, internal: Any) -> Progress:
    """Return the progress before the first block of a segment."""
    zero = jnp.zeros((), jnp.int32)
    needed = jnp.stack([pairs.count, pairs.lookahead, zero, zero, zero])
    return Progress(state, jnp.zeros((), bool), capacity.exceeded_by(needed), needed, internal)


def repeat_until(
    end: ArrayLike, block: Callable[[Progress], Progress], first: Progress
) -> Progress:
    """Run blocks until the end is reached, the neighbour list is stale or a block fails.

    A run of `MAX_STALLED` blocks that do not advance the time is a failure, too.
    """
    min_duration = _min_duration(first.state)

    def unfinished(carry):
        now, _ = carry
        return (now.state.time < end) & ~now.stale & (now.status == status.OK)

    def run_block(carry):
        old, num_stalled = carry
        new = block(old)
        advanced = _elapsed(old.state, new.state) > min_duration
        num_stalled = jnp.where(advanced, 0, num_stalled + 1)
        stalled = status.flag(status.STALLED, num_stalled >= MAX_STALLED)
        return new._replace(status=new.status | stalled), num_stalled

    return jax.lax.while_loop(unfinished, run_block, (first, jnp.zeros((), jnp.int32)))[0]


def _elapsed(old: State, new: State) -> Float[Array, ""]:
    return (new.time - old.time) + (new.time_rest - old.time_rest)


def _min_duration(state: State) -> Float[Array, ""]:
    """Return the time in which the fastest sphere flies `MIN_FLIGHT`; 0 for spheres at rest."""
    speed = jnp.sqrt(jnp.max(jnp.sum(state.velocity * state.velocity, -1)))
    return jnp.where(speed > 0, MIN_FLIGHT / jnp.where(speed > 0, speed, 1.0), 0.0)


def run_segments(
    dynamics: AbstractDynamics,
    state: State,
    end: ArrayLike,
    engine: str,
    min_segments: ArrayLike,
    max_segments: int | None = None,
    fault: ArrayLike = status.OK,
) -> tuple[State, Array, Array]:
    """Run segments until an end, or until one fails.

    Args:
        dynamics: of the spheres.
        state: state at the beginning.
        end: time at which to stop.
        engine: see `AbstractDynamics.run_segment`.
        min_segments: least number of segments, even if the end is reached.
        max_segments: largest number of segments; None for no limit.
        fault: status before; no segment is run unless it is ok.

    Returns:
        The state after the last good segment, the status of the last segment, and the largest
        number of rows needed in each array.
    """

    def unfinished(carry):
        num_segments, _, state, fault, _ = carry
        due = (num_segments < min_segments) | (state.time < end)
        if max_segments is not None:
            due &= num_segments < max_segments
        return due & (fault == status.OK)

    def run_one(carry):
        num_segments, num_stalled, old, _, needed = carry
        now = dynamics.run_segment(old, end, engine)
        advanced = _elapsed(old, now.state) > _min_duration(old)
        num_stalled = jnp.where(advanced, 0, num_stalled + 1)
        fault = now.status | status.flag(status.STALLED, num_stalled >= MAX_STALLED)
        state = jax.tree.map(partial(jnp.where, now.status == status.OK), now.state, old)
        return num_segments + 1, num_stalled, state, fault, jnp.maximum(needed, now.needed)

    zero, needed = jnp.zeros((), jnp.int32), jnp.zeros(len(dynamics.capacity), jnp.int32)
    carry = zero, zero, state, jnp.asarray(fault, jnp.int32), needed
    return jax.lax.while_loop(unfinished, run_one, carry)[2:]
