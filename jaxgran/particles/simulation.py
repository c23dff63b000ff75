"""A run of spheres in boxes: what its two layers, `pure` and `driver`, have in common.

A gas starts from random positions and Maxwellian velocities, melts elastically, and then cools from
exactly T_0 without momentum; or it starts from what a user gives.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from jaxgran.data.curve import Particles
from jaxgran.data.run import Run
from jaxgran.data.trajectory import Sphere, Trajectory
from jaxgran.particles import initial, neighbours, relaxation, snapshot
from jaxgran.particles.capacity import Capacity
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.state import State, centred
from jaxgran.tangents.rule import Inputs, Outputs

MELT_COLLISIONS = 10.0
"""Mean free times of elastic motion before t = 0."""

PREPARED = 10.0
"""Further mean free times in a steady state, where a gas begins in one."""

SETTLED = 2.0
"""Mean free times of melting after which the capacity of the run suffices."""

SMALLEST_BOX = 2.1
"""Box side in diameters below which a sphere could touch another one and its image at once."""


class Simulation(NamedTuple):
    """A run of spheres in boxes.

    Attributes:
        dynamics: how they move; with the capacity of the run.
        melt_capacity: of the first mean free times of the melt.
        inputs: times, start and key, in reduced units.
        directions: in the material, along which tangents are followed; None for no tangents.
        num_particles: in each box.
        dimension: d.
        skin: of the first neighbour list.
        engine: who finds the pairs, see `neighbours.engine`.
        save: a user's function of the particles of a replica; None for none.
    """

    dynamics: AbstractDynamics
    melt_capacity: Capacity
    inputs: Inputs
    directions: Any
    num_particles: int
    dimension: int
    skin: ArrayLike
    engine: str
    save: Callable[[Particles], Any] | None = None

    @property
    def melts(self) -> bool:
        """Whether the start is random."""
        return self.inputs.start is None

    @property
    def melt_time(self) -> Array:
        """Duration of the melt."""
        return MELT_COLLISIONS / self.dynamics.scene.collision_frequency

    @property
    def prepared_time(self) -> Array:
        """Time at the end of the preparation, which begins at that of the melt."""
        return (MELT_COLLISIONS + PREPARED) / self.dynamics.scene.collision_frequency

    @property
    def key(self) -> PRNGKeyArray:
        """Of the random numbers."""
        return jax.random.key(0) if self.inputs.key is None else self.inputs.key

    @property
    def drift(self) -> Array:
        """Velocity of the centre of mass of each particle's replica, in which the run is at rest.

        Shape (n, d), or 0 for a random start, and where walls or drag are at rest.
        """
        if self.inputs.start is None or not self.dynamics.inertial:
            return jnp.zeros(())
        velocity = self.inputs.start[1]
        return velocity - centred(velocity, self.dynamics.replicas).reshape(velocity.shape)

    def outputs(self, state: State, records: dict[str, Array], fault: ArrayLike) -> Outputs:
        """The results of a run, in the frame in which the start was given."""
        position, velocity, spin = self.seen(state, self.inputs.times[-1])
        fault = jnp.asarray(fault, jnp.int32)
        return Outputs(position, velocity, records, fault, spin)

    def seen(self, state: State, time: Array) -> tuple[Array, Array, Array | None]:
        """Positions in the box, velocities and spins, in the frame in which the start was given."""
        drift = self.drift
        velocity, spin = self.dynamics.seen(state, state.velocity + drift)
        inside = neighbours.wrap(self.dynamics.scene.side, state.position + drift * time)
        return inside, velocity, spin

    def observe(self, state: State) -> dict[str, Array]:
        """The records of a state, and what a user's function makes of it."""
        records = self.dynamics.observe(state)
        if self.save is None:
            return records
        return records | snapshot.saved(self.save, self.particles(state))

    def particles(self, state: State) -> Particles:
        """The particles of a state in SI."""
        seen = self.seen(state, state.time)
        return snapshot.particles(self.inputs.units, self.dynamics.replicas, *seen)

    def writer(self, run: Run) -> Callable[[int, State], None]:
        """Writes the particles at a time, by its number, to the trajectory, if there is one."""
        if run.trajectory is None:
            return lambda k, state: None
        resumed = run.checkpoint is not None and Path(run.checkpoint).exists()
        trajectory = Trajectory(run.trajectory, self.dynamics.replicas, resumed)
        units = self.inputs.units
        sphere = Sphere(float(units.length), float(units.mass))
        unit_time = float(units.length / units.velocity)

        def write(k: int, state: State) -> None:
            time = float(self.inputs.times[k]) * unit_time
            trajectory.write(k, time, self.particles(state), sphere)

        return write

    def first_state(self) -> State:
        """The state at the beginning of the melt, or of the run of a given start."""
        if self.inputs.start is not None:
            position, velocity = self.inputs.start
            return self.dynamics.begin(position, velocity - self.drift, self.skin)
        places, _ = jax.random.split(self.key)
        return self._at_random(initial.positions(places, *self._box))

    def compiled_first_state(self, fault: Array) -> tuple[State, Array]:
        """The same without a call to the host, and the status, from that before."""
        if self.inputs.start is not None:
            return self.first_state(), fault
        places, _ = jax.random.split(self.key)
        side, *size, room = self._box
        lists = self.melt_capacity.pairs, self.melt_capacity.lookahead
        sizes = size[0], size[1], size[2]
        found, fault = relaxation.positions(places, side, sizes, self.skin, lists, room, fault)
        return self._at_random(found), fault

    @property
    def _box(self) -> tuple[Array, int, int, int, Array | None]:
        """Side, replicas, particles in each, dimension and room."""
        dynamics = self.dynamics
        size = dynamics.replicas, self.num_particles, self.dimension
        return dynamics.scene.side, *size, dynamics.room

    def _at_random(self, position: Array) -> State:
        """The state of random velocities at given positions."""
        _, speeds = jax.random.split(self.key)
        position = position if self.dynamics.room is None else position + 0.5
        velocity = initial.velocities(
            speeds, self.dynamics.replicas, self.num_particles, self.dimension
        )
        return self.dynamics.begin(position, velocity, self.skin)

    def cooling_state(self, melted: State) -> State:
        """The state at t = 0, from that at the end of the melt; with tangents if they are wanted.

        The energy in contacts is counted by the first call of `AbstractDynamics.advance`.
        """
        velocity = melted.velocity
        if self.melts:
            velocity = initial.settle(velocity, self.dynamics.replicas)
        state = self.dynamics.begin(melted.position, velocity, melted.skin)
        state = self.dynamics.drawn(state, self.key, melted)
        if self.directions is None:
            return state
        return self.dynamics.with_tangents(state, self.directions)
