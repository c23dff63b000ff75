"""The interface of a kind of particles: soft spheres, hard spheres, and DSMC.

`jaxgran.particles.run` moves any of them through the times of its records.
"""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxgran.gradients.rule import Records
from jaxgran.particles.capacity import Capacity

P = TypeVar("P", bound="AbstractProcess")


def time_left(state: Any, until: ArrayLike) -> Float[Array, "..."]:
    """Return the time from a state, with the fields `time` and `time_rest`, to another time."""
    return (jnp.asarray(until) - state.time) - state.time_rest


def advance_time(state: Any, duration: ArrayLike) -> Any:
    """Advance the time of a state by a duration: `time_rest` is its rounding error."""
    passed = state.time_rest + duration
    time = state.time + passed
    return state._replace(time=time, time_rest=passed - (time - state.time))


class AbstractProcess(eqx.Module):
    """What moves a state in time, by calls of bounded work.

    A state is a named tuple of arrays, of which the loops around a process read

    - `time`, which all replicas have reached;
    - `status`, the faults of all replicas together or of each, see `jaxgran._utils.status`. A
      state in which all have faults does not move any more;
    - `needed`, where arrays can be too short: rows that each array of `Capacity` would have needed.

    Attributes:
        shape: number of replicas, of particles in each, and dimension d.
        capacity: lengths of the arrays; None if they do not depend on the run.
    """

    shape: AbstractVar[tuple[int, int, int]]
    capacity: AbstractVar[Capacity | None]

    @property
    @abstractmethod
    def calls_host(self) -> bool:
        """True if `advance` takes known numbers only, and is not compiled as a whole."""

    @abstractmethod
    def unfinished(self, state: Any, until: ArrayLike) -> Bool[Array, ""]:
        """Return whether a state has still to be moved to reach a time."""

    @abstractmethod
    def advance(self, state: Any, until: ArrayLike) -> Any:
        """Move a state towards a time, not beyond it, by a bounded amount of work.

        A state that is not `unfinished` stays as it is.
        """

    def with_capacity(self: P, capacity: Capacity) -> P:
        """Return the same process with other lengths of arrays."""
        return dataclasses.replace(self, capacity=capacity)

    def described(self) -> dict[str, Any]:
        """Return all that decides what a process does: its fields but for lengths of arrays."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        known = {name: x for name, x in values.items() if not isinstance(x, Capacity)}
        return {"kind": type(self).__name__} | known


class AbstractDynamics(AbstractProcess):
    """A gas of particles in reduced units: how it begins, moves and is observed.

    Attributes:
        scene: numbers of the gas in reduced units.
    """

    scene: AbstractVar[Any]

    @abstractmethod
    def random_start(self, key: Any, each: Callable, reach: Callable) -> Any:
        """Return random positions and velocities, and their status; None if `initial` draws them.

        Args:
            key: of the random numbers, one for each group of replicas.
            each: ``each(function, shared, group)`` calls a function of the module for every group,
                with an input that all groups share and the inputs of each.
            reach: ``reach(stages, state)`` moves a state through processes in turn, each until a
                time.
        """

    @property
    @abstractmethod
    def equilibrium(self) -> Any:
        """All that the places of a random start depend on, but for its key."""

    @abstractmethod
    def with_new_velocities(self, start: Any, key: Any) -> Any:
        """Return a random start with other velocities."""

    @abstractmethod
    def initial(self, start: Any, key: Any, directions: Any) -> Any:
        """Return the state at t = 0.

        Args:
            start: positions and velocities.
            key: of the random numbers.
            directions: of tangents in the material, stacked along a first axis of each leaf; None
                for no tangents.
        """

    @abstractmethod
    def observe(self, state: Any) -> Records:
        """Return the records of a state, with rates and tangents if it has tangents."""

    @abstractmethod
    def to_lab_frame(self, state: Any) -> tuple[Array, Array, Array | None]:
        """Return positions in the box, true velocities and spins in the frame of the start.

        Spins are None if no particle rotates, positions are nan if particles have none.
        """
