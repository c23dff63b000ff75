"""Hard spheres: instantaneous impacts in a periodic box, resolved event by event."""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran import events, initial, neighbours, observables, status
from jaxgran.blocks import Room, longest_skin
from jaxgran.checkpoint import fingerprint
from jaxgran.curve import CoolingCurve, Particles
from jaxgran.events import Scene, State
from jaxgran.gas import Gas
from jaxgran.simulation import simulate

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
    plan: events.Plan | None = eqx.field(static=True, default=None)

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
            NotImplementedError: under a derivative with respect to the gas or the times.
        """
        with jax.ensure_compile_time_eval():
            self._check(gas)
        gas, times = jax.tree.map(_constant, (gas, times))
        scene = reduced_scene(gas, self.num_particles, self.contact_time)
        unit_time = gas.diameter / jnp.sqrt(gas.temperature)
        inputs = gas, times, self.start, self.key
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(inputs)):
            state, records, fault = self._traced(gas, scene, times / unit_time)
        else:
            state, records = self._driven(gas, scene, times / unit_time)
            fault = jnp.zeros((), jnp.int32)
        return self._curve(gas, times, scene, state, records, fault)

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
        given = float(start.box_side / gas.diameter)
        if not abs(given / side - 1) < 1e-6:
            raise ValueError(
                f"start.box_side is {given:.7g} diameters, the gas fills {side:.7g}: change "
                "packing_fraction or the start"
            )
        if isinstance(start.position, Tracer):
            return
        position = neighbours.wrap(side, start.position.reshape(-1, gas.dimension) / gas.diameter)
        room = 8 * len(position)
        pairs = neighbours.find_pairs(position, side, 1.0, replicas=self.replicas, room=room)
        apart = position[pairs.i] - position[pairs.j] - pairs.offset
        distance = np.linalg.norm(apart, axis=-1)[: int(pairs.count)]
        closest = float(np.min(distance, initial=1.0))
        tolerance = max(OVERLAP, 10 * side * float(jnp.finfo(position.dtype).eps))
        if closest < 1 - tolerance:
            raise ValueError(
                f"two spheres of the start are {closest:.9g} diameters apart, hard spheres must "
                "not overlap; move them apart, or leave start out for a random one"
            )

    def _skin(self, gas: Gas) -> Float[Array, ""]:
        """Reach of the neighbour list beyond contact, in diameters."""
        d = gas.dimension
        inside = gas.packing_fraction * 2 ** (d - 1)  # pairs per particle within contact, were g 1
        skin = (1 + PAIRS_PER_PARTICLE / inside) ** (1 / d) - 1
        side = gas.box_side(self.num_particles) / gas.diameter
        return jnp.minimum(skin, longest_skin(side))

    def sized_for(self, gas: Gas, spare: float = 1.4) -> "HardSpheres":
        """This model with the sizes of its arrays settled, which `jax.jit` needs beforehand.

        Outside of jit they follow from the gas and grow where they must. Inside, they are fixed,
        and a run that outgrows them ends in nan and a status.

        Args:
            gas: with known numbers, alike the gases to come: the densest of them.
            spare: room over the expected need.
        """
        return dataclasses.replace(self, plan=self._sized(gas, spare))

    def _sized(self, gas: Gas, spare: float = 1.4) -> events.Plan:
        n = self.replicas * self.num_particles
        share = max(WINDOW_SHARE, 2 * events.LEAST_IMPACTS / n)
        inside = float(gas.packing_fraction) * 2 ** (gas.dimension - 1)
        listed = inside * (1 + float(self._skin(gas))) ** gas.dimension
        # As measured; a list changes its length little, windows differ more.
        near, chosen, members = (min(factor * share, listed) for factor in (4.0, 1.7, 2.0))
        counts = [n * number for number in (listed / 1.3, near, chosen, members)]
        rooms = [int(spare * count + 5 * count**0.5) + 64 for count in counts]
        rooms[1:3] = [max(rows, min(rooms[0], 512)) for rows in rooms[1:3]]  # spare small runs
        room = Room(*rooms[:3], members=min(max(rooms[3], 512), n))
        return events.Plan(self.replicas, share, room)

    def _initial(self, gas: Gas, scene: Scene, plan: events.Plan) -> State:
        d = gas.dimension
        if self.start is None:
            keys = jax.random.split(jax.random.key(0) if self.key is None else self.key)
            size = self.replicas, self.num_particles, d
            position = initial.positions(keys[0], scene.side, *size)
            velocity = initial.velocities(keys[1], *size)
        else:
            position = (self.start.position / gas.diameter).reshape(-1, d)
            velocity = (self.start.velocity / jnp.sqrt(gas.temperature)).reshape(-1, d)
        return events.at_start(position, velocity, scene, self._skin(gas), plan)

    def _melted(self, state: State, scene: Scene, plan: events.Plan) -> State:
        velocity = initial.settle(state.velocity, self.replicas)
        return events.at_start(state.position, velocity, scene, state.skin, plan)

    def _driven(self, gas: Gas, scene: Scene, times: Array) -> tuple[State, dict[str, Array]]:
        """Run by a loop on the host, which makes room as it is needed."""
        plan = self.plan or self._sized(gas)
        drive = self._driver(plan)
        state = self._initial(gas, scene, plan)
        observe = partial(_observe, scene=scene, replicas=self.replicas)
        if self.start is None:
            elastic = scene._replace(elastic=jnp.array(True))
            end = np.asarray([MELT_COLLISIONS / scene.collision_frequency])
            melt = partial(drive, elastic)
            state, _ = simulate(state, end, melt, observe, progress=self.progress, label="melt")
            state = self._melted(state, scene, plan)
        state, records = simulate(
            state,
            np.asarray(times),
            partial(drive, scene),
            observe,
            scene=fingerprint(gas, times, state, self.contact_time, self.neighbours),
            progress=self.progress,
            path=self.checkpoint,
        )
        return state, {name: jnp.asarray(value) for name, value in records.items()}

    def _driver(self, plan: events.Plan) -> Callable[[Scene, State, float], State]:
        by = neighbours.engine(self.neighbours)

        def advance(scene: Scene, state: State, end: float) -> State:
            nonlocal plan
            while True:
                now = events.stretch(state, scene, end, plan, by)
                state, fault = now.state, int(now.status)
                if fault == status.OK:
                    return state
                needed = [int(x) for x in now.needed]
                missing = fault & (status.LIST_FULL.bit | status.CONTACTS_FULL.bit)
                if not missing or max(needed) > MOST_PAIRS * len(state.position):
                    at = float(jnp.mean(state.velocity**2))
                    raise RuntimeError(f"stopped at T/T_0 = {at:.3g}: {status.explain(fault)}")
                plan = plan._replace(room=plan.room.grown(needed))

        return advance

    def _traced(self, gas: Gas, scene: Scene, times: Array):
        """The same inside `jax.jit`, `jax.vmap` or a derivative: room is fixed beforehand."""
        try:
            with jax.ensure_compile_time_eval():
                plan = self.plan or self._sized(gas)
        except jax.errors.ConcretizationTypeError:
            raise ValueError(
                "inside jax.jit the sizes of arrays must be known: give HardSpheres(...)"
                ".sized_for(gas), made outside with a gas of known numbers"
            ) from None

        def run(carry, scene, end):
            def further(carry):
                now = events.stretch(carry[0], scene, end, plan)
                return now.state, now.status

            def unfinished(carry):
                return (carry[0].time < end) & (carry[1] == status.OK)

            return jax.lax.while_loop(unfinished, further, carry)

        state, fault = self._initial(gas, scene, plan), jnp.zeros((), jnp.int32)
        if self.start is None:
            elastic = scene._replace(elastic=jnp.array(True))
            state, fault = run((state, fault), elastic, MELT_COLLISIONS / scene.collision_frequency)
            state = self._melted(state, scene, plan)

        def to(carry, end):
            state, fault = run(carry, scene, end)
            records = _observe(state, scene=scene, replicas=self.replicas)
            bad = fault != status.OK
            return (state, fault), jax.tree.map(lambda x: jnp.where(bad, jnp.nan, x), records)

        (state, fault), records = jax.lax.scan(to, (state, fault), times)
        return state, records, fault

    def _curve(self, gas, times, scene, state, records, fault) -> CoolingCurve:
        units = {
            "temperature": gas.temperature,
            "sonine": 1.0,
            "displacement": gas.diameter**2,
            "velocity_correlation": gas.temperature,
            "dissipated_energy": gas.mass * gas.temperature,
            "collisions": 1.0,
            "regularised": 1.0,
        }
        each = {name: records[name].T * unit for name, unit in units.items()}
        mean = {name: jnp.mean(values, axis=0) for name, values in each.items()}
        errors = {}
        if self.replicas > 1:
            for name in ("temperature", "displacement"):
                deviation = jnp.std(each[name], axis=0, ddof=1)
                errors[f"{name}_error"] = deviation / self.replicas**0.5
        shape = self.replicas, self.num_particles, gas.dimension
        position = neighbours.wrap(scene.side, state.position)
        particles = Particles(
            position=position.reshape(shape) * gas.diameter,
            velocity=state.velocity.reshape(shape) * jnp.sqrt(gas.temperature),
            box_side=scene.side * gas.diameter,
        )
        return CoolingCurve(
            times=times,
            **mean,
            **errors,
            replicas=CoolingCurve(times=times, **each),
            particles=particles,
            status=fault,
        )


@jax.custom_jvp
def _constant(x: Array) -> Array:
    return x


@_constant.defjvp
def _no_tangent(primals, tangents):
    # What comes out of differentiating each impact grows e^2 to e^5 an impact: better none.
    raise NotImplementedError(
        "HardSpheres has no derivatives with respect to the gas or the times yet; use "
        "jaxgran.KineticTheory for them, or finite differences over several replicas"
    )


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
    def centred(x):
        boxes = x.reshape(replicas, -1, x.shape[-1])
        return boxes - jnp.mean(boxes, axis=1, keepdims=True)

    num_particles = len(state.position) // replicas
    velocity = centred(state.velocity)
    travelled = centred(state.position - state.origin + scene.side * state.image)
    first = centred(state.first_velocity)
    return {
        "temperature": observables.temperature(velocity),
        "sonine": observables.sonine(velocity),
        "displacement": observables.mean_square_displacement(travelled),
        "velocity_correlation": observables.velocity_correlation(first, velocity),
        "dissipated_energy": state.dissipated / num_particles,
        "collisions": 2 / num_particles * state.impacts,
        "regularised": 2 / num_particles * state.regularised,
    }
