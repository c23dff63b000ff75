"""Base of the models of spheres in periodic boxes: checks, array sizes, derivatives and runs."""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import POSITIVE, Domain, checked_float, checked_int
from jaxgran.data.curve import DEFAULTS, CoolingCurve, Particles, Run
from jaxgran.gradients.differences import by_differences
from jaxgran.gradients.rule import Result, differentiable
from jaxgran.models import checks
from jaxgran.models.error_model import ErrorModel, slope_bias_of_run
from jaxgran.models.particle_model import AbstractParticleModel
from jaxgran.particles import neighbours, snapshot
from jaxgran.particles.capacity import Capacity, Neighbourhood, skin_for_pairs
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.run import Inputs, Simulation, simulate_on_host, simulate_traced
from jaxgran.particles.setup import check_inside, check_start, has_other_box, reduced_start
from jaxgran.scene.gas import Gas, SphereScene

DIFFERENCE_STEPS = Domain(0.0, 0.5, high_allowed=True)
"""Allowed steps of differences: the lower value of alpha must stay positive."""


S = TypeVar("S", bound="AbstractSpheres")


class Plan(NamedTuple):
    """Static sizes of a compiled run.

    Attributes:
        replicas: number of boxes.
        steps_per_contact: see `SoftSpheres`; None for hard spheres.
        steps: time steps in a block of soft spheres, impacts per particle in a window of hard ones.
        capacity: sizes of the arrays of the run.
        equilibration_capacity: sizes of the arrays in the first mean free times of equilibration.
    """

    replicas: int
    steps_per_contact: int | None
    steps: Any
    capacity: Capacity
    equilibration_capacity: Capacity


class AbstractSpheres(AbstractParticleModel):
    """A model of spheres in periodic boxes.

    Attributes:
        start: positions and velocities given by a user; None for random ones.
        neighbours: the search for pairs.
        differences: step of derivatives by differences; None for projected ones.
        plan: static sizes from `sized_for`; None if they follow from the gas.
        listed_by_skin: pairs per particle that the skin adds to a neighbour list.
    """

    start: AbstractVar[Particles | None]
    neighbours: AbstractVar[str]
    differences: AbstractVar[float | None]
    plan: AbstractVar[Plan | None]
    listed_by_skin: AbstractClassVar[float]

    has_positions: ClassVar[bool] = True
    derivative_accuracy: ClassVar[float] = 0.02

    @property
    def projected(self) -> bool:
        """True if derivatives are projected or by differences, False if they are plain."""
        return True

    def neighbourhood(self, scene: SphereScene, dimension: int) -> Neighbourhood:
        """Return the expected numbers of neighbours in a scene of known numbers."""
        side, n = float(scene.filled_side), self.num_particles
        around = Neighbourhood.of(side, n, self.replicas, dimension, self.listed_by_skin)
        if scene.container is None:
            return around
        shorter = max(1.0, side / float(scene.container[0]))  # the sweep runs along the first axis
        return around._replace(lookahead=min(around.lookahead * shorter, n))

    def derivative_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"]:
        """Relative error of projected derivatives by a flow, or of differences by their noise."""
        if self.differences is None:
            return error_model.slope_error()
        return error_model.noise_of_differences(
            self.differences, math.hypot(*self.noise(error_model))
        )

    @abstractmethod
    def scene(self, gas: Gas) -> SphereScene:
        """Return the gas in units of its diameter, mass and initial temperature."""

    @abstractmethod
    def planned(self, scene: SphereScene, dimension: int, spare: float | None = None) -> Plan:
        """Return static sizes for a scene of known numbers, with a spare factor on capacities."""

    @abstractmethod
    def dynamics(self, scene: SphereScene, plan: Plan) -> AbstractDynamics:
        """Return the equations of motion of the spheres."""

    def clock(self, scene: SphereScene, times: Float[Array, "times"]) -> Float[Array, "times"]:
        """Return the times of the run at reduced times."""
        return times

    def invalid_times(
        self, gas: Gas, times: Float[Array, "times"]
    ) -> tuple[Bool[Array, "times"], Int[Array, ""]]:
        """Return a mask of the times that the run cannot reach, and the status for them."""
        late, fault = super().invalid_times(gas, times)
        # Traced values could not be checked before the run.
        other_box = has_other_box(self.start, gas, self.num_particles)
        return late | other_box, fault | status.flag(status.BOX_MISMATCH, other_box)

    def refused_derivatives(self, scene: SphereScene) -> dict[str, Any]:
        """Return numbers of a scene in which the derivative of a run is not known, by a message."""
        return {}

    def check_fit(self, names: tuple[str, ...]) -> None:
        """Refuse plain derivatives, and the temperature and lengths of a given start."""
        if not self.projected:
            raise ValueError(
                f"a fit needs projected derivatives. Give {type(self).__name__} a projection."
            )
        fixed = [n for n in ("temperature", "diameter", "packing_fraction") if n in names]
        if self.start is not None and fixed:
            raise ValueError(
                f"{' and '.join(fixed)} cannot be fitted from a given start, which fixes them. "
                f"Leave start out of {type(self).__name__}, or free other parameters."
            )

    def sized_for(self: S, gas: Gas, spare: float = 2.0) -> S:
        """Return this model with fixed sizes of its arrays, for `jax.jit`.

        Outside of jit sizes follow from the gas, and arrays grow if they must. Inside they are
        fixed; a run that exceeds them ends in nan and a status.

        Args:
            gas: a gas of known numbers that represents the later ones: the densest, hottest and
                softest of them.
            spare: capacity over the expected need.
        """
        checked_float("spare", spare, POSITIVE, "2 is twice the expected need.")
        self.check_scene(checks.checked_gas(gas))
        plan = self.planned(self.scene(gas), gas.dimension, spare)
        return dataclasses.replace(self, plan=plan)

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run = DEFAULTS) -> CoolingCurve:
        """Return the cooling curve at the given times, s; see `jaxgran.AbstractModel.simulate`."""
        if self.start is not None:  # then T_0 is a constant unit of speed in derivatives
            gas = gas.replace(temperature=jax.lax.stop_gradient(gas.temperature))
        return super().simulate(gas, times, run)

    def inputs(self, gas: Gas, times: Float[Array, "times"], run: Run) -> Inputs:
        """Return the gas, the times and the start in units of the run."""
        scene, speed = self.scene(gas), jnp.sqrt(gas.temperature)
        return Inputs(
            scene=scene,
            times=self.clock(scene, times * speed / gas.diameter),
            start=reduced_start(self.start, gas, differentiable=not self.projected),
            key=run.key,
            units=snapshot.Units.of(gas, self.num_particles, gas.diameter, speed),
        )

    def differentiable(self, outputs: Callable[..., Result], run: Run) -> Callable[..., Result]:
        """Return runs with projected derivatives, with differences of runs, or unchanged."""
        if not self.projected:
            return outputs
        if self.differences is not None:
            shifted = partial(outputs, run=Run(run.key, run.progress))  # these write no files
            outputs = by_differences(outputs, shifted, self.differences)
        return differentiable(
            outputs,
            material=lambda scene: scene.material,
            frequency=lambda scene: scene.collision_frequency,
            refused=self.refused_derivatives,
        )

    def single_replica(self: S) -> S:
        """Return the model of one replica; the inputs of its run have its start."""
        return dataclasses.replace(self, replicas=1, start=None, plan=None)

    def outputs(self, inputs: Inputs, directions: Any, dimension: int, run: Run) -> Result:
        """Run all replicas in one array, from the host unless a number of the inputs is traced."""
        plan = self._known_plan(inputs.scene, dimension)
        side = inputs.scene.filled_side
        sim = Simulation(
            dynamics=self.dynamics(inputs.scene, plan),
            equilibration_capacity=plan.equilibration_capacity,
            inputs=inputs,
            directions=directions,
            num_particles=self.num_particles,
            dimension=dimension,
            skin=skin_for_pairs(self.listed_by_skin, self.num_particles, side, dimension),
            engine=self.neighbours,
            save=snapshot.save_function(run.save),
        )
        if not any_traced(inputs):
            model = dataclasses.replace(self, start=None, plan=None)
            return simulate_on_host(sim, run, {"model": model, "steps": plan.steps})
        if self.neighbours == "jax-md":
            raise ValueError(
                'inside jax.jit or jax.vmap neighbours="jax-md" is not supported, since it sizes '
                "its cells from known numbers: leave neighbours out"
            )
        return simulate_traced(sim)

    def _known_plan(self, scene: SphereScene, dimension: int) -> Plan:
        """Return the plan of the model, or a new one if all numbers that it needs are known."""
        name = type(self).__name__
        if self.plan is not None:
            for setting in ("replicas", "steps_per_contact"):
                planned, value = getattr(self.plan, setting), getattr(self, setting, None)
                if planned != value:
                    raise ValueError(
                        f"this {name} was sized for {setting} = {planned!r}, and now has "
                        f"{value!r}. Call sized_for(gas) again."
                    )
            return self.plan
        try:
            with jax.ensure_compile_time_eval():
                return self.planned(scene, dimension)
        except jax.errors.ConcretizationTypeError:
            raise ValueError(
                "inside jax.jit the sizes of arrays must be known. Use "
                f"{name}(...).sized_for(gas), with a gas of known numbers and outside of jax.jit."
            ) from None

    @eqx.filter_jit
    def derivative_bias(self, gas: Gas, times: Array, flow_share: Array) -> Array | None:
        """Estimate the bias of projected derivatives, 0 in a box below L_c, which has no flow."""
        if self.differences is not None or not self.projected:
            return None
        has_flow = gas.box_side(self.num_particles) > gas.critical_box
        return jnp.where(has_flow, slope_bias_of_run(times, jnp.mean(flow_share, axis=0)), 0.0)

    def check_counts(self, **minimum: int) -> None:
        """Check the whole numbers of the model against their minima, and its other settings."""
        for name, lowest in ({"num_particles": 2, "replicas": 1} | minimum).items():
            checked_int(name, getattr(self, name), lowest)
        neighbours.choose_engine(self.neighbours)
        if self.differences is None:
            return
        advice = "In the logarithm of an impact's loss: 0.3, or None for projected derivatives."
        checked_float("differences", self.differences, DIFFERENCE_STEPS, advice)
        if not self.projected:
            raise ValueError(
                f"differences = {self.differences} and projection = None ask for two kinds of "
                "derivative. Leave one of them out."
            )

    def check_box(self, gas: Gas, min_wall_distance: float) -> None:
        """Raise ValueError for a gas too dense, a box too small, or a start of another gas.

        Args:
            gas: the gas.
            min_wall_distance: least distance, in diameters, of a centre of the start from a wall.
        """
        check_start(self.start, gas, self.replicas, self.num_particles)
        if self.differences is not None and gas.elements:
            raise ValueError(
                "derivatives by differences need smooth spheres in free flight, and this gas has "
                f"{', '.join(gas.elements)}. Leave differences out of the model, or take "
                "differences of runs yourself."
            )
        checks.check_packing(gas, self.num_particles, random=self.start is None)
        checks.check_volume(gas, self.num_particles)
        if self.start is None:
            return
        if gas.container is not None:
            check_inside(self.start, gas.container, gas.diameter * min_wall_distance)
        if self.start.angular_velocity is not None:
            raise ValueError(
                f"{type(self).__name__} draws the angular velocities of a start. Give the start "
                "without them, start._replace(angular_velocity=None), and rotational_temperature "
                "of the surface."
            )

    def noise(self, error_model: ErrorModel) -> tuple[float, float]:
        """Standard errors of ln T by shot noise and by the random amplitudes of a flow."""
        total = self.num_particles * self.replicas
        return error_model.shot_noise(total), error_model.flow_noise(self.replicas)
