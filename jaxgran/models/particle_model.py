"""Base of the models of particles: how a gas becomes a run of particles, and a run a curve."""

import dataclasses
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Bool, Float, Int

from jaxgran._utils import status
from jaxgran._utils.tracing import any_traced, nan_where
from jaxgran.data.curve import CoolingCurve
from jaxgran.data.particles import Particles
from jaxgran.data.quantities import QUANTITIES
from jaxgran.data.run_options import DEFAULTS, Run
from jaxgran.gradients.rule import Result
from jaxgran.models import checks
from jaxgran.models.base import AbstractModel
from jaxgran.models.members import by_member, together
from jaxgran.particles import snapshot
from jaxgran.particles.dynamics import AbstractDynamics
from jaxgran.particles.elements import flight_time
from jaxgran.particles.run import Recorder, grouped, run_on_host, run_traced, start_traced
from jaxgran.particles.start import has_other_box, reduced_start
from jaxgran.scene.gas import Gas


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

    @property
    @abstractmethod
    def projected(self) -> bool:
        """True if derivatives are projected or by differences, False if they are plain."""

    @abstractmethod
    def scene(self, gas: Gas) -> Any:
        """Return the gas in the units of the run."""

    @abstractmethod
    def units(self, gas: Gas) -> snapshot.Units:
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
            run: a function of the scene, the times, the start, all else, and directions.
            shifted: the same function without files, for further runs.
        """

    @abstractmethod
    def merged(
        self, dimension: int, scene: Any, differs: Any, members: int
    ) -> AbstractDynamics | None:
        """Return the motion of members of a batch as replicas in one array, without a start.

        Args:
            dimension: d.
            scene: of all members in the units of the run.
            differs: the same with True at numbers that have a first axis of members.
            members: number of members.

        Returns:
            The motion; None if members cannot share an array.
        """

    @abstractmethod
    def derivative_bias(self, gas: Gas, times: Array, flow_share: Array) -> Array | None:
        """Estimate the bias of the derivatives of ln T from the flow in each replica."""

    def simulate(self, gas: Gas, times: Float[Array, "times"], run: Run = DEFAULTS) -> CoolingCurve:
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
        rule = self.differentiable(
            partial(simulated, run), partial(simulated, Run(run.key, run.progress))
        )
        result = rule(scene, reduced, start, (key, units, times))
        return self._curve(gas, times, units, result, invalid, fault, run.save == "particles")

    def invalid_times(
        self, gas: Gas, times: Float[Array, "times"]
    ) -> tuple[Bool[Array, "times"], Int[Array, ""]]:
        """Return a mask of the times that the run cannot reach, and the status for them."""
        late = jnp.zeros(times.shape, bool)
        if self.transforms_time:
            late = checks.unreachable_with_drag(gas, times)
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
        others: Any,
        directions: Any = None,
    ) -> Result:
        """Return the result of a run, from the host unless a number is traced.

        Args:
            dimension: d.
            run: options.
            scene, times, start: the gas, the times and a given start in units of the run.
            others: key of the random numbers, units of the run, and the times in SI.
            directions: of tangents in the material; None for no tangents.
        """
        save = snapshot.resolve_save(run.save)
        if any_traced(scene, times, start, others):
            checks.refuse_files(self, run)
            traced = partial(self._run_traced, dimension, save)
            if save is None and start is None and directions is None and self.projected:
                traced = together(traced, partial(self._run_members, dimension))
            return traced(scene, (times, start, others, directions))
        key, units, seconds = others
        groups = grouped(self.replicas, self.num_particles if self.has_positions else 0)
        dynamics = self.dynamics(scene, dimension, self.replicas // groups.number)
        recorder = Recorder(dynamics, units, save)
        return run_on_host(recorder, times, start, key, directions, groups, run, seconds)

    def _run_traced(self, dimension: int, save: Any, scene: Any, others: Any) -> Result:
        """Return the result of a run of numbers some of which are traced."""
        times, start, (key, units, _), directions = others
        dynamics = self.dynamics(scene, dimension, self.replicas, traced=True)
        recorder = Recorder(dynamics, units, save)
        return run_traced(recorder, times, start, key, directions)

    def _run_members(
        self, dimension: int, scene: Any, others: Any, differs: Any, members: int
    ) -> Result | None:
        """Return the result of members of a batch in one array; None if they cannot share it.

        They have a common start, as they would have alone, or one for each key.
        """
        scene_differs, (times_differ, _, (key_differs, *constants_differ), _) = differs
        times, _, (key, units, _), _ = others
        dynamics = self.merged(dimension, scene, scene_differs, members)
        if dynamics is None or any(jax.tree.leaves((times_differ, constants_differ))):
            return None
        first = jax.tree.map(lambda x, has_axis: x[0] if has_axis else x, scene, scene_differs)
        alone = self.dynamics(first, dimension, self.replicas, traced=True)
        if key_differs:
            start, faults = jax.vmap(partial(start_traced, alone))(key)
            start = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), start)
            fault = jnp.bitwise_or.reduce(faults)
            key = key[0]
        else:
            start, fault = start_traced(alone, key)
            start = jax.tree.map(lambda x: jnp.tile(x, (members, 1)), start)
        result = run_traced(Recorder(dynamics, units, None), times, start, key, None, fault)
        return by_member(result, members)

    @eqx.filter_jit
    def _curve(
        self,
        gas: Gas,
        times: Float[Array, "times"],
        units: snapshot.Units,
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
            others["particles"] = snapshot.to_particles(units, self.replicas, *result.particles)
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
