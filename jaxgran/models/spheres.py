"""What models of spheres in periodic boxes share: checks, array sizes, runs and curves.

How the derivatives of models of spheres are taken: projected, by differences, or plainly.
"""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Bool, Float

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced
from jaxgran._utils.validation import POSITIVE, Domain, no_type_check, plain_number, whole_number
from jaxgran.data.curve import DEFAULTS, CoolingCurve, Particles, Run
from jaxgran.gradients.rule import Inputs, Outputs, by_differences, differentiable
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.models.error_model import ErrorModel, slope_bias_of_run
from jaxgran.particles import neighbours, snapshot
from jaxgran.particles import run as beside
from jaxgran.particles.capacity import Capacity, skin_adding
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.run import Simulation, simulate_on_host, simulate_traced
from jaxgran.particles.setup import (
    check_start,
    has_other_box,
    reduced_start,
    with_constant_temperature,
)
from jaxgran.scene.gas import Gas

DIFFERENCE_STEPS = Domain(0.0, 0.5, high_allowed=True)
"""Steps of differences: the lower one of alpha must leave it positive."""


def check_difference_step(differences: Any, projected: bool) -> None:
    """Raise ValueError for a step of differences out of range, or beside plain derivatives."""
    if differences is None:
        return
    advice = "In the logarithm of an impact's loss: 0.3, or None for projected derivatives."
    plain_number("differences", differences, DIFFERENCE_STEPS, advice)
    if not projected:
        raise ValueError(
            f"differences = {differences} and projection = None ask for two kinds of derivative: "
            "leave one of them out"
        )


def check_gas_for_differences(differences: float | None, gas: Gas) -> None:
    """Raise ValueError for a gas whose derivatives are not known by differences."""
    if differences is not None and gas.elements:
        raise ValueError(
            "derivatives by differences are known for smooth spheres in free flight, and this gas "
            f"has {', '.join(gas.elements)}: leave differences out of the model, or take "
            "differences of runs yourself"
        )


def with_derivative_rule(
    outputs: Callable[..., Outputs],
    run: Run,
    differences: float | None,
    projected: bool,
    non_differentiable: Callable[[Any], Any],
) -> Callable[[Inputs], Outputs]:
    """A run with its rule of differentiation.

    Args:
        outputs: the run, of inputs, directions, and options.
        run: the options.
        differences: step of differences of whole runs; None for none.
        projected: whether derivatives are projected; if not they are plain.
        held: see `jaxgran.gradients.rule.differentiable`.
    """
    outputs = partial(outputs, run=run)
    if not projected:
        return outputs
    if differences is not None:
        further = partial(outputs, run=Run(run.key, run.progress))  # which write no files
        outputs = by_differences(outputs, further, differences)
    return differentiable(outputs, lambda scene: scene.material, non_differentiable)


S = TypeVar("S", bound="AbstractSpheres")


class Plan(NamedTuple):
    """The static sizes of a compiled run.

    Attributes:
        replicas: number of boxes.
        pace: static settings of the steps, which differ between kinds of spheres.
        capacity: of the run.
        melt_capacity: of the first mean free times of its melt.
    """

    replicas: int
    pace: Any
    capacity: Capacity
    equilibration_capacity: Capacity


class AbstractSpheres(AbstractModel):
    """A model of spheres in periodic boxes.

    Attributes:
        num_particles: N in each box.
        replicas: independent boxes.
        start: positions and velocities given by a user; None for random ones.
        neighbours: who finds the pairs.
        differences: step of derivatives by differences; None for projected ones.
        plan: static sizes, where `sized_for` has settled them.
        listed_by_skin: pairs per particle that the skin adds to a neighbour list.
    """

    num_particles: AbstractVar[int]
    replicas: AbstractVar[int]
    start: AbstractVar[Particles | None]
    neighbours: AbstractVar[str]
    differences: AbstractVar[float | None]
    plan: AbstractVar[Plan | None]
    listed_by_skin: AbstractClassVar[float]

    stochastic: ClassVar[bool] = True
    saves: ClassVar[bool] = True
    has_positions: ClassVar[bool] = True
    derivative_accuracy: ClassVar[float] = 0.02

    @property
    @abstractmethod
    def projected(self) -> bool:
        """Whether derivatives are projected, or by differences, and not plain."""

    def derivative_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"]:
        """Of projected derivatives, where the gas has a flow; of differences their noise."""
        if self.differences is None:
            return error_model.slope_error()
        return error_model.noise_of_differences(
            self.differences, math.hypot(*self.noise(error_model))
        )

    @abstractmethod
    def scene(self, gas: Gas) -> Any:
        """The gas in units of its diameter, mass and first temperature."""

    @abstractmethod
    def planned(self, scene: Any, dimension: int, spare: float | None = None) -> Plan:
        """Static sizes for a scene of known numbers, with a spare factor on the capacities."""

    @abstractmethod
    def dynamics(self, scene: Any, plan: Plan) -> AbstractDynamics:
        """How the spheres move."""

    @abstractmethod
    def pace_fixed(self) -> dict[str, Any]:
        """Settings of this model that `Plan.pace` repeats, by name."""

    def clock(self, scene: Any, times: Float[Array, "times"]) -> Float[Array, "times"]:
        """The time of the run at reduced times."""
        return times

    def unreachable_times(self, gas: Gas, times: Float[Array, "times"]) -> Bool[Array, "times"]:
        """Which times are too late for the clock."""
        return checks.unreachable_with_drag(gas, times)

    def filled_side(self, scene: Any) -> Array:
        """Side in diameters of a cube of the volume in which the spheres are."""
        return scene.side

    def non_differentiable(self, scene: Any) -> Any:
        """Numbers of a scene in which the derivative of a run is not known."""
        return ()

    def check_fit(self, names: tuple[str, ...]) -> None:
        """A given start has its own temperature and lengths, which then cannot be fitted."""
        if not self.projected:
            raise ValueError(
                f"a fit needs projected derivatives: give {type(self).__name__} a projection"
            )
        fixed = [n for n in ("temperature", "diameter", "packing_fraction") if n in names]
        if self.start is not None and fixed:
            raise ValueError(
                f"{' and '.join(fixed)} cannot be fitted from a given start, which has its own: "
                f"leave start out of {type(self).__name__}, or free other parameters"
            )

    @no_type_check
    def sized_for(self: S, gas: Gas, spare: float = 2.0) -> S:
        """This model with the sizes of its arrays settled, which `jax.jit` needs beforehand.

        Outside of jit sizes follow from the gas, and arrays grow where they must. Inside they are
        fixed; a run that exceeds them ends in nan and a status.

        Args:
            gas: with known numbers, like the gases to come: the densest, hottest and softest.
            spare: capacity over the expected need.
        """
        if not isinstance(gas, Gas):
            raise ValueError(f"gas must be a jaxgran.Gas, got {type(gas).__name__}")
        plain_number("spare", spare, POSITIVE, "2 is twice the expected need.")
        self.check_scene(gas)
        plan = self.planned(self.scene(gas), gas.dimension, spare)
        return dataclasses.replace(self, plan=plan)

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run = DEFAULTS) -> CoolingCurve:
        """The cooling curve at the given times, s; see `jaxgran.AbstractModel.simulate`."""
        unreachable_times = self.unreachable_times(gas, times)
        gas = with_constant_temperature(self.start, gas)
        scene = self.scene(gas)
        inputs = Inputs(
            scene=scene,
            times=self.clock(scene, times * jnp.sqrt(gas.temperature) / gas.diameter),
            start=reduced_start(self.start, gas, differentiable=not self.projected),
            key=run.key,
        )
        inputs = inputs._replace(units=self._units(gas, inputs.scene.side))

        def outputs(inputs: Inputs, directions: Any = None, run: Run = run) -> Outputs:
            return self._outputs(inputs, directions, gas.dimension, run)

        how = self.differences, self.projected, self.non_differentiable
        found = with_derivative_rule(outputs, run, *how)(inputs)
        return self._curve(gas, times, inputs.units, found, unreachable_times, run.save)

    def _units(self, gas: Gas, side: Array) -> snapshot.Units:
        """Of what is seen of the particles, SI."""
        length, velocity = gas.diameter, jnp.sqrt(gas.temperature)
        box_side = side * length if gas.container is None else gas.container.side
        return snapshot.Units(length, velocity, 2 * velocity / length, box_side, gas.mass)

    def _outputs(self, inputs: Inputs, directions: Any, dimension: int, run: Run) -> Outputs:
        """The run in reduced units: driven from the host if all numbers are known, else pure."""
        if not any_traced(inputs) and (
            on := beside.replica_devices(self.replicas, self.num_particles)
        ):
            alone = dataclasses.replace(self, replicas=1, start=None, plan=None)

            def one(k: int, run: Run) -> Outputs:
                own = beside.replica_inputs(inputs, k, self.num_particles, run)
                return alone._outputs(own, directions, dimension, run)

            return beside.join_outputs(beside.run_replicas(one, self.replicas, run, on))
        plan = self._settled_plan(inputs.scene, dimension)
        side = self.filled_side(inputs.scene)
        skin = skin_adding(self.listed_by_skin, self.num_particles, side, dimension)
        sim = Simulation(
            dynamics=self.dynamics(inputs.scene, plan),
            equilibration_capacity=plan.equilibration_capacity,
            inputs=inputs,
            directions=directions,
            num_particles=self.num_particles,
            dimension=dimension,
            skin=skin,
            engine=self.neighbours,
            save=snapshot.function(run.save),
        )
        if not any_traced(inputs):
            model = dataclasses.replace(self, start=None, plan=None)
            return simulate_on_host(sim, run, {"model": model, "pace": plan.pace})
        checks.refuse_files(self, run)
        if self.neighbours == "jax-md":
            raise ValueError(
                'inside jax.jit or jax.vmap neighbours="jax-md" cannot find the pairs, as it sizes '
                "its cells from known numbers: leave neighbours out"
            )
        return simulate_traced(sim)

    def _settled_plan(self, scene: Any, dimension: int) -> Plan:
        """The model's plan, or one made now, if all numbers that it depends on are known."""
        name = type(self).__name__
        if self.plan is not None:
            planned = {"replicas": self.plan.replicas} | self.plan.pace._asdict()
            for setting, value in ({"replicas": self.replicas} | self.pace_fixed()).items():
                if planned[setting] != value:
                    raise ValueError(
                        f"this {name} was sized for {setting} = {planned[setting]!r}, and now has "
                        f"{value!r}: call sized_for(gas) again"
                    )
            return self.plan
        try:
            with jax.ensure_compile_time_eval():
                return self.planned(scene, dimension)
        except jax.errors.ConcretizationTypeError:
            raise ValueError(
                f"inside jax.jit the sizes of arrays must be known: give {name}(...)"
                ".sized_for(gas), made outside with a gas of known numbers"
            ) from None

    def _curve(
        self,
        gas: Gas,
        times: Float[Array, "times"],
        units: snapshot.Units,
        out: Outputs,
        unreachable_times: Bool[Array, "times"],
        save: Any,
    ) -> CoolingCurve:
        """The curve in SI units, of records in units of diameter, mass and first temperature."""
        energy = gas.mass * gas.temperature
        of_records = {
            "temperature": gas.temperature,
            "sonine": 1.0,
            "displacement": gas.diameter**2,
            "velocity_correlation": gas.temperature,
            "elastic_energy": energy,
            "dissipated_energy": energy,
            "collisions": 1.0,
            "regularised": 1.0,
            "flow_share": 1.0,
            "rotational_temperature": gas.temperature,
        }
        known = [name for name in of_records if name in out.records]
        each = {name: out.records[name].T * of_records[name] for name in known}
        # Where it could not be checked before.
        other = has_other_box(self.start, gas, self.num_particles)
        wrong = other | unreachable_times
        each = {name: jnp.where(wrong[None], jnp.nan, values) for name, values in each.items()}
        particles = snapshot.particles(units, self.replicas, out.position, out.velocity, out.spin)
        late = status.flag(status.OUT_OF_RANGE, jnp.any(unreachable_times))
        curve = CoolingCurve.of_replicas(
            times,
            each,
            particles=particles,
            status=out.status | status.flag(status.OTHER_BOX, other) | late,
            derivative_bias=self._bias(gas, times, each.get("flow_share")),
        )
        return snapshot.with_saved(curve, save, out.records, particles, wrong[None])

    def _bias(self, gas: Gas, times: Array, flow_share: Array | None) -> Array | None:
        """Estimated bias of projected derivatives, 0 in a box below L_c, which has no flow."""
        if flow_share is None or self.differences is not None or not self.projected:
            return None
        longer = gas.box_side(self.num_particles) > gas.critical_box
        return jnp.where(longer, slope_bias_of_run(times, jnp.mean(flow_share, axis=0)), 0.0)

    def check_counts(self, **least: int) -> None:
        """Raise ValueError where a whole number of the model is less than it must be."""
        for name, lowest in ({"num_particles": 2, "replicas": 1} | least).items():
            whole_number(name, getattr(self, name), lowest)
        neighbours.choose_engine(self.neighbours)
        check_difference_step(self.differences, self.projected)

    def check_box(self, gas: Gas) -> None:
        """Raise ValueError for a gas too dense, a box too small, or a start not of this gas."""
        check_start(self.start, gas, self.replicas, self.num_particles)
        check_gas_for_differences(self.differences, gas)
        checks.check_packing(gas, self.num_particles, random=self.start is None)

    def noise(self, error_model: ErrorModel) -> tuple[float, float]:
        """Standard errors of ln T by shot noise and by the chance amplitudes of a flow."""
        total = self.num_particles * self.replicas
        return error_model.shot_noise(total), error_model.flow_noise(self.replicas)
