"""Base of the models of spheres in boxes: what hard and soft spheres accept, and how they run."""

import dataclasses
import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Float

from jaxgran._utils.validation import POSITIVE, Domain, checked_float
from jaxgran.gradients.differences import by_differences
from jaxgran.gradients.rule import Result, differentiable
from jaxgran.models import checks
from jaxgran.models.array_sizes import SIZED_MEMBERS, ArraySizes
from jaxgran.models.error_model import ErrorModel, slope_bias_of_run
from jaxgran.models.members import differ_in_law_alone, with_axis_of_replicas
from jaxgran.models.particle_model import AbstractParticleModel
from jaxgran.particles.capacity import Neighbourhood
from jaxgran.particles.neighbours.lists import check_engine, choose_engine
from jaxgran.particles.snapshot import Units
from jaxgran.particles.spheres import AbstractSphereDynamics
from jaxgran.particles.start import check_inside, check_start
from jaxgran.scene.gas import Gas
from jaxgran.scene.reduced import SphereScene

DIFFERENCE_STEPS = Domain(0.0, 0.5, high_allowed=True)
"""Allowed steps of differences: the lower value of alpha must stay positive."""


class AbstractSpheres(AbstractParticleModel):
    """A model of spheres in periodic boxes.

    Attributes:
        neighbours: the search for pairs.
        differences: step of derivatives by differences; None for projected ones.
        listed_by_skin: pairs per particle that the skin adds to a neighbour list.
        sized_by: fields for which the sizes of arrays are made.
    """

    neighbours: AbstractVar[str]
    differences: AbstractVar[float | None]
    _sizes: AbstractVar[ArraySizes | None]
    listed_by_skin: AbstractClassVar[float]
    sized_by: AbstractClassVar[tuple[str, ...]]

    has_positions: ClassVar[bool] = True
    derivative_accuracy: ClassVar[float] = 0.02

    @abstractmethod
    def scene(self, gas: Gas) -> SphereScene:
        """Return the gas in units of its diameter, mass and initial temperature."""

    @abstractmethod
    def needed_sizes(
        self, scene: SphereScene, dimension: int, replicas: int, spare: float | None = None
    ) -> ArraySizes:
        """Return static sizes for a scene of known numbers, with a spare factor on capacities."""

    @abstractmethod
    def motion(
        self, scene: SphereScene, shape: tuple[int, int, int], sizes: ArraySizes, engine: str
    ) -> AbstractSphereDynamics:
        """Return the motion of the spheres.

        Args:
            scene: the gas in the units of the run.
            shape: number of replicas, of particles in each, and dimension.
            sizes: static sizes of its arrays.
            engine: search for pairs, see `jaxgran.particles.neighbours.lists`.
        """

    @abstractmethod
    def refused_derivatives(self, scene: SphereScene) -> dict[str, Any]:
        """Return numbers of a scene in which the derivative of a run is not known, by a message."""

    @abstractmethod
    def law_of_replicas(self, laws: Any, differs: Any) -> Any:
        """Return the law of the impacts of replicas that have different ones.

        Args:
            laws: law whose numbers have a first axis of replicas.
            differs: the same law with True at numbers that differ.

        Returns:
            The law; None if replicas with different numbers cannot share an array.
        """

    def __check_init__(self):
        check_engine(self.neighbours)
        if self.differences is None:
            return
        advice = "Step in ln(loss), typically 0.3; None for projected derivatives."
        checked_float("differences", self.differences, DIFFERENCE_STEPS, advice)
        if not self.projected:
            raise ValueError(
                f"differences = {self.differences} and projection = None ask for two kinds of "
                "derivative. Leave one of them out."
            )

    def check_spheres(self, gas: Gas, min_wall_distance: float) -> None:
        """Raise ValueError for a start, derivatives or a box that spheres do not support.

        Args:
            gas: the gas.
            min_wall_distance: least distance, in diameters, of a centre of the start from a wall.
        """
        self._check_start(gas, min_wall_distance)
        self._check_differences(gas)
        if self.start is None:
            checks.check_packing(gas)
        checks.check_box_side(gas, self.num_particles)
        checks.check_volume(gas, self.num_particles)

    def _check_start(self, gas: Gas, min_wall_distance: float) -> None:
        """Raise ValueError for a start of another gas, outside of walls, or with given spins."""
        if self.start is None:
            return
        check_start(self.start, gas, self.replicas, self.num_particles)
        if gas.container is not None:
            check_inside(self.start, gas.container, gas.diameter * min_wall_distance)
        if self.start.angular_velocity is not None:
            raise ValueError(
                f"{type(self).__name__} draws the angular velocities of a start. Give the start "
                "without them, start._replace(angular_velocity=None), and rotational_temperature "
                "of the surface."
            )

    def _check_differences(self, gas: Gas) -> None:
        """Raise ValueError for derivatives by differences in a gas with further elements."""
        if self.differences is not None and gas.elements:
            raise ValueError(
                "derivatives by differences need smooth spheres in free flight, and this gas has "
                f"{', '.join(gas.elements)}. Leave differences out of the model, or take "
                "differences of runs yourself."
            )

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

    def noise(self, error_model: ErrorModel) -> tuple[float, float]:
        """Standard errors of ln T by shot noise and by the random amplitudes of a flow."""
        total = self.num_particles * self.replicas
        return error_model.shot_noise(total), error_model.flow_noise(self.replicas)

    def derivative_error(self, error_model: ErrorModel) -> Float[np.ndarray, "times"]:
        """Relative error of projected derivatives by a flow, or of differences by their noise."""
        if self.differences is None:
            return error_model.slope_error()
        noise = math.hypot(*self.noise(error_model))
        return error_model.noise_of_differences(self.differences, noise)

    @eqx.filter_jit
    def derivative_bias(self, gas: Gas, times: Array, flow_share: Array) -> Array | None:
        """Estimate the bias of projected derivatives, 0 in a box below L_c, which has no flow."""
        if self.differences is not None or not self.projected:
            return None
        has_flow = gas.box_side(self.num_particles) > gas.critical_box
        return jnp.where(has_flow, slope_bias_of_run(times, jnp.mean(flow_share, axis=0)), 0.0)

    def neighbourhood(self, scene: SphereScene, dimension: int, replicas: int) -> Neighbourhood:
        """Return the expected numbers of neighbours in a scene of known numbers."""
        side = float(scene.filled_side)
        longer = 1.0
        if scene.container is not None:  # the sweep runs along the first axis
            longer = max(1.0, side / float(scene.container[0]))
        return Neighbourhood.expected(
            side,
            self.num_particles,
            replicas,
            dimension,
            listed_more=self.listed_by_skin,
            engine=self.neighbours,
            longer=longer,
        )

    def sized_for(self, gas: Gas, spare: float = 2.0) -> Self:
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
        needed = partial(self.needed_sizes, self.scene(gas), gas.dimension)
        sizes = needed(self.replicas, spare)._replace(
            made_for=tuple((name, getattr(self, name)) for name in self.sized_by),
            of_batch=needed(SIZED_MEMBERS * self.replicas, spare),
        )
        return dataclasses.replace(self, _sizes=sizes)

    def _known_sizes(self, scene: SphereScene, dimension: int, replicas: int) -> ArraySizes:
        """Return the sizes of the model, or new ones if all numbers that they need are known.

        The sizes of the model are for all its replicas in one array.
        """
        if self._sizes is not None:
            self._sizes.check_made_for(self)
            if replicas == self.replicas:
                return self._sizes
        try:
            with jax.ensure_compile_time_eval():
                return self.needed_sizes(scene, dimension, replicas)
        except jax.errors.ConcretizationTypeError:
            raise ValueError(
                "inside jax.jit the sizes of arrays must be known. Use "
                f"{type(self).__name__}(...).sized_for(gas), with a gas of known numbers and "
                "outside of jax.jit."
            ) from None

    def units(self, gas: Gas) -> Units:
        """Return the diameter and the thermal speed as units."""
        speed = jnp.sqrt(gas.temperature)
        return Units.from_gas(gas, self.num_particles, gas.diameter, speed)

    def differentiable(
        self, run: Callable[..., Result], shifted: Callable[..., Result]
    ) -> Callable[..., Result]:
        """Return runs with projected derivatives, with differences of runs, or unchanged."""
        if not self.projected:
            return run
        if self.differences is not None:
            run = by_differences(run, shifted, self.differences)
        return differentiable(
            run,
            material=lambda scene: scene.material,
            frequency=lambda scene: scene.collision_frequency,
            refused=self.refused_derivatives,
        )

    def dynamics(
        self, scene: SphereScene, dimension: int, replicas: int, traced: bool = False
    ) -> AbstractSphereDynamics:
        """Return the motion of the spheres, with arrays of the sizes that it needs."""
        sizes = self._known_sizes(scene, dimension, replicas)
        engine = choose_engine(self.neighbours, sizes.engine, traced=traced)
        if traced and engine == "jax-md":
            raise ValueError(
                'inside jax.jit or jax.vmap neighbours="jax-md" is not supported, since it sizes '
                "its cells from known numbers: leave neighbours out"
            )
        return self.motion(scene, (replicas, self.num_particles, dimension), sizes, engine)

    def batch_dynamics(
        self, scene: SphereScene, differs: SphereScene, dimension: int, members: int
    ) -> AbstractSphereDynamics | None:
        """Return the motion of members that differ in their law alone; None for all others."""
        sizes = None if self._sizes is None else self._sizes.for_members(members)
        if sizes is None or not differ_in_law_alone(differs):
            return None
        differing = differs.material.law
        laws = with_axis_of_replicas(scene.material.law, differing, members, self.replicas)
        law = self.law_of_replicas(laws, differing)
        if law is None:
            return None
        shared_scene = scene._replace(
            contact_duration=jnp.min(scene.contact_duration),
            material=scene.material._replace(law=law),
        )
        engine = choose_engine(self.neighbours, sizes.engine, traced=True)
        shape = members * self.replicas, self.num_particles, dimension
        return self.motion(shared_scene, shape, sizes, engine)
