"""Base of the models of particles: how a gas becomes a run of particles, and a run a curve."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, is_known, nan_where
from jaxgran._utils.validation import checked_int
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.particles import Particles
from jaxgran.data.quantities import QUANTITIES
from jaxgran.data.run_options import Run
from jaxgran.gradients.rule import Result
from jaxgran.models.base import AbstractModel
from jaxgran.models.members import split_members, start_members, with_batch_rule
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.elements import flight_time
from jaxgran.particles.groups import grouped
from jaxgran.particles.run import Recorder, run_on_host, run_traced
from jaxgran.particles.snapshot import Units, resolve_save
from jaxgran.particles.start import has_other_box, reduced_start
from jaxgran.scene.gas import Gas


class Constants(NamedTuple):
    """Inputs of a run that have no derivatives.

    Attributes:
        key: of the random numbers.
        units: of the run.
        seconds: the times of the records in SI.
    """

    key: PRNGKeyArray
    units: Units
    seconds: Float[Array, "times"]


class TracedInputs(NamedTuple):
    """Inputs of a traced run besides its scene.

    Attributes:
        times: of the records, in units of the run.
        start: given positions and velocities in units of the run; None for random ones.
        constants: inputs that have no derivatives.
        directions: of tangents in the material; None for no tangents.
    """

    times: Any
    start: Any
    constants: Constants
    directions: Any


class AbstractParticleModel(AbstractModel):
    """A model of particles.

    Attributes:
        num_particles: N of each replica.
        replicas: number of independent gases.
        start: positions and velocities given by a user; None for random ones.
        transforms_time: True if drag is integrated in transformed time, which rounding limits.
    """

    num_particles: AbstractVar[int]
    replicas: AbstractVar[int]
    start: AbstractVar[Particles | None]
    transforms_time: AbstractClassVar[bool]

    stochastic: ClassVar[bool] = True
    saves: ClassVar[bool] = True

    def __check_init__(self):
        checked_int("num_particles", self.num_particles, 2)
        checked_int("replicas", self.replicas, 1)

    @property
    @abstractmethod
    def projected(self) -> bool:
        """True if derivatives are projected or by differences, False if they are plain."""

    @abstractmethod
    def scene(self, gas: Gas) -> Any:
        """Return the gas in the units of the run."""

    @abstractmethod
    def units(self, gas: Gas) -> Units:
        """Return the units of the run."""

    @abstractmethod
    def dynamics(
        self, scene: Any, dimension: int, replicas: int, traced: bool = False
    ) -> AbstractDynamics:
        """Return the motion of the particles.

        Args:
            scene: the gas in the units of the run.
            dimension: d.
            replicas: number of replicas in one array.
            traced: whether numbers of the run are traced.
        """

    @abstractmethod
    def differentiable(
        self, run: Callable[..., Result], shifted: Callable[..., Result]
    ) -> Callable[..., Result]:
        """Return a run with derivatives, see `jaxgran.gradients.rule.differentiable`.

        Args:
            run: a function of the scene, the times, the start, the `Constants`, and directions.
            shifted: the same function without files, for further runs.
        """

    @abstractmethod
    def batch_dynamics(
        self, scene: Any, differs: Any, dimension: int, members: int
    ) -> AbstractDynamics | None:
        """Return the motion of members of a batch as replicas in one array, without a start.

        Args:
            scene: of all members in the units of the run.
            differs: the same with True at numbers that have a first axis of members.
            dimension: d.
            members: number of members.

        Returns:
            The motion; None if members cannot share an array.
        """

    @abstractmethod
    def derivative_bias(self, gas: Gas, times: Array, flow_share: Array) -> Array | None:
        """Estimate the bias of the derivatives of ln T from the flow in each replica."""

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run) -> CoolingCurve:
        """Return the cooling curve at the given times, s, as `AbstractModel.simulate` describes."""
        invalid, fault = self.invalid_times(gas, times)
        if self.start is not None:  # then T_0 is a constant unit of speed in derivatives
            gas = gas.replace(temperature=jax.lax.stop_gradient(gas.temperature))
        scene = self.scene(gas)
        units = self.units(gas)
        reduced = times * units.velocity / units.length
        if self.transforms_time and gas.drag is not None:
            reduced = flight_time(scene.drag_rates.rate, reduced)
        start = reduced_start(self.start, gas, differentiable=not self.projected)
        key = jax.random.key(0) if run.key is None else run.key
        simulated = partial(self._simulated, gas.dimension)
        without_files = Run(run.key, run.progress)
        rule = self.differentiable(
            run=partial(simulated, run), shifted=partial(simulated, without_files)
        )
        result = rule(scene, reduced, start, Constants(key, units, seconds=times))
        return self._curve(gas, times, units, result, invalid, fault, run.save == "particles")

    def invalid_times(
        self, gas: Gas, times: Float[Array, "times"]
    ) -> tuple[Bool[Array, "times"], Int[Array, ""]]:
        """Return a mask of the times that the run cannot reach, and the status for them."""
        late = jnp.zeros(times.shape, bool)
        if self.transforms_time:
            late = _unreachable_with_drag(gas, times)
        # Traced values could not be checked before the run.
        other_box = has_other_box(self.start, gas, self.num_particles)
        fault = status.flag(status.OUT_OF_RANGE, jnp.any(late))
        return late | other_box, fault | status.flag(status.BOX_MISMATCH, other_box)

    def _simulated(
        self,
        dimension: int,
        run: Run,
        scene: Any,
        times: Float[Array, "times"],
        start: Any,
        constants: Constants,
        directions: Any = None,
    ) -> Result:
        """Return the result of a run, from the host unless a number is traced.

        Args:
            dimension: d.
            run: options.
            scene, times, start: the gas, the times and a given start in units of the run.
            constants: inputs that have no derivatives.
            directions: of tangents in the material; None for no tangents.
        """
        save = resolve_save(run.save)
        if any_traced(scene, times, start, constants):
            _refuse_files(self, run)
            traced = partial(self._run_traced, dimension, save)
            if save is None and start is None and directions is None and self.projected:
                traced = with_batch_rule(traced, partial(self._run_members, dimension))
            return traced(scene, TracedInputs(times, start, constants, directions))
        groups = grouped(self.replicas, self.num_particles if self.has_positions else 0)
        dynamics = self.dynamics(scene, dimension, self.replicas // groups.number)
        recorder = Recorder(dynamics, constants.units, save)
        return run_on_host(
            recorder, times, start, constants.key, directions, groups, run, constants.seconds
        )

    def _run_traced(
        self, dimension: int, save: Callable | None, scene: Any, inputs: TracedInputs
    ) -> Result:
        """Return the result of a run of numbers some of which are traced."""
        dynamics = self.dynamics(scene, dimension, self.replicas, traced=True)
        recorder = Recorder(dynamics, inputs.constants.units, save)
        return run_traced(
            recorder, inputs.times, inputs.start, inputs.constants.key, inputs.directions
        )

    def _run_members(
        self,
        dimension: int,
        scene: Any,
        inputs: TracedInputs,
        differs: tuple[Any, TracedInputs],
        members: int,
    ) -> Result | None:
        """Return the result of members of a batch in one array; None if they cannot share it.

        Args:
            dimension: d.
            scene: of all members in the units of the run.
            inputs: of all members; no start is given, and no directions.
            differs: the scene and the inputs with True at what has a first axis of members.
            members: number of members.
        """
        scene_differs, inputs_differ = differs
        dynamics = self.batch_dynamics(scene, scene_differs, dimension, members)
        others_differ = inputs_differ.times, inputs_differ.constants._replace(key=False)
        if dynamics is None or any(jax.tree.leaves(others_differ)):
            return None
        first = jax.tree.map(lambda x, has_axis: x[0] if has_axis else x, scene, scene_differs)
        alone = self.dynamics(first, dimension, self.replicas, traced=True)
        key = inputs.constants.key
        key_differs = bool(inputs_differ.constants.key)
        start, fault = start_members(alone, key, key_differs, members)
        recorder = Recorder(dynamics, inputs.constants.units, None)
        first_key = key[0] if key_differs else key
        result = run_traced(recorder, inputs.times, start, first_key, None, fault)
        return split_members(result, members)

    @eqx.filter_jit
    def _curve(
        self,
        gas: Gas,
        times: Float[Array, "times"],
        units: Units,
        result: Result,
        invalid: Bool[Array, "times"],
        fault: Int[Array, ""],
        saves_particles: bool,
    ) -> CoolingCurve:
        """Return the curve of a run in SI, with nan at invalid times."""
        one_or_nan = jnp.where(invalid[None], jnp.nan, jnp.ones_like(gas.temperature))
        records = result.records.values
        saved = result.records.saved
        scales = {
            "1": 1.0,
            "m^2": units.length**2,
            "m^2/s^2": gas.temperature,
            "J": gas.mass * gas.temperature,
        }
        values = {
            name: records[name].T * scales[quantity.unit] * one_or_nan
            for name, quantity in QUANTITIES.items()
            if name in records
        }
        others = {}
        if self.has_positions:
            others["particles"] = units.to_particles(self.replicas, *result.particles)
        if "flow_share" in values:
            others["derivative_bias"] = self.derivative_bias(gas, times, values["flow_share"])
        curve = CoolingCurve.of_replicas(times, values, status=result.status | fault, **others)
        if saved is None:
            return curve
        saved = jax.tree.map(partial(nan_where, invalid[:, None]), saved)
        if not saves_particles:
            return curve.with_saved(jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), saved))
        box_side = jnp.broadcast_to(units.box_side, (len(times), *units.box_side.shape))
        return dataclasses.replace(curve, saved=saved._replace(box_side=box_side))


def _unreachable_with_drag(gas: Gas, times: Float[Array, "times"]) -> Bool[Array, "times"]:
    """Return a mask of the times that particle models with drag cannot reach.

    Raises:
        ValueError: if gas and times are known, and some times are too late.
    """
    if gas.drag is None:
        return jnp.zeros(times.shape, bool)
    limit = float(-0.5 * np.log(np.finfo(times.dtype).eps))  # half of the digits of 1 - gamma s
    too_late = gas.drag.rate * times > limit
    if is_known(too_late) and np.any(np.asarray(too_late)):
        raise ValueError(
            f"drag has slowed the gas by exp(-{float(gas.drag.rate * times[-1]):.3g}) at the last "
            f"time; particle models are exact up to exp(-{limit:.3g}). "
            f"End before t = {limit / float(gas.drag.rate):.4g} s, or use KineticTheory()."
        )
    return too_late


def _refuse_files(model: AbstractModel, run: Run) -> None:
    """Raise ValueError if a compiled run should write files."""
    for name in ("checkpoint", "trajectory"):
        path = getattr(run, name)
        if path is not None:
            raise ValueError(
                f"inside jax.jit and jax.vmap {type(model).__name__} cannot write a {name}, got "
                f"{str(path)!r}. Set {name}=None."
            )
