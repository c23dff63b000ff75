"""The interface of one kind of spheres: how they move from neighbour list to neighbour list."""

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
from jaxgran.particles import neighbours
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.neighbours import Found, Pairs
from jaxgran.particles.state import State, initial_state

MAX_IDLE = 1000
"""Blocks, or neighbour lists, in a row that may advance the time by nothing."""

MIN_FLIGHT = 1e-15
"""Flight of the fastest sphere, in diameters, below which a block advances the time by nothing."""


class Progress(NamedTuple):
    """A state on its way within one neighbour list.

    Attributes:
        state: after the last block (window) that succeeded.
        stale: whether a new neighbour list is needed.
        status: of the last block.
        needed: the most rows needed of each array of `Capacity`.
        own: what only one kind of spheres has.
    """

    state: State
    stale: Bool[Array, ""]
    status: Int[Array, ""]
    needed: Int[Array, "kinds"]
    internal: Any


class AbstractDynamics(eqx.Module):
    """How one kind of spheres moves. All lengths of arrays are static; the scene is data.

    Attributes:
        scene: numbers of the gas, in units of its diameter, mass and first temperature.
        replicas: number of boxes.
        capacity: lengths of the arrays.
    """

    scene: AbstractVar[Any]
    replicas: AbstractVar[int]
    capacity: AbstractVar[Capacity]

    @abstractmethod
    def initial_internal(self, num_rows: int, dtype: Any) -> Any:
        """`State.internal` at t = 0."""

    @abstractmethod
    def prepare(self, state: State, end: ArrayLike) -> tuple[State, Array, Array]:
        """The state ready for a new neighbour list, the positions to list, and until when."""

    @abstractmethod
    def advance(
        self, state: State, listed: Float[Array, "n d"], pairs: Pairs, end: ArrayLike
    ) -> Progress:
        """Follow the spheres to an end, or until the neighbour list is stale or a block fails."""

    @abstractmethod
    def recover(self, now: Progress, began: State) -> tuple[State, Int[Array, ""]]:
        """The state with settings that avoid a failure, and the status of what cannot be mended."""

    @abstractmethod
    def observe(self, state: State) -> dict[str, Array]:
        """The records of a state; with tangents, those of `jaxgran.gradients.rule`, too."""

    @abstractmethod
    def elastic(self) -> "AbstractDynamics":
        """The same spheres without dissipation."""

    @abstractmethod
    def with_tangents(self, state: State, directions: Any) -> State:
        """A state that does not depend on the material, with its tangents along directions."""

    @property
    def room(self) -> Float[Array, "d"] | None:
        """Lengths of the box, from 1/2 on, in which centres are placed; None for the whole box."""
        return None

    @property
    def inertial(self) -> bool:
        """Whether a run may be followed in any frame that moves at a constant velocity."""
        return True

    @property
    def preparing(self) -> "AbstractDynamics | None":
        """The same spheres in the steady state in which they begin; None if they just melt."""
        return None

    def with_kicks(self, state: State, key: PRNGKeyArray) -> State:
        """The state after the melt with what `preparing` needs: random numbers for kicks, spins."""
        return state

    def sample_spins(self, state: State, key: PRNGKeyArray, melted: State) -> State:
        """The state at t = 0 with what else is random: spins, but for those of a preparation.

        Args:
            state: so far.
            key: of the run.
            melted: the state after the melt and the preparation.
        """
        return state

    def to_lab_frame(self, state: State, velocity: Array) -> tuple[Array, Array | None]:
        """True velocities, from those of a state's kind, and spins, where spheres have some."""
        return velocity, None

    def check_start(self, state: State) -> Int[Array, ""]:
        """The status of positions given by a user."""
        return jnp.zeros((), jnp.int32)

    def begin(self, position: Array, velocity: Array, skin: ArrayLike) -> State:
        """The state at t = 0 of given positions and velocities."""
        internal = self.initial_internal(len(position), position.dtype)
        return initial_state(position, velocity, self.scene.side, skin, self.replicas, internal)

    def with_capacity(self, capacity: Capacity) -> "AbstractDynamics":
        """The same spheres in arrays of other lengths."""
        return dataclasses.replace(self, capacity=capacity)

    def run_segment(self, state: State, end: ArrayLike, engine: str) -> Progress:
        """A new neighbour list, blocks until it is stale, and what can be mended of a failure.

        The state is the last good one. A status that is not ok cannot be mended here: an array is
        too short, a number is not finite, or a step cannot become shorter.

        Args:
            state: where to start.
            end: time at which to stop.
            engine: who finds the pairs, see `neighbours.search`.
        """
        began, listed, until = self.prepare(state, end)
        cutoff, room = 1 + began.skin, self.capacity[:2]
        found = neighbours.search_pairs(
            listed, self.scene.side, cutoff, self.replicas, room, engine
        )
        return _until_stale(self, began, listed, found, until)


@jax.jit
def _until_stale(
    dynamics: AbstractDynamics, began: State, listed: Array, found: Found, until: ArrayLike
) -> Progress:
    pairs = neighbours.with_offsets(listed, dynamics.scene.side, found)
    now = dynamics.advance(began, listed, pairs, until)
    state, fault = dynamics.recover(now, began)
    return now._replace(state=state, status=fault)


def first_progress(state: State, pairs: Pairs, capacity: Capacity, internal: Any) -> Progress:
    """Before the first block within a neighbour list."""
    zero = jnp.zeros((), jnp.int32)
    needed = jnp.stack([pairs.count, pairs.lookahead, zero, zero, zero])
    return Progress(state, jnp.zeros((), bool), capacity.exceeded_by(needed), needed, internal)


def kept_if(good: Array, new: State, old: State) -> State:
    """The new state if a block succeeded, else the old one."""
    return jax.tree.map(lambda new, old: jnp.where(good, new, old), new, old)


def repeat_until(
    end: ArrayLike, block: Callable[[Progress], Progress], first: Progress
) -> Progress:
    """Blocks until the end is reached, the neighbour list is stale or a block fails.

    Blocks that do not advance the time fail in the end, too.
    """

    shortest = _shortest(first.state)

    def unfinished(carry):
        now, _ = carry
        return (now.state.time < end) & ~now.stale & (now.status == status.OK)

    def further(carry):
        old, idle = carry
        new = block(old)
        idle = jnp.where(_passed(old.state, new.state) > shortest, 0, idle + 1)
        stalled = status.flag(status.STALLED, idle >= MAX_IDLE)
        return new._replace(status=new.status | stalled), idle

    return jax.lax.while_loop(unfinished, further, (first, jnp.zeros((), jnp.int32)))[0]


def _passed(old: State, new: State) -> Float[Array, ""]:
    """The time from one state to another."""
    return (new.time - old.time) + (new.time_rest - old.time_rest)


def _shortest(state: State) -> Float[Array, ""]:
    """The time in which the fastest sphere of a state flies `SHORTEST_FLIGHT`; 0 at rest."""
    speed = jnp.sqrt(jnp.max(jnp.sum(state.velocity * state.velocity, -1)))
    return jnp.where(speed > 0, MIN_FLIGHT / jnp.where(speed > 0, speed, 1.0), 0.0)


def run_segments(
    dynamics: AbstractDynamics,
    state: State,
    end: ArrayLike,
    engine: str,
    least: int,
    most: int | None = None,
    fault: ArrayLike = status.OK,
) -> tuple[State, Array, Array]:
    """Stretches until an end, at least and at most so many, or until one fails.

    Returns:
        The state after the last good stretch, the status of the last, and the most rows needed.
    """

    def unfinished(carry):
        made, _, state, fault, _ = carry
        going = (made < least) | (state.time < end)
        if most is not None:
            going &= made < most
        return going & (fault == status.OK)

    def further(carry):
        made, idle, state, _, needed = carry
        now = dynamics.run_segment(state, end, engine)
        idle = jnp.where(_passed(state, now.state) > _shortest(state), 0, idle + 1)
        fault = now.status | status.flag(status.STALLED, idle >= MAX_IDLE)
        kept = jax.tree.map(partial(jnp.where, now.status == status.OK), now.state, state)
        return made + 1, idle, kept, fault, jnp.maximum(needed, now.needed)

    zero, needed = jnp.zeros((), jnp.int32), jnp.zeros(len(dynamics.capacity), jnp.int32)
    begin = zero, zero, state, jnp.asarray(fault, jnp.int32), needed
    return jax.lax.while_loop(unfinished, further, begin)[2:]
