"""Soft spheres: every contact resolved in time, in a periodic box."""

import dataclasses
from functools import partial
from math import pi
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer, eval_context
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran import blocks, initial, kinetics, neighbours, observables, status, tangents
from jaxgran.blocks import Plan, Scene, State
from jaxgran.checkpoint import fingerprint
from jaxgran.curve import CoolingCurve, Particles
from jaxgran.gas import Gas, sphere_surface
from jaxgran.restitution import Viscoelastic
from jaxgran.simulation import simulate
from jaxgran.tangents import Inputs, Outputs

SMALLEST_BOX = 2.1
"""Box side in diameters below which a sphere could touch another and its image at once."""

MELT_COLLISIONS = 10.0
"""Mean free times of elastic motion before t = 0."""

PAIRS_PER_PARTICLE = 3.0
"""How many pairs beyond contact a neighbour list should hold for each particle."""

MOST_PAIRS = 100
"""Pairs per particle beyond which a list is taken to have gone wrong."""

PROJECTION = 0.1
"""Mean free times between thermal projections of a derivative."""

_FASTEST = 4.8  # speed of the fastest of some thousand spheres, in sqrt(T)


class SoftSpheres(eqx.Module):
    """Viscoelastic spheres in periodic boxes, every contact resolved by time steps.

    ``m dv_i/dt = sum_j n_ij F(xi_ij, xi_dot_ij)`` with the force of `jaxgran.contact_force`,
    by drift-kick-drift steps whose kick is an implicit midpoint rule solved in closed form.
    Second order in the step: at 40 steps a contact eps is good to 2e-5 on average, with a scatter
    of 1e-4 that comes from the square root at first touch and falls as dt^(3/2).

    The gas starts from random positions and Maxwellian velocities of exactly T_0 and no momentum,
    after an elastic melt of 10 mean free times. Steps lengthen as it cools.

    Args:
        num_particles: N in each box, >= 2; the box must be 2.1 diameters or longer.
        steps_per_contact: steps in the mean contact duration at the current temperature, >= 10.
        replicas: independent boxes run side by side; two or more give error bars.
        key: of the random start; `jax.random.key(0)` by default.
        start: positions and velocities to begin with instead of random ones; their box must be
            that of the gas.
        neighbours: "vesin" (host), "jax-md" (device), or "auto" for the faster one here.
        progress: show a progress bar on a terminal.
        checkpoint: a file to save the run to each minute and to resume it from. The resumed run
            gives the same numbers bit for bit.
        projection: mean free times between thermal projections of a derivative, 0.02 to 0.5 (see
            `jaxgran.tangents`); None for the plain derivative, which is exact, and useless after
            3 to 5 collisions a particle.
        plan: sizes of arrays, see `sized_for`.

    Derivatives of T, collisions, <dr^2> and the energies are taken in every float of the gas,
    forward and reverse alike: a gas depends on (alpha, A), its collision frequency and the times
    only. The first two are followed by tangents; the density acts by
    the Enskog frequency of collisions. T is followed exactly but for the projection, the rest is
    estimated from it: a_2 and the paths are taken as the same at the same number of collisions (so
    that d ln<dr^2>/d ln A is up to 0.2 too low: dissipation makes velocities last longer), the
    velocity correlation as decaying at 2/d of the collision rate. The last particles carry no
    derivative.

    Raises:
        ValueError: for numbers out of range.
    """

    num_particles: int = eqx.field(static=True)
    steps_per_contact: int = eqx.field(static=True, default=40)
    replicas: int = eqx.field(static=True, default=1)
    key: PRNGKeyArray | None = None
    start: Particles | None = None
    neighbours: str = eqx.field(static=True, default="auto")
    progress: bool = eqx.field(static=True, default=True)
    checkpoint: str | Path | None = eqx.field(static=True, default=None)
    projection: float | None = eqx.field(static=True, default=PROJECTION)
    plan: blocks.Plan | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        for name, least in (("num_particles", 2), ("steps_per_contact", 10), ("replicas", 1)):
            value = getattr(self, name)
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be a whole number >= {least}, got {value!r}")
        neighbours.engine(self.neighbours)

    @property
    def accuracy(self) -> float:
        """Relative error of a projected derivative: what differs by less is not told apart."""
        return 0.02

    def cool(self, gas: Gas, times: Float[Array, "times"]) -> CoolingCurve:
        """The cooling curve at the given times, s; see `jaxgran.cool`, which checks them.

        Raises:
            ValueError: if the gas is not viscoelastic, too dense, or its box too small.
            RuntimeError: if the run fails beyond repair, with what to do.
        """
        with jax.ensure_compile_time_eval():
            law = self._check(gas)
        inputs = Inputs(
            scene=reduced_scene(gas, self.num_particles),
            times=times * jnp.sqrt(gas.temperature) / gas.diameter,
            start=self._reduced_start(gas),
            key=self.key,
        )
        run = partial(self._run, dimension=gas.dimension, clipped=law.clipped)
        if self.projection is not None:
            run = tangents.differentiable(run, lambda s: (s.alpha, s.dissipative_constant))
        return self._curve(gas, times, inputs.scene, run(inputs))

    def _reduced_start(self, gas: Gas) -> tuple[Array, Array] | None:
        if self.start is None:
            return None
        # The same start in units of any other gas.
        units = gas.diameter, jnp.sqrt(gas.temperature)
        length, speed = units if self.projection is None else jax.lax.stop_gradient(units)
        position, velocity = self.start.position / length, self.start.velocity / speed
        return position.reshape(-1, gas.dimension), velocity.reshape(-1, gas.dimension)

    def _check(self, gas: Gas) -> Viscoelastic:
        if not isinstance(gas.law, Viscoelastic):
            raise ValueError(
                "SoftSpheres needs the Viscoelastic law, which has a force; this gas has "
                f"{type(gas.law).__name__}: use a model of instant impacts"
            )
        if isinstance(gas.packing_fraction, Tracer) or isinstance(gas.diameter, Tracer):
            return gas.law
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
            shape = (self.replicas, self.num_particles, gas.dimension)
            for name, values in zip(self.start._fields[:2], self.start[:2], strict=True):
                if np.shape(values) != shape:
                    raise ValueError(f"start.{name} has shape {np.shape(values)}, not {shape}")
            if isinstance(self.start.box_side, Tracer):
                return gas.law
            given = float(self.start.box_side / gas.diameter)
            if not abs(given / side - 1) < 1e-6:
                raise ValueError(
                    f"start.box_side is {given:.7g} diameters, the gas fills {side:.7g}: change "
                    "packing_fraction or the start"
                )
        return gas.law

    def sized_for(self, gas: Gas, spare: float = 2.0) -> "SoftSpheres":
        """This model with the sizes of its arrays settled, which `jax.jit` needs beforehand.

        Outside of jit they follow from the gas and grow where they must. Inside, they are fixed,
        and a run that outgrows them ends in nan and a status.

        Args:
            gas: with known numbers, alike the gases to come: the hottest and softest of them.
            spare: room over the expected need.
        """
        law, scene = self._check(gas), reduced_scene(gas, self.num_particles)
        plan = self._sized(scene, gas.dimension, law.clipped, spare)
        return dataclasses.replace(self, plan=plan)

    def _pairs_in_contact(self, scene: Scene, d: int) -> Array:
        """Pairs a particle within contact, were the pair correlation 1."""
        return self.num_particles * sphere_surface(d) / (2 * d) / scene.side**d

    def _skin(self, scene: Scene, d: int) -> Array:
        """Reach of the neighbour list beyond contact, in diameters."""
        skin = (1 + PAIRS_PER_PARTICLE / self._pairs_in_contact(scene, d)) ** (1 / d) - 1
        return jnp.minimum(skin, blocks.longest_skin(scene.side))

    def _sized(self, scene: Scene, d: int, clipped: bool, spare: float = 1.4) -> Plan:
        flight = _FASTEST * float(scene.contact_duration)
        # A block is at most a contact long, and shorter where spheres go far in that time.
        steps = max(round(self.steps_per_contact * min(1.0, 0.08 / flight)), 8)
        flight *= steps / self.steps_per_contact
        inside = float(self._pairs_in_contact(scene, d))
        listed = inside * (1 + float(self._skin(scene, d))) ** d
        dilute = sphere_surface(d) / pi**0.5 * self.num_particles / float(scene.side) ** d
        contact_value = float(scene.collision_frequency) / dilute
        near = min(inside * contact_value * ((1 + 5 * flight) ** d - 1), listed)
        contact_fraction = float(scene.contact_duration * scene.collision_frequency)
        touching = min(contact_fraction * (4 + 6 * near), near)
        n = self.replicas * self.num_particles
        counts = [n * share for share in (listed, near, touching, 2 * touching)]
        spares = min(spare, 1.4), spare, spare, spare  # of all, pairs listed vary least
        rooms = [int(s * x + 5 * x**0.5) + 32 for s, x in zip(spares, counts, strict=True)]
        room = blocks.Room(*rooms[:3], members=min(rooms[3], n))
        return Plan(self.replicas, self.steps_per_contact, steps, clipped, room)

    def _run(
        self,
        inputs: Inputs,
        dimension: int,
        clipped: bool,
        directions: tuple[Array, Array] | None = None,
    ) -> Outputs:
        """Melt, then cool; and with it the tangents along directions in (alpha, A)."""
        traced = _is_traced(inputs)
        try:
            with jax.ensure_compile_time_eval():
                plan = self.plan or self._sized(inputs.scene, dimension, clipped)
        except jax.errors.ConcretizationTypeError:
            raise ValueError(
                "inside jax.jit the sizes of arrays must be known: give SoftSpheres(...)"
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
        skin = self._skin(scene, dimension)
        state = blocks.at_start(position, velocity, scene, skin, replicas)

        def begun(melted: State) -> State:
            velocity = melted.velocity
            if inputs.start is None:
                velocity = initial.settle(velocity, replicas)
            state = blocks.at_start(melted.position, velocity, scene, melted.skin, replicas)
            if directions is None:
                return state
            assert self.projection is not None
            damping = kinetics.TWO_TERM * scene.dissipative_constant * scene.alpha**0.4
            along = tangents.at_start(*directions, velocity, replicas, self.projection, damping)
            return state._replace(tangents=along)

        if traced:
            state, records, fault = self._traced(inputs, plan, state, begun)
        else:
            # Under jax.grad every call of a compiled function would be traced again.
            with eval_context():
                state, records, fault = self._driven(inputs, plan, state, begun)
        position = neighbours.wrap(scene.side, state.position)
        return Outputs(position, state.velocity, records, fault)

    def _driven(self, inputs: Inputs, plan: Plan, state: State, begun):
        """Run by a loop on the host, which makes room as it is needed."""
        scene, times = inputs.scene, np.asarray(inputs.times)
        observe = partial(_observe, scene=scene, replicas=self.replicas)
        engine = neighbours.engine(self.neighbours)

        def advance(state: State, end: float, scene: Scene) -> State:
            nonlocal plan
            while True:
                now = blocks.stretch(state, scene, end, plan, engine)
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
            melt = partial(advance, scene=_elastic(scene))
            end = np.asarray([MELT_COLLISIONS / scene.collision_frequency])
            state, _ = simulate(state, end, melt, observe, progress=self.progress, label="melt")
        cool = partial(advance, scene=scene)
        state = cool(begun(state), 0.0)  # counts the energy in contacts
        size = self.num_particles, self.replicas, self.steps_per_contact, self.neighbours
        state, records = simulate(
            state,
            times,
            cool,
            observe,
            scene=fingerprint(inputs, state.tangents, size),
            progress=self.progress,
            path=self.checkpoint,
        )
        records = {name: jnp.asarray(value) for name, value in records.items()}
        return state, records, jnp.zeros((), jnp.int32)

    def _traced(self, inputs: Inputs, plan: Plan, state: State, begun):
        """The same inside `jax.jit`, `jax.vmap` or a derivative: room is fixed beforehand."""

        def run(carry, scene, end):
            def further(carry):
                now = blocks.stretch(carry[0], scene, end, plan)
                return now.state, now.status

            def unfinished(carry):
                return (carry[0].time < end) & (carry[1] == status.OK)

            return jax.lax.while_loop(unfinished, further, carry)

        scene, fault = inputs.scene, jnp.zeros((), jnp.int32)
        if inputs.start is None:
            end = MELT_COLLISIONS / scene.collision_frequency
            state, fault = run((state, fault), _elastic(scene), end)

        def to(carry, end):
            state, fault = run(carry, scene, end)
            records = _observe(state, scene=scene, replicas=self.replicas)
            bad = fault != status.OK
            return (state, fault), jax.tree.map(lambda x: jnp.where(bad, jnp.nan, x), records)

        (state, fault), records = jax.lax.scan(to, (begun(state), fault), inputs.times)
        return state, records, fault

    def _curve(self, gas: Gas, times: Array, scene: Scene, run: Outputs) -> CoolingCurve:
        energy = gas.mass * gas.temperature
        units = {
            "temperature": gas.temperature,
            "sonine": 1.0,
            "displacement": gas.diameter**2,
            "velocity_correlation": gas.temperature,
            "elastic_energy": energy,
            "dissipated_energy": energy,
            "collisions": 1.0,
        }
        each = {name: run.records[name].T * unit for name, unit in units.items()}
        mean = {name: jnp.mean(values, axis=0) for name, values in each.items()}
        errors = {}
        if self.replicas > 1:
            for name in ("temperature", "displacement"):
                deviation = jnp.std(each[name], axis=0, ddof=1)
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


def _is_traced(tree) -> bool:
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def _elastic(scene: Scene) -> Scene:
    return scene._replace(dissipative_constant=0.0 * scene.alpha)


def reduced_scene(gas: Gas, num_particles: int) -> Scene:
    """A gas of viscoelastic spheres in units of its diameter, mass and first temperature."""
    unit_time = gas.diameter / jnp.sqrt(gas.temperature)
    law = gas.law
    assert isinstance(law, Viscoelastic)
    return Scene(
        side=gas.box_side(num_particles) / gas.diameter,
        alpha=gas.alpha * gas.diameter**0.5 * unit_time**2,
        dissipative_constant=law.dissipative_constant / unit_time,
        contact_duration=gas.contact_duration / unit_time,
        collision_frequency=gas.collision_frequency * unit_time,
    )


@partial(jax.jit, static_argnames="replicas")
def _observe(state: State, *, scene: Scene, replicas: int) -> dict[str, Array]:
    """The records of a state, and if tangents are followed, x.along and x.rate for each record x:
    its derivatives along the directions at this time, and in time."""

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
        "elastic_energy": state.elastic / num_particles,
        "dissipated_energy": state.dissipated / num_particles,
        "collisions": 2 / num_particles * state.contacts,
    }
    along = state.tangents
    if along is None:
        return records
    T, C, U = (records[n] for n in ("temperature", "velocity_correlation", "elastic_energy"))
    cooling, meeting = along.rates.cooling(along.trend(T)), along.rates.collision(T)
    c, clock = tangents.projected(along, state.velocity, state.time)
    stiffer = (along.alpha / scene.alpha)[:, None]
    # At a fixed place in the sequence of collisions the paths are the same; contacts are not.
    kept = {"temperature": c * T[None], "velocity_correlation": 0.5 * c * C[None]}
    kept["elastic_energy"] = (1.4 * c - 0.4 * stiffer) * U[None]
    rates = {
        "temperature": -cooling * T,
        "displacement": 2 * jnp.mean(jnp.sum(travelled * velocity, -1), axis=1),
        "velocity_correlation": -2 / d * meeting * C,
        "elastic_energy": -1.4 * cooling * U,
        "collisions": meeting,
    }
    return tangents.with_tangents(records, kept, rates, clock)
