"""Hard spheres: instantaneous impacts in a periodic box, resolved event by event."""

import dataclasses
import math
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxgran import boxes, events, given, neighbours, status, tangents
from jaxgran.curve import CoolingCurve, Particles
from jaxgran.events import Plan, Scene, State
from jaxgran.gas import Gas
from jaxgran.restitution import ReducedLaw
from jaxgran.room import contact_value, pairs_in_contact, rooms, skin_with, within_reach
from jaxgran.tangents import ImpactTangents, Inputs, Outputs

PAIRS_PER_PARTICLE = 7.0
"""How many pairs beyond contact a neighbour list should hold for each particle."""

WINDOW_SHARE = 0.05
"""Share of the particles that collide in a window."""

OVERLAP = 1e-9
"""Overlap in diameters up to which a given start is one of hard spheres."""


class HardSpheres(eqx.Module):
    """Spheres in periodic boxes that collide instantaneously, by any law of restitution.

    Between impacts spheres fly freely; an impact changes their velocities by
    ``+- (1 + eps(g)) g n / 2`` with the unit vector n between the centres and the normal speed g of
    approach. The impacts are those of a serial event-driven code, but many at once: all that no
    other can forestall.

    Inelastic collapse, infinitely many impacts in a finite time, is prevented by an impact of a
    sphere being elastic within ``contact_time`` of its last one (Luding & McNamara, Granular Matter
    1, 113 (1998), the TC model). A homogeneous gas notices it as a loss weaker by twice that.

    The gas starts from random positions and Maxwellian velocities of exactly T_0 and no momentum,
    after an elastic melt of 10 mean free times.

    Args:
        num_particles: N in each box, >= 2; the box must be 2.1 diameters or longer.
        replicas: independent boxes run side by side; two or more give error bars.
        contact_time: in mean free times of the homogeneous gas at the current temperature, in
            [0, 0.1]; 0 is the pure hard sphere, which may collapse.
        key: of the random start; `jax.random.key(0)` by default.
        start: positions and velocities to begin with instead of random ones; their box must be
            that of the gas, and no spheres may overlap.
        neighbours: who finds the pairs: "sweep" (compiled with the rest), "vesin" (on the host),
            "jax-md" (on the device, not inside `jax.jit`), or "auto" for the one fastest here.
        progress: show a progress bar on a terminal.
        checkpoint: a file to save the run to each minute and to resume it from. The resumed run
            gives the same numbers bit for bit.
        plan: sizes of arrays, see `sized_for`.

    Derivatives of T, collisions, <dr^2> and the dissipated energy are taken in every float of the
    gas and in the times, forward and reverse alike, whatever the law. They are thermally projected
    at every impact (see `jaxgran.tangents`): the gas is taken to remember its temperature alone,
    and to cool on at the rate of its last 5 mean free times. Against finite differences
    d ln T/d ln A is right within 5 % in boxes shorter than L_c, but 14 % too large after 10 mean
    free times where flows have begun to hold energy (phi = .2, beta = .3, 1.2 L_c). a_2 and the
    paths are taken as the same at the same number of collisions (so that d ln<dr^2>/d ln A is up to
    0.2 too low: dissipation makes velocities last longer), the velocity correlation as decaying at
    2/d of the collision rate. The density acts by the Enskog frequency of collisions. The last
    particles carry no derivative. Beside a given start T_0 is a unit alone, and its derivative 0;
    the start takes part in a change of the diameter.

    Raises:
        ValueError: for numbers out of range.
    """

    num_particles: int = eqx.field(static=True)
    replicas: int = eqx.field(static=True, default=1)
    contact_time: float = eqx.field(static=True, default=1e-5)
    key: PRNGKeyArray | None = None
    start: Particles | None = None
    neighbours: str = eqx.field(static=True, default="auto")
    progress: bool = eqx.field(static=True, default=True)
    checkpoint: str | Path | None = eqx.field(static=True, default=None)
    plan: Plan | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        boxes.check_counts(self)
        if not isinstance(self.contact_time, float | int) or not 0 <= self.contact_time <= 0.1:
            raise ValueError(
                f"contact_time must lie in [0, 0.1] mean free times, got {self.contact_time!r}; it "
                "only keeps clusters from collapsing, so leave it small"
            )

    def cool(self, gas: Gas, times: Float[Array, "times"]) -> CoolingCurve:
        """The cooling curve at the given times, s; see `jaxgran.cool`, which checks them.

        Raises:
            ValueError: if the gas is too dense, its box too small, or the start not of this gas.
            RuntimeError: if the run fails beyond repair, with what to do.
        """
        with jax.ensure_compile_time_eval():
            self._check(gas)
        gas = given.unit_temperature(self, gas)
        inputs = Inputs(
            scene=reduced_scene(gas, self.num_particles, self.contact_time),
            times=times * jnp.sqrt(gas.temperature) / gas.diameter,
            start=given.reduced(self, gas),
            key=self.key,
        )
        run = partial(self._run, dimension=gas.dimension)
        run = tangents.differentiable(run, lambda scene: scene.law)
        return boxes.curve(gas, times, self, inputs.scene.side, run(inputs))

    @property
    def accuracy(self) -> float:
        """Relative error of a projected derivative: what differs by less is not told apart."""
        return 0.02

    def _check(self, gas: Gas) -> None:
        boxes.check_box(self, gas)
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((gas, self.start))):
            return  # looked at when it runs
        if self.start is None:
            return
        start, side = self.start, self.start.box_side / gas.diameter
        position = neighbours.wrap(side, start.position.reshape(-1, gas.dimension) / gas.diameter)
        closest = float(_closest(position, side, self.replicas, 8 * len(position)))
        tolerance = _overlap_allowed(position, side)
        if closest < 1 - tolerance:
            raise ValueError(
                f"two spheres of the start are {closest:.9g} diameters apart, hard spheres must "
                "not overlap; move them apart, or leave start out for a random one"
            )

    def _skin(self, scene: Scene, d: int) -> Array:
        return skin_with(PAIRS_PER_PARTICLE, self.num_particles, scene.side, d)

    def sized_for(self, gas: Gas, spare: float = 2.0) -> "HardSpheres":
        """This model with the sizes of its arrays settled, which `jax.jit` needs beforehand.

        Outside of jit they follow from the gas and grow where they must. Inside, they are fixed,
        and a run that outgrows them ends in nan and a status.

        Args:
            gas: with known numbers, alike the gases to come: the densest of them.
            spare: room over the expected need.
        """
        scene = reduced_scene(gas, self.num_particles, self.contact_time)
        return dataclasses.replace(self, plan=self._sized(scene, gas.dimension, spare))

    def _sized(self, scene: Scene, d: int, spare: float = 1.15) -> Plan:
        n = self.replicas * self.num_particles
        share = max(WINDOW_SHARE, 2 * events.LEAST_IMPACTS / n)
        inside = float(pairs_in_contact(self.num_particles, scene.side, d))
        skin = float(self._skin(scene, d))
        listed = inside * (1 + skin) ** d
        fastest = events.SPEED_MARGIN * (0.5 + (2 * math.log(n)) ** 0.5)  # of Maxwell's n speeds
        reach = 2 * fastest * share / float(scene.collision_frequency)
        at_contact = contact_value(scene.collision_frequency, inside, d)
        # As measured in gases of phi = .001 to .4 (disks: to .6), N = 125 to 50 000.
        packed = 0.9 + 0.45 * inside / 2 ** (d - 1)
        reachable = min(packed * at_contact * inside * ((1 + reach) ** d - 1), listed)
        chosen = min((0.65 + 0.35 * reachable) * share, listed)
        expected = listed, reachable, chosen, 1.25 * share
        more = 1.3 * max(inside - 0.4, 0.0)  # in random places more spheres are in reach
        ahead = within_reach(self.num_particles, scene.side, skin)
        return Plan(self.replicas, share, *rooms(expected, ahead, spare, more, n))

    def _run(self, inputs: Inputs, dimension: int, directions: ReducedLaw | None = None) -> Outputs:
        """Melt, then cool; and with it the tangents along directions in the law."""
        scene, replicas = inputs.scene, self.replicas
        plan = boxes.settled_plan(self, lambda: self._sized(scene, dimension), replicas=replicas)

        def followed(state: State) -> State:
            if directions is None:
                return state
            along = ImpactTangents.at_start(directions, replicas, state.velocity.dtype)
            return state._replace(tangents=along)

        def fault(state: State) -> Array:
            closest = _closest(state.position, scene.side, replicas, plan.room.pairs)
            overlap = closest < 1 - _overlap_allowed(state.position, scene.side)
            return status.flag(status.OVERLAPPING, overlap)

        kind = boxes.Kind(
            at_start=lambda x, v, skin: events.at_start(x, v, scene, skin, plan),
            stretch=events.stretch,
            observe=partial(_observe, scene=scene, replicas=replicas),
            elastic=lambda scene: scene._replace(elastic=jnp.array(True)),
            followed=followed,
            fault=fault,
        )
        return boxes.run(self, inputs, kind, plan, self._skin(scene, dimension), dimension)


def _closest(position: Array, side: ArrayLike, replicas: int, room: int) -> Array:
    """The least distance between two spheres, in diameters; 1 if none are closer."""
    pairs = neighbours.find_pairs(position, side, 1.0, replicas=replicas, room=room)
    apart = position[pairs.i] - position[pairs.j] - pairs.offset
    square = jnp.where(jnp.arange(room) < pairs.count, jnp.sum(apart * apart, -1), 1.0)
    return jnp.sqrt(jnp.min(square, initial=1.0))


def _overlap_allowed(position: Array, side: ArrayLike) -> Array:
    """What round-off of places may make of two spheres that touch."""
    return jnp.maximum(OVERLAP, 10 * side * jnp.finfo(position.dtype).eps)


def reduced_scene(gas: Gas, num_particles: int, contact_time: float = 0.0) -> Scene:
    """A gas of hard spheres in units of its diameter, mass and first temperature."""
    unit_time = gas.diameter / jnp.sqrt(gas.temperature)
    return Scene(
        side=gas.box_side(num_particles) / gas.diameter,
        law=gas.reduced_law,
        collision_frequency=gas.collision_frequency * unit_time,
        contact_time=jnp.asarray(contact_time, gas.temperature.dtype),
        elastic=jnp.array(False),
    )


@partial(jax.jit, static_argnames="replicas")
def _observe(state: State, *, scene: Scene, replicas: int) -> dict[str, Array]:
    """The records of a state, with their derivatives if tangents are followed."""

    records, travelled, velocity = boxes.observed(state, scene.side, replicas)
    num_particles, d = velocity.shape[1:]
    records |= {
        "dissipated_energy": state.dissipated / num_particles,
        "collisions": 2 / num_particles * state.impacts,
        "regularised": 2 / num_particles * state.regularised,
    }
    along = state.tangents
    if along is None:
        return records
    T, C = records["temperature"], records["velocity_correlation"]
    cooling = along.rates.cooling(events.cooling_trend(scene.law, T, d))
    meeting, c = along.rates.collision(T), along.log_temperature
    # At a fixed place in the sequence of collisions the paths are the same.
    kept = {"temperature": c * T[None], "velocity_correlation": 0.5 * c * C[None]}
    rates = {
        "temperature": -cooling * T,
        "displacement": 2 * jnp.mean(jnp.sum(travelled * velocity, -1), axis=1),
        "velocity_correlation": -2 / d * meeting * C,
        "collisions": meeting,
    }
    return tangents.with_tangents(records, kept, rates, along.clock)
