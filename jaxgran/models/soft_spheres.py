"""Soft spheres: every contact resolved in time, in a periodic box."""

import dataclasses
import math
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from jaxgran import blocks, boxes, closed_forms, given, tangents
from jaxgran.blocks import Plan, Scene, State
from jaxgran.curve import CoolingCurve, Particles
from jaxgran.gas import Gas
from jaxgran.restitution import Viscoelastic
from jaxgran.room import contact_value, pairs_in_contact, rooms, skin_with, within_reach
from jaxgran.tangents import Inputs, Outputs

PAIRS_PER_PARTICLE = 3.0
"""How many pairs beyond contact a neighbour list should hold for each particle."""

PROJECTION = 0.1
"""Mean free times between thermal projections of a derivative."""

_FASTEST = 4.8  # speed of the fastest of some thousand spheres, in sqrt(T)


class SoftSpheres(eqx.Module):
    """Viscoelastic spheres in periodic boxes, every contact resolved by time steps.

    ``m dv_i/dt = sum_j n_ij F(xi_ij, xi_dot_ij)`` with the force of `jaxgran.contact_force`,
    by drift-kick-drift steps whose kick is an implicit midpoint rule solved in closed form.
    Second order in the step: at 40 steps a contact eps is good to 3e-5 on average, with a scatter
    of 2e-4 that comes from the square root at first touch and falls as dt^(3/2).

    The gas starts from random positions and Maxwellian velocities of exactly T_0 and no momentum,
    after an elastic melt of 10 mean free times. Steps lengthen as it cools.

    Args:
        num_particles: N in each box, >= 2; the box must be 2.1 diameters or longer.
        steps_per_contact: steps in the mean contact duration at the current temperature, >= 10.
        replicas: independent boxes run side by side; two or more give error bars.
        key: of the random start; `jax.random.key(0)` by default.
        start: positions and velocities to begin with instead of random ones; their box must be
            that of the gas.
        neighbours: who finds the pairs: "sweep" (compiled with the rest), "vesin" (on the host),
            "jax-md" (on the device, not inside `jax.jit`), or "auto" for the one fastest here.
        progress: show a progress bar on a terminal.
        checkpoint: a file to save the run to each minute and to resume it from. The resumed run
            gives the same numbers bit for bit.
        projection: mean free times between thermal projections of a derivative, > 0; from 0.02 to
            0.5 they agree (see `jaxgran.tangents`). None for the plain derivative, which is exact,
            and useless after 3 to 5 collisions a particle.
        plan: sizes of arrays, see `sized_for`.

    Derivatives of T, collisions, <dr^2> and the energies are taken in every float of the gas,
    forward and reverse alike: a gas depends on (alpha, A), its collision frequency and the times
    only. The first two are followed by tangents; the density acts by
    the Enskog frequency of collisions. T is followed exactly but for the projection, the rest is
    estimated from it: a_2 and the paths are taken as the same at the same number of collisions (so
    that d ln<dr^2>/d ln A is up to 0.2 too low: dissipation makes velocities last longer), the
    velocity correlation as decaying at 2/d of the collision rate. The last particles carry no
    derivative. Beside a given start T_0 is a unit alone, and its derivative 0.

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
        boxes.check_counts(self, steps_per_contact=10)
        if self.projection is not None and not 0 < self.projection < math.inf:
            raise ValueError(
                f"projection must be a number of mean free times > 0, got {self.projection!r}; "
                f"take {PROJECTION}, or None for the plain derivative"
            )

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
        gas = given.unit_temperature(self, gas)
        inputs = Inputs(
            scene=reduced_scene(gas, self.num_particles),
            times=times * jnp.sqrt(gas.temperature) / gas.diameter,
            start=given.reduced(self, gas, differentiable=self.projection is None),
            key=self.key,
        )
        run = partial(self._run, dimension=gas.dimension, clipped=law.clipped)
        if self.projection is not None:
            run = tangents.differentiable(run, lambda s: (s.alpha, s.dissipative_constant))
        return boxes.curve(gas, times, self, inputs.scene.side, run(inputs))

    def _check(self, gas: Gas) -> Viscoelastic:
        if not isinstance(gas.law, Viscoelastic):
            raise ValueError(
                "SoftSpheres needs the Viscoelastic law, which has a force; this gas has "
                f"{type(gas.law).__name__}: use a model of instant impacts"
            )
        boxes.check_box(self, gas)
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

    def _skin(self, scene: Scene, d: int) -> Array:
        return skin_with(PAIRS_PER_PARTICLE, self.num_particles, scene.side, d)

    def _sized(self, scene: Scene, d: int, clipped: bool, spare: float = 1.2) -> Plan:
        flight = _FASTEST * float(scene.contact_duration)
        # A block is at most a contact long, and shorter where spheres go far in that time.
        steps = max(round(self.steps_per_contact * min(1.0, 0.08 / flight)), 8)
        flight *= steps / self.steps_per_contact
        inside = float(pairs_in_contact(self.num_particles, scene.side, d))
        skin = float(self._skin(scene, d))
        listed = inside * (1 + skin) ** d
        at_contact = contact_value(scene.collision_frequency, inside, d)
        # As measured, here and below: phi = .01 to .4 (disks: to .5), t_c/tau_c = .003 to .3.
        near = 0.75 * inside * at_contact * ((1 + 5 * flight) ** d - 1)
        near = near * listed / (near + listed)
        # Contacts that there are and that begin in a block, and the pairs near them.
        contact_fraction = float(scene.contact_duration * scene.collision_frequency)
        contact_fraction *= (1 + steps / self.steps_per_contact) / 2
        touching = min(contact_fraction * (2.2 + 3 * near**2), near)
        n = self.replicas * self.num_particles
        expected = listed, near, touching, 2 * touching / (1 + 1.6 * touching**0.6)
        # Where places are random, about as many pairs touch besides as would at no correlation.
        ahead = within_reach(self.num_particles, scene.side, skin)
        found = rooms(expected, ahead, spare, 1.3 * inside, n)
        return Plan(self.replicas, self.steps_per_contact, steps, clipped, *found)

    def _run(
        self,
        inputs: Inputs,
        dimension: int,
        clipped: bool,
        directions: tuple[Array, Array] | None = None,
    ) -> Outputs:
        """Melt, then cool; and with it the tangents along directions in (alpha, A)."""
        scene, replicas = inputs.scene, self.replicas

        def followed(state: State) -> State:
            if directions is None:
                return state
            assert self.projection is not None
            damping = closed_forms.TWO_TERM * scene.dissipative_constant * scene.alpha**0.4
            interval = self.projection
            along = tangents.at_start(*directions, state.velocity, replicas, interval, damping)
            return state._replace(tangents=along)

        kind = boxes.Kind(
            at_start=lambda x, v, skin: blocks.at_start(x, v, scene, skin, replicas),
            stretch=blocks.stretch,
            observe=partial(_observe, scene=scene, replicas=replicas),
            elastic=lambda scene: scene._replace(dissipative_constant=0.0 * scene.alpha),
            followed=followed,
        )
        plan = boxes.settled_plan(
            self,
            lambda: self._sized(scene, dimension, clipped),
            replicas=replicas,
            steps_per_contact=self.steps_per_contact,
            clipped=clipped,
        )
        skin, settings = self._skin(scene, dimension), (self.steps_per_contact,)
        return boxes.run(self, inputs, kind, plan, skin, dimension, settings)


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

    records, travelled, velocity = boxes.observed(state, scene.side, replicas)
    num_particles, d = velocity.shape[1:]
    records |= {
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
