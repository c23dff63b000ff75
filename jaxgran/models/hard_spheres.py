"""Hard spheres: instantaneous impacts in a periodic box, resolved event by event."""

import dataclasses
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer, eval_context
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from jaxgran import events, initial, neighbours, observables, status, tangents
from jaxgran.blocks import Room, longest_skin
from jaxgran.checkpoint import fingerprint
from jaxgran.curve import CoolingCurve, Particles
from jaxgran.events import Plan, Scene, State
from jaxgran.gas import Gas, sphere_surface
from jaxgran.restitution import ReducedLaw
from jaxgran.simulation import simulate
from jaxgran.tangents import ImpactTangents, Inputs, Outputs

SMALLEST_BOX = 2.1
"""Box side in diameters below which a sphere could touch another and its image at once."""

MELT_COLLISIONS = 10.0
"""Mean free times of elastic motion before t = 0."""

PAIRS_PER_PARTICLE = 7.0
"""How many pairs beyond contact a neighbour list should hold for each particle."""

MOST_PAIRS = 100
"""Pairs per particle beyond which a list is taken to have gone wrong."""

WINDOW_SHARE = 0.1
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
        neighbours: "vesin" (host), "jax-md" (device), or "auto" for the faster one here.
        progress: show a progress bar on a terminal.
        checkpoint: a file to save the run to each minute and to resume it from. The resumed run
            gives the same numbers bit for bit.
        plan: sizes of arrays, see `sized_for`.

    Derivatives of T, collisions, <dr^2> and the dissipated energy are taken in every float of the
    gas and in the times, forward and reverse alike, whatever the law. They are thermally projected
    at every impact (see `jaxgran.tangents`): the gas is taken to remember its temperature alone,
    and to cool on at the rate of its last 5 mean free times. a_2 and the paths are taken as the
    same at the same number of collisions (so that d ln<dr^2>/d ln A is up to 0.2 too low:
    dissipation makes velocities last longer), the velocity correlation as decaying at 2/d of the
    collision rate. The density acts by the Enskog frequency of collisions. The last particles carry
    no derivative.

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
        for name, least in (("num_particles", 2), ("replicas", 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
        if not 0 <= self.contact_time <= 0.1:
            raise ValueError(
                f"contact_time must lie in [0, 0.1] mean free times, got {self.contact_time!r}; it "
                "only keeps clusters from collapsing, so leave it small"
            )
        neighbours.engine(self.neighbours)

    def cool(self, gas: Gas, times: Float[Array, "times"]) -> CoolingCurve:
        """The cooling curve at the given times, s; see `jaxgran.cool`, which checks them.

        Raises:
            ValueError: if the gas is too dense, its box too small, or the start not of this gas.
            RuntimeError: if the run fails beyond repair, with what to do.
        """
        with jax.ensure_compile_time_eval():
            self._check(gas)
        inputs = Inputs(
            scene=reduced_scene(gas, self.num_particles, self.contact_time),
            times=times * jnp.sqrt(gas.temperature) / gas.diameter,
            start=self._reduced_start(gas),
            key=self.key,
        )
        run = partial(self._run, dimension=gas.dimension)
        run = tangents.differentiable(run, lambda scene: scene.law)
        return self._curve(gas, times, inputs.scene, run(inputs))

    @property
    def accuracy(self) -> float:
        """Relative error of a projected derivative: what differs by less is not told apart."""
        return 0.02

    def _reduced_start(self, gas: Gas) -> tuple[Array, Array] | None:
        if self.start is None:
            return None
        # The same start in units of any other gas.
        length, speed = jax.lax.stop_gradient((gas.diameter, jnp.sqrt(gas.temperature)))
        position, velocity = self.start.position / length, self.start.velocity / speed
        return position.reshape(-1, gas.dimension), velocity.reshape(-1, gas.dimension)

    def _check(self, gas: Gas) -> None:
        if isinstance(gas.packing_fraction, Tracer) or isinstance(gas.diameter, Tracer):
            return
        limit, phi = initial.PACKING_LIMIT[gas.dimension], float(jnp.max(gas.packing_fraction))
        if phi > limit and self.start is None:
            raise ValueError(
                f"packing_fraction {phi:.3g} is too dense for a fluid start, at most {limit:g}; "
                "lower it, or give your own start"
            )
        side = float(jnp.min(gas.box_side(self.num_particles) / gas.diameter))
        if side < SMALLEST_BOX:
            raise ValueError(
                f"the box is {side:.3g} diameters long, at least {SMALLEST_BOX} are needed to tell "
                "a sphere from its image; use more particles or a lower packing_fraction"
            )
        if self.start is not None:
            self._check_start(self.start, gas, side)

    def _check_start(self, start: Particles, gas: Gas, side: float) -> None:
        shape = (self.replicas, self.num_particles, gas.dimension)
        for name, values in zip(start._fields[:2], start[:2], strict=True):
            if np.shape(values) != shape:
                raise ValueError(f"start.{name} has shape {np.shape(values)}, not {shape}")
        if any(isinstance(leaf, Tracer) for leaf in start):
            return
        given = float(start.box_side / gas.diameter)
        if not abs(given / side - 1) < 1e-6:
            raise ValueError(
                f"start.box_side is {given:.7g} diameters, the gas fills {side:.7g}: change "
                "packing_fraction or the start"
            )
        position = neighbours.wrap(side, start.position.reshape(-1, gas.dimension) / gas.diameter)
        closest = float(_closest(position, side, self.replicas, 8 * len(position)))
        tolerance = _overlap_allowed(position, side)
        if closest < 1 - tolerance:
            raise ValueError(
                f"two spheres of the start are {closest:.9g} diameters apart, hard spheres must "
                "not overlap; move them apart, or leave start out for a random one"
            )

    def _pairs_in_contact(self, scene: Scene, d: int) -> Array:
        """Pairs a particle within contact, were the pair correlation 1."""
        return self.num_particles * sphere_surface(d) / (2 * d) / scene.side**d

    def _skin(self, scene: Scene, d: int) -> Array:
        """Reach of the neighbour list beyond contact, in diameters."""
        skin = (1 + PAIRS_PER_PARTICLE / self._pairs_in_contact(scene, d)) ** (1 / d) - 1
        return jnp.minimum(skin, longest_skin(scene.side))

    def sized_for(self, gas: Gas, spare: float = 1.4) -> "HardSpheres":
        """This model with the sizes of its arrays settled, which `jax.jit` needs beforehand.

        Outside of jit they follow from the gas and grow where they must. Inside, they are fixed,
        and a run that outgrows them ends in nan and a status.

        Args:
            gas: with known numbers, alike the gases to come: the densest of them.
            spare: room over the expected need.
        """
        scene = reduced_scene(gas, self.num_particles, self.contact_time)
        return dataclasses.replace(self, plan=self._sized(scene, gas.dimension, spare))

    def _sized(self, scene: Scene, d: int, spare: float = 1.4) -> Plan:
        n = self.replicas * self.num_particles
        share = max(WINDOW_SHARE, 2 * events.LEAST_IMPACTS / n)
        inside = float(self._pairs_in_contact(scene, d))
        listed = inside * (1 + float(self._skin(scene, d))) ** d
        # As measured; a list changes its length little, windows differ more.
        near, chosen, members = (min(factor * share, listed) for factor in (4.0, 1.7, 2.0))
        counts = [n * number for number in (listed / 1.3, near, chosen, members)]
        rooms = [int(spare * count + 5 * count**0.5) + 64 for count in counts]
        rooms[1:3] = [max(rows, min(rooms[0], 512)) for rows in rooms[1:3]]  # spare small runs
        room = Room(*rooms[:3], members=min(max(rooms[3], 512), n))
        return Plan(self.replicas, share, room)

    def _run(self, inputs: Inputs, dimension: int, directions: ReducedLaw | None = None) -> Outputs:
        """Melt, then cool; and with it the tangents along directions in the law."""
        traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(inputs))
        try:
            with jax.ensure_compile_time_eval():
                plan = self.plan or self._sized(inputs.scene, dimension)
        except jax.errors.ConcretizationTypeError:
            raise ValueError(
                "inside jax.jit the sizes of arrays must be known: give HardSpheres(...)"
                ".sized_for(gas), made outside with a gas of known numbers"
            ) from None
        scene, replicas = inputs.scene, self.replicas
        if inputs.start is None:
            keys = jax.random.split(jax.random.key(0) if inputs.key is None else inputs.key)
            size = replicas, self.num_particles, dimension
            position = initial.positions(keys[0], scene.side, *size)
            velocity = initial.velocities(keys[1], *size)
        else:
            position, velocity = inputs.start
        state = events.at_start(position, velocity, scene, self._skin(scene, dimension), plan)

        def begun(melted: State) -> State:
            velocity = melted.velocity
            if inputs.start is None:
                velocity = initial.settle(velocity, replicas)
            state = events.at_start(melted.position, velocity, scene, melted.skin, plan)
            if directions is None:
                return state
            along = ImpactTangents.at_start(directions, replicas, velocity.dtype)
            return state._replace(tangents=along)

        if traced:
            state, records, fault = self._traced(inputs, plan, state, begun)
        else:
            # Under jax.grad every call of a compiled function would be traced again.
            with eval_context():
                state, records, fault = self._driven(inputs, plan, state, begun)
        return Outputs(neighbours.wrap(scene.side, state.position), state.velocity, records, fault)

    def _driven(self, inputs: Inputs, plan: Plan, state: State, begun):
        """Run by a loop on the host, which makes room as it is needed."""
        scene = inputs.scene
        observe = partial(_observe, scene=scene, replicas=self.replicas)
        engine = neighbours.engine(self.neighbours)

        def advance(state: State, end: float, scene: Scene) -> State:
            nonlocal plan
            while True:
                now = events.stretch(state, scene, end, plan, engine)
                state, fault = now.state, int(now.status)
                if fault == status.OK:
                    return state
                needed = [int(x) for x in now.needed]
                missing = fault & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)
                if not missing or max(needed) > MOST_PAIRS * len(state.position):
                    at = float(jnp.mean(state.velocity**2))
                    raise RuntimeError(f"stopped at T/T_0 = {at:.3g}: {status.explain(fault)}")
                plan = plan._replace(room=plan.room.grown(needed))

        # A run to be resumed has been melted.
        if inputs.start is None and not (self.checkpoint and Path(self.checkpoint).exists()):
            melt = partial(advance, scene=scene._replace(elastic=jnp.array(True)))
            end = np.asarray([MELT_COLLISIONS / scene.collision_frequency])
            state, _ = simulate(state, end, melt, observe, progress=self.progress, label="melt")
        state = begun(state)
        size = self.num_particles, self.replicas, self.neighbours
        state, records = simulate(
            state,
            np.asarray(inputs.times),
            partial(advance, scene=scene),
            observe,
            scene=fingerprint(inputs, state.tangents, size),
            progress=self.progress,
            path=self.checkpoint,
        )
        records = {name: jnp.asarray(value) for name, value in records.items()}
        return state, records, jnp.zeros((), jnp.int32)

    def _traced(self, inputs: Inputs, plan: Plan, state: State, begun):
        """The same inside `jax.jit` or `jax.vmap`: room is fixed beforehand."""

        def run(carry, scene, end):
            def further(carry):
                now = events.stretch(carry[0], scene, end, plan)
                return now.state, now.status

            def unfinished(carry):
                return (carry[0].time < end) & (carry[1] == status.OK)

            return jax.lax.while_loop(unfinished, further, carry)

        scene, fault = inputs.scene, jnp.zeros((), jnp.int32)
        if inputs.start is None:
            elastic = scene._replace(elastic=jnp.array(True))
            state, fault = run((state, fault), elastic, MELT_COLLISIONS / scene.collision_frequency)
        else:
            closest = _closest(state.position, scene.side, self.replicas, plan.room.pairs)
            overlap = closest < 1 - _overlap_allowed(state.position, scene.side)
            fault = status.flag(status.OVERLAPPING, overlap)

        def to(carry, end):
            state, fault = run(carry, scene, end)
            records = _observe(state, scene=scene, replicas=self.replicas)
            bad = fault != status.OK
            return (state, fault), jax.tree.map(lambda x: jnp.where(bad, jnp.nan, x), records)

        (state, fault), records = jax.lax.scan(to, (begun(state), fault), inputs.times)
        return state, records, fault

    def _curve(self, gas: Gas, times: Array, scene: Scene, run: Outputs) -> CoolingCurve:
        units = {
            "temperature": gas.temperature,
            "sonine": 1.0,
            "displacement": gas.diameter**2,
            "velocity_correlation": gas.temperature,
            "dissipated_energy": gas.mass * gas.temperature,
            "collisions": 1.0,
            "regularised": 1.0,
        }
        each = {name: run.records[name].T * unit for name, unit in units.items()}
        mean = {name: jnp.mean(values, axis=0) for name, values in each.items()}
        errors = {}
        if self.replicas > 1:
            for name in ("temperature", "displacement"):
                # Where all replicas agree, at t = 0, a root has no derivative.
                deviation = jnp.std(jax.lax.stop_gradient(each[name]), axis=0, ddof=1)
                errors[f"{name}_error"] = deviation / self.replicas**0.5
        shape = self.replicas, self.num_particles, gas.dimension
        particles = Particles(
            position=run.position.reshape(shape) * gas.diameter,
            velocity=run.velocity.reshape(shape) * jnp.sqrt(gas.temperature),
            box_side=scene.side * gas.diameter,
        )
        return CoolingCurve(
            times=times,
            **mean,
            **errors,
            replicas=CoolingCurve(times=times, **each),
            particles=particles,
            status=run.status,
        )


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

    def centred(x):
        boxes = x.reshape(replicas, -1, x.shape[-1])
        return boxes - jnp.mean(boxes, axis=1, keepdims=True)

    num_particles, d = len(state.position) // replicas, state.position.shape[-1]
    velocity = centred(state.velocity)
    travelled = centred(state.position - state.origin + scene.side * state.image)
    first = centred(state.first_velocity)
    records = {
        "temperature": observables.temperature(velocity),
        "sonine": observables.sonine(velocity),
        "displacement": observables.mean_square_displacement(travelled),
        "velocity_correlation": observables.velocity_correlation(first, velocity),
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
